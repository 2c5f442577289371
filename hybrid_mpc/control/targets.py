"""Target calculator: the steady state with the outputs at a set-point, or as close to it as the limits allow."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.equilibrium import (
    CURVED,
    NEAR,
    PLAIN,
    REACHED,
    WAIT,
    Descent,
    Range,
    Steady,
    SteadySearch,
    StepEquations,
    hidden_fixed_point,
    run_to_rest,
)
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]


class Targets:
    """Steady states for set-points of outputs: ``y_ref`` to ``(x_ref, u_ref)``.

    It solves ``min |y - y_ref|^2``, weighted by ``q_y``, over steady states ``z = F(z, u, w, d)`` with inputs, states
    and outputs within the problem's bounds and the signals' ranges. Among equally good inputs, the input closest to
    that of the operating point is used, in the inputs' scales. For an unreachable set-point the closest reachable one
    is returned, with ``reached`` False. If no steady state keeps the bounds of states and outputs, these are ignored.

    The search is :class:`~hybrid_mpc.model.equilibrium.SteadySearch`, from the given start. Without a start, or if
    Newton's method does not contract from it, set-point and disturbances are continued from the operating point in
    steps for which Newton's method contracts: the result is on the operating point's branch, whatever the rounding. If
    that branch ends, the branch of the start is followed. If it ends, too, descents start at the operating point,
    beside it, and where the model's own run from there ends; of the steady states equally close to the set-point, the
    one closest to the operating point is returned. All quantities are scaled by the problem's
    :class:`~hybrid_mpc.control.sizes.Sizes`, so results do not depend on units. The object has no state, but reuses
    its buffers: it is not thread-safe.

    Args:
        model: The model, with its disturbance model.
        ocp: A problem with weights on outputs.
        sizes: Sizes of the signals. Default: from model and problem.

    Raises:
        InputError: If the problem has no weights on outputs, or another number of them than the model has outputs; if
            the size of a state is unknown.

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
                f"targets: q_y must have {model.n_y} weights, one per output of model {model.name}, got {ocp.q_y}"
                " [HM-CONTROL-054]"
            )
        self.model, self._ocp = model, ocp
        n_x, n_z = model.n_x, model.n_x + model.n_h
        self._tracked = np.flatnonzero(ocp.q_y > 0)
        sizes = Sizes(model, ocp) if sizes is None else sizes
        self.scale: Array = np.concatenate([sizes.states, sizes.hidden, ocp.input_scale])
        """Scales of the unknowns ``(x, h, u)`` ``(n_z + n_u,)``."""
        # near a network that hardly settles, or settles anywhere (its gates are shut), the states' equations come first
        self.heed: Array = np.concatenate([np.full(n_x, 0.2), np.ones(model.n_h)])
        """Factors ``(n_z,)`` on the scales of the steady-state equations."""
        ranges = [np.array([(s.lower, s.upper) for s in group]).T for group in (model.states, model.outputs)]
        x_min, x_max = ocp.state_range
        y_min, y_max = ocp.output_range(model.n_y)
        self.x_range: tuple[Array, Array] = np.maximum(x_min, ranges[0][0]), np.minimum(x_max, ranges[0][1])
        """Lower and upper bounds of the states ``(n_x,)``."""
        self.y_range: tuple[Array, Array] = np.maximum(y_min, ranges[1][0]), np.minimum(y_max, ranges[1][1])
        """Likewise of the outputs ``(n_y,)``."""
        open_ = np.full(model.n_h, np.inf)
        self._equations = StepEquations(model)
        self._search = SteadySearch(
            self._equations, self.scale, self.scale[:n_z], np.sqrt(ocp.q_y),
            np.concatenate([model.x0, np.zeros(model.n_h), model.u0]), np.arange(n_z, n_z + model.n_u),
            Range(
                np.concatenate([self.x_range[0], -open_, ocp.u_min]),
                np.concatenate([self.x_range[1], open_, ocp.u_max]),
                np.arange(n_z + model.n_u) >= n_z, *self.y_range,
            ),
            heed=self.heed, hidden=slice(n_x, n_z),
        )  # fmt: skip

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
            y_ref: Outputs ``(n_y,)``; those without a weight are ignored and may be NaN.
            d: Unmeasured disturbances ``(n_d,)``. Default: zero.
            w: Measured disturbances ``(n_w,)``. Default: those of the operating point.
            start: Start of the search, e.g. the last result. Default: the operating point.
            wide: Whether to search from other points if a steady ``start`` does not lead to a solution. Default: yes.

        Raises:
            InputError: If a size does not fit, or a required value is not finite.
        """
        m, search = self.model, self._search
        goal = np.asarray(y_ref, dtype=float).ravel()
        if goal.size != m.n_y or not np.all(np.isfinite(goal[self._tracked])):
            raise InputError(
                f"y_ref: must have {m.n_y} outputs, finite for weighted outputs, got {goal} [HM-CONTROL-055]"
            )
        d = np.zeros(m.n_d) if d is None else vector(d, m.n_d, "d")
        w = m.w if w is None else vector(w, m.n_w, "w")
        given = start.unknowns if start is not None and start.steady else None
        # searched widely for this set-point not long ago: the last result is followed
        tracked = self._tracked
        again = start is not None and np.array_equal(start.goal[tracked], goal[tracked])
        age = min(start.age + 1, WAIT) if start is not None and again else WAIT
        recent = age < WAIT
        wide = wide and (given is not None or not recent)
        if given is None:
            _ = self.begun  # takes thousands of periods: computed with the first plan, not in a later period
        self._equations.d, self._equations.w = d, w
        first = self.beside[0] if given is None else given
        tried: list[Descent] = []
        if given is not None or not wide:
            # an input within its limits beyond reach of the set-point: there an output turns
            turns = start is not None and start.steady and not start.reached
            if turns and start is not None:
                near = NEAR * self.scale[m.n_x + m.n_h :]
                turns = bool(np.any((start.u > self._ocp.u_min + near) & (start.u < self._ocp.u_max - near)))
            found = search.descend(first, goal, mode=CURVED if turns else PLAIN)
            if self._lost(found) and given is not None:
                other = search.descend(self.beside[0], goal)
                found = other if other.steady and other.off < found.off else found
            if found.sure or (found.steady and (recent or not wide)):
                return self._steady(found, goal, age)
            tried.append(found)
        if wide:
            age = 0
            for begun in (None,) if given is None else (None, given):
                led = self._followed(goal, d, w, begun)
                if led is not None and not self._lost(led):
                    return self._steady(led, goal, age)
                tried += [] if led is None else [led]
            tried += [search.descend(v, goal) for v in (*self.beside, *self.run_out)]
            if (best := search.best(tried)) is not None:
                return self._steady(best, goal, age)
            if (led := self._followed(goal, d, w, given, sure=False)) is not None:
                return self._steady(led, goal, age)
        starts = [first, *([self.beside[0]] if wide and given is not None else [])]
        free = [search.descend(v, goal, bounded=False) for v in starts]
        return self._steady(next((f for f in free if f.steady), tried[0]), goal, age)

    def _followed(
        self, goal: Array, d: Array, w: Array, given: Array | None = None, *, sure: bool = True
    ) -> Descent | None:
        """The end of a continuation of the set-point: from ``given`` at the present disturbances, or from the operating
        point (or the end of its run), with the disturbances continued from none.
        """
        equations = self._equations
        if given is not None:
            return self._search.follow(given, equations.shown(given)[0], goal, sure=sure)

        def disturbed(share: float) -> None:
            equations.d, equations.w = share * d, self.model.w + share * (w - self.model.w)

        nearest, begun = self.begun
        found = self._search.follow(nearest, begun, goal, sure=sure, before=disturbed)
        equations.d, equations.w = d, w
        return found

    def _lost(self, found: Descent) -> bool:
        """Whether a descent missed its set-point at a point where outputs do not respond as at the operating point."""
        return found.steady and found.off > REACHED and bool(np.vdot(found.slopes, self.slopes) < self.flat)

    def _steady(self, found: Descent, goal: Array, age: int) -> Steady:
        n_x, n_z = self.model.n_x, self.model.n_x + self.model.n_h
        u = np.clip(found.v[n_z:], self._ocp.u_min, self._ocp.u_max)
        return Steady(found.v[:n_x], found.v[n_x:n_z], u, found.y, found.reached, found.steady, goal, age)

    def _undisturbed(self) -> None:
        self._equations.d, self._equations.w = np.zeros(self.model.n_d), self.model.w

    @cached_property
    def slopes(self) -> Array:
        """Derivatives of the weighed outputs by the inputs ``(n, n_u)`` along steady states, at the operating point."""
        kept = self._equations.d, self._equations.w
        self._undisturbed()
        slopes = self._search.slopes(self.beside[0])
        self._equations.d, self._equations.w = kept
        return slopes

    @cached_property
    def flat(self) -> float:
        """Product with :attr:`slopes` below which slopes count as zero."""
        # 1 % of the slopes at the operating point: the absolute value of a speed beyond standstill, the top of a curve
        return 0.01 * float(np.vdot(self.slopes, self.slopes))

    @cached_property
    def beside(self) -> list[Array]:
        """The operating point, and points with one input increased or decreased; hidden states, which may take a
        thousand steps to settle, are settled there.
        """
        m, ocp = self.model, self._ocp
        u0 = np.clip(m.u0, ocp.u_min, ocp.u_max)
        # a network that has learned sticking friction has zero slope between its breakaway inputs: start beside it
        moves = np.diag(0.1 * ocp.input_scale)
        inputs = [u0, *(np.clip(u0 + move, ocp.u_min, ocp.u_max) for row in moves for move in (row, -row))]
        return [np.concatenate([m.x0, hidden_fixed_point(m, m.x0, u), u]) for u in inputs]

    @cached_property
    def run_out(self) -> list[Array]:
        """The nearly steady end of the model's own run from the operating point; empty if the run does not settle, or
        the operating point is nearly steady already.

        The operating point may be far from steady in a state that no sensor measures. A descent there may move hidden
        states out of the range that a network ever reaches, where its gates are shut and it settles anywhere.
        """
        self._undisturbed()
        # the operating point is nearly steady
        if self._search.lacks(self.beside[0]) < 0.001:
            return []
        end = run_to_rest(self._search, self.beside[0])
        return [] if end is None else [end]

    @cached_property
    def begun(self) -> tuple[Array, Array]:
        """Start of continuations: the run's end, else the operating point, and the outputs ``(n_y,)`` there."""
        nearest = (self.run_out or self.beside)[0]
        self._undisturbed()
        return nearest, self._equations.shown(nearest)[0]
