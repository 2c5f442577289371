"""The mean of a square is the true one; what it shares with the window's estimator is in test_moving_horizon."""

import casadi as ca
import pytest
from test_moving_horizon import TANK, tanks

from hybrid_mpc import (
    HybridModel,
    InputError,
    MovingHorizonEstimator,
    Signal,
    SwitchingFilter,
    TrackedParameter,
    TrackingFilter,
    UnscentedKalmanFilter,
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


def test_parameters_are_tracked_with_it():
    tracking = TrackingFilter(
        UnscentedKalmanFilter(tanks(), **TANK), [TrackedParameter("outlet", 0.3, relative=True)]
    )
    assert isinstance(tracking.inner, UnscentedKalmanFilter)


def test_a_switching_filter_refuses_other_kinds():
    for kind in (UnscentedKalmanFilter, MovingHorizonEstimator):
        with pytest.raises(InputError, match="HM-ESTIMATE-018"):
            SwitchingFilter([kind(tanks(), **TANK)], [[1.0]])
