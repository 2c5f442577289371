"""Output error by multiple shooting: the states at the segments' starts are unknowns beside the parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor
from torch.func import functional_call

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.dataset import Windows, cut_windows
from hybrid_mpc.identification.prior_residuals import LARGEST, ParameterFit, spread_of
from hybrid_mpc.identification.step import required_substeps, rk4

Array = NDArray[np.float64]
MOST_SEGMENTS = 60
"""Unknown states grow with the segments, and the time of a step with their cube."""
CONTINUITY = (1.0, 10.0, 100.0)
"""Weights, one after the other, of the gaps between segments: first they may gape, in the end they are closed to a
ten-thousandth of a measurement's share."""
EVALUATIONS = 15


@dataclass(frozen=True)
class Segments:
    """Adjacent segments of trajectories.

    Args:
        windows: The segments, ``n`` of them.
        joined: True ``(n,)`` where a segment's end is the next one's start.
    """

    windows: Windows
    joined: NDArray[np.bool_]


def cut_segments(trajectories: Sequence[Trajectory], periods: int, most: int = MOST_SEGMENTS) -> Segments:
    """Adjacent segments of ``periods``, of evenly chosen trajectories if there are more than ``most``.

    Args:
        trajectories: Recordings; what is left at the end of one is not used.
        periods: Length of a segment.
        most: Most segments.

    Raises:
        InputError: If no trajectory holds a segment.

    Example:
        >>> t, z = 0.02 * np.arange(65), np.zeros((65, 1))
        >>> run = Trajectory("run", "train", 0.02, t, z, z, np.hstack([z, z]), np.hstack([z, z]))
        >>> cut_segments([run, run], 30).joined.tolist()
        [True, False, True, False]
    """
    counts = [(len(t.t) - 1) // periods for t in trajectories]
    fitting = [i for i, count in enumerate(counts) if count]
    if not fitting:
        raise InputError(
            f"multiple shooting: no trajectory holds a segment of {periods} periods; the longest has "
            f"{max((len(t.t) for t in trajectories), default=0)} samples. Take shorter segments or longer runs."
        )
    take = max(1, min(len(fitting), most // max(counts)))
    chosen = [fitting[i] for i in np.linspace(0, len(fitting) - 1, take).round().astype(int)]
    parts, joined = [], []
    for i in chosen:
        n = min(counts[i], most)
        parts.append(cut_windows([trajectories[i]], 0, periods, periods).take(torch.arange(n)))
        joined += [True] * (n - 1) + [False]
    x, u, xdot = (torch.cat([getattr(p, name) for p in parts]) for name in ("x", "u", "xdot"))
    whole = Windows(x, u, 0, xdot)
    return Segments(whole, np.array(joined))


def multiple_shooting(fit: ParameterFit, start: Array, segments: Segments) -> tuple[Array, Array]:
    """Fit parameters and the state at the start of every segment together.

    Residuals, in spreads of the data: the measured states along each segment, those at the start of a trajectory, and
    the gaps between segments times a weight that grows (``CONTINUITY``). With all gaps closed a trajectory is one free
    run from an unknown state: no measured state is taken for exact, while free runs from measured ones carry their
    noise along. Derivatives are exact (forward mode through the integrator).

    Args:
        fit: The parameters.
        start: First ``theta``; the states start as they are measured.
        segments: What is fitted.

    Returns:
        ``theta`` and the Jacobian by it with the states projected out, over the residuals' standard deviation: the
        standard errors made of it know that the states are unknown.

    Source: Bock, *Recent advances in parameter identification techniques for O.D.E.* (1983).
    """
    problem = _Problem(fit, segments, start)
    z = np.concatenate([fit.inside(start), problem.measured.ravel()])
    free = np.full(problem.measured.size, np.inf)
    bounds = np.concatenate([fit.lower, -free]), np.concatenate([fit.upper, free])
    result: Any = None
    for weight in CONTINUITY:
        z = np.concatenate([fit.inside(z[: len(start)]), z[len(start) :]])
        result = least_squares(
            lambda z, w=weight: problem.residual(z, w),
            z,
            jac=lambda z, w=weight: problem.jacobian(z, w),
            bounds=bounds,
            max_nfev=EVALUATIONS,
        )
        z = result.x
    n = len(start)
    own, states = result.jac[:, :n], np.linalg.qr(result.jac[:, n:])[0]
    degrees = max(1, problem.measurements - n)
    noise = np.sqrt(max(2 * result.cost / degrees, 1e-30))
    return z[:n], (own - states @ (states.T @ own)) / noise


class _Problem:
    """Residuals of multiple shooting over ``z = [theta, states in spreads]``, and their Jacobian."""

    def __init__(self, fit: ParameterFit, segments: Segments, near: Array) -> None:
        self.fit, self.joined = fit, np.flatnonzero(segments.joined)
        # the start of a segment that follows another is measured as that one's end
        self.first = np.setdiff1d(np.arange(len(segments.joined)), self.joined + 1)
        self.spread = spread_of(segments.windows)
        self.u = segments.windows.u
        scaled = segments.windows.x / self.spread
        self.measured, self.later = scaled[:, 0].numpy(), scaled[:, 1:]
        self.measurements = self.later.numel()
        self.substeps = required_substeps(fit.make(fit.values(near)), fit.dt)
        run = self._run()
        self._value = torch.func.vmap(run, in_dims=(None, 0, 0))
        self._slopes = torch.func.vmap(torch.func.jacfwd(run, argnums=(0, 1)), in_dims=(None, 0, 0))

    def residual(self, z: Array, weight: float) -> Array:
        theta, nodes = self._split(z)
        ahead = self._value(torch.tensor(theta), torch.tensor(nodes), self.u)
        errors = _limited(ahead - self.later).numpy()
        gaps = _limited(ahead[:, -1]).numpy()[self.joined] - nodes[self.joined + 1]
        starts = (nodes - self.measured)[self.first]
        return np.concatenate([errors.ravel(), starts.ravel(), weight * gaps.ravel()])

    def jacobian(self, z: Array, weight: float) -> Array:
        theta, nodes = self._split(z)
        by_theta, by_node = (
            torch.nan_to_num(s, 0.0, 0.0, 0.0).clamp(-1e6, 1e6).numpy()
            for s in self._slopes(torch.tensor(theta), torch.tensor(nodes), self.u)
        )
        n, periods, n_x = by_theta.shape[:3]
        p, rows = len(theta), n * periods * n_x
        gaps = rows + len(self.first) * n_x
        out = np.zeros((gaps + len(self.joined) * n_x, p + n * n_x))
        out[:rows, :p] = by_theta.reshape(rows, p)
        for i in range(n):
            out[i * periods * n_x : (i + 1) * periods * n_x, self._columns(i)] = by_node[i].reshape(-1, n_x)
        for k, i in enumerate(self.first.tolist()):
            out[rows + k * n_x : rows + (k + 1) * n_x, self._columns(i)] = np.eye(n_x)
        for k, i in enumerate(self.joined.tolist()):
            at = slice(gaps + k * n_x, gaps + (k + 1) * n_x)
            out[at, :p] = weight * by_theta[i, -1]
            out[at, self._columns(i)] = weight * by_node[i, -1]
            out[at, self._columns(i + 1)] = -weight * np.eye(n_x)
        return out

    def _columns(self, i: int) -> slice:
        p, n_x = len(self.fit.free), self.measured.shape[1]
        return slice(p + i * n_x, p + (i + 1) * n_x)

    def _split(self, z: Array) -> tuple[Array, Array]:
        p = len(self.fit.free)
        return z[:p], z[p:].reshape(self.measured.shape)

    def _run(self) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        fit, spread, substeps = self.fit, self.spread, self.substeps
        unit, names = torch.tensor(fit.unit), [p.name for p in fit.free]

        def run(theta: Tensor, node: Tensor, inputs: Tensor) -> Tensor:
            """States ``(periods, n_x)`` [spreads] of one segment."""
            values = dict(zip(names, theta * unit, strict=True))
            x, states = node * spread, []
            for u in inputs:
                x = rk4(lambda z, u=u: functional_call(fit.prior, values, (z, u)), x, fit.dt, substeps)  # type: ignore[misc]
                states.append(x / spread)
            return torch.stack(states)

        return run


def _limited(values: Tensor) -> Tensor:
    return torch.nan_to_num(values, LARGEST, LARGEST, -LARGEST).clamp(-LARGEST, LARGEST)
