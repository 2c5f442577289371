"""The best of several solves, against local optima; not for real time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import Limits, input_plan
from hybrid_mpc.control.problem import Controller, Solution
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import START_LIMIT, Estimate
from hybrid_mpc.model.equilibrium import hidden_fixed_point

Array = NDArray[np.float64]
Start = Callable[[Estimate], Array]


class BestOf(Controller):
    """Solves from several initial guesses and returns the cheapest plan; for use without real-time requirements.

    Guesses are the shifted previous plan, the given ``starts``, and the plans of ``rivals``, controllers on other
    models of the same machine. Plans are compared by their cost in a run of the model itself, so the result is at most
    as expensive by this model as any rival's. Rivals have no memory: their hidden state starts settled at the estimated
    state, their disturbance is the estimate's own.

    Args:
        controller: Solver for every guess, e.g. an :class:`~hybrid_mpc.control.sqp.SQPController`.
        starts: Guesses: input plans ``(N, n_u)``, or functions ``estimate -> (N, n_u)``.
        rivals: Controllers whose plans are further guesses; same states, inputs and horizon.
        most: Most guesses, besides the previous plan, that are solved from: those that are cheapest in a run of the
            model. Default: all.

    Raises:
        InputError: If a rival or a plan does not fit, ``most < 1``, or there is neither start nor rival.

    Example: ``BestOf(SQPController(model, ocp), starts=[np.full((ocp.horizon, 1), 0.5)])``
    """

    def __init__(
        self,
        controller: Controller,
        *,
        starts: Sequence[Array | Start] = (),
        rivals: Sequence[Controller] = (),
        most: int | None = None,
    ) -> None:
        ocp = controller.ocp
        if most is not None and most < 1:
            raise InputError(
                f"most: must be at least 1, got {most}. Omit most to use all starts. [HM-CONTROL-001]"
            )
        for rival in rivals:
            given = rival.ocp.n_x, rival.ocp.n_u, rival.ocp.horizon
            if given != (ocp.n_x, ocp.n_u, ocp.horizon):
                raise InputError(
                    f"rival on {rival.model.name}: (n_x, n_u, N) must be {(ocp.n_x, ocp.n_u, ocp.horizon)}, "
                    f"got {given} [HM-CONTROL-002]"
                )
        for start in starts:
            if not callable(start):
                input_plan(start, ocp.horizon, ocp.n_u, "start")
        if not starts and not rivals:
            raise InputError(
                "starts, rivals: give at least one; without any use the controller itself [HM-CONTROL-003]"
            )
        self.problem, self._controller = controller.problem, controller
        self._starts, self._rivals, self._most = tuple(starts), tuple(rivals), most

    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None, w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """The cheapest plan of all guesses; see :meth:`Controller.solve`.

        Its cost is that of a run of the model. If no solve succeeds, the one from the previous plan is returned.
        """
        begin = perf_counter()
        target = self.problem.target(reference, weight, estimate, w, previous.steady)
        u_prev, z0 = previous.u[0], np.concatenate([estimate.x, estimate.h])

        def cost_of(u: Array) -> float:
            acting = self.model.acting(u, estimate.d, target.w)
            cost = self.problem.cost(self.problem.run(z0, acting), u, u_prev, target)
            return cost if np.isfinite(cost) else np.inf

        given = estimate, reference, weight
        first = self._controller.solve(previous, *given, limits=limits, w=w)
        solutions = [first]
        guesses = self._guesses(previous, *given, limits, w) if estimate.finite else []
        for guess in sorted(guesses, key=cost_of)[: self._most]:
            start = self._controller.initial(estimate, guess).delayed(previous.u[0])  # its shift is the guess
            solutions.append(self._controller.solve(start, *given, limits=limits, w=w))
        best, least = first, np.inf
        for s in solutions:
            cost = cost_of(s.u)
            if s.status.ok and cost < least:
                best, least = replace(s, cost=cost), cost
        return replace(best, timing={"solve": (perf_counter() - begin) * 1e3})

    def _guesses(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None,
        limits: Limits | None, w: Array | None,
    ) -> list[Array]:  # fmt: skip
        guesses = [
            input_plan(s(estimate) if callable(s) else s, self.ocp.horizon, self.ocp.n_u, "start")
            for s in self._starts
        ]
        for rival in self._rivals:
            known = estimate.w if estimate.w.size == rival.model.n_w else None
            h = hidden_fixed_point(rival.model, estimate.x, previous.u[0], w=known, limit=START_LIMIT)
            own = replace(estimate, h=h)
            plan = rival.solve(rival.initial(own, previous.u), own, reference, weight, limits=limits, w=w)
            if plan.status.ok:
                guesses.append(plan.u)
        return guesses
