"""Target calculator: the steady state at which the outputs are a set-point, or as near to it as the limits allow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel, output_with_jacobian
from hybrid_mpc.model.riccati import hidden_fixed_point, vector

Array = NDArray[np.float64]
SETTLING = 6
"""Steps of Newton's method at most by which a hidden state is brought to rest."""
ITERATIONS = 60
STEADY = 1e-9
"""Largest step, in scales of the unknowns, at which Newton's method has converged."""
REACHED = 1e-6
"""Largest deviation of an output that counts as reached, in tolerated deviations ``1 / sqrt(q_y)``."""
RANK = 1e-9
"""Singular values below this share of the largest count as zero."""
HEED = 0.2
"""Rest of a state counts as much as this share of it in a hidden state: of a network that rests hardly, or anywhere
(its gates are shut), the states' equations are to hold first."""
FREE = 1e-6
"""Weight of the inputs' distance from the operating point along directions that the outputs do not see."""
ASIDE = 0.1
"""Distance of further starts from the operating point's input, in scales of the input. A network that has learned how a
machine sticks feels no input between the two on which the machine breaks loose, and Newton's method stops there."""
STALLED, WITHIN = 0.9, 5
"""A descent is given up whose lack of a steady state has not fallen to this share within so many steps, which those
that arrive do many times over."""
STILL = 1e-6
"""Largest lack of a steady state, in the states' scales, that is rounding."""
NEAR = 1e-5
"""Largest step, in scales of the unknowns, that rounding may keep from helping."""
FLAT = 0.01
"""Share of the outputs' slopes at the operating point below which they do not answer to the inputs as they do there: a
speed whose size alone is measured, at a standstill and beyond; the top of a curve. A descent does not leave such a
point."""
RUN = 5000
"""Periods of the model's own run from the operating point at most."""
NEARER = 1e-3
"""Largest lack of a steady state, in the states' scales, at which a run has nearly come to rest."""
PARTS = (2, 4, 8)
"""Parts of the way to a set-point to which no start leads at once."""
FOLLOWED = 8
"""Parts of the way from the operating point along which the first set-point is met."""
LEAST_SHARE = 1e-3
"""Smallest share of a step that is tried."""


@dataclass(frozen=True)
class Steady:
    """A steady state.

    Args:
        x: States ``(n_x,)``.
        h: Hidden states ``(n_h,)``.
        u: Inputs ``(n_u,)`` that hold it.
        y: Outputs ``(n_y,)`` there, with what unmeasured disturbances add.
        reached: Whether the outputs that the problem weighs are the set-point's.
        steady: Whether it is a steady state of the model; False: none was found, this is the last iterate.
    """

    x: Array
    h: Array
    u: Array
    y: Array
    reached: bool
    steady: bool

    @property
    def unknowns(self) -> Array:
        """``(x, h, u)`` in one vector."""
        return np.concatenate([self.x, self.h, self.u])


class _Point(NamedTuple):
    """A point ``v = (x, h, u)``.

    Args:
        v: ``(n_z + n_u,)``.
        rest: ``F(z, u) - z`` ``(n_z,)``.
        rest_by_v: Its Jacobian ``(n_z, n_z + n_u)``.
        y: Outputs ``(n_y,)``.
        y_by_v: Their Jacobian ``(n_y, n_z + n_u)``.
        lacks: Size of ``rest`` in the scales of the states.
        merit: What a descent lowers: ``lacks``, and the outputs' weighted error, less.
    """

    v: Array
    rest: Array
    rest_by_v: Array
    y: Array
    y_by_v: Array
    lacks: float
    merit: float


class Targets:
    """Steady states for set-points of outputs: ``y_ref`` to ``(x_ref, u_ref)``.

    It solves ``min |y - y_ref|^2`` in the weights ``q_y`` over steady states ``z = F(z, u, w, d)`` with inputs, states
    and outputs within the problem's bounds and the signals' ranges. Of several inputs that do equally well the one
    nearest to the operating point's is taken, in the inputs' scales. A set-point that cannot be reached gives the
    nearest that can, and ``reached`` is False. Where no steady state keeps the bounds of states and outputs, they are
    left out.

    It is Gauss-Newton's method, the steady states eliminated by their null space; bounds are an active set. It
    begins where it is told to. Where there is no such start, or whole steps do not lead from it to a steady state,
    the set-point is met by way of ``FOLLOWED`` others between the operating point's outputs and it: of several
    steady states the one on the operating point's branch is taken, which rounding does not change; shortened steps
    over a long way may end at any of them. Then it begins at the operating point, beside it, and where the model's
    own run from there ends; at the operating point, too, where it misses a set-point because outputs do not answer
    to the inputs where it began (``FLAT``). Where all of that leads to no steady state, set-points on the way from
    the start are met first. All counts in the :class:`~hybrid_mpc.control.sizes.Sizes` of the problem, so that no
    answer depends on units. No method changes the object's answers; not for several threads at once.

    Args:
        model: The model, with its disturbance model.
        ocp: A problem with weights on outputs.
        sizes: Sizes of the signals. Default: made of the two.

    Raises:
        InputError: If the problem has no weights on outputs, or they are another number than the model's; if the size
            of a state is not known.

    Source: Rawlings, Mayne, Diehl, *Model Predictive Control*, 2017, section 1.5.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("u", "m/s"),), level, x=x, u=u, y=x,
        ...     x_next=x + 0.1 * (u - x), xdot=0.1 * (u - x))
        >>> targets = Targets(tank, OCP(10, [0.0], [0.1], [0.0], [0.0], [2.0], q_y=[1.0]))
        >>> steady = targets.at([1.5])
        >>> steady.u.round(6), targets.at([3.0]).y.round(6), targets.at([3.0]).reached
        (array([1.5]), array([2.]), False)
    """

    def __init__(self, model: HybridModel, ocp: OCP, sizes: Sizes | None = None) -> None:
        if ocp.q_y.size != model.n_y or not ocp.n_y:
            raise InputError(
                f"targets: the problem has q_y = {ocp.q_y}, model {model.name} {model.n_y} outputs; give a weight each"
            )
        assert model.with_jacobian is not None
        self.model, self._ocp = model, ocp
        self._step, self._output = map(BufferedFunction, (model.with_jacobian, output_with_jacobian(model)))
        self._step.inputs[4][:] = model.p
        self._n_z = model.n_x + model.n_h
        self._on_u, self._on_x, self._on_y = model.disturbed
        self._tracked = np.flatnonzero(ocp.q_y > 0)
        self._root = np.sqrt(ocp.q_y[self._tracked])
        sizes = Sizes(model, ocp) if sizes is None else sizes
        self.scale: Array = np.concatenate([sizes.states, sizes.hidden, ocp.input_scale])
        """What 1 means of the unknowns ``(x, h, u)`` ``(n_z + n_u,)``."""
        self.heed: Array = np.concatenate([np.full(model.n_x, HEED), np.ones(model.n_h)])
        """Shares ``(n_z,)`` of these that count as much in the equations of rest."""
        ranges = [np.array([(s.lower, s.upper) for s in group]).T for group in (model.states, model.outputs)]
        x_min, x_max = ocp.state_range
        y_min, y_max = ocp.output_range(model.n_y)
        self.x_range: tuple[Array, Array] = np.maximum(x_min, ranges[0][0]), np.minimum(x_max, ranges[0][1])
        """Lower and upper bounds of the states ``(n_x,)``."""
        self.y_range: tuple[Array, Array] = np.maximum(y_min, ranges[1][0]), np.minimum(y_max, ranges[1][1])
        """Likewise of the outputs ``(n_y,)``."""

    def at(
        self,
        y_ref: ArrayLike,
        d: ArrayLike | None = None,
        w: ArrayLike | None = None,
        start: Steady | None = None,
        *,
        wide: bool = True,
    ) -> Steady:
        """The steady state for a set-point.

        Args:
            y_ref: Outputs ``(n_y,)``; those without a weight do not matter and may be NaN.
            d: Unmeasured disturbances ``(n_d,)``. Default: zero.
            w: Measured disturbances ``(n_w,)``. Default: those of the operating point.
            start: Where to begin, e.g. the last answer. Default: the operating point.
            wide: Whether to begin elsewhere where a steady ``start`` does not lead to one. Default: yes.

        Raises:
            InputError: If a size does not fit, or a value that is needed is not finite.
        """
        m = self.model
        goal = np.asarray(y_ref, dtype=float).ravel()
        if goal.size != m.n_y or not np.all(np.isfinite(goal[self._tracked])):
            raise InputError(f"y_ref {goal} given; needed: {m.n_y} outputs, finite where q_y weighs them")
        d = np.zeros(m.n_d) if d is None else vector(d, m.n_d, "d")
        w = m.w if w is None else vector(w, m.n_w, "w")
        given = start if start is not None and start.steady else None
        if given is None:
            _ = self.run_out  # thousands of periods: at the first plan, not in some later period
        best: Steady | None = None
        own, follows = None if given is None else given.unknowns, wide
        for bounded in (True, False):
            beside = None if wide and bounded else int(wide or given is None)
            for first in self._firsts(own, beside):
                if follows and first is not own:
                    follows = False
                    if (followed := self._approached(None, goal, d, w, (FOLLOWED,))) is not None:
                        return followed
                    if best is not None and best.steady:
                        return best
                found, off, slopes, straight = self._descend(first, goal, d, w, bounded)
                if follows and not straight:
                    best = found
                    continue
                missed = found.steady and not found.reached and first is not self.beside[0]
                if missed and np.vdot(slopes, self.slopes) < self.flat:
                    other, nearer, *_ = self._descend(self.beside[0], goal, d, w, bounded)
                    found = other if other.steady and nearer < off else found
                if found.steady:
                    return found
                best = best or found
            if wide and bounded and (approached := self._approached(given, goal, d, w)) is not None:
                return approached
        assert best is not None
        return best

    def _firsts(self, given: Array | None, most: int | None) -> Iterator[Array]:
        """Points at which a descent begins: the given one and ``most`` of :attr:`beside`; with None all of these, and
        :attr:`run_out` last. What is not needed is not computed.
        """
        if given is not None:
            yield given
        if most != 0:
            yield from self.beside[:most]
        if most is None:
            yield from self.run_out

    def _approached(
        self, given: Steady | None, goal: Array, d: Array, w: Array, every: Sequence[int] = PARTS
    ) -> Steady | None:
        """The steady state to which descents lead along set-points between the outputs at a point near rest and the
        goal, a few, then more of them; None where they lead to none.
        """
        first = (self.run_out or self.beside)[0] if given is None else given.unknowns
        begun = self._outputs(first, d, w)[0]
        for parts in every:
            v = first
            for k in range(1, parts + 1):
                found = self._descend(v, begun + k / parts * (goal - begun), d, w, True)[0]
                if not found.steady:
                    break
                v = found.unknowns
            else:
                return found
        return None

    @cached_property
    def slopes(self) -> Array:
        """How the weighed outputs answer to the inputs ``(n, n_u)`` along steady states, at the operating point."""
        m = self.model
        at = self._point(self.beside[0], np.zeros(m.n_y), np.zeros(m.n_d), m.w)
        return self._newton(at, at.y, False)[1]

    @cached_property
    def flat(self) -> float:
        """Product with :attr:`slopes` of slopes that count as none."""
        return FLAT * float(np.vdot(self.slopes, self.slopes))

    @cached_property
    def beside(self) -> list[Array]:
        """The operating point, and points with one input more or less; hidden states, which may take a thousand steps
        to settle, at rest there.
        """
        m, ocp = self.model, self._ocp
        u0 = np.clip(m.u0, ocp.u_min, ocp.u_max)
        moves = np.diag(ASIDE * ocp.input_scale)
        inputs = [u0, *(np.clip(u0 + move, ocp.u_min, ocp.u_max) for row in moves for move in (row, -row))]
        return [np.concatenate([m.x0, hidden_fixed_point(m, m.x0, u), u]) for u in inputs]

    @cached_property
    @np.errstate(over="ignore", invalid="ignore")  # what overflows is no rest
    def run_out(self) -> list[Array]:
        """Where the model's own run from the operating point comes nearly to rest under its input; nothing where it
        does not, or nearly rests there from the first.

        The operating point may be far from rest in a state that no sensor shows. Hidden states that a descent moves
        there leave what a network ever reaches: their gates are shut, and they rest anywhere.
        """
        m, f, n_x, n_z = self.model, self._step, self.model.n_x, self._n_z
        v = self.beside[0].copy()

        def lacks() -> float:
            return self._point(v, np.zeros(m.n_y), np.zeros(m.n_d), m.w).lacks

        if lacks() < NEARER:
            return []
        for _ in range(RUN):
            f.inputs[0][:], f.inputs[1][:], f.inputs[2][:], f.inputs[3][:] = v[:n_x], v[n_x:n_z], v[n_z:], m.w
            f()
            after = np.concatenate(f.outputs[:2])
            moved, v[:n_z] = np.max(np.abs((after - v[:n_z]) / self.scale[:n_z])), after
            if not moved > STEADY:
                break
        return [v] if lacks() < NEARER else []

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is looked at and refused
    def _descend(
        self, v: Array, goal: Array, d: Array, w: Array, bounded: bool
    ) -> tuple[Steady, float, Array, bool]:
        """Gauss-Newton from ``v = (x, h, u)``; ``bounded``: within the bounds of states and outputs.

        Returns:
            The answer, its largest deviation, :attr:`slopes` there, and whether all steps were whole ones.
        """
        n_x, n_z = self.model.n_x, self._n_z
        at, done, straight = self._point(v, goal, d, w), False, True
        lacks = [at.lacks]
        for _ in range(ITERATIONS):
            step, slopes = self._newton(at, goal, bounded)
            if step is None or not np.all(np.isfinite(step)):
                break
            size = float(np.max(np.abs(step / self.scale)))
            if size <= STEADY:
                done = at.lacks <= STILL
                break
            share = 1.0
            after = self._settled(at.v + step, goal, d, w)
            while not after.merit < at.merit and share > LEAST_SHARE:
                share, straight = 0.5 * share, straight and size < NEAR
                after = self._settled(at.v + share * step, goal, d, w)
            if not after.merit < at.merit:
                done = size < NEAR and at.lacks <= STILL  # rounding is all that is left
                break
            at = after
            lacks.append(at.lacks)
            if len(lacks) > WITHIN and at.lacks > max(STALLED * lacks[-1 - WITHIN], STILL):
                break
        off = float(np.max(np.abs(self._root * (at.y - goal)[self._tracked]), initial=0.0))
        u = np.clip(at.v[n_z:], self._ocp.u_min, self._ocp.u_max)
        steady = Steady(at.v[:n_x], at.v[n_x:n_z], u, at.y, done and off <= REACHED, done)
        return steady, off, slopes, straight

    def _newton(self, at: _Point, goal: Array, bounded: bool) -> tuple[Array | None, Array]:
        """The step that the linearization asks for, None where its QP has no answer; and :attr:`slopes` there."""
        m, scale, v, y = self.model, self.scale, at.v, at.y
        n_z, n_x = self._n_z, m.n_x
        own = scale[:n_z] * self.heed  # rows have units, too: which rank they have must not depend on these
        rest, e, j = at.rest / own, at.rest_by_v * scale / own[:, None], at.y_by_v * scale
        if not (np.all(np.isfinite(e)) and np.all(np.isfinite(j)) and np.all(np.isfinite(rest))):
            return None, np.full((self._tracked.size, m.n_u), np.nan)
        left, sizes, right = np.linalg.svd(e)
        rank = int(np.sum(sizes > RANK * sizes[0]))
        onto = right[:rank].T @ ((left[:, :rank].T @ -rest) / sizes[:rank])  # to the steady states
        along = right[rank:].T  # and along them
        sees = self._root[:, None] * j[self._tracked] @ along
        error = self._root * (goal - y - j @ onto)[self._tracked]
        far = ((m.u0 - v[n_z:]) / scale[n_z:]) - onto[n_z:]
        _, s, vt = np.linalg.svd(sees)
        size = max(float(s[0]) if s.size else 0.0, 1e-150)
        unseen = vt[int(np.sum(s > RANK * size)) :]
        move = along[n_z:]
        inward = unseen.T @ unseen
        h = sees.T @ sees / size**2 + FREE * inward @ (move.T @ move) @ inward
        g = -(sees.T @ error / size**2 + FREE * inward @ (move.T @ far))
        h += 1e-12 * np.trace(h) * np.eye(len(h)) + 1e-14 * np.eye(len(h))
        values = [(v[n_z:], np.arange(n_z, v.size), self._ocp.u_min, self._ocp.u_max)]
        rows, lower, upper = [], [], []
        if bounded:
            values.append((v[:n_x], np.arange(n_x), *self.x_range))
            low, high = self.y_range
            k = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
            rows.append(j[k] @ along)
            lower.append(low[k] - y[k] - j[k] @ onto)
            upper.append(high[k] - y[k] - j[k] @ onto)
        for now, places, low, high in values:
            k = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
            rows.append(along[places[k]])
            lower.append((low - now)[k] / scale[places[k]] - onto[places[k]])
            upper.append((high - now)[k] / scale[places[k]] - onto[places[k]])
        eta = bounded_least_squares(h, g, np.vstack(rows), np.concatenate(lower), np.concatenate(upper))
        return None if eta is None else (onto + along @ eta) * scale, sees @ along[n_z:].T

    def _settled(self, v: Array, goal: Array, d: Array, w: Array) -> _Point:
        """The point with the hidden state at rest under its state and input, by Newton's method; as it is where that
        does not end there. What a network does between two rests says nothing of how far the machine is from one.
        """
        plain = at = self._point(v, goal, d, w)
        hidden = slice(self.model.n_x, self._n_z)
        for _ in range(SETTLING if self.model.n_h else 0):
            size = self.scale[hidden]
            off = at.rest[hidden] / size
            if not np.all(np.isfinite(at.rest)) or np.max(np.abs(off)) < STEADY:
                break
            try:
                move = size * np.linalg.solve(at.rest_by_v[hidden, hidden] * size / size[:, None], -off)
            except np.linalg.LinAlgError:
                return plain
            v = at.v.copy()
            v[hidden] += move
            at = self._point(v, goal, d, w)
        return at if at.merit < plain.merit else plain

    def _point(self, v: Array, goal: Array, d: Array, w: Array) -> _Point:
        """What descents need to know of ``v``; the merit is infinite where something is not finite."""
        rest, rest_by_v = self._rest(v, d, w)
        y, y_by_v = self._outputs(v, d, w)
        lacks = float(np.sum(np.abs(rest / self.scale[: self._n_z])))
        merit = 100.0 * lacks + float(np.linalg.norm(self._root * (y - goal)[self._tracked]))
        return _Point(v, rest, rest_by_v, y, y_by_v, lacks, merit if np.isfinite(merit) else np.inf)

    def _rest(self, v: Array, d: Array, w: Array) -> tuple[Array, Array]:
        """``F(z, u) - z`` and its Jacobian ``(n_z, n_z + n_u)``."""
        m, f, n_x, n_z = self.model, self._step, self.model.n_x, self._n_z
        f.inputs[0][:], f.inputs[1][:] = v[:n_x], v[n_x:n_z]
        f.inputs[2][:], f.inputs[3][:] = v[n_z:] + self._on_u @ d, w
        f()
        x, h, a, b = f.outputs
        moved = np.concatenate([x + self._on_x @ d, h]) - v[:n_z]
        return moved, np.hstack([a.reshape(n_z, n_z).T - np.eye(n_z), b.reshape(m.n_u, n_z).T])

    def _outputs(self, v: Array, d: Array, w: Array) -> tuple[Array, Array]:
        """Outputs and their Jacobian ``(n_y, n_z + n_u)``."""
        m, f, n_z = self.model, self._output, self._n_z
        f.inputs[0][:], f.inputs[1][:], f.inputs[2][:] = v[: m.n_x], v[n_z:] + self._on_u @ d, w
        f()
        y, by_x, by_u = f.outputs
        hidden = np.zeros((m.n_y, n_z - m.n_x))
        return y + self._on_y @ d, np.hstack(
            [by_x.reshape(m.n_x, m.n_y).T, hidden, by_u.reshape(m.n_u, m.n_y).T]
        )


def bounded_least_squares(h: Array, g: Array, rows: Array, lower: Array, upper: Array) -> Array | None:
    """``min 1/2 s'hs + g's`` with ``lower <= rows s <= upper``, for a few unknowns; None where there is none.

    The bounds' squared violation is the dual's non-negative least squares: exact, whatever the number of rows.
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
    t = -rest[:-1] / rest[-1]
    return np.asarray(free + np.linalg.solve(root.T, t))
