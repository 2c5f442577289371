"""Convex quadratic programs with few unknowns and many rows, hard or penalised, by active sets that start warm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmm, dtrsm
from scipy.linalg.lapack import dpotrf, dpotrs

Array = NDArray[np.float64]
Active = NDArray[np.int8]
"""State of a QP's rows: 1 on the upper bound, -1 on the lower, 2 and -2 beyond a penalised bound, 0 inactive."""

PRIMAL_TOLERANCE = 1e-10
"""Violation above which a row becomes active: the distance of the unknowns from its bound, in their scale."""
LARGE, LOOSEST = 1e3, 1e-8
"""Multiplier above which the tolerance grows in proportion, as rounding does, and the largest tolerance."""
LEAST_SHARE = 1e-4
"""Smallest share of the tolerance, for rows that hardly depend on the unknowns."""
ROUNDING = 1e-15
"""Rounding error of a row's value, over its bounds."""
CHANGES = 25
"""Most changes of the whole active set; a warm start needs 1 to 10."""
PATIENCE = 3
"""Consecutive changes of the whole set that may increase the number of wrong rows. After them the row-by-row method
continues from the best set."""
DEPENDENT = 1e-12
"""Pivot of a row, over its size in the dual, below which it is linearly dependent on the others."""


@dataclass(frozen=True)
class RowQP:
    """``min 1/2 s'hs + g's + penalties`` with the rows ``v = (s, a s)``, ``lower <= v <= upper``.

    A violation ``e`` of a row costs ``linear e + e^2 / (2 give)``. Hard rows, and they alone, have an infinite
    ``linear`` and a ``give`` of zero. ``h`` ``(n, n)`` is symmetric positive definite, ``a`` any number of rows; the
    unknowns come first in all other arrays ``(R,)``.
    """

    h: Array
    g: Array
    a: Array
    lower: Array
    upper: Array
    linear: Array
    give: Array

    def values(self, s: Array) -> Array:
        """Values ``(R,)`` of all rows."""
        return np.concatenate([s, self.a @ s]) if len(self.a) else s.copy()

    def excess(self, values: Array) -> Array:
        """Violation of the bounds by values ``(R,)``; negative inside."""
        return np.maximum(values - self.upper, self.lower - values)

    def tolerance(self, multipliers: Array) -> Array:
        """Violations ``(R,)`` above which rows become active.

        A row that hardly depends on the unknowns needs a smaller one: its violation over its norm is the distance.
        """
        within = min(
            max(1.0, float(np.abs(multipliers).max(initial=0.0)) / LARGE) * PRIMAL_TOLERANCE, LOOSEST
        )
        return within * self._shares + self._rounding

    @cached_property
    def _shares(self) -> Array:
        norms = np.sqrt(np.einsum("ij,ij->i", self.a, self.a))
        return np.concatenate([np.ones(self.g.size), np.clip(norms, LEAST_SHARE, 1.0)])

    @cached_property
    def _rounding(self) -> Array:
        bounds = np.abs([self.lower, self.upper])
        bounds[np.isinf(bounds)] = 0.0
        return np.asarray(ROUNDING * bounds.max(axis=0))

    @np.errstate(invalid="ignore")  # values that are not finite show in the result
    def residuals(self, s: Array, multipliers: Array) -> tuple[float, float, float]:
        """KKT residuals of unknowns and multipliers ``(R,)``: stationarity, penalties, violation of hard rows.

        A multiplier must be a slope of its row's penalty: to push the row's value by it and to step back under the
        penalty (a proximal point) changes nothing only there.
        """
        value, n = self.values(s), s.size
        slope = self.h @ s + self.g + multipliers[:n]
        if len(self.a):
            slope += multipliers[n:] @ self.a
        pushed = value + multipliers
        inside = np.minimum(np.maximum(pushed, self.lower), self.upper)
        wrong = value - inside
        if len(self.a):
            out = pushed - inside
            beyond = np.maximum(np.abs(out) - self.linear, 0.0) * (self.give / (1.0 + self.give))
            wrong -= np.copysign(beyond, out)
        outside = self.excess(value)[self.give == 0].max(initial=0.0)
        return float(np.abs(slope).max()), float(np.abs(wrong).max()), float(outside)


class Found(NamedTuple):
    """Unknowns, multipliers of all rows, and the active rows."""

    s: Array
    multipliers: Array
    active: Active


class _On(NamedTuple):
    """Active rows: indices, sides, their rows in the dual, its Cholesky factor and diagonal, multipliers."""

    rows: NDArray[np.int64]
    side: Active
    chosen: Array
    pivots: Array
    own: Array
    push: Array


class ActiveSet:
    """The method for one QP: ``ActiveSet(qp).solve(active)``.

    An inactive row only costs its check. :meth:`all_at_once` changes the whole set until its solution keeps all other
    rows and has multipliers of the right sign: the semismooth Newton method on the KKT conditions, fast if the set is
    nearly right. A penalised row needs no slack: it is inactive, or kept with a multiplier of at most its linear
    penalty, or violated in proportion to the multiplier's excess over that penalty. If this fails (linearly dependent
    rows, a cycle), :meth:`one_at_a_time` ascends the dual, which always terminates: the multiplier of the worst row
    grows until the row is kept, while rows whose multipliers reach zero or their penalty leave the set or are relaxed.

    Args:
        qp: The problem.
        later: For every row the row of the same value one period later, or itself: of several consecutive newly
            violated rows only the worst one joins the set at once. Default: all join.
        earlier: Likewise.

    Source: Hintermüller, Ito, Kunisch, *The primal-dual active set strategy as a semismooth Newton method*, SIAM J.
    Optim. 13 (2002); Goldfarb and Idnani, *A numerically stable dual method for solving strictly convex quadratic
    programs*, Math. Program. 27 (1983).

    Example:
        >>> one, none = np.ones(1), np.zeros(1)
        >>> qp = RowQP(np.eye(1), np.array([-3.0]), np.zeros((0, 1)), -one, one, np.array([np.inf]), none)
        >>> found = ActiveSet(qp).solve()
        >>> found.s, found.multipliers, found.active
        (array([1.]), array([2.]), array([1], dtype=int8))
    """

    def __init__(
        self, qp: RowQP, later: NDArray[np.int64] | None = None, earlier: NDArray[np.int64] | None = None
    ) -> None:
        own = np.arange(qp.lower.size)
        self._later, self._earlier = own if later is None else later, own if earlier is None else earlier
        self._qp = qp
        self._factor, bad = dpotrf(qp.h, 1)
        self._free = -dpotrs(self._factor, qp.g, 1)[0]
        self._finite = not bad and bool(np.isfinite(self._free).all())
        self._at_free = qp.values(self._free)
        self._n = qp.g.size
        self._nearest: Active = np.zeros(qp.lower.size, dtype=np.int8)
        self._wrong = qp.lower.size + 1

    def solve(self, active: Active | None = None) -> Found:
        """The solution, whose residuals must be checked; ``active`` are rows for a warm start."""
        none = np.zeros(self._qp.lower.size, dtype=np.int8)
        if not self._finite:
            return Found(np.full(self._n, np.nan), np.full(none.size, np.nan), none)
        start = none if active is None or active.size != none.size else active
        if not start.any():
            unpushed = np.zeros(none.size)
            if (self._qp.excess(self._at_free) <= self._qp.tolerance(unpushed)).all():
                return Found(self._free, unpushed, none)
        return (
            self.all_at_once(start)
            or (self.all_at_once(none) if start.any() else None)  # after a jump the last set is useless
            or self.one_at_a_time(self._nearest)
            or self.one_at_a_time(none)
            or Found(self._free, np.zeros(none.size), none)
        )

    def all_at_once(self, active: Active) -> Found | None:
        """The solution by changes of the whole set; None if they do not converge."""
        qp, seen, least, left = self._qp, set(), active.size + 1, PATIENCE
        for _ in range(CHANGES):
            on = self._on(active)
            if on is None:
                return None
            s = self._unknowns(on)
            pushed = qp.values(s)
            pushed[on.rows] += on.own * on.push
            out = pushed - np.minimum(np.maximum(pushed, qp.lower), qp.upper)
            after, excess = np.sign(out).astype(np.int8), np.abs(out)
            mine = np.where(on.push * on.side > 0, np.sign(on.side), after[on.rows])
            mine[np.abs(on.push) > qp.linear[on.rows]] *= 2
            excess[on.rows] = (
                0.0  # of the others, rows join whose violation exceeds that of their neighbours in time
            )
            near = np.maximum(excess[self._later], excess[self._earlier])
            after *= excess >= np.maximum(near, qp.tolerance(on.push))
            after[on.rows] = mine
            wrong = int(np.count_nonzero(after != active))
            if not wrong:
                return self._answer(active, on, s)
            left = PATIENCE if wrong < least else left - 1
            least = min(least, wrong)
            if wrong < self._wrong:
                self._wrong, self._nearest = wrong, active
            key = after.tobytes()
            if left < 0 or key in seen:
                return None
            seen.add(key)
            active = after
        return None

    def one_at_a_time(self, active: Active) -> Found | None:
        """The solution by dual ascent; None if rounding prevents it."""
        start = self._dual_feasible(active)
        if start is None:
            return None
        qp, size = self._qp, np.sqrt(np.maximum(np.sum(self._reduced**2, axis=1), 1e-300))
        multipliers, active = start.multipliers.copy(), start.active.copy()
        row, sign = -1, 0.0
        # ten steps per row at most
        for _ in range(10 * qp.lower.size):
            acts = np.flatnonzero(multipliers)
            s = self._free - (multipliers[acts] @ self._reduced[acts]) @ self._inverse
            values = qp.values(s)
            excess = qp.excess(values)
            if row < 0:
                joins = (active == 0) & (excess > qp.tolerance(multipliers))
                worst = np.where(joins, excess / size, 0.0)
                row = int(np.argmax(worst))
                if worst[row] <= 0:
                    return self._refined(Found(s, multipliers, active))
                sign = 1.0 if values[row] > qp.upper[row] else -1.0
            on = self._on(active)
            if on is None:
                return None
            own = self._reduced[row]
            change = -sign * dpotrs(on.pivots, on.chosen @ own, 1)[0] if on.rows.size else np.zeros(0)
            rate = float(own @ own + sign * change @ (on.chosen @ own))
            rate = rate if rate > DEPENDENT * size[row] ** 2 else 0.0
            given = abs(multipliers[row]) - qp.linear[row]
            left = float(excess[row])
            if given >= 0:
                rate, left = rate + qp.give[row], left - given * qp.give[row]
            length = left / rate if rate > 0 else np.inf
            event, to = -1, 0
            if -given < length and given < 0:
                length, event = -given, row
            if on.rows.size:
                grows, now, beyond = (
                    change * np.sign(on.side),
                    np.abs(multipliers[on.rows]),
                    np.abs(on.side) > 1,
                )
                goal = np.where(grows > 0, qp.linear[on.rows], np.where(beyond, qp.linear[on.rows], 0.0))
                meets = (grows < 0) | ((grows > 0) & ~beyond & np.isfinite(goal))
                lengths = np.full(now.size, np.inf)
                lengths[meets] = np.maximum((goal - now)[meets] / grows[meets], 0.0)
                i = int(np.argmin(lengths))
                if lengths[i] < length:
                    length, event = float(lengths[i]), int(on.rows[i])
                    to = 1 if beyond[i] else 2 if grows[i] > 0 else 0
            if not np.isfinite(length):
                return Found(s, multipliers, active)  # hard rows that contradict each other
            multipliers[on.rows] += length * change
            multipliers[row] += sign * length
            if event < 0:
                active[row], row = int(sign) * (1 if given < 0 else 2), -1
            elif event == row:
                multipliers[row] = sign * qp.linear[row]
            else:
                side = np.sign(active[event])
                multipliers[event] = side * qp.linear[event] if to else 0.0
                active[event] = side * to
        return None

    def _dual_feasible(self, active: Active) -> Found | None:
        """The solution on those rows of a set with multipliers of the right sign; it may violate other rows."""
        for _ in range(CHANGES):
            on = self._on(active)
            if on is None:
                return None
            if not on.rows.size:
                return self._answer(active, on, self._unknowns(on))
            right = (on.push > 0) == (on.side > 0)
            beyond = np.where(np.abs(on.push) > self._qp.linear[on.rows], 2, 1)
            after = np.where(right, np.sign(on.side) * beyond, 0)
            if np.array_equal(after, on.side):
                return self._answer(active, on, self._unknowns(on))
            active = active.copy()
            active[on.rows] = after
        return None

    def _on(self, active: Active) -> _On | None:
        """Multipliers if the active rows are kept and all others ignored; None if they are linearly dependent."""
        rows, qp = active.nonzero()[0], self._qp
        side = active[rows]
        if rows.size > self._n and np.count_nonzero(np.abs(side) == 1) > self._n:
            return None
        if not rows.size:
            none = np.zeros(0)
            return _On(rows, side, np.zeros((0, self._n)), np.zeros((0, 0)), none, none)
        chosen = (self._inverse.T if rows[-1] < self._n else self._reduced)[rows]
        dual = chosen @ chosen.T
        own = dual.diagonal().copy()
        off = self._at_free[rows] - np.where(side > 0, qp.upper[rows], qp.lower[rows])
        beyond = (np.abs(side) > 1).nonzero()[0]
        if beyond.size:
            place = rows[beyond]
            dual[beyond, beyond] += qp.give[place]
            off[beyond] += np.sign(side[beyond]) * qp.linear[place] * qp.give[place]
        least = DEPENDENT * dual.diagonal()
        pivots, bad = dpotrf(dual.T, 1, 0, 1)
        if bad or not (pivots.diagonal() ** 2 > least).all():
            return None
        return _On(rows, side, chosen, pivots, own, dpotrs(pivots, off, 1)[0])

    @cached_property
    def _inverse(self) -> Array:
        """Inverse of the Hessian's Cholesky factor; only needed with active rows."""
        return np.asarray(dtrsm(1.0, self._factor, np.eye(self._n), 0, 1, 0, 0, 1))

    @cached_property
    def _reduced(self) -> Array:
        """All rows in the dual ``(R, n)``; not needed if only bounds of the unknowns are active."""
        return np.vstack([self._inverse.T, dtrmm(1.0, self._inverse, self._qp.a.T, 0, 1).T])

    def _refined(self, found: Found) -> Found:
        """The solution, refined after many steps with rounding; multipliers of relaxed rows are large."""
        qp, multipliers = self._qp, found.multipliers.copy()
        on = self._on(found.active)
        if on is None or not on.rows.size:
            return found
        rows, side = on.rows, np.sign(on.side)
        bound = np.where(side > 0, qp.upper[rows], qp.lower[rows])
        linear = np.where(np.abs(on.side) > 1, qp.linear[rows], 0.0)
        s = found.s
        for _ in range(2):
            slack = np.where(np.abs(on.side) > 1, multipliers[rows] - side * linear, 0.0) * qp.give[rows]
            change = dpotrs(on.pivots, qp.values(s)[rows] - bound - slack, 1)[0]
            multipliers[rows] += change
            s = s - (change @ on.chosen) @ self._inverse
        return Found(s, multipliers, found.active)

    def _unknowns(self, on: _On) -> Array:
        return self._free - (on.push @ on.chosen) @ self._inverse if on.rows.size else self._free

    def _answer(self, active: Active, on: _On, s: Array) -> Found:
        multipliers = np.zeros(active.size)
        multipliers[on.rows] = on.push
        return Found(s, multipliers, active)
