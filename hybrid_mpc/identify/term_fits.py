"""Fits of a prior with terms, in every fold of the held-out evidence. No torch in here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import periods as periods_of
from hybrid_mpc.data.scales import robust_spread
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.evidence import BLOCKS, SHORTEST, HeldOut, gathered
from hybrid_mpc.identify.explanation import FittedParameter, FoundTerm, HeldOutError, terms_of
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import Shooting, bounded_step
from hybrid_mpc.identify.simulation import Points, visited
from hybrid_mpc.identify.windows import OutputWindows
from hybrid_mpc.machine.prior import POINT, Prior
from hybrid_mpc.machine.terms import Term, extended, signals_at

Array = NDArray[np.float64]
Terms: TypeAlias = tuple[Term, ...]
WINDOWS = 48
"""Maximum number of windows of the search, shared evenly by the recordings; twice as many for short windows."""
SHORTER = 5
"""Ratio of the lengths of long and short windows. Short windows also score, start and evaluate candidates: small errors
of a force are seen where large ones have not yet grown over a long free run."""
ITERATIONS = 12
"""Gauss-Newton steps of a fit that starts near the optimum."""
WORTH = 0.95
"""Ratio of errors that a term must fall below to be needed beside another one, or an alternative to it."""
REACH = 3.0
"""Limit of an error of a free run, in spreads of the output, also for diverging runs."""
FAR = 2.0
"""Ratio of a start's error to that of the other start above which the start is not tried."""
RIDGE = 1e-6
"""Relative increase of the diagonal of the normal equations, so that equal columns stay solvable."""
LEAST_T = 2.0
"""Minimum t-ratio: at least one weight of each new term must differ from zero by this many standard errors."""
LEAST = 20
"""Minimum periods of a part of a single recording."""
ALONG = 4
"""Integration steps of a period for a term's state along a recording."""
FEW, EVERY = 6, 3
"""Iterations over the long windows that score a lag, and the share of the windows that do, one of so many."""
LOWERED = 0.99
"""Ratio of errors over all windows that a candidate must fall below before it is fitted in every fold."""


@dataclass(frozen=True)
class Present:
    """The terms that the search has added, their fit, and its squared errors over held-out data."""

    terms: Terms
    theta: Array
    squares: Array


@dataclass(frozen=True)
class FittedCandidate:
    """A candidate after its fit in every fold.

    ``forms`` are its terms; a process that fits for another one leaves them to it. ``held_out`` is None if the fit
    failed, or is ``worse`` over all data. ``sure``: it can be added; ``reason``: why not. ``needed`` are the terms of a
    pair without a needless one.
    """

    forms: Terms
    held_out: HeldOutError | None
    theta: Array
    squares: Array
    reason: str = ""
    sure: bool = False
    worse: bool = False
    short: HeldOutError | None = None
    needed: Terms = ()


@dataclass(frozen=True)
class Work:
    """A candidate to score or to fit beside the present terms, as data for any process.

    Args:
        task: ``"score"``: the logarithm of the ratio of errors of a term that acts at its nominal values; ``"fit"``:
            the fit in every fold.
        present: The present terms.
        theta: Their fit.
        squares: Its squared errors over held-out data.
        error: Its mean squared error over all data.
        forms: The candidate's terms.
        candidates: Number of candidates that are fitted in the step.
    """

    task: Literal["score", "fit"]
    present: tuple[FoundTerm, ...]
    theta: Array
    squares: Array
    error: float
    forms: tuple[FoundTerm, ...]
    candidates: int = 1


Answer: TypeAlias = float | FittedCandidate | str
"""Answer to a :class:`Work`: score or fitted candidate; or why it failed."""


class TermFits:
    """Windows of recordings, and fits of a prior with any terms to them.

    Args:
        base: The prior's class.
        values: Fitted values [their units] of the prior by name.
        known: Recordings with inputs that act and smoothed states.
        dt: Model period [s].
        length: Length [s] of the free runs that evaluate models.
        warm_up: Length [s] of the first part of a held-out free run, which only determines its initial state.
        own: A user's own terms.

    Raises:
        InputError: If there are too few recordings to evaluate terms.
    """

    def __init__(
        self,
        base: type[Prior],
        values: dict[str, float],
        known: Sequence[Trajectory],
        dt: float,
        length: float,
        warm_up: float,
        own: Sequence[Term] = (),
    ) -> None:
        self.base, self.dt, self.own = base, dt, tuple(own)
        ends = {name: max(len(t.t) for t in known if t.file == name) - 1 for name in {t.file for t in known}}
        longest = min(periods_of(length, dt, 2), max(ends.values()))
        # at least half the requested length, so that shorter recordings are used too
        longest = min(end for end in ends.values() if 2 * end >= longest)
        if len({t.file for t in known}) == 1:  # pieces of evidence are parts of the recording
            samples = sum(len(t.t) for t in known)
            longest = samples // BLOCKS - 1
            if longest < min(LEAST, periods_of(length, dt, 2)):
                raise InputError(
                    f"one recording of {samples} samples is too short to test terms: {BLOCKS} parts of at least "
                    f"{LEAST} periods are needed. Record {BLOCKS * (LEAST + 1) - samples} more samples, or a second "
                    "recording [HM-IDENTIFY-012]"
                )
        periods = min(periods_of(length, dt, 2), longest)
        prior, warm = base(values), round(warm_up / dt)
        self.evidence = gathered(known, prior, periods, warm, WINDOWS)
        less = max(periods // SHORTER, min(periods, 2 * SHORTEST))
        self.short = gathered(known, prior, less, warm, 2 * WINDOWS)
        self.points = visited(known)
        self.sizes = np.array([robust_spread(c) or 1.0 for c in np.concatenate([t.x for t in known]).T])
        y = self.evidence.windows.y
        self.spread = np.array([robust_spread(c) or 1.0 for c in y.reshape(-1, y.shape[-1]).T])
        self._fits: dict[Terms, OutputFit] = {}
        self._short_squares: dict[tuple[Terms, bytes], Array] = {}

    def fit(self, terms: Terms) -> OutputFit:
        """The fit of the prior with terms."""
        if terms not in self._fits:
            own = OutputFit(extended(self.base, *terms), self.dt)
            own.points = self.with_states(terms, self.points)
            self._fits[terms] = own
        return self._fits[terms]

    def with_states(self, terms: Terms, points: Points) -> Points:
        """Points with the terms' states; each of these states equals its signal."""
        added = [self._signal_of(term, points, self.base().p) for term in with_state(terms)]
        return np.column_stack([points[0], *added]), *points[1:]

    def _signal_of(self, term: Term, points: Points, p: Array) -> Array:
        """Values ``(n,)`` of a term's signal at points."""
        x, u, w = points
        if term.place == "output":
            values = self.base().equations.output(x.T, u.T, w.T, p).full().T
        else:
            values = {"input": u, "disturbance": w}.get(term.place, x)
        return np.asarray(values[:, index_of(self.base, term)])

    def problem(self, terms: Terms, windows: OutputWindows) -> Shooting:
        """Shooting problem for the fit of the prior with terms."""
        fit, sizes, first, known = self.fit(terms), self.sizes, windows.x, windows.known
        for term in with_state(terms):
            own, size = self._first(term, windows)
            first = np.column_stack([first, np.where(np.isfinite(own), own, np.nanmean(own))])
            known = np.column_stack([known, np.zeros(len(own), dtype=bool)])
            sizes = np.append(sizes, size or 1.0)
        return Shooting(fit, replace(windows, x=first, known=known), sizes, self.spread)

    def _first(self, term: Term, windows: OutputWindows) -> tuple[Array, float]:
        """Initial values ``(n,)`` of a term's state in windows (values of its signal), and its size."""
        k = index_of(self.base, term)
        if term.place == "rate":
            return windows.x[:, k], float(self.sizes[k])
        if term.place == "input":
            return windows.u[:, windows.lead, k], float(np.std(self.points[1][:, k]))
        if term.place == "disturbance":
            return windows.w[:, 0, k], float(np.std(self.points[2][:, k]))
        return windows.y[:, 0, k], float(self.spread[k])

    def evaluation(
        self, by: HeldOut, terms: Terms, theta: Array, keep: NDArray[np.bool_] | None = None
    ) -> Shooting:
        """Shooting problem for the evaluation of the prior with terms.

        The warm-up only determines the initial states; errors are counted on the rest. The initial value of a term's
        state follows from a simulation along the recording, since a free one could explain other effects.
        """
        some = np.ones(len(by.starts), dtype=bool) if keep is None else keep
        problem = self.problem(terms, replace(by.rows(some), warm=by.warm))
        added = with_state(terms)
        if not added:
            return problem
        values = self.fit(terms).values(theta)
        n_x, windows = len(self.base.states), problem.windows
        first, known = windows.x.copy(), windows.known.copy()
        for k, term in enumerate(added, n_x):
            along = {id(t): self._along(term, t, values) for t, _ in by.starts}
            first[:, k] = [along[id(t)][at] for (t, at), kept in zip(by.starts, some, strict=True) if kept]
            known[:, k] = True
        return Shooting(problem.own, replace(windows, x=first, known=known), problem.sizes, self.spread)

    def _along(self, term: Term, trajectory: Trajectory, values: dict[str, float]) -> Array:
        """Simulate a term's state along a recording ``(n,)``; it starts at the first value of its signal."""
        prior, n = extended(self.base, term)(), len(trajectory.t)
        z, u, w, p = (ca.SX.sym(key, len(prior.names_of(key))) for key in POINT)
        x, state = z[:-1], z[-1]  # the term's state is the last one
        rate = ca.Function("rate", [z, u, w, p], [prior.equations.xdot(z, u, w, p)[-1]])
        h, one = self.dt / ALONG, state
        for _ in range(ALONG):
            half = one + 0.5 * h * rate(ca.vertcat(x, one), u, w, p)
            one = one + h * rate(ca.vertcat(x, half), u, w, p)
        step = ca.Function("step", [state, x, u, w, p], [one]).mapaccum(n)
        own_p = np.array([values[name] for name in prior.names_of("p")])
        columns = [np.nan_to_num(getattr(trajectory, key)) for key in ("x", "u", "w")]
        x_0, u_0, w_0 = (c[:1] for c in columns)
        first = self._signal_of(term, (x_0, u_0, w_0), own_p[: len(self.base.parameters)])
        found = step(first, *(c.T for c in columns), np.tile(own_p[:, None], n)).full().ravel()
        return np.concatenate([first, found[:-1]])

    def held_out(self, by: HeldOut, terms: Terms, theta: Array) -> Array:
        """Squared errors ``(n, T + 1)`` of every window with a fit to the other folds, which starts from ``theta``."""
        squares, first = np.zeros(by.pieces.shape), self.problem(terms, by.windows).first_states(theta)
        for fold in sorted(set(by.folds.tolist())):
            held = by.folds == fold
            fitted = self.problem(terms, by.rows(~held)).solve(theta, ITERATIONS, first[~held]).theta
            squares[held] = squared_errors(self.evaluation(by, terms, fitted, held), fitted)
        return squares

    def start(self, terms: Terms, theta: Array) -> Array:
        """``theta`` of all terms from that of the first ones; the others start at their nominal values."""
        return np.concatenate([theta, self.fit(terms).nominal[len(theta) :]])

    def slow_score(self, now: Terms, terms: Terms, theta: Array) -> float:
        """Logarithm of the ratio of errors with a lag: derivatives at its nominal value do not predict its effect.

        The better of a fit to short windows, and a few iterations over long ones: in short windows the initial states
        explain a part of a lag.
        """
        start = self.start(terms, theta)
        long, short = (np.arange(len(by.starts)) % EVERY == 0 for by in (self.evidence, self.short))
        fits = [
            self.problem(terms, self.short.rows(short)).solve(start, ITERATIONS).theta,
            self.problem(terms, self.evidence.rows(long)).solve(start, FEW).theta,
        ]
        ends = self.error(now, theta, long)
        return 0.5 * math.log(min(self.error(terms, one, long) for one in fits) / ends)

    def begun(self, terms: Terms, theta: Array) -> Fitted:
        """Fit to all windows, from ``theta`` of the terms without the last ones.

        Two starts: directly, and via a fit to short windows (long free runs have more local optima); the better result
        is used.
        """
        start = self.start(terms, theta)
        problem = self.problem(terms, self.evidence.windows)
        near = self.problem(terms, self.short.windows).solve(start, ITERATIONS).theta
        starts = (
            [start, near] if problem.explained([near])[0] < FAR * problem.explained([start])[0] else [start]
        )
        fits = [problem.solve(one, ITERATIONS) for one in starts]
        return min(fits, key=lambda fit: problem.explained([fit.theta])[0])

    def indistinct(self, terms: Terms, fitted: Fitted, new: Terms) -> list[Term]:
        """New terms whose weights are all insignificant.

        For a term with a state, weight and time constant are identified together, so only the held-out error decides.
        """
        errors = np.sqrt(np.maximum(np.diag(fitted.covariance), 0.0))
        names, found = self.fit(terms).names, []
        for term in new:
            weights = [p.name for p in term.parameters if p.value == 0.0 and not p.fixed]
            at = [names.index(name) for name in weights]
            if term.state is None and at and (np.abs(fitted.theta[at]) < LEAST_T * errors[at]).all():
                found.append(term)
        return found

    def error(self, terms: Terms, theta: Array, keep: NDArray[np.bool_] | None = None) -> float:
        """Mean squared error over all windows, or over those of a mask."""
        squares = squared_errors(self.evaluation(self.evidence, terms, theta, keep), theta)
        counted_ = self.evidence.counted if keep is None else self.evidence.counted[keep]
        return max(float(squares[counted_].mean()), 1e-300)

    def without(self, terms: Terms, theta: Array, dropped: Term) -> tuple[Terms, Array]:
        """The terms without one, and the remaining ``theta``."""
        kept = tuple(term for term in terms if term is not dropped)
        keep = [name not in dropped.names for name in self.fit(terms).names]
        return kept, theta[keep]

    def answer(self, work: Work) -> Answer:
        """Score or fit a candidate; a failure of its fit is an answer, too."""
        present = Present(terms_of(work.present, self.own), work.theta, work.squares)
        forms = terms_of(work.forms, self.own)
        try:
            if work.task == "score":
                return self.slow_score(present.terms, (*present.terms, *forms), present.theta)
            return replace(self.fitted(present, forms, work.error, work.candidates), forms=())
        except (InputError, np.linalg.LinAlgError) as error:
            return str(error)

    def fitted(self, present: Present, forms: Terms, error: float, candidates: int) -> FittedCandidate:
        """Fit a candidate in every fold and evaluate it; ``error`` is the present mean squared error over all data."""
        terms = (*present.terms, *forms)
        own = self.begun(terms, present.theta)
        left = math.sqrt(self.error(terms, own.theta) / error)
        if left > LOWERED:
            said = f"in a fit to all data, the error ratio with to without the term is {left:.3f}"
            return FittedCandidate(forms, None, own.theta, np.zeros(0), said, worse=True)
        indistinct = self.indistinct(terms, own, forms)
        squares = self.held_out(self.evidence, terms, own.theta)
        return self._evaluated(present, forms, own.theta, squares, candidates, indistinct)

    def _evaluated(
        self,
        present: Present,
        forms: Terms,
        theta: Array,
        squares: Array,
        candidates: int,
        indistinct: Sequence[Term],
    ) -> FittedCandidate:
        """A candidate with these squared errors over held-out data; ``indistinct`` of its terms are insignificant."""
        if not np.isfinite(squares).all():
            return FittedCandidate(forms, None, theta, squares, "free runs with the term diverge")
        found = self.evidence.compared(squares, present.squares, candidates)
        reason, shorter = self.evidence.doubt(found, squares, present.squares, candidates), None
        if reason and found.ratio < WORTH:
            own, before = (
                self._short(terms, at)
                for terms, at in (((*present.terms, *forms), theta), (present.terms, present.theta))
            )
            shorter = self.short.compared(own, before, candidates)
            if not self.short.doubt(shorter, own, before, candidates):
                reason = ""
        if reason:
            return FittedCandidate(forms, found, theta, squares, reason, short=shorter)
        if indistinct:
            names = ", ".join(term.name for term in indistinct)
            reason = f"the data do not identify the parameters of {names}"
        elif ends := self._at_bounds((*present.terms, *forms), forms, theta):
            reason = f"{', '.join(ends)} would end at a bound"
        return FittedCandidate(forms, found, theta, squares, reason, not reason, short=shorter)

    def _short(self, terms: Terms, theta: Array) -> Array:
        """Squared errors of held-out short runs with terms."""
        key = terms, theta.tobytes()
        if key not in self._short_squares:
            self._short_squares[key] = self.held_out(self.short, terms, theta)
        return self._short_squares[key]

    def _at_bounds(self, terms: Terms, forms: Terms, theta: Array) -> list[str]:
        """Parameters of new terms that end at a bound; such a term replaces another effect."""
        fit = self.fit(terms)
        own, values = {name for form in forms for name in form.names}, fit.values(theta)
        fitted = [
            FittedParameter(p.name, values[p.name], p.unit, 0.0, p.lower, p.upper)
            for p in fit.prior.parameters
            if p.name in own
        ]
        return [p.name for p in fitted if p.at_bound]


class Promises:
    """Predicted held-out error with additional terms, to first order.

    One Gauss-Newton step of all parameters and initial states in every fold.
    """

    def __init__(
        self, fits: TermFits, evidence: HeldOut, terms: Terms, theta: Array, forms: Sequence[Term]
    ) -> None:
        joint = (*terms, *forms)
        own = fits.fit(joint)
        start = np.concatenate([theta, own.nominal[len(theta) :]])
        normals = []
        for problem, before in (
            (fits.problem(joint, evidence.windows), fits.problem(terms, evidence.windows)),
            (fits.evaluation(evidence, joint, start), fits.evaluation(evidence, terms, theta)),
        ):
            x = before.first_states(theta)
            slopes, errors = problem.linear(start, x)
            every = np.concatenate([slopes, errors[..., None]], axis=-1)
            normal = every.swapaxes(1, 2) @ every  # (n, k + 1, k + 1)
            each = sorted(set(evidence.folds.tolist()))
            normals.append([normal[evidence.folds == f].sum(axis=0) for f in each])
        self.low, self.high = own.lower - start, own.upper - start
        self.present, count = list(range(len(theta))), len(theta)
        self.places: list[list[int]] = []
        for form in forms:
            free = [p for p in form.parameters if not p.fixed]
            self.places.append(list(range(count, count + len(free))))
            count += len(free)
        total = np.sum(normals[0], axis=0)
        self.fitted = [total - own_normal for own_normal in normals[0]]
        self.held = normals[1]
        self.plain = self._left(self.present)

    def _left(self, columns: list[int]) -> float:
        cost = 0.0
        for fitted, own in zip(self.fitted, self.held, strict=True):
            matrix = fitted[np.ix_(columns, columns)]
            matrix = matrix + RIDGE * np.diag(np.diag(matrix) + 1e-300)
            step = bounded_step(matrix, fitted[columns, -1], self.low[columns], self.high[columns])
            moved = own[np.ix_(columns, columns)] @ step
            cost += own[-1, -1] + 2.0 * float(own[columns, -1] @ step) + float(step @ moved)
        return max(cost, 1e-300)

    def of(self, *forms: int) -> float:
        """Logarithm of the predicted ratio of errors with these forms together."""
        columns = [*self.present, *(place for form in forms for place in self.places[form])]
        return 0.5 * math.log(self._left(columns) / self.plain)


def with_state(terms: Sequence[Term]) -> list[Term]:
    """Terms with a state, in order."""
    return [term for term in terms if term.state is not None]


def index_of(base: type[Prior], term: Term) -> int:
    """Index of a term's signal among the signals of its kind."""
    return [s.name for s in signals_at(base, term.place)].index(term.of)


def squared_errors(problem: Shooting, theta: Array) -> Array:
    """Squared error ``(n, T + 1)`` of each sample of free runs with the best initial states; zero without measurement.

    Mean over the outputs of the squared error over the squared spread.
    """
    point = problem.start(theta, problem.first_states(theta), "")
    shape = problem.windows.y.shape
    seen = problem.seen.sum(axis=-1)
    return np.asarray(
        np.square(problem.relative(point, REACH)).reshape(shape).sum(axis=-1) / np.maximum(seen, 1.0)
    )
