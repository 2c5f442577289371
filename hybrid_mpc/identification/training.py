"""Training of recurrent corrections: teacher forcing, then free runs; checkpointed and resumable."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.checkpoint import load_checkpoint, save_checkpoint
from hybrid_mpc.identification.dataset import Windows, cut_windows, fitting_horizon, scaling_of
from hybrid_mpc.identification.networks import GRUNetwork, StackedGRU
from hybrid_mpc.identification.objectives import (
    OBJECTIVES,
    Prediction,
    VectorPerformanceIndex,
    error_objective,
    free_run,
    teacher_forced,
)
from hybrid_mpc.identification.step import HybridStep, Scaling, n_features
from hybrid_mpc.physics import Prior

Kind = Literal["rnn", "pgrnn", "mopgrnn"]
KINDS: tuple[Kind, ...] = ("rnn", "pgrnn", "mopgrnn")
NAMES = tuple(OBJECTIVES)


@dataclass(frozen=True)
class TrainingSettings:
    """Everything that decides a training; two trainings with equal settings and data are equal.

    Args:
        kind: ``"rnn"`` (no prior), ``"pgrnn"`` (prior, error objective), ``"mopgrnn"`` (error and energy).
        hidden: Hidden units z.
        networks: Networks trained at once; they differ in their initial weights.
        teacher_steps: Optimiser steps with teacher forcing.
        free_run_steps: Optimiser steps on free runs.
        seed: Seed of weights and batches.
        warm: Warm-up samples of a window.
        horizon: Most scored periods of a free-run window; fewer where a trajectory is short
            (:func:`~hybrid_mpc.identification.dataset.fitting_horizon`).
        batch: Windows a step.
        decay: Weight decay of AdamW times the number of training samples: the weights' prior counts the
            less, the more data there are. Small recordings need it, large ones do not notice.
        learning_rates: Start and end of the cosine schedule, teacher forcing then free runs.
        every: Steps between evaluations (bounds, validation, checkpoint).
    """

    kind: Kind
    hidden: int
    networks: int
    teacher_steps: int
    free_run_steps: int
    seed: int
    warm: int
    horizon: int = 50
    batch: int = 32
    decay: float = 300.0
    learning_rates: tuple[float, float, float, float] = (1e-2, 1e-3, 5e-3, 1e-4)
    every: int = 25


@dataclass(frozen=True)
class Trained:
    """Result of a training: plain arrays, so that it travels between processes and into files.

    Args:
        settings: What it was trained with.
        scaling: Magnitudes inside the model.
        weights: Best weights of each network by its validation, stacked.
        validation: Best validation error of each network ``(networks,)``.
        curve: ``step, free_run, loss_error, loss_energy, bound_error, bound_energy, validation``; one row an
            evaluation, a column a network.
        skipped: Updates skipped for a loss that was not finite, per network.
    """

    settings: TrainingSettings
    scaling: Scaling
    weights: Mapping[str, NDArray[np.float64]]
    validation: NDArray[np.float64]
    curve: Mapping[str, NDArray[np.float64]]
    skipped: NDArray[np.int64]

    @property
    def best(self) -> int:
        """The network with the lowest validation error."""
        return int(np.argmin(self.validation))

    def step(self, prior: Prior, dt: float, i: int | None = None) -> HybridStep:
        """The hybrid step of network ``i`` (default: the best)."""
        stack = _stack(prior, self.settings)
        stack.load_state_dict({name: torch.tensor(value) for name, value in self.weights.items()})
        network: GRUNetwork = stack.member(self.best if i is None else i)
        use_prior = self.settings.kind != "rnn"
        return HybridStep(prior, network, self.scaling, dt, use_prior=use_prior).requires_grad_(False)


Progress = Callable[[int, int, float], None]


def train(
    prior: Prior,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    *,
    checkpoint: Path | None = None,
    on_progress: Progress = lambda done, total, error: None,
) -> Trained:
    """Train a stack of networks on trajectories; the best weights of each by validation free runs are kept.

    First teacher forcing (the paper's training), then free runs with back-propagation through the
    integrator. All kinds get the same steps, batches and data.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories; they choose weights, they are not trained on.
        settings: See :class:`TrainingSettings`.
        checkpoint: File to save to and to resume from; default: none.
        on_progress: ``(done, total, best validation error)`` at every evaluation.

    Raises:
        InputError: If no trajectory is long enough, or the checkpoint is of another training.
    """
    torch.set_num_threads(1)  # tensors this small only lose by threads
    run = _Run(prior, training, validation, settings)
    key = _key(settings, training, validation, prior)
    total = settings.teacher_steps + settings.free_run_steps
    if checkpoint is not None and checkpoint.is_file():
        run.restore(*load_checkpoint(checkpoint, key))
    while run.done < total:
        if run.done in (0, settings.teacher_steps):
            run.enter_stage()
        for _ in range(min(settings.every, run.stage_end - run.done)):
            run.update()
        run.evaluate()
        if checkpoint is not None:
            save_checkpoint(checkpoint, key, *run.snapshot())
        on_progress(run.done, total, float(run.best.min()))
    return run.result()


class _Run:
    """State of one training. Batches are drawn from (seed, step), so a resumed run is the same run."""

    def __init__(
        self,
        prior: Prior,
        training: Sequence[Trajectory],
        validation: Sequence[Trajectory],
        s: TrainingSettings,
    ) -> None:
        self.settings, use_prior, dt = s, s.kind != "rnn", training[0].dt
        horizon = fitting_horizon(training, s.warm, s.horizon)
        self.windows = cut_windows(training, s.warm, horizon, max(1, horizon // 10))
        self.fixed = self.windows.take(torch.linspace(0, len(self.windows) - 1, 64).round().long().unique())
        horizon = fitting_horizon(validation, s.warm, 5 * s.horizon)
        self.valid = cut_windows(validation, s.warm, horizon, max(1, horizon // 5))
        self.scaling = scaling_of(prior, self.windows, dt, use_prior=use_prior)
        self.stack = _stack(prior, s)
        self.step = HybridStep(prior, self.stack, self.scaling, dt, use_prior=use_prior)
        self.weights = dict(self.stack.named_parameters())
        self.decay = s.decay / sum(len(t.t) for t in training)
        self.optimizer = self._fresh_optimizer()
        self.done, self.free = 0, False
        self.best = torch.full((s.networks,), math.inf, dtype=torch.float64)
        self.best_weights = {name: w.detach().clone() for name, w in self.weights.items()}
        self.index = VectorPerformanceIndex(torch.ones(s.networks, len(NAMES), dtype=torch.float64))
        self.skipped = torch.zeros(s.networks, dtype=torch.int64)
        self.rows: list[Tensor] = []

    @property
    def stage_end(self) -> int:
        s = self.settings
        return s.teacher_steps + s.free_run_steps if self.free else s.teacher_steps

    def enter_stage(self) -> None:
        """Fresh optimiser and bounds; the free-run stage starts from the best weights so far."""
        self.free = self.done >= self.settings.teacher_steps
        if self.done:
            self._load(self.best_weights)
        self.optimizer = self._fresh_optimizer()
        with torch.no_grad():
            losses = self._losses(self._predict(self.fixed))
            self.index = VectorPerformanceIndex(
                torch.where(torch.isfinite(losses), losses, 1e6).clamp_min(1e-12)
            )
        self.evaluate()

    def update(self) -> None:
        """One step of AdamW on a batch, each network's gradient clipped for itself."""
        s = self.settings
        rng = np.random.default_rng([s.seed, self.done])
        batch = self.windows.take(torch.tensor(rng.integers(len(self.windows), size=s.batch)))
        losses = self._losses(self._predict(batch))
        value = self.index.value(losses) if s.kind == "mopgrnn" else losses[:, 0] / self.index.bounds[:, 0]
        self.optimizer.zero_grad()
        value.sum().backward()
        self._clip()
        for group in self.optimizer.param_groups:
            group["lr"] = self._learning_rate()
        self.optimizer.step()
        self.done += 1

    def evaluate(self) -> None:
        """Lower the bounds on the fixed windows, judge by validation free runs, keep the best weights."""
        with torch.no_grad():
            losses = self._losses(self._predict(self.fixed))
            self.index = self.index.lower(losses)
            valid = error_objective(self.step, free_run(self.step, self.valid))
        valid = torch.where(torch.isfinite(valid), valid, math.inf)
        better = valid < self.best
        self.best = torch.where(better, valid, self.best)
        for name, w in self.weights.items():
            keep = better.view(-1, *([1] * (w.dim() - 1)))
            self.best_weights[name] = torch.where(keep, w.detach(), self.best_weights[name])
        head = torch.full((2, len(valid)), float(self.done), dtype=torch.float64)
        head[1] = float(self.free)
        self.rows.append(torch.cat([head, losses.T, self.index.bounds.T, valid[None]]))

    def _fresh_optimizer(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(list(self.weights.values()), weight_decay=self.decay)

    def _predict(self, windows: Windows) -> Prediction:
        return (free_run if self.free else teacher_forced)(self.step, windows)

    def _losses(self, prediction: Prediction) -> Tensor:
        return torch.stack([OBJECTIVES[name](self.step, prediction) for name in NAMES], dim=-1)

    def _clip(self, most: float = 1.0) -> None:
        grads = [w.grad for w in self.weights.values() if w.grad is not None]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in grads]).sum(0).sqrt()
        finite = torch.isfinite(norm)
        self.skipped += ~finite
        factor = torch.where(finite, most / norm.clamp_min(most), 0.0)
        for g in grads:
            g.nan_to_num_(0.0, 0.0, 0.0).mul_(factor.view(-1, *([1] * (g.dim() - 1))))

    def _learning_rate(self) -> float:
        s, r = self.settings, self.settings.learning_rates
        start, end = (r[2], r[3]) if self.free else (r[0], r[1])
        at = self.done - (s.teacher_steps if self.free else 0)
        share = at / max(1, s.free_run_steps if self.free else s.teacher_steps)
        return end + 0.5 * (start - end) * (1.0 + math.cos(math.pi * share))

    def _load(self, weights: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            for name, w in self.weights.items():
                w.copy_(weights[name])

    def snapshot(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All tensors and numbers that the rest of the run depends on."""
        tensors = {f"w.{n}": w.detach() for n, w in self.weights.items()}
        tensors |= {f"best.{n}": w for n, w in self.best_weights.items()}
        for i, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{i}.{n}": v for n, v in state.items()}
        tensors |= {"bounds": self.index.bounds, "best": self.best, "skipped": self.skipped}
        return tensors | {"rows": torch.stack(self.rows)}, {"done": self.done, "free": self.free}

    def restore(self, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
        """Continue from a snapshot."""
        self._load({n: tensors[f"w.{n}"] for n in self.weights})
        self.best_weights = {n: tensors[f"best.{n}"] for n in self.weights}
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            if name.startswith("adam."):
                _, i, field = name.split(".")
                state.setdefault(int(i), {})[field] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": state})
        self.index = VectorPerformanceIndex(tensors["bounds"])
        self.best, self.skipped = tensors["best"], tensors["skipped"]
        self.rows = list(tensors["rows"])
        self.done, self.free = int(numbers["done"]), bool(numbers["free"])

    def result(self) -> Trained:
        """The best weights and the curve."""
        rows = torch.stack(self.rows).numpy()
        names = ("step", "free_run", "loss_error", "loss_energy", "bound_error", "bound_energy", "validation")
        curve = {name: rows[:, i] for i, name in enumerate(names)}
        weights = {name: w.numpy() for name, w in self.best_weights.items()}
        return Trained(self.settings, self.scaling, weights, self.best.numpy(), curve, self.skipped.numpy())


def _stack(prior: Prior, s: TrainingSettings) -> StackedGRU:
    use_prior = s.kind != "rnn"
    n_in = n_features(prior, use_prior)
    return StackedGRU(s.networks, n_in, s.hidden, prior.n_q, seed=s.seed, zero_head=use_prior)


def _key(
    s: TrainingSettings, training: Sequence[Trajectory], validation: Sequence[Trajectory], prior: Prior
) -> str:
    digest = hashlib.sha256(json.dumps([asdict(s), prior.values], sort_keys=True).encode())
    for trajectory in (*training, *validation):
        digest.update(np.ascontiguousarray(trajectory.x).tobytes())
        digest.update(np.ascontiguousarray(trajectory.u).tobytes())
    return digest.hexdigest()
