"""Noise at the inputs gives a loop more of the margin of its state feedback (loop transfer recovery)."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    OCP,
    CondensedController,
    HybridModel,
    InputError,
    Signal,
    linearize,
    make_estimator,
    mpc_gain,
    mpc_loop,
    steady_filter,
)

DT, U_MAX, REST = 0.02, 4.0, (np.zeros(2), np.zeros(1))
SIGMA_X = np.array([1e-5, 1e-3])


def fall():
    """A mass that falls away from rest, ``a = 9 q + u``; its position is measured."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    rate = ca.vertcat(x[1], 9.0 * x[0] + u)
    states = (Signal("q", "m", -1.0, 1.0), Signal("v", "m/s", -5.0, 5.0))
    return HybridModel.of(
        "fall", DT, states, (Signal("u", "m/s^2"),), (Signal("y", "m"),), x=x, u=u,
        x_next=x + DT * rate + 0.5 * DT**2 * ca.vertcat(rate[1], 9.0 * x[1]), xdot=rate, y=x[0],
    )  # fmt: skip


MODEL = fall()
CONTROL = OCP(60, q=[400.0, 0.0], r=[0.0], r_delta=[1.0], u_min=[-U_MAX], u_max=[U_MAX])
MACHINE = SimpleNamespace(name="fall", sensor_sigma=(1e-3,), first_sigma=None, control=CONTROL)


def filters(input_noise):
    return make_estimator(MODEL, MACHINE, SIGMA_X, input_noise=input_noise).filters


def test_the_quiet_filter_assumes_independent_noise_at_the_inputs():
    by_u = np.array([0.5 * DT**2, DT]) * 2 * U_MAX
    quiet, slip, jump, outlier = (f.noise[0][:2] for f in filters(0.1))
    np.testing.assert_allclose(quiet, SIGMA_X**2 + (0.1 * by_u) ** 2, rtol=1e-9)
    np.testing.assert_allclose(slip, np.maximum((10 * SIGMA_X) ** 2, quiet), rtol=1e-9)  # never quieter
    for others in (jump, outlier):
        np.testing.assert_allclose(others, SIGMA_X**2, rtol=1e-9)


@pytest.mark.parametrize("share", [-0.1, np.nan, np.inf])
def test_a_share_below_zero_is_refused(share):
    with pytest.raises(InputError, match="HM-KIT-044"):
        filters(share)


def test_it_brings_back_margin():
    gain, plant = mpc_gain(CondensedController(MODEL, CONTROL), *REST), linearize(MODEL, *REST)
    without, default, more = (
        mpc_loop(gain, steady_filter(filters(share)[0], *REST), plant).margins().modulus
        for share in (0.0, 0.05, 0.2)
    )
    assert without < default - 0.05 < more - 0.05
