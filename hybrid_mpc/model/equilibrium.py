"""Steady states of a model: one search for all uses, and functions of a machine at rest.

A steady state solves ``0 = F(z, u, w, d) - z``, or ``0 = xdot``, within bounds and, if given, at a set-point of the
outputs. Observers, target calculator, safeguard, analysis, pre-flight check and default tasks use this search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import Expression, HybridModel, output_with_jacobian, positions_of

Array = NDArray[np.float64]
Places = NDArray[np.int64]
SETTLING = 6
"""Most Newton steps that settle a hidden state."""
ITERATIONS = 60
STEADY = 1e-9
"""Largest step, in scales of the unknowns, of a converged Newton iteration."""
REACHED = 1e-6
"""Largest deviation of an output that counts as reached, in tolerated deviations ``1 / sqrt(q_y)``."""
RANK = 1e-9
"""Singular values below this share of the largest count as zero."""
FREE = 1e-6
"""Weight of the distance from the operating point along directions that do not affect the outputs."""
STALLED, CREEPS, WITHIN = 0.9, 0.99, 5
"""A descent stops if within ``WITHIN`` steps its residual has not fallen to the share ``STALLED``, nor its merit to
the share ``CREEPS``. Successful descents fall far more, but along a curved branch, as that of a saturating actuator,
steps are short at first."""
LEAST_WEIGHT = 100.0
"""Smallest weight of the residual, over that of the deviation from the set-point, in the merit of a descent."""
PLAIN, CURVED, LEANING = range(3)
"""Second derivatives in a step: none, those of the deviation from the set-point, those of the distance from the
operating point."""
STIFF = 100.0
"""Curvature against leaving bounds, over the norm of the second derivatives, where these are not positive definite."""
ASIDE = 1e-5
"""Step of the differences that measure curvature, in scales of the unknowns."""
WAIT = 20
"""Searches from the last result, for the same set-point, between two from several starts, which take a hundred times
as long."""
AWAY = 1e6
"""Distance from its start, in scales of the unknowns, at which a descent has diverged."""
STILL = 1e-6
"""Largest residual of a steady state, in the states' scales, that is rounding."""
NEAR = 1e-5
"""Largest step, in scales of the unknowns, that rounding may prevent from reducing the residual."""
CONTRACTS = 0.7
"""Largest ratio of a step to the previous one in a descent whose end does not depend on rounding."""
FOLLOWED, LEAST_PART, MOST_PARTS = 0.125, 1 / 1024, 100
"""First and smallest part of the way of a continuation, and the most descents."""
EQUAL = 1e-3
"""Largest relative difference between deviations of equally good steady states."""
EXACT = 1e-12
"""Largest step, in scales of the unknowns, at which an analysis has converged."""
RESIDUAL = 1e-10
"""Largest residual of an analysis's steady states, in the units of the states."""
REACHES = 0.01 * 2.0 ** np.arange(12)
"""Distances from a guess at which the search for a holding input restarts."""


@dataclass(frozen=True)
class Steady:
    """A steady state.

    Args:
        x: States ``(n_x,)``.
        h: Hidden states ``(n_h,)``.
        u: Inputs ``(n_u,)`` that hold it.
        y: Outputs ``(n_y,)``, with the effect of unmeasured disturbances.
        reached: Whether the outputs with weights are at the set-point.
        steady: Whether it is a steady state of the model; False: none was found, and this is the last iterate.
        goal: Set-point ``(n_y,)`` that it was searched for.
        age: Searches for this set-point since the last one from several starts, each from the result before.
    """

    x: Array
    h: Array
    u: Array
    y: Array
    reached: bool
    steady: bool
    goal: Array
    age: int

    @property
    def unknowns(self) -> Array:
        """``(x, h, u)`` in one vector."""
        return np.concatenate([self.x, self.h, self.u])


class Equations(Protocol):
    """The equations of a steady state and the outputs of set-points, as functions of the unknowns ``v`` ``(n_v,)``."""

    def rest(self, v: Array) -> tuple[Array, Array]:
        """Residual ``(n_e,)`` of the steady state, and its Jacobian ``(n_e, n_v)``."""
        ...

    def shown(self, v: Array) -> tuple[Array, Array]:
        """Outputs of set-points ``(n_y,)``, and their Jacobian ``(n_y, n_v)``."""
        ...


class StepEquations:
    """A model's step and outputs over ``v = (x, h, u)``; the disturbances ``d`` and ``w`` may be changed.

    ``rows`` are the indices of the states and hidden states that must be steady. Default: all.
    """

    def __init__(self, model: HybridModel, rows: Places | None = None) -> None:
        self.model = model
        self._step, self._output = map(BufferedFunction, (model.with_jacobian, output_with_jacobian(model)))
        self._step.inputs[4][:] = model.p
        self._on_u, self._on_x, self._on_y = model.disturbed
        self._eye, self._rows = np.eye(model.n_x + model.n_h), slice(None) if rows is None else rows
        self._hidden = np.zeros((model.n_y, model.n_h))
        self.d: Array = np.zeros(model.n_d)
        """Unmeasured disturbances ``(n_d,)``."""
        self.w: Array = model.w
        """Measured disturbances ``(n_w,)``."""

    def rest(self, v: Array) -> tuple[Array, Array]:
        """``F(z, u) - z`` of the rows that must be steady, and its Jacobian ``(n_e, n_z + n_u)``."""
        m, f, n_x = self.model, self._step, self.model.n_x
        n_z = len(self._eye)
        f.inputs[0][:], f.inputs[1][:] = v[:n_x], v[n_x:n_z]
        f.inputs[2][:], f.inputs[3][:] = v[n_z:] + self._on_u @ self.d, self.w
        f()
        x, h, a, b = f.outputs
        moved = np.concatenate([x + self._on_x @ self.d, h]) - v[:n_z]
        slopes = np.hstack([a.reshape(n_z, n_z).T - self._eye, b.reshape(m.n_u, n_z).T])
        return moved[self._rows], slopes[self._rows]

    def shown(self, v: Array) -> tuple[Array, Array]:
        """Outputs and their Jacobian ``(n_y, n_z + n_u)``."""
        m, f = self.model, self._output
        f.inputs[0][:], f.inputs[2][:] = v[: m.n_x], self.w
        f.inputs[1][:] = v[len(self._eye) :] + self._on_u @ self.d
        f()
        y, by_x, by_u = f.outputs
        return y + self._on_y @ self.d, np.hstack(
            [by_x.reshape(m.n_x, m.n_y).T, self._hidden, by_u.reshape(m.n_u, m.n_y).T]
        )

    def after(self, v: Array) -> Array:
        """States and hidden states ``(n_z,)`` a period later."""
        f, n_x, n_z = self._step, self.model.n_x, len(self._eye)
        f.inputs[0][:], f.inputs[1][:], f.inputs[2][:], f.inputs[3][:] = v[:n_x], v[n_x:n_z], v[n_z:], self.w
        f()
        return np.concatenate(f.outputs[:2])


class RateEquations:
    """Rates ``xdot(x, u, w, p)`` over ``v = (x, u)`` at constant ``w`` and ``p``; set-points are of ``shown(x, u, w,
    p)``, by default of the states.
    """

    def __init__(self, xdot: ca.Function, w: Array, p: Array, shown: ca.Function | None = None) -> None:
        x, u = ca.SX.sym("x", xdot.size1_in(0)), ca.SX.sym("u", xdot.size1_in(1))
        v = ca.vertcat(x, u)
        values = xdot(x, u, w, p), x if shown is None else shown(x, u, w, p)
        pairs = [[ca.densify(value), ca.densify(ca.jacobian(value, v))] for value in values]
        self._rest, self._shown = (ca.Function("equations", [v], pair) for pair in pairs)

    def rest(self, v: Array) -> tuple[Array, Array]:
        """Rates ``(n_x,)`` and their Jacobian."""
        rates, slopes = (m.full() for m in self._rest(v))
        return rates.ravel(), slopes

    def shown(self, v: Array) -> tuple[Array, Array]:
        """Outputs of set-points, and their Jacobian."""
        values, slopes = (m.full() for m in self._shown(v))
        return values.ravel(), slopes


@dataclass(frozen=True)
class Range:
    """Bounds of a search: ``lower``, ``upper`` ``(n_v,)`` of the unknowns and ``y_lower``, ``y_upper`` ``(n_y,)`` of
    the outputs. Bounds of the unknowns ``kept`` hold in every search, the others only in bounded ones.
    """

    lower: Array
    upper: Array
    kept: NDArray[np.bool_]
    y_lower: Array
    y_upper: Array

    @classmethod
    def none(cls, n_v: int, n_y: int) -> Range:
        """No bounds."""
        v, y = np.full(n_v, np.inf), np.full(n_y, np.inf)
        return cls(-v, v, np.ones(n_v, dtype=bool), -y, y)


class Descent(NamedTuple):
    """The end of a descent.

    Attributes:
        v: The unknowns.
        y: The outputs.
        off: Largest deviation of an output from the set-point, in tolerated deviations.
        slopes: Derivatives of the outputs by the leaning unknowns, along steady states.
        steady: Whether it is a steady state.
        sure: Whether all steps were full and shorter than the one before: then the end does not depend on rounding, or
            on small changes of the start.
    """

    v: Array
    y: Array
    off: float
    slopes: Array
    steady: bool
    sure: bool

    @property
    def reached(self) -> bool:
        """Whether it is a steady state at the set-point."""
        return self.steady and self.off <= REACHED


class _Point(NamedTuple):
    """A point of a descent: ``rest`` and ``y`` with Jacobians; ``lacks``, the scaled norm of ``rest``; and ``off``, the
    weighted deviation of ``y``.
    """

    v: Array
    rest: Array
    rest_by_v: Array
    y: Array
    y_by_v: Array
    lacks: float
    off: float

    def merit(self, weight: float) -> float:
        """What a descent reduces, with the weight of ``lacks``; infinite if a value is not finite."""
        found = weight * self.lacks + self.off
        return found if np.isfinite(found) else np.inf


class SteadySearch:
    """Steady states closest to a set-point within bounds: ``min |y - goal|^2``, weighted, subject to ``rest(v) = 0``.

    A Gauss-Newton method that eliminates the steady-state equations by their null space; bounds are treated by an
    active set. Among equally good solutions, the solution closest to the operating point is used, measured in the
    scales of the leaning unknowns. All quantities are scaled, so solutions do not depend on units.

    Args:
        equations: Steady-state equations and outputs.
        scale: Scale of the unknowns ``(n_v,)``.
        size: Scale of the equations ``(n_e,)``.
        root: Square roots of the set-point's weights ``(n_y,)``; 0: no weight.
        near: The operating point ``(n_v,)``.
        leans: Indices of the unknowns that stay close to it.
        bounds: Bounds. Default: none.
        heed: Factors ``(n_e,)`` on ``size`` in the linearization. Default: 1.
        hidden: Indices of hidden states, which are settled in between; the last equations are theirs. Default: none.
        free: Indices of the free unknowns; the others are constant. Default: all.
        steady: Largest step, in scales, at which a descent has converged. Default: 1e-9.

    Source: Rawlings, Mayne, Diehl, *Model Predictive Control*, 2017, section 1.5; Nocedal, Wright, *Numerical
    Optimization*, 2006, section 15.6, for the watchdog; Deuflhard, *Newton Methods for Nonlinear Problems*, 2011,
    chapter 5, for the continuation.

    Example:
        >>> x, u = ca.SX.sym("x"), ca.SX.sym("u")
        >>> empty = ca.SX.sym("w", 0), ca.SX.sym("p", 0)
        >>> tank = RateEquations(ca.Function("xdot", [x, u, *empty], [u - x**2]), np.zeros(0), np.zeros(0))
        >>> one = np.ones(1)
        >>> search = SteadySearch(tank, np.ones(2), one, one, np.ones(2), np.array([1]))
        >>> search.descend(np.array([2.0, 3.0]), np.array([2.0])).v.round(6)
        array([2., 4.])
    """

    def __init__(
        self, equations: Equations, scale: Array, size: Array, root: Array, near: Array, leans: Places,
        bounds: Range | None = None, *, heed: Array | None = None, hidden: slice = slice(0, 0),
        free: Places | None = None, steady: float = STEADY,
    ) -> None:  # fmt: skip
        self.equations, self.scale, self.size, self.near = equations, scale, size, near
        self._tracked = np.flatnonzero(root > 0)
        self._root, self._free, self._steady = root[self._tracked], free, steady
        self._hidden = hidden if scale[hidden].size else None
        self._settles = slice(size.size - scale[hidden].size, size.size)
        self._own = size if heed is None else size * heed
        n_v = scale.size
        self._sought = np.arange(n_v) if free is None else free
        place = np.full(n_v, -1)
        place[self._sought] = np.arange(self._sought.size)
        self._leaning, self._leans = place[leans][place[leans] >= 0], leans[place[leans] >= 0]
        self._spare = self._leaning.size > self._tracked.size  # inputs that set-points do not determine
        bounds = Range.none(n_v, root.size) if bounds is None else bounds
        self.bounds = bounds
        finite = (np.isfinite(bounds.lower) | np.isfinite(bounds.upper)) & (place >= 0)
        # indices of bounded unknowns, their indices among the free ones, and their scaled bounds
        self._always, self._all = (
            (k, place[k], bounds.lower[k] / scale[k], bounds.upper[k] / scale[k])
            for k in (
                np.flatnonzero(finite & bounds.kept),
                np.concatenate([np.flatnonzero(finite & bounds.kept), np.flatnonzero(finite & ~bounds.kept)]),
            )
        )
        self._seen = np.flatnonzero(np.isfinite(bounds.y_lower) | np.isfinite(bounds.y_upper))

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def descend(
        self, v: Array, goal: Array, bounded: bool = True, firm: bool = False, mode: int = PLAIN
    ) -> Descent:
        """Gauss-Newton from ``v`` to the set-point ``goal`` ``(n_y,)``; not ``bounded``: only kept bounds hold.

        Second derivatives of the deviation are used from the start (``CURVED``) or once a whole step fails, those of
        the distance from the operating point once steps at the set-point do not contract. ``firm``: ends as soon as its
        end is not sure.
        """
        at, done, sure = self._point(v, goal), False, True
        passed, before, weight, good, near = [at], np.inf, LEAST_WEIGHT, at, False
        slopes = np.full((self._tracked.size, self._leans.size), np.nan)
        for _ in range(ITERATIONS):
            if firm and not sure:
                break
            step, slopes = self._newton(at, goal, bounded, mode)
            if step is None or not np.all(np.isfinite(step)):
                break
            size = float(np.max(np.abs(step / self.scale), initial=0.0))
            if size <= self._steady:
                done = at.lacks <= STILL
                break
            spare = self._spare and mode != LEANING and at.lacks <= STILL and at.off <= REACHED
            if spare and size > CONTRACTS * before:
                mode, good, near, before = LEANING, at, size < NEAR, np.inf  # the same point again
                continue
            if mode == LEANING:
                if not size <= CONTRACTS * before:
                    break
                before, at = size, self._settled(at.v + step, goal)
                continue
            # exact penalty: the step must reduce the merit to first order (Nocedal, Wright, 2006, section 18.3)
            worse = self._deviation(at.y + at.y_by_v @ step, goal) - at.off
            weight = max(weight, 2.0 * worse / at.lacks) if at.lacks > STILL else weight
            last, share, merit = before, 1.0, at.merit(weight)
            before = size
            after = self._settled(at.v + step, goal)
            if not after.merit(weight) < merit and size >= NEAR:
                # watchdog: on a curved branch a step leaves it to second order, and the next step returns to it
                second = self._newton(after, goal, bounded, mode)[0]
                again = np.inf if second is None else float(np.max(np.abs(second / self.scale), initial=0.0))
                if second is not None and np.isfinite(again):
                    then = self._settled(after.v + second, goal)
                    if then.merit(weight) < merit:
                        sure = sure and (again < NEAR or again <= CONTRACTS * size)
                        after, before = then, again
            if not after.merit(weight) < merit and size >= NEAR and at.off > REACHED and mode == PLAIN:
                mode, before = CURVED, last  # the same point again
                continue
            sure = sure and (size < NEAR or size <= CONTRACTS * last)
            # where an output turns, the merit is flat, and rounding hides what the last steps gain
            flat = mode == CURVED and size < NEAR and size <= CONTRACTS * last
            # smallest share of a step that is tried
            while not (flat or after.merit(weight) < merit) and share > 1e-3:
                share, sure = 0.5 * share, sure and size < NEAR
                after = self._settled(at.v + share * step, goal)
            if not (flat or after.merit(weight) < merit):
                if spare:
                    mode, good, near, before = LEANING, at, size < NEAR, np.inf
                    continue
                done = size < NEAR and at.lacks <= STILL  # only rounding is left
                break
            at = after
            passed.append(at)
            if np.max(np.abs((at.v - v) / self.scale), initial=0.0) > AWAY:
                break
            if len(passed) > WITHIN:
                past = passed[-1 - WITHIN]
                stalled = at.lacks > max(STALLED * past.lacks, STILL)
                if stalled and at.merit(weight) > CREEPS * past.merit(weight):
                    break
        if mode == LEANING and not done:
            at, done, sure = (
                good,
                True,
                sure and near,
            )  # the set-point is reached, farther from the operating point
        off = float(np.max(np.abs(self._root * (at.y - goal)[self._tracked]), initial=0.0))
        return Descent(at.v, at.y, off, slopes, done, done and sure)

    def follow(
        self,
        v: Array,
        begun: Array,
        goal: Array,
        *,
        sure: bool = True,
        before: Callable[[float], None] | None = None,
    ) -> Descent | None:
        """The steady state reached by moving the set-point from ``begun``, that of ``v``, to ``goal``; None if the
        branch ends.

        Steps along the way shrink if Newton's method does not contract and grow if it does, so the continuation stays
        on its branch whatever the rounding. Not ``sure``: any steady state is accepted. ``before`` is called with the
        share of the way before each descent, to change other quantities along it.
        """
        done, part, found = 0.0, FOLLOWED, None
        for _ in range(MOST_PARTS):
            to = min(1.0, done + part)
            if before is not None:
                before(to)
            found = self.descend(v, begun + to * (goal - begun), firm=sure)
            if found.steady and (found.sure or not sure):
                if to >= 1.0:
                    return found
                v, done, part = found.v, to, 2.0 * part
            else:
                part *= 0.25
                if part < LEAST_PART:
                    break
        return None

    def best(self, found: list[Descent]) -> Descent | None:
        """The steady state closest to the set-point; of equally close ones, the one closest to the operating point.

        Uncertain ones count only if none is sure. None if there is no steady state.
        """
        steady = [f for f in found if f.sure] or [f for f in found if f.steady]
        if not steady:
            return None
        least = max(min(f.off for f in steady) * (1.0 + EQUAL), REACHED)
        return min((f for f in steady if f.off <= least), key=self.distance)

    def distance(self, found: Descent) -> float:
        """Scaled distance of the free unknowns, without hidden states, from the operating point."""
        apart = ((found.v - self.near) / self.scale)[self._sought]
        if self._hidden is not None:
            apart = np.delete(
                apart, np.flatnonzero(np.isin(self._sought, np.arange(self.scale.size)[self._hidden]))
            )
        return float(np.linalg.norm(apart))

    def slopes(self, v: Array) -> Array:
        """Derivatives of the weighted outputs by the leaning unknowns, along steady states ``(n, len(leans))``."""
        at = self._point(v, np.zeros(self.bounds.y_lower.size))
        return self._newton(at, at.y, False)[1]

    def lacks(self, v: Array) -> float:
        """Scaled residual of the steady state at ``v``."""
        return float(np.sum(np.abs(self.equations.rest(v)[0] / self.size)))

    def _newton(
        self, at: _Point, goal: Array, bounded: bool, mode: int = PLAIN
    ) -> tuple[Array | None, Array]:
        """The step of the linearized problem (None if its QP has no solution), and :meth:`slopes` there.

        ``mode`` says which second derivatives along the steady states it has.
        """
        scale, v, y = self.scale, at.v, at.y
        # scaled rows, so that their rank does not depend on units
        rest, e, j = at.rest / self._own, at.rest_by_v * scale / self._own[:, None], at.y_by_v * scale
        if self._free is not None:
            e, j = e[:, self._free], j[:, self._free]
        if not (np.all(np.isfinite(e)) and np.all(np.isfinite(j)) and np.all(np.isfinite(rest))):
            return None, np.full((self._tracked.size, self._leans.size), np.nan)
        left, sizes, right = np.linalg.svd(e)
        rank = int(np.sum(sizes > RANK * sizes[0])) if sizes.size else 0
        onto = right[:rank].T @ ((left[:, :rank].T @ -rest) / sizes[:rank])  # step to the steady states
        along = right[rank:].T  # directions along the steady states
        sees = self._root[:, None] * j[self._tracked] @ along
        error = self._root * (goal - y - j @ onto)[self._tracked]
        lean = self._leans
        far = (self.near[lean] - v[lean]) / scale[lean] - onto[self._leaning]
        _, s, vt = np.linalg.svd(sees)
        size = max(float(s[0]) if s.size else 0.0, 1e-150)
        unseen = vt[int(np.sum(s > RANK * size)) :]
        move = along[self._leaning]
        inward = unseen.T @ unseen
        h, g = sees.T @ sees, -sees.T @ error
        leaning, towards = inward @ (move.T @ move) @ inward, inward @ (move.T @ far)
        if mode == PLAIN:
            h, g = h / size**2 + FREE * leaning, g / size**2 - FREE * towards
        else:
            # unknowns at bounds, which have multipliers of their own
            inside = (v - self.bounds.lower > NEAR * scale) & (self.bounds.upper - v > NEAR * scale)
            inside = inside[self._sought]
            bend, turned = self._bend(at, goal, along, onto, inside, mode)
            if mode == CURVED:
                size = float(np.sqrt(size**2 + np.linalg.norm(bend)))
                h, g = convex(h / size**2, bend / size**2, along[~inside]), (g + turned) / size**2
                h, g = h + FREE * leaning, g - FREE * towards
            else:
                h, g = h / size**2 + FREE * leaning, g / size**2 + FREE * (inward @ turned - towards)
                h = convex(h, FREE * inward @ bend @ inward, along[~inside])
        h += 1e-12 * np.trace(h) * np.eye(len(h)) + 1e-14 * np.eye(len(h))
        which, places, low, high = self._all if bounded else self._always
        now = v[which] / scale[which] + onto[places]
        rows, lower, upper = along[places], low - now, high - now
        if bounded and self._seen.size:
            k = self._seen
            now = y[k] + j[k] @ onto
            rows = np.vstack([j[k] @ along, rows])
            lower = np.concatenate([self.bounds.y_lower[k] - now, lower])
            upper = np.concatenate([self.bounds.y_upper[k] - now, upper])
        eta = bounded_least_squares(h, g, rows, lower, upper)
        if eta is None:
            return None, sees @ move.T
        moved = onto + along @ eta
        if self._free is not None:
            whole = np.zeros(scale.size)
            whole[self._free] = moved
            moved = whole
        return moved * scale, sees @ move.T

    def _bend(
        self, at: _Point, goal: Array, along: Array, onto: Array, inside: NDArray[np.bool_], mode: int
    ) -> tuple[Array, Array]:
        """Second derivatives of the Lagrangian along steady states, and their product with the scaled step ``onto``
        them, by differences of Jacobians.

        ``CURVED``: of half the square of the deviation from the set-point. Gauss-Newton neglects them, but they matter
        if a set-point beyond reach is closest where an output turns. ``LEANING``: of half the square of the distance
        from the operating point at the set-point. ``inside``: unknowns that are not at bounds.
        """
        tracked, scale, n_e = self._tracked, self.scale, at.rest.size

        def slopes(point: _Point) -> Array:
            tracked_rows = self._root[:, None] * point.y_by_v[tracked]
            found = np.concatenate([point.rest_by_v / self._own[:, None], tracked_rows]) * scale
            return np.asarray(found[:, self._sought])

        begun = slopes(at)
        own = begun * inside
        if mode == CURVED:
            push = self._root * (at.y - goal)[tracked]
            multipliers = np.concatenate([-np.linalg.pinv(own[:n_e], RANK).T @ (push @ own[n_e:]), push])
        else:
            away = np.zeros(inside.size)
            away[self._leaning] = ((at.v - self.near) / scale)[self._leans]
            multipliers = -np.linalg.pinv(own, RANK).T @ (away * inside)
        far = float(np.linalg.norm(onto)) + 1e-150
        columns = []
        for direction in (*along.T, onto / far):
            v = at.v.copy()
            v[self._sought] += ASIDE * direction * scale[self._sought]
            columns.append(along.T @ (multipliers @ (slopes(self._point(v, goal)) - begun)) / ASIDE)
        bend = np.array(columns[:-1]).reshape(along.shape[1], along.shape[1])
        return 0.5 * (bend + bend.T), far * columns[-1]

    def _settled(self, v: Array, goal: Array) -> _Point:
        """The point with its hidden state settled by Newton's method, or unchanged if that fails. The hidden state on
        the way between two steady states does not measure the distance from either.
        """
        plain = at = self._point(v, goal)
        if self._hidden is None:
            return plain
        hidden = self._hidden
        size = self.scale[hidden]
        for _ in range(SETTLING):
            off = at.rest[self._settles] / size
            if not np.all(np.isfinite(at.rest)) or np.max(np.abs(off)) < STEADY:
                break
            try:
                move = size * np.linalg.solve(
                    at.rest_by_v[self._settles, hidden] * size / size[:, None], -off
                )
            except np.linalg.LinAlgError:
                return plain
            v = at.v.copy()
            v[hidden] += move
            at = self._point(v, goal)
        return at if at.merit(LEAST_WEIGHT) < plain.merit(LEAST_WEIGHT) else plain

    def _point(self, v: Array, goal: Array) -> _Point:
        """The data of a point."""
        rest, rest_by_v = self.equations.rest(v)
        y, y_by_v = self.equations.shown(v)
        lacks = float(np.sum(np.abs(rest / self.size)))
        return _Point(v, rest, rest_by_v, y, y_by_v, lacks, self._deviation(y, goal))

    def _deviation(self, y: Array, goal: Array) -> float:
        """Weighted deviation of the outputs from the set-point."""
        return float(np.linalg.norm(self._root * (y - goal)[self._tracked]))


def convex(square: Array, bend: Array, held: Array) -> Array:
    """``square + bend``, made positive definite: by changes of what is at bounds, with the directions ``held``, and if
    that is not enough, of everything.
    """
    size, lengths = float(np.linalg.norm(bend)), np.sum(held**2, axis=1)
    rows = held[lengths > 0] / np.sqrt(lengths[lengths > 0])[:, None]
    found = square + bend
    for more in (STIFF * size * rows.T @ rows, 2.0 * size * np.eye(len(bend))):
        try:
            np.linalg.cholesky(found)
        except np.linalg.LinAlgError:
            found = found + more
    return np.asarray(found)


def natural_sizes(model: HybridModel) -> Array:
    """Sizes ``(n_x + n_h,)`` of a model's states for an analysis: spread, else half the range, else the operating
    point's value, else 1; for delayed inputs the size of the input, for other hidden states 1.
    """
    half = np.array([0.5 * (s.upper - s.lower) for s in model.states])
    spread = np.array(model.state_spread) if model.state_spread else np.zeros(model.n_x)
    own = np.where(model.x0 != 0, np.abs(model.x0), 1.0)
    x = np.where(spread > 0, spread, np.where(np.isfinite(half) & (half > 0), half, own))
    return np.concatenate(
        [x, np.resize(input_sizes(model), model.delay_states), np.ones(model.n_h - model.delay_states)]
    )


def input_sizes(model: HybridModel) -> Array:
    """Sizes ``(n_u,)`` of inputs for an analysis: half the range, else the operating point's value, else 1."""
    half = np.array([0.5 * (s.upper - s.lower) for s in model.inputs])
    own = np.where(model.u0 != 0, np.abs(model.u0), 1.0)
    return np.where(np.isfinite(half) & (half > 0), half, own)


def rest_search(
    model: HybridModel, scale: Array | None = None, *, rows: Places | None = None, free: Places | None = None,
    settles: bool = True,
) -> SteadySearch:  # fmt: skip
    """A search for steady states ``v = (x, h, u)`` without a set-point; ``scale`` ``(n_z,)`` are sizes of ``(x, h)``.

    Args:
        model: The model.
        scale: Default: :func:`natural_sizes`.
        rows: Indices of the states and hidden states that must be steady. Default: all.
        free: Indices of the free unknowns. Default: states and hidden states, at a constant input.
        settles: Whether the hidden state is settled in between. Default: True.
    """
    n_x, n_z = model.n_x, model.n_x + model.n_h
    scale = natural_sizes(model) if scale is None else scale
    return SteadySearch(
        StepEquations(model, rows), np.concatenate([scale, input_sizes(model)]),
        scale if rows is None else scale[rows], np.zeros(model.n_y),
        np.concatenate([model.x0, np.zeros(model.n_h), model.u0]), np.zeros(0, dtype=np.int64),
        hidden=slice(n_x, n_z if settles else n_x), free=np.arange(n_z) if free is None else free, steady=EXACT,
    )  # fmt: skip


def rate_search(
    equations: RateEquations, scale: Array, near: Array, root: Array, *, bounds: Range | None = None,
    free: Places | None = None,
) -> SteadySearch:  # fmt: skip
    """A search for steady states ``v = (x, u)`` of rates, scaled by the effect of states and inputs of their sizes.

    ``near`` is the operating point, to which the inputs stay close; the rest is as in :class:`SteadySearch`.
    """
    slopes = equations.rest(near)[1]
    size = np.linalg.norm(np.where(np.isfinite(slopes), slopes * scale, 0.0), axis=1)
    size = np.where(size > 0, size, 1.0)
    return SteadySearch(
        equations, scale, size, root, near, np.arange(len(size), len(near)), bounds, free=free, steady=EXACT
    )


@np.errstate(over="ignore", invalid="ignore")  # a run that overflows does not settle
def run_to_rest(search: SteadySearch, v: Array) -> Array | None:
    """The nearly steady end of the model's own run from ``v = (x, h, u)``; None if it does not settle."""
    equations, v = search.equations, v.copy()
    assert isinstance(equations, StepEquations)
    n_z = search.size.size
    # most periods of the model's own run
    for _ in range(5000):
        after = equations.after(v)
        moved, v[:n_z] = np.max(np.abs((after - v[:n_z]) / search.size)), after
        if not moved > STEADY:
            break
    # largest residual, in the states' scales, at which a run has nearly settled
    return v if search.lacks(v) < 1e-3 else None


def fixed_point(model: HybridModel, u: ArrayLike, x_guess: ArrayLike) -> tuple[Array, Array]:
    """The equilibrium ``x`` ``(n_x,)``, ``h`` ``(n_h,)`` at a constant input, by Newton's method from a guess of ``x``.

    If Newton's method fails, it restarts from the end of the model's own run, which finds a stable equilibrium.

    Raises:
        InputError: If a size is wrong or no equilibrium is found (largest residual above 1e-10 in the states' units).
    """
    x0, u0 = vector(x_guess, model.n_x, "x_guess"), vector(u, model.n_u, "u")
    search, none = rest_search(model), np.zeros(model.n_y)
    start = np.concatenate([x0, hidden_fixed_point(model, x0, u0, limit=100), u0])
    found = search.descend(start, none)
    if not found.steady or residual_of(search, found.v) > RESIDUAL:
        run = run_to_rest(search, start)
        found = found if run is None else search.descend(run, none)
    if not found.steady or (size := residual_of(search, found.v)) > RESIDUAL:
        size = residual_of(search, found.v)
        raise InputError(
            f"model {model.name}: no equilibrium found from x = {x0.tolist()} under u = {u0.tolist()} "
            f"(residual {size:.2g}, must be below {RESIDUAL:g}). Give a closer x_guess or an input with an equilibrium."
            " [HM-MODEL-008]"
        )
    return found.v[: model.n_x], found.v[model.n_x : model.n_x + model.n_h]


def residual_of(search: SteadySearch, v: Array) -> float:
    """Largest residual of the equations, in their units; infinite if it is not finite."""
    size = float(np.max(np.abs(search.equations.rest(v)[0]), initial=0.0))
    return size if np.isfinite(size) else float("inf")


def hidden_fixed_point(
    model: HybridModel, x: Array, u: Array, *, w: Array | None = None, limit: int = 2000
) -> Array:
    """Hidden state ``(n_h,)`` that the step reaches with ``x`` ``(n_x,)``, ``u`` ``(n_u,)`` and ``w`` ``(n_w,)`` held.

    The iteration starts at zero (delayed inputs at ``u``) and ends when no element changes by more than 1e-10, or after
    ``limit`` steps.
    """
    h = np.zeros(model.n_h)
    h[: model.delay_states] = np.resize(u, model.delay_states)
    held = model.w if w is None else w
    for _ in range(limit if model.n_h else 0):
        h_next = model.step(x, h, u, held, model.p)[1].full().ravel()
        moved, h = np.max(np.abs(h_next - h)), h_next
        # largest change per step of a settled hidden state
        if not moved > 1e-10:
            break
    return h


def hidden_equilibrium(model: HybridModel, x: ArrayLike, u: ArrayLike) -> Array:
    """Steady hidden state ``(n_h,)`` at constant ``x`` ``(n_x,)`` and ``u`` ``(n_u,)``, by Newton's method.

    Raises:
        InputError: If none is found.
    """
    x0, u0 = vector(x, model.n_x, "x"), vector(u, model.n_u, "u")
    if model.n_h == 0:
        return np.zeros(0)
    n_x, n_z = model.n_x, model.n_x + model.n_h
    hidden = np.arange(n_x, n_z)
    search = rest_search(model, rows=hidden, free=hidden, settles=False)
    start = np.concatenate([x0, hidden_fixed_point(model, x0, u0, limit=100), u0])
    found = search.descend(start, np.zeros(model.n_y))
    size = residual_of(search, found.v)
    if not found.steady or size > RESIDUAL:
        raise InputError(
            f"model {model.name}: the hidden state does not settle at x = {x0.tolist()} (residual {size:.2g}). Give h."
            " [HM-MODEL-009]"
        )
    return found.v[n_x:n_z]


def holding_input(model: HybridModel, q: ArrayLike, *, u_guess: ArrayLike | None = None) -> Array:
    """Input ``(n_u,)`` that holds a machine at rest at positions ``q`` ``(n_x / 2,)``, with its hidden state settled.

    If Newton's method fails from the guess (e.g. a network that has learned sticking friction has a zero slope there),
    it restarts at growing distances on both sides, and the closest input is returned.

    Args:
        model: The model, state ``[q, v]``, with as many inputs as positions.
        q: The positions.
        u_guess: Start ``(n_u,)``. Default: zero.

    Raises:
        InputError: If the numbers of inputs and positions differ, or no such input is found.

    Example:
        ``gain_schedule(model, [(np.append(q, 0.0), holding_input(model, [q])) for q in angles], weights, costs)``
    """
    n_q = positions_of(model)
    if model.n_u != n_q:
        raise InputError(
            f"model {model.name}: an input for {n_q} positions needs as many inputs, got {model.n_u}. Give the input."
            " [HM-MODEL-010]"
        )
    x = np.concatenate([vector(q, n_q, "q"), np.zeros(n_q)])
    guess = np.zeros(model.n_u) if u_guess is None else vector(u_guess, model.n_u, "u_guess")
    n_x, n_z = model.n_x, model.n_x + model.n_h
    search = rest_search(model, rows=np.arange(n_q, n_z), free=np.arange(n_x, n_z + model.n_u))

    def begun(u: Array) -> tuple[Array, float]:
        start = np.concatenate([x, hidden_fixed_point(model, x, u, limit=100), u])
        v = search.descend(start, np.zeros(model.n_y)).v
        return v[n_z:], residual_of(search, v)

    found, size = begun(guess)
    if size > RESIDUAL:
        aside = [
            begun(guess + move) for reach in REACHES for e in reach * np.eye(model.n_u) for move in (e, -e)
        ]
        held = [u for u, left in aside if left <= RESIDUAL]
        if not held:
            raise InputError(
                f"model {model.name}: no input holds q = {x[:n_q].tolist()} (residual {size:.2g})"
                " [HM-MODEL-011]"
            )
        found = min(held, key=lambda u: float(np.linalg.norm((u - guess) / input_sizes(model))))
    return found


def holding(rates: Expression, u: Expression, u0: Array, sizes: Array, scale: Array) -> Expression:
    """The input that holds a state best: one Newton step of least squares on ``rates`` ``(n_x,)`` over the symbol ``u``
    from the operating point's input ``u0``. Rates are scaled by ``sizes``, inputs by ``scale``.

    A fallback holds states that are no steady states, within one period, where a search has no solution. For rates
    linear in the inputs one step is exact, and in C it is scalar code.
    """
    size, rates = ca.DM(scale), rates / ca.DM(sizes)
    slope = ca.jacobian(rates, u) @ ca.diag(size)
    square = slope.T @ slope
    # of size one, and damped: CasADi's QR refuses pivots below 1e-12, as those of two inputs with the same effect
    weight = ca.trace(square) + 1e-300
    damped = square / weight + 1e-10 * ca.DM.eye(u.numel())
    best = u - size * ca.solve(damped, slope.T @ rates / weight)
    return ca.densify(ca.substitute(best, u, ca.DM(u0)))


def equilibrium_input(model: HybridModel, sizes: Array, scale: Array) -> ca.Function:
    """``(x, w) -> u`` that holds a state best; see :func:`holding`."""
    x, u, w = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u), ca.MX.sym("w", model.n_w)
    rates = model.xdot(x, ca.DM.zeros(model.n_h, 1), u, w, model.p)
    return ca.Function("equilibrium_input", [x, w], [holding(rates, u, model.u0, sizes, scale)])


def bounded_least_squares(h: Array, g: Array, rows: Array, lower: Array, upper: Array) -> Array | None:
    """``min 1/2 s'hs + g's`` with ``lower <= rows s <= upper``, for a few unknowns; None if infeasible.

    Solved as least distance programming by non-negative least squares of the dual: exact for any number of rows.

    Source: C. L. Lawson, R. J. Hanson, *Solving Least Squares Problems*, 1974, chapter 23.
    """
    from scipy.linalg import LinAlgError, cho_factor, cho_solve
    from scipy.optimize import nnls

    if not all(np.all(np.isfinite(m)) for m in (h, g, rows)):
        return None
    if not len(h):
        inside = np.all(lower <= 1e-9) and np.all(upper >= -1e-9)
        return np.zeros(0) if inside else None
    try:
        factor = cho_factor(h)
    except LinAlgError:
        return None
    free = -cho_solve(factor, g)
    sides = np.concatenate([rows[np.isfinite(upper)], -rows[np.isfinite(lower)]])
    ends = np.concatenate([upper[np.isfinite(upper)], -lower[np.isfinite(lower)]])
    size = np.maximum(np.linalg.norm(sides, axis=1), 1e-300)
    sides, ends = sides / size[:, None], ends / size
    gap = ends - sides @ free
    if np.all(gap >= -1e-12):
        return np.asarray(free)
    # least distance programming: min |t| with G t >= b for t = L' (s - free)
    root = np.linalg.cholesky(h)
    over = -np.linalg.solve(root, sides.T).T
    e = np.vstack([over.T, -gap[None]])
    f = np.zeros(len(e))
    f[-1] = 1.0
    try:
        multipliers, left = nnls(e, f, maxiter=30 * e.shape[1])
    except RuntimeError:
        return None
    rest = e @ multipliers - f
    if left <= 1e-10 or abs(rest[-1]) < 1e-300:
        return None
    # the active rows again, exactly: t is rounded in proportion to its length
    on = sides[multipliers > 0]
    push = np.linalg.lstsq(on @ cho_solve(factor, on.T), gap[multipliers > 0], rcond=None)[0]
    return np.asarray(free + cho_solve(factor, on.T @ push))
