"""Point-to-point moves: the horizon is free, and the plan ends within a target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import Controller, Solution, Status
from hybrid_mpc.control.soft import HardBound
from hybrid_mpc.control.sqp import SQPController
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Move:
    """A move of N periods.

    Args:
        duration: ``N dt`` [s].
        t: Times ``(N + 1,)`` from its begin [s].
        x: States ``(N + 1, n_x)``; a reference of states for a controller that follows.
        u: Inputs ``(N, n_u)``.
        plan: The plan it is.
        tried: Whether a plan of so many periods keeps all hard bounds, by number.
    """

    duration: float
    t: Array
    x: Array
    u: Array
    plan: Solution
    tried: Mapping[int, bool]


def shortest_move(
    model: HybridModel,
    ocp: OCP,
    estimate: Estimate,
    target: HardBound,
    *,
    reference: ArrayLike | None = None,
    price: float = np.inf,
    longest: int = 400,
    controller: Callable[[HybridModel, OCP], Controller] = SQPController,
) -> Move:
    """The move of fewest periods that ends within a target and keeps all limits and hard bounds.

    The number of periods is found by doubling and halving: what can be reached in N periods must be reachable in more,
    as it is where the target can be held or come to more slowly. Of the moves of that length the problem's cost chooses
    one: it should be small beside the limits, or it makes the move no shorter and only smoother.

    Args:
        model: The model, prior or hybrid.
        ocp: Limits, weights and bounds; its own horizon does not matter.
        estimate: Where the move begins, hidden state and disturbances included.
        target: Where it ends, a hard bound with ``at_end``.
        reference: What the cost counts from, a row ``(n,)`` as controllers take it. Default: the middle of a target of
            states, and where it has none the state at the begin.
        price: What a second costs [unit of the problem's cost]: a longer move is taken where it is cheaper with the
            price of its time. Default: only time counts.
        longest: Most periods.
        controller: What solves it. Default: :class:`~hybrid_mpc.control.sqp.SQPController`.

    Raises:
        InputError: If the target is none, no reference follows from it, or no move of ``longest`` periods reaches it.

    Example:
        ``move = shortest_move(model, ocp, estimate, HardBound("x", goal - 0.01, goal + 0.01, at_end=True))``
    """
    if not isinstance(target, HardBound) or not target.at_end:
        raise InputError(f"target: {target!r} given; needed: a HardBound(..., at_end=True) [HM-CONTROL-004]")
    if reference is None and target.what != "x":
        raise InputError(
            "reference: none follows from a target that is not of the states; give a row of it"
            " [HM-CONTROL-005]"
        )
    row = np.atleast_2d(_middle(target, estimate.x) if reference is None else np.asarray(reference, float))
    bounded = ocp.changed(hard=(*ocp.hard, target))
    plans: dict[int, Solution] = {}

    def reaches(n: int) -> bool:
        if n not in plans:
            solver = controller(model, bounded.changed(horizon=n))
            plans[n] = solver.solve(solver.initial(estimate, None), estimate, row, None)
        return plans[n].status is Status.SOLVED and not plans[n].given_way

    def total(n: int) -> float:
        return plans[n].cost + price * n * model.dt if reaches(n) else np.inf

    least, most = 0, 1
    while not reaches(most):
        if most >= longest:
            raise InputError(
                f"no move of {longest} periods ({longest * model.dt:g} s) ends within the target; the longest one "
                f"misses {_missed(plans[most])}. Give a wider target, wider limits, or a larger longest"
                " [HM-CONTROL-006]"
            )
        least, most = most, min(2 * most, longest)
    while most - least > 1:
        middle = (least + most) // 2
        least, most = (least, middle) if reaches(middle) else (middle, most)
    best = most
    if np.isfinite(price):
        best = _cheapest(total, most, longest)
    plan = plans[best]
    tried = {n: plans[n].status is Status.SOLVED and not plans[n].given_way for n in sorted(plans)}
    t = np.linspace(0.0, best * model.dt, best + 1)
    return Move(best * model.dt, t, plan.x, plan.u, plan, tried)


def _middle(target: HardBound, x: Array) -> Array:
    both = np.isfinite(target.lower) & np.isfinite(target.upper)
    one = np.where(
        np.isfinite(target.lower), target.lower, np.where(np.isfinite(target.upper), target.upper, x)
    )
    low, up = np.where(both, target.lower, 0.0), np.where(both, target.upper, 0.0)
    return np.where(both, 0.5 * (low + up), one)


def _missed(plan: Solution) -> str:
    if plan.status is not Status.SOLVED:
        return f"it: {plan.status.value}"
    return ", ".join(f"{name} by {value:.3g}" for name, value in plan.given_way.items())


def _cheapest(total: Callable[[int], float], first: int, last: int) -> int:
    """The number of least total: steps that double until it rises, then halves; there is one valley."""
    step, best = 1, first
    while best + step <= last and total(best + step) < total(best):
        best, step = best + step, 2 * step
    while step >= 1:
        for n in (best + step, best - step):
            if first <= n <= last and total(n) < total(best):
                best = n
                break
        else:
            step //= 2
    return best
