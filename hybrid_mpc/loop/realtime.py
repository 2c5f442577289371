"""The loop in real time: against a machine's callbacks, in step with a clock, and with a safe end."""

from __future__ import annotations

import atexit
import math
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import FrameType, TracebackType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.problem import Controller, Status
from hybrid_mpc.control.safeguard import Decision, SafeController, check_safe_input
from hybrid_mpc.errors import InputError, SafeInputError
from hybrid_mpc.estimate.delay import sees_truth
from hybrid_mpc.estimate.kalman import Estimate, Estimator
from hybrid_mpc.loop.guard import Guard, Switch
from hybrid_mpc.loop.loop import Loop, Monitor, Reading
from hybrid_mpc.loop.preview import Preview
from hybrid_mpc.model.limits import check_function, check_part, sampled, whole

Array = NDArray[np.float64]
TIMED = ("measure", "estimate", "solve", "actuate", "monitor", "prepare")
"""What of a period is timed, in this order: the input is out after ``actuate``."""
RECENT = 25
"""Solves whose fastest tells whether another one still fits before a deadline."""
QUANTILES = {"median": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK", "SIGXCPU", "SIGTSTP")
    if hasattr(signal, name)
)
"""Signals that ask a program to end or to stand still, as far as the operating system has them: Ctrl-C, ``kill``, a
terminal that closes, Ctrl-\\, Ctrl-Break, a used-up limit of computing time, Ctrl-Z."""
PAUSES_S = (0.0, 0.01, 0.1, 1.0)
"""Pauses [s] before each further try to hand the safe input over: none after a message that a signal has cut off, then
what a bus or its driver may need to recover. No more, since a process that is to end must end."""
EARLY = 1e-3
"""Share of a period by which a wait may end early: rounding, and what no controller notices."""
WAKES = 10
"""Waits for one instant that may end early, one after the other: a sleep that something woke is slept again."""


MOST_KEPT = 10**9
"""Most periods whose rows a report keeps."""


class Runner:
    """Steps estimator, controller and monitor against a machine's sensors and actuators, in real time.

    It drives a :class:`~hybrid_mpc.loop.loop.Loop`. Before the clock starts, while the machine rests: the first sample,
    and plan and input from it. Each period: wait for its instant, measure, estimate, decide, actuate, then what the
    loop leaves until after the input. A missing sample leaves the prediction. A solve is never interrupted: one that
    comes back after the deadline is dropped, one that cannot be in time any more is not begun, and the shifted plan is
    applied (:meth:`~hybrid_mpc.control.safeguard.SafeController.late`). After a long delay the run goes on at the
    grid's nearest instant; the estimator is led through the periods in between without a measurement.

    Numbers never raise. Whatever ends the run, exceptions in callbacks and signals (Ctrl-C, SIGTERM, SIGHUP, ...)
    included, the safe input is handed to the actuator before anything else (:class:`SafeEnd`); then the exception is
    raised on, or the signal has its effect. Signals reach Python's main thread alone: in another thread ``stop`` ends
    a run. What no program can catch (SIGKILL, a hang in a driver, a power cut) takes a watchdog in the actuator;
    ``docs/watchdog.md`` has one. ``actuate`` may be broken off by a signal, and is then called with the safe input.

    Without a delay the input is assumed to act from the grid's instant on: keep steps short against the period, or
    declare the delay (:class:`~hybrid_mpc.estimate.delay.DelayCompensation`).

    Args:
        measure: ``() -> y (n_y,)``, or None where no sample has come.
        actuate: Takes the input ``u (n_u,)``, to be held until the next.
        estimator: Filter on the controller's model.
        controller: A :class:`~hybrid_mpc.control.safeguard.SafeController`; a bare controller is guarded without
            fallback.
        reference: ``t (n,) [s] -> x_ref (n, n_x)``, or ``y_ref (n, n_y)`` where the problem weighs outputs; ``t``
            counts from the start.
        weight: Factors on ``q``, alike. Default: 1.
        measure_w: ``() -> w (n_w,)``, measured disturbances, or None where no sample has come. Default: nobody measures
            them, and they are those of the operating point.
        w: Forecast of them, as in :class:`~hybrid_mpc.loop.loop.Loop`.
        monitor: One that has limits to alarm by. Default: none.
        deadline: Time [s] after a period's instant by which its input must be decided. Default: one period.
        safe_input: Input ``(n_u,)`` within the limits for the end of the run. Default: the controller's; one of the two
            must be declared.
        input_delay: As in :class:`~hybrid_mpc.loop.loop.Loop`.
        sensor_delay: As there.
        clock: Default: the computer's. One that does not wait, stands still, goes back or gives NaN ends the run.
        on_step: Called at the end of every period with a :class:`RunnerStep`; must be short.
        guard: What to do on alarms of the monitor, which it needs. Default: nothing.
        keep: Periods whose rows the report keeps, the last ones. Default 100 000.

    Raises:
        InputError: If models, deadline, safe input, delays or ``keep`` do not fit, no safe input is declared, the
            monitor has no limits, or the estimator wants the truth.

    Example: see ``docs/hardware.md``; in short::

        runner = Runner(read_encoder, set_torque, ekf, controller, task.reference, weight=task.weight)
        print(runner.run(duration=6.0).percentiles())
    """

    def __init__(
        self,
        measure: Callable[[], ArrayLike | None],
        actuate: Callable[[Array], object],
        estimator: Estimator,
        controller: SafeController | Controller,
        reference: Preview,
        *,
        weight: Preview | None = None,
        measure_w: Callable[[], ArrayLike | None] | None = None,
        w: Preview | None = None,
        monitor: Monitor | None = None,
        deadline: float | None = None,
        safe_input: ArrayLike | None = None,
        input_delay: int = 0,
        sensor_delay: int = 0,
        clock: Clock | None = None,
        on_step: Callable[[RunnerStep], None] | None = None,
        keep: int = 100_000,
        guard: Guard | None = None,
    ) -> None:
        check_part(estimator, "Runner: estimator", "a filter", "model", "start", "update")
        optional: dict[str, object] = {"measure_w": measure_w, "on_step": on_step}
        given = {name: function for name, function in optional.items() if function is not None}
        for name, function in {"measure": measure, "actuate": actuate, **given}.items():
            check_function(function, f"Runner: {name}")
        if clock is not None:
            check_part(clock, "Runner: clock", "a clock", "now", "sleep_until")
        if sees_truth(estimator):
            raise InputError(
                "Runner: a machine does not give its true state; give a filter, not TrueState [HM-LOOP-033]"
            )
        if why := getattr(monitor, "cannot_alarm", ""):
            raise InputError(
                f"Runner: monitor: {why}; or leave monitor out, then nothing is watched [HM-LOOP-034]"
            )
        dt = estimator.model.dt
        due = dt if deadline is None else float(sampled(deadline, (), "Runner: deadline"))
        if not 0 < due <= dt * (1 + 1e-9):
            raise InputError(
                f"Runner: deadline must lie within the period of {dt} s, got {deadline} s [HM-LOOP-035]"
            )
        keep = whole(keep, "Runner: keep [periods]", 1, MOST_KEPT)
        self._clock, self._dt, self._deadline, self._keep = (
            RealClock() if clock is None else clock,
            dt,
            due,
            keep,
        )
        self._measure, self._actuate, self._on_step = measure, actuate, on_step
        self._measure_w = measure_w
        self._loop = partial(
            Loop, estimator, controller, monitor=monitor, reference=reference, weight=weight, guard=guard,
            w=w, input_delay=input_delay, sensor_delay=sensor_delay,
        )  # fmt: skip
        loop = self._loop()
        declared = loop.safe_input if safe_input is None else safe_input
        if declared is None:
            raise InputError(
                "Runner: no safe input is declared; give safe_input=[...], or Scenario(safe_input=...): the input that "
                "the machine may be left with. Zero is not safe for every machine, so it is never guessed [HM-LOOP-036]"
            )
        self._safe_input = check_safe_input(declared, loop.ocp)

    @property
    def safe_input(self) -> Array:
        """The input handed over at the end of every run ``(n_u,)``."""
        return self._safe_input.copy()

    def run(self, duration: float | None = None, stop: Callable[[], bool] | None = None) -> RunReport:
        """Run until the duration has passed or ``stop()`` is true, whichever is first.

        Args:
            duration: Length [s], rounded to whole periods. Default: none.
            stop: Asked before every period. Default: never.

        Raises:
            InputError: If neither end is given, the duration is not positive and finite, a callback returns
                another shape, or the clock is none. What a callback raises is raised on, after the safe input.
            SafeInputError: If the actuator did not take the safe input.
        """
        if stop is not None:
            check_function(stop, "Runner: stop")
        n = self._periods(duration, stop)
        clock = CheckedClock(self._clock, self._dt)
        loop = self._loop(end=math.inf if n is None else n * self._dt, now=clock.now)
        run = _Run(self, loop, clock)
        ended = "duration"
        with SafeEnd(lambda: self._actuate(self.safe_input)) as end:
            end.check()
            loop.warm_up()
            run.begin()
            while n is None or run.k < n:
                end.check()
                if stop is not None and _stops(stop()):
                    ended = "stop"
                    break
                run.period()
            run.wait()
        return run.report(end.cause or ended)

    def _periods(self, duration: float | None, stop: Callable[[], bool] | None) -> int | None:
        if duration is None:
            if stop is None:
                raise InputError(
                    "Runner: give a duration [s], or a function stop() that ends the run [HM-LOOP-037]"
                )
            return None
        dt, duration = self._dt, float(sampled(duration, (), "Runner: duration"))
        if not (math.isfinite(duration) and round(duration / dt) >= 1):
            raise InputError(
                f"Runner: duration {duration} s given; at least one period of {dt} s, and finite, needed [HM-LOOP-038]"
            )
        return round(duration / dt)


def _stops(answer: object) -> bool:
    """What ``stop()`` has answered."""
    try:
        return bool(answer)
    except ValueError as error:  # several numbers
        raise InputError(
            f"Runner: stop() must return True or False, it returns {type(answer).__name__} [HM-LOOP-039]"
        ) from error


class _Run:
    """One run: its clock, its counts and its last rows; all that the loop remembers is in the loop."""

    def __init__(self, runner: Runner, loop: Loop, clock: CheckedClock) -> None:
        self._runner, self._loop, self._clock = runner, loop, clock
        self._dt, self._deadline = runner._dt, runner._deadline
        self.k = self._periods = self._skipped = self._missing = self._late = self._overruns = 0
        self._sources: Counter[str] = Counter()
        self._rows: deque[RunnerStep] = deque(maxlen=runner._keep)
        self._solves: deque[float] = deque(maxlen=RECENT)
        self._start = 0.0

    def begin(self) -> None:
        """Measure, plan and decide while the machine still rests; the first period is then now."""
        self._loop.start(self._sample(), self._disturbances())
        self._start = self._clock.now()

    def wait(self) -> None:
        """Until the next period's instant, to hold the last input for a whole one."""
        self._clock.sleep_until(self._start + self.k * self._dt)

    def period(self) -> None:
        """Wait for the period's instant, and do all of it."""
        self.wait()
        loop, clock = self._loop, self._clock
        due = self._start + self.k * self._dt
        begin = measured = clock.now()
        if self._periods:  # the first input was decided before the clock began
            y = self._sample()
            measured = clock.now()
            self._decide(y, due + self._deadline)
        decided = clock.now()
        self._runner._actuate(loop.decision.u.copy())
        acted = clock.now()
        loop.finish()
        spent = {"measure": measured - begin, "actuate": acted - decided, **loop.spent}
        step = RunnerStep(
            k=self.k,
            t=self.k * self._dt,
            y=loop.state.y,
            estimate=loop.estimate,
            decision=loop.decision,
            reading=loop.reading,
            lateness=begin - due,
            applied=acted - due,
            spent=spent,
        )
        self._count(step)
        if self._runner._on_step is not None:
            self._runner._on_step(step)
        self._go_on()

    def report(self, stopped: str) -> RunReport:
        """What happened."""
        rows, model = list(self._rows), self._loop.model
        return RunReport(
            periods=self._periods, sources=dict(self._sources), missing=self._missing, late=self._late,
            overruns=self._overruns, skipped=self._skipped, stopped=stopped,
            t=np.array([row.t for row in rows]),
            y=np.array([row.y for row in rows]).reshape(-1, model.n_y),
            u=np.array([row.decision.u for row in rows]).reshape(-1, model.n_u),
            x_hat=np.array([row.estimate.x for row in rows]).reshape(-1, model.n_x),
            source=tuple(row.decision.source.name for row in rows),
            status=tuple(row.decision.status.name for row in rows),
            lateness_ms=1e3 * np.array([row.lateness for row in rows]),
            applied_ms=1e3 * np.array([row.applied for row in rows]),
            timing_ms={name: 1e3 * np.array([row.spent[name] for row in rows]) for name in TIMED},
            alarm=np.array([row.reading is not None and bool(row.reading.alarm) for row in rows], dtype=bool),
            switches=self._loop.switches if self._periods else (),
            given_way=tuple(row.decision.solution.given_way for row in rows),
        )  # fmt: skip

    def _sample(self) -> Array | None:
        y = self._runner._measure()
        return None if y is None else sampled(y, (self._loop.model.n_y,), "what measure() returns")

    def _disturbances(self) -> ArrayLike | None:
        return None if self._runner._measure_w is None else self._runner._measure_w()

    def _decide(self, y: Array | None, deadline: float) -> None:
        """A step whose solve is begun where it can be in time, and dropped where it was not."""
        # Half of the time left is always tried: else a slow spell would end all solving.
        needed = min(min(self._solves, default=0.0), 0.5 * self._deadline)
        begun = False

        def in_time() -> bool:
            nonlocal begun
            begun = self._clock.now() + needed <= deadline
            return begun

        self._loop.step(y, self._disturbances(), in_time=in_time)
        if begun:
            self._solves.append(self._loop.spent["solve"])
            if self._clock.now() > deadline:
                self._loop.late()

    def _count(self, step: RunnerStep) -> None:
        self._rows.append(step)
        self._periods += 1
        self._sources[step.decision.source.name] += 1
        self._missing += not np.any(np.isfinite(step.y))
        self._late += step.decision.status is Status.LATE
        self._overruns += step.applied > self._deadline

    def _go_on(self) -> None:
        """To the next instant on the grid, or the nearest to now if that has long passed."""
        following = max(self.k + 1, round((self._clock.now() - self._start) / self._dt))
        skipped = following - self.k - 1
        if skipped:
            self._loop.skip(skipped)
        self._skipped += skipped
        self.k = following


@dataclass(frozen=True)
class RunnerStep:
    """One period as ``on_step`` sees it; times are in seconds.

    Args:
        k: Its number on the grid; skipped periods have none.
        t: Its time on the grid, since the start.
        y: Measurement ``(n_y,)``; NaN where there was none.
        estimate: The estimate.
        decision: The input and where it came from.
        reading: What the monitor says, or None.
        lateness: Begin of the period after its instant on the grid.
        applied: Instant after the grid's at which the input had been handed over.
        spent: Durations by the names of ``TIMED``.
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
    """How a real-time run went; counts are of all periods, rows of the last ``keep``.

    Args:
        periods: Periods that ran.
        sources: Number of inputs by the name of their :class:`~hybrid_mpc.control.safeguard.Source`.
        missing: Periods without a measurement (None, or nothing finite in it).
        late: Periods in which the shifted plan was applied because the solve was, or would have been, late.
        overruns: Periods whose input was applied after their deadline.
        skipped: Periods that did not run at all, since one before them took too long.
        stopped: What ended the run: ``"duration"``, ``"stop"``, the name of a signal that the program survives
            (``"SIGTERM"``), or ``"exit"`` of the interpreter.
        t: Times ``(n,)`` [s] on the grid, since the start, of the last ``keep`` periods.
        y: Measurements ``(n, n_y)``; NaN where there was none.
        u: Inputs ``(n, n_u)``.
        x_hat: Estimated states ``(n, n_x)``.
        source: Name of the source of each input.
        status: Name of the :class:`~hybrid_mpc.control.problem.Status` of each solve.
        lateness_ms: Begin of each period after its instant on the grid ``(n,)`` [ms].
        applied_ms: Instant after the grid's at which each input had been handed over ``(n,)`` [ms].
        timing_ms: Durations ``(n,)`` [ms]: ``measure``, ``estimate``, ``solve``, ``actuate``, ``monitor``, ``prepare``.
        alarm: ``(n,)``, True while the monitor alarms.
        switches: Changes of the guard's mode in the whole run. Default: none.
        given_way: For each period the hard bounds that its plan exceeds, since none keeps them all, with the largest
            violation in the plan. Default: unknown.
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
    given_way: tuple[Mapping[str, float], ...] = ()

    def percentiles(self) -> dict[str, dict[str, float]]:
        """Median, 95th and 99th percentile and maximum [ms] of lateness, applied instant and durations.

        Example: ``runner.run(duration=10.0).percentiles()["lateness"]["p99"]``
        """
        rows = {"lateness": self.lateness_ms, "applied": self.applied_ms, **self.timing_ms}
        return {name: percentiles(values) for name, values in rows.items()}


def percentiles(values: Array) -> dict[str, float]:
    """Median, 95th and 99th percentile and maximum of ``values`` ``(n,)``; NaN where there are none."""
    if len(values) == 0:
        return dict.fromkeys(QUANTILES, float("nan"))
    return {name: float(np.quantile(values, q)) for name, q in QUANTILES.items()}


class Ended(BaseException):
    """Leads out of the block of a :class:`SafeEnd`, and never leaves it."""


class SafeEnd:
    """A block at whose end the safe input is handed over, however the block ends.

    When it ends by itself, or by any exception: ``hand_over()`` comes first, the exception is raised on. In the main
    thread also when a signal ends it (``ENDING``): the signal breaks off what the block is doing, the safe input is
    handed over, and only then the signal has the effect that it would have had without this block: the process ends by
    it, or ``KeyboardInterrupt`` is raised, or the program's own handler is called. If the program lives on, it goes on
    behind the block. Signals that are ignored, as under ``nohup``, stay so. While the safe input is handed over no
    signal interrupts; it waits.

    Another thread gets no signals. There the block ends when the interpreter does, which waits for it.

    Args:
        hand_over: Hands the safe input to the actuator. Where it raises it is called again after ``PAUSES_S``.

    Raises:
        SafeInputError: At the end of the block, if the safe input could not be handed over, from the first failure of
            ``hand_over``. If a signal then ends the process, the error is printed.

    Example:
        >>> held = [0.7]
        >>> with SafeEnd(lambda: held.append(0.0)) as end:
        ...     end.check()
        ...     raise OSError("the sensor's cable")
        Traceback (most recent call last):
        ...
        OSError: the sensor's cable
        >>> held
        [0.7, 0.0]
    """

    def __init__(self, hand_over: Callable[[], object]) -> None:
        self._hand_over = hand_over
        self._handler, self._armed = self._signalled, False
        self._previous: dict[int, Any] = {}
        self._signals: list[int] = []
        self._exiting, self._over = False, threading.Event()

    @property
    def cause(self) -> str:
        """What asked the block to end: the name of the first signal, ``"exit"`` of the interpreter, or nothing."""
        if self._signals:
            return signal.Signals(self._signals[0]).name
        return "exit" if self._exiting else ""

    def check(self) -> None:
        """End the block if that has been asked for.

        Call it often: a callback may have swallowed what a signal raised.
        """
        if self.cause:
            raise Ended(self.cause)

    def __enter__(self) -> SafeEnd:
        self._thread = threading.current_thread()
        if self._thread is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                if before not in (signal.SIG_IGN, None):  # None: not Python's, so it could not be put back
                    self._previous[number] = before
                    signal.signal(number, self._handler)
        else:
            atexit.register(self._at_exit)
        self._armed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        self._armed = False
        failure = self._handed_over()
        for number, before in self._previous.items():
            if signal.getsignal(number) is self._handler:
                signal.signal(number, before)
        self._over.set()
        if not self._exiting:
            atexit.unregister(self._at_exit)
        if failure is not None and self._signals:  # the signal may leave no time to say so
            traceback.print_exception(failure)
        _deliver(list(dict.fromkeys(self._signals)))
        if failure is not None:
            raise failure
        return isinstance(error, Ended)

    def _handed_over(self) -> SafeInputError | None:
        failures: list[BaseException] = []
        for pause in (0.0, *PAUSES_S):
            try:
                time.sleep(pause)
                self._hand_over()
            except BaseException as failure:
                failures.append(failure)
            else:
                return None
        error = SafeInputError(
            f"the safe input could not be handed over: the actuator failed {len(failures)} times, at last with "
            f"{failures[-1]!r}. The machine may still follow the last input: cut its power [HM-LOOP-053]"
        )
        error.__cause__ = failures[0]
        return error

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        self._signals.append(number)
        entering_or_leaving = frame is not None and frame.f_code in _OWN
        if self._armed and not entering_or_leaving:
            raise Ended(self.cause)

    def _at_exit(self) -> None:
        """The interpreter ends: wait for the block's end, unless its thread is one of a parent process."""
        self._exiting = True
        if self._thread.is_alive():
            self._over.wait()


_OWN = (SafeEnd.__enter__.__code__, SafeEnd.__exit__.__code__)
"""A signal that arrives between the block and the first or last statement of these would else get past them."""


def _deliver(signals: Sequence[int]) -> None:
    """Let signals have their effect, each whatever those before it raise."""
    if signals:
        try:
            signal.raise_signal(signals[0])
        finally:
            _deliver(signals[1:])


class Clock(Protocol):
    """What the runner knows of time."""

    def now(self) -> float:
        """Time [s] on a scale that never goes back."""

    def sleep_until(self, t: float) -> None:
        """Return at ``t`` [s] or as soon as possible after it; at once if it has passed."""


class RealClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """Time [s] since some fixed instant."""
        return time.perf_counter()

    def sleep_until(self, t: float) -> None:
        """Sleep; the operating system decides how punctual the return is."""
        while (left := t - time.perf_counter()) > 0:
            time.sleep(left)


class CheckedClock:
    """A clock that is checked: a loop on one that stands still would spin for ever.

    A wait may end early by a small share of the loop's period ``dt`` [s].
    """

    def __init__(self, clock: Clock, dt: float) -> None:
        self._clock, self._early, self._last = clock, EARLY * dt, -math.inf

    def now(self) -> float:
        """Time [s], finite and never before the last one."""
        t = float(sampled(self._clock.now(), (), "clock: what now() returns"))
        if not math.isfinite(t):
            raise InputError(f"clock: now() gives {t}; a finite time [s] needed [HM-LOOP-040]")
        if t < self._last:
            raise InputError(
                f"clock: now() has gone back from {self._last} to {t}; give one that never does [HM-LOOP-041]"
            )
        self._last = t
        return t

    def sleep_until(self, t: float) -> None:
        """Wait until ``t`` [s]."""
        for _ in range(WAKES):
            self._clock.sleep_until(t)
            if self.now() >= t - self._early:
                return
        raise InputError(
            f"clock: sleep_until({t}) has come back {WAKES} times, at last at {self._last}; it must wait [HM-LOOP-042]"
        )
