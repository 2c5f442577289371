"""A load that comes at once is estimated within a few periods, however large the process noise is."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import OCP, Disturbance, ExtendedKalmanFilter, HybridModel, Signal, SwitchingFilter
from hybrid_mpc.estimate.switching import SWITCHES, with_outliers
from hybrid_mpc.kit.assembly import JUMP, jump_shares, make_estimator

X, U = ca.MX.sym("x"), ca.MX.sym("u")
TANK = HybridModel.of(
    "tank", 1.0, (Signal("level", "m", -9.0, 9.0),), (Signal("pump", "m/s", -1.0, 1.0),),
    (Signal("level", "m", -9.0, 9.0),), x=X, u=U, y=X, x_next=0.9 * X + 0.1 * U, xdot=U - X,
    disturbance_model=(Disturbance("rate", "level", 1.0),),
)  # fmt: skip
SCENARIO = SimpleNamespace(
    name="tank", sensor_sigma=(0.01,), first_sigma=None,
    control=OCP(20, q=(1.0,), r=(0.0,), r_delta=(1.0,), u_min=(-1.0,), u_max=(1.0,)),
)  # fmt: skip
LOAD = 0.8  # [m/s]: one and a half times the noise of a slip, 10 * 0.05
SIGMA_X = np.array([0.05])


def found(observer, after=8):
    """Estimate of the load ``after`` periods with it."""
    rng, x, u = np.random.default_rng(0), 0.0, np.zeros(1)
    estimate = observer.start(np.zeros(1))
    for k in range(20 + after):
        x = 0.9 * x + LOAD * (k >= 20) + 0.02 * rng.standard_normal()
        estimate = observer.update(estimate, np.array([x + 0.01 * rng.standard_normal()]), u)
    return estimate.d[0]


def test_a_load_that_a_slip_could_explain_is_found_within_eight_periods():
    assert found(make_estimator(TANK, SCENARIO, SIGMA_X)) == pytest.approx(LOAD, rel=0.15)


def test_with_small_jumps_slips_explain_it():
    quiet, slip, _, outlier = make_estimator(TANK, SCENARIO, SIGMA_X).filters
    small = ExtendedKalmanFilter(
        TANK, sigma_y=[0.01], sigma_x=SIGMA_X, sigma_x0=[0.01], sigma_d=[JUMP], sigma_d0=[0.001]
    )
    former = SwitchingFilter([quiet, slip, small, outlier], with_outliers(SWITCHES))
    assert found(former) < 0.2 * LOAD


@pytest.mark.parametrize(("sigma", "share"), [(1e-4, JUMP), (0.01, 0.2), (0.05, 1.0), (1.0, 1.0)], ids=str)
def test_the_jump_exceeds_a_slip_twice_and_stays_between_its_limits(sigma, share):
    assert jump_shares(TANK, np.array([sigma]), np.ones(1)) == pytest.approx(share)


@pytest.mark.parametrize(
    ("disturbance", "sigma", "share"),
    [
        (Disturbance("output", "level", 1.0), 0.05, JUMP),
        (
            Disturbance("input", "pump"),
            0.004,
            0.8,
        ),  # the whole range moves the level by 0.1, 20 * 0.004 is less
        (Disturbance("input", "pump"), 0.05, JUMP),  # more
    ],
)
def test_what_no_jump_shows_keeps_the_default(disturbance, sigma, share):
    model = replace(TANK, disturbance_model=(disturbance,))
    assert jump_shares(model, np.array([sigma]), np.ones(1)) == pytest.approx(share)
