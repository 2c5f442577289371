"""A machine whose operating point is far from rest in a state that no sensor shows, with a network's gated memory."""

import casadi as ca
import numpy as np

from hybrid_mpc import HybridModel, Signal


def gated(seed, units=16):
    """A tank heated through a wall, corrected by a GRU; the operating point has the right level and a wall far too hot.

    Where Newton's method moves the memory far beyond one its gates shut, and it rests wherever it is.
    """
    rng = np.random.default_rng(seed)
    x, h, u = ca.SX.sym("x", 2), ca.SX.sym("h", units), ca.SX.sym("u", 1)

    def layer():
        own, given = (rng.normal(size=(units, n)) * 2.0 for n in (units, 3))
        return own / np.sqrt(units) @ h + given @ ca.vertcat(x, u) + rng.normal(size=units)

    keeps = 1 / (1 + ca.exp(-layer() - 3.0))
    h_next = keeps * h + (1 - keeps) * ca.tanh(layer())
    flows = 0.1 * ca.vertcat(x[1] - 2 * x[0], u - (x[1] - x[0]))
    rate = flows + 0.05 * (0.1 * rng.normal(size=(2, units)) / np.sqrt(units) @ h_next)
    tank, wall = Signal("tank", "K", -5, 5), Signal("wall", "K", -5, 10)
    return HybridModel.of(
        "gated", 1.0, (tank, wall), (Signal("power", "W"),), (tank,), x=x, h=h, u=u, x_next=x + rate, h_next=h_next,
        xdot=rate, y=x[0], nominal_x=(0.5, 4.0), nominal_u=(0.5,),
    )  # fmt: skip


def saturated(seed, units):
    """A tank with a wall, of whose rates a saturated memory of level and inflow takes a part."""
    rng = np.random.default_rng(seed)
    x, h, u = ca.SX.sym("x", 2), ca.SX.sym("h", units), ca.SX.sym("u", 2)
    w_h = rng.normal(size=(units, units)) * 0.9 / np.sqrt(units)
    w_x, out = 4.0 * rng.normal(size=(units, 4)), 0.2 * rng.normal(size=(2, units)) / np.sqrt(units)
    h_next = ca.tanh(w_h @ h + w_x @ ca.vertcat(x, u) + rng.normal(size=units))
    rate = ca.vertcat(u[0] - ca.sqrt(0.1 + x[0] ** 2), u[1] - u[0] * x[1]) + out @ h_next
    levels = (Signal("level", "m", -2, 2), Signal("heat", "K", -2, 2))
    return HybridModel.of(
        "memory", 0.1, levels, (Signal("in", "m/s"), Signal("power", "K/s")), levels,
        x=x, h=h, u=u, x_next=x + 0.02 * rate, h_next=h_next, xdot=rate, y=x,
        nominal_x=(0.5, 0.5), nominal_u=(0.6, 0.4),
    )  # fmt: skip
