"""The door to hardware: estimator, controller and monitor in step with a real clock."""

from __future__ import annotations

import contextlib
import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.closed_loop.guard import Guard, GuardedLoop
from hybrid_mpc.closed_loop.machine import Preview, Previews, fitting
from hybrid_mpc.closed_loop.simulate import Monitor, check_models
from hybrid_mpc.closed_loop.timing import Clock, RealClock, RunnerStep, RunReport, make_report
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.delays import filtered, sees_truth
from hybrid_mpc.estimation.kalman import Estimate, Estimator
from hybrid_mpc.mpc.problem import Controller
from hybrid_mpc.mpc.safeguard import Decision, SafeController
from hybrid_mpc.mpc.solution import Status
from hybrid_mpc.riccati import vector

Array = NDArray[np.float64]
RECENT = 25
"""Solves whose fastest tells whether another one still fits before a deadline."""
LONG = 250
"""Skipped periods after which the estimate starts anew: a filter knows little after as many without a sample."""


class Runner:
    """Steps estimator, controller and monitor against a machine's sensors and actuators, in real time.

    Before the clock starts, while the machine rests: the first sample, and the first plan from it. Each period:
    wait for its instant, measure, estimate, decide, actuate, then monitor. A missing sample leaves
    the prediction. A solve that comes back after the deadline is dropped, and one that cannot be in time any more
    is not begun: the shifted plan is applied (:meth:`~hybrid_mpc.mpc.SafeController.late`). A solve that has begun
    is not interrupted. After a long delay the run goes on at the grid's nearest instant; the estimator is led
    through the periods in between without a measurement, with the input that was held.

    Numbers never raise. Whatever ends the run, Ctrl-C and an exception in a callback included, the safe input
    is handed to the actuator before anything else; the exception is raised on. The input that acts with
    no delay is assumed to act from the grid's instant on: keep steps short against the period, or declare the
    delay (:class:`~hybrid_mpc.estimation.DelayCompensation`).

    Args:
        measure: ``() -> y (n_y,)``, or None where no sample has come.
        actuate: Takes the input ``u (n_u,)``, to be held until the next.
        estimator: Filter on the controller's model.
        controller: A :class:`~hybrid_mpc.mpc.SafeController`; a bare controller is guarded without fallback.
        reference: ``t (n,) [s] -> x_ref (n, n_x)``, previewed over the horizon; ``t`` counts from the start.
        weight: Factors on ``q``, alike. Default: 1.
        horizon: Periods of preview. Default: the controller's horizon.
        monitor: Default: none.
        deadline: Time [s] after a period's instant by which its input must be decided. Default: one period.
        safe_input: Input ``(n_u,)`` within the limits for the end of the run. Default: zero, or the bound next to it.
        input_delay: Periods after which an input acts, as the estimator knows it; shifts the preview.
        sensor_delay: Periods after which a measurement arrives; pairs it with its input for the monitor.
        clock: Default: the computer's.
        on_step: Called at the end of every period with a :class:`RunnerStep`; must be short.
        guard: What to do on alarms of the monitor, which it needs. Default: nothing.
        keep: Periods whose rows the report keeps, the last ones. Default 100 000.

    Raises:
        InputError: If models, deadline, safe input, delays or ``keep`` do not fit, or the estimator wants the truth.

    Example: see ``docs/control.md``; in short::

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
        horizon: int | None = None,
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
        safe = controller if isinstance(controller, SafeController) else SafeController(controller)
        self._safe, self._estimator, self._ocp = safe, estimator, safe.controller.ocp
        check_models(estimator.model, safe.controller.model)
        if sees_truth(estimator):
            raise InputError("Runner: a machine does not tell its true state; give a filter, not TrueState")
        self._dt = estimator.model.dt
        if abs(safe.controller.model.dt - self._dt) > 1e-9 * self._dt:
            raise InputError(
                f"Runner: the estimator's period is {self._dt} s, the controller's "
                f"{safe.controller.model.dt} s; they must agree"
            )
        self._deadline = self._dt if deadline is None else float(deadline)
        if not 0 < self._deadline <= self._dt * (1 + 1e-9):
            raise InputError(f"Runner: deadline must lie within the period of {self._dt} s, got {deadline} s")
        self._delays = _whole(input_delay, "input_delay"), _whole(sensor_delay, "sensor_delay")
        if guard is not None and monitor is None:
            raise InputError("Runner: a guard acts on a monitor's alarms; give monitor= as well")
        self._guard = guard
        if keep < 1:
            raise InputError(f"Runner: keep must be 1 or more periods, got {keep}")
        self._measure, self._actuate, self._monitor = measure, actuate, monitor
        self._reference, self._weight, self._horizon = reference, weight, horizon
        self._safe_input = self._checked_safe(safe_input)
        self._clock, self._on_step, self._keep = clock or RealClock(), on_step, keep

    @property
    def safe_input(self) -> Array:
        """The input handed over at the end of every run ``(n_u,)``."""
        return self._safe_input.copy()

    def run(self, duration: float | None = None, stop: Callable[[], bool] | None = None) -> RunReport:
        """Run until the duration has passed or ``stop()`` is true, whichever is first.

        Args:
            duration: Length [s], rounded to whole periods. Default: none.
            stop: Asked before every period. Default: never.

        Returns:
            The statistics and the rows of the last ``keep`` periods.

        Raises:
            InputError: If neither end is given, the duration is not positive and finite, or a callback returns
                another shape. What a callback raises is raised on, after the safe input.
        """
        n = self._periods(duration, stop)
        previews = Previews(
            self._reference, self._weight, self._ocp, self._horizon, self._dt,
            math.inf if n is None else n * self._dt,
        )  # fmt: skip
        loop = _Run(self, previews)
        ended = "duration"
        try:
            self._warm_up(previews)
            loop.begin()
            while n is None or loop.k < n:
                if stop is not None and stop():
                    ended = "stop"
                    break
                loop.period()
            loop.wait()
        except BaseException:
            with contextlib.suppress(Exception):  # the first failure is the one to report
                self._actuate(self.safe_input)
            raise
        self._actuate(self.safe_input)
        return loop.report(ended)

    def _periods(self, duration: float | None, stop: Callable[[], bool] | None) -> int | None:
        if duration is None:
            if stop is None:
                raise InputError("Runner: give a duration [s], or a function stop() that ends the run")
            return None
        if not (math.isfinite(duration) and round(duration / self._dt) >= 1):
            raise InputError(
                f"Runner: duration {duration} s given; at least one period of {self._dt} s, and finite, needed"
            )
        return round(duration / self._dt)

    def _warm_up(self, previews: Previews) -> None:
        """Everything once before the clock runs, since first calls are slow; nothing remembers it."""
        x_ref, factors = previews(self._delays[0] * self._dt)
        estimate = self._estimator.start(np.zeros(self._estimator.model.n_y))
        for _ in range(2):
            decision = self._safe.decide(self._safe.initial(estimate), estimate, x_ref, factors)
            self._safe.late(decision, estimate, x_ref)
            estimate = self._estimator.update(estimate, np.zeros(self._estimator.model.n_y), decision.u)
        if self._monitor is not None:
            y = np.zeros(self._estimator.model.n_y)
            self._monitor.update(self._monitor.initial(), y, decision.u, filtered(estimate))

    def _checked_safe(self, given: ArrayLike | None) -> Array:
        low, high = self._ocp.u_min, self._ocp.u_max
        u = vector(np.clip(0.0, low, high) if given is None else given, self._ocp.n_u, "safe_input")
        if np.any(u < low) or np.any(u > high):
            raise InputError(f"Runner: safe_input {u} is outside the limits {low} to {high}")
        return u


class _Run:
    """One run: the only place that remembers from period to period."""

    def __init__(self, runner: Runner, previews: Previews) -> None:
        self._r, self._previews = runner, previews
        self._guarded = None if runner._guard is None else runner._guard.begin(runner._safe)
        self._control: SafeController | GuardedLoop = self._guarded or runner._safe
        self.k = self._skipped = self._missing = self._late = self._overruns = self._count = 0
        self._sources: Counter[str] = Counter()
        self._rows: deque[RunnerStep] = deque(maxlen=runner._keep)
        self._solves: deque[float] = deque(maxlen=RECENT)
        self._estimate: Estimate | None = None
        self._decision: Decision | None = None
        self._memory: Any = None if runner._monitor is None else runner._monitor.initial()
        self._held: deque[Array] = deque(maxlen=sum(runner._delays) + 1)
        self._first = np.zeros(0)
        self._start = 0.0

    def begin(self) -> None:
        """Measure and make the first plan while the machine still rests; the first period is then now."""
        r = self._r
        self._first = self._sample()
        x_ref, factors = self._previews(r._delays[0] * r._dt)
        self._estimate = r._estimator.start(self._first, 0.0)
        self._decision = self._control.initial(self._estimate, None, x_ref, factors)
        self._held.extend([self._decision.u] * (self._held.maxlen or 1))
        self._start = r._clock.now()

    def wait(self) -> None:
        """Until the next period's instant, to hold the last input for a whole one."""
        self._r._clock.sleep_until(self._start + self.k * self._r._dt)

    def period(self) -> None:
        """Wait for the period's instant, and do all of it."""
        self.wait()
        r, clock, due = self._r, self._r._clock, self._start + self.k * self._r._dt
        times = [clock.now()]
        first, t = not self._count, self.k * r._dt
        y = self._first if first else self._sample()
        times.append(clock.now())
        x_ref, factors = self._previews(t + r._delays[0] * r._dt)
        previous = self._decision
        assert previous is not None
        if self._estimate is None:
            self._estimate = r._estimator.start(y, t)
        elif not first:
            self._estimate = r._estimator.update(self._estimate, y, previous.u)
        estimate = self._estimate
        if self._guarded is not None:
            self._guarded.measured(t, y, previous.u)
        times.append(clock.now())
        decision = self._decided(previous, estimate, x_ref, factors, due + r._deadline)
        times.append(clock.now())
        r._actuate(decision.u.copy())
        times.append(clock.now())
        reading = None
        if r._monitor is not None:
            self._memory, reading = r._monitor.update(self._memory, y, self._held[0], filtered(estimate))
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
        if r._on_step is not None:
            r._on_step(step)
        self._go_on()

    def _sample(self) -> Array:
        n_y, y = self._r._estimator.model.n_y, self._r._measure()
        return np.full(n_y, np.nan) if y is None else fitting(y, n_y, "what measure() returns")

    def _decided(
        self, previous: Decision, estimate: Estimate, x_ref: Array, factors: Array | None, deadline: float
    ) -> Decision:
        safe, clock = self._control, self._r._clock
        begin = clock.now()
        # Half of the time left is always tried: else a slow spell would end all solving.
        needed = min(min(self._solves, default=0.0), 0.5 * self._r._deadline)
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
        self._overruns += step.applied > self._r._deadline

    def _go_on(self) -> None:
        """To the next instant on the grid, or the nearest to now if that has long passed."""
        r = self._r
        following = max(self.k + 1, round((r._clock.now() - self._start) / r._dt))
        skipped = following - self.k - 1
        if skipped > LONG:
            self._estimate = None
        elif self._estimate is not None and self._decision is not None:
            for _ in range(skipped):
                y = np.full(r._estimator.model.n_y, np.nan)
                self._estimate = r._estimator.update(self._estimate, y, self._decision.u)
                self._held.append(self._decision.u)
                if self._guarded is not None:
                    self._guarded.measured(self.k * r._dt, y, self._decision.u)
        self._skipped += skipped
        self.k = following

    def report(self, stopped: str) -> RunReport:
        """What happened."""
        return make_report(
            list(self._rows), self._r._estimator.model, periods=self._count, sources=dict(self._sources),
            missing=self._missing, late=self._late, overruns=self._overruns, skipped=self._skipped,
            stopped=stopped, switches=() if self._guarded is None else tuple(self._guarded.switches),
        )  # fmt: skip


def _whole(delay: int, name: str) -> int:
    if int(delay) != delay or delay < 0:
        raise InputError(f"Runner: {name}: a whole number of periods needed, not negative; got {delay}")
    return int(delay)
