"""Choice of the recommended model among fitted prior and hybrids, by free runs over held-out data.

A hybrid is recommended only if its error is significantly smaller than the fitted prior's. If the full correction of
the networks is not significantly better, a share of it is tried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.evidence import HARM
from hybrid_mpc.machine.specification import ChoiceRule

Array = NDArray[np.float64]
RULE = ChoiceRule()


@dataclass(frozen=True)
class CandidateFigures:
    """Errors of a candidate in free runs over held-out data.

    Args:
        error: Root mean square of the outputs' errors, each over its spread [-]; infinite if a run diverged.
        ratio: Error over the prior's [-]; for several recordings the geometric mean of their ratios.
        upper: Upper bound of the ratio at the confidence level of the :class:`~hybrid_mpc.ChoiceRule` [-].
        share: Share of the networks' correction in the candidate. Default: the full correction.
        harm: Probability that the error is more than 5 % larger than the prior's. Default: 1, also without a bound.
        worst: Largest ratio to the prior's error of an output, over all runs together [-]. Default: 1.
    """

    error: float
    ratio: float
    upper: float
    share: float = 1.0
    harm: float = 1.0
    worst: float = 1.0


@dataclass(frozen=True)
class Choice:
    """The recommended model and the reason.

    Args:
        recommended: Name of the recommended candidate.
        hybrid: The hybrid that is exported: the recommended one, else the one with the least error.
        candidates: Figures by candidate.
        reason: One sentence for the report.
        blocks: Number of recordings or blocks that were compared.
        sure: The hybrids that are significantly better than the prior, as the :class:`~hybrid_mpc.ChoiceRule` asks.
        confidence: Confidence level of the upper bounds.
    """

    recommended: str
    hybrid: str
    candidates: Mapping[str, CandidateFigures]
    reason: str
    blocks: int
    sure: tuple[str, ...] = ()
    confidence: float = RULE.confidence

    def share(self, name: str) -> float:
        """Share of the networks' correction in a model; 1 for a model that is not a candidate."""
        return self.candidates[name].share if name in self.candidates else 1.0


def recommend(
    errors: Mapping[str, Sequence[Array]],
    *,
    prior: str = "phy",
    deploy: str = "",
    samples: int = 1,
    recordings: Sequence[str] = (),
    evidence: str = "recordings",
    shrunk: Callable[[str, float], Sequence[Array]] | None = None,
    rule: ChoiceRule = RULE,
) -> Choice:
    """Choose among the prior and hybrids by their squared errors over the same held-out runs.

    A hybrid is significantly better than the prior if the upper bound of its ratio is below the rule's limit (default
    1), its error over all runs together is smaller too, and that of no output is larger than the rule allows. Of
    several such hybrids, the one with the lowest ratio is recommended.

    - Two or more recordings: the ratio is the geometric mean over the recordings of the hybrid's error over the
      prior's. Its bound is that of the mean of the logarithms (Student's t). So a single recording with a large error
      of the prior does not dominate.
    - A single recording: the ratio is that of the root mean squares. Its standard error is the jackknife's: one block
      (a contiguous part of a run) after the other is left out.

    Args:
        errors: Squared errors of each run [-] over the squared spread, by candidate: of each output ``(n, n_y)``, NaN
            where it is not measured, or their mean ``(n,)``.
        prior: Name of the prior in ``errors``.
        deploy: Candidate to recommend whatever the figures are. Default: none.
        samples: Minimum samples of a block; errors within a block are correlated. Default: 1.
        recordings: Recording of each run, or part of a single recording. Default: all runs are of one recording.
        evidence: Name of the recordings or parts in the reason.
        shrunk: ``(name, share) -> errors`` of a hybrid with a share of its networks' correction. It is called if the
            full correction is not significantly better than the prior. The largest share of the rule that is
            significantly better is used, else the full correction. Default: only the full correction.
        rule: Confidence level, limits, shares, and fewest recordings. Default: 95 %, 1.

    Raises:
        InputError: If ``deploy`` is not a candidate, or there is no validation run.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> runs = [rng.uniform(0.5, 1.5, 100) for _ in range(4)]
        >>> choice = recommend({"phy": runs, "pgrnn": [0.25 * run for run in runs]})
        >>> choice.recommended, round(choice.candidates["pgrnn"].ratio, 3)
        ('pgrnn', 0.5)

    Source: Efron, *The jackknife, the bootstrap and other resampling plans* (1982).
    """
    if deploy and deploy not in errors:
        raise InputError(
            f"deploy: no candidate {deploy!r}; choose one of: {', '.join(errors)} [HM-IDENTIFY-003]"
        )
    if not errors.get(prior):
        raise InputError(
            "choice: no validation run to compare the models on; give longer recordings [HM-IDENTIFY-004]"
        )
    compared = _Compared(errors[prior], samples, recordings, rule)
    figures = {name: compared.figures(runs) for name, runs in errors.items()}
    for name in errors if shrunk is not None else ():
        if name == prior or compared.sure(figures[name]):
            continue
        for share in rule.shares:
            less = compared.figures(shrunk(name, share), share)  # type: ignore[misc]
            if compared.sure(less):
                figures[name] = less
                break
    hybrids = [name for name in errors if name != prior]
    best = min(hybrids, key=lambda name: figures[name].error, default=prior)
    safe = [name for name in hybrids if compared.sure(figures[name])]
    # the lowest mean logarithm is the best expectation for the next recording; equal ratios are ordered by the error
    chosen = min(safe, key=lambda name: (figures[name].ratio, figures[name].error), default=prior)
    pieces = compared.pieces
    of_what = f"{evidence}, their geometric mean" if compared.whole else "block" if pieces == 1 else "blocks"
    reason = _reason(figures, best, chosen, prior, f"{pieces} {of_what}", rule)
    if deploy and deploy != chosen:
        reason = f"{deploy} is deployed as requested. {reason}"
    asked = deploy if deploy != prior else ""
    hybrid = asked or (chosen if chosen != prior else best)
    return Choice(deploy or chosen, hybrid, figures, reason, pieces, tuple(safe), rule.confidence)


class _Compared:
    """Comparison of candidates with the prior, over the recordings or blocks that the prior's runs are cut into."""

    def __init__(
        self, prior: Sequence[Array], samples: int, recordings: Sequence[str], rule: ChoiceRule
    ) -> None:
        self._rule, self._by_output = rule, _sums_of_outputs(prior)
        self._cuts = _cuts([len(run) for run in prior], samples)
        self._sizes = np.array([b - a for run in self._cuts for a, b in run])
        # errors within a recording are correlated, and recordings can differ from day to day
        self.whole = len(set(recordings)) > 1
        self._of = np.zeros(0, dtype=np.int64)
        if self.whole:
            blocks = [name for name, run in zip(recordings, self._cuts, strict=True) for _ in run]
            self._of = np.unique(blocks, return_inverse=True)[1]
        self._prior = _sums(prior, self._cuts)

    @property
    def pieces(self) -> int:
        """Number of recordings or blocks."""
        return len(set(self._of.tolist())) if self.whole else len(self._sizes)

    def figures(self, runs: Sequence[Array], share: float = 1.0) -> CandidateFigures:
        """Figures of a candidate from its squared errors by run."""
        own, by_output = _sums(runs, self._cuts), _sums_of_outputs(runs)
        if np.array_equal(own, self._prior) and np.isfinite(own).all():
            return CandidateFigures(_root_mean(own, self._sizes), 1.0, 1.0, share, 0.0)
        found = _by_blocks(own, self._prior, self._sizes, self._rule)
        if self.whole:
            of_own, of_prior = (np.bincount(self._of, v).astype(np.float64) for v in (own, self._prior))
            found = _by_recordings(of_own, of_prior, found, self._rule)
        known = np.isfinite(self._by_output) & (self._by_output > 0)
        ratios = by_output[known] / self._by_output[known]
        worst = math.sqrt(float(ratios.max())) if ratios.size else 1.0
        return replace(found, share=share, worst=worst)

    def sure(self, figures: CandidateFigures) -> bool:
        """Whether the bound is below the rule's limit, and the candidate is better over all runs together."""
        better = figures.upper < self._rule.limit and figures.error < _root_mean(self._prior, self._sizes)
        return better and figures.worst <= self._rule.each


def evidence_of(runs: Sequence[tuple[int | None, Sequence[Trajectory]]]) -> tuple[list[str], str]:
    """Independent piece of evidence of each run, and the name of such pieces.

    A recording is one piece, because the errors within a recording are correlated. With a single recording, each part
    that a network left out is one piece; blocks of a recording are not independent enough (EMPS).

    Args:
        runs: Held-out runs of a training (:func:`~hybrid_mpc.identify.evaluate.unseen_runs`).
    """
    files = [t.file for _, them in runs for t in them]
    if len(set(files)) > 1:
        return files, "recordings"
    parts = [f"part {own}" for own, them in runs if own is not None for _ in them]
    return (parts, "parts of one recording") if parts else (files, "recordings")


def _reason(
    figures: Mapping[str, CandidateFigures], best: str, chosen: str, prior: str, blocks: str, rule: ChoiceRule
) -> str:
    if best == prior:
        return "The fitted prior is recommended: no network was trained."
    if not math.isfinite(figures[best].error):
        return f"The fitted prior is recommended: free runs of {best} diverge on validation recordings."
    own = figures[best if chosen == prior else chosen]
    bound = f"upper bound {own.upper:.2f}" if math.isfinite(own.upper) else "no upper bound: too few data"
    whose = "its error" if own.share == 1 else f"with {own.share:g} of its correction, its error"
    if own.ratio < 1.0 <= own.upper and own.harm < 1.0:
        bound += f", probability of harm {100 * own.harm:.0f} %"
    error = f"{whose} on held-out data is {own.ratio:.2f} times the prior's ({bound}; {blocks})"
    if chosen == prior and own.upper < rule.limit:
        error += (
            f", but that of an output is {own.worst:.2f} times the prior's"
            if own.worst > rule.each
            else ", but the prior's error over all these data together is not larger"
        )
    if chosen == prior:
        return f"The fitted prior is recommended: {best} is not significantly better; {error}."
    return f"{chosen} is recommended: {error}."


def _cuts(lengths: Sequence[int], samples: int) -> list[list[tuple[int, int]]]:
    """Blocks of each run as first and last sample: whole runs, or parts of runs if there are few runs."""
    # eight blocks at least: the scatter between fewer says little
    parts = math.ceil(8 / max(1, len(lengths)))
    cuts = []
    for n in lengths:
        count = max(1, min(parts, n // max(1, samples)))
        edges = np.linspace(0, n, count + 1).round().astype(int).tolist()
        cuts.append(list(pairwise(edges)))
    return cuts


def _sums(runs: Sequence[Array], cuts: Sequence[Sequence[tuple[int, int]]]) -> Array:
    means = [run if run.ndim == 1 else np.nanmean(run, axis=1) for run in runs]
    return np.array([float(np.sum(run[a:b])) for run, own in zip(means, cuts, strict=True) for a, b in own])


def _sums_of_outputs(runs: Sequence[Array]) -> Array:
    """Sum over all runs of the squared errors of each output ``(n_y,)``."""
    return np.asarray(sum(np.nansum(run.reshape(len(run), -1), axis=0) for run in runs))


def _root_mean(sums: Array, sizes: Array) -> float:
    """Root mean square from the sums of squares and the sizes of blocks; infinite if a run diverged."""
    return math.sqrt(float(sums.sum()) / float(sizes.sum())) if np.isfinite(sums).all() else math.inf


def _by_blocks(own: Array, prior: Array, sizes: Array, rule: ChoiceRule) -> CandidateFigures:
    """Figures from the sums of squares of blocks, with the jackknife's standard error.

    With l_i the logarithm of the ratio without block i: s^2 = (n - 1) / n sum (l_i - mean(l))^2 (Efron, 1982).
    """
    n = len(sizes)
    error = _root_mean(own, sizes)
    if not math.isfinite(error):
        return CandidateFigures(math.inf, math.inf, math.inf)
    if not np.isfinite(prior).all():
        return CandidateFigures(error, 0.0, 0.0, harm=0.0)
    ratio = float(np.sqrt(own.sum() / max(float(prior.sum()), 1e-300)))
    if n < 2:
        return CandidateFigures(error, ratio, math.inf)
    without = 0.5 * np.log(np.maximum(own.sum() - own, 1e-300) / np.maximum(prior.sum() - prior, 1e-300))
    scatter = math.sqrt((n - 1) / n * float(np.sum(np.square(without - without.mean()))))
    mean = math.log(max(ratio, 1e-300))
    bound = mean + float(student.ppf(rule.confidence, n - 1)) * scatter
    return CandidateFigures(error, ratio, math.exp(min(bound, 700.0)), harm=_harm(mean, scatter, n))


def _by_recordings(own: Array, prior: Array, blocks: CandidateFigures, rule: ChoiceRule) -> CandidateFigures:
    """Figures from the sums of squares of recordings.

    With l_i = log(ratio of recording i): upper = exp(mean(l) + t_{n-1, confidence} std(l) / sqrt(n)).
    """
    if not np.isfinite(own).all() or not np.isfinite(prior).all():
        return blocks
    n, each = len(own), 0.5 * np.log(np.maximum(own, 1e-300) / np.maximum(prior, 1e-300))
    mean = float(each.mean())
    most, harm = math.inf, 1.0  # no bound from two recordings: they may agree by chance
    if n >= rule.fewest:
        scatter = float(each.std(ddof=1)) / math.sqrt(n)
        most, harm = mean + float(student.ppf(rule.confidence, n - 1)) * scatter, _harm(mean, scatter, n)
    return CandidateFigures(
        blocks.error, math.exp(mean), math.exp(most) if most < 700 else math.inf, harm=harm
    )


def _harm(mean: float, scatter: float, n: int) -> float:
    """Probability that the logarithm of a ratio exceeds that of ``HARM``, by Student's t with ``n - 1`` degrees."""
    return float(student.cdf((mean - math.log(HARM)) / max(scatter, 1e-12), n - 1))
