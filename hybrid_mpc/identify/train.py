"""Training of recurrent corrections: teacher forcing, then free runs; checkpointed and resumable.

:func:`train` completes a :class:`TrainingRun` and returns a :class:`Trained`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_ARRAYS, read_bytes, replacing
from hybrid_mpc.identify.dataset import (
    Windows,
    check_rates,
    cut_windows,
    fitting_horizon,
    in_parts,
    validation_horizon,
)
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.objectives import (
    VectorPerformanceIndex,
    error_objective,
    free_run,
    objectives_of,
    teacher_forced,
)
from hybrid_mpc.identify.prior_replay import BATCH, make_prior_replay, prior_replay_penalty
from hybrid_mpc.identify.settings import TrainingSettings
from hybrid_mpc.identify.simulation import required_substeps, visited
from hybrid_mpc.identify.step import PREFIX, HybridStep, RecurrentStep, Scaling, TrainedParameters, shift_to
from hybrid_mpc.machine.prior import Prior

Progress = Callable[[int, int, float], None]
REPEATS = 5
"""Number of successive skipped updates after which a network is stopped; a single batch may diverge by chance."""
CLIP = 1.0
"""Largest norm of a network's gradient."""


def train(
    prior: Prior,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    *,
    form: type[RecurrentStep] = HybridStep,
    checkpoint: Path | None = None,
    device: str = "cpu",
    on_progress: Progress = lambda done, total, error: None,
) -> Trained:
    """Train a stack of networks on trajectories; each network keeps the weights with the least validation error.

    First teacher forcing (the paper's training), then free runs with back-propagation through the integrator. If the
    first objective is that of the outputs, teacher forcing uses that of the rates instead, because outputs hardly
    change within a period. All kinds get the same steps, batches and data. A network whose gradient is not finite skips
    the update. After several such updates in a row, the network stops with its best weights, and ``Trained.failures``
    names the reason.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories, which only select weights.
        settings: See :class:`~hybrid_mpc.identify.settings.TrainingSettings`.
        form: The form of the model. Default: prior plus correction of its rates.
        checkpoint: File to save to and to resume from. Default: none.
        device: Device of the tensors, ``"cpu"`` or e.g. ``"cuda"``; the result is always on the CPU.
        on_progress: ``(done, total, best validation error)`` at every evaluation.

    Raises:
        InputError: If no trajectory is long enough, a value is not finite, prior replay is requested for a form that
            does not correct a prior, or the checkpoint belongs to another training.

    Example:
        >>> trained = train(prior, runs[:3], runs[3:], settings)  # doctest: +SKIP
        >>> step = trained.step(prior, dt=0.02)  # doctest: +SKIP
    """
    torch.set_num_threads(1)  # threads slow down operations on such small tensors
    run = TrainingRun(prior, training, validation, settings, device, form)
    key = _key(settings, training, validation, prior, form)
    total = settings.teacher_steps + settings.free_run_steps
    if checkpoint is not None and checkpoint.is_file():
        run.restore(*load_checkpoint(checkpoint, key))
    if not total:  # untrained networks, which correct nothing
        run.enter_stage()
    while not run.over:
        if run.done in (0, settings.teacher_steps):
            run.enter_stage()
        for _ in range(min(settings.every, run.stage_end - run.done)):
            run.update()
        run.evaluate()
        if checkpoint is not None:
            save_checkpoint(checkpoint, key, *run.snapshot())
        on_progress(run.done, total, float(run.best.min()))
    return run.result()


@dataclass(frozen=True)
class TrainingFailure:
    """Skipped updates of a network because of numbers that are not finite.

    Args:
        network: Number of the network.
        objective: Objective whose loss was not finite; ``"gradient"`` if all losses were finite.
        step: Step of the last skipped update.
        stopped: Whether the network was stopped; it then keeps its best weights.
    """

    network: int
    objective: str
    step: int
    stopped: bool


HEAD = ("w_out", "b_out")
"""Weights to which a network's output is proportional."""


@dataclass(frozen=True)
class Trained:
    """Result of a training, as plain arrays for files and other processes.

    Args:
        settings: Settings of the training.
        scaling: Scales of features and outputs.
        weights: Weights of each network with its least validation error, stacked. Trained parameters of the prior are
            ``prior.<name>`` ``(networks,)`` [SI].
        validation: Least validation error of each network ``(networks,)``.
        curve: ``step, free_run``, ``loss_NAME`` and ``bound_NAME`` of each objective, ``validation``; one row for each
            evaluation, one column for each network.
        skipped: Number of skipped updates of each network ``(networks,)``.
        failures: One entry for each network with skipped updates.
        form: The form of the model.
    """

    settings: TrainingSettings
    scaling: Scaling
    weights: Mapping[str, NDArray[np.float64]]
    validation: NDArray[np.float64]
    curve: Mapping[str, NDArray[np.float64]]
    skipped: NDArray[np.int64]
    failures: tuple[TrainingFailure, ...] = ()
    form: type[RecurrentStep] = HybridStep

    @property
    def best(self) -> int:
        """Number of the network with the least validation error."""
        return int(self.ranking[0])

    @property
    def ranking(self) -> NDArray[np.intp]:
        """Numbers of the networks, the best first."""
        return np.argsort(self.validation, kind="stable")

    @property
    def shares(self) -> NDArray[np.float64]:
        """Weight of each network in the mean ``(networks,)``, proportional to 1 / (validation error)^2.

        These weights are optimal for independent errors. A network without a finite validation error has the weight 0.
        If no network has a finite validation error, all weights are equal.
        """
        finite = np.isfinite(self.validation)
        if not finite.any():
            return np.full(finite.size, 1.0 / finite.size)
        least = max(float(self.validation[finite].min()), 1e-300)
        weight = np.where(finite, np.square(least / np.maximum(self.validation, least)), 0.0)
        return np.asarray(weight / weight.sum())

    def step(self, prior: Prior, dt: float, i: int | None = None) -> RecurrentStep:
        """Create the model: the weighted mean of the networks' corrections (:attr:`shares`) as one network.

        With ``i``, the model is network ``i`` alone. The networks leave out different parts of the data, so their
        errors differ, and the mean has less error than the network with the least validation error. The prior's
        parameters are those of ``prior`` (the fitted one), or the trained ones (their mean). Balances and output are
        those of ``prior``.
        """
        values = self.prior_values(i)
        shift = shift_to(prior, values) if values else None
        which = np.flatnonzero(self.shares) if i is None else [i]
        shares = (self.shares[which] if i is None else np.ones(1)).tolist()
        own = {n: torch.tensor(w[which]) for n, w in self.weights.items() if not n.startswith(PREFIX)}
        return self._step(prior, dt, own, lambda stack: stack.joined(shares), shift)

    def steps(self, prior: Prior, dt: float) -> list[RecurrentStep]:
        """Steps of the single networks, the best first."""
        return [self.step(prior, dt, i) for i in self.ranking.tolist()]

    def stacked_step(self, prior: Prior, dt: float) -> RecurrentStep:
        """Step of all networks at once, with tensors ``(networks, n, ...)``; the prior's parameters must be fixed."""
        own = {name: torch.tensor(w) for name, w in self.weights.items()}
        return self._step(prior, dt, own, lambda stack: stack, None)

    def shrunk(self, prior: Prior, share: float) -> Trained:
        """Multiply the networks' corrections by ``share``: 0 gives the fitted ``prior``, 1 the trained model.

        The difference of trained parameters from those of the prior is multiplied too.
        """
        own = prior.values

        def part(name: str, weight: NDArray[np.float64]) -> NDArray[np.float64]:
            if name.startswith(PREFIX):
                start = own[name.removeprefix(PREFIX)]
                return start + share * (weight - start)
            return share * weight if name in HEAD else weight

        return self if share == 1 else replace(self, weights={n: part(n, w) for n, w in self.weights.items()})

    def prior_values(self, i: int | None = None) -> dict[str, float]:
        """Values [SI] of the trained parameters of network ``i``, or their mean; empty without trained parameters."""
        shares = self.shares if i is None else np.eye(len(self.validation))[i]
        own = {n: shares @ w for n, w in self.weights.items() if n.startswith(PREFIX)}
        return {n.removeprefix(PREFIX): float(value) for n, value in own.items()}

    def _step(
        self,
        prior: Prior,
        dt: float,
        weights: dict[str, Tensor],
        part: Callable[[StackedGRU], nn.Module],
        shift: Tensor | None,
    ) -> RecurrentStep:
        stack = _stack(prior, replace(self.settings, networks=len(weights["w_ih"])), self.form)
        stack.load_state_dict(weights)
        use_prior = self.settings.use_prior
        step = self.form(prior, part(stack), self.scaling, dt, use_prior=use_prior, shift=shift)
        return step.requires_grad_(False)


class TrainingRun:
    """State of a training; arguments as in :func:`train`.

    A batch depends only on seed and step, so a resumed training has the same result.
    """

    def __init__(
        self,
        prior: Prior,
        training: Sequence[Trajectory],
        validation: Sequence[Trajectory],
        settings: TrainingSettings,
        device: str = "cpu",
        form: type[RecurrentStep] = HybridStep,
    ) -> None:
        s, self.form, dt = settings, form, training[0].dt
        self.settings, self.device = s, torch.device(device)
        if form.needs_rates:
            check_rates([*training, *validation])
        if s.prior_replay and not form.corrects_prior:
            raise InputError(
                f"{form.__name__} corrects no prior, so there is none to replay; leave prior_replay 0 [HM-IDENTIFY-052]"
            )
        training, part = in_parts(training, s.parts, s.shortest)
        without = [[float(own != i) for i in range(s.networks)] for own in part] if s.parts else []
        horizon = fitting_horizon(training, s.warm, s.horizon)
        windows = cut_windows(training, s.warm, horizon, max(1, horizon // 10), without)
        horizon = (
            fitting_horizon(validation, s.warm, s.validation_horizon)
            if s.validation_horizon
            else validation_horizon(validation, s.warm)
        )
        valid = cut_windows(validation, s.warm, horizon, max(1, horizon // 5))
        scaling = form.scaling_of(prior, windows, dt, use_prior=s.use_prior)
        own_rates = s.use_prior and form.corrects_prior
        substeps = required_substeps(prior, dt, visited(training)) if own_rates else 0
        self.scaling = replace(scaling, substeps=substeps)
        self.windows, self.valid = windows.to(self.device), valid.to(self.device)
        # number of fixed windows on which the bounds are lowered
        self.fixed = self.windows.take(torch.linspace(0, len(windows) - 1, 64).round().long().unique())
        self.objectives = objectives_of(prior, s.objectives)
        self.parameters = TrainedParameters(prior, s.networks) if s.prior_parameters == "trained" else None
        replayed = bool(s.prior_replay) and s.use_prior
        self.prior_replay = make_prior_replay(prior, training, s.seed).to(self.device) if replayed else None
        stack = _stack(prior, s, form)
        step = form(prior, stack, self.scaling, dt, use_prior=s.use_prior, shift=self.parameters)
        self.step = step.to(self.device)
        self.weights = dict(stack.named_parameters())
        if self.parameters is not None:
            self.weights |= self.parameters.weights()
        self.decay = s.decay / sum(len(t.t) for t in training)
        self.optimizer = self._fresh_optimizer()
        self.done, self.free = 0, False
        self.best = torch.full((s.networks,), math.inf, dtype=torch.float64, device=self.device)
        self.best_weights = {name: w.detach().clone() for name, w in self.weights.items()}
        ones = torch.ones(s.networks, len(self.objectives), dtype=torch.float64, device=self.device)
        self.index = VectorPerformanceIndex(ones)
        self.skipped, self.in_row = torch.zeros(2, s.networks, dtype=torch.int64, device=self.device)
        self.stopped = torch.zeros(s.networks, dtype=torch.bool, device=self.device)
        self.failures: dict[int, TrainingFailure] = {}
        self.rows: list[Tensor] = []

    @property
    def stage_end(self) -> int:
        """Number of steps at the end of the present stage."""
        s = self.settings
        return s.teacher_steps + s.free_run_steps if self.free else s.teacher_steps

    @property
    def over(self) -> bool:
        """Whether all steps are done, or all networks are stopped."""
        s = self.settings
        return self.done >= s.teacher_steps + s.free_run_steps or bool(self.stopped.all())

    def enter_stage(self) -> None:
        """Start a stage with a new optimizer and new bounds; the free-run stage starts from the best weights."""
        self.free = self.done >= self.settings.teacher_steps
        if self.done:
            self._load(self.best_weights)
        self.optimizer = self._fresh_optimizer()
        with torch.no_grad():
            losses = self._losses(self.fixed)
            bounds = torch.where(torch.isfinite(losses), losses, 1e6).clamp_min(1e-12)
            self.index = VectorPerformanceIndex(bounds)
        self.evaluate()

    def update(self) -> None:
        """One AdamW step on a batch; gradients are clipped separately for each network."""
        s = self.settings
        rng = np.random.default_rng([s.seed, self.done])
        batch = self.windows.take(torch.tensor(rng.integers(len(self.windows), size=s.batch)))
        losses = self._losses(batch, len(self.objectives) if s.kind == "mopgrnn" else 1)
        value = self.index.value(losses) if s.kind == "mopgrnn" else losses[:, 0] / self.index.bounds[:, 0]
        if self.prior_replay is not None:
            index = torch.tensor(rng.integers(self.prior_replay.x.shape[1], size=BATCH))
            value = value + s.prior_replay * prior_replay_penalty(self.step, self.prior_replay.take(index))
        self.optimizer.zero_grad()
        value.sum().backward()
        finite = self._clip()
        for group in self.optimizer.param_groups:
            group["lr"] = self._learning_rate()
        self.optimizer.step()
        if self.parameters is not None:
            self.parameters.project()
        self._note(losses, finite)
        self.done += 1

    def evaluate(self) -> None:
        """Lower the bounds on the fixed windows, and keep the weights with the least validation error."""
        with torch.no_grad():
            losses = self._losses(self.fixed)
            self.index = self.index.lower(losses)
            error = next(iter(self.objectives.values()))
            valid = error(self.step, free_run(self.step, self.valid))
        valid = torch.where(torch.isfinite(valid), valid, math.inf)
        better = valid < self.best
        self.best = torch.where(better, valid, self.best)
        for name, w in self.weights.items():
            self.best_weights[name] = torch.where(_by(better, w), w.detach(), self.best_weights[name])
        head = torch.full_like(valid, float(self.done)), torch.full_like(valid, float(self.free))
        self.rows.append(torch.cat([torch.stack(head), losses.T, self.index.bounds.T, valid[None]]))

    def snapshot(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All tensors and numbers that the rest of the training depends on."""
        tensors = {f"w.{n}": w.detach() for n, w in self.weights.items()}
        tensors |= {f"best.{n}": w for n, w in self.best_weights.items()}
        for i, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{i}.{n}": v for n, v in state.items()}
        tensors |= {name: getattr(self, name) for name in ("best", "skipped", "in_row", "stopped")}
        tensors |= {"bounds": self.index.bounds, "rows": torch.stack(self.rows)}
        failures = [asdict(f) for f in self.failures.values()]
        return tensors, {"done": self.done, "free": self.free, "failures": failures}

    def restore(self, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
        """Continue from a snapshot."""
        tensors = {n: v if n.endswith(".step") else v.to(self.device) for n, v in tensors.items()}
        self._load({n: tensors[f"w.{n}"] for n in self.weights})
        self.best_weights = {n: tensors[f"best.{n}"] for n in self.weights}
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            if name.startswith("adam."):
                _, i, field = name.split(".")
                state.setdefault(int(i), {})[field] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": state})
        self.index = VectorPerformanceIndex(tensors["bounds"])
        for name in ("best", "skipped", "in_row", "stopped"):
            setattr(self, name, tensors[name])
        self.rows = list(tensors["rows"])
        self.failures = {f["network"]: TrainingFailure(**f) for f in numbers["failures"]}
        self.done, self.free = int(numbers["done"]), bool(numbers["free"])

    def result(self) -> Trained:
        """Return the best weights and the curve."""
        rows, objectives = torch.stack(self.rows).cpu().numpy(), list(self.objectives)
        losses, bounds = ([f"{kind}_{n}" for n in objectives] for kind in ("loss", "bound"))
        names = ("step", "free_run", *losses, *bounds, "validation")
        curve = {name: rows[:, i] for i, name in enumerate(names)}
        weights = {name: w.cpu().numpy() for name, w in self.best_weights.items()}
        if self.parameters is not None:
            weights |= self.parameters.in_units(self.best_weights)
        best, skipped = self.best.cpu().numpy(), self.skipped.cpu().numpy()
        failures = tuple(self.failures[i] for i in sorted(self.failures))
        return Trained(self.settings, self.scaling, weights, best, curve, skipped, failures, self.form)

    def _fresh_optimizer(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(list(self.weights.values()), weight_decay=self.decay)

    def _losses(self, windows: Windows, first: int | None = None) -> Tensor:
        """Losses ``(networks, objectives)`` of the present stage, of the first objectives or of all."""
        prediction = (free_run if self.free else teacher_forced)(self.step, windows)
        every = list(self.objectives.values())[:first]
        if not self.free and next(iter(self.objectives)) == "output":
            every[0] = error_objective  # within one period, the outputs hardly change
        return torch.stack([objective(self.step, prediction) for objective in every], dim=-1)

    def _clip(self) -> Tensor:
        """Clip each network's gradient, and set those that are not finite to zero; returns the mask of finite ones."""
        grads = [w.grad for w in self.weights.values() if w.grad is not None]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in grads]).sum(0).sqrt()
        finite = torch.isfinite(norm)
        factor = torch.where(finite, CLIP / norm.clamp_min(CLIP), 0.0)
        for g in grads:
            g.nan_to_num_(0.0, 0.0, 0.0).mul_(_by(factor, g))
        return finite

    def _note(self, losses: Tensor, finite: Tensor) -> None:
        """Record skipped updates; a network with too many in a row returns to its best weights and stops."""
        skips = ~finite & ~self.stopped
        self.skipped = self.skipped + skips
        self.in_row = torch.where(skips, self.in_row + 1, 0)
        self.stopped = self.stopped | (self.in_row >= REPEATS)
        for i in skips.nonzero().flatten().tolist():
            bad = (~torch.isfinite(losses[i].detach())).nonzero().flatten().tolist()
            objective = list(self.objectives)[bad[0]] if bad else "gradient"
            self.failures[i] = TrainingFailure(i, objective, self.done, bool(self.stopped[i]))
        if self.stopped.any():
            with torch.no_grad():
                for name, w in self.weights.items():
                    w.copy_(torch.where(_by(self.stopped, w), self.best_weights[name], w))

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


def _stack(prior: Prior, s: TrainingSettings, form: type[RecurrentStep]) -> StackedGRU:
    """Create the untrained stack of a training."""
    n_in, n_out = form.sizes(prior, s.use_prior)
    # a model that corrects the prior starts with zero correction
    zero_head = s.use_prior and form.corrects_prior
    return StackedGRU(s.networks, n_in, s.hidden, n_out, seed=s.seed, zero_head=zero_head)


def _by(values: Tensor, weight: Tensor) -> Tensor:
    """Reshape one value for each network for broadcasting with a stacked weight."""
    return values.view(-1, *([1] * (weight.dim() - 1)))


def _key(
    s: TrainingSettings,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    prior: Prior,
    form: type[RecurrentStep],
) -> str:
    """Hash of all arguments that the result of a training depends on."""
    plain = [asdict(s), prior.values, form.__name__]
    digest = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
    for trajectory in (*training, *validation):
        for array in (trajectory.x, trajectory.u, trajectory.w, trajectory.xdot):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def save_checkpoint(path: Path, key: str, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
    """Write a checkpoint as one safetensors file; after an interruption, the old or the new file exists."""
    own = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(numbers)
    metadata = {"key": key, "numbers": text, "sha256": _content_hash(own, text)}
    with replacing(path) as file:
        file.write(save(own, metadata=metadata))


def load_checkpoint(path: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors and numbers of a checkpoint."""
    read_bytes(path, MOST_ARRAYS)  # refuses special and oversized files
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"checkpoint {path} cannot be read ({error}); delete this file to train again [HM-IDENTIFY-053]"
        ) from error
    numbers = metadata.get("numbers", "")
    if metadata.get("sha256") != _content_hash(tensors, numbers):
        raise InputError(f"checkpoint {path} is damaged; delete this file to train again [HM-IDENTIFY-054]")
    if metadata.get("key") != key:
        raise InputError(
            f"checkpoint {path} belongs to a training with other settings or data; resume with the same settings and "
            "data, or choose another output folder [HM-IDENTIFY-055]"
        )
    return tensors, json.loads(numbers)


def _content_hash(tensors: dict[str, Tensor], numbers: str) -> str:
    digest = hashlib.sha256(numbers.encode())
    for name in sorted(tensors):
        array = tensors[name].numpy()
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
