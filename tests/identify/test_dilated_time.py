"""Fit and smoother of machines whose periods are milliseconds, minutes or hours: one pendulum in dilated time."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError, fit_prior, fit_smoother
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.workflow.benchmark import REFIT_LENGTHS, refitted

POWERS = {"J": 2, "mgl": 0, "d": 1}
"""With time k times as long, an inertia of k^2 J and a damping of k d give the same swings."""
DILATIONS = [5e-3, 0.05, 100.0, 180_000.0]
"""Periods of 0.1 ms, 1 ms, 2 s and an hour in place of 20 ms."""


def dilated(k):
    """The prior whose swings take k times as long."""

    class Dilated(Pendulum):
        parameters = tuple(
            replace(
                p, **{name: getattr(p, name) * k ** POWERS[p.name] for name in ("value", "lower", "upper")}
            )
            for p in Pendulum.parameters
        )

    return Dilated


def stretched(run, k):
    """The same motion in k times as much time."""
    x, xdot = run.x.copy(), run.xdot.copy()
    x[:, 1] /= k
    xdot[:, 0] /= k
    xdot[:, 1] /= k**2
    return replace(run, dt=k * run.dt, t=k * run.t, x=x, xdot=xdot)


@pytest.fixture(scope="module")
def runs():
    return [record(seed, seconds=3.0, noise=1e-3) for seed in range(4)]


@pytest.mark.parametrize(
    "k", [DILATIONS[0], DILATIONS[-1], *(pytest.param(k, marks=pytest.mark.full) for k in DILATIONS[1:-1])]
)
def test_the_fit_finds_the_parameters_at_any_sampling_period(runs, k):
    *train, valid = [stretched(run, k) for run in runs]
    fit = fit_prior(dilated(k), train, [valid], dt=k * DT)
    for name, value in TRUTH.items():
        # noise of 0.1 % of the motion over 12 s; damping is told ten times less well than what carries the swing
        assert fit.values[name] == pytest.approx(value * k ** POWERS[name], rel=0.05), name
    assert fit.best != "nominal"


@pytest.mark.parametrize("k", [DILATIONS[0], DILATIONS[-1]])
def test_the_smoother_finds_the_states_at_any_sampling_period(runs, k):
    noisy = [stretched(run, k) for run in runs[:2]]
    exact = stretched(record(0, seconds=3.0), k)
    prior = dilated(k)({name: value * k ** POWERS[name] for name, value in TRUTH.items()})
    found = fit_smoother(prior, noisy, k * DT).smooth(noisy)[0]
    error = np.std(found.x - exact.x, axis=0) / np.std(exact.x, axis=0)
    # the noise is 0.2 % of the angle and, differenced over a period, 7 % of the speed: the model averages that away
    assert error[0] < 2e-3
    assert error[1] < 1e-2


WINDOWS = ("free runs of 0.5 s", "free runs of 2 s")


def test_windows_are_of_half_a_second_and_two_at_20_ms(runs):
    """25 and 100 periods; the recordings are too short for 5 s, and the longest windows are whole ones."""
    assert time_unit(runs, DT) == 1.0
    fit = fit_prior(Pendulum, runs[:1], runs[1:2], dt=DT)
    assert [row["stage"] for row in fit.stages] == ["nominal", *WINDOWS, "free runs of 2.98 s"]
    longer = fit_prior(Pendulum, runs[:1], runs[1:2], dt=DT, length=1.5)
    assert [row["stage"] for row in longer.stages] == [
        "nominal",
        "free runs of 0.5 s",
        "free runs of 1.5 s",
        "whole recordings",
    ]


def test_a_recording_shorter_than_any_window_is_one(runs):
    short = [run.part(slice(20)) for run in runs]
    fit = fit_prior(Pendulum, short[:2], short[2:], dt=DT)
    assert [row["stage"] for row in fit.stages] == ["nominal", "free runs of 0.38 s"]  # all of its 19 periods


@pytest.mark.parametrize("k", [20.0, 180_000.0])
def test_a_refit_counts_in_the_machines_seconds(runs, k):
    """Of a pendulum whose swings take k times as long, 2.5 k seconds are fitted anew as 2.5 s of the other."""
    prior, (run, *_) = dilated(k), [stretched(run, k) for run in runs]
    fit = fit_prior(prior, [run], [run], dt=k * DT)
    off = replace(fit, values={**fit.values, "mgl": 0.8 * fit.values["mgl"]})
    again, rest = refitted(prior, off, run, seconds=2.5 * k, dt=k * DT)
    unit = time_unit([run], k * DT)
    assert [row["stage"] for row in again.stages] == [f"free runs of {unit * s:g} s" for s in REFIT_LENGTHS]
    assert len(rest.t) == len(run.t) - 125
    # noise of 0.1 % of the motion over 2.5 s
    assert again.values["mgl"] == pytest.approx(TRUTH["mgl"], rel=0.05)
    with pytest.raises(InputError, match=f"at least {1.5 * unit:g} s"):
        refitted(prior, off, run, seconds=1.2 * unit, dt=k * DT)
