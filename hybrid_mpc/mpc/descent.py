"""One solve of the SQP: the steps from one run of the model to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.mpc.condensing import Prepared
from hybrid_mpc.mpc.curvature import convex
from hybrid_mpc.mpc.landscape import Case, Landscape, Point, Run
from hybrid_mpc.mpc.qp import Answer
from hybrid_mpc.mpc.solution import Status

Array = NDArray[np.float64]
NAN = float("nan")
ARMIJO = 1e-4
KKT = 1e-6
ATTEMPTS = 15
"""Most QPs of an iteration, each damped more than the one before."""
MORE = 4.0
"""Factor of the damping from one attempt to the next; a good step takes as much away."""
POOR, GOOD = 0.25, 0.5
"""Shares of the promise: a step that keeps less asks for damping, one that keeps more for less of it."""
CORRECTIONS = 2
"""Most corrections of a step by what it was found to bend."""
SLOW = 0.1
"""Share of the residual that the Hessian got wrong, above which second derivatives are taken anew."""
AGAIN = (1, 4, 16, 64)
"""Times at which a hidden state's curvature that hardly mattered is looked at again."""


@dataclass(frozen=True)
class _Step:
    """What a search has found.

    Args:
        run: The model on the step; None if no step lowers the cost.
        answer: The QP's.
        hessian: The damped Hessian that the answer belongs to.
        promised: What the model without damping promises of the step before its correction.
        own: That model's curvature along the step, in the damping's metric.
    """

    run: Run | None
    answer: Answer
    hessian: Array
    promised: float
    own: float


class Descent:
    """The steps of one solve, from a first point on.

    Args:
        landscape: Cost and derivatives.
        case: What the solve is given.
        at: The first run; its cost is finite.
        curvature: Second derivatives from the last solve, shifted. Default: taken at the first run.
        tolerance: See :class:`~hybrid_mpc.mpc.SQPController`.
    """

    def __init__(
        self, landscape: Landscape, case: Case, at: Point, curvature: Array | None, tolerance: float
    ) -> None:
        self._land, self._case, self._tolerance = landscape, case, tolerance
        self.at, self.curvature = at, curvature
        self.count, self.status, self.kkt, self.ended = 0, Status.STOPPED, NAN, False
        self._stale, self._fresh, self._plain, self._taken = curvature is None, False, False, 0
        self._soft = np.zeros(at.run.soft[0].size)  # multipliers
        self._damping = 0.0

    def iterate(self) -> None:
        """One linearisation, and QPs until the step of one lowers the cost."""
        self.count += 1
        prepared = self._land.condensed(self.at, self._case)
        hessian = self._hessian(prepared)
        found = self._search(prepared, hessian)
        if not found.answer.status.ok:
            self._refused(found.answer.status)
        elif found.run is None:
            self._lost(found)
        else:
            self._go(hessian, found, found.run)

    def _go(self, hessian: Array, found: _Step, run: Run) -> None:
        """Make a step, and judge by the QP's multipliers what is left to do there."""
        answer, land = found.answer, self._land
        before = max(answer.kkt, self._residual(hessian, found.hessian @ answer.step))
        gained = self.at.run.cost - run.cost
        new = land.at(run, self._case)
        change = land.lagrangian(new, answer.multipliers)[1]
        change = change - land.lagrangian(self.at, answer.multipliers)[1]
        wrong = self._residual(hessian, change - hessian @ answer.step)
        left = change - found.hessian @ answer.step
        after = max(answer.kkt, self._residual(hessian, left))
        self.at, self.kkt, self._soft = new, after, answer.multipliers
        self._stale, self._fresh, self._plain = wrong > SLOW * before, False, False
        self.ended = after <= KKT and self._promise(hessian, left) <= self._enough
        self.status = Status.SOLVED if self.ended else Status.STOPPED
        if gained < POOR * found.promised:
            self._damping = max(2 * self._damping, 0.5 * found.own)
        elif gained > GOOD * found.promised:
            self._damping = self._damping / MORE if self._damping > 0.1 * found.own else 0.0

    def _search(self, prepared: Prepared, hessian: Array) -> _Step:
        """The first step, damped more and more, that lowers the cost enough, if there is one."""
        first = None
        for _ in range(ATTEMPTS):
            damped = hessian
            if self._damping:
                damped = hessian + np.diag(self._damping * self._land.metric)
            answer = self._answer(damped, self.at.gradient, prepared.soft[0], prepared.soft[2])
            step = answer.step
            own = float(step @ (hessian @ step)) / max(float(step**2 @ self._land.metric), 1e-300)
            found = _Step(None, answer, damped, self._promised(prepared, hessian, step), own)
            first = found if first is None else first
            if not answer.status.ok:
                return found
            promised = self._promised(prepared, damped, step)
            run, answer = self._along(prepared, damped, answer, promised)
            if run is not None:
                return _Step(run, answer, damped, found.promised, own)
            if promised <= self._enough:
                break
            self._damping = max(MORE * self._damping, own)
        assert first is not None
        return first

    def _along(
        self, prepared: Prepared, damped: Array, answer: Answer, promised: float
    ) -> tuple[Run | None, Answer]:
        """The run on a step if it lowers the cost enough, or on the step corrected by what it was found to bend."""
        least, before = self.at.run.cost - ARMIJO * promised, np.inf
        for i in range(1 + CORRECTIONS):
            run = self._trial(answer.step)
            if run.cost <= least:
                return run, answer
            if i == CORRECTIONS or not run.cost < before:
                break
            before, answer = run.cost, self._corrected(prepared, damped, answer, run)
            if not answer.status.ok:
                break
        return None, answer

    def _corrected(self, prepared: Prepared, damped: Array, answer: Answer, run: Run) -> Answer:
        """The QP once more, with what states and soft bounds were found to be beside the last answer's line."""
        old, n_x, (value, _, slope) = self.at.run, self._land.inner.ocp.n_x, prepared.soft
        bend = (run.z[:, :n_x] - old.z[:, :n_x]).ravel() - prepared.from_u @ answer.step
        if len(slope):
            value = run.soft[0] - slope @ answer.step
        return self._answer(damped, self.at.gradient + 2 * bend @ prepared.weighted, value, slope)

    def _answer(self, hessian: Array, gradient: Array, value: Array, slope: Array) -> Answer:
        soft = (value, slope) if value.size else None
        case = self._case
        return self._land.inner.qp.answer(hessian, gradient, self.at.run.u, case.u_prev, soft, case.limits)

    def _trial(self, step: Array) -> Run:
        run, bounds = self.at.run, self._land.inner.ocp.bounds(self._case.u_prev, self._case.limits)
        u = np.clip(run.u + step.reshape(run.u.shape), *bounds)
        return self._land.run(run.z[0], u, self._case)

    def _promised(self, prepared: Prepared, hessian: Array, step: Array) -> float:
        """By how much the convex model falls along a step."""
        value, _, slope = prepared.soft
        lowers = -float(step @ (self.at.gradient + 0.5 * (hessian @ step)))
        if value.size:
            lowers += self._land.penalty(value) - self._land.penalty(value + slope @ step)
        return lowers

    def _promise(self, hessian: Array, left: Array) -> float:
        """What the convex model at the point promises at most (weak duality), ``left`` of the stationarity."""
        qp = self._land.inner.qp
        left, hessian = qp.by_blocks(left), qp.blocked_hessian(hessian)
        promise = 0.5 * float(left @ np.linalg.solve(hessian, left))
        return promise + self._land.gap(self.at.run.soft[0], self._soft)

    def _residual(self, hessian: Array, slope: Array) -> float:
        """A gradient of the cost by the inputs in the QP's scaling."""
        qp = self._land.inner.qp
        size = np.max(np.diag(qp.blocked_hessian(hessian)) * qp.scale**2)
        return float(np.max(np.abs(qp.scale * qp.by_blocks(slope))) / size)

    @property
    def _enough(self) -> float:
        return self._tolerance * max(abs(self.at.run.cost), 1e-12)

    def _hessian(self, prepared: Prepared) -> Array:
        if self._plain:
            return prepared.hessian
        multipliers, slope = self._land.lagrangian(self.at, self._soft)
        if self._stale or self.curvature is None:
            self.curvature = self._taken_anew(prepared, multipliers)
        if not np.all(np.isfinite(self.curvature)):
            return prepared.hessian
        return convex(
            prepared.hessian, self._land.rest(prepared, self.curvature, self._case), self._held(slope)
        )

    def _taken_anew(self, prepared: Prepared, multipliers: Array) -> Array:
        """Second derivatives here; the hidden state's, which change slowly, from the second time on."""
        land, old = self._land, self.curvature
        small = old is not None and old.shape[1] < land.stages.size
        if old is not None and (self._taken in AGAIN if small else self._taken > 0):
            old = None
        curvature = land.curvature(self.at, self._case, multipliers, self._soft, old)
        if old is None:
            curvature = land.without_what_is_small(prepared, curvature)
        self._stale, self._fresh, self._taken = False, True, self._taken + 1
        return curvature

    def _held(self, slope: Array) -> NDArray[np.bool_] | None:
        """Inputs that lie on a bound against which the cost pushes them."""
        ocp, u = self._land.inner.ocp, self.at.run.u
        if ocp.blocks is not None:
            return None
        s, near = slope.reshape(u.shape), 1e-6 * self._land.inner.qp.scale.reshape(u.shape)
        lower, upper = ocp.bounds(self._case.u_prev, self._case.limits)
        return (((u <= lower + near) & (s > 0)) | ((u >= upper - near) & (s < 0))).ravel()

    def _lost(self, found: _Step) -> None:
        """No step lowers the cost: where it is flat what is left is rounding, else start anew."""
        self.kkt = max(found.answer.kkt, self._residual(found.hessian, found.hessian @ found.answer.step))
        flat = found.promised <= self._enough
        self.ended = (flat and self.kkt <= KKT) or self._plain
        self.status = Status.SOLVED if self.ended and flat else Status.STOPPED
        self._stale, self._plain, self._damping = not self._fresh, self._fresh, 0.0

    def _refused(self, status: Status) -> None:
        """The QP's answer is no good: Gauss-Newton's Hessian is better conditioned, then it is over."""
        self.ended = self._plain
        self._plain, self._damping = True, 0.0
        if self.ended:
            self.status = status if self.count <= 2 else Status.STOPPED
