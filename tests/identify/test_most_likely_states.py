"""The most likely trajectory: the minimum that another solver finds, exact slopes, a cost that only falls, no estimate
that runs away, outliers that count little, one result in any order.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

from hybrid_mpc import InputError, Prior, Signal, Trajectory, fit_smoother
from hybrid_mpc.data.scales import Sizes
from hybrid_mpc.identify.horizon import HUBER, Horizon, Stretches, _Linearized
from hybrid_mpc.identify.smooth import Smoother
from tests.simulated_pendulum import DT, TRUTH, Pendulum, record

SIGMA, WALK, N = 0.02, 0.3, 25


def rates(z, u):
    """Rates of the pendulum's ``(phi, phi_dot, d)`` from its documented equation."""
    phi, v, d = z
    own = Pendulum(TRUTH).equations.xdot([phi, v], u, [], Pendulum(TRUTH).p).full().ravel()
    return np.array([own[0], own[1] + d, 0.0])


def period(z, u):
    """Runge-Kutta of order 4 over a period."""
    k1 = rates(z, u)
    k2 = rates(z + 0.5 * DT * k1, u)
    k3 = rates(z + 0.5 * DT * k2, u)
    k4 = rates(z + DT * k3, u)
    return z + DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def problem(fading=0.9, **changed):
    inf = np.full(3, np.inf)
    values = {
        "equations": Pendulum(TRUTH).equations, "corrected": (1,), "p": np.array(Pendulum(TRUTH).p), "dt": DT,
        "substeps": 1, "fading": fading, "sigma": np.array([SIGMA]), "process": np.array([1e-3, 2e-3, WALK]),
        "spread": np.array([0.5, 2.0, 3.0]), "size": np.array([1.0, 2.0, 10.0]), "lower": -inf, "upper": inf,
    }  # fmt: skip
    return Horizon(**(values | changed))


def stretch(seed, n=N):
    run = record(seed, seconds=2.0).part(slice(n))
    y = run.y + SIGMA * np.random.default_rng(seed).standard_normal(run.y.shape)
    first = np.array([[run.x[0, 0] + 0.1, 0.0, 0.0]])
    return Stretches(y, np.zeros(y.shape), run.u, run.w, np.array([0]), first)


def residuals(z, own, horizon):
    """All residuals, one by one as the class documents them."""
    z = z.reshape(-1, 3)
    found = [(z[0] - own.first[0]) / horizon.spread]
    for k in range(len(z)):
        if np.isfinite(own.y[k, 0]):
            found.append([(own.y[k, 0] - z[k, 0]) / horizon.sigma[0]])
        if k + 1 < len(z):
            ahead = period(z[k], own.u[k]) * [1.0, 1.0, horizon.fading]
            found.append((z[k + 1] - ahead) / horizon.process)
    return np.concatenate(found)


@pytest.mark.parametrize("missing", [pytest.param(False, marks=pytest.mark.full), True])
def test_the_minimum_is_the_one_that_another_solver_finds(missing):
    own, horizon = stretch(3), problem()
    if missing:
        own.y[5:12] = np.nan
    ours = horizon.solve(own, [np.zeros((N, 3))])
    size = np.tile(horizon.size, N)
    theirs = least_squares(
        lambda v: residuals(v * size, own, horizon), ours.ravel() / size + 0.01, method="lm", xtol=1e-12
    )
    assert horizon.costs(own, ours)[0] == pytest.approx(
        2 * theirs.cost, rel=1e-5
    )  # it stops at 1e-4 a sample
    # at the end a step would move each estimate by about 1 % of its standard deviation at most
    deviation = np.sqrt(np.diag(np.linalg.inv(theirs.jac.T @ theirs.jac)))
    assert (np.abs(ours.ravel() / size - theirs.x) < 0.02 * deviation).all()


def test_costs_and_slopes_are_those_of_the_residuals():
    own, horizon = stretch(4), problem()
    z = np.random.default_rng(0).normal(size=(N, 3)) * 1e-3 + np.hstack([own.y, np.zeros((N, 2))])
    at = _Linearized.at(horizon, own, z, 1.0)
    assert np.abs((own.y - z[:, :1]) / SIGMA).max() < HUBER
    assert at.cost[0] == pytest.approx(np.sum(residuals(z.ravel(), own, horizon) ** 2), rel=1e-9)
    difference, step = np.zeros((N, 3)), 1e-6
    for k, i in np.ndindex(N, 3):
        both = [z.copy(), z.copy()]
        both[0][k, i] += step * horizon.size[i]
        both[1][k, i] -= step * horizon.size[i]
        difference[k, i] = np.subtract(*(horizon.costs(own, v)[0] for v in both)) / (2 * step)
    # half the slope of the cost; central differences of squares are exact to rounding and step^2
    np.testing.assert_allclose(at.gradient, difference / 2, rtol=1e-5, atol=1e-5 * np.abs(at.gradient).max())


@pytest.mark.parametrize("seed", range(6))
def test_the_cost_only_falls_from_any_start(seed):
    rng = np.random.default_rng(seed)
    own = stretch(seed)
    own.y[rng.uniform(size=own.y.shape) < 0.1] += 30.0
    horizon = problem(process=np.array([1e-6, 1e-6, WALK]))
    start = rng.normal(size=(N, 3)) * [5.0, 50.0, 300.0]
    found = horizon.solve(own, [start])
    assert np.isfinite(found).all()
    assert horizon.costs(own, found)[0] < horizon.costs(own, start)[0]
    # and no start is much worse than another: equations that give way lead back
    other = horizon.solve(own, [np.zeros((N, 3)), start])
    assert horizon.costs(own, other)[0] <= 1.01 * horizon.costs(own, found)[0]


def test_a_gross_outlier_counts_by_its_size_alone():
    own, horizon = stretch(5), problem()
    plain = horizon.solve(own, [np.zeros((N, 3))])
    moved = []
    for error in (1.0, 1e3):
        wrong = replace(own, y=own.y.copy())
        wrong.y[10] += error
        moved.append(np.abs(horizon.solve(wrong, [np.zeros((N, 3))]) - plain)[:, 0].max())
    assert moved[1] == pytest.approx(moved[0], rel=0.05)  # from 4 standard deviations on its pull is the same
    assert moved[1] < HUBER * SIGMA


def test_states_stay_within_bounds():
    own = stretch(6)
    top = float(np.nanmax(own.y)) - 3 * SIGMA
    horizon = problem(upper=np.array([top, np.inf, np.inf]))
    found = horizon.solve(own, [np.zeros((N, 3))])
    assert found[:, 0].max() == top
    free = problem().solve(own, [np.zeros((N, 3))])
    assert problem().costs(own, found)[0] > problem().costs(own, free)[0]


def test_equations_without_a_number_at_the_start_are_refused():
    with pytest.raises(InputError, match="HM-IDENTIFY-020"):
        problem().solve(stretch(1), [np.full((N, 3), np.nan)])


class Runaway(Prior):
    """A pendulum upright whose torque is declared with the wrong sign."""

    states = (Signal("q", "rad", -4.0, 4.0), Signal("v", "rad/s", -60.0, 60.0))
    inputs = (Signal("u", "N m", -5.0, 5.0),)
    outputs = (Signal("q", "rad"),)
    corrects = ("v",)
    sign = -1.0

    def xdot(self, x, u, w, p):
        return x.v, 60.0 * ca.sin(x.q) + self.sign * 40.0 * u.u

    def output(self, x, u, w, p):
        return (x.q,)


def test_an_unstable_prior_with_a_wrong_sign_cannot_run_away():
    """The upright pendulum under state feedback: estimates stay with what was measured, whatever the prior says."""

    class Right(Runaway):
        sign = 1.0

    n, dt, rng = 800, 0.01, np.random.default_rng(0)
    z, y, us = np.array([0.2, 0.0]), [], []
    xdot = Right().equations.xdot
    for k in range(n):
        y.append(z[0] + 2e-3 * rng.standard_normal())
        u = np.clip(-(4.0 * z[0] + 0.6 * z[1]) + 0.4 * np.sin(0.02 * k * k**0.5), -5, 5)
        us.append(u)
        for _ in range(10):
            z = z + 0.1 * dt * xdot(z, u, [], []).full().ravel()
    nothing = np.full((n, 2), np.nan)
    run = Trajectory(
        "up", "train", dt, dt * np.arange(n), np.array(us)[:, None], np.array(y)[:, None], nothing, nothing
    )
    for make in (Right, Runaway):
        smoother = fit_smoother(make(), [run], dt)
        found = smoother.smooth([run])[0]
        assert np.abs(found.x[:, 0] - run.y[:, 0]).max() < 0.05
        assert np.abs(found.x[:, 1]).max() < 60.0
        assert smoother.sigma[0] < np.std(run.y)
        assert np.isfinite(found.xdot).all()


def test_a_recording_of_nonsense_gives_finite_states_within_thrice_their_ranges():
    n, rng = 300, np.random.default_rng(1)
    nothing = np.full((n, 2), np.nan)
    u, y = rng.uniform(-5, 5, (n, 1)), rng.uniform(-1e3, 1e3, (n, 1))
    run = Trajectory("noise", "train", 0.01, 0.01 * np.arange(n), u, y, nothing, nothing)
    sizes = Sizes((1.0,), (1e-3,), (1.0, 10.0), (1.0, 10.0))
    found = Smoother(Runaway(), 0.01, sigma=(1e-3,), walk=(0.1,), sizes=sizes).smooth([run])[0]
    assert np.isfinite(found.x).all()
    assert (np.abs(found.x) <= [12.0, 180.0]).all()
