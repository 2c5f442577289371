"""The output network G: what sensors show beyond the prior's output equation, trained after the dynamics."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.evaluate import FreeRun
from hybrid_mpc.identify.networks import StackedFeedForward
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.torch_prior import Prior


@dataclass(frozen=True)
class OutputSettings:
    """Everything that decides the training of output networks.

    Args:
        hidden: Units of each of the two layers.
        networks: Networks trained at once; they differ in their initial weights.
        steps: Optimiser steps.
        seed: Seed of weights and batches.
        batch: Samples a step.
        decay: Weight decay of AdamW times the number of training samples.
        learning_rates: Start and end of the cosine schedule.
        every: Steps between evaluations on validation samples.

    Raises:
        InputError: If a number of units, networks, steps, samples is not positive.

    Example:
        >>> OutputSettings().hidden
        16
    """

    hidden: int = 16
    networks: int = 4
    steps: int = 1500
    seed: int = 0
    batch: int = 256
    decay: float = 1.0
    learning_rates: tuple[float, float] = (1e-2, 1e-4)
    every: int = 50

    def __post_init__(self) -> None:
        for name in ("hidden", "networks", "steps", "batch", "every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} of an output network must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class OutputScaling:
    """Magnitudes of features and correction; part of the model.

    Args:
        x: Scale of each state ``(n_x,)``.
        u: Scale of each input ``(n_u,)``.
        y: Scale of the prior's outputs as features ``(n_y,)``.
        correction: Scale of what the network adds ``(n_y,)``.
    """

    x: tuple[float, ...]
    u: tuple[float, ...]
    y: tuple[float, ...]
    correction: tuple[float, ...]


class OutputModel(nn.Module):
    """``y_hat = prior.output(x, u) + G(x, u, prior.output(x, u))``, as ``(x, u) -> y``; it has no memory.

    An angle that turns enters as sine and cosine, other signals scaled. A deployed model's output is a function of
    ``(x, u)``, so G is: what depends on the past (backlash, hysteresis of a sensor) is out of its reach.

    Args:
        prior: Names the signals, gives the output that is corrected.
        network: ``(s, h) -> (correction, h)`` with an empty h, one or a stack.
        scaling: Magnitudes.
    """

    scale_x: Tensor
    scale_u: Tensor
    scale_y: Tensor
    scale_correction: Tensor

    def __init__(self, prior: Prior, network: nn.Module, scaling: OutputScaling) -> None:
        super().__init__()
        self.prior, self.network = prior, network
        for name in ("x", "u", "y", "correction"):
            self.register_buffer(f"scale_{name}", torch.tensor(getattr(scaling, name), dtype=torch.float64))

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """Outputs ``(..., n_y)``."""
        return self.prior.output(x, u) + self.correction(x, u)

    def correction(self, x: Tensor, u: Tensor) -> Tensor:
        """What the network adds to the prior's outputs, ``(..., n_y)`` [output units]."""
        parts = _features(self.prior.states, x, self.scale_x)
        parts += [u / self.scale_u, *_features(self.prior.outputs, self.prior.output(x, u), self.scale_y)]
        out: Tensor = self.network(torch.cat(parts, dim=-1), x[..., :0])[0]
        return out * self.scale_correction


@dataclass(frozen=True)
class TrainedOutput:
    """Result of the training of output networks: plain arrays.

    Args:
        settings: What it was trained with.
        scaling: Magnitudes inside the model.
        weights: Best weights of each network by its validation, stacked.
        validation: Best validation error of each network ``(networks,)``: root mean square of the outputs' errors, each
            in units of ``scaling.correction``.
        without: The same of the prior's output alone.
    """

    settings: OutputSettings
    scaling: OutputScaling
    weights: Mapping[str, NDArray[np.float64]]
    validation: NDArray[np.float64]
    without: float

    @property
    def best(self) -> int:
        """The network with the lowest validation error."""
        return int(np.argmin(self.validation))

    def model(self, prior: Prior, i: int | None = None) -> OutputModel:
        """The output of network ``i`` (default: the best), for ``trace_model(step, output=...)``."""
        stack = _stack(prior, self.settings)
        stack.load_state_dict({name: torch.tensor(value) for name, value in self.weights.items()})
        member = stack.member(self.best if i is None else i)
        return OutputModel(prior, member, self.scaling).requires_grad_(False)


def train_output(
    prior: Prior,
    training: Sequence[Trajectory] | Sequence[FreeRun],
    validation: Sequence[Trajectory] | Sequence[FreeRun],
    settings: OutputSettings | None = None,
    *,
    skip: int = 0,
    on_progress: Callable[[int, int, float], None] = lambda done, total, error: None,
) -> TrainedOutput:
    """Train a stack of output networks on measured outputs; the best weights of each by validation are kept.

    Where the states come from decides what can be found:

    - :class:`~hybrid_mpc.data.trajectories.Trajectory`: measured states (a reference sensor, a simulation). States
      that were smoothed *from these outputs* by the prior carry the sensor's error themselves; nothing is left to find.
    - :class:`~hybrid_mpc.identify.evaluate.FreeRun` of a model F over recordings: F's own states, for outputs
      that are all there is. What F's equation tells about absolute states can then be found: an encoder's constant
      offset where gravity pulls towards a known direction and damping forgets the start; not on an axis without
      gravity, which is the same at every angle. An error of F is learned with it.

    The networks start as the prior's output, so validation never gets worse than that.

    Args:
        prior: Names the signals, gives the output that is corrected.
        training: Training runs, with measured outputs ``y``.
        validation: Validation runs; they choose weights.
        settings: Default: ``OutputSettings()``.
        skip: Samples at the start of each run that are left out: what a free run needs to forget a start that came
            from these very outputs. Default 0.
        on_progress: ``(done, total, best validation error)`` at every evaluation.

    Raises:
        InputError: If there are no runs, ``skip`` leaves nothing of one, columns do not fit the prior, or a value is
            not finite.

    Source: network G of Schön, Götte, Timmermann (IFAC ALCOS 2022), whose further input is the prior's output.
    """
    s = settings or OutputSettings()
    x, u, y = _samples(prior, training, skip)
    valid = _samples(prior, validation, skip)
    with torch.no_grad():
        plain = prior.output(x, u)
        scaling = OutputScaling(_rms(x), _rms(u), _rms(plain), _rms(y - plain))
        model = OutputModel(prior, _stack(prior, s), scaling)
        without = float(_errors(prior.output, valid, model.scale_correction))
    weights = dict(model.network.named_parameters())
    best = torch.full((s.networks,), math.inf, dtype=torch.float64)
    best_weights = {name: w.detach().clone() for name, w in weights.items()}
    optimizer = torch.optim.AdamW(list(weights.values()), weight_decay=s.decay / len(x))
    rng, (start, end) = np.random.default_rng(s.seed), s.learning_rates
    for done in range(s.steps + 1):
        if done % s.every == 0 or done == s.steps:
            with torch.no_grad():
                error = _errors(model, valid, model.scale_correction)
            better = error < best  # not where it is no number
            best = torch.where(better, error, best)
            for name, w in weights.items():
                best_weights[name] = torch.where(better.view(-1, 1, 1), w.detach(), best_weights[name])
            on_progress(done, s.steps, float(best.min()))
        if done == s.steps:
            break
        take = torch.tensor(rng.integers(len(x), size=s.batch))
        optimizer.zero_grad()
        loss = ((model(x[take], u[take]) - y[take]) / model.scale_correction).square().mean((1, 2)).sum()
        loss.backward()
        optimizer.param_groups[0]["lr"] = end + 0.5 * (start - end) * (
            1.0 + math.cos(math.pi * done / s.steps)
        )
        optimizer.step()
    arrays = {name: w.numpy() for name, w in best_weights.items()}
    return TrainedOutput(s, scaling, arrays, best.numpy(), without)


def with_output(runs: Sequence[FreeRun], output: OutputModel) -> list[FreeRun]:
    """Free runs with ``y_hat`` from an output model, for :func:`~hybrid_mpc.identify.evaluate.score`."""
    with torch.no_grad():
        return [replace(r, y_hat=output(torch.tensor(r.x_hat), torch.tensor(r.u)).numpy()) for r in runs]


def _features(signals: Sequence[Signal], values: Tensor, scale: Tensor) -> list[Tensor]:
    parts = []
    for i, signal in enumerate(signals):
        column = values[..., i : i + 1]
        turned = [torch.sin(column), torch.cos(column)] if signal.periodic else [column / scale[i : i + 1]]
        parts += turned
    return parts


def _stack(prior: Prior, s: OutputSettings) -> StackedFeedForward:
    signals = (*prior.states, *prior.inputs, *prior.outputs)
    n_in = len(signals) + sum(x.periodic for x in (*prior.states, *prior.outputs))
    n_y = len(prior.outputs)
    return StackedFeedForward(s.networks, n_in, s.hidden, n_y, seed=s.seed, zero_head=True)


def _samples(
    prior: Prior, runs: Sequence[Trajectory] | Sequence[FreeRun], skip: int
) -> tuple[Tensor, Tensor, Tensor]:
    """States, inputs and outputs of all runs, ``(n, columns)``; the states of a free run are the model's."""
    if not runs:
        raise InputError("an output network needs training and validation runs, at least one of each")
    out: dict[str, list[NDArray[np.float64]]] = {"x": [], "u": [], "y": []}
    sizes = {"x": len(prior.states), "u": len(prior.inputs), "y": len(prior.outputs)}
    for run in runs:
        if not 0 <= skip < len(run.t):
            raise InputError(
                f"{run.name}: it has {len(run.t)} samples, skip = {skip} leaves none; lower skip"
            )
        for name, size in sizes.items():
            values = run.x_hat if name == "x" and isinstance(run, FreeRun) else getattr(run, name)
            if values.shape[1] != size:
                raise InputError(
                    f"{run.name}: {name} has {values.shape[1]} columns, {type(prior).__name__} has {size}"
                )
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(bad):
                raise InputError(
                    f"{run.name}: {name} is not finite at {run.t[bad[0]]:g} s ({len(bad)} samples in all); leave "
                    "these samples out, or take a model whose free runs stay finite"
                )
            out[name].append(values[skip:])
    x, u, y = (torch.tensor(np.concatenate(parts)) for parts in out.values())
    return x, u, y


def _errors(
    output: Callable[[Tensor, Tensor], Tensor], samples: tuple[Tensor, Tensor, Tensor], scale: Tensor
) -> Tensor:
    """Root mean square over samples and outputs, a value a network (or one)."""
    x, u, y = samples
    return ((output(x, u) - y) / scale).square().mean((-2, -1)).sqrt()


def _rms(values: Tensor) -> tuple[float, ...]:
    return tuple(float(v) for v in values.square().mean(0).sqrt().clamp_min(1e-9))
