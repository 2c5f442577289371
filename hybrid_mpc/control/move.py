"""Point-to-point moves: the horizon is free, and the plan ends in a target."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import Controller, Solution, Status, UnreachedBound
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
        t: Times ``(N + 1,)`` from the start [s].
        x: States ``(N + 1, n_x)``, e.g. as a reference of states for a tracking controller.
        u: Inputs ``(N, n_u)``.
        plan: The plan of the move.
        tried: By number of periods, whether such a plan keeps all hard bounds.
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
    """The move with the fewest periods that ends in a target and keeps all limits and hard bounds.

    The number of periods is found by doubling and bisection: if the target is reachable in N periods, it must be
    reachable in more, as it is if the target can be held or approached more slowly. Among moves of that length the
    problem's cost decides: it should be small compared to the limits, since it only smooths the move.

    Args:
        model: The model, prior or hybrid.
        ocp: Limits, weights and bounds; its own horizon is ignored.
        estimate: Start of the move, with hidden state and disturbances.
        target: End of the move, a hard bound with ``at_end``.
        reference: Reference of the cost, a row ``(n,)`` as for controllers. Default: the middle of a target of states,
            or the initial state where the target has no middle.
        price: Cost of a second [unit of the problem's cost]: a longer move is preferred if it is cheaper including its
            time. Default: only time counts.
        longest: Most periods.
        controller: The solver. Default: :class:`~hybrid_mpc.control.sqp.SQPController`.

    Raises:
        InputError: If the target is invalid, has no reference, or is not reached in ``longest`` periods.

    Example:
        ``move = shortest_move(model, ocp, estimate, HardBound("x", goal - 0.01, goal + 0.01, at_end=True))``
    """
    if not isinstance(target, HardBound) or not target.at_end:
        raise InputError(f"target: must be a HardBound(..., at_end=True), got {target!r} [HM-CONTROL-004]")
    if reference is None and target.what != "x":
        raise InputError(
            "reference: must be given, one row, for a target that is not on the states [HM-CONTROL-005]"
        )
    row = np.atleast_2d(_middle(target, estimate.x) if reference is None else np.asarray(reference, float))
    bounded = ocp.changed(hard=(*ocp.hard, target))
    plans: dict[int, Solution] = {}

    def reaches(n: int) -> bool:
        if n not in plans:
            try:
                solver = controller(model, bounded.changed(horizon=n))
            except UnreachedBound:  # an input with a delay acts in longer plans only
                if n >= longest:
                    raise
                return False
            plans[n] = solver.solve(solver.initial(estimate, None), estimate, row, None)
        return plans[n].status is Status.SOLVED and not plans[n].given_way

    def total(n: int) -> float:
        return plans[n].cost + price * n * model.dt if reaches(n) else np.inf

    least, most = 0, 1
    while not reaches(most):
        if most >= longest:
            raise InputError(
                f"target: no move of up to {longest} periods ({longest * model.dt:g} s) ends in the target; the "
                f"longest move misses {_missed(plans[most])}. Give a wider target, wider limits, or a larger longest. "
                "[HM-CONTROL-006]"
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
    """The number with the smallest total: doubled steps until it rises, then halved ones; assumes a single minimum."""
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
