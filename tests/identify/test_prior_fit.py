from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError, fit_prior
from hybrid_mpc.identify.fit import ParameterFit

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
    at_rest.u[::2] = 1e-12  # nothing moves: no parameter can be found
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
        # no noise, no error
        assert abs(again.values[name] - truth) < 0.1 * abs(fit.values[name] - truth) + 1e-6


def test_methods_are_those_asked_for_and_the_best_wins():
    train = [record(seed, seconds=3.0, noise=NOISE) for seed in range(2)]
    valid = [record(9, seconds=3.0, role="valid", noise=NOISE)]
    one = fit_prior(Pendulum, train, valid, dt=DT, methods=("equation_error",))
    assert [row["stage"] for row in one.stages] == ["nominal", "equation error"]
    two = fit_prior(Pendulum, train, valid, dt=DT, methods=("multiple_shooting", "equation_error"))
    assert [row["stage"] for row in two.stages] == ["nominal", "equation error", "multiple shooting 0.5 s"]
    assert two.stages[:2] == one.stages
    assert two.best == "multiple shooting 0.5 s"  # of the two the one that knows of noise in the states
    again = fit_prior(Pendulum, train, valid, dt=DT, before=two, methods=("multiple_shooting",))
    assert [row["stage"] for row in again.stages] == ["the fit before", "multiple shooting 0.5 s"]
    same = fit_prior(Pendulum, train, valid, dt=DT, before=two, methods=("equation_error",))
    assert (same.values, same.standard_errors, same.correlations) == (
        two.values,
        two.standard_errors,
        two.correlations,
    )


@pytest.mark.parametrize("methods", [("particle_swarm",), (), "output_error"])
def test_methods_that_are_none_are_refused(methods):
    with pytest.raises(InputError, match="equation_error, output_error, multiple_shooting"):
        fit_prior(Pendulum, [], [], dt=DT, methods=methods)


def test_a_start_of_ones_own_is_tried_besides_the_nominal_parameters():
    train = [record(0, seconds=1.0)]
    fit = fit_prior(Pendulum, train, train, dt=DT, methods=("output_error",), start=TRUTH)
    assert [row["stage"] for row in fit.stages][:2] == ["nominal", "start"]
    assert fit.stages[1]["validation_error"] < 1e-3 * fit.stages[0]["validation_error"]  # it is the truth


def test_a_prior_without_free_parameters_stays_as_it_is():
    class Fixed(Pendulum):
        parameters_spec = tuple(replace(p, lower=p.value, upper=p.value) for p in Pendulum.parameters_spec)

    train = [record(0, seconds=1.0)]
    same = fit_prior(Fixed, train, train, dt=DT)
    assert same.values == Fixed().values
    assert (same.best, same.standard_errors, same.warnings) == ("nominal", {}, ())
    assert same.stages[0]["validation_error"] > 0.01  # J is 50 % off
    assert fit_prior(Fixed, train, train, dt=DT, before=same) == same


def test_correlations_and_t_ratios_are_those_of_the_covariance(fit):
    parameters = ParameterFit(Pendulum, DT)
    jacobian = np.random.default_rng(0).normal(size=(50, 3)) @ np.diag([1.0, 5.0, 0.2])
    jacobian[:, 1] += 40 * jacobian[:, 0]  # J and mgl nearly one
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    sigma = np.sqrt(np.diag(covariance))
    found = parameters.correlations(jacobian)
    assert found["J, mgl"] == pytest.approx(covariance[0, 1] / sigma[0] / sigma[1], rel=1e-9)
    assert found["mgl, d"] == pytest.approx(covariance[1, 2] / sigma[1] / sigma[2], rel=1e-6, abs=1e-9)
    assert set(fit.correlations) == {"J, mgl", "J, d", "mgl, d"}
    assert fit.t_ratios["J"] == fit.values["J"] / fit.standard_errors["J"]
    assert fit.identifiability == fit.warnings == ()  # these data identify all three
    assert any("J and mgl" in line for line in replace(fit, correlations=found).identifiability)


def test_a_motion_that_hides_the_scale_is_reported(fit):
    # almost no torque: only the ratios of J, mgl and d show, and their errors go together
    train = [record(seed, seconds=3.0, size=1e-3, noise=NOISE) for seed in range(3)]
    valid = [record(9, seconds=3.0, size=1e-3, role="valid", noise=NOISE)]
    hidden = fit_prior(Pendulum, train, valid, dt=DT)
    assert "J and mgl can hardly be told apart" in " ".join(hidden.identifiability)


def test_the_table_has_a_row_a_parameter(fit):
    table = fit.table(Pendulum.parameters_spec)
    assert list(table.index) == ["J", "mgl", "d"]
    assert table.loc["mgl", "nominal"] == 1.0
    assert table.loc["mgl", "fitted"] == fit.values["mgl"]
    assert table.loc["mgl", "t_ratio"] == pytest.approx(fit.values["mgl"] / fit.standard_errors["mgl"])
    with_j = [fit.correlations[key] for key in ("J, mgl", "J, d")]
    assert table.loc["J", "correlation"] == max(with_j, key=abs)
    assert fit.rows(Pendulum.parameters_spec)[2]["unit"] == "N m s/rad"
