"""On a linear model the unscented filter is the Kalman filter; on a square its mean is the true one."""

import casadi as ca
import numpy as np
import pytest
from online_models import pendulum_model, random_linear
from test_moving_horizon import PENDULUM, TANK, sigmas, stacked, survives, tanks

from hybrid_mpc import (
    DelayCompensation,
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    MovingHorizonEstimator,
    Signal,
    SwitchingFilter,
    TrackedParameter,
    TrackingFilter,
    UnscentedKalmanFilter,
)


@pytest.mark.parametrize("n_h", [0, 3])
def test_on_a_linear_model_it_is_the_kalman_filter(n_h):
    model, *_ = random_linear(4, n_x=3, n_u=2, n_y=2, n_h=n_h)
    rng = np.random.default_rng(0)
    ys, us = rng.normal(size=(40, 2)), rng.normal(size=(40, 2))
    ys[7], ys[9, 0] = np.nan, np.nan
    got, want = (kind(model, **sigmas(model)) for kind in (UnscentedKalmanFilter, ExtendedKalmanFilter))
    for a, b in zip(got.run(ys, us), want.run(ys, us), strict=True):
        np.testing.assert_allclose(stacked(a), stacked(b), rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.P, b.P, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            [*a.innovation, a.nis, a.t], [*b.innovation, b.nis, b.t], rtol=0, atol=1e-9
        )
    ahead = want.predict(want.start(ys[0]), us[0])
    assert got.assess(ahead, ys[1])[1] == pytest.approx(want.assess(ahead, ys[1])[1], abs=1e-9)
    np.testing.assert_allclose(
        got.innovation_covariance(ahead), want.innovation_covariance(ahead), atol=1e-12
    )


def test_a_square_has_its_true_mean_and_spread():
    x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
    model = HybridModel.of(
        "square", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x**2, xdot=u, y=x
    )
    ukf = UnscentedKalmanFilter(model, sigma_y=[1.0], sigma_x=[0.0], sigma_x0=[0.5])
    ahead = ukf.predict(ukf.start([2.0]), [0.0])
    # E x^2 = 4.25; the cubature rule is exact for polynomials of degree 3
    assert ahead.x[0] == pytest.approx(4.25, abs=1e-9)
    # the spread of the points, which lacks the fourth moment: (2 * 2 * 0.5)^2, with n = 2 points of d, too
    assert ahead.P[0, 0] == pytest.approx(4.0, abs=0.3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n", [2000, pytest.param(50_000, marks=pytest.mark.full)])
def test_rubbish_raises_nothing(n):
    survives(UnscentedKalmanFilter, pendulum_model(z=3), n, **PENDULUM)


@pytest.mark.parametrize("delays", [(0, 2), (3, 1)])
def test_with_delays_it_is_the_delayed_kalman_filter(delays):
    model, *_ = random_linear(4, n_x=3, n_u=2, n_y=2)
    rng = np.random.default_rng(0)
    ys, us = rng.normal(size=(30, 2)), rng.normal(size=(30, 2))
    got, want = (
        DelayCompensation(kind(model, **sigmas(model)), sensor_delay=delays[0], input_delay=delays[1])
        for kind in (UnscentedKalmanFilter, ExtendedKalmanFilter)
    )
    a, b = got.start(ys[0]), want.start(ys[0])
    for y, u in zip(ys[1:], us, strict=False):
        a, b = got.update(a, y, u), want.update(b, y, u)
        np.testing.assert_allclose(stacked(a), stacked(b), rtol=0, atol=1e-9)


def test_a_constant_load_leaves_no_offset():
    model = pendulum_model()
    ukf = UnscentedKalmanFilter(model, **PENDULUM)
    x, e = np.zeros(2), ukf.start([0.0])
    for _ in range(300):
        x = model.step(x, [], [0.3 + 0.5], model.w, model.p)[0].full().ravel()
        e = ukf.update(e, x[:1], [0.3])
    np.testing.assert_allclose(e.d, 0.5, rtol=0, atol=0.01)
    np.testing.assert_allclose(e.x, x, rtol=0, atol=2e-3)


def test_parameters_are_tracked_with_it():
    tracking = TrackingFilter(
        UnscentedKalmanFilter(tanks(), **TANK), [TrackedParameter("outlet", 0.3, relative=True)]
    )
    assert isinstance(tracking.inner, UnscentedKalmanFilter)


def test_a_switching_filter_refuses_other_kinds():
    for kind in (UnscentedKalmanFilter, MovingHorizonEstimator):
        with pytest.raises(InputError, match="HM-ESTIMATE-018"):
            SwitchingFilter([kind(tanks(), **TANK)], [[1.0]])
