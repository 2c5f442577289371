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
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.identify.evidence import ADDED, FEWEST
from hybrid_mpc.identify.explanation import (
    ExplainStep,
    Explanation,
    FittedParameter,
    FoundTerm,
    HeldOutError,
    Outcome,
    Trial,
)
from hybrid_mpc.identify.simulation import Points
from hybrid_mpc.identify.term_fits import (
    ITERATIONS,
    WORTH,
    Answer,
    FittedCandidate,
    Present,
    Promises,
    TermFits,
    Terms,
    Work,
)
from hybrid_mpc.identify.term_library import Candidate, library
from hybrid_mpc.identify.term_pictures import TermPictures
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.terms import Term, extended
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
Answers = Callable[[Sequence[Work]], Iterator[tuple[int, Answer]]]
Progress = Callable[[int, int, str], None]
TRIED = 3
"""Number of candidates of a step that are fitted in every fold."""
PAIRS = 3
"""Number of pairs that are fitted in every fold if no single term is added."""
STEPS = 8
"""Maximum number of steps."""
GENERIC = ("product", "coupling")
"""Laws that are no candidates with fewer than ``FEWEST`` recordings: they adapt to any variation within a recording."""


def _free(terms: Sequence[Term]) -> int:
    """Number of parameters that are fitted."""
    return sum(not p.fixed for term in terms for p in term.parameters)


def _is_generic(candidate: Candidate) -> bool:
    """Whether a candidate is a product or a coupling: these imitate other effects, and need several recordings."""
    made = candidate.forms[0].made
    return made is not None and made.maker in GENERIC


def _vanishes(term: Term) -> bool:
    """Whether a term is zero at its nominal values, so that derivatives predict its effect."""
    return term.state is None and term.parameters[0].value == 0.0


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
    answers: Answers | None = None,
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
        answers: Yields the index and the answer of each of several candidates to score or to fit, in any order, e.g.
            from several processes, each with its own :class:`~hybrid_mpc.identify.term_fits.TermFits`. Default: one
            after the other, here.

    Raises:
        InputError: If there are too few recordings to evaluate terms, two terms have the same name, or a user's term
            does not match the prior, its units or its balances.
    """
    found = _Explain(base, values, known, dt, length, warm_up, candidates, own, on_progress, answers)
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
        answers: Answers | None,
    ) -> None:
        prior = base(values)
        self.base, self.known, self.own, self.on_progress = base, known, tuple(own), on_progress
        given_terms = [form for one in candidates or () for form in one.forms if form.made is None]
        self.search = TermFits(base, values, known, dt, length, warm_up, [*own, *given_terms])
        self.evidence, self.short, points = self.search.evidence, self.search.short, self.search.points
        self.answers = answers or self._in_turn
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
        self.now = Present((), theta, self.first)

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
        self.now = Present(terms, theta, search.held_out(self.evidence, terms, theta))
        there = {term.name for step in begun.steps for term in step.terms}
        self.pool = [one for one in self.pool if not there & {form.name for form in one.forms}]

    def _step(self) -> tuple[tuple[Trial, ...], int, FittedCandidate | None]:
        """Run one step: fitted candidates, number of scored candidates, and the candidate to add."""
        number = 1 + sum(step.action == "added" for step in self.steps)
        singles, pairs, diverged = self._scored(number)
        fitted = self._fitted(singles.best(TRIED), f"step {number}")
        chosen = self._chosen(fitted)
        both: list[FittedCandidate] = []
        if chosen is None:
            some = pairs().best(PAIRS, singles)
            both = [self._as_needed(one) for one in self._fitted(some, f"step {number}, pairs")]
            fitted += both
            chosen = self._chosen(both)
        if chosen is None:  # of a pair with one needless term, the other one may pass alone
            tried = {one.forms for one in fitted}
            halves = list(dict.fromkeys(one.needed for one in both if one.needed and one.needed not in tried))
            fitted += (more := self._fitted(halves, f"step {number}, terms of pairs"))
            chosen = self._chosen(more)
        trials = [self._trial(one, chosen) for one in fitted] + diverged
        return tuple(trials), len(self.pool), chosen

    def _scored(self, number: int) -> tuple[_Ranked, Callable[[], _Ranked], list[Trial]]:
        """Single terms with the logarithm of their predicted ratio of errors, those of pairs, and failed candidates."""
        search, now = self.search, self.now
        self.on_progress(0, len(self.pool), f"step {number}: scoring {len(self.pool)} candidates")
        plain = [(k, form) for k, one in enumerate(self.pool) for form in one.forms if _vanishes(form)]
        some = [form for _, form in plain]
        promises = [
            Promises(search, by, now.terms, now.theta, some) for by in (search.evidence, search.short)
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
        # a lag acts at its nominal values, so derivatives do not predict its effect
        slow = [(k, form) for k, one in enumerate(self.pool) for form in one.forms if not _vanishes(form)]
        answers = self._answered("score", [(form,) for _, form in slow], f"step {number}: scoring")
        scores: dict[int, tuple[float, Terms]] = {}
        for (k, form), score in zip(slow, answers, strict=True):
            if isinstance(score, float):
                scores[k] = min(scores.get(k, (math.inf, ())), (score, (form,)), key=lambda s: s[0])
            else:
                diverged.append(Trial((_found(form),), "diverged", None, str(score)))
        lists[0] += scores.values()

        def pairs() -> _Ranked:
            both: list[list[tuple[float, Terms]]] = [[], []]
            for by, ranked, found in zip(promises, among, both, strict=True):
                for (_, i), (_, j) in combinations(ranked, 2):
                    if not set(plain[i][1].names) & set(plain[j][1].names):
                        found.append((by.of(i, j), (plain[i][1], plain[j][1])))
            return _Ranked(*both)

        return _Ranked(*lists), pairs, diverged

    def _fitted(self, some: Sequence[Terms], text: str) -> list[FittedCandidate]:
        """Fit candidates in every fold and evaluate them."""
        return [
            replace(answer, forms=forms)
            if isinstance(answer, FittedCandidate)
            else FittedCandidate(forms, None, np.zeros(0), np.zeros(0), str(answer))
            for forms, answer in zip(some, self._answered("fit", some, f"{text}: fitting"), strict=True)
        ]

    def _answered(self, task: Literal["score", "fit"], some: Sequence[Terms], text: str) -> list[Answer]:
        """Answers to candidates, in their order."""
        if not some:
            return []
        now, count = self.now, len(some)
        present, error = tuple(map(_found, now.terms)), self.search.error(now.terms, now.theta)
        forms = [tuple(map(_found, one)) for one in some]
        works = [Work(task, present, now.theta, now.squares, error, one, count) for one in forms]
        found: dict[int, Answer] = {}
        for i, answer in self.answers(works):
            found[i] = answer
            self.on_progress(len(found), count, f"{text} {' and '.join(form.name for form in some[i])}")
        return [found[i] for i in range(count)]

    def _in_turn(self, works: Sequence[Work]) -> Iterator[tuple[int, Answer]]:
        return ((i, self.search.answer(work)) for i, work in enumerate(works))

    def _chosen(self, fitted: Sequence[FittedCandidate]) -> FittedCandidate | None:
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

    def _as_needed(self, pair: FittedCandidate) -> FittedCandidate:
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

    def _trial(self, one: FittedCandidate, chosen: FittedCandidate | None) -> Trial:
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
            # nearly equal errors are alternatives even if one is surely smaller
            outcome = "alternative" if between.lower <= 1.0 or between.ratio <= 1.0 / WORTH else "worse"
            said = f"the error ratio to the model with {chosen.forms[0].name} is {between.ratio:.2f}"
            reason = f"{said}; {one.reason}" if one.reason else said
        elif one.held_out.ratio < 1.0:
            outcome = "unsure"
        return Trial(tuple(_found(form) for form in one.forms), outcome, one.held_out, reason, one.short)

    def _add(self, chosen: FittedCandidate, scored: int, trials: tuple[Trial, ...]) -> None:
        assert chosen.held_out is not None
        order = {"added": 0, "alternative": 1, "unsure": 2, "worse": 3, "diverged": 4}
        ranked = sorted(
            trials, key=lambda t: (order[t.outcome], t.held_out.ratio if t.held_out else math.inf)
        )
        found = tuple(_found(form) for form in chosen.forms)
        self.now = Present((*self.now.terms, *chosen.forms), chosen.theta, chosen.squares)
        self.steps.append(
            ExplainStep("added", found, chosen.held_out, (), scored, tuple(ranked), short=chosen.short)
        )
        added = {form.name for form in chosen.forms}
        self.pool = [one for one in self.pool if not added & {form.name for form in one.forms}]

    def _remove(self) -> None:
        """Remove terms that the newest ones made superfluous, one after the other."""
        newest = {term.name for term in self.steps[-1].terms}
        while len(self.now.terms) > len(newest):
            least: tuple[HeldOutError, Term, Present] | None = None
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
                    least = found, term, Present(kept, fitted.theta, squares)
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
        pictures = TermPictures(self.search, terms, parameters, self.known)
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
