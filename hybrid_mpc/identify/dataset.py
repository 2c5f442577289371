"""Windows of trajectories as tensors, for trainings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError

LONGEST = 1000
"""Maximum periods of a validation window: long enough to show drifts, and short enough for the training's time."""


@dataclass(frozen=True)
class Windows:
    """Windows of equal length, cut from trajectories [SI]: a warm-up on measurements, then an evaluated part.

    Args:
        x: States ``(n, warm + horizon + 1, n_x)``.
        u: Inputs ``(n, warm + horizon, n_u)``.
        w: Disturbances ``(n, warm + horizon, n_w)``.
        warm: Samples of the warm-up.
        xdot: Derivatives of the states at the start of each period ``(n, warm + horizon, n_x)``.
        weight: Weight of each window for each network ``(networks, n)``. Default: equal weights.
    """

    x: Tensor
    u: Tensor
    w: Tensor
    warm: int
    xdot: Tensor
    weight: Tensor | None = None

    @property
    def horizon(self) -> int:
        """Evaluated periods of each window."""
        return self.u.shape[1] - self.warm

    def __len__(self) -> int:
        return self.x.shape[0]

    def take(self, index: Tensor) -> Windows:
        """Select the windows of ``index``."""
        index = index.to(self.x.device)
        weight = None if self.weight is None else self.weight[:, index]
        return Windows(self.x[index], self.u[index], self.w[index], self.warm, self.xdot[index], weight)

    def to(self, device: torch.device) -> Windows:
        """Move the windows to a device."""
        weight = None if self.weight is None else self.weight.to(device)
        return Windows(
            self.x.to(device), self.u.to(device), self.w.to(device), self.warm, self.xdot.to(device), weight
        )


def cut_windows(
    trajectories: Sequence[Trajectory],
    warm: int,
    horizon: int,
    stride: int,
    weights: Sequence[Sequence[float]] = (),
) -> Windows:
    """Cut windows of ``warm + horizon`` periods, every ``stride`` samples, from all trajectories that are long enough.

    ``weights`` has a row for each trajectory: the weight of its windows for each network. Default: equal weights.
    """
    x, u, w, xdot, length = [], [], [], [], warm + horizon
    rows: list[Sequence[float]] = []
    for i, trajectory in enumerate(trajectories):
        _check_finite(trajectory)
        for start in range(0, len(trajectory.t) - length, stride):
            x.append(trajectory.x[start : start + length + 1])
            u.append(trajectory.u[start : start + length])
            w.append(trajectory.w[start : start + length])
            xdot.append(trajectory.xdot[start : start + length])
            rows += weights[i : i + 1]
    if not x:
        longest = max((len(t.t) for t in trajectories), default=0)
        raise InputError(
            f"training recordings: too short. The longest has {longest} samples, but a window of {warm} periods of "
            f"warm-up and {horizon} evaluated periods needs {length + 1}. Record longer runs, or reduce warm_up "
            "[HM-IDENTIFY-005]"
        )
    x_all, u_all, w_all, xdot_all = (torch.tensor(np.stack(parts)) for parts in (x, u, w, xdot))
    weight = torch.tensor(np.array(rows, dtype=np.float64).T) if rows else None
    return Windows(x_all, u_all, w_all, warm, xdot_all, weight)


def in_parts(
    trajectories: Sequence[Trajectory], parts: int, shortest: int
) -> tuple[list[Trajectory], list[int]]:
    """Divide training data into parts of about the same length; each network leaves one part out.

    If there are at least as many recordings as parts, a part consists of whole recordings. Else every recording is cut
    into stretches of equal length; pieces shorter than ``shortest`` after a cut are dropped.

    Args:
        trajectories: Training trajectories.
        parts: Number of parts; 0 or 1: no parts.
        shortest: Minimum samples of a stretch; a short recording is cut into fewer stretches.

    Returns:
        The trajectories, and the part of each; -1 without parts.

    Example:
        >>> z = np.zeros((100, 1))
        >>> run = Trajectory("run", "train", 0.1, z[:, 0], z, z, z, z)
        >>> pieces, part = in_parts([run], 4, 20)
        >>> [len(p.t) for p in pieces], part, in_parts([run], 4, 60)[1]
        ([25, 25, 25, 25], [0, 1, 2, 3], [-1])
    """
    files = list(dict.fromkeys(t.file for t in trajectories))
    size = {file: sum(len(t.t) for t in trajectories if t.file == file) for file in files}
    count = {file: min(-(-parts // max(1, len(files))), size[file] // max(1, shortest)) for file in files}
    if parts < 2 or sum(max(1, c) for c in count.values()) < 2:
        return list(trajectories), [-1] * len(trajectories)
    if len(files) >= parts:
        load, of = np.zeros(parts), {}
        for file in sorted(files, key=lambda name: -size[name]):
            of[file] = int(load.argmin())
            load[of[file]] += size[file]
        return list(trajectories), [of[t.file] for t in trajectories]
    pieces, part, first = [], [], 0
    for file in files:
        cuts, done = np.linspace(0, size[file], max(1, count[file]) + 1).round().astype(int).tolist(), 0
        for t in (t for t in trajectories if t.file == file):
            for k, (a, b) in enumerate(pairwise(cuts)):
                keep = slice(max(a - done, 0), max(min(b - done, len(t.t)), 0))
                whole = keep.stop - keep.start == len(t.t)
                if keep.stop - keep.start >= shortest or whole:
                    pieces.append(t if whole else t.part(keep))
                    part.append((first + k) % parts)
            done += len(t.t)
        first += max(1, count[file])
    return pieces, part


def fitting_horizon(trajectories: Sequence[Trajectory], warm: int, most: int) -> int:
    """Evaluated periods of a window, so that the shortest trajectory gives windows with several start samples.

    The result is two thirds of the shortest trajectory after its warm-up, at most ``most``. If this is less than half
    of ``most``, the longest trajectory decides up to that half: a trajectory that is too short then gives no window,
    which is better than short windows for all.
    """
    lengths = [2 * (len(t.t) - warm - 1) // 3 for t in trajectories]
    return max(1, min(most, max(min(lengths), min(most // 2, max(lengths)))))


def validation_horizon(trajectories: Sequence[Trajectory], warm: int) -> int:
    """Evaluated periods of a validation window; only long runs show a drift.

    The result is two thirds of a typical trajectory after its warm-up, at most ``LONGEST``. Half of all samples lie in
    trajectories at least as long as the typical one. Shorter trajectories give no window.
    """
    lengths = np.sort([len(t.t) for t in trajectories])[::-1]
    usual = int(lengths[np.searchsorted(np.cumsum(lengths), 0.5 * lengths.sum())])
    return max(1, min(LONGEST, 2 * (usual - warm - 1) // 3))


def check_rates(trajectories: Sequence[Trajectory]) -> None:
    """Refuse trajectories without derivatives, on which the paper's form is trained."""
    for trajectory in trajectories:
        _check_finite(trajectory, ("xdot",))


def _check_finite(trajectory: Trajectory, names: Sequence[str] = ("x", "u", "w")) -> None:
    for name in names:
        bad = np.flatnonzero(~np.isfinite(getattr(trajectory, name)).all(axis=1))
        if len(bad):
            raise InputError(
                f"{trajectory.name}: {name} is not finite at {trajectory.t[bad[0]]:g} s ({len(bad)} samples "
                "in total). Remove these samples from the file [HM-IDENTIFY-006]"
            )
