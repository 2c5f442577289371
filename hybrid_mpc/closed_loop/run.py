"""A run of the real-time runner: a loop in step with a clock, and what is counted and kept of it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.closed_loop.loop import Loop
from hybrid_mpc.closed_loop.machine import fitting
from hybrid_mpc.closed_loop.timing import CheckedClock, RunnerStep, RunReport, make_report
from hybrid_mpc.mpc.solution import Status

Array = NDArray[np.float64]
RECENT = 25
"""Solves whose fastest tells whether another one still fits before a deadline."""


@dataclass(frozen=True)
class Parts:
    """What a run is made of; :class:`~hybrid_mpc.closed_loop.Runner` says what each is, and has checked it."""

    measure: Callable[[], ArrayLike | None]
    actuate: Callable[[Array], object]
    deadline: float
    on_step: Callable[[RunnerStep], None] | None
    keep: int


class Run:
    """One run: what is counted and kept; all that the loop itself remembers is in the loop.

    Args:
        parts: Callbacks and settings.
        loop: A loop that has not begun.
        clock: The clock, checked.
    """

    def __init__(self, parts: Parts, loop: Loop, clock: CheckedClock) -> None:
        self._parts, self._loop, self._clock, self._dt = parts, loop, clock, loop.model.dt
        self.k = self._skipped = self._missing = self._late = self._overruns = self._count = 0
        self._sources: Counter[str] = Counter()
        self._rows: deque[RunnerStep] = deque(maxlen=parts.keep)
        self._solves: deque[float] = deque(maxlen=RECENT)
        self._start = 0.0

    def begin(self) -> None:
        """Measure, plan and decide while the machine still rests; the first period is then now."""
        self._loop.start(self._sample())
        self._start = self._clock.now()

    def wait(self) -> None:
        """Until the next period's instant, to hold the last input for a whole one."""
        self._clock.sleep_until(self._start + self.k * self._dt)

    def period(self) -> None:
        """Wait for the period's instant, and do all of it."""
        self.wait()
        parts, loop, clock = self._parts, self._loop, self._clock
        due = self._start + self.k * self._dt
        begin = measured = clock.now()
        if self._count:  # the first input was decided before the clock began
            y = self._sample()
            measured = clock.now()
            self._decide(y, due + parts.deadline)
        decided = clock.now()
        parts.actuate(loop.decision.u.copy())
        acted = clock.now()
        loop.finish()
        spent = {"measure": measured - begin, "actuate": acted - decided, **loop.spent}
        step = RunnerStep(
            self.k, self.k * self._dt, loop.state.y, loop.estimate, loop.decision, loop.reading, begin - due,
            acted - due, spent,
        )  # fmt: skip
        self._note(step)
        if parts.on_step is not None:
            parts.on_step(step)
        self._go_on()

    def _sample(self) -> Array | None:
        y = self._parts.measure()
        return None if y is None else fitting(y, self._loop.model.n_y, "what measure() returns")

    def _decide(self, y: Array | None, deadline: float) -> None:
        """A step whose solve is begun where it can be in time, and dropped where it was not."""
        # Half of the time left is always tried: else a slow spell would end all solving.
        needed = min(min(self._solves, default=0.0), 0.5 * self._parts.deadline)
        begun = []

        def in_time() -> bool:
            if self._clock.now() + needed > deadline:
                return False
            begun.append(True)
            return True

        self._loop.step(y, in_time=in_time)
        if begun:
            self._solves.append(self._loop.spent["solve"])
            if self._clock.now() > deadline:
                self._loop.late()

    def _note(self, step: RunnerStep) -> None:
        self._rows.append(step)
        self._count += 1
        self._sources[step.decision.source.name] += 1
        self._missing += not np.any(np.isfinite(step.y))
        self._late += step.decision.status is Status.LATE
        self._overruns += step.applied > self._parts.deadline

    def _go_on(self) -> None:
        """To the next instant on the grid, or the nearest to now if that has long passed."""
        following = max(self.k + 1, round((self._clock.now() - self._start) / self._dt))
        skipped = following - self.k - 1
        if skipped:
            self._loop.skip(skipped)
        self._skipped += skipped
        self.k = following

    def report(self, stopped: str) -> RunReport:
        """What happened."""
        return make_report(
            list(self._rows), self._loop.model, periods=self._count, sources=dict(self._sources),
            missing=self._missing, late=self._late, overruns=self._overruns, skipped=self._skipped,
            stopped=stopped, switches=self._loop.switches if self._count else (),
        )  # fmt: skip
