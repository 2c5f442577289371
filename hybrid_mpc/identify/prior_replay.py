"""Prior replay: the training penalizes a network's correction in states far from all recordings.

A network extrapolates without limits: for a pendulum that was only swung, the correction in the upright position is
arbitrary. Prior replay consists of short runs of the prior, from random states in the measured range (for an angle, the
whole turn). In states far from all recordings, the training penalizes the correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.simulation import required_substeps, visited
from hybrid_mpc.identify.step import PriorStep, RecurrentStep
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
RUNS = 2000
"""Number of runs."""
BATCH = 64
"""Number of runs in a training step."""
FOLLOWED = 10
"""Periods of a run before its corrections count, so that the hidden state settles."""
COUNTED = 20
"""Periods of a run whose corrections count."""
HELD = 5
"""Periods for which an input is held; all inputs are recorded ones."""
AWAY = 10.0
"""Distance beyond the measured range, in ranges, at which a run stops, because a prior may be unstable (not for
angles)."""
NEAR = 0.1
"""Distance from measured states at which the weight is 0.63. Each state is scaled by its root mean square in the
recordings; an angle is represented by sine and cosine."""


@dataclass(frozen=True)
class PriorReplay:
    """Runs of the prior ``(FOLLOWED + COUNTED, n, ...)`` [SI], and the weight of each state.

    The weight is 0 at a recorded sample and 1 far from all recorded samples. It is 0 outside the measured range of a
    state that is not an angle.
    """

    x: Tensor
    u: Tensor
    w: Tensor
    weight: Tensor

    def take(self, index: Tensor) -> PriorReplay:
        """Select the runs of ``index``."""
        index = index.to(self.x.device)
        return PriorReplay(self.x[:, index], self.u[:, index], self.w[:, index], self.weight[:, index])

    def to(self, device: torch.device) -> PriorReplay:
        """Move the runs to a device."""
        return PriorReplay(*(v.to(device) for v in (self.x, self.u, self.w, self.weight)))


def make_prior_replay(prior: Prior, training: Sequence[Trajectory], seed: int) -> PriorReplay:
    """Simulate prior replay for training trajectories."""
    rng = np.random.default_rng([seed, 1])
    x, u, w = (np.concatenate([getattr(t, key) for t in training]) for key in ("x", "u", "w"))
    low, high = x.min(0), x.max(0)
    angles = np.array([signal.periodic for signal in prior.states])
    turn = np.array([signal.period for signal in prior.states])
    start = rng.uniform(
        np.where(angles, -turn / 2, low), np.where(angles, turn / 2, high), (RUNS, x.shape[1])
    )
    length = FOLLOWED + COUNTED
    drawn = rng.integers(len(u), size=(-(-length // HELD), RUNS))
    inputs, disturbances = (z[drawn].repeat(HELD, axis=0)[:length] for z in (u, w))
    far = np.where(angles, np.inf, AWAY * (high - low))
    dt = training[0].dt
    step = PriorStep(prior, dt, required_substeps(prior, dt, visited(training)))
    states = _prior_runs(step, start, (inputs, disturbances), (low - far, high + far))
    places = _Places(angles, 2 * np.pi / turn, np.sqrt(np.mean(x**2, axis=0)).clip(1e-9))
    distance, _ = cKDTree(places(x)).query(places(states.reshape(-1, x.shape[1])))
    weight = 1.0 - np.exp(-((distance.reshape(states.shape[:2]) / NEAR) ** 2))
    weight *= (angles | ((states >= low) & (states <= high))).all(-1)
    return PriorReplay(*(torch.tensor(v) for v in (states, inputs, disturbances, weight)))


def prior_replay_penalty(step: RecurrentStep, prior_replay: PriorReplay) -> Tensor:
    """Mean over all runs of weight times squared (scaled) correction; one value per network."""
    stack = cast(StackedGRU, step.network)
    features = step.stacked_features(prior_replay.x, prior_replay.u, prior_replay.w)
    out, _ = stack.sequence(features, stack.initial(prior_replay.x.shape[1]))
    weight = prior_replay.weight[FOLLOWED:, None, :, None]
    return (weight * out[FOLLOWED:].square()).mean(dim=(0, 2, 3))


def _prior_runs(
    step: PriorStep, start: Array, held: tuple[Array, Array], bounds: tuple[Array, Array]
) -> Array:
    """States ``(n, RUNS, n_x)`` of the prior alone; a run that would leave the bounds stops at its last state."""
    none = torch.zeros(len(start), 0, dtype=torch.float64)
    low, high = (torch.tensor(bound) for bound in bounds)
    x, states = torch.tensor(start), []
    with torch.no_grad():
        for u, w in zip(*(torch.tensor(v) for v in held), strict=True):
            states.append(x)
            x_next, _ = step(x, none, u, w)
            within = ((x_next >= low) & (x_next <= high) & x_next.isfinite()).all(-1, keepdim=True)
            x = torch.where(within, x_next, x)
    return torch.stack(states).numpy()


@dataclass(frozen=True)
class _Places:
    """Maps states to scaled points for distances; an angle becomes sine and cosine."""

    angles: NDArray[np.bool_]
    radians: Array
    scale: Array

    def __call__(self, x: Array) -> Array:
        turns = (x * self.radians)[:, self.angles]
        return np.hstack([np.sin(turns), np.cos(turns), (x / self.scale)[:, ~self.angles]])
