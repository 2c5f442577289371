"""Physical terms that can be added to any prior: friction, losses, curved characteristics of inputs and sensors, lags.

A :class:`Term` changes a prior by one to three parameters; it has no effect if they are zero. :func:`extended` gives
the prior with terms, which is used like any other prior; its balances contain what the terms store, supply and lose.
Each law is a function of this module. The laws that a prior may lack, with bounds from its recordings, are chosen by
:func:`hybrid_mpc.identify.term_library.library`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import casadi as ca

from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.machine import term_units
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import POINT, Balance, OperatingPoint, Prior, named
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Line, Name

Place: TypeAlias = Literal["force", "potential", "inertia", "rate", "input", "disturbance", "output"]
PLACES: tuple[Place, ...] = ("force", "potential", "inertia", "rate", "input", "disturbance", "output")
MECHANICAL: tuple[Place, ...] = ("force", "potential", "inertia")
"""Places of mechanical priors, in the order in which they act."""
Option: TypeAlias = Signal | tuple[float, ...] | bool | float | str


@dataclass(frozen=True)
class Made:
    """The call that makes a term, as data.

    Args:
        maker: Name of the function of this module.
        of: Name of the signal.
        parameters: The parameters, in the function's order.
        options: Its other arguments by name.

    Example:
        >>> Made("viscous", "v", (Parameter("d", 0.0, "kg/s", 0.0, 1.0),), {"place": "rate"}).code
        "terms.viscous('v', Parameter('d', 0.0, 'kg/s', 0.0, 1.0), place='rate')"
    """

    maker: Name
    of: Name
    parameters: tuple[Parameter, ...]
    options: Mapping[str, Option] = field(default_factory=dict)

    @property
    def code(self) -> str:
        """The call as code."""
        more = [f"{key}={code_of(value)}" for key, value in self.options.items()]
        return f"terms.{self.maker}({', '.join([repr(self.of), *map(code_of, self.parameters), *more])})"


def again(made: Made) -> Term:
    """Create the term of a call that was stored as data.

    Raises:
        InputError: If there is no such function.

    Example:
        >>> again(Made("viscous", "v", (Parameter("d", 0.0, "N s/m", 0.0, 1.0),))).name
        'viscous friction of v'
    """
    if made.maker not in EXPLANATIONS:
        raise InputError(
            f"no law {made.maker!r} of a term; there are {', '.join(EXPLANATIONS)} [HM-MACHINE-030]"
        )
    term: Term = globals()[made.maker](made.of, *made.parameters, **made.options)
    return term


class At(NamedTuple):
    """Arguments of a law.

    Attributes:
        x: States of the prior, by name.
        u: Inputs that act, by name.
        w: Measured disturbances, by name.
        p: Parameters of the prior, by name.
        own: The signal that the term changes: the state whose rate or force it adds to, the input or output itself.
        position: The position whose speed is :attr:`own`; None if :attr:`own` is not a speed.
        driven: Force or rate due to the inputs, minus that of the inputs at rest [unit of the force or rate].
        resting: Force or rate at the present position without motion, e.g. of gravity or a spring.
        state: The term's own state; None without one.
    """

    x: Any
    u: Any
    w: Any
    p: Any
    own: Any
    position: Any = None
    driven: Any = 0.0
    resting: Any = 0.0
    state: Any = None

    @classmethod
    def of(cls, prior: Prior, point: Sequence[Any], own: Any, **more: Any) -> At:
        """Arguments of a law at the columns ``x, u, w, p`` of a prior."""
        x, u, w, p = (
            named(prior.names_of(key), ca.vertsplit(v) if v.numel() else [])
            for key, v in zip(POINT, point, strict=True)
        )
        return cls(x, u, w, p, own, **more)


@dataclass(frozen=True)
class Term:
    """A physical term: a change of a prior.

    Args:
        name: Name of the term, e.g. ``"Coulomb friction of phi_dot"``.
        place: Place in the prior: ``"force"`` adds a generalised force to a mechanical prior's speed ``of``,
            ``"potential"`` an energy of its position, ``"inertia"`` an inertia of its axis; ``"rate"`` adds to the
            rate of the state ``of``; ``"input"``, ``"disturbance"`` and ``"output"`` replace the acting or the
            measured signal.
        of: Name of the speed, state, input, disturbance or output.
        parameters: Its parameters; the term has almost no effect if the first one is zero, or at its nominal value.
        law: ``(at, p) -> value``: the force, inertia or rate that is added, the energy, or the signal in place of
            ``at.own``.
            With a state ``(value, rate)``. ``p`` are its parameters in order, by name.
        text: Its formula.
        loss: Whether the term is a loss of a balance, like friction. Default: it is a supply.
        state: An additional state, e.g. of a lag; its nominal value is that of the signal. Default: none.
        explanation: Description in one sentence, for tables.
        made: The call of a law of this module that creates the term. Default: none.

    Raises:
        InputError: If a field has a wrong type, or the term has no parameter.

    Example:
        >>> leak = Term("leak", "rate", "level", (Parameter("leak", 0.0, "1/s", 0.0, 1.0),),
        ...     lambda at, p: -p.leak * at.own, "-leak level")
        >>> leak.names
        ('leak',)
    """

    name: Line
    place: Place
    of: Name
    parameters: tuple[Parameter, ...]
    law: Callable[[At, Any], Any] = field(compare=False)
    text: Line = ""
    loss: bool = False
    state: Signal | None = None
    explanation: Line = ""
    made: Made | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        own = Fields(self, f"term {self.name!r}")
        own.need(
            "place",
            lambda: self.place in PLACES,
            f"place {self.place!r} is unknown; choose from {', '.join(PLACES)} [HM-MACHINE-031]",
        )
        own.need("parameters", lambda: len(self.parameters) > 0, "a term needs a parameter [HM-MACHINE-032]")
        own.refuse()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its parameters."""
        return tuple(p.name for p in self.parameters)

    @property
    def code(self) -> str:
        """Code of the call that creates the term; empty for a user's own term."""
        return "" if self.made is None else self.made.code


def extended(base: type[Prior], *terms: Term) -> type[Prior]:
    """Create a prior class with additional terms; their parameters and states come after those of ``base``.

    Args:
        base: A prior class in CasADi or torch; it may have terms already.
        terms: Terms, in any order. Default: none, ``base`` itself.

    Raises:
        InputError: With all problems: a signal of a term is missing, a parameter or state appears twice, a force is
            added to a prior that is not mechanical, units do not match, a potential depends on more than its
            position, or an inertia is not constant.

    Example:
        >>> class Disk(MechanicalPrior):
        ...     states, outputs = (Signal("phi", "rad"), Signal("phi_dot", "rad/s")), (Signal("phi", "rad"),)
        ...     inputs, parameters = (Signal("torque", "N m"),), (Parameter("J", 0.5, "kg m^2", 0.1, 1.0),)
        ...     def mass_matrix(self, q, p):
        ...         return p.J
        >>> drag = quadratic("phi_dot", Parameter("c", 0.1, "N m s^2/rad^2", 0.0, 1.0))
        >>> dragged = extended(Disk, drag)()
        >>> dragged.equations.xdot([0.0, 2.0], 0.0, [], dragged.p)
        DM([2, -0.8])
        >>> [b.loss([0.0, 2.0], 0.0, [], dragged.p) for b in dragged.equations.balances]
        [DM(0.8)]
    """
    own: Any = base
    if not terms:
        return base
    made: type[Prior] = _extended(getattr(own, "base", own), (*getattr(own, "terms", ()), *terms))
    return made


def with_nominal(
    prior: type[Prior], values: Mapping[str, float], operating_point: OperatingPoint | None = None
) -> type[Prior]:
    """Create a prior class with other nominal parameters, e.g. fitted ones, including those of its terms.

    Args:
        prior: A prior class; it may have terms.
        values: Nominal values [their units] by name. Other parameters keep their values.
        operating_point: The equilibrium with these values, including the states of terms. Default: the prior's.

    Raises:
        InputError: If a name is not a parameter, or a value lies outside the prior's bounds.

    Example:
        >>> class Decay(Prior):
        ...     states, inputs, outputs = (Signal("x", "m"),), (Signal("u", "m/s"),), (Signal("x", "m"),)
        ...     parameters = (Parameter("k", 1.0, "1/s", 0.0, 9.0),)
        ...     def xdot(self, x, u, w, p):
        ...         return (u.u - p.k * x.x,)
        >>> with_nominal(Decay, {"k": 2.0})().values
        {'k': 2.0}
    """
    names = [p.name for p in prior.parameters]
    if unknown := sorted(set(values) - set(names)):
        raise InputError(
            f"{prior.__name__} has no parameter {', '.join(unknown)}; there are {', '.join(names) or 'none'}"
            " [HM-MACHINE-033]"
        )
    own: Any = prior
    terms: tuple[Term, ...] = getattr(own, "terms", ())
    base: Any = getattr(own, "base", own)
    refuse(list(_beyond(base, values)))
    chosen = tuple(replace(p, value=values.get(p.name, p.value)) for p in base.parameters)
    changed = {"parameters": chosen, "__module__": base.__module__, "__doc__": base.__doc__}
    point = operating_point or prior.operating_point
    if point is not None:
        changed["operating_point"] = replace(point, x=point.x[: len(base.states)])
    made: Any = extended(
        type(base.__name__, (base,), changed), *(_with_values(term, values) for term in terms)
    )
    made.operating_point = point
    chosen_prior: type[Prior] = made
    return chosen_prior


def _beyond(base: Any, values: Mapping[str, float]) -> Iterator[str]:
    """Values outside the bounds of the class that declares the parameters."""
    file = getattr(sys.modules.get(base.__module__), "__file__", None)
    where = f"class {base.__name__}" + (f" in {file}" if file else "")
    for p in base.parameters:
        value = values.get(p.name, p.value)
        if not p.lower <= value <= p.upper:
            what = "fixes it" if p.fixed else "bounds it"
            yield (
                f"with_nominal: {p.name} = {value:g} {p.unit} lies outside [{p.lower:g}, {p.upper:g}]: {where} {what}. "
                f"Leave {p.name} out of the values to keep {p.value:g} (in a file of hybrid-mpc explain: delete its "
                "line of FITTED), widen its bounds there, or run hybrid-mpc explain again with the new bounds "
                "[HM-MACHINE-046]"
            )


def _with_values(term: Term, values: Mapping[str, float]) -> Term:
    """A term with other nominal parameters."""
    chosen = tuple(replace(p, value=values.get(p.name, p.value)) for p in term.parameters)
    made = None if term.made is None else replace(term.made, parameters=chosen)
    return replace(term, parameters=chosen, made=made)


@cache
def _extended(base: Any, terms: tuple[Term, ...]) -> Any:
    _check(base, terms)
    added = tuple(term.state for term in terms if term.state is not None)
    states = (*base.states, *added)

    class Extended(Prior):
        inputs, outputs, disturbances = base.inputs, base.outputs, base.disturbances
        parameters = (*base.parameters, *(p for term in terms for p in term.parameters))
        corrects = tuple(base().states[i].name for i in base().corrected)
        operating_point = _operating_point(base, terms)

        def expressions(self, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[Any, Any, tuple[Balance, ...]]:
            return _expressions(base, terms, x, u, w, p)

    made: Any = Extended
    made.states = states
    made.__name__ = made.__qualname__ = f"{base.__name__}Extended"
    made.__module__, made.__doc__ = base.__module__, base.__doc__
    made.base, made.terms = base, terms
    return made


def _expressions(
    base: type[Prior], terms: tuple[Term, ...], x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX
) -> tuple[Any, Any, tuple[Balance, ...]]:
    """Rates, outputs and balances of a prior with terms."""
    prior = base()
    n_x, n_p = len(base.states), len(base.parameters)
    of_base, own_p = p[:n_p], iter(ca.vertsplit(p)[n_p:])
    own_x = iter(ca.vertsplit(x)[n_x:])
    states = {term: next(own_x) for term in terms if term.state is not None}
    given = {term: named(term.names, [next(own_p) for _ in term.parameters]) for term in terms}
    x_base, extra = x[:n_x], dict[Term, Any]()

    def applied(term: Term, own: Any, **more: Any) -> Any:
        """Value of a law; the rate of its own state is stored."""
        point = At.of(prior, (x_base, u, w, of_base), own, state=states.get(term), **more)
        value = term.law(point, given[term])
        if term.state is not None:
            value, extra[term] = value
        return value

    replaced = {
        "input": dict(zip(prior.names_of("u"), ca.vertsplit(u), strict=True)),
        "disturbance": dict(zip(prior.names_of("w"), ca.vertsplit(w), strict=True)),
    }
    for term in terms:
        if term.place in replaced:
            acting = replaced[term.place]
            acting[term.of] = applied(term, acting[term.of])
    u, w = (ca.vertcat(*replaced[place].values()) for place in ("input", "disturbance"))
    equations = prior.equations
    rates = equations.xdot(x_base, u, w, of_base)
    added, lost, stored = ca.SX.zeros(n_x), ca.SX.zeros(n_x), ca.SX(0)
    names = prior.names_of("x")
    positions = {names[v]: q for q, v in prior.kinematics}
    half = n_x // 2
    mass: Any = (
        _masses(cast(Any, base))(x_base[:half], of_base) if issubclass(base, MechanicalPrior) else None
    )
    adding = [term for term in terms if term.place in (*MECHANICAL, "rate")]
    for term in sorted(adding, key=lambda term: PLACES.index(term.place)):
        i = names.index(term.of)
        q = positions.get(term.of)
        driven, resting = _forces(base, x_base, u, w, of_base, term, i)
        position = None if q is None else x_base[q]
        value = ca.SX(applied(term, x_base[i], position=position, driven=driven, resting=resting))
        if term.place == "potential":
            stored = stored + value
            assert q is not None
            value = -ca.gradient(value, x_base[q]) if ca.depends_on(value, x_base[q]) else ca.SX(0)
        change = ca.SX.zeros(n_x)
        if term.place == "rate":
            change[i] = value
        else:
            force = ca.SX.zeros(half)
            force[i - half] = value
            if term.place == "inertia":
                # (M + J) a' = M a, so a' - a = -(M + J)^-1 J a; the energy J v^2 / 2 is stored
                stored = stored + 0.5 * value * x_base[i] ** 2
                mass = mass + ca.diag(force)
                force = -force * (rates + added)[half:]
            change[half:] = ca.solve(mass, force)
        added = added + change
        if term.loss:
            lost = lost + change
    shown = ca.vertsplit(equations.output(x_base, u, w, of_base))
    outputs = dict(zip((s.name for s in base.outputs), shown, strict=True))
    for term in terms:
        if term.place == "output":
            outputs[term.of] = applied(term, outputs[term.of])
    balances = []
    for b in equations.balances:
        storage = b.storage(x_base, of_base)
        slope = ca.gradient(storage, x_base)
        mechanical = issubclass(base, MechanicalPrior) and b.name == "energy"
        # the force of a potential only converts stored energy: it cancels in dS/dt of the total storage
        held = stored if mechanical else ca.SX(0)
        supply = (
            b.supply(x_base, u, w, of_base)
            + slope.T @ (added - lost)
            + ca.gradient(held, x_base).T @ (rates + added)
        )
        loss = b.loss(x_base, u, w, of_base) - slope.T @ lost
        balances.append(Balance(b.name, storage + held, supply, loss, b.unit, b.rate_unit))
    xdot = ca.vertcat(rates + added, *(extra[term] for term in states))
    return xdot, tuple(outputs.values()), tuple(balances)


def _forces(
    base: type[Prior], x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX, term: Term, i: int
) -> tuple[ca.SX, ca.SX]:
    """Force or rate of a state due to the inputs, and at rest."""
    prior, n_x = base(), len(base.states)
    point = base.operating_point
    at_rest = ca.DM([0.0] * len(base.inputs) if point is None else list(point.u))
    still = ca.vertcat(*(0.0 if k in {v for _, v in prior.kinematics} else x[k] for k in range(n_x)))
    xdot = prior.equations.xdot
    driven, resting = xdot(x, u, w, p) - xdot(x, at_rest, w, p), xdot(still, at_rest, w, p)
    if term.place == "rate":
        return driven[i], resting[i]
    half = n_x // 2
    mass = _masses(cast(Any, base))(x[:half], p)
    return (mass @ driven[half:])[i - half], (mass @ resting[half:])[i - half]


@cache
def _masses(base: Any) -> ca.Function:
    prior = base()
    assert isinstance(prior, MechanicalPrior)
    return prior.masses


def _operating_point(base: type[Prior], terms: tuple[Term, ...]) -> OperatingPoint | None:
    """The operating point of the base; states of terms equal the signals that they follow."""
    point = base.operating_point
    if point is None or not any(term.state for term in terms):
        return point
    prior = base()
    y = prior.equations.output(point.x, point.u, point.w, prior.p).full().ravel().tolist()
    at = {
        place: dict(zip((s.name for s in signals), values, strict=True))
        for place, signals, values in (
            ("rate", base.states, point.x), ("input", base.inputs, point.u),
            ("disturbance", base.disturbances, point.w or (0.0,) * len(base.disturbances)),
            ("output", base.outputs, y),
        )
    }  # fmt: skip
    more = [float(at[term.place][term.of]) for term in terms if term.state is not None]
    return OperatingPoint((*point.x, *more), point.u, point.w)


def signals_at(base: type[Prior], place: str) -> tuple[Signal, ...]:
    """Signals that a term of this place can change."""
    found = {"input": base.inputs, "disturbance": base.disturbances, "output": base.outputs}
    return found.get(place, base.states)


def _check(base: type[Prior], terms: tuple[Term, ...]) -> None:
    problems, prior = [], base()
    moving = {base.states[v].name for _, v in prior.kinematics}
    for term in terms:
        where = f"term {term.name!r} for {base.__name__}"
        names = [s.name for s in signals_at(base, term.place)]
        if term.of not in names:
            problems.append(
                f"{where}: there is no {term.of!r}; choose from {', '.join(names)}. [HM-MACHINE-034]"
            )
        elif term.place in MECHANICAL and not issubclass(base, MechanicalPrior):
            problems.append(
                f"{where}: place {term.place!r} needs a MechanicalPrior. Use place='rate'. [HM-MACHINE-035]"
            )
        elif term.place in MECHANICAL and term.of not in moving:
            problems.append(
                f"{where}: {term.of!r} is no speed; choose from {', '.join(sorted(moving))}. [HM-MACHINE-036]"
            )
        if term.state is not None and term.place in MECHANICAL:
            problems.append(f"{where}: place {term.place!r} cannot have a state of its own. [HM-MACHINE-037]")
    if not problems:
        problems = [problem for term in terms for problem in _misfits(base, prior, term)]
    for what, every in (
        ("parameter", [p.name for p in base.parameters] + [name for t in terms for name in t.names]),
        ("state", [s.name for s in base.states] + [t.state.name for t in terms if t.state is not None]),
    ):
        twice = sorted({name for name in every if every.count(name) > 1})
        if twice:
            problems.append(
                f"{base.__name__} with terms: {what} {', '.join(twice)} appear twice. Rename one. [HM-MACHINE-038]"
            )
    refuse(problems)


def _misfits(base: type[Prior], prior: Prior, term: Term) -> Iterator[str]:
    """Why a term's law is invalid at its place: its units, or a potential that depends on more than its position."""
    where = f"term {term.name!r} for {base.__name__}"
    groups: dict[str, tuple[Signal | Parameter, ...]] = {
        "x": base.states, "u": base.inputs, "w": base.disturbances, "p": base.parameters,
    }  # fmt: skip
    symbols: dict[str, list[Any]] = {
        key: [ca.SX.sym(s.name) for s in signals] for key, signals in groups.items()
    }
    inputs: list[tuple[Any, str]] = [
        (v, s.unit) for key in groups for v, s in zip(symbols[key], groups[key], strict=True)
    ]
    kind: str = {"input": "u", "disturbance": "w"}.get(term.place, "x")
    signals = signals_at(base, term.place)
    k = [s.name for s in signals].index(term.of)
    unit, position = signals[k].unit, None
    wanted, power = term_units.of(unit), None
    if term.place == "output":
        inputs.append((own := ca.SX.sym("y"), unit))
    else:
        own = symbols[kind][k]
    for q, v in prior.kinematics:
        if kind == "x" and v == k:
            position = symbols["x"][q]
            power = "N m" if term_units.of(base.states[q].unit) == term_units.NONE else "N"
    if term.place == "rate":
        wanted = term_units.per_second(wanted)
    elif term.place in MECHANICAL:
        wanted = term_units.of("J" if term.place == "potential" else power or "N")
        if term.place == "inertia":
            wanted = term_units.of("kg m^2" if power == "N m" else "kg")
    driven, resting = ca.SX.sym("driven"), ca.SX.sym("resting")
    given = [ca.SX.sym(q.name) for q in term.parameters]
    inputs += [(v, q.unit) for v, q in zip(given, term.parameters, strict=True)]
    state = None if term.state is None else ca.SX.sym(term.state.name)
    if term.state is not None:
        inputs.append((state, term.state.unit))
    columns = [ca.vertcat(*symbols[key]) for key in POINT]
    more = {"position": position, "driven": driven, "resting": resting, "state": state}
    point = At.of(prior, columns, own, **more)
    value = _uneven(term).law(point, named(term.names, given))
    parts = [(value, wanted)]
    if term.state is not None:
        parts = [(value[0], wanted), (value[1], term_units.per_second(term_units.of(term.state.unit)))]
    for one, needed in parts:
        if said := term_units.clash(one, inputs, needed):
            yield f"{where}: units do not match: {said}. Correct the unit of a parameter, or the law. [HM-MACHINE-042]"
    if term.place in ("potential", "inertia"):
        known = position if term.place == "potential" else None
        free = [v for v in (*symbols["x"], *symbols["u"], *symbols["w"], driven, resting) if v is not known]
        if ca.depends_on(ca.SX(value), ca.vertcat(*free)):
            only = "may only depend on its position" if term.place == "potential" else "must be constant"
            yield f"{where}: the {term.place} {only}, else the energy balance is wrong. Use a force [HM-MACHINE-043]"


def _uneven(term: Term) -> Term:
    """The same law with other numbers: a factor of 1 or 2 disappears from an expression, whatever its unit."""
    if term.made is None:
        return term
    options = {k: 1.2345 * v if type(v) is float else v for k, v in term.made.options.items()}
    return again(replace(term.made, options=options))


def _sign(v: Any, width: Any) -> Any:
    """Smooth sign of a speed: 96 % at two widths."""
    return ca.tanh(v / width)


def code_of(value: Option | Parameter) -> str:
    """A parameter, signal or option as code.

    Example:
        >>> code_of(Parameter("d", 0.0, "N s/m", 0.0, math.inf)), code_of(Signal("s", "N"))
        ("Parameter('d', 0.0, 'N s/m', 0.0, float('inf'))", "Signal('s', 'N')")
    """
    if isinstance(value, float):  # also numpy's, whose repr names numpy
        return repr(float(value)) if math.isfinite(value) else f"float('{value}')"
    if isinstance(value, tuple):
        return f"({''.join(f'{code_of(one)}, ' for one in value).rstrip()})"
    if isinstance(value, Parameter):
        given: list[Option] = [value.name, value.value, value.unit, value.lower, value.upper]
        given += [value.description] if value.description else []
        return f"Parameter({', '.join(map(code_of, given))})"
    if isinstance(value, Signal):
        more = [
            f", {f.name}={code_of(own)}"
            for f in fields(value)[2:]
            if (own := getattr(value, f.name)) != f.default
        ]
        return f"Signal({value.name!r}, {value.unit!r}{''.join(more)})"
    return repr(value)


def _added(
    maker: str, title: str, place: Place, of: str, parameters: tuple[Parameter, ...], law: Callable[[At, Any], Any],
    text: str, *, loss: bool = False, state: Signal | None = None, **options: Any,
) -> Term:  # fmt: skip
    by_rate = maker in BY_RATE and place == "rate"
    if state is not None:
        options["state"] = state
    made = Made(maker, of, parameters, {**options, **({"place": place} if by_rate else {})})
    name = f"{title} of {of}"
    return Term(name, place, of, parameters, law, text, loss, state, EXPLANATIONS[maker], made)


# Friction: against the motion of one axis.


def coulomb(of: str, level: Parameter, *, width: float, place: Place = "force") -> Term:
    """Dry friction ``-F tanh(v / width)``.

    ``F / (width inertia)`` is the rate at which it stops the machine near rest, which the integration steps follow.

    Args:
        of: Speed.
        level: F [N or N m], of a rate [unit/s].
        width: Speed over which the friction changes its sign.
        place: ``"rate"`` for a prior that is not mechanical.
    """
    return _added(
        "coulomb", "Coulomb friction", place, of, (level,), lambda at, p: -p[0] * _sign(at.own, width),
        f"-{level.name} sign({of})", loss=True, width=width,
    )  # fmt: skip


def asymmetric(of: str, more: Parameter, *, width: float, place: Place = "force") -> Term:
    """Dry friction that depends on the direction: ``-A tanh(v / width)^2``.

    Args:
        of: Speed.
        more: A [N or N m], half of the difference between both directions.
        width: Speed over which the friction changes its sign.
        place: ``"rate"`` for a prior that is not mechanical.
    """
    return _added(
        "asymmetric", "friction by direction", place, of, (more,), lambda at, p: -p[0] * _sign(at.own, width) ** 2,
        f"-{more.name} |sign({of})|", width=width,
    )  # fmt: skip


def viscous(of: str, d: Parameter, *, place: Place = "force") -> Term:
    """Viscous friction ``-d v``."""
    return _added(
        "viscous", "viscous friction", place, of, (d,), lambda at, p: -p[0] * at.own, f"-{d.name} {of}",
        loss=True,
    )  # fmt: skip


def viscous_by_direction(of: str, a: Parameter, *, place: Place = "force") -> Term:
    """Viscous friction that differs by direction: ``-a |v|``."""
    return _added(
        "viscous_by_direction", "viscous friction by direction", place, of, (a,),
        lambda at, p: -p[0] * ca.fabs(at.own), f"-{a.name} |{of}|",
    )  # fmt: skip


def quadratic(of: str, c: Parameter, *, place: Place = "force") -> Term:
    """Drag ``-c v |v|``."""
    return _added(
        "quadratic", "quadratic drag", place, of, (c,), lambda at, p: -p[0] * at.own * ca.fabs(at.own),
        f"-{c.name} {of} |{of}|", loss=True,
    )  # fmt: skip


def stribeck(of: str, more: Parameter, *, speed: float, width: float, place: Place = "force") -> Term:
    """Friction that is larger near rest than in motion: ``-F exp(-(v / speed)^2) tanh(v / width)``.

    Source: Armstrong-Hélouvry, Dupont, Canudas de Wit, *A survey of models, analysis tools and compensation methods for
    the control of machines with friction*, Automatica 30 (1994).
    """
    return _added(
        "stribeck", "Stribeck friction", place, of, (more,),
        lambda at, p: -p[0] * ca.exp(-((at.own / speed) ** 2)) * _sign(at.own, width),
        f"-{more.name} exp(-({of} / {speed:.3g})^2) sign({of})", loss=True, speed=speed, width=width,
    )  # fmt: skip


def loaded(of: str, mu: Parameter, *, load: str, width: float, place: Place = "force") -> Term:
    """Friction that grows with the load of a gear or bearing: ``-mu |load| tanh(v / width)``.

    ``load`` is ``"driven"`` (the effect of the inputs), ``"resting"`` (gravity, springs) or ``"both"``, their sum.

    Source: Duclusaud, Passault, Padois, Ly, *Extended friction models for the physics simulation of servo actuators*
    (ICRA 2025).
    """
    chosen: Mapping[str, Callable[[At], Any]] = {
        "driven": lambda at: at.driven, "resting": lambda at: at.resting, "both": lambda at: at.driven + at.resting,
    }  # fmt: skip
    return _added(
        "loaded", f"friction by {load} load", place, of, (mu,),
        lambda at, p: -p[0] * ca.fabs(chosen[load](at)) * _sign(at.own, width),
        f"-{mu.name} |{'load' if load == 'both' else load + ' load'}| sign({of})", loss=True, load=load, width=width,
    )  # fmt: skip


def coulomb_by_position(
    of: str,
    one: Parameter,
    two: Parameter,
    *,
    width: float,
    turning: bool,
    centre: float = 0.0,
    place: Place = "force",
) -> Term:
    """Dry friction that depends on the position: ``-(a sin q + b cos q) tanh(v / width)``, or with ``q - centre`` and
    its square for a position that does not turn.
    """
    first, second = (ca.sin, ca.cos) if turning else (lambda q: q - centre, lambda q: (q - centre) ** 2)
    return _added(
        "coulomb_by_position", "Coulomb friction by position", place, of, (one, two),
        lambda at, p: -(p[0] * first(at.position) + p[1] * second(at.position)) * _sign(at.own, width),
        f"-({one.name} {'sin' if turning else ''} q + {two.name} {'cos q' if turning else 'q^2'}) sign({of})",
        width=width, turning=turning, centre=centre,
    )  # fmt: skip


# Forces and potentials.


def offset(of: str, value: Parameter, *, place: Place = "force") -> Term:
    """A constant force or rate."""
    return _added("offset", "offset", place, of, (value,), lambda at, p: p[0], value.name)


def gravity_error(of: str, sine: Parameter, cosine: Parameter) -> Term:
    """A weight that is missing in the prior, or acts at a different angle: the potential ``-a cos q + b sin q``."""
    return _added(
        "gravity_error", "gravity error", "potential", of, (sine, cosine),
        lambda at, p: -p[0] * ca.cos(at.position) + p[1] * ca.sin(at.position),
        f"-{sine.name} sin q - {cosine.name} cos q",
    )  # fmt: skip


def cogging(of: str, sine: Parameter, cosine: Parameter, *, periods: float) -> Term:
    """Cogging of magnets on teeth, or an eccentric shaft: the potential ``(a cos(n q) - b sin(n q)) / n``, with n
    periods in 2 pi of the position.
    """
    return _added(
        "cogging", f"cogging by {periods:.3g}", "potential", of, (sine, cosine),
        lambda at, p: (p[0] * ca.cos(periods * at.position) - p[1] * ca.sin(periods * at.position)) / periods,
        f"{sine.name} sin({periods:.3g} q) + {cosine.name} cos({periods:.3g} q)", periods=periods,
    )  # fmt: skip


def spring(of: str, stiffness: Parameter, *, centre: float) -> Term:
    """A spring: the potential ``k (q - centre)^2 / 2``."""
    return _added(
        "spring", "spring", "potential", of, (stiffness,), lambda at, p: 0.5 * p[0] * (at.position - centre) ** 2,
        f"-{stiffness.name} (q - {centre:.3g})", centre=centre,
    )  # fmt: skip


def inertia(of: str, j: Parameter) -> Term:
    """More inertia of one axis alone, such as that of a geared rotor: the force ``-j dv/dt``."""
    return _added("inertia", "inertia", "inertia", of, (j,), lambda at, p: p[0], f"-{j.name} d({of})/dt")


def elastic_end(of: str, stiffness: Parameter, *, edge: float, upper: bool) -> Term:
    """An elastic stop: the potential ``k max(q - edge, 0)^2 / 2``, with ``edge - q`` for a lower end."""
    side = 1.0 if upper else -1.0
    return _added(
        "elastic_end", f"{'upper' if upper else 'lower'} elastic end", "potential", of, (stiffness,),
        lambda at, p: 0.5 * p[0] * ca.fmax(side * (at.position - edge), 0.0) ** 2,
        f"-{stiffness.name} (q - {edge:.3g}) beyond this edge", edge=edge, upper=upper,
    )  # fmt: skip


# Rates of processes.


def _from(of: str, centre: str) -> str:
    """A signal's distance from a centre, in words; the signal alone if the centre is zero.

    Example:
        >>> _from("speed", "0"), _from("water", "21")
        ('speed', '(water - 21)')
    """
    return of if centre in ("0", "-0") else f"({of} - {centre})"


def _power(x: str, exponent: float) -> str:
    """An odd power, which keeps the sign.

    Example:
        >>> _power("speed", 1.0), _power("speed", 2.0), _power("(T - 21)", 1.25)
        ('speed', 'speed |speed|', '(T - 21) |T - 21|^0.25')
    """
    if exponent == 1.0:
        return x
    more = "" if exponent == 2.0 else f"^{exponent - 1.0:g}"
    return f"{x} |{x.removeprefix('(').removesuffix(')')}|{more}"


def loss(of: str, k: Parameter, n: Parameter, *, scale: float, reference: str | float = 0.0) -> Term:
    """A loss to the surroundings: ``-k (x - r) |(x - r) / scale|^(n - 1)``.

    Args:
        of: State.
        k: Loss rate [1/s] at a distance of ``scale`` from the reference.
        n: Exponent: 1 for conduction, 1.25 to 1.33 for free convection, 0.5 for an outlet.
        scale: Distance from the reference [unit of the state], that of the recordings.
        reference: The state or measured disturbance of the same unit on the other side, or a number.

    Source: Incropera, DeWitt, *Fundamentals of Heat and Mass Transfer*, 6th edition (2007), section 9.3, for free
    convection.
    """

    def law(at: At, p: Any) -> Any:
        far = at.own - (_signal(at, reference) if isinstance(reference, str) else reference)
        share = far / scale
        # square of the distance from a reference, over its scale, that keeps a loss' slope finite where both are equal
        return -p[0] * far * (share * share + 1e-4) ** (0.5 * (p[1] - 1.0))

    to = reference if isinstance(reference, str) else f"{reference:.3g}"
    far_off = _from(of, to)
    return _added(
        "loss", f"loss to {to}", "rate", of, (k, n), law,
        f"-{k.name} {far_off} |{far_off} / {scale:.3g}|^({n.name} - 1)",
        scale=scale, reference=reference,
    )  # fmt: skip


def radiation(of: str, k: Parameter, *, kelvin: float, surroundings: float) -> Term:
    """Radiation ``-k ((x + kelvin)^4 - (surroundings + kelvin)^4) / 1e8``; ``kelvin`` is 273.15 for degC, 0 for K.

    Its formula is written in kelvin.
    """
    return _added(
        "radiation", "radiation", "rate", of, (k,),
        lambda at, p: -p[0] * ((at.own + kelvin) ** 4 - (surroundings + kelvin) ** 4) / 1e8,
        f"-{k.name} ({_kelvin(of, kelvin)}^4 - {surroundings + kelvin:.5g}^4) / 1e8",
        kelvin=kelvin, surroundings=surroundings,
    )  # fmt: skip


def _kelvin(of: str, kelvin: float) -> str:
    """A temperature in kelvin, as text.

    Example:
        >>> _kelvin("T", 273.15), _kelvin("T", 0.0)
        ('(T + 273.15)', 'T')
    """
    return of if kelvin == 0.0 else f"({of} + {kelvin:g})"


def storage(of: str, k: Parameter, tau: Parameter, *, state: Signal) -> Term:
    """A second capacity next to a state, such as a wall: ``k (s - x)`` with ``tau s' = x - s``."""
    return _added(
        "storage", "second capacity", "rate", of, (k, tau),
        lambda at, p: (p[0] * (at.state - at.own), (at.own - at.state) / p[1]),
        f"{k.name} (s - {of}), {tau.name} s' = {of} - s", state=state,
    )  # fmt: skip


def overflow(of: str, k: Parameter, edge: Parameter, *, width: float) -> Term:
    """Overflow above an edge: ``-k max(x - edge, 0)``, smooth over ``width``."""
    return _added(
        "overflow", "overflow", "rate", of, (k, edge),
        lambda at, p: -0.5 * p[0] * (at.own - p[1] + ca.sqrt((at.own - p[1]) ** 2 + width**2)),
        f"-{k.name} max({of} - {edge.name}, 0)", loss=True, width=width,
    )  # fmt: skip


def coupling(of: str, k: Parameter, *, source: str, centre: float = 0.0) -> Term:
    """Effect of another signal on a state: ``k (source - centre)``; an input, state or measured disturbance."""
    return _added(
        "coupling", f"coupling from {source}", "rate", of, (k,), lambda at, p: p[0] * (_signal(at, source) - centre),
        f"{k.name} {source}", source=source, centre=centre,
    )  # fmt: skip


def product(of: str, k: Parameter, *, one: str, two: str, centres: tuple[float, float] = (0.0, 0.0)) -> Term:
    """Effect of a product of two signals: ``k (one - c1) (two - c2)``."""
    return _added(
        "product", f"product of {one} and {two}", "rate", of, (k,),
        lambda at, p: p[0] * (_signal(at, one) - centres[0]) * (_signal(at, two) - centres[1]), f"{k.name} {one} {two}",
        one=one, two=two, centres=centres,
    )  # fmt: skip


def _signal(at: At, name: str) -> Any:
    """A state, input or disturbance by its name."""
    for group in (at.x, at.u, at.w):
        if name in getattr(group, "_fields", ()):
            return getattr(group, name)
    raise InputError(f"there is no state, input or disturbance {name!r} [HM-MACHINE-039]")


# Inputs.


def input_gain(of: str, g: Parameter) -> Term:
    """A different gain: ``(1 + g) u``."""
    return _added(
        "input_gain", "gain", "input", of, (g,), lambda at, p: (1.0 + p[0]) * at.own, f"(1 + {g.name}) {of}"
    )


def input_offset(of: str, value: Parameter) -> Term:
    """``u + offset``."""
    return _added(
        "input_offset", "input offset", "input", of, (value,), lambda at, p: at.own + p[0],
        f"{of} + {value.name}",
    )  # fmt: skip


def gain_by_direction(of: str, b: Parameter) -> Term:
    """A gain that differs by the sign of the input: ``u + b |u|``."""
    return _added(
        "gain_by_direction", "gain by direction", "input", of, (b,), lambda at, p: at.own + p[0] * ca.fabs(at.own),
        f"{of} + {b.name} |{of}|",
    )  # fmt: skip


def input_curve(of: str, c: Parameter, *, centre: float, span: float) -> Term:
    """A curved characteristic: ``u + c (u - centre) |u - centre| / span``; negative ``c`` saturates.

    It reverses where ``2 c |u - centre| < -span``: bound ``c`` by the input's range.
    """
    return _added(
        "input_curve", "input curve", "input", of, (c,),
        lambda at, p: at.own + p[0] * (at.own - centre) * ca.fabs(at.own - centre) / span,
        f"{of} + {c.name} {_power(_from(of, f'{centre:.3g}'), 2.0)} / {span:.3g}", centre=centre, span=span,
    )  # fmt: skip


def saturation(of: str, k: Parameter) -> Term:
    """An input whose effect levels off: ``u / sqrt(1 + k u^2)``; it never exceeds ``1 / sqrt(k)``."""
    return _added(
        "saturation", "saturation", "input", of, (k,),
        lambda at, p: at.own / ca.sqrt(1.0 + p[0] * at.own * at.own), f"{of} / sqrt(1 + {k.name} {of}^2)",
    )  # fmt: skip


def dead_zone(of: str, d: Parameter, *, width: float) -> Term:
    """A dead zone: ``u - (sqrt((u + d)^2 + width^2) - sqrt((u - d)^2 + width^2)) / 2``.

    Small inputs have no effect. The result is nearly ``u - d`` far above ``d``, and ``u + d`` far below ``-d``.
    """

    def law(at: At, p: Any) -> Any:
        # With s(z) = sqrt(z^2 + width^2), a smooth |z|, whose slope z / s(z) lies between -1 and 1, the law's slope is
        # 1 - ((u + d) / s(u + d) - (u - d) / s(u - d)) / 2. For d >= 0 it lies above 0 and reaches at most 1, whatever
        # d and width are: a controller never sees a reversed input. (u - d tanh(u / width) reverses where d > width.)
        # At d = 0 both roots are equal: the law is u to the last digit, and its slope by d is a smooth sign of u.
        above, below = (ca.sqrt((at.own + side * p[0]) ** 2 + width**2) for side in (1.0, -1.0))
        return at.own - 0.5 * (above - below)

    return _added(
        "dead_zone", "dead zone", "input", of, (d,), law,
        f"{of} - {d.name} sign({of}) where |{of}| > {d.name}, else 0 (smooth)", width=width,
    )  # fmt: skip


def input_lag(of: str, tau: Parameter, *, state: Signal) -> Term:
    """An actuator lag: ``tau s' = u - s``, and ``s`` acts."""
    return _added(
        "input_lag", "lag", "input", of, (tau,), lambda at, p: (at.state, (at.own - at.state) / p[0]),
        f"{tau.name} s' = {of} - s", state=state,
    )  # fmt: skip


def input_delay(of: str, tau: Parameter, *, state: Signal) -> Term:
    """An input delay: ``2 s - u`` with ``tau s' = 2 (u - s)``, the Padé approximation of first order.

    Source: K. Ogata, *Modern Control Engineering*, 5th edition (2010), section 5.5.
    """
    return _added(
        "input_delay", "delay", "input", of, (tau,),
        lambda at, p: (2.0 * at.state - at.own, 2.0 * (at.own - at.state) / p[0]), f"{of}(t - {tau.name})", state=state,
    )  # fmt: skip


# Measured disturbances.


def disturbance_gain(of: str, g: Parameter, *, centre: float = 0.0) -> Term:
    """A measured disturbance with a different gain: ``w + g (w - centre)``."""
    return _added(
        "disturbance_gain", "gain of the disturbance", "disturbance", of, (g,),
        lambda at, p: at.own + p[0] * (at.own - centre), f"{of} + {g.name} ({of} - {centre:.3g})", centre=centre,
    )  # fmt: skip


def disturbance_offset(of: str, value: Parameter) -> Term:
    """A measured disturbance whose sensor has an offset: ``w + offset``."""
    return _added(
        "disturbance_offset", "offset of the disturbance", "disturbance", of, (value,), lambda at, p: at.own + p[0],
        f"{of} + {value.name}",
    )  # fmt: skip


def disturbance_lag(of: str, tau: Parameter, *, state: Signal) -> Term:
    """A measured disturbance that acts through a lag: ``tau s' = w - s``, and ``s`` acts."""
    return _added(
        "disturbance_lag", "lag of the disturbance", "disturbance", of, (tau,),
        lambda at, p: (at.state, (at.own - at.state) / p[0]), f"{tau.name} s' = {of} - s", state=state,
    )  # fmt: skip


# Sensors.


def output_gain(of: str, g: Parameter) -> Term:
    """A sensor with a different gain: ``(1 + g) y``."""
    return _added(
        "output_gain", "sensor gain", "output", of, (g,), lambda at, p: (1.0 + p[0]) * at.own,
        f"(1 + {g.name}) {of}",
    )  # fmt: skip


def output_offset(of: str, value: Parameter) -> Term:
    """A sensor with an offset: ``y + offset``."""
    return _added(
        "output_offset", "sensor offset", "output", of, (value,), lambda at, p: at.own + p[0],
        f"{of} + {value.name}",
    )  # fmt: skip


def output_curve(of: str, bend: Parameter, *, lower: float, upper: float) -> Term:
    """A curved sensor that is exact at two values: ``y + bend (y - lower) (y - upper)``.

    It reverses where ``bend (2 y - lower - upper) < -1``: bound ``bend`` by the output's range.
    """
    return _added(
        "output_curve", "sensor curve", "output", of, (bend,),
        lambda at, p: at.own + p[0] * (at.own - lower) * (at.own - upper),
        f"{of} + {bend.name} ({of} - {lower:.3g}) ({of} - {upper:.3g})", lower=lower, upper=upper,
    )  # fmt: skip


def output_lag(of: str, tau: Parameter, *, state: Signal) -> Term:
    """A sensor lag, or an averaging sensor: ``tau s' = y - s``, and ``s`` is measured."""
    return _added(
        "output_lag", "sensor lag", "output", of, (tau,), lambda at, p: (at.state, (at.own - at.state) / p[0]),
        f"{tau.name} s' = {of} - s", state=state,
    )  # fmt: skip


BY_RATE = frozenset({
    "coulomb", "asymmetric", "viscous", "viscous_by_direction", "quadratic", "stribeck", "loaded",
    "coulomb_by_position", "offset",
})  # fmt: skip
"""Laws that take ``place="rate"``."""
EXPLANATIONS: Mapping[str, str] = {
    "coulomb": "Constant dry friction against the motion.",
    "asymmetric": "Dry friction is larger in one direction than in the other.",
    "viscous": "Friction proportional to the speed.",
    "viscous_by_direction": "Friction proportional to the speed is larger in one direction than in the other.",
    "quadratic": "Drag proportional to the square of the speed, as in air.",
    "stribeck": "Dry friction is larger near rest than in motion.",
    "loaded": "Dry friction grows with the load of a gear or bearing.",
    "coulomb_by_position": "Dry friction depends on the position.",
    "offset": "A constant force or rate acts all the time.",
    "gravity_error": "Weight, lever arm or angle of gravity differ from the prior.",
    "cogging": "A torque is periodic in the position: cogging, or an eccentric shaft.",
    "spring": "A spring, such as a cable or hose, pulls towards one position.",
    "elastic_end": "An elastic stop acts near the end of the travel.",
    "inertia": "An axis has more inertia, e.g. that of its motor behind a gear.",
    "loss": "A loss to the surroundings or to another state.",
    "radiation": "Heat is lost by radiation.",
    "storage": "A second capacity, such as a wall, stores and releases with its own time constant.",
    "overflow": "Material overflows above an edge.",
    "coupling": "Another signal acts on the state.",
    "product": "The product of two signals acts on the state.",
    "input_gain": "The input's gain differs from the prior's.",
    "input_offset": "The input has an offset.",
    "gain_by_direction": "The input's gain depends on its sign.",
    "input_curve": "The input's characteristic is curved.",
    "saturation": "The input's effect levels off at large values.",
    "dead_zone": "Small inputs have no effect.",
    "input_lag": "The actuator follows its command with a time constant.",
    "input_delay": "The input acts after a delay.",
    "disturbance_gain": "The measured disturbance has another gain than the prior's.",
    "disturbance_offset": "The sensor of the measured disturbance has an offset.",
    "disturbance_lag": "The measured disturbance acts with a time constant.",
    "output_gain": "The sensor's gain is wrong.",
    "output_offset": "The sensor has an offset.",
    "output_curve": "The sensor's characteristic is curved.",
    "output_lag": "The sensor, or its filter, follows with a time constant.",
}
"""One sentence about each law of this module."""
