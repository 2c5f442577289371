"""The door to hardware: estimator, controller and monitor in step with a real clock."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.closed_loop.guard import Guard
from hybrid_mpc.closed_loop.loop import Loop, Monitor
from hybrid_mpc.closed_loop.machine import Preview
from hybrid_mpc.closed_loop.run import Parts, Run
from hybrid_mpc.closed_loop.safe_end import SafeEnd
from hybrid_mpc.closed_loop.timing import CheckedClock, Clock, RealClock, RunnerStep, RunReport
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.delays import sees_truth
from hybrid_mpc.estimation.kalman import Estimator
from hybrid_mpc.mpc.problem import Controller
from hybrid_mpc.mpc.safeguard import SafeController, checked_safe_input

Array = NDArray[np.float64]


class Runner:
    """Steps estimator, controller and monitor against a machine's sensors and actuators, in real time.

    It drives a :class:`~hybrid_mpc.closed_loop.Loop`. Before the clock starts, while the machine rests: the first
    sample, and plan and input from it. Each period: wait for its instant, measure, estimate, decide, actuate, then what
    the loop leaves until after the input (monitor, preparation of the next solve). A missing sample leaves
    the prediction. A solve that comes back after the deadline is dropped, and one that cannot be in time any more
    is not begun: the shifted plan is applied (:meth:`~hybrid_mpc.mpc.SafeController.late`). A solve that has begun
    is not interrupted. After a long delay the run goes on at the grid's nearest instant; the estimator is led
    through the periods in between without a measurement, with the input that was held.

    Numbers never raise. Whatever ends the run, exceptions in callbacks and signals (Ctrl-C, SIGTERM, SIGHUP, ...)
    included, the safe input is handed to the actuator before anything else (:class:`SafeEnd`); then the exception is
    raised on, or the signal has its effect. Signals reach Python's main thread alone: in another thread ``stop`` ends
    a run. What no program can catch (SIGKILL, a hang in a driver, a power cut) takes a watchdog in the actuator;
    ``docs/control.md`` has one. ``actuate`` may be broken off by a signal, and is then called with the safe input.

    The input that acts with no delay is assumed to act from the grid's instant on: keep steps short against the
    period, or declare the delay (:class:`~hybrid_mpc.estimation.DelayCompensation`).

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
        safe_input: Input ``(n_u,)`` within the limits for the end of the run. Default: the controller's.
        input_delay: Periods after which an input acts, as the estimator knows it; shifts the preview.
        sensor_delay: Periods after which a measurement arrives; pairs it with its input for the monitor.
        clock: Default: the computer's. One that does not wait, stands still, goes back or gives NaN ends the run.
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
        if sees_truth(estimator):
            raise InputError("Runner: a machine does not tell its true state; give a filter, not TrueState")
        dt = estimator.model.dt
        due = dt if deadline is None else float(deadline)
        if not 0 < due <= dt * (1 + 1e-9):
            raise InputError(f"Runner: deadline must lie within the period of {dt} s, got {deadline} s")
        if keep < 1:
            raise InputError(f"Runner: keep must be 1 or more periods, got {keep}")
        self._clock = clock or RealClock()
        self._parts = Parts(measure, actuate, due, on_step, keep)

        def make(end: float, now: Callable[[], float]) -> Loop:
            return Loop(
                estimator, controller, monitor=monitor, reference=reference, weight=weight, guard=guard,
                horizon=horizon, end=end, input_delay=input_delay, sensor_delay=sensor_delay, now=now,
            )  # fmt: skip

        self._dt, self._make = dt, make
        loop = make(math.inf, self._clock.now)
        self._safe_input = loop.safe_input if safe_input is None else checked_safe_input(safe_input, loop.ocp)

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
            InputError: If neither end is given, the duration is not positive and finite, a callback returns
                another shape, or the clock is none. What a callback raises is raised on, after the safe input.
            SafeInputError: If the actuator did not take the safe input.
        """
        n = self._periods(duration, stop)
        clock = CheckedClock(self._clock, self._dt)
        loop = self._make(math.inf if n is None else n * self._dt, clock.now)
        run = Run(self._parts, loop, clock)
        ended = "duration"
        with SafeEnd(lambda: self._parts.actuate(self.safe_input)) as end:
            end.check()
            loop.warm_up()
            run.begin()
            while n is None or run.k < n:
                end.check()
                if stop is not None and stop():
                    ended = "stop"
                    break
                run.period()
            run.wait()
        return run.report(end.cause or ended)

    def _periods(self, duration: float | None, stop: Callable[[], bool] | None) -> int | None:
        if duration is None:
            if stop is None:
                raise InputError("Runner: give a duration [s], or a function stop() that ends the run")
            return None
        dt = self._dt
        if not (math.isfinite(duration) and round(duration / dt) >= 1):
            raise InputError(
                f"Runner: duration {duration} s given; at least one period of {dt} s, and finite, needed"
            )
        return round(duration / dt)
