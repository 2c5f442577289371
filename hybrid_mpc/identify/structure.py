"""Diagnosis of a wrong prior: factors on its terms and signals are fitted to the recordings. No torch in here.

A parameter cannot correct a wrong sign, a wrong unit or a superfluous term. A factor on the term can: a factor of -1
means a wrong sign, 57.3 means degrees in place of radians, 0 means that the term does not exist.
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

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.fit import LENGTHS, QUIET, check_observable, with_states
from hybrid_mpc.identify.output_fit import GROWN, OutputFit, Slopes
from hybrid_mpc.identify.shooting import Shooting, Trial
from hybrid_mpc.identify.simulation import MAX_SUBSTEPS, Points, required_substeps, visited
from hybrid_mpc.identify.smooth import rough_smoother
from hybrid_mpc.identify.sound import shooting
from hybrid_mpc.identify.starts import POOR
from hybrid_mpc.identify.windows import OutputWindows
from hybrid_mpc.machine.prior import POINT, Parameter, Prior, components
from hybrid_mpc.machine.units import turn_in
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
LARGEST = 1e7
"""Largest factor, above the largest unit error of 1e6."""
READINGS = (
    (-1.0, "its sign seems wrong"),
    (180 / math.pi, "the unit seems to be rad instead of deg"),
    (math.pi / 180, "the unit seems to be deg instead of rad"),
    (60.0, "a factor of 60 is missing, as between minutes and seconds"),
    (1 / 60, "the value is 60 times too large, as between minutes and seconds"),
    (3600.0, "a factor of 3600 is missing, as between hours and seconds"),
    (1 / 3600, "the value is 3600 times too large, as between hours and seconds"),
    (2 * math.pi, "a factor of 2 pi is missing, as between turns and radians"),
    (0.5 / math.pi, "the value is 2 pi times too large, as between turns and radians"),
    (2.0, "a factor of 2 is missing"),
    (0.5, "the term seems to be included twice"),
    *((10.0**k, f"a factor of 1e{k} is missing, as between units") for k in (1, 2, 3, 5, 6)),
    *((10.0**-k, f"the value is 1e{k} times too large, as between units") for k in (1, 2, 3, 5, 6)),
)
"""Factors that identify the mistake, and their texts."""
UNITS = tuple(v for one in (10.0, 60.0, 1e3, 1e5) for v in (one, 1 / one))
"""Start values of the factor besides 1 and -1, for unit errors. From each result, the values of ``READINGS`` within a
factor of ``TAKEN`` are tried at the end.
"""
TRIALS, FEW = 12, 4
"""Number of windows of a trial fit, and for the comparison of unit errors, which have large effects."""
TAKEN = 30.0
"""Largest factor of a mistake that other parameters can compensate."""
EACH = 2
"""Number of unit errors that are tried for each term."""
NEAR = 0.2
"""Relative distance from a value of ``READINGS`` up to which a factor counts as this value; other parameters compensate
a part of a mistake."""
SMALL = 0.1
"""Size of a factor below which its term may not exist."""
SIZE = 1.5
"""Smallest factor (or inverse factor) that shows a mistake; parameters can compensate smaller factors."""
NAMED, GUESSED = 0.7, 0.5
"""Ratio of the error with the corrected mistake to the error before, below which the mistake is reported: if the factor
identifies the mistake, and if it does not.
"""
BETTER = 0.95
"""Ratio of two errors below which the smaller one counts as smaller."""
ALIKE, TOLD = 1.25, 2.0
"""Ratio of two errors up to which two explanations count as equal, and up to which an explanation whose factor
identifies the mistake is preferred.
"""
TRIED = 16
"""Maximum number of trial fits over long windows."""
STEPS = 3
"""Pairs of Gauss-Newton steps of a trial fit, which only estimates the size of an error."""
MOST = 3
"""Maximum number of equal explanations that are reported."""


VAGUE = ("its sign and its size seem wrong", "a factor or a unit seems to be wrong")
"""Texts for other factors: negative, and positive."""
COMMON = 0.05, 15.0
"""Range of positive factors that missing physics can also cause, so they do not identify a mistake."""
SUMS = (ca.OP_ADD, ca.OP_SUB)


@dataclass(frozen=True)
class Cause:
    """A mistake in a prior that explains its errors on the recordings.

    Args:
        what: The wrong term or signal.
        why: Description of the mistake.
        ratio: Free-run error after the correction over the error before it [-].
        factor: Fitted factor of the term; NaN without a factor. Default: NaN.
        before: False: the prior cannot be fitted with the mistake, so there is no error before the correction, and
            ``ratio`` is over the outputs' spread. Default: True.

    Example:
        >>> print(Cause("k * u", "its sign seems wrong", 0.1, -1.02))
        k * u: its sign seems wrong (factor -1.02); with the correction, the free-run error falls to 10 %
    """

    what: str
    why: str
    ratio: float
    factor: float = math.nan
    before: bool = True

    @property
    def exact(self) -> bool:
        """Whether the factor identifies the mistake."""
        return self.why not in VAGUE and not COMMON[0] < self.factor < COMMON[1]

    def __str__(self) -> str:
        factor = "" if math.isnan(self.factor) else f" (factor {self.factor:.3g})"
        left = f"{100 * self.ratio:.0f} %"
        change = f"falls to {left}" if self.before else f"is {left} of the outputs' spread"
        return f"{self.what}: {self.why}{factor}; with the correction, the free-run error {change}"


def reading_of(factor: float, needed: bool = True) -> str:
    """Text about the mistake that a factor shows; empty for a factor near 1.

    ``needed``: whether the recordings need the term.

    Example:
        >>> reading_of(-1.04), reading_of(0.001), reading_of(0.001, needed=False), reading_of(1.1)
        ('its sign seems wrong', 'the value is 1e3 times too large, as between units', 'the term seems superfluous', '')
    """
    if not needed:
        return "the term seems superfluous"
    if texts := _readings(factor):
        return ", or ".join(texts)
    if factor < 0.0:
        return VAGUE[0]
    return "" if 1 / SIZE < factor < SIZE else VAGUE[1]


def _readings(factor: float) -> list[str]:
    """Texts of the values near a factor, the nearest first; 57.3 and 60, for example, are not distinguishable."""
    off = sorted((abs(factor / value - 1.0), text) for value, text in READINGS)
    return [text for distance, text in off if distance <= NEAR]


class _Editor:
    """A prior's equations with factors on terms; terms are numbered in the order of their occurrence."""

    def __init__(self, prior: Prior, factors: Mapping[int, ca.SX]) -> None:
        self._prior, self._factors = copy.copy(prior), factors
        self._evaluate, self.terms = prior.evaluated, []
        self._prior.evaluated = self._evaluated  # type: ignore[method-assign]

    terms: list[str]

    def expressions(self, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Rates and outputs at symbols; each input and disturbance gets a factor."""
        signals = self._prior.inputs, self._prior.disturbances
        scaled = [
            ca.vertcat(*(v[i] * self._factor(f"{kind} {s.label}") for i, s in enumerate(own)))
            for v, own, kind in zip((u, w), signals, ("input", "disturbance"), strict=True)
        ]
        rates, outputs, _ = self._prior.expressions(x, u, w, p)
        found = [ca.vertcat(*(ca.SX(v) for v in components(one))) for one in (rates, outputs)]
        # substituted at the end, so that the numbered terms are those of the prior's own graph
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
    """Graph of the scalars of one method; the operands of its sums get factors."""

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
        for scalar in {one.element_hash(): one for one in scalars}.values():  # symmetric entries count once
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
        """Insert factors into a scalar, and one on the whole scalar."""
        text = self.text(scalar)
        if scalar.is_zero():
            return scalar
        key = f"{place}: {text}"
        if key not in self._roots:  # symmetric entries of a matrix share a factor
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
        """Whether a node is part of a longer sum: ``a + b`` in ``a + b + c``."""
        return e.op() in SUMS and e.n_dep() == 2 and self._uses[e.element_hash()] == 1

    def text(self, e: ca.SX) -> str:
        """Write a node as a formula."""
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
    """Names of the terms and signals of a prior that get a factor, in the order of their numbers.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> terms_of(PendulumPrior())[0]
        'input u [N m]'
    """
    editor = _Editor(prior, {})
    editor.expressions(*_symbols(prior))
    return editor.terms


def with_factor(make: Callable[..., Prior]) -> type[Prior]:
    """Create a class of the prior with a free factor, and one selector (0 or 1) for each of its terms.

    A term with selector 1 has the factor (:func:`terms_of` names the terms).
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
        """Required sub-steps, or the maximum; a stiffer model diverges and is not reported."""
        return self._enough(self.values(theta))

    def _enough(self, values: Mapping[str, float]) -> int:
        try:
            return max(self.least, required_substeps(self.make(values), self.dt, self.points))
        except InputError:
            return MAX_SUBSTEPS


class _FactorFit(_Lenient):
    """Parameters and the factor of one term.

    ``chosen`` holds the number of the term of each ``theta``; a negative number means no term.
    """

    def __init__(
        self, make: Callable[..., Prior], dt: float, on_progress: Callable[[str], None] = lambda text: None
    ) -> None:
        super().__init__(with_factor(make), dt)
        self.on_progress = on_progress
        self.term_names = terms_of(make())
        self.chosen: Sequence[int] = ()
        self.held = False
        self._needed: dict[tuple[bytes, int], int] = {}

    def visiting(self, known: Sequence[Trajectory]) -> _FactorFit:
        """Copy the fit, with the points of these recordings."""
        other = copy.copy(self)
        other.points, other._needed = visited(known), {}
        return other

    def choosing(self, chosen: Sequence[int], held: bool = False) -> _FactorFit:
        """Copy the fit for several ``theta`` with these terms; derivatives by a fixed (``held``) factor are zero."""
        other = copy.copy(self)
        other.chosen, other.held = chosen, held
        return other

    @property
    def _free(self) -> list[int]:
        """Indices of the fitted parameters; the factor is the last one."""
        places = super()._free
        return places[:-1] if self.held else places

    def outputs(
        self, theta: Array, x: Array, windows: OutputWindows, substeps: int, slopes: Slopes
    ) -> tuple[Array, Array]:
        """Outputs and derivatives, with a column for the factor even if it is fixed."""
        y, by = super().outputs(theta, x, windows, substeps, slopes)
        if self.held and slopes == "all":
            by = np.insert(by, len(self.unit) - 1, 0.0, axis=-1)
        return y, by

    def most_substeps(self, thetas: Array) -> int:
        """Largest number of sub-steps, with each factor on its term."""
        return max(self._substeps_with(theta, k) for theta, k in zip(thetas, self.chosen, strict=True))

    def _substeps_with(self, theta: Array, term: int) -> int:
        key = theta.tobytes(), term
        if key not in self._needed:
            values = {**self.values(theta), **({f"chosen {term}": 1.0} if term >= 0 else {})}
            self._needed[key] = self._enough(values)
        return self._needed[key]

    def _every(self, thetas: Array) -> list[list[float]]:
        terms = len(self.term_names)
        chosen = np.array(self.chosen)[:, None] == np.arange(terms)
        rows = []
        for one, own in zip(thetas, chosen, strict=True):
            *constants, late = self._constants(one)
            rows.append([*constants[:-terms], *own.astype(float), late])
        return rows


def _off_nominal(fit: OutputFit, theta: Array) -> float:
    """Squared distance of parameters from their nominal values, over half ranges; logarithmic for positive ranges."""
    ratio = (fit.lower > 0.0) & (fit.upper > fit.lower)
    low, high, own, nominal = (np.where(ratio, v, 1.0) for v in (fit.lower, fit.upper, theta, fit.nominal))
    relative = np.log(own / nominal) / np.where(ratio, 0.5 * np.log(high / low), 1.0)
    linear = (theta - fit.nominal) / np.where(fit.half > 0.0, fit.half, 1.0)
    return float(np.square(np.where(ratio, relative, linear)).sum())


def _lengths(fit: OutputFit, thetas: Sequence[Array], longest: float) -> list[float]:
    """Lengths [s] of the free runs that compare explanations.

    If small errors grow fast, there is a shorter length: twice the time in which they grow tenfold (initial states are
    free). The longest one is used too, because the mistake may cause the growth.
    """
    shorter = max(4 * fit.dt, 2 * min(fit.reach(theta, GROWN[0]) for theta in thetas))
    # ratio of a shorter to a longer length above which only the longer one is used
    return [shorter, longest] if shorter < 0.7 * longest else [longest]


def named(found: Sequence[Cause]) -> str:
    """Text of equally likely causes; empty without a cause."""
    return "; or, equally likely, ".join(str(one) for one in found)


def causes(
    make: Callable[..., Prior],
    values: Mapping[str, float],
    recorded: Sequence[Trajectory],
    dt: float,
    longest: float,
    time_unit: float,
    on_progress: Callable[[str], None] = lambda text: None,
) -> tuple[Cause, ...]:
    """Search a prior for mistakes that explain its errors on recordings: the likeliest, then equally likely ones.

    Each term of the equations and each signal gets a factor in turn. The factor is fitted with all parameters, from 1,
    from -1, and from the unit errors with the least error over short runs. If no factor explains the error, the signs
    of outputs are changed, signals of a kind are exchanged, and angles are shifted by quarter turns.

    A mistake is reported if its correction reduces the error of free runs below ``NAMED`` times the error before. If
    the factor does not identify the mistake (:func:`reading_of`), the limit is ``GUESSED``.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        values: Fitted values [their units] by name.
        recorded: Training trajectories as recorded, with the inputs that act.
        dt: Model period [s].
        longest: Length [s] of the free runs that evaluate models; shorter ones are used if small errors grow.
        time_unit: The machine's time unit [s].
        on_progress: Called before every group of trial fits with a text. Default: nothing.
    """
    known, sizes, noise = _smoothed(make, recorded, dt, time_unit)
    fit = _FactorFit(make, dt, on_progress).visiting(known)
    thetas = [fit.nominal, fit.scaled({**fit.prior.values, **values})]
    lengths = _lengths(fit, thetas, longest)

    def quiet(windows: Shooting) -> float:
        """Error below which the residual is mostly sensor noise."""
        return QUIET * float(np.sqrt(np.mean(np.square(noise / windows.spread))))

    found: list[Cause] = []
    for length in lengths:
        problem, short, few = (
            shooting(fit, known, sizes, min(own, length), most)
            for own, most in ((length, TRIALS), (LENGTHS[1] * time_unit, TRIALS), (time_unit, FEW))
        )
        if _tried(fit, problem, [_Start(-1, thetas[1])], 0)[0].error <= quiet(problem):
            continue
        plain, moved = _moved(fit, short, few, thetas, quiet)
        before, found = _explained(fit, problem, short, plain, moved)
        if before * min((one.ratio for one in found), default=1.0) > POOR or not found:
            signals = _signals(
                make, recorded, before, [theta[:-1] for theta in thetas], dt, length, time_unit, on_progress
            )
            found += [one for one in signals if one.ratio <= NAMED]
        if length > lengths[0]:  # on an unstable machine, a wrong model may only diverge later
            found = [one for one in found if before * one.ratio <= POOR]
        if found:
            break
    least = min((one.ratio for one in found), default=1.0)
    found = [one for one in found if one.exact and one.ratio <= TOLD * least] or found
    least = min((one.ratio for one in found), default=1.0)
    found.sort(key=lambda one: one.ratio)
    return tuple(one for one in found if one.ratio <= ALIKE * least)[:MOST]


def _moved(
    fit: _FactorFit,
    short: Shooting,
    few: Shooting,
    thetas: Sequence[Array],
    quiet: Callable[[Shooting], float],
) -> tuple[list[_Start], list[_Start]]:
    """Starts without a factor, and with factors that reduce the error over short windows.

    They are the results of trial fits over short windows, because long windows have more local optima.

    Args:
        fit: Parameters with the factor.
        short: Short windows.
        few: Fewer short windows, for unit errors.
        thetas: Start values of the parameters.
        quiet: Returns the error of windows below which the residual is mostly sensor noise.
    """
    terms = range(len(fit.term_names))
    begun = [_Start(-1, theta) for theta in thetas]
    plain = _best(begun, tried := _tried(fit, short, begun, STEPS, held=True), len(begun))
    enough = BETTER * min(one.error for one in tried)
    enough = math.inf if enough <= quiet(short) else enough
    moved: list[_Start] = []
    for begun, held, each in (
        ([_Start(k, plain[0].theta) for k in terms], False, 1),
        ([_Start(k, np.append(theta[:-1], -1.0)) for k in terms for theta in thetas], True, 1),
        (_units(fit, few), True, EACH),
    ):
        tried = _tried(fit, short, begun, STEPS, held=held)
        moved += _best(begun, [one for one in tried if one.error <= enough], each)
    return plain, sorted(moved, key=lambda one: one.error)[:TRIED]


def _explained(
    fit: _FactorFit, problem: Shooting, short: Shooting, plain: Sequence[_Start], moved: Sequence[_Start]
) -> tuple[float, list[Cause]]:
    """Error of free runs without a factor, and the causes: terms whose factor explains this error."""
    before = min(one.error for one in _tried(fit, problem, plain, STEPS, held=True))
    trials = _fitted(fit, problem, moved)
    least = min((one.error for one in trials.values()), default=math.inf)
    found = [
        _cause(fit, problem, short, k, one, before)
        for k, one in trials.items()
        if one.error <= min(TOLD * least, NAMED * before)
    ]
    return before, [one for one in found if one.why and one.ratio <= (NAMED if one.exact else GUESSED)]


def causes_of_refusal(
    make: Callable[..., Prior], recorded: Sequence[Trajectory], dt: float, longest: float, time_unit: float
) -> tuple[Cause, ...]:
    """Search for unit and sign errors of a prior that is refused as too stiff for the period, or as not observable.

    If a factor on a term makes the prior usable, its parameters are fitted to short runs. ``ratio`` is then the error
    of free runs with the correction, over the outputs' spread.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        recorded: Training trajectories as recorded.
        dt: Model period [s].
        longest: Length [s] of the free runs that evaluate models.
        time_unit: The machine's time unit [s].
    """
    known, points = None, None
    if _fits(make, dt, time_unit):  # usable at rest, but perhaps not along the recordings
        known = _smoothed(make, recorded, dt, time_unit)
        points = visited(known[0])
        if _fits(make, dt, time_unit, points):
            return ()
    fit = _FactorFit(make, dt)
    usable = []
    for k in range(len(fit.term_names)):
        for value in (value for value, _ in READINGS if value not in (0.5, 2.0)):
            one = _with_mended(make, k, value)
            if _fits(one, dt, time_unit, points):
                known = known or _smoothed(one, recorded, dt, time_unit)
                usable.append(_Start(k, np.append(fit.nominal[:-1], value)))
    if known is None:
        return ()
    tried: list[Trial] = []
    for steps in (0, STEPS):
        if tried:  # smooth the recordings with the best correction
            usable = [usable[one.start] for one in tried[:TRIED]]
            best = _with_mended(make, usable[0].term, float(usable[0].theta[-1]))
            known = _smoothed(best, recorded, dt, time_unit)
        fit = fit.visiting(known[0])
        short = shooting(fit, known[0], known[1], min(LENGTHS[1] * time_unit, longest), TRIALS)
        tried = sorted(_tried(fit, short, usable, steps, held=True), key=lambda one: one.error)
    alike = [one for one in tried if one.error <= min(GUESSED, ALIKE * tried[0].error)]
    alike.sort(key=lambda one: _off_nominal(fit, one.theta))
    values = [
        (fit.term_names[usable[one.start].term], float(one.theta[-1]), one.error) for one in alike[:MOST]
    ]
    return tuple(Cause(name, reading_of(value), error, value, before=False) for name, value, error in values)


def _fits(make: Callable[..., Prior], dt: float, time_unit: float, points: Points | None = None) -> bool:
    """Whether a prior is observable, and not too stiff for the period at rest and at points."""
    try:
        check_observable(make(), dt, time_unit)
        required_substeps(make(), dt, points)
    except InputError:
        return False
    return True


def _with_mended(make: Callable[..., Prior], term: int, value: float) -> type[Prior]:
    """Create a class of the prior whose factor on one term is fixed at ``value``."""
    base = with_factor(make)
    fixed = {"factor": value, f"chosen {term}": 1.0}
    own = (
        Parameter(p.name, fixed[p.name], p.unit, fixed[p.name], fixed[p.name]) if p.name in fixed else p
        for p in base.parameters
    )
    return type(base.__name__, (base,), {"parameters": tuple(own), "__module__": __name__})


@dataclass(frozen=True)
class _Start:
    """A start of a trial fit: term with the factor (-1: none), ``theta`` with the factor at its end, and error."""

    term: int
    theta: Array
    error: float = math.inf


def _tried(
    fit: _FactorFit, problem: Shooting, begun: Sequence[_Start], steps: int, held: bool = False
) -> list[Trial]:
    """Run trial fits from several starts.

    Args:
        fit: Parameters with the factor.
        problem: Windows.
        begun: Starts.
        steps: Pairs of Gauss-Newton steps; 0: only initial states are fitted.
        held: True: factors are fixed. Default: False.
    """
    groups: dict[int, list[int]] = {}
    # grouped by sub-steps, so that a stiff start does not slow down the others
    for i, one in enumerate(begun):
        substeps = fit.choosing([one.term]).most_substeps(one.theta[None])
        groups.setdefault(substeps.bit_length(), []).append(i)
    found = []
    for own in groups.values():
        length = fit.dt * (problem.windows.y.shape[1] - 1)
        fit.on_progress(f"{counted(len(own), 'trial fit')} in free runs of {length:.3g} s")
        chosen, thetas = (
            fit.choosing([begun[i].term for i in own], held),
            np.stack([begun[i].theta for i in own]),
        )
        every = problem.several(chosen, thetas, steps, -1 if held else None)
        found += [replace(one, start=own[one.start]) for one in every]
    return found


def _units(fit: _FactorFit, few: Shooting) -> list[_Start]:
    """Unit errors with the least error over a few short windows at nominal values, at most ``EACH`` for each term."""
    (before,) = _tried(fit, few, [_Start(-1, fit.nominal)], 0)
    terms = len(fit.term_names)
    begun = [_Start(k, np.append(fit.nominal[:-1], unit)) for k in range(terms) for unit in UNITS]
    begun = [one for one in begun if fit.choosing([one.term]).most_substeps(one.theta[None]) < MAX_SUBSTEPS]
    better = [one for one in _tried(fit, few, begun, 0) if one.error < BETTER * before.error]
    return _best(begun, better, EACH)[: max(TRIED, terms)]


def _best(begun: Sequence[_Start], trials: Sequence[Trial], each: int) -> list[_Start]:
    """Starts at the results of trial fits, at most ``each`` for each term, the best first."""
    count: Counter[int] = Counter()
    found = []
    for one in sorted(trials, key=lambda trial: trial.error):
        own = begun[one.start]
        count[own.term] += 1
        if count[own.term] <= each:
            found.append(replace(own, theta=one.theta, error=one.error))
    return found


def _cause(
    fit: _FactorFit, problem: Shooting, short: Shooting, term: int, free: Trial, before: float
) -> Cause:
    """Cause that a term's factor shows.

    A value of ``READINGS`` is preferred if its error is close to the least (``BETTER``). Of several such values, the
    value whose parameters are nearest to their nominal values is taken.
    """
    name = fit.term_names[term]
    why = reading_of(float(free.theta[-1]), _needed(fit, problem, term, free))
    plain = Cause(name, why, free.error / before, float(free.theta[-1]))
    if not why or not free.theta[-1]:
        return plain
    values = [value for value, _ in READINGS if 1 / TAKEN < value / free.theta[-1] < TAKEN]
    if not values:
        return plain
    begun = [_Start(term, np.append(fit.nominal[:-1], value)) for value in values]
    begun = _best(begun, _tried(fit, short, begun, STEPS, held=True), len(values))
    begun += [_Start(term, np.append(free.theta[:-1], value)) for value in values]
    held = _tried(fit, problem, begun, STEPS, held=True)
    least = min(free.error, *(one.error for one in held))
    alike = [one for one in held if one.error <= least / BETTER]
    if not alike:
        return plain
    alike.sort(key=lambda one: _off_nominal(fit, one.theta))
    said = list(dict.fromkeys(text for one in alike for text in _readings(float(one.theta[-1]))))
    chosen = alike[0]
    return Cause(name, ", or ".join(said[:2]), chosen.error / before, float(chosen.theta[-1]))


def _needed(fit: _FactorFit, problem: Shooting, term: int, trial: Trial) -> bool:
    """Whether free runs need a term whose factor is small."""
    if abs(trial.theta[-1]) > SMALL:
        return True
    (nothing,) = _tried(fit, problem, [_Start(term, np.append(trial.theta[:-1], 0.0))], 0)
    return trial.error < BETTER * nothing.error


def _fitted(fit: _FactorFit, problem: Shooting, begun: Sequence[_Start]) -> dict[int, Trial]:
    """The best complete fit with a free factor, by term."""
    found: dict[int, Trial] = {}
    for one in sorted(_tried(fit, problem, begun, 2 * STEPS), key=lambda trial: trial.error):
        other = found.setdefault(begun[one.start].term, one)
        turned = one.theta[-1] < 0.0 and abs(one.theta[-1] + 1.0) < abs(other.theta[-1] + 1.0)
        if turned and other.theta[-1] < 0.0 and other.error > BETTER * one.error:
            found[begun[one.start].term] = one  # of two negative factors, prefer the one nearer to -1
    return found


def _smoothed(
    make: Callable[..., Prior], recorded: Sequence[Trajectory], dt: float, time_unit: float
) -> tuple[list[Trajectory], Array, Array]:
    """Recordings with states smoothed by the nominal prior, sizes of the states, and noise of the outputs."""
    smoother = rough_smoother(make(), recorded, dt, time_unit=time_unit)
    sizes = smoother.sizes
    return with_states(recorded, smoother, 0.0), np.array(sizes.x), np.array(sizes.noise)


def _signals(
    make: Callable[..., Prior], recorded: Sequence[Trajectory], before: float, starts: Sequence[Array], dt: float,
    length: float, time_unit: float, on_progress: Callable[[str], None],
) -> Iterator[Cause]:  # fmt: skip
    """Causes in the signals: wrong sign, exchanged signals, angles with another zero."""
    prior = make()
    changes: list[tuple[str, str, Callable[[Trajectory], Trajectory]]] = []
    for key, signals in (("y", prior.outputs), ("u", prior.inputs)):
        kind = "output" if key == "y" else "input"
        for j, signal in enumerate(signals):
            name = f"{kind} {signal.label}"
            if key == "y" and signal.lower < 0.0 < signal.upper:  # for an input, the factor covers this case
                changes.append(
                    (name, "the sign convention seems to be the opposite", _changed(key, j, j, -1.0))
                )
            turn = turn_in(signal.unit) if key == "y" else None
            for off in () if turn is None else (turn / 2, turn / 4, -turn / 4):
                why = f"an offset of {off:+.4g} {signal.unit} seems to be missing: the angle has another zero"
                changes.append((name, why, _changed(key, j, j, 1.0, off)))
            changes += [
                (
                    f"{kind}s {signal.label} and {other.label}",
                    "the two seem to be exchanged",
                    _changed(key, j, i, 1.0),
                )
                for i, other in enumerate(signals[:j])
            ]
    for what, why, change in changes:
        on_progress(f"{what}: {why}")
        known, sizes, _ = _smoothed(make, [change(t) for t in recorded], dt, time_unit)
        fit = _Lenient(make, dt)
        fit.points = visited(known)
        problem = shooting(fit, known, sizes, length, TRIALS)
        found = problem.several(fit, np.stack(starts), STEPS)
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
