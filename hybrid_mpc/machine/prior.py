"""The prior of a machine: an ODE with outputs and balances, written in CasADi. Does not import torch.

:class:`Prior` is the base class. :class:`~hybrid_mpc.machine.torch_prior.TorchPrior` takes the same methods written in
torch, :class:`~hybrid_mpc.machine.mechanical.MechanicalPrior` the parts of an equation of motion. Every prior becomes
:class:`Equations`: CasADi functions, used by fit, training, estimator and controller.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError, no_exit
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Name, Number, Unit

Array = NDArray[np.float64]
POINT = ("x", "u", "w", "p")
"""Arguments of a prior's equations: states, inputs, measured disturbances, parameters."""


_KINDS: dict[str, type] = {
    "states": Signal, "inputs": Signal, "outputs": Signal, "disturbances": Signal, "parameters": Parameter,
}  # fmt: skip


@dataclass(frozen=True)
class Balance:
    """A conserved quantity that the machine stores: ``dS/dt = supply - loss``.

    Args:
        name: e.g. ``"energy"``, ``"mass"``, ``"heat"``.
        storage: Stored amount S(x) [unit].
        supply: Supplied amount per time [rate_unit], of either sign.
        loss: Lost amount per time [rate_unit], not negative. Default: zero.
        unit: Unit of the storage. Default: J.
        rate_unit: Unit of supply and loss. Default: W.

    Raises:
        InputError: If the name or a unit is invalid.

    Example:
        >>> Balance("mass", storage=2.0, supply=0.1, unit="kg", rate_unit="kg/s").loss
        0.0
    """

    name: Name
    storage: Any
    supply: Any
    loss: Any = 0.0
    unit: Unit = "J"
    rate_unit: Unit = "W"

    def __post_init__(self) -> None:
        Fields(self, f"balance {self.name!r}").refuse()


@dataclass(frozen=True)
class OperatingPoint:
    """An equilibrium at which a machine works.

    Args:
        x: States ``(n_x,)`` [their units].
        u: Inputs ``(n_u,)`` that hold the states.
        w: Measured disturbances ``(n_w,)`` there. Default: none.

    Example:
        >>> OperatingPoint(x=(0.1, 0.2), u=(3.0,)).w
        ()
    """

    x: tuple[Number, ...]
    u: tuple[Number, ...]
    w: tuple[Number, ...] = ()

    def __post_init__(self) -> None:
        Fields(self, "operating point").refuse()


class Prior:
    """Any ODE ``xdot = f(x, u, w; p)`` with outputs ``y = g(x, u, w; p)``, written in CasADi.

    A subclass names its signals and parameters as class attributes and defines :meth:`xdot`, and :meth:`output` and
    :meth:`balances` unless the defaults apply. Each method takes four named tuples of scalar expressions, in the order
    of the signals: ``x.level`` or ``level, flow = x``. It returns a tuple of scalars, one per state or output.

    Attributes:
        states: Signals of ``x``. They need not be measured.
        inputs: Signals of ``u``, the commands of a controller.
        outputs: Signals of ``y``, measured by sensors.
        disturbances: Signals of ``w``: measured, but not commanded. Default: none.
        parameters: The parameters ``p`` with values, bounds and units. Default: none.
        corrects: Names of the states whose rates a network may correct. Default: all. Leave out states with exact
            rates, such as positions.
        operating_point: An equilibrium at which the machine works. Default: unknown.
        methods: Methods with the prior's equations, and the arguments of each.

    Args:
        values: Parameter values [their units] by name that replace nominal ones, e.g. fitted values.

    Raises:
        InputError: If a name in ``values`` is no parameter, a role has no signals, or the operating point does not have
            one number for each of them; and, when the class is defined, if
            a signal or parameter is of another type.

    Example:
        >>> class Tank(Prior):
        ...     states = (Signal("level", "m", 0.0, 1.0),)
        ...     inputs = (Signal("inflow", "m^3/s"),)
        ...     outputs = (Signal("level", "m"),)
        ...     parameters = (Parameter("area", 2.0, "m^2", 1.0, 4.0), Parameter("k", 0.1, "m^2.5/s", 0.0, 1.0))
        ...
        ...     def xdot(self, x, u, w, p):
        ...         return ((u.inflow - p.k * ca.sqrt(ca.fmax(x.level, 1e-6))) / p.area,)
        ...
        ...     def balances(self, x, u, w, p):
        ...         out = p.k * ca.sqrt(ca.fmax(x.level, 1e-6))
        ...         return (Balance("volume", p.area * x.level, u.inflow, out, "m^3", "m^3/s"),)
        >>> tank = Tank({"k": 0.2})
        >>> tank.equations.xdot(0.25, 0.1, [], tank.p)
        DM(0)
    """

    states: ClassVar[tuple[Signal, ...]]
    inputs: ClassVar[tuple[Signal, ...]]
    outputs: ClassVar[tuple[Signal, ...]]
    disturbances: ClassVar[tuple[Signal, ...]] = ()
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    corrects: ClassVar[tuple[str, ...] | None] = None
    operating_point: ClassVar[OperatingPoint | None] = None
    methods: ClassVar[Mapping[str, tuple[str, ...]]] = {"xdot": POINT, "output": POINT, "balances": POINT}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for role, kind in _KINDS.items():
            given = vars(cls).get(role, ())
            if not isinstance(given, tuple) or not all(isinstance(one, kind) for one in given):
                one = kind.__name__
                raise InputError(
                    f"{cls.__name__}: {role} must be a tuple of {one}, as ({one}(...), {one}(...)), got {given!r:.80}"
                    " [HM-MACHINE-005]"
                )

    def __init__(self, values: Mapping[str, float] | None = None) -> None:
        kind = type(self).__name__
        if not isinstance(values, Mapping | None):
            raise InputError(
                f"{kind}: values must be a mapping (name: number), got {values!r:.80} [HM-MACHINE-006]"
            )
        given = dict(values or {})
        if wrong := {k: v for k, v in given.items() if v is None or isinstance(v, bool | str)}:
            raise InputError(f"{kind}: values must be numbers, got {wrong!r:.80} [HM-MACHINE-007]")
        missing = [role for role in ("states", "inputs", "outputs") if not hasattr(self, role)]
        if missing:
            raise InputError(
                f"{kind} has no {' and no '.join(missing)}. Write {missing[0]} = (Signal(name, unit), ...) in the "
                "class. [HM-MACHINE-008]"
            )
        self._check_point(kind)
        self._values = {p.name: float(given.pop(p.name, p.value)) for p in self.parameters}
        if given:
            raise InputError(
                f"{kind} has no parameter {', '.join(given)}; it has {', '.join(self._values) or 'none'}"
                " [HM-MACHINE-009]"
            )

    def _check_point(self, kind: str) -> None:
        """Check that the operating point has one number for each signal."""
        point: Any = self.operating_point
        if not isinstance(point, OperatingPoint | None):
            raise InputError(
                f"{kind}: operating_point must be OperatingPoint(x=(...), u=(...)), got {point!r:.80} [HM-MACHINE-048]"
            )
        for key in "xuw" if point else "":
            names, given = self.names_of(key), getattr(point, key)
            if len(given) != len(names) and (given or key != "w"):  # without w: the middle of its range
                of_terms = (
                    ". The states of terms belong to the class that extended(...) returns: set its operating_point "
                    "after that line" if key == "x" and len(given) > len(names) else ""
                )  # fmt: skip
                raise InputError(
                    f"{kind}: operating_point: {key} must have {len(names)} numbers "
                    f"({', '.join(names) or 'none'}), got {len(given)}: {given}{of_terms} [HM-MACHINE-049]"
                )

    @property
    def values(self) -> dict[str, float]:
        """Current parameter values [their units] by name."""
        return dict(self._values)

    @property
    def p(self) -> Array:
        """Current parameter values ``(n_p,)`` in the order of ``parameters``."""
        return np.array(list(self._values.values()), dtype=np.float64)

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the states: a tuple with one scalar per state."""
        raise NotImplementedError(f"{type(self).__name__} must define xdot(x, u, w, p)")

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Measured outputs: a tuple with one scalar per output. Default: the states of the same names."""
        at = {state.name: component for state, component in zip(self.states, x, strict=True)}
        unknown = [output.name for output in self.outputs if output.name not in at]
        if unknown:
            raise InputError(
                f"{type(self).__name__}: no state is called {', '.join(unknown)} like the output; the states are "
                f"{', '.join(at)}. Define output(x, u, w, p), or give the output the name of the state it measures."
                " [HM-MACHINE-010]"
            )
        return tuple(at[output.name] for output in self.outputs)

    def balances(self, x: Any, u: Any, w: Any, p: Any) -> tuple[Balance, ...]:
        """Balances of the stored quantities. Default: none, which excludes the MOPGRNN."""
        return ()

    @property
    def corrected(self) -> tuple[int, ...]:
        """Indices in ``x`` of the states whose rates a network may correct; InputError if a name is no state."""
        names, kind = [s.name for s in self.states], type(self).__name__
        if isinstance(self.corrects, str):
            raise InputError(
                f"{kind}: corrects must be a tuple of names, e.g. ({self.corrects!r},) [HM-MACHINE-011]"
            )
        chosen = names if self.corrects is None else self.corrects
        unknown = [name for name in chosen if name not in names]
        if unknown:
            raise InputError(
                f"{kind}: corrects names {', '.join(unknown)}, but the states are {', '.join(names)} [HM-MACHINE-012]"
            )
        return tuple(i for i, name in enumerate(names) if name in chosen)

    @property
    def kinematics(self) -> tuple[tuple[int, int], ...]:
        """Pairs of indices in ``x``: a state whose rate is another state, and that state (position and speed).

        Example:
            >>> from scenarios.pendulum.prior import PendulumPrior
            >>> PendulumPrior().kinematics
            ((0, 1),)
        """
        point = [ca.SX.sym(key, len(self.names_of(key))) for key in POINT]
        rates = self.equations.xdot(*point)
        slopes = ca.jacobian(rates, ca.vertcat(*point))
        found = []
        for i in range(rates.numel()):
            row = slopes[i, :]
            places = row.sparsity().get_col()
            if len(places) == 1 and places[0] < len(self.states) and ca.is_equal(row.nz[0], ca.SX(1)):
                found.append((i, places[0]))
        return tuple(found)

    @property
    def equations(self) -> Equations:
        """The prior as CasADi functions of ``(x, u, w, p)``; cached for equal priors."""
        return _equations(_Alike(self))

    def expressions(self, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[Any, Any, tuple[Balance, ...]]:
        """Rates of the states, outputs and balances for columns of expressions."""
        given = tuple(zip(POINT, (x, u, w, p), strict=True))
        return self.evaluated("xdot", *given), self.evaluated("output", *given), self._balances(*given)

    def _balances(self, *given: tuple[str, ca.SX]) -> tuple[Balance, ...]:
        found = self.evaluated("balances", *given)
        if not isinstance(found, tuple | list) or not all(isinstance(b, Balance) for b in found):
            raise InputError(
                f"{type(self).__name__}.balances(x, u, w, p) must give a tuple of Balance(...), got {found!r:.80}"
                " [HM-MACHINE-013]"
            )
        return tuple(found)

    def evaluated(self, method: str, *arguments: tuple[str, ca.SX]) -> Any:
        """The result of a method for expressions: nested tuples of scalars, and balances.

        Args:
            method: Its name.
            arguments: Name and expression ``(n,)`` of each argument; the name determines its components
                (:meth:`names_of`).

        Raises:
            InputError: If the method uses operations that only torch's tensors support.
        """
        given = (named(self.names_of(key), ca.vertsplit(v)) for key, v in arguments)
        try:
            with no_exit(f"{type(self).__name__}.{method}"):
                return getattr(self, method)(*given)
        except (TypeError, AttributeError) as error:
            if "Tensor" not in str(error) and "'SX' object" not in str(error):
                raise
            raise InputError(
                f"{type(self).__name__}.{method} gets CasADi expressions: {error}. A method written in torch needs a "
                "TorchPrior. [HM-MACHINE-014]"
            ) from error

    def names_of(self, argument: str) -> tuple[str, ...]:
        """Names of the components of ``x``, ``u``, ``w`` or ``p``."""
        signals: dict[str, tuple[Signal | Parameter, ...]] = {
            "x": self.states, "u": self.inputs, "w": self.disturbances, "p": self.parameters,
        }  # fmt: skip
        return tuple(s.name for s in signals[argument])


@dataclass(frozen=True)
class BalanceEquations:
    """A balance as CasADi functions of scalar operations.

    ``storage`` ``(x, p)`` [unit]; ``supply`` and ``loss`` ``(x, u, w, p)`` [rate_unit]; ``residual`` ``(x, xdot, u, w,
    p)`` [rate_unit] is ``dS/dx xdot - supply + loss``, in which rates that networks do not correct are the prior's own.
    """

    name: str
    unit: str
    rate_unit: str
    storage: ca.Function
    supply: ca.Function
    loss: ca.Function
    residual: ca.Function


@dataclass(frozen=True)
class Equations:
    """A prior as CasADi functions of scalar operations, with columns ``x, u, w, p`` as arguments.

    Args:
        xdot: ``(x, u, w, p) -> xdot (n_x,)``.
        output: ``(x, u, w, p) -> y (n_y,)``.
        balances: Its balances.
    """

    xdot: ca.Function
    output: ca.Function
    balances: tuple[BalanceEquations, ...]


def components(value: Any) -> list[Any]:
    """The scalars in a result of a prior's method: in nested tuples, a column, or a number."""
    if isinstance(value, tuple | list):
        return [scalar for part in value for scalar in components(part)]
    if isinstance(value, ca.SX | ca.DM) and value.numel() > 1:
        return list(ca.vertsplit(ca.reshape(ca.densify(value).T, -1, 1)))
    return [value]


def column(value: Any, n: int, what: str, names: Sequence[str] = ()) -> ca.SX:
    """A result of a prior's method as a column of ``n``; ``names`` of its components are used in messages."""
    try:
        found = ca.vertcat(*(ca.SX(v) for v in components(value)))
    except (NotImplementedError, TypeError) as error:
        raise InputError(
            f"{what} gives {type(value).__name__}, not a tuple of scalars. Check for a missing 'return'; a method "
            "written in torch needs a TorchPrior. [HM-MACHINE-015]"
        ) from error
    if found.shape[0] != n:
        each = f": one for each of {', '.join(names)} is needed" if names else ""
        raise InputError(f"{what} must give {n} values, got {found.shape[0]}{each} [HM-MACHINE-016]")
    return ca.densify(found)


@cache
def _tuple_of(names: tuple[str, ...]) -> Any:
    def missing(_: Any, name: str) -> Any:
        raise AttributeError(
            f"no component {name!r}; known names: {', '.join(names) or 'none'} [HM-MACHINE-044]"
        )

    # names that are no identifiers are only reachable by index
    bases = (namedtuple("named", names, rename=True),)
    return type("named", bases, {"__slots__": (), "__getattr__": missing})


def named(names: tuple[str, ...], parts: Sequence[Any]) -> Any:
    """Components with names: ``x.level`` or ``level, flow = x``."""
    return _tuple_of(names)(*parts[: len(names)])


class _Alike:
    """A prior as a cache key, without the values of its parameters. Two priors of one class are equal if their own
    attributes are equal numbers or texts; any other attribute makes a prior equal only to itself.
    """

    def __init__(self, prior: Prior) -> None:
        own = {name: value for name, value in vars(prior).items() if name != "_values"}
        simple = all(isinstance(value, bool | int | float | str) for value in own.values())
        self.prior = prior
        self._key = type(prior), prior.parameters, tuple(sorted(own.items())) if simple else id(prior)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Alike) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=32)
def _equations(alike: _Alike) -> Equations:
    prior, kind = alike.prior, type(alike.prior).__name__
    sizes = (len(prior.names_of(key)) for key in POINT)
    point = [ca.SX.sym(key, n) for key, n in zip(POINT, sizes, strict=True)]
    rates, outputs, balances = prior.expressions(*point)
    x_names, y_names = ([s.name for s in signals] for signals in (prior.states, prior.outputs))
    xdot = column(rates, len(x_names), f"{kind}.xdot(x, u, w, p)", x_names)
    y = column(outputs, len(y_names), f"{kind}.output(x, u, w, p)", y_names)
    names = [b.name for b in balances]
    if len(set(names)) < len(names):
        raise InputError(f"{kind}.balances(x, u, w, p): names must differ, got {names} [HM-MACHINE-017]")
    return Equations(
        ca.Function("xdot", point, [ca.cse(xdot)], [*POINT], ["xdot"]),
        ca.Function("output", point, [ca.cse(y)], [*POINT], ["y"]),
        tuple(_balance(prior, b, point, xdot) for b in balances),
    )


def _balance(prior: Prior, balance: Balance, point: list[ca.SX], xdot: ca.SX) -> BalanceEquations:
    what = f"{type(prior).__name__}: balance {balance.name}"
    storage, supply, loss = (
        column(getattr(balance, key), 1, f"{what}: {key}") for key in ("storage", "supply", "loss")
    )
    x, u, w, p = point
    if ca.depends_on(storage, ca.vertcat(u, w)):
        raise InputError(
            f"{what}: the storage must be a function of x and p only, but depends on u or w [HM-MACHINE-018]"
        )
    rate = ca.SX.sym("xdot", len(prior.states))
    corrected = set(prior.corrected)
    taken = ca.vertcat(*(rate[i] if i in corrected else xdot[i] for i in range(rate.numel())))
    residual = ca.gradient(storage, x).T @ taken - supply + loss
    held = [x, rate, u, w, p]
    return BalanceEquations(
        balance.name, balance.unit, balance.rate_unit,
        ca.Function("storage", [x, p], [ca.densify(storage)], ["x", "p"], ["storage"]),
        ca.Function("supply", point, [ca.densify(supply)], [*POINT], ["supply"]),
        ca.Function("loss", point, [ca.densify(loss)], [*POINT], ["loss"]),
        ca.Function("residual", held, [ca.cse(ca.densify(residual))], ["x", "xdot", "u", "w", "p"], ["residual"]),
    )  # fmt: skip
