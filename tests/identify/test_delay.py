"""Recordings of a machine whose input acts later."""

from dataclasses import replace

import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError, Parameter, Prior, Signal, fit_prior
from hybrid_mpc.identify.delay import delayed, lost_samples
from hybrid_mpc.identify.step import rk4


def late_recording(seed):
    """A recording with the commanded torque, which acts 1.3 periods later; at 1.5 its two shares would be equal."""
    run = record(seed, seconds=3.0)
    prior, x = Pendulum(TRUTH), [torch.tensor(run.x[0])]
    for k in range(len(run.u) - 1):
        older, younger = (torch.tensor(run.u[max(k - m, 0)]) for m in (2, 1))
        between = rk4(lambda z, u=older: prior(z, u), x[-1], 0.3 * DT, 2)
        x.append(rk4(lambda z, u=younger: prior(z, u), between, 0.7 * DT, 2))
    states = torch.stack(x).numpy()
    return replace(run, x=states, y=states[:, :1])


def test_a_prior_is_fitted_to_delayed_recordings():
    commanded = [late_recording(seed) for seed in range(2)]
    acting = [delayed(run, 1.3 * DT) for run in commanded]
    right, wrong = (
        fit_prior(Pendulum, runs, runs, dt=DT, methods=("equation_error",)) for runs in (acting, commanded)
    )
    for name, truth in TRUTH.items():
        # what acts is told by its mean over a period: that costs a part of the motion within one
        assert right.values[name] == pytest.approx(truth, rel=0.01)
    assert abs(wrong.values["d"] / TRUTH["d"] - 1) > 0.1


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


@pytest.mark.parametrize("bad", [0.0, -1.0, float("inf")])
def test_a_delay_that_is_none_is_refused(bad):
    with pytest.raises(InputError, match="delay must be positive"):
        delayed(record(0, seconds=0.2), bad)


def test_a_delay_longer_than_the_recording_is_refused():
    with pytest.raises(InputError, match="leaves nothing"):
        delayed(record(0, seconds=0.2), 1.0)


def test_odd_states_are_still_refused():
    class Odd(Prior):
        states = (Signal("a", "rad"), Signal("b", "rad"), Signal("c", "rad"))
        inputs = (Signal("u", "N m"),)
        outputs = states[:1]
        parameters_spec = (Parameter("k", 1.0, "N m", 0.5, 2.0),)

    with pytest.raises(InputError, match="in pairs, got 3"):
        Odd()
