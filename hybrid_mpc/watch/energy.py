"""Readings of a mechanical machine with measured positions: residual forces, and the energy of free runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import Balance, HybridModel
from hybrid_mpc.watch.lengths import (
    AVERAGE_S,
    FREE_RUN_S,
    NOTHING_STICKS,
    SHORTEST_S,
    WINDOW_S,
    checked_rest,
    half_window,
    samples,
    seconds,
)
from hybrid_mpc.watch.readings import ENERGY, Channel, Sample, Test, Validity

Array = NDArray[np.float64]
RUNS = 2
"""Number of free runs, which begin half a length apart: the older one has always run for at least half a length."""
RUN_SUMS = 3
"""Sums of a free run: energy departure, squared speed, squared input."""
FORCES = {("W", "rad/s"): "N m", ("W", "m/s"): "N"}
"""Short names of a power over a speed."""
HELD_SHARE = 0.25
"""Change of an input, as a share of its range, that static friction cannot compensate."""
TERMS = 4
"""Regressors of a variance: constant, squared speed, squared input, and rest (force) or inverse time (power)."""
DRIFT = 2.0
"""Dead band of the cumulative sums [deviations]."""
UNKNOWN = (math.nan,) * TERMS


class Layout:
    """Layout of the readings' memory vector.

    ``window`` is the number of samples, ``length`` the periods of a free run; 0 for none.
    """

    def __init__(self, model: HybridModel, window: int, length: int = 0) -> None:
        self.model, self.window, self.length = model, window, length
        n_q = self.n_q = model.n_x // 2
        self.row = 2 * n_q + model.n_u + model.n_w
        """Model increments, input and measured disturbances of a period."""
        self.one_step = window * n_q + (window - 1) * self.row
        """Size of the window's part of the memory; travel and push follow it."""
        self.runs = self.one_step + 3 * n_q + model.n_u
        """Index of the first free run."""
        self.run = model.n_x + model.n_h + window * n_q + RUN_SUMS
        """Size of a free run: state, hidden state, positions, sums."""
        self.size = self.runs + (RUNS * self.run if length else 0)

    def initial(self) -> tuple[Array, tuple[int, ...]]:
        """Memory before the first sample, and the periods until each free run restarts."""
        memory = np.full(self.size, np.nan)
        memory[self.one_step : self.runs] = 0.0
        return memory, (1, self.length // 2 + 1) if self.length else ()

    def begin_runs(self, memory: Array, left: tuple[int, ...], x: Array, h: Array) -> tuple[int, ...]:
        """Restart the free runs that have ended, in place; returns the remaining periods of each."""
        following = []
        for i, periods in enumerate(left):
            if periods > 1:
                following.append(periods - 1)
                continue
            first, n = self.runs + i * self.run, self.model.n_x + self.model.n_h
            memory[first : first + self.run - RUN_SUMS] = np.nan
            memory[first : first + n] = np.concatenate([x, h])
            memory[first + self.run - RUN_SUMS - self.n_q : first + self.run - RUN_SUMS] = x[: self.n_q]
            memory[first + self.run - RUN_SUMS : first + self.run] = 0.0
            known = bool(np.isfinite(x).all())  # else try again at the next sample
            following.append(self.length if known else 1)
        return tuple(following)


@dataclass(frozen=True)
class EnergyState:
    """State of the readings, never changed in place; ``x`` and ``h`` are those of the latest estimate.

    Args:
        memory: Vector with the layout of :class:`Layout`; NaN until filled.
        left: Remaining periods of each free run.
        seen: Number of processed samples, and ``whole`` since the last missing value; both at most the window's.
        w: Measured disturbances ``(n_w,)`` from that sample on.
    """

    memory: Array
    x: Array
    h: Array
    left: tuple[int, ...] = ()
    seen: int = 0
    whole: int = 0
    w: Array = field(default_factory=lambda: np.zeros(0))


class EnergyReadings:
    """Compares the model's power balance with the measured one, using past samples only.

    **Violation** [W]: a least-squares cubic through the last ``window`` samples of ``y`` gives position, velocity and
    acceleration at the window's centre. This acceleration is a weighted mean of the true one,
    ``sum_i w_i y_i = int K(s) a(s) ds`` with the Peano kernel ``K(s) = sum_{t_i > s} w_i (t_i - s)``. The model's
    acceleration is averaged with the same ``K``: one step from every estimate ``(x_hat_i, h_i)`` gives
    ``dv = int a ds`` and ``dp = int (t_{i+1} - s) a ds``, hence exactly ``int K a ds = K_{i+1} dv - K' dp`` in every
    period. So steps of the input cause no violation. The estimated disturbance ``d`` is left out, since it would hide
    the fault. Both balances use the state ``[q, v]`` of the cubic and the input averaged with ``K``; with one degree
    of freedom their difference is ``J |v| |a_model - a_measured|``. The violation has no limit, because the residual
    forces contain the same information.

    **Residual force**: at rest the violation is zero for any force; ``M (a_measured - a_model)`` with the inertia ``M``
    of the energy balance is not. Near rest, dry friction can have any value up to half the jump of the model's force at
    zero speed. Only the residual above this dead band counts; the dead band closes linearly up to twice ``rest_speed``.
    So a hand that holds the machine is detected, but static friction is not.

    **Power of the free run** [W]: the one-step prediction starts at an estimate that partly follows the fault. With
    ``free_run`` the model also runs freely with the applied inputs. The difference of its energy balance to the
    measured one is integrated, and the channel is its mean over the time of the run: noise averages out, a constant
    loss does not. Of two runs that begin half a length apart, the older one is read.

    **Travel** of a sensor that repeats its reading: the sum of the one-step predictions that are faster than
    ``rest_speed``. Near rest, the estimator takes a frozen sensor for a machine at rest, and the controller increases
    its input. So the predicted motion due to the change of the input since the sensor's last change counts, too, if the
    change is above a quarter of the input's range. A blocked machine cannot be distinguished from a frozen sensor.

    A missing (NaN) measurement gives NaN readings until it has left the window. Positions must be continuous over full
    turns. Not thread-safe (buffers are reused).

    Args:
        model: Model whose outputs are its positions ``q`` (state ``[q, v]``).
        window: Samples in the local polynomial, odd, at least 5. Default: 0.2 time constants of the machine.
        free_run: Length [s] of the model's free runs; 0: none. Default: 0.6 time constants of the machine.
        rest_speed: Speeds ``(n_q,)`` [unit of v] below which friction may stick, or one for all; see
            :func:`~hybrid_mpc.watch.lengths.rest_speeds`. Default: nothing sticks.
        input_range: Range ``(n_u,)`` of each input, largest minus smallest, for the travel near rest. Default: that of
            the model's signals; without bounds, inputs do not contribute to the travel.

    Raises:
        InputError: If the window or a rest speed is invalid, a free run is shorter than two windows, the outputs are
            not the positions, or the energy balance does not depend on the acceleration.

    Source: energy balance and violation of the paper (energy objective, powers in W); Savitzky and Golay
    (1964) for the polynomial; Peano kernel theorem for the weighting.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, rate = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("rate", 2)
        >>> model = HybridModel.of(
        ...     "cart", 0.1, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        ...     x=x, u=u, x_next=x + 0.1 * ca.vertcat(x[1] + 0.05 * u, u), xdot=ca.vertcat(x[1], u), y=x[0],
        ...     rate=rate, energy=(rate[1] - u) * x[1])
        >>> readings = EnergyReadings(model, window=5)
        >>> [(channel.name, channel.unit) for channel in readings.channels], round(readings.delay, 6)
        ([('violation', 'W'), ('force of q', 'N'), ('power of the free run', 'W')], 0.2)
    """

    kind = ENERGY

    def __init__(
        self,
        model: HybridModel,
        *,
        window: int | None = None,
        free_run: float | None = None,
        rest_speed: ArrayLike | None = None,
        input_range: ArrayLike | None = None,
    ) -> None:
        window = 2 * half_window(WINDOW_S, model) + 1 if window is None else window
        if free_run is None:
            free_run = max(seconds(FREE_RUN_S, model), 2 * window * model.dt)
        if window < 5 or window % 2 == 0:
            raise InputError(
                f"energy: window must be an odd number of at least 5 samples, got {window} [HM-WATCH-011]"
            )
        check_model(model)
        self.layout = Layout(model, window, round(free_run / model.dt))
        if free_run and self.layout.length < 2 * window:
            raise InputError(
                f"energy: free_run of {free_run} s is too short; give at least two windows, {2 * window * model.dt:g} s"
                " [HM-WATCH-012]"
            )
        self.model, self.window = model, window
        self.rest_speed = checked_rest(
            NOTHING_STICKS if rest_speed is None else rest_speed, model.n_x // 2, "energy"
        )
        self.input_range = _spans(model, input_range)
        """Range ``(n_u,)`` of each input, for the travel near rest."""
        self.patience = window + samples(AVERAGE_S, model)
        self.n_terms = TERMS
        self.shortest = SHORTEST_S * model.time_unit
        """Shortest evaluated time [s] of a free run."""
        rate, n_q = _energy_of(model).rate_unit, self.layout.n_q
        forces = zip(model.states[:n_q], force_units(model), strict=True)
        self.channels = (
            Channel("violation", rate, "balance of the model minus that of the measurement"),
            *(
                Channel(f"force of {q.name}", unit, "force that the model does not explain")
                for q, unit in forces
            ),
            *[Channel("power of the free run", rate, "energy error of a free run over its time")]
            * bool(self.layout.length),
        )
        self.tests = tuple(
            Test(c, 0, DRIFT) if c <= n_q else Test(c, 1) for c in range(1, len(self.channels))
        )
        self._squares = tuple(rest * rest for rest in self.rest_speed)
        self._function = BufferedFunction(reading_function(self.layout, self.rest_speed, self.input_range))
        self._sizes = tuple(values.size for values in self._function.inputs[1:5])
        self._inside, self._repeats = (True,) * n_q, (1,) * n_q

    @property
    def delay(self) -> float:
        """Delay [s] of violation and force: from the window's centre to its last sample."""
        return 0.5 * (self.window - 1) * self.model.dt

    def initial(self) -> EnergyState:
        """State before the first sample."""
        empty = np.full(self.model.n_x, np.nan), np.full(self.model.n_h, np.nan)
        memory, left = self.layout.initial()
        return EnergyState(memory, *empty, left, w=self.model.w)

    def update(
        self, state: EnergyState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[EnergyState, Sample]:
        """Process one sample; see :class:`~hybrid_mpc.watch.readings.Readings`.

        The estimate's ``x`` ``(n_x,)``, ``h`` ``(n_h,)`` and, for a model with measured disturbances, ``w`` ``(n_w,)``
        are used; a missing ``w`` is that of the operating point.
        """
        x, h = (np.array(values, dtype=np.float64).ravel() for values in (estimate.x, estimate.h))
        y, u_prev = (np.asarray(values, dtype=np.float64).ravel() for values in (y, u_prev))
        if (x.size, h.size, u_prev.size, y.size) != self._sizes:
            raise InputError(
                f"monitor of model {self.model.name}: x, h, u_prev, y have {(x.size, h.size, u_prev.size, y.size)} "
                f"entries, but the model has {self._sizes}. Give values of this model [HM-WATCH-013]"
            )
        ins, outs = self._function.inputs, self._function.outputs
        ins[0][:], ins[1][:], ins[2][:], ins[3][:], ins[4][:] = state.memory, state.x, state.h, u_prev, y
        ins[6][:] = state.w
        w = getattr(estimate, "w", self.model.w)
        w = np.array(w, dtype=np.float64) if np.size(w) == self.model.n_w else self.model.w
        left = state.left and self._free_runs(state)
        self._function()
        numbers, n_q = outs[1].tolist(), self.layout.n_q
        seen = min(state.seen + 1, self.window)
        missing = not math.isfinite(sum(y.tolist()) + (sum(u_prev.tolist()) if state.seen else 0.0))
        whole = 0 if missing else min(state.whole + 1, self.window)
        values = numbers[: 1 + n_q]
        validity = Validity.VALID
        if not math.isfinite(sum(values)):
            validity = Validity.WARM_UP if seen < self.window else (
                Validity.MISSING if whole < self.window else Validity.NOT_FINITE
            )  # fmt: skip
        first = 1 + 2 * n_q
        v2 = u2 = slow = 0.0
        for v, square in zip(numbers[first : first + n_q], self._squares, strict=True):
            v2 += v * v
            slow += v * v / square
        for u in numbers[first + n_q : first + n_q + self.model.n_u]:
            u2 += u * u
        terms = [UNKNOWN] + [(1.0, v2, u2, 1.0 / (1.0 + slow))] * n_q
        if left:
            power, of_power = self._power(numbers, left)
            values.append(power)
            terms.append(of_power)
        following = EnergyState(outs[0].copy(), x, h, left, seen, whole, w)
        travel = numbers[1 + n_q : first]
        return following, Sample(values, terms, travel, self._repeats, self._inside, True, validity)

    def _free_runs(self, state: EnergyState) -> tuple[int, ...]:
        """Remaining periods of each free run after restarting those that have ended; sets which windows are full."""
        left = state.left
        if min(left) <= 1:
            left = self.layout.begin_runs(self._function.inputs[0], left, state.x, state.h)
        else:
            left = left[0] - 1, left[1] - 1
        youngest, full = self.layout.length - self.window + 2, self._function.inputs[5]
        full[0], full[1] = left[0] <= youngest, left[1] <= youngest
        return left

    def _power(self, numbers: list[float], left: tuple[int, ...]) -> tuple[float, tuple[float, ...]]:
        """Mean power [W] of the older free run and the terms of its variance; NaN while the run is short."""
        sums = (numbers[-6:-3], left[0]), (numbers[-3:], left[1])
        (older, periods), younger = sums if left[0] <= left[1] else sums[::-1]
        if older[0] != older[0]:  # NaN: not begun yet, or a measurement was missing
            older, periods = younger
        time = max(self.layout.length - self.window + 3 - periods, 0) * self.model.dt
        if not time >= self.shortest:
            return math.nan, UNKNOWN
        return older[0] / time, (1.0, older[1] / time, older[2] / time, 1.0 / time)


def _spans(model: HybridModel, given: ArrayLike | None) -> Array:
    if given is None:
        return np.array([s.upper - s.lower for s in model.inputs])
    spans = np.asarray(given, dtype=float).ravel()
    if spans.shape != (model.n_u,) or not np.all(spans > 0):
        raise InputError(
            f"energy: input_range must be {model.n_u} positive ranges, got {spans} [HM-WATCH-014]"
        )
    return spans


def weights(window: int, dt: float) -> tuple[Array, Array, Array, Array, Array]:
    """Weights of position, velocity, acceleration, and the Peano kernel at nodes with its slopes."""
    s = (np.arange(window) - 0.5 * (window - 1)) * dt
    scale = s[-1]
    fit = np.linalg.pinv(np.vander(s / scale, 4, increasing=True))
    position, velocity, acceleration = fit[0], fit[1] / scale, 2.0 * fit[2] / scale**2
    kernel = np.maximum(s[None, :] - s[:, None], 0.0) @ acceleration
    return position, velocity, acceleration, kernel, np.diff(kernel) / dt


def _given(model: HybridModel, g: ca.MX) -> tuple[ca.MX, Any]:
    """Input and measured disturbances of ``g``: both, or the input alone, under those of the operating point."""
    n_u = model.n_u
    return (g, model.w) if g.shape[0] == n_u else (g[:n_u], g[n_u:])


def energy_balance(model: HybridModel, x: ca.MX, xdot: ca.MX, g: ca.MX) -> ca.MX:
    """Residual [W] of the model's energy balance if its state changes at ``xdot``; ``g`` is the input ``(n_u,)``, or
    the input and the measured disturbances.
    """
    return _energy_of(model).residual(x, xdot, *_given(model, g), model.p)


def _energy_of(model: HybridModel) -> Balance:
    for balance in model.balances:
        if balance.name == ENERGY:
            return balance
    known = ", ".join(b.name for b in model.balances) or "none"
    raise InputError(
        f"energy: model {model.name} has no balance {ENERGY!r} (it has: {known}), so its energy cannot be monitored. "
        "Add this balance to its prior (a MechanicalPrior has it) and run again, or use residuals [HM-WATCH-015]"
    )


def force_units(model: HybridModel) -> tuple[str, ...]:
    """Unit of each residual force: that of the balance's rate over that of the speed."""
    rate = _energy_of(model).rate_unit
    return tuple(FORCES.get((rate, v.unit), f"{rate}/({v.unit})") for v in model.states[model.n_x // 2 :])


def inertia_of(model: HybridModel, x: ca.MX, u: ca.MX) -> ca.MX:
    """Inertia matrix ``M(q)`` of the energy balance, which is ``v' M a`` plus terms without ``a``."""
    n_q = model.n_x // 2
    a, rows = ca.MX.sym("a", n_q), []
    for i in range(n_q):
        v = ca.DM.zeros(n_q)
        v[i] = 1.0
        state, rate = ca.vertcat(x[:n_q], v), ca.vertcat(v, a)
        rows.append(ca.jacobian(energy_balance(model, state, rate, u), a))
    return ca.graph_substitute(ca.vertcat(*rows), [a], [ca.MX.zeros(n_q)])


def _near_rest(
    model: HybridModel, position: ca.MX, h: ca.MX, g: ca.MX, rest: ca.DM
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Accelerations of a model near rest: mean, deceleration ``D(s)``, and deceleration by dry friction alone.

    Half the difference of the accelerations at speeds ``-s`` and ``s`` is ``D(s) = jump + damping s``: dry friction,
    which is fully developed at the rest speed ``s``, plus viscous damping. So ``2 D(s) - D(2 s) = jump`` is the part
    that dry friction can hold at rest. Returns the mean, ``D(s)`` and ``2 D(s) - D(2 s)``.
    """
    n_q = model.n_x // 2
    (back, forth), (faster_back, faster_forth) = (
        [
            model.xdot(ca.vertcat(position, sign * speed), h, *_given(model, g), model.p)[n_q:]
            for sign in (-1, 1)
        ]
        for speed in (rest, 2 * rest)
    )
    slowed = 0.5 * (back - forth)
    return 0.5 * (back + forth), slowed, 2 * slowed - 0.5 * (faster_back - faster_forth)


def _residual(
    model: HybridModel, a_measured: ca.MX, a_model: ca.MX, x: ca.MX, h: ca.MX, g: ca.MX, rest: ca.DM
) -> ca.MX:
    """Residual force ``(n_q,)``; near rest only the part above the dry friction.

    The accelerations near rest take half of the monitor's computing time, so they are only evaluated at low speed.
    """
    n_q = model.n_x // 2
    sizes = {"e": n_q, "a": n_q, "x": model.n_x, "h": model.n_h, "g": model.n_u + model.n_w}
    sym = [ca.MX.sym(name, size) for name, size in sizes.items()]
    error, measured, state, hidden, held_input = sym
    inertia, speed = inertia_of(model, state, held_input), state[n_q:]
    mean, slowed, jump = _near_rest(model, state[:n_q], hidden, held_input, rest)
    friction = ca.fmax(0, inertia @ jump)
    # damping between joints counts as that of each joint
    damping = (inertia @ slowed - friction) * speed / rest
    held = inertia @ (measured - mean) + damping  # without dry friction
    held = ca.sign(held) * ca.fmax(0, ca.fabs(held) - friction)
    near = ca.fmax(0, ca.fmin(1, 2 - ca.fabs(speed) / rest))
    slow = ca.Function("slow", sym, [ca.densify(near * held + (1 - near) * (inertia @ error))])
    fast = ca.Function("fast", sym, [ca.densify(inertia @ error)])
    at_speed = ca.mmin(ca.fabs(x[n_q:]) / rest) >= 2
    choice = ca.Function.if_else("residual", fast, slow)
    return choice(at_speed, a_measured - a_model, a_measured, x, h, g)


def _free_run(
    layout: Layout, memory: ca.MX, g: ca.MX, measured_w: ca.MX, g_mean: ca.MX, v: ca.MX, full: ca.MX
) -> tuple[ca.MX, ca.MX]:
    """One period of a free run: its memory, and its sums over the periods with a full window.

    Its positions are filtered by the same polynomial as the measured ones.
    """
    model, window, n_q = layout.model, layout.window, layout.n_q
    n_x, n_z = model.n_x, model.n_x + model.n_h
    x, h = model.step(memory[:n_x], memory[n_x:n_z], *_given(model, g), model.p)
    ring = ca.vertcat(memory[n_z + n_q : n_z + window * n_q], x[:n_q])
    position, velocity, acceleration, _, _ = weights(window, model.dt)
    # positions need no offset here: a run is short
    q_m, v_m, a_m = (ca.reshape(ring, n_q, window) @ ca.DM(w) for w in (position, velocity, acceleration))
    power = energy_balance(model, ca.vertcat(q_m, v_m), ca.vertcat(v_m, a_m), g_mean)
    u_mean = g_mean[: model.n_u]
    added = model.dt * ca.vertcat(power - measured_w, ca.dot(v, v), ca.dot(u_mean, u_mean))
    sums = memory[n_z + window * n_q :] + ca.if_else(full, added, 0)
    return ca.vertcat(x, h, ring, sums), sums


def _pushed(
    layout: Layout, memory: ca.MX, still: ca.MX, x: ca.MX, h: ca.MX, u: ca.MX, w: ca.MX, rest: ca.DM, spans: ca.DM
) -> tuple[ca.MX, ca.MX, ca.MX]:  # fmt: skip
    """Predicted speed and travel ``(n_q,)`` due to the input since the sensors' last change, and the input then.

    With a frozen sensor, the estimator takes the machine for standing still and explains it by an unknown load, while
    the controller increases its input. The predicted acceleration is the smaller of those due to the change of the
    input and due to the input itself beyond friction: a constant load is no change, and after braking the input
    itself is small. The model is only evaluated for changes above ``HELD_SHARE`` of the input's range, because this
    needs six evaluations.
    """
    model, n_q = layout.model, layout.n_q
    first = layout.one_step + n_q
    speed, travel, before = ca.vertsplit(memory[first : layout.runs], [0, n_q, 2 * n_q, 2 * n_q + model.n_u])
    if model.delay_states:  # the oldest delayed input is the one that acts now
        u = h[: model.n_u]
    before = ca.if_else(ca.logic_and(still, ca.mmin(_known(before))), before, u)
    strong = ca.logic_and(still, ca.mmax(ca.fabs(u - before) - HELD_SHARE * spans) > 0)
    sizes = {"x": model.n_x, "h": model.n_h, "u": model.n_u, "before": model.n_u, "w": model.n_w}
    sym = [ca.MX.sym(name, size) for name, size in sizes.items()]
    (mean, _, jump), (earlier, _, _) = (
        _near_rest(model, sym[0][:n_q], sym[1], ca.vertcat(pull, sym[4]), rest) for pull in sym[2:4]
    )
    alone = ca.sign(mean) * ca.fmax(0, ca.fabs(mean) - ca.fmax(0, jump))
    change = mean - earlier
    both = ca.sign(alone) * ca.fmin(ca.fabs(alone), ca.fabs(change)) * (alone * change > 0)
    asked = ca.Function("asked", sym, [ca.densify(both)])
    none = ca.Function("none", sym, [ca.DM.zeros(n_q)])
    push = ca.Function.if_else("push", asked, none)(strong, x, h, u, before, w)
    speed = ca.if_else(strong, speed + model.dt * push, 0)
    travel = ca.if_else(still, travel + model.dt * ca.fabs(speed), 0)
    return ca.if_else(_known(speed), speed, 0), ca.if_else(_known(travel), travel, 0), before


def _known(values: ca.MX) -> ca.MX:
    """Which values are finite; CasADi simplifies ``values == values`` to true, so it cannot detect NaN."""
    return ca.fabs(values) < np.inf


def reading_function(layout: Layout, rest_speed: Sequence[float], spans: Array) -> ca.Function:
    """``(memory, x_prev, h_prev, u_prev, y, full, w_prev) -> (memory_next, numbers)``.

    The numbers: violation, residual ``(n_q)``, travel ``(n_q)``, speed ``(n_q)`` and input ``(n_u)`` at the centre of
    the window; with free runs the sums of each. ``full`` says for each run whether its window is full. ``rest_speed``
    ``(n_q,)`` are the speeds below which friction may stick, ``spans`` ``(n_u,)`` the ranges of the inputs.
    """
    model, window, n_q, rest = layout.model, layout.window, layout.n_q, ca.DM(list(rest_speed))
    n_u, dt, row = model.n_u, model.dt, layout.row
    position, velocity, acceleration, kernel, slope = weights(window, dt)
    memory = ca.MX.sym("memory", layout.size)
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", n_u)
    y, full, w = ca.MX.sym("y", n_q), ca.MX.sym("full", RUNS), ca.MX.sym("w", model.n_w)
    given = ca.vertcat(u, w)
    x_next = model.step(x, h, u, w, model.p)[0]
    dv = x_next[n_q:] - x[n_q:]
    dp = x_next[:n_q] - x[:n_q] - dt * x[n_q:]
    ys = ca.vertcat(memory[n_q : window * n_q], y)
    rows = ca.vertcat(memory[window * n_q + row : layout.one_step], dv, dp, given)
    y_grid, row_grid = ca.reshape(ys, n_q, window), ca.reshape(rows, row, window - 1)
    # positions relative to the newest: after many turns this avoids cancellation
    relative = y_grid - ca.repmat(y, 1, window)
    q, v, a_measured = (relative @ ca.DM(w) for w in (position, velocity, acceleration))
    a_model = row_grid[:n_q, :] @ ca.DM(kernel[1:]) - row_grid[n_q : 2 * n_q, :] @ ca.DM(slope)
    g_mean = row_grid[2 * n_q :, :] @ ca.DM(0.5 * dt * (kernel[:-1] + kernel[1:]))
    u_mean, state = g_mean[:n_u], ca.vertcat(q + y, v)
    balances = [energy_balance(model, state, ca.vertcat(v, a), g_mean) for a in (a_model, a_measured)]
    residual = _residual(model, a_measured, a_model, state, h, g_mean, rest)
    # Travel: predicted motion while the sensor repeats its reading; a missing sample or estimate resets it. Motion
    # below the rest speed does not count, because an estimate without friction creeps there.
    y_before = memory[(window - 1) * n_q : window * n_q]
    moved = x_next[:n_q] - x[:n_q]
    ahead = memory[layout.one_step : layout.one_step + n_q] + moved * (ca.fabs(moved) > rest * dt)
    travel = ca.if_else(ca.logic_and(y == y_before, _known(ahead)), ahead, 0)
    pushed = _pushed(layout, memory, ca.mmin(y == y_before), x, h, u, w, rest, ca.DM(spans))
    shown = ca.if_else(pushed[1] > ca.fabs(travel), pushed[1], travel)
    violation = ca.fabs(balances[0] - balances[1])
    outs = [ys, rows, travel, *pushed]
    numbers = [violation, residual, shown, v, u_mean]
    if layout.length:
        for i in range(RUNS):
            part = memory[layout.runs + i * layout.run : layout.runs + (i + 1) * layout.run]
            run, sums = _free_run(layout, part, given, balances[1], g_mean, v, full[i])
            outs.append(run)
            numbers.append(sums)
    vectors = [ca.densify(ca.vertcat(*parts)) for parts in (outs, numbers)]
    return ca.Function("monitor", [memory, x, h, u, y, full, w], vectors)


def check_model(model: HybridModel) -> None:
    """Refuse a model whose energy cannot be monitored: outputs that are not its positions, or no energy balance."""
    n_q = model.n_x // 2
    x, u = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    jacobian = ca.Function("C", [x, u], [ca.jacobian(model.output(x, u, model.w, model.p), ca.vertcat(x, u))])
    given = np.array(jacobian(0, 0).full())
    if given.shape[0] != n_q or not np.array_equal(given, np.eye(n_q, model.n_x + model.n_u)):
        raise InputError(
            f"energy: the outputs of model {model.name} must be its positions "
            f"{[s.name for s in model.states[:n_q]]}, but they are {[s.name for s in model.outputs]}. "
            "Give a model whose output is x[:n_q], or use residuals [HM-WATCH-016]"
        )
    if not np.all(np.diag(ca.Function("M", [x, u], [inertia_of(model, x, u)])(0, 0).full()) > 0):
        raise InputError(
            f"energy: the energy balance of model {model.name} does not grow with its acceleration. "
            "Check the mass matrix of its prior, or the storage of its balance"
            " [HM-WATCH-017]"
        )
