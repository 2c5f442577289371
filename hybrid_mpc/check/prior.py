"""Check of a prior: names, units, shapes, jumps, time, balances. An error in one part does not prevent the others."""

from __future__ import annotations

import difflib
import inspect
import math
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError, named_extra, no_exit, said_by
from hybrid_mpc.identify.simulation import rest_of
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import POINT, BalanceEquations, Prior, column
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.machine.units import differ, is_product, per_second
from nn_export import ExportError

Array = NDArray[np.float64]
POINTS = 16
"""Random points at which a prior is evaluated, besides the origin and the ends of the signals' ranges."""
BALANCE = 1e-6
"""Largest residual of a balance along the prior's own flow, over its terms; rounding is a billion times smaller."""
SAMPLES = 64
"""Points of each line along which jumps are searched."""
JUMP = 1e-4
"""Change over the last piece, over the change along the whole line, above which it is a jump: a slope would have to be
ten million times steeper than the line's."""
DRIFT = 0.01
"""Largest drift of a state within a warm-up, over its range, at an operating point that counts as an equilibrium."""
ROLES = ("states", "inputs", "outputs", "disturbances", "parameters")
TIMES = ("t", "time", "time_s", "clock", "now", "k")
ALGEBRAIC = ("z", "alg", "algebraic", "dae", "xdot", "x_dot", "dx", "dxdt")
NO_TIME = (
    ". Time can only enter as a measured disturbance: a column of the recordings that is known in advance, a Signal in "
    "disturbances, w.<name> in the equations"
)
NO_DAE = (
    ". Algebraic variables are not supported: substitute their equations, or make each variable a state with a fast "
    "rate"
)
FINITE = (
    ". It must be finite within the signals' ranges. Keep the arguments of roots and logarithms, and denominators, "
    "away from zero"
)
TOO_FEW = "HM-MACHINE-016"
"""Code of the error that equations give another number of values than there are signals."""
IF = "Cannot compute the truth value"
"""CasADi's message if code branches on an expression."""
NUMBER = ("must be real number", "float() argument", "to_int not defined", "loop of ufunc")
"""Messages of functions that expect a number and get an expression."""
NO_NUMBERS = (
    ". Write ca.sin(x), ca.sqrt(x) ... instead of functions of math or float(): they accept only numbers"
)


@dataclass
class Report:
    """Results so far: problems, which stop a job, and warnings."""

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def add(self, text: str) -> None:
        """Add a problem, once."""
        if text not in self.problems:
            self.problems.append(text)

    def warn(self, text: str) -> None:
        """Add a warning, once."""
        if text not in self.warnings:
            self.warnings.append(text)

    @contextmanager
    def part(self, what: str) -> Iterator[None]:
        """Check one part of the scenario: an exception becomes a problem, and the next part is still checked."""
        try:
            with no_exit(), named_extra():
                yield
        except InputError as error:
            for text in error.problems:
                self.add(f"{what}: {text}")
        except ExportError as error:  # several lines, one per operator
            self.add(f"{what}: {error}")
        except Exception as error:  # user code may raise any exception; it becomes a problem of the report
            said = (said_by(error) or "no message").splitlines()[0]
            self.add(
                f"{what} raised {type(error).__name__}: {said}{_place(error)}{_hint(error)} [HM-CHECK-061]"
            )

    @contextmanager
    def sound(self, what: str) -> Iterator[list[bool]]:
        """As ``part``; the list stays empty unless the part passes."""
        before, passed = len(self.problems), list[bool]()
        with self.part(what):
            yield passed
        if len(self.problems) == before:
            passed.append(True)


@dataclass(frozen=True)
class Points:
    """Points at which a prior is evaluated: states ``(n, n_x)``, inputs, disturbances and parameters ``(n, n_p)``.

    First the origin (or the nearest point of the ranges), then random points within the ranges, then the ends of the
    ranges, of each signal alone and of all together. Parameters are the prior's own; at every other random point they
    are random within their bounds.
    """

    x: Array
    u: Array
    w: Array
    p: Array

    @classmethod
    def of(cls, prior: Prior) -> Points:
        """The points of a prior."""
        groups = prior.states, prior.inputs, prior.disturbances
        drawn = [_drawn(group, seed) for seed, group in enumerate(groups)]
        signals = [s for group in groups for s in group]
        inner = np.column_stack(drawn)
        ends = [inner[0].copy() for _ in range(2 * len(signals))]
        for j, signal in enumerate(signals):
            for k, end in enumerate((signal.lower, signal.upper)):
                if math.isfinite(end):
                    ends[2 * j + k][j] = end
        both = [np.array([e if math.isfinite(e) else o for e, o in zip(side, inner[0], strict=True)])
                for side in ([s.lower for s in signals], [s.upper for s in signals])]  # fmt: skip
        every = np.vstack([inner, *ends, *both])
        p = np.broadcast_to(prior.p, (len(every), len(prior.parameters))).copy()
        rng = np.random.default_rng(3)
        for j, parameter in enumerate(prior.parameters):
            if math.isfinite(parameter.upper - parameter.lower):
                p[1 : POINTS + 1 : 2, j] = rng.uniform(parameter.lower, parameter.upper, POINTS // 2)
        sizes = np.cumsum([len(group) for group in groups])[:-1]
        x, u, w = np.split(every, sizes, axis=1)
        return cls(x, u, w, p)

    @property
    def columns(self) -> tuple[Array, Array, Array, Array]:
        """Arguments for CasADi: one column per point."""
        return self.x.T, self.u.T, self.w.T, self.p.T

    @property
    def nominal(self) -> Points:
        """Points with the prior's own parameters."""
        return self.where((self.p == self.p[0]).all(axis=1))

    def where(self, kept: NDArray[np.bool_]) -> Points:
        """Points of a mask ``(n,)``."""
        return Points(self.x[kept], self.u[kept], self.w[kept], self.p[kept])

    def named(self, k: int) -> str:
        """A point as text, with parameters if they are not the prior's own."""
        other = bool((self.p[k] != self.p[0]).any())
        shown = {key: v for key, v in vars(self).items() if v.size and (key != "p" or other)}
        return ", ".join(f"{name} = {v[k].tolist()}" for name, v in shown.items())


def _drawn(signals: Sequence[Signal], seed: int) -> Array:
    """The origin (or the nearest point of the range) and random points within the range, as rows."""
    rng = np.random.default_rng(seed)
    columns = []
    for signal in signals:
        low, high = _finite_range(signal)
        columns.append(np.concatenate([[min(max(0.0, low), high)], rng.uniform(low, high, POINTS)]))
    return np.column_stack(columns) if columns else np.zeros((POINTS + 1, 0))


def _finite_range(signal: Signal) -> tuple[float, float]:
    low = signal.lower if math.isfinite(signal.lower) else min(-1.0, signal.upper - 1.0)
    return low, signal.upper if math.isfinite(signal.upper) else max(1.0, signal.lower + 1.0)


def check_prior(report: Report, make: Callable[..., Prior]) -> tuple[Prior | None, bool]:
    """The prior if it can be made, and whether its equations can be evaluated at its operating point."""
    prior = _make(report, make)
    if prior is None:
        return None, False
    _check_signals(report, prior)
    if not (prior.states and prior.inputs and prior.outputs):
        return None, False
    _check_attributes(report, prior)
    _check_units(report, prior)
    with report.sound("prior") as rests:
        _check_point(prior)
    with report.part("prior"):
        prior.corrected  # noqa: B018  raises for names that are no states
    if len(prior.p) == len(prior.parameters) and _written(
        report, prior
    ):  # duplicate names are reported above
        return prior, _check_numbers(report, prior) and bool(rests)
    return prior, False


def _make(report: Report, make: Callable[..., Prior]) -> Prior | None:
    prior: Prior | None = None
    with report.part("prior"):
        found = make()
        if not isinstance(found, Prior):
            raise InputError(
                f"must create a hybrid_mpc Prior, e.g. prior=MyPrior, but creates a {type(found).__name__} "
                "[HM-CHECK-032]"
            )
        prior = found
    if prior is not None:
        with report.part("prior"):
            again = make(dict(prior.values))
            if again.values != prior.values:
                raise InputError(
                    f"prior(values) must use the given values, but {prior.values} became {again.values} [HM-CHECK-033]"
                )
    return prior


def _check_signals(report: Report, prior: Prior) -> None:
    for role in ROLES[:-1]:
        signals = getattr(prior, role)
        if not (signals or role == "disturbances"):
            report.add(
                f"prior: {role} must be a tuple of at least one Signal, got {signals!r} [HM-CHECK-034]"
            )
        elif len({s.name for s in signals}) < len(signals):
            report.add(
                f"prior: {role} must have different names, got {[s.name for s in signals]} [HM-CHECK-035]"
            )
    names = [p.name for p in prior.parameters]
    if len(set(names)) < len(names):
        report.add(f"prior: parameters must have different names, got {names} [HM-CHECK-036]")


def _check_attributes(report: Report, prior: Prior) -> None:
    """Attributes that a prior does not have: algebraic variables, misspelt roles, rates that are never called."""
    kind = type(prior)
    own = [
        c for c in kind.__mro__ if issubclass(c, Prior) and not c.__module__.startswith("hybrid_mpc.machine")
    ]
    for name, value in {name: value for c in own for name, value in vars(c).items()}.items():
        if name.startswith("algebraic") or name in ("alg", "dae", "z"):
            report.add(f"prior: {kind.__name__} has {name!r}{NO_DAE} [HM-CHECK-037]")
        held = isinstance(value, tuple) and value and all(isinstance(v, Signal) for v in value)
        near = difflib.get_close_matches(name, ROLES, n=1, cutoff=0.8)
        if held and near and name not in ROLES:
            report.add(
                f"prior: {kind.__name__} has signals under {name!r}, which is not used; did you mean {near[0]!r}?"
                " [HM-CHECK-038]"
            )
    if isinstance(prior, MechanicalPrior) and "xdot" not in prior.methods and kind.xdot is not Prior.xdot:
        report.add(
            f"prior: {kind.__name__}.xdot is never called: the rates of a MechanicalPrior come from "
            f"{', '.join(list(prior.methods)[:4])}. Define these methods, or derive from Prior. [HM-CHECK-039]"
        )


def _check_units(report: Report, prior: Prior) -> None:
    """Report units that contradict each other; an unknown unit contradicts nothing."""
    if type(prior).output is Prior.output:
        states = {s.name: s for s in prior.states}
        for one in prior.outputs:
            state = states.get(one.name)
            if state is not None and differ(one.unit, state.unit):
                report.add(
                    f"prior: the output {one.label} is the state {state.label} unchanged. Give both the same unit, or "
                    "write output(x, u, w, p) with the conversion. For columns in other units use units={...} in the "
                    "DataSpec. [HM-CHECK-040]"
                )
    if not isinstance(prior, MechanicalPrior):
        return
    for q, v in zip(prior.states[: prior.n_q], prior.states[prior.n_q :], strict=True):
        if differ(v.unit, per_second(q.unit)):
            report.add(
                f"prior: {v.label} is the rate of {q.label}, so its unit must be {per_second(q.unit)}. Check that the "
                "states are in the order [q, v]. [HM-CHECK-041]"
            )
    if type(prior).force is MechanicalPrior.force and len(prior.inputs) == prior.n_q:
        for u, q in zip(prior.inputs, prior.states[: prior.n_q], strict=True):
            if not is_product(u.unit, q.unit, "J"):
                report.add(
                    f"prior: the input {u.label} drives {q.label} as a force, so their product must be an energy [J]. "
                    "Correct a unit, or write force(q, v, u, w, p) with the conversion. [HM-CHECK-042]"
                )


def _check_point(prior: Prior) -> None:
    """Check that the operating point lies within the ranges."""
    point = prior.operating_point
    if point is None:
        return
    for name, values, signals in (
        ("x", point.x, prior.states), ("u", point.u, prior.inputs), ("w", point.w, prior.disturbances),
    ):  # fmt: skip
        beyond = [
            f"{s.label} from {s.lower:g} to {s.upper:g}"
            for s, v in zip(signals, values, strict=True)
            if not (s.lower <= v <= s.upper and math.isfinite(v))
        ]
        if beyond:
            raise InputError(
                f"operating_point: {name} = {values} is outside the range of {', '.join(beyond)}. Correct it, or the "
                "bounds of the signal. [HM-CHECK-045]"
            )


def _written(report: Report, prior: Prior) -> bool:
    """Whether all methods accept their arguments and return what they must."""
    before, kind, whole = len(report.problems), type(prior).__name__, list[str]()
    wrong = [
        name for name, arguments in prior.methods.items() if _check_arguments(report, prior, name, arguments)
    ]
    if not wrong:
        quiet = Report()
        with quiet.part("prior"):
            prior.equations  # noqa: B018
        if not quiet.problems:
            return True
        whole = quiet.problems
    for name, arguments in prior.methods.items():
        if name not in wrong:
            with report.part("prior"):
                _call(prior, name, arguments, f"{kind}.{name}({', '.join(arguments)})")
    if len(report.problems) == before:
        for text in whole:
            report.add(text)
    return False


def _check_arguments(report: Report, prior: Prior, name: str, arguments: Sequence[str]) -> bool:
    """Report a method with other arguments, such as time or algebraic variables; whether it has any."""
    signature = inspect.signature(getattr(prior, name))
    others = [key for key in signature.parameters if key not in arguments]
    fits = True
    try:
        signature.bind(*arguments)
    except TypeError:
        fits = False
    time, algebraic = ([key for key in others if key in known] for known in (TIMES, ALGEBRAIC))
    if fits and not time and not algebraic:
        return False
    report.add(
        f"prior: {type(prior).__name__}.{name} must take ({', '.join(arguments)}), but takes "
        f"({', '.join(signature.parameters)}){NO_TIME if time else NO_DAE if algebraic else ''} [HM-CHECK-046]"
    )
    return True


def _call(prior: Prior, name: str, arguments: Sequence[str], what: str) -> None:
    given = tuple((key, ca.SX.sym(key, len(prior.names_of(key)))) for key in arguments)
    if name == "balances":
        prior._balances(*given)
        return
    if isinstance(prior, MechanicalPrior) and name == "mass_matrix":
        prior.masses  # noqa: B018
        return
    value = prior.evaluated(name, *given)
    if isinstance(prior, MechanicalPrior) and name != "output":
        size, names = (1, ()) if name == "potential" else (prior.n_q, prior.names_of("v"))
    else:
        signals = prior.states if name == "xdot" else prior.outputs
        size, names = len(signals), tuple(s.name for s in signals)
    try:
        column(value, size, what, names)
    except InputError as error:
        few = name == "xdot" and TOO_FEW in error.codes
        raise InputError(
            f"{error}. Every state needs a rate{NO_DAE} [HM-CHECK-060]" if few else str(error)
        ) from error


def _check_numbers(report: Report, prior: Prior) -> bool:
    """Check values of the equations: finite, smooth, functions of the state, in balance; return whether finite."""
    points = Points.of(prior)
    finite = []
    with report.part("prior"):
        _check_again(prior, points)
    with report.sound("prior") as masses:
        _check_masses(prior, points.nominal)  # extreme parameters may describe no machine
    if not masses:
        return False
    for what, f in (
        ("xdot(x, u, w, p)", prior.equations.xdot),
        ("output(x, u, w, p)", prior.equations.output),
    ):
        with report.sound("prior") as passed:
            _check_finite(what, f, points)
        finite += passed
        if passed:
            with report.part("prior"):
                _check_smooth(what, f, prior, points)
    with report.part("prior"):
        _check_clock(prior)
    sound = points.nominal
    if len(finite) < 2:  # a singular end of a range must not hide other errors
        sound = sound.where(_finite_at(prior, sound))
    if len(sound.x):
        _check_effects(report, prior, sound)
        rates = prior.equations.xdot(*sound.columns).full()
        for balance in prior.equations.balances:
            with report.part("prior"):
                _check_balance(prior, balance, sound, rates)
    for balance in prior.equations.balances:
        if differ(balance.rate_unit, per_second(balance.unit)):
            report.add(
                f"prior: balance {balance.name}: the rate of a storage in {balance.unit} has the unit "
                f"{per_second(balance.unit)}, not {balance.rate_unit}. Correct unit or rate_unit. [HM-CHECK-047]"
            )
    if len(finite) == 2:
        return True
    try:
        x, u, w = rest_of(prior)
        return bool(_finite_at(prior, Points(x[None], u[None], w[None], prior.p[None]))[0])
    except (ValueError, RuntimeError):  # the operating point does not fit, which is reported already
        return False


def _values(prior: Prior) -> tuple[list[ca.SX], ca.SX]:
    """The symbols of a point, and rates and outputs there."""
    symbols = [ca.SX.sym(key, len(prior.names_of(key))) for key in POINT]
    return symbols, ca.vertcat(prior.equations.xdot(*symbols), prior.equations.output(*symbols))


def _finite_at(prior: Prior, points: Points) -> NDArray[np.bool_]:
    """Where rates, outputs and their derivatives are finite ``(n,)``."""
    symbols, value = _values(prior)
    slopes = [ca.vec(ca.densify(ca.jacobian(value, symbol))) for symbol in symbols]
    found = ca.Function("parts", symbols, [ca.vertcat(value, *slopes)])(*points.columns)
    return np.asarray(np.isfinite(found.full()).all(axis=0))


def _check_again(prior: Prior, points: Points) -> None:
    """Check that the equations are the same when called again: no clock, no random numbers."""
    if type(prior).evaluated is not Prior.evaluated:  # a torch prior: tracing again takes seconds
        return
    symbols = [ca.SX.sym(key, v.shape[1]) for key, v in vars(points).items()]
    rates, outputs, _ = prior.expressions(*symbols)
    for what, value, signals, f in (
        ("xdot", rates, prior.states, prior.equations.xdot),
        ("output", outputs, prior.outputs, prior.equations.output),
    ):
        again = ca.Function(what, symbols, [column(value, len(signals), what)])
        found, before = (g(*points.columns).full() for g in (again, f))
        if not np.allclose(found, before, rtol=1e-9, atol=0.0, equal_nan=True):
            raise InputError(
                f"{what} gives a different result when called again. It must be a function of (x, u, w, p) only, "
                f"without a clock or random numbers{NO_TIME} [HM-CHECK-048]"
            )


def _check_masses(prior: Prior, points: Points) -> None:
    """Check that a mass matrix is symmetric and positive definite within the signals' ranges."""
    if not isinstance(prior, MechanicalPrior):
        return
    masses = prior.masses
    for k, q in enumerate(points.x[:, : prior.n_q]):
        matrix = masses(q, points.p[k]).full()
        right = np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=BALANCE, atol=0)
        if not right or np.linalg.eigvalsh(matrix).min() <= 0:
            found = matrix.tolist() if prior.n_q > 1 else float(matrix[0, 0])
            raise InputError(
                f"mass_matrix(q, p) is {found} at {points.named(k)}. An inertia must be positive, a mass matrix "
                "symmetric and positive definite: check its terms and their signs. [HM-CHECK-049]"
            )


def _check_finite(what: str, f: ca.Function, points: Points) -> None:
    """Check that values and derivatives are finite within the signals' ranges."""
    symbols = dict(zip(POINT, f.sx_in(), strict=True))
    value = f(*symbols.values())
    parts = {"its value": value} | {
        f"its derivative by {key}": ca.vec(ca.densify(ca.jacobian(value, symbols[key]))) for key in "xup"
    }
    found = ca.Function("parts", [*symbols.values()], [*parts.values()])(*points.columns)
    for which, values in zip(parts, found, strict=True):
        bad = ~np.isfinite(values.full()).all(axis=0)
        if which == "its value" and bad.all():
            raise InputError(f"{what}: its value is not finite anywhere{NO_NUMBERS} [HM-CHECK-050]")
        if bad.any():
            where = points.named(int(np.argmax(bad)))
            raise InputError(
                f"{what}: {which} is not finite at {where}{FINITE}, e.g. sqrt(fmax(level, 1e-6)) [HM-CHECK-051]"
            )


def _check_smooth(what: str, f: ca.Function, prior: Prior, points: Points) -> None:
    """Check that a function has no jumps within the ranges: bisect the largest change along lines between points."""
    one = np.hstack([points.nominal.x, points.nominal.u, points.nominal.w])
    ends = one[:-1], one[1:]
    sizes = [len(prior.states), len(prior.inputs), len(prior.disturbances)]

    def along(share: Array) -> Array:
        """Values ``(lines, samples, n)`` at shares ``(lines, samples)`` of the way."""
        at = ends[0][:, None] + share[..., None] * (ends[1] - ends[0])[:, None]
        x, u, w = np.split(at.reshape(-1, at.shape[2]).T, np.cumsum(sizes)[:-1])
        found = f(x, u, w, prior.p).full().T
        return np.asarray(found.reshape(*share.shape, -1))

    share = np.linspace(0.0, 1.0, SAMPLES + 1)
    values = along(np.broadcast_to(share, (len(ends[0]), SAMPLES + 1)))
    steps = np.abs(np.diff(values, axis=1))
    span = np.ptp(values, axis=1)
    for i in range(values.shape[2]):
        k = steps[:, :, i].argmax(axis=1)
        low, high = share[k], share[k + 1]
        first, last = values[np.arange(len(k)), k, i], values[np.arange(len(k)), k + 1, i]
        # bisections of the piece with the largest change; the last piece is 1e-12 of the piece's length
        for _ in range(40):
            middle = 0.5 * (low + high)
            between = along(middle[:, None])[:, 0, i]
            left = np.abs(between - first) >= np.abs(last - between)
            low, high = np.where(left, low, middle), np.where(left, middle, high)
            first, last = np.where(left, first, between), np.where(left, between, last)
        jump = np.abs(last - first)
        found = int(
            np.argmax(np.where(span[:, i] > 0, jump / np.where(span[:, i] > 0, span[:, i], 1.0), 0.0))
        )
        if jump[found] > max(JUMP * span[found, i], BALANCE * np.abs(values[:, :, i]).max()):
            at = ends[0][found] + high[found] * (ends[1][found] - ends[0][found])
            parts = np.split(at, np.cumsum(sizes)[:-1])
            where = ", ".join(
                f"{key} = {v.round(9).tolist()}" for key, v in zip("xuw", parts, strict=True) if v.size
            )
            signal = (prior.states if what.startswith("xdot") else prior.outputs)[i]
            of = "the rate of " if what.startswith("xdot") else ""
            raise InputError(
                f"{what}: {of}{signal.name} jumps from {first[found]:.4g} to {last[found]:.4g} at {where}. Replace a "
                "switch by a smooth function of a width that you choose, e.g. tanh(v / 0.01) for sign(v). Inputs that "
                "are integers, or on and off, are not supported. [HM-CHECK-052]"
            )


def _check_clock(prior: Prior) -> None:
    x, u, w, p = (ca.SX.sym(key, len(prior.names_of(key))) for key in POINT)
    rates = prior.equations.xdot(x, u, w, p)
    for state, rate in zip(prior.states, ca.vertsplit(rates), strict=True):
        if rate.is_constant() and float(rate) != 0.0:
            raise InputError(
                f"the rate of {state.label} is always {float(rate):g}, so the state counts the time{NO_TIME}"
                " [HM-CHECK-053]"
            )


def _check_effects(report: Report, prior: Prior, points: Points) -> None:
    """Check that each input acts smoothly; warn of disturbances and parameters without effect."""
    symbols, value = _values(prior)
    groups: tuple[tuple[Signal | Parameter, ...], ...] = prior.inputs, prior.disturbances, prior.parameters
    for key, symbol, signals in zip("uwp", symbols[1:], groups, strict=True):
        for one, component in zip(signals, ca.vertsplit(symbol), strict=True):
            there = bool(ca.depends_on(value, component))
            if key != "u":
                if not there:
                    role = "parameter" if key == "p" else "disturbance"
                    report.warn(
                        f"prior: no rate and no output depends on the {role} {one.label}. Remove this {role}"
                    )
                continue
            slope = ca.Function("slope", symbols, [ca.densify(ca.jacobian(value, component))])
            if there and slope(*points.columns).full().any():
                continue
            how = (
                "acts only as a switch: its derivatives are zero everywhere. Inputs that are integers, or on and off, "
                "are not supported. Use a continuous input such as a duty cycle"
                if there
                else "changes no rate and no output. Use this input in the equations, or remove it"
            )
            report.add(f"prior: the input {one.label} {how} [HM-CHECK-054]")


def _check_balance(prior: Prior, balance: BalanceEquations, points: Points, rates: Array) -> None:
    """Check that a balance constrains rates, is finite, holds along the flow, and has no negative loss."""
    name = f"balance {balance.name} [{balance.rate_unit}]"
    symbols = balance.residual.sx_in()
    if not ca.depends_on(balance.residual(*symbols), symbols[1]):
        corrected = ", ".join(prior.states[i].name for i in prior.corrected)
        raise InputError(
            f"{name}: the storage does not depend on {corrected or 'any state'}, whose rates a network may correct, so "
            "the balance has no effect. Store what depends on them, or remove the balance. [HM-CHECK-055]"
        )
    x, u, w, p = points.columns
    supply, loss = (f(x, u, w, p).full()[0] for f in (balance.supply, balance.loss))
    residual = np.abs(balance.residual(x, rates, u, w, p).full()[0])
    bad = ~np.isfinite([supply, loss, residual]).all(axis=0)
    if bad.any():
        raise InputError(f"{name}: not finite at {points.named(int(np.argmax(bad)))}{FINITE} [HM-CHECK-056]")
    size, k = float(np.max(np.abs([supply, loss, residual]))), int(np.argmax(residual))
    if residual[k] > BALANCE * size:
        raise InputError(
            f"{name}: dS/dt - supply + loss is {residual[k]:.3g} along a trajectory of the prior, at "
            f"{points.named(k)}, but must be 0. Look for a missing term or a wrong sign. [HM-CHECK-057]"
        )
    k = int(np.argmin(loss))
    if loss[k] < -BALANCE * size:
        raise InputError(
            f"{name}: the loss is {loss[k]:.3g} at {points.named(k)}, but must not be negative. Move terms of either "
            "sign into the supply. [HM-CHECK-058]"
        )


def _hint(error: BaseException) -> str:
    """A remedy for known messages of Python and CasADi."""
    text = said_by(error)
    if IF in text:
        return ". Write ca.if_else(condition, one, other) instead of if"
    return NO_NUMBERS if any(word in text for word in NUMBER) else ""


def _place(error: BaseException) -> str:
    """The last line of the user's own code in an error's traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    library = Path(__file__).parents[1]
    own = [f for f in frames if library not in Path(f.filename).parents and "site-packages" not in f.filename]
    return f" ({own[-1].filename}:{own[-1].lineno})" if own else ""
