"""Comparison of the costs of two controllers on the same seeds, by an interval that holds with early stopping."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

LOOKS = 3
"""Largest number of interim analyses (looks). Each look spends a part of the 5 % error probability, so more looks widen
the last interval."""
FEWEST = 6
"""Seeds before the first look. The interval of four seeds at the level of a first look is 2.3 times as wide as that of
six seeds at 95 %: such a look would decide little, but spend its part of the 5 %."""
LEVEL = 0.95
"""Probability that the intervals of all looks contain the ratio."""
SAME = 0.02
"""Ratios within 2 % of 1 count as the same cost: a smaller difference does not matter in practice."""


def looks(most: int) -> tuple[int, ...]:
    """Numbers of seeds at the looks: thirds of ``most``, at least six; the last is ``most``.

    Args:
        most: Largest number of seeds, at least 1, fixed before the first loop runs.

    Example:
        >>> looks(30), looks(10), looks(6), looks(2)
        ((10, 20, 30), (7, 10), (6,), (2,))
    """
    thirds = [math.ceil(most * k / LOOKS) for k in range(1, LOOKS + 1)]
    return tuple(dict.fromkeys(n for n in thirds if n >= FEWEST or n == most))


def level_at(n: int, most: int) -> float:
    """Level of the interval at the look of ``n`` seeds, such that the intervals of all looks together hold with 95 %.

    Look ``k`` of ``K`` has the level ``1 - 0.05 k / (1 + ... + K)``.

    Args:
        n: Number of seeds that have run.
        most: Largest number of seeds, fixed before the first loop.

    Example:
        >>> [round(level_at(n, 30), 4) for n in (10, 20, 30)], level_at(3, 3)
        ([0.9917, 0.9833, 0.975], 0.95)
    """
    every = looks(most)
    k = 1 + sum(look < n for look in every)
    return 1.0 - (1.0 - LEVEL) * k / (len(every) * (len(every) + 1) / 2)


@dataclass(frozen=True)
class Comparison:
    """Cost of one controller over that of another on the same seeds.

    Args:
        ratio: Geometric mean of the ratios seed by seed; None if a cost is not finite or not positive.
        low: Lower end of the interval of the ratio; None without an interval.
        high: Upper end.
        n: Number of seeds.
        reason: Why ratio or interval is missing. Default: empty, both exist.
    """

    ratio: float | None
    low: float | None
    high: float | None
    n: int
    reason: str = ""

    @property
    def finding(self) -> str:
        """``"cheaper"``, ``"more expensive"``, ``"the same"`` (interval within 2 % of 1), or ``"undecided"``."""
        if self.low is None or self.high is None:
            return "undecided"
        if self.low > 1.0 - SAME and self.high < 1.0 + SAME:
            return "the same"
        return "cheaper" if self.high < 1.0 else "more expensive" if self.low > 1.0 else "undecided"

    @property
    def decided(self) -> bool:
        """Whether the interval shows that one cost is lower, or that the costs are the same."""
        return self.finding != "undecided"

    @property
    def words(self) -> str:
        """Text with the ratio and its interval, or why there is no interval.

        Example:
            >>> Comparison(0.5, 0.4, 0.625, 6).words
            '0.5 (0.4 to 0.625)'
        """
        ratio = "–" if self.ratio is None else f"{self.ratio:.3g}"
        of = self.reason if self.low is None or self.high is None else f"{self.low:.3g} to {self.high:.3g}"
        return f"{ratio} ({of})"


def hardest(comparisons: Mapping[str, Comparison]) -> str:
    """The best baseline: that of the largest ratio of costs. Baselines without a ratio come last.

    Example:
        >>> hardest({"prior": Comparison(0.5, 0.4, 0.6, 6), "prior_observer": Comparison(0.8, 0.7, 0.9, 6)})
        'prior_observer'
    """
    ratios = {name: -math.inf if found.ratio is None else found.ratio for name, found in comparisons.items()}
    return max(ratios, key=lambda name: ratios[name])


def compare_costs(costs: Sequence[float], base: Sequence[float], most: int) -> Comparison:
    """Compare costs with those of a base on the same seeds, at one of the looks.

    The interval is Student's t of the logarithms of the ratios, at the level of its look (:func:`level_at`). By the
    union bound, the probability that any look's interval misses the ratio is at most 5 %, so loops may stop at any
    look. This assumes normal logarithms and independent seeds. The level belongs to a single comparison: with equal
    costs, one of twenty tasks may be decided wrongly. Later looks get a larger part of the 5 %, so the last interval is
    only a little wider than that of a fixed number of seeds.

    Args:
        costs: ``(n,)``, one a seed.
        base: ``(n,)``, of the same seeds.
        most: Largest number of seeds, fixed before; ``n`` is one of ``looks(most)``.

    Raises:
        ValueError: If the numbers of costs differ, or are not a number of a look.

    Source:
        Group sequential tests with spent errors: Lan, DeMets, Discrete sequential boundaries for clinical trials,
        Biometrika 70 (1983).

    Example:
        >>> found = compare_costs([1.0, 1.1, 0.9, 1.0, 1.2, 1.0], [2.0, 2.1, 1.9, 2.0, 2.2, 1.9], most=9)
        >>> round(found.ratio, 2), found.high < 1.0, found.decided
        (0.51, True, True)
    """
    from scipy.stats import t as student

    x, y, n, every = np.asarray(costs, dtype=float), np.asarray(base, dtype=float), len(costs), looks(most)
    if x.shape != y.shape or n not in every:
        raise ValueError(
            f"costs: got {n}, and {len(base)} of the base; give the same number of both, one of {every} "
            "[HM-COMPARE-021]"
        )
    for values, of in ((x, "its own"), (y, "the baseline's")):
        if not np.all(np.isfinite(values)):
            return Comparison(None, None, None, n, f"a loop diverged: {of}")
    if not (np.all(x > 0.0) and np.all(y > 0.0)):
        return Comparison(None, None, None, n, "a cost is not positive")
    logs = np.log(x) - np.log(y)
    ratio = float(np.exp(logs.mean()))
    if n == 1:
        return Comparison(ratio, None, None, n, "one seed has no interval")
    half = float(student.ppf(0.5 + level_at(n, most) / 2, n - 1) * logs.std(ddof=1) / math.sqrt(n))
    # largest half width of an interval of logarithms; a wider one says nothing, and its ends overflow
    if half > 100.0:
        return Comparison(ratio, None, None, n, "the ratios scatter too much for an interval")
    return Comparison(ratio, ratio * math.exp(-half), ratio * math.exp(half), n)
