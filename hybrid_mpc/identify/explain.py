"""Search for physical terms that a prior lacks, evaluated on held-out recordings. No torch in here.

Each step

1. scores all candidates by one Gauss-Newton step of parameters and initial states from the present fit, in every fold,
2. fits the best few candidates in every fold,
3. adds the best candidate that reduces the held-out error significantly; if there is none, pairs are tried,
4. removes terms that the new term made superfluous.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from hybrid_mpc.data.scales import evenly, robust_spread, time_unit
from hybrid_mpc.data.scales import periods as periods_of
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.identify.explanation import (
    Evidence,
    ExplainStep,
    Explanation,
    FittedParameter,
    FoundTerm,
    HeldOutError,
    Outcome,
    TermPicture,
    Trial,
)
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import Shooting, bounded_step
from hybrid_mpc.identify.simulation import Points, visited
from hybrid_mpc.identify.term_library import Candidate, library
from hybrid_mpc.identify.windows import OutputWindows, cut_outputs
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import POINT, Prior, named
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.terms import At, Term, extended, signals_at
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
Places = NDArray[np.int64]
Terms = tuple[Term, ...]
Progress = Callable[[int, int, str], None]
FOLDS = 5
"""Maximum number of groups of recordings that are held out in turn."""
BLOCKS = 8
"""Number of blocks that a few recordings are cut into."""
WINDOWS = 48
"""Maximum number of windows of the search, shared evenly by the recordings; twice as many for short windows."""
SHORTER = 5
"""Ratio of the lengths of long and short windows. Short windows also score, start and evaluate candidates: small errors
of a force are seen where large ones have not yet grown over a long free run."""
TRIED = 3
"""Number of candidates of a step that are fitted in every fold."""
PAIRS = 3
"""Number of pairs that are fitted in every fold if no single term is added."""
STEPS = 8
"""Maximum number of steps."""
ITERATIONS = 12
"""Gauss-Newton steps of a fit that starts near the optimum."""
WORTH = 0.95
"""Ratio of errors that a term must fall below to be needed beside another one, or an alternative to it."""
ADDED = 0.85
"""Ratio of errors that a term must fall below to be added. Smaller held-out gains became harm on another recording as
often as gain (docs/results/explain.md), and a term costs its reader attention."""
HARM = 1.05
"""Ratio of errors above which a term is harmful."""
GAIN = 0.7
"""Lower limit of a recording's ratio of errors in the upper bound. It makes the bound larger, and a single recording
with a large reduction does not widen the interval."""
POOR = 0.7
"""Relative error of a model that explains half of the outputs' variance. If the error with a term is larger, only a
ratio below ``GAIN`` counts, because small reductions of such free runs occur by chance. The same holds with fewer than
``FEWEST`` recordings: their blocks do not show what differs in the next."""
DOUBT = 0.1
"""Probability that the ratio exceeds one bound of its interval, for all fitted candidates of a step together. A term is
added if the upper bound is below 1."""
REACH = 3.0
"""Limit of an error of a free run, in spreads of the output, also for diverging runs."""
FAR = 2.0
"""Ratio of a start's error to that of the other start above which the start is not tried."""
RIDGE = 1e-6
"""Relative increase of the diagonal of the normal equations, so that equal columns stay solvable."""
SMALL = 0.1
"""Share of the smaller mean squared error that is added to the mean squared error of every piece. So pieces in which
both models have small errors have little influence."""
FEWEST, MANY = 3, 5
"""Minimum number of pieces of evidence for an interval, and of recordings for small gains; number of recordings from
which on each recording is one piece."""
GENERIC = ("product", "coupling")
"""Laws that are no candidates with fewer than ``FEWEST`` recordings: they adapt to any variation within a recording."""
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
MEMORY = 3.0
"""Minimum length of a block [time units]; shorter blocks are not independent. There are at least ``FEWEST`` blocks in
any case."""
SHORTEST = 4
"""Minimum samples of a block."""
DRAWN = 200
"""Number of points of a term's picture."""


@dataclass(frozen=True)
class _HeldOut:
    """Windows, with the piece of evidence of each sample and the fold of each window.

    ``starts`` are the trajectory and first sample of each window.
    """

    windows: OutputWindows
    starts: tuple[tuple[Trajectory, int], ...]
    pieces: Places
    folds: Places
    summary: Evidence
    warm: int

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Mask ``(n, T + 1)`` of the counted samples: measured, and after the warm-up."""
        late = np.arange(self.windows.y.shape[1]) >= self.warm
        return np.asarray(np.isfinite(self.windows.y).any(axis=-1) & late)

    def rows(self, keep: NDArray[np.bool_]) -> OutputWindows:
        """Select windows by a mask."""
        w = self.windows
        return replace(
            w, y=w.y[keep], u=w.u[keep], w=w.w[keep], x=w.x[keep], censored=w.censored[keep], known=w.known[keep],
            group=np.arange(int(keep.sum())),
        )  # fmt: skip

    def compared(self, own: Array, other: Array, candidates: int) -> HeldOutError:
        """Compare squared errors ``(n, T + 1)`` of a model with those of another; ``candidates`` widens the interval.

        With l_i the logarithms of the ratios by piece: upper = mean(max(l, log GAIN)) + t_{n-1} std / sqrt(n).
        """
        each = self._each(own, other)
        n, mean, error = len(each), float(each.mean()), float(np.sqrt(own[self.counted].mean()))
        if n < FEWEST:
            return HeldOutError(error, math.exp(mean), 0.0, math.inf, 1.0)
        capped = np.maximum(each, math.log(GAIN))  # larger mean, and less scatter from large reductions
        scatter, safe = (max(float(v.std(ddof=1)) / math.sqrt(n), 1e-9) for v in (each, capped))
        wide = float(student.ppf(1.0 - DOUBT / candidates, n - 1))
        upper = float(capped.mean()) + wide * safe
        harm = float(student.cdf((float(capped.mean()) - math.log(HARM)) / safe, n - 1))
        return HeldOutError(
            error, math.exp(mean), math.exp(max(mean - wide * scatter, -700.0)), math.exp(min(upper, 700.0)),
            min(1.0, candidates * harm),
        )  # fmt: skip

    def needed(self, own: Array, other: Array, candidates: int) -> int:
        """Number of further similar recordings for an upper bound below 1; 0 if it would be more than tenfold."""
        capped = np.maximum(self._each(own, other), math.log(GAIN))
        mean, scatter, n = float(capped.mean()), float(capped.std(ddof=1)), len(capped)
        for pieces in range(n + 1, 10 * n + 1):
            wide = float(student.ppf(1.0 - DOUBT / candidates, pieces - 1)) * scatter / math.sqrt(pieces)
            if mean + wide < 0:
                return math.ceil((pieces - n) * self.summary.recordings / n)
        return 0

    def doubt(self, found: HeldOutError, squares: Array, before: Array, candidates: int) -> str:
        """Why the evidence does not suffice to add a candidate with these squared errors; empty if it does."""
        said = f"the error ratio with to without the term is {found.words}"
        if found.ratio >= ADDED:
            return said
        if squares.sum() >= before.sum():
            return f"{said}, but the error over all samples is not smaller"
        if found.upper >= 1.0:
            more = self.needed(squares, before, candidates)
            return f"{said}: not significant" + (
                f"; {more} more such recordings would show the effect" if more else ""
            )
        if self.summary.recordings < FEWEST and found.ratio > GAIN:
            return (
                f"{said}, but must be below {GAIN:g} with fewer than {FEWEST} recordings: add "
                f"{counted(FEWEST - self.summary.recordings, 'recording')}"
            )
        if found.error > POOR and found.ratio > GAIN:
            return f"{said}: with a relative error of {found.error:.2f}, a ratio above {GAIN:g} may be due to chance"
        return ""

    def _each(self, own: Array, other: Array) -> Array:
        """Logarithm of the ratio of errors of each piece of evidence."""
        seen = self.counted
        sums = [np.bincount(self.pieces[seen], weights=v[seen]) for v in (own, other)]
        counts = np.bincount(self.pieces[seen])
        means = [total[counts > 0] / counts[counts > 0] for total in sums]
        floor = SMALL * min(float(own[seen].mean()), float(other[seen].mean())) + 1e-300
        return np.asarray(0.5 * np.log((means[0] + floor) / (means[1] + floor)))


def _gathered(known: Sequence[Trajectory], prior: Prior, periods: int, warm: int, most: int) -> _HeldOut:
    """Cut windows of all recordings, and form the groups that are held out together.

    A group consists of similar recordings, or of parts of a single recording.
    """
    files = sorted({t.file for t in known})
    share = max(2 if len(files) > 1 else most, most // len(files))
    parts, of = [], []
    starts: list[tuple[Trajectory, int]] = []
    for number, name in enumerate(files):
        own = [t for t in known if t.file == name and len(t.t) > periods]
        if own:
            parts.append(cut_outputs(own, periods, 0, share, prior.states))
            of += [number] * len(parts[-1].x)
            begins = [(t, k) for t in own for k in range(0, len(t.t) - periods, periods)]
            starts += [begins[i] for i in evenly(len(begins), share)]
    joined: dict[str, Any] = {
        key: np.concatenate([getattr(p, key) for p in parts])
        for key in ("y", "u", "w", "x", "censored", "known")
    }
    windows = replace(parts[0], **joined, group=np.arange(len(of)))
    recording, present = np.array(of), sorted(set(of))
    if len(present) > 1:
        order, groups = _by_kind(windows, recording, present), min(FOLDS, len(present))
        fold = dict(zip(order, np.arange(len(order)) * groups // len(order), strict=True))
        folds = np.array([fold[own] for own in of])
    else:
        groups = min(FOLDS, len(of))
        folds = np.arange(len(of)) * groups // len(of)
    samples, text = windows.y.shape[1], "one recording" if len(present) == 1 else f"{len(present)} recordings"
    pieces, count = np.repeat(recording[:, None], samples, axis=1), len(present)
    if len(present) < MANY:  # a few recordings are cut into blocks as pieces of evidence
        lasting, count = MEMORY * time_unit(known, known[0].dt) / known[0].dt, 0
        for recorded in present:
            at = np.flatnonzero(recording == recorded)
            whole = len(at) * samples
            most = max(FEWEST / len(present), min(BLOCKS / len(present), whole / lasting))
            blocks = max(1, min(math.ceil(most), whole // SHORTEST))
            pieces[at] = (count + np.arange(whole) * blocks // whole).reshape(len(at), samples)
            count += blocks
        if count < FEWEST or groups < 2:
            raise InputError(
                f"{len(present)} recording of {whole} samples is too short to test terms. Add a similar recording, or "
                f"record at least {2 * samples} samples [HM-IDENTIFY-011]"
            )
        text = f"{count} blocks of {text}"
    summary = Evidence(len(present), count, groups, periods * known[0].dt, f"{text} in {groups} groups")
    return _HeldOut(windows, tuple(starts), pieces, folds, summary, min(warm, samples // 3))


def _by_kind(windows: OutputWindows, pieces: Places, present: Sequence[int]) -> list[int]:
    """Sort recordings along the first principal component of means and sizes of inputs, outputs and disturbances.

    Neighbours are held out together, so held-out recordings differ from the fitted ones. Otherwise the held-out error
    would be too optimistic.
    """
    rows = []
    for piece in present:
        own = pieces == piece
        columns = np.concatenate([windows.y[own], windows.u[own][:, windows.lead :], windows.w[own]], axis=-1)
        columns = columns.reshape(-1, columns.shape[-1])
        with np.errstate(invalid="ignore"):
            rows.append(np.concatenate([np.nanmean(columns, axis=0), np.nanstd(columns, axis=0)]))
    table = np.nan_to_num(np.array(rows))
    scale = table.std(axis=0)
    table = (table - table.mean(axis=0)) / np.where(scale > 0, scale, 1.0)
    direction = np.linalg.svd(table, full_matrices=False)[2][0]
    return [present[k] for k in np.argsort(table @ direction, kind="stable")]


@dataclass
class _Search:
    """Recordings of the search, and cached fits."""

    base: type[Prior]
    dt: float
    evidence: _HeldOut
    short: _HeldOut
    sizes: Array
    points: Points
    spread: Array
    fits: dict[Terms, OutputFit] = field(default_factory=dict)

    def fit(self, terms: Terms) -> OutputFit:
        """The fit of the prior with terms."""
        if terms not in self.fits:
            own = OutputFit(extended(self.base, *terms), self.dt)
            own.points = self.with_states(terms, self.points)
            self.fits[terms] = own
        return self.fits[terms]

    def with_states(self, terms: Terms, points: Points) -> Points:
        """Points with the terms' states; each of these states equals its signal."""
        added = [self._signal_of(term, points, self.base().p) for term in _with_state(terms)]
        return np.column_stack([points[0], *added]), *points[1:]

    def _signal_of(self, term: Term, points: Points, p: Array) -> Array:
        """Values ``(n,)`` of a term's signal at points."""
        x, u, w = points
        if term.place == "output":
            values = self.base().equations.output(x.T, u.T, w.T, p).full().T
        else:
            values = {"input": u, "disturbance": w}.get(term.place, x)
        return np.asarray(values[:, _index(self.base, term)])

    def problem(self, terms: Terms, windows: OutputWindows) -> Shooting:
        """Shooting problem for the fit of the prior with terms."""
        fit, sizes, first, known = self.fit(terms), self.sizes, windows.x, windows.known
        for term in _with_state(terms):
            own, size = self._first(term, windows)
            first = np.column_stack([first, np.where(np.isfinite(own), own, np.nanmean(own))])
            known = np.column_stack([known, np.zeros(len(own), dtype=bool)])
            sizes = np.append(sizes, size or 1.0)
        return Shooting(fit, replace(windows, x=first, known=known), sizes, self.spread)

    def _first(self, term: Term, windows: OutputWindows) -> tuple[Array, float]:
        """Initial values ``(n,)`` of a term's state in windows (values of its signal), and its size."""
        k = _index(self.base, term)
        if term.place == "rate":
            return windows.x[:, k], float(self.sizes[k])
        if term.place == "input":
            return windows.u[:, windows.lead, k], float(np.std(self.points[1][:, k]))
        if term.place == "disturbance":
            return windows.w[:, 0, k], float(np.std(self.points[2][:, k]))
        return windows.y[:, 0, k], float(self.spread[k])

    def evaluation(
        self, by: _HeldOut, terms: Terms, theta: Array, keep: NDArray[np.bool_] | None = None
    ) -> Shooting:
        """Shooting problem for the evaluation of the prior with terms.

        The warm-up only determines the initial states; errors are counted on the rest. The initial value of a term's
        state follows from a simulation along the recording, since a free one could explain other effects.
        """
        some = np.ones(len(by.starts), dtype=bool) if keep is None else keep
        problem = self.problem(terms, replace(by.rows(some), warm=by.warm))
        added = _with_state(terms)
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

    def held_out(self, by: _HeldOut, terms: Terms, theta: Array) -> Array:
        """Squared errors ``(n, T + 1)`` of every window with a fit to the other folds, which starts from ``theta``."""
        squares = np.zeros(by.pieces.shape)
        for fold in sorted(set(by.folds.tolist())):
            held = by.folds == fold
            fitted = self.problem(terms, by.rows(~held)).solve(theta, ITERATIONS).theta
            squares[held] = _squares(self.evaluation(by, terms, fitted, held), fitted)
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
        squares = _squares(self.evaluation(self.evidence, terms, theta, keep), theta)
        counted_ = self.evidence.counted if keep is None else self.evidence.counted[keep]
        return max(float(squares[counted_].mean()), 1e-300)

    def without(self, terms: Terms, theta: Array, dropped: Term) -> tuple[Terms, Array]:
        """The terms without one, and the remaining ``theta``."""
        kept = tuple(term for term in terms if term is not dropped)
        keep = [name not in dropped.names for name in self.fit(terms).names]
        return kept, theta[keep]


class _Promises:
    """Predicted held-out error with additional terms, to first order.

    One Gauss-Newton step of all parameters and initial states in every fold.
    """

    def __init__(
        self, search: _Search, evidence: _HeldOut, terms: Terms, theta: Array, forms: Sequence[Term]
    ) -> None:
        joint = (*terms, *forms)
        own = search.fit(joint)
        start = np.concatenate([theta, own.nominal[len(theta) :]])
        normals = []
        for problem, before in (
            (search.problem(joint, evidence.windows), search.problem(terms, evidence.windows)),
            (search.evaluation(evidence, joint, start), search.evaluation(evidence, terms, theta)),
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


def _free(terms: Sequence[Term]) -> int:
    """Number of parameters that are fitted."""
    return sum(not p.fixed for term in terms for p in term.parameters)


def _with_state(terms: Sequence[Term]) -> list[Term]:
    """Terms with a state, in order."""
    return [term for term in terms if term.state is not None]


def _is_generic(candidate: Candidate) -> bool:
    """Whether a candidate is a product or a coupling: these imitate other effects, and need several recordings."""
    made = candidate.forms[0].made
    return made is not None and made.maker in GENERIC


def _vanishes(term: Term) -> bool:
    """Whether a term is zero at its nominal values, so that derivatives predict its effect."""
    return term.state is None and term.parameters[0].value == 0.0


def _index(base: type[Prior], term: Term) -> int:
    """Index of a term's signal among the signals of its kind."""
    return [s.name for s in signals_at(base, term.place)].index(term.of)


def _squares(problem: Shooting, theta: Array) -> Array:
    """Squared error ``(n, T + 1)`` of each sample of free runs with the best initial states; zero without measurement.

    Mean over the outputs of the squared error over the squared spread.
    """
    point = problem.start(theta, problem.first_states(theta), "")
    shape = problem.windows.y.shape
    seen = problem.seen.sum(axis=-1)
    return np.asarray(
        np.square(problem.relative(point, REACH)).reshape(shape).sum(axis=-1) / np.maximum(seen, 1.0)
    )


@dataclass(frozen=True)
class _Fitted:
    """A candidate after its fit in every fold."""

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
class _Ranked:
    """Candidates with the logarithm of their predicted ratio of errors, over long windows and over short ones."""

    long: list[tuple[float, Terms]]
    short: list[tuple[float, Terms]]

    def best(self, count: int, beyond: _Ranked | None = None) -> list[Terms]:
        """The ``count`` best candidates of both; only those that are better than all of ``beyond``."""
        found: list[Terms] = []
        others = ([], []) if beyond is None else (beyond.long, beyond.short)
        for own, other in zip((self.long, self.short), others, strict=True):
            enough = math.log(WORTH) + min([score for score, _ in other], default=0.0)
            found += [forms for score, forms in sorted(own, key=lambda s: s[0])[:count] if score < enough]
        return list({frozenset(form.name for form in forms): forms for forms in found}.values())


@dataclass
class _State:
    """State of the search: terms, their fit, and squared errors over held-out data."""

    terms: Terms
    theta: Array
    squares: Array


def explain(
    base: type[Prior],
    values: dict[str, float],
    known: Sequence[Trajectory],
    *,
    dt: float,
    length: float,
    warm_up: float = 0.0,
    candidates: Sequence[Candidate] | None = None,
    own: Sequence[Term] = (),
    begun: Explanation | None = None,
    most: int = STEPS,
    on_progress: Progress = lambda done, total, text: None,
    on_step: Callable[[Explanation], None] = lambda found: None,
) -> Explanation:
    """Search for the terms that a fitted prior lacks.

    Args:
        base: The prior's class.
        values: Fitted values [their units] of the prior by name.
        known: Recordings with inputs that act and smoothed states (:func:`~hybrid_mpc.identify.fit.smoothed`).
        dt: Model period [s].
        length: Length [s] of the free runs that evaluate models.
        warm_up: Length [s] of the first part of a held-out free run, which only determines its initial state; errors
            are counted on the rest. Default 0: the whole run serves both.
        candidates: Candidate terms. Default: :func:`~hybrid_mpc.identify.term_library.library`.
        own: A user's additional terms. Default: none.
        begun: The last value of ``on_step`` of an interrupted search with the same arguments, which is continued.
            Default: a new search.
        most: Maximum number of steps that add terms.
        on_progress: ``(done, total, text)`` after every fit of a step.
        on_step: Receives the result after each step, for example to store it.

    Raises:
        InputError: If there are too few recordings to evaluate terms, two terms have the same name, or a user's term
            does not match the prior, its units or its balances.
    """
    found = _Explain(base, values, known, dt, length, warm_up, candidates, own, on_progress)
    return found.run(begun, most, on_step)


class _Explain:
    """A search: see :func:`explain`."""

    def __init__(
        self,
        base: type[Prior],
        values: dict[str, float],
        known: Sequence[Trajectory],
        dt: float,
        length: float,
        warm_up: float,
        candidates: Sequence[Candidate] | None,
        own: Sequence[Term],
        on_progress: Progress,
    ) -> None:
        prior = base(values)
        self.base, self.known, self.own, self.on_progress = base, known, tuple(own), on_progress
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
        self.evidence = _gathered(known, prior, periods, round(warm_up / dt), WINDOWS)
        less = max(periods // SHORTER, min(periods, 2 * SHORTEST))
        self.short = _gathered(known, prior, less, round(warm_up / dt), 2 * WINDOWS)
        self.shorter: dict[Terms, Array] = {}
        points = visited(known)
        sizes = np.array([robust_spread(c) or 1.0 for c in np.concatenate([t.x for t in known]).T])
        y = self.evidence.windows.y
        spread = np.array([robust_spread(c) or 1.0 for c in y.reshape(-1, y.shape[-1]).T])
        self.search = _Search(base, dt, self.evidence, self.short, sizes, points, spread)
        given = library(prior, points, dt, length) if candidates is None else candidates
        if self.evidence.summary.recordings < FEWEST:
            given = [one for one in given if not _is_generic(one)]
        self.pool = [*given, *(Candidate(term.name, (term,)) for term in own)]
        _check(prior, self.pool, own, points)
        self.candidates = len(self.pool)
        self.steps: list[ExplainStep] = []
        search = self.search
        theta = (
            search.problem((), self.evidence.windows).solve(search.fit(()).scaled(values), ITERATIONS).theta
        )
        self.first = search.held_out(self.evidence, (), theta)
        self.nominal = math.sqrt(search.error((), search.fit(()).nominal))
        self.now = _State((), theta, self.first)

    def run(
        self, begun: Explanation | None, most: int, on_step: Callable[[Explanation], None]
    ) -> Explanation:
        """Run the whole search."""
        if begun is not None:
            self._resume(begun)
        last: tuple[Trial, ...] = ()
        reason = f"the limit of {counted(most, 'step')} is reached"
        while sum(step.action == "added" for step in self.steps) < most:
            trials, scored, chosen = self._step()
            if chosen is None:
                last, reason = trials, _reason(trials, self.evidence.summary.pieces)
                break
            self._add(chosen, scored, trials)
            self._remove()
            on_step(self._explanation("the search was stopped", ()))
        return self._explanation(reason, last)

    def _resume(self, begun: Explanation) -> None:
        terms = begun.terms(self.own)
        search = self.search
        theta = search.fit(terms).scaled({**search.fit(terms).prior.values, **begun.values})
        self.steps = list(begun.steps)
        self.now = _State(terms, theta, search.held_out(self.evidence, terms, theta))
        there = {term.name for step in begun.steps for term in step.terms}
        self.pool = [one for one in self.pool if not there & {form.name for form in one.forms}]

    def _step(self) -> tuple[tuple[Trial, ...], int, _Fitted | None]:
        """Run one step: fitted candidates, number of scored candidates, and the candidate to add."""
        number = 1 + sum(step.action == "added" for step in self.steps)
        singles, pairs, diverged = self._scored(number)
        fitted = list(self._fitted(singles.best(TRIED), f"step {number}"))
        chosen = self._chosen(fitted)
        both: list[_Fitted] = []
        if chosen is None:
            some = pairs.best(PAIRS, singles)
            both = [self._as_needed(one) for one in self._fitted(some, f"step {number}, pairs")]
            fitted += both
            chosen = self._chosen(both)
        if chosen is None:  # of a pair with one needless term, the other one may pass alone
            tried = {one.forms for one in fitted}
            halves = list(dict.fromkeys(one.needed for one in both if one.needed and one.needed not in tried))
            fitted += (more := list(self._fitted(halves, f"step {number}, terms of pairs")))
            chosen = self._chosen(more)
        trials = [self._trial(one, chosen) for one in fitted] + diverged
        return tuple(trials), len(self.pool), chosen

    def _scored(self, number: int) -> tuple[_Ranked, _Ranked, list[Trial]]:
        """Single terms and pairs with the logarithm of their predicted ratio of errors, and failed candidates."""
        search, now = self.search, self.now
        self.on_progress(0, len(self.pool), f"step {number}: scoring {len(self.pool)} candidates")
        plain = [(k, form) for k, one in enumerate(self.pool) for form in one.forms if _vanishes(form)]
        some = [form for _, form in plain]
        promises = [
            _Promises(search, by, now.terms, now.theta, some) for by in (search.evidence, search.short)
        ]
        lists: list[list[tuple[float, Terms]]] = [[], []]
        among: list[list[tuple[float, int]]] = [[], []]
        for by, singles, ranked in zip(promises, lists, among, strict=True):
            best: dict[int, tuple[float, int]] = {}
            for i, (k, _) in enumerate(plain):
                own = by.of(i), i
                best[k] = min(best.get(k, own), own)
            ranked += sorted(best.values())
            singles += [(score, (plain[i][1],)) for score, i in ranked]
        diverged = []
        slow = [one for one in self.pool if not _vanishes(one.forms[0])]
        # a lag acts at its nominal values, so derivatives do not predict its effect
        for i, one in enumerate(slow, 1):
            scores = []
            for form in one.forms:
                try:
                    score = search.slow_score(now.terms, (*now.terms, form), now.theta)
                except (InputError, np.linalg.LinAlgError) as error:
                    diverged.append(Trial((_found(form),), "diverged", None, str(error)))
                    continue
                scores.append((score, (form,)))
            lists[0] += [min(scores, key=lambda s: s[0])] if scores else []
            self.on_progress(
                len(self.pool) - len(slow) + i, len(self.pool), f"step {number}: scoring {one.name}"
            )
        pairs: list[list[tuple[float, Terms]]] = [[], []]
        for by, ranked, found in zip(promises, among, pairs, strict=True):
            for (_, i), (_, j) in combinations(ranked, 2):
                if not set(plain[i][1].names) & set(plain[j][1].names):
                    found.append((by.of(i, j), (plain[i][1], plain[j][1])))
        return _Ranked(*lists), _Ranked(*pairs), diverged

    def _fitted(self, some: Sequence[Terms], text: str) -> Iterator[_Fitted]:
        """Fit candidates in every fold and evaluate them."""
        search, now = self.search, self.now
        ends = search.error(now.terms, now.theta)
        for done, forms in enumerate(some):
            self.on_progress(done, len(some), f"{text}: fitting {' and '.join(form.name for form in forms)}")
            terms = (*now.terms, *forms)
            try:
                own = search.begun(terms, now.theta)
                left = math.sqrt(search.error(terms, own.theta) / ends)
                if left > LOWERED:
                    said = f"in a fit to all data, the error ratio with to without the term is {left:.3f}"
                    yield _Fitted(forms, None, own.theta, np.zeros(0), said, worse=True)
                    continue
                indistinct = search.indistinct(terms, own, forms)
                squares = search.held_out(self.evidence, terms, own.theta)
            except (InputError, np.linalg.LinAlgError) as error:
                yield _Fitted(forms, None, np.zeros(0), np.zeros(0), str(error))
                continue
            yield self._evaluated(forms, own.theta, squares, len(some), indistinct)

    def _evaluated(
        self, forms: Terms, theta: Array, squares: Array, candidates: int, indistinct: Sequence[Term]
    ) -> _Fitted:
        if not np.isfinite(squares).all():
            return _Fitted(forms, None, theta, squares, "free runs with the term diverge")
        found = self.evidence.compared(squares, self.now.squares, candidates)
        reason, shorter = self.evidence.doubt(found, squares, self.now.squares, candidates), None
        if reason and found.ratio < WORTH:
            own, before = self._short(forms, theta), self._short((), self.now.theta)
            shorter = self.short.compared(own, before, candidates)
            if not self.short.doubt(shorter, own, before, candidates):
                reason = ""
        if reason:
            return _Fitted(forms, found, theta, squares, reason, short=shorter)
        if indistinct:
            reason = (
                f"the data do not identify the parameters of {', '.join(term.name for term in indistinct)}"
            )
        elif ends := self._at_bounds(forms, theta):
            reason = f"{', '.join(ends)} would end at a bound"
        return _Fitted(forms, found, theta, squares, reason, not reason, short=shorter)

    def _short(self, forms: Terms, theta: Array) -> Array:
        """Squared errors of held-out short runs with the present terms and ``forms``."""
        terms = (*self.now.terms, *forms)
        if terms not in self.shorter:
            self.shorter[terms] = self.search.held_out(self.short, terms, theta)
        return self.shorter[terms]

    def _at_bounds(self, forms: Terms, theta: Array) -> list[str]:
        """Parameters of new terms that end at a bound; such a term replaces another effect."""
        fit = self.search.fit((*self.now.terms, *forms))
        own, values = {name for form in forms for name in form.names}, fit.values(theta)
        fitted = [
            FittedParameter(p.name, values[p.name], p.unit, 0.0, p.lower, p.upper)
            for p in fit.prior.parameters
            if p.name in own
        ]
        return [p.name for p in fitted if p.at_bound]

    def _chosen(self, fitted: Sequence[_Fitted]) -> _Fitted | None:
        """The significant candidate with the lowest error, or a simpler one.

        A further parameter must gain as much as a further term: of the candidates that are less than 1 / ``ADDED``
        worse than the best, the one with the fewest parameters is taken.
        """
        sure = [one for one in fitted if one.sure]
        best = min(sure, key=lambda one: one.held_out.ratio if one.held_out else math.inf, default=None)
        if best is None:
            return None
        ratios = {id(one): self.evidence.compared(one.squares, best.squares, 1).ratio for one in sure}
        near = [one for one in sure if ratios[id(one)] <= 1.0 / ADDED]
        return min(near, key=lambda one: (_free(one.forms), ratios[id(one)]))

    def _as_needed(self, pair: _Fitted) -> _Fitted:
        """A pair, which is refused if one of its terms does not reduce the error in addition to the other."""
        if not pair.sure:
            return pair
        terms = (*self.now.terms, *pair.forms)
        for form in pair.forms:
            kept, theta = self.search.without(terms, pair.theta, form)
            try:
                alone = self.search.held_out(self.evidence, kept, theta)
            except (InputError, np.linalg.LinAlgError):
                continue  # without this term the model cannot be simulated in every fold
            if self.evidence.compared(pair.squares, alone, 1).ratio >= WORTH:
                needed = tuple(one for one in pair.forms if one is not form)
                return replace(pair, sure=False, reason=f"{form.name} is not needed", needed=needed)
        return pair

    def _trial(self, one: _Fitted, chosen: _Fitted | None) -> Trial:
        outcome: Outcome = "worse"
        reason = one.reason
        if one is chosen:
            outcome = "added"
        elif one.held_out is None:
            outcome = "worse" if one.worse else "diverged"
        elif chosen is not None and set(chosen.forms) < set(one.forms):
            outcome = "worse"  # no alternative: it contains the added term
        elif chosen is not None and one.held_out.ratio < WORTH:
            between = self.evidence.compared(one.squares, chosen.squares, 1)
            outcome = "alternative" if between.lower <= 1.0 else "worse"
            reason = f"the error ratio to the model with {chosen.forms[0].name} is {between.ratio:.2f}"
        elif one.held_out.ratio < 1.0:
            outcome = "unsure"
        return Trial(tuple(_found(form) for form in one.forms), outcome, one.held_out, reason, one.short)

    def _add(self, chosen: _Fitted, scored: int, trials: tuple[Trial, ...]) -> None:
        assert chosen.held_out is not None
        order = {"added": 0, "alternative": 1, "unsure": 2, "worse": 3, "diverged": 4}
        ranked = sorted(
            trials, key=lambda t: (order[t.outcome], t.held_out.ratio if t.held_out else math.inf)
        )
        found = tuple(_found(form) for form in chosen.forms)
        self.now = _State((*self.now.terms, *chosen.forms), chosen.theta, chosen.squares)
        self.steps.append(
            ExplainStep("added", found, chosen.held_out, (), scored, tuple(ranked), short=chosen.short)
        )
        added = {form.name for form in chosen.forms}
        self.pool = [one for one in self.pool if not added & {form.name for form in one.forms}]

    def _remove(self) -> None:
        """Remove terms that the newest ones made superfluous, one after the other."""
        newest = {term.name for term in self.steps[-1].terms}
        while len(self.now.terms) > len(newest):
            least: tuple[HeldOutError, Term, _State] | None = None
            for term in self.now.terms:
                if term.name in newest:
                    continue
                kept, theta = self.search.without(self.now.terms, self.now.theta, term)
                try:
                    fitted = self.search.begun(kept, theta)
                    squares = self.search.held_out(self.evidence, kept, fitted.theta)
                except (InputError, np.linalg.LinAlgError):
                    continue  # without this term the model cannot be simulated in every fold
                found = self.evidence.compared(squares, self.now.squares, 1)
                if least is None or found.ratio < least[0].ratio:
                    least = found, term, _State(kept, fitted.theta, squares)
            if least is None or least[0].ratio >= 1.0 / WORTH:
                return
            found, term, state = least
            parameters = self._parameters(self.now.terms, self.now.theta)
            own = tuple(p for p in parameters if p.name in term.names)
            self.now = state
            self.steps.append(ExplainStep("removed", (_found(term),), found, own, 0))

    def _parameters(self, terms: Terms, theta: Array) -> tuple[FittedParameter, ...]:
        """Values and standard errors of all parameters, after a final fit to all windows."""
        fit = self.search.fit(terms)
        last = self.search.problem(terms, self.evidence.windows).solve(theta, ITERATIONS)
        sizes = (
            np.sqrt(np.maximum(np.diag(last.covariance), 0.0)) * fit.unit
            if len(last.covariance)
            else np.zeros(0)
        )
        errors = dict(zip(fit.names, sizes.tolist(), strict=True))
        values = fit.values(last.theta)
        return tuple(
            FittedParameter(
                p.name, values[p.name], p.unit, errors.get(p.name, 0.0), p.lower, p.upper, p.description
            )
            for p in fit.prior.parameters
        )

    def _error(self, squares: Array) -> float:
        return float(np.sqrt(squares[self.evidence.counted].mean()))

    def _explanation(self, reason: str, last: tuple[Trial, ...]) -> Explanation:
        terms = self.now.terms
        parameters = self._parameters(terms, self.now.theta)
        there = {term.name: term for term in terms}
        pictures = _Pictures(self.search, terms, parameters, self.known)
        steps = []
        for step in self.steps:
            own = [there[term.name] for term in step.terms if term.name in there]
            if step.action == "added" and own:
                names = {name for term in own for name in term.names}
                drawn = [pictures.of(term) for term in own]
                step = replace(
                    step, parameters=tuple(p for p in parameters if p.name in names),
                    pictures=tuple(one for one in drawn if one is not None),
                )  # fmt: skip
            steps.append(step)
        return Explanation(
            base=self.base.__name__,
            nominal=self.nominal,
            before=self._error(self.first),
            after=self.evidence.compared(self.now.squares, self.first, 1),
            steps=tuple(steps),
            last=last,
            parameters=parameters,
            evidence=replace(self.evidence.summary, short=self.short.summary.length),
            candidates=self.candidates,
            reason=reason,
        )


def _reason(trials: Sequence[Trial], pieces: int) -> str:
    """Reason why the search ends."""
    evaluated = [trial for trial in trials if trial.held_out is not None]
    if not evaluated:
        return "no further candidate lowers the error in a Gauss-Newton step"
    best = min(evaluated, key=lambda trial: trial.held_out.ratio if trial.held_out else math.inf)
    return f"{best.name}: {best.reason}"


def _found(term: Term) -> FoundTerm:
    return FoundTerm(
        term.name, term.text, term.explanation or term.text, term.place, term.of, term.code, term.made
    )


def _check(prior: Prior, pool: Sequence[Candidate], own: Sequence[Term], points: Points) -> None:
    """Check that names are unique, and that a user's terms match the prior.

    Raises:
        InputError: If not; lists all errors together.
    """
    names = [name for one in pool for name in {form.name for form in one.forms}]
    parameters = [name for one in pool for form in one.forms for name in form.names]
    problems = []
    for term in own:
        if names.count(term.name) > 1:
            problems.append(f"term {term.name!r} has the name of another term; rename it. [HM-IDENTIFY-013]")
        problems += [
            f"term {term.name!r}: parameter {name} has the name of another parameter; rename it. [HM-IDENTIFY-014]"
            for name in term.names
            if parameters.count(name) > 1
        ]
        made = extended(type(prior), term)
        if term.loss and term.state is None:
            problems += _supplied(prior, made, term, points)
    refuse(problems)


def _supplied(prior: Prior, made: type[Prior], term: Term, points: Points) -> list[str]:
    """Errors of a term that is declared a loss but adds to a balance at some points of the recordings."""
    given = tuple(v.T for v in points)
    values = {p.name: p.upper if math.isfinite(p.upper) else p.value or 1.0 for p in term.parameters}
    full = made({**prior.values, **values})
    for before, after in zip(prior.equations.balances, full.equations.balances, strict=True):
        lost = after.loss(*given, full.p).full() - before.loss(*given, prior.p).full()
        if lost.min() < -1e-6 * max(np.abs(lost).max(), 1e-300):
            return [
                f"term {term.name!r} is declared a loss, but adds to the balance {before.name!r} at some points of the "
                "recordings. Correct the sign of the term, or set loss=False. [HM-IDENTIFY-074]"
            ]
    return []


class _Pictures:
    """Pictures of a model's terms over its recordings."""

    def __init__(
        self,
        search: _Search,
        terms: Terms,
        parameters: Sequence[FittedParameter],
        known: Sequence[Trajectory],
    ) -> None:
        self.base, self.terms, self.parameters = search.base, terms, parameters
        columns = [np.concatenate([getattr(t, key) for t in known]) for key in ("x", "u", "w", "xdot")]
        whole = np.isfinite(np.hstack(columns)).all(axis=1)
        chosen = np.flatnonzero(whole)
        chosen = chosen[evenly(len(chosen), DRAWN)]
        self.bare_x, self.u, self.w, self.xdot = (c[chosen] for c in columns)
        self.x, _, _ = search.with_states(terms, (self.bare_x, self.u, self.w))
        self.values = np.array([p.value for p in parameters])
        self.prior = extended(search.base, *terms)()
        plain = search.base()
        self.masses = plain.masses if isinstance(plain, MechanicalPrior) else None
        self.n_p = len(plain.parameters)

    def of(self, term: Term) -> TermPicture | None:
        """Picture of one term; None for a term with a state, which is not a curve."""
        if term.state is not None:
            return None
        places = [k for k, p in enumerate(self.parameters) if p.name in term.names]
        value = self._added(term, self.values)
        spread = np.zeros(len(value))
        for k in places:
            moved = self.values.copy()
            moved[k] += self.parameters[k].standard_error
            spread = spread + np.square(self._added(term, moved) - value)
        spread = 2.0 * np.sqrt(spread)
        over, abscissa = self._over(term)
        order = np.argsort(over, kind="stable")
        data = self._left(term)
        shown = () if data is None else tuple((value + data)[order].tolist())
        at, drawn, low, high = (
            tuple(c[order].tolist()) for c in (over, value, value - spread, value + spread)
        )
        return TermPicture(abscissa, self._ordinate(term), at, drawn, low, high, shown)

    def _signal(self, name: str) -> tuple[Signal, Array]:
        for group, values in (
            (self.base.states, self.bare_x), (self.base.inputs, self.u), (self.base.disturbances, self.w),
        ):  # fmt: skip
            for k, signal in enumerate(group):
                if signal.name == name:
                    return signal, values[:, k]
        raise KeyError(name)

    def _over(self, term: Term) -> tuple[Array, str]:
        """Values and label of the horizontal axis."""
        if term.place == "output":
            k = _index(self.base, term)
            return self._shown(without=term)[:, k], self.base.outputs[k].label
        if term.place == "inertia":
            k = _index(self.base, term)
            return self.xdot[:, k], f"d({term.of})/dt [{self.base.states[k].unit}/s]"
        options = {} if term.made is None else term.made.options
        name = str(options.get("source") or options.get("one") or term.of)
        positions = {self.base.states[v].name: self.base.states[q].name for q, v in self.base().kinematics}
        if term.place == "potential" or (term.made is not None and term.made.maker == "coulomb_by_position"):
            name = positions[term.of]
        signal, values = self._signal(name)
        return values, signal.label

    def _ordinate(self, term: Term) -> str:
        unit = signals_at(self.base, term.place)[_index(self.base, term)].unit
        if term.place in ("input", "disturbance", "output"):
            return f"{term.name} [{unit}]"
        if term.place == "rate":
            return f"{term.name} [{unit}/s]"
        return f"{term.name} [{'N' if unit.startswith('m') else 'N m'}]"

    def _zeroed(self, term: Term, values: Array) -> Array:
        own = values.copy()
        own[[k for k, p in enumerate(self.parameters) if p.name in term.names]] = 0.0
        return own

    def _shown(self, values: Array | None = None, without: Term | None = None) -> Array:
        own = self.values if values is None else values
        own = own if without is None else self._zeroed(without, own)
        return np.asarray(self.prior.equations.output(self.x.T, self.u.T, self.w.T, own).full().T)

    def _rates(self, values: Array) -> Array:
        n_x = self.bare_x.shape[1]
        return np.asarray(self.prior.equations.xdot(self.x.T, self.u.T, self.w.T, values).full().T)[:, :n_x]

    def _as_force(self, rates: Array, term: Term) -> Array:
        """Convert rates to a force on the term's axis if the term is a force; else return the rate of its state."""
        k = _index(self.base, term)
        if term.place == "rate" or self.masses is None:
            return rates[:, k]
        half = self.bare_x.shape[1] // 2
        found = np.empty(len(rates))
        for i, (q, own) in enumerate(zip(self.bare_x[:, :half], rates[:, half:], strict=True)):
            found[i] = (self.masses(q, self.values[: self.n_p]).full() @ own)[k - half]
        return found

    def _added(self, term: Term, values: Array) -> Array:
        """Value of a term at every point ``(n,)``."""
        zero = self._zeroed(term, values)
        if term.place == "output":
            k = _index(self.base, term)
            return (self._shown(values) - self._shown(zero))[:, k]
        if term.place in ("input", "disturbance"):
            point = [ca.DM(v) for v in (self.bare_x.T, self.u.T, self.w.T, self.values[: self.n_p])]
            own = ca.DM(self._signal(term.of)[1]).T
            given = [float(v) for v, p in zip(values, self.parameters, strict=True) if p.name in term.names]
            acting = term.law(At.of(self.base(), point, own), named(term.names, given))
            return np.asarray((acting - own).full().ravel())
        return self._as_force(self._rates(values) - self._rates(zero), term)

    def _left(self, term: Term) -> Array | None:
        """Residual of the rate or force at the term's place ``(n,)``; None for terms of inputs, disturbances, outputs.

        The states are smoothed without the terms, so they follow a wrong sensor, and residuals of outputs do not show
        it.
        """
        if term.place in ("input", "disturbance", "output"):
            return None
        return self._as_force(self.xdot - self._rates(self.values), term)
