"""Training of recurrent corrections: teacher forcing, then free runs; checkpointed and resumable."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
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
    literal_scaling_of,
    scaling_of,
)
from hybrid_mpc.identify.networks import StackedNetwork, make_stack
from hybrid_mpc.identify.objectives import OBJECTIVES, Combination, combine, free_run, teacher_forced
from hybrid_mpc.identify.prior_replay import BATCH, make_prior_replay, prior_replay_penalty
from hybrid_mpc.identify.settings import KINDS, Kind, TrainingSettings
from hybrid_mpc.identify.step import (
    PREFIX,
    HybridStep,
    LiteralStep,
    RecurrentStep,
    Scaling,
    StackedPrior,
    n_features,
    with_values,
)
from hybrid_mpc.machine.torch_prior import Prior

# What comes out of a training, and the models made of it.


@dataclass(frozen=True)
class TrainingFailure:
    """Updates of one network that were skipped because a number was not finite.

    Args:
        network: Its index.
        objective: The objective whose loss was not finite; ``"gradient"`` where all losses were finite.
        step: The last such update.
        stopped: Whether the network was stopped there, since too many came in a row; it then keeps its best
            weights by validation.
    """

    network: int
    objective: str
    step: int
    stopped: bool


@dataclass(frozen=True)
class Trained:
    """Result of a training: plain arrays, so that it travels between processes and into files.

    Args:
        settings: What it was trained with.
        scaling: Magnitudes inside the model.
        weights: Best weights of each network by its validation, stacked; parameters of the prior that were trained
            along are among them as ``prior.<name>`` ``(networks,)`` [SI].
        validation: Best validation error of each network ``(networks,)``.
        curve: ``step, free_run``, ``loss_`` and ``bound_`` with each objective's name, ``validation``; one row
            an evaluation, a column a network.
        skipped: Updates skipped for a loss that was not finite, per network.
        faults: Which objective they were skipped for, one entry a network that has any.
    """

    settings: TrainingSettings
    scaling: Scaling
    weights: Mapping[str, NDArray[np.float64]]
    validation: NDArray[np.float64]
    curve: Mapping[str, NDArray[np.float64]]
    skipped: NDArray[np.int64]
    faults: tuple[TrainingFailure, ...] = ()

    @property
    def best(self) -> int:
        """The network with the lowest validation error."""
        return int(np.argmin(self.validation))

    def step(self, prior: Prior, dt: float, i: int | None = None) -> RecurrentStep:
        """The step of network ``i`` (default: the best), around the prior's parameters that were trained with it.

        ``prior`` is the fitted one: it starts the parameters, and its energy balance and output are the step's.
        """
        i = self.best if i is None else i
        values = self.prior_values(i)
        dynamics = with_values(prior, values) if values else None
        stack = stack_for(prior, self.settings)
        own = {name: torch.tensor(w) for name, w in self.weights.items() if not name.startswith(PREFIX)}
        stack.load_state_dict(own)
        step = step_for(prior, stack.member(i), self.scaling, dt, self.settings, dynamics)
        return step.requires_grad_(False)

    def prior_values(self, i: int | None = None) -> dict[str, float]:
        """Values [SI] of the parameters trained along with network ``i`` (default: the best); empty if none were."""
        i = self.best if i is None else i
        return {n.removeprefix(PREFIX): float(w[i]) for n, w in self.weights.items() if n.startswith(PREFIX)}


def stack_for(prior: Prior, s: TrainingSettings) -> StackedNetwork:
    """The untrained stack of a training."""
    literal = s.form == "literal"
    n_in = n_features(prior, s.use_prior, literal=literal)
    n_out = len(prior.states) if literal else prior.n_q
    # a hybrid starts as its prior; the literal form has no such start
    zero_head = s.use_prior and not literal
    return make_stack(
        s.cell, s.networks, n_in, s.hidden, n_out, seed=s.seed, zero_head=zero_head, fused=s.fused
    )


def step_for(
    prior: Prior,
    network: nn.Module,
    scaling: Scaling,
    dt: float,
    s: TrainingSettings,
    dynamics: Prior | StackedPrior | None = None,
) -> RecurrentStep:
    """The step of a training around a network or a stack; ``dynamics`` has the parameters trained along."""
    form = LiteralStep if s.form == "literal" else HybridStep
    return form(prior, network, scaling, dt, use_prior=s.use_prior, dynamics=dynamics)


# Training checkpoints: one safetensors file, written atomically, bound to its training.


def save_checkpoint(path: Path, key: str, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
    """Write tensors and numbers to ``path``; a kill at any moment leaves the old file or the new one."""
    own = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(numbers)
    metadata = {"key": key, "numbers": text, "sha256": _content_hash(own, text)}
    with replacing(path) as file:
        file.write(save(own, metadata=metadata))


def load_checkpoint(path: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and numbers of a checkpoint.

    Raises:
        InputError: If the file is damaged or belongs to a training with other settings or data.
    """
    read_bytes(path, MOST_ARRAYS)  # a regular file of a size that can be
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"checkpoint {path} cannot be read ({error}); delete it to train anew") from error
    numbers = metadata.get("numbers", "")
    if metadata.get("sha256") != _content_hash(tensors, numbers):
        raise InputError(f"checkpoint {path} is damaged; delete it to train anew")
    if metadata.get("key") != key:
        raise InputError(
            f"checkpoint {path} belongs to a training with other settings or data; "
            f"resume with the same ones or choose another output folder"
        )
    return tensors, json.loads(numbers)


def _content_hash(tensors: dict[str, Tensor], numbers: str) -> str:
    """SHA-256 of what a training goes on with."""
    whole = hashlib.sha256(numbers.encode())
    for name in sorted(tensors):
        array = tensors[name].numpy()
        whole.update(f"{name} {array.dtype} {array.shape}".encode())
        whole.update(array.tobytes())
    return whole.hexdigest()


# One training as it runs: what it holds, an update, an evaluation, and how it is saved and restored.

REPEATS = 5
"""Updates skipped in a row after which a network is stopped; a single batch may well diverge once."""
_PREDICTIONS = {"one_step": teacher_forced, "free_run": free_run}


class TrainingRun:
    """State of one training. Batches are drawn from (seed, step), so a resumed run is the same run.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories.
        s: See :class:`~hybrid_mpc.identify.settings.TrainingSettings`.
        device: Where the tensors live.

    Raises:
        InputError: If no trajectory is long enough or one holds a value that is not finite.
    """

    def __init__(
        self,
        prior: Prior,
        training: Sequence[Trajectory],
        validation: Sequence[Trajectory],
        s: TrainingSettings,
        device: str = "cpu",
    ) -> None:
        self.settings, self.device, dt = s, torch.device(device), training[0].dt
        windows, self.valid = _cut(training, validation, s)
        if s.form == "literal":
            self.scaling = literal_scaling_of(prior, windows)
        else:
            self.scaling = scaling_of(prior, windows, dt, use_prior=s.use_prior)
        self.windows, self.valid = windows.to(self.device), self.valid.to(self.device)
        self.fixed = self.windows.take(torch.linspace(0, len(windows) - 1, 64).round().long().unique())
        prior = prior if device == "cpu" else copy.deepcopy(prior)  # the prior given stays where it is
        self.physics = StackedPrior(prior, s.networks) if s.prior_parameters == "trained" else None
        anchored = bool(s.prior_replay) and s.use_prior
        self.prior_replay = make_prior_replay(prior, training, s.seed).to(self.device) if anchored else None
        step = step_for(prior, stack_for(prior, s), self.scaling, dt, s, self.physics)
        self.step = step.to(self.device)
        self.weights = dict(self.step.network.named_parameters())
        if self.physics is not None:
            self.weights |= self.physics.weights()
        self.decay = s.decay / sum(len(t.t) for t in training)
        self.optimizer = self._fresh_optimizer()
        self.done, self.free = 0, False
        self.best = torch.full((s.networks,), math.inf, dtype=torch.float64, device=self.device)
        self.best_weights = {name: w.detach().clone() for name, w in self.weights.items()}
        ones = torch.ones(s.networks, len(s.objectives), dtype=torch.float64, device=self.device)
        self.index = self._combine({"bounds": ones})
        self.skipped, self.in_row = torch.zeros(2, s.networks, dtype=torch.int64, device=self.device)
        self.stopped = torch.zeros(s.networks, dtype=torch.bool, device=self.device)
        self.faults: dict[int, TrainingFailure] = {}
        self.rows: list[Tensor] = []

    @property
    def stage_end(self) -> int:
        """Steps done when the present stage is over."""
        s = self.settings
        return s.teacher_steps + s.free_run_steps if self.free else s.teacher_steps

    @property
    def over(self) -> bool:
        """All steps are done, or no network is left."""
        s = self.settings
        return self.done >= s.teacher_steps + s.free_run_steps or bool(self.stopped.all())

    def enter_stage(self) -> None:
        """Fresh optimiser and bounds; the free-run stage starts from the best weights so far."""
        self.free = self.done >= self.settings.teacher_steps
        if self.done:
            self._load(self.best_weights)
        self.optimizer = self._fresh_optimizer()
        with torch.no_grad():
            losses = self._losses(self.fixed)
            bounds = torch.where(torch.isfinite(losses), losses, 1e6).clamp_min(1e-12)
            self.index = self._combine({"bounds": bounds})
        self.evaluate()

    def update(self) -> None:
        """One step of AdamW on a batch, each network's gradient clipped for itself."""
        s = self.settings
        rng = np.random.default_rng([s.seed, self.done])
        batch = self.windows.take(torch.tensor(rng.integers(len(self.windows), size=s.batch)))
        losses = self._losses(batch, s.objectives if s.kind == "mopgrnn" else s.objectives[:1])
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
        if self.physics is not None:
            self.physics.project()
        self._note(losses, finite)
        self.done += 1

    def evaluate(self) -> None:
        """Lower the bounds on the fixed windows, judge by validation free runs, keep the best weights."""
        with torch.no_grad():
            losses = self._losses(self.fixed)
            self.index = self.index.updated(losses)
            judge = OBJECTIVES[self.settings.objectives[0]]
            valid = judge(self.step, free_run(self.step, self.valid))
        valid = torch.where(torch.isfinite(valid), valid, math.inf)
        better = valid < self.best
        self.best = torch.where(better, valid, self.best)
        for name, w in self.weights.items():
            self.best_weights[name] = torch.where(_by(better, w), w.detach(), self.best_weights[name])
        head = torch.full_like(valid, float(self.done)), torch.full_like(valid, float(self.free))
        self.rows.append(torch.cat([torch.stack(head), losses.T, self.index.bounds.T, valid[None]]))

    def snapshot(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All tensors and numbers that the rest of the run depends on."""
        tensors = {f"w.{n}": w.detach() for n, w in self.weights.items()}
        tensors |= {f"best.{n}": w for n, w in self.best_weights.items()}
        for i, state in self.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{i}.{n}": v for n, v in state.items()}
        tensors |= {f"index.{n}": v for n, v in self.index.tensors().items()}
        tensors |= {name: getattr(self, name) for name in ("best", "skipped", "in_row", "stopped")}
        numbers = {"done": self.done, "free": self.free, "faults": [asdict(f) for f in self.faults.values()]}
        return tensors | {"rows": torch.stack(self.rows)}, numbers

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
        index = {n.removeprefix("index."): v for n, v in tensors.items() if n.startswith("index.")}
        self.index = self._combine(index)
        for name in ("best", "skipped", "in_row", "stopped"):
            setattr(self, name, tensors[name])
        self.rows = list(tensors["rows"])
        self.faults = {f["network"]: TrainingFailure(**f) for f in numbers["faults"]}
        self.done, self.free = int(numbers["done"]), bool(numbers["free"])

    def result(self) -> Trained:
        """The best weights and the curve."""
        rows, objectives = torch.stack(self.rows).cpu().numpy(), self.settings.objectives
        losses, bounds = ([f"{kind}_{n}" for n in objectives] for kind in ("loss", "bound"))
        names = ("step", "free_run", *losses, *bounds, "validation")
        curve = {name: rows[:, i] for i, name in enumerate(names)}
        weights = {name: w.cpu().numpy() for name, w in self.best_weights.items()}
        if self.physics is not None:
            weights |= self.physics.in_si(self.best_weights)
        best, skipped = self.best.cpu().numpy(), self.skipped.cpu().numpy()
        faults = tuple(self.faults[i] for i in sorted(self.faults))
        return Trained(self.settings, self.scaling, weights, best, curve, skipped, faults)

    def _combine(self, tensors: Mapping[str, Tensor]) -> Combination:
        s = self.settings
        return combine(s.combination if s.kind == "mopgrnn" else "smooth_maximum", tensors, s.weights)

    def _fresh_optimizer(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(list(self.weights.values()), weight_decay=self.decay)

    def _losses(self, windows: Windows, names: Sequence[str] | None = None) -> Tensor:
        """Losses ``(networks, objectives)``; each prediction that they need is made once."""
        stage = "free_run" if self.free else "one_step"
        energy = stage if self.settings.energy == "stage" else self.settings.energy
        reading = {n: energy if n == "energy" else stage for n in names or self.settings.objectives}
        made = {r: _PREDICTIONS[r](self.step, windows) for r in dict.fromkeys(reading.values())}
        return torch.stack([OBJECTIVES[n](self.step, made[r]) for n, r in reading.items()], dim=-1)

    def _clip(self, most: float = 1.0) -> Tensor:
        """Clip each network's gradient; one that is not finite becomes zero. Which ones were finite."""
        grads = [w.grad for w in self.weights.values() if w.grad is not None]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in grads]).sum(0).sqrt()
        finite = torch.isfinite(norm)
        factor = torch.where(finite, most / norm.clamp_min(most), 0.0)
        for g in grads:
            g.nan_to_num_(0.0, 0.0, 0.0).mul_(_by(factor, g))
        return finite

    def _note(self, losses: Tensor, finite: Tensor) -> None:
        """Count and name skipped updates; a network that has too many in a row goes back to its best weights."""
        skips = ~finite & ~self.stopped
        self.skipped = self.skipped + skips
        self.in_row = torch.where(skips, self.in_row + 1, 0)
        self.stopped = self.stopped | (self.in_row >= REPEATS)
        for i in skips.nonzero().flatten().tolist():
            bad = (~torch.isfinite(losses[i].detach())).nonzero().flatten().tolist()
            objective = self.settings.objectives[bad[0]] if bad else "gradient"
            self.faults[i] = TrainingFailure(i, objective, self.done, bool(self.stopped[i]))
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


def _cut(
    training: Sequence[Trajectory], validation: Sequence[Trajectory], s: TrainingSettings
) -> tuple[Windows, Windows]:
    """Windows for training, and longer ones for validation."""
    if s.form == "literal":
        check_rates([*training, *validation])
    horizon = fitting_horizon(training, s.warm, s.horizon)
    windows = cut_windows(training, s.warm, horizon, max(1, horizon // 10))
    horizon = fitting_horizon(validation, s.warm, s.validation_horizon or 5 * s.horizon)
    return windows, cut_windows(validation, s.warm, horizon, max(1, horizon // 5))


def _by(values: Tensor, weight: Tensor) -> Tensor:
    """A value per network, shaped to go with a stacked weight."""
    return values.view(-1, *([1] * (weight.dim() - 1)))


__all__ = ["train", "TrainingSettings", "Trained", "TrainingFailure", "Kind", "KINDS", "Progress"]

Progress = Callable[[int, int, float], None]


def train(
    prior: Prior,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    *,
    checkpoint: Path | None = None,
    device: str = "cpu",
    on_progress: Progress = lambda done, total, error: None,
) -> Trained:
    """Train a stack of networks on trajectories; the best weights of each by validation free runs are kept.

    First teacher forcing (the paper's training), then free runs with back-propagation through the
    integrator. All kinds get the same steps, batches and data. A network whose gradient is no number skips
    that update; after several in a row it stops with its best weights, and ``Trained.faults`` says what for.
    With ``settings.prior_replay`` corrections fade where no training trajectory comes near.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories; they choose weights, they are not trained on.
        settings: See :class:`TrainingSettings`.
        checkpoint: File to save to and to resume from; default: none.
        device: Where the tensors live, ``"cpu"`` or e.g. ``"cuda"``; the result is on the CPU in any case.
        on_progress: ``(done, total, best validation error)`` at every evaluation.

    Raises:
        InputError: If no trajectory is long enough, a value is not finite, or the checkpoint is of another
            training.
    """
    torch.set_num_threads(1)  # tensors this small only lose by threads
    run = TrainingRun(prior, training, validation, settings, device)
    key = _key(settings, training, validation, prior)
    total = settings.teacher_steps + settings.free_run_steps
    if checkpoint is not None and checkpoint.is_file():
        run.restore(*load_checkpoint(checkpoint, key))
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


def _key(
    s: TrainingSettings, training: Sequence[Trajectory], validation: Sequence[Trajectory], prior: Prior
) -> str:
    settings = asdict(s)
    if s.prior_parameters == "fixed":
        del settings["prior_parameters"]  # the key is then that of trainings that could do nothing else
    if not s.prior_replay:
        del settings["prior_replay"]  # likewise
    digest = hashlib.sha256(json.dumps([settings, prior.values], sort_keys=True).encode())
    for trajectory in (*training, *validation):
        digest.update(np.ascontiguousarray(trajectory.x).tobytes())
        digest.update(np.ascontiguousarray(trajectory.u).tobytes())
        if s.form == "literal":
            digest.update(np.ascontiguousarray(trajectory.xdot).tobytes())
    return digest.hexdigest()
