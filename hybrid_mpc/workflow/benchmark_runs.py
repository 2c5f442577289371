"""A benchmark's recordings with their roles, free runs of all models over them, and the errors of these."""

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
    measured_as,
    model_states,
    output_errors,
)
from hybrid_mpc.identify.linear import LinearModel
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.step import PriorStep
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import BenchmarkSpec, Role
from hybrid_mpc.records import known
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
LONGEST = 60.0
"""Most of a recording in :attr:`Recordings.long` [the machine's seconds]: drift shows by then."""
SCORED = 50
"""Fewest periods of a piece after its warm-up."""


@dataclass(frozen=True)
class Recordings:
    """The training files of a benchmark in pieces: for fit and training, to choose by, and held back for the test.

    ``long`` are whole recordings that were split in order of time, from the first sample to where validation ends, at
    most a minute (of the machine's own seconds). They were mostly trained on: they show drift, not accuracy.
    """

    train: tuple[Trajectory, ...]
    valid: tuple[Trajectory, ...]
    held_back: tuple[Trajectory, ...]
    long: tuple[Trajectory, ...]
    dataset: Dataset


def benchmark_of(scenario: Scenario) -> BenchmarkSpec:
    """The scenario's benchmark specification; InputError if it has none."""
    if scenario.benchmark is None:
        raise InputError(
            f"scenario {scenario.name} has no benchmark: give it one with Scenario(benchmark=BenchmarkSpec(...))"
            " [HM-WORKFLOW-013]"
        )
    return scenario.benchmark


def read_training(scenario: Scenario, paths: Sequence[Path]) -> Recordings:
    """Read training files; long ones are cut into pieces.

    Raises:
        InputError: If a file is bad, has windows where whole files validate, or nothing is left to train or validate
        on.
    """
    prior, spec = scenario.prior(), benchmark_of(scenario)
    uncut = 0 < spec.valid_every <= len(paths)
    named = [path.name for path in paths if path.stem in scenario.data.windows]
    if uncut and named:
        raise InputError(
            f"{named[0]} has windows in the data specification, and the benchmark's valid_every={spec.valid_every} "
            "gives whole files their roles; leave out one of the two [HM-WORKFLOW-014]"
        )
    needed: tuple[Role, ...] = () if spec.cycle or uncut else ("train", "valid")
    data = replace(scenario.data, fractions=spec.fractions or scenario.data.fractions)  # and checked as given
    dataset = load_trajectories(paths, prior, data, needed=needed)
    parts = _parts(dataset, scenario, uncut)
    train, valid, held_back = (
        tuple(p for p in parts if p.role == role) for role in ("train", "valid", "test")
    )
    if not (train and valid):
        cut = "".join(f"\n  {c.file} {c.start:g} to {c.end:g} s: {c.why}" for c in dataset.cuts)
        raise InputError(
            f"nothing is left to {'validate on' if train else 'train on'}; give longer recordings"
            f"{f'. Cut out:{cut}' if cut else ''} [HM-WORKFLOW-047]"
        )
    in_order = not (spec.cycle or uncut) and spec.length is None
    long = until_validated(dataset, scenario.data.windows) if in_order else ()
    return Recordings(train, valid, held_back, long, dataset)


def _parts(dataset: Dataset, scenario: Scenario, uncut: bool) -> list[Trajectory]:
    """Pieces with roles: by the cycle, by whole files (``uncut``), or as the data specification splits."""
    spec, data = benchmark_of(scenario), scenario.data
    if not spec.cycle:
        runs = whole_runs(dataset, spec.valid_every) if uncut else dataset.trajectories
        return [p for t in runs for p in pieces(t, spec.piece)]
    parts = [p for t in dataset.whole for p in in_turn(t, spec, data.smoothing)]
    shortest = data.warm_up + SCORED * data.dt
    if any(len(p.t) * p.dt < shortest for p in parts):
        raise InputError(
            f"a recording is too short to be cut into {len(spec.cycle)} pieces of {shortest:.3g} s and more, which "
            "training and validation need; give longer ones [HM-WORKFLOW-015]"
        )
    return parts


def until_validated(dataset: Dataset, windows: Container[str]) -> tuple[Trajectory, ...]:
    """Recordings that were split in order of time, from the first sample to a gap or where validation ends.

    Left out are stems with named ``windows``: what lies between these may be anything.
    """
    stems, found = {Path(file).stem for file in dataset.files}, []
    longest = LONGEST * time_unit(dataset.whole, dataset.whole[0].dt) if dataset.whole else 0.0
    for whole in dataset.whole:
        # after a gap a recording begins in motion, and a test run does not
        if whole.name not in stems or whole.name in windows:
            continue
        ends = [p.t[-1] for p in dataset.by_role("valid") if _stem(p.name, stems) == whole.name]
        if ends:
            end = min(max(ends), whole.t[0] + longest)
            found.append(whole.part(whole.t <= end, whole.name, "valid"))
    return tuple(found)


def _stem(name: str, stems: Container[str]) -> str:
    """Stem of the file that a piece is from: later pieces of a file have # and their number after it.

    Example:
        >>> _stem("run#12", {"run"}), _stem("run", {"run"}), _stem("take#2", {"take", "take#2"})
        ('run', 'run', 'take#2')
    """
    return name if name in stems else name.rpartition("#")[0]


def whole_runs(dataset: Dataset, every: int) -> tuple[Trajectory, ...]:
    """All recordings uncut, those of every so many-th file as validation; a gap stays a cut.

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
    """A test file as whole runs, one for each side of a gap; windows of the data specification are ignored.

    Raises:
        InputError: If the file is bad or nothing of it is long enough.
    """
    prior = scenario.prior()
    spec = replace(scenario.data, windows={})
    dataset = load_trajectories([path], prior, spec, needed=())
    if not dataset.whole:
        raise InputError(
            f"{path}: no part is long enough for a free run after {spec.warm_up:g} s that are given [HM-WORKFLOW-016]"
        )
    for finding in dataset.findings:
        warn(str(finding))
    return dataset.whole


def in_turn(trajectory: Trajectory, spec: BenchmarkSpec, distance: float) -> tuple[Trajectory, ...]:
    """Pieces of a whole recording with the cycle's roles in turn, ``distance`` [s] apart.

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
    """Equal pieces of about ``seconds`` each; a few samples at the end may be left over.

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
    """Parts of ``n`` samples one behind the other; a shorter trajectory stays as it is.

    Example:
        >>> z = np.zeros((101, 1))
        >>> run = Trajectory("run", "test", 0.1, 0.1 * np.arange(101), z, z, np.zeros((101, 2)), np.zeros((101, 2)))
        >>> [(p.name, len(p.t), round(float(p.t[0]), 1)) for p in in_runs([run], 40)], len(in_runs([run], 200))
        ([('run', 40, 0.0), ('run', 40, 4.0)], 1)
    """
    return [t.part(slice(a, a + n)) for t in trajectories for a in range(0, max(1, len(t.t) - n + 1), n)]


@dataclass(frozen=True)
class BenchmarkRun:
    """A free run of all candidates over one trajectory: the scored samples, commanded inputs as they act, measured
    outputs, and those of each candidate ``(n, n_y)``.
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

    Only what lies within ``warm_up`` [s] is given: it yields the state that all models start from, and the networks'
    hidden states. Everything after it is scored, or the first ``length`` [s]. Trajectories have the commanded inputs.
    """
    dt = trajectories[0].dt
    warm = warm_samples(warm_up, fit.delay, dt)
    starts = evaluation_trajectories(shifted(trajectories, fit.delay), fit.smoother(prior, dt), warm)
    if length is not None:
        n = warm + round(length / dt) + 1
        starts = [t.part(np.arange(len(t.t)) < n, t.name, t.role) for t in starts]
    after = slice(1, -1)  # after the warm-up: neither the start nor what follows the last input
    found = {"phy": model_states(PriorStep(prior, dt, fit.substeps), starts, warm)[:, after]}
    for kind, trained in networks.items():
        found[kind] = model_states(trained.step(prior, dt), starts, warm)[:, after]
    longest, n_y = max(len(t.t) for t in starts), len(prior.outputs)
    u, w = (np.stack([_padded(getattr(t, key), longest)[warm + 1 :] for t in starts]) for key in ("u", "w"))
    held = np.concatenate(u).T, np.concatenate(w).T, prior.p
    outputs = {
        name: measured_as(
            prior,
            prior.equations.output(x.reshape(-1, x.shape[-1]).T, *held).full().T.reshape(*x.shape[:2], n_y),
        )
        for name, x in found.items()
    }
    first = lost_samples(fit.delay, dt) + warm + 1  # linear models have the inputs as they were commanded
    whole = [t.part(slice(0, first + len(s.t) - warm - 1)) for t, s in zip(trajectories, starts, strict=True)]
    straight = {name: model.free_runs(whole, first) for name, model in (linear or {}).items()}
    return [
        BenchmarkRun(
            t.name,
            t.t[warm + 1 :],
            t.u[warm + 1 :],
            t.y[warm + 1 :],
            {name: y[i, : len(t.t) - warm - 1] for name, y in outputs.items()}
            | {name: measured_as(prior, y[i]) for name, y in straight.items()},
        )
        for i, t in enumerate(starts)
    ]


def scored_signals(outputs: Sequence[Signal], spec: BenchmarkSpec) -> list[tuple[Signal, float]]:
    """Outputs in the units of the figures, and how many of these are one of their own.

    Raises:
        InputError: If the specification has a unit for what is no output.

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
    """Errors of one candidate over all runs of a file, in the benchmark's units; ``error`` is over the standard
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


def warm_samples(warm_up: float, delay: float, dt: float) -> int:
    """Periods from the first sample whose acting input is known to the last one that is given.

    Example:
        >>> warm_samples(1.225, 0.0, 0.025), warm_samples(1.225, 0.03, 0.025)
        (49, 47)
    """
    return max(1, round(warm_up / dt) - lost_samples(delay, dt))


def _padded(values: Array, length: int) -> Array:
    """Rows up to a length, the last one again and again."""
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])
