"""Free runs of models over whole trajectories, and their figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.step import Step
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
STARTS = 5
"""Starts of short free runs within the length of one."""


@dataclass(frozen=True)
class FreeRun:
    """A free run over one trajectory after its warm-up, and the measurement; n scored periods.

    ``x`` are the measured, smoothed states, ``y`` the measured outputs, not smoothed; ``xdot`` and ``xdot_hat`` are
    mean rates over each period. ``energy_measured_w`` is ΔE_S, the residual of the prior's first balance on the
    measurement, ``energy_model_w`` ΔE_M on the model's own run; NaN for a prior without balances.
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
    w: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def squared_errors(self, spread: Sequence[float]) -> Array:
        """Mean over the outputs of the squared error over ``spread`` ``(n_y,)``, where any was measured ``(m,)``."""
        squares = np.square((self.y_hat - self.y) / np.array(spread))
        seen = np.isfinite(self.y).any(axis=1)
        with np.errstate(invalid="ignore"):
            squares = np.where(np.isfinite(self.y) & ~np.isfinite(squares), np.inf, squares)
        return np.asarray(np.nanmean(squares[seen], axis=1))


@dataclass(frozen=True)
class Scores:
    """Figures of one model over several free runs; a diverging run makes them infinite.

    Args:
        e_sim_s: Simulation error in duration form: mean over runs of the time mean of ``|xdot - xdot_hat|_1``.
        rmse_rad: Root mean square of the first output's error (rad for an angle).
        energy_violation_w: Time mean of ``|ΔE_M - ΔE_S|`` [W].
    """

    e_sim_s: float
    rmse_rad: float
    energy_violation_w: float


def evaluation_trajectories(
    trajectories: Sequence[Trajectory], smoother: Smoother, warm: int, length: float | None = None
) -> list[Trajectory]:
    """The trajectories that a model is evaluated on: their starts are smoothed from their warm-ups alone.

    Args:
        trajectories: Test trajectories, smoothed with all their samples (the models' rates are compared with these).
        smoother: Smoother of the warm-ups; the same for every model.
        warm: Samples of the warm-up.
        length: Length [s] of a run after its warm-up; one starts every fifth of it. A shorter trajectory is one run.
            Default: every trajectory is one run.

    Returns:
        Trajectories whose first ``warm + 1`` states know the measurements up to sample ``warm`` and none after it.
    """
    pieces = []
    for t in trajectories:
        n = len(t.t) if length is None else min(len(t.t), warm + round(length / t.dt) + 1)
        stride = len(t.t) if length is None else max(1, round(length / t.dt / STARTS))
        pieces += [t.part(slice(a, a + n)) for a in range(0, len(t.t) - n + 1, stride)]
    starts = smoother.smooth([t.part(slice(0, warm + 1)) for t in pieces])
    return [
        replace(t, x=np.vstack([s.x, t.x[warm + 1 :]]), xdot=np.vstack([s.xdot, t.xdot[warm + 1 :]]))
        for t, s in zip(pieces, starts, strict=True)
    ]


def free_runs(
    step: Step, prior: Prior, trajectories: Sequence[Trajectory], warm: int, h0: Tensor | None = None
) -> list[FreeRun]:
    """Free runs of one model over trajectories; the warm-up is given and not scored.

    Args:
        step: The model.
        prior: The prior whose energy balance and output count (the fitted one).
        trajectories: The trajectories (:func:`evaluation_trajectories`); they may differ in length.
        warm: Samples of the warm-up.
        h0: Hidden state before the warm-up ``(n_h,)``. Default: zero.

    Example:
        >>> from hybrid_mpc import PriorStep
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> prior = PendulumPrior()
        >>> runs = free_runs(PriorStep(prior, 0.01), prior, exact_runs("test", 1), warm=10)
        >>> runs[0].x_hat.shape
        (490, 2)
    """
    x_hat = model_states(step, trajectories, warm, h0)
    return [_free_run(prior, t, x_hat[i], warm) for i, t in enumerate(trajectories)]


def stacked_free_runs(
    trained: Trained, prior: Prior, dt: float, balance: Prior, trajectories: Sequence[Trajectory], warm: int
) -> list[list[FreeRun]]:
    """:func:`free_runs` of all networks of a training at once: those of the first network, the second, ..."""
    step = trained.stacked_step(prior, dt)
    x_hat = model_states(step, trajectories, warm)
    return [[_free_run(balance, t, x[i], warm) for i, t in enumerate(trajectories)] for x in x_hat]


def model_states(
    step: Step, trajectories: Sequence[Trajectory], warm: int, h0: Tensor | None = None
) -> Array:
    """States of a model that runs freely from sample ``warm`` on, ``(..., runs, samples - warm + 1, n_x)``.

    Shorter trajectories go on under their last input. ``h0`` ``(n_h,)``, of a stack ``(networks, 1, n_h)``, is the
    hidden state before the warm-up; default zero.
    """
    h0 = step.h0 if h0 is None else h0
    longest = max(len(t.t) for t in trajectories)
    h = h0.expand(*h0.shape[:-2], len(trajectories), h0.shape[-1])
    x_all, u_all, w_all = (
        torch.tensor(np.stack([_padded(getattr(t, key), longest) for t in trajectories]))
        for key in ("x", "u", "w")
    )
    x_all, u_all, w_all = (a.expand(*h.shape[:-2], *a.shape) for a in (x_all, u_all, w_all))
    with torch.no_grad():
        for k in range(warm):
            _, h = step(x_all[..., k, :], h, u_all[..., k, :], w_all[..., k, :])
        held = (a[..., warm:, :].movedim(-2, 0) for a in (u_all, w_all))
        x_hat: Array = step.free_run(x_all[..., warm, :], h, *held).movedim(0, -2).numpy()
    return x_hat


def score(runs: Sequence[FreeRun]) -> Scores:
    """Figures over free runs (paper: E_sim, energy violation)."""
    e_sim, square, energy = [], [], []
    for run in runs:
        e_sim.append(np.abs(run.xdot_hat - run.xdot).sum(1).mean())
        square.append(((run.y_hat[:, 0] - run.y[:, 0]) ** 2).mean())
        energy.append(np.abs(run.energy_model_w - run.energy_measured_w).mean())
    figures = np.mean(e_sim), np.sqrt(np.mean(square)), np.mean(energy)
    return Scores(*(float(v) if np.isfinite(v) else float("inf") for v in figures))


def _free_run(prior: Prior, trajectory: Trajectory, x_hat: Array, warm: int) -> FreeRun:
    n, dt = len(trajectory.t) - warm - 1, trajectory.dt
    part = slice(warm, warm + n)
    u, w, x = trajectory.u[part], trajectory.w[part], trajectory.x[part]
    xdot, xdot_hat = np.diff(trajectory.x[warm:], axis=0) / dt, np.diff(x_hat[: n + 1], axis=0) / dt
    equations, held = prior.equations, (u.T, w.T, prior.p)
    y_hat = measured_as(prior, equations.output(x_hat[:n].T, *held).full().T)
    measured, model = (
        equations.balances[0].residual(*(z.T for z in point), *held).full()[0]
        if equations.balances
        else np.full(n, np.nan)
        for point in ((x, xdot), (x_hat[:n], xdot_hat))
    )
    return FreeRun(
        trajectory.name, trajectory.t[part], u, x, x_hat[:n], trajectory.y[part], y_hat, xdot, xdot_hat,
        measured, model, w,
    )  # fmt: skip


def measured_as(prior: Prior, y: Array) -> Array:
    """Outputs ``(..., n_y)`` as the sensors show them: within the ranges that they declare."""
    ends = [s.saturation or (-np.inf, np.inf) for s in prior.outputs]
    return np.asarray(np.clip(y, [low for low, _ in ends], [high for _, high in ends]))


def _padded(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])
