"""A pendulum with known parameters, simulated by an integrator of its own: data for these tests."""

from dataclasses import replace

import numpy as np
import pytest
from example_priors import Swing
from scipy.integrate import solve_ivp

from hybrid_mpc import TrainingSettings, Trajectory, train

DT = 0.02
TRUTH = {"J": 0.1, "mgl": 1.2, "d": 0.05}
SMALL = TrainingSettings(
    "mopgrnn", 4, 2, 20, 20, seed=3, warm=10, horizon=20, batch=8, every=10, learning_rates=(1e-2, 1e-3, 5e-3, 1e-4)
)  # fmt: skip
"""A training of a second."""


class Pendulum(Swing):
    """The prior that these runs are for."""


def record(seed, seconds=4.0, role="train", extra=lambda phi, v: 0.0, noise=0.0, size=0.6):
    """A run under random steps of torque; ``extra`` [N m] is a torque that the prior lacks."""
    rng, n = np.random.default_rng(seed), round(seconds / DT)
    u = np.repeat(rng.uniform(-size, size, n // 20 + 1), 20)[:n, None]
    x = np.empty((n, 2))
    x[0] = rng.uniform(-1, 1, 2)

    def f(_, x, u):
        phi, v = x
        torque = u - TRUTH["mgl"] * np.sin(phi) - TRUTH["d"] * v + extra(phi, v)
        return [v, torque / TRUTH["J"]]

    for k in range(n - 1):  # a new start at every step of u keeps the integrator's tolerance
        x[k + 1] = solve_ivp(f, (0, DT), x[k], args=(u[k, 0],), rtol=1e-10, atol=1e-12).y[:, -1]
    xdot = np.array([f(0, *pair) for pair in zip(x, u[:, 0], strict=True)])
    x = x + noise * rng.standard_normal(x.shape)
    return Trajectory(f"run{seed}", role, DT, DT * np.arange(n), u, x[:, :1], x, xdot)


def drag(phi, v):
    """A torque [N m] that the prior lacks."""
    return -0.08 * np.tanh(v / 0.5)


def dragged():
    """Two runs to train on and one to validate with, under that torque."""
    runs = [record(seed, seconds=3.0, extra=drag) for seed in range(3)]
    return runs[:2], [replace(runs[2], role="valid")]


class Killed(Exception):
    """What a test raises in the middle of a training."""


def killed_and_resumed(at, file, *data, **options):
    """A training that is killed after ``at`` steps and goes on from its checkpoint; the steps seen after that."""

    def kill(done, total, error):
        if done == at:
            raise Killed

    seen = []
    with pytest.raises(Killed):
        train(*data, checkpoint=file, on_progress=kill, **options)
    resumed = train(
        *data, checkpoint=file, on_progress=lambda done, total, error: seen.append(done), **options
    )
    return resumed, seen


def same_training(one, two):
    """Settings, scaling, weights, curves and validation agree to the last bit."""
    assert one.settings == two.settings
    assert one.scaling == two.scaling
    for name, weight in one.weights.items():
        np.testing.assert_array_equal(weight, two.weights[name])
    for name, column in one.curve.items():
        np.testing.assert_array_equal(column, two.curve[name])
    np.testing.assert_array_equal(one.validation, two.validation)
