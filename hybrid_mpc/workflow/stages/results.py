"""``results.json`` of a run: the results of its stages side by side, as the stages return them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybrid_mpc.kit.promises import PromiseTable
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explained import ExplainResult
from hybrid_mpc.workflow.stage import Absent, Stage, read_as
from hybrid_mpc.workflow.stages.analyze import ANALYSIS, LinearizedModels
from hybrid_mpc.workflow.stages.choose import CHOICE, ChoiceResult
from hybrid_mpc.workflow.stages.compare import CONTROL, ControlResult
from hybrid_mpc.workflow.stages.estimate import ESTIMATION, EstimationResult
from hybrid_mpc.workflow.stages.evaluate import EVALUATION, EvaluationResult
from hybrid_mpc.workflow.stages.explain import EXPLAIN
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, ExportResult, NoiseResult
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR, TRAINING, DataResult, PriorResult, TrainingResult
from hybrid_mpc.workflow.stages.on_model import LOOPS_ON_MODEL, OnModelResult
from hybrid_mpc.workflow.stages.promises import PROMISES
from hybrid_mpc.workflow.stages.track import TRACK, TrackResult
from hybrid_mpc.workflow.stages.watch import WATCH, WatchResult

SCHEMA_VERSION = 14
SHOWN: tuple[Stage[Any], ...] = (
    DATA, EXPLAIN, PRIOR, TRAINING, CHOICE, EVALUATION, EXPORT, TRACK, NOISE, CONTROL, LOOPS_ON_MODEL, ESTIMATION,
    PROMISES, WATCH, ANALYSIS,
)  # fmt: skip
"""Stages whose results the file and the report show: all but ``tasks``, which only writes files, and ``report``."""


@dataclass(frozen=True)
class Results:
    """Settings of a run and the results of its stages; a stage without a result has a reason instead.

    Args:
        schema_version: Version of ``results.json``.
        scenario: Registered name, or the name in the scenario file.
        seed: Seed of all random numbers.
        budget: ``quick``, ``full``, or a budget of the scenario.
        versions: Versions of the packages by name.
        data: Recordings.
        explain: Search for missing terms.
        prior: Fitted prior.
        training: Trained networks.
        choice: Recommended model.
        evaluation: Free runs on test data.
        export: Exported models compared with PyTorch.
        track: Parameters that differ between recordings.
        noise: Process noise of the observers.
        control: Closed loops on the scenario's plant, and durations of steps.
        on_model: Closed loops of a scenario without plant.
        estimation: Tests of the observers.
        promises: What the kit promises.
        watch: Monitor.
        analysis: Linearized models.
    """

    schema_version: int
    scenario: str
    seed: int
    budget: str
    versions: Mapping[str, str]
    data: DataResult
    explain: ExplainResult | Absent
    prior: PriorResult
    training: TrainingResult
    choice: ChoiceResult
    evaluation: EvaluationResult
    export: ExportResult
    track: TrackResult | Absent
    noise: NoiseResult | Absent
    control: ControlResult | Absent
    on_model: OnModelResult | Absent
    estimation: EstimationResult | Absent
    promises: PromiseTable | Absent
    watch: WatchResult | Absent
    analysis: LinearizedModels | Absent


def collect(context: Context) -> Results:
    """Results of all stages."""
    found: dict[str, Any] = {stage.name: context.find(stage) for stage in SHOWN}
    settings = context.settings
    return Results(
        SCHEMA_VERSION, context.scenario.name, settings.seed, settings.budget, context.versions, **found
    )


def read_results(path: Path) -> Results:
    """Read a run's ``results.json``, checked; arrays are empty.

    Raises:
        InputError: If the file is missing, damaged, or of another version.

    Example:
        ``read_results(Path("runs/mine/results.json")).choice.choice.recommended``
    """
    return read_as(Results, SCHEMA_VERSION, path, "the run")
