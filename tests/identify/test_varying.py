"""Parameters that differ between recordings, fits of each alone, and predictions with and without tracking."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import InputError, Parameter, Prior, Signal, fit_prior
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.tracking import DAY, TrackedParameter, TrackingFilter
from hybrid_mpc.identify.ahead import _unlearned, choose_tracked, errors_ahead
from hybrid_mpc.identify.own_fits import fit_each
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.identify.varying import find_varying
from hybrid_mpc.kit.artifact import build_model

DT, SIGMA = 0.1, 0.01


class Heater(Prior):
    """A heater with a sensor; ``cool`` acts with ``gain`` alone, so that the two are one."""

    states = (Signal("heat", "K", -20.0, 20.0),)
    inputs = (Signal("power", "W", -5.0, 5.0),)
    outputs = states
    parameters = (
        Parameter("gain", 2.0, "K/W", 0.2, 10.0),
        Parameter("tau", 1.0, "s", 0.1, 10.0),
        Parameter("bias", 0.0, "W", -2.0, 2.0),
    )

    def xdot(self, x, u, w, p):
        return ((p.gain * (u.power + p.bias) - x.heat) / p.tau,)


class Twins(Heater):
    """Two parameters of which only the product shows."""

    parameters = (*Heater.parameters[:2], Parameter("share", 1.0, "-", 0.1, 10.0))

    def xdot(self, x, u, w, p):
        return ((p.gain * p.share * u.power - x.heat) / p.tau,)


def recorded(gains, *, bias=0.0, seconds=40.0, seed=0, late=0, sigma=SIGMA):
    """A recording for each gain, exactly integrated, with white noise; inputs act ``late`` periods later."""
    rng, found, n = np.random.default_rng(seed), [], round(seconds / DT)
    for i, gain in enumerate(gains):
        u = np.repeat(rng.uniform(-2.0, 2.0, n // 8 + 1), 8)[:n, None]
        acts, x, a = np.concatenate([np.repeat(u[:1], late, axis=0), u])[:n], np.zeros((n, 1)), np.exp(-DT)
        for k in range(n - 1):
            x[k + 1] = a * x[k] + (1 - a) * gain * (acts[k] + bias)
        y, t = x + sigma * rng.standard_normal(x.shape), np.arange(n) * DT
        nothing = np.full(x.shape, np.nan)
        zeros = np.zeros(y.shape, dtype=np.int8)
        found.append(Trajectory(f"day{i}", "train", DT, t, u, y, nothing, nothing, np.zeros((n, 0)), zeros))
    return found


def varying_of(make, recordings, length=4.0):
    fit = fit_prior(make, recordings, [], dt=DT, length=length)
    return fit, find_varying(make, fit, recordings, dt=DT, length=length)


GAINS = 2.0 * np.exp(0.15 * np.random.default_rng(3).standard_normal(12))


def test_the_spread_between_recordings_is_recovered():
    _, found = varying_of(Heater, recorded(GAINS))
    own = {p.name: p for p in found.parameters}
    assert found.pieces == 12
    assert not found.blocks
    assert found.names == ("gain",)
    assert own["gain"].relative
    assert not own["bias"].relative
    true = float(np.std(GAINS, ddof=1))
    assert own["gain"].std == pytest.approx(true, rel=0.25)
    assert own["gain"].gain > 20
    assert own["gain"].tracked() == TrackedParameter("gain", own["gain"].std / own["gain"].value, True)
    assert found.rows()[0]["varies"] is True
    assert own["tau"].std == own["bias"].std == 0.0


def test_equal_recordings_have_fixed_parameters():
    _, found = varying_of(Heater, recorded([2.0] * 6, seed=1))
    assert found.names == ()


def test_two_recordings_tell_a_large_difference_and_one_is_cut_into_blocks():
    _, two = varying_of(Heater, recorded([1.6, 2.4]))
    assert two.names == ("gain",)
    assert two.pieces == 2
    _, one = varying_of(Heater, recorded([2.0]))
    assert one.blocks
    assert one.pieces == 4
    assert one.names == ()


def test_a_parameter_that_is_not_identified_does_not_vary_beside_its_twin():
    _, found = varying_of(Twins, recorded(GAINS))
    assert len(found.names) == 1
    assert found.names[0] in ("gain", "share")


def test_the_user_decides():
    class Declared(Heater):
        parameters = (
            Parameter("gain", 2.0, "K/W", 0.2, 10.0, varies=False),
            Parameter("tau", 1.0, "s", 0.1, 10.0, varies=True),
            Parameter("bias", 0.0, "W", -2.0, 2.0, varies=(0.05, 60.0)),
        )

    _, found = varying_of(Declared, recorded([2.0] * 3))
    own = {p.name: p for p in found.parameters}
    assert own["gain"].std == 0.0
    assert own["gain"].declared
    assert own["bias"].std == pytest.approx(0.05)
    assert own["bias"].tracked().time == 60.0
    assert own["tau"].tracked().time == DAY
    assert own["tau"].std > 0


def observer(fit, make=Heater):
    prior = make(fit.values)
    programs = {f"prior/{name}": p for name, p in prior_programs(prior, DT).items()}
    model = build_model("prior", programs, model_info(prior, DT))
    return ExtendedKalmanFilter(
        model, sigma_y=[SIGMA], sigma_x=[0.005], sigma_x0=[0.1], sigma_d=[1e-3], sigma_d0=[1e-2]
    )


def test_predictions_from_the_observer_improve_where_a_parameter_varies():
    fit, found = varying_of(Heater, recorded(GAINS))
    chosen = choose_tracked([[(observer(fit), recorded(GAINS[:4], seed=5))]], found, 2.0, warm_up=1.0)
    assert chosen.tracked[0].name == "gain"
    assert chosen.tracked[0].time == DAY  # the gain is constant within each recording
    assert chosen.ratio["heat"] < 0.8
    assert chosen.doubts == ()
    held = recorded([1.4, 2.8], seed=9)
    plain = errors_ahead(observer(fit), held, 2.0, warm_up=10.0)
    tracked = errors_ahead(TrackingFilter(observer(fit), chosen.tracked), held, 2.0, warm_up=10.0)
    assert tracked.names == ("day0", "day1")
    assert tracked.starts == plain.starts
    assert (tracked.rmse < 0.4 * plain.rmse).all()


def drifting(n, seed, std=0.3, time=15.0):
    """Recordings of 40 s whose gain is a stationary process with this time constant [s]."""
    found, a, e = [], np.exp(-DT / time), np.exp(-DT)
    for i, t in enumerate(recorded([2.0] * n, seed=seed)):
        rng, x = np.random.default_rng([seed, i]), np.zeros_like(t.y)
        theta = std * rng.standard_normal()
        for k in range(len(x) - 1):
            x[k + 1] = e * x[k] + (1 - e) * 2.0 * np.exp(theta) * t.u[k]
            theta = a * theta + std * np.sqrt(1 - a * a) * rng.standard_normal()
        found.append(replace(t, y=x + SIGMA * rng.standard_normal(x.shape)))
    return found


def test_a_gain_that_changes_within_recordings_has_a_drift():
    fit, found = varying_of(Heater, drifting(6, 0))
    only = replace(found, parameters=found.parameters[:1])
    (gain,) = choose_tracked([[(observer(fit), drifting(3, 1))]], only, 2.0, warm_up=1.0).tracked
    assert gain.time < 100.0
    held, plain = drifting(3, 2), replace(gain, time=DAY)
    drifts, constant = (
        errors_ahead(TrackingFilter(observer(fit), [one]), held, 2.0, warm_up=10.0) for one in (gain, plain)
    )
    assert (drifts.pooled < 0.7 * constant.pooled).all()  # about a half
    given = replace(only.parameters[0], declared=True, time=1000.0)
    (kept,) = choose_tracked([[(observer(fit), held)]], replace(found, parameters=(given,)), 2.0).tracked
    assert kept.time == 1000.0


def test_nothing_is_tracked_that_does_not_vary():
    fit, found = varying_of(Heater, recorded([2.0] * 4))
    chosen = choose_tracked([[(observer(fit), recorded([2.0] * 2, seed=5))]], found, 2.0)
    assert chosen.tracked == ()
    assert dict(chosen.ratio) == {"heat": 1.0}


def test_errors_are_zero_for_the_exact_model_without_noise():
    fit, _ = varying_of(Heater, recorded([2.0] * 2))
    exact = observer(fit)
    (t,) = recorded([2.0], seed=4)
    x = t.y[:1]
    clean = [x[0]]
    for k in range(len(t.y) - 1):
        x = exact.model.step(x.ravel(), [], t.u[k], [], exact.model.p)[0].full()
        clean.append(x.ravel())
    errors = errors_ahead(exact, [replace(t, y=np.array(clean))], 1.0)
    assert errors.pooled[0] < 1e-9
    with pytest.raises(InputError, match="HM-IDENTIFY-079"):  # no recording is longer than the horizon
        errors_ahead(exact, [t], 60.0)


class Scaled(Heater):
    """The sensor's scale differs between the recordings instead of the gain."""

    parameters = (*Heater.parameters[1:], Parameter("scale", 2.0, "-", 0.2, 10.0))

    def xdot(self, x, u, w, p):
        return ((u.power + p.bias - x.heat) / p.tau,)

    def output(self, x, u, w, p):
        return (p.scale * x.heat,)


def test_a_parameter_of_the_sensor_varies_but_is_no_candidate():
    recordings = recorded(GAINS[:6])
    fit, found = varying_of(Scaled, recordings)
    assert {p.name: p.varies for p in found.parameters}["scale"]
    chosen = choose_tracked([[(observer(fit, Scaled), recordings)]], found, 2.0)
    assert "scale" not in {one.name for one in chosen.tracked} | {
        name for names in chosen.tried for name in names.split(", ")
    }


def test_a_load_that_stays_beside_an_unlearned_parameter_is_doubted():
    """An observer that blames a load for everything, as one whose noise was tuned on a prior without a lag does."""
    fit, found = varying_of(Heater, recorded(GAINS))
    made = observer(fit)
    blaming = made.same_on(
        made.model,
        sigma_y=[0.5],
        sigma_x=[0.5],
        sigma_x0=[0.1],
        sigma_d=[0.1],
        sigma_d0=[2.0],
        sigma_h=[],
        sigma_h0=[],
    )
    gain = found.parameters[0].tracked()
    (doubt,) = _unlearned(blaming, recorded(GAINS[:3], seconds=10.0, seed=5), (gain,))
    assert "HM-IDENTIFY-083" in doubt
    assert "gain" in doubt
    assert _unlearned(made, recorded(GAINS[:3], seed=5), (gain,)) == ()


# fits of each recording alone


class Plain(Heater):
    """The heater without a bias."""

    parameters = Heater.parameters[:2]

    def xdot(self, x, u, w, p):
        return ((p.gain * u.power - x.heat) / p.tau,)


DAYS = (0.8, 3.6, 2.0, 1.2, 2.8)


def days(gains, late=0):
    return recorded(gains, seconds=60.0, late=late, sigma=0.02)


def own_fits(recordings):
    fit = fit_prior(Plain, recordings, [], dt=DT, length=4.0)
    return fit, fit_each(Plain, fit, recordings, dt=DT, length=4.0)


def test_a_late_input_shows_in_each_recording_where_days_differ():
    fit, found = own_fits(days(DAYS, late=1))
    assert not any("HM-IDENTIFY-080" in one for one in fit.warnings)  # the common fit does not see it
    assert len(found.late) == len(DAYS)
    assert [one.delay for one in found.late] == pytest.approx([DT] * len(DAYS), rel=0.2)
    assert found.varying.names == ("gain",)
    # the lacking delay biases the gains, but keeps their order
    assert np.argsort(found.values["gain"]).tolist() == np.argsort(DAYS).tolist()
    assert [code for code in ("081", "082") if any(f"HM-IDENTIFY-{code}" in one for one in found.warnings)]
    assert "0.1 s" in found.warnings[0]


def test_days_that_differ_have_own_values_and_no_late_input():
    _, found = own_fits(days(DAYS))
    assert not found.late
    # beside the common tau, which the differences bias
    assert found.values["gain"] == pytest.approx(DAYS, rel=0.06)
    assert found.ratio < 0.2
    (warning,) = found.warnings
    assert "HM-IDENTIFY-082" in warning
    assert f"day1 {found.values['gain'][1]:.3g}" in warning


def test_equal_days_need_no_warning():
    _, found = own_fits(days([2.0] * 5))
    assert found.warnings == ()
    assert found.ratio == 1.0
    assert fit_each(Plain, _, [t.part(slice(20)) for t in days([2.0])], dt=DT, length=4.0) is None
