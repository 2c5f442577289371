"""Process noise by maximum likelihood, on a linear system whose noise is known."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hybrid_mpc import ExtendedKalmanFilter, HybridModel, InputError, Signal, process_noise, with_input_delay
from hybrid_mpc.estimate.tuning import (
    _error,
    _left,
    choose_most_likely,
    log_likelihood,
    periods_to_find,
    remaining_load,
)
from hybrid_mpc.kit.assembly import MOST_DOUBLED, QUIET_SHARE, quiet_shares

DT, SIGMA_Y, SIGMA_X = 0.1, 0.02, (0.0, 0.05)


def mass() -> HybridModel:
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    return HybridModel.of(
        "mass", DT, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        x=x, u=u, x_next=ca.vertcat(x[0] + DT * x[1], x[1] + DT * u), xdot=ca.vertcat(x[1], u), y=x[0],
    )  # fmt: skip


def filter_with(scale: float) -> ExtendedKalmanFilter:
    sigma_x = scale * np.array(SIGMA_X)
    return ExtendedKalmanFilter(mass(), sigma_y=[SIGMA_Y], sigma_x=sigma_x, sigma_x0=[0.1, 0.1])


def recording(n: int, seed: int) -> SimpleNamespace:
    rng = np.random.default_rng(seed)
    u, x, y = rng.normal(size=(n, 1)), np.zeros(2), np.zeros((n, 1))
    for k in range(n):
        y[k] = x[0] + SIGMA_Y * rng.standard_normal()
        x = np.array([x[0] + DT * x[1], x[1] + DT * u[k, 0]]) + np.array(SIGMA_X) * rng.standard_normal(2)
    return SimpleNamespace(u=u, y=y)


def test_likelihood_is_that_of_the_joint_gaussian():
    n, run = 12, recording(12, 0)
    f, c = np.array([[1.0, DT], [0.0, 1.0]]), np.array([1.0, 0.0])
    # start: at rest at the first sample, known to 0.1 each; then the joint law of the samples 1 .. n - 1
    mean, p = np.array([run.y[0, 0], 0.0]), np.diag([0.01, 0.01])
    means, covariance = [], np.zeros((n - 1, n - 1))
    states = []
    for k in range(1, n):
        mean, p = f @ mean + np.array([0.0, DT * run.u[k - 1, 0]]), f @ p @ f.T + np.diag(np.square(SIGMA_X))
        means.append(c @ mean)
        states.append(p)
    for i in range(n - 1):
        for j in range(i, n - 1):
            covariance[i, j] = covariance[j, i] = c @ np.linalg.matrix_power(f, j - i) @ states[i] @ c
    covariance += SIGMA_Y**2 * np.eye(n - 1)
    exact = multivariate_normal(np.array(means), covariance).logpdf(run.y[1:, 0]) + 0.5 * (n - 1) * np.log(
        2 * np.pi
    )
    assert log_likelihood(filter_with(1.0), run, skip=1) == pytest.approx(exact, rel=1e-9)  # rounding


def test_the_true_noise_is_the_most_likely():
    runs = [recording(600, seed) for seed in (1, 2)]
    # 1200 samples: a factor of 3 in the noise lowers the likelihood by hundreds
    assert choose_most_likely(filter_with, runs, (0.1, 0.3, 1.0, 3.0, 10.0)) == 1.0


def test_process_noise_is_the_error_of_one_period():
    rng, n, model = np.random.default_rng(3), 4000, mass()
    u, x = rng.normal(size=(n, 1)), np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = x[k] + DT * np.array([x[k, 1], u[k, 0]])
        x[k + 1] += np.array([0.001, 0.05]) * rng.standard_normal(2)
    found = process_noise(model, [SimpleNamespace(u=u, y=x[:, :1], x=x)])
    # A standard deviation of 4,000 samples is off by 1 / sqrt(8000) = 1.1 %; four of these.
    assert np.abs(found / [0.001, 0.05] - 1).max() < 0.045
    half = SimpleNamespace(u=u[:100], y=x[:100, :1], x=x[:100])
    # the second one is not looked at
    assert np.array_equal(process_noise(model, [half, half], most=50), process_noise(model, [half]))
    with pytest.raises(InputError, match="HM-ESTIMATE-022"):
        process_noise(model, [])


def test_process_noise_leaves_out_periods_whose_delayed_inputs_are_unknown():
    rng, n, late = np.random.default_rng(3), 30, 2
    u, x = rng.normal(size=(n, 1)), np.zeros((n, 2))
    acting = np.concatenate([np.full((late, 1), 50.0), u])  # before the recording another input acted
    for k in range(n - 1):
        x[k + 1] = x[k] + DT * np.array([x[k, 1], acting[k, 0]])
    found = process_noise(with_input_delay(mass(), late * DT), [SimpleNamespace(u=u, y=x[:, :1], x=x)])
    assert found.max() < 1e-4  # rounding, at most a millionth of the states' sizes


def observer_of(shares, sigma_x=SIGMA_X):
    return ExtendedKalmanFilter(
        mass(), sigma_y=[SIGMA_Y], sigma_x=sigma_x, sigma_x0=[SIGMA_Y, 0.1], sigma_d=np.ravel(shares)
    )


def test_what_is_left_of_a_load_is_what_the_filter_shows():
    """A settled filter under a constant load, without noise."""
    ekf, load, periods = observer_of(0.02), 1.0, 40
    estimate = ekf.start(np.zeros(1))
    for _ in range(2000):
        estimate = ekf.update(estimate, np.zeros(1), np.zeros(1))
    x = np.zeros(2)
    for _ in range(periods):
        x = np.array([x[0] + DT * x[1], x[1] + DT * load])
        estimate = ekf.update(estimate, x[:1], np.zeros(1))
    left = abs(load - estimate.d[0]) / load
    # to rounding: the filter before the first measurement and after it differ by one gain, the covariance has settled
    assert remaining_load(ekf, periods)[0] == pytest.approx(left, rel=1e-6)


@pytest.mark.parametrize(("noise", "periods"), [(0.05, 5000), (0.05, 400), (0.05, 100)])
def test_the_quiet_filter_finds_a_constant_load_in_time(noise, periods):
    shares = quiet_shares(lambda s: observer_of(s, (0.0, noise)), periods, 1)
    doubled = round(np.log2(shares[0] / QUIET_SHARE))
    assert (
        remaining_load(observer_of(shares, (0.0, noise)), periods)[0] < np.exp(-1) or doubled == MOST_DOUBLED
    )
    if doubled:  # no more than it takes
        assert remaining_load(observer_of(shares / 2, (0.0, noise)), periods)[0] > np.exp(-1)
    assert doubled == {5000: 0, 400: 3, 100: 5}[periods]


def test_friction_that_hides_a_load_at_rest_does_not_make_the_filter_quick():
    """A mass whose dry friction changes its sign over 1 mm/s: at rest a load moves it by an eleventh of what it does in
    motion."""
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    rate = ca.vertcat(x[1], u - 0.1 * ca.tanh(x[1] / 1e-3))
    moved = ca.vertcat(x[0] + DT * x[1], (x[1] + DT * u) / (1 + DT * 100 * (1 - ca.tanh(x[1] / 1e-3) ** 2)))
    model = HybridModel.of(
        "sticks", DT, (Signal("q", "m", -5, 5), Signal("v", "m/s", -5, 5)), (Signal("F", "N"),), (Signal("q", "m"),),
        x=x, u=u, x_next=moved, xdot=rate, y=x[0],
    )  # fmt: skip

    def filter_of(shares):
        return ExtendedKalmanFilter(
            model, sigma_y=[SIGMA_Y], sigma_x=[0.0, 0.005], sigma_x0=[SIGMA_Y, 0.1], sigma_d=shares
        )

    quiet, periods = np.array([QUIET_SHARE]), 500
    ekf = filter_of(quiet)
    at_rest = _left([_error(ekf, ekf.start(np.full(1, np.nan)))], periods, 1)
    assert at_rest[0] > np.exp(-1) > remaining_load(ekf, periods)[0]
    assert quiet_shares(filter_of, periods, 1).tolist() == quiet.tolist()


def test_a_filter_that_does_not_settle_keeps_its_step():
    """No noise reaches the speed, which nothing damps."""
    still = observer_of(0.0, (0.0, 0.0))
    assert np.isnan(remaining_load(still, 10)).tolist() == [True]
    assert np.isnan(periods_to_find(still, 100)).tolist() == [True]
