"""The tests of a filter's innovations: right at their rate, wrong where the filter is."""

from dataclasses import dataclass

import numpy as np
import pytest
from online_models import random_linear

from hybrid_mpc import ExtendedKalmanFilter, InputError, SwitchingFilter
from hybrid_mpc.estimate.consistency import consistency, innovations

SIGMA_Y, SIGMA_X = 0.1, 0.05


@dataclass(frozen=True)
class Run:
    y: np.ndarray
    u: np.ndarray


def system(n_y=1):
    return random_linear(2, n_x=2, n_u=1, n_y=n_y)


def make(model, scale_y=1.0, scale_x=1.0):
    return ExtendedKalmanFilter(
        model, sigma_y=np.full(model.n_y, scale_y * SIGMA_Y), sigma_x=np.full(2, scale_x * SIGMA_X),
        sigma_x0=[0.3, 0.3],
    )  # fmt: skip


def recorded(a, b, c, n, seed):
    """A linear system with exactly the noise that the filter assumes."""
    rng = np.random.default_rng(seed)
    x, u, y = np.zeros(2), rng.normal(size=(n, 1)), np.zeros((n, len(c)))
    for k in range(n):
        y[k] = c @ x + SIGMA_Y * rng.normal(size=len(c))
        x = a @ x + b @ u[k] + SIGMA_X * rng.normal(size=2)
    return Run(y, u)


def nis_passes(found):
    low, high = found.nis_band
    return low <= found.mean_nis <= high


def white(found):
    return found.ljung_box <= found.ljung_box_limit


@pytest.mark.full
def test_a_right_filter_passes_at_the_rate_of_the_bands():
    model, *matrices = system()
    ekf = make(model)
    found = [consistency(ekf, [recorded(*matrices, 180, seed)], lags=10) for seed in range(120)]
    # 120 trials at 95 %: the number of failures is binomial with mean 6 and deviation 2.4; below 16 (four of
    # these above the mean), and some must fail, else the bands are too wide: none has probability 0.95^120 = 2e-3.
    for passes in ([nis_passes(f) for f in found], [white(f) for f in found]):
        assert 0 < passes.count(False) < 16
    # Single lags and single NIS, 1200 and 18 600 of them: 93 % and 97 %, 94 % and 96 % are three deviations and more
    # away.
    lags = np.mean([np.abs(f.autocorrelation) <= f.correlation_band for f in found])
    assert 0.93 < lags < 0.97
    assert np.mean([f.nis_inside for f in found]) == pytest.approx(0.95, abs=0.01)


def test_wrong_noise_and_an_offset_fail():
    model, *matrices = system()
    runs = [recorded(*matrices, 600, seed) for seed in (1, 2)]
    right = consistency(make(model), runs)
    assert nis_passes(right)
    assert white(right)
    for scale, too_small in ((0.5, True), (2.0, False)):
        found = consistency(make(model, scale_y=scale), runs)
        assert not nis_passes(found)
        assert (found.mean_nis > found.nis_band[1]) == too_small
    drifting = [Run(run.y + 2.0 * np.arange(600)[:, None] / 600, run.u) for run in runs]
    assert not white(consistency(make(model), drifting))
    coloured = consistency(make(model, scale_x=0.02), [recorded(*matrices, 1500, 3)])
    assert not white(coloured)
    assert np.abs(coloured.autocorrelation).max() > 3 * coloured.correlation_band


def test_several_outputs_missing_samples_and_recordings():
    model, *matrices = system(n_y=2)
    runs = [recorded(*matrices, 800, seed) for seed in (7, 8, 9)]
    runs[0].y[100:140, 0] = np.nan  # half of the sample is gone
    runs[1].y[200:230] = np.nan  # all of it
    found = consistency(make(model), runs, skip=25)
    assert found.samples == 3 * (800 - 25) - 30
    assert found.autocorrelation.shape == (20, 2)
    # One draw of a right filter: seeds that pass. One in twenty does not, as (0, 1, 2), with a statistic of 58 to 56.
    assert nis_passes(found)
    assert white(found)
    first = found.runs[0]
    np.testing.assert_array_equal(first.degrees[100 - 25 : 140 - 25], 1)
    assert np.isnan(first.normalised[75:115]).all()
    assert first.t[0] == pytest.approx(25 * model.dt)
    # The squares of the normalised innovations are the NIS, which the filter takes output by output.
    whole = np.isfinite(first.normalised).all(axis=1)
    # rounding of two orders of the same arithmetic
    np.testing.assert_allclose(np.sum(first.normalised[whole] ** 2, axis=1), first.nis[whole], rtol=1e-9)


def test_the_statistics_by_hand():
    model, *matrices = system()
    run = recorded(*matrices, 400, 5)
    found = consistency(make(model), [run], skip=10, lags=3)
    e = innovations(make(model), run, skip=10).normalised[:, 0]
    assert len(e) == 390
    nis = [estimate.nis for estimate in make(model).run(run.y, run.u)]  # the filter's own estimates
    np.testing.assert_array_equal(found.runs[0].nis, nis[10:])
    r = [np.sum(e[k:] * e[:-k]) / np.sum(e**2) for k in (1, 2, 3)]
    np.testing.assert_allclose(found.autocorrelation[:, 0], r, rtol=1e-12)
    q = 390 * 392 * sum(r[k - 1] ** 2 / (390 - k) for k in (1, 2, 3))
    assert found.ljung_box == pytest.approx(q, rel=1e-12)
    assert found.ljung_box_limit == pytest.approx(7.8147, abs=1e-4)  # chi-square table, 3 degrees, 95 %
    assert found.correlation_band == pytest.approx(1.959964 / np.sqrt(390), rel=1e-6)


@pytest.mark.full
def test_a_switching_filter_is_judged_by_its_mixture():
    model, a, b, c = system()
    chain, steps = np.array([[0.95, 0.05], [0.5, 0.5]]), (SIGMA_X, 10 * SIGMA_X)
    switching = SwitchingFilter([make(model), make(model, scale_x=10.0)], chain)
    rng, runs = np.random.default_rng(10), []
    for _ in range(3):  # a system whose noise switches as the filter supposes
        x, u, y, mode = np.zeros(2), rng.normal(size=(800, 1)), np.zeros((800, 1)), 0
        for k in range(800):
            y[k] = c @ x + SIGMA_Y * rng.normal(size=1)
            mode = rng.choice(2, p=chain[mode])
            x = a @ x + b @ u[k] + steps[mode] * rng.normal(size=2)
        runs.append(Run(y, u))
    found = consistency(switching, runs)
    first = found.runs[0]
    np.testing.assert_array_equal(first.nis, first.normalised[:, 0] ** 2)
    # 2325 squares of a mixture whose kurtosis is some 7 to 10: the mean's deviation is 0.05 to 0.06
    assert found.mean_nis == pytest.approx(1.0, abs=0.2)
    assert consistency(make(model), runs).mean_nis > 2.0  # a filter that knows the quiet mode only


@pytest.mark.parametrize(
    ("options", "words"),
    [({"skip": 0}, "skip"), ({"lags": 0}, "lags"), ({"lags": 100}, r"500.*HM-ESTIMATE-002")],
)
def test_bad_options_and_shapes_are_refused(options, words):
    model, *matrices = system()
    run = recorded(*matrices, 200, 0)
    with pytest.raises(InputError, match=words):
        consistency(make(model), [run], **options)
    with pytest.raises(InputError, match="HM-ESTIMATE-002"):
        consistency(make(model), [])
    with pytest.raises(InputError, match="HM-ESTIMATE-003"):
        consistency(make(model), [Run(run.y, run.u[:-1])])
