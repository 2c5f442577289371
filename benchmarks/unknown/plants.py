"""The plants behind the recordings: their equations with named parameters, which a benchmark of loops moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from unknown.common import Array

G = 9.81
CELLS = 6
"""Cells of each side of the heat exchanger."""
FEED_STAGE = 4
"""Stage of the column, of eight, that the feed enters."""


@dataclass(frozen=True)
class Plant:
    """A plant that the prior does not describe exactly.

    Args:
        rates: ``(x, u, w, p) -> xdot (n,)`` with parameters ``p`` as attributes.
        measure: ``x -> y (n_y,)`` without noise.
        parameters: Values of its parameters.
        start: A state ``(n,)`` at which it works.
        sigma: White noise of the sensors ``(n_y,)``.
        step: Steps of the sensors ``(n_y,)``; 0: none.
        longest: Longest step [s] of its integration.
        advance: ``(x, u, w, p) -> x`` a period later, in place of Runge-Kutta steps. Default: none.
    """

    rates: Callable[[Array, Array, Array, Any], Array]
    measure: Callable[[Array], Array]
    parameters: Mapping[str, float]
    start: tuple[float, ...]
    sigma: tuple[float, ...]
    step: tuple[float, ...]
    longest: float
    advance: Callable[[Array, Array, Array, Any], Array] | None = None

    @property
    def p(self) -> SimpleNamespace:
        """Its parameters as attributes."""
        return SimpleNamespace(**self.parameters)


NONE: Array = np.zeros(0)


def run(
    plant: Plant,
    control: Callable[[int, Array], Array],
    dt: float,
    samples: int,
    steps: int,
    *,
    start: Sequence[float] | None = None,
    measure: Callable[[Array], Array] | None = None,
    w: Callable[[float], Array] = lambda t: NONE,
) -> tuple[Array, Array, Array]:
    """Times, inputs and measured outputs of a plant under ``control(k, y)`` with disturbances ``w(t)``; RK4."""
    x, measure, p = np.array(plant.start if start is None else start), measure or plant.measure, plant.p
    t, h = dt * np.arange(samples), dt / steps
    inputs, outputs = [], []

    def rates(x: Array, u: Array, now: float) -> Array:
        return plant.rates(x, u, w(now), p)

    for k in range(samples):
        y = measure(x)
        u = np.atleast_1d(control(k, y))
        inputs.append(u)
        outputs.append(y)
        for i in range(steps):
            now = t[k] + i * h
            k1 = rates(x, u, now)
            k2 = rates(x + h / 2 * k1, u, now + h / 2)
            k3 = rates(x + h / 2 * k2, u, now + h / 2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, u, now + h))
    return t, np.array(inputs), np.array(outputs)


def exchanger_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Cells on either side of walls that store heat; heat transfer grows with the flow."""
    m = CELLS
    hot, wall, cold = x[:m], x[m : 2 * m], x[2 * m :]
    qh, qc = u / 60
    k = p.UA / 60 / m * (u / 5) ** p.power
    from_hot, from_cold = np.r_[80.0, hot[:-1]], np.r_[15.0, cold[:-1]]
    return np.concatenate([
        (qh * (from_hot - hot) - k[0] * (hot - wall)) / (p.V_h / m),
        (k[0] * (hot - wall) + k[1] * (cold[::-1] - wall)) / (p.C_w / m),
        (qc * (from_cold - cold) + k[1] * (wall[::-1] - cold) - p.loss / 60 * (cold - 20)) / (p.V_c / m),
    ])  # fmt: skip


def tanks_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Four tanks; a pump begins to pump at a voltage."""
    a = np.array([p.a_1, p.a_2, p.a_3, p.a_4])
    out = a * np.maximum(x, 0.0) ** p.power
    q = np.array([p.k_1, p.k_2]) * np.maximum(u - p.dead, 0.0)
    return np.array([
        p.g_1 * q[0] + out[2] - out[0], p.g_2 * q[1] + out[3] - out[1],
        (1 - p.g_2) * q[1] - out[2], (1 - p.g_1) * q[0] - out[3],
    ])  # fmt: skip


def bioreactor_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Growth inhibited by substrate (Haldane), maintenance."""
    b, s = np.maximum(x, 0.0)
    mu = p.mu * s / (p.K + s + s * s / p.K_i)
    return np.array([(mu - u[0] - p.decay) * b, u[0] * (20 - s) - mu * b / p.Y - p.maintenance * b]) / 3600


def evaporator_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Level, composition, pressure and the heater's lag; the condenser saturates."""
    _, conc, pressure, lag = x
    f1 = w[0]
    t2 = 0.5616 * pressure + 0.3126 * conc + 48.43
    f4 = p.UA * (0.1538 * lag + 90.0 - t2)
    ua = p.k * u[2] * 0.07 / (1 + p.k_s * u[2])
    f5 = ua * (0.507 * pressure + 55.0 - 25.0)
    return (
        np.array(
            [(f1 - f4 - u[0]) / p.A, (f1 * 5.0 - u[0] * conc) / p.M, (f4 - f5) / p.C, (u[1] - lag) / p.T]
        )
        / 60
    )


def column_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Eight stages with constant molar overflow."""
    m, at = 8, FEED_STAGE
    f, (down, v) = w[0], u
    y = p.alpha * x / (1 + (p.alpha - 1) * x)
    liquid = np.where(np.arange(m) <= at, down + 1.0, down)
    out = np.zeros(m)
    out[0] = (liquid[1] * x[1] - (liquid[1] - v) * x[0] - v * y[0]) / p.M_b
    for i in range(1, m - 1):
        into = (down if i == at else liquid[i + 1]) * x[i + 1] + (f if i == at else 0.0)
        out[i] = (into - liquid[i] * x[i] + v * (y[i - 1] - y[i])) / p.M
    out[-1] = v * (y[-2] - x[-1]) / p.M_d
    return out / 60


def building_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Air, furniture and walls in two layers, the heater; infiltration."""
    i, m, e, h = x
    im, me, eo, hi = p.H_im * (i - m), p.H_me * (m - e), p.H_eo * (e - w[0]), p.H_h * (h - i)
    leak = p.leak * (i - w[0])
    return (
        np.array(
            [
                (hi + p.A_i * w[1] - im - leak) / p.C_i,
                (im - me + p.A_m * w[1]) / p.C_m,
                (me - eo) / p.C_e,
                (u[0] - hi) / p.C_h,
            ]
        )
        / 3600
    )


def shaft_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """A shaft that stiffens, dry friction on the load."""
    m, load, q = x
    shaft = p.c * q + p.c_3 * q**3 + p.d * (m - load)
    return np.array(
        [(p.k * u[0] - p.b * m - shaft) / p.J_m, (shaft - p.dry * np.tanh(load / 1.0)) / p.J_l, m - load]
    )


def magnet_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """A ball below a magnet whose inductance depends on the gap."""
    gap, v, i = x
    pull = p.k * (i / (gap + p.x_0)) ** 2
    return np.array([v, 9810 - pull, (u[0] - p.R * i) / (p.L_0 + p.L_1 / (gap + p.x_0))])


def cart_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """An upright pole on a cart with dry friction."""
    _, phi, sd, pd = x
    a, c, e = p.M + p.m, p.m * p.l * np.cos(phi), p.J + p.m * p.l * p.l
    f1 = u[0] - p.b * sd - p.dry * np.tanh(sd / 0.02) + p.m * p.l * np.sin(phi) * pd**2
    f2 = p.m * G * p.l * np.sin(phi) - p.b_p * pd
    det = a * e - c * c
    return np.array([sd, pd, (e * f1 - c * f2) / det, (a * f2 - c * f1) / det])


def ship_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Cubic damping, a rudder of limited speed; ``w`` is the waves' part of the turning rate, 0 where empty."""
    _, r, d = x
    waves = w[0] if len(w) else 0.0
    return np.array(
        [
            r,
            (p.K * (d - p.bias) - r - p.cubic * r**3) / p.T + waves / p.T,
            np.clip((u[0] - d) / p.T_r, -3.0, 3.0),
        ]
    )


def ball_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """A beam of second order, rolling friction, centrifugal force."""
    s, v, q, turn = x
    a = p.k * (s * turn * turn - G * np.sin(q - p.off)) - p.b * v - p.dry * np.tanh(v / 0.01)
    return np.array([v, a, turn, p.w_0**2 * (u[0] - q) - 2 * p.damping * p.w_0 * turn])


def cylinder_rates(x: Array, u: Array, w: Array, p: Any) -> Array:
    """Leakage, dry friction, a valve with a lag."""
    _, v, pressure, q = x
    flow = p.k_q * q * np.sqrt(max(70 - np.sign(q) * pressure, 1e-3)) - p.leak * pressure
    return np.array(
        [
            v,
            (100 * pressure - p.b * v - p.dry * np.tanh(v / 0.005)) / p.m,
            1000 * p.C * (flow - 1e-3 * v),
            (u[0] - q) / p.T,
        ]
    )


def first(n: int) -> Callable[[Array], Array]:
    """Outputs that are the first states."""
    return lambda x: x[:n]


def chosen(*places: int) -> Callable[[Array], Array]:
    """Outputs that are single states."""
    return lambda x: x[list(places)]


_MACHINES = {
    "heat_exchanger_2": Plant(
        exchanger_rates, chosen(CELLS - 1, -1),
        {"UA": 7.5, "power": 0.6, "V_h": 1.1, "C_w": 0.3, "V_c": 1.8, "loss": 0.01},
        tuple(np.concatenate([np.linspace(75, 55, CELLS), np.linspace(60, 40, CELLS), np.linspace(18, 42, CELLS)])),
        (0.1, 0.1), (0.1, 0.1), 1.0 / 8,
    ),
    "quadruple_tank": Plant(
        tanks_rates, first(2),
        {"a_1": 0.0044, "a_2": 0.0040, "a_3": 0.0062, "a_4": 0.0070, "power": 0.47, "k_1": 6.0e-4, "k_2": 7.0e-4,
         "dead": 0.5, "g_1": 0.65, "g_2": 0.6},
        (0.3, 0.3, 0.03, 0.03), (1e-3, 1e-3), (5e-4, 5e-4), 0.5,
    ),
    "bioreactor": Plant(
        bioreactor_rates, first(1),
        {"mu": 0.62, "K": 1.3, "K_i": 60.0, "Y": 0.47, "decay": 0.01, "maintenance": 0.02},
        (7.0, 2.0), (0.05,), (0.02,), 150.0,
    ),
    "evaporator": Plant(
        evaporator_rates, chosen(0, 2),
        {"A": 28.0, "M": 26.0, "C": 3.0, "UA": 0.2, "k": 0.0118, "k_s": 0.0008, "T": 0.8},
        (1.0, 22.0, 50.0, 195.0), (0.01, 0.3), (0.005, 0.1), 4.0,
    ),
    "column": Plant(
        column_rates, chosen(0, -1), {"alpha": 1.9, "M_b": 14.0, "M": 1.5, "M_d": 15.0},
        tuple(np.linspace(0.15, 0.85, 8)), (2e-3, 2e-3), (1e-3, 1e-3), 7.5,
    ),
    "building": Plant(
        building_rates, first(1),
        {"H_im": 0.7, "H_me": 0.6, "H_eo": 0.55, "H_h": 1.4, "leak": 0.06, "A_i": 2.2, "A_m": 0.8, "C_i": 1.6,
         "C_m": 9.0, "C_e": 8.0, "C_h": 0.25},
        (20.0, 18.0, 12.0, 22.0), (0.05,), (0.0625,), 75.0,
    ),
    "flexible_shaft": Plant(
        shaft_rates, first(2),
        {"c": 1.4, "c_3": 3.0, "d": 0.006, "k": 0.04, "b": 0.0028, "J_m": 7e-4, "dry": 0.02, "J_l": 4.2e-3},
        (0.0, 0.0, 0.0), (0.2, 0.2), (0.1, 0.1), 1e-3,
    ),
    "magnetic_levitation": Plant(
        magnet_rates, chosen(0, 2), {"k": 2.1e6, "x_0": 4.5, "R": 6.5, "L_0": 0.12, "L_1": 0.4},
        (10.0, 0.0, 0.99), (0.005, 0.004), (0.005, 0.002), 5e-4,
    ),
    "inverted_pendulum": Plant(
        cart_rates, first(2),
        {"M": 0.7, "m": 0.28, "l": 0.25, "J": 0.0075, "b": 1.6, "dry": 0.4, "b_p": 0.002},
        (0.0, 0.0, 0.0, 0.0), (3e-4, 5e-4), (5e-4, 2 * np.pi / 4096), 2.5e-3,
    ),
    "ship": Plant(
        ship_rates, first(1), {"K": 0.055, "bias": 1.2, "cubic": 0.8, "T": 28.0, "T_r": 1.5},
        (0.0, 0.0, 0.0), (0.05,), (0.1,), 0.25,
    ),
    "ball_and_beam": Plant(
        ball_rates, first(1), {"k": 5 / 7, "off": 0.012, "b": 0.25, "dry": 0.03, "w_0": 15.0, "damping": 0.8},
        (0.05, 0.0, 0.0, 0.0), (5e-4,), (1e-3,), 5e-3,
    ),
    "hydraulic_cylinder": Plant(
        cylinder_rates, first(1),
        {"k_q": 3.6e-6, "leak": 2.0e-7, "b": 2900.0, "dry": 150.0, "m": 140.0, "C": 220.0, "T": 0.006},
        (0.0, 0.0, 0.0, 0.0), (5e-5,), (1e-4,), 5e-4,
    ),
}  # fmt: skip

PLANTS: Mapping[str, Plant] = {
    **_MACHINES,
    "quadruple_tank_levels": replace(
        _MACHINES["quadruple_tank"], measure=first(4), sigma=(1e-3,) * 4, step=(5e-4,) * 4
    ),
    "building_walls": replace(_MACHINES["building"], measure=first(2), sigma=(0.05,) * 2, step=(0.0625,) * 2),
}
"""By the machine's name."""
