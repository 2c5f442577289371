import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.prior_fit import fit_prior

NOISE = 2e-3


@pytest.fixture(scope="module")
def fit():
    train = [record(seed, seconds=3.0, noise=NOISE) for seed in range(3)]
    return fit_prior(Pendulum, train, [record(9, seconds=3.0, role="valid", noise=NOISE)], dt=DT)


def test_known_parameters_are_recovered_within_their_standard_errors(fit):
    for name, truth in TRUTH.items():
        error, sigma = fit.values[name] - truth, fit.standard_errors[name]
        # the start of every window carries noise too, which the standard errors do not know of, and
        # windows overlap: 3 sigma get a factor of 3 for both
        assert abs(error) < 9 * sigma, (name, error, sigma)
        assert abs(error) < 0.02 * truth, (name, error)  # noise of 0.2 % of the motion over 9 s


def test_standard_errors_shrink_with_the_noise(fit):
    train = [record(seed, seconds=3.0, noise=NOISE / 10) for seed in range(3)]
    quiet = fit_prior(Pendulum, train, [record(9, seconds=3.0, role="valid", noise=NOISE / 10)], dt=DT)
    for name in TRUTH:
        ratio = fit.standard_errors[name] / quiet.standard_errors[name]
        assert 3 < ratio < 30, (name, ratio)  # proportional to the noise: 10, up to the winner's stage


def test_a_parameter_without_effect_is_named(fit):
    at_rest = record(0, seconds=1.0)
    for array in (at_rest.u, at_rest.x, at_rest.y, at_rest.xdot):
        array[:] = 0.0
    at_rest.u[::2] = 1e-12  # nothing moves: no parameter can be told
    with torch.no_grad():
        dull = fit_prior(Pendulum, [at_rest], [at_rest], dt=DT)
    assert dull.warnings


def test_no_trajectory_is_refused():
    with pytest.raises((InputError, ValueError)):
        fit_prior(Pendulum, [], [], dt=DT)


def test_the_winner_is_the_best_on_validation(fit):
    errors = [stage["validation_error"] for stage in fit.stages]
    assert min(errors) < 0.2 * errors[0]  # the nominal parameters are 20 to 50 % off
    assert np.isfinite(errors).all()


def test_a_fit_goes_on_from_another_with_the_length_that_won(fit):
    train = [record(seed, seconds=3.0) for seed in range(3)]  # the same motions without noise
    valid = [record(9, seconds=3.0, role="valid")]
    again = fit_prior(Pendulum, train, valid, dt=DT, before=fit)
    assert [stage["stage"] for stage in again.stages] == ["the fit before", fit.best]
    for name, truth in TRUTH.items():
        assert (
            abs(again.values[name] - truth) < 0.1 * abs(fit.values[name] - truth) + 1e-6
        )  # no noise, no error
