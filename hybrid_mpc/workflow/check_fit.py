"""Fit a prior as a run does, and list the doubts about its structure, without training."""

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

MANY = 500
"""Periods of the longest windows above which the fit may take minutes."""


@no_exit()
@named_extra("the fit")
def check_fit(settings: RunSettings, progress: Progress | None = None) -> PriorResult:
    """Fit the prior as :func:`~hybrid_mpc.workflow.run.run` does, and compare it with simpler models; train nothing.

    It computes stages data and prior of the run, and writes no file.

    Args:
        settings: Settings of the run.
        progress: Where to report. Default: nowhere.

    Returns:
        ``fit``: values, standard errors, warnings. ``bounds``: parameters at a bound. ``errors`` and ``baselines``:
        errors of free runs on the test recordings. ``in_doubt``: reasons to doubt the structure of the prior.
        ``no_gain``: why a run would stop after the fit; empty if it would continue.

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
    """:func:`check_fit` of a checked scenario; simulated recordings are written to a temporary folder.

    Raises:
        InputError: If there are no recordings, or the fit is impossible.
    """
    check_data(context)
    if not context.settings.data:
        with TemporaryDirectory() as folder:
            return _fitted(replace(context, out=Path(folder)))
    return _fitted(context)


def long_windows(context: Context) -> str:
    """Text about windows of more than ``MANY`` periods that ``free_run`` can shorten; empty if there are none."""
    length, dt = context.fit_length, context.spec.dt
    if context.spec.free_run or length is None or length <= MANY * dt:
        return ""
    own = f"windows up to {length:.3g} s, {length / dt:.0f} periods, which takes long"
    return f" ({own}; DataSpec.free_run limits them)"


def _fitted(context: Context) -> PriorResult:
    progress = context.progress
    progress.start(DATA.title)
    data_stage(context)
    progress.finish("")
    progress.start(PRIOR.title + long_windows(context))
    found = examined_prior(context)
    progress.finish("")
    return found
