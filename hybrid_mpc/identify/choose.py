"""Do no harm: which of the candidates is recommended, by free runs over data that were left out.

A hybrid is recommended only if it beats the fitted prior there by more than the uncertainty of the comparison. Where
the whole correction does not, a share of it may.
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
from hybrid_mpc.machine.specification import ChoiceRule

Array = NDArray[np.float64]
RULE = ChoiceRule()


@dataclass(frozen=True)
class CandidateFigures:
    """A candidate on the runs that it is judged by: over data that were left out.

    Args:
        error: Root mean square of the outputs' errors, each over its spread [-]; infinite if a run diverged.
        ratio: That over the prior's [-]; of several recordings the geometric mean of each one's.
        upper: Upper bound of the ratio with the probability of the :class:`~hybrid_mpc.ChoiceRule` [-].
        share: Share of the networks' correction that it has. Default: the whole.
    """

    error: float
    ratio: float
    upper: float
    share: float = 1.0


@dataclass(frozen=True)
class Choice:
    """Which model is recommended and why.

    Args:
        recommended: Name of the candidate.
        hybrid: The hybrid that is exported: the recommended one, else that with the least error.
        candidates: Figures by candidate.
        reason: One sentence for the report.
        blocks: Blocks of these runs that were compared.
        sure: The hybrids that surely beat the prior.
    """

    recommended: str
    hybrid: str
    candidates: Mapping[str, CandidateFigures]
    reason: str
    blocks: int
    sure: tuple[str, ...] = ()

    def share(self, name: str) -> float:
        """Share of the networks' correction that a kind has in the model; of what is no candidate the whole."""
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
    """Choose among the prior and hybrids, by their squared errors over the same runs, which no hybrid was trained on.

    The ratio of a hybrid's error to the prior's is the geometric mean of each recording's where there are
    two or more, and its bound is that of the mean of the logarithms: another recording may be like any of
    these, so a single one in which the prior is far off does not outweigh the others. Over all runs together the hybrid
    must be better as well. Of several hybrids that surely beat the prior the one with the lowest ratio is recommended.
    Within a single recording the ratio is that of the root mean squares; its scatter is found by leaving out one block
    after the other (jackknife); a block is a contiguous part of a run.

    Args:
        errors: For each candidate its squared errors of each run ``(n,)`` [-]: the mean over the outputs of the error
            over its spread, squared.
        prior: Name of the prior among them.
        deploy: Candidate that the user wants whatever the figures say. Default: none.
        samples: Samples of a block at least, within which errors hang together. Default: 1.
        recordings: Which recording each run is from, or which part of a single one. Default: all are from one.
        evidence: What these are called in the reason.
        shrunk: ``(name, share) -> errors`` of a hybrid of which a share of its networks' correction counts. It is asked
            where the whole does not surely beat the prior; the largest of the rule's ``shares`` that surely does is
            taken, else the whole. Default: the whole alone.
        rule: How sure the comparison must be. Default: 95 %.

    Raises:
        InputError: If ``deploy`` is no candidate, or there is no validation run.

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
    # the lowest mean of the logarithms: what the next recording is expected to have; two that are alike by their error
    chosen = min(safe, key=lambda name: (figures[name].ratio, figures[name].error), default=prior)
    pieces = compared.pieces
    of_what = f"{evidence}, their geometric mean" if compared.whole else "block" if pieces == 1 else "blocks"
    reason = _reason(figures, best, chosen, prior, f"{pieces} {of_what}")
    if deploy and deploy != chosen:
        reason = f"{deploy} is deployed as requested. {reason}"
    asked = deploy if deploy != prior else ""
    hybrid = asked or (chosen if chosen != prior else best)
    return Choice(deploy or chosen, hybrid, figures, reason, pieces, tuple(safe))


class _Compared:
    """Figures of candidates over the pieces of evidence that the prior's runs are cut into."""

    def __init__(
        self, prior: Sequence[Array], samples: int, recordings: Sequence[str], rule: ChoiceRule
    ) -> None:
        self._rule = rule
        self._cuts = _cuts([len(run) for run in prior], samples)
        self._sizes = np.array([b - a for run in self._cuts for a, b in run])
        # errors within a recording hang together, and the next recording may be of another day
        self.whole = len(set(recordings)) > 1
        self._of = np.zeros(0, dtype=np.int64)
        if self.whole:
            blocks = [name for name, run in zip(recordings, self._cuts, strict=True) for _ in run]
            self._of = np.unique(blocks, return_inverse=True)[1]
        self._prior = _sums(prior, self._cuts)

    @property
    def pieces(self) -> int:
        """How many there are."""
        return len(set(self._of.tolist())) if self.whole else len(self._sizes)

    def figures(self, runs: Sequence[Array], share: float = 1.0) -> CandidateFigures:
        """Of a candidate's squared errors by run."""
        own = _sums(runs, self._cuts)
        if np.array_equal(own, self._prior) and np.isfinite(own).all():
            return CandidateFigures(_root_mean(own, self._sizes), 1.0, 1.0, share)
        found = _by_blocks(own, self._prior, self._sizes, self._rule)
        if self.whole:
            of_own, of_prior = (np.bincount(self._of, v).astype(np.float64) for v in (own, self._prior))
            found = _by_recordings(of_own, of_prior, found, self._rule)
        return replace(found, share=share)

    def sure(self, figures: CandidateFigures) -> bool:
        """Whether they are surely better than the prior's, and better over all runs together."""
        return figures.upper < 1.0 and figures.error < _root_mean(self._prior, self._sizes)


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


def _reason(figures: Mapping[str, CandidateFigures], best: str, chosen: str, prior: str, blocks: str) -> str:
    if best == prior:
        return "The fitted prior is recommended: there is no hybrid."
    if not math.isfinite(figures[best].error):
        return f"The fitted prior is recommended: free runs of {best} diverge on validation recordings."
    own = figures[best if chosen == prior else chosen]
    bound = f"at most {own.upper:.2f}" if math.isfinite(own.upper) else "without a bound: record more"
    of_it = "its error" if own.share == 1 else f"with {own.share:g} of its correction, its error"
    said = f"{of_it} on held-out data is {own.ratio:.2f} of the prior's ({bound}; {blocks})"
    if chosen == prior and own.upper < 1.0:
        said += ", but over all of them together the prior's is no larger"
    if chosen == prior:
        return f"The fitted prior is recommended: {best} does not surely beat it; {said}."
    return f"{chosen} is recommended: {said}."


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
    return np.array([float(np.sum(run[a:b])) for run, own in zip(runs, cuts, strict=True) for a, b in own])


def _root_mean(sums: Array, sizes: Array) -> float:
    """Root mean square of what the sums of squares of blocks are of; infinite where a run diverged."""
    return math.sqrt(float(sums.sum()) / float(sizes.sum())) if np.isfinite(sums).all() else math.inf


def _by_blocks(own: Array, prior: Array, sizes: Array, rule: ChoiceRule) -> CandidateFigures:
    """Figures from the sums of squares of blocks; the scatter is the jackknife's."""
    n = len(sizes)
    error = _root_mean(own, sizes)
    if not math.isfinite(error):
        return CandidateFigures(math.inf, math.inf, math.inf)
    if not np.isfinite(prior).all():
        return CandidateFigures(error, 0.0, 0.0)
    ratio = float(np.sqrt(own.sum() / max(float(prior.sum()), 1e-300)))
    if n < 2:
        return CandidateFigures(error, ratio, math.inf)
    without = 0.5 * np.log(np.maximum(own.sum() - own, 1e-300) / np.maximum(prior.sum() - prior, 1e-300))
    scatter = math.sqrt((n - 1) / n * float(np.sum(np.square(without - without.mean()))))
    bound = math.log(max(ratio, 1e-300)) + float(student.ppf(rule.confidence, n - 1)) * scatter
    return CandidateFigures(error, ratio, math.exp(min(bound, 700.0)))


def _by_recordings(own: Array, prior: Array, blocks: CandidateFigures, rule: ChoiceRule) -> CandidateFigures:
    """Figures from the sums of squares of recordings: the mean of the logarithms of their ratios."""
    if not np.isfinite(own).all() or not np.isfinite(prior).all():
        return blocks
    n, each = len(own), 0.5 * np.log(np.maximum(own, 1e-300) / np.maximum(prior, 1e-300))
    most = math.inf  # two may agree by chance
    if n >= rule.fewest:
        most = float(each.mean() + student.ppf(rule.confidence, n - 1) * each.std(ddof=1) / math.sqrt(n))
    return CandidateFigures(
        blocks.error, math.exp(float(each.mean())), math.exp(most) if most < 700 else math.inf
    )
