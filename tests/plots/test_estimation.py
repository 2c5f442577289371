"""The figure of a filter's innovations."""

import numpy as np
import pytest

from hybrid_mpc import InputError, Signal
from hybrid_mpc.plots import estimation
from hybrid_mpc.plots.style import save

PHI = (Signal("phi", "rad"),)
BANDS = {"mean_band": (0.9, 1.1), "correlation_band": 0.1}


def test_figure_shows_all_samples_and_lags(tmp_path):
    rng = np.random.default_rng(0)
    nis = [rng.chisquare(1, 200), rng.chisquare(1, 120)]
    nis[0][50:60] = np.nan
    r = 0.05 * rng.normal(size=(15, 1))
    figure = estimation.innovations(nis, r, dt=0.1, outputs=PHI, title="costs $1", **BANDS)
    top, bottom = figure.axes
    assert len(top.lines[0].get_xdata()) == 320
    assert len(top.lines[1].get_xdata()) == 320 - 50 + 1
    np.testing.assert_allclose(
        [bar.get_height() for bar in bottom.patches if bar.get_width() < 0.71][:15], r[:, 0]
    )
    assert "[s]" in top.get_xlabel()
    assert save(figure, tmp_path / "nis.png").stat().st_size > 10_000


def test_short_and_empty_recordings():
    estimation.innovations([np.full(10, np.nan)], np.zeros((2, 1)), dt=0.1, outputs=PHI, **BANDS)
    with pytest.raises(InputError, match="at least one recording"):
        estimation.innovations([], np.zeros((2, 1)), dt=0.1, outputs=PHI, **BANDS)
    with pytest.raises(InputError, match="autocorrelation"):
        estimation.innovations([np.ones(10)], np.zeros((2, 2)), dt=0.1, outputs=PHI, **BANDS)
