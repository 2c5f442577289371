"""Every cell in every form leaves torch at rounding."""

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, Pendulum, record

from hybrid_mpc import TrainingSettings, check_parity, load, model_info, save_artifact, trace_model
from hybrid_mpc.identify.dataset import cut_windows, literal_scaling_of, scaling_of
from hybrid_mpc.identify.train import stack_for, step_for

CELLS = ("gru", "gru_paper", "lstm", "feed_forward")
RUN = record(0, seconds=2.0)
WINDOWS = cut_windows([RUN], warm=0, horizon=20, stride=5)


def model(cell, form, kind="mopgrnn"):
    """A step with random weights, its linear layer too."""
    prior = Pendulum()
    settings = TrainingSettings(kind, 5, 2, 1, 1, seed=1, warm=0, cell=cell, form=form)
    stack = stack_for(prior, settings)
    with torch.no_grad():
        stack.w_out.uniform_(-0.5, 0.5, generator=torch.Generator().manual_seed(0))
    if form == "literal":
        scaling = literal_scaling_of(prior, WINDOWS)
    else:
        scaling = scaling_of(prior, WINDOWS, DT, use_prior=settings.use_prior)
    return step_for(prior, stack.member(1), scaling, DT, settings).requires_grad_(False)


@pytest.mark.parametrize("form", ["hybrid", "literal"])
@pytest.mark.parametrize("cell", CELLS)
def test_every_cell_exports_at_rounding(cell, form):
    step = model(cell, form)
    parity = check_parity(step, trace_model(step), model_info(step.prior, DT), [RUN], seed=0)
    assert parity.max_abs_error < 1e-12
    assert parity.jacobian_max_abs_error < 1e-12


@pytest.mark.parametrize("cell", CELLS)
def test_a_saved_model_runs_freely_like_torch(cell, tmp_path):
    step = model(cell, "literal", "rnn")
    save_artifact(tmp_path, {"m": trace_model(step)}, model_info(step.prior, DT))
    saved = load(tmp_path).models["m"]
    assert saved.n_h == step.network.n_h
    x, h = torch.tensor(RUN.x[0]), torch.zeros(step.network.n_h, dtype=torch.float64)
    x_own, h_own = RUN.x[0], np.zeros(step.network.n_h)
    for u in RUN.u[:50]:
        x, h = step(x, h, torch.tensor(u))
        x_own, h_own = (m.full().ravel() for m in saved.step(x_own, h_own, u, saved.w, saved.p))
    # rounding through 50 steps of a model that is no faster than 1 / dt
    np.testing.assert_allclose(x_own, x, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(h_own, h, rtol=1e-10, atol=1e-10)
