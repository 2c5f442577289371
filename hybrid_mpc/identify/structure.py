"""Which part of a prior is wrong: terms and signals get a factor that is fitted to the recordings. No torch in here.

A parameter cannot mend a wrong sign, a wrong unit or a term that does not exist. A factor on the term can: at -1 the
sign is wrong, at 57.3 degrees stand for radians, at zero there is no such term.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data import scales
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.fit import (
    GROWN,
    LENGTHS,
    POOR,
    QUIET,
    WINDOWS,
    OutputFit,
    Shooting,
    Trial,
    cut_outputs,
    with_states,
)
from hybrid_mpc.identify.simulation import MAX_SUBSTEPS, visited
from hybrid_mpc.identify.smooth import rough_smoother
from hybrid_mpc.machine.prior import POINT, Parameter, Prior, components

Array = NDArray[np.float64]
LARGEST = 1e4
"""Largest factor: the largest mistake of a unit that is looked for is one of 3,600, hours for seconds."""
READINGS = (
    (-1.0, "its sign seems wrong"),
    (180 / math.pi, "radians seem to stand for degrees"),
    (math.pi / 180, "degrees seem to stand for radians"),
    (60.0, "a factor of 60 is missing, as between minutes and seconds"),
    (1 / 60, "it is 60 times too large, as between minutes and seconds"),
    (3600.0, "a factor of 3600 is missing, as between hours and seconds"),
    (1 / 3600, "it is 3600 times too large, as between hours and seconds"),
    (2 * math.pi, "a factor of 2 pi is missing, as between turns and radians"),
    (0.5 / math.pi, "it is 2 pi times too large, as between turns and radians"),
    (2.0, "a factor of 2 is missing"),
    (0.5, "it seems to be counted twice"),
    *((10.0**k, f"a factor of 1e{k} is missing, as between units") for k in (1, 2, 3, 5, 6)),
    *((10.0**-k, f"it is 1e{k} times too large, as between units") for k in (1, 2, 3, 5, 6)),
)
"""Factors that say what the mistake is."""
NEAR = 0.2
"""Relative distance of a factor from such a value that counts as the same: parameters take a part of a mistake."""
SMALL = 0.1
"""Size of a factor below which its term may not exist."""
SIZE = 1.5
"""Least factor, or its inverse, that says that something is wrong: parameters take what is smaller."""
SHORTER = 0.7
"""Ratio of a length to a longer one from which on both tell the same."""
NAMED, GUESSED = 0.7, 0.5
"""Error with the mistake mended over the error without below which the mistake is named: where the factor says what the
mistake is, and where it says no more than that something is wrong.
"""
BETTER = 0.95
"""Ratio of two errors from which on the smaller counts."""
ALIKE = 1.25
"""Ratio of two errors up to which their explanations count as equal."""
TRIED = 16
"""Trial fits at least that go on to the end."""
STEPS = 3
"""Pairs of Gauss-Newton steps of a trial fit; it shows the size of an error, no more."""
MOST = 3
"""Explanations that are named at most where several are equal."""
ANGLES: Mapping[str, float] = {"rad": 0.5 * math.pi, "deg": 90.0}
"""A quarter of a turn in the units of angles."""


VAGUE = ("its sign seems wrong, and its size too", "a factor or a unit seems to be wrong")
"""What is said of other factors."""
COMMON = 0.05, 15.0
"""Factors between these that are positive may stand for missing physics, too: 0.5 and 2 say little of a mistake."""
SUMS = (ca.OP_ADD, ca.OP_SUB)


@dataclass(frozen=True)
class Cause:
    """A mistake that explains why a prior does not follow the recordings.

    Args:
        what: The term or signal that is wrong.
        why: What is wrong with it.
        ratio: Error of free runs with the mistake mended over the error without [-].
        factor: Factor that the recordings give the term; NaN where there is none.

    Example:
        >>> print(Cause("k * u in the rate of v", "its sign seems wrong", 0.1, -1.02))
        k * u in the rate of v: its sign seems wrong (factor -1.02); mended, the error of free runs falls to 10 %
    """

    what: str
    why: str
    ratio: float
    factor: float = math.nan

    @property
    def exact(self) -> bool:
        """Whether the factor says what the mistake is."""
        return self.why not in VAGUE and not COMMON[0] < self.factor < COMMON[1]

    def __str__(self) -> str:
        factor = "" if math.isnan(self.factor) else f" (factor {self.factor:.3g})"
        return f"{self.what}: {self.why}{factor}; mended, the error of free runs falls to {100 * self.ratio:.0f} %"


def reading_of(factor: float, needed: bool = True) -> str:
    """What a factor says of its term, and whether recordings do need the term; empty where it is about 1.

    Example:
        >>> reading_of(-1.04), reading_of(0.001), reading_of(0.001, needed=False), reading_of(1.1)
        ('its sign seems wrong', 'it is 1e3 times too large, as between units', 'it seems not to exist', '')
    """
    if not needed:
        return "it seems not to exist"
    off, text = min((abs(factor / value - 1.0), text) for value, text in READINGS)
    if off <= NEAR:
        return text
    if factor < 0.0:
        return VAGUE[0]
    return "" if 1 / SIZE < factor < SIZE else VAGUE[1]


class _Editor:
    """A prior's equations with factors on terms; terms are counted in the order in which they are met."""

    def __init__(self, prior: Prior, factors: Mapping[int, ca.SX]) -> None:
        self._prior, self._factors = copy.copy(prior), factors
        self._evaluate, self.terms = prior.evaluated, []
        self._prior.evaluated = self._evaluated  # type: ignore[method-assign]

    terms: list[str]

    def expressions(self, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Rates and outputs at symbols; those of inputs and disturbances get a factor each."""
        signals = self._prior.inputs, self._prior.disturbances
        scaled = [
            ca.vertcat(*(v[i] * self._factor(f"{kind} {s.label}") for i, s in enumerate(own)))
            for v, own, kind in zip((u, w), signals, ("input", "disturbance"), strict=True)
        ]
        rates, outputs, _ = self._prior.expressions(x, u, w, p)
        found = [ca.vertcat(*(ca.SX(v) for v in components(one))) for one in (rates, outputs)]
        # put in at the end: the graph whose terms are counted is the prior's own
        rates, outputs = ca.substitute(found, [u, w], scaled)
        return rates, outputs

    def _factor(self, term: str) -> ca.SX | float:
        self.terms.append(term)
        return self._factors.get(len(self.terms) - 1, 1.0)

    def _evaluated(self, method: str, *arguments: tuple[str, ca.SX]) -> Any:
        value = self._evaluate(method, *arguments)
        if method == "balances":
            return ()
        names = {
            str(v[i]): name
            for key, v in arguments
            for i, name in enumerate(self._prior.names_of(key)[: v.numel()])
        }
        scalars = [ca.SX(one) for one in components(value)]
        moving = {str(v[i]) for key, v in arguments if key != "p" for i in range(v.numel())}
        graph = _Graph(scalars, names, moving, self._factor)
        places = self._places(method, len(scalars))
        return tuple(graph.edited(one, place) for one, place in zip(scalars, places, strict=True))

    def _places(self, method: str, n: int) -> list[str]:
        prior = self._prior
        if method == "xdot":
            return [f"rate of {s.name}" for s in prior.states]
        if method == "output":
            return [f"output {s.name}" for s in prior.outputs]
        if method == "mass_matrix" and n == (size := len(prior.states) // 2) ** 2:
            names = prior.names_of("q")
            pairs = [(min(i, j), max(i, j)) for i in range(size) for j in range(size)]
            return [f"mass matrix ({names[i]}, {names[j]})" for i, j in pairs]
        title = method.replace("_", " ")
        return [title] if n == 1 else [f"{title} of {name}" for name in prior.names_of("q")]


class _Graph:
    """The scalars of one method as a graph whose sums get factors on their operands."""

    def __init__(
        self,
        scalars: Sequence[ca.SX],
        names: Mapping[str, str],
        moving: set[str],
        factor: Callable[[str], Any],
    ) -> None:
        self._names, self._moving, self._factor = names, moving, factor
        self._done: dict[int, ca.SX] = {}
        self._moves: dict[int, bool] = {}
        self._roots: dict[str, Any] = {}
        self._uses: Counter[int] = Counter()
        met: set[int] = set()
        for scalar in scalars:
            self._count(scalar, met)

    def _count(self, e: ca.SX, met: set[int]) -> None:
        self._uses[e.element_hash()] += 1
        if e.element_hash() not in met:
            met.add(e.element_hash())
            for i in range(e.n_dep()):
                self._count(e.dep(i), met)

    def moves(self, e: ca.SX) -> bool:
        """Whether a node depends on states, inputs or disturbances."""
        key = e.element_hash()
        if key not in self._moves:
            own = e.is_symbolic() and str(e) in self._moving
            self._moves[key] = own or any(self.moves(e.dep(i)) for i in range(e.n_dep()))
        return self._moves[key]

    def edited(self, scalar: ca.SX, place: str) -> ca.SX:
        """A scalar with factors, on the whole of it too."""
        text = self.text(scalar)
        if scalar.is_zero():
            return scalar
        key = f"{place}: {text}"
        if key not in self._roots:  # entries of a symmetric matrix share theirs
            whole = scalar.op() in SUMS
            self._roots[key] = self._factor(f"the {place}" if whole else f"{text} in the {place}")
        return self._inside(scalar, place) * self._roots[key]

    def _inside(self, e: ca.SX, place: str) -> ca.SX:
        key = e.element_hash()
        if key in self._done:
            return self._done[key]
        operands = [self._inside(e.dep(i), place) for i in range(e.n_dep())]
        if e.op() in SUMS and self.moves(e):
            operands = [
                own
                if self._chained(e.dep(i))
                else own * self._factor(f"{self.text(e.dep(i))} in the {place}")
                for i, own in enumerate(operands)
            ]
        if not operands:
            found = e
        elif len(operands) == 1:
            found = ca.SX.unary(e.op(), operands[0])
        else:
            found = ca.SX.binary(e.op(), *operands)
        if operands and self._uses[key] > 1 and self.moves(e):
            found = found * self._factor(f"{self.text(e)} wherever the {place} uses it")
        self._done[key] = found
        return found

    def _chained(self, e: ca.SX) -> bool:
        """Whether a node is a part of a longer sum: ``a + b`` in ``a + b + c``."""
        return e.op() in SUMS and e.n_dep() == 2 and self._uses[e.element_hash()] == 1

    def text(self, e: ca.SX) -> str:
        """A node as a formula."""
        if not e.n_dep():
            return self._names.get(str(e), str(e))
        inner = [self.text(e.dep(i)) for i in range(e.n_dep())]
        sums = [e.dep(i).op() in SUMS and e.dep(i).n_dep() == 2 for i in range(e.n_dep())]
        op = e.op()
        if op in _INFIX:
            sign, tight = _INFIX[op]
            wrapped = [
                f"({t})" if s and (tight or (op == ca.OP_SUB and i)) else t
                for i, (t, s) in enumerate(zip(inner, sums, strict=True))
            ]
            if op == ca.OP_DIV and e.dep(1).op() in (ca.OP_MUL, ca.OP_DIV) and e.dep(1).n_dep():
                wrapped[1] = f"({inner[1]})"
            return sign.join(wrapped)
        if op == ca.OP_NEG:
            return f"-({inner[0]})" if sums[0] else f"-{inner[0]}"
        if op == ca.OP_TWICE:
            return f"2 * ({inner[0]})" if sums[0] else f"2 * {inner[0]}"
        if op == ca.OP_SQ:
            return f"{inner[0]}^2" if not e.dep(0).n_dep() else f"({inner[0]})^2"
        return str(ca.print_operator(e, inner))


_INFIX = {
    ca.OP_ADD: (" + ", False),
    ca.OP_SUB: (" - ", False),
    ca.OP_MUL: (" * ", True),
    ca.OP_DIV: (" / ", True),
}


def _symbols(prior: Prior) -> list[ca.SX]:
    return [ca.vertcat(*(ca.SX.sym(name) for name in prior.names_of(key))) for key in POINT]


def terms_of(prior: Prior) -> list[str]:
    """Terms and signals of a prior that get a factor, in the order of their numbers.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> terms_of(PendulumPrior())[0]
        'input u [N m]'
    """
    editor = _Editor(prior, {})
    editor.expressions(*_symbols(prior))
    return editor.terms


def with_factor(make: Callable[..., Prior]) -> type[Prior]:
    """The prior as a class of its own with a free factor, and for each of its terms a number that chooses it.

    A term whose number is 1 has the factor, one whose number is 0 has none (:func:`terms_of` names them).
    """
    base = make()
    n, terms = len(base.parameters), len(terms_of(base))
    more = (
        Parameter("factor", 1.0, "-", -LARGEST, LARGEST),
        *(Parameter(f"chosen {k}", 0.0, "-", 0.0, 0.0) for k in range(terms)),
    )

    def expressions(self: Prior, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[Any, Any, tuple[()]]:
        factors = {k: 1.0 + p[n + 1 + k] * (p[n] - 1.0) for k in range(terms)}
        return *_Editor(base, factors).expressions(x, u, w, p[:n]), ()

    signals = {key: getattr(base, key) for key in ("states", "inputs", "outputs", "disturbances")}
    own = {
        **signals, "parameters": (*base.parameters, *more), "expressions": expressions,
        "corrects": tuple(base.states[i].name for i in base.corrected), "operating_point": base.operating_point,
        "__module__": __name__,
    }  # fmt: skip
    return type(f"{type(base).__name__}WithFactor", (Prior,), own)


class _Lenient(OutputFit):
    """Parameters of trial fits."""

    def substeps(self, theta: Array) -> int:
        """As many as are needed, or the most that there may be: a model that is stiffer runs away and is not named."""
        try:
            return super().substeps(theta)
        except InputError:
            return MAX_SUBSTEPS


class _FactorFit(_Lenient):
    """Parameters and the factor of one term; several ``theta`` have the factor on a term each, by ``chosen``.

    A negative number chooses none.
    """

    def __init__(self, make: Callable[..., Prior], dt: float) -> None:
        super().__init__(make, dt)
        self.terms = sum(p.name.startswith("chosen ") for p in self.prior.parameters)
        self.chosen: Sequence[int] = ()

    def choosing(self, chosen: Sequence[int]) -> _FactorFit:
        """The same fit for as many ``theta`` with these terms."""
        other = copy.copy(self)
        other.chosen = chosen
        return other

    def _every(self, thetas: Array) -> list[list[float]]:
        chosen = np.array(self.chosen)[:, None] == np.arange(self.terms)
        rows = []
        for one, own in zip(thetas, chosen, strict=True):
            *constants, late = self._constants(one)
            rows.append([*constants[: -self.terms], *own.astype(float), late])
        return rows


def run_length(
    make: Callable[..., Prior],
    values: Mapping[str, float],
    recorded: Sequence[Trajectory],
    dt: float,
    longest: float,
    time_unit: float,
) -> float:
    """Length [s] of the free runs by which explanations are compared: that of the runs by which models are judged, less
    where small errors grow faster. There it is twice the time in which they grow tenfold: first states are free.
    """
    fit = OutputFit(make, dt)
    fit.points = visited(_smoothed(make, recorded, dt, time_unit)[0])
    tenfold = math.log(GROWN[0]) / math.log(GROWN[-1])
    reach = min(fit.reach(theta) for theta in (fit.nominal, fit.scaled(values))) * tenfold
    return max(4 * dt, min(longest, 2 * reach))


def _cut(fit: OutputFit, known: Sequence[Trajectory], sizes: Array, length: float) -> Shooting:
    """Windows of ``length`` [s], or as long as the recordings hold."""
    longest = max(len(t.t) for t in known) - 1
    periods = min(scales.periods(length, fit.dt, 2), longest)
    return Shooting(fit, cut_outputs(known, periods, 0, WINDOWS // 4, fit.prior.states), sizes)


def named(found: Sequence[Cause]) -> str:
    """What is said of causes that explain equally much; empty without any."""
    return "; or, as likely, ".join(str(one) for one in found)


def causes(
    make: Callable[..., Prior],
    values: Mapping[str, float],
    recorded: Sequence[Trajectory],
    dt: float,
    length: float,
    time_unit: float,
) -> tuple[Cause, ...]:
    """Mistakes in a prior that explain why it does not follow recordings; the likeliest first, equal ones behind it.

    Each term of its equations and each signal gets a factor, which is fitted with all parameters, from 1 and from -1
    on. Where no factor explains the error, outputs are counted the other way, signals of a kind are exchanged, and
    angles are turned by quarters of a turn.
    A mistake is named where mending it takes the error of free runs to less than ``NAMED``, or ``GUESSED`` where its
    factor does not say what is wrong (:func:`reading_of`).

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        values: Fitted values [their units] by name.
        recorded: Training trajectories as recorded, with the inputs that act.
        dt: Model period [s].
        length: Length [s] of the free runs.
        time_unit: The machine's second [s].
    """
    known, sizes, noise = _smoothed(make, recorded, dt, time_unit)
    fit = _FactorFit(with_factor(make), dt)
    fit.points = visited(known)
    problem, names = _cut(fit, known, sizes, length), terms_of(make())
    thetas = fit.nominal, fit.scaled({**fit.prior.values, **values})
    begun = [(-1, theta) for theta in thetas]
    begun += [
        (k, np.append(theta[:-1], one)) for k in range(len(names)) for theta in thetas for one in (-1.0, 1.0)
    ]
    (plain,) = problem.several(thetas[1][None], lambda numbers: fit.choosing([-1] * len(numbers)), [])
    if plain.error <= QUIET * float(np.sqrt(np.mean(np.square(noise / problem.spread)))):
        return ()  # little is left but the sensors' noise
    short = _cut(fit, known, sizes, min(LENGTHS[1] * time_unit, length))
    before, terms = _fitted(fit, problem, _moved(fit, short, begun))
    found = [
        Cause(names[k], why, trial.error / before, float(trial.theta[-1]))
        for k, trial in terms.items()
        if (why := reading_of(float(trial.theta[-1]), _needed(fit, problem, k, trial)))
    ]
    found = [one for one in found if one.ratio <= (NAMED if one.exact else GUESSED)]
    least = min((one.ratio for one in found), default=1.0)
    if before * least > POOR or not found:
        signals = _signals(make, recorded, before, [theta[:-1] for theta in thetas], dt, length, time_unit)
        found += [one for one in signals if one.ratio <= NAMED]
    found.sort(key=lambda one: one.ratio)
    return tuple(one for one in found if one.ratio <= ALIKE * found[0].ratio)[:MOST]


def _moved(fit: _FactorFit, short: Shooting, begun: Sequence[tuple[int, Array]]) -> list[tuple[int, Array]]:
    """Starts to which a few steps over short windows lead, with factors held: long windows have more optima."""
    chosen = [k for k, _ in begun]
    every = short.several(
        np.stack([theta for _, theta in begun]), lambda numbers: fit.choosing([chosen[i] for i in numbers]),
        [len(begun)] * STEPS, -1,
    )  # fmt: skip
    return [(chosen[one.start], one.theta) for one in every]


def _needed(fit: _FactorFit, problem: Shooting, k: int, trial: Trial) -> bool:
    """Whether free runs need a term whose factor is small."""
    if abs(trial.theta[-1]) > SMALL:
        return True
    without = np.append(trial.theta[:-1], 0.0)[None]
    (nothing,) = problem.several(without, lambda numbers: fit.choosing([k] * len(numbers)), [])
    return trial.error < BETTER * nothing.error


def _fitted(
    fit: _FactorFit, problem: Shooting, begun: Sequence[tuple[int, Array]]
) -> tuple[float, dict[int, Trial]]:
    """Error without a factor, and for each term what is best of the fits that went on to the end."""

    def choosing(numbers: Sequence[int]) -> _FactorFit:
        return fit.choosing([begun[i][0] for i in numbers])

    plain = [theta for k, theta in begun if k < 0]
    before = min(
        t.error
        for t in problem.several(np.stack(plain), lambda n: fit.choosing([-1] * len(n)), [len(plain)] * STEPS)
    )
    keep = [max(TRIED, len(begun) // 2**i) for i in range(2 * STEPS)]
    found: dict[int, Trial] = {}
    every = problem.several(np.stack([theta for _, theta in begun]), choosing, keep)
    for one in sorted(every, key=lambda t: t.error):
        k = begun[one.start][0]
        other = found.setdefault(k, one)
        turned = one.theta[-1] < 0.0 and abs(one.theta[-1] + 1.0) < abs(other.theta[-1] + 1.0)
        if turned and other.theta[-1] < 0.0 and other.error > BETTER * one.error:
            found[k] = one  # where its size is unknown, its sign alone counts
    found.pop(-1, None)
    return before, found


def _smoothed(
    make: Callable[..., Prior], recorded: Sequence[Trajectory], dt: float, time_unit: float
) -> tuple[list[Trajectory], Array, Array]:
    """Recordings with states that the nominal prior smooths, sizes of the states, and noise of the outputs."""
    smoother = rough_smoother(make(), recorded, dt, time_unit=time_unit)
    sizes = smoother.sizes
    return with_states(recorded, smoother, 0.0), np.array(sizes.x), np.array(sizes.noise)


def _signals(
    make: Callable[..., Prior], recorded: Sequence[Trajectory], before: float, starts: Sequence[Array], dt: float,
    length: float, time_unit: float,
) -> Iterator[Cause]:  # fmt: skip
    """Signals that are counted the other way, exchanged, or angles from another zero."""
    prior = make()
    changes: list[tuple[str, str, Callable[[Trajectory], Trajectory]]] = []
    for key, signals in (("y", prior.outputs), ("u", prior.inputs)):
        kind = "output" if key == "y" else "input"
        for j, signal in enumerate(signals):
            name = f"{kind} {signal.label}"
            if key == "y" and signal.lower < 0.0 < signal.upper:  # of an input the factor says so
                changes.append((name, "it seems to be counted the other way", _changed(key, j, j, -1.0)))
            for turns in (2.0, 1.0, -1.0) if signal.unit in ANGLES and key == "y" else ():
                off = turns * ANGLES[signal.unit]
                why = f"{off:+.4g} {signal.unit} seems to be missing: the angle is counted from another zero"
                changes.append((name, why, _changed(key, j, j, 1.0, off)))
            changes += [
                (
                    f"{kind}s {signal.label} and {other.label}",
                    "they seem to be exchanged",
                    _changed(key, j, i, 1.0),
                )
                for i, other in enumerate(signals[:j])
            ]
    for what, why, change in changes:
        known, sizes, _ = _smoothed(make, [change(t) for t in recorded], dt, time_unit)
        fit = _Lenient(make, dt)
        fit.points = visited(known)
        problem = _cut(fit, known, sizes, length)
        found = problem.several(np.stack(starts), lambda numbers, own=fit: own, [len(starts)] * STEPS)  # type: ignore[misc]
        yield Cause(what, why, min(t.error for t in found) / before)


def _changed(
    key: str, j: int, i: int, factor: float, offset: float = 0.0
) -> Callable[[Trajectory], Trajectory]:
    """Trajectories with columns ``i`` and ``j`` of outputs (``"y"``) or inputs (``"u"``) exchanged, scaled, shifted."""

    def change(trajectory: Trajectory) -> Trajectory:
        values = np.array(getattr(trajectory, key))
        values[:, [j, i]] = values[:, [i, j]] * factor + offset
        if key == "u":
            return replace(trajectory, u=values)
        censored = np.array(trajectory.censored)
        censored[:, [j, i]] = censored[:, [i, j]] * int(np.sign(factor))
        return replace(trajectory, y=values, censored=censored)

    return change
