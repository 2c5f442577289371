"""The energy monitor over recordings of an artifact's machine, or its detector learned from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Dataset, Trajectory, load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_object, write_json, write_text
from hybrid_mpc.job.context import Progress, Silent
from hybrid_mpc.job.controllers import find_noise
from hybrid_mpc.kit.artifact import Kit, artifact_folder, load
from hybrid_mpc.kit.assembly import make_monitor, sensor_steps
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.diagnose import Diagnoser
from hybrid_mpc.monitor.energy import EnergyMonitor, Verdict
from hybrid_mpc.monitor.learn import guard_monitor, learn_from
from hybrid_mpc.monitor.lengths import HISTORY_S, samples
from hybrid_mpc.monitor.replay import EstimatorLike, MonitorTrace, TrajectoryLike, along, replay
from hybrid_mpc.monitor.residuals import force_units
from hybrid_mpc.records import plain, record
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
FROZEN = "the sensor repeats itself while motion is predicted"
BLIND = {
    Verdict.WARM_UP: "nothing can be judged: the monitor's window is not full",
    Verdict.MISSING: "nothing can be judged: samples are missing",
    Verdict.NOT_FINITE: "nothing can be judged: model or estimator gives no finite number",
}
"""What is said of an alarm that the monitor raises because it is blind."""


@dataclass(frozen=True)
class MonitorJob:
    """What ``hybrid-mpc monitor`` needs.

    Args:
        kit: Prior and hybrid, and the process noise of their filters.
        data: The recordings.
        resolution: Step of each sensor, or None.
        detector: Detector, or None for the artifact's thresholds.
    """

    kit: Kit
    data: Dataset
    resolution: tuple[float, ...] | None = None
    detector: Detector | None = None

    @property
    def estimator(self) -> EstimatorLike:
        """The estimator of the closed loops."""
        return self.kit.observer()

    @property
    def monitor(self) -> EnergyMonitor:
        """The guard's monitor where there is a detector, else that of the main job with the artifact's thresholds."""
        model = self.kit.models["hybrid"]
        if self.detector is not None:
            known, ranges = model.n_p > 0, self.kit.problem().input_range
            return guard_monitor(
                model, self.detector, resolution=self.resolution, input_range=ranges, diagnose=known
            )
        return make_monitor(model, self.kit.calibration)


def prepared(
    scenario: Scenario,
    model: Path,
    recordings: Sequence[Path],
    *,
    resolution: tuple[float, ...] | None = None,
    calibration: Path | None = None,
) -> MonitorJob:
    """Load and check everything.

    Args:
        scenario: The machine.
        model: Artifact folder, or the folder of the run that holds it as ``model``.
        recordings: CSV, ``.npz`` or ``.mat`` files.
        resolution: Step of each sensor. Default: with a detector what the filters' assumed noise comes to, as in the
            main job.
        calibration: ``calibration.json`` with a detector. Default: the artifact's, if it has one.

    Raises:
        InputError: If the scenario defines no control problem, a file is bad, or things do not fit each other.
    """
    if scenario.control is None:
        raise InputError(
            f"scenario {scenario.name} defines no control problem, so the estimator knows no input range; give the "
            "scenario control=OCP(...)"
        )
    folder = artifact_folder(model)
    kit = load(folder).on(scenario)
    hybrid = kit.models["hybrid"]
    if abs(hybrid.dt - scenario.data.dt) > 1e-9:
        raise InputError(
            f"the model's period is {hybrid.dt} s, scenario {scenario.name} resamples to {scenario.data.dt} s"
        )
    # all of a recording is watched: nothing warms up, and no part of it has a role
    spec = replace(scenario.data, windows={}, warm_up=scenario.data.dt, fractions=(1.0, 0.0, 0.0))
    data = load_trajectories(
        recordings, spec, outputs=hybrid.outputs, inputs=hybrid.inputs, states=hybrid.states, needed=()
    )
    if not data.whole:
        cut = "; ".join(f"{c.file} {c.start:g} to {c.end:g} s: {c.why}" for c in data.cuts)
        raise InputError(f"no part of the recordings is long enough to be watched: {cut}")
    kit = kit.with_noise(find_noise(scenario, kit, ("hybrid_observer",), 0)[0])
    if calibration is not None:
        found: Detector | None = read_detector(calibration)
    else:
        found = None if kit.calibration is None else kit.calibration.detector
    if found is not None and resolution is None:
        resolution = sensor_steps(scenario.sensor_sigma)
    return MonitorJob(kit, data, resolution, found)


def read_detector(path: Path) -> Detector:
    """The detector in a ``calibration.json`` that :func:`learn` wrote.

    Raises:
        InputError: If it cannot be read or holds none.
    """
    stored = read_object(path)
    if stored.get("detector") is None:
        raise InputError(f"{path} holds no detector; make it with hybrid-mpc monitor ... --learn 1")
    return record(Detector, stored["detector"], f"{path}: detector")


def learn(job: MonitorJob, rate: float, out: Path, progress: Progress | None = None) -> Detector:
    """Learn a detector from the job's recordings, in which nothing may be wrong; writes ``calibration.json``.

    Args:
        job: The job.
        rate: Wanted false alarms an hour.
        out: Folder.
        progress: Where to report; default: nowhere.
    """
    model, say = job.kit.models["hybrid"], progress or Silent()
    say.start("replaying the recordings")
    detector = learn_from(
        model, job.estimator, job.data.whole, false_alarms_per_hour=rate, rest_speed=job.kit.rest_speed,
        data_hash=job.data.hash, report=say.update,
    )  # fmt: skip
    say.finish("")
    write_json(out / "calibration.json", {"detector": plain(detector)})
    return detector


def watch(job: MonitorJob, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Replay the monitor over each recording: ``NAME.csv`` and ``NAME.png``, and last ``monitor.json``.

    Args:
        job: The job.
        out: Folder.
        progress: Where to report; default: nowhere.

    Returns:
        What ``monitor.json`` holds: of each recording its alarms, and how much of it was judged and how much not, by
        reason.
    """
    from hybrid_mpc.plots.monitor import overview
    from hybrid_mpc.plots.style import save

    rows, output, tell = [], job.kit.models["hybrid"].outputs[0], progress or Silent()
    tell.start("replaying the recordings")
    for recording, say in along(job.data.whole, tell.update):
        trace, alarms = watched(job, recording, say)
        length = {"seconds": len(trace.t) * recording.dt, **trace.coverage(recording.dt)}
        rows.append({"recording": recording.name, **length, "alarms": alarms})
        name = recording.name.replace("#", "_")
        write_text(out / f"{name}.csv", table(trace, recording, job.kit.models["hybrid"].outputs))
        limits, calibration = {}, job.monitor.calibration
        if calibration is not None:
            found = {"violation": calibration.threshold_w, "residual": calibration.residual_threshold}
            limits = {name: limit for name, limit in found.items() if limit is not None}
        notes = [(a["start_s"], a["diagnosis"]) for a in alarms if a["diagnosis"]]
        figure = overview(
            trace,
            recording.y[:, 0],
            output=output,
            force_unit=force_units(job.kit.models["hybrid"])[0],
            thresholds=limits,
            notes=notes,
            title=name,
        )
        save(figure, out / f"{name}.png")
    tell.finish("")
    result = {
        "recordings": rows,
        "warnings": [str(finding) for finding in job.data.findings],
        "gaps": [cut._asdict() for cut in job.data.cuts if "gap" in cut.why],
        "not_watched": [cut._asdict() for cut in job.data.cuts if "gap" not in cut.why],
        "detector": plain(job.detector),
        "thresholds": plain(job.monitor.calibration),
        "data_hash": job.data.hash,
    }
    write_json(out / "monitor.json", result)
    return result


def watched(
    job: MonitorJob, recording: Trajectory, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[MonitorTrace, list[dict[str, Any]]]:
    """Trace of a recording, and its alarms with what explains them (empty where nothing can say)."""
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
) -> tuple[MonitorTrace, list[dict[str, Any]]]:
    """Replay a monitor, and say of each alarm what explains it.

    Args:
        monitor: The monitor; with history and detector its alarms are explained.
        estimator: The estimator of the closed loops.
        recording: On the model's grid.
        causes: What may break, see :class:`~hybrid_mpc.monitor.diagnose.Diagnoser`. Empty: each parameter by itself.
        on_progress: ``(done, total)`` samples.
        prior: Model of the prior alone, see there.

    Returns:
        The trace, and ``{start_s, end_s, diagnosis}`` of each alarm; no diagnosis where nothing can say.
    """
    can = monitor.layout.history and monitor.detector is not None
    diagnoser = Diagnoser(monitor, causes or None, prior=prior) if can else None
    dt, last = monitor.model.dt, len(recording.t) - 1
    later = samples(HISTORY_S, monitor.model)  # by then the history holds nothing from before the alarm
    texts: dict[int, str] = {}
    began: list[int] = []

    def look(k: int, state: Any, reading: Any) -> None:
        if reading.alarm and (not began or began[-1] < 0):
            began.append(k)
        if not began or began[-1] < 0:
            return
        start = began[-1]
        if reading.frozen:
            texts[start] = FROZEN
        elif reading.blind:
            texts.setdefault(start, BLIND[reading.verdict])
        due = not reading.alarm or k == start + later or k == last
        if due and diagnoser is not None and start not in texts:
            texts[start] = diagnoser.diagnose(state, (k - start) * dt).text
        if not reading.alarm:
            began.append(-1)

    trace = replay(monitor, estimator, recording, look, on_progress=on_progress)
    alarms = [
        {"start_s": float(trace.t[a]), "end_s": end, "diagnosis": texts.get(a, "")}
        for a, (_, end) in zip([k for k in began if k >= 0], trace.intervals(), strict=True)
    ]
    return trace, alarms


def table(trace: MonitorTrace, recording: Trajectory, outputs: Sequence[Any]) -> str:
    """The trace as CSV, one row a sample, columns with units."""
    columns: dict[str, Any] = {"t_s": trace.t}
    for i, signal in enumerate(outputs):
        columns[f"{signal.name}_{signal.unit}"] = recording.y[:, i]
    for name in (
        "dE_model_w",
        "dE_measured_w",
        "violation_w",
        "level_w",
        "residual_level",
        "energy_j",
        "energy_s",
    ):
        columns[name] = getattr(trace, name)
    if trace.scores.size:
        columns |= {"force_score": trace.scores[:, 0], "power_score": trace.scores[:, 1]}
    columns |= {"judged": (trace.verdict == Verdict.JUDGED).astype(int)}
    columns |= {"frozen": trace.frozen.astype(int), "alarm": trace.alarm.astype(int)}
    row = ",".join(["%.9g"] * len(columns))
    lines = [
        ",".join(columns),
        *(row % tuple(values) for values in np.column_stack([*columns.values()]).tolist()),
    ]
    return "\n".join(lines) + "\n"
