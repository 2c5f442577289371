"""What of errors an input explains: found where it is, and the band holds errors that it does not explain."""

import numpy as np
import pytest
from scipy.signal import lfilter

from hybrid_mpc.identify.evaluate import input_correlation


def test_what_an_input_drives_is_found_at_its_delay():
    rng = np.random.default_rng(0)
    u = [rng.standard_normal(800) for _ in range(3)]
    e = [0.3 * np.concatenate([np.zeros(4), v[:-4]]) + 0.3 * rng.standard_normal(800) for v in u]
    e[0][::5] = np.nan  # where nothing was measured
    rho, band = input_correlation(e[1:], u[1:], 10)
    assert int(np.argmax(np.abs(rho))) == 4
    assert rho[4] == pytest.approx(1 / np.sqrt(2), abs=0.05)  # of its variance a half
    assert band == pytest.approx(1.96 / np.sqrt(1600), rel=0.1)


@pytest.mark.parametrize("memory", [0.0, pytest.param(0.9, marks=pytest.mark.full), 0.97])
def test_the_band_holds_errors_that_are_independent_however_long_both_remember(memory):
    rng, inside = np.random.default_rng(1), []
    for _ in range(100):
        e, u = (lfilter([1.0], [1.0, -memory], rng.standard_normal((2, 1500)))[:, :, None] for _ in range(2))
        rho, band = input_correlation(list(e[:, :, 0]), list(u[:, :, 0]), 5)
        inside.append(np.abs(rho) <= band)
    # 95 % of 100 draws, whose lags are alike: three deviations of a share
    assert np.mean(inside) == pytest.approx(0.95, abs=0.05)


def test_what_does_not_move_has_none():
    rho, band = input_correlation([np.zeros(100)], [np.arange(100.0)], 3)
    assert np.isnan(rho).all()
    assert np.isnan(band)
