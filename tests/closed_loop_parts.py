"""Controllers, filters and plants that the tests of closed loops share; no torch."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from online_models import PendulumPlant, pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    ExtendedKalmanFilter,
    LoopRow,
    Runner,
    SafeController,
    simulate,
)
from hybrid_mpc.control.safeguard import Source

DT = 0.02
POINT = [0.0, 1.0], [0.0]


def make_ekf(model, sigma_d=2e-2):
    return ExtendedKalmanFilter(
        model, sigma_y=[1e-3], sigma_x=[1e-3, 1e-2], sigma_d=[sigma_d], sigma_x0=[1e-2, 0.1], sigma_d0=[0.1]
    )


def make_safe(model, *, horizon=20, bound=6.0, du_max=None, q=(300.0, 1.0), r=0.05):
    limit = None if du_max is None else [du_max]
    ocp = OCP(horizon, q, [r], [0.05], [-bound], [bound], limit, working_point=POINT)
    return SafeController(CondensedController(model, ocp), pendulum_model(), safe_input=[0.0])


def loop_row(task="a", controller="prior", seed=0, cost=1.0, **fields):
    """The row of a loop in which nothing happened."""
    none = {
        "tracking_rmse": {"phi [rad]": 0.0}, "largest_x": {}, "largest_u": {}, "limits": {}, "excess": {},
        "sources": {s.name: float(s is Source.MPC) for s in Source}, "figures": {}, "alarms": None, "alarm_share": None,
        "largest_violation": None, "invalid_s": 0.0, "switches": (), "timing_ms": {}, "seconds": 1.0,
    }  # fmt: skip
    return LoopRow(task, controller, seed, cost=cost, **{**none, **fields})


def sine(t, amplitude=0.5, omega=2.0):
    return np.column_stack([amplitude * np.sin(omega * t), amplitude * omega * np.cos(omega * t)])


def hold(t, phi=0.4):
    return np.column_stack([np.full(len(t), phi), np.zeros(len(t))])


@dataclass(frozen=True)
class Recorder:
    """A plant that notes what reaches it, and else is another plant."""

    plant: PendulumPlant
    inputs: list

    def step(self, state, u, dt):
        self.inputs.append(u.copy())
        return self.plant.step(state, u, dt)

    def __getattr__(self, name):
        return getattr(self.plant, name)


def run(model, safe, **changes):
    """A short closed loop of the mismatched pendulum; ``changes`` are arguments of ``simulate``."""
    arguments = {
        "plant": PendulumPlant(), "estimator": make_ekf(model), "controller": safe, "reference": sine,
        "dt": DT, "duration": 0.6, "x0": [0.1, 0.0], "seed": 0,
    }  # fmt: skip
    arguments |= changes
    head = [arguments.pop(name) for name in ("plant", "estimator", "controller", "reference")]
    return simulate(*head, **arguments)


@dataclass
class FakeClock:
    """Stands still but for sleeping and what a test adds."""

    t: float = 5.0

    def now(self):
        return self.t

    def sleep_until(self, t):
        self.t = max(self.t, t)


@dataclass
class Rig:
    """A plant behind two callbacks: advances by a period with each input, the one before measured then."""

    plant: PendulumPlant = field(default_factory=PendulumPlant)
    seed: int = 0
    gaps: tuple = ()

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        self.state = self.plant.reset(np.array([0.1, 0.0]), self.seed)
        self.u, self.y = [], []

    def measure(self):
        if self.u:
            self.state = self.plant.step(self.state, self.u[-1], DT)
        y = self.plant.measure(self.state, self.rng)
        self.y.append(y)
        return None if len(self.y) - 1 in self.gaps else y

    def actuate(self, u):
        self.u.append(u)


@dataclass
class LateRig(Rig):
    """A rig whose inputs act some periods late; before the first the input was zero."""

    delay: int = 1

    def measure(self):
        if self.u:
            acting = self.u[-1 - self.delay] if len(self.u) > self.delay else np.zeros(1)
            self.state = self.plant.step(self.state, acting, DT)
        return self.plant.measure(self.state, self.rng)


def make_runner(model, safe, rig, clock=None, **options):
    return Runner(rig.measure, rig.actuate, options.pop("estimator", None) or make_ekf(model), safe,
                  options.pop("reference", sine), clock=clock or FakeClock(), **options)  # fmt: skip


@dataclass(frozen=True)
class ScriptedReading:
    """A reading."""

    alarm: bool
    frozen: bool = False
    violation_w: float = 0.0
    share: float = 0.0


class ScriptedMonitor:
    """A monitor that alarms in the given periods; its state counts them."""

    def __init__(self, alarms=(), frozen=()):
        self._alarms, self._frozen = alarms, frozen

    def initial(self):
        return 0

    def update(self, state, y, u_prev, estimate):
        frozen = any(a <= state < b for a, b in self._frozen)
        return state + 1, ScriptedReading(frozen or any(a <= state < b for a, b in self._alarms), frozen)
