"""A pendulum whose faults are known, and estimators, that the tests of the monitor share; no torch."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from online_models import rk4

from hybrid_mpc import ChannelLimit, EnergyReadings, HybridModel, Monitor, Parameter, Signal, WatchLimits

DT, J, MGL, GAMMA = 0.02, 0.1, 1.5, 0.15


def pendulum(
    friction: float = GAMMA, push: float = 0.0, dry: float = 0.0, inertia: float = J, mgl: float = MGL
) -> HybridModel:
    x, u, rate, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("rate", 2), ca.MX.sym("p", 3)

    def torque(x):
        return u + push - p[1] * ca.sin(x[0]) - p[2] * x[1] - dry * ca.tanh(x[1] / 0.02)

    def rhs(x):
        return ca.vertcat(x[1], torque(x) / p[0])

    return HybridModel.of(
        "pendulum", DT, (Signal("phi", "rad"), Signal("phi_dot", "rad/s")), (Signal("tau", "N m"),),
        (Signal("phi", "rad"),),
        x=x, u=u, p=p, x_next=rk4(rhs, x, DT, 4), xdot=rhs(x), y=x[0], rate=rate,
        energy=(p[0] * rate[1] - torque(x)) * x[1],
        parameters=(
            Parameter("J", inertia, "kg m^2", 0.0, 100.0), Parameter("mgl", mgl, "N m", 0.0, 100.0),
            Parameter("gamma", friction, "N m s", 0.0, 100.0),
        ),
    )  # fmt: skip


def energy(model=None, limits=None, *, resolution=None, window=5, free_run=0.0, **options) -> Monitor:
    """A monitor of the energy, by default with the shortest window and without free runs."""
    readings = EnergyReadings(model or pendulum(), window=window, free_run=free_run, **options)
    return Monitor(readings, limits, resolution=resolution)


def by_hand(*channels: ChannelLimit, dt=DT, **options) -> WatchLimits:
    """Limits of the energy of one degree of freedom, and no test for freezing."""
    return WatchLimits("energy", dt, channels, (np.inf,), (0,), **options)


def of_force(threshold, release=None, scale=1.0, drift=0.0, length=0) -> ChannelLimit:
    """A limit of the pendulum's force; ``scale`` is its constant variance [N^2 m^2]."""
    coefficients = (scale, 0.0, 0.0, 0.0)
    return ChannelLimit(
        "force of phi", "N m", length, threshold, release or 0.5 * threshold, coefficients, drift
    )


@dataclass(frozen=True)
class Estimate:
    x: np.ndarray
    h: np.ndarray
    d: np.ndarray


@dataclass(frozen=True)
class Run:
    t: np.ndarray
    y: np.ndarray
    u: np.ndarray
    x: np.ndarray


class Exact:
    """Knows the true states of a run."""

    def __init__(self, run):
        self.run, self.k = run, 0

    def start(self, y, t):
        self.k = 0
        return Estimate(self.run.x[0], np.zeros(0), np.zeros(1))

    def update(self, estimate, y, u_prev):
        self.k += 1
        return Estimate(self.run.x[self.k], np.zeros(0), np.zeros(1))


class Observer:
    """A Luenberger observer with disturbance: exact model prediction, fixed gains (poles near 0.7)."""

    def __init__(self, model):
        self.model = model

    def start(self, y, t):
        return Estimate(np.array([y[0], 0.0]), np.zeros(0), np.zeros(1))

    def update(self, estimate, y, u_prev):
        m = self.model
        x = m.step(estimate.x, estimate.h, u_prev + estimate.d, m.w, m.p)[0].full().ravel()
        e = y[0] - x[0]
        return Estimate(x + np.array([0.6, 5.0]) * e, np.zeros(0), estimate.d + 3.0 * e)


def simulate(n, seed=0, fault=None, at=10**9, noise=0.0, kind="sine"):
    rng = np.random.default_rng(seed)
    t = np.arange(n) * DT
    u = 0.8 * np.sin(2 * np.pi * 0.5 * t) + 0.5 * np.sin(2 * np.pi * 0.37 * t + seed)
    if kind == "steps":
        u = rng.choice([-1.2, 1.2], n // 7 + 1).repeat(7)[:n]
    if kind == "rest":
        u = np.zeros(n)
    model, broken = pendulum(), fault or pendulum()
    x = np.zeros((n, 2))
    for k in range(n - 1):
        acting = broken if k >= at else model
        x[k + 1] = acting.step(x[k], [], u[k], acting.w, acting.p)[0].full().ravel()
    return Run(t, x[:, :1] + noise * rng.standard_normal((n, 1)), u[:, None], x)


NOISE = 1e-4  # rad: an encoder of about 14 bits
