"""Five simulated machines that their priors describe exactly, for what a fit says of its own errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from hybrid_mpc import Parameter, Prior, Signal, Trajectory
from unknown.common import Array, levels
from unknown.independent import Runs, Windows

SUBSTEPS = 4
Control = Callable[[Array, float], float]


class TwoLags(Prior):
    """A slow and a fast lag one behind the other; the first has no sensor."""

    states = (Signal("first", "V", -10, 10), Signal("second", "V", -10, 10))
    inputs = (Signal("u", "V", -2, 2),)
    outputs = states[1:]
    parameters = (
        Parameter("a", 1.5, "1/s", 1.0, 4.0),
        Parameter("b", 0.6, "1/s", 0.2, 1.0),
        Parameter("c", 1.0, "-", 0.2, 6.0),
    )

    def xdot(self, x, u, w, p):
        """Two lags."""
        return p.a * (p.c * u.u - x.first), p.b * (x.first - x.second)


class Swing(Prior):
    """A driven pendulum; the angle is measured."""

    states = (Signal("phi", "rad", -4, 4), Signal("phi_dot", "rad/s", -15, 15))
    inputs = (Signal("u", "N m", -3, 3),)
    outputs = states[:1]
    parameters = (
        Parameter("g", 7.0, "1/s^2", 2.0, 30.0),
        Parameter("d", 0.8, "1/s", 0.05, 4.0),
        Parameter("k", 5.0, "1/(kg m^2)", 1.0, 20.0),
    )

    def xdot(self, x, u, w, p):
        """Gravity, damping, torque."""
        return x.phi_dot, -p.g * ca.sin(x.phi) - p.d * x.phi_dot + p.k * u.u


class Tanks(Prior):
    """Two tanks one below the other; the lower level is measured."""

    states = (Signal("upper", "m", 0.0, 2.0), Signal("lower", "m", 0.0, 2.0))
    inputs = (Signal("q", "m/s", 0.0, 0.05),)
    outputs = states[1:]
    parameters = (
        Parameter("a", 0.02, "sqrt(m)/s", 0.005, 0.08),
        Parameter("b", 0.03, "sqrt(m)/s", 0.005, 0.08),
        Parameter("k", 1.0, "-", 0.3, 3.0),
    )

    def xdot(self, x, u, w, p):
        """Outflows by Torricelli."""
        upper, lower = (ca.sqrt(ca.fmax(h, 1e-3)) for h in x)
        return p.k * u.q - p.a * upper, p.a * upper - p.b * lower


class Heater(Prior):
    """A heater that radiates and its sensor's lag."""

    states = (Signal("T", "degC", 0, 300), Signal("T_s", "degC", 0, 300))
    inputs = (Signal("u", "%", 0, 100),)
    outputs = states[1:]
    parameters = (
        Parameter("k", 0.03, "K/(s %)", 0.005, 0.2),
        Parameter("h", 0.006, "1/s", 0.001, 0.05),
        Parameter("e", 4e-12, "1/(s K^3)", 0.0, 4e-11),
        Parameter("tau", 15.0, "s", 3.0, 60.0),
    )

    def xdot(self, x, u, w, p):
        """Convection, radiation, lag."""
        hot, room = x.T + 273.15, 293.15
        return p.k * u.u - p.h * (x.T - 20.0) - p.e * (hot**4 - room**4), (x.T - x.T_s) / p.tau


class Upright(Prior):
    """A pendulum held upright by a controller; unstable."""

    states = (Signal("phi", "rad", -1, 1), Signal("phi_dot", "rad/s", -5, 5))
    inputs = (Signal("u", "N m", -5, 5),)
    outputs = states[:1]
    parameters = (
        Parameter("g", 12.0, "1/s^2", 3.0, 40.0),
        Parameter("d", 0.5, "1/s", 0.0, 3.0),
        Parameter("k", 6.0, "1/(kg m^2)", 2.0, 30.0),
    )

    def xdot(self, x, u, w, p):
        """Gravity, damping, torque."""
        return x.phi_dot, p.g * ca.sin(x.phi) - p.d * x.phi_dot + p.k * u.u


@dataclass(frozen=True)
class Simulated:
    """A machine whose recordings its own prior makes.

    Args:
        prior: The prior.
        truth: Parameters of the recordings.
        dt: Period [s].
        noise: Of the measured output [its unit].
        inputs: Least and largest input, and the shortest and longest time [periods] that one is held.
        first: State at the start.
        control: Input by the measured output and its slope; none: open loop.
        length: Length [s] of the free runs that compare.
    """

    prior: type[Prior]
    truth: Mapping[str, float]
    dt: float
    noise: float
    inputs: tuple[float, float, int, int]
    first: tuple[float, ...]
    control: Control | None = None
    length: float = 5.0

    @property
    def name(self) -> str:
        """Its name."""
        return self.prior.__name__

    def record(self, seed: int, samples: int = 200, role: str = "train") -> tuple[Trajectory, Array]:
        """A recording, and its true first state."""
        rng = np.random.default_rng([seed, 5])
        low, high, shortest, longest = self.inputs
        push = levels(rng, samples, low, high, shortest, longest)
        x = np.array(self.first) * rng.uniform(0.7, 1.3, len(self.first))
        first, period, p = x, _period(self.prior, self.dt), np.array([*self.truth.values()])
        noise, u, y, last, speed = self.noise * rng.standard_normal(samples), [], [], None, 0.0
        place = [s.name for s in self.prior.states].index(self.prior.outputs[0].name)
        for k in range(samples):
            y.append(x[place] + noise[k])
            speed += 0.0 if last is None else 0.5 * ((y[-1] - last) / self.dt - speed)
            last = y[-1]
            u.append(push[k] + (self.control(np.array([y[-1], speed]), k * self.dt) if self.control else 0.0))
            x = period(x, u[-1], p).full()[:, 0]
        nothing = np.full((samples, len(x)), np.nan)
        made = Trajectory(
            f"run{seed}", role, self.dt, self.dt * np.arange(samples), np.array(u)[:, None], np.array(y)[:, None],
            nothing, nothing,
        )  # fmt: skip
        return made, first


@cache
def _period(prior: type[Prior], dt: float) -> ca.Function:
    own, h = prior(), dt / SUBSTEPS
    x, u, p = (ca.SX.sym(key, len(own.names_of(key))) for key in ("x", "u", "p"))
    after: Any = x
    for _ in range(SUBSTEPS):
        k1 = own.equations.xdot(after, u, [], p)
        k2 = own.equations.xdot(after + h / 2 * k1, u, [], p)
        k3 = own.equations.xdot(after + h / 2 * k2, u, [], p)
        after = after + h / 6 * (k1 + 2 * k2 + 2 * k3 + own.equations.xdot(after + h * k3, u, [], p))
    return ca.Function("period", [x, u, p], [after])


def cramer_rao(machine: Simulated, runs: list[tuple[Trajectory, Array]]) -> Array:
    """Standard errors that no unbiased estimate undercuts, of parameters with free first states."""
    prior, truth = machine.prior(), np.array([*machine.truth.values()])
    own = Runs(prior, machine.dt, np.array([machine.noise]), SUBSTEPS)
    information = np.zeros((len(truth), len(truth)))
    for t, first in runs:
        windows = Windows(t.y[None], t.u[None], np.zeros((1, len(t.t), 0)), first[None])
        steps = [*(1e-7 * truth), *(1e-7 * own.sizes)]
        slopes = []
        for k, h in enumerate(steps):
            ends = []
            for sign in (1, -1):
                z = np.concatenate([truth, first])
                z[k] += sign * h
                ends.append(own.outputs(z[None, : len(truth)], z[None, len(truth) :], windows).ravel())
            slopes.append((ends[0] - ends[1]) / (2 * h) / machine.noise)
        by, states = np.stack(slopes[: len(truth)], 1), np.stack(slopes[len(truth) :], 1)
        left = by - states @ np.linalg.lstsq(states, by, rcond=None)[0]
        information += left.T @ left
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


MACHINES = (
    Simulated(TwoLags, {"a": 1.2, "b": 0.8, "c": 2.0}, 0.1, 0.02, (-1.0, 1.0, 5, 5), (0.5, 0.5)),
    Simulated(Swing, {"g": 9.5, "d": 0.6, "k": 8.0}, 0.05, 0.01, (-0.35, 0.35, 6, 25), (0.5, 0.0)),
    Simulated(Tanks, {"a": 0.03, "b": 0.025, "k": 1.4}, 4.0, 0.005, (0.004, 0.018, 8, 30), (0.4, 0.5), length=200.0),
    Simulated(
        Heater, {"k": 0.045, "h": 0.0045, "e": 6e-12, "tau": 22.0}, 5.0, 0.3, (0.0, 40.0, 12, 50), (60.0, 60.0),
        length=300.0,
    ),
    Simulated(
        Upright, {"g": 9.0, "d": 0.3, "k": 8.5}, 0.02, 0.003, (-0.6, 0.6, 3, 12), (0.05, 0.0),
        lambda z, t: float(np.clip(-3.5 * z[0] - 0.7 * z[1], -4, 4)), 1.0,
    ),
)  # fmt: skip
