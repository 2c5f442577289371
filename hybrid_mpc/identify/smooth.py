"""Smoothing of measured outputs with the prior's equations: estimates of measured and unmeasured states."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import Sizes, SmootherSettings, evenly, robust_spread
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.horizon import Horizon, Stretches
from hybrid_mpc.identify.simulation import (
    flow_slope,
    over_time,
    required_substeps,
    rest_of,
    stepped,
    visited,
    with_unknown_rates,
)
from hybrid_mpc.machine.prior import Equations, Prior

Array = NDArray[np.float64]
STILL = 0.01
"""Last Newton step, over the states' sizes, below which an equilibrium has converged."""
DECADES = (-6.0, 2.0)
"""Searched range of the walk of the unexplained rates, as a power of ten of their natural size: from an exact prior to
a prior that explains nothing."""
PIVOT = 1e-14
"""Smallest pivot of a matrix of correlations; rounding alone makes some 1e-16."""
AT_ONCE, NARROW = 15, 0.1
"""Number of walks that are tried at once, and the resolution [powers of ten] at which the search ends."""
ALIKE = 0.5
"""Minimum ratio of lengths of trajectories that run in one batch."""
IGNORANCE = 10.0
"""Standard deviation of an unknown initial state over its natural size; at most half its range."""
SAMPLE = 12
"""Maximum number of trajectories for the estimation of the noise levels."""
FADING = 10.0
"""Time constant [time units] with which an unexplained rate decays without data. Without decay, the state that it
drives would drift away."""
GROWN = 10.0
"""Growth of a small error that limits the time over which the states' sizes of an unstable machine are computed."""
QUIETEST = 1e-6
"""Minimum noise of a sensor over the spread of its output. Simulated recordings can be free of noise. Unknown initial
states have a standard deviation of about 10 spreads, so the squares of the two span all digits."""
SLACK = 0.1
"""Process noise of the states' equations over the machine's time unit, over the sensors' noise. It is too small to be
visible and large enough for a well-conditioned problem. All other unexplained effects are in ``d``."""
UNSEEN = 1e-6
"""Share of the outputs' spread below which the effect of a state's whole range counts as unobservable."""


@dataclass(frozen=True)
class Smoother(SmootherSettings):
    """Smoother: most likely ``(x, d)`` of recordings, with unexplained rates ``d`` of the corrected states.

    Model: ``x_{k+1} = f(x_k, u_k, w_k, d_k)`` is the prior integrated over a period with constant ``d_k``; ``d`` is a
    random walk that decays by ``fading``; ``y_k = g(x_k, u_k, w_k) + noise``. All samples of a recording are estimated
    together (:class:`~hybrid_mpc.identify.horizon.Horizon`). So unmeasured states are estimated, and responses to
    inputs are not smeared as by a local polynomial.

    States stay within three times their ranges. Missing samples (NaN) are skipped. A censored sample counts only if the
    estimate contradicts it. The loss of an outlier is linear.

    Args:
        prior: The fitted prior.
        dt: Period [s].

    Source: as for the horizon; for the filter that gives its start and the innovations: Jazwinski, *Stochastic
    processes and filtering theory* (1970), section 8.3.
    """

    prior: Prior
    dt: float

    def smooth(self, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
        """Estimate ``x`` and ``xdot`` of every trajectory from its own samples."""
        smoothed: dict[int, Trajectory] = {}
        for group in _together(trajectories):
            for (i, t), z in zip(group.items(), self._estimate(list(group.values())), strict=True):
                smoothed[i] = self._with_states(t, z)
        return [smoothed[i] for i in range(len(trajectories))]

    @property
    def _n_z(self) -> int:
        return len(self.prior.states) + len(self.prior.corrected)

    @cached_property
    def _period(self) -> ca.Function:
        """One period of the filter."""
        own = self._horizon
        return _filter(
            own.equations, own.corrected, own.dt, own.substeps, own.fading,
            (tuple(own.lower.tolist()), tuple(own.upper.tolist())),
        )  # fmt: skip

    def _with_states(self, trajectory: Trajectory, z: Array) -> Trajectory:
        n_x = len(self.prior.states)
        x, d = z[:, :n_x], z[:, n_x:]
        held = trajectory.u.T, trajectory.w.T, self.prior.p
        xdot = self.prior.equations.xdot(x.T, *held).full().T
        xdot[:, list(self.prior.corrected)] += d
        return replace(trajectory, x=x, xdot=xdot)

    def _estimate(self, group: Sequence[Trajectory]) -> list[Array]:
        """Most likely ``(x, d)`` ``(n, n_z)``; the starts are the filter's estimates and constant states."""
        runs, lengths = _Runs.of(self, group), [len(t.t) for t in group]
        begins = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.intp)
        y, censored, u, w = (
            np.concatenate([np.asarray(getattr(t, key), dtype=float) for t in group])
            for key in ("y", "censored", "u", "w")
        )
        n_x = len(self.prior.states)
        first = np.concatenate([runs.first, np.zeros((len(group), self._n_z - n_x))], axis=1)
        stretches, horizon = Stretches(y, censored, u, w, begins, first), self._horizon
        filtered = self._filtered(runs).now[runs.inside]
        held = np.repeat(np.clip(first, horizon.lower, horizon.upper), lengths, axis=0)
        return np.split(horizon.solve(stretches, [filtered, held]), begins[1:])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the states ``(n_x,)``: three times their ranges; none for an angle that can turn fully."""
        low, high = (np.array([getattr(s, end) for s in self.prior.states]) for end in ("lower", "upper"))
        beyond = np.where([s.periodic for s in self.prior.states], np.inf, high - low)
        bounded = np.isfinite(beyond)
        return np.where(bounded, low - beyond, -np.inf), np.where(bounded, high + beyond, np.inf)

    @cached_property
    def _horizon(self) -> Horizon:
        sizes = self.sizes
        rate = np.array([sizes.rate[i] for i in self.prior.corrected])
        (low, high), unknown = self.bounds, np.full(len(rate), np.inf)
        seconds = self.dt * sizes.rate[0] / sizes.x[0]  # of the machine, in a period
        quiet = max(float(np.min(np.array(self.sigma) / np.array(sizes.y))), QUIETEST)
        exact = SLACK * quiet * math.sqrt(seconds) * np.array(sizes.x)
        walk = np.maximum(self.walk, QUIETEST * QUIETEST * rate)
        return Horizon(
            equations=self.prior.equations,
            corrected=self.prior.corrected,
            p=self.prior.p,
            dt=self.dt,
            substeps=self.substeps or required_substeps(self.prior, self.dt),
            fading=self.fading,
            sigma=np.array(self.sigma),
            process=np.concatenate([exact, walk]),
            spread=self._ignorance(np.array(self.walk)),
            size=np.concatenate([sizes.x, rate]),
            lower=np.concatenate([low, -unknown]),
            upper=np.concatenate([high, unknown]),
        )

    def _ignorance(self, walk: Array) -> Array:
        """Standard deviations ``(..., n_z)`` of the initial ``(x, d)``, for the walk ``(..., n_d)``."""
        if self.fading < 1.0:
            settled = walk / math.sqrt(1.0 - self.fading**2)  # stationary standard deviation of d
        else:
            own = IGNORANCE * np.array([self.sizes.rate[i] for i in self.prior.corrected])
            settled = np.broadcast_to(own, walk.shape)
        ranges = np.array([0.5 * (s.upper - s.lower) for s in self.prior.states])
        known = np.minimum(IGNORANCE * np.array(self.sizes.x), ranges)
        return np.concatenate([np.broadcast_to(known, (*walk.shape[:-1], len(known))), settled], axis=-1)

    def prediction_errors(self, trajectories: Sequence[Trajectory]) -> list[Array]:
        """One-step prediction errors ``(n, n_y)`` of the filter for each trajectory; NaN where nothing is measured."""
        own: dict[int, Array] = {}
        for group in _together(trajectories):
            runs = _Runs.of(self, list(group.values()))
            found = self._filtered(runs)
            seen = np.where(found.counted, found.e, np.nan)
            own |= {i: v[:n] for i, v, n in zip(group, seen, runs.lengths, strict=True)}
        return [own[i] for i in range(len(trajectories))]

    def _filtered(self, runs: _Runs, levels: tuple[Array, Array] | None = None) -> _Filtered:
        """Run the filter.

        Noise and walk are the smoother's, or those of each run in ``levels``, ``(b, n_y)`` and ``(b, n_d)``.
        """
        b, n_z, n_x = len(runs.y), self._n_z, len(self.prior.states)
        sigma, walk = (np.broadcast_to(v, (b, np.shape(v)[-1])) for v in levels or (self.sigma, self.walk))
        spread = self._ignorance(walk)
        first = np.concatenate([runs.first, np.zeros((b, n_z - n_x))], axis=1)
        ahead = np.concatenate([first[:, None], spread[..., None] ** 2 * np.eye(n_z)], axis=1)
        signals = [np.where(runs.seen, runs.y, 0.0), runs.seen, runs.censored, runs.u, runs.w]
        values = np.broadcast_to(self.prior.p, (b, len(self.prior.parameters)))
        noise = np.concatenate([np.zeros((b, n_x)), np.square(walk)], axis=1)
        _, others = over_time(
            self._period,
            np.moveaxis(ahead, 0, -1),
            [np.moveaxis(v, 0, -1) for v in signals],
            [v.T for v in (values, np.square(sigma), noise)],
        )
        now, e, s, counts = (
            np.moveaxis(v.reshape(len(v), -1, rows, b), (3, 0, 2, 1), (0, 1, 2, 3))
            for v, rows in zip(others, (n_z, *(3 * [runs.y.shape[2]])), strict=True)
        )
        return _Filtered(counts[..., 0] > 0, now[..., 0], e[..., 0], s)

    def _starts(self, trajectories: Sequence[Trajectory]) -> Array:
        """Initial states ``(b, n_x)``: of the states that match the measurement, the nearest to the equilibrium.

        The equilibrium is the stable one of the first inputs; without it, rest. The distance is in the states' sizes.
        This resolves ambiguous sensors, for example a sensor that shows the size of a speed without its sign.
        """
        n, rest = len(trajectories), rest_of(self.prior)
        u, w = (
            np.stack([v[0] if len(v[0]) else near for v in given])
            for given, near in (
                ([t.u for t in trajectories], rest[1]), ([t.w for t in trajectories], rest[2])
            )
        )  # fmt: skip
        x = self._held(rest[0], u, w)
        y = np.stack([_first_seen(t.y) for t in trajectories])
        output = output_slope(self.prior.equations).map(n)
        size, outputs = np.array(self.sizes.x), np.array(self.sizes.y)
        for _ in range(5):
            found, c = (v.full() for v in output(x.T, u.T, w.T, np.tile(self.prior.p[:, None], (1, n))))
            e = np.where(np.isfinite(y), y - found.T, 0.0) / outputs
            scaled = np.moveaxis(c.reshape(c.shape[0], n, -1), 1, 0) * size / outputs[:, None]
            x = x + size * (np.linalg.pinv(scaled, rcond=1e-6) @ e[..., None])[..., 0]
        return x

    def _held(self, rest: Array, u: Array, w: Array) -> Array:
        """Stable equilibria ``(b, n_x)`` under constant inputs within the states' ranges, near rest; else rest."""
        n, size = len(u), np.array(self.sizes.x)
        held = u.T, w.T, np.tile(self.prior.p[:, None], (1, n))
        rates, slopes = self.prior.equations.xdot.map(n), flow_slope(self.prior.equations.xdot).map(n)
        low, high = (np.array([getattr(s, end) for s in self.prior.states]) for end in ("lower", "upper"))
        x = np.tile(rest, (n, 1))
        # Newton steps to the equilibrium of the first inputs
        for _ in range(15):
            xdot = rates(x.T, *held).full().T
            a = np.moveaxis(slopes(x.T, *held).full().reshape(len(rest), n, -1), 1, 0)
            good = np.isfinite(xdot).all(axis=1) & np.isfinite(a).all(axis=(1, 2))
            xdot, a = np.where(good[:, None], xdot, 0.0), np.where(good[:, None, None], a, 0.0)
            scaled = a * size / size[:, None]
            step = size * (np.linalg.pinv(scaled, rcond=1e-9) @ (xdot / size)[..., None])[..., 0]
            x = x - step
        stable = np.linalg.eigvals(a).real.max(axis=1) < 0
        found = (
            good & stable & (np.abs(step) < STILL * size).all(axis=1) & ((low <= x) & (x <= high)).all(axis=1)
        )
        return np.where(found[:, None], x, rest)


def _first_seen(y: Array) -> Array:
    """First measured sample of each output."""
    there = np.isfinite(y)
    return np.array([c[h][0] if h.any() else np.nan for c, h in zip(y.T, there.T, strict=True)])


@dataclass(frozen=True)
class _Runs:
    """Parallel trajectories ``(b, n, ...)``; a shorter one repeats its last sample, without measurements."""

    y: Array
    seen: Array
    censored: Array
    u: Array
    w: Array
    first: Array
    lengths: tuple[int, ...]

    @classmethod
    def of(cls, smoother: Smoother, group: Sequence[Trajectory]) -> _Runs:
        """Stack trajectories, with the smoother's initial states."""
        lengths = tuple(len(t.t) for t in group)
        index = np.minimum(np.arange(max(lengths)), np.array(lengths)[:, None] - 1)
        y, censored, u, w = (
            np.stack([getattr(t, key)[i] for t, i in zip(group, index, strict=True)])
            for key in ("y", "censored", "u", "w")
        )
        within = np.arange(max(lengths)) < np.array(lengths)[:, None]
        seen = (np.isfinite(y) & within[..., None]).astype(float)
        return cls(y, seen, censored.astype(float), u, w, smoother._starts(group), lengths)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Mask of the trajectories' own samples ``(b, n)``."""
        return np.asarray(np.arange(self.y.shape[1]) < np.array(self.lengths)[:, None])

    def times(self, m: int) -> _Runs:
        """Repeat the runs ``m`` times, one after the other."""
        own = (
            np.concatenate([v] * m) for v in (self.y, self.seen, self.censored, self.u, self.w, self.first)
        )
        y, seen, censored, u, w, first = own
        return _Runs(y, seen, censored, u, w, first, self.lengths * m)


@dataclass(frozen=True)
class _Filtered:
    """A filter's results for ``b`` runs of ``n`` samples: estimates, innovations and their covariances.

    ``counted`` are the measured samples, without censored samples that the estimate does not contradict.
    """

    counted: NDArray[np.bool_]
    now: Array
    e: Array
    s: Array


def _whitened(e: Array, s: Array) -> tuple[Array, Array]:
    """Errors ``(..., n_y)`` over the Cholesky root of their covariances ``(..., n_y, n_y)``, and the log-determinants.

    With ``s = D C D``, ``D`` the standard deviations and ``C = L L'`` the correlations: ``L^-1 D^-1 e``. Pivots of
    ``C`` are at least :data:`PIVOT`: where a filter diverges, rounding makes ``s`` singular. Numbers that are
    not finite stay.
    """
    n = e.shape[-1]
    with np.errstate(all="ignore"):
        size = np.sqrt(np.diagonal(s, axis1=-2, axis2=-1))
        c, white = s / (size[..., :, None] * size[..., None, :]), e / size
        root = np.zeros_like(c)
        for j in range(n):
            rest = c[..., j:, j] - (root[..., j:, :j] @ root[..., j, :j, None])[..., 0]
            pivot = np.sqrt(np.maximum(rest[..., :1], PIVOT))
            root[..., j:, j] = np.concatenate([pivot, rest[..., 1:] / pivot], axis=-1)
            known = np.sum(root[..., j, :j] * white[..., :j], axis=-1)
            white[..., j] = (white[..., j] - known) / root[..., j, j]
        logs = 2.0 * np.sum(np.log(size * np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    return white, logs


def _innovations(
    smoothers: Sequence[Smoother], trajectories: Sequence[Trajectory]
) -> list[tuple[float, float, int]]:
    """Sums of squared innovations over their variances and of log determinants, and number of innovations.

    One value for each of several smoothers that differ only in noise and walk. The filter starts with a large
    covariance; the first samples, which reduce it, are not counted.
    """
    one, m = smoothers[0], len(smoothers)
    squares, logs, count = np.zeros(m), np.zeros(m), np.zeros(m)
    for group in _together(trajectories):
        runs, b = _Runs.of(one, list(group.values())), len(group)
        levels = (
            np.repeat([own.sigma for own in smoothers], b, axis=0),
            np.repeat([own.walk for own in smoothers], b, axis=0),
        )
        found = one._filtered(runs.times(m), levels=levels)
        skip = np.minimum(math.ceil(one._n_z / max(1, len(one.sigma))), np.array(runs.lengths) - 1)
        counts = runs.inside & (np.arange(runs.y.shape[1]) >= skip[:, None])
        e, s = (v.reshape(m, b, *v.shape[1:])[:, counts] for v in (found.e, found.s))
        counted = found.counted.reshape(m, b, *found.counted.shape[1:])[:, counts]
        white, logarithms = _whitened(e, s)
        # the cost of a diverged filter is not finite or large, so it is not selected
        with np.errstate(invalid="ignore", over="ignore"):
            squares += np.sum(np.square(white), axis=(1, 2))
            logs += logarithms.sum(axis=1)
        count += counted.sum(axis=(1, 2))
    return [(float(a), float(b), int(c)) for a, b, c in zip(squares, logs, count, strict=True)]


def fit_smoother(
    prior: Prior,
    trajectories: Sequence[Trajectory],
    dt: float,
    *,
    time_unit: float | None = None,
    substeps: int | None = None,
) -> Smoother:
    """Estimate noise and walk of a smoother by maximum likelihood of the measurements.

    The ratio of walk to noise is searched; the scale of the noise follows in closed form. Ratios between outputs are
    those of their third differences. Ratios between walks are those of the rates' natural sizes.

    Args:
        prior: The fitted prior.
        trajectories: Recordings; at most ``SAMPLE`` of them, evenly chosen, are used.
        dt: Period [s].
        time_unit: The machine's time unit [s]. Default: that of the trajectories.
        substeps: Runge-Kutta sub-steps a period. Default: as many as the prior needs along the trajectories' states.
    """
    if substeps is None:
        substeps = required_substeps(prior, dt, visited(trajectories))
    unit = scales.time_unit(trajectories, dt) if time_unit is None else time_unit
    sample = [trajectories[i] for i in evenly(len(trajectories), SAMPLE)]
    at = _smoothers(prior, trajectories, dt, unit, substeps)

    def costs(ratios: Array) -> Array:
        found = _innovations([at(ratio) for ratio in ratios], sample)
        squares, logs, count = (np.array(v, dtype=float) for v in zip(*found, strict=True))
        values = count * np.log(np.maximum(squares, 1e-300) / np.maximum(count, 1)) + logs
        return np.where(np.isfinite(values), values, 1e300)

    best, width = 0.5 * (DECADES[0] + DECADES[1]), 0.5 * (DECADES[1] - DECADES[0])
    while width > NARROW:  # several walks at once cost little more than one
        ratios = np.clip(best + width * np.linspace(-1.0, 1.0, AT_ONCE), *DECADES)
        best, width = float(ratios[np.argmin(costs(ratios))]), 2 * width / (AT_ONCE - 1)
    ((squares, _, count),) = _innovations([at(best)], sample)
    sizes = at(best).sizes
    # a sensor's noise is at most the spread of its output
    most = float(np.max(np.array(sizes.y) / np.array(sizes.noise)))
    return at(best, float(np.clip(math.sqrt(squares / max(count, 1)), QUIETEST * most, most)))


def rough_smoother(
    prior: Prior, trajectories: Sequence[Trajectory], dt: float, *, time_unit: float
) -> Smoother:
    """Smoother for a prior that is not fitted yet, whose rates may have large errors.

    Arguments as for :func:`fit_smoother`; there is no search.
    """
    # walk, as a power of ten, for a prior that is not fitted yet
    return _smoothers(prior, trajectories, dt, time_unit, required_substeps(prior, dt))(-0.5, 1.0)


def _smoothers(
    prior: Prior, trajectories: Sequence[Trajectory], dt: float, unit: float, substeps: int
) -> Callable[..., Smoother]:
    """Smoothers by the walk's ratio, as a power of ten, and the scale of noise and walk."""
    sizes = sizes_of(prior, trajectories, dt, unit)
    fading = math.exp(-dt / (FADING * unit))
    rates = np.array(sizes.rate)[list(prior.corrected)] * math.sqrt(dt / unit)

    def at(ratio: float, scale: float = 1.0) -> Smoother:
        sigma, walk = scale * np.array(sizes.noise), scale * 10.0**ratio * rates
        return Smoother(
            prior, dt, sigma=tuple(sigma.tolist()), walk=tuple(walk.tolist()), sizes=sizes, fading=fading,
            substeps=substeps,
        )  # fmt: skip

    return at


def sizes_of(prior: Prior, trajectories: Sequence[Trajectory], dt: float, time_unit: float) -> Sizes:
    """Compute natural sizes of a machine's signals, from recordings and the prior linearized at rest."""
    y = np.concatenate([t.y for t in trajectories])
    spread = np.array([robust_spread(c) for c in y.T])
    spread = np.where(spread > 0, spread, 1.0)
    noise = np.maximum(_noise(trajectories), QUIETEST * spread)
    seen = seen_by(prior, dt, time_unit) / spread[:, None, None]
    # effect of one unit of each state on the outputs, in spreads
    size = np.sqrt(np.mean(np.sum(np.square(seen), axis=0), axis=0))
    ranges = np.array([s.upper - s.lower for s in prior.states])
    x = np.minimum(1.0 / np.maximum(size, 1e-300), np.where(np.isfinite(ranges), ranges, math.inf))
    unknown = ~np.isfinite(x) | (x > 1e200)
    x = np.where(unknown, 1.0, x)
    return Sizes(*(tuple(float(v) for v in values) for values in (spread, noise, x, x / time_unit)))


def seen_by(prior: Prior, dt: float, time_unit: float) -> Array:
    """Effect of each state on each output over the machine's time unit, ``C exp(A t)``, ``(n_y, n, n_x)``.

    On an unstable machine, the time is at most that in which a small error grows by ``GROWN``. The prior is linearized
    at rest (:func:`~hybrid_mpc.identify.simulation.rest_of`) and at a second point, because a sensor can be insensitive
    at one point (``|v|`` at rest).
    """
    x, u, w = rest_of(prior)
    ranges = np.array([s.upper - s.lower for s in prior.states])
    beside = x + np.where(np.isfinite(ranges), 0.1 * ranges, 1.0)
    slope, output = flow_slope(prior.equations.xdot), output_slope(prior.equations)
    found = []
    for point in (x, beside):
        a = slope(point, u, w, prior.p).full()
        c = output(point, u, w, prior.p)[1].full()
        if not (np.isfinite(a).all() and np.isfinite(c).all()):
            continue
        rate = float(np.linalg.eigvals(a).real.max(initial=0.0))
        periods = max(2, round(min(time_unit, math.log(GROWN) / rate if rate > 0 else math.inf) / dt))
        skip = max(1, periods // 50)  # fifty instants are enough
        with np.errstate(over="ignore", invalid="ignore"):  # fast unstable modes overflow
            step, rows, at = expm(a * dt * skip), [], np.eye(len(x))
        with np.errstate(over="ignore", invalid="ignore"):  # overflow is clipped below
            for _ in range(0, periods, skip):
                at = at @ step
                rows.append(c @ at)
        found.append(np.clip(np.nan_to_num(np.stack(rows, axis=1)), -1e100, 1e100))
    if not found:
        return np.zeros((len(prior.outputs), 1, len(x)))
    return np.concatenate(found, axis=1)


def unseen_states(prior: Prior, dt: float, time_unit: float) -> list[str]:
    """Names of the states that are not observable, alone or in combination with others.

    States are scaled by their ranges, outputs by the effect of all states.
    """
    seen = seen_by(prior, dt, time_unit)
    ranges = np.array([s.upper - s.lower for s in prior.states])
    scaled = seen * np.where(np.isfinite(ranges), ranges, 1.0)
    size = np.abs(scaled).max(axis=(1, 2), keepdims=True)
    rows = (scaled / np.where(size > 0, size, 1.0)).reshape(-1, len(ranges))
    columns = np.abs(rows).max(axis=0)
    alone = {s.name for s, c in zip(prior.states, columns, strict=True) if c < UNSEEN}
    left = [i for i, c in enumerate(columns) if c >= UNSEEN]
    if left:
        _, singular, directions = np.linalg.svd(rows[:, left] / columns[left], full_matrices=True)
        rank = int((singular > UNSEEN * singular[0]).sum())
        for direction in directions[rank:]:
            alone |= {prior.states[left[k]].name for k in np.flatnonzero(np.abs(direction) > 0.1)}
    return [s.name for s in prior.states if s.name in alone]


def _noise(trajectories: Sequence[Trajectory]) -> Array:
    """Standard deviation ``(n_y,)`` of the sensors' noise, from third differences of the measured samples.

    The third difference ``[1, -3, 3, -1]`` of white noise has 20 times its variance.
    """
    found = []
    for j in range(trajectories[0].y.shape[1]):
        columns = [t.y[np.isfinite(t.y[:, j]), j] for t in trajectories]
        third = np.concatenate([np.diff(c, 3) for c in columns])
        found.append(robust_spread(third) / math.sqrt(20.0))
    return np.array(found)


def _together(trajectories: Iterable[Trajectory]) -> list[dict[int, Trajectory]]:
    """Group trajectories of similar length; each keeps its index in the given order."""
    groups: list[dict[int, Trajectory]] = []
    longest = 0
    for i, t in sorted(enumerate(trajectories), key=lambda pair: -len(pair[1].t)):
        if not groups or len(t.t) < ALIKE * longest:
            groups.append({})
            longest = len(t.t)
        groups[-1][i] = t
    return groups


@lru_cache(maxsize=32)
def output_slope(equations: Equations) -> ca.Function:
    """``(x, u, w, p) -> y`` and its derivative by ``x``."""
    f = equations.output
    point = [ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4)]
    y = f(*point)
    return ca.Function("output", point, [y, ca.densify(ca.jacobian(y, point[0]))])


@lru_cache(maxsize=32)
def _filter(
    equations: Equations,
    corrected: tuple[int, ...],
    dt: float,
    substeps: int,
    fading: float,
    bounds: tuple[tuple[float, ...], tuple[float, ...]],
) -> ca.Function:
    """One period of the extended Kalman filter, with estimates clipped to bounds.

    Arguments: prediction ``[z, P]``, sample ``y``, masks of measured and of censored outputs, ``u, w``, ``p``,
    variances of noise and walk. Results: prediction of the next sample, estimate, innovation and its covariance, mask
    of counted outputs.
    """
    xdot = with_unknown_rates(equations.xdot, corrected)
    n_x, n_z, n_y = equations.xdot.size1_in(0), xdot.size1_in(0), equations.output.size1_out(0)
    sizes = {"u": xdot.size1_in(1), "w": xdot.size1_in(2), "p": xdot.size1_in(3)}
    ahead, y, seen, censored = (
        ca.SX.sym("ahead", n_z, 1 + n_z), *(ca.SX.sym(name, n_y) for name in ("y", "seen", "censored"))
    )  # fmt: skip
    u, w, p = (ca.SX.sym(name, n) for name, n in sizes.items())
    r, noise = ca.SX.sym("r", n_y), ca.SX.sym("noise", n_z)
    z, covariance = ahead[:, 0], ahead[:, 1:]
    expected = equations.output(z[:n_x], u, w, p)
    # a censored sample counts only if the estimate lies within the sensor's range
    counts = seen * (1 - ca.logic_and(censored != 0, censored * (expected - y) > 0))
    e, c = counts * (y - expected), ca.diag(counts) @ ca.jacobian(expected, z)
    s = c @ covariance @ c.T + ca.diag(counts * r + (1 - counts))
    gain = ca.solve(s, c @ covariance).T if n_y > 1 else (covariance @ c.T) / s
    rest = ca.SX.eye(n_z) - gain @ c  # Joseph form: rounding makes no variance negative
    after = rest @ covariance @ rest.T + gain @ ca.diag(counts * r) @ gain.T
    after = 0.5 * (after + after.T)
    now = ca.SX.sym("now", n_z)
    moved = stepped(xdot, now, u, w, p, dt, substeps)
    moved[n_x:] *= fading
    estimate = _between(z + gain @ e, *bounds)
    slope = ca.substitute(ca.jacobian(moved, now), now, estimate)
    moved = _between(ca.substitute(moved, now, estimate), *bounds)
    later = ca.horzcat(moved, slope @ after @ slope.T + ca.diag(noise))
    outputs = [ca.densify(v) for v in (later, estimate, e, s, counts)]
    given = [ahead, y, seen, censored, u, w, p, r, noise]
    return ca.Function("filter", given, [ca.cse(v) for v in outputs])


def _between(z: ca.SX, lower: tuple[float, ...], upper: tuple[float, ...]) -> ca.SX:
    """Clip the first components of ``z`` to their bounds."""
    bounded = [
        ca.fmin(ca.fmax(z[i], low), high) if math.isfinite(low) and math.isfinite(high) else z[i]
        for i, (low, high) in enumerate(zip(lower, upper, strict=True))
    ]
    return ca.vertcat(*bounded)
