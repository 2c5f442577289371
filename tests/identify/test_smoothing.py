"""The smoother with the prior's equations: noise found again, jumps stay sharp, nothing known of the future."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import fit_smoother
from hybrid_mpc.data.differentiate import local_polynomial
from hybrid_mpc.identify.smooth import Smoother
from tests.simulated_pendulum import DT, TRUTH, Pendulum, record

SIGMA = 1e-3


def noisy(seed, seconds=4.0, extra=lambda phi, v: 0.0):
    run = record(seed, seconds=seconds, extra=extra)
    y = run.y + SIGMA * np.random.default_rng(100 + seed).standard_normal(run.y.shape)
    return run, replace(run, y=y, x=np.full_like(run.x, np.nan), xdot=np.full_like(run.xdot, np.nan))


def unknown(phi, v):
    return 0.1 * np.sin(2.0 * phi)


def test_noise_level_is_found_by_maximum_likelihood():
    runs = [noisy(seed, extra=unknown)[1] for seed in range(4)]
    smoother = fit_smoother(Pendulum(TRUTH), runs, DT)
    # 800 samples: the standard error of a standard deviation is 1 / sqrt(1600) = 2.5 %; four of them
    assert smoother.sigma[0] == pytest.approx(SIGMA, rel=0.1)


def test_velocity_is_better_than_a_polynomial_where_the_input_jumps():
    truth, run = noisy(1, extra=unknown)
    smoothed = fit_smoother(Pendulum(TRUTH), [run], DT).smooth([run])[0]
    polynomial = local_polynomial(run.y, DT, 0.2).first[:, 0]
    inner = slice(10, -10)

    def error(v):
        return np.sqrt(np.mean((v[inner] - truth.x[inner, 1]) ** 2))

    # jumps of about 0.4 N m / 0.1 kg m^2 smeared over 0.2 s; a factor of two leaves room for the noise drawn
    assert error(smoothed.x[:, 1]) < 0.5 * error(polynomial)
    # d is the unknown torque over J; tenth of its size: what noise leaves of it after smoothing
    d = smoothed.xdot[:, 1] - Pendulum(TRUTH).acceleration(*map(_tensor, (smoothed.x, run.u))).numpy()[:, 0]
    expected = unknown(truth.x[:, 0], 0.0) / TRUTH["J"]
    assert np.sqrt(np.mean((d - expected)[inner] ** 2)) < 0.3 * np.std(expected)


def test_without_noise_and_with_the_true_prior_the_states_are_exact():
    truth = record(2)
    run = replace(truth, x=np.full_like(truth.x, np.nan))
    smoothed = Smoother(Pendulum(TRUTH), DT, (1e-6,), (1e-3,)).smooth([run])[0]
    # a wandering d of 1e-3 over a period, and more
    np.testing.assert_allclose(smoothed.x, truth.x, atol=1e-4)


def test_equals_the_least_squares_solution_of_a_linear_system():
    class Mass(Pendulum):
        def acceleration(self, x, u):
            return u / self.J

    run = noisy(3, seconds=0.6)[1]
    sigma, walk = 2e-3, 0.3
    ours = Smoother(Mass(TRUTH), DT, (sigma,), (walk,)).smooth([run])[0]
    n = len(run.t)
    # unknowns q_0, v_0, d_0 and the changes of d: minimise |y - q|^2 / sigma^2 + |changes|^2 / walk^2
    response = np.zeros((n, n + 2))
    state = np.zeros((3, n + 2))
    state[[0, 1, 2], [0, 1, 2]] = 1.0
    step = np.array([[1.0, DT, 0.5 * DT**2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
    forced, known = np.zeros(3), np.zeros(n)
    for k in range(n):
        response[k], known[k] = state[0], forced[0]
        state = step @ state
        push = np.array([0.0, 0.0, run.u[k, 0] / TRUTH["J"]])
        forced = step @ (forced + push) - push
        if k + 3 < n + 2:
            state[2, k + 3] = 1.0
    rows = np.vstack([response / sigma, np.eye(n + 2)[3:] / walk])
    solution = np.linalg.lstsq(
        rows, np.concatenate([(run.y[:, 0] - known) / sigma, np.zeros(n - 1)]), rcond=None
    )
    # the start is known to 1e4 noises in the one and not at all in the other: 1e-8 of the noise, and rounding
    np.testing.assert_allclose(ours.x[:, 0], response @ solution[0] + known, atol=1e-6 * sigma)


def test_knows_nothing_outside_its_samples():
    run = noisy(4)[1]
    other = replace(run, y=np.where(run.t[:, None] > 1.0, 9.0, run.y))
    smoother = Smoother(Pendulum(TRUTH), DT, (SIGMA,), (0.5,))
    ours, theirs = (
        smoother.smooth([replace(r, t=r.t[:50], u=r.u[:50], y=r.y[:50], x=r.x[:50], xdot=r.xdot[:50])])[0]
        for r in (run, other)
    )
    np.testing.assert_array_equal(ours.x, theirs.x)


def _tensor(values):
    import torch

    return torch.tensor(values)
