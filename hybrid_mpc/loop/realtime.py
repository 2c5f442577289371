"""The loop in real time: it runs on a machine's callbacks and a clock, and always ends with the safe input."""

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
"""Timed parts of a period, in this order: the input is applied after ``actuate``."""
QUANTILES = {"median": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK", "SIGXCPU", "SIGTSTP")
    if hasattr(signal, name)
)
"""Signals that ask a program to end or to stop, if the operating system has them: Ctrl-C, ``kill``, closed terminal,
Ctrl-\\, Ctrl-Break, limit of computing time, Ctrl-Z."""
PAUSES_S = (0.0, 0.01, 0.1, 1.0)
"""Pauses [s] before each further attempt to apply the safe input: none after a message that a signal interrupted, then
the time that a bus or its driver may need to recover. There are no more attempts, since the process must end."""
WAKES = 10
"""Largest number of successive waits that end early: an interrupted sleep is continued."""


MOST_KEPT = 10**9
"""Largest number of periods with rows in a report."""


class Runner:
    """Runs estimator, controller and monitor on a machine's sensors and actuators, in real time.

    It drives a :class:`~hybrid_mpc.loop.loop.Loop`. Before the clock starts, while the machine is at rest, it takes the
    first sample and computes the first plan. In each period it waits for the period's time, measures, estimates,
    decides and actuates; then it runs the rest of the period. With a missing sample the estimator predicts. A solve is
    never interrupted: if it ends after the deadline, its result is discarded; if it cannot meet the deadline, it does
    not begin. In both cases the shifted plan is applied
    (:meth:`~hybrid_mpc.control.safeguard.SafeController.late`). After a long delay the run continues at the nearest
    time of the grid; the estimator predicts through the skipped periods.

    No sensor, model or reference value can raise an exception. However the run ends, also by an exception in a callback
    or by a signal (Ctrl-C, SIGTERM, SIGHUP, ...), the safe input is applied first (:class:`SafeEnd`); then the
    exception is raised, or the signal takes effect. Only Python's main thread receives signals: in another thread,
    end a run by ``stop``. Events that no program can catch (SIGKILL, a hanging driver, a power failure) need a
    watchdog in the actuator; ``docs/watchdog.md`` shows one. A signal may interrupt ``actuate``, which is then called
    with the safe input.

    Without a delay, an input is assumed to act from the grid's time on: steps must be short compared with the period,
    or the delay must be declared (:class:`~hybrid_mpc.estimate.delay.DelayCompensation`).

    Args:
        measure: ``() -> y (n_y,)``, or None without a new sample.
        actuate: Applies the input ``u (n_u,)``, which is held until the next call.
        estimator: Filter on the controller's model.
        controller: A :class:`~hybrid_mpc.control.safeguard.SafeController`; a bare controller has no fallback.
        reference: ``t (n,) [s] -> x_ref (n, n_x)``, or ``y_ref (n, n_y)`` if the problem weights outputs; ``t`` is the
            time since the start.
        weight: Factors on ``q``, as a function of ``t``. Default: 1.
        measure_w: ``() -> w (n_w,)``, measured disturbances, or None without a new sample. Default: those of the
            operating point.
        w: Forecast of the measured disturbances, as in :class:`~hybrid_mpc.loop.loop.Loop`. Default: none.
        monitor: A monitor with limits. Default: none.
        deadline: Time [s] after the begin of a period at which its input must be decided. Default: one period.
        safe_input: Input ``(n_u,)`` within the limits for the end of the run. Default: the controller's; one of both
            must be declared.
        input_delay: As in :class:`~hybrid_mpc.loop.loop.Loop`. Default: 0.
        sensor_delay: As in :class:`~hybrid_mpc.loop.loop.Loop`. Default: 0.
        clock: The clock. Default: the computer's. A clock that does not wait, stops, goes back or gives NaN ends the
            run.
        on_step: Called at the end of every period with a :class:`RunnerStep`; it must be short. Default: nothing.
        guard: Reaction to alarms of the monitor, which it needs. Default: none.
        keep: Number of the last periods with rows in the report. Default: 100 000.

    Raises:
        InputError: If models, deadline, safe input, delays or ``keep`` are invalid, no safe input is declared, the
            monitor has no limits, or the estimator needs the truth.

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
                "Runner: estimator TrueState needs the true state, which a machine does not give. Give a filter "
                "[HM-LOOP-033]"
            )
        if why := getattr(monitor, "cannot_alarm", ""):
            raise InputError(f"Runner: monitor: {why}, or omit monitor to run without one [HM-LOOP-034]")
        dt = estimator.model.dt
        due = dt if deadline is None else float(sampled(deadline, (), "Runner: deadline"))
        if not 0 < due <= dt * (1 + 1e-9):
            raise InputError(
                f"Runner: deadline: give at most the period of {dt} s, and more than 0 s; got {deadline} s "
                "[HM-LOOP-035]"
            )
        keep = whole(keep, "Runner: keep [periods]", 1, MOST_KEPT)
        self._clock = RealClock() if clock is None else clock
        self._dt, self._deadline, self._keep = dt, due, keep
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
                "Runner: safe_input is missing: the input that may act without supervision. Give "
                "safe_input=[...], or Scenario(safe_input=...). There is no default, since zero is not safe for every "
                "machine [HM-LOOP-036]"
            )
        self._safe_input = check_safe_input(declared, loop.ocp)

    @property
    def safe_input(self) -> Array:
        """The input applied at the end of every run ``(n_u,)``."""
        return self._safe_input.copy()

    def run(self, duration: float | None = None, stop: Callable[[], bool] | None = None) -> RunReport:
        """Run until the duration has passed or ``stop()`` is true, whichever is first.

        Args:
            duration: Length [s], rounded to whole periods. Default: unlimited.
            stop: Called before every period. Default: never stops.

        Raises:
            InputError: If both arguments are missing, the duration is not positive and finite, a callback returns a
                wrong shape, or the clock is invalid. Exceptions of a callback are raised after the safe input.
            SafeInputError: If the actuator did not accept the safe input.
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
                if stop is not None and _read_answer(stop()):
                    ended = "stop"
                    break
                run.period()
            run.wait()
        return run.report(end.cause or ended)

    def _periods(self, duration: float | None, stop: Callable[[], bool] | None) -> int | None:
        if duration is None:
            if stop is None:
                raise InputError(
                    "Runner: the end of the run is missing; give a duration [s], or a function stop() [HM-LOOP-037]"
                )
            return None
        dt, duration = self._dt, float(sampled(duration, (), "Runner: duration"))
        if not (math.isfinite(duration) and round(duration / dt) >= 1):
            raise InputError(
                f"Runner: duration must be finite and at least one period of {dt} s, got {duration} s [HM-LOOP-038]"
            )
        return round(duration / dt)


def _read_answer(answer: object) -> bool:
    try:
        return bool(answer)
    except ValueError as error:  # several numbers
        raise InputError(
            f"Runner: stop() must return True or False, but it returns {type(answer).__name__} [HM-LOOP-039]"
        ) from error


class _Run:
    """One run: its clock, its counts and its last rows; the control state is in the loop."""

    def __init__(self, runner: Runner, loop: Loop, clock: CheckedClock) -> None:
        self._runner, self._loop, self._clock = runner, loop, clock
        self._dt, self._deadline = runner._dt, runner._deadline
        self.k = self._periods = self._skipped = self._missing = self._late = self._overruns = 0
        self._sources: Counter[str] = Counter()
        self._rows: deque[RunnerStep] = deque(maxlen=runner._keep)
        # number of recent solves; the fastest of them decides whether a solve can meet its deadline
        self._solves: deque[float] = deque(maxlen=25)
        self._start = 0.0

    def begin(self) -> None:
        """Measure, plan and decide while the machine is at rest; the first period begins afterwards."""
        self._loop.start(self._sample(), self._disturbances())
        self._start = self._clock.now()

    def wait(self) -> None:
        """Wait for the begin of the next period."""
        self._clock.sleep_until(self._start + self.k * self._dt)

    def period(self) -> None:
        """Wait for the begin of a period, and run it."""
        self.wait()
        loop, clock = self._loop, self._clock
        due = self._start + self.k * self._dt
        begin = measured = clock.now()
        if self._periods:  # the first input was decided before the clock started
            y = self._sample()
            measured = clock.now()
            self._decide(y, due + self._deadline)
        decided = clock.now()
        self._runner._actuate(loop.decision.u.copy())
        acted = clock.now()
        loop.finish()
        spent = {"measure": measured - begin, "actuate": acted - decided, **loop.spent}
        step = RunnerStep(
            k=self.k, t=self.k * self._dt, y=loop.state.y, estimate=loop.estimate, decision=loop.decision,
            reading=loop.reading, lateness=begin - due, applied=acted - due, spent=spent,
        )  # fmt: skip
        self._count(step)
        if self._runner._on_step is not None:
            self._runner._on_step(step)
        self._go_on()

    def report(self, stopped: str) -> RunReport:
        """The report of the run."""
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
        """Run a step; a solve only begins if it can meet the deadline, and its result is discarded if it is late."""
        # with half of the deadline left, always solve: otherwise a slow period could prevent all further solves
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
        """Advance to the next period, or after a long delay to the period nearest to the present time."""
        following = max(self.k + 1, round((self._clock.now() - self._start) / self._dt))
        skipped = following - self.k - 1
        if skipped:
            self._loop.skip(skipped)
        self._skipped += skipped
        self.k = following


@dataclass(frozen=True)
class RunnerStep:
    """One period, as passed to ``on_step``; times are in seconds.

    Args:
        k: Number of the period on the grid.
        t: Time on the grid since the start.
        y: Measurement ``(n_y,)``; NaN if missing.
        estimate: The estimate.
        decision: The input and its source.
        reading: The monitor's reading; None without a monitor.
        lateness: Delay of the period's start relative to the grid.
        applied: Time from the grid until the input has been applied.
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
    """Report of a real-time run; counts include all periods, rows the last ``keep`` periods.

    Args:
        periods: Periods that ran.
        sources: Number of inputs by the name of their :class:`~hybrid_mpc.control.safeguard.Source`.
        missing: Periods without a measurement (None, or no finite value).
        late: Periods in which the shifted plan was applied because the solve was late, or would have been.
        overruns: Periods whose input was applied after the deadline.
        skipped: Periods that did not run because an earlier period took too long.
        stopped: Cause of the end: ``"duration"``, ``"stop"``, the name of a signal that the program survives
            (``"SIGTERM"``), or ``"exit"`` of the interpreter.
        t: Times ``(n,)`` [s] on the grid since the start, of the last ``keep`` periods.
        y: Measurements ``(n, n_y)``; NaN if missing.
        u: Inputs ``(n, n_u)``.
        x_hat: Estimated states ``(n, n_x)``.
        source: Name of the source of each input.
        status: Name of the :class:`~hybrid_mpc.control.problem.Status` of each solve.
        lateness_ms: Delay of each period's start relative to the grid ``(n,)`` [ms].
        applied_ms: Time from the grid until each input has been applied ``(n,)`` [ms].
        timing_ms: Durations ``(n,)`` [ms]: ``measure``, ``estimate``, ``solve``, ``actuate``, ``monitor``, ``prepare``.
        alarm: ``(n,)``, True while the monitor alarms.
        switches: Changes of the guard's mode in the whole run. Default: none.
        given_way: For each period the hard bounds that the plan violates, with the largest violation. Default: unknown.
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
        """Median, 95th and 99th percentile and maximum [ms] of lateness, time of application and durations.

        Example: ``runner.run(duration=10.0).percentiles()["lateness"]["p99"]``
        """
        rows = {"lateness": self.lateness_ms, "applied": self.applied_ms, **self.timing_ms}
        return {name: percentiles(values) for name, values in rows.items()}


def percentiles(values: Array) -> dict[str, float]:
    """Median, 95th and 99th percentile and maximum of ``values`` ``(n,)``; NaN for no values."""
    if len(values) == 0:
        return dict.fromkeys(QUANTILES, float("nan"))
    return {name: float(np.quantile(values, q)) for name, q in QUANTILES.items()}


class Ended(BaseException):
    """Internal exception that ends the block of a :class:`SafeEnd`; it never leaves the block."""


class SafeEnd:
    """Context manager that applies the safe input at the end of its block, however the block ends.

    At the normal end, or after any exception, ``hand_over()`` is called first; then the exception is raised. In the
    main thread this also holds for signals (``ENDING``): a signal interrupts the block, the safe input is applied,
    and only then the signal takes its usual effect: it ends the process, raises ``KeyboardInterrupt``, or calls the
    program's own handler. If the program continues, it continues after the block. Ignored signals, as under
    ``nohup``, stay ignored. A signal during ``hand_over()`` is delayed.

    Other threads receive no signals. There, the end of the interpreter ends the block, and waits for it.

    Args:
        hand_over: Applies the safe input at the actuator. If it raises, it is called again after ``PAUSES_S``.

    Raises:
        SafeInputError: At the end of the block, if the safe input could not be applied; its cause is the first failure
            of ``hand_over``. If a signal then ends the process, the error is printed.

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
        self._handler, self._armed = self._receive_signal, False
        self._previous: dict[int, Any] = {}
        self._signals: list[int] = []
        self._exiting, self._over = False, threading.Event()

    @property
    def cause(self) -> str:
        """Cause of the block's end: the name of the first signal, ``"exit"`` of the interpreter, or empty."""
        if self._signals:
            return signal.Signals(self._signals[0]).name
        return "exit" if self._exiting else ""

    def check(self) -> None:
        """End the block if a signal or the interpreter's exit has requested it.

        Call it often: a callback may have caught the exception of a signal.
        """
        if self.cause:
            raise Ended(self.cause)

    def __enter__(self) -> SafeEnd:
        self._thread = threading.current_thread()
        if self._thread is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                # None: not a Python handler, so it could not be restored
                if before not in (signal.SIG_IGN, None):
                    self._previous[number] = before
                    signal.signal(number, self._handler)
        else:
            atexit.register(self._wait_at_exit)
        self._armed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        self._armed = False
        failure = self._apply_safe_input()
        for number, before in self._previous.items():
            if signal.getsignal(number) is self._handler:
                signal.signal(number, before)
        self._over.set()
        if not self._exiting:
            atexit.unregister(self._wait_at_exit)
        if failure is not None and self._signals:  # the signal may end the process: print now
            traceback.print_exception(failure)
        _deliver(list(dict.fromkeys(self._signals)))
        if failure is not None:
            raise failure
        return isinstance(error, Ended)

    def _apply_safe_input(self) -> SafeInputError | None:
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
            f"actuator: the safe input could not be applied. It failed {len(failures)} times, the last time with "
            f"{failures[-1]!r}. The machine may still follow the last input: cut its power [HM-LOOP-053]"
        )
        error.__cause__ = failures[0]
        return error

    def _receive_signal(self, number: int, frame: FrameType | None) -> None:
        self._signals.append(number)
        entering_or_leaving = frame is not None and frame.f_code in _OWN
        if self._armed and not entering_or_leaving:
            raise Ended(self.cause)

    def _wait_at_exit(self) -> None:
        """At the end of the interpreter, wait for the block's end, unless its thread belongs to a parent process."""
        self._exiting = True
        if self._thread.is_alive():
            self._over.wait()


_OWN = (SafeEnd.__enter__.__code__, SafeEnd.__exit__.__code__)
"""Code of the two methods: a signal within them must not raise, or the safe input could be skipped."""


def _deliver(signals: Sequence[int]) -> None:
    """Raise the signals again, each of them even if an earlier one raises an exception."""
    if signals:
        try:
            signal.raise_signal(signals[0])
        finally:
            _deliver(signals[1:])


class Clock(Protocol):
    """Interface of a clock."""

    def now(self) -> float:
        """Monotonic time [s]."""

    def sleep_until(self, t: float) -> None:
        """Return at ``t`` [s] or as soon as possible after it; at once if it has passed."""


class RealClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """Time [s] since an arbitrary origin."""
        return time.perf_counter()

    def sleep_until(self, t: float) -> None:
        """Sleep; the operating system decides how punctual the return is."""
        while (left := t - time.perf_counter()) > 0:
            time.sleep(left)


class CheckedClock:
    """A checked clock: with a clock that stops, a loop would never end.

    A wait may end early by a small share of the loop's period ``dt`` [s].
    """

    def __init__(self, clock: Clock, dt: float) -> None:
        # share of a period by which a wait may end early: rounding, irrelevant for a controller
        self._clock, self._early, self._last = clock, 1e-3 * dt, -math.inf

    def now(self) -> float:
        """Time [s], checked to be finite and monotonic."""
        t = float(sampled(self._clock.now(), (), "clock: what now() returns"))
        if not math.isfinite(t):
            raise InputError(f"clock: now() returns {t}; it must return a finite time [s] [HM-LOOP-040]")
        if t < self._last:
            raise InputError(
                f"clock: now() went back from {self._last} to {t}; give a monotonic clock [HM-LOOP-041]"
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
            f"clock: sleep_until({t}) returned {WAKES} times too early, the last time at {self._last}; it must wait "
            "[HM-LOOP-042]"
        )
