"""The parts of the benchmark of identification: every method runs, starts where the others do and is timed alike."""

import math
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import load_scenario
from hybrid_mpc.identify.simulation import Simulation
from scenarios.pendulum.data import exact_runs
from scenarios.pendulum.prior import PendulumPrior

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import identifiers as own

DT, WARM = 0.01, 20
MACHINES = ("golf_robot", "unbalanced_disk", "torque_pendulum", "emps")


@cache
def tiny():
    """The paper's pendulum, exact data: what fits its prior must predict it."""
    train, valid, test = (exact_runs(role, 1) for role in ("train", "valid", "test"))
    cut = [tuple(t.part(slice(0, 150)) for t in part) for part in (train, valid, test)]
    settings = {"hidden": 4, "networks": 1, "teacher_steps": 10, "free_run_steps": 0, "horizon": 10}
    return own.Problem(
        SimpleNamespace(prior=PendulumPrior), DT, WARM, cut[0], cut[1], cut[1], cut[2], None, 0.0, settings
    )


def watched(name, limit=2.0):
    """A method on the pendulum; not a millisecond of its looks counts."""
    problem = tiny()
    watch = own.watched(problem, name, 0, limit)
    seconds = [s for s, _, _ in watch.points]
    assert seconds == sorted(seconds)
    assert all(math.isfinite(valid) for _, valid, _ in watch.points)
    return watch, float(np.std(np.concatenate([t.y for t in problem.test_runs])))


@pytest.mark.parametrize("machine", MACHINES)
def test_a_prior_walked_in_numpy_is_the_prior(machine):
    prior = load_scenario(machine).prior()
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(2, 7)), rng.normal(size=(1, 7))
    found = own.walked(prior.equations.xdot, np)(list(x), list(u), [], list(prior.p))
    exact = prior.equations.xdot(x, u, np.zeros((0, 7)), prior.p).full()
    np.testing.assert_allclose(np.stack(np.broadcast_arrays(*found)), exact, rtol=1e-13, atol=1e-13)


def test_a_prior_walked_in_jax_is_the_prior():
    jax = pytest.importorskip("jax", reason="jax-sysid is not installed")
    jax.config.update("jax_enable_x64", True)
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    f = ca.Function(
        "f", [x, u], [ca.vertcat(ca.tanh(x[0]) * ca.fabs(u), ca.if_else(x[1] > 0, x[1] ** 2, 1 / x[1]))]
    )
    point = [np.array([0.3, -2.0]), np.array([1.5, -0.5])], [np.array([-2.0, 2.0])]
    exact = f(np.stack(point[0]), point[1][0][None]).full()
    np.testing.assert_allclose(np.stack(own.walked(f, jax.numpy)(*point)), exact, rtol=1e-14)


def test_the_rivals_simulate_the_same_prior():
    prior = load_scenario("golf_robot").prior()
    box = own.GreyBox(prior, 0.02, 0.0, np)
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(3, 2)), rng.uniform(-0.3, 0.3, (3, 30, 1))
    theta = np.array([prior.p[i] for i in box.free]) / box.size
    exact = Simulation(prior.equations.xdot, 0.02).values(x, u, np.zeros((3, 30, 0)), prior.p, box.substeps)
    np.testing.assert_allclose(box.run(x, u, theta), exact[..., :1], rtol=1e-11, atol=1e-12)


def test_a_late_input_lies_between_two_samples_of_the_past():
    box = own.GreyBox(load_scenario("unbalanced_disk").prior(), 0.025, 0.06, np)
    theta = box.first.copy()
    theta[-1] = 1.25  # periods
    u = box.lagged(np.arange(6.0)[:, None])
    (acting,), _, _ = box.point(u, theta)
    # a ramp of 1 a period, 1.25 periods late; before the recording its first sample goes on
    np.testing.assert_allclose(acting, [0.0, 0.0, 0.75, 1.75, 2.75, 3.75], atol=1e-12)


def test_the_first_state_is_found_from_the_warm_up():
    t = 0.1 * np.arange(30)

    def swing(x, u):
        """A pendulum without losses whose frequency falls with its swing: first angle and speed to angles."""
        w = 2.0 - 0.1 * (x**2).sum(1, keepdims=True)
        return (x[:, :1] * np.cos(w * t) + x[:, 1:] / w * np.sin(w * t))[..., None]

    x = np.array([[0.4, -1.0], [-0.2, 1.5]])
    u = np.zeros((2, 30, 1))
    found = own.fitted_states(swing, swing(x, u), u, np.zeros((2, 2)), np.ones(2), steps=12)
    np.testing.assert_allclose(found, x, atol=1e-4)  # data without noise; the damping leaves that


def test_least_squares_finds_the_pendulum():
    watch, spread = watched("least_squares", 10.0)
    # exact data, the prior's own equations: what is left is that of the first states
    assert watch.at(10.0) < 1e-2 * spread


@pytest.mark.parametrize("name", ["jax-sysid grey", "jax-sysid black", "SUBNET"])
def test_the_rivals_run(name, tmp_path, monkeypatch):
    pytest.importorskip(own.NEEDS[name], reason=f"{own.NEEDS[name]} is not installed")
    monkeypatch.setenv("HOME", str(tmp_path))  # deepSI's checkpoints
    watch, _ = watched(name)
    assert watch.points
