"""``hybrid-mpc monitor``: replay the monitor over recordings, or learn its limits from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from hybrid_mpc.compare.controllers import find_noise
from hybrid_mpc.data.trajectories import Cut, Dataset, load_trajectories
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_object, write_json, write_text
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.kit.assembly import sensor_steps
from hybrid_mpc.kit.parts import artifact_folder
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.records import record
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.watch.explain import WatchedRecording, explained, table
from hybrid_mpc.watch.learn import learn_limits
from hybrid_mpc.watch.lengths import rest_speeds
from hybrid_mpc.watch.monitor import Monitor, make_monitor, make_readings, reads_energy
from hybrid_mpc.watch.readings import ENERGY, RESIDUALS
from hybrid_mpc.watch.replay import EstimatorLike, along


@dataclass(frozen=True)
class MonitorResult:
    """Results of :func:`watch`, content of ``monitor.json``.

    Args:
        kind: Kind of readings.
        recordings: The recordings with their alarms.
        warnings: Warnings about the recordings.
        notes: How files were read that needed more than a plain table.
        gaps: Gaps of the recordings.
        not_watched: Parts too short for the monitor.
        limits: Limits of the channels.
        data_hash: Hash of the recordings.
    """

    kind: str
    recordings: tuple[WatchedRecording, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    gaps: tuple[Cut, ...]
    not_watched: tuple[Cut, ...]
    limits: WatchLimits | None
    data_hash: str


@dataclass(frozen=True)
class MonitorJob:
    """Input of ``hybrid-mpc monitor``.

    Args:
        kit: Models and learned limits.
        data: The recordings.
        kind: Kind of readings, ``"energy"`` or ``"residuals"``.
        limits: Limits of the channels. Default: none.
        resolution: Resolution of each sensor ``(n_y,)``. Default: that of the limits.
    """

    kit: Kit
    data: Dataset
    kind: str
    limits: WatchLimits | None = None
    resolution: tuple[float, ...] | None = None

    @property
    def model(self) -> HybridModel:
        """The recommended model, which the monitor compares with the machine."""
        return self.kit.models[self.kit.recommended]

    @cached_property
    def estimator(self) -> EstimatorLike:
        """The estimator of the closed loops."""
        return self.kit.observer()

    @cached_property
    def monitor(self) -> Monitor:
        """The monitor."""
        rest = None if self.limits is not None and self.limits.rest_speed else self.kit.known_rest
        return make_monitor(
            self.model, self.limits, kind=self.kind, resolution=self.resolution, rest_speed=rest,
            input_range=self.kit.problem().input_range,
        )  # fmt: skip


def prepared(
    scenario: Scenario | None,
    model: Path,
    recordings: Sequence[Path],
    *,
    resolution: tuple[float, ...] | None = None,
    calibration: Path | None = None,
    residuals: bool = False,
) -> MonitorJob:
    """Load and check model, recordings and limits.

    Args:
        scenario: Says how recordings are read, and the noise of the estimator. None: the artifact says both.
        model: Folder of the artifact, or of its run.
        recordings: Files.
        resolution: Resolution of each sensor. Default: that of the limits.
        calibration: ``calibration.json`` with limits. Default: the artifact's limits, if any.
        residuals: Whether to watch residuals although the energy can be watched. Default: False.

    Raises:
        InputError: If there is no control problem, a file is bad, or model and recordings do not match; without a
            scenario also if the artifact does not say how its recordings are read.
    """
    if scenario is not None and scenario.control is None:
        raise InputError(
            f"scenario {scenario.name}: no control problem, so the estimator knows no input range. Give the scenario "
            "control=OCP(...) [HM-WORKFLOW-022]"
        )
    folder = artifact_folder(model)
    kit = load(folder)
    if scenario is not None:
        kit, spec = kit.on(scenario), scenario.data
    elif kit.predicting is not None:
        spec = kit.predicting.data
    else:
        raise InputError(
            f"{folder}: an older version wrote it, without a data specification. Give --scenario, or run the scenario "
            "again [HM-WORKFLOW-023]"
        )
    watched = kit.models[kit.recommended]
    if abs(watched.dt - spec.dt) > 1e-9:
        raise InputError(
            f"dt: the model period is {watched.dt} s, but scenario {kit.name} resamples to {spec.dt} s. Give the "
            "scenario of this model [HM-WORKFLOW-024]"
        )
    # the monitor watches whole recordings: no warm-up, no roles
    spec = replace(spec, windows={}, warm_up=spec.dt, fractions=(1.0, 0.0, 0.0))
    data = load_trajectories(recordings, watched, spec, needed=())
    if not data.whole:
        cut = "; ".join(f"{c.file} {c.start_s:g} to {c.end_s:g} s: {c.why}" for c in data.cuts)
        raise InputError(
            f"recordings: every part is too short for the monitor: {cut}. Give longer recordings [HM-WORKFLOW-025]"
        )
    if scenario is not None:
        kit = kit.with_noise(find_noise(scenario, kit, (f"{kit.recommended}_observer",), 0)[0])
    kind = RESIDUALS if residuals or not reads_energy(watched) else ENERGY
    if calibration is not None:
        limits: WatchLimits | None = read_limits(calibration, kind)
    else:
        own = kit.watch.get(kit.recommended)
        limits = None if own is None else own.limits.get(kind)
    return MonitorJob(kit, data, kind, limits, resolution)


def read_limits(path: Path, kind: str) -> WatchLimits:
    """Read the limits of a kind from a ``calibration.json`` of :func:`learn`; InputError if they are missing."""
    stored = read_object(path)
    if stored.get(kind) is None:
        raise InputError(
            f"{path}: no limits of {kind}; learn them with hybrid-mpc monitor ... --learn 1 [HM-WORKFLOW-026]"
        )
    return record(WatchLimits, stored[kind], f"{path}: {kind}")


def learn(job: MonitorJob, rate: float, out: Path, progress: Progress | None = None) -> WatchLimits:
    """Learn limits for ``rate`` false alarms an hour from nominal recordings; writes ``calibration.json``."""
    model, say = job.model, progress or Progress()
    say.start("replaying the recordings")
    rest = None
    if job.kind == ENERGY:
        rest = job.kit.rest_speed or rest_speeds(job.data.whole, model)
    limits = learn_limits(
        make_readings(model, job.kind, rest_speed=rest), job.estimator, job.data.whole, false_alarms_per_hour=rate,
        resolution=job.resolution or (sensor_steps(job.kit.sensor_sigma) if job.kind == ENERGY else None),
        data_hash=job.data.hash, on_progress=lambda done, total: say.update("recordings", done, total, "samples"),
    )  # fmt: skip
    say.finish("")
    write_json(out / "calibration.json", {job.kind: limits})
    return limits


def watch(job: MonitorJob, out: Path, progress: Progress | None = None) -> MonitorResult:
    """Replay the monitor over each recording: ``NAME.csv`` and ``NAME.png``, and last ``monitor.json``."""
    from hybrid_mpc.plots.monitor import channels
    from hybrid_mpc.plots.style import save

    progress, rows, monitor = progress or Progress(), [], job.monitor
    diagnoser = None if job.limits is None else job.kit.diagnoser
    progress.start("replaying the recordings")
    for recording, report in along(job.data.whole, progress.update):
        name, seconds = recording.name.replace("#", "_"), len(recording.t) * recording.dt
        trace, alarms = explained(monitor, job.estimator, recording, diagnoser, report)
        rows.append(WatchedRecording(recording.name, seconds, **trace.coverage(recording.dt), alarms=alarms))
        write_text(out / f"{name}.csv", table(trace, recording.y, job.model.outputs, monitor))
        notes = [(alarm.start_s, alarm.diagnosis) for alarm in alarms if alarm.diagnosis]
        figure = channels(
            trace, recording.y, outputs=job.model.outputs, limits=job.limits, notes=notes, title=name
        )
        save(figure, out / f"{name}.png")
    progress.finish("")
    data = job.data
    gaps, short = (tuple(cut for cut in data.cuts if ("gap" in cut.why) is gap) for gap in (True, False))
    result = MonitorResult(
        job.kind, tuple(rows), data.warnings, data.notes, gaps, short, job.limits, data.hash
    )
    write_json(out / "monitor.json", result)
    return result
