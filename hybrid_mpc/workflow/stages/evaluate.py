"""Stage evaluation: free runs of every model over the test recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.identify.bands import RunParts, coverage, interval_score
from hybrid_mpc.identify.evaluate import FreeRun, Scores, evaluation_trajectories, score
from hybrid_mpc.kit.prediction import Bands
from hybrid_mpc.records import beside
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Stage
from hybrid_mpc.workflow.stages.choose import CHOICE, run_parts
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR, TRAINING, models_of, runs_of

Array = NDArray[Any]
DRAWN = ("t", "u", "x", "x_hat", "y", "y_hat", "balances", "balances_hat")
"""Signals of a free run that are kept for the figures."""


@dataclass(frozen=True)
class BandScores:
    """Coverage and width of the bands around a model's free runs on test data.

    Args:
        share: Nominal coverage.
        coverage: Share of the measurements within the band.
        width: Mean width by output, ``"phi [rad]"``.
        score: Mean interval score by output; lower is better.
        score_of_constant: Interval score of a band of constant width with the same calibration.
    """

    share: float
    coverage: float
    width: Mapping[str, float]
    score: Mapping[str, float]
    score_of_constant: Mapping[str, float]


@dataclass(frozen=True)
class ModelScores:
    """Errors of a model on test data.

    Args:
        model: Errors of the model.
        networks: Errors of each of its networks alone, if the model is the mean of several.
    """

    model: Scores
    networks: tuple[Scores, ...]


@dataclass(frozen=True)
class EvaluationResult:
    """Free runs of every model over the test recordings.

    Args:
        scores: Errors by model.
        by_file: Errors by model and recording.
        runs: Names of the free runs.
        bands: Coverage of the bands around the free runs, by model.
        arrays: Signals of each run, ``"MODEL/RUN/SIGNAL"``.
    """

    scores: Mapping[str, ModelScores]
    by_file: Mapping[str, Mapping[str, Scores]]
    runs: tuple[str, ...]
    bands: Mapping[str, BandScores]
    arrays: Mapping[str, Array] = beside()


def finite(value: float) -> float | None:
    """The number, or None if it is not finite: a free run diverged."""
    return float(value) if math.isfinite(value) else None


def evaluation_stage(context: Context) -> EvaluationResult:
    """Free runs of every model over the test trajectories.

    The figures show whole runs; for an unstable machine, which is judged by short runs, they show the beginning.
    """
    prior, spec, chosen = context.prior, context.spec, context.read(CHOICE)
    phy = context.scenario.prior(prior.fit.values)
    smoother = prior.fit.smoother(phy, spec.dt)
    whole = context.smoothed("test")
    longest = prior.longest_run
    begins = slice(
        0, None if spec.free_run or longest is None else context.warm + round(longest / spec.dt) + 1
    )
    shown = evaluation_trajectories([t.part(begins) for t in whole], smoother, context.warm)
    test = evaluation_trajectories(whole, smoother, context.warm, longest)
    scores: dict[str, ModelScores] = {}
    files: dict[str, dict[str, Scores]] = {}
    arrays: dict[str, Array] = {}
    bands: dict[str, BandScores] = {}
    spread = smoother.sizes.y
    models = models_of(context)
    for i, name in enumerate(models):
        context.progress.update("models", i, len(models), name)
        share = chosen.choice.share(name)
        every = runs_of(context, name, phy, test, share=share)
        drawn = every if longest is None else runs_of(context, name, phy, shown, share=share)
        model, *networks = (score(runs, phy, spread) for runs in every)
        scores[name] = ModelScores(model, tuple(networks))
        files[name] = {f: score(part, phy, spread) for f, part in _by_file(every[0]).items()}
        for run in drawn[0]:
            for key in DRAWN:
                arrays[f"{name}/{run.name}/{key}"] = getattr(run, key)
        if name in chosen.bands:
            own = chosen.bands[name]
            parts_of_runs = run_parts(phy, prior.fit, every, spec.dt)
            bands[name] = _band_scores(parts_of_runs, own, [s.label for s in phy.outputs])
            for run, parts in zip(drawn[0], run_parts(phy, prior.fit, drawn, spec.dt), strict=True):
                arrays[f"{name}/{run.name}/band"] = own.half_width(parts.parts)
    return EvaluationResult(scores, files, tuple(t.name for t in whole), bands, arrays)


def _band_scores(runs: Sequence[RunParts], bands: Bands, outputs: Sequence[str]) -> BandScores:
    """Coverage and score of a band on test runs, and the score of a band of constant width with its calibration."""
    widths = [2 * bands.half_width(run.parts).mean(axis=0) for run in runs]
    sizes = [len(run.error) for run in runs]

    def mean(values: Sequence[Any]) -> Any:
        return np.average(np.array(values), axis=0, weights=sizes)

    def by_output(values: Sequence[Any]) -> dict[str, float]:
        return {name: float(v) for name, v in zip(outputs, mean(values), strict=True)}

    flat = bands.of_constant_width()
    return BandScores(
        bands.share,
        float(mean([coverage(run, bands) for run in runs])),
        by_output(widths),
        by_output([interval_score(run, bands) for run in runs]),
        by_output([interval_score(run, flat) for run in runs]),
    )


def _by_file(runs: Sequence[FreeRun]) -> dict[str, list[FreeRun]]:
    """Free runs by the stem of the recording they come from."""
    files: dict[str, list[FreeRun]] = {}
    for run in runs:
        files.setdefault(run.name.split("#")[0], []).append(run)
    return files


EVALUATION = Stage(
    "evaluation", "free runs on test data", EvaluationResult, evaluation_stage,
    lambda context: {"free runs": (context.warm, context.spec.free_run)}, (DATA, PRIOR, TRAINING, CHOICE),
)  # fmt: skip
