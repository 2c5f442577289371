"""The energy monitor: how far the model's power balance lies from the measured one, online."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.calibration import Calibration

Array = NDArray[np.float64]


class EstimateLike(Protocol):
    """What the monitor reads of an estimate: ``x`` (n_x,) and ``h`` (n_h,). It ignores ``d``."""

    @property
    def x(self) -> Any:
        """Estimated state ``(n_x,)``."""

    @property
    def h(self) -> Any:
        """Hidden state ``(n_h,)`` before this sample's input."""


@dataclass(frozen=True)
class MonitorState:
    """All that the monitor remembers. Never changed in place.

    Args:
        memory: Past measurements, model increments and inputs of the window, in one vector; NaN until filled.
        x: Estimated state ``(n_x,)`` at the latest sample.
        h: Hidden state ``(n_h,)`` at the latest sample.
        violations: The latest ``average`` violations [W]; NaN where there was none.
        residuals: The latest ``average`` residual forces ``(average, n_q)``; NaN where there was none.
        alarms: True while the alarm on the violation, and the one on the residual force, is on.
    """

    memory: Array
    x: Array
    h: Array
    violations: Array
    residuals: Array
    alarms: tuple[bool, bool]


@dataclass(frozen=True)
class MonitorReading:
    """One reading. It speaks of the window's centre, ``EnergyMonitor.delay`` before this sample.

    Args:
        dE_model_w: Energy balance [W] with the model's acceleration.
        dE_measured_w: Energy balance [W] with the measured acceleration, at the same state.
        violation_w: ``|dE_model_w - dE_measured_w|`` [W].
        level_w: Mean violation [W] over the last ``average`` samples.
        residual: Force that the model does not explain ``(n_q,)`` [N m for an angle, N for a length]; what
            sticking friction may hold is taken off near rest.
        residual_level: Length of the mean residual over the last ``average`` samples.
        alarm: True while either alarm is on; always False without a calibration.
    """

    dE_model_w: float
    dE_measured_w: float
    violation_w: float
    level_w: float
    residual: Array
    residual_level: float
    alarm: bool


class EnergyMonitor:
    """Compares the model's power balance with the measured one, causally.

    Measured side: a cubic through the last ``window`` samples of ``y`` (least squares) gives position,
    velocity and acceleration at the window's centre. That acceleration is a weighted mean of the true
    one, ``sum_i w_i y_i = int K(s) a(s) ds``, where the Peano kernel ``K(s) = sum_{t_i > s} w_i (t_i - s)``
    has unit area and is linear between samples. The model's acceleration is averaged with the same ``K``:
    one step from every estimate ``(x_hat_i, h_i)`` under the input applied there gives
    ``dv = int a ds`` and ``dp = int (t_{i+1} - s) a ds``, hence exactly
    ``int K a ds = K_{i+1} dv - K' dp`` in every period. So steps of the input, however large, raise no
    violation; the estimated disturbance ``d`` is left out, since it would hide the fault.

    Both balances take the state ``[q, v]`` of the cubic and the input averaged with ``K``. At equal state
    the other terms cancel: the violation is ``J |v| |a_model - a_measured|`` (one degree of freedom), where
    ``a_model`` is a mean over each period's own step, so a model error acts as it would in a prediction.
    The other terms of each single balance are taken at the centre, not averaged.

    At rest the violation is zero, whatever the forces do. Beside it stands the residual force
    ``M (a_measured - a_model)`` with the inertia ``M`` that the energy balance holds. Near rest friction may
    be anything up to ``F``, half the jump of the model's acceleration times ``M`` between ``-rest_speed``
    and ``rest_speed``: only what exceeds this dead band counts there; it closes linearly up to twice the
    speed. So a hand that holds the machine still shows, and sticking friction does not.

    A missing (NaN) measurement gives NaN readings until it has left the window. The level is the mean of
    the finite ones of the last ``average`` violations, NaN (and no alarm) while fewer than half are finite.
    Positions must count on through full turns. Not for several threads at once (it reuses its buffers).

    Args:
        model: Model whose outputs are its positions ``q`` (state ``[q, v]``).
        window: Samples in the local polynomial, odd, at least 5.
        average: Samples in the moving average of the level.
        calibration: Thresholds of the alarm. Default: none, then there is no alarm.
        rest_speed: Speed [unit of v] below which friction may stick. Default 0.2.

    Raises:
        InputError: If the window or average is unfit, or the outputs are not the positions.

    Source: energy balance and violation of the paper (energy objective, powers in W); Savitzky and Golay
    (1964) for the polynomial; Peano kernel theorem for the weighting.

    Example:
        >>> from hybrid_mpc.signals import Signal
        >>> x, h, u, w = ca.MX.sym("x", 2), ca.MX.sym("h", 0), ca.MX.sym("u"), ca.MX.sym("w", 2)
        >>> model = HybridModel(
        ...     "cart", 0.1, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        ...     step=ca.Function("f", [x, h, u], [x + 0.1 * ca.vertcat(x[1] + 0.05 * u, u), h]),
        ...     xdot=ca.Function("g", [x, h, u], [ca.vertcat(x[1], u)]),
        ...     output=ca.Function("y", [x, u], [x[0]]),
        ...     energy_balance=ca.Function("e", [x, w, u], [(w[1] - u) * x[1]]))
        >>> monitor = EnergyMonitor(model, window=5, average=2)
        >>> round(monitor.delay, 6)
        0.2
    """

    def __init__(
        self,
        model: HybridModel,
        *,
        window: int,
        average: int,
        calibration: Calibration | None = None,
        rest_speed: float = 0.2,
    ) -> None:
        _check(model, window, average, rest_speed)
        self.model = model
        self.window = window
        self.average = average
        self.calibration = calibration
        self._function = _reading_function(model, window, rest_speed)
        sizes_in = [self._function.size1_in(i) for i in range(5)]
        sizes_out = [self._function.size1_out(i) for i in range(3)]
        self._ins = [np.zeros(n) for n in sizes_in]
        self._outs = [np.zeros(n) for n in sizes_out]
        buffer: Any
        buffer, self._evaluate = self._function.buffer()
        for i, array in enumerate(self._ins):
            buffer.set_arg(i, memoryview(array.data))
        for i, array in enumerate(self._outs):
            buffer.set_res(i, memoryview(array.data))
        self._buffer = buffer

    @property
    def delay(self) -> float:
        """Time [s] from the moment a violation speaks of to the sample at which it is read."""
        return 0.5 * (self.window - 1) * self.model.dt

    def initial(self) -> MonitorState:
        """State before the first sample."""
        model = self.model
        return MonitorState(
            np.full(self._ins[0].size, np.nan),
            np.full(model.n_x, np.nan),
            np.full(model.n_h, np.nan),
            np.full(self.average, np.nan),
            np.full((self.average, model.n_x // 2), np.nan),
            (False, False),
        )

    def update(
        self, state: MonitorState, y: Array, u_prev: Array, estimate: EstimateLike
    ) -> tuple[MonitorState, MonitorReading]:
        """Take one sample; pure: the same arguments give the same result.

        Args:
            state: State after the previous sample, or :meth:`initial`.
            y: Measurement ``(n_y,)`` now; NaN where missing.
            u_prev: Input ``(n_u,)`` applied over the period that just ended.
            estimate: Estimate at this sample, with ``x`` ``(n_x,)`` and ``h`` ``(n_h,)``.

        Returns:
            The next state and the reading.

        Raises:
            InputError: If a shape does not fit the model.
        """
        y, u_prev = np.asarray(y, dtype=np.float64), np.asarray(u_prev, dtype=np.float64)
        x, h = np.array(estimate.x, dtype=np.float64), np.array(estimate.h, dtype=np.float64)
        model = self.model
        sizes = y.size, u_prev.size, x.size, h.size
        if sizes != (model.n_y, model.n_u, model.n_x, model.n_h):
            raise InputError(
                f"monitor of model {model.name}: y, u_prev, x, h have {sizes} entries, "
                f"the model needs {(model.n_y, model.n_u, model.n_x, model.n_h)}"
            )
        ins = self._ins
        for target, value in zip(ins, (state.memory, state.x, state.h, u_prev, y), strict=True):
            target[:] = value.reshape(-1)
        self._evaluate()
        memory, (de_model, de_measured), residual = (out.copy() for out in self._outs)
        violation = abs(float(de_model - de_measured))
        violations, residuals = _push(state.violations, violation), _push(state.residuals, residual)
        level = float(_mean_of_finite(violations))
        residual_level = float(np.linalg.norm(_mean_of_finite(residuals)))
        alarms = self.alarms(level, residual_level, state.alarms)
        following = MonitorState(memory, x.reshape(-1), h.reshape(-1), violations, residuals, alarms)
        return following, MonitorReading(
            float(de_model), float(de_measured), violation, level, residual, residual_level, any(alarms)
        )

    def alarms(self, level: float, residual_level: float, were_on: tuple[bool, bool]) -> tuple[bool, bool]:
        """Whether power and residual alarm at these levels [W], [N m], after having been on or not."""
        c = self.calibration
        if c is None:
            return False, False
        power = level > (c.release_w if were_on[0] else c.threshold_w)
        if c.residual_threshold is None or c.residual_release is None:
            return power, False
        return power, residual_level > (c.residual_release if were_on[1] else c.residual_threshold)


def _push(values: Array, latest: Any) -> Array:
    following = np.empty_like(values)
    following[:-1], following[-1] = values[1:], latest
    return following


def _mean_of_finite(values: Array) -> Any:
    """Mean along the first axis of the rows without NaN; NaN where fewer than half are."""
    total = values.sum(axis=0)
    if np.isfinite(total).all():
        return total / len(values)
    finite = values[np.isfinite(values.reshape(len(values), -1)).all(axis=1)]
    return finite.mean(axis=0) if len(finite) and 2 * len(finite) >= len(values) else total * np.nan


def _weights(window: int, dt: float) -> tuple[Array, Array, Array, Array, Array]:
    """Weights of position, velocity, acceleration, and the Peano kernel at nodes with its slopes."""
    s = (np.arange(window) - 0.5 * (window - 1)) * dt
    scale = s[-1]
    fit = np.linalg.pinv(np.vander(s / scale, 4, increasing=True))
    position, velocity, acceleration = fit[0], fit[1] / scale, 2.0 * fit[2] / scale**2
    kernel = np.maximum(s[None, :] - s[:, None], 0.0) @ acceleration
    return position, velocity, acceleration, kernel, np.diff(kernel) / dt


def _inertia(model: HybridModel, x: ca.MX, u: ca.MX) -> ca.MX:
    """Inertia matrix ``M(q)`` of the energy balance, which is ``v' M a`` plus terms without ``a``."""
    n_q = model.n_x // 2
    a, rows = ca.MX.sym("a", n_q), []
    for i in range(n_q):
        v = ca.DM.zeros(n_q)
        v[i] = 1.0
        state, rate = ca.vertcat(x[:n_q], v), ca.vertcat(v, a)
        rows.append(ca.jacobian(model.energy_balance(state, rate, u), a))
    return ca.graph_substitute(ca.vertcat(*rows), [a], [ca.MX.zeros(n_q)])


def _residual(
    model: HybridModel, a_measured: ca.MX, a_model: ca.MX, x: ca.MX, h: ca.MX, u: ca.MX, rest_speed: float
) -> ca.MX:
    """Force ``(n_q,)`` that the model does not explain; near rest, what friction could not hold either."""
    n_q = model.n_x // 2
    inertia, speed = _inertia(model, x, u), rest_speed * ca.DM.ones(n_q)
    back, forth = (model.xdot(ca.vertcat(x[:n_q], s), h, u)[n_q:] for s in (-speed, speed))
    friction = ca.fmax(0, 0.5 * inertia @ (back - forth))
    held = inertia @ (a_measured - 0.5 * (back + forth))  # friction of either direction taken out
    held = ca.sign(held) * ca.fmax(0, ca.fabs(held) - friction)
    near = ca.fmax(0, ca.fmin(1, 2 - ca.fabs(x[n_q:]) / rest_speed))
    return near * held + (1 - near) * (inertia @ (a_measured - a_model))


def _reading_function(model: HybridModel, window: int, rest_speed: float) -> ca.Function:
    """``(memory, x_prev, h_prev, u_prev, y) -> (memory_next, [dE_model, dE_measured], residual)``."""
    n_q, n_u, dt = model.n_x // 2, model.n_u, model.dt
    position, velocity, acceleration, kernel, slope = _weights(window, dt)
    row = 2 * n_q + n_u
    memory = ca.MX.sym("memory", window * n_q + (window - 1) * row)
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", n_u)
    y = ca.MX.sym("y", n_q)
    x_next = model.step(x, h, u)[0]
    dv = x_next[n_q:] - x[n_q:]
    dp = x_next[:n_q] - x[:n_q] - dt * x[n_q:]
    ys = ca.vertcat(memory[n_q : window * n_q], y)
    rows = ca.vertcat(memory[window * n_q + row :], dv, dp, u)
    y_grid, row_grid = ca.reshape(ys, n_q, window), ca.reshape(rows, row, window - 1)
    # Positions relative to the newest: after many turns the small differences keep their digits.
    relative = y_grid - ca.repmat(y, 1, window)
    q, v, a_measured = (relative @ ca.DM(w) for w in (position, velocity, acceleration))
    a_model = row_grid[:n_q, :] @ ca.DM(kernel[1:]) - row_grid[n_q : 2 * n_q, :] @ ca.DM(slope)
    u_mean = row_grid[2 * n_q :, :] @ ca.DM(0.5 * dt * (kernel[:-1] + kernel[1:]))
    state = ca.vertcat(q + y, v)
    balances = [model.energy_balance(state, ca.vertcat(v, a), u_mean) for a in (a_model, a_measured)]
    residual = _residual(model, a_measured, a_model, state, h, u_mean, rest_speed)
    outs = [ca.vertcat(ys, rows), ca.vertcat(*balances), residual]
    return ca.Function("monitor", [memory, x, h, u, y], [ca.densify(out) for out in outs])


def _check(model: HybridModel, window: int, average: int, rest_speed: float) -> None:
    if not rest_speed > 0:
        raise InputError(f"energy monitor: rest_speed must be positive, got {rest_speed}")
    if window < 5 or window % 2 == 0:
        raise InputError(f"energy monitor: window must be an odd number of at least 5 samples, got {window}")
    if average < 1:
        raise InputError(f"energy monitor: average must be at least 1 sample, got {average}")
    n_q = model.n_x // 2
    x, u = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    jacobian = ca.Function("C", [x, u], [ca.jacobian(model.output(x, u), ca.vertcat(x, u))])
    given = np.array(jacobian(0, 0).full())
    if given.shape[0] != n_q or not np.array_equal(given, np.eye(n_q, model.n_x + model.n_u)):
        raise InputError(
            f"energy monitor: the outputs of model {model.name} must be its positions "
            f"{[s.name for s in model.states[:n_q]]}; it measures {[s.name for s in model.outputs]}. "
            "Give a model whose output is x[:n_q]."
        )
