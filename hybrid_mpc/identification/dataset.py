"""Trajectories as tensors: windows for training, whole runs for evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.step import Scaling
from hybrid_mpc.physics import Prior


@dataclass(frozen=True)
class Windows:
    """Equal windows cut from trajectories: a warm-up on measurements, then a scored part.

    Args:
        x: States ``(n, warm + horizon + 1, n_x)`` [SI].
        u: Inputs ``(n, warm + horizon, n_u)`` [SI].
        warm: Samples of the warm-up.
    """

    x: Tensor
    u: Tensor
    warm: int

    @property
    def horizon(self) -> int:
        """Scored periods of each window."""
        return self.u.shape[1] - self.warm

    def __len__(self) -> int:
        return self.x.shape[0]

    def take(self, index: Tensor) -> Windows:
        """The windows of ``index``."""
        return Windows(self.x[index], self.u[index], self.warm)


def cut_windows(trajectories: Sequence[Trajectory], warm: int, horizon: int, stride: int) -> Windows:
    """Windows of ``warm + horizon`` periods, every ``stride`` samples, from every trajectory long enough.

    Raises:
        InputError: If no trajectory is long enough.
    """
    x, u, length = [], [], warm + horizon
    for trajectory in trajectories:
        for start in range(0, len(trajectory.t) - length, stride):
            x.append(trajectory.x[start : start + length + 1])
            u.append(trajectory.u[start : start + length])
    if not x:
        longest = max((len(t.t) for t in trajectories), default=0)
        raise InputError(
            f"no training trajectory is long enough: the longest has {longest} samples, a window of "
            f"{warm} warm-up and {horizon} scored periods needs {length + 1}. Record longer runs or lower warm_up."
        )
    return Windows(torch.tensor(np.stack(x)), torch.tensor(np.stack(u)), warm)


def scaling_of(prior: Prior, windows: Windows, dt: float, *, use_prior: bool) -> Scaling:
    """Scaling from training windows: root mean squares of signals and of what the network must give."""
    x, u = windows.x[:, :-1].reshape(-1, windows.x.shape[-1]), windows.u.reshape(-1, windows.u.shape[-1])
    n_q = prior.n_q
    measured = (windows.x[:, 1:, n_q:] - windows.x[:, :-1, n_q:]).reshape(-1, n_q) / dt
    predicted = prior.acceleration(x, u)
    residual = measured - predicted if use_prior else measured

    def rms(values: Tensor) -> tuple[float, ...]:
        return tuple(float(v) for v in values.square().mean(0).sqrt().clamp_min(1e-9))

    return Scaling(x=rms(x), u=rms(u), acceleration=rms(predicted), correction=rms(residual))
