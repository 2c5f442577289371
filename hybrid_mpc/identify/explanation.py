"""Result of a search for missing terms, as plain data for tables, pictures and files. No torch in here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.terms import Made, Term, again, extended

Outcome: TypeAlias = Literal["added", "alternative", "unsure", "worse", "diverged"]
Action: TypeAlias = Literal["added", "removed"]


@dataclass(frozen=True)
class FittedParameter:
    """A parameter with its fitted value.

    Args:
        name: Its name.
        value: Fitted value [unit].
        unit: Its unit.
        standard_error: Standard error of the value [unit]; 0 for a fixed parameter.
        lower: Lower bound of the fit [unit].
        upper: Upper bound of the fit [unit].
        description: Short description.

    Example:
        >>> print(FittedParameter("F", 0.1523, "N m", 0.0041, 0.0, 1.0))
        F = 0.152 +- 0.0041 N m
    """

    name: str
    value: float
    unit: str
    standard_error: float
    lower: float
    upper: float
    description: str = ""

    @property
    def at_bound(self) -> bool:
        """Whether a fitted value lies at one of its bounds."""
        width = self.upper - self.lower
        near = min(self.value - self.lower, self.upper - self.value)
        return width > 0.0 and near <= 1e-3 * width and self.value != 0.0

    def __str__(self) -> str:
        return f"{self.name} = {self.value:.3g} +- {self.standard_error:.2g} {self.unit}"


@dataclass(frozen=True)
class HeldOutError:
    """Error of free runs over held-out data: root mean square over the outputs' spreads, initial states fitted.

    Args:
        error: Error with the change [-].
        ratio: Error with the change over the error without it [-]: geometric mean over the pieces of evidence.
        lower: Lower bound of the ratio's interval [-]. The probability of a ratio below it is 10 %, divided by the
            number of candidates that were fitted in the step.
        upper: Upper bound of the ratio's interval [-], likewise; infinite with too few pieces of evidence.
        harm: Probability that the change increases the expected error by more than 5 %, times the number of candidates
            that were fitted in the step, at most 1.
    """

    error: float
    ratio: float
    lower: float
    upper: float
    harm: float

    @property
    def words(self) -> str:
        """Ratio with its interval.

        Example:
            >>> HeldOutError(0.1, 0.954, 0.8, 1.13, 0.2).words, HeldOutError(0.1, 0.954, 0.0, float("inf"), 1.0).words
            ('0.95 (0.80 to 1.13)', '0.95 (no upper bound)')
        """
        if self.lower > 0.0:
            return f"{self.ratio:.2f} ({self.lower:.2f} to {self.upper:.2f})"
        end = f"upper bound {self.upper:.2f}" if self.upper < 1e6 else "no upper bound"
        return f"{self.ratio:.2f} ({end})"


@dataclass(frozen=True)
class FoundTerm:
    """A term, as text.

    Args:
        name: Its name, e.g. ``"Coulomb friction of phi_dot"``.
        formula: Formula of the added term, or of the signal that replaces the original one.
        explanation: Description in a sentence.
        place: Place in the prior: ``"force"``, ``"potential"``, ``"inertia"``, ``"rate"``, ``"input"``,
            ``"disturbance"``, ``"output"``.
        of: The speed, state, input, disturbance or output.
        code: The call that creates the term, for a file; empty for a user's own term without one.
        made: The call as data, for :meth:`Explanation.prior`; None for a user's own term.
    """

    name: str
    formula: str
    explanation: str
    place: str
    of: str
    code: str
    made: Made | None = None


@dataclass(frozen=True)
class Trial:
    """A candidate that was fitted in a step, and the outcome.

    Args:
        terms: The candidate's terms: one, or a pair.
        outcome: ``"added"``; ``"alternative"``: the error is less than 5 % larger than with the added terms, or not
            significantly larger; ``"unsure"``: smaller, but not significantly; ``"worse"``: not smaller, or larger than
            with the added terms; ``"diverged"``: the fit failed.
        held_out: Error over held-out data; None if the fit failed or did not reduce the error over all data.
        reason: Why the candidate was not added; empty if it was.
        short: Error over short held-out runs; None if the longer runs suffice.
    """

    terms: tuple[FoundTerm, ...]
    outcome: Outcome
    held_out: HeldOutError | None
    reason: str = ""
    short: HeldOutError | None = None

    @property
    def name(self) -> str:
        """Names of its terms."""
        return _named(self.terms)

    @property
    def outcome_words(self) -> str:
        """The outcome for a reader."""
        smaller = self.held_out is not None and self.held_out.ratio < 1.0
        if self.outcome == "worse" and (smaller or self.held_out is None):
            return "worse than the added term" if smaller else "no gain"
        return "not significantly better" if self.outcome == "unsure" else self.outcome


@dataclass(frozen=True)
class TermPicture:
    """A term over its data, for a picture.

    Args:
        abscissa: Label of the horizontal axis with unit, e.g. ``"phi_dot [rad/s]"``.
        ordinate: Label of the vertical axis with unit.
        at: Points of the recordings on the horizontal axis, increasing ``(n,)``.
        term: Value of the term at each point.
        low: Value of the term minus two standard errors of its parameters.
        high: Value of the term plus two standard errors.
        data: Value of the term plus the residual of the model with all terms; empty if no rate shows it.
    """

    abscissa: str
    ordinate: str
    at: tuple[float, ...]
    term: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    data: tuple[float, ...] = ()


@dataclass(frozen=True)
class ExplainStep:
    """A step of the search: a term or pair that was added, or a term that was removed as superfluous.

    Args:
        action: ``"added"`` or ``"removed"``.
        terms: One term, or a pair.
        held_out: Error with the step's change, compared with the error before the step.
        parameters: Fitted values of the terms' parameters: from the last fit, or from this step for removed terms.
        scored: Number of candidates that were scored by one Gauss-Newton step.
        trials: Candidates that were fitted, the best first, including the alternatives.
        pictures: Picture of each term; empty for terms that were removed later.
        short: As ``held_out``, over short runs, if these showed that the terms are needed; otherwise None.
    """

    action: Action
    terms: tuple[FoundTerm, ...]
    held_out: HeldOutError
    parameters: tuple[FittedParameter, ...]
    scored: int
    trials: tuple[Trial, ...] = ()
    pictures: tuple[TermPicture, ...] = ()
    short: HeldOutError | None = None

    @property
    def name(self) -> str:
        """Names of its terms."""
        return _named(self.terms)

    @property
    def words(self) -> str:
        """Ratio with its interval; also that over short runs, if these decided."""
        return self.held_out.words + (f"; short runs {self.short.words}" if self.short else "")

    @property
    def alternatives(self) -> tuple[Trial, ...]:
        """Candidates that are not significantly different from the added terms."""
        return tuple(trial for trial in self.trials if trial.outcome == "alternative")


@dataclass(frozen=True)
class Evidence:
    """Evidence of the search.

    Args:
        recordings: Number of recordings.
        pieces: Number of independent pieces of evidence: recordings, or blocks of recordings if these are few.
        folds: Number of groups that were held out in turn.
        length: Length [s] of the free runs.
        text: The evidence in words.
        short: Length [s] of the short runs.
    """

    recordings: int
    pieces: int
    folds: int
    length: float
    text: str
    short: float = 0.0


@dataclass(frozen=True)
class Explanation:
    """The terms that a prior lacks, and all data about the search for tables and pages.

    The object is plain data: :func:`hybrid_mpc.records.plain` writes it, :func:`hybrid_mpc.records.record` reads it.

    Args:
        base: Name of the prior's class.
        nominal: Error with the nominal parameters over the same data [-].
        before: Held-out error of the fitted prior without terms [-].
        after: Held-out error with all terms, compared with the error without terms.
        steps: Steps of the search in order.
        last: Candidates that were fitted in the last step, in which nothing was added.
        parameters: Fitted values of all parameters, the prior's first.
        evidence: Evidence of the search.
        candidates: Number of candidates in the library.
        reason: Why the search ended.
    """

    base: str
    nominal: float
    before: float
    after: HeldOutError
    steps: tuple[ExplainStep, ...]
    last: tuple[Trial, ...]
    parameters: tuple[FittedParameter, ...]
    evidence: Evidence
    candidates: int
    reason: str

    @property
    def averaged(self) -> str:
        """What a ratio of errors is the mean of, in words: each piece of evidence counts the same.

        The errors themselves weigh all samples together, so the ratio of two errors is another number.
        """
        own = self.evidence
        pieces = "recordings" if own.pieces == own.recordings else "blocks"
        return f"geometric mean of the ratios of {own.pieces} {pieces}"

    @property
    def found(self) -> tuple[FoundTerm, ...]:
        """The terms that remain, in the order in which they were added."""
        there: dict[str, FoundTerm] = {}
        for step in self.steps:
            for term in step.terms:
                if step.action == "added":
                    there[term.name] = term
                else:
                    there.pop(term.name)
        return tuple(there.values())

    @property
    def values(self) -> dict[str, float]:
        """Fitted values [their units] of all parameters by name."""
        return {p.name: p.value for p in self.parameters}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors [their units] of all parameters by name."""
        return {p.name: p.standard_error for p in self.parameters}

    @property
    def diverged(self) -> tuple[Trial, ...]:
        """Candidates whose fit failed."""
        trials = [trial for step in self.steps for trial in step.trials] + list(self.last)
        return tuple(trial for trial in trials if trial.outcome == "diverged")

    def terms(self, own: Sequence[Term] = ()) -> tuple[Term, ...]:
        """Create the terms that remain.

        Args:
            own: A user's own terms, which only the user's code can create.

        Raises:
            InputError: If a term without a call is not among ``own``.
        """
        return terms_of(self.found, own)

    def prior(self, base: type[Prior], own: Sequence[Term] = ()) -> type[Prior]:
        """Create the prior's class with the terms; ``prior(base)(explanation.values)`` has the fitted values.

        Args:
            base: The prior's class at the start of the search.
            own: A user's own terms, which only the user's code can create.
        """
        return extended(base, *self.terms(own))


def _named(terms: Sequence[FoundTerm]) -> str:
    return " and ".join(term.name for term in terms)


def terms_of(found: Sequence[FoundTerm], own: Sequence[Term] = ()) -> tuple[Term, ...]:
    """Create terms from their data; ``own`` are those that only a user's code can create.

    Raises:
        InputError: If a term without a call is not among ``own``.
    """
    given, made = {term.name: term for term in own}, []
    for term in found:
        if term.made is None and term.name not in given:
            raise InputError(
                f"term {term.name!r}: only its own code can create it; call explanation.terms([term]) "
                "[HM-IDENTIFY-015]"
            )
        made.append(given[term.name] if term.made is None else again(term.made))
    return tuple(made)
