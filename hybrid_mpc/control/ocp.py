"""The control problem as plain data, for scenarios, tasks and solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from dataclasses import fields as dataclass_fields
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.soft import (
    PENALTY,
    HardBound,
    SoftBound,
    fixed,
    number_content,
    output_bounds,
    same_expression,
    state_bounds,
    tightest,
)
from hybrid_mpc.errors import Collected, InputError
from hybrid_mpc.model.limits import check_flag, input_limits, numbers, vector, whole
from hybrid_mpc.model.model import output_with_jacobian
from hybrid_mpc.model.riccati import dare, linearization, remedy_for_unmoved, unmoved_states
from hybrid_mpc.records import known
from hybrid_mpc.rules import LARGEST

if TYPE_CHECKING:
    from hybrid_mpc.model.model import HybridModel


Array = NDArray[np.float64]
Bound = TypeVar("Bound", SoftBound, HardBound)
MOST_HORIZON = 10_000
"""Longest horizon [periods]: a plan and its derivatives are kept in memory."""


@dataclass(frozen=True)
class Limits:
    """Bounds of the inputs for one solve, tighter than the problem's own, e.g. from a guard.

    Args:
        u_min: Lower bounds ``(n_u,)``; ``-inf`` for the problem's own.
        u_max: Upper bounds ``(n_u,)``; ``inf`` for the problem's own.

    Raises:
        InputError: If shapes differ, bounds cross, or one is NaN.

    Example:
        >>> Limits([-0.2], [0.2]).u_max
        array([0.2])
    """

    u_min: Array
    u_max: Array

    def __init__(self, u_min: ArrayLike, u_max: ArrayLike) -> None:
        lower, upper = numbers(u_min, "limits: u_min"), numbers(u_max, "limits: u_max")
        if lower.shape != upper.shape or not np.all(lower <= upper):
            raise InputError(
                f"limits: every input needs u_min <= u_max, got u_min {lower}, u_max {upper} [HM-CONTROL-009]"
            )
        object.__setattr__(self, "u_min", lower)
        object.__setattr__(self, "u_max", upper)


@dataclass(frozen=True, eq=False)
class OCP:
    """A quadratic tracking problem with bounded inputs, and soft and hard bounds on states and outputs.

    The cost of a plan is ``sum_k stage_k dt + (x_N - x_ref_N)' P (x_N - x_ref_N)`` with
    ``stage_k = (x_k - x_ref_k)' diag(q) (x_k - x_ref_k) + (y_k - y_ref_k)' diag(q_y) (y_k - y_ref_k) +
    (u_k - u_ref_k)' diag(r) (u_k - u_ref_k) + du_k' diag(r_delta) du_k``, ``du_k = u_k - u_{k-1}``, ``k = 0 .. N-1``.
    Only the stages are multiplied by ``dt``.

    The meaning of a reference depends on ``q_y``. Without ``q_y`` it is that of the states, ``x_ref``, and ``u_ref`` is
    the model's operating point. With ``q_y`` it is that of the outputs, ``y_ref``; a target calculator then computes
    ``x_ref`` and ``u_ref``, given the estimated disturbances (:class:`~hybrid_mpc.control.targets.Targets`). For an
    unreachable set-point ``y_ref`` is the closest reachable one.

    References and weights may vary over time. With weight factors ``w_k`` ``(n_x,)`` in a solve, ``q`` becomes
    ``w_k q`` at stage k and ``P`` becomes ``S P S`` with ``S = diag(sqrt(w_N))``. The task "be at x* at the time t*"
    has factors of zero before ``t*``, large ones at ``t*``, ordinary ones after it, and a horizon that reaches beyond
    ``t*`` from the start.

    Bounds on states hold for ``x_1 .. x_N`` and are soft: a violation ``s`` costs ``slack_linear s +
    slack_quadratic s^2`` per second, see :class:`~hybrid_mpc.control.soft.SoftBound`. The default is 1,000 times
    the cost of the tolerated deviation ``1 / sqrt(q)``, far above the multipliers of weights by Bryson's rule; weight
    factors above 100 need larger penalties.

    A problem is plain data: :func:`hybrid_mpc.records.plain` makes JSON of it and ``record(OCP, data, where)`` reads
    it. Two problems are equal if their numbers are equal and their expressions are the same programs. The arrays are
    read-only; :meth:`changed` makes a different problem.

    Args:
        horizon: N, number of model periods.
        q: Weights of the states ``(n_x,)``, not negative.
        r: Weights of the inputs ``(n_u,)``, not negative.
        r_delta: Weights of the input changes ``(n_u,)``; ``r + r_delta`` must be positive.
        u_min: Lower bounds ``(n_u,)``; ``-inf`` for none.
        u_max: Upper bounds ``(n_u,)``; ``inf`` for none.
        du_max: Largest change per period ``(n_u,)``, positive. Default: none.
        terminal: ``"riccati"``, or a symmetric positive semi-definite ``(n_x, n_x)`` matrix ``P``.
        working_point: ``(x, u)`` at which ``"riccati"`` and a fallback linearize the model. With steep friction use a
            moving point (see :func:`hybrid_mpc.model.riccati.lqr`). Default: the model's operating point.
        x_min: Soft lower bounds of the states ``(n_x,)``; ``-inf`` for none. Default: none.
        x_max: Soft upper bounds of the states ``(n_x,)``; ``inf`` for none. Default: none.
        slack_linear: Penalties ``(n_x,)`` [cost/s/unit], not negative. Default: ``1000 sqrt(q)``.
        slack_quadratic: Penalties ``(n_x,)`` [cost/s/unit^2], positive. Default: ``1000 q``. For zero ``q`` both
            defaults use ``cost / size^2`` instead: a deviation of a state by its size costs as much as that of any
            other signal (:class:`~hybrid_mpc.control.sizes.Sizes`).
        soft: Soft bounds on expressions of ``(x, u)``, ``(x, u, w)`` or ``(x, u, w, p)``. Default: none.
        blocks: Move blocking: numbers of periods over which the input is held, one block after the other,
            e.g. ``(1, 1, 2, 4)`` for a horizon of 8. The first block starts at every solve. Default: none.
        economic: A further stage cost per second, ``(x, u) -> scalar``, twice differentiable, of ``(x_0, u_0) ..
            (x_{N-1}, u_{N-1})``; it may be negative and nonconvex. ``rti`` replaces negative curvature by zero; ``sqp``
            and ``ipopt`` use the exact curvature. With ``(x, u, p) -> scalar`` references have ``n_p`` more columns,
            the values of ``p``, e.g. prices. Default: none.
        starts: Input plans ``(horizon, n_u)``, further initial guesses of a loop's first plan, for a task with several
            solutions (a swing-up); the cheapest plan is used. Default: none.
        q_y: Weights of the outputs ``(n_y,)``, not negative. At most as many outputs as inputs can be held without
            offset. Default: none; references are then those of the states.
        y_min: Soft lower bounds of the outputs ``y_0 .. y_{N-1}`` ``(n_y,)``; ``-inf`` for none. Violations are
            penalised as for states, by ``q_y``. Default: none.
        y_max: Soft upper bounds of the outputs ``(n_y,)``; ``inf`` for none. Default: none.
        hard: Hard bounds on states, outputs and expressions. If not all can be kept, they are relaxed in the order of
            their priorities. Default: none.
        preview: Whether references and weights are known ahead; else the present values are held. Default: ahead.
        preview_w: Whether measured disturbances are known ahead if there is a forecast; else the last values are held.
            Default: held.

    Raises:
        InputError: With all problems: an argument of a wrong kind, shapes that do not fit, bounds that cross, a
            negative or non-finite weight, blocks whose lengths do not sum to the horizon.

    Example:
        >>> from hybrid_mpc.records import plain, record
        >>> heater = OCP(20, (1.0, 0.1), (0.1,), (0.0,), u_min=(0.0,), u_max=(5.0,))
        >>> heater.q, heater.input_range
        (array([1. , 0.1]), array([5.]))
        >>> record(OCP, plain(heater), "ocp.json") == heater
        True
    """

    horizon: int
    q: Array
    r: Array
    r_delta: Array
    u_min: Array
    u_max: Array
    du_max: Array | None = None
    terminal: Array | Literal["riccati"] = "riccati"
    working_point: tuple[Array, Array] | None = None
    x_min: Array = field(default_factory=lambda: np.zeros(0))
    x_max: Array = field(default_factory=lambda: np.zeros(0))
    slack_linear: Array | None = None
    slack_quadratic: Array | None = None
    soft: tuple[SoftBound, ...] = ()
    blocks: tuple[int, ...] | None = None
    economic: ca.Function | None = None
    starts: tuple[Array, ...] = ()
    q_y: Array = field(default_factory=lambda: np.zeros(0))
    y_min: Array = field(default_factory=lambda: np.zeros(0))
    y_max: Array = field(default_factory=lambda: np.zeros(0))
    hard: tuple[HardBound, ...] = ()
    preview: bool = True
    preview_w: bool = False

    def __init__(
        self,
        horizon: int,
        q: ArrayLike,
        r: ArrayLike,
        r_delta: ArrayLike,
        u_min: ArrayLike,
        u_max: ArrayLike,
        du_max: ArrayLike | None = None,
        terminal: ArrayLike | Literal["riccati"] = "riccati",
        working_point: tuple[ArrayLike, ArrayLike] | None = None,
        x_min: ArrayLike | None = None,
        x_max: ArrayLike | None = None,
        slack_linear: ArrayLike | None = None,
        slack_quadratic: ArrayLike | None = None,
        soft: Sequence[SoftBound] = (),
        blocks: Sequence[int] | None = None,
        economic: ca.Function | None = None,
        starts: Sequence[ArrayLike] = (),
        q_y: ArrayLike = (),
        y_min: ArrayLike = (),
        y_max: ArrayLike = (),
        hard: Sequence[HardBound] = (),
        preview: bool = True,
        preview_w: bool = False,
    ) -> None:
        own = Collected()
        n = own(whole, horizon, "horizon [periods]", 1, MOST_HORIZON)
        q_v, r_v = own(_diagonal, q, "q"), own(_diagonal, r, "r")
        n_x, n_u = (None if v is None else v.size for v in (q_v, r_v))
        soft_b, hard_b = own(_bounds, soft, SoftBound, "soft"), own(_bounds, hard, HardBound, "hard")
        flags = [own(check_flag, v, name) for v, name in ((preview, "preview"), (preview_w, "preview_w"))]
        outputs = own(_weights, q_y, "q_y")
        fields: dict[str, Any] = {
            "horizon": n, "q": q_v, "r": r_v, "economic": own(_stage_cost, economic), "q_y": outputs,
            "preview": flags[0], "preview_w": flags[1], "soft": soft_b, "hard": hard_b,
            "du_max": None, "working_point": None, "blocks": None,
        }  # fmt: skip
        if q_v is not None and n_x is not None:
            fields["terminal"] = own(_terminal_matrix, terminal, n_x)
            fields["states"] = own(
                state_bounds, np.where(q_v > 0, q_v, 1.0), x_min, x_max, slack_linear, slack_quadratic
            )
        if r_v is not None and n_u is not None:
            fields["r_delta"] = own(_change_weights, r_delta, r_v)
            fields["u"] = own(input_limits, u_min, u_max, n_u)
            if du_max is not None:
                fields["du_max"] = own(_largest_change, du_max, n_u)
        if n_x is not None and n_u is not None and working_point is not None:
            fields["working_point"] = own(_point, working_point, n_x, n_u)
        if n is not None and blocks is not None:
            fields["blocks"] = own(_block_lengths, blocks, n)
        if n is not None and n_u is not None:
            fields["starts"] = own(_plans, starts, n, n_u)
        if outputs is not None:
            fields["y"] = own(output_bounds, np.where(outputs > 0, outputs, 1.0), y_min, y_max)
        if n_x is not None and outputs is not None and hard_b is not None:
            own(_check_hard, hard_b, n_x, outputs.size)
        if soft_b is not None and hard_b is not None:
            own(_check_shared, fields["economic"], soft_b, hard_b)
        own.refuse()
        (low, up, linear, quadratic), (y_low, y_up, *_) = fields.pop("states"), fields.pop("y")
        fields["u_min"], fields["u_max"] = fields.pop("u")
        fields |= {
            "x_min": low, "x_max": up, "y_min": y_low, "y_max": y_up,
            "slack_linear": None if slack_linear is None else linear,
            "slack_quadratic": None if slack_quadratic is None else quadratic,
        }  # fmt: skip
        for name, value in fields.items():
            for array in value if isinstance(value, tuple) else (value,):
                if isinstance(array, np.ndarray):
                    fixed(array)
            object.__setattr__(self, name, value)

    def changed(self, **fields: Any) -> OCP:
        """The same problem with other values of some fields, which are checked as for a new problem.

        Raises:
            InputError: If a field is unknown, or the problem would be invalid.
        """
        names = [field.name for field in dataclass_fields(self)]
        for name in fields:
            known(name, names, "field of a control problem")
        if "q" in fields and np.size(fields["q"]) != self.n_x:  # infinite bounds adapt to the new size
            free = (name for name in ("x_min", "x_max") if not np.any(np.isfinite(getattr(self, name))))
            fields = {**dict.fromkeys(free), **fields}
        return replace(self, **fields)

    def with_states(self, at_rest: ArrayLike) -> OCP:
        """The same problem for a model with further states behind the present ones, without weights and bounds.

        ``at_rest`` ``(k,)`` are their values at the working point.

        Example:
            >>> heater = OCP(20, (1.0, 0.1), (0.1,), (0.0,), u_min=(0.0,), u_max=(5.0,), x_max=(90.0, 90.0))
            >>> slower = heater.with_states([2.0])
            >>> slower.q, slower.x_max
            (array([1. , 0.1, 0. ]), array([90., 90., inf]))
        """
        rest = np.asarray(at_rest, dtype=np.float64)
        k, n_x = rest.size, self.n_x
        # a state without weight needs penalties of its bounds, which are infinite
        sizes = {"q": 0.0, "x_min": -np.inf, "x_max": np.inf, "slack_linear": 0.0, "slack_quadratic": 1.0}
        fields: dict[str, Any] = {
            name: np.append(value, np.full(k, more))
            for name, more in sizes.items()
            if (value := getattr(self, name)) is not None
        }
        if not isinstance(self.terminal, str):
            fields["terminal"] = np.pad(self.terminal, (0, k))
        if self.working_point is not None:
            fields["working_point"] = np.append(self.working_point[0], rest), self.working_point[1]
        fields["economic"] = self.economic and _of_first_states(self.economic, n_x, k)
        fields["soft"] = [
            SoftBound(_of_first_states(b.expression, n_x, k), b.lower, b.upper, b.linear, b.quadratic)
            for b in self.soft
        ]
        fields["hard"] = [_with_free_states(b, n_x, k) for b in self.hard]
        return self.changed(**fields)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OCP):
            return NotImplemented
        return number_content(self) == number_content(other) and same_expression(
            self.economic, other.economic
        )

    def __hash__(self) -> int:
        return hash(number_content(self))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return int(self.q.size)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return int(self.r.size)

    @property
    def n_y(self) -> int:
        """Number of outputs if references are those of the outputs, else 0."""
        return int(self.q_y.size)

    @property
    def columns(self) -> int:
        """Number of columns of a reference: states, or outputs if ``q_y`` weighs them, and ``n_p``."""
        return (self.n_y or self.n_x) + self.n_p

    @property
    def n_p(self) -> int:
        """Number of parameters of the economic stage cost and of bounds: the last columns of a reference."""
        if self.economic is not None and self.economic.n_in() > 2:
            return int(self.economic.numel_in(2))
        return max((int(f.numel_in(3)) for f in _parametric(self.soft, self.hard)), default=0)

    @property
    def state_range(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the states ``(n_x,)`` each: the tighter of soft and hard ones."""
        return tightest(self.x_min, self.x_max, self.hard, "x", self.n_x)

    def output_range(self, n_y: int) -> tuple[Array, Array]:
        """Likewise of the ``n_y`` outputs."""
        return tightest(self.y_min, self.y_max, self.hard, "y", n_y)

    @property
    def penalties(self) -> tuple[Array, Array]:
        """Linear and quadratic penalties of the states' bounds ``(n_x,)`` each, with defaults from ``q``; NaN if ``q``
        is zero, where the default needs a size.
        """
        q = np.where(self.q > 0, self.q, np.nan)
        linear = PENALTY * np.sqrt(q) if self.slack_linear is None else self.slack_linear
        return linear, PENALTY * q if self.slack_quadratic is None else self.slack_quadratic

    @property
    def input_range(self) -> Array:
        """Size of each input ``(n_u,)``: its range, or twice the deviation that its weights tolerate."""
        return 2.0 * self.input_scale

    @property
    def input_scale(self) -> Array:
        """Scale of the inputs ``(n_u,)`` in solvers: half the range, else the deviation that their weights tolerate."""
        half = 0.5 * (self.u_max - self.u_min)
        return np.where(np.isfinite(half), half, 1.0 / np.sqrt(self.r + self.r_delta))

    @property
    def block_starts(self) -> NDArray[np.int64]:
        """First period of every move block; all periods without blocks."""
        lengths = self.blocks if self.blocks is not None else (1,) * self.horizon
        return np.cumsum((0, *lengths[:-1]))

    def held(self, u: Array) -> Array:
        """Inputs ``(N, n_u)`` held over the move blocks, each at its first value."""
        return u if self.blocks is None else np.repeat(u[self.block_starts], self.blocks, axis=0)

    def stage_cost(
        self, x: Array, u: Array, x_ref: Array, du: Array, weight: Array | float = 1.0,
        *, u_ref: Array | float = 0.0, y_error: Array | None = None,
    ) -> Array:  # fmt: skip
        """Stage cost ``(...)`` per second of states ``(..., n_x)`` and inputs ``(..., n_u)``.

        ``weight`` ``(..., n_x)`` are factors on ``q``, ``u_ref`` ``(..., n_u)`` is the target input, ``y_error``
        ``(..., n_y)`` are the outputs' deviations. Penalties of soft bounds are not included.
        """
        error = weight * (np.asarray(x) - np.asarray(x_ref)) ** 2
        inputs = np.asarray(np.asarray(u) - u_ref)
        total = np.asarray(error @ self.q + inputs**2 @ self.r + np.asarray(du) ** 2 @ self.r_delta)
        return total if y_error is None or not self.n_y else total + y_error**2 @ self.q_y

    def bounds(self, u_prev: Array, limits: Limits | None = None) -> tuple[Array, Array]:
        """Lower and upper bounds of a plan's inputs, ``(N, n_u)`` each.

        ``limits`` tighten the problem's own. If ``du_max`` prevents ``u_prev`` from meeting them at once, the bounds
        approach them as fast as ``du_max`` allows.

        Raises:
            InputError: If the limits have another size.
        """
        shape = (self.horizon, self.n_u)
        if limits is None:
            return np.broadcast_to(self.u_min, shape), np.broadcast_to(self.u_max, shape)
        if limits.u_min.size != self.n_u:
            raise InputError(
                f"limits: must have {self.n_u} inputs, as the problem, got {limits.u_min.size} [HM-CONTROL-010]"
            )
        lower, upper = (np.clip(v, self.u_min, self.u_max) for v in (limits.u_min, limits.u_max))
        if self.du_max is None:
            return np.broadcast_to(lower, shape), np.broadcast_to(upper, shape)
        change = np.arange(1.0, self.block_starts.size + 1)[:, None] * self.du_max
        rows = np.minimum(lower, u_prev + change), np.maximum(upper, u_prev - change)
        own = (np.clip(row, self.u_min, self.u_max) for row in rows)
        lower, upper = (row if self.blocks is None else np.repeat(row, self.blocks, axis=0) for row in own)
        return lower, upper

    def saturate(self, u: Array, u_prev: Array, limits: Limits | None = None) -> Array:
        """``u`` ``(n_u,)`` moved within ``du_max`` of ``u_prev`` and into :meth:`bounds`."""
        u = np.asarray(u, dtype=float)
        if self.du_max is not None:
            u = np.clip(u, u_prev - self.du_max, u_prev + self.du_max)
        lower, upper = self.bounds(u_prev, limits)
        return np.clip(u, lower[0], upper[0])

    def terminal_weight(self, model: HybridModel) -> Array:
        """Terminal matrix ``(n_x, n_x)`` for a model.

        ``"riccati"``: the cost-to-go of the LQR at the working point, minimised over the hidden states (Schur
        complement), so they need no target. Change weights are added to the input weights: exact for ``r_delta = 0``.
        Weights on outputs count as weights on the states that the outputs depend on there.

        Raises:
            InputError: If the linearized model is not stabilisable.
        """
        if not isinstance(self.terminal, str):
            return self.terminal
        n_x = self.n_x
        a, b, q, r = self.linear_quadratic(model)
        try:
            p, _ = dare(a, b, q, r)
        except InputError as error:
            why = remedy_for_unmoved(unmoved_states(model, a, b))
            raise InputError(f"{error}{why and '; ' + why}") from None
        if not model.n_h:
            return p
        own = np.sqrt(np.diag(p)[:n_x])  # scaled, so that rounding does not depend on units
        late, n_own = np.resize(self.input_scale, model.delay_states), model.n_h - model.delay_states
        size = np.concatenate([np.where(own > 0, own, 1.0), 1.0 / late, np.ones(n_own)])
        p = p / np.outer(size, size)
        reduced = (
            p[:n_x, :n_x] - p[:n_x, n_x:] @ np.linalg.pinv(p[n_x:, n_x:], hermitian=True) @ p[n_x:, :n_x]
        )
        values, vectors = np.linalg.eigh(0.5 * (reduced + reduced.T))
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T) * np.outer(size[:n_x], size[:n_x])

    def point(self, model: HybridModel) -> tuple[Array, Array]:
        """State and input at which terminal weight and fallback are linearized: the working point, else the model's
        operating point with its input clipped to the limits.
        """
        if self.working_point is not None:
            return self.working_point
        return model.x0, np.clip(model.u0, self.u_min, self.u_max)

    def linear_quadratic(self, model: HybridModel) -> tuple[Array, Array, Array, Array]:
        """``A``, ``B``, ``Q`` ``(n_z, n_z)`` and ``R`` of the linear-quadratic problem at :meth:`point`, per period.

        With weights on outputs ``Q`` contains ``C' diag(q_y) C``. A direct effect of inputs on outputs is neglected.
        """
        x, u = self.point(model)
        a, b, _ = linearization(model, x, u)
        q = np.diag(np.concatenate([self.q, np.zeros(model.n_h)]) * model.dt)
        if self.n_y:
            c = output_with_jacobian(model)(x, u, model.w)[1].full()
            q[: self.n_x, : self.n_x] += (c.T * self.q_y) @ c * model.dt
        return a, b, q, np.diag(self.r + self.r_delta) * model.dt


def _of_first_states(f: ca.Function, n_x: int, more: int) -> ca.Function:
    """An expression of ``(x, u, ...)`` for states that have ``more`` further ones behind."""
    x = ca.SX.sym("x", n_x + more)
    others = [ca.SX.sym(f.name_in(i), f.sparsity_in(i)) for i in range(1, f.n_in())]
    return ca.Function(f.name(), [x, *others], [f(x[:n_x], *others)])


def _with_free_states(bound: HardBound, n_x: int, more: int) -> HardBound:
    """A hard bound that leaves ``more`` further states free."""
    if isinstance(bound.what, ca.Function):
        what = _of_first_states(bound.what, n_x, more)
        return HardBound(what, bound.lower, bound.upper, bound.priority, bound.at_end)
    if bound.what == "y":
        return bound
    lower, upper = (
        np.append(bound.lower, np.full(more, -np.inf)),
        np.append(bound.upper, np.full(more, np.inf)),
    )
    return HardBound("x", lower, upper, bound.priority, bound.at_end)


def _bounds(given: object, kind: type[Bound], name: str) -> tuple[Bound, ...]:
    example = f"{kind.__name__}({'expression' if kind is SoftBound else 'what'}, lower, upper, ...)"
    if not isinstance(given, tuple | list):
        raise InputError(f"{name}: must be a list of {example}, got {given!r:.80} [HM-CONTROL-013]")
    if wrong := [bound for bound in given if not isinstance(bound, kind)]:
        raise InputError(f"{name}: must contain {example}, got {wrong[0]!r:.80} [HM-CONTROL-014]")
    return tuple(given)


def _check_hard(hard: Sequence[HardBound], n_x: int, n_y: int) -> None:
    for bound in hard:
        needed = {"x": n_x, "y": n_y}.get(bound.what if isinstance(bound.what, str) else "", 0)
        if needed and bound.lower.size != needed:
            raise InputError(
                f"hard bound on {bound.what}: must have {needed} values, got {bound.lower.size}"
                " [HM-CONTROL-015]"
            )


def _check_shared(economic: ca.Function | None, soft: Sequence[SoftBound], hard: Sequence[HardBound]) -> None:
    """Refuse parameters of different sizes: all costs and bounds with parameters share them."""
    own = {economic.numel_in(2)} if economic is not None and economic.n_in() > 2 else set()
    if len(given := own | {f.numel_in(3) for f in _parametric(soft, hard)}) > 1:
        raise InputError(
            f"parameters p: all costs and bounds share them, so their sizes must be equal, got {sorted(given)}"
            " [HM-CONTROL-016]"
        )


def _stage_cost(value: ca.Function | None) -> ca.Function | None:
    """An economic stage cost ``(x, u) -> scalar`` or ``(x, u, p) -> scalar``, or none."""
    if value is not None and not _is_stage_cost(value):
        raise InputError(
            f"economic: must be a function (x, u) or (x, u, p) -> scalar, got {value!r:.80} [HM-CONTROL-017]"
        )
    return value


def _largest_change(value: ArrayLike, n_u: int) -> Array:
    found = vector(numbers(value, "du_max", most=LARGEST), n_u, "du_max")
    if not np.all(found > 0):
        raise InputError(f"du_max: must be positive, got {found}. Omit du_max for no limit. [HM-CONTROL-018]")
    return found


def _plans(starts: object, horizon: int, n_u: int) -> tuple[Array, ...]:
    if not isinstance(starts, tuple | list | np.ndarray):
        raise InputError(f"starts: must be a list of input plans, got {starts!r:.80} [HM-CONTROL-019]")
    for i, plan in enumerate(starts):
        numbers(plan, f"starts[{i}]", most=LARGEST)
    return tuple(input_plan(s, horizon, n_u, f"starts[{i}]") for i, s in enumerate(starts))


def _parametric(soft: Sequence[SoftBound], hard: Sequence[HardBound]) -> list[ca.Function]:
    """Bounded expressions with parameters."""
    given = [bound.expression for bound in soft] + [b.what for b in hard if not isinstance(b.what, str)]
    return [f for f in given if f.n_in() > 3]


def _diagonal(values: ArrayLike, name: str) -> Array:
    """Weights as a vector, at least one; a matrix is refused."""
    array = _weights(values, name)
    shape = np.shape(values)
    if len(shape) > 1 and max(shape) < array.size:
        raise InputError(
            f"{name}: must be the diagonal only, one weight per signal, got shape {shape} [HM-CONTROL-020]"
        )
    if not array.size:
        raise InputError(f"{name}: no weight given. Give one per signal. [HM-CONTROL-021]")
    return array


def _weights(values: ArrayLike, name: str) -> Array:
    array = numbers(values, name, most=LARGEST)
    if not (np.all(np.isfinite(array)) and np.all(array >= 0)):
        raise InputError(f"{name}: weights must be finite and not negative, got {array} [HM-CONTROL-022]")
    return array


def _change_weights(values: ArrayLike, r: Array) -> Array:
    """Weights of input changes; with those of the inputs they must determine every input."""
    array = _weights(vector(values, r.size, "r_delta"), "r_delta")
    if not np.all(r + array > 0):
        raise InputError(
            "r, r_delta: every input needs a positive weight in r or r_delta; otherwise the input is undetermined "
            "[HM-CONTROL-023]"
        )
    return array


def input_plan(value: ArrayLike, horizon: int, n_u: int, name: str) -> Array:
    """A finite input plan ``(horizon, n_u)``."""
    array = numbers(value, name).reshape(np.shape(value))
    if array.shape != (horizon, n_u) or not np.all(np.isfinite(array)):
        raise InputError(
            f"{name}: must be a finite input plan of shape ({horizon}, {n_u}), got shape {array.shape}"
            " [HM-CONTROL-024]"
        )
    return array


def _point(value: object, n_x: int, n_u: int) -> tuple[Array, Array]:
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise InputError(
            f"working_point: must be (x, u), a state and an input, got {value!r} [HM-CONTROL-025]"
        )
    own = Collected()
    x, u = (
        own(vector, numbers(part, f"working_point {name}", most=LARGEST), size, f"working_point {name}")
        for part, size, name in ((value[0], n_x, "x"), (value[1], n_u, "u"))
    )
    own.refuse()
    assert x is not None
    assert u is not None
    return x, u


def _is_stage_cost(f: object) -> bool:
    """Whether ``f`` is a function ``(x, u) -> scalar`` or ``(x, u, p) -> scalar``."""
    return isinstance(f, ca.Function) and f.n_in() in (2, 3) and (f.n_out(), f.numel_out(0)) == (1, 1)


def _block_lengths(blocks: object, horizon: int) -> tuple[int, ...]:
    """Lengths of move blocks that fit the horizon."""
    given = tuple(blocks) if isinstance(blocks, tuple | list | np.ndarray) else ()
    lengths = tuple(whole(length, "blocks: a length [periods]", 1, horizon) for length in given)
    if sum(lengths) != horizon:
        raise InputError(
            f"blocks: must be positive integers that sum to the horizon of {horizon}, got {blocks!r:.80}"
            " [HM-CONTROL-026]"
        )
    return lengths


def _terminal_matrix(value: ArrayLike, n_x: int) -> Array | Literal["riccati"]:
    """``"riccati"``, or a finite, symmetric, positive semi-definite ``(n_x, n_x)`` matrix."""
    if isinstance(value, str) and value == "riccati":
        return "riccati"
    if isinstance(value, str):
        raise InputError(
            f"terminal: must be 'riccati' or an ({n_x}, {n_x}) matrix, got {value!r} [HM-CONTROL-027]"
        )
    matrix = numbers(value, "terminal", most=LARGEST).reshape(np.shape(value))
    fits = matrix.shape == (n_x, n_x) and bool(np.all(np.isfinite(matrix)))
    size = np.sqrt(np.abs(np.diag(matrix))) if fits else np.ones(n_x)
    size = np.where(size > 0, size, 1.0)
    scaled = matrix / np.outer(size, size) if fits else matrix  # entries have different units
    if not fits or not np.allclose(scaled, scaled.T):
        raise InputError(
            f"terminal: must be a finite symmetric ({n_x}, {n_x}) matrix, got shape {matrix.shape} [HM-CONTROL-028]"
        )
    if np.min(np.linalg.eigvalsh(scaled)) < -1e-9 * float(np.max(np.abs(scaled))):
        raise InputError(
            "terminal: must be positive semi-definite, but has a negative eigenvalue [HM-CONTROL-029]"
        )
    return matrix
