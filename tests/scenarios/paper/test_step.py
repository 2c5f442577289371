"""The paper form: explicit Euler of the network's derivative; it trains, resumes and is exported as any other."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from energy_checks import rates
from simulated_pendulum import DT, TRUTH, Pendulum, dragged, killed_and_resumed, record, same_training

from hybrid_mpc import (
    InputError,
    PriorStep,
    Scaling,
    TrainingSettings,
    check_parity,
    model_info,
    trace_model,
    train,
)
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.objectives import free_run, teacher_forced
from scenarios.paper.step import PaperStep


class Copier(torch.nn.Module):
    """A network that hands on some of its features."""

    def __init__(self, chosen):
        super().__init__()
        self.chosen = chosen

    def forward(self, s, h):
        return s[..., self.chosen], h


SCALES = Scaling(x=(2.0, 3.0), u=(0.5,), rate=(4.0, 5.0), correction=(4.0, 5.0))
X, U = torch.tensor([0.5, -1.0]).double(), torch.tensor([0.25]).double()
H = W = torch.zeros(0).double()


def test_the_paper_step_is_explicit_euler_of_what_the_network_says():
    prior = Pendulum()
    step = PaperStep(prior, Copier(slice(3, 5)), SCALES, DT)  # the prior's xdot, which is a feature
    own = torch.from_numpy(rates(prior, X.numpy()[None], U.numpy()[None])[0])
    torch.testing.assert_close(step.xdot(X, H, U, W), own, rtol=1e-15, atol=0)
    torch.testing.assert_close(step(X, H, U, W)[0], X + DT * own, rtol=1e-15, atol=0)
    free = PaperStep(prior, Copier(slice(1, 3)), SCALES, DT, use_prior=False)  # [v, u]: no exact kinematics
    torch.testing.assert_close(
        free.xdot(X, H, U, W), torch.tensor([-4.0 / 3.0, 2.5], dtype=torch.float64), rtol=1e-15, atol=0
    )


def test_euler_feeds_energy_into_a_pendulum_and_the_hybrid_step_does_not():
    """The reason for the hybrid step: the same network, the paper's integrator and ours."""
    prior = Pendulum({"J": 0.1, "mgl": 1.2, "d": 0.0})
    paper = PaperStep(prior, Copier(slice(3, 5)), SCALES, DT)
    exact = PriorStep(prior, DT)
    energies = []
    for step in (paper, exact):
        x = torch.tensor([0.5, 0.0]).double()
        for _ in range(250):
            x, _ = step(x, H, torch.zeros(1).double(), W)
        energies.append(float(0.05 * x[1] ** 2 + 1.2 * (1.0 - x[0].cos())))
    start = 1.2 * (1.0 - math.cos(0.5))
    assert energies[1] == pytest.approx(start, rel=1e-4)  # order 4 at 0.07 rad a step
    # each step of Euler multiplies the energy by 1 + (w dt)^2 = 1.0048: 3.3 in 250, less at large angles
    assert 2.0 < energies[0] / start < 4.0


def test_the_paper_form_is_compared_with_the_recorded_derivative():
    run = record(0)
    windows = cut_windows([run], warm=5, horizon=3, stride=7)
    prior = Pendulum()
    scaling = PaperStep.scaling_of(prior, windows, DT, use_prior=True)
    stack = StackedGRU(2, PaperStep.sizes(prior, True)[0], 4, 2, seed=0)
    step = PaperStep(prior, stack, scaling, DT)
    with torch.no_grad():
        forced, free = teacher_forced(step, windows), free_run(step, windows)
    assert forced.xdot[0, 0, 1].tolist() == run.xdot[7 + 5].tolist()
    torch.testing.assert_close(free.xdot, forced.xdot, rtol=0, atol=0)
    # the first period starts at the measurement in both; rounding of states of order one over dt = 0.02
    torch.testing.assert_close(free.xdot_hat[0], forced.xdot_hat[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(free.x_hat[1], free.x_hat[0] + DT * forced.xdot_hat[0], rtol=0, atol=1e-14)


SHORT = TrainingSettings("mopgrnn", 4, 2, 15, 10, seed=3, warm=10, horizon=20, batch=8, every=5)


FULL = pytest.mark.full


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=FULL),
        pytest.param({"kind": "rnn"}, marks=FULL),
        {"prior_parameters": "trained"},
    ],
    ids=str,
)
def test_it_trains_resumes_and_leaves_torch_at_rounding(options, tmp_path):
    data, prior, file = dragged(), Pendulum(TRUTH), tmp_path / "training.safetensors"
    settings = replace(SHORT, **options)
    whole = train(prior, *data, settings, form=PaperStep)
    assert (whole.validation < whole.curve["validation"][0]).all()
    same_training(whole, killed_and_resumed(10, file, prior, *data, settings, form=PaperStep)[0])
    with pytest.raises(InputError, match="HM-IDENTIFY-055"):
        train(prior, *data, settings, checkpoint=file)  # the hybrid form is another training
    step = whole.step(prior, DT)
    assert isinstance(step, PaperStep)
    parity = check_parity(step, trace_model(step), model_info(prior, DT), [record(0, seconds=2.0)], seed=0)
    assert parity.max_abs_error < 1e-12
    assert parity.jacobian_max_abs_error < 1e-12


def test_it_needs_the_derivative_and_corrects_no_prior():
    (one, two), valid = dragged()
    xdot = two.xdot.copy()
    xdot[40] = np.nan
    bad = [one, replace(two, xdot=xdot)]
    with pytest.raises(InputError, match=r"run1.*xdot.*0\.8.*HM-IDENTIFY-006"):
        train(Pendulum(TRUTH), bad, valid, SHORT, form=PaperStep)
    brief = replace(SHORT, teacher_steps=1, free_run_steps=0)
    train(Pendulum(TRUTH), bad, valid, brief)  # the hybrid does not need it
    with pytest.raises(InputError, match="HM-IDENTIFY-052"):
        train(Pendulum(TRUTH), [one], valid, replace(SHORT, prior_replay=1.0), form=PaperStep)
