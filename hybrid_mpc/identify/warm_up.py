"""Fit to free runs that begin from a warm-up, as the evaluation and an observer begin. No torch in here.

With free initial states, an unmeasured state can hide what parameters get wrong: many parameters explain the windows
equally well, each with other initial states. From a short warm-up, which determines the initial state with the model's
own parameters, most of them predict badly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import evenly, robust_spread
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import FAR, Shooting
from hybrid_mpc.identify.simulation import measured_as, simulation_of
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.windows import FEW, WINDOWS, FirstStates, cut_outputs, most_samples
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
MISLED = 2.0
"""Ratio of the error from the warm-up to that with free initial states above which the parameters are fitted again, and
ratio by which the error from the warm-up must fall. Smaller gains became harm on other recordings as often as gain
(docs/results/identification.md)."""


def refitted(
    fit: OutputFit,
    chosen: Fitted,
    smoother: Smoother,
    others: Sequence[Array],
    acting: Sequence[Trajectory],
    error: float,
    *,
    warm: int,
    periods: int,
    smoother_of: Callable[[Fitted], Smoother],
) -> tuple[Fitted, Smoother] | None:
    """Another fit where the chosen one predicts badly from a warm-up, with its smoother; None where it does not.

    A fit with a delay is left as it is.

    Args:
        fit: The fit.
        chosen: Its parameters.
        smoother: The smoother around them.
        others: Further starts, e.g. the results of shorter windows.
        acting: Training and validation trajectories with the inputs that act.
        error: Error of free runs with free initial states, over the outputs' spreads.
        warm: Samples of the warm-up.
        periods: Periods of a free run after it.
        smoother_of: Fits a smoother to these trajectories.
    """
    if not warm or fit.lead or most_samples(acting) < warm + 3:
        return None
    periods = min(periods, most_samples(acting) - warm - 2)
    before = error_from_warm_up(smoother, acting, warm, periods)
    if before <= MISLED * error:
        return None
    known = [replace(t, x=s.x) for t, s in zip(acting, smoother.smooth(acting), strict=True)]
    first = FirstStates("warm_up", seconds=warm * fit.dt)
    windows = cut_outputs(known, warm + periods, 0, WINDOWS, fit.prior.states, fit.prior.outputs, first)
    moved = [robust_spread(column) for column in np.concatenate([t.x for t in known]).T]
    problem, best, least = Shooting(fit, windows, np.maximum(smoother.sizes.x, moved)), None, before / MISLED
    for start in (chosen.theta, *others):
        try:
            found = problem.solve(start)
            own = smoother_of(found)
        except InputError:  # too stiff for the period there
            continue
        if (after := error_from_warm_up(own, acting, warm, periods)) < least:
            best, least = (found, own), after
    return best


def error_from_warm_up(
    smoother: Smoother, trajectories: Sequence[Trajectory], warm: int, periods: int
) -> float:
    """Root mean square error over the outputs' spreads, each at most ``FAR``, of the free runs of a smoother's prior.

    The states at the start of the runs are smoothed from the ``warm`` samples before.
    """
    prior: Prior = smoother.prior
    starts = [(t, k) for t in trajectories for k in range(0, len(t.t) - warm - periods, periods)]
    chosen = [starts[i] for i in evenly(len(starts), FEW)]
    before = smoother.smooth([t.part(slice(k, k + warm + 1)) for t, k in chosen])
    x = np.stack([t.x[-1] for t in before])

    def after(key: str) -> Array:
        return np.stack([getattr(t, key)[k + warm : k + warm + periods + 1] for t, k in chosen])

    equations = prior.equations
    simulation = simulation_of(equations.xdot, smoother.dt, (), equations.output)
    with np.errstate(over="ignore", invalid="ignore"):  # a diverging run has the largest error
        shown = simulation.values(x, after("u"), after("w"), prior.p, smoother.substeps)
    y = after("y")
    spread = np.array([robust_spread(c) or 1.0 for c in np.concatenate([t.y for t in trajectories]).T])
    shown = np.stack([measured_as(prior, own) for own in shown])
    off = np.nan_to_num(np.abs(shown - y) / spread, nan=FAR, posinf=FAR)
    seen = np.isfinite(y)
    return float(np.sqrt(np.mean(np.square(np.minimum(off, FAR))[seen])))
