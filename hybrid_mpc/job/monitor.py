"""``hybrid-mpc monitor``: what watches a machine over recordings of it, or what it alarms by learned from them."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_mpc.data.trajectories import Cut, Dataset, Trajectory, load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_object, write_json, write_text
from hybrid_mpc.job.context import Progress
from hybrid_mpc.job.controllers import find_noise
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.kit.assembly import energy_is_watched, make_monitor, sensor_steps
from hybrid_mpc.kit.parts import artifact_folder
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import Calibration
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.diagnose import Diagnoser
from hybrid_mpc.monitor.energy import EnergyMonitor, Validity
from hybrid_mpc.monitor.energy_readings import force_unit
from hybrid_mpc.monitor.explain import ResidualDiagnoser
from hybrid_mpc.monitor.learn import guard_monitor, learn_from
from hybrid_mpc.monitor.lengths import HISTORY_S, samples
from hybrid_mpc.monitor.replay import EstimatorLike, MonitorTrace, TrajectoryLike, along, replay
from hybrid_mpc.monitor.residuals import (
    ResidualLimits,
    ResidualMonitor,
    ResidualTrace,
    learn_residuals,
    replay_residuals,
)
from hybrid_mpc.records import record
from hybrid_mpc.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FROZEN = "the sensor repeats itself while motion is predicted"
BLIND = {
    Validity.WARM_UP: "no valid reading: the monitor's window is not full",
    Validity.MISSING: "no valid reading: samples are missing",
    Validity.NOT_FINITE: "no valid reading: model or estimator gives no finite number",
}
"""Diagnosis of an alarm that the monitor raises because it has no valid reading."""
COLUMNS = (
    "dE_model_w", "dE_measured_w", "violation_w", "level_w", "residual_level", "energy_j", "energy_s"
)  # fmt: skip
"""Numbers of a trace that its CSV holds."""


@dataclass(frozen=True)
class Alarm:
    """An alarm from its first to its last sample [s] in the recording's own time, what explains it, if anything can,
    and of the residuals the channels that alarmed, in the order in which they did.
    """

    start_s: float
    end_s: float
    diagnosis: str
    channels: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordingResult:
    """What the monitor found in a recording, and why it had no valid reading of parts: its window was not full
    (``warm_up_s``), samples were missing, or model or estimator gave no finite number.
    """

    recording: str
    seconds: float
    valid_s: float
    warm_up_s: float
    missing_s: float
    not_finite_s: float
    alarms: tuple[Alarm, ...]


@dataclass(frozen=True)
class MonitorResult:
    """What :func:`watch` found in each recording, the gaps in them, and parts too short to be watched."""

    recordings: tuple[RecordingResult, ...]
    gaps: tuple[Cut, ...]
    not_watched: tuple[Cut, ...]


@dataclass(frozen=True)
class MonitorJob:
    """What ``hybrid-mpc monitor`` needs.

    Args:
        kit: The models, and what was learned with them.
        data: The recordings.
        resolution: Step of each sensor. Default: unknown.
        detector: Detector of the energy. Default: none, then the artifact's thresholds.
        energy: Whether the energy is watched; else the residuals. Default: yes.
        limits: Limits of the residuals. Default: none.
    """

    kit: Kit
    data: Dataset
    resolution: tuple[float, ...] | None = None
    detector: Detector | None = None
    energy: bool = True
    limits: ResidualLimits | None = None

    @property
    def name(self) -> str:
        """Name of the model that is compared with the machine: of the energy the hybrid, else the recommended one."""
        return "hybrid" if self.energy else self.kit.recommended

    @property
    def model(self) -> HybridModel:
        """That model."""
        return self.kit.models[self.name]

    @cached_property
    def estimator(self) -> EstimatorLike:
        """The estimator of the closed loops."""
        return self.kit.observer(self.name)

    @cached_property
    def residuals(self) -> ResidualMonitor:
        """The monitor of the residuals."""
        return ResidualMonitor(self.model, limits=self.limits, resolution=self.resolution)

    @cached_property
    def monitor(self) -> EnergyMonitor:
        """The guard's monitor where there is a detector, else that of the main job with the artifact's thresholds."""
        model = self.model
        if self.detector is not None:
            known, ranges = model.n_p > 0, self.kit.problem().input_range
            return guard_monitor(
                model, self.detector, resolution=self.resolution, input_range=ranges, diagnose=known
            )
        return make_monitor(model, self.kit.calibration)


def prepared(
    scenario: Scenario | None,
    model: Path,
    recordings: Sequence[Path],
    *,
    resolution: tuple[float, ...] | None = None,
    calibration: Path | None = None,
    residuals: bool = False,
) -> MonitorJob:
    """Load and check everything.

    ``model`` is an artifact's folder or its run's. Without a ``scenario`` the artifact says how recordings are read,
    and what the estimator assumes; with one, the scenario does. The ``resolution`` is the step of each sensor; default:
    with a detector what the filters' assumed noise comes to, as in the main job, else the limits of the residuals know
    it.
    ``calibration`` is a ``calibration.json`` with a detector, or limits of residuals; default: the artifact's, if it
    has them. ``residuals``: watch these where the energy can be watched, too.

    Raises:
        InputError: If there is no control problem, a file is bad, or things do not fit each other; without a scenario
            also if the artifact does not say how its recordings are read.
    """
    if scenario is not None and scenario.control is None:
        raise InputError(
            f"scenario {scenario.name} defines no control problem, so the estimator knows no input range; give the "
            "scenario control=OCP(...)"
        )
    folder = artifact_folder(model)
    kit = load(folder)
    if scenario is not None:
        kit, spec = kit.on(scenario), scenario.data
    elif kit.predicting is not None:
        spec = kit.predicting.data
    else:
        raise InputError(
            f"{folder} does not say how its recordings are read: an older version wrote it; give --scenario, or run "
            "the scenario again"
        )
    hybrid = kit.models.get("hybrid", kit.models[kit.recommended])
    energy = not residuals and energy_is_watched(hybrid)
    if abs(hybrid.dt - spec.dt) > 1e-9:
        raise InputError(f"the model's period is {hybrid.dt} s, scenario {kit.name} resamples to {spec.dt} s")
    # all of a recording is watched: nothing warms up, and no part of it has a role
    spec = replace(spec, windows={}, warm_up=spec.dt, fractions=(1.0, 0.0, 0.0))
    data = load_trajectories(recordings, hybrid, spec, needed=())
    if not data.whole:
        cut = "; ".join(f"{c.file} {c.start:g} to {c.end:g} s: {c.why}" for c in data.cuts)
        raise InputError(f"no part of the recordings is long enough to be watched: {cut}")
    watched = "hybrid" if energy else kit.recommended
    if scenario is not None:
        kit = kit.with_noise(find_noise(scenario, kit, (f"{watched}_observer",), 0)[0])
    if not energy:
        limits = kit.residuals.get(watched) if calibration is None else read_limits(calibration)
        return MonitorJob(kit, data, resolution, None, False, limits)
    if calibration is not None:
        found: Detector | None = read_detector(calibration)
    else:
        found = None if kit.calibration is None else kit.calibration.detector
    if found is not None and resolution is None:
        resolution = sensor_steps(kit.sensor_sigma)
    return MonitorJob(kit, data, resolution, found)


def read_detector(path: Path) -> Detector:
    """The detector in a ``calibration.json`` that :func:`learn` wrote; InputError if there is none."""
    stored = read_object(path)
    if stored.get("detector") is None:
        raise InputError(f"{path} holds no detector; make it with hybrid-mpc monitor ... --learn 1")
    return record(Detector, stored["detector"], f"{path}: detector")


def read_limits(path: Path) -> ResidualLimits:
    """The limits of residuals in a ``calibration.json`` that :func:`learn` wrote; InputError if there are none."""
    stored = read_object(path)
    if stored.get("residuals") is None:
        raise InputError(
            f"{path} holds no limits of residuals; make them with hybrid-mpc monitor ... --learn 1"
        )
    return record(ResidualLimits, stored["residuals"], f"{path}: residuals")


def learn(
    job: MonitorJob, rate: float, out: Path, progress: Progress | None = None
) -> Detector | ResidualLimits:
    """Learn for ``rate`` false alarms an hour from nominal recordings: a detector of the energy, or limits of the
    residuals; writes ``calibration.json``.
    """
    model, say = job.model, progress or Progress()
    say.start("replaying the recordings")
    if not job.energy:
        limits = learn_residuals(
            model, job.estimator, job.data.whole, false_alarms_per_hour=rate,
            on_progress=lambda done, total: say.update("recordings", done, total, "samples"),
        )  # fmt: skip
        say.finish("")
        write_json(out / "calibration.json", {"residuals": limits})
        return limits
    detector = learn_from(
        model, job.estimator, job.data.whole, false_alarms_per_hour=rate, rest_speed=job.kit.rest_speed,
        data_hash=job.data.hash, report=say.update,
    )  # fmt: skip
    say.finish("")
    write_json(out / "calibration.json", {"detector": detector})
    return detector


def watch(job: MonitorJob, out: Path, progress: Progress | None = None) -> MonitorResult:
    """Replay the monitor over each recording: ``NAME.csv`` and ``NAME.png``, and last ``monitor.json``."""
    from hybrid_mpc.plots.style import save

    progress, rows = progress or Progress(), []
    look: Callable[..., tuple[MonitorTrace | ResidualTrace, tuple[Alarm, ...], str, Figure]]
    look = _by_energy if job.energy else _by_residuals
    progress.start("replaying the recordings")
    for recording, report in along(job.data.whole, progress.update):
        name, seconds = recording.name.replace("#", "_"), len(recording.t) * recording.dt
        trace, alarms, csv, figure = look(job, recording, name, report)
        rows.append(RecordingResult(recording.name, seconds, **trace.coverage(recording.dt), alarms=alarms))
        write_text(out / f"{name}.csv", csv)
        save(figure, out / f"{name}.png")
    progress.finish("")
    gaps, short = ([cut for cut in job.data.cuts if ("gap" in cut.why) is gap] for gap in (True, False))
    how: dict[str, object] = {"residuals": job.limits}
    if job.energy:
        how = {"detector": job.detector, "thresholds": job.monitor.calibration}
    result = {
        "recordings": rows,
        "warnings": [str(finding) for finding in job.data.findings],
        "gaps": [cut._asdict() for cut in gaps],
        "not_watched": [cut._asdict() for cut in short],
        **how,
        "data_hash": job.data.hash,
    }
    write_json(out / "monitor.json", result)
    return MonitorResult(tuple(rows), tuple(gaps), tuple(short))


def _by_residuals(
    job: MonitorJob, recording: Trajectory, title: str, report: Callable[[int, int], None]
) -> tuple[ResidualTrace, tuple[Alarm, ...], str, Figure]:
    """What the residuals say of a recording, and that as table and picture."""
    from hybrid_mpc.plots.monitor import channels

    monitor, limits = job.residuals, job.limits
    trace, alarms = explained_residuals(
        monitor, job.estimator, recording, job.kit.models.get("prior"), job.kit.causes, report
    )
    thresholds = None if limits is None else limits.threshold
    figure = channels(trace, monitor.units, thresholds, notes=_notes(alarms), title=title)
    return trace, alarms, residual_table(trace, recording, monitor), figure


def _by_energy(
    job: MonitorJob, recording: Trajectory, title: str, report: Callable[[int, int], None]
) -> tuple[MonitorTrace, tuple[Alarm, ...], str, Figure]:
    """What the energy says of a recording, and that as table and picture."""
    from hybrid_mpc.plots.monitor import overview

    trace, alarms = watched(job, recording, report)
    figure = overview(
        trace, recording.y, outputs=job.model.outputs, force_unit=force_unit(job.model),
        thresholds=thresholds_of(job.monitor.calibration), notes=_notes(alarms), title=title,
    )  # fmt: skip
    return trace, alarms, table(trace, recording, job.model.outputs), figure


def _notes(alarms: Sequence[Alarm]) -> list[tuple[float, str]]:
    return [(alarm.start_s, alarm.diagnosis) for alarm in alarms if alarm.diagnosis]


def thresholds_of(calibration: Calibration | None) -> dict[str, float]:
    """Thresholds that there are, as :func:`~hybrid_mpc.plots.monitor.overview` takes them."""
    if calibration is None:
        return {}
    found = {"violation": calibration.threshold_w, "residual": calibration.residual_threshold}
    return {name: limit for name, limit in found.items() if limit is not None}


def watched(
    job: MonitorJob, recording: Trajectory, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[MonitorTrace, tuple[Alarm, ...]]:
    """Trace of a recording, and its alarms."""
    return explained(
        job.monitor, job.estimator, recording, job.kit.causes, on_progress, prior=job.kit.models.get("prior")
    )


def explained(
    monitor: EnergyMonitor,
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    causes: Mapping[str, tuple[str, ...]],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    *,
    prior: HybridModel | None = None,
) -> tuple[MonitorTrace, tuple[Alarm, ...]]:
    """Replay a monitor with the closed loops' estimator, and diagnose each alarm if it has history and detector.

    ``causes`` and ``prior`` are those of :class:`~hybrid_mpc.monitor.diagnose.Diagnoser`.
    """
    can = monitor.layout.history and monitor.detector is not None
    diagnoser = Diagnoser(monitor, causes or None, prior=prior) if can else None
    dt, last = monitor.model.dt, len(recording.t) - 1
    later = samples(HISTORY_S, monitor.model)  # by then the history holds nothing from before the alarm
    texts: dict[int, str] = {}
    starts: list[int] = []
    active = False

    def look(k: int, state: Any, reading: Any) -> None:
        nonlocal active
        if reading.alarm and not active:
            starts.append(k)
        elif not active:
            return
        active, start = reading.alarm, starts[-1]
        if reading.frozen:
            texts[start] = FROZEN
        elif reading.blind:
            texts.setdefault(start, BLIND[reading.validity])
        due = not active or k == start + later or k == last
        if due and diagnoser is not None and start not in texts:
            texts[start] = diagnoser.diagnose(state, (k - start) * dt).text

    trace = replay(monitor, estimator, recording, look, on_progress=on_progress)
    ends = (end for _, end in trace.intervals())
    return trace, tuple(
        Alarm(float(trace.t[k]), end, texts.get(k, "")) for k, end in zip(starts, ends, strict=True)
    )


def explained_residuals(
    monitor: ResidualMonitor,
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    prior: HybridModel | None,
    causes: Mapping[str, tuple[str, ...]],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[ResidualTrace, tuple[Alarm, ...]]:
    """Replay the monitor of residuals with the closed loops' estimator, and diagnose each alarm if there are limits.

    ``causes`` and ``prior`` are those of :class:`~hybrid_mpc.monitor.explain.ResidualDiagnoser`.
    """
    estimates: list[Any] = []
    trace = replay_residuals(
        monitor, estimator, recording, on_sample=lambda k, estimate: estimates.append(estimate),
        on_progress=on_progress,
    )  # fmt: skip
    model = monitor.model
    diagnoser = None
    if monitor.limits is not None and trace.alarm.any():
        diagnoser = ResidualDiagnoser(model, monitor.limits, causes or None, prior=prior)
    alarms = []
    for start, end in trace.intervals():
        k, channels = int(np.searchsorted(trace.t, start - 1e-9)), trace.named(start, end)
        text = BLIND.get(Validity(int(trace.validity[k])), "") if not channels else ""
        if diagnoser is not None and channels:
            text = diagnoser.of_alarm(k, trace, recording, estimates)
        alarms.append(Alarm(start, end, text, channels))
    return trace, tuple(alarms)


def begun(alarms: Sequence[Alarm], start: float) -> tuple[list[Alarm], list[Alarm]]:
    """Alarms that begin before ``start`` [s], and those from then on.

    One that is on already when something breaks says nothing of it.

    Example:
        >>> before, seen = begun((Alarm(1.0, 9.0, ""), Alarm(5.0, 6.0, "pump")), 4.0)
        >>> len(before), seen[0].diagnosis
        (1, 'pump')
    """
    before = [alarm for alarm in alarms if alarm.start_s < start - 1e-9]
    return before, [alarm for alarm in alarms if alarm not in before]


def residual_table(trace: ResidualTrace, recording: Trajectory, monitor: ResidualMonitor) -> str:
    """The trace as CSV, one row a sample: measurements, residuals and their levels with units, alarms by channel."""
    columns: dict[str, Any] = {"t_s": trace.t}
    columns |= {f"{s.name}_{s.unit}": recording.y[:, i] for i, s in enumerate(monitor.model.outputs)}
    for i, (name, unit) in enumerate(zip(monitor.channels, monitor.units, strict=True)):
        label = name.replace(" ", "_")
        columns[f"{label}_residual_{unit}"] = trace.residual[:, i]
        columns |= {f"{label}_{of}_{unit}": trace.level[:, i, j] for j, of in enumerate(("short", "long"))}
        columns[f"{label}_alarm"] = trace.on[:, i]
    columns |= {f"{name}_frozen": trace.frozen[:, i] for i, name in enumerate(trace.outputs)}
    columns |= {"share": trace.share, "valid": trace.validity == Validity.VALID, "alarm": trace.alarm}
    return _csv(columns)


def table(trace: MonitorTrace, recording: Trajectory, outputs: Sequence[Signal]) -> str:
    """The trace as CSV, one row a sample, columns with units."""
    columns: dict[str, Any] = {"t_s": trace.t}
    columns |= {f"{s.name}_{s.unit}": recording.y[:, i] for i, s in enumerate(outputs)}
    columns |= {name: getattr(trace, name) for name in COLUMNS}
    if trace.scores.size:
        columns |= {"force_score": trace.scores[:, 0], "power_score": trace.scores[:, 1]}
    columns |= {"valid": trace.validity == Validity.VALID, "frozen": trace.frozen, "alarm": trace.alarm}
    return _csv(columns)


def _csv(columns: Mapping[str, Any]) -> str:
    text = io.StringIO()
    rows = np.column_stack([*columns.values()])
    np.savetxt(text, rows, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
    return text.getvalue()
