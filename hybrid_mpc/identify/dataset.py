"""Windows of trajectories as tensors: what fits and trainings take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError

LONGEST = 1000
"""Periods of a validation window at most: drifts show by then, and longer ones would take the training's time."""


@dataclass(frozen=True)
class Windows:
    """Equal windows cut from trajectories [SI]: a warm-up of ``warm`` samples on measurements, then a scored part.

    States ``x`` are ``(n, warm + horizon + 1, n_x)``; inputs ``u``, disturbances ``w`` and the states' derivatives
    ``xdot`` at the periods' starts ``(n, warm + horizon, ...)``.
    """

    x: Tensor
    u: Tensor
    w: Tensor
    warm: int
    xdot: Tensor

    @property
    def horizon(self) -> int:
        """Scored periods of each window."""
        return self.u.shape[1] - self.warm

    def __len__(self) -> int:
        return self.x.shape[0]

    def take(self, index: Tensor) -> Windows:
        """The windows of ``index``."""
        index = index.to(self.x.device)
        return Windows(self.x[index], self.u[index], self.w[index], self.warm, self.xdot[index])

    def to(self, device: torch.device) -> Windows:
        """The same windows on a device."""
        return Windows(
            self.x.to(device), self.u.to(device), self.w.to(device), self.warm, self.xdot.to(device)
        )


def cut_windows(trajectories: Sequence[Trajectory], warm: int, horizon: int, stride: int) -> Windows:
    """Windows of ``warm + horizon`` periods, every ``stride`` samples, from every trajectory long enough."""
    x, u, w, xdot, length = [], [], [], [], warm + horizon
    for trajectory in trajectories:
        _check_finite(trajectory)
        for start in range(0, len(trajectory.t) - length, stride):
            x.append(trajectory.x[start : start + length + 1])
            u.append(trajectory.u[start : start + length])
            w.append(trajectory.w[start : start + length])
            xdot.append(trajectory.xdot[start : start + length])
    if not x:
        longest = max((len(t.t) for t in trajectories), default=0)
        raise InputError(
            f"no training trajectory is long enough: the longest has {longest} samples, a window of "
            f"{warm} warm-up and {horizon} scored periods needs {length + 1}. Record longer runs or lower "
            "warm_up."
        )
    x_all, u_all, w_all, xdot_all = (torch.tensor(np.stack(parts)) for parts in (x, u, w, xdot))
    return Windows(x_all, u_all, w_all, warm, xdot_all)


def fitting_horizon(trajectories: Sequence[Trajectory], warm: int, most: int) -> int:
    """Scored periods of a window that let the shortest trajectory give windows at several starts.

    That is two thirds of what the warm-up leaves of it, at most ``most``. Where that is less than half of
    ``most``, the longest trajectory decides up to that half: one too short then gives no window, which is
    better than short windows for all.
    """
    lengths = [2 * (len(t.t) - warm - 1) // 3 for t in trajectories]
    return max(1, min(most, max(min(lengths), min(most // 2, max(lengths)))))


def validation_horizon(trajectories: Sequence[Trajectory], warm: int) -> int:
    """Scored periods of a validation window: a drift shows in long runs alone.

    That is two thirds of what the warm-up leaves of a usual trajectory (half of all samples lie in ones at least as
    long), at most ``LONGEST``. Shorter trajectories give no window.
    """
    lengths = np.sort([len(t.t) for t in trajectories])[::-1]
    usual = int(lengths[np.searchsorted(np.cumsum(lengths), 0.5 * lengths.sum())])
    return max(1, min(LONGEST, 2 * (usual - warm - 1) // 3))


def check_rates(trajectories: Sequence[Trajectory]) -> None:
    """Refuse trajectories whose derivative is not known: the paper form is trained on it."""
    for trajectory in trajectories:
        _check_finite(trajectory, ("xdot",))


def _check_finite(trajectory: Trajectory, names: Sequence[str] = ("x", "u", "w")) -> None:
    for name in names:
        bad = np.flatnonzero(~np.isfinite(getattr(trajectory, name)).all(axis=1))
        if len(bad):
            raise InputError(
                f"{trajectory.name}: {name} is not finite at {trajectory.t[bad[0]]:g} s ({len(bad)} samples "
                "in all); leave these samples out of the file"
            )
