"""Stage choice: the recommended model and the bands around free runs, both from held-out data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.identify.bands import FAR, RunParts, fit_bands, run_variance
from hybrid_mpc.identify.choose import Choice, evidence_of, recommend
from hybrid_mpc.identify.evaluate import FreeRun, evaluation_trajectories, unseen_runs
from hybrid_mpc.identify.fit import parameter_variance
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.kit.prediction import Bands
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Stage
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR, TRAINING, models_of, runs_of, training_settings

Array = NDArray[np.float64]
CANDIDATES = ("phy", "pgrnn", "mopgrnn")
"""Candidates for the recommendation: the fitted prior, and the hybrids that :func:`models_of` the run has."""


@dataclass(frozen=True)
class ChoiceResult:
    """Result of the comparison of all candidates on held-out data.

    Args:
        choice: The recommended candidate and the reason.
        bands: Bands around free runs, by candidate.
        longest: Length [s] of the longest of these free runs.
    """

    choice: Choice
    bands: Mapping[str, Bands]
    longest: float

    @property
    def deployed(self) -> str:
        """The kind of network that is exported as the hybrid; ``"phy"`` if no network was trained."""
        return self.choice.hybrid


def choice_stage(context: Context) -> ChoiceResult:
    """Choose a model by free runs of all candidates over held-out data, as long as those over the test data.

    Each network leaves out one part of the training recordings; only that network is evaluated on that part. The bands
    are calibrated on these parts and on the validation recordings, to which the prior was not fitted.
    """
    prior, spec, warm = context.prior, context.spec, context.warm
    phy = context.scenario.prior(prior.fit.values)
    smoother = prior.fit.smoother(phy, spec.dt)
    candidates = [name for name in models_of(context) if name in CANDIDATES]
    settings = training_settings(context, "pgrnn")
    runs = unseen_runs(
        settings, context.smoothed("train"), context.smoothed("valid"), smoother, prior.longest_run
    )
    calibrating = list(runs)
    if all(own is not None for own, _ in runs):
        validation = evaluation_trajectories(context.smoothed("valid"), smoother, warm, prior.longest_run)
        calibrating.append((None, validation))
    n_left_out = sum(len(them) for _, them in runs)

    @cache
    def scored(name: str, share: float = 1.0) -> list[tuple[FreeRun, ...]]:
        """A candidate's free runs; beside each run those of its networks."""
        context.progress.update(
            "candidates", candidates.index(name), len(candidates), f"{name}, {100 * share:.0f} %"
        )
        return [
            run
            for own, them in calibrating
            for run in zip(*runs_of(context, name, phy, them, own, share), strict=True)
        ]

    def errors_of(name: str, share: float = 1.0) -> list[Array]:
        return [run.squares_by_output(smoother.sizes.y) for run, *_ in scored(name, share)[:n_left_out]]

    samples = max(1, round(context.time_unit / spec.dt))
    recordings, evidence = evidence_of(runs)
    found = recommend(
        {name: errors_of(name) for name in candidates}, deploy=context.settings.deploy, samples=samples,
        recordings=recordings, evidence=evidence, shrunk=errors_of, rule=context.scenario.choice,
    )  # fmt: skip
    if found.recommended != "phy" and prior.in_doubt:  # networks must not hide a wrong structure
        doubt = f"However, the structure of the prior is in doubt: {prior.in_doubt[0]}."
        found = replace(found, reason=f"{found.reason} {doubt}")
    bands: dict[str, Bands] = {}
    for name in candidates:
        every = list(zip(*scored(name, found.share(name)), strict=True))
        bands[name] = fit_bands(run_parts(phy, prior.fit, every, spec.dt))
    longest = max((len(t.t) - warm - 2) * spec.dt for _, them in calibrating for t in them)
    return ChoiceResult(found, bands, longest)


def run_parts(phy: Prior, fit: PriorFit, every: Sequence[Sequence[FreeRun]], dt: float) -> list[RunParts]:
    """Errors of each run of a model, and the parts of their variance; ``every``: its runs, then each network's."""
    spread, parameters = np.array(fit.sizes.y), by_parameters(phy, fit, every[0], dt)
    found = []
    for i, runs in enumerate(zip(*every, strict=True)):
        own = runs[0]
        error = np.clip(
            np.nan_to_num(own.y_hat - own.y, nan=np.nan, posinf=np.inf), -FAR * spread, FAR * spread
        )
        outputs = np.stack([run.y_hat for run in runs[1:] or runs])
        parts = run_variance(outputs, parameters[i], own.t - own.t[0], np.array(fit.sigma), spread)
        found.append(RunParts(error, parts))
    return found


def by_parameters(phy: Prior, fit: PriorFit, runs: Sequence[FreeRun], dt: float) -> list[Array]:
    """Variance of each run's outputs ``(n, n_y)`` due to the covariance of the fitted parameters.

    Runs of equal length are evaluated together.
    """
    covariance, found = np.array(fit.covariance(phy.parameters)), [np.zeros((0, 0))] * len(runs)
    for length in sorted({len(run.t) for run in runs}):
        same = [i for i, run in enumerate(runs) if len(run.t) == length]
        x, u, w = (
            np.stack(v) for v in zip(*((runs[i].x_hat[0], runs[i].u, runs[i].w) for i in same), strict=True)
        )
        for i, own in zip(same, parameter_variance(phy, covariance, x, u, w, dt, fit.substeps), strict=True):
            found[i] = own
    return found


CHOICE = Stage(
    "choice", "choosing a model", ChoiceResult, choice_stage,
    lambda context: {
        "free runs": (context.warm, context.spec.free_run), "deploy": context.settings.deploy,
        "rule of the choice": context.scenario.choice,
    },
    (DATA, PRIOR, TRAINING),
)  # fmt: skip
