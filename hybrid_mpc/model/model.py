"""HybridModel: the deployed model of a machine as CasADi functions, and functions of a single model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.model.disturbance import Disturbance, disturbance_matrices

Array = NDArray[np.float64]
Expression: TypeAlias = Any
"""A CasADi expression, of MX or of SX."""
ManyPoints: TypeAlias = Callable[..., tuple[Array, ...]]
"""``(x, h, u, w, p)``, each ``(n, size)``, to ``(x_next, h_next)`` and Jacobians ``(n, n_z, columns)``."""
SideBySide: TypeAlias = Callable[[int, Mapping[str, Sequence[str]]], ManyPoints]
"""Makes such a function for ``n`` points; the mapping gives the variables of each Jacobian, ``{"A": ("x", "h")}``."""
STEP_INPUTS = ("x", "h", "u", "w", "p")
STEP_OUTPUTS = ("x_next", "h_next")


@dataclass(frozen=True)
class Balance:
    """A balance of a quantity that a machine stores, e.g. of its energy, as defined by the prior.

    ``residual`` ``(x, xdot, u, w, p)`` [rate_unit] is the violation of the balance if the state changes at ``xdot``;
    zero along the prior's own flow. ``unit`` is that of the storage, e.g. ``"J"``.
    """

    name: str
    unit: str
    rate_unit: str
    residual: ca.Function


@dataclass(frozen=True)
class HybridModel:
    """A discrete-time model over the state ``x`` and the hidden state ``h``, all in SI units.

    ``h`` is the hidden state before ``(x_k, u_k)``; a prior's is empty (``n_h = 0``, 0 x 1). ``w`` are measured
    disturbances, ``p`` are the prior's parameters. Both may be empty; :attr:`w` and :attr:`p` are their nominal values.
    Unmeasured disturbances ``d`` are no argument of the functions: :attr:`disturbance_model` says where they are added.
    The fitted prior, the hybrid and an oracle share this interface. :meth:`of` makes a model from expressions.

    Args:
        name: e.g. ``"mopgrnn"``.
        dt: Model period [s].
        states: Signals of ``x``.
        inputs: Signals of ``u``.
        outputs: Signals of ``y``.
        step: ``(x, h, u, w, p) -> (x_next, h_next)``, columns n_x, n_h, n_u, n_w, n_p.
        xdot: ``(x, h, u, w, p) -> xdot``, with the network's correction.
        output: ``(x, u, w, p) -> y``.
        with_jacobian: ``(x, h, u, w, p) -> (x_next, h_next, A, B)`` with ``A`` of ``(x_next, h_next)`` by
            ``(x, h)`` and ``B`` by ``u``. Default: made from ``step`` by CasADi's own derivatives.
        side_by_side: The same at many points in one call, if that is faster than one call per point, e.g.
            :class:`nn_export.SideBySide` of a program. Default: none.
        disturbances: Signals of ``w``. Default: none.
        nominal_w: Values of ``w`` if none are given ``(n_w,)`` [their units]. Default: zeros.
        parameters: The prior's parameters with fitted values and bounds, in the order of ``p``. A network's correction
            does not depend on them. Default: none; then no diagnosis can name a changed parameter.
        covariance: Rows ``(n_p, n_p)`` of the covariance of the fitted values. Default: unknown.
        balances: Balances of energy, mass, heat, ... Default: none.
        delay_states: Number of leading entries of ``h`` that are delayed inputs, the oldest first; ``xdot`` and the
            balances then take the input that acts. Default 0.
        time_unit: The machine's unit of time [s] (:func:`~hybrid_mpc.data.scales.time_unit`), in which lengths of
            monitor and guard are counted. Default 1.
        nominal_x: State ``(n_x,)`` of the operating point: an equilibrium with ``nominal_u`` and ``nominal_w``, and the
            default start of loops. Default: zeros.
        nominal_u: Input ``(n_u,)`` that holds it. Default: zeros.
        disturbance_model: Where unmeasured disturbances are added. Default: one at each input.
        state_spread: Spread of the states ``(n_x,)`` in the recordings, by which controllers scale
            (:class:`~hybrid_mpc.control.sizes.Sizes`); 0 for an unknown one. Default: unknown.
        output_spread: Likewise of the outputs ``(n_y,)``.

    Raises:
        InputError: If the functions' shapes do not fit the signals and parameters.

    Example:
        >>> x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", 0), ca.MX.sym("u")
        >>> w, p = ca.MX.sym("w", 0), ca.MX.sym("p")
        >>> rhs = ca.vertcat(x[1], u / p)
        >>> model = HybridModel(
        ...     "cart", 0.1, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        ...     step=ca.Function("step", [x, h, u, w, p], [x + 0.1 * rhs, h]),
        ...     xdot=ca.Function("xdot", [x, h, u, w, p], [rhs]),
        ...     output=ca.Function("output", [x, u, w, p], [x[0]]),
        ...     parameters=(Parameter("m", 2.0, "kg", 1.0, 4.0),))
        >>> model.n_x, model.n_h, model.n_u, model.n_w, model.n_p
        (2, 0, 1, 0, 1)
        >>> x_next, h_next = model.step([0.0, 1.0], [], 3.0, model.w, model.p)
        >>> x_next
        DM([0.1, 1.15])
    """

    name: str
    dt: float
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    step: ca.Function = field(repr=False)
    xdot: ca.Function = field(repr=False)
    output: ca.Function = field(repr=False)
    with_jacobian: ca.Function = field(default=None, repr=False)  # type: ignore[assignment]  # made if missing
    side_by_side: SideBySide | None = field(default=None, repr=False)
    disturbances: tuple[Signal, ...] = ()
    nominal_w: tuple[float, ...] = ()
    parameters: tuple[Parameter, ...] = field(default=(), repr=False)
    covariance: tuple[tuple[float, ...], ...] = field(default=(), repr=False)
    balances: tuple[Balance, ...] = field(default=(), repr=False)
    delay_states: int = 0
    time_unit: float = 1.0
    nominal_x: tuple[float, ...] = ()
    nominal_u: tuple[float, ...] = ()
    disturbance_model: tuple[Disturbance, ...] | None = None
    state_spread: tuple[float, ...] = ()
    output_spread: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("dt", "time_unit"):
            if not getattr(self, name) > 0:
                raise InputError(
                    f"model {self.name}: {name} must be positive, got {getattr(self, name)} [HM-MODEL-026]"
                )
        x, h, u, y = (self.n_x, 1), (self.n_h, 1), (self.n_u, 1), (self.n_y, 1)
        w, p = (self.n_w, 1), (self.n_p, 1)
        _check(self.name, "step", self.step, [x, h, u, w, p], [x, h])
        _check(self.name, "xdot", self.xdot, [x, h, u, w, p], [x])
        _check(self.name, "output", self.output, [x, u, w, p], [y])
        for balance in self.balances:
            _check(self.name, f"balance {balance.name}", balance.residual, [x, x, u, w, p], [(1, 1)])
        with_jacobian = self.with_jacobian or with_slopes(self.step)
        object.__setattr__(self, "with_jacobian", with_jacobian)
        n_z = self.n_x + self.n_h
        slopes = [(n_z, n_z), (n_z, self.n_u)]
        _check(self.name, "with_jacobian", with_jacobian, [x, h, u, w, p], [x, h, *slopes])
        for name, size in (("nominal_x", self.n_x), ("nominal_u", self.n_u), ("nominal_w", self.n_w)):
            object.__setattr__(self, name, tuple(getattr(self, name)) or (0.0,) * size)
        _check_numbers(self)
        _ = self.disturbed  # raises for an unknown signal

    @classmethod
    def of(
        cls,
        name: str,
        dt: float,
        states: Sequence[Signal],
        inputs: Sequence[Signal],
        outputs: Sequence[Signal],
        *,
        x: Expression,
        u: Expression,
        x_next: Expression,
        xdot: Expression,
        y: Expression,
        h: Expression | None = None,
        h_next: Expression | None = None,
        w: Expression | None = None,
        p: Expression | None = None,
        rate: Expression | None = None,
        energy: Expression | None = None,
        with_jacobian: ca.Function | None = None,
        disturbances: Sequence[Signal] = (),
        nominal_w: Sequence[float] = (),
        parameters: Sequence[Parameter] = (),
        nominal_x: Sequence[float] = (),
        nominal_u: Sequence[float] = (),
        disturbance_model: tuple[Disturbance, ...] | None = None,
    ) -> HybridModel:
        """A model from CasADi expressions, MX or SX.

        Args:
            name: Its name.
            dt: Model period [s].
            states: Signals of ``x``.
            inputs: Signals of ``u``.
            outputs: Signals of ``y``.
            x: Symbol of the state ``(n_x,)``.
            u: Symbol of the input ``(n_u,)``.
            x_next: The state one period later.
            xdot: Its rate.
            y: The outputs.
            h: Symbol of the hidden state ``(n_h,)``. Default: none.
            h_next: The hidden state one period later. Default: unchanged.
            w: Symbol of the disturbances ``(n_w,)``. Default: none.
            p: Symbol of the parameters ``(n_p,)``. Default: none.
            rate: Symbol ``(n_x,)`` of any rate of the state, for ``energy``.
            energy: Residual [W] of the energy balance if the state changes at ``rate``. Default: no balance.
            with_jacobian: See :class:`HybridModel`.
            disturbances: Signals of ``w``.
            nominal_w: See :class:`HybridModel`.
            parameters: The parameters ``p``.
            nominal_x: See :class:`HybridModel`.
            nominal_u: See :class:`HybridModel`.
            disturbance_model: See :class:`HybridModel`.

        Raises:
            InputError: If an expression contains another symbol, or shapes do not fit.

        Example:
            >>> x, u = ca.MX.sym("x"), ca.MX.sym("u")
            >>> level = (Signal("x", "m"),)
            >>> tank = HybridModel.of(
            ...     "tank", 1.0, level, (Signal("u", "m/s"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
            >>> tank.n_h, float(tank.step(0.5, [], 0.25, tank.w, tank.p)[0])
            (0, 0.75)
        """
        h, w, p = (type(x).sym(key, 0) if s is None else s for key, s in zip("hwp", (h, w, p), strict=True))
        rates = type(x).sym("rate", x.shape[0]) if rate is None else rate
        point = [x, h, u, w, p]

        def function(key: str, given: list[Expression], values: list[Expression]) -> ca.Function:
            try:
                return ca.Function(key, given, [ca.densify(v) for v in values])
            except RuntimeError as error:
                raise InputError(
                    f"model {name}: {key} must be an expression of the given symbols (x, u; h, w, p, rate if given): "
                    f"{str(error).strip().splitlines()[-1]} [HM-MODEL-027]"
                ) from error

        step = function("step", point, [x_next, h if h_next is None else h_next])
        return cls(
            name, dt, tuple(states), tuple(inputs), tuple(outputs), step=step,
            xdot=function("xdot", point, [xdot]),
            output=function("output", [x, u, w, p], [y]), with_jacobian=with_jacobian or with_slopes(step),
            disturbances=tuple(disturbances), nominal_w=tuple(nominal_w), parameters=tuple(parameters),
            balances=()
            if energy is None
            else (Balance("energy", "J", "W", function("energy", [x, rates, u, w, p], [energy])),),
            nominal_x=tuple(nominal_x), nominal_u=tuple(nominal_u), disturbance_model=disturbance_model,
        )  # fmt: skip

    @property
    def n_x(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def n_h(self) -> int:
        """Number of hidden states."""
        return int(self.step.size1_in(1))

    @property
    def n_w(self) -> int:
        """Number of disturbances."""
        return len(self.disturbances)

    @property
    def n_p(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def n_d(self) -> int:
        """Number of unmeasured disturbances."""
        return int(self.disturbed[0].shape[1])

    @cached_property
    def disturbed(self) -> tuple[Array, Array, Array]:
        """Effect of unmeasured disturbances: matrices of ``d`` on ``u`` ``(n_u, n_d)``, on ``x_next`` ``(n_x, n_d)``
        and on ``y`` ``(n_y, n_d)``.
        """
        return disturbance_matrices(self.disturbance_model, self.inputs, self.states, self.outputs, self.dt)

    def acting(self, u: Array, d: Array, w: Array) -> Array:
        """All inputs of a period ``(N, n_v)``: ``u`` ``(N, n_u)`` with the effect of ``d`` ``(n_d,)``, then ``w``
        ``(N, n_w)`` if any, then the effect of ``d`` on the next states if any.
        """
        on_u, on_x, _ = self.disturbed
        parts = [u + d if self.disturbance_model is None else u + on_u @ d]
        if self.n_w:
            parts.append(np.broadcast_to(w, (len(u), self.n_w)))
        if np.any(on_x):
            parts.append(np.broadcast_to(on_x @ d, (len(u), self.n_x)))
        return parts[0] if len(parts) == 1 else np.hstack(parts)

    @property
    def n_v(self) -> int:
        """Number of columns of :meth:`acting`."""
        return self.n_u + self.n_w + (self.n_x if np.any(self.disturbed[1]) else 0)

    @property
    def x0(self) -> Array:
        """State ``(n_x,)`` of the operating point."""
        return np.array(self.nominal_x, dtype=np.float64)

    @property
    def u0(self) -> Array:
        """Input ``(n_u,)`` of the operating point."""
        return np.array(self.nominal_u, dtype=np.float64)

    @property
    def w(self) -> Array:
        """Measured disturbances ``(n_w,)`` of the operating point, used if none are given."""
        return np.array(self.nominal_w, dtype=np.float64)

    @property
    def p(self) -> Array:
        """Fitted values ``(n_p,)`` of the parameters."""
        return np.array([parameter.value for parameter in self.parameters], dtype=np.float64)


def output_with_jacobian(model: HybridModel) -> ca.Function:
    """Output ``(n_y,)`` of a model at ``(x, u, w)`` and its dense Jacobians by ``x`` and by ``u``."""
    x, u, w = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u), ca.MX.sym("w", model.n_w)
    y = model.output(x, u, w, model.p)
    return ca.Function(
        "output_with_jacobian", [x, u, w],
        [ca.densify(y), ca.densify(ca.jacobian(y, x)), ca.densify(ca.jacobian(y, u))],
    )  # fmt: skip


def longer_period(model: HybridModel, periods: int) -> HybridModel:
    """The same model with a period that is a multiple of its own; input and disturbance are held over it.

    One step is ``periods`` steps of the model, and its Jacobian their chain: nothing is discretised again. Estimator,
    controller and closed loop then run at the longer period: costs are summed over its instants, ``du_max`` and
    ``r_delta`` apply to its changes, bounds on states hold at its instants and not between them, and a filter's noise
    is that of a longer period.

    Args:
        model: The deployed model.
        periods: Periods of the model per new period, at least 1.

    Raises:
        InputError: If ``periods`` is not a whole number of at least 1.

    Example:
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of(
        ...     "sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=0.5 * x + u, xdot=u, y=x)
        >>> slow = longer_period(model, 3)
        >>> slow.dt, float(slow.step(8.0, [], 1.0, slow.w, slow.p)[0])
        (3.0, 2.75)
    """
    if not isinstance(periods, int) or periods < 1:
        raise InputError(
            f"model {model.name}: periods must be an integer of at least 1, got {periods} [HM-MODEL-028]"
        )
    point = step_symbols(model)
    by_value, by_jacobian, held = point[:2], point[:2], point[2:]
    a, b = ca.MX.eye(model.n_x + model.n_h), ca.MX.zeros(model.n_x + model.n_h, model.n_u)
    for _ in range(periods):
        by_value = inlined(model.step, [*by_value, *held])
        *by_jacobian, a_k, b_k = inlined(model.with_jacobian, [*by_jacobian, *held])
        a, b = a_k @ a, a_k @ b + b_k
    return replace(
        model,
        dt=periods * model.dt,
        step=step_function("step", point, by_value),
        with_jacobian=step_function("with_jacobian", point, [*by_jacobian, ca.densify(a), ca.densify(b)]),
        side_by_side=None,  # the model's own only covers its own period
    )


def prior_acceleration(model: HybridModel, prior: HybridModel | None = None) -> ca.Function:
    """Acceleration ``(x, u, w, p) -> a`` ``(n_q,)`` of a model's prior, without the network.

    ``prior`` is the model of the prior alone. Default: the model itself, if it has no network.
    """
    if prior is None:
        if model.n_h > model.delay_states:
            raise InputError(
                f"model {model.name} has a network, but its parameters are those of its prior. Give prior=, the model "
                'of the prior alone, e.g. kit.models["prior"]. [HM-MODEL-029]'
            )
        prior = model
    if prior.parameters != model.parameters or not model.n_p:
        own, other = ([p.name for p in m.parameters] for m in (model, prior))
        raise InputError(
            f"model {model.name} has the parameters {own}, but its prior {prior.name} has {other}. Both need the same "
            "parameters, as in models of one artifact (hybrid-mpc run). [HM-MODEL-030]"
        )
    n_q, point = prior.n_x // 2, step_symbols(prior)
    x, _, u, w, p = point
    a = prior.xdot(x, ca.DM.zeros(prior.n_h), u, w, p)[n_q : 2 * n_q]
    return ca.Function("acceleration", [x, u, w, p], [ca.densify(a)])


def kinematics(model: HybridModel) -> dict[int, int]:
    """Indices of states that are the rates of others, by the indices of these: speeds by their positions.

    A rate counts as a state if it equals that state exactly at random points: ``{0: 1}`` for ``x = (q, q_dot)``.
    """
    point = step_symbols(model)
    x, h, u, w, _ = point
    rates = model.xdot(*point)
    slopes = ca.Function("slopes", point, [rates, ca.densify(ca.jacobian(rates, ca.vertcat(x, h, u, w)))])
    rng = np.random.default_rng(0)
    found: dict[int, int] = {}
    scale = np.where(model.x0 != 0, np.abs(model.x0), 1.0)
    for trial in range(3):
        x_k = model.x0 + 0.3 * scale * rng.uniform(-1, 1, model.n_x)
        u_k = model.u0 + 0.3 * rng.uniform(-1, 1, model.n_u)
        h_k = 0.3 * rng.uniform(-1, 1, model.n_h)
        value, jacobian = (m.full() for m in slopes(x_k, h_k, u_k, model.w, model.p))
        now = {
            i: int(np.argmax(row))
            for i, row in enumerate(jacobian)
            if np.array_equal(row, np.eye(row.size)[np.argmax(row)])
            and np.argmax(row) < model.n_x
            and value[i, 0] == x_k[np.argmax(row)]
        }
        found = now if trial == 0 else {i: j for i, j in found.items() if now.get(i) == j}
    return {i: j for i, j in found.items() if i != j}


def positions_of(model: HybridModel) -> int:
    """Number ``n_q`` of positions of a model whose state is ``[q, v]`` with ``q_dot = v``.

    Raises:
        InputError: If its states are anything else.

    Example:
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m"),)
        >>> tank = HybridModel.of("tank", 0.1, level, (Signal("u", "m/s"),), level,
        ...     x=x, u=u, x_next=x + 0.1 * (u - x), xdot=u - x, y=x)
        >>> positions_of(tank)
        Traceback (most recent call last):
            ...
        hybrid_mpc.errors.InputError: model tank: its states (x) must be positions followed by their speeds...
    """
    n_q = model.n_x // 2
    if not n_q or kinematics(model) != {i: n_q + i for i in range(n_q)} or model.n_x != 2 * n_q:
        raise InputError(
            f"model {model.name}: its states ({', '.join(s.name for s in model.states)}) must be positions followed by "
            "their speeds; friction and working speeds are only defined for these [HM-MODEL-031]"
        )
    return n_q


def changeable(model: HybridModel) -> tuple[str, ...]:
    """Properties of a prior that may change: its parameters, and the gain of each input."""
    return (*(p.name for p in model.parameters), *(f"gain of {s.name}" for s in model.inputs))


def incidence(model: HybridModel, groups: Mapping[str, Sequence[str]], what: str) -> Array:
    """Which of the :func:`changeable` properties each group changes ``(n_p + n_u, groups)``: 1, else 0."""
    known = changeable(model)
    matrix = np.zeros((len(known), len(groups)))
    for j, names in enumerate(groups.values()):
        for name in names:
            if name not in known:
                raise InputError(
                    f"{what}: no parameter {name!r}; known names: {', '.join(known)} [HM-MODEL-032]"
                )
            matrix[known.index(name), j] = 1.0
    return matrix


def step_symbols(model: HybridModel) -> list[ca.MX]:
    """Symbols ``x, h, u, w, p`` of a model's step."""
    sizes = model.n_x, model.n_h, model.n_u, model.n_w, model.n_p
    return [ca.MX.sym(name, n) for name, n in zip(STEP_INPUTS, sizes, strict=True)]


def step_function(name: str, point: Sequence[ca.MX], values: Sequence[ca.MX]) -> ca.Function:
    """A function of ``x, h, u, w, p`` with the names of a step, with or without its Jacobians."""
    outputs = [*STEP_OUTPUTS, "A", "B"][: len(values)]
    return ca.Function(name, list(point), list(values), [*STEP_INPUTS], outputs)


def inlined(f: ca.Function, point: Sequence[Expression]) -> list[Expression]:
    """Results of a function for symbols; a function of MX graphs is inlined, which saves a call."""
    return list(f.call(list(point), f.is_a("MXFunction"), False))


def at_arguments(
    model: HybridModel, point: Sequence[ca.MX], given: Sequence[ca.MX], **changes: Any
) -> HybridModel:
    """The model as a function of other symbols ``point``, ``x, h, u, w, p``, with ``changes`` of other fields.

    Its own arguments are ``given``, expressions of these symbols.
    """
    x, _, u, w, p = point
    own_x, _, own_u, own_w, own_p = given
    rate = ca.MX.sym("rate", model.n_x)
    outer, inner = [x, u, w, p], [own_x, own_u, own_w, own_p]
    balances = [inlined(b.residual, [own_x, rate, *inner[1:]]) for b in model.balances]
    return replace(
        model,
        step=step_function("step", point, inlined(model.step, given)),
        xdot=ca.Function("xdot", list(point), inlined(model.xdot, given), [*STEP_INPUTS], ["xdot"]),
        output=ca.Function("output", outer, inlined(model.output, inner), ["x", "u", "w", "p"], ["y"]),
        with_jacobian=step_function("with_jacobian", point, inlined(model.with_jacobian, given)),
        balances=tuple(
            replace(b, residual=ca.Function("residual", [x, rate, u, w, p], residual))
            for b, residual in zip(model.balances, balances, strict=True)
        ),
        **changes,
    )


def with_slopes(step: ca.Function) -> ca.Function:
    """A model's ``with_jacobian`` from its ``step``."""
    point = [ca.MX.sym(name, step.size1_in(i)) for i, name in enumerate(STEP_INPUTS)]
    x, h, u = point[:3]
    x_next, h_next = inlined(step, point)  # twice as fast as the derivative of a call
    z = ca.vertcat(x_next, h_next)
    a = ca.densify(ca.horzcat(ca.jacobian(z, x), ca.jacobian(z, h)))
    b = ca.densify(ca.jacobian(z, u))
    return step_function("with_jacobian", point, [x_next, h_next, a, b])


def _check_numbers(model: HybridModel) -> None:
    n_p = model.n_p
    for name, size in (("nominal_x", model.n_x), ("nominal_u", model.n_u), ("nominal_w", model.n_w)):
        values = getattr(model, name)
        if len(values) != size or not all(map(math.isfinite, values)):
            raise InputError(
                f"model {model.name}: {name} must have {size} finite values, got {values} [HM-MODEL-033]"
            )
    for name, size in (("state_spread", model.n_x), ("output_spread", model.n_y)):
        values = getattr(model, name)
        if values and (len(values) != size or not all(math.isfinite(v) and v >= 0 for v in values)):
            raise InputError(
                f"model {model.name}: {name} must have {size} finite values of at least 0, or none, got {values}"
                " [HM-MODEL-034]"
            )
    if model.covariance and [len(row) for row in model.covariance] != [n_p] * n_p:
        raise InputError(
            f"model {model.name}: covariance must have {n_p} rows of {n_p} values, one per parameter [HM-MODEL-035]"
        )
    for what, names in (
        ("parameters", [p.name for p in model.parameters]), ("balances", [b.name for b in model.balances])
    ):  # fmt: skip
        if len(set(names)) < len(names):
            raise InputError(
                f"model {model.name}: {what} must have different names, got {', '.join(names)} [HM-MODEL-036]"
            )
    if not 0 <= model.delay_states <= model.n_h or model.delay_states % model.n_u:
        raise InputError(
            f"model {model.name}: delay_states must be a multiple of the inputs and at most the "
            f"{model.n_h} entries of h, got {model.delay_states} [HM-MODEL-037]"
        )


def _check(
    model: str, name: str, f: ca.Function, ins: list[tuple[int, int]], outs: list[tuple[int, int]]
) -> None:
    given = [f.size_in(i) for i in range(f.n_in())], [f.size_out(i) for i in range(f.n_out())]
    if given != (ins, outs):
        raise InputError(
            f"model {model}: {name} takes {given[0]} and returns {given[1]}, "
            f"but its signals need {ins} and {outs} [HM-MODEL-038]"
        )
