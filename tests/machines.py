"""Small machines that are no pendulum: rest that is not zero, several inputs and outputs, measured disturbances."""

from dataclasses import replace

import casadi as ca
import numpy as np
from online_models import StatePlant, rk4
from scipy.optimize import brentq

from hybrid_mpc import Disturbance, ExtendedKalmanFilter, HybridModel, Signal

AREA, PIPE, GRAVITY = 0.02, 1.2e-4, 9.81
LEVEL, PUMP, INFLOW = 0.30, 1.8e-4, 4e-5
"""Levels [m], the pump's flow [m^3/s] and the measured inflow of the lower tank [m^3/s] of the operating point."""


def _model(name, dt, states, inputs, outputs, rates, y, *, w=None, **options):
    """A model of rates ``f(x, u, w)``."""
    x, u = ca.SX.sym("x", len(states)), ca.SX.sym("u", len(inputs))
    ws = ca.SX.sym("w", len(w or ()))
    given = {"w": ws, "disturbances": w} if w else {}
    return HybridModel.of(
        name, dt, states, inputs, outputs, x=x, u=u, xdot=rates(x, u, ws), y=y(x, u, ws),
        x_next=rk4(lambda z: rates(z, u, ws), x, dt), **given, **options,
    )  # fmt: skip


def outflow(level):
    return PIPE * ca.sqrt(2 * GRAVITY * ca.fmax(level, 1e-4))


def two_tanks(dt=5.0, **options):
    """A pump fills the upper tank, which drains into the lower one, whose level is measured; an inflow ``w`` fills the
    lower one too, and is measured.
    """
    upper, lower = rest_levels()
    return _model(
        "two tanks", dt, (Signal("upper", "m", 0.0, 2.0), Signal("lower", "m", 0.0, 2.0)), (Signal("pump", "m^3/s"),),
        (Signal("lower", "m"),),
        lambda x, u, w: ca.vertcat((u[0] - outflow(x[0])) / AREA, (outflow(x[0]) + w[0] - outflow(x[1])) / AREA),
        lambda x, u, w: x[1], w=(Signal("inflow", "m^3/s"),), nominal_x=(upper, lower), nominal_u=(PUMP,),
        nominal_w=(INFLOW,), **options,
    )  # fmt: skip


def rest_levels(pump=PUMP, inflow=INFLOW):
    """Levels at which the tanks rest."""
    return level_of(pump), level_of(pump + inflow)


def level_of(flow):
    """Level from which this much flows out."""
    return brentq(lambda level: float(outflow(level)) - flow, 1e-3, 5.0)


def dc_motor(dt=0.005, **options):
    """Voltage in; current and speed out. Both states are of first order. It turns at 20 rad/s against a steady load."""
    resistance, inductance, constant, inertia, damping, load = 1.0, 0.01, 0.1, 2e-3, 1e-3, 0.05
    speed = 20.0
    current = (damping * speed + load) / constant
    voltage = resistance * current + constant * speed
    return _model(
        "motor", dt, (Signal("current", "A"), Signal("speed", "rad/s")), (Signal("voltage", "V"),),
        (Signal("current", "A"), Signal("speed", "rad/s")),
        lambda x, u, w: ca.vertcat(
            (u[0] - resistance * x[0] - constant * x[1]) / inductance,
            (constant * x[0] - damping * x[1] - load) / inertia,
        ),
        lambda x, u, w: x, nominal_x=(current, speed), nominal_u=(voltage,), **options,
    )  # fmt: skip


AMBIENT, HEAT = 20.0, np.array([8.0, 5.0])


def thermal(dt=10.0, **options):
    """Two heaters, two temperatures that are coupled; the ambient temperature is far from zero."""
    gains = np.array([[1.0, 0.3], [0.25, 0.8]])
    loss = np.array([[0.05, -0.015], [-0.015, 0.04]])
    capacity = 40.0
    rest = AMBIENT + np.linalg.solve(loss, gains @ HEAT) / 10
    states = (Signal("t1", "C", -50.0, 300.0), Signal("t2", "C", -50.0, 300.0))
    return _model(
        "thermal", dt, states, (Signal("heater_1", "W"), Signal("heater_2", "W")), states,
        lambda x, u, w: (gains @ u - 10 * loss @ (x - AMBIENT)) / capacity, lambda x, u, w: x,
        nominal_x=tuple(rest), nominal_u=tuple(HEAT), **options,
    )  # fmt: skip


def observer(model, sigma_d=None, *, sigma_y=1e-3, sigma_x0=0.1):
    """A filter whose deviations are the same for all outputs and states."""
    return ExtendedKalmanFilter(
        model, sigma_y=[sigma_y] * model.n_y, sigma_x=[1e-4] * model.n_x, sigma_x0=[sigma_x0] * model.n_x,
        sigma_d=sigma_d, sigma_d0=sigma_d,
    )  # fmt: skip


class MachinePlant(StatePlant):
    """A machine that is a model, with loads on its inputs, leaks of its states [1/s] and white noise of its sensors."""

    def __init__(self, model, load=0.0, leak=0.0, offset=0.0, sigma=0.0):
        self._model, self._load, self._leak, self._offset, self._sigma = model, load, leak, offset, sigma

    def step(self, state, u, dt, w=None):
        m = self._model
        self._u, self._w = u, m.w if w is None else w
        x = m.step(state, [], u + self._load, self._w, m.p)[0].full().ravel()
        return x + self._leak * np.ones(m.n_x) * dt

    def measure(self, state, rng):
        m = self._model
        y = m.output(state, getattr(self, "_u", m.u0), getattr(self, "_w", m.w), m.p).full().ravel()
        return y + self._offset + self._sigma * rng.normal(size=m.n_y)


def ventilated():
    """A sunny room cooled by a vent: its effect saturates, and a motor opens it in minutes."""
    x, u, w = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("w", 2)
    exchange = 0.55 + 0.043 * x[1] / ca.sqrt(1.0 + 0.0017 * x[1] ** 2)
    xdot = ca.vertcat((0.015 * w[1] - exchange * (x[0] - w[0])) / 1200.0, (u - x[1]) / 150.0)
    air, percent = Signal("T", "degC", -5.0, 45.0), Signal("vent", "%", 0.0, 100.0)
    return HybridModel.of(
        "room", 120.0, (air, replace(percent, name="opening")), (percent,), (air,), x=x, u=u, w=w, y=x[0],
        x_next=x + 120.0 * xdot, xdot=xdot, disturbances=(Signal("out", "degC"), Signal("sun", "W/m^2")),
        nominal_w=(15.0, 300.0), nominal_x=(18.7084, 20.0), nominal_u=(20.0,),
    )  # fmt: skip


def heated():
    """A room with a heater and a vent that cools most half open; a motor moves the vent. A load heats the room."""
    x, u, w = ca.MX.sym("x", 2), ca.MX.sym("u", 2), ca.MX.sym("w", 2)
    exchange = 0.55 + 0.06 * x[1] * (1.0 - 0.01 * x[1])
    xdot = ca.vertcat((0.12 * u[0] + 0.015 * w[1] - exchange * (x[0] - w[0])) / 1200.0, (u[1] - x[1]) / 150.0)
    air, percent = Signal("T", "degC", -5.0, 45.0), Signal("heater", "%", 0.0, 100.0)
    return HybridModel.of(
        "heated", 60.0, (air, replace(percent, name="opening")), (percent, replace(percent, name="vent")), (air,),
        x=x, u=u, w=w, y=x[0], x_next=x + 60.0 * xdot, xdot=xdot,
        disturbances=(Signal("out", "degC"), Signal("sun", "W/m^2")), nominal_w=(10.0, 100.0),
        nominal_x=(18.0, 10.0), nominal_u=((1.09 * 8.0 - 1.5) / 0.12, 10.0),
        disturbance_model=(Disturbance("rate", "T", 1e-3),),
    )  # fmt: skip
