"""The energy monitor over recordings of an artifact's machine, or its detector learned from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Artifact, artifact_folder, load_artifact
from hybrid_mpc.data.trajectories import Dataset, Trajectory, load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_json, write_json, write_text
from hybrid_mpc.monitor import Calibration, Detector, Diagnoser, EnergyMonitor, MonitorTrace, guard_monitor
from hybrid_mpc.monitor.replay import EstimatorLike, TrajectoryLike, replay
from hybrid_mpc.monitor.standard import learn_from
from hybrid_mpc.pipeline.control_noise import find_noise
from hybrid_mpc.pipeline.loops import make_estimator, make_monitor, sensor_steps
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
DIAGNOSED_S = 2.0
"""An alarm is explained so long after its start, or at its end: by then the history holds nothing older."""
FROZEN = "the sensor repeats itself while motion is predicted"


@dataclass(frozen=True)
class MonitorJob:
    """What ``hybrid-mpc monitor`` needs.

    Args:
        scenario: The machine: columns, period, input range, sensor noise.
        artifact: Prior and hybrid.
        data: The recordings.
        sigma_x: Process noise of the hybrid's filter ``(n_x,)``.
        resolution: Step of each sensor, or None.
        detector: Detector, or None for the artifact's thresholds.
    """

    scenario: Scenario
    artifact: Artifact
    data: Dataset
    sigma_x: Array
    resolution: tuple[float, ...] | None = None
    detector: Detector | None = None

    @property
    def estimator(self) -> Any:
        """The estimator of the closed loops."""
        assert self.scenario.control is not None
        return make_estimator(self.artifact.models["hybrid"], self.scenario.control, self.sigma_x)

    @property
    def monitor(self) -> EnergyMonitor:
        """The guard's monitor where there is a detector, else that of the main job with the artifact's thresholds."""
        model, stored = self.artifact.models["hybrid"], self.artifact.calibration
        if self.detector is not None:
            known = model.parametric is not None
            control = self.scenario.control
            ranges = None if control is None else control.input_range
            return guard_monitor(
                model, self.detector, resolution=self.resolution, input_range=ranges, diagnose=known
            )
        calibration = None if stored is None else Calibration.from_dict(stored)
        return make_monitor(model, calibration)


def prepared(
    scenario: Scenario,
    model: Path,
    recordings: Sequence[Path],
    *,
    noise: Path | None = None,
    resolution: tuple[float, ...] | None = None,
    calibration: Path | None = None,
) -> MonitorJob:
    """Load and check everything.

    Args:
        scenario: The machine.
        model: Artifact folder, or the folder of the run that holds it as ``model``.
        recordings: CSV, ``.npz`` or ``.mat`` files.
        noise: ``control.json`` of a run. Default: as ``hybrid-mpc control`` finds it.
        resolution: Step of each sensor. Default: with a detector what the filters' assumed noise comes to, as in the
            main job.
        calibration: ``calibration.json`` with a detector. Default: the artifact's, if it has one.

    Raises:
        InputError: If the scenario defines no control problem, a file is bad, or things do not fit each other.
    """
    if scenario.control is None:
        raise InputError(
            f"scenario {scenario.name} defines no control problem, so the estimator knows neither input range nor "
            "sensor noise; give the scenario control=ControlSpec(...)"
        )
    folder = artifact_folder(model)
    artifact = load_artifact(folder)
    hybrid = artifact.models["hybrid"]
    if abs(hybrid.dt - scenario.data.dt) > 1e-9:
        raise InputError(
            f"the model's period is {hybrid.dt} s, scenario {scenario.name} resamples to {scenario.data.dt} s"
        )
    spec = replace(scenario.data, windows={})  # all of a recording is watched
    data = load_trajectories(
        recordings, spec, outputs=hybrid.outputs, inputs=hybrid.inputs, states=hybrid.states
    )
    sigma, _ = find_noise(scenario, artifact, folder, ("hybrid_observer",), 0, noise)
    stored = artifact.calibration if calibration is None else read_json(calibration)
    detector = None if stored is None else stored.get("detector")
    if calibration is not None and detector is None:
        raise InputError(f"{calibration} holds no detector; make it with hybrid-mpc monitor ... --learn 1")
    found = None if detector is None else Detector.from_dict(detector)
    if found is not None and resolution is None:
        resolution = sensor_steps(scenario.control)
    return MonitorJob(scenario, artifact, data, np.asarray(sigma["hybrid_observer"]), resolution, found)


def learn(job: MonitorJob, rate: float, out: Path) -> Detector:
    """Learn a detector from the job's recordings, in which nothing may be wrong; writes ``calibration.json``.

    Args:
        job: The job.
        rate: Wanted false alarms an hour.
        out: Folder.
    """
    model = job.artifact.models["hybrid"]
    detector = learn_from(
        model, job.estimator, job.data.whole, false_alarms_per_hour=rate, data_hash=job.data.hash
    )
    write_json(out / "calibration.json", {"detector": detector.to_dict()})
    return detector


def watch(job: MonitorJob, out: Path) -> dict[str, Any]:
    """Replay the monitor over each recording: ``NAME.csv`` and ``NAME.png``, and last ``monitor.json``.

    Args:
        job: The job.
        out: Folder.
    """
    from hybrid_mpc.plots import save
    from hybrid_mpc.plots.monitor_trace import overview

    rows, output = [], job.artifact.models["hybrid"].outputs[0]
    for recording in job.data.whole:
        trace, alarms = watched(job, recording)
        rows.append({"recording": recording.name, "seconds": len(trace.t) * recording.dt, "alarms": alarms})
        name = recording.name.replace("#", "_")
        write_text(out / f"{name}.csv", table(trace, recording, job.artifact.models["hybrid"].outputs))
        limits, calibration = {}, job.monitor.calibration
        if calibration is not None:
            limits["violation"] = calibration.threshold_w
            if calibration.residual_threshold is not None:
                limits["residual"] = calibration.residual_threshold
        notes = [(a["start_s"], a["diagnosis"]) for a in alarms if a["diagnosis"]]
        unit = {"rad": "N m", "m": "N"}.get(output.unit, "SI")
        figure = overview(
            trace,
            recording.y[:, 0],
            output=output,
            force_unit=unit,
            thresholds=limits,
            notes=notes,
            title=name,
        )
        save(figure, out / f"{name}.png")
    result = {
        "recordings": rows,
        "warnings": [str(finding) for finding in job.data.findings],
        "gaps": [cut._asdict() for cut in job.data.cuts if "gap" in cut.why],
        "detector": None if job.detector is None else job.detector.to_dict(),
        "thresholds": None if job.monitor.calibration is None else job.monitor.calibration.to_dict(),
        "data_hash": job.data.hash,
    }
    write_json(out / "monitor.json", result)
    return result


def watched(job: MonitorJob, recording: Trajectory) -> tuple[MonitorTrace, list[dict[str, Any]]]:
    """Trace of a recording, and its alarms with what explains them (empty where nothing can say)."""
    return explained(job.monitor, job.estimator, recording, job.scenario.causes)


def explained(
    monitor: EnergyMonitor,
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    causes: Mapping[str, tuple[str, ...]],
) -> tuple[MonitorTrace, list[dict[str, Any]]]:
    """Replay a monitor, and say of each alarm what explains it.

    Args:
        monitor: The monitor; with history and detector its alarms are explained.
        estimator: The estimator of the closed loops.
        recording: On the model's grid.
        causes: What may break, see :class:`~hybrid_mpc.monitor.Diagnoser`. Empty: each parameter by itself.

    Returns:
        The trace, and ``{start_s, end_s, diagnosis}`` of each alarm; no diagnosis where nothing can say.
    """
    can = monitor.layout.history and monitor.detector is not None
    diagnoser = Diagnoser(monitor, causes or None) if can else None
    dt, last = monitor.model.dt, len(recording.t) - 1
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
        due = not reading.alarm or k == start + round(DIAGNOSED_S / dt) or k == last
        if due and diagnoser is not None and start not in texts:
            texts[start] = diagnoser.diagnose(state, (k - start) * dt).text
        if not reading.alarm:
            began.append(-1)

    trace = replay(monitor, estimator, recording, look)
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
    columns |= {"frozen": trace.frozen.astype(int), "alarm": trace.alarm.astype(int)}
    lines = [",".join(columns)]
    lines += [",".join(f"{v:.9g}" for v in row) for row in zip(*columns.values(), strict=True)]
    return "\n".join(lines) + "\n"
