"""Free runs of a model over whole trajectories and the figures that judge them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.train import Trained, stack_for, step_for
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]
STARTS = 5
"""Starts of short free runs within the length of one."""


@dataclass(frozen=True)
class FreeRun:
    """A free run over one trajectory after its warm-up, beside the measurement; n scored periods.

    Args:
        name: The trajectory's name.
        t: Times [s] ``(n,)``.
        u: Inputs ``(n, n_u)``.
        x: Measured (smoothed) states ``(n, n_x)``; x_hat: the model's.
        x_hat: States of the model ``(n, n_x)``.
        y: Measured outputs ``(n, n_y)``, not smoothed.
        y_hat: Outputs of the model ``(n, n_y)``.
        xdot: Measured mean rates over each period ``(n, n_x)``.
        xdot_hat: Mean rates of the model ``(n, n_x)``.
        energy_measured_w: ΔE_S [W] ``(n,)``, the prior's balance on the measurement.
        energy_model_w: ΔE_M [W] ``(n,)`` on the model's own run.
    """

    name: str
    t: Array
    u: Array
    x: Array
    x_hat: Array
    y: Array
    y_hat: Array
    xdot: Array
    xdot_hat: Array
    energy_measured_w: Array
    energy_model_w: Array


@dataclass(frozen=True)
class Scores:
    """Figures of one model over several free runs; a diverging run makes them infinite.

    Args:
        e_sim_s: Simulation error in duration form, λ = 0: mean over runs of the time mean of
            ``|xdot - xdot_hat|_1``.
        e_sim_lambda1_s: The same discounted by ``1 / (1 + λ t)`` with λ = 1 1/s.
        e_sim_literal_s: The paper's literal form: integral over the run divided by its number of samples.
        rmse_rad: Root mean square of the first output's error (rad for an angle).
        energy_violation_w: Time mean of ``|ΔE_M - ΔE_S|`` [W].
        amplitude_ratio: Largest ``|y_hat|`` over largest ``|y|``, the largest over runs.
    """

    e_sim_s: float
    e_sim_lambda1_s: float
    e_sim_literal_s: float
    rmse_rad: float
    energy_violation_w: float
    amplitude_ratio: float


def judged(
    trajectories: Sequence[Trajectory], smoother: Smoother, warm: int, length: float | None = None
) -> list[Trajectory]:
    """The runs that judge a model: what is known at their start was smoothed from their warm-up alone.

    Args:
        trajectories: Test trajectories, smoothed as a whole (what the models' rates are compared with).
        smoother: Smoother of the warm-ups; the same for every model.
        warm: Samples of the warm-up.
        length: Length [s] of a run after its warm-up; one starts every fifth of it. A trajectory that is
            shorter is one run. Default: every trajectory is one run.

    Returns:
        Runs whose first ``warm + 1`` states know the measurements up to sample ``warm`` and none after it.
    """
    pieces = []
    for t in trajectories:
        n = len(t.t) if length is None else min(len(t.t), warm + round(length / t.dt) + 1)
        stride = len(t.t) if length is None else max(1, round(length / t.dt / STARTS))
        pieces += [_samples(t, slice(a, a + n)) for a in range(0, len(t.t) - n + 1, stride)]
    starts = smoother.smooth([_samples(t, slice(0, warm + 1)) for t in pieces])
    return [
        replace(t, x=np.vstack([s.x, t.x[warm + 1 :]]), xdot=np.vstack([s.xdot, t.xdot[warm + 1 :]]))
        for t, s in zip(pieces, starts, strict=True)
    ]


def free_runs(
    step: nn.Module, prior: Prior, trajectories: Sequence[Trajectory], warm: int, h0: Tensor
) -> list[FreeRun]:
    """Free runs of one step over trajectories; the warm-up is measured and not scored.

    h is warmed up on the samples before ``warm``; there the run leaves the measurement.

    Args:
        step: ``(x, h, u) -> (x_next, h_next)``, one network, any batch.
        prior: The prior whose energy balance judges (the fitted one).
        trajectories: The runs (see :func:`judged`); they may differ in length.
        warm: Samples of the warm-up.
        h0: Hidden state before the warm-up ``(n_h,)``.
    """
    x_all, u_all = _padded(trajectories)
    x_hat = _states(step, x_all, u_all, warm, h0.expand(len(trajectories), -1))
    return [_free_run(prior, t, x_hat[i], warm) for i, t in enumerate(trajectories)]


def stacked_free_runs(
    trained: Trained, prior: Prior, dt: float, judge: Prior, trajectories: Sequence[Trajectory], warm: int
) -> list[list[FreeRun]]:
    """:func:`free_runs` of all networks of a training at once: those of the first network, the second, ...

    Args:
        trained: The training.
        prior: The prior that the networks correct.
        dt: Model period [s].
        judge: The prior whose energy balance judges.
        trajectories: The runs; they may differ in length.
        warm: Samples of the warm-up.
    """
    stack = stack_for(prior, trained.settings)
    stack.load_state_dict({name: torch.tensor(value) for name, value in trained.weights.items()})
    step = step_for(prior, stack, trained.scaling, dt, trained.settings)
    x_all, u_all = (a.expand(stack.networks, *a.shape) for a in _padded(trajectories))
    with torch.no_grad():
        x_hat = _states(step, x_all, u_all, warm, stack.initial(len(trajectories)))
    return [
        [_free_run(judge, t, x_hat[k, i], warm) for i, t in enumerate(trajectories)]
        for k in range(len(x_hat))
    ]


def _padded(trajectories: Sequence[Trajectory]) -> tuple[Tensor, Tensor]:
    """States and inputs ``(runs, samples, n)``, short ones prolonged by their last sample."""
    longest = max(len(t.t) for t in trajectories)
    x_all, u_all = (
        torch.tensor(np.stack([_pad(a, longest) for a in arrays]))
        for arrays in ([t.x for t in trajectories], [t.u for t in trajectories])
    )
    return x_all, u_all


def _states(step: nn.Module, x_all: Tensor, u_all: Tensor, warm: int, h: Tensor) -> Array:
    """States of the model from sample ``warm`` on, ``(..., samples - warm + 1, n_x)``."""
    with torch.no_grad():
        for k in range(warm):
            _, h = step(x_all[..., k, :], h, u_all[..., k, :])
        x, states = x_all[..., warm, :], []
        for k in range(warm, x_all.shape[-2]):
            states.append(x)
            x, h = step(x, h, u_all[..., k, :])
        states.append(x)
    x_hat: Array = torch.stack(states, -2).numpy()
    return x_hat


def score(runs: Sequence[FreeRun]) -> Scores:
    """Figures over free runs (paper: E_sim, energy violation)."""
    e0, e1, literal, square, energy, amplitude = [], [], [], [], [], []
    for run in runs:
        error = np.abs(run.xdot_hat - run.xdot).sum(1)
        t, dt = run.t - run.t[0], float(np.mean(np.diff(run.t)))
        e0.append(error.mean())
        e1.append((error / (1.0 + t)).mean())
        literal.append(error.mean() * dt)
        square.append(((run.y_hat[:, 0] - run.y[:, 0]) ** 2).mean())
        energy.append(np.abs(run.energy_model_w - run.energy_measured_w).mean())
        amplitude.append(np.abs(run.y_hat).max() / np.abs(run.y).max())
    figures = (
        np.mean(e0),
        np.mean(e1),
        np.mean(literal),
        np.sqrt(np.mean(square)),
        np.mean(energy),
        np.max(amplitude),
    )
    return Scores(*(float(v) if np.isfinite(v) else float("inf") for v in figures))


def _free_run(prior: Prior, trajectory: Trajectory, x_hat: Array, warm: int) -> FreeRun:
    n, dt = len(trajectory.t) - warm - 1, trajectory.dt
    part = slice(warm, warm + n)
    u, x = trajectory.u[part], trajectory.x[part]
    xdot, xdot_hat = np.diff(trajectory.x[warm:], axis=0) / dt, np.diff(x_hat[: n + 1], axis=0) / dt
    tensors = (torch.tensor(a) for a in (x, xdot, u, x_hat[:n], xdot_hat))
    with torch.no_grad():
        x_t, xdot_t, u_t, x_hat_t, xdot_hat_t = tensors
        measured = prior.energy_balance(x_t, xdot_t, u_t).numpy()
        model = prior.energy_balance(x_hat_t, xdot_hat_t, u_t).numpy()
        y_hat = prior.output(x_hat_t, u_t).numpy()
    return FreeRun(
        trajectory.name,
        trajectory.t[part],
        u,
        x,
        x_hat[:n],
        trajectory.y[part],
        y_hat,
        xdot,
        xdot_hat,
        measured,
        model,
    )


def _samples(trajectory: Trajectory, keep: slice) -> Trajectory:
    arrays = {key: getattr(trajectory, key)[keep] for key in ("t", "u", "y", "x", "xdot")}
    return replace(trajectory, **arrays)


def _pad(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])
