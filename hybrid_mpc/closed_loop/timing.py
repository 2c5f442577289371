"""Clocks for the real-time runner, and the record of how it kept time."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.closed_loop.guard import Switch
from hybrid_mpc.closed_loop.loop import Reading
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.safeguard import Decision

Array = NDArray[np.float64]
TIMED = ("measure", "estimate", "solve", "actuate", "monitor", "prepare")
"""What of a period is timed, in this order: the input is out after ``actuate``."""
QUANTILES = {"median": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
EARLY = 1e-3
"""Share of a period by which a wait may end early: rounding, and what no controller notices."""
WAKES = 10
"""Waits for one instant that may end early, one after the other: a sleep that something woke is slept again."""


class Clock(Protocol):
    """What the runner knows of time."""

    def now(self) -> float:
        """Time [s] on a scale that never goes back."""

    def sleep_until(self, t: float) -> None:
        """Return at ``t`` [s] or as soon as possible after it; at once if it has passed."""


class RealClock:
    """The computer's monotonic clock.

    Example:
        >>> clock = RealClock()
        >>> until = clock.now() + 0.002
        >>> clock.sleep_until(until)
        >>> clock.now() >= until
        True
    """

    def now(self) -> float:
        """Time [s] since some fixed instant."""
        return time.perf_counter()

    def sleep_until(self, t: float) -> None:
        """Sleep; the operating system decides how punctual the return is."""
        while (left := t - time.perf_counter()) > 0:
            time.sleep(left)


class CheckedClock:
    """A clock that is held to its word: a loop on one that stands still would spin for ever.

    Args:
        clock: The clock.
        dt: Period [s] of the loop, against which it is judged how early a wait ends.

    Example:
        >>> class Dead:
        ...     def now(self):
        ...         return 7.0
        ...     def sleep_until(self, t):
        ...         pass
        >>> CheckedClock(Dead(), 0.02).sleep_until(7.5)
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: clock: sleep_until(7.5) has come back 10 times, at last at 7.0; it must wait
    """

    def __init__(self, clock: Clock, dt: float) -> None:
        self._clock, self._early, self._last = clock, EARLY * dt, -math.inf

    def now(self) -> float:
        """Time [s].

        Raises:
            InputError: If it is not finite, or before the last one.
        """
        t = float(self._clock.now())
        if not math.isfinite(t):
            raise InputError(f"clock: now() gives {t}; a finite time [s] needed")
        if t < self._last:
            raise InputError(f"clock: now() has gone back from {self._last} to {t}; give one that never does")
        self._last = t
        return t

    def sleep_until(self, t: float) -> None:
        """Wait until ``t`` [s].

        Raises:
            InputError: If the clock does not wait, or as :meth:`now`.
        """
        for _ in range(WAKES):
            self._clock.sleep_until(t)
            if self.now() >= t - self._early:
                return
        raise InputError(
            f"clock: sleep_until({t}) has come back {WAKES} times, at last at {self._last}; it must wait"
        )


@dataclass(frozen=True)
class RunnerStep:
    """One period as ``on_step`` sees it.

    Args:
        k: Its number on the grid; skipped periods have none.
        t: Its time [s] on the grid, since the start.
        y: Measurement ``(n_y,)``; NaN where there was none.
        estimate: What is believed.
        decision: The input and where it came from.
        reading: What the monitor says, or None.
        lateness: Begin of the period after its instant on the grid [s].
        applied: Instant after the grid's at which the input had been handed over [s].
        spent: Durations [s] by the names of ``TIMED``.
    """

    k: int
    t: float
    y: Array
    estimate: Estimate
    decision: Decision
    reading: Reading | None
    lateness: float
    applied: float
    spent: Mapping[str, float]


@dataclass(frozen=True)
class RunReport:
    """How a real-time run went; counts are of all periods, rows of the last ones kept.

    Args:
        periods: Periods that ran.
        sources: Number of inputs by the name of their :class:`~hybrid_mpc.mpc.Source`.
        missing: Periods without a measurement (None, or nothing finite in it).
        late: Periods in which the shifted plan was applied because the solve was, or would have been, late.
        overruns: Periods whose input was applied after their deadline.
        skipped: Periods that did not run at all, since one before them took too long.
        stopped: What ended the run: ``"duration"``, ``"stop"``, the name of a signal that the program survives
            (``"SIGTERM"``), or ``"exit"`` of the interpreter.
        t: Times ``(n,)`` [s] on the grid, since the start, of the periods kept.
        y: Measurements ``(n, n_y)``; NaN where there was none.
        u: Inputs ``(n, n_u)``.
        x_hat: Estimated states ``(n, n_x)``.
        source: Name of the source of each input.
        status: Name of the :class:`~hybrid_mpc.mpc.Status` of each solve.
        lateness_ms: Begin of each period after its instant on the grid ``(n,)`` [ms].
        applied_ms: Instant after the grid's at which each input had been handed over ``(n,)`` [ms].
        timing_ms: Durations ``(n,)`` [ms]: ``measure``, ``estimate``, ``solve``, ``actuate``, ``monitor``, ``prepare``.
        alarm: ``(n,)``, True while the monitor alarms.
        switches: Changes of the guard's mode in the whole run. Default: none.
    """

    periods: int
    sources: Mapping[str, int]
    missing: int
    late: int
    overruns: int
    skipped: int
    stopped: str
    t: Array
    y: Array
    u: Array
    x_hat: Array
    source: tuple[str, ...]
    status: tuple[str, ...]
    lateness_ms: Array
    applied_ms: Array
    timing_ms: Mapping[str, Array]
    alarm: NDArray[np.bool_]
    switches: tuple[Switch, ...] = ()

    def percentiles(self) -> dict[str, dict[str, float]]:
        """Median, 95th and 99th percentile and maximum [ms] of lateness, applied instant and durations.

        Example: ``runner.run(duration=10.0).percentiles()["lateness"]["p99"]``
        """
        rows = {"lateness": self.lateness_ms, "applied": self.applied_ms, **self.timing_ms}
        return {name: percentiles(values) for name, values in rows.items()}


def make_report(
    steps: Sequence[RunnerStep], model: HybridModel, *, periods: int, sources: Mapping[str, int],
    missing: int, late: int, overruns: int, skipped: int, stopped: str, switches: tuple[Switch, ...] = (),
) -> RunReport:  # fmt: skip
    """The report of a run from the steps kept and the counts of all.

    Args:
        steps: The periods kept; may be empty.
        model: For the sizes.
        periods: This and the others: see :class:`RunReport`.
        sources: See there.
        missing: See there.
        late: See there.
        overruns: See there.
        skipped: See there.
        stopped: See there.
        switches: See there.
    """
    return RunReport(
        periods, sources, missing, late, overruns, skipped, stopped,
        t=np.array([s.t for s in steps]),
        y=np.array([s.y for s in steps]).reshape(-1, model.n_y),
        u=np.array([s.decision.u for s in steps]).reshape(-1, model.n_u),
        x_hat=np.array([s.estimate.x for s in steps]).reshape(-1, model.n_x),
        source=tuple(s.decision.source.name for s in steps),
        status=tuple(s.decision.status.name for s in steps),
        lateness_ms=1e3 * np.array([s.lateness for s in steps]),
        applied_ms=1e3 * np.array([s.applied for s in steps]),
        timing_ms={name: 1e3 * np.array([s.spent[name] for s in steps]) for name in TIMED},
        alarm=np.array([s.reading is not None and bool(s.reading.alarm) for s in steps], dtype=bool),
        switches=switches,
    )  # fmt: skip


def percentiles(values: Array) -> dict[str, float]:
    """Median, 95th and 99th percentile and maximum of ``values`` ``(n,)``; NaN where there are none.

    Example:
        >>> percentiles(np.arange(101.0))
        {'median': 50.0, 'p95': 95.0, 'p99': 99.0, 'max': 100.0}
    """
    if len(values) == 0:
        return dict.fromkeys(QUANTILES, float("nan"))
    return {name: float(np.quantile(values, q)) for name, q in QUANTILES.items()}
