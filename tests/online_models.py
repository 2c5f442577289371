"""Models and plants of the tests of the online half; no torch."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from hybrid_mpc import ExtendedKalmanFilter, HybridModel, Signal


def linear_model(a, b, c, dt=0.1, n_h=0):
    """Linear model over (x, h) from its matrices; the outputs are C x."""
    n_z, n_u = np.shape(b)
    n_x, n_y = n_z - n_h, len(c)
    x, h, u = ca.MX.sym("x", n_x), ca.MX.sym("h", n_h), ca.MX.sym("u", n_u)
    z = ca.DM(a) @ ca.vertcat(x, h) + ca.DM(b) @ u
    return HybridModel.of(
        "linear", dt,
        tuple(Signal(f"x{i}", "-") for i in range(n_x)),
        tuple(Signal(f"u{i}", "-") for i in range(n_u)),
        tuple(Signal(f"y{i}", "-") for i in range(n_y)),
        x=x, h=h, u=u, x_next=z[:n_x], h_next=z[n_x:], xdot=(z[:n_x] - x) / dt, y=ca.DM(c) @ x,
    )  # fmt: skip


def random_linear(seed, n_x=3, n_u=2, n_y=1, n_h=0, radius=0.98):
    """Random linear model of the given spectral radius."""
    rng = np.random.default_rng(seed)
    n_z = n_x + n_h
    a = rng.normal(size=(n_z, n_z))
    a *= radius / np.max(np.abs(np.linalg.eigvals(a)))
    b, c = rng.normal(size=(n_z, n_u)), rng.normal(size=(n_y, n_x))
    return linear_model(a, b, c, n_h=n_h), a, b, c


def runaway(bound):
    """``x+ = 1.5 x + u`` in the declared range ``-bound .. bound``; with inputs up to 0.1 it leaves 0.9 for 2,900."""
    x, u = ca.MX.sym("x"), ca.MX.sym("u")
    signal = Signal("x", "m", -bound, bound)
    return HybridModel.of(
        "runaway",
        1.0,
        (signal,),
        (Signal("u", "-"),),
        (signal,),
        x=x,
        u=u,
        y=x,
        x_next=1.5 * x + u,
        xdot=0.5 * x + u,
    )


def make_filter(model, **changes):
    """A filter of deviations that are the same for all states, outputs and inputs."""
    sigma = {
        "sigma_y": np.full(model.n_y, 0.1), "sigma_x": np.full(model.n_x, 0.05), "sigma_d": np.full(model.n_u, 0.02),
        "sigma_x0": np.full(model.n_x, 0.3), "sigma_d0": np.full(model.n_u, 0.2),
    }  # fmt: skip
    return ExtendedKalmanFilter(model, **{**sigma, **changes})


def pendulum_rhs(x, u, *, inertia=0.14, gravity=2.4, damping=0.02, friction=0.05, slope=20.0):
    """Pendulum with smoothed Coulomb friction; defaults are near a golf robot's."""
    acceleration = (u - gravity * ca.sin(x[0]) - damping * x[1] - friction * ca.tanh(slope * x[1])) / inertia
    return ca.vertcat(x[1], acceleration)


class StatePlant:
    """A plant whose state is that of the model; its step is a test's own. The first state is measured, exactly."""

    def reset(self, x0, seed):
        return np.array(x0, dtype=float)

    def measure(self, state, rng):
        return state[:1]

    def truth(self, state):
        return state

    def hidden(self, state):
        return np.zeros(0)


def rk4(f, x, dt, substeps=2):
    step = dt / substeps
    for _ in range(substeps):
        k1 = f(x)
        k2 = f(x + 0.5 * step * k1)
        k3 = f(x + 0.5 * step * k2)
        k4 = f(x + step * k3)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def pendulum_model(z=0, dt=0.02, seed=0, correction=0.3, **parameters):
    """Pendulum, RK4 with 2 substeps; z > 0 adds a random stable GRU cell that corrects the acceleration."""
    rng = np.random.default_rng(seed)
    x, h, u, rate = ca.MX.sym("x", 2), ca.MX.sym("h", z), ca.MX.sym("u"), ca.MX.sym("rate", 2)
    extra, h_next = 0, h
    if z:
        s = ca.vertcat(ca.sin(x[0]), ca.cos(x[0]), x[1], u, pendulum_rhs(x, u, **parameters)[1] / 10)
        wi = [ca.DM(rng.normal(size=(z, 5)) * 0.4) for _ in range(3)]
        wh = [ca.DM(rng.normal(size=(z, z)) * 0.5 / np.sqrt(z)) for _ in range(3)]
        sigmoid = lambda v: 0.5 * (1 + ca.tanh(0.5 * v))  # noqa: E731
        r, g = (sigmoid(wi[i] @ s + wh[i] @ h) for i in range(2))
        n = ca.tanh(wi[2] @ s + r * (wh[2] @ h))
        h_next = (1 - g) * n + g * h
        extra = correction * ca.DM(rng.normal(size=(1, z)) / np.sqrt(z)) @ h_next
    rhs = lambda v: pendulum_rhs(v, u, **parameters) + ca.vertcat(0, extra)  # noqa: E731
    return HybridModel.of(
        f"pendulum_{z}", dt,
        (Signal("phi", "rad", periodic=True), Signal("phi_dot", "rad/s")),
        (Signal("torque", "N m"),), (Signal("phi", "rad"),),
        x=x, h=h, u=u, x_next=rk4(rhs, x, dt, 2), h_next=h_next, xdot=rhs(x), y=x[0],
        rate=rate, energy=(0.14 * rate[1] - u) * x[1],
    )  # fmt: skip


@dataclass(frozen=True)
class PendulumPlant:
    """A pendulum of other parameters than the models', integrated by CVODES; 1 mrad of sensor noise."""

    noise: float = 1e-3
    disturbance: float = 0.0
    inertia: float = 0.16
    gravity: float = 2.9
    damping: float = 0.05
    friction: float = 0.09

    def _integrator(self, dt):
        x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
        rhs = pendulum_rhs(
            x, u + self.disturbance, inertia=self.inertia, gravity=self.gravity, damping=self.damping,
            friction=self.friction, slope=60.0,
        )  # fmt: skip
        options = {"abstol": 1e-9, "reltol": 1e-9}
        return ca.integrator("plant", "cvodes", {"x": x, "u": u, "ode": rhs}, 0, dt, options)

    def reset(self, x0, seed):
        return np.asarray(x0, dtype=float), self._integrator(0.02)

    def step(self, state, u, dt):
        assert dt == 0.02
        return state[1](x0=state[0], u=u)["xf"].full().ravel(), state[1]

    def measure(self, state, rng):
        return state[0][:1] + self.noise * rng.normal(size=1)

    def truth(self, state):
        return state[0]

    def hidden(self, state):
        return np.zeros(0)


def levitated_ball():
    """A ball under a coil (textbook): gap, speed and current; the force has a pole beyond the declared range."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    xdot = ca.vertcat(
        x[1], 1e3 * (9.81 - 70.0 * x[2] ** 2 / (x[0] + 6.0) ** 2 / 0.068), (u - 11.0 * x[2]) / 0.3
    )
    rates, x_next = ca.Function("rates", [x, u], [xdot]), x
    for _ in range(8):  # the midpoint rule, 0.5 ms each
        x_next = x_next + 5e-4 * rates(x_next + 2.5e-4 * rates(x_next, u), u)
    states = (
        Signal("gap", "mm", 0.0, 14.0),
        Signal("speed", "mm/s", -400.0, 400.0),
        Signal("current", "A", 0.0, 3.0),
    )
    current = float(np.sqrt(9.81 * 0.068 / 70.0) * 13.0)
    return HybridModel.of(
        "ball", 0.004, states, (Signal("voltage", "V", 0.0, 24.0),), (Signal("gap", "mm"),), x=x, u=u, x_next=x_next,
        xdot=xdot, y=x[0], nominal_x=[7.0, 0.0, current], nominal_u=[11.0 * current],
    )  # fmt: skip
