import math
from types import SimpleNamespace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_pendulum import DT, Pendulum, record

from hybrid_mpc import HybridStep, n_features
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.objectives import (
    OBJECTIVES,
    Prediction,
    VectorPerformanceIndex,
    energy_objective,
    error_objective,
    free_run,
    position_objective,
    teacher_forced,
)

losses = st.lists(st.lists(st.floats(1e-6, 1e6), min_size=2, max_size=2), min_size=1, max_size=8)


def hybrid(windows, networks=3):
    prior = Pendulum()
    scaling = HybridStep.scaling_of(prior, windows, DT, use_prior=True)
    return HybridStep(prior, StackedGRU(networks, n_features(prior, True), 4, 1, seed=0), scaling, DT)


def test_a_free_run_of_one_period_is_teacher_forcing():
    windows = cut_windows([record(0)], warm=5, horizon=1, stride=7)
    step = hybrid(windows)
    with torch.no_grad():
        free, forced = free_run(step, windows), teacher_forced(step, windows)
        for name in ("x_hat", "xdot", "xdot_hat"):
            a, b = torch.broadcast_tensors(getattr(free, name), getattr(forced, name))
            # rounding of states of order one divided by dt = 0.02
            torch.testing.assert_close(a, b, rtol=0, atol=1e-12)
        for objective in OBJECTIVES.values():
            one, two = objective(step, free), objective(step, forced)
            assert one.shape == two.shape == (3,)
            torch.testing.assert_close(one, two, rtol=1e-12, atol=0)


def test_a_longer_free_run_leaves_the_measurement():
    windows = cut_windows([record(0)], warm=5, horizon=20, stride=7)
    step = hybrid(windows)
    with torch.no_grad():
        free, forced = free_run(step, windows), teacher_forced(step, windows)
    torch.testing.assert_close(free.x_hat[0], forced.x_hat[0].expand_as(free.x_hat[0]))
    assert (free.x_hat[-1] - forced.x_hat[-1]).abs().max() > 1e-3


def test_objectives_of_a_known_error():
    windows = cut_windows([record(0)], warm=5, horizon=3, stride=7)
    step = hybrid(windows, networks=1)
    with torch.no_grad():
        p = teacher_forced(step, windows)
        wrong = type(p)(p.x, p.x, p.u, p.xdot, p.xdot + torch.tensor([0.0, 2.0]))
        # mean |(0, 2)|_1 = 2 and mean |J v 2|: the energy objective is a speed-weighted error here
        np.testing.assert_allclose(error_objective(step, wrong), 2.0, rtol=1e-12)
        speed = float(p.x[..., 1].abs().mean())
        np.testing.assert_allclose(energy_objective(step, wrong), 0.15 * 2.0 * speed, rtol=1e-12)


@settings(max_examples=100, deadline=None)
@given(losses)
def test_bounds_never_rise_and_no_objective_is_traded(sequence):
    index = VectorPerformanceIndex(torch.ones(1, 2).double())
    for values in sequence:
        now = torch.tensor([values], dtype=torch.float64)
        lowered = index.lower(now)
        assert (lowered.bounds <= index.bounds).all()
        if (now > index.bounds).any():
            assert torch.equal(lowered.bounds, index.bounds)
        else:
            assert torch.equal(lowered.bounds, now)
        index = lowered


@settings(max_examples=100, deadline=None)
@given(st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=2))
def test_the_index_is_within_log_2_by_rho_of_the_maximum(values):
    index = VectorPerformanceIndex(torch.tensor([[2.0, 0.5]]).double())
    ratio = max(values[0] / 2.0, values[1] / 0.5)
    excess = float(index.value(torch.tensor([values], dtype=torch.float64))) - ratio
    assert -1e-9 * ratio <= excess <= math.log(2) / 10 + 1e-9 * ratio


def test_a_loss_that_is_no_number_lowers_no_bound():
    index = VectorPerformanceIndex(torch.ones(2, 2).double())
    lowered = index.lower(torch.tensor([[math.nan, 0.5], [0.5, 0.5]]).double())
    assert lowered.bounds.tolist() == [[1.0, 1.0], [0.5, 0.5]]


def test_predictions_stay_on_their_device():
    """``meta`` computes nothing, but refuses a tensor made elsewhere."""
    windows = cut_windows([record(0)], warm=5, horizon=3, stride=7)
    there, step = windows.to(torch.device("meta")), hybrid(windows).to("meta")
    for predict in (teacher_forced, free_run):
        for objective in OBJECTIVES.values():
            assert objective(step, predict(step, there)).device.type == "meta"


def test_the_position_objective_is_the_rms_error_a_period_later():
    x = torch.zeros(3, 1, 2, 2, dtype=torch.float64)
    step = SimpleNamespace(prior=SimpleNamespace(n_q=1), dt=0.1)
    # two networks: the first is off by 0.2 in position and gains 0.1 over the period, the second is right
    x_hat = torch.stack([x[:, 0] + torch.tensor([0.2, 5.0], dtype=torch.float64), x[:, 0]], dim=1)
    rate = torch.stack([x[:, 0] + torch.tensor([1.0, 7.0], dtype=torch.float64), x[:, 0]], dim=1)
    got = position_objective(step, Prediction(x, x_hat, x[..., :1], x, rate))
    # the velocity's error of 5 and 7 does not count; 1e-12 is the floor under the root
    torch.testing.assert_close(got, torch.tensor([0.3, 1e-12], dtype=torch.float64), rtol=1e-12, atol=0)
