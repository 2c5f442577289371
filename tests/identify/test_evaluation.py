from dataclasses import replace

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import PriorStep, evaluation_trajectories, free_runs, score
from hybrid_mpc.identify.evaluate import FreeRun
from hybrid_mpc.identify.smooth import Smoother, sizes_of


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
    assert figures.rmse_rad == pytest.approx(0.5)
    assert figures.energy_violation_w == pytest.approx(0.25)


def test_runs_count_alike_whatever_their_sampling():
    slow, fast = hand_made(100, 0.02, 1.0), hand_made(200, 0.01, 1.0)
    assert score([slow]).e_sim_s == pytest.approx(score([fast]).e_sim_s)
    short, long = hand_made(10, 0.02, 4.0), hand_made(1000, 0.02, 2.0)
    assert score([short, long]).e_sim_s == pytest.approx(3.0)


def test_a_diverging_run_makes_its_figures_infinite():
    run = hand_made(50, 0.02, 1.0)
    run.y_hat[7] = np.nan
    figures = score([run])
    assert figures.rmse_rad == np.inf
    assert figures.e_sim_s == pytest.approx(1.0)


def test_the_true_model_runs_along_the_measurement():
    prior, run, warm = Pendulum(TRUTH), record(3, seconds=2.0), 25
    # x is exact and the prior true: only the integrator's error (1e-8 a period) is left
    (free,) = free_runs(PriorStep(prior, DT), prior, [run], warm, torch.zeros(0).double())
    assert len(free.t) == len(run.t) - warm - 1
    assert free.t[0] == run.t[warm]
    np.testing.assert_allclose(free.y_hat, free.y, atol=1e-4)
    assert score([free]).energy_violation_w < 1e-3


def test_short_runs_start_every_fifth_of_their_length():
    run, warm = record(3, seconds=2.0), 25
    prior = Pendulum(TRUTH)
    smoother = Smoother(prior, DT, (1e-3,), (0.1,), sizes_of(prior, [run], DT, 1.0))
    pieces = evaluation_trajectories([run], smoother, warm, 0.5)
    # 100 samples; 25 of warm-up, 25 periods of the run; a start every 5 samples
    assert [p.t[0] for p in pieces] == pytest.approx(run.t[0 : 100 - 50 : 5])
    assert {len(p.t) for p in pieces} == {51}
    assert len(evaluation_trajectories([run], smoother, warm)) == 1


def test_a_free_run_knows_nothing_of_the_measurement_after_its_start():
    prior, run, warm = Pendulum(TRUTH), record(3, seconds=2.0), 25
    later = replace(run, x=run.x.copy(), y=run.y.copy())
    later.x[warm + 1 :], later.y[warm + 1 :] = 9.0, 9.0
    step, h = PriorStep(prior, DT), torch.zeros(0).double()
    smoother = Smoother(prior, DT, (1e-3,), (0.1,), sizes_of(prior, [run], DT, 1.0))
    ours, theirs = (
        free_runs(step, prior, evaluation_trajectories([r], smoother, warm), warm, h)[0] for r in (run, later)
    )
    np.testing.assert_array_equal(ours.x_hat, theirs.x_hat)
    assert not np.array_equal(ours.x, theirs.x)  # what it is compared with does know
