"""Who has diverged, where; the same free runs one by one and all at once; when a training has converged."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hybrid_mpc import TrainingSettings, free_runs, train
from hybrid_mpc.identify.evaluate import FreeRun, stacked_free_runs
from scenarios.paper.jobs import converged_steps, figures_of, network_figures, step_class
from scenarios.pendulum.data import exact_runs
from scenarios.pendulum.prior import PublishedPendulumPrior


def run(name, n=50):
    """A free run that is right."""
    t = 0.5 + 0.1 * np.arange(n)
    y, z = np.sin(t)[:, None], np.zeros(n)
    x = np.column_stack([np.sin(t), np.cos(t)])
    return FreeRun(name, t, z[:, None], x, x, y, y, x, x, z[:, None], z[:, None])


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_where_a_state_is_lost(value):
    good, bad = run("one"), run("two")
    x_hat, y_hat = bad.x_hat.copy(), bad.y_hat.copy()
    x_hat[30:], y_hat[30:] = value, value
    network = network_figures([good, replace(bad, x_hat=x_hat, y_hat=y_hat)], validation=0.1, converged=5)
    assert network.figures == {}
    where = network.diverged
    assert (where.run, where.step, where.runs) == ("two", 30, 1)
    assert where.time_s == pytest.approx(3.0)  # 30 samples of 0.1 s after the start


@pytest.mark.parametrize("form", ["hybrid", "paper"])
def test_all_networks_at_once_are_the_networks_one_by_one(form):
    prior, warm = PublishedPendulumPrior(), 10
    settings = TrainingSettings("pgrnn", 4, 3, 5, 0, seed=0, warm=warm, batch=4, every=5)
    data = exact_runs("train", 1), exact_runs("valid", 1)
    trained = train(prior, *data, settings, form=step_class(form))
    test = exact_runs("test", 2)
    test[1] = test[1].part(np.arange(501) < 300, "short", "test")  # runs may differ in length
    stacked = stacked_free_runs(trained, prior, 0.01, prior, test, warm)
    assert len(stacked) == 3
    h0 = torch.zeros(4, dtype=torch.float64)
    for k, runs in enumerate(stacked):
        single = free_runs(trained.step(prior, 0.01, k), prior, test, warm, h0)
        for one, other in zip(runs, single, strict=True):
            assert one.x_hat.shape == other.x_hat.shape
            # sums run in another order: rounding, grown over 490 steps of a damped pendulum
            np.testing.assert_allclose(one.x_hat, other.x_hat, rtol=1e-9, atol=1e-9)


def test_when_a_training_has_converged():
    validation = np.array([[9.0, np.inf], [2.0, 5.0], [1.05, 6.0], [1.0, 4.0], [3.0, 4.2]])
    step = np.repeat([[0.0], [10.0], [20.0], [30.0], [40.0]], 2, axis=1)
    curve = {"validation": validation, "step": step}
    assert converged_steps(SimpleNamespace(curve=curve)) == [20, 30]  # 1.05 is within 10 % of 1; 4 of 4


@pytest.mark.parametrize("dt", [0.02, 0.01])
def test_figures_as_the_paper_has_them(dt):
    n, off = round(2.0 / dt), np.array([0.0, -3.0])
    z = np.zeros((n, 2))
    made = FreeRun("r", dt * np.arange(n), z[:, :1], z, z, z, z - 0.5, z, z + off, z[:, :1], z[:, :1] + 0.25)
    figures = figures_of([made])
    assert (figures["rmse_rad"], figures["energy_violation_w"]) == pytest.approx((0.5, 0.25))
    assert figures["e_sim_s"] == pytest.approx(3.0, rel=1e-12)
    # integral over 2 s / n samples
    assert figures["e_sim_paper_s"] == pytest.approx(3.0 * 2.0 / n, rel=1e-12)
    # 1/T integral of 3 / (1 + t) over T = 2 s; the sum over left ends errs by dt / 2 (f(0) - f(T)) / T
    assert figures["e_sim_lambda1_s"] == pytest.approx(1.5 * np.log(3.0), abs=dt / 2 * 1.05)
