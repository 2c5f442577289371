"""The record of closed loops, with their means and intervals by task and controller, and the durations of steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.loops import LoopRow, with_arrays
from hybrid_mpc.compare.sequential import LEVEL, level_at
from hybrid_mpc.control.safeguard import Source
from hybrid_mpc.loop.realtime import percentiles
from hybrid_mpc.records import beside

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mean:
    """A mean with its 95 % interval (Student's t).

    Args:
        mean: The mean; None if a value is not finite, or without values.
        ci95: Half width of the interval, valid with early stopping; None for a single value.
        n: Number of values.
    """

    mean: float | None
    ci95: float | None
    n: int


def interval(values: Sequence[float], level: float = LEVEL) -> Mean:
    """Mean of values and half width of its interval.

    Args:
        values: ``(n,)``.
        level: Probability that the interval contains the mean, for normal values. Default: 0.95. With early stopping
            it must be higher (:func:`~hybrid_mpc.compare.sequential.level_at`).

    Example:
        >>> interval([1.0])
        Mean(mean=1.0, ci95=None, n=1)
        >>> found = interval([1.0, 2.0])  # t(0.975, 1) = 12.706, standard error 0.5
        >>> found.mean, round(found.ci95, 3)
        (1.5, 6.353)
    """
    from scipy.stats import t as student

    x, n = np.asarray(values, dtype=float), len(values)
    if not (n and np.all(np.isfinite(x))):
        return Mean(None, None, n)
    half = float(student.ppf(0.5 + level / 2, n - 1) * x.std(ddof=1) / math.sqrt(n)) if n > 1 else None
    return Mean(float(x.mean()), half, n)


@dataclass(frozen=True)
class Summary:
    """Summary of the loops of one task and controller.

    Args:
        cost: Closed-loop cost.
        tracking_rmse: Tracking errors by signal.
        figures: The task's own figures.
        mean_abs_figures: Magnitudes of these figures.
        sources: Share of periods by the source of the input.
        limits: Largest used share of each limit over all loops.
    """

    cost: Mean
    tracking_rmse: Mapping[str, Mean]
    figures: Mapping[str, Mean]
    mean_abs_figures: Mapping[str, Mean]
    sources: Mapping[str, float]
    limits: Mapping[str, float]


def by_task(rows: Sequence[LoopRow]) -> dict[str, dict[str, list[LoopRow]]]:
    """Rows by task and controller, in their order."""
    table: dict[str, dict[str, list[LoopRow]]] = {}
    for row in rows:
        table.setdefault(row.task, {}).setdefault(row.controller, []).append(row)
    return table


def summaries(rows: Sequence[LoopRow], most: int | None = None) -> dict[str, dict[str, Summary]]:
    """Summaries of loops by task and controller.

    Args:
        rows: The loops.
        most: Largest number of seeds with early stopping (:mod:`hybrid_mpc.compare.sequential`); the intervals of all
            looks then hold together with 95 %. Default: no early stopping.

    Example: ``summaries(rows)["track_sine"]["hybrid"].cost.mean``
    """
    found = {}
    for task, cells in by_task(rows).items():
        # all controllers of a task stop together, even those with fewer seeds
        level = LEVEL if most is None else level_at(max(map(len, cells.values())), most)
        found[task] = {name: summary(own, level) for name, own in cells.items()}
    return found


def summary(rows: Sequence[LoopRow], level: float = LEVEL) -> Summary:
    """The summary of at least one loop of one task and controller, with intervals of a ``level``."""

    def of(
        pick: Callable[[LoopRow], Mapping[str, float]], change: Callable[[float], float] = float
    ) -> dict[str, Mean]:
        return {key: interval([change(pick(row)[key]) for row in rows], level) for key in pick(rows[0])}

    limits: dict[str, float] = {}
    for row in rows:
        for key, share in row.limits.items():
            limits[key] = max(share, limits.get(key, 0.0))
    return Summary(
        cost=interval([row.cost for row in rows], level),
        tracking_rmse=of(lambda row: row.tracking_rmse),
        figures=of(lambda row: row.figures),
        mean_abs_figures=of(lambda row: row.figures, abs),
        sources={s.name: float(np.mean([row.sources[s.name] for row in rows])) for s in Source},
        limits=limits,
    )


@dataclass(frozen=True)
class ClosedLoops:
    """A record of closed loops.

    Args:
        rows: The loops by task, controller and seed.
        arrays: Their kept signals, ``"NUMBER/NAME"`` with the number of the row.
    """

    rows: tuple[LoopRow, ...]
    _: KW_ONLY
    arrays: Mapping[str, Array] = beside()

    @property
    def kept(self) -> list[LoopRow]:
        """The loops with their kept signals; most keep none."""
        return with_arrays(self.rows, self.arrays) if self.rows else []

    @property
    def drawn(self) -> list[LoopRow]:
        """The loops that kept signals, with these."""
        return [row for row in self.kept if row.arrays]

    @cached_property
    def means(self) -> dict[str, dict[str, Summary]]:
        """Means of the loops by task and controller."""
        return summaries(self.rows)

    @property
    def plants(self) -> dict[str, str]:
        """Name of the model in place of the machine by controller; empty for loops on the scenario's plant.

        Each controller has another model as plant, so figures of two controllers must not be compared.
        """
        return {row.controller: row.on_model for row in self.rows if row.on_model}


@dataclass(frozen=True)
class StepTimes:
    """Durations of a controller's whole steps, from measurement to input [ms of wall time].

    Args:
        median: Median.
        p95: 95th percentile.
        p99: 99th percentile.
        max: Longest duration.
        period: Control period.
        misses: Number of steps that took longer than the period.
    """

    median: float
    p95: float
    p99: float
    max: float
    period: float
    misses: int


def step_times(durations: Array, period: float) -> StepTimes:
    """Statistics of the durations of steps [ms] for a control period [ms].

    Example:
        >>> step_times(np.array([1.0, 2.0, 3.0]), 2.5).misses
        1
    """
    return StepTimes(**percentiles(durations), period=period, misses=int((durations > period).sum()))
