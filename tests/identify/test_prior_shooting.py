import numpy as np
import pytest
from scipy.optimize._numdiff import approx_derivative
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError
from hybrid_mpc.identify.fit import ParameterFit, _Problem, cut_segments, multiple_shooting

NOISE = 5e-3


@pytest.fixture(scope="module")
def fit():
    return ParameterFit(Pendulum, DT)


def runs(noise, seed=0):
    return [record(10 * seed + k, seconds=3.0, noise=noise) for k in range(2)]


def test_segments_are_adjacent_and_cover_the_runs():
    segments = cut_segments(runs(0.0), 25)
    x = segments.windows.x
    assert segments.joined.tolist() == 2 * [True, True, True, True, False]
    for i in np.flatnonzero(segments.joined):
        assert np.array_equal(x[i, -1], x[i + 1, 0])
    few = cut_segments([record(k, seconds=3.0) for k in range(4)], 25, most=10)
    assert len(few.windows) == 10  # of two trajectories, the first and the last
    assert np.array_equal(few.windows.x[5, 0], record(3, seconds=3.0).x[0])
    with pytest.raises(InputError, match="holds a segment of 400 periods"):
        cut_segments(runs(0.0), 400)


def test_derivatives_are_exact(fit):
    problem = _Problem(fit, cut_segments(runs(NOISE), 25), fit.nominal)
    rng = np.random.default_rng(0)
    z = np.concatenate([fit.nominal * 1.1, problem.measured.ravel()])
    z += 0.01 * rng.standard_normal(z.shape)
    exact = problem.jacobian(z, 7.0)
    numeric = approx_derivative(lambda z: problem.residual(z, 7.0), z, method="3-point")
    # three-point differences: rounding^(2/3) of residuals of order one, times 7
    np.testing.assert_allclose(exact, numeric, rtol=0, atol=2e-7 * 7)


def test_without_noise_the_parameters_are_exact_and_the_gaps_closed(fit):
    segments = cut_segments(runs(0.0), 25)
    theta, _ = multiple_shooting(fit, fit.nominal, segments)
    for name, truth in TRUTH.items():
        # the integrators' difference at 20 ms
        assert fit.values(theta)[name] == pytest.approx(truth, rel=1e-5)


def test_standard_errors_are_those_of_the_noise(fit):
    z = []
    for seed in range(6):
        theta, jacobian = multiple_shooting(fit, fit.nominal, cut_segments(runs(NOISE, seed)[:1], 25))
        errors, warnings = fit.confidence(theta, jacobian)
        values = fit.values(theta)
        z += [(values[name] - truth) / errors[name] for name, truth in TRUTH.items()]
        assert warnings == []
    # 18 draws, correlated within a fit: their rms lies between 0.5 and 1.7 with more than 99 %
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.7


def test_a_start_far_off_still_finds_the_plant(fit):
    far = fit.nominal * np.array([2.5, 4.0, 20.0])  # J, mgl, d
    theta, _ = multiple_shooting(fit, far, cut_segments(runs(NOISE), 25))
    for name, truth in TRUTH.items():
        assert fit.values(theta)[name] == pytest.approx(truth, rel=0.05)  # noise of 1 % of the motion
