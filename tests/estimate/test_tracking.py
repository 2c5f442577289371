"""An observer that tracks parameters: finds them, keeps bounds, does not wind up, and is a disturbance to the rest."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import InputError, Parameter, Signal
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import SwitchingFilter
from hybrid_mpc.estimate.tracking import (
    TrackedParameter,
    TrackingFilter,
    tracked_values,
    tracking_model,
    with_tracked,
)
from hybrid_mpc.model.model import HybridModel

DT = 0.1


def tank(*, output="x", lower=0.5):
    """``x' = k (u + w) - x / 5 + offset``."""
    x, u, w, p = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("w"), ca.MX.sym("p", 2)
    level, rate = (Signal("level", "m"),), p[0] * (u + w) - 0.2 * x + p[1]
    return HybridModel.of(
        "tank", DT, level, (Signal("pump", "-"),), level, x=x, u=u, w=w, p=p, x_next=x + DT * rate, xdot=rate,
        y=x if output == "x" else p[0] * x, disturbances=(Signal("rain", "-"),),
        parameters=(Parameter("k", 2.0, "m/s", lower, 3.0), Parameter("offset", 0.0, "m/s", -1.0, 1.0)),
    )  # fmt: skip


def base(model, **more):
    more = {"sigma_d": [0.0], "sigma_d0": [0.0]} | more
    return ExtendedKalmanFilter(model, sigma_y=[0.01], sigma_x=[0.001], sigma_x0=[0.1], **more)


GAIN = TrackedParameter("k", 0.2, relative=True)
OFFSET = TrackedParameter("offset", 0.3)


def watched(tracking, k=2.5, offset=0.0, periods=300, quiet=False):
    """Estimates along a simulated run, noise included."""
    rng, x = np.random.default_rng(0), np.zeros(1)
    estimate, found = tracking.start(x, w=[0.0]), []
    for i in range(periods):
        u = np.zeros(1) if quiet else np.array([np.sign(np.sin(0.3 * i))])
        x = x + DT * (k * u - 0.2 * x + offset)
        estimate = tracking.update(estimate, x + 0.01 * rng.standard_normal(1), u, w=[0.0])
        found.append(estimate)
    return found


@pytest.mark.parametrize("switching", [False, True])
def test_a_changed_gain_is_found_and_the_model_uses_it(switching):
    own = base(tank())
    noisy = ExtendedKalmanFilter(own.model, sigma_y=[0.01], sigma_x=[0.01], sigma_x0=[0.1])
    given = SwitchingFilter([own, noisy], [[0.9, 0.1], [0.5, 0.5]]) if switching else own
    tracking = TrackingFilter(given, [GAIN])
    last = watched(tracking)[-1]
    assert last.w.shape == (2,)
    assert last.w[1] == pytest.approx(2.5, abs=0.05)
    assert last.std[0] < 0.1 * GAIN.std
    assert last.P.shape == (2, 2)
    ahead = tracking.model.step(last.x, last.h, [1.0], last.w, tracking.model.p)[0]
    assert float(ahead) == pytest.approx(float(last.x[0] + DT * (last.w[1] - 0.2 * last.x[0])))
    assert tracking.predict(last, [1.0]).x == pytest.approx(ahead.full().ravel())


def test_without_excitation_neither_estimate_nor_covariance_drifts():
    quiet = watched(TrackingFilter(base(tank()), [GAIN]), periods=3000, quiet=True)
    assert abs(quiet[-1].w[1] - 2.0) < 1e-3
    assert all(e.std[0] <= GAIN.std * (1 + 1e-9) for e in quiet[::100])


def test_a_parameter_stays_within_its_bounds():
    last = watched(TrackingFilter(base(tank()), [GAIN]), k=9.0)[-1]
    assert 2.5 < last.w[1] <= 3.0
    theta = ca.MX.sym("theta", 2)
    values = ca.Function("values", [theta], [tracked_values(tank(), [GAIN, OFFSET], theta)])
    assert values([0.0, 0.0]).full().ravel().tolist() == [2.0, 0.0]
    for far in (-1e3, 1e3):
        k, offset = values([far, far]).full().ravel()
        assert 0.5 <= k <= 3.0
        assert -1.0 <= offset <= 1.0
    slope = ca.Function("slope", [theta], [ca.jacobian(values(theta), theta)])
    np.testing.assert_allclose(slope([0.0, 0.0]).full(), np.diag([2.0, 1.0]))


def test_a_parameter_that_was_fitted_to_its_bound_stays_within():
    model = tank(lower=2.0)
    theta = ca.MX.sym("theta", 1)
    for one in (GAIN, TrackedParameter("k", 0.5)):
        values = ca.Function("values", [theta], [tracked_values(model, [one], theta)])
        assert float(values(-1.0)) == 2.0
        assert 2.0 < float(values(0.3)) <= 3.0
        TrackingFilter(base(model, sigma_d=[0.01], sigma_d0=[0.1]), [one])  # its check goes to both sides


def test_a_parameter_returns_to_its_value_in_its_time():
    tracking = TrackingFilter(base(tank()), [replace(GAIN, time=10.0)])
    estimate = watched(tracking)[-1]
    for _ in range(300):  # three time constants without a measurement
        estimate = tracking.predict(estimate, [0.0])
    assert estimate.w[1] == pytest.approx(2.0 * np.exp(np.exp(-3.0) * np.log(2.5 / 2.0)), rel=0.02)
    assert GAIN.std * 0.98 < estimate.std[0] <= GAIN.std


def test_offsets_are_additive_and_two_are_told_apart():
    last = watched(TrackingFilter(base(tank()), [GAIN, OFFSET]), offset=-0.4)[-1]
    np.testing.assert_allclose(last.w[1:], [2.5, -0.4], atol=0.05)


def test_missing_samples_and_measured_disturbances():
    tracking = TrackingFilter(base(tank()), [GAIN])
    estimate = tracking.start([0.0], w=[0.5])
    after = tracking.update(estimate, [np.nan], [0.0], w=[0.7, 99.0])  # the tracked entry is ignored
    assert after.w.tolist() == [0.7, estimate.w[1]]
    assert np.isnan(after.nis)
    assert tracking.update(after, [0.1], [0.0]).w[0] == 0.7
    assert tracking.measuring(after, [0.2]).w[0] == 0.2
    moved, likelihood = tracking.assess(after, [0.1])
    assert np.isfinite(likelihood)
    assert tracking.correct(after, [0.1]).x == pytest.approx(moved.x)


def test_the_model_with_disturbances_equals_the_model_with_those_parameters():
    model = tank()
    tracking = with_tracked(model, [OFFSET, GAIN])
    assert [s.name for s in tracking.disturbances] == ["rain", "offset", "k"]
    assert tracking.w.tolist() == [0.0, 0.0, 2.0]
    for name in ("step", "with_jacobian"):
        one = getattr(model, name)([0.3], [], [0.2], [0.1], [2.7, 0.4])
        other = getattr(tracking, name)([0.3], [], [0.2], [0.1, 0.4, 2.7], model.p)
        assert [v.full().tolist() for v in one] == [v.full().tolist() for v in other]


def test_refusals():
    with pytest.raises(InputError, match="HM-ESTIMATE-025"):
        TrackingFilter(base(tank()), [TrackedParameter("mass", 0.1)])
    with pytest.raises(InputError, match="HM-ESTIMATE-024"):
        with_tracked(tank(), [GAIN, GAIN])
    with pytest.raises(InputError, match="HM-ESTIMATE-023"):
        tracking_model(tank(output="k x"), [GAIN])
    with pytest.raises(InputError, match="HM-ESTIMATE-027"):
        TrackingFilter(base(tank()), [GAIN]).predict(base(tank()).start([0.0]), [0.0])


def test_disturbances_must_be_detectable_for_other_parameters_too():
    lost = tank(lower=0.0)
    wild = TrackedParameter("k", 2.0)  # two standard deviations below its value the gain is all but zero
    with pytest.raises(InputError, match="HM-ESTIMATE-026"):
        TrackingFilter(base(lost, sigma_d=[0.01], sigma_d0=[0.1]), [replace(wild, std=100.0)])
