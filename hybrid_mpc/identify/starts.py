"""Start values of a fit: nominal values and points between the bounds, sorted by their error over the windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import Shooting

Array = NDArray[np.float64]
STARTS = 6
"""Number of starts between the bounds over the shortest windows, besides the nominal values."""
START_ITERATIONS = 6
"""Gauss-Newton steps from each start before the best ones are selected."""
POOR = 0.3
"""Error, over the outputs' spread, above which the longest windows are fitted from every start."""
FOLLOWED = 3
"""Maximum number of starts that are followed from one length to the next, because the best may be a wrong optimum."""
PROMISING = 1.5
"""Ratio to the least error up to which another start is followed."""
DISTINCT, FACTOR = 0.1, 3.0
"""Followed starts differ in at least one parameter by more than ``DISTINCT`` half ranges, or by more than ``DISTINCT *
FACTOR`` of its value."""


def promising_starts(
    fit: OutputFit, short: Shooting, long: Shooting, start: Mapping[str, float] | None
) -> list[Array]:
    """Parameters after a few steps over short windows from several starts, sorted by their error over long windows."""
    found = []
    for one in [fit.nominal, *([] if start is None else [fit.scaled(start)]), *_draws(fit)]:
        try:
            found.append(short.solve(one, START_ITERATIONS).theta)
        except InputError:  # too stiff for the period there
            continue
    return promising(fit, long, found) if found else [fit.nominal]


def _draws(fit: OutputFit) -> list[Array]:
    """Starts between the bounds (a Sobol sequence)."""
    between = qmc.Sobol(len(fit.nominal), seed=0).random_base2(3)[:STARTS]
    return list(fit.lower + between * (fit.upper - fit.lower))


def further_starts(fit: OutputFit, problem: Shooting, solved: Sequence[Fitted]) -> list[Fitted]:
    """Fits from the nominal values and from points between the bounds, until an error is below ``POOR``."""
    found = list(solved)
    for one in (fit.nominal, *_draws(fit)):
        if min(problem.explained([f.theta for f in found])) <= POOR:
            break
        try:
            found.append(problem.solve(one))
        except InputError:  # too stiff for the period there
            continue
    return found[len(solved) :]


def promising(fit: OutputFit, problem: Shooting, thetas: Sequence[Array]) -> list[Array]:
    """Select up to ``FOLLOWED`` distinct ``thetas`` with the least errors, the best first."""
    errors = problem.explained(thetas)
    order = sorted(range(len(thetas)), key=errors.__getitem__)
    kept: list[Array] = []
    for i in order:
        far = all(_apart(fit, thetas[i], one) for one in kept)
        if far and errors[i] <= PROMISING * errors[order[0]] and len(kept) < FOLLOWED:
            kept.append(thetas[i])
    return kept


def _apart(fit: OutputFit, one: Array, other: Array) -> bool:
    """Whether two starts are distinct."""
    off = np.abs(one - other)
    share = off / np.maximum(np.maximum(np.abs(one), np.abs(other)), DISTINCT * fit.half)
    return bool(np.max(np.maximum(off / fit.half, share / FACTOR)) > DISTINCT)
