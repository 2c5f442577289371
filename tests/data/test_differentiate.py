"""Smoothing and differentiation: every method does what it says of its bandwidth, delay and noise."""

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from hybrid_mpc import (
    CausalPolynomial,
    InputError,
    LocalPolynomial,
    SmoothingSpline,
    ZeroPhaseFilter,
    differentiate,
)
from hybrid_mpc.data.differentiate import gcv_cutoff, local_polynomial

DT = 0.01
METHODS = {
    "local": LocalPolynomial(0.2),
    "spline": SmoothingSpline(6.0),
    "filter": ZeroPhaseFilter(6.0),
    "causal": CausalPolynomial(0.1),
    "causal_now": CausalPolynomial(0.1, lag=0.0),
}


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


def parts(d):
    return d.value, d.first, d.second


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_sines_come_out_as_the_response_says(method, derivative):
    """Gain and phase, also where they are far from 1: below, at and above the bandwidth."""
    t = np.arange(1200) * DT
    for f in (0.7, 3.0, 7.0):
        s = 2 * np.pi * f
        got = parts(differentiate(np.exp(1j * s * t).real, DT, method))[derivative]
        response = method.response(np.array([f]), DT, derivative)[0]
        then = t - method.delay(DT)
        expected = (response * (1j * s) ** derivative * np.exp(1j * s * then)).real
        # 300 samples are more than any reach: kernels are below 1e-12 there, times their gain of about s^2
        inner = slice(300, -300)
        np.testing.assert_allclose(got[inner], expected[inner], atol=1e-8 * max(1.0, s**derivative))


@pytest.mark.parametrize("method", [SmoothingSpline, ZeroPhaseFilter])
@pytest.mark.parametrize(("cutoff", "dt"), [(6.0, 0.01), (0.5, 0.01), (3.0, 0.001), (40.0, 0.01)])
def test_the_cutoff_is_where_the_value_has_lost_3_db(method, cutoff, dt):
    gain = method(cutoff).response(np.array([cutoff]), dt)[0]
    assert gain == pytest.approx(np.sqrt(0.5), abs=1e-6)  # equations of the slow splines lose digits
    step = max(1 / (2**15 * dt), 1e-3 * cutoff)  # of the transform in which it is looked for
    assert method(cutoff).bandwidth(dt) == pytest.approx(cutoff, abs=step)


def test_the_local_polynomial_is_exact_on_quartics_up_to_the_ends():
    t = np.arange(100) * DT
    d = differentiate(t**4 - t, DT, LocalPolynomial(0.2))
    # rounding 1e-16 times the gain of the second derivative, about 1e3, with margin for the ends
    np.testing.assert_allclose(d.value, t**4 - t, atol=1e-12)
    np.testing.assert_allclose(d.first, 4 * t**3 - 1, atol=1e-10)
    np.testing.assert_allclose(d.second, 12 * t**2, atol=1e-8)


def test_the_causal_polynomial_is_exact_on_quadratics_late_by_its_lag_and_knows_no_future():
    t, m = np.arange(60) * DT, CausalPolynomial(0.1)
    d = differentiate(3 + 2 * t + 5 * t**2, DT, m)
    assert m.delay(DT) == pytest.approx(0.05)
    then = t[10:] - 0.05
    assert np.isnan(d.first[:10]).all()
    np.testing.assert_allclose(d.value[10:], 3 + 2 * then + 5 * then**2, rtol=1e-10)
    np.testing.assert_allclose(d.first[10:], 2 + 10 * then, rtol=1e-10)
    np.testing.assert_allclose(d.second[10:], 10.0, rtol=1e-8)  # rounding times its gain of 1e3
    y = np.random.default_rng(1).standard_normal((60, 2))
    later = y.copy()
    later[31:] += 5.0
    first, other = (differentiate(z, DT, m).first[:31] for z in (y, later))
    np.testing.assert_array_equal(first, other)


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_noise_comes_through_as_said(method, derivative):
    noise = np.random.default_rng(2).standard_normal(20_000)
    got = np.nanstd(parts(differentiate(noise, DT, method))[derivative])
    # values of neighbours depend on each other over about 20 samples: 20000 / 20 independent ones scatter by
    # 1 / sqrt(2 * 1000) = 2.2 %; 4 sigma
    assert got == pytest.approx(method.noise_gain(DT, derivative), rel=0.09)


def test_straight_lines_pass_up_to_the_ends(method):
    """No method bends a straight line, not even where it has too few neighbours."""
    t = np.arange(400) * DT
    d = differentiate(3.0 - 2.0 * t, DT, method)
    known = np.isfinite(d.value)
    assert known.sum() >= 390
    # rounding 1e-15 times the noise gain of the second derivative, up to 1e4; recursions add up a few of them
    np.testing.assert_allclose(d.value[known], (3.0 - 2.0 * (t - method.delay(DT)))[known], atol=1e-9)
    np.testing.assert_allclose(d.first[known], -2.0, atol=1e-8)
    np.testing.assert_allclose(d.second[known], 0.0, atol=1e-6)


@pytest.mark.full
def test_gcv_is_scipys_and_finds_a_useful_bandwidth():
    rng = np.random.default_rng(4)
    t = np.arange(1500) * DT
    true = np.sin(2 * np.pi * 0.7 * t)
    y = true + 0.05 * rng.standard_normal(len(t))
    value = SmoothingSpline(gcv_cutoff(y, DT)).derivatives(y, DT).value
    scipys = make_smoothing_spline(np.arange(1500.0), y)(np.arange(1500.0))
    # the trace over frequencies is right up to terms of the ends: the two curves differ by far less than the noise
    assert np.abs(value - scipys).max() < 0.01 * 0.05
    assert np.std(value - true) < 0.3 * 0.05


def test_bad_input_is_refused(method):
    for y, dt, match in (
        (np.zeros((4, 4, 4)), DT, "shape"),
        (np.zeros(0), DT, "shape"),
        (np.zeros(100), 0.0, "HM-DATA-003"),
        (np.r_[np.zeros(50), np.nan, np.zeros(50)], DT, r"50.*HM-DATA-004"),
        (np.zeros(4), DT, "the signal has 4"),
    ):
        with pytest.raises(InputError, match=match):
            differentiate(y, dt, method)


def test_bad_settings_are_refused():
    y = np.zeros(100_000)
    for m, dt, match in (
        (SmoothingSpline(60.0), DT, r"50.*HM-DATA-012"),
        (ZeroPhaseFilter(-1.0), DT, "positive"),
        (SmoothingSpline(0.01), 1e-3, "HM-DATA-009"),
        (CausalPolynomial(0.1, lag=0.2), DT, r"0\.2.*HM-DATA-008"),
        (CausalPolynomial(0.01), DT, "HM-DATA-006"),
    ):
        with pytest.raises(InputError, match=match):
            differentiate(y, dt, m)
    with pytest.raises(InputError, match="HM-DATA-010"):
        gcv_cutoff(np.zeros(10), DT)
    with pytest.raises(InputError, match=r"21.*HM-DATA-007"):
        local_polynomial(np.zeros(20), DT, 0.2)
