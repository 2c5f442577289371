"""``hybrid-mpc predict``: predictions of recordings by a model of an artifact; tables, figures, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hybrid_mpc.data.files import write_csv
from hybrid_mpc.data.recording import COARSE, MIN_SCORED
from hybrid_mpc.data.trajectories import Trajectory, load_trajectories
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.files import write_json
from hybrid_mpc.identify.delay import lost_samples
from hybrid_mpc.identify.predict import Predicted, Prediction, predict
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.records import known
from hybrid_mpc.workflow.stage import read_as

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class RecordingErrors:
    """Errors of the predictions of one recording.

    Args:
        recording: Name of the recording.
        seconds: Length after the warm-up [s].
        run_length: Length [s] of the free runs, one after the other; None: one run over the recording.
        free_run: Errors of the free runs.
        one_step: Errors of the one-step predictions; None without them.
        reason: Why there are no one-step predictions; empty if there are.
    """

    recording: str
    seconds: float
    run_length: float | None
    free_run: Predicted
    one_step: Predicted | None
    reason: str


@dataclass(frozen=True)
class PredictResults:
    """``predict.json`` of ``hybrid-mpc predict``.

    Args:
        schema_version: Version of the file.
        model: Name of the model.
        recordings: Errors by recording.
    """

    schema_version: int
    model: str
    recordings: tuple[RecordingErrors, ...]


def read_predictions(path: Path) -> PredictResults:
    """Read a ``predict.json``, checked; arrays are empty.

    Raises:
        InputError: If the file is missing, damaged, or of another version.

    Example:
        ``read_predictions(Path("today/predict.json")).recordings[0].free_run.rmse``
    """
    return read_as(PredictResults, SCHEMA_VERSION, path, "hybrid-mpc predict")


def read_recordings_of(kit: Kit, paths: Sequence[Path]) -> tuple[list[Trajectory], list[str]]:
    """Read recordings as the artifact specifies, with warnings about them.

    Raises:
        InputError: If a file is bad; the message lists the errors of all files, one a line.
    """
    if kit.predicting is None:
        raise InputError(
            f"model of scenario {kit.name or '(unnamed)'}: an older version wrote it, without a data specification. "
            "Run the scenario again [HM-WORKFLOW-027]"
        )
    spec, problems, found, doubts = kit.predicting.data, [], [], list[str]()
    if twice := sorted({p.name for p in paths if [q.stem for q in paths].count(p.stem) > 1}):
        raise InputError(
            f"recordings: {', '.join(twice)} given more than once; file names must differ. Rename or remove a file "
            "[HM-WORKFLOW-028]"
        )
    whole = replace(spec, fractions=(1.0, 0.0, 0.0))
    for path in paths:
        try:
            data = load_trajectories([path], kit.models["prior"], whole, needed=())
        except InputError as error:
            problems += str(error).splitlines()
            continue
        doubts += data.warnings
        if data.sampling[0] > COARSE * spec.dt:
            problems.append(
                f"{path}: sampled every {data.sampling[0]:.3g} s, too slow for the model period of {spec.dt:g} s. "
                "Record at least one sample a period [HM-WORKFLOW-029]"
            )
        late = lost_samples(kit.input_delay, spec.dt) * spec.dt
        least = spec.warm_up + MIN_SCORED * spec.dt + late
        long = [t for t in data.whole if len(t.t) * spec.dt > least - 0.5 * spec.dt]
        if not long:
            parts = [t.t[-1] - t.t[0] + spec.dt for t in data.whole]
            parts += [c.end_s - c.start_s for c in data.cuts if not c.why.startswith("gap")]
            problems.append(
                f"{path}: too short. Its longest part without a gap has {max(parts, default=0.0):.4g} s; the warm-up "
                f"of {spec.warm_up:g} s and {MIN_SCORED} periods need {least:.4g} s. Give a longer recording "
                "[HM-WORKFLOW-030]"
            )
        found += long
    refuse(problems)
    return found, doubts


def predict_recordings(
    kit: Kit, trajectories: Sequence[Trajectory], out: Path, model: str = "", progress: Progress | None = None
) -> list[Prediction]:
    """Predict recordings; write ``NAME.csv`` and ``NAME.png`` for each, and ``predict.json`` last.

    Raises:
        InputError: If the model is unknown, or a recording is too short.
        StorageError: If something cannot be written.
    """
    # plots take half a second to import: check first
    known(model or kit.recommended, kit.models, "model")
    from hybrid_mpc.plots.fit import prediction
    from hybrid_mpc.plots.style import save

    say, found = progress or Progress(), []
    say.start("predicting")
    for i, trajectory in enumerate(trajectories):
        say.update("recordings", i, len(trajectories), trajectory.name)
        one = predict(kit, trajectory, model)
        name = trajectory.name.replace("#", "_")
        write_csv(out / f"{name}.csv", one.columns())
        runs = {one.title: one.free_run, "one step ahead": one.one_step}
        bands = {label: (run.y_hat, run.half_width) for label, run in runs.items() if run is not None}
        figure = prediction(
            one.t, one.y, bands, outputs=one.outputs, model=one.model, title=f"{name}: {one.model}"
        )
        save(figure, out / f"{name}.png")
        found.append(one)
    rows = tuple(
        RecordingErrors(p.name, p.seconds, p.run_length, p.free_run, p.one_step, p.reason) for p in found
    )
    write_json(out / "predict.json", PredictResults(SCHEMA_VERSION, found[0].model, rows))
    say.finish("")
    return found
