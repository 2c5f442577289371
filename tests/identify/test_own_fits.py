"""Fits of each recording alone: differences between recordings, and a late input that they hide in the common fit."""

import numpy as np
import pytest

from hybrid_mpc import Parameter, Prior, Signal, fit_prior
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.own_fits import fit_each

DT, SIGMA = 0.1, 0.02
GAINS = (0.8, 3.6, 2.0, 1.2, 2.8)


class Heater(Prior):
    states = outputs = (Signal("heat", "K", -20.0, 20.0),)
    inputs = (Signal("power", "W", -5.0, 5.0),)
    parameters = (Parameter("gain", 2.0, "K/W", 0.2, 10.0), Parameter("tau", 1.0, "s", 0.1, 10.0))

    def xdot(self, x, u, w, p):
        return ((p.gain * u.power - x.heat) / p.tau,)


def recorded(gains, late=0, seconds=60.0):
    """A recording for each gain, whose input acts ``late`` periods after the command."""
    rng, n, found = np.random.default_rng(0), round(seconds / DT), []
    for i, gain in enumerate(gains):
        u = np.repeat(rng.uniform(-2.0, 2.0, n // 8 + 1), 8)[:n, None]
        acts, x, a = np.concatenate([np.repeat(u[:1], late, axis=0), u])[:n], np.zeros((n, 1)), np.exp(-DT)
        for k in range(n - 1):
            x[k + 1] = a * x[k] + (1 - a) * gain * acts[k]
        y, nothing = x + SIGMA * rng.standard_normal(x.shape), np.full(x.shape, np.nan)
        found.append(Trajectory(f"day{i}", "train", DT, np.arange(n) * DT, u, y, nothing, nothing))
    return found


def fits(recordings):
    fit = fit_prior(Heater, recordings, [], dt=DT, length=4.0)
    return fit, fit_each(Heater, fit, recordings, dt=DT, length=4.0)


def test_a_late_input_shows_in_each_recording_where_days_differ():
    fit, found = fits(recorded(GAINS, late=1))
    assert not any("HM-IDENTIFY-080" in one for one in fit.warnings)  # the common fit does not see it
    assert len(found.late) == len(GAINS)
    assert [one.delay for one in found.late] == pytest.approx([DT] * len(GAINS), rel=0.2)
    assert found.varying.names == ("gain",)
    # the lacking delay biases the gains, but keeps their order
    assert np.argsort(found.values["gain"]).tolist() == np.argsort(GAINS).tolist()
    assert [code for code in ("081", "082") if any(f"HM-IDENTIFY-{code}" in one for one in found.warnings)]
    assert "0.1 s" in found.warnings[0]


def test_days_that_differ_have_own_values_and_no_late_input():
    _, found = fits(recorded(GAINS))
    assert not found.late
    # beside the common tau, which the differences bias
    assert found.values["gain"] == pytest.approx(GAINS, rel=0.06)
    assert found.ratio < 0.2
    (warning,) = found.warnings
    assert "HM-IDENTIFY-082" in warning
    assert f"day1 {found.values['gain'][1]:.3g}" in warning


def test_equal_days_need_no_warning():
    _, found = fits(recorded([2.0] * 5))
    assert found.warnings == ()
    assert found.ratio == 1.0
    assert fit_each(Heater, _, [t.part(slice(20)) for t in recorded([2.0])], dt=DT, length=4.0) is None
