"""The monitor of any machine: what its model does not explain of every output and of every balance."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.data.scales import noise_of, periods
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import alarm_intervals, calibrate
from hybrid_mpc.monitor.energy import FROZEN_STEPS, SECONDS, Validity
from hybrid_mpc.monitor.lengths import block_seconds, machine_second
from hybrid_mpc.monitor.replay import REPORTED, EstimatorLike, TrajectoryLike
from hybrid_mpc.rules import Line

Array = NDArray[np.float64]
SHORT_S, LONG_S = 0.3, 3.0
"""Lengths of the two averages [the machine's seconds]: one is soon there, one shows what is small and lasts."""
FREE_RUN_S = 1.0
"""Length of the model's free runs [the machine's seconds]. A jump of a sensor, which the estimator follows within a few
samples, shows in them until the next one begins."""
SETTLING_S = 1.0
"""Beginning of a recording or loop that counts for nothing [the machine's seconds]: the estimator does not know the
states yet."""
MARGIN = 1.5
"""Where nominal data are too short for a rate: threshold over the highest nominal level."""
RUNS = 2
"""Free runs that take turns, half a length apart: one has always half a length behind it."""


@dataclass(frozen=True)
class ResidualLimits:
    """Thresholds of a :class:`ResidualMonitor`, learned from recordings in which nothing is wrong.

    Args:
        channels: Names of the residuals, see :attr:`ResidualMonitor.channels`.
        dt: Period [s] they were learned at.
        threshold: Levels ``(channels, 2)`` above which an alarm starts, of the short and of the long average [units of
            the channels]. Infinite where a measured disturbance was constant.
        release: Levels below which it ends.
        travel: How far each output may be predicted to move while its sensor repeats itself ``(n_y,)`` [its unit].
        repeats: For so many samples each sensor may repeat itself while it should move ``(n_y,)``.
        false_alarms_per_hour: Wanted rate [1/h] of all alarms together.
        hours: Duration of the recordings [h].
        method: How they were found.
        rated: Whether the rate was told from the recordings; False where they were too short for any, and thresholds
            are a margin above the highest nominal level.

    Raises:
        InputError: If the sizes differ, or a number is not positive.
    """

    channels: tuple[str, ...]
    dt: float
    threshold: tuple[tuple[float, float], ...]
    release: tuple[tuple[float, float], ...]
    travel: tuple[float, ...]
    repeats: tuple[int, ...]
    false_alarms_per_hour: float
    hours: float
    method: Line = ""
    rated: bool = True

    def __post_init__(self) -> None:
        sides = np.array(self.threshold, dtype=float), np.array(self.release, dtype=float)
        if any(a.shape != (len(self.channels), 2) or not np.all(a > 0) for a in sides):
            raise InputError(
                f"limits of residuals: {len(self.channels)} channels need two positive thresholds and releases each, "
                f"got {self.threshold} and {self.release}"
            )
        if not all(travel > 0 for travel in self.travel):
            raise InputError(f"limits of residuals: travels must be positive, got {self.travel}")


@dataclass(frozen=True)
class ResidualState:
    """All that the monitor remembers, never changed in place.

    Args:
        x: The latest estimate's state ``(n_x,)``; ``h`` its hidden state, ``w`` its disturbances; NaN before the first.
        y: The latest measurement ``(n_y,)``.
        recent: The latest residuals ``(long, channels)``, NaN until there are any and where something was missing.
        travel: How far each output was predicted to move since its sensor last moved ``(n_y,)``.
        repeats: Samples since then ``(n_y,)``.
        on: Which alarms are on ``(channels, 2)``.
        runs: States, hidden states and unmeasured disturbances of the free runs ``(2, n_x + n_h + n_d)``.
        age: Periods since each of them began; negative: so long until it does.
        seen: Samples taken, up to the long average's.
        invalid: Samples in a row without a valid reading.
    """

    x: Array
    h: Array
    w: Array
    y: Array
    recent: Array
    travel: Array
    repeats: NDArray[np.int_]
    on: NDArray[np.bool_]
    runs: Array
    age: tuple[int, ...]
    seen: int = 0
    invalid: int = 0


@dataclass(frozen=True)
class ResidualReading:
    """What the monitor says of the period that just ended.

    Args:
        residual: By channel ``(channels,)`` [their units]; NaN where unknown.
        level: Means of the latest residuals over both lengths ``(channels, 2)`` [units of the channels], with sign.
        share: The largest level over its threshold [-]; NaN without limits.
        channels: Names of the channels that alarm.
        frozen_outputs: Names of the outputs whose sensor repeats itself while the model predicts that they move.
        travel: How far each output was predicted to move since its sensor last moved ``(n_y,)`` [its unit].
        repeats: Samples since then ``(n_y,)``.
        alarm: True while any channel alarms, a sensor is frozen, or the monitor is blind.
        validity: Whether this reading is valid, and if not, why.
        blind: True while no reading has been valid for twice the short average.
    """

    residual: Array
    level: Array
    share: float
    channels: tuple[str, ...]
    frozen_outputs: tuple[str, ...]
    travel: Array
    repeats: NDArray[np.int_]
    alarm: bool
    validity: Validity
    blind: bool

    @property
    def frozen(self) -> bool:
        """Whether a sensor is frozen."""
        return bool(self.frozen_outputs)

    @property
    def violation_w(self) -> float:
        """NaN: a power [W] is known of the energy monitor alone."""
        return math.nan

    @property
    def level_w(self) -> float:
        """NaN, as :attr:`violation_w`."""
        return math.nan


class ResidualMonitor:
    """Compares a model with its machine, output by output and balance by balance; for any model.

    Its channels, in this order:

    - Each **output**: what was measured less what one step of the model predicts from the estimate of a period ago,
      under the input that acted and without the estimated disturbance [its unit].
    - Each **balance**: what the estimate has become instead, over the period, is a rate that the model does not
      explain, ``r = (x_hat - x_predicted) / dt``. It holds the correction by the measurement, and what a disturbance
      observer takes for a load: so a constant load shows as long as it is there. The residual is ``dS/dx r`` [unit of
      rate], for a mechanical prior the power that the machine has and the model has not.
    - Each **measured disturbance**: how far it is from the operating point's [its unit]. No model says what it should
      be, but one that is where it never was when nothing was wrong is an alarm by itself, and models know nothing
      there.
    - The **free run** of each output: what was measured less what the model, left alone since up to one of the
      machine's seconds, makes of the inputs and of the disturbance that was estimated at its start [unit of the
      output]. The one step begins at an estimate that has half followed the fault; the free run does not. Two take
      turns, and the older one is read.

    **Levels** are means over two lengths. An alarm starts where one passes the threshold of its channel, and its
    channel is named. The first of the machine's seconds counts for nothing: estimates settle in it; an average counts
    from when its length has passed since. **Frozen sensor**:
    an output repeats itself exactly, for longer than when nothing was wrong, while the model's own predictions of it
    add up to more than they did then (limits), and to more than three of the sensor's steps (resolution). A sensor
    at an end of its range is not frozen.

    For a mechanical model whose positions are measured :class:`~hybrid_mpc.monitor.energy.EnergyMonitor` sees more: it
    knows dry friction. Not for several threads at once (it reuses its buffers).

    Args:
        model: The model that is compared with the machine.
        limits: Thresholds, of :func:`learn_residuals`. Default: none, then only a frozen sensor and blindness alarm.
        resolution: Step of each sensor ``(n_y,)`` [output units]. Default: the limits' alone; without these no test
            for freezing.

    Raises:
        InputError: If the limits are of other channels or of another period, or a step is not positive.

    Example:
        >>> from types import SimpleNamespace
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("level", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("inflow", "m/s"),), level,
        ...     x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> monitor = ResidualMonitor(tank)
        >>> none = np.zeros(0)
        >>> memory = monitor.initial()
        >>> for measured in (0.0, 0.1, 0.4):  # 0.1 m flow in each period, and 0.2 m more in the last one
        ...     known = SimpleNamespace(x=np.array([measured]), h=none, w=none)
        ...     memory, reading = monitor.update(memory, np.array([measured]), np.array([0.1]), known)
        >>> monitor.channels, reading.residual.round(6).tolist()
        (('level', 'free run of level'), [0.2, nan])
    """

    def __init__(
        self, model: HybridModel, *, limits: ResidualLimits | None = None, resolution: ArrayLike | None = None
    ) -> None:
        self.model, self.limits = model, limits
        outputs, balances, measured = model.outputs, model.balances, model.disturbances
        free = tuple(f"free run of {s.name}" for s in outputs)
        names = *(s.name for s in outputs), *(b.name for b in balances), *(s.name for s in measured)
        self.channels = (*names, *free)
        """Names of the residuals."""
        units = tuple(s.unit for s in outputs)
        self.units = (*units, *(b.rate_unit for b in balances), *(s.unit for s in measured), *units)
        if limits is not None and (
            limits.channels != self.channels or abs(limits.dt - model.dt) > 1e-9 * model.dt
        ):
            raise InputError(
                f"residual monitor: the limits are of {limits.channels} at {limits.dt} s, the model {model.name} has "
                f"{self.channels} at {model.dt} s; learn them anew with learn_residuals"
            )
        steps = np.full(model.n_y, np.inf if limits is None else 0.0)
        if resolution is not None:
            steps = np.asarray(resolution, dtype=float).ravel()
            if steps.shape != (model.n_y,) or not np.all(steps > 0):
                raise InputError(
                    f"residual monitor: resolution needs {model.n_y} positive steps, got {steps.tolist()}"
                )
        self.frozen_travel = np.maximum(
            FROZEN_STEPS * steps, 0.0 if limits is None else np.array(limits.travel)
        )
        """How far each output may be predicted to move while its sensor repeats itself ``(n_y,)`` [its unit]."""
        self.frozen_repeats = np.zeros(model.n_y) if limits is None else np.array(limits.repeats)
        """For how many samples it may ``(n_y,)``."""
        unit = machine_second(model.dt, model.time_unit)
        self.short, self.long, self.settling = (
            periods(length * unit, model.dt) for length in (SHORT_S, LONG_S, SETTLING_S)
        )
        self.free_run = periods(FREE_RUN_S * unit, model.dt, RUNS)
        """Length of a free run [periods]."""
        ends = [s.saturation or (-np.inf, np.inf) for s in model.outputs]
        self.sensor_ends = np.array(ends, dtype=float).T
        """Ends of the sensors' ranges ``(2, n_y)``."""
        if limits is not None:
            self._threshold, self._release = np.array(limits.threshold), np.array(limits.release)
        self._function = BufferedFunction(_residuals(model))

    @property
    def cannot_alarm(self) -> str:
        """Why no reading could raise an alarm, and what would give it limits; empty if one could."""
        if self.limits is not None or np.isfinite(self.frozen_travel).any():
            return ""
        return (
            "it has no limits, so nothing alarms but missing readings; the run's stage residuals learns them, and "
            "kit.monitor() has them"
        )

    def initial(self) -> ResidualState:
        """State before the first sample."""
        m, n = self.model, len(self.channels)
        x, h, w, y = (np.full(size, np.nan) for size in (m.n_x, m.n_h, m.n_w, m.n_y))
        recent, on = np.full((self.long, n), np.nan), np.zeros((n, 2), dtype=bool)
        runs = np.full((RUNS, m.n_x + m.n_h + m.n_d), np.nan)
        age = tuple(-self.settling - i * self.free_run // RUNS for i in range(RUNS))
        return ResidualState(x, h, w, y, recent, np.zeros(m.n_y), np.zeros(m.n_y, dtype=int), on, runs, age)

    def update(
        self, state: ResidualState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[ResidualState, ResidualReading]:
        """Take one sample; pure: the same arguments give the same result.

        Args:
            state: State after the previous sample, or :meth:`initial`.
            y: Measurement ``(n_y,)`` now; NaN where missing.
            u_prev: Input ``(n_u,)`` applied over the period that just ended.
            estimate: Estimate at this sample, of which ``x``, ``h``, ``w`` and, where it has one, ``d`` are read.

        Returns:
            The next state and the reading.
        """
        m = self.model
        y = np.array(y, dtype=np.float64).ravel()
        x, h = (np.array(values, dtype=np.float64).ravel() for values in (estimate.x, estimate.h))
        given = estimate.w if np.size(estimate.w) == m.n_w else m.w
        w, d = np.array(given, dtype=np.float64).ravel(), np.ravel(getattr(estimate, "d", ()))
        ins, outs = self._function.inputs, self._function.outputs
        for place, values in zip(ins, (state.x, state.h, u_prev, state.w, y, x, state.runs), strict=True):
            place[:] = values.ravel()
        self._function()
        moved, ahead, free = outs[1].copy(), outs[2].reshape(RUNS, -1).copy(), outs[3].reshape(RUNS, -1)
        begun = np.concatenate([x, h, d if d.size == m.n_d else np.zeros(m.n_d)])
        runs, age, error = self._turned(ahead, free, begun, state.age)
        residual = np.concatenate([outs[0], w - m.w, error])
        residual[~np.isfinite(residual)] = np.nan
        seen = min(state.seen + 1, self.settling + self.long)
        counted = residual if seen > self.settling else np.full_like(residual, np.nan)
        recent = np.vstack([state.recent[1:], counted])
        level = np.column_stack([_mean(recent[-length:]) for length in (self.short, self.long)])
        level[:, [seen < self.settling + length for length in (self.short, self.long)]] = np.nan
        on, share = self.alarms(level, state.on)
        still = (y == state.y) & np.isfinite(moved) & (seen > self.settling)
        travel = np.where(still, state.travel + moved, 0.0)
        repeats = np.where(still, state.repeats + 1, 0)
        frozen = self.frozen(y, travel, repeats)
        validity = self._validity(residual[: -m.n_y], y, u_prev, seen)
        invalid = state.invalid + 1 if validity else 0
        blind = invalid > 2 * self.short
        names = tuple(name for name, row in zip(self.channels, on, strict=True) if row.any())
        stuck = tuple(s.name for s, f in zip(m.outputs, frozen, strict=True) if f)
        following = ResidualState(x, h, w, y, recent, travel, repeats, on, runs, age, seen, invalid)
        alarm = bool(names or stuck or blind)
        return following, ResidualReading(
            residual, level, share, names, stuck, travel, repeats, alarm, validity, blind
        )

    def _turned(
        self, ahead: Array, free: Array, begun: Array, age: tuple[int, ...]
    ) -> tuple[Array, tuple[int, ...], Array]:
        """Free runs and their ages after those that are at their end, or lost, have begun anew; error of the older."""
        running = [k for k in range(RUNS) if age[k] >= 0]
        older = max(running, key=lambda k: age[k], default=None)
        error = np.full(self.model.n_y, np.nan) if older is None else free[older].copy()
        following = []
        for k, periods_ago in enumerate(age):
            now = periods_ago + 1
            lost = now > 0 and not np.isfinite(ahead[k]).all()
            if now == 0 or now >= self.free_run or lost:
                ahead[k] = begun
                now = 0 if np.isfinite(begun).all() else -1  # else try again at the next sample
            following.append(now)
        return ahead, tuple(following), error

    def frozen(self, y: Array, travel: Array, repeats: NDArray[np.int_]) -> NDArray[np.bool_]:
        """Which sensors are frozen ``(n_y,)``: from the measurement, and how far and long each repeated itself."""
        inside = (y > self.sensor_ends[0]) & (y < self.sensor_ends[1])
        return inside & (np.abs(travel) > self.frozen_travel) & (repeats > self.frozen_repeats)

    def alarms(self, level: Array, were_on: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
        """Which alarms are on at levels ``(channels, 2)``, and the largest level over its threshold."""
        if self.limits is None:
            return were_on, math.nan
        size = np.abs(np.nan_to_num(level))
        on = size > np.where(were_on, self._release, self._threshold)
        return on, float(np.max(size / self._threshold))

    def _validity(self, residual: Array, y: Array, u_prev: Array, seen: int) -> Validity:
        if np.isfinite(residual).all():
            return Validity.VALID
        if seen < 2:
            return Validity.WARM_UP
        missing = not (np.isfinite(y).all() and np.isfinite(u_prev).all())
        return Validity.MISSING if missing else Validity.NOT_FINITE


@dataclass(frozen=True)
class ResidualTrace:
    """Readings of a :class:`ResidualMonitor` along a recording of ``n`` samples.

    Args:
        t: Time [s] ``(n,)``.
        residual: ``(n, channels)`` [units of the channels].
        level: ``(n, channels, 2)``.
        share: Largest level over its threshold ``(n,)`` [-].
        on: Which channels alarm ``(n, channels)``.
        frozen: Which outputs are frozen ``(n, n_y)``.
        travel: How far outputs were predicted to move while their sensor repeated itself ``(n, n_y)``.
        repeats: For how many samples it did ``(n, n_y)``.
        alarm: Any alarm ``(n,)``.
        validity: Values of :class:`~hybrid_mpc.monitor.energy.Validity` ``(n,)``.
        channels: Names of the channels.
        outputs: Names of the outputs.
    """

    t: Array
    residual: Array
    level: Array
    share: Array
    on: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    travel: Array
    repeats: NDArray[np.int_]
    alarm: NDArray[np.bool_]
    validity: NDArray[np.int_]
    channels: tuple[str, ...]
    outputs: tuple[str, ...]

    def intervals(self) -> list[tuple[float, float]]:
        """Alarms as ``(first, last)`` [s] in the recording's own time."""
        return _intervals(self.alarm, self.t)

    def by_channel(self) -> dict[str, list[tuple[float, float]]]:
        """Alarms of each channel that had any, and of each frozen sensor as ``"NAME frozen"``."""
        every = dict(zip(self.channels, self.on.T, strict=True))
        every |= {f"{name} frozen": on for name, on in zip(self.outputs, self.frozen.T, strict=True)}
        return {name: _intervals(on, self.t) for name, on in every.items() if on.any()}

    def named(self, start: float, end: float) -> tuple[str, ...]:
        """Channels that alarm between two instants [s], in the order in which they do; frozen sensors as
        ``"NAME frozen"``.
        """
        within = (self.t >= start - 1e-9) & (self.t <= end + 1e-9)
        on = np.hstack([self.on, self.frozen])[within]
        names = (*self.channels, *(f"{name} frozen" for name in self.outputs))
        first = [int(np.argmax(column)) if column.any() else len(on) for column in on.T]
        return tuple(names[i] for i in np.argsort(first, kind="stable") if first[i] < len(on))

    def coverage(self, dt: float) -> dict[str, float]:
        """Seconds with a valid reading, and those without, by reason."""
        return {name: float(np.sum(self.validity == why)) * dt for why, name in SECONDS.items()}


def _intervals(on: NDArray[np.bool_], t: Array) -> list[tuple[float, float]]:
    return [(float(t[int(a)]), float(t[int(b)])) for a, b in alarm_intervals(on, 1.0)]


def replay_residuals(
    monitor: ResidualMonitor,
    estimator: EstimatorLike,
    recording: TrajectoryLike,
    *,
    on_sample: Callable[[int, Any], None] = lambda k, estimate: None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResidualTrace:
    """Feed a recording to the estimator and the monitor, sample by sample.

    Args:
        monitor: The monitor.
        estimator: The one that the loop uses.
        recording: With ``t`` (n,), ``y`` (n, n_y), ``u`` (n, n_u) and, where the model has measured disturbances, ``w``
            (n, n_w), on the model's grid.
        on_sample: Called with each sample's number and estimate. Default: none.
        on_progress: Called with ``(done, total)`` samples every so often. Default: none.

    Example: ``replay_residuals(kit.monitor(), kit.observer(), recording).by_channel()``
    """
    m, n = monitor.model, len(recording.t)
    state, readings, estimate, on = monitor.initial(), [], None, []
    w_all: Array | None = getattr(recording, "w", None)
    for k, y in enumerate(np.asarray(recording.y, dtype=np.float64)):
        if k % REPORTED == 0:
            on_progress(k, n)
        also: dict[str, Any] = {} if not m.n_w or w_all is None else {"w": w_all[k]}
        u_prev = recording.u[k - 1] if k else np.full(m.n_u, np.nan)
        if estimate is None:
            estimate = estimator.start(y, float(recording.t[0]), **also)
        else:
            estimate = estimator.update(estimate, y, u_prev, **also)
        state, reading = monitor.update(state, y, u_prev, estimate)
        readings.append(reading)
        on.append(state.on.any(axis=1))
        on_sample(k, estimate)
    on_progress(n, n)
    outputs = tuple(s.name for s in m.outputs)
    columns = {
        name: np.array([getattr(r, name) for r in readings])
        for name in ("residual", "level", "share", "travel", "repeats", "alarm", "validity")
    }
    return ResidualTrace(
        np.asarray(recording.t, dtype=np.float64), on=np.array(on),
        frozen=np.array([[name in r.frozen_outputs for name in outputs] for r in readings]),
        channels=monitor.channels, outputs=outputs, **columns,
    )  # fmt: skip


def with_alarms(monitor: ResidualMonitor, trace: ResidualTrace, y: Array) -> ResidualTrace:
    """A trace with the alarms of ``monitor``'s limits; ``y`` ``(n, n_y)`` are its measurements.

    Residuals do not depend on limits, so nothing is replayed.
    """
    rows, frozen = [], []
    on = np.zeros((len(monitor.channels), 2), dtype=bool)
    shares = []
    for level, travel, repeats, measured in zip(trace.level, trace.travel, trace.repeats, y, strict=True):
        on, share = monitor.alarms(level, on)
        rows.append(on.any(axis=1))
        shares.append(share)
        frozen.append(monitor.frozen(measured, travel, repeats))
    found, stuck = np.array(rows), np.array(frozen)
    blind = trace.alarm & ~trace.on.any(axis=1) & ~trace.frozen.any(axis=1)
    alarm = found.any(axis=1) | stuck.any(axis=1) | blind
    return replace(trace, share=np.array(shares), on=found, frozen=stuck, alarm=alarm)


def learn_residuals(
    model: HybridModel,
    estimator: EstimatorLike,
    recordings: Iterable[TrajectoryLike],
    *,
    false_alarms_per_hour: float | Sequence[float] = 1.0,
    nominal: Sequence[NDArray[np.bool_]] | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResidualLimits:
    """Limits of a :class:`ResidualMonitor` from recordings in which nothing is wrong.

    Each channel and length has its share of the wanted rate. Its threshold is the level that nominal ones pass so often
    (:func:`~hybrid_mpc.monitor.calibrate.calibrate`, extreme values); where the recordings are too short for that,
    half as much again as the highest of them, and ``method`` says so.

    Args:
        model: The model.
        estimator: The one that the loop will use.
        recordings: With ``t``, ``y``, ``u`` and, where the model has disturbances, ``w``, on the model's grid.
        false_alarms_per_hour: Wanted rate [1/h] of all alarms together; of several, in rising order, the first that the
            recordings are long enough for in every channel. Default 1.
        nominal: Which samples of each recording count, ``(n,)`` each. Default: all behind the first of the machine's
            seconds, in which the estimator settles.
        on_progress: Called with ``(done, total)`` samples as the replays go on. Default: not at all.

    Raises:
        InputError: If the recordings leave nothing behind their beginning, or a channel has no residual in them.
    """
    monitor, given = ResidualMonitor(model), list(recordings)
    total, before = sum(len(r.t) for r in given), 0
    traces = []
    for recording in given:
        start = before

        def say(done: int, own: int, start: int = start) -> None:
            on_progress(start + done, total)

        traces.append(replay_residuals(monitor, estimator, recording, on_progress=say))
        before += len(recording.t)
    return limits_of(monitor, given, traces, false_alarms_per_hour=false_alarms_per_hour, nominal=nominal)


def limits_of(
    monitor: ResidualMonitor,
    recordings: Sequence[TrajectoryLike],
    traces: Sequence[ResidualTrace],
    *,
    false_alarms_per_hour: float | Sequence[float] = 1.0,
    nominal: Sequence[NDArray[np.bool_]] | None = None,
) -> ResidualLimits:
    """The limits of :func:`learn_residuals` from the ``traces`` of the ``recordings`` by a monitor without limits."""
    model, levels, travels, repeats = monitor.model, [], [], []
    for i, trace in enumerate(traces):
        counts = np.ones(len(trace.t), dtype=bool) if nominal is None else np.array(nominal[i])
        counts[: monitor.settling] = False
        levels.append(np.where(counts[:, None, None], np.abs(trace.level), np.nan))
        travels.append(np.abs(trace.travel[counts]))
        repeats.append(trace.repeats[counts])
    seconds = float(sum(np.isfinite(run[:, 0, 0]).sum() for run in levels)) * model.dt
    if not seconds:
        raise InputError(
            f"learn_residuals: no recording is longer than the {monitor.settling * model.dt:g} s that the estimator "
            "settles in"
        )
    far, often = _freezing(model, recordings, np.concatenate(travels), np.concatenate(repeats))
    for rate in np.atleast_1d(false_alarms_per_hour).tolist():
        threshold, release, short = _thresholds(monitor, levels, rate)
        if not short:
            break
    return ResidualLimits(
        monitor.channels, model.dt, _pairs(threshold), _pairs(release), far, often, rate, seconds / 3600,
        f"{MARGIN} x the highest nominal level ({short})" if short else "extreme values of blocks", not short,
    )  # fmt: skip


def _thresholds(monitor: ResidualMonitor, levels: Sequence[Array], rate: float) -> tuple[Array, Array, str]:
    """Thresholds and releases ``(channels, 2)`` for a rate, and why extreme values do not tell them all."""
    model, n = monitor.model, len(monitor.channels)
    first_w = model.n_y + len(model.balances)
    each, block = rate / (2 * n), block_seconds(model.dt, model.time_unit)
    threshold, release, short = np.empty((n, 2)), np.empty((n, 2)), ""
    for i, j in np.ndindex(n, 2):
        runs = [run[:, i, j] for run in levels]
        finite = np.concatenate(runs)
        finite = finite[np.isfinite(finite)]
        if first_w <= i < first_w + model.n_w and not (finite.size and finite.max() > 0):
            threshold[i, j] = release[i, j] = math.inf
            continue
        if not (finite.size and finite.max() > 0):
            raise InputError(
                f"learn_residuals: {monitor.channels[i]} has no residual in the recordings that is not zero"
            )
        try:
            found = calibrate(runs, model.dt, false_alarms_per_hour=each, block_s=block)
            assert found.threshold_w is not None
            assert found.release_w is not None
            threshold[i, j], release[i, j] = found.threshold_w, found.release_w
        except InputError as error:
            short = str(error)
            threshold[i, j] = MARGIN * float(finite.max())
            release[i, j] = max(0.5 * float(threshold[i, j]), float(np.quantile(finite, 0.95)))
    return threshold, release, short


def _freezing(
    model: HybridModel, recordings: Sequence[TrajectoryLike], travel: Array, repeats: NDArray[np.int_]
) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """How far outputs may be predicted to move, and for how many samples, while their sensor repeats itself: beyond
    what nominal data have, and three of the sensor's steps.

    The step is that of an even error as large as the sensor's noise, and no less than the smallest change recorded.
    Repetitions of what is not predicted to move by a step are those of a machine at rest.
    """
    found = []
    for i, (signal, noise) in enumerate(zip(model.outputs, noise_of(recordings).tolist(), strict=True)):
        changes = np.concatenate([np.abs(np.diff(r.y[:, i])) for r in recordings])
        changes = changes[changes > 0]
        if not changes.size:
            raise InputError(f"learn_residuals: {signal.name} never changes in the recordings")
        step, moved = max(math.sqrt(12.0) * noise, float(changes.min())), np.abs(travel[:, i])
        most = int(np.max(repeats[moved > step, i], initial=0))
        found.append((max(MARGIN * float(moved.max()), FROZEN_STEPS * step), math.ceil(MARGIN * most)))
    return tuple(far for far, _ in found), tuple(count for _, count in found)


def _pairs(values: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(short), float(long)) for short, long in values)


def _residuals(model: HybridModel) -> ca.Function:
    """``(x, h, u, w, y, x_hat, runs) -> residuals of outputs and balances, predicted changes of the outputs, free runs
    a period on, and their errors``; ``x`` and ``h`` of a period ago.
    """
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    w, y, x_hat = ca.MX.sym("w", model.n_w), ca.MX.sym("y", model.n_y), ca.MX.sym("x_hat", model.n_x)
    x_next, _ = model.step(x, h, u, w, model.p)
    predicted = model.output(x_next, u, w, model.p)
    r = (x_hat - x_next) / model.dt
    none = ca.MX.zeros(model.n_x)
    violations = [
        b.residual(x, r, u, w, model.p) - b.residual(x, none, u, w, model.p) for b in model.balances
    ]
    moved = predicted - model.output(x, u, w, model.p)
    n_z = model.n_x + model.n_h
    runs, ahead, errors = ca.MX.sym("runs", n_z + model.n_d, RUNS), [], []
    on_u, on_x, on_y = (ca.DM(matrix) for matrix in model.disturbed)
    for k in range(RUNS):
        x_k, h_k, d = ca.vertsplit(runs[:, k], [0, model.n_x, n_z, n_z + model.n_d])
        acting = u + on_u @ d
        x_k, h_k = model.step(x_k, h_k, acting, w, model.p)
        x_k += on_x @ d
        ahead.append(ca.vertcat(x_k, h_k, d))
        errors.append(y - model.output(x_k, acting, w, model.p) - on_y @ d)
    outs = [ca.vertcat(y - predicted, *violations), moved, ca.vertcat(*ahead), ca.vertcat(*errors)]
    return ca.Function("residuals", [x, h, u, w, y, x_hat, runs], [ca.densify(values) for values in outs])


def _mean(rows: Array) -> Array:
    """Mean of each column without NaN; NaN where fewer than half are numbers."""
    finite = np.isfinite(rows)
    count = finite.sum(axis=0)
    total = np.where(finite, rows, 0.0).sum(axis=0)
    return np.where(2 * count >= len(rows), total / np.maximum(count, 1), np.nan)
