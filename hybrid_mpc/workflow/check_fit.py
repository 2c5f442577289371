"""The fit of a prior as a run would make it, and what puts the prior in doubt, before anything is trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.engine import Progress
from hybrid_mpc.errors import named_extra, no_exit
from hybrid_mpc.scenario import load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stages.identify import (
    DATA,
    PRIOR,
    PriorResult,
    check_data,
    data_stage,
    examined_prior,
)


@no_exit()
@named_extra("the fit")
def check_fit(settings: RunSettings, progress: Progress | None = None) -> PriorResult:
    """Fit the prior as :func:`~hybrid_mpc.workflow.run.run` would, and compare it with simpler models; train nothing.

    It computes the run's own stages data and prior, and writes no file.

    Args:
        settings: What a run would compute.
        progress: Where to report. Default: nowhere.

    Returns:
        ``fit``: values, standard errors, warnings. ``bounds``: parameters at a bound. ``errors`` and ``baselines``:
        errors of free runs on the test recordings. ``in_doubt``: why the structure of the prior is in doubt.
        ``no_gain``: why a run would stop; empty where it would not.

    Raises:
        InputError: For any bad input, and if the fit is impossible.

    Example:
        >>> found = check_fit(RunSettings("torque_pendulum", data=(Path("swing.csv"),)))  # doctest: +SKIP
        >>> found.in_doubt  # doctest: +SKIP
        ()
    """
    context = Context(settings, load_scenario(settings.scenario), Path(), progress or Progress())
    check_scenario(context.scenario, context.budget, (lambda: context.dataset) if settings.data else None)
    return fit_of(context)


def fit_of(context: Context) -> PriorResult:
    """:func:`check_fit` of a scenario that has been checked; a simulated machine records into a folder that is removed.

    Raises:
        InputError: If there are no recordings, or the fit is impossible.
    """
    check_data(context)
    if not context.settings.data:
        with TemporaryDirectory() as folder:
            return _fitted(replace(context, out=Path(folder)))
    return _fitted(context)


def _fitted(context: Context) -> PriorResult:
    progress = context.progress
    progress.start(DATA.title)
    data_stage(context)
    progress.finish("")
    progress.start(PRIOR.title)
    found = examined_prior(context)
    progress.finish("")
    return found
