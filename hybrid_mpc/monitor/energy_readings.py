"""The energy monitor's arithmetic as one CasADi function: violation, residual force, free runs, frozen sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import Balance, HybridModel

Array = NDArray[np.float64]
RUNS = 2
"""Free runs side by side, half a length apart: the older one always has half a length behind it."""
RUN_SUMS = 3
"""Sums of a free run: energy departure, squared speed, squared input."""
ENERGY = "energy"
"""Name of the balance that is watched."""
FORCES = {("W", "rad/s"): "N m", ("W", "m/s"): "N"}
"""Short names of a power over a speed."""
HELD_SHARE = 0.25
"""Change of an input, as a share of its range, that sticking friction does not hold."""


class Layout:
    """Where things lie in the monitor's memory and in its outputs.

    ``window`` and ``average`` are samples, ``length`` the periods of a free run, ``history`` the rows kept for a
    diagnosis; 0 for none.
    """

    def __init__(
        self, model: HybridModel, window: int, average: int, length: int = 0, history: int = 0
    ) -> None:
        self.model, self.window, self.average, self.length, self.history = (
            model,
            window,
            average,
            length,
            history,
        )
        n_q = self.n_q = model.n_x // 2
        self.row = 2 * n_q + model.n_u + model.n_w
        """Model increments, input and measured disturbances of a period."""
        self.one_step = window * n_q + (window - 1) * self.row
        """Size of the window's part of the memory."""
        self.averaged = self.one_step + 3 * n_q + model.n_u
        """Where the latest violations begin; the residuals follow them."""
        self.runs = self.averaged + average * (1 + n_q)
        """Where the free runs begin."""
        self.run = model.n_x + model.n_h + window * n_q + RUN_SUMS
        """Size of a free run: state, hidden state, positions, sums."""
        self.rows = self.runs + (RUNS * self.run if length else 0)
        """Where the history begins."""
        self.history_row = 3 * n_q + model.n_u
        """Numbers of a row: state and input at the centre, residual."""
        self.size = self.rows + history * self.history_row

    def initial(self) -> tuple[Array, tuple[int, ...]]:
        """Memory before the first sample, and the periods until each free run begins anew."""
        memory = np.full(self.size, np.nan)
        memory[self.one_step : self.averaged] = 0.0
        return memory, (1, self.length // 2 + 1) if self.length else ()

    def begin_runs(self, memory: Array, left: tuple[int, ...], x: Array, h: Array) -> tuple[int, ...]:
        """Begin those free runs anew, in place, that have come to their end; returns the periods left of each."""
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
        f"energy monitor: model {model.name} has no balance {ENERGY!r} (it has: {known}), so its energy cannot be "
        "watched; give its prior one (a MechanicalPrior has it), and export it again, or take no monitor"
    )


def force_units(model: HybridModel) -> tuple[str, ...]:
    """Unit of each residual force: that of the balance's rate over that of the speed."""
    rate = _energy_of(model).rate_unit
    return tuple(FORCES.get((rate, v.unit), f"{rate}/({v.unit})") for v in model.states[model.n_x // 2 :])


def force_unit(model: HybridModel) -> str:
    """Unit of the level of all residual forces together; forces of several units are all named.

    Example: ``force_unit(kit.models["prior"])`` is ``"N m"`` for a pendulum, ``"N, N m"`` for a cart with one.
    """
    return ", ".join(dict.fromkeys(force_units(model)))


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
    """What a model says of slow motion: its mean acceleration there, and by how much dry friction and damping slow it.

    Half the difference of the accelerations back and forth is ``D(s) = jump + damping s``: dry friction, which is fully
    there at the rest speed, and what grows with the speed. So ``2 D(s) - D(2 s)`` is what dry friction can hold at
    rest, and what damps is no part of it. Returned are the mean, ``D(s)`` and ``2 D(s) - D(2 s)``.
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
    """Force ``(n_q,)`` that the model does not explain; near rest, what dry friction could not hold either.

    The model's accelerations near rest are half the monitor's work, so they are left out at speed.
    """
    n_q = model.n_x // 2
    sizes = {"e": n_q, "a": n_q, "x": model.n_x, "h": model.n_h, "g": model.n_u + model.n_w}
    sym = [ca.MX.sym(name, size) for name, size in sizes.items()]
    error, measured, state, hidden, held_input = sym
    inertia, speed = inertia_of(model, state, held_input), state[n_q:]
    mean, slowed, jump = _near_rest(model, state[:n_q], hidden, held_input, rest)
    friction = ca.fmax(0, inertia @ jump)
    damping = (inertia @ slowed - friction) * speed / rest  # between joints it counts as each joint's own
    held = inertia @ (measured - mean) + damping  # friction of either direction taken out
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
    """A free run one period on: its memory, and its sums over the periods whose windows are full.

    Its own positions go through the same polynomial as the measured ones.
    """
    model, window, n_q = layout.model, layout.window, layout.n_q
    n_x, n_z = model.n_x, model.n_x + model.n_h
    x, h = model.step(memory[:n_x], memory[n_x:n_z], *_given(model, g), model.p)
    ring = ca.vertcat(memory[n_z + n_q : n_z + window * n_q], x[:n_q])
    position, velocity, acceleration, _, _ = weights(window, model.dt)
    # No need to take the newest off: a run is short.
    q_m, v_m, a_m = (ca.reshape(ring, n_q, window) @ ca.DM(w) for w in (position, velocity, acceleration))
    power = energy_balance(model, ca.vertcat(q_m, v_m), ca.vertcat(v_m, a_m), g_mean)
    u_mean = g_mean[: model.n_u]
    added = model.dt * ca.vertcat(power - measured_w, ca.dot(v, v), ca.dot(u_mean, u_mean))
    sums = memory[n_z + window * n_q :] + ca.if_else(full, added, 0)
    return ca.vertcat(x, h, ring, sums), sums


def _pushed(
    layout: Layout,
    memory: ca.MX,
    still: ca.MX,
    x: ca.MX,
    h: ca.MX,
    u: ca.MX,
    w: ca.MX,
    rest: ca.DM,
    spans: ca.DM,
) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Speed and travel ``(n_q,)`` that the input should have caused since the sensors' last step, and the input then.

    An estimator takes a frozen sensor for a standing machine, and an unknown load for what holds it; the controller
    pulls, and nothing moves. What counts is what both the input's change since then and the input itself, beyond
    friction, would do: a load that is there is no change, and a machine that has braked is left with no pull. The model
    is asked only beyond ``HELD_SHARE`` of the input's range, for it costs six evaluations.
    """
    model, n_q = layout.model, layout.n_q
    first = layout.one_step + n_q
    speed, travel, before = ca.vertsplit(
        memory[first : layout.averaged], [0, n_q, 2 * n_q, 2 * n_q + model.n_u]
    )
    if model.delay_states:  # the oldest of the inputs on their way is the one that has begun to act
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
    """Where values are numbers. ``values == values`` is true for CasADi, whatever they are."""
    return ca.fabs(values) < np.inf


def reading_function(layout: Layout, rest_speed: Sequence[float], spans: Array) -> ca.Function:
    """``(memory, x_prev, h_prev, u_prev, y, full, w_prev) -> (memory_next, numbers)``.

    The numbers: balances of model and measurement, violation, residual ``(n_q)``, travel ``(n_q)``, speed ``(n_q)``
    and input ``(n_u)`` at the centre; with free runs the sums of each. ``full`` says of each run whether its window is
    full. ``rest_speed`` ``(n_q,)`` are the speeds below which friction may stick, ``spans`` ``(n_u,)`` the ranges of
    the inputs.
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
    # Positions relative to the newest: after many turns the small differences keep their digits.
    relative = y_grid - ca.repmat(y, 1, window)
    q, v, a_measured = (relative @ ca.DM(w) for w in (position, velocity, acceleration))
    a_model = row_grid[:n_q, :] @ ca.DM(kernel[1:]) - row_grid[n_q : 2 * n_q, :] @ ca.DM(slope)
    g_mean = row_grid[2 * n_q :, :] @ ca.DM(0.5 * dt * (kernel[:-1] + kernel[1:]))
    u_mean, state = g_mean[:n_u], ca.vertcat(q + y, v)
    balances = [energy_balance(model, state, ca.vertcat(v, a), g_mean) for a in (a_model, a_measured)]
    residual = _residual(model, a_measured, a_model, state, h, g_mean, rest)
    # What is predicted while the sensor repeats itself; a missing sample or estimate begins anew. Where friction may
    # stick nothing counts: there an estimate creeps that does not know of it.
    y_before = memory[(window - 1) * n_q : window * n_q]
    moved = x_next[:n_q] - x[:n_q]
    ahead = memory[layout.one_step : layout.one_step + n_q] + moved * (ca.fabs(moved) > rest * dt)
    travel = ca.if_else(ca.logic_and(y == y_before, _known(ahead)), ahead, 0)
    pushed = _pushed(layout, memory, ca.mmin(y == y_before), x, h, u, w, rest, ca.DM(spans))
    shown = ca.if_else(pushed[1] > ca.fabs(travel), pushed[1], travel)
    violation = ca.fabs(balances[0] - balances[1])
    averaged = memory[layout.averaged : layout.runs]
    outs = [
        ys,
        rows,
        travel,
        *pushed,
        averaged[1 : layout.average],
        violation,
        averaged[layout.average + n_q :],
        residual,
    ]
    numbers = [*balances, violation, residual, shown, v, u_mean]
    if layout.length:
        for i in range(RUNS):
            part = memory[layout.runs + i * layout.run : layout.runs + (i + 1) * layout.run]
            run, sums = _free_run(layout, part, given, balances[1], g_mean, v, full[i])
            outs.append(run)
            numbers.append(sums)
    if layout.history:
        outs += [memory[layout.rows + layout.history_row :], state, u_mean, residual]
    vectors = [ca.densify(ca.vertcat(*parts)) for parts in (outs, numbers)]
    return ca.Function("monitor", [memory, x, h, u, y, full, w], vectors)


def check_model(model: HybridModel) -> None:
    """Refuse a model that the monitor cannot read: its outputs are not its positions, or it has no energy balance."""
    n_q = model.n_x // 2
    x, u = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u)
    jacobian = ca.Function("C", [x, u], [ca.jacobian(model.output(x, u, model.w, model.p), ca.vertcat(x, u))])
    given = np.array(jacobian(0, 0).full())
    if given.shape[0] != n_q or not np.array_equal(given, np.eye(n_q, model.n_x + model.n_u)):
        raise InputError(
            f"energy monitor: the outputs of model {model.name} must be its positions "
            f"{[s.name for s in model.states[:n_q]]}; it measures {[s.name for s in model.outputs]}. "
            "Give a model whose output is x[:n_q]."
        )
    if not np.all(np.diag(ca.Function("M", [x, u], [inertia_of(model, x, u)])(0, 0).full()) > 0):
        raise InputError(
            f"energy monitor: the energy balance of model {model.name} does not grow with its acceleration, so it "
            "says nothing of its motion; check the mass matrix of its prior, or the storage of its balance"
        )
