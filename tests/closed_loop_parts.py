"""Controllers, filters and plants that the tests of closed loops share; no torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from online_models import PendulumPlant, pendulum_model

from hybrid_mpc.closed_loop import simulate
from hybrid_mpc.estimation import ExtendedKalmanFilter
from hybrid_mpc.mpc import OCP, CondensedController, SafeController

DT = 0.02
POINT = [0.0, 1.0], [0.0]


def make_ekf(model, sigma_d=2e-2):
    return ExtendedKalmanFilter(
        model, sigma_y=[1e-3], sigma_x=[1e-3, 1e-2], sigma_d=[sigma_d], sigma_x0=[1e-2, 0.1], sigma_d0=[0.1]
    )


def make_safe(model, *, horizon=20, bound=6.0, du_max=None, q=(300.0, 1.0), r=0.05):
    limit = None if du_max is None else [du_max]
    ocp = OCP(horizon, q, [r], [0.05], [-bound], [bound], limit, working_point=POINT)
    return SafeController(CondensedController(model, ocp), pendulum_model())


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
