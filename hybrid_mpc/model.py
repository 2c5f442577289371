"""HybridModel: the deployed model of a machine as CasADi functions. No torch in here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.signals import Signal

ManyPoints: TypeAlias = Callable[..., tuple[NDArray[np.float64], ...]]
"""``(x, h, u)``, each ``(n, size)``, to ``(x_next, h_next)`` and Jacobians ``(n, n_z, columns)``."""
SideBySide: TypeAlias = Callable[[int, Mapping[str, Sequence[str]]], ManyPoints]
"""Makes such a function: from ``n`` and, for each Jacobian, the inputs that it is by, ``{"A": ("x", "h")}``."""


@dataclass(frozen=True)
class HybridModel:
    """A discrete-time model over the state ``x`` and the hidden state ``h``, all in SI units.

    ``h`` is the hidden state before ``(x_k, u_k)``; it is empty (``n_h = 0``, 0 x 1) for a prior. The
    fitted prior, the hybrid and an oracle share this interface.

    Args:
        name: e.g. ``"mopgrnn"``.
        dt: Model period [s].
        states: Signals of ``x``, ``[q, v]``.
        inputs: Signals of ``u``.
        outputs: Signals of ``y``.
        step: ``(x, h, u) -> (x_next, h_next)``, columns n_x, n_h, n_u.
        xdot: ``(x, h, u) -> xdot`` at the instant, with the correction that ``(x, h, u)`` gives.
        output: ``(x, u) -> y``.
        energy_balance: ``(x, xdot, u) -> dE`` [W] of the prior; zero along the prior's own flow.
        with_jacobian: ``(x, h, u) -> (x_next, h_next, A, B)`` with ``A`` of ``(x_next, h_next)`` by
            ``(x, h)`` and ``B`` by ``u``. Default: made from ``step`` by CasADi's own derivatives.
        side_by_side: The same at many points in one call, where the model has a faster way than one call a
            point: what :class:`nn_export.SideBySide` makes of a program. Default: none.
        parameters: Values [SI] of the prior's parameters by name. Default: none.
        parametric: ``(x, u, p) -> a`` ``(n_q,)``: the prior's acceleration with its parameters, in the order of
            ``parameters``, as an input. Default: none; then nobody can tell what broke.
        waiting: Leading entries of ``h`` that are inputs on their way to the machine, the oldest first; ``xdot``,
            ``energy_balance`` and ``parametric`` then take the input that acts. Default 0: none waits.
        time_unit: The machine's second [s] (:func:`~hybrid_mpc.data.time_unit`): what the lengths of monitor and guard
            are counted in. Default 1.

    Raises:
        InputError: If the functions' shapes do not fit the signals.

    Example:
        >>> x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", 0), ca.MX.sym("u")
        >>> rhs, y, w = ca.vertcat(x[1], u), x[0], ca.MX.sym("w", 2)
        >>> model = HybridModel(
        ...     "double_integrator", 0.1,
        ...     (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        ...     step=ca.Function("step", [x, h, u], [x + 0.1 * rhs, h]),
        ...     xdot=ca.Function("xdot", [x, h, u], [rhs]),
        ...     output=ca.Function("output", [x, u], [y]),
        ...     energy_balance=ca.Function("energy_balance", [x, w, u], [(w[1] - u) * x[1]]))
        >>> model.n_x, model.n_h, model.n_u
        (2, 0, 1)
    """

    name: str
    dt: float
    states: tuple[Signal, ...]
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    step: ca.Function
    xdot: ca.Function
    output: ca.Function
    energy_balance: ca.Function
    with_jacobian: ca.Function | None = None
    side_by_side: SideBySide | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    parametric: ca.Function | None = None
    waiting: int = 0
    time_unit: float = 1.0

    def __post_init__(self) -> None:
        for name in ("dt", "time_unit"):
            if not getattr(self, name) > 0:
                raise InputError(f"model {self.name}: {name} must be positive, got {getattr(self, name)}")
        x, u, y = (self.n_x, 1), (self.n_u, 1), (len(self.outputs), 1)
        h = (self.n_h, 1)
        _check(self.name, "step", self.step, [x, h, u], [x, h])
        _check(self.name, "xdot", self.xdot, [x, h, u], [x])
        _check(self.name, "output", self.output, [x, u], [y])
        _check(self.name, "energy_balance", self.energy_balance, [x, x, u], [(1, 1)])
        with_jacobian = self.with_jacobian or _with_jacobian(self.step)
        object.__setattr__(self, "with_jacobian", with_jacobian)
        n_z = self.n_x + self.n_h
        _check(self.name, "with_jacobian", with_jacobian, [x, h, u], [x, h, (n_z, n_z), (n_z, self.n_u)])
        if not 0 <= self.waiting <= self.n_h or self.waiting % self.n_u:
            raise InputError(
                f"model {self.name}: waiting must be whole inputs within the {self.n_h} entries of h, "
                f"got {self.waiting}"
            )
        if self.parametric is not None:
            a = self.parametric.size_out(0)  # a prior may have states after [q, v]
            _check(self.name, "parametric", self.parametric, [x, u, (len(self.parameters), 1)], [a])

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


def longer_period(model: HybridModel, periods: int) -> HybridModel:
    """The same model with a period that is a multiple of its own; the input is held all the while.

    One step is ``periods`` steps of the model, the hidden state in each of them, and its Jacobian the chain of
    theirs, so nothing is discretised anew. Estimator, controller, terminal weight and closed loop made of it all run
    at the longer period: costs count its instants, ``du_max`` and ``r_delta`` its changes, and bounds on states hold
    at its instants, not between them. A filter's noise per period is that of the longer one.

    Args:
        model: The deployed model.
        periods: Periods of the model that make one of the new ones, at least 1.

    Raises:
        InputError: If ``periods`` is not a whole number of at least 1.

    Example:
        >>> x, h, u, w = ca.MX.sym("x"), ca.MX.sym("h", 0), ca.MX.sym("u"), ca.MX.sym("w")
        >>> model = HybridModel("sum", 1.0, (Signal("x", "-"),), (Signal("u", "-"),), (Signal("x", "-"),),
        ...     ca.Function("f", [x, h, u], [0.5 * x + u, h]), ca.Function("g", [x, h, u], [u]),
        ...     ca.Function("y", [x, u], [x]), ca.Function("e", [x, w, u], [w - u]))
        >>> slow = longer_period(model, 3)
        >>> slow.dt, float(slow.step(8.0, [], 1.0)[0])
        (3.0, 2.75)
    """
    if not isinstance(periods, int) or periods < 1:
        raise InputError(f"model {model.name}: periods must be a whole number of at least 1, got {periods}")
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    assert model.with_jacobian is not None
    inline = model.step.is_a("MXFunction"), model.with_jacobian.is_a("MXFunction")
    by_value, by_jacobian = [x, h], [x, h]
    a, b = ca.MX.eye(model.n_x + model.n_h), ca.MX.zeros(model.n_x + model.n_h, model.n_u)
    for _ in range(periods):
        by_value = model.step.call([*by_value, u], inline[0], False)
        *by_jacobian, a_k, b_k = model.with_jacobian.call([*by_jacobian, u], inline[1], False)
        a, b = a_k @ a, a_k @ b + b_k
    names = ["x", "h", "u"], ["x_next", "h_next"]
    return replace(
        model,
        dt=periods * model.dt,
        step=ca.Function("step", [x, h, u], by_value, *names),
        with_jacobian=ca.Function(
            "with_jacobian",
            [x, h, u],
            [*by_jacobian, ca.densify(a), ca.densify(b)],
            names[0],
            [*names[1], "A", "B"],
        ),
        side_by_side=None,  # that of the model knows one of its own periods only
    )


def _with_jacobian(step: ca.Function) -> ca.Function:
    x, h, u = (ca.MX.sym(name, step.size1_in(i)) for i, name in enumerate(("x", "h", "u")))
    # Differentiated inside the caller's graph where it is a graph of matrices: twice as fast as a call.
    x_next, h_next = step.call([x, h, u], step.is_a("MXFunction"), False)
    z = ca.vertcat(x_next, h_next)
    a = ca.densify(ca.horzcat(ca.jacobian(z, x), ca.jacobian(z, h)))
    b = ca.densify(ca.jacobian(z, u))
    names = ["x", "h", "u"], ["x_next", "h_next", "A", "B"]
    return ca.Function("with_jacobian", [x, h, u], [x_next, h_next, a, b], *names)


def _check(
    model: str, name: str, f: ca.Function, ins: list[tuple[int, int]], outs: list[tuple[int, int]]
) -> None:
    given = [f.size_in(i) for i in range(f.n_in())], [f.size_out(i) for i in range(f.n_out())]
    if given != (ins, outs):
        raise InputError(
            f"model {model}: {name} takes {given[0]} and returns {given[1]}, "
            f"its signals need {ins} and {outs}"
        )
