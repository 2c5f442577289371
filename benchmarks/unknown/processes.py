"""Six processes: what the user writes, and the plant that is recorded.

Sources: Bequette, *Process Control* (2003) for exchanger, column and bioreactor; Johansson, *The quadruple-tank
process* (2000); Newell and Lee, *Applied Process Control* (1989) for the evaporator; Madsen and Holst, *Estimation of
continuous-time models for the heat dynamics of a building* (1995).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np

from hybrid_mpc import DataSpec, OperatingPoint, Parameter, Prior, Signal
from unknown.common import Array, Machine, drop_outs, levels, quantised
from unknown.plants import PLANTS, run

"""Measured disturbances of a machine without any."""


class HeatExchanger(Prior):
    """Two mixed cells on each side, counter-current; the walls hold no heat."""

    states = (
        Signal("hot_1", "degC", 0, 100), Signal("hot_2", "degC", 0, 100),
        Signal("cold_1", "degC", 0, 100), Signal("cold_2", "degC", 0, 100),
    )  # fmt: skip
    inputs = (Signal("hot_flow", "l/min", 0, 12), Signal("cold_flow", "l/min", 0, 12))
    outputs = (states[1], states[3])
    parameters = (
        Parameter("V_h", 0.8, "l", 0.2, 3.0, "volume of a hot cell"),
        Parameter("V_c", 1.2, "l", 0.2, 4.0, "volume of a cold cell"),
        Parameter("UA", 1.6, "l/min", 0.2, 8.0, "heat transfer of a cell over rho cp"),
        Parameter("T_h", 80.0, "degC", 80.0, 80.0), Parameter("T_c", 15.0, "degC", 15.0, 15.0),
    )  # fmt: skip
    operating_point = OperatingPoint(x=(69.39, 58.78, 25.61, 36.22), u=(5.0, 5.0))

    def xdot(self, x, u, w, p):
        """Heat balances of the cells; minutes to seconds."""
        qh, qc = u.hot_flow / 60, u.cold_flow / 60
        k = p.UA / 60
        return (
            (qh * (p.T_h - x.hot_1) - k * (x.hot_1 - x.cold_2)) / p.V_h,
            (qh * (x.hot_1 - x.hot_2) - k * (x.hot_2 - x.cold_1)) / p.V_h,
            (qc * (p.T_c - x.cold_1) + k * (x.hot_2 - x.cold_1)) / p.V_c,
            (qc * (x.cold_1 - x.cold_2) + k * (x.hot_1 - x.cold_2)) / p.V_c,
        )


def heat_exchanger(seed: int) -> Array:
    """Six cells a side with walls, heat transfer that grows with the flow, losses."""
    rng = np.random.default_rng([seed, 1])
    n, dt, plant = 1500, 1.0, PLANTS["heat_exchanger_2"]
    flows = np.stack([levels(rng, n, 2, 9, 30, 150), levels(rng, n, 2, 9, 30, 150)], 1)

    t, u, y = run(plant, lambda k, y: flows[k], dt, n, 8)
    y = drop_outs(quantised(y + 0.1 * rng.standard_normal(y.shape), 0.1), rng, 0.02)
    return np.column_stack([t, u, y])


class QuadrupleTank(Prior):
    """Four tanks, two pumps, the lower levels measured."""

    states = tuple(Signal(f"h{i}", "m", 0.0, 0.6) for i in (1, 2, 3, 4))
    inputs = (Signal("v1", "V", 0, 12), Signal("v2", "V", 0, 12))
    outputs = states[:2]
    parameters = (
        Parameter("a12", 0.0030, "sqrt(m)/s", 0.0005, 0.02, "outlets of the lower tanks over their area"),
        Parameter("a34", 0.0050, "sqrt(m)/s", 0.0005, 0.02, "outlets of the upper tanks over their area"),
        Parameter("k1", 1.0e-3, "m/(V s)", 1e-4, 5e-3, "pump 1 over area"),
        Parameter("k2", 1.0e-3, "m/(V s)", 1e-4, 5e-3, "pump 2 over area"),
        Parameter("g1", 0.5, "-", 0.1, 0.95, "share of pump 1 to the lower tank"),
        Parameter("g2", 0.5, "-", 0.1, 0.95, "share of pump 2 to the lower tank"),
    )
    operating_point = OperatingPoint(x=(0.25, 0.25, 0.0225, 0.0225), u=(1.5, 1.5))

    def xdot(self, x, u, w, p):
        """Outflows by Torricelli; the root is smooth at an empty tank."""
        q = [h / ca.sqrt(ca.sqrt(h * h + 1e-6)) for h in x]
        return (
            p.g1 * p.k1 * u.v1 + p.a34 * q[2] - p.a12 * q[0],
            p.g2 * p.k2 * u.v2 + p.a34 * q[3] - p.a12 * q[1],
            (1 - p.g2) * p.k2 * u.v2 - p.a34 * q[2],
            (1 - p.g1) * p.k1 * u.v1 - p.a34 * q[3],
        )


def quadruple_tank(seed: int, name: str = "quadruple_tank") -> Array:
    """Outlets that differ, an exponent below a half, pumps that need a voltage before they pump."""
    rng = np.random.default_rng([seed, 2])
    n, dt, plant = 1200, 2.0, PLANTS[name]
    volts = np.stack([levels(rng, n, 2, 6, 30, 120), levels(rng, n, 2, 6, 30, 120)], 1)

    t, u, y = run(plant, lambda k, y: volts[k], dt, n, 4)
    y = drop_outs(quantised(y + 1e-3 * rng.standard_normal(y.shape), 5e-4), rng, 0.03, 10)
    return np.column_stack([t, u, y])


class QuadrupleTankLevels(QuadrupleTank):
    """The same with all levels measured."""

    outputs = QuadrupleTank.states


class Bioreactor(Prior):
    """Continuous culture after Monod; the biomass is measured, the substrate is not."""

    states = (Signal("X", "g/l", 0.0, 20.0), Signal("S", "g/l", 0.0, 30.0))
    inputs = (Signal("D", "1/h", 0.0, 0.6),)
    outputs = states[:1]
    parameters = (
        Parameter("mu", 0.55, "1/h", 0.1, 1.5, "largest growth"),
        Parameter("K", 0.8, "g/l", 0.05, 8.0, "half saturation"),
        Parameter("Y", 0.4, "-", 0.1, 0.9, "yield"),
        Parameter("S_f", 20.0, "g/l", 20.0, 20.0, "feed"),
    )
    operating_point = OperatingPoint(x=(7.616, 0.96), u=(0.3,))

    def xdot(self, x, u, w, p):
        """Growth and washout; the model's time is in seconds."""
        mu = p.mu * x.S / (p.K + ca.fmax(x.S, 0.0))
        return (mu - u.D) * x.X / 3600, (u.D * (p.S_f - x.S) - mu * x.X / p.Y) / 3600


def bioreactor(seed: int) -> Array:
    """Growth inhibited by substrate (Haldane) and maintenance."""
    rng = np.random.default_rng([seed, 3])
    n, dt, plant = 720, 600.0, PLANTS["bioreactor"]
    feed = levels(rng, n, 0.05, 0.34, 18, 72)

    t, u, y = run(plant, lambda k, y: feed[k : k + 1], dt, n, 4)
    y = drop_outs(quantised(y + 0.05 * rng.standard_normal(y.shape), 0.02), rng, 0.05)
    return np.column_stack([t / 3600, u, y])


class Evaporator(Prior):
    """Level, product composition and pressure; the level integrates and is held by a controller."""

    states = (Signal("L", "m", 0.0, 3.0), Signal("X", "%", 5.0, 60.0), Signal("P", "kPa", 20.0, 90.0))
    inputs = (
        Signal("F2", "kg/min", 0.0, 10.0),
        Signal("steam", "kPa", 50.0, 400.0),
        Signal("F200", "kg/min", 50.0, 400.0),
    )
    outputs = (states[0], states[2])
    disturbances = (Signal("F1", "kg/min", 5.0, 15.0),)
    parameters = (
        Parameter("A", 20.0, "kg/m", 5.0, 80.0, "mass a level"),
        Parameter("M", 20.0, "kg", 5.0, 80.0, "mass of liquid"),
        Parameter("C", 4.0, "kg/kPa", 0.5, 20.0, "vapour a pressure"),
        Parameter("UA", 0.16, "kg/(min K)", 0.02, 0.6, "heater over latent heat"),
        Parameter("k", 0.012, "1/K", 0.002, 0.06, "condenser"),
        Parameter("X1", 5.0, "%", 5.0, 5.0, "feed"),
    )
    operating_point = OperatingPoint(x=(1.0, 15.0, 50.0), u=(3.333, 213.7, 143.4), w=(10.0,))

    def xdot(self, x, u, w, p):
        """Minutes to seconds."""
        t2 = 0.5616 * x.P + 0.3126 * x.X + 48.43
        f4 = p.UA * (0.1538 * u.steam + 90.0 - t2)
        f5 = p.k * u.F200 * (0.507 * x.P + 55.0 - 25.0) * 0.07
        return ((w.F1 - f4 - u.F2) / p.A / 60, (w.F1 * p.X1 - u.F2 * x.X) / p.M / 60, (f4 - f5) / p.C / 60)


def evaporator(seed: int) -> Array:
    """The level by a PI controller; heater and condenser saturate, the heater lags."""
    rng = np.random.default_rng([seed, 4])
    n, dt, plant = 1500, 12.0, PLANTS["evaporator"]
    steam, cooling, feed = (
        levels(rng, n, 150, 250, 30, 120),
        levels(rng, n, 150, 260, 40, 160),
        levels(rng, n, 9, 11, 40, 200),
    )
    goal, memory = levels(rng, n, 0.8, 1.3, 150, 400), [0.0]

    def control(k: int, y: Array) -> Array:
        off = y[0] - goal[k]
        memory[0] += 0.02 * off
        return np.array([np.clip(2.5 + 6.0 * off + memory[0], 0.0, 8.0), steam[k], cooling[k]])

    noise = rng.standard_normal((2 * n, 2)) * [0.01, 0.3]
    count = iter(noise)
    t, u, y = run(
        plant, control, dt, n, 3,
        measure=lambda x: quantised(plant.measure(x) + next(count), np.array([0.005, 0.1])),
        w=lambda t: feed[min(int(t / dt), n - 1)][None],
    )  # fmt: skip
    return np.column_stack([t, u, feed + 0.05 * rng.standard_normal(n), drop_outs(y, rng, 0.01)])


class Column(Prior):
    """Binary distillation with a reboiler, two stages and a condenser; ends measured."""

    states = tuple(Signal(name, "-", 0.0, 1.0) for name in ("x_B", "x_1", "x_2", "x_D"))
    inputs = (Signal("reflux", "kmol/min", 0.0, 8.0), Signal("boil_up", "kmol/min", 0.0, 8.0))
    outputs = (states[0], states[3])
    disturbances = (Signal("z_F", "-", 0.2, 0.8),)
    parameters = (
        Parameter("alpha", 3.0, "-", 1.2, 8.0, "relative volatility"),
        Parameter("M", 4.0, "kmol", 0.5, 20.0, "a stage's holdup"),
        Parameter("M_e", 10.0, "kmol", 2.0, 60.0, "holdup of reboiler and condenser"),
        Parameter("F", 1.0, "kmol/min", 1.0, 1.0, "feed, liquid, to stage 1"),
    )
    operating_point = OperatingPoint(x=(0.1955, 0.3911, 0.6259, 0.8339), u=(2.7, 3.2), w=(0.5147,))

    def xdot(self, x, u, w, p):
        """Component balances with constant molar overflow; minutes to seconds."""

        def y(v):
            return p.alpha * v / (1 + (p.alpha - 1) * v)

        below = u.reflux + p.F
        return (
            (below * x.x_1 - (below - u.boil_up) * x.x_B - u.boil_up * y(x.x_B)) / p.M_e / 60,
            (u.reflux * x.x_2 + p.F * w.z_F - below * x.x_1 + u.boil_up * (y(x.x_B) - y(x.x_1))) / p.M / 60,
            (u.reflux * (x.x_D - x.x_2) + u.boil_up * (y(x.x_1) - y(x.x_2))) / p.M / 60,
            u.boil_up * (y(x.x_2) - x.x_D) / p.M_e / 60,
        )


def column(seed: int) -> Array:
    """Eight stages of less holdup and less volatility."""
    rng = np.random.default_rng([seed, 5])
    n, dt, plant = 1200, 30.0, PLANTS["column"]
    reflux, feed = levels(rng, n, 2.4, 3.0, 30, 150), levels(rng, n, 0.45, 0.55, 80, 300)
    boil = reflux + levels(rng, n, 0.4, 0.6, 40, 200)

    t, u, y = run(
        plant, lambda k, y: np.array([reflux[k], boil[k]]), dt, n, 4,
        w=lambda t: feed[min(int(t / dt), n - 1)][None],
    )  # fmt: skip
    y = drop_outs(quantised(y + 2e-3 * rng.standard_normal(y.shape), 1e-3), rng, 0.02)
    return np.column_stack([t, u, feed, y])


class Building(Prior):
    """Room air and walls, electric heating, outdoor temperature and sun measured."""

    states = (Signal("T_i", "degC", -10, 50), Signal("T_m", "degC", -10, 50))
    inputs = (Signal("heat", "kW", 0, 10),)
    outputs = states[:1]
    disturbances = (Signal("T_o", "degC", -30, 40), Signal("sun", "kW/m^2", 0, 1.2))
    parameters = (
        Parameter("C_i", 2.0, "kWh/K", 0.3, 10.0, "air and furniture"),
        Parameter("C_m", 12.0, "kWh/K", 2.0, 60.0, "walls"),
        Parameter("H_im", 1.0, "kW/K", 0.1, 5.0, "air to walls"),
        Parameter("H_mo", 0.2, "kW/K", 0.02, 1.0, "walls to the outside"),
        Parameter("A_w", 4.0, "m^2", 0.5, 20.0, "windows"),
    )
    operating_point = OperatingPoint(x=(20.0, 18.0), u=(2.0,), w=(8.0, 0.0))

    def xdot(self, x, u, w, p):
        """Heat balances; hours to seconds."""
        flow = p.H_im * (x.T_i - x.T_m)
        return (
            (u.heat + p.A_w * w.sun - flow) / p.C_i / 3600,
            (flow - p.H_mo * (x.T_m - w.T_o)) / p.C_m / 3600,
        )


def building(seed: int, name: str = "building") -> Array:
    """Four heat stores, infiltration that the user forgot, a thermostat at times."""
    rng = np.random.default_rng([seed, 6])
    n, dt, plant = 1440, 600.0, PLANTS[name]
    hours = dt / 3600 * np.arange(n)
    outside = 5 + 6 * np.sin(2 * np.pi * (hours - 15) / 24) + np.cumsum(rng.standard_normal(n)) * 0.1
    sun = (
        np.maximum(np.sin(2 * np.pi * (hours - 6) / 24), 0)
        * np.repeat(rng.uniform(0.1, 0.9, n // 36 + 1), 36)[:n]
    )
    power = levels(rng, n, 0.0, 7.0, 12, 60)

    def weather(t: float) -> Array:
        k = min(int(t / dt), n - 1)
        return np.array([outside[k], sun[k]])

    t, u, y = run(plant, lambda k, y: power[k : k + 1], dt, n, 8, w=weather)
    y = drop_outs(quantised(y + 0.05 * rng.standard_normal(y.shape), 0.0625), rng, 0.03, 12)
    return np.column_stack([t, u, outside + 0.1 * rng.standard_normal(n), sun, y])


class BuildingWalls(Building):
    """The same with the walls' temperature measured."""

    outputs = Building.states


PROCESSES = (
    Machine(
        "heat_exchanger_2", HeatExchanger,
        DataSpec("t", ("hot_flow", "cold_flow"), ("hot_out", "cold_out"), 2.0, 6.0, 12.0, 30.0),
        heat_exchanger, "t,hot_flow,cold_flow,hot_out,cold_out", 200.0, {"V_h": 0.55, "V_c": 0.9, "UA": 2.0}, True,
    ),
    Machine(
        "quadruple_tank", QuadrupleTank, DataSpec("t", ("v1", "v2"), ("h1", "h2"), 4.0, 12.0, 40.0, 60.0),
        quadruple_tank, "t,v1,v2,h1,h2", 500.0,
        {"a12": 0.0042, "a34": 0.0066, "k1": 6e-4, "k2": 7e-4, "g1": 0.65, "g2": 0.6}, True,
    ),
    Machine(
        "bioreactor", Bioreactor,
        DataSpec("t", ("D",), ("X",), 600.0, 3600.0, 6000.0, 10800.0, units={"t": "h"}),
        bioreactor, "t,D,X", 100000.0, {"mu": 0.62, "K": 1.3, "Y": 0.47}, True,
    ),
    Machine(
        "evaporator", Evaporator,
        DataSpec("t", ("F2", "steam", "F200"), ("L", "P"), 12.0, 60.0, 120.0, 300.0, disturbances=("F1",)),
        evaporator, "t,F2,steam,F200,F1,L,P", 2400.0,
        {"A": 28.0, "M": 26.0, "C": 3.0, "UA": 0.2, "k": 0.0101}, True, True,
    ),
    Machine(
        "column", Column,
        DataSpec("t", ("reflux", "boil_up"), ("x_B", "x_D"), 60.0, 180.0, 600.0, 900.0, disturbances=("z_F",)),
        column, "t,reflux,boil_up,z_F,x_B,x_D", 6000.0, {"alpha": 4.0, "M": 5.0, "M_e": 14.0}, False,
    ),
    Machine(
        "building", Building,
        DataSpec("t", ("heat",), ("T_i",), 600.0, 3600.0, 3600.0, 7200.0, disturbances=("T_o", "sun")),
        building, "t,heat,T_o,sun,T_i", 86400.0,
        {"C_i": 1.85, "C_m": 17.0, "H_im": 0.7, "H_mo": 0.29, "A_w": 3.0}, False,
    ),
)  # fmt: skip
WHOLE = (
    replace(
        PROCESSES[1], name="quadruple_tank_levels", prior=QuadrupleTankLevels,
        spec=replace(PROCESSES[1].spec, outputs=("h1", "h2", "h3", "h4")),
        record=partial(quadruple_tank, name="quadruple_tank_levels"), header="t,v1,v2,h1,h2,h3,h4",
    ),
    replace(
        PROCESSES[5], name="building_walls", prior=BuildingWalls,
        spec=replace(PROCESSES[5].spec, outputs=("T_i", "T_m")), record=partial(building, name="building_walls"),
        header="t,heat,T_o,sun,T_i,T_m",
    ),
)  # fmt: skip
"""Two of them with every state of the prior measured."""
