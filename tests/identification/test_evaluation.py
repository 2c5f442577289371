from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc.identification.evaluation import FreeRun, free_runs, score, smoothed_start
from hybrid_mpc.identification.step import PriorStep


def hand_made(n, dt, error):
    """A run of n samples: rates off by ``error`` in the second state, output off by 0.5, power by 0.25 W."""
    zeros, t = np.zeros((n, 2)), dt * np.arange(n)
    xdot_hat = zeros + np.array([0.0, error])
    y, power = np.ones((n, 1)), np.zeros(n)
    return FreeRun(
        "r", t, zeros[:, :1], zeros, zeros, y, y + 0.5, zeros, xdot_hat, power, power - 0.25
    )  # fmt: skip


def test_scores_of_a_run_made_by_hand():
    figures = score([hand_made(100, 0.02, -3.0)])
    assert figures.e_sim_s == pytest.approx(3.0, rel=1e-12)  # 1/T integral of 3 over T
    assert figures.e_sim_literal_s == pytest.approx(
        3.0 * 2.0 / 100, rel=1e-12
    )  # integral over 2 s / 100 samples
    # 1/T integral of 3 / (1 + t) over T = 2 s; the sum over left ends errs by dt / 2 (f(0) - f(T)) / T
    assert figures.e_sim_lambda1_s == pytest.approx(3.0 * np.log(3.0) / 2.0, abs=0.02 / 2 * 2.0 / 2.0 * 1.05)
    assert figures.rmse_rad == pytest.approx(0.5)
    assert figures.energy_violation_w == pytest.approx(0.25)
    assert figures.amplitude_ratio == pytest.approx(1.5)


def test_runs_count_alike_and_only_the_literal_form_knows_the_sampling():
    slow, fast = hand_made(100, 0.02, 1.0), hand_made(200, 0.01, 1.0)
    assert score([slow]).e_sim_s == pytest.approx(score([fast]).e_sim_s)
    assert score([slow]).e_sim_literal_s == pytest.approx(2 * score([fast]).e_sim_literal_s)
    short, long = hand_made(10, 0.02, 4.0), hand_made(1000, 0.02, 2.0)
    assert score([short, long]).e_sim_s == pytest.approx(3.0)


def test_a_diverging_run_makes_its_figures_infinite():
    run = hand_made(50, 0.02, 1.0)
    run.y_hat[7] = np.nan
    figures = score([run])
    assert figures.rmse_rad == np.inf
    assert figures.e_sim_s == pytest.approx(1.0)


def test_the_true_model_runs_along_the_measurement():
    prior, run = Pendulum(TRUTH), record(3, seconds=2.0)
    warm = 25
    start = smoothed_start(prior, run, warm)
    # y is exact and the prior true: only the integrator's error (1e-8 a period) is left
    np.testing.assert_allclose(start, run.x[warm], atol=1e-5)
    (free,) = free_runs(PriorStep(prior, DT), prior, [run], [start], warm, torch.zeros(0).double())
    assert len(free.t) == len(run.t) - warm - 1
    np.testing.assert_allclose(free.y_hat, free.y, atol=1e-4)
    assert score([free]).energy_violation_w < 1e-3


def test_a_start_knows_the_warm_up_alone_and_averages_its_noise():
    prior, run, warm = Pendulum(TRUTH), record(3, seconds=2.0), 25
    noise = 1e-3 * np.random.default_rng(0).standard_normal(run.y.shape)
    noisy = replace(run, y=run.y + noise)
    start = smoothed_start(prior, noisy, warm)
    later = replace(noisy, y=noisy.y.copy(), x=noisy.x.copy())
    later.y[warm + 1 :], later.x[warm + 1 :] = 9.0, 9.0
    # rounding of the least squares may depend on where in memory its arrays lie
    np.testing.assert_allclose(smoothed_start(prior, later, warm), start, rtol=0, atol=1e-12)
    # position, speed and acceleration from 26 samples in 0.5 s: sigma_v = sqrt(192 / 26) / 0.5 = 5.4 sigma
    assert abs(start[1] - run.x[warm, 1]) < 3 * 5.4 * 1e-3


def test_runs_of_different_length_are_each_their_own():
    prior, warm = Pendulum(), 25
    runs = [record(1, seconds=1.5), record(2, seconds=2.5)]
    starts = [run.x[warm] for run in runs]
    none = torch.zeros(0).double()
    together = free_runs(PriorStep(prior, DT), prior, runs, starts, warm, none)
    for run, start, one in zip(runs, starts, together, strict=True):
        (alone,) = free_runs(PriorStep(prior, DT), prior, [run], [start], warm, none)
        np.testing.assert_allclose(one.x_hat, alone.x_hat, rtol=0, atol=1e-12)  # rounding of another batch
        assert len(one.t) == len(run.t) - warm - 1
