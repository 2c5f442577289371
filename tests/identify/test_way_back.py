"""Fitted parameters that go a part of the way back to their nominal values."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import fit_prior
from hybrid_mpc.identify.fit import OutputFit, _way_back

NOMINAL = Pendulum().values


def sticking(phi, v):
    """A torque [N m] that the prior lacks."""
    return -0.15 * np.tanh(v / 0.1)


@pytest.fixture(scope="module")
def exact():
    runs = [record(seed, seconds=3.0) for seed in range(3)]
    return runs, fit_prior(Pendulum, runs[:2], runs[2:], dt=DT, warm_up=0.2)


def test_right_parameters_stay(exact):
    _, fit = exact
    for name, truth in TRUTH.items():
        assert fit.values[name] == pytest.approx(truth, rel=1e-4)
    assert fit.warnings == ()


@pytest.mark.parametrize("share", [0.125, 0.25, 0.5])
def test_the_share_is_found_at_which_runs_are_best(exact, share):
    runs, fit = exact
    own, smoother = OutputFit(Pendulum, DT), fit.smoother(Pendulum(fit.values), DT)
    truth = own.scaled(TRUTH)
    beyond = truth + (truth - own.nominal) * share / (1 - share)  # so far, the truth is on the way back
    found, left = _way_back(own, beyond, runs, smoother, 10, 100)
    assert found == share
    assert left < 1e-3


def test_all_parameters_go_the_same_share_and_the_fit_says_so():
    runs = [record(seed, seconds=3.0, extra=sticking, noise=0.01) for seed in range(3)]
    fitted, nearer = (fit_prior(Pendulum, runs[:2], runs[2:], dt=DT, warm_up=w) for w in (None, 0.2))
    (told,) = (line for line in nearer.warnings if "way back" in line)
    share = float(told.split()[2])
    assert share > 0
    for name, value in fitted.values.items():
        assert nearer.values[name] == pytest.approx(value + share * (NOMINAL[name] - value), rel=1e-12)
    assert nearer.stages == fitted.stages
    assert nearer.sigma != fitted.sigma  # what smooths states is of the prior that is handed on


def test_runs_shorter_than_a_warm_up_leave_the_fit_as_it_is(exact):
    runs, _ = exact
    short = [replace(run.part(slice(0, 40)), name=run.name) for run in runs]
    near, far = (fit_prior(Pendulum, short, short, dt=DT, warm_up=w).values for w in (None, 5.0))
    assert near == far
