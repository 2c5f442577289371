import numpy as np
import pytest

from hybrid_mpc import InputError
from hybrid_mpc.data.differentiate import (
    bandwidth,
    causal_derivatives,
    frequency_gain,
    local_polynomial,
    noise_gain,
    window_samples,
)

DT, LENGTH = 0.01, 0.2


def test_exact_on_quartics_up_to_the_ends():
    t = np.arange(100) * DT
    d = local_polynomial(t**4 - t, DT, LENGTH)
    # rounding 1e-16 times the gain of the second derivative, about 1e3, with margin for the ends
    np.testing.assert_allclose(d.value, t**4 - t, atol=1e-12)
    np.testing.assert_allclose(d.first, 4 * t**3 - 1, atol=1e-10)
    np.testing.assert_allclose(d.second, 12 * t**2, atol=1e-8)


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_error_on_a_sine_is_what_the_frequency_response_says(derivative):
    f = 3.0
    t = np.arange(400) * DT
    s = 2 * np.pi * f
    d = local_polynomial(np.sin(s * t), DT, LENGTH)
    got = (d.value, d.first, d.second)[derivative][50:-50]
    exact = (np.sin(s * t), s * np.cos(s * t), -(s**2) * np.sin(s * t))[derivative][50:-50]
    gain = frequency_gain(np.array([f]), DT, window_samples(LENGTH, DT), derivative=derivative)[0]
    assert 0.8 < gain < 0.9999  # the filter does attenuate: the comparison is not trivial
    np.testing.assert_allclose(got, gain * exact, atol=1e-9 * s**derivative)  # rounding only


def test_minus_3_db_at_the_bandwidth():
    f = bandwidth(DT, LENGTH)
    t = np.arange(1000) * DT
    value = local_polynomial(np.sin(2 * np.pi * f * t), DT, LENGTH).value[100:-100]
    # frequencies are searched in steps of 2.5 mHz, over which the gain moves by less than 1e-3
    assert np.sqrt(2 * np.mean(value**2)) == pytest.approx(np.sqrt(0.5), abs=5e-3)


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_noise_gain_is_that_of_the_coefficients(derivative):
    noise = np.random.default_rng(1).standard_normal(100_000)
    d = local_polynomial(noise, DT, LENGTH)
    got = (d.value, d.first, d.second)[derivative].std()
    # relative scatter of a standard deviation from about 100000/21 independent samples: 1 %; 4 sigma
    assert got == pytest.approx(noise_gain(DT, LENGTH, derivative=derivative), rel=0.04)


def test_causal_derivatives_exact_on_quadratics_and_delayed_by_half_the_window():
    t = np.arange(9) * DT
    d = causal_derivatives(3 + 2 * t + 5 * t**2, DT)
    centre = t[4]
    assert float(d.value) == pytest.approx(3 + 2 * centre + 5 * centre**2, rel=1e-12)
    assert float(d.first) == pytest.approx(2 + 10 * centre, rel=1e-10)
    assert float(d.second) == pytest.approx(10, rel=1e-8)


def test_too_short_a_window_or_signal_is_refused():
    with pytest.raises(InputError, match="Raise smoothing"):
        local_polynomial(np.zeros(50), 0.05, 0.2)
    with pytest.raises(InputError, match="needs 21 samples"):
        local_polynomial(np.zeros(20), DT, LENGTH)
    with pytest.raises(InputError, match="odd"):
        causal_derivatives(np.zeros(4), DT)
