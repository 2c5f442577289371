"""A run of the real-time runner: what happens in a period, and what is remembered from one to the next."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.closed_loop.guard import Guard, GuardedLoop
from hybrid_mpc.closed_loop.machine import Previews, fitting
from hybrid_mpc.closed_loop.simulate import Monitor
from hybrid_mpc.closed_loop.timing import CheckedClock, Clock, RunnerStep, RunReport, make_report
from hybrid_mpc.estimation.delays import filtered
from hybrid_mpc.estimation.kalman import Estimate, Estimator
from hybrid_mpc.mpc.safeguard import Decision, SafeController
from hybrid_mpc.mpc.solution import Status

Array = NDArray[np.float64]
RECENT = 25
"""Solves whose fastest tells whether another one still fits before a deadline."""
LONG = 250
"""Skipped periods after which the estimate starts anew: a filter knows little after as many without a sample."""


@dataclass(frozen=True)
class Parts:
    """What a run is made of; :class:`~hybrid_mpc.closed_loop.Runner` says what each is, and has checked it."""

    measure: Callable[[], ArrayLike | None]
    actuate: Callable[[Array], object]
    estimator: Estimator
    safe: SafeController
    monitor: Monitor | None
    guard: Guard | None
    dt: float
    deadline: float
    input_delay: int
    sensor_delay: int
    clock: Clock
    on_step: Callable[[RunnerStep], None] | None
    keep: int


class Run:
    """One run: the only place that remembers from period to period."""

    def __init__(self, parts: Parts, previews: Previews) -> None:
        self._parts, self._previews = parts, previews
        self._clock = CheckedClock(parts.clock, parts.dt)
        self._guarded = None if parts.guard is None else parts.guard.begin(parts.safe)
        self._control: SafeController | GuardedLoop = self._guarded or parts.safe
        self.k = self._skipped = self._missing = self._late = self._overruns = self._count = 0
        self._sources: Counter[str] = Counter()
        self._rows: deque[RunnerStep] = deque(maxlen=parts.keep)
        self._solves: deque[float] = deque(maxlen=RECENT)
        self._estimate: Estimate | None = None
        self._decision: Decision | None = None
        self._memory: Any = None if parts.monitor is None else parts.monitor.initial()
        self._held: deque[Array] = deque(maxlen=parts.input_delay + parts.sensor_delay + 1)
        self._first = np.zeros(0)
        self._start = 0.0

    def begin(self) -> None:
        """Measure and make the first plan while the machine still rests; the first period is then now."""
        parts = self._parts
        self._first = self._sample()
        x_ref, factors = self._previews(parts.input_delay * parts.dt)
        self._estimate = parts.estimator.start(self._first, 0.0)
        self._decision = self._control.initial(self._estimate, None, x_ref, factors)
        self._held.extend([self._decision.u] * (self._held.maxlen or 1))
        self._start = self._clock.now()

    def wait(self) -> None:
        """Until the next period's instant, to hold the last input for a whole one."""
        self._clock.sleep_until(self._start + self.k * self._parts.dt)

    def period(self) -> None:
        """Wait for the period's instant, and do all of it."""
        self.wait()
        parts = self._parts
        clock, due = self._clock, self._start + self.k * parts.dt
        times = [clock.now()]
        first, t = not self._count, self.k * parts.dt
        y = self._first if first else self._sample()
        times.append(clock.now())
        x_ref, factors = self._previews(t + parts.input_delay * parts.dt)
        previous = self._decision
        assert previous is not None
        if self._estimate is None:
            self._estimate = parts.estimator.start(y, t)
        elif not first:
            self._estimate = parts.estimator.update(self._estimate, y, previous.u)
        estimate = self._estimate
        if self._guarded is not None:
            self._guarded.measured(t, y, previous.u)
        times.append(clock.now())
        decision = self._decided(previous, estimate, x_ref, factors, due + parts.deadline)
        times.append(clock.now())
        parts.actuate(decision.u.copy())
        times.append(clock.now())
        reading = None
        if parts.monitor is not None:
            self._memory, reading = parts.monitor.update(self._memory, y, self._held[0], filtered(estimate))
            if self._guarded is not None:
                self._guarded.watched(t, reading)
        times.append(clock.now())
        self._held.append(decision.u)
        self._decision = decision
        spent = tuple(np.diff(times).tolist())
        step = RunnerStep(
            self.k, t, y, estimate, decision, reading, times[0] - due, times[4] - due, spent
        )  # fmt: skip
        self._note(step)
        if parts.on_step is not None:
            parts.on_step(step)
        self._go_on()

    def _sample(self) -> Array:
        n_y, y = self._parts.estimator.model.n_y, self._parts.measure()
        return np.full(n_y, np.nan) if y is None else fitting(y, n_y, "what measure() returns")

    def _decided(
        self, previous: Decision, estimate: Estimate, x_ref: Array, factors: Array | None, deadline: float
    ) -> Decision:
        safe, clock = self._control, self._clock
        begin = clock.now()
        # Half of the time left is always tried: else a slow spell would end all solving.
        needed = min(min(self._solves, default=0.0), 0.5 * self._parts.deadline)
        if begin + needed > deadline:
            return safe.late(previous, estimate, x_ref)
        decision = safe.decide(previous, estimate, x_ref, factors)
        end = clock.now()
        self._solves.append(end - begin)
        return safe.late(previous, estimate, x_ref) if end > deadline else decision

    def _note(self, step: RunnerStep) -> None:
        self._rows.append(step)
        self._count += 1
        self._sources[step.decision.source.name] += 1
        self._missing += not np.any(np.isfinite(step.y))
        self._late += step.decision.status is Status.LATE
        self._overruns += step.applied > self._parts.deadline

    def _go_on(self) -> None:
        """To the next instant on the grid, or the nearest to now if that has long passed."""
        parts = self._parts
        following = max(self.k + 1, round((self._clock.now() - self._start) / parts.dt))
        skipped = following - self.k - 1
        if skipped > LONG:
            self._estimate = None
        elif self._estimate is not None and self._decision is not None:
            for _ in range(skipped):
                y = np.full(parts.estimator.model.n_y, np.nan)
                self._estimate = parts.estimator.update(self._estimate, y, self._decision.u)
                self._held.append(self._decision.u)
                if self._guarded is not None:
                    self._guarded.measured(self.k * parts.dt, y, self._decision.u)
        self._skipped += skipped
        self.k = following

    def report(self, stopped: str) -> RunReport:
        """What happened."""
        return make_report(
            list(self._rows), self._parts.estimator.model, periods=self._count, sources=dict(self._sources),
            missing=self._missing, late=self._late, overruns=self._overruns, skipped=self._skipped,
            stopped=stopped, switches=() if self._guarded is None else tuple(self._guarded.switches),
        )  # fmt: skip
