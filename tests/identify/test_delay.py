"""Recordings of a machine whose input acts later."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import Parameter, Prior, Signal, Trajectory, fit_prior
from hybrid_mpc.identify.delay import delayed, lost_samples
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.simulation import Simulation


def late_recording(seed, delay=1.3):
    """A recording with the commanded torque, which acts 1.3 periods later; at 1.5 its two shares would be equal."""
    run, younger = record(seed, seconds=3.0), int(delay)
    prior, x = Pendulum(TRUTH), [run.x[0]]
    shares = (delay - younger, 1.0 + younger - delay)
    parts = [Simulation(prior.equations.xdot, share * DT) for share in shares]
    for k in range(len(run.u) - 1):
        now = x[-1][None]
        for simulation, m in zip(
            parts, (younger + 1, younger), strict=True
        ):  # the older input, then the younger
            held = run.u[None, [max(k - m, 0)] * 2]
            now = simulation.values(now, held, np.zeros((1, 2, 0)), prior.p, 2)[:, -1]
        x.append(now[0])
    states = np.stack(x)
    return replace(run, x=states, y=states[:, :1])


def test_a_prior_is_fitted_to_delayed_recordings():
    commanded = [late_recording(seed) for seed in range(2)]
    acting = [delayed(run, 1.3 * DT) for run in commanded]
    right, wrong = (fit_prior(Pendulum, runs, runs, dt=DT) for runs in (acting, commanded))
    for name, truth in TRUTH.items():
        # what acts is told by its mean over a period: that costs a part of the motion within one
        assert right.values[name] == pytest.approx(truth, rel=0.01)
    # who takes the input for one that acts at once errs by several times that, and explains the motion worse
    assert abs(wrong.values["d"] / TRUTH["d"] - 1) > 0.05
    errors = [min(row["validation_error"] for row in fit.stages) for fit in (right, wrong)]
    assert errors[0] < 0.1 * errors[1]
    (told,) = (w for w in wrong.warnings if "later than recorded" in w)
    assert 1.2 * DT < float(told.split()[4]) < 1.4 * DT
    assert not any("later than" in w for w in right.warnings)


def late_told(train, valid):
    return any("later than" in w for w in fit_prior(Pendulum, train, valid, dt=DT).warnings)


@pytest.mark.full
def test_late_inputs_are_told_where_all_recordings_show_them():
    late, others = [late_recording(seed) for seed in range(3)], [record(seed, 3.0) for seed in range(3)]
    noisy = [record(seed, seconds=3.0, noise=0.01) for seed in range(3)]
    assert late_told(late[:2], late[2:])
    assert late_told(late, [])
    assert late_told(late[:2], [late[2].part(slice(0, 6))])  # too short to tell
    assert not late_told(late[:2], others[2:])
    assert not late_told(noisy[:2], noisy[2:])


class Lag(Prior):
    """A lag of a second."""

    states = outputs = (Signal("speed", "-", -9.0, 9.0),)
    inputs = (Signal("u", "-"),)
    parameters = (Parameter("gain", 1.0, "-", 0.2, 5.0), Parameter("tau", 1.0, "s", 0.2, 5.0))

    def xdot(self, x, u, w, p):
        """First order."""
        return ((p.gain * u.u - x.speed) / p.tau,)


@pytest.mark.parametrize("late", [0, 1])
def test_short_free_runs_show_a_delay_that_a_load_hides_in_long_ones(late):
    """A slow load causes most of the error over 200 periods; over eight periods the delay does."""
    dt, n, runs = 0.02, 3000, []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u, a = np.repeat(rng.uniform(-1.0, 1.0, n // 5), 5), np.exp(-dt / 1.0)
        load, x = 0.2 * np.sin(2 * np.pi * dt * np.arange(n) / (5.0 + seed)), np.zeros(n)
        for k in range(n - 1):
            x[k + 1] = a * x[k] + (1 - a) * (u[max(0, k - late)] + load[k])
        nothing = np.full((n, 1), np.nan)
        y = (x + 1e-3 * rng.standard_normal(n))[:, None]
        runs.append(Trajectory(f"r{seed}", "train", dt, dt * np.arange(n), u[:, None], y, nothing, nothing))
    warnings = fit_prior(Lag, runs[:1], runs[1:], dt=dt, length=200 * dt).warnings
    told = [one for one in warnings if "HM-IDENTIFY-080" in one]
    assert len(told) == late
    assert not told or "8 periods" in told[0]


@pytest.mark.full
def test_a_delay_that_nobody_would_act_on_is_not_told(monkeypatch):
    """Half of a hundredth of a period explains all that is left of exact recordings, and matters to nobody."""
    runs = [late_recording(seed, 0.005) for seed in range(3)]
    assert not late_told(runs[:2], runs[2:])
    monkeypatch.setattr("hybrid_mpc.identify.fit_warnings.SHORTEST", 0.0)
    assert late_told(runs[:2], runs[2:])


@pytest.mark.parametrize("largest", [2 * DT, pytest.param(4 * DT, marks=pytest.mark.full)])
def test_the_delay_is_fitted_with_the_parameters(largest):
    commanded = [late_recording(seed) for seed in range(2)]
    fit = fit_prior(Pendulum, commanded, commanded, dt=DT, largest_delay=largest)
    # 1.3 periods; within a period the input is told by its mean
    assert fit.delay == pytest.approx(1.3 * DT, abs=0.02 * DT)
    for name, truth in TRUTH.items():
        assert fit.values[name] == pytest.approx(truth, rel=0.01)
    assert "delay" not in fit.values
    ours, theirs = (
        smoothed(Pendulum, fit, [run], DT)[0]
        for run in (commanded[0], replace(commanded[0], x=0 * commanded[0].x))
    )
    np.testing.assert_array_equal(ours.x, theirs.x)  # from the outputs alone, under the input that acts
    np.testing.assert_array_equal(ours.u, delayed(commanded[0], fit.delay).u)
    np.testing.assert_allclose(ours.x, commanded[0].x[lost_samples(fit.delay, DT) :], atol=5e-3)


@pytest.mark.parametrize("delay", [0.6 * DT, DT, 2.7 * DT, 3 * DT])
def test_an_input_acts_as_its_mean_over_the_period(delay):
    run = record(0, seconds=2.0)
    later = delayed(run, delay)
    lost = lost_samples(delay, DT)
    assert len(later.t) == len(run.t) - lost
    assert later.t[0] == run.t[lost]
    whole, share = int(delay / DT + 1e-9), delay / DT - int(delay / DT + 1e-9)
    for k in (lost, lost + 7, len(run.t) - 1):
        older = run.u[k - whole - 1] if share > 1e-9 else 0.0
        assert later.u[k - lost] == pytest.approx((1 - share) * run.u[k - whole] + share * older, abs=1e-12)
