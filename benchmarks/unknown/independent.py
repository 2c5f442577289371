"""A fit of a prior that shares nothing with the library's own, and the error that both are compared by.

Multiple shooting: recordings are cut into windows, the state at the start of each is an unknown. Runge-Kutta of order
4, differences of outputs as derivatives, ``scipy.optimize.least_squares``. Of the library it uses the prior's equations
alone.

Source: Bock, *Recent advances in parameter identification techniques for O.D.E.* (1983).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hybrid_mpc import Prior, Trajectory

Array = NDArray[np.float64]
STEP = 1e-6
"""Difference that a derivative is made of [sizes]."""
FAR = 10.0
"""Largest error that counts [spreads of an output]: a run that diverges stays finite."""
HELD = 1e-3
"""What holds a first state at its guess, over its size: what no output shows stays there."""
STEPS = 40
"""Steps at most towards the best first states."""


@dataclass(frozen=True)
class Windows:
    """Pieces of recordings of one length: ``y`` ``(n, T + 1, n_y)``, ``u``, ``w``, and the guess ``x`` ``(n, n_x)``."""

    y: Array
    u: Array
    w: Array
    x: Array

    def first(self, periods: int) -> Windows:
        """The beginning of each."""
        keep = slice(0, periods + 1)
        return Windows(self.y[:, keep], self.u[:, keep], self.w[:, keep], self.x)


def cut(prior: Prior, trajectories: Sequence[Trajectory], periods: int, most: int) -> Windows:
    """At most ``most`` windows, one behind the other, evenly chosen; a first state is guessed by what is measured."""
    places = [(t, k) for t in trajectories for k in range(0, len(t.t) - periods, periods)]
    chosen = [places[i] for i in sorted({*np.linspace(0, len(places) - 1, most).round().astype(int)})]
    y, u, w = (np.stack([getattr(t, key)[k : k + periods + 1] for t, k in chosen]) for key in ("y", "u", "w"))
    return Windows(y, u, w, guesses(prior, y, chosen[0][0].dt))


def guesses(prior: Prior, y: Array, dt: float) -> Array:
    """First states by the operating point, or the middle of the ranges, by outputs that are states, and by the speeds
    of these.
    """
    point = prior.operating_point
    x = np.array(point.x if point else [_middle(s.lower, s.upper) for s in prior.states], dtype=float)
    x = np.tile(x, (len(y), 1))
    places = {s.name: i for i, s in enumerate(prior.states)}
    for j, output in enumerate(prior.outputs):
        if output.name in places:
            first = [c[np.isfinite(c)][0] if np.isfinite(c).any() else np.nan for c in y[:, :, j]]
            x[:, places[output.name]] = np.where(np.isfinite(first), first, x[:, places[output.name]])
    few = min(8, y.shape[1])
    for position, speed in prior.kinematics:
        for j, output in enumerate(prior.outputs):
            if output.name == prior.states[position].name:
                for i, c in enumerate(y[:, :few, j]):
                    there = np.isfinite(c)
                    if there.sum() > 1:
                        x[i, speed] = np.polyfit(dt * np.flatnonzero(there), c[there], 1)[0]
    return x


def _middle(low: float, high: float) -> float:
    return 0.5 * (low + high) if np.isfinite(low + high) else 0.0


@dataclass
class Runs:
    """Free runs of a prior over windows.

    Args:
        prior: The prior.
        dt: Period [s].
        spread: What an error of each output is counted in ``(n_y,)``.
        substeps: Runge-Kutta steps a period.
    """

    prior: Prior
    dt: float
    spread: Array
    substeps: int = 4
    _functions: dict[tuple[int, int], ca.Function] = field(default_factory=dict)

    @cached_property
    def sizes(self) -> Array:
        """Sizes of the states: a quarter of their ranges."""
        ranges = np.array([s.upper - s.lower for s in self.prior.states])
        return np.where(np.isfinite(ranges), 0.25 * ranges, 1.0)

    def outputs(self, p: Array, x: Array, windows: Windows) -> Array:
        """Outputs ``(n, T + 1, n_y)`` with parameters ``p`` ``(n, n_p)`` from ``x`` ``(n, n_x)``."""
        n, steps = windows.u.shape[:2]
        if (n, steps) not in self._functions:
            self._functions[n, steps] = self._simulation(n, steps)
        held = (v.reshape(n * steps, -1).T for v in (windows.u, windows.w))
        y = self._functions[n, steps](x.T, *held, np.repeat(p, steps, axis=0).T).full()
        return np.moveaxis(y.reshape(-1, n, steps), 0, -1)

    def errors(self, p: Array, x: Array, windows: Windows) -> Array:
        """Errors ``(n, (T + 1) n_y)`` over the spreads, zero where nothing was measured."""
        off = (self.outputs(p, x, windows) - windows.y) / self.spread
        off = np.where(np.isfinite(windows.y), np.clip(np.nan_to_num(off, nan=FAR), -FAR, FAR), 0.0)
        return off.reshape(len(x), -1)

    def first_states(self, p: Array, x: Array, windows: Windows) -> tuple[Array, Array]:
        """First states that explain windows best for ``p`` ``(n_p,)``, and the errors: Levenberg and Marquardt."""
        n, n_x = x.shape
        every, damping, x = np.tile(p, (n, 1)), np.full(n, 1e-2), x.copy()
        many, guess = (
            windows.__class__(*(np.concatenate([v] * (n_x + 1)) for v in _parts(windows))),
            windows.x,
        )
        error = self.errors(every, x, windows)
        cost = np.square(error).sum(1) + np.square(HELD * (x - guess) / self.sizes).sum(1)
        for _ in range(STEPS):
            moved = np.concatenate([x, *(x + STEP * self.sizes * one for one in np.eye(n_x))])
            found = self.errors(np.tile(p, (len(moved), 1)), moved, many).reshape(n_x + 1, n, -1)
            slopes = np.moveaxis((found[1:] - found[0]) / STEP, 0, -1)
            normal = slopes.swapaxes(1, 2) @ slopes + HELD**2 * np.eye(n_x)
            right = (slopes.swapaxes(1, 2) @ error[..., None])[..., 0] + HELD**2 * (x - guess) / self.sizes
            scale = damping[:, None, None] * (normal * np.eye(n_x))
            trial = x - self.sizes * np.linalg.solve(normal + scale, right[..., None])[..., 0]
            off = self.errors(every, trial, windows)
            new = np.square(off).sum(1) + np.square(HELD * (trial - guess) / self.sizes).sum(1)
            better = new < cost
            gain = np.where(better, cost - new, 0.0).sum()
            x[better], error[better] = trial[better], off[better]
            cost, damping = np.minimum(cost, new), np.clip(damping * np.where(better, 0.1, 5.0), 1e-9, 1e9)
            if (better.any() and gain < 1e-6 * cost.sum()) or (damping >= 1e8).all():
                break
        return x, error

    def _simulation(self, n: int, steps: int) -> ca.Function:
        names = ("x", "u", "w", "p")
        x, u, w, p = (ca.SX.sym(key, len(self.prior.names_of(key))) for key in names)
        f, h, after = self.prior.equations.xdot, self.dt / self.substeps, x
        for _ in range(self.substeps):
            k1 = f(after, u, w, p)
            k2 = f(after + h / 2 * k1, u, w, p)
            k3 = f(after + h / 2 * k2, u, w, p)
            k4 = f(after + h * k3, u, w, p)
            after = after + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        shown = self.prior.equations.output(x, u, w, p)
        period = ca.Function("period", [x, u, w, p], [after, shown])
        run = period.mapaccum("run", steps)
        first, *held = (
            ca.MX.sym(key, v.numel(), 1 if key == "x" else steps)
            for key, v in zip(names, (x, u, w, p), strict=True)
        )
        return ca.Function("runs", [first, *held], [run(first, *held)[1]]).map(n)


def _parts(windows: Windows) -> tuple[Array, Array, Array, Array]:
    return windows.y, windows.u, windows.w, windows.x


def growing(runs: Runs, p: Array, windows: Windows, x: Array | None = None) -> tuple[Array, Array]:
    """First states, over the beginning of the windows first: what is unstable has no optimum far from the truth."""
    periods = windows.y.shape[1] - 1
    x = windows.x if x is None else x
    for share in (0.1, 0.3, 1.0):
        own = max(4, round(share * periods))
        x, error = runs.first_states(p, x, windows.first(min(own, periods)))
    return x, error


def free_run_errors(runs: Runs, windows: Windows, values: Sequence[Mapping[str, float]]) -> list[float]:
    """Root mean square of the errors over the spreads, of each set of parameters, each from first states that suit it
    best: of those found for any of the sets the ones that explain a window better.
    """
    thetas = [np.array([own[q.name] for q in runs.prior.parameters]) for own in values]
    found = [growing(runs, p, windows)[0] for p in thetas]
    errors = []
    count = max(1, int(np.isfinite(windows.y).sum()))
    for p in thetas:
        tried = [runs.first_states(p, x, windows)[1] for x in found]
        least = np.min([np.square(e).sum(1) for e in tried], axis=0)
        errors.append(float(np.sqrt(least.sum() / count)))
    return errors


def fit(
    runs: Runs, trajectories: Sequence[Trajectory], periods: int, start: Mapping[str, float], most: int = 24
) -> dict[str, float]:
    """Parameters from one start: over windows of a tenth, three tenths and the whole of ``periods``.

    Outputs count by what is left of them from the second fit of each length on, as in maximum likelihood.
    """
    prior = runs.prior
    free = [i for i, q in enumerate(prior.parameters) if not q.fixed]
    p = np.array([start[q.name] for q in prior.parameters], dtype=float)
    low, high = (np.array([getattr(prior.parameters[i], end) for i in free]) for end in ("lower", "upper"))
    unit = np.maximum(np.abs(p[free]), 1e-3 * (high - low))
    for share in (0.1, 0.3, 1.0):
        own = max(6, round(share * periods))
        windows = cut(prior, trajectories, min(own, periods), most)
        x, _ = growing(runs, p, windows)
        weights = np.ones(len(runs.spread))
        for _ in range(2):
            p, x = _solved(runs, windows, p, x, free, (low, high), unit, weights)
            left = runs.errors(np.tile(p, (len(x), 1)), x, windows).reshape(windows.y.shape)
            seen = np.isfinite(windows.y)
            size = np.sqrt((left**2).sum((0, 1)) / np.maximum(seen.sum((0, 1)), 1))
            weights = 1.0 / np.maximum(size, 1e-6)
            weights = weights / np.sqrt(np.mean(weights**2))
    return dict(zip((q.name for q in prior.parameters), p.tolist(), strict=True))


def _solved(
    runs: Runs,
    windows: Windows,
    p: Array,
    x: Array,
    free: list[int],
    bounds: tuple[Array, Array],
    unit: Array,
    weights: Array,
) -> tuple[Array, Array]:
    """One call of least_squares over parameters and first states."""
    (n, n_x), n_y = x.shape, len(weights)
    every = np.tile(weights, windows.y.shape[1])
    columns = [*range(len(free))]

    def split(z: Array) -> tuple[Array, Array]:
        own = p.copy()
        own[free] = z[: len(free)] * unit
        return own, z[len(free) :].reshape(n, n_x) * runs.sizes

    def residuals(z: Array) -> Array:
        own, first = split(z)
        off = runs.errors(np.tile(own, (n, 1)), first, windows) * every
        return np.concatenate([off.ravel(), (HELD * (first - windows.x) / runs.sizes).ravel()])

    def slopes(z: Array) -> Array:
        own, first = split(z)
        sets = [(own, first)]
        for k in columns:
            sets.append((own + STEP * unit[k] * (np.arange(len(own)) == free[k]), first))
        sets += [(own, first + STEP * runs.sizes * one) for one in np.eye(n_x)]
        many = Windows(*(np.concatenate([v] * len(sets)) for v in _parts(windows)))
        every_p = np.concatenate([np.tile(q, (n, 1)) for q, _ in sets])
        found = runs.errors(every_p, np.concatenate([s for _, s in sets]), many).reshape(len(sets), n, -1)
        by = (found[1:] - found[0]) / STEP * every
        m = by.shape[-1]
        whole = np.zeros((n * m + n * n_x, len(z)))
        whole[: n * m, : len(free)] = by[: len(free)].reshape(len(free), -1).T
        for i in range(n):
            rows = slice(i * m, (i + 1) * m)
            whole[rows, len(free) + i * n_x : len(free) + (i + 1) * n_x] = by[len(free) :, i].T
        whole[n * m :, len(free) :] = HELD * np.eye(n * n_x)
        return whole

    assert windows.y.shape[2] == n_y
    z = np.concatenate([np.clip(p[free], *bounds) / unit, (x / runs.sizes).ravel()])
    inner = np.concatenate([bounds[0] / unit, np.full(n * n_x, -np.inf)])
    outer = np.concatenate([bounds[1] / unit, np.full(n * n_x, np.inf)])
    z = np.clip(z, inner + 1e-9, outer - 1e-9)
    found = least_squares(
        residuals, z, slopes, (inner, outer), x_scale="jac", max_nfev=30, ftol=1e-7, xtol=1e-9
    )
    return split(found.x)
