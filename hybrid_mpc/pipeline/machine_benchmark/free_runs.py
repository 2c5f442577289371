"""Free runs of all models over recordings by a machine's convention, and the figures that judge them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.evaluation import judged
from hybrid_mpc.identification.settings import KINDS
from hybrid_mpc.identification.step import PriorStep
from hybrid_mpc.identification.trained import Trained, stack_for, step_for
from hybrid_mpc.physics import Prior
from hybrid_mpc.pipeline.machine_benchmark.physics import Physics, lost_samples, shifted

if TYPE_CHECKING:
    from torch import Tensor, nn

Array = NDArray[np.float64]
MODELS = ("phy", *KINDS)


@dataclass(frozen=True)
class Run:
    """What is known of one free run.

    Args:
        name: Of the trajectory.
        t: Times of the scored samples ``(n,)`` [s].
        u: Commanded inputs there ``(n, n_u)``, as they act.
        y: Measured outputs ``(n, n_y)``.
        y_hat: By candidate, ``(n, n_y)``.
    """

    name: str
    t: Array
    u: Array
    y: Array
    y_hat: Mapping[str, Array]


def run_freely(
    prior: Prior,
    physics: Physics,
    networks: Mapping[str, Trained],
    trajectories: Sequence[Trajectory],
    *,
    warm_up: float,
    length: float | None,
) -> list[Run]:
    """Free runs of the prior, of the best network of each kind, and of the mean over the networks of each kind.

    Of a trajectory only what lies within ``warm_up`` is known: from it comes the state that all models start from,
    and the networks' hidden states. Everything after it is scored.

    Args:
        prior: The fitted prior.
        physics: Its delay and smoother.
        networks: Trained networks by kind; each kind's best is that of its own validation.
        trajectories: Recordings with the commanded inputs.
        warm_up: Length [s] of what is given.
        length: Length [s] of a run after it; default: to the end.

    Returns:
        A run for each trajectory; candidates are ``phy``, ``rnn``, ``rnn mean`` and so on.
    """
    import torch

    dt = trajectories[0].dt
    warm = warm_samples(warm_up, physics.delay, dt)
    starts = judged(shifted(trajectories, physics.delay), physics.smoother(prior, dt), warm)
    if length is not None:
        starts = [_first(t, warm + round(length / dt) + 1) for t in starts]
    found = {
        "phy": _simulate(PriorStep(prior, dt), torch.zeros(1, 1, 0, dtype=torch.float64), starts, warm)[0]
    }
    for kind, trained in networks.items():
        stack = stack_for(prior, trained.settings)
        stack.load_state_dict({name: torch.tensor(value) for name, value in trained.weights.items()})
        step = step_for(prior, stack, trained.scaling, dt, trained.settings)
        all_runs = _simulate(step, stack.initial(1), starts, warm)
        found |= {kind: all_runs[trained.best], f"{kind} mean": all_runs.mean(0)}
    with torch.no_grad():
        outputs = {
            name: prior.output(torch.tensor(x), torch.zeros(len(prior.inputs))).numpy()
            for name, x in found.items()
        }
    return [
        Run(
            t.name,
            t.t[warm + 1 :],
            t.u[warm + 1 :],
            t.y[warm + 1 :],
            {name: y[i, : len(t.t) - warm - 1] for name, y in outputs.items()},
        )
        for i, t in enumerate(starts)
    ]


def figures_of(runs: Sequence[Run], name: str, *, unit: str, scale: float) -> dict[str, Any]:
    """RMSE over all scored samples, and its share of the measured output's standard deviation.

    Args:
        runs: Free runs over one file.
        name: The candidate.
        unit: Unit of the figures.
        scale: Figures' units in an SI unit.

    Example:
        >>> y = np.array([[0.0], [1.0], [2.0]])
        >>> run = Run("run", np.arange(3.0), y, y, {"phy": y + 0.1})
        >>> figures_of([run], "phy", unit="mm", scale=1e3)["rmse"].__round__(6)
        100.0
    """
    error = np.concatenate([run.y_hat[name][:, 0] - run.y[:, 0] for run in runs])
    spread = float(np.std(np.concatenate([run.y[:, 0] for run in runs])))
    rmse = float(np.sqrt(np.mean(error**2)))
    if not np.isfinite(rmse):
        rmse = float("inf")
    relative = rmse / spread if spread > 0 else float("inf")
    return {"rmse": scale * rmse, "relative": relative, "unit": unit}


def warm_samples(warm_up: float, delay: float, dt: float) -> int:
    """Periods from the first sample whose acting input is known to the last one that is given.

    Example:
        >>> warm_samples(1.225, 0.0, 0.025), warm_samples(1.225, 0.03, 0.025)
        (49, 47)
    """
    return max(1, round(warm_up / dt) - lost_samples(delay, dt))


def _first(trajectory: Trajectory, n: int) -> Trajectory:
    arrays = {key: getattr(trajectory, key)[:n] for key in ("t", "u", "y", "x", "xdot")}
    return replace(trajectory, **arrays)


def _simulate(step: nn.Module, h0: Tensor, trajectories: Sequence[Trajectory], warm: int) -> Array:
    """States ``(networks, runs, n, n_x)`` of the samples after ``warm``; shorter runs go on under their last input."""
    import torch

    longest = max(len(t.t) for t in trajectories)
    x_all, u_all = (
        torch.tensor(np.stack([_padded(getattr(t, key), longest) for t in trajectories]))
        for key in ("x", "u")
    )
    networks, runs = h0.shape[0], len(trajectories)
    with torch.no_grad():
        h, states = h0.expand(networks, runs, -1), []
        wide = [a.expand(networks, *a.shape) for a in (x_all, u_all)]
        for k in range(warm):
            _, h = step(wide[0][:, :, k], h, wide[1][:, :, k])
        x = wide[0][:, :, warm]
        for k in range(warm, longest - 1):
            x, h = step(x, h, wide[1][:, :, k])
            states.append(x)
    return torch.stack(states, 2).numpy()


def _padded(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])
