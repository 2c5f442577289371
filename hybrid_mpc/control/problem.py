"""A model and a control problem prepared for a solver: free run, targets, cost, first plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP, Limits, input_plan
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.control.soft import GIVES_WAY, HIGHER, HardBound, fixed, output_bounds, state_bounds
from hybrid_mpc.control.targets import Targets
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.equilibrium import Steady
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.stages import free_run, stage_step

if TYPE_CHECKING:  # BLAS takes long to import
    from hybrid_mpc.model.active_set import Active

Array = NDArray[np.float64]
KEPT = 1e-7
"""Violation, over its size, up to which a hard bound counts as kept: the tolerance of the solvers."""
BEYOND = 10.0
"""Widths of a state's declared range that a plan may lie outside of it: further out the model's prediction diverges."""
USABLE = 0.5
"""Widths beyond its declared range in which a state of a free run may be: there the first linearization still holds."""
HALVINGS = 30
"""Halvings of the distance to an admissible input: the rest is 1e-9 of it."""
CONCAVE = 1e-12
"""Eigenvalue of a Hessian with the wrong sign, over the largest one, that counts as rounding."""
KNOTS = 8
"""Most set-points of one preview with a steady state of their own. For a reference that changes all the time, steady
states are interpolated between so many rows."""


class Status(Enum):
    """Result of a solve; the value is the message."""

    INITIAL = "a first plan, not optimised"
    SOLVED = "the QP was solved and its solution checked"
    NOT_FINITE = "the estimate, the reference, the model or the plan contains a value that is not finite"
    STOPPED = "the iterations ended before convergence; the plan satisfies the model and the limits"
    INFEASIBLE = "the solution violates an input bound or the limit of its change"
    INACCURATE = "the solution fails the KKT check"
    DIVERGED = (
        "the plan leaves the declared range of a state by more than ten times its width: the model diverges"
    )
    NLP_FAILED = "the nonlinear solver's solution violates the model or the limits"
    LATE = "the solve missed its deadline"

    @property
    def ok(self) -> bool:
        """True if the plan may be applied."""
        return self in (Status.SOLVED, Status.STOPPED)


@dataclass(frozen=True)
class Solution:
    """A plan from ``t_k`` on, and the result of its solve.

    Args:
        u: Inputs ``(N, n_u)``; ``u[0]`` is the one to hold now.
        x: Predicted states ``(N + 1, n_x)``.
        h: Predicted hidden states ``(N + 1, n_h)``.
        d: Unmeasured disturbances ``(n_d,)`` assumed by the prediction.
        cost: Cost of the plan (see :class:`~hybrid_mpc.control.ocp.OCP`); NaN if it was not solved.
        status: Result of the solve.
        kkt: KKT residual in the QP's scaling, relative to its gradient [-]; for ``ipopt`` that of the NLP.
        defect: Largest defect ``|x_{k+1} - f(x_k, h_k, u_k)|`` at the last linearization, over (x, h).
        timing: Durations [ms] by name (``prepare``, ``feedback``); for information only.
        excess: Largest violation of a soft bound along ``x`` and ``u`` [its unit].
        iterations: Linearizations (or iterations of the nonlinear solver) of this solve.
        curvature: Second derivatives of the stages by ``(x, u, h)`` ``(N, n, n)``, or by ``(x, u)`` if those of the
            hidden state hardly matter, with which ``sqp`` starts its next solve; None from other solvers.
        w: Measured disturbances ``(N, n_w)`` assumed by the prediction.
        steady: The steady state for the first row of an outputs' reference; None if references are the states'.
        active: Active rows of the QP, the warm start of the next solve. None: cold start.
        given_way: Hard bounds that the plan violates: largest violation by name. A state has its name in the model, an
            output is ``output`` and its name, an expression has its function's name. Of a decision also the violations
            of hard bounds on inputs before the input was moved (:meth:`InputBounds.keep`).
        multipliers: Multipliers ``(M,)`` of the bounds [cost per unit], by which the next real-time iteration weighs
            the curvature of the bounds. None: zero.
    """

    u: Array
    x: Array
    h: Array
    d: Array
    cost: float
    status: Status
    kkt: float
    defect: float
    timing: Mapping[str, float]
    excess: float = 0.0
    iterations: int = 1
    curvature: Array | None = None
    w: Array = field(default_factory=lambda: np.zeros((0, 0)))
    steady: Steady | None = None
    active: Active | None = None
    given_way: Mapping[str, float] = field(default_factory=dict)
    multipliers: Array | None = None

    @property
    def following(self) -> Array:
        """Inputs ``(N, n_u)`` of the plan one period later, with the last one repeated."""
        return np.vstack([self.u[1:], self.u[-1:]])

    def beginning_with(self, u: Array, given_way: Mapping[str, float] | None = None) -> Solution:
        """The plan with first input ``u`` ``(n_u,)``, and with further violations of hard bounds."""
        ways = dict(self.given_way)
        for name, value in (given_way or {}).items():
            ways[name] = max(value, ways.get(name, 0.0))
        return replace(self, u=np.vstack([u[None], self.u[1:]]), given_way=ways)

    def delayed(self, u_held: Array) -> Solution:
        """The plan one period earlier, with ``u_held`` ``(n_u,)`` in that period: a solve that shifts it has this plan.

        It loses its last period, which the shift appends again.
        """
        x, h, w = (np.vstack([v[:1], v[:-1]]) for v in (self.x, self.h, self.w))
        c = self.curvature
        c = None if c is None else np.concatenate([c[:1], c[:-1]])
        return replace(
            self, u=np.vstack([u_held[None], self.u[:-1]]), x=x, h=h, w=w, curvature=c, active=None, multipliers=None
        )  # fmt: skip


class UnreachedBound(InputError):
    """No input of the plan affects a value with a hard bound: the horizon is too short, or no input ever affects it."""


class BoundRows:
    """The M soft and hard bounds of a problem along a trajectory, one row per bound and period.

    Bounds on states hold for ``x_1 .. x_N`` (``x_0`` is given), those on outputs and expressions for ``(x_0, u_0) ..
    (x_{N-1}, u_{N-1})``. Outputs and expressions of ``w`` or ``p`` also depend on ``e`` ``(N, n_d + n_w + n_p)``: the
    unmeasured and measured disturbances and the parameters of each period, by default zero.

    Hard bounds are rows with exact penalties, which grow by :data:`~hybrid_mpc.control.soft.HIGHER` from one priority
    to the next. Rows that no input reaches have no bounds.
    """

    stage: NDArray[np.int64]
    """Index ``(M,)`` of the state in the trajectory that a row bounds."""
    later: NDArray[np.int64]
    """Index ``(M,)`` of the row of the same value one period later; the last rows refer to themselves."""
    hard: NDArray[np.bool_]
    """Which rows ``(M,)`` are hard bounds."""
    names: tuple[str, ...]
    """Names of the rows ``(M,)``."""
    parametric: bool
    """Whether a bounded value depends on ``e``."""
    curved: bool
    """Whether a bounded value is not affine in state and input."""
    convex: NDArray[np.bool_]
    """Which rows ``(M,)`` are curved, quadratic and bounded on their convex side, as a circle that may not be left."""
    on_inputs: InputBounds
    """The hard bounds on expressions of the inputs alone."""

    def __init__(self, ocp: OCP, model: HybridModel, sizes: Sizes) -> None:
        n = ocp.horizon
        self._n_x, self._n_u, self._horizon = ocp.n_x, ocp.n_u, n
        self._n_e = ocp.n_p + model.n_d + model.n_w
        groups = _bounded(ocp, model, sizes)
        self.parametric = any(
            f is not None and f.jac_sparsity(0, 2).nnz() > 0 for f in (g.function for g in groups)
        )
        self.functions: tuple[ca.Function, ...] = tuple(g.function for g in groups if g.function is not None)
        """The bounded expressions ``(x, u, e) -> column``, as the rows of :attr:`lower` after the states'."""
        self.states: NDArray[np.int64] = np.concatenate([g.states for g in groups]).astype(np.int64)
        """The bounded states, in the order of a period's rows of them; one may be there twice."""
        self._expressions = [BufferedFunction(_with_slopes(f).map(n)) for f in self.functions]
        self._curvature = [
            None if is_affine(f) else BufferedFunction(_curvature(f).map(n)) for f in self.functions
        ]
        self.curved = any(f is not None for f in self._curvature)
        self.on_inputs = InputBounds(groups, ocp)
        blocks = [[g for g in groups if g.function is None], *([g] for g in groups if g.function is not None)]
        each = [
            np.hstack([g.rows for g in block]) for block in blocks
        ]  # of a period; rows go period by period
        lower, upper, self.linear, self.quadratic, hard, at_end, size = np.hstack(
            [np.tile(rows, n) for rows in each]
        )
        counts = [rows.shape[1] for rows in each]
        self.hard = hard > 0
        bends = [
            bend is not None and _is_convex(g.function, *g.rows[:2])
            for bend, (g,) in zip(self._curvature, blocks[1:], strict=True)
        ]
        self.convex = np.repeat([False, *bends], n * np.array(counts))
        self.stage = np.concatenate(
            [np.repeat(np.arange(n) + (b == 0), count) for b, count in enumerate(counts)]
        )
        last = np.concatenate([np.full(n * count, n - (b > 0)) for b, count in enumerate(counts)])
        before = (at_end > 0) & (self.stage < last)
        lower, upper = np.where(before, -np.inf, lower), np.where(before, np.inf, upper)
        move = [np.repeat([count] * (n - 1) + [0], count) for count in counts]
        self.later = np.arange(self.stage.size) + np.concatenate(move)
        self.names = tuple(name for block in blocks for name in n * sum((g.names for g in block), ()))
        if ocp.hard:
            lower, upper = self._reached(model, lower, upper)
        self.lower, self.upper = lower, upper
        half = 0.5 * (upper - lower)
        # One-sided bounds have no range: the violation that costs as much quadratically as linearly, or the size.
        other = np.where(self.linear > 0, self.linear / self.quadratic, size)
        self.scale: Array = np.where(np.isfinite(half), half, other)
        kept = np.where(self.hard, KEPT * self.scale, 0.0)
        self._kept = lower - kept, upper + kept
        own = np.tile(self.states, n)
        self._rows = np.repeat(np.arange(1, n + 1), self.states.size) * ocp.n_x + own
        self._of_states = fixed(np.eye(ocp.n_x)[own]), fixed(np.zeros((own.size, ocp.n_u)))
        self._soft, self._firm = np.flatnonzero(~self.hard), np.flatnonzero(self.hard)

    def __len__(self) -> int:
        return int(self.stage.size)

    def _reached(self, model: HybridModel, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bounds without those of hard rows that no input reaches; UnreachedBound if a name has no other row."""
        n = self._horizon
        states, values = _first_stages(model, self.functions)
        out = self.hard & (
            self.stage < np.concatenate([np.tile(states[self.states], n), *(np.tile(v, n) for v in values)])
        )
        kept = {self.names[row] for row in np.flatnonzero(self.hard & ~out)}
        if lost := {self.names[row] for row in np.flatnonzero(out)} - kept:
            raise UnreachedBound(
                f"hard bound on {', '.join(sorted(lost))}: no input of the plan affects this value. Bound a value that "
                "inputs change within the horizon. [HM-CONTROL-030]"
            )
        return np.where(out, -np.inf, lower), np.where(out, np.inf, upper)

    def values(self, x: Array, u: Array, e: Array | None = None) -> Array:
        """Bounded values ``(M,)`` along states ``(N + 1, n_x)`` and inputs ``(N, n_u)``."""
        return self.linearize(x, u, e)[0]

    def linearize(self, x: Array, u: Array, e: Array | None = None) -> tuple[Array, Array, Array]:
        """Values ``(M,)`` and their derivatives by the row's state ``(M, n_x)`` and input ``(M, n_u)``."""
        n = self._horizon
        rows = [(x[1:, self.states].ravel(), *self._of_states)]
        for f in self._expressions:
            f.inputs[0][:], f.inputs[1][:] = x[:-1].ravel(), u.ravel()
            f.inputs[2][:] = 0.0 if e is None else e.ravel()
            f()
            value, by_x, by_u = (out.copy() for out in f.outputs)
            each = value.size // n
            by_x = by_x.reshape(n, self._n_x, each).transpose(0, 2, 1).reshape(value.size, self._n_x)
            by_u = by_u.reshape(n, self._n_u, each).transpose(0, 2, 1).reshape(value.size, self._n_u)
            rows.append((value, by_x, by_u))
        if len(rows) == 1:
            return rows[0]
        return (
            np.concatenate([r[0] for r in rows]),
            np.vstack([r[1] for r in rows]),
            np.vstack([r[2] for r in rows]),
        )

    def curvature(self, x: Array, u: Array, multipliers: Array, e: Array | None = None) -> Array:
        """Second derivatives by ``(x, u)`` of each period's values, weighted with ``multipliers`` ``(M,)`` and summed:
        ``(N, n_x + n_u, n_x + n_u)``.
        """
        n, size, first = self._horizon, self._n_x + self._n_u, self._rows.size
        total = np.zeros((n, size, size))
        for f, g in zip(self._curvature, self.functions, strict=True):
            own = multipliers[first : first + n * g.numel_out(0)]
            first += own.size
            if f is not None and own.any():
                f.inputs[0][:], f.inputs[1][:] = x[:-1].ravel(), u.ravel()
                f.inputs[2][:], f.inputs[3][:] = 0.0 if e is None else e.ravel(), own
                f()
                total += f.outputs[0].reshape(n, size, size)
        return total

    def by_period(self, rows: Array) -> Array:
        """Numbers of the rows ``(M,)`` of expressions, period by period: ``(N, E)``."""
        sizes = [self._horizon * f.numel_out(0) for f in self.functions]
        parts = np.split(rows[self._rows.size :], np.cumsum(sizes)[:-1])
        return np.hstack([part.reshape(self._horizon, -1) for part in parts])

    def by_row(self, periods: Array) -> Array:
        """Numbers of expressions ``(N, E)`` as those of all rows ``(M,)``; zero for those of states."""
        parts = np.split(periods, np.cumsum([f.numel_out(0) for f in self.functions])[:-1], axis=1)
        return np.concatenate([np.zeros(self._rows.size), *(part.ravel() for part in parts)])

    def condensed(
        self, x: Array, u: Array, from_u: Array, e: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Values ``(M,)`` and their derivatives by the row's state ``(M, n_x)`` and by all inputs ``(M, N n_u)``.

        ``from_u`` ``((N + 1) n_x, N n_u)`` are the derivatives of the states by the inputs.
        """
        if not len(self):
            return np.zeros(0), np.zeros((0, self._n_x)), np.zeros((0, u.size))
        value, by_x, by_u = self.linearize(x, u, e)
        own = self._rows.size
        slope = from_u[self._rows]
        if own < len(self):  # expressions
            states = from_u.reshape(len(x), self._n_x, u.size)[self.stage[own:]]
            slope = np.vstack([slope, (by_x[own:, None, :] @ states)[:, 0, :]])
            direct = np.flatnonzero(np.any(by_u != 0, axis=1))
            for j in range(self._n_u):
                slope[direct, self.stage[direct] * self._n_u + j] += by_u[direct, j]
        return value, by_x, slope

    def excess(self, values: Array) -> Array:
        """Violations ``(M,)``, zero where a bound is kept."""
        return np.asarray(np.maximum(0.0, np.maximum(values - self._kept[1], self._kept[0] - values)))

    def given_way(self, excess: Array) -> dict[str, float]:
        """Largest violation of each hard bound that violations ``(M,)`` have, by name."""
        found: dict[str, float] = {}
        for row in self._firm[excess[self._firm] > 0]:
            found[self.names[row]] = max(found.get(self.names[row], 0.0), float(excess[row]))
        return found

    def largest(self, excess: Array) -> float:
        """Largest violation of a soft bound among violations ``(M,)``."""
        return float(excess[self._soft].max(initial=0.0))

    def penalty(self, excess: Array) -> float:
        """Cost per second of violations ``(M,)``, summed."""
        return float(self.linear @ excess + self.quadratic @ excess**2)


@dataclass(frozen=True)
class _Bounded:
    """Bounded values in a period: states, or the values of a function ``(x, u, e)``.

    ``rows`` ``(7, n)`` are lower and upper bounds, linear and quadratic penalties, 1 for hard bounds, 1 for bounds only
    at the end, and sizes of the bounded values.
    """

    function: ca.Function | None
    states: NDArray[np.int64]
    rows: Array
    names: tuple[str, ...]


class InputBounds:
    """Hard bounds on expressions of inputs alone, which every applied input keeps.

    Args:
        groups: All bounds of the problem.
        ocp: The problem.
    """

    def __init__(self, groups: Sequence[_Bounded], ocp: OCP) -> None:
        self._ocp = ocp
        u, values, rows = ca.MX.sym("u", ocp.n_u), [], []
        self.kinds: list[int] = []
        """Index of each bound among the bounds of a period, states first."""
        self.names: tuple[str, ...] = ()
        at = sum(g.states.size for g in groups)
        for g in groups:
            if (f := g.function) is None:
                continue
            lower, upper, _, _, hard, at_end, size = g.rows
            others = np.hstack([ca.DM(f.jac_sparsity(0, i), 1).full() for i in (0, 2)])
            own = np.flatnonzero((hard > 0) & (at_end == 0) & ~np.any(others, axis=1))
            if own.size:
                values.append(f(np.zeros(f.numel_in(0)), u, np.zeros(f.numel_in(2)))[own.tolist()])
                kept = KEPT * np.where(np.isfinite(upper - lower), 0.5 * (upper - lower), size)[own]
                rows.append((lower[own] - kept, upper[own] + kept))
                self.kinds += (at + own).tolist()
                self.names += tuple(g.names[i] for i in own)
            at += f.numel_out(0)
        self.lower: Array
        self.upper: Array
        self.lower, self.upper = np.hstack(rows) if rows else np.zeros((2, 0))
        self.function = ca.Function("bounds_of_inputs", [u], [ca.densify(ca.vertcat(*values))])
        """``u`` to the bounded values."""
        finite = np.isfinite(ocp.u_min) & np.isfinite(ocp.u_max)
        with np.errstate(invalid="ignore"):
            self.centre: Array = np.where(
                finite, 0.5 * (ocp.u_min + ocp.u_max), np.clip(0.0, ocp.u_min, ocp.u_max)
            )
        """Middle of the inputs' ranges ``(n_u,)``, for an open range the value closest to zero."""

    def given_way(self, u: Array) -> dict[str, float]:
        """Violations of the input ``u`` ``(n_u,)`` by name."""
        if not self.names:
            return {}
        value = self.function(u).full().ravel()
        off = np.maximum(value - self.upper, self.lower - value)
        return {name: float(v) for name, v in zip(self.names, off, strict=True) if not v <= 0}

    def keep(self, u: Array, held: Array, limits: Limits | None = None) -> tuple[Array, dict[str, float]]:
        """``u`` within the limits (:meth:`OCP.saturate`) and these bounds, and its violations of these bounds before.

        An input that violates a bound moves straight towards the held one until all bounds hold, or towards the middle
        of the ranges if the held one violates them too. If both do, ``u`` is only saturated.
        """
        u = self._ocp.saturate(u, held, limits)
        if not (way := self.given_way(u)):
            return u, way
        for goal in (held, self.centre):
            inside, beyond = self._ocp.saturate(goal, held, limits), u
            if self.given_way(inside):
                continue
            for _ in range(HALVINGS):
                middle = 0.5 * (inside + beyond)
                inside, beyond = (inside, middle) if self.given_way(middle) else (middle, beyond)
            return inside, way
        return u, way


def _bounded(ocp: OCP, model: HybridModel, sizes: Sizes) -> list[_Bounded]:
    """All bounds of a problem except those of its inputs; states first."""
    y_names = tuple(f"output {s.name}" for s in model.outputs)
    no_states = np.zeros(0, dtype=np.int64)

    def states(*rows: Array) -> _Bounded:
        chosen = np.flatnonzero(np.isfinite(rows[0]) | np.isfinite(rows[1]))
        return _Bounded(None, chosen, np.array(rows)[:, chosen], tuple(model.states[i].name for i in chosen))

    def values(f: ca.Function, name: str, *rows: Array) -> _Bounded:
        n = rows[0].size
        names = (name,) if n == 1 else tuple(f"{name}[{i}]" for i in range(n))
        return _Bounded(f, no_states, np.array(rows), names)

    def outputs(*rows: Array) -> _Bounded:
        return _Bounded(_outputs(model, ocp.n_p), no_states, np.array(rows), y_names)

    weights = _weights(ocp.q, ocp.x_min, ocp.x_max, sizes.states, sizes, "state")
    bounds = state_bounds(weights, ocp.x_min, ocp.x_max, ocp.slack_linear, ocp.slack_quadratic)
    found = [states(*bounds, *np.zeros((2, ocp.n_x)), sizes.states)]
    for b in ocp.hard:
        if isinstance(b.what, str) and b.what == "x":
            found.append(states(*_hard_rows(b, ocp, sizes.states, ocp.q)))
    for bound in ocp.soft:
        f, name = _of_point(bound.expression, ocp, model), bound.expression.name()
        size = _violations(bound.lower, bound.upper, sizes.values(f), f"soft bound {name}", bound.linear > 0)
        none = np.zeros((2, bound.lower.size))
        rows = bound.lower, bound.upper, bound.linear, bound.quadratic, *none, size
        found.append(values(f, name, *rows))
    if ocp.y_min.size:
        size = sizes.outputs
        weights = _weights(ocp.q_y, ocp.y_min, ocp.y_max, size, sizes, "output")
        found.append(
            outputs(*output_bounds(weights, ocp.y_min, ocp.y_max), *np.zeros((2, weights.size)), size)
        )
    for b in ocp.hard:
        if not isinstance(b.what, str):
            f = _of_point(b.what, ocp, model)
            found.append(values(f, b.what.name(), *_hard_rows(b, ocp, sizes.values(f))))
        elif b.what == "y":
            found.append(outputs(*_hard_rows(b, ocp, sizes.outputs, ocp.q_y)))
    return found


def _weights(weight: Array, lower: Array, upper: Array, size: Array, sizes: Sizes, what: str) -> Array:
    """Weights for the penalties of bounds ``(n,)``: the signals' own; without one, the weight by which a deviation of a
    signal by its size costs as much as that of any other signal.
    """
    own = np.where(weight > 0, weight, 1.0) if weight.size else np.ones(lower.size)
    open_ = (np.isfinite(lower) | np.isfinite(upper)) & ~(
        (weight > 0) if weight.size else np.zeros(lower.size, bool)
    )
    if not np.any(open_):
        return own
    if lost := np.flatnonzero(open_ & np.isnan(size)).tolist():
        raise InputError(
            f"soft bounds: the size of {what} {lost[0]} is unknown, so a violation cannot be weighted. Give its "
            "signal a range, or the signal a weight. [HM-CONTROL-031]"
        )
    return np.where(open_, sizes.cost / size**2, own)


def _violations(
    lower: Array, upper: Array, size: Array, what: str, other: NDArray[np.bool_] | bool = False
) -> Array:
    """The unit of violation of bounds ``(n,)``: half the range, else the bound's value, else the size of the bounded
    value.

    ``other`` marks values whose unit does not matter.
    """
    half = 0.5 * (upper - lower)
    value = np.abs(np.where(np.isfinite(upper), upper, lower))
    found = np.where(np.isfinite(half), half, np.where(np.isfinite(value) & (value > 0), value, size))
    if lost := np.flatnonzero(
        np.isnan(found) & (np.isfinite(lower) | np.isfinite(upper)) & ~np.asarray(other)
    ).tolist():
        raise InputError(
            f"{what}: the size of value {lost[0]} is unknown, since nothing affects this value at the operating point. "
            "Give both of its bounds. [HM-CONTROL-032]"
        )
    return np.where(np.isnan(found), 1.0, found)  # unbounded values, or units that do not matter


def _hard_rows(bound: HardBound, ocp: OCP, sizes: Array, weights: Array | None = None) -> list[Array]:
    """Rows ``(n,)`` of a hard bound: bounds, penalties of its relaxation, the hard flag, the end flag, and sizes."""
    name = bound.what if isinstance(bound.what, str) else bound.what.name()
    ranks, range_ = sorted({b.priority for b in ocp.hard}), ocp.input_range
    size = _violations(bound.lower, bound.upper, sizes, f"hard bound {name}")
    cost = np.full(size.size, max(1.0, float(np.max((ocp.r + ocp.r_delta) * range_**2))))
    if weights is not None and weights.size:
        cost = np.maximum(cost, weights * size**2)
    linear = GIVES_WAY * HIGHER ** ranks.index(bound.priority) * cost / size
    ends = np.full(size.size, bound.at_end)
    return [bound.lower, bound.upper, linear, linear / size, np.ones(size.size), ends, size]


def _first_stages(model: HybridModel, functions: tuple[ca.Function, ...]) -> tuple[Array, list[Array]]:
    """The first stage of each state, and of each value of functions ``(x, u, e)``, that an input of the plan affects.

    From the sparsity of the model's equations; infinite if there is none.
    """
    step = stage_step(model)
    by_z, by_v = (np.array(ca.DM(step.jac_sparsity(0, i), 1).full(), dtype=bool) for i in (0, 1))
    first, reached = np.full(by_z.shape[0], np.inf), np.zeros(by_z.shape[0], dtype=bool)
    for stage in range(1, by_z.shape[0] + 1):
        reached = by_z @ reached | np.any(by_v[:, : model.n_u], axis=1)
        first[reached & np.isinf(first)] = stage
    states, rows = first[: model.n_x], []
    for f in functions:
        by_x, by_u = (np.array(ca.DM(f.jac_sparsity(0, i), 1).full(), dtype=bool) for i in (0, 1))
        shown = np.min(np.where(by_x, states, np.inf), axis=1)
        rows.append(np.where(np.any(by_u, axis=1), 0.0, shown))
    return states, rows


def _of_point(f: ca.Function, ocp: OCP, model: HybridModel) -> ca.Function:
    """A bounded expression as a function of ``(x, u, e)``."""
    n_w, n_p = model.n_w, ocp.n_p
    n_e = n_p + model.n_d + n_w
    wanted = [(ocp.n_x, 1), (ocp.n_u, 1), (n_w, 1), (n_p, 1)][: f.n_in()]
    if [f.size_in(i) for i in range(f.n_in())] != wanted:
        raise InputError(
            f"soft bound: expression {f} must take (x, u) of {ocp.n_x} states and {ocp.n_u} inputs, or (x, u, w) with "
            f"{n_w} measured disturbances, or (x, u, w, p) [HM-CONTROL-033]"
        )
    # in scalar code if the expression is scalar code
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    x, u, e = kind.sym("x", ocp.n_x), kind.sym("u", ocp.n_u), kind.sym("e", n_e)
    given = (x, u, e[n_e - n_p - n_w : n_e - n_p], e[n_e - n_p :])
    return ca.Function("bounded", [x, u, e], [f(*given[: f.n_in()])])


def _outputs(model: HybridModel, n_p: int = 0) -> ca.Function:
    """Outputs of a model as a function of ``(x, u, e)``, with the effect of unmeasured disturbances.

    The last ``n_p`` entries of ``e`` are ignored.
    """
    on_u, _, on_y = (ca.DM(m) for m in model.disturbed)
    n_e = model.n_d + model.n_w + n_p
    x, u, e = (ca.MX.sym(k, n) for k, n in zip("xue", (model.n_x, model.n_u, n_e), strict=True))
    d, w = e[: model.n_d], e[model.n_d : model.n_d + model.n_w]
    y = model.output(x, u + on_u @ d, w, ca.DM(model.p)) + on_y @ d
    return ca.Function("outputs", [x, u, e], [ca.densify(y)])


def _with_slopes(f: ca.Function) -> ca.Function:
    """``(x, u, e)`` to the expression and its derivatives by ``x`` and by ``u``."""
    n_x, n_u, n_e = (f.size1_in(i) for i in range(3))
    # one Jacobian by both in one call: two Jacobians would evaluate the expression's calls twice
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    z, inner = kind.sym("z", n_x + n_u), kind.sym("e", n_e)
    x, u, e = ca.MX.sym("x", n_x), ca.MX.sym("u", n_u), ca.MX.sym("e", n_e)
    value = f(z[:n_x], z[n_x:], inner)
    outs = [ca.densify(value), ca.densify(ca.jacobian(value, z))]
    both = ca.Function("both", [z, inner], outs, {"cse": True})
    found, slope = both(ca.vertcat(x, u), e)
    return ca.Function("soft", [x, u, e], [found, slope[:, :n_x], slope[:, n_x:]])


def is_affine(f: ca.Function) -> bool:
    """Whether ``f(x, u, e)`` is affine in ``x`` and ``u``."""
    return bool(_curvature(f).nnz_out(0) == 0)


def _curvature(f: ca.Function) -> ca.Function:
    """``(x, u, e, m)`` to the second derivatives of ``m' f`` by ``(x, u)``."""
    n_x, n_u, n_e = (f.size1_in(i) for i in range(3))
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    z, e, m = kind.sym("z", n_x + n_u), kind.sym("e", n_e), kind.sym("m", f.numel_out(0))
    both = ca.Function(
        "both", [z, e, m], [ca.hessian(ca.dot(m, f(z[:n_x], z[n_x:], e)), z)[0]], {"cse": True}
    )
    x, u, e, m = (ca.MX.sym(name, n) for name, n in zip("xuem", (n_x, n_u, n_e, m.numel()), strict=True))
    return ca.Function("curvature", [x, u, e, m], [both(ca.vertcat(x, u), e, m)])


def _is_convex(f: ca.Function | None, lower: Array, upper: Array) -> bool:
    """Whether ``lower <= f(x, u, e) <= upper`` is a convex set by its Hessians, which must be the same everywhere."""
    assert f is not None
    bends, rng = _curvature(f), np.random.default_rng(0)
    points = [[rng.standard_normal(f.size1_in(i)) for i in range(3)] for _ in range(3)]
    for one, low, high in zip(np.eye(f.numel_out(0)), lower, upper, strict=True):
        here, *others = (bends(*point, one).full() for point in points)
        if not all(np.array_equal(here, other) for other in others):
            return False
        values = np.linalg.eigvalsh(here)
        rounded = CONCAVE * np.max(np.abs(values))
        if (np.isfinite(high) and values[0] < -rounded) or (np.isfinite(low) and values[-1] > rounded):
            return False
    return True


def stage_cost(ocp: OCP, model: HybridModel | None = None) -> ca.Function | None:
    """The non-quadratic stage cost, ``(x, u, p) -> scalar``: the economic cost plus that of the outputs.

    ``p`` are the economic cost's own parameters, then, if outputs are weighed, ``y_ref``, ``d`` and ``w``. None if
    there is no such cost.
    """
    f = ocp.economic
    n_x, n_u = ocp.n_x, ocp.n_u
    if f is not None and (
        (f.size_in(0), f.size_in(1)) != ((n_x, 1), (n_u, 1)) or (f.n_in() > 2 and f.size2_in(2) != 1)
    ):
        raise InputError(
            f"economic: {f} must take (x, u) of {n_x} states and {n_u} inputs, or these and a column p"
            " [HM-CONTROL-034]"
        )
    if not ocp.n_y or model is None:
        return f
    n_p, n_y = ocp.n_p, ocp.n_y
    x, u = ca.MX.sym("x", n_x), ca.MX.sym("u", n_u)
    p = ca.MX.sym("p", n_p + n_y + model.n_d + model.n_w)
    error = _outputs(model)(x, u, p[n_p + n_y :]) - p[n_p : n_p + n_y]
    total = ca.dot(ca.DM(ocp.q_y), error**2)
    if f is not None:
        total += f(x, u, p[:n_p]) if f.n_in() > 2 else f(x, u)
    return ca.Function("stage_cost", [x, u, p], [total])


class StageCost:
    """:func:`stage_cost` along a trajectory, with first and second derivatives; zero without such a cost."""

    def __init__(
        self, ocp: OCP, dt: float, model: HybridModel | None = None, sizes: Array | None = None
    ) -> None:
        self.function, self._dt, self._n = stage_cost(ocp, model), dt, ocp.horizon
        self.size: Array = np.concatenate([np.ones(ocp.n_x) if sizes is None else sizes, ocp.input_scale])
        """Scales ``(n_x + n_u,)`` of directions in state and input."""
        f, n_x, n_u = self.function, ocp.n_x, ocp.n_u
        self.n_p = int(f.numel_in(2)) if f is not None and f.n_in() > 2 else 0
        """Number of its parameters."""
        if f is None:
            return
        x, u, p = ca.MX.sym("x", n_x), ca.MX.sym("u", n_u), ca.MX.sym("p", self.n_p)
        value = ca.densify(f(x, u, p) if f.n_in() > 2 else f(x, u))
        slope = ca.horzcat(ca.jacobian(value, x), ca.jacobian(value, u)).T
        curvature = ca.horzcat(ca.jacobian(slope, x), ca.jacobian(slope, u))
        self._value = BufferedFunction(ca.Function("economic", [x, u, p], [value]).map(self._n))
        outs = [ca.densify(slope), ca.densify(curvature)]
        self._derivatives = BufferedFunction(ca.Function("economic_slopes", [x, u, p], outs).map(self._n))

    def value(self, x: Array, u: Array, p: Array | None = None) -> float:
        """Cost of states ``(N + 1, n_x)`` or longer, inputs ``(N, n_u)`` and parameters ``(N + 1, n_p)``."""
        if self.function is None:
            return 0.0
        self._fill(self._value, x, u, p)
        self._value()
        return self._dt * float(np.sum(self._value.outputs[0]))

    def derivatives(self, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
        """Derivatives of the stages' costs by ``(x, u)``: ``(N, n_x + n_u)`` and ``(N, n_x + n_u, n_x + n_u)``."""
        f, n = self._derivatives, self._n
        self._fill(f, x, u, p)
        f()
        slope = self._dt * f.outputs[0].reshape(n, -1)
        return slope, self._dt * f.outputs[1].reshape(n, slope.shape[1], -1)

    def convex(self, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
        """The same with positive semi-definite second derivatives: negative curvature is replaced by zero.

        Eigenvectors are those of the scaled matrix, so the result does not depend on units.
        """
        slope, curvature = self.derivatives(x, u, p)
        if not np.all(np.isfinite(curvature)):
            return slope, curvature
        both = np.outer(self.size, self.size)
        values, vectors = np.linalg.eigh(curvature * both)
        flat = np.maximum(values, 0.0)[:, None, :]
        return slope, (vectors * flat) @ vectors.transpose(0, 2, 1) / both

    def _fill(self, f: BufferedFunction, x: Array, u: Array, p: Array | None) -> None:
        f.inputs[0][:], f.inputs[1][:] = x[: self._n].ravel(), u.ravel()
        if p is not None and self.n_p:
            f.inputs[2][:] = p[: self._n].ravel()


@dataclass(frozen=True)
class Target:
    """The goal of a plan over the horizon; beyond a preview its last values hold.

    Args:
        x: Reference of the states ``(N + 1, n_x)``.
        weight: Weight factors on ``q`` ``(N + 1, n_x)``.
        p: Parameters of :func:`stage_cost` ``(N + 1, n_p)``.
        u: Target inputs ``(N, n_u)``.
        w: Measured disturbances ``(N, n_w)``.
        d: Unmeasured disturbances ``(n_d,)``.
        y: Reference of the outputs ``(N + 1, n_y)``, or the closest reachable one; no columns if references are the
            states'.
        e: Further arguments of bounded values, see :class:`BoundRows`: ``(N, n_d + n_w + n_p)``.
        steady: Steady state of the first row of such a reference.
    """

    x: Array
    weight: Array
    p: Array
    u: Array
    w: Array
    d: Array
    y: Array
    e: Array
    steady: Steady | None = None

    @property
    def ok(self) -> bool:
        """True if all values are finite and no factor is negative."""
        finite = all(np.all(np.isfinite(v)) for v in (self.x, self.p, self.u, self.w, self.d))
        return bool(finite and weights_ok(self.weight))


def weights_ok(weight: Array) -> bool:
    """True for weight factors that are finite and not negative."""
    return bool(np.all(np.isfinite(weight)) and np.all(weight >= 0))


class Problem:
    """A model with an :class:`~hybrid_mpc.control.ocp.OCP`, and the functions that every solver needs.

    Raises:
        InputError: If problem and model do not fit, the terminal weight cannot be computed, or the size of a state or a
            bounded value is unknown.
    """

    def __init__(self, model: HybridModel, ocp: OCP) -> None:
        if (ocp.n_x, ocp.n_u) != (model.n_x, model.n_u):
            raise InputError(
                f"the problem has {ocp.n_x} states and {ocp.n_u} inputs, but model {model.name} has "
                f"{model.n_x} and {model.n_u} [HM-CONTROL-035]"
            )
        for name, values in (("q_y", ocp.q_y), ("y_min", ocp.y_min), ("y_max", ocp.y_max)):
            if values.size not in (0, model.n_y):
                raise InputError(
                    f"{name}: must have {model.n_y} values, one per output of model {model.name}, got {values.size}"
                    " [HM-CONTROL-036]"
                )
        for bound in ocp.hard:
            if isinstance(bound.what, str) and bound.what == "y" and bound.lower.size != model.n_y:
                raise InputError(
                    f"hard bound on y: must have {model.n_y} values, as model {model.name}, got {bound.lower.size}"
                    " [HM-CONTROL-037]"
                )
        self.model, self.ocp, self.sizes = model, ocp, Sizes(model, ocp)
        self.targets = Targets(model, ocp, self.sizes) if ocp.n_y else None
        """Steady states for set-points; None if references are the states'."""
        self.terminal = ocp.terminal_weight(model)
        self.soft = BoundRows(ocp, model, self.sizes)
        self.economic = StageCost(ocp, model.dt, model, self.sizes.states)
        self.run = free_run(model, ocp.horizon)
        self._rows = np.arange(ocp.horizon + 1)
        self._u0 = fixed(np.tile(model.u0, (ocp.horizon, 1)))
        self._even = fixed(np.ones((ocp.horizon + 1, ocp.n_x)))
        self._even_stages = fixed(np.tile(ocp.q * model.dt, (ocp.horizon, 1)))
        self._no_w, self._no_y = fixed(np.zeros((ocp.horizon, 0))), fixed(np.zeros((ocp.horizon + 1, 0)))
        self._no_e = fixed(np.zeros((ocp.horizon, model.n_d + model.n_w + ocp.n_p)))
        self.u_rest: Array = np.clip(model.u0, ocp.u_min, ocp.u_max)
        """Input ``(n_u,)`` of the operating point, within the limits."""
        limits = [(-np.inf, np.inf) if s.periodic else (s.lower, s.upper) for s in model.states]
        lower, upper = np.array(limits).reshape(-1, 2).T
        width = upper - lower
        self.reach: tuple[Array, Array] = lower - BEYOND * width, upper + BEYOND * width
        """Bounds ``(n_x,)`` beyond which a plan diverges; infinite for periodic states and open ranges."""
        self.usable: tuple[Array, Array] = lower - USABLE * width, upper + USABLE * width
        """Bounds ``(n_x,)`` within which a free run is a first plan, likewise."""
        followed, weight = (model.outputs, ocp.q_y) if ocp.n_y else (model.states, ocp.q)
        pairs = zip(followed, weight.tolist(), strict=True)
        names = [f"{s.name} [{s.unit}]" if q else f"{s.name} [{s.unit}], without weight" for s, q in pairs]
        names += [f"parameter {i + 1} of cost and bounds" for i in range(ocp.n_p)]
        self.reference_name = f"reference ({'outputs' if ocp.n_y else 'states'}: {'; '.join(names)})"
        """Name of a reference with its columns in their order, for messages."""

    def diverges(self, x: Array) -> bool:
        """True if states ``(n, n_x)`` lie further outside of their declared ranges than :data:`BEYOND` widths."""
        lower, upper = self.reach
        return bool(((x < lower) | (x > upper)).any())

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan, of status INITIAL: a free run of the model from the estimate with ``u`` ``(N, n_u)``.

        ``u[0]`` is the input held before the next solve; without ``u`` it is the operating point's. If the free run
        leaves the declared ranges by more than :data:`USABLE` widths, the state is held at the estimate: a free run of
        an unstable machine soon is where the model means nothing.
        """
        n, ocp = self.ocp.horizon, self.ocp
        start = np.tile(self.u_rest, (n, 1)) if u is None else input_plan(u, n, ocp.n_u, "u")
        plan, w = np.clip(start, ocp.u_min, ocp.u_max), self.forecast(None, estimate)
        z = self.run(np.concatenate([estimate.x, estimate.h]), self.model.acting(plan, estimate.d, w))
        low, high = self.usable
        if not (np.isfinite(z).all() and ((z[:, : ocp.n_x] >= low) & (z[:, : ocp.n_x] <= high)).all()):
            z = np.tile(z[0], (n + 1, 1))
        x, h = z[:, : ocp.n_x], z[:, ocp.n_x :]
        nan = float("nan")
        return Solution(
            u=plan, x=x, h=h, d=estimate.d, cost=nan, status=Status.INITIAL, kkt=nan, defect=nan, timing={},
            w=w,
        )  # fmt: skip

    def target(
        self, reference: ArrayLike, weight: ArrayLike | None = None, estimate: Estimate | None = None,
        w: ArrayLike | None = None, start: Steady | None = None,
    ) -> Target:  # fmt: skip
        """The goal of a plan; beyond a shorter preview its last value holds.

        Args:
            reference: See :meth:`Controller.solve`.
            weight: Likewise.
            estimate: Its disturbances are used for steady states. Default: none, and the nominal ``w``.
            w: See :meth:`Controller.solve`.
            start: Steady state from which those of an outputs' reference are searched.
        """
        n, m, ocp = self.ocp.horizon, self.model, self.ocp
        rows = self._preview(reference, self.reference_name, ocp.columns)
        p, weights = rows[:, ocp.columns - ocp.n_p :], self.weights(weight)
        d = np.zeros(m.n_d) if estimate is None else estimate.d
        ahead = self.forecast(w, estimate)
        e = self.around(d, ahead, p)
        if self.targets is None:
            return Target(rows[:, : ocp.n_x], weights, p, self._u0, ahead, d, self._no_y, e)
        y_ref = np.where(ocp.q_y > 0, rows[:, : ocp.n_y], 0.0)
        along = np.vstack([ahead, ahead[-1:]])
        if not all(np.all(np.isfinite(v)) for v in (y_ref, d, along)):
            return Target(
                np.full((n + 1, ocp.n_x), np.nan), weights, p, np.tile(m.u0, (n, 1)), ahead, d, y_ref, e
            )
        x, u, y, steady = self._steady(y_ref, d, along, start)
        own = np.hstack([p, y, np.tile(d, (n + 1, 1)), along])
        return Target(x=x, weight=weights, p=own, u=u[:-1], w=ahead, d=d, y=y, e=e, steady=steady)

    def around(self, d: Array, w: Array, p: Array | None = None) -> Array:
        """Further arguments of bounded values: ``(N, n_d + n_w + n_p)``; ``p`` has one more row, or is 0.

        Zeros if no bounded value depends on them.
        """
        if not self.soft.parametric:
            return self._no_e
        n, n_d, n_w = len(w), d.size, w.shape[1]
        e = np.zeros((n, n_d + n_w + self.ocp.n_p))
        e[:, :n_d], e[:, n_d : n_d + n_w] = d, w
        if p is not None:
            e[:, n_d + n_w :] = p[:-1]
        return e

    def standing(self) -> Array:
        """The reference ``(1, columns)`` of the operating point; parameters of the economic cost are zero."""
        m, ocp = self.model, self.ocp
        goal = m.output(m.x0, m.u0, m.w, m.p).full().ravel() if ocp.n_y else m.x0
        return np.concatenate([goal, np.zeros(ocp.n_p)])[None]

    def _steady(
        self, y_ref: Array, d: Array, w: Array, start: Steady | None
    ) -> tuple[Array, Array, Array, Steady]:
        """States, inputs and outputs of the steady states for each row; at most :data:`KNOTS` are computed."""
        assert self.targets is not None
        rows = np.hstack([y_ref, w])
        new = np.flatnonzero(np.any(np.diff(rows, axis=0) != 0, axis=1)) + 1
        knots = (
            np.concatenate([[0], new])
            if new.size < KNOTS
            else np.linspace(0, len(rows) - 1, KNOTS).astype(int)
        )
        found: list[Steady] = []
        for k in knots:
            # if nothing was found once, the rest of the horizon is searched less widely
            wide = not found or found[-1].steady
            found.append(self.targets.at(y_ref[k], d, w[k], start, wide=wide))
            start = found[-1] if found[-1].steady else start
        weighed = self.ocp.q_y > 0
        point = self.model.x0, self.u_rest
        x = np.array([s.x if s.steady else point[0] for s in found])
        u = np.array([s.u if s.steady else point[1] for s in found])
        off = np.array(
            [
                np.where(weighed, s.y - y_ref[k], 0.0) * (s.steady and not s.reached)
                for s, k in zip(found, knots, strict=True)
            ]
        )
        if new.size < KNOTS:
            which = np.searchsorted(knots, self._rows, side="right") - 1
            return x[which], u[which], y_ref + off[which], found[0]
        x, u, off = (
            np.stack([np.interp(self._rows, knots, column) for column in v.T], axis=1) for v in (x, u, off)
        )
        return x, u, y_ref + off, found[0]

    def forecast(self, w: ArrayLike | None, estimate: Estimate | None) -> Array:
        """Measured disturbances ``(N, n_w)`` from ``(m, n_w)``, the last value held; None: those of the estimate."""
        n, n_w = self.ocp.horizon, self.model.n_w
        if w is None and not n_w:
            return self._no_w
        if w is None:
            known = estimate is not None and estimate.w.size == n_w
            held = estimate.w if known and estimate is not None else self.model.w
            return np.tile(held, (n, 1))
        return self._preview(w, "w", n_w)[:n]

    def weights(self, weight: ArrayLike | None) -> Array:
        """Weight factors ``(N + 1, n_x)`` from ``(m, n_x)``, the last value held. Default: 1."""
        if weight is None:
            return self._even
        if isinstance(weight, np.ndarray) and self.is_even(weight):
            return weight
        return self._preview(weight, "weight", self.ocp.n_x)

    def _preview(self, values: ArrayLike, name: str, columns: int) -> Array:
        array = np.asarray(values, dtype=float)
        if array.ndim != 2 or len(array) < 1 or array.shape[1] != columns:
            raise InputError(
                f"{name}: must have shape (m, {columns}) with m > 0, got {array.shape} [HM-CONTROL-038]"
            )
        return array.take(self._rows, axis=0, mode="clip")

    def state_weights(self, weight: Array) -> tuple[Array, Array]:
        """Weights of the stages ``(N, n_x)`` and the terminal matrix for weight factors ``(N + 1, n_x)``."""
        if self.is_even(weight):
            return self._even_stages, self.terminal
        root = np.sqrt(weight[-1])
        return weight[:-1] * (self.ocp.q * self.model.dt), self.terminal * root * root[:, None]

    def is_even(self, weight: Array) -> bool:
        """Whether these are the default factors of 1 from :meth:`weights`."""
        return weight is self._even

    @np.errstate(over="ignore", invalid="ignore")  # an overflow is checked and refused
    def cost(self, z: Array, u: Array, u_prev: Array, target: Target, excess: Array | None = None) -> float:
        """Cost of a plan with the trajectory ``z`` ``(N + 1, n_x)`` or longer rows, with penalties of soft bounds.

        ``excess`` ``(M,)`` are the violations of the soft bounds. Default: those of the trajectory.
        """
        ocp, x = self.ocp, z[:, : self.ocp.n_x]
        du, off = u.copy(), u - target.u
        du[1:] -= u[:-1]
        du[0] -= u_prev
        error = x - target.x
        stages, terminal = self.state_weights(target.weight)
        last, inputs = error[-1], np.vdot(off * ocp.r, off) + np.vdot(du * ocp.r_delta, du)
        states = error[:-1]
        total = float(np.vdot(stages * states, states) + self.model.dt * inputs + last @ terminal @ last)
        total += self.economic.value(x, u, target.p)
        if len(self.soft):
            excess = self.soft.excess(self.soft.values(x, u, target.e)) if excess is None else excess
            total += self.model.dt * self.soft.penalty(excess)
        return total


class Controller(Protocol):
    """The interface of every solver. Built once; methods do not change it, and no number makes them raise."""

    problem: Problem
    """Problem and model, prepared."""
    converges: bool = True
    """False if a solve only improves the last plan a little: then another solver makes the first plan."""

    @property
    def model(self) -> HybridModel:
        """The model that predicts."""
        return self.problem.model

    @property
    def ocp(self) -> OCP:
        """The problem as plain data."""
        return self.problem.ocp

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan: a free run of the model from the estimate; see :meth:`Problem.initial`."""
        return self.problem.initial(estimate, u)

    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None, w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """The plan from now on; ``previous.u[0]`` is the input being held.

        Args:
            previous: The last plan; shifted by one period it is the initial guess.
            estimate: The state now; its ``d`` is assumed constant over the horizon.
            reference: ``(m, n_x)``, or ``(m, n_y)`` if the problem weighs outputs, from now on in steps of ``dt``;
                if ``m < N + 1`` its last value holds. If the economic stage cost has parameters, ``n_p`` more columns
                are their values.
            weight: Factors on ``q`` ``(m, n_x)``, not negative, like the reference. Default: 1.
            limits: Bounds of the inputs for this solve. Default: the problem's own.
            w: Measured disturbances ``(m, n_w)`` from now on, like the reference. Default: those of the estimate, held.
        """
        ...


class SplitController(Controller):
    """A solver that does most of its work before the measurement: the loop prepares while the last input acts."""

    def prepare(self, previous: Solution, weight: Array | None = None) -> Any:
        """The part of the next :meth:`solve` that needs no measurement; arguments as there."""
        raise NotImplementedError

    def finish(
        self, prepared: Any, estimate: Estimate, reference: Array, limits: Limits | None = None,
        w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """The remaining part, with the result of :meth:`prepare`."""
        raise NotImplementedError

    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None, w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """:meth:`prepare` and :meth:`finish`."""
        return self.finish(self.prepare(previous, weight), estimate, reference, limits, w)
