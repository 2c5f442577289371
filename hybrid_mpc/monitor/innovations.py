"""The monitor of any machine: what its model does not explain of every output and of every balance."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.data.scales import COARSEST
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.monitor.calibrate import calibrate
from hybrid_mpc.monitor.energy import FROZEN_STEPS, Validity
from hybrid_mpc.monitor.lengths import block_seconds
from hybrid_mpc.monitor.replay import EstimatorLike, TrajectoryLike

Array = NDArray[np.float64]
SHORT_S, LONG_S = 0.3, 3.0
"""Lengths of the two averages [the machine's seconds]: one is soon there, one shows what is small and lasts."""
SETTLING_S = 3.0
"""Beginning of a recording that nothing is learned from [the machine's seconds]: the estimator does not know the states
yet."""
MARGIN = 1.5
"""Where nominal data are too short for a rate: threshold over the highest nominal level."""


@dataclass(frozen=True)
class ResidualLimits:
    """Thresholds of a :class:`ResidualMonitor`, learned from recordings in which nothing is wrong.

    Args:
        channels: Names of the residuals: the outputs, then the balances.
        dt: Period [s] they were learned at.
        threshold: Levels ``(channels, 2)`` above which an alarm starts, of the short and of the long average [units of
            the channels].
        release: Levels below which it ends.
        false_alarms_per_hour: Wanted rate [1/h] of all alarms together.
        hours: Duration of the recordings [h].
        method: How they were found.

    Raises:
        InputError: If the sizes differ, or a number is not positive.
    """

    channels: tuple[str, ...]
    dt: float
    threshold: tuple[tuple[float, float], ...]
    release: tuple[tuple[float, float], ...]
    false_alarms_per_hour: float
    hours: float
    method: str = ""

    def __post_init__(self) -> None:
        sides = np.array(self.threshold, dtype=float), np.array(self.release, dtype=float)
        if any(a.shape != (len(self.channels), 2) or not np.all(a > 0) for a in sides):
            raise InputError(
                f"limits of residuals: {len(self.channels)} channels need two positive thresholds and releases each, "
                f"got {self.threshold} and {self.release}"
            )


@dataclass(frozen=True)
class ResidualState:
    """All that the monitor remembers, never changed in place.

    Args:
        x: The latest estimate's state ``(n_x,)``; ``h`` its hidden state, ``w`` its disturbances; NaN before the first.
        y: The latest measurement ``(n_y,)``.
        recent: The latest residuals ``(long, channels)``, NaN until there are any and where something was missing.
        travel: How far each output was predicted to move since its sensor last moved ``(n_y,)``.
        on: Which alarms are on ``(channels, 2)``.
        seen: Samples taken, up to the long average's.
        invalid: Samples in a row without a valid reading.
    """

    x: Array
    h: Array
    w: Array
    y: Array
    recent: Array
    travel: Array
    on: NDArray[np.bool_]
    seen: int = 0
    invalid: int = 0


@dataclass(frozen=True)
class ResidualReading:
    """What the monitor says of the period that just ended.

    Args:
        residual: Of each output what was measured less what was predicted a period before [its unit], then of each
            balance what the estimate's change does not fulfil [its unit of rate] ``(channels,)``; NaN where unknown.
        level: Means of the latest residuals over both lengths ``(channels, 2)`` [units of the channels], with sign.
        share: The largest level over its threshold [-]; NaN without limits.
        channels: Names of the channels that alarm.
        frozen_outputs: Names of the outputs whose sensor repeats itself while the model predicts that they move.
        alarm: True while any channel alarms, a sensor is frozen, or the monitor is blind.
        validity: Whether this reading is valid, and if not, why.
        blind: True while no reading has been valid for twice the short average.
    """

    residual: Array
    level: Array
    share: float
    channels: tuple[str, ...]
    frozen_outputs: tuple[str, ...]
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

    One step of the model from the estimate of a period ago, under the input that acted and without the estimated
    disturbance, predicts the outputs; what was measured instead is the residual of each **output**. What the estimate
    has become instead, over the period, is a rate that the model does not explain, ``r = (x_hat - x_predicted) / dt``.
    It holds the correction by the measurement, and what a disturbance observer takes for a load: so a constant load
    shows as long as it is there. Of each **balance** the residual is ``dS/dx r`` [its unit of rate], for a mechanical
    prior the power that the machine has and the model has not.

    **Levels** are means over two lengths. An alarm starts where one passes the threshold of its channel, and its
    channel is named. **Frozen sensor**, with ``resolution``: an output repeats itself exactly while the model's own
    predictions of it add up to more than three of the sensor's steps. A sensor at an end of its range is not frozen.

    For a mechanical model whose positions are measured :class:`~hybrid_mpc.monitor.energy.EnergyMonitor` sees more: it
    knows dry friction. Not for several threads at once (it reuses its buffers).

    Args:
        model: The model that is compared with the machine.
        limits: Thresholds, of :func:`learn_residuals`. Default: none, then only a frozen sensor and blindness alarm.
        resolution: Step of each sensor ``(n_y,)`` [output units]. Default: unknown, no test for freezing.

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
        >>> reading.residual.round(6).tolist()
        [0.2]
    """

    def __init__(
        self, model: HybridModel, *, limits: ResidualLimits | None = None, resolution: ArrayLike | None = None
    ) -> None:
        self.model, self.limits = model, limits
        self.channels = (*(s.name for s in model.outputs), *(b.name for b in model.balances))
        self.units = (*(s.unit for s in model.outputs), *(b.rate_unit for b in model.balances))
        if limits is not None and (
            limits.channels != self.channels or abs(limits.dt - model.dt) > 1e-9 * model.dt
        ):
            raise InputError(
                f"residual monitor: the limits are of {limits.channels} at {limits.dt} s, the model {model.name} has "
                f"{self.channels} at {model.dt} s; learn them anew with learn_residuals"
            )
        self._resolution = np.full(model.n_y, np.inf)
        if resolution is not None:
            steps = np.asarray(resolution, dtype=float).ravel()
            if steps.shape != (model.n_y,) or not np.all(steps > 0):
                raise InputError(
                    f"residual monitor: resolution needs {model.n_y} positive steps, got {steps.tolist()}"
                )
            self._resolution = steps
        unit = max(model.time_unit, COARSEST * model.dt)
        self.short, self.long = (max(1, round(length * unit / model.dt)) for length in (SHORT_S, LONG_S))
        ends = [s.saturation or (-np.inf, np.inf) for s in model.outputs]
        self._ends = np.array(ends, dtype=float).T
        self._function = BufferedFunction(_residuals(model))

    def initial(self) -> ResidualState:
        """State before the first sample."""
        m, n = self.model, len(self.channels)
        x, h, w, y = (np.full(size, np.nan) for size in (m.n_x, m.n_h, m.n_w, m.n_y))
        recent, on = np.full((self.long, n), np.nan), np.zeros((n, 2), dtype=bool)
        return ResidualState(x, h, w, y, recent, np.zeros(m.n_y), on)

    def update(
        self, state: ResidualState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[ResidualState, ResidualReading]:
        """Take one sample; pure: the same arguments give the same result.

        Args:
            state: State after the previous sample, or :meth:`initial`.
            y: Measurement ``(n_y,)`` now; NaN where missing.
            u_prev: Input ``(n_u,)`` applied over the period that just ended.
            estimate: Estimate at this sample, of which ``x``, ``h`` and ``w`` are read.

        Returns:
            The next state and the reading.
        """
        y = np.array(y, dtype=np.float64).ravel()
        x, h = (np.array(values, dtype=np.float64).ravel() for values in (estimate.x, estimate.h))
        w = np.array(
            estimate.w if np.size(estimate.w) == self.model.n_w else self.model.w, dtype=np.float64
        ).ravel()
        ins, outs = self._function.inputs, self._function.outputs
        given = state.x, state.h, u_prev, state.w, y, x
        for place, values in zip(ins, given, strict=True):
            place[:] = values
        self._function()
        residual, moved = outs[0].copy(), outs[1].copy()
        residual[~np.isfinite(residual)] = np.nan
        recent = np.vstack([state.recent[1:], residual])
        level = np.column_stack([_mean(recent[-self.short :]), _mean(recent)])
        on, share = self._alarms(level, state.on)
        travel = np.where((y == state.y) & np.isfinite(moved), state.travel + moved, 0.0)
        inside = (y > self._ends[0]) & (y < self._ends[1])
        frozen = inside & (np.abs(travel) > FROZEN_STEPS * self._resolution)
        seen = min(state.seen + 1, self.long)
        validity = self._validity(residual, y, u_prev, seen)
        invalid = state.invalid + 1 if validity else 0
        blind = invalid > 2 * self.short
        names = tuple(name for name, row in zip(self.channels, on, strict=True) if row.any())
        still = tuple(s.name for s, f in zip(self.model.outputs, frozen, strict=True) if f)
        following = ResidualState(x, h, w, y, recent, travel, on, seen, invalid)
        alarm = bool(names or still or blind)
        return following, ResidualReading(residual, level, share, names, still, alarm, validity, blind)

    def _alarms(self, level: Array, were_on: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
        """Which alarms are on, and the largest level over its threshold."""
        if self.limits is None:
            return were_on, math.nan
        size = np.abs(np.nan_to_num(level))
        threshold, release = np.array(self.limits.threshold), np.array(self.limits.release)
        return size > np.where(were_on, release, threshold), float(np.max(size / threshold))

    def _validity(self, residual: Array, y: Array, u_prev: Array, seen: int) -> Validity:
        if np.isfinite(residual).all():
            return Validity.VALID
        if seen < 2:
            return Validity.WARM_UP
        missing = not (np.isfinite(y).all() and np.isfinite(u_prev).all())
        return Validity.MISSING if missing else Validity.NOT_FINITE


def learn_residuals(
    model: HybridModel,
    estimator: EstimatorLike,
    recordings: Iterable[TrajectoryLike],
    *,
    false_alarms_per_hour: float = 1.0,
) -> ResidualLimits:
    """Limits of a :class:`ResidualMonitor` from recordings in which nothing is wrong.

    Each channel and length has its share of the wanted rate. Its threshold is the level that nominal ones pass so often
    (:func:`~hybrid_mpc.monitor.calibrate.calibrate`, extreme values); where the recordings are too short for that,
    half as much again as the highest of them, and ``method`` says so.

    Args:
        model: The model.
        estimator: The one that the loop will use.
        recordings: With ``t``, ``y``, ``u`` and, where the model has disturbances, ``w``, on the model's grid.
        false_alarms_per_hour: Wanted rate [1/h] of all alarms together. Default 1.

    Raises:
        InputError: If the recordings leave nothing behind their beginning, or a channel has no residual in them.
    """
    monitor = ResidualMonitor(model)
    unit = max(model.time_unit, COARSEST * model.dt)
    skipped, n = max(1, round(SETTLING_S * unit / model.dt)), len(monitor.channels)
    runs = [np.abs(levels_along(monitor, estimator, r)[skipped:]) for r in recordings]
    runs = [run for run in runs if len(run)]
    if not runs:
        raise InputError(
            f"learn_residuals: no recording is longer than the {skipped * model.dt:g} s that the estimator settles in"
        )
    rate, block = false_alarms_per_hour / (2 * n), block_seconds(model.dt, model.time_unit)
    threshold, release, short = np.empty((n, 2)), np.empty((n, 2)), ""
    for i, j in np.ndindex(n, 2):
        levels = [run[:, i, j] for run in runs]
        finite = np.concatenate(levels)
        finite = finite[np.isfinite(finite)]
        if not (finite.size and finite.max() > 0):
            raise InputError(
                f"learn_residuals: {monitor.channels[i]} has no residual in the recordings that is not zero"
            )
        try:
            found = calibrate(levels, model.dt, false_alarms_per_hour=rate, block_s=block)
            assert found.threshold_w is not None
            assert found.release_w is not None
            threshold[i, j], release[i, j] = found.threshold_w, found.release_w
        except InputError as error:
            short = str(error)
            threshold[i, j] = MARGIN * float(finite.max())
            release[i, j] = max(0.5 * float(threshold[i, j]), float(np.quantile(finite, 0.95)))
    seconds = sum(len(run) for run in runs) * model.dt
    method = f"{MARGIN} x the highest nominal level ({short})" if short else "extreme values of blocks"
    return ResidualLimits(
        monitor.channels,
        model.dt,
        _pairs(threshold),
        _pairs(release),
        false_alarms_per_hour,
        seconds / 3600,
        method,
    )


def _pairs(values: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(short), float(long)) for short, long in values)


def levels_along(monitor: ResidualMonitor, estimator: EstimatorLike, recording: TrajectoryLike) -> Array:
    """Levels ``(n, channels, 2)`` along a recording."""
    state, levels, estimate = monitor.initial(), [], None
    w_all: Array | None = getattr(recording, "w", None)
    for k, y in enumerate(np.asarray(recording.y, dtype=np.float64)):
        also: dict[str, Any] = {} if not monitor.model.n_w or w_all is None else {"w": w_all[k]}
        u_prev = recording.u[k - 1] if k else np.full(monitor.model.n_u, np.nan)
        if estimate is None:
            estimate = estimator.start(y, float(recording.t[0]), **also)
        else:
            estimate = estimator.update(estimate, y, u_prev, **also)
        state, reading = monitor.update(state, y, u_prev, estimate)
        levels.append(reading.level)
    return np.array(levels)


def _residuals(model: HybridModel) -> ca.Function:
    """``(x, h, u, w, y, x_hat) -> residuals, predicted changes of the outputs``; ``x`` and ``h`` of a period ago."""
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
    outs = [ca.densify(ca.vertcat(y - predicted, *violations)), ca.densify(moved)]
    return ca.Function("residuals", [x, h, u, w, y, x_hat], outs)


def _mean(rows: Array) -> Array:
    """Mean of each column without NaN; NaN where fewer than half are numbers."""
    finite = np.isfinite(rows)
    count = finite.sum(axis=0)
    total = np.where(finite, rows, 0.0).sum(axis=0)
    return np.where(2 * count >= len(rows), total / np.maximum(count, 1), np.nan)
