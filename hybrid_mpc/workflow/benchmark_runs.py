"""A benchmark's recordings with their roles, free runs of all models over them, and their errors."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Dataset, Trajectory, load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.delay import lost_samples, shifted
from hybrid_mpc.identify.evaluate import (
    OutputErrors,
    evaluation_trajectories,
    model_states,
    output_errors,
)
from hybrid_mpc.identify.linear import LinearModel
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.simulation import measured_as
from hybrid_mpc.identify.step import PriorStep
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import BenchmarkSpec, Role
from hybrid_mpc.records import known
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
LONGEST = 60.0
"""Longest run in :attr:`Recordings.long` [time constants of the machine]; it is long enough to show drift."""


@dataclass(frozen=True)
class Recordings:
    """The training files of a benchmark in pieces: for training, for validation, and held back for the test.

    ``long`` are recordings that were split in order of time, from the first sample to the end of validation, at most
    :data:`LONGEST`. Most of them is training data: they show drift, not accuracy.
    """

    train: tuple[Trajectory, ...]
    valid: tuple[Trajectory, ...]
    held_back: tuple[Trajectory, ...]
    long: tuple[Trajectory, ...]
    dataset: Dataset


def benchmark_of(scenario: Scenario) -> BenchmarkSpec:
    """The scenario's benchmark specification; InputError if it is missing."""
    if scenario.benchmark is None:
        raise InputError(
            f"scenario {scenario.name}: no benchmark specification; add Scenario(benchmark=BenchmarkSpec(...))"
            " [HM-WORKFLOW-013]"
        )
    return scenario.benchmark


def read_training(scenario: Scenario, paths: Sequence[Path]) -> Recordings:
    """Read training files, and cut long recordings into pieces.

    Raises:
        InputError: If a file is bad or has windows although roles are given to whole files, or if no data remain for
            training or validation.
    """
    prior, spec = scenario.prior(), benchmark_of(scenario)
    uncut = 0 < spec.valid_every <= len(paths)
    named = [path.name for path in paths if path.stem in scenario.data.windows]
    if uncut and named:
        raise InputError(
            f"{named[0]}: has windows in the data specification, but the benchmark's valid_every={spec.valid_every} "
            "gives roles to whole files. Remove one of the two [HM-WORKFLOW-014]"
        )
    needed: tuple[Role, ...] = () if spec.cycle or uncut else ("train", "valid")
    data = replace(scenario.data, fractions=spec.fractions or scenario.data.fractions)
    dataset = load_trajectories(paths, prior, data, needed=needed)
    parts = _parts(dataset, scenario, uncut)
    train, valid, held_back = (
        tuple(p for p in parts if p.role == role) for role in ("train", "valid", "test")
    )
    if not (train and valid):
        cut = "".join(f"\n  {c.file} {c.start_s:g} to {c.end_s:g} s: {c.why}" for c in dataset.cuts)
        raise InputError(
            f"recordings: no data remain to {'validate on' if train else 'train on'}; give longer recordings"
            f"{f'. Cut out:{cut}' if cut else ''} [HM-WORKFLOW-047]"
        )
    in_order = not (spec.cycle or uncut) and spec.length is None
    long = until_validated(dataset, scenario.data.windows) if in_order else ()
    return Recordings(train, valid, held_back, long, dataset)


def _parts(dataset: Dataset, scenario: Scenario, uncut: bool) -> list[Trajectory]:
    """Pieces with roles: by the benchmark's cycle, by whole files (``uncut``), or by the data specification."""
    spec, data = benchmark_of(scenario), scenario.data
    if not spec.cycle:
        runs = whole_runs(dataset, spec.valid_every) if uncut else dataset.trajectories
        return [p for t in runs for p in pieces(t, spec.piece)]
    parts = [p for t in dataset.whole for p in in_turn(t, spec, data.smoothing)]
    # smallest number of periods of a piece after its warm-up
    shortest = data.warm_up + 50 * data.dt
    if any(len(p.t) * p.dt < shortest for p in parts):
        raise InputError(
            f"recordings: at least one is too short to be cut into {len(spec.cycle)} pieces of at least "
            f"{shortest:.3g} s for training and validation. Give longer recordings [HM-WORKFLOW-015]"
        )
    return parts


def until_validated(dataset: Dataset, windows: Container[str]) -> tuple[Trajectory, ...]:
    """Recordings that were split in order of time, from the first sample to a gap or the end of validation.

    Files with ``windows`` are left out, because the data between their windows may be disturbed.
    """
    stems, found = {Path(file).stem for file in dataset.files}, []
    longest = LONGEST * time_unit(dataset.whole, dataset.whole[0].dt) if dataset.whole else 0.0
    for whole in dataset.whole:
        # skip parts after a gap: they begin in motion, unlike test runs
        if whole.name not in stems or whole.name in windows:
            continue
        ends = [p.t[-1] for p in dataset.by_role("valid") if _stem(p.name, stems) == whole.name]
        if ends:
            end = min(max(ends), whole.t[0] + longest)
            found.append(whole.part(whole.t <= end, whole.name, "valid"))
    return tuple(found)


def _stem(name: str, stems: Container[str]) -> str:
    """Stem of a piece's file: the names of later pieces of a file end with # and a number.

    Example:
        >>> _stem("run#12", {"run"}), _stem("run", {"run"}), _stem("take#2", {"take", "take#2"})
        ('run', 'run', 'take#2')
    """
    return name if name in stems else name.rpartition("#")[0]


def whole_runs(dataset: Dataset, every: int) -> tuple[Trajectory, ...]:
    """All recordings uncut (except at gaps); every ``every``-th file is for validation.

    Example:
        >>> z = np.zeros((2, 1))
        >>> runs = [Trajectory(name, "", 0.1, z[:, 0], z, z, z, z) for name in ("c", "a", "b", "c#2")]
        >>> data = Dataset((), tuple(runs), (), ("c.csv", "a.csv", "b.csv"), (), "")
        >>> [(t.name, t.role) for t in whole_runs(data, 3)]
        [('c', 'valid'), ('a', 'train'), ('b', 'train'), ('c#2', 'valid')]
    """
    stems = sorted(Path(file).stem for file in dataset.files)
    chosen = set(stems[every - 1 :: every])
    return tuple(
        replace(t, role="valid" if _stem(t.name, stems) in chosen else "train") for t in dataset.whole
    )


def read_test(
    scenario: Scenario, path: Path, warn: Callable[[str], None] = lambda text: None
) -> tuple[Trajectory, ...]:
    """Read a test file as whole runs, cut at gaps; windows of the data specification are ignored.

    Raises:
        InputError: If the file is bad, or every part is too short.
    """
    prior = scenario.prior()
    spec = replace(scenario.data, windows={})
    dataset = load_trajectories([path], prior, spec, needed=())
    if not dataset.whole:
        raise InputError(
            f"{path}: every part is too short for a free run after a warm-up of {spec.warm_up:g} s. Give a longer "
            "recording [HM-WORKFLOW-016]"
        )
    for warning in dataset.warnings:
        warn(warning)
    return dataset.whole


def in_turn(trajectory: Trajectory, spec: BenchmarkSpec, distance: float) -> tuple[Trajectory, ...]:
    """Pieces of a whole recording with the roles of the benchmark's cycle in turn, ``distance`` [s] apart.

    Example:
        >>> z = np.zeros((400, 1))
        >>> run = Trajectory("run", "", 0.1, 0.1 * np.arange(400), z, z, np.zeros((400, 2)), np.zeros((400, 2)))
        >>> spec = BenchmarkSpec(piece=10.0, cycle=("train", "valid"))
        >>> [(p.role, len(p.t)) for p in in_turn(run, spec, 0.4)]
        [('train', 96), ('valid', 96), ('train', 96), ('valid', 96)]
    """
    seconds = min(spec.piece, len(trajectory.t) * trajectory.dt / len(spec.cycle))
    margin = round(0.5 * distance / trajectory.dt)
    parts = []
    for i, part in enumerate(pieces(trajectory, seconds)):
        index = np.arange(len(part.t))
        inner = (index >= margin) & (index < len(part.t) - margin)
        parts.append(part.part(inner, part.name, spec.cycle[i % len(spec.cycle)]))
    return tuple(parts)


def pieces(trajectory: Trajectory, seconds: float) -> tuple[Trajectory, ...]:
    """Equal pieces of about ``seconds`` each; a few samples at the end may remain unused.

    Example:
        >>> z = np.zeros((101, 1))
        >>> run = Trajectory("run", "train", 0.1, 0.1 * np.arange(101), z, z, np.zeros((101, 2)), np.zeros((101, 2)))
        >>> [(p.name, len(p.t)) for p in pieces(run, 5.0)], len(pieces(run, 60.0))
        ([('run#1', 50), ('run#2', 50)], 1)
    """
    count = round(len(trajectory.t) * trajectory.dt / seconds)
    if count < 2:
        return (trajectory,)
    n, index = len(trajectory.t) // count, np.arange(len(trajectory.t))
    return tuple(
        trajectory.part(
            (index >= i * n) & (index < (i + 1) * n), f"{trajectory.name}#{i + 1}", trajectory.role
        )
        for i in range(count)
    )


def in_runs(trajectories: Sequence[Trajectory], n: int) -> list[Trajectory]:
    """Consecutive parts of ``n`` samples; a shorter trajectory stays as it is.

    Example:
        >>> z = np.zeros((101, 1))
        >>> run = Trajectory("run", "test", 0.1, 0.1 * np.arange(101), z, z, np.zeros((101, 2)), np.zeros((101, 2)))
        >>> [(p.name, len(p.t), round(float(p.t[0]), 1)) for p in in_runs([run], 40)], len(in_runs([run], 200))
        ([('run', 40, 0.0), ('run', 40, 4.0)], 1)
    """
    return [t.part(slice(a, a + n)) for t in trajectories for a in range(0, max(1, len(t.t) - n + 1), n)]


@dataclass(frozen=True)
class BenchmarkRun:
    """A free run of all candidates over one trajectory: evaluated times, inputs with their delay, measured outputs, and
    outputs of each candidate ``(n, n_y)``.
    """

    name: str
    t: Array
    u: Array
    y: Array
    y_hat: Mapping[str, Array]


def run_freely(
    prior: Prior,
    fit: PriorFit,
    networks: Mapping[str, Trained],
    trajectories: Sequence[Trajectory],
    *,
    warm_up: float,
    length: float | None,
    linear: Mapping[str, LinearModel] | None = None,
) -> list[BenchmarkRun]:
    """Free runs of the prior (``phy``), of each kind's model (the mean of its networks), and of linear models by name.

    The first ``warm_up`` [s] determine the initial state of all models and the networks' hidden states. The rest is
    evaluated, or its first ``length`` [s]. Trajectories have the commanded inputs.
    """
    dt = trajectories[0].dt
    warm = max(1, round(warm_up / dt) - lost_samples(fit.delay, dt))  # from the first known delayed input on
    starts = evaluation_trajectories(shifted(trajectories, fit.delay), fit.smoother(prior, dt), warm)
    if length is not None:
        n = warm + round(length / dt) + 1
        starts = [t.part(np.arange(len(t.t)) < n, t.name, t.role) for t in starts]
    states = {"phy": model_states(PriorStep(prior, dt, fit.substeps), starts, warm)}
    for kind, trained in networks.items():
        states[kind] = model_states(trained.step(prior, dt), starts, warm)
    first = lost_samples(fit.delay, dt) + warm + 1  # linear models use the inputs as commanded
    whole = [t.part(slice(0, first + len(s.t) - warm - 1)) for t, s in zip(trajectories, starts, strict=True)]
    straight = {name: model.free_runs(whole, first) for name, model in (linear or {}).items()}
    found = []
    for i, t in enumerate(starts):
        after = slice(warm + 1, None)  # without the initial state and the state after the last input
        u, n = t.u[after], len(t.t) - warm
        y_hat = {
            name: prior.equations.output(x[i, 1:n].T, u.T, t.w[after].T, prior.p).full().T
            for name, x in states.items()
        } | {name: y[i] for name, y in straight.items()}
        clipped = {name: measured_as(prior, y) for name, y in y_hat.items()}
        found.append(BenchmarkRun(t.name, t.t[after], u, t.y[after], clipped))
    return found


def scored_signals(outputs: Sequence[Signal], spec: BenchmarkSpec) -> list[tuple[Signal, float]]:
    """Outputs in the units of the benchmark, and the factor from their own unit to that unit.

    Raises:
        InputError: If the specification has a unit for a signal that is not an output.

    Example:
        >>> found = scored_signals((Signal("q", "m"), Signal("v", "m/s")), BenchmarkSpec(units={"q": ("mm", 1e3)}))
        >>> [(signal.label, scale) for signal, scale in found]
        [('q [mm]', 1000.0), ('v [m/s]', 1.0)]
    """
    for name in spec.units:
        known(name, [s.name for s in outputs], "output in the units of the benchmark")
    found = [(s.name, *spec.units.get(s.name, (s.unit, 1.0))) for s in outputs]
    return [(Signal(name, unit), factor) for name, unit, factor in found]


def run_error(
    runs: Sequence[BenchmarkRun], name: str, outputs: Sequence[Signal], spec: BenchmarkSpec
) -> OutputErrors:
    """Errors of one candidate over all runs of a file, in the benchmark's units; ``error`` is divided by the standard
    deviations of the outputs in these runs.

    Example:
        >>> y = np.array([[0.0], [1.0], [2.0]])
        >>> run = BenchmarkRun("run", np.arange(3.0), y, y, {"phy": y + 0.1})
        >>> found = run_error([run], "phy", [Signal("q", "m")], BenchmarkSpec(units={"q": ("mm", 1e3)}))
        >>> {name: round(value, 6) for name, value in found.rmse.items()}
        {'q [mm]': 100.0}
    """
    signals, scales = zip(*scored_signals(outputs, spec), strict=True)
    scaled = np.array(scales)
    return output_errors(
        [scaled * run.y_hat[name] for run in runs], [scaled * run.y for run in runs], signals
    )
