"""Smoothing of measured outputs with the prior's own equations: states, measured or not, that know the inputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import minimize_scalar

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import evenly, robust_spread
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.simulation import flow_slope, required_substeps, rest_of, stepped, with_unknown_rates
from hybrid_mpc.machine.prior import Equations, Prior

Array = NDArray[np.float64]
SWEEPS = 4
"""Linearizations along the smoothed trajectory, after the first along the filter's estimates."""
MOST_SWEEPS = 20
"""Linearizations at most, where the censored samples that count are not yet the same from one to the next."""
DECADES = (-6.0, 2.0)
"""Range searched for the walk of the unexplained rates, as a power of ten of their natural size: from a prior that is
right to one that explains nothing."""
ROUGH = -0.5
"""Walk, as a power of ten, of a prior that is not fitted yet."""
IGNORANCE = 10.0
"""Standard deviation of a state that is not known at first, as a multiple of its natural size; half its range at
most."""
SAMPLE = 12
"""At most so many trajectories decide the noise levels."""
FADING = 10.0
"""Machine's seconds in which an unexplained rate fades that nothing tells of: without, what it drives would drift
away."""
QUIETEST = 1e-6
"""Least noise of a sensor, as a share of the spread of its output: recordings of a simulation may have none, and what
is not known at first is some 10 spreads, whose square holds no more digits."""
UNSEEN = 1e-6
"""Share of the outputs' spread below which a state's whole range shows in no output."""


@dataclass(frozen=True)
class Sizes:
    """Natural sizes of a machine's signals, found in its recordings.

    ``y`` ``(n_y,)`` are the spreads of the outputs, ``noise`` ``(n_y,)`` what of them is noise. ``x`` ``(n_x,)`` is how
    far each state alone moves the outputs by their spread, within the machine's second; ``rate`` ``(n_x,)`` is that
    over this second. They depend on no unit.
    """

    y: tuple[float, ...]
    noise: tuple[float, ...]
    x: tuple[float, ...]
    rate: tuple[float, ...]


@dataclass(frozen=True)
class Smoother:
    """Fixed-interval smoother over ``(x, d)``: ``d`` is what the prior does not explain of the rates that it corrects.

    ``x_{k+1} = f(x_k, u_k, w_k, d_k)`` is the prior integrated over a period with ``d_k`` held, ``d`` walks at random,
    ``y_k = g(x_k, u_k, w_k) + noise``. Where nothing that is measured tells of ``d``, it fades (``fading``). So states
    that no sensor sees are estimated, and the input's part of a motion is known where a local polynomial would smear
    it. Missing samples (NaN) of single outputs are passed over; a censored one counts only where the estimate
    contradicts it.

    Args:
        prior: The fitted prior.
        dt: Period [s].
        sigma: Standard deviation of the measurement ``(n_y,)`` [output units].
        walk: Standard deviation of d's change per period ``(n_d,)`` [units of the corrected rates].
        sizes: Natural sizes of the signals (:func:`sizes_of`).
        fading: What is left of ``d`` after a period [-].

    Source: Rauch, Tung, Striebel, *Maximum likelihood estimates of linear dynamic systems* (1965); iterated
    linearization: Bell, *The iterated Kalman smoother as a Gauss-Newton method* (1994).
    """

    prior: Prior
    dt: float
    sigma: tuple[float, ...]
    walk: tuple[float, ...]
    sizes: Sizes
    fading: float = 1.0

    def smooth(self, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
        """Every trajectory with ``x`` and ``xdot`` from all of its own samples and from nothing outside it."""
        smoothed: dict[int, Trajectory] = {}
        for group in _by_length(trajectories):
            z = self._estimate(list(group.values()))
            for i, t, zi in zip(group, group.values(), z, strict=True):
                smoothed[i] = self._with_states(t, zi)
        return [smoothed[i] for i in range(len(trajectories))]

    def innovations(self, trajectories: Sequence[Trajectory]) -> tuple[float, float, int]:
        """Squared innovations over their variances, the logarithms of these variances, and how many there are.

        They are those of a filter that starts in ignorance; the samples that end it do not count.
        """
        squares, logs, count = 0.0, 0.0, 0
        for group in _by_length(trajectories):
            found = self._filtered(list(group.values()))
            skip = min(math.ceil(self._n_z / max(1, len(self.sigma))), found.y.shape[1] - 1)
            e, s, counted = (v[:, skip:] for v in (found.e, found.s, found.counted))
            squares += float(np.sum(e * np.linalg.solve(s, e[..., None])[..., 0]))
            logs += float(np.linalg.slogdet(s)[1].sum())
            count += int(counted.sum())
        return squares, logs, count

    @property
    def _n_z(self) -> int:
        return len(self.prior.states) + len(self.prior.corrected)

    @cached_property
    def _passes(self) -> tuple[ca.Function, ca.Function]:
        """One period of the filter: linearized along its own estimates, and along given ones."""
        return _filters(
            self.prior.equations,
            self.prior.corrected,
            self.dt,
            required_substeps(self.prior, self.dt),
            self.fading,
        )

    def _with_states(self, trajectory: Trajectory, z: Array) -> Trajectory:
        n_x = len(self.prior.states)
        x, d = z[:, :n_x], z[:, n_x:]
        held = trajectory.u.T, trajectory.w.T, self.prior.p
        xdot = self.prior.equations.xdot(x.T, *held).full().T
        xdot[:, list(self.prior.corrected)] += d
        return replace(trajectory, x=x, xdot=xdot)

    def _estimate(self, group: Sequence[Trajectory]) -> Array:
        """Smoothed ``(x, d)`` ``(b, n, n_z)`` of trajectories of one length."""
        found = self._filtered(group)
        z = _smoothed(found)
        for i in range(MOST_SWEEPS):
            found, before = self._filtered(group, z), found.counted
            z = _smoothed(found)
            if i + 1 >= SWEEPS and np.array_equal(before, found.counted):
                break
        return z

    def prediction_errors(self, trajectories: Sequence[Trajectory], p: Array) -> tuple[Array, list[Array]]:
        """Prediction errors of the filter for several sets of parameters ``(m, n_p)``.

        Gives them one behind the other, each over the standard deviation that the first set gives it, ``(m, N)``; and
        those of the first set by trajectory, ``(n, n_y)``, as they are.
        """
        every: list[Array] = []
        own: dict[int, Array] = {}
        for group in _by_length(trajectories):
            listed = list(group.values())
            runs = [t for _ in p for t in listed]
            found = self._filtered(runs, p=np.repeat(p, len(listed), axis=0))
            e = found.e.reshape(len(p), len(listed), *found.e.shape[1:])
            own |= dict(zip(group, np.where(found.counted[: len(listed)] > 0, e[0], np.nan), strict=True))
            root = np.linalg.cholesky(found.s[: len(listed)])
            every.append(np.linalg.solve(root, e[..., None])[..., 0].reshape(len(p), -1))
        return np.concatenate(every, axis=1), [own[i] for i in range(len(trajectories))]

    def _filtered(
        self, group: Sequence[Trajectory], along: Array | None = None, p: Array | None = None
    ) -> _Filtered:
        """What the filter finds, linearized along its own estimates or along ``(x, d)`` ``(b, n, n_z)``.

        Parameters are the prior's, or ``p`` ``(b, n_p)``.
        """
        y, u, w = (np.stack([getattr(t, key) for t in group]) for key in ("y", "u", "w"))
        censored = np.stack([t.censored for t in group])
        b, n = y.shape[:2]
        n_z, n_x = self._n_z, len(self.prior.states)
        seen = np.isfinite(y)
        first = np.stack([np.concatenate([self._start(t), np.zeros(n_z - n_x)]) for t in group])
        ranges = np.array([0.5 * (s.upper - s.lower) for s in self.prior.states])
        if self.fading < 1.0:
            settled = np.array(self.walk) / math.sqrt(1.0 - self.fading**2)  # of d, when it has long walked
        else:
            settled = IGNORANCE * np.array([self.sizes.rate[i] for i in self.prior.corrected])
        spread = np.concatenate([np.minimum(IGNORANCE * np.array(self.sizes.x), ranges), settled])
        ahead = np.concatenate(
            [first[..., None], np.broadcast_to(np.diag(spread**2), (b, n_z, n_z))], axis=-1
        )
        signals = [np.where(seen, y, 0.0), seen.astype(float), censored.astype(float), u, w]
        noise = np.concatenate([np.zeros(n_x), np.square(self.walk)])
        constant = [np.square(self.sigma), noise]
        values = np.broadcast_to(self.prior.p, (b, len(self.prior.parameters))) if p is None else p
        own, given = self._passes
        if along is not None:
            signals.append(along)
        run = _run(own if along is None else given, n, b)
        found = run(
            np.moveaxis(ahead, 1, 0).reshape(n_z, -1),
            *(v.reshape(b * n, v.shape[-1]).T for v in signals),
            values.T,
            *(np.tile(c[:, None], (1, b)) for c in constant),
        )
        ahead_, now, slope, e, s, counts = (
            np.moveaxis(v.full().reshape(v.shape[0], b, n, -1), 0, 2) for v in found
        )
        return _Filtered(y, counts[..., 0] > 0, first, spread, ahead_, now, slope, e[..., 0], s)

    def _start(self, trajectory: Trajectory) -> Array:
        """States at the first sample: nearest to rest, in their sizes, of those that explain what is measured."""
        x, u, w = rest_of(self.prior)
        u, w = (own[0] if len(own[0]) else near for own, near in ((trajectory.u, u), (trajectory.w, w)))
        there = np.isfinite(trajectory.y)
        y = np.array([c[h][0] if h.any() else np.nan for c, h in zip(trajectory.y.T, there.T, strict=True)])
        output, size, outputs = (
            _output_slope(self.prior.equations),
            np.array(self.sizes.x),
            np.array(self.sizes.y),
        )
        for _ in range(5):
            found, c = (v.full() for v in output(x, u, w, self.prior.p))
            e = np.where(np.isfinite(y), y - found[:, 0], 0.0) / outputs
            scaled = c * size / outputs[:, None]
            x = x + size * (np.linalg.pinv(scaled, rcond=1e-6) @ e)
        return x


@dataclass(frozen=True)
class _Filtered:
    """A filter's results for ``b`` trajectories of ``n`` samples; the last axis is ``[z, P]`` of estimates.

    ``counted`` are the samples that are there, without the censored ones that nothing contradicts.
    """

    y: Array
    counted: NDArray[np.bool_]
    first: Array
    spread: Array
    ahead: Array
    now: Array
    slope: Array
    e: Array
    s: Array


def _smoothed(found: _Filtered) -> Array:
    """Rauch-Tung-Striebel smoother behind a filter: ``z`` ``(b, n, n_z)``."""
    b, n, n_z, _ = found.now.shape
    forward = found.slope[:, :-1] @ found.now[:, :-1, :, 1:]
    # where data are exact some directions are known to rounding: it is added to the correlations
    covariance = found.ahead[:, :-1, :, 1:]
    size = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 1e-300))[..., None]
    correlation = covariance / (size * np.swapaxes(size, -1, -2)) + 1e-14 * np.eye(n_z)
    back = np.swapaxes(np.linalg.solve(correlation, forward / size) / size, -1, -2)
    own, ahead = found.now[..., 0], found.ahead[:, :-1, :, 0]
    given = own[:, -2::-1] - np.einsum("bnij,bnj->bni", back, ahead)[:, ::-1], back[:, ::-1]
    if n < 2:
        return own
    run = _backward(n_z, n - 1).map(b)
    later = run(
        own[:, -1].T,
        given[0].reshape(-1, n_z).T,
        np.moveaxis(given[1].reshape(-1, n_z, n_z), 1, 0).reshape(n_z, -1),
    )
    earlier = later.full().T.reshape(b, n - 1, n_z)[:, ::-1]
    return np.concatenate([earlier, own[:, -1:]], axis=1)


def fit_smoother(
    prior: Prior, trajectories: Sequence[Trajectory], dt: float, *, time_unit: float | None = None
) -> Smoother:
    """Smoother whose noise and walk make the measurements most likely.

    The ratio of walk to noise is searched, the noise's scale follows in closed form. Several outputs keep the ratio of
    noises that their third differences show, several walks that of the natural sizes of the rates.

    Args:
        prior: The fitted prior.
        trajectories: Recordings; at most ``SAMPLE`` of them, evenly chosen, are used.
        dt: Period [s].
        time_unit: The machine's second [s]. Default: that of the trajectories.
    """
    unit = scales.time_unit(trajectories, dt) if time_unit is None else time_unit
    sample = [trajectories[i] for i in evenly(len(trajectories), SAMPLE)]
    at = _smoothers(prior, trajectories, dt, unit)

    def cost(ratio: float) -> float:
        squares, logs, count = at(ratio).innovations(sample)
        value = count * math.log(max(squares, 1e-300) / max(count, 1)) + logs
        return value if math.isfinite(value) else 1e300

    best = float(minimize_scalar(cost, bounds=DECADES, method="bounded", options={"xatol": 0.1}).x)
    squares, _, count = at(best).innovations(sample)
    sizes = at(best).sizes
    least = QUIETEST * float(np.max(np.array(sizes.y) / np.array(sizes.noise)))
    return at(best, max(math.sqrt(squares / max(count, 1)), least))


def rough_smoother(
    prior: Prior, trajectories: Sequence[Trajectory], dt: float, *, time_unit: float
) -> Smoother:
    """Smoother of a prior that is not fitted yet: its rates may be wrong by a good part of their size.

    Arguments as for :func:`fit_smoother`; nothing is searched.
    """
    return _smoothers(prior, trajectories, dt, time_unit)(ROUGH, 1.0)


def _smoothers(
    prior: Prior, trajectories: Sequence[Trajectory], dt: float, unit: float
) -> Callable[..., Smoother]:
    """Smoothers by the walk's ratio, as a power of ten, and the scale of noise and walk."""
    sizes = sizes_of(prior, trajectories, dt, unit)
    fading = math.exp(-dt / (FADING * unit))
    rates = np.array(sizes.rate)[list(prior.corrected)] * math.sqrt(dt / unit)

    def at(ratio: float, scale: float = 1.0) -> Smoother:
        sigma, walk = scale * np.array(sizes.noise), scale * 10.0**ratio * rates
        return Smoother(prior, dt, tuple(sigma.tolist()), tuple(walk.tolist()), sizes, fading)

    return at


def sizes_of(prior: Prior, trajectories: Sequence[Trajectory], dt: float, time_unit: float) -> Sizes:
    """Natural sizes of a machine's signals, from recordings and the prior linearized at rest."""
    y = np.concatenate([t.y for t in trajectories])
    spread = np.array([robust_spread(c) for c in y.T])
    spread = np.where(spread > 0, spread, 1.0)
    noise = np.maximum(_noise(trajectories), QUIETEST * spread)
    seen = seen_by(prior, dt, time_unit) / spread[:, None, None]
    size = np.sqrt(
        np.mean(np.sum(np.square(seen), axis=0), axis=0)
    )  # of the outputs, for one unit of each state
    ranges = np.array([s.upper - s.lower for s in prior.states])
    x = np.minimum(1.0 / np.maximum(size, 1e-300), np.where(np.isfinite(ranges), ranges, math.inf))
    unknown = ~np.isfinite(x) | (x > 1e200)
    x = np.where(unknown, 1.0, x)
    return Sizes(*(tuple(float(v) for v in values) for values in (spread, noise, x, x / time_unit)))


def seen_by(prior: Prior, dt: float, time_unit: float) -> Array:
    """How each state at a time shows in each output over the machine's second after it ``(n_y, n, n_x)``.

    The prior is linearized at rest (:func:`~hybrid_mpc.identify.simulation.rest_of`) and a little beside it, since a
    sensor may be blind at one point: ``|v|`` at rest.
    """
    x, u, w = rest_of(prior)
    ranges = np.array([s.upper - s.lower for s in prior.states])
    beside = x + np.where(np.isfinite(ranges), 0.1 * ranges, 1.0)
    periods = max(2, round(time_unit / dt))
    skip = max(1, periods // 50)  # fifty instants tell as much as a thousand
    slope, output = flow_slope(prior.equations.xdot), _output_slope(prior.equations)
    found = []
    for point in (x, beside):
        a = slope(point, u, w, prior.p).full()
        c = output(point, u, w, prior.p)[1].full()
        if not (np.isfinite(a).all() and np.isfinite(c).all()):
            continue
        step, rows, at = expm(a * dt * skip), [], np.eye(len(x))
        with np.errstate(over="ignore", invalid="ignore"):  # what runs away is cut off below
            for _ in range(0, periods, skip):
                at = at @ step
                rows.append(c @ at)
        found.append(np.clip(np.nan_to_num(np.stack(rows, axis=1)), -1e100, 1e100))
    if not found:
        return np.zeros((len(prior.outputs), 1, len(x)))
    return np.concatenate(found, axis=1)


def unseen_states(prior: Prior, dt: float, time_unit: float) -> list[str]:
    """Names of the states that no output tells of: alone, or together with others.

    States are scaled by their ranges, outputs by what all states together make of them.
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
    """Standard deviation ``(n_y,)`` of the sensors' noise, from third differences of the samples that are there."""
    found = []
    for j in range(trajectories[0].y.shape[1]):
        columns = [t.y[np.isfinite(t.y[:, j]), j] for t in trajectories]
        third = np.concatenate([np.diff(c, 3) for c in columns])
        found.append(robust_spread(third) / math.sqrt(20.0))
    return np.array(found)


def _by_length(trajectories: Iterable[Trajectory]) -> list[dict[int, Trajectory]]:
    """Trajectories of equal length together, each under its place in the order given."""
    groups: dict[int, dict[int, Trajectory]] = {}
    for i, trajectory in enumerate(trajectories):
        groups.setdefault(len(trajectory.t), {})[i] = trajectory
    return list(groups.values())


@lru_cache(maxsize=32)
def _output_slope(equations: Equations) -> ca.Function:
    """``(x, u, w, p) -> y`` and its derivative by ``x``."""
    f = equations.output
    point = [ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4)]
    y = f(*point)
    return ca.Function("output", point, [y, ca.densify(ca.jacobian(y, point[0]))])


@lru_cache(maxsize=32)
def _filters(
    equations: Equations, corrected: tuple[int, ...], dt: float, substeps: int, fading: float
) -> tuple[ca.Function, ca.Function]:
    """A period of the filter, along its own estimates and along given ones.

    Takes what is expected ``[z, P]``, a sample ``y``, which outputs were seen, which are censored, ``u, w``, ``z`` to
    linearize along, ``p``, variances of the noise and of the walk. Gives what is expected of the next sample, the
    estimate ``[z, P]``, the transition, the innovation with its covariance, and which samples counted.
    """
    xdot = with_unknown_rates(equations.xdot, corrected)
    n_x, n_z, n_y = equations.xdot.size1_in(0), xdot.size1_in(0), equations.output.size1_out(0)
    sizes = {"u": xdot.size1_in(1), "w": xdot.size1_in(2), "p": xdot.size1_in(3)}
    ahead, y, seen, censored = (
        ca.SX.sym("ahead", n_z, 1 + n_z), *(ca.SX.sym(name, n_y) for name in ("y", "seen", "censored"))
    )  # fmt: skip
    u, w, p = (ca.SX.sym(name, n) for name, n in sizes.items())
    along, r, noise = ca.SX.sym("along", n_z), ca.SX.sym("r", n_y), ca.SX.sym("noise", n_z)

    def linear(of: ca.SX, at: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Output at ``of``, linearized at ``at``, and its slope."""
        x = ca.SX.sym("x", n_x)
        value = equations.output(x, u, w, p)
        slope = ca.horzcat(ca.jacobian(value, x), ca.SX(n_y, n_z - n_x))
        value, slope = (ca.substitute(v, x, at[:n_x]) for v in (value, slope))
        return value + slope @ (of - at), slope

    def moved(of: ca.SX, at: ca.SX) -> tuple[ca.SX, ca.SX]:
        z = ca.SX.sym("z", n_z)
        value = stepped(xdot, z, u, w, p, dt, substeps)
        value[n_x:] *= fading
        value, slope = (ca.substitute(v, z, at) for v in (value, ca.jacobian(value, z)))
        return value + slope @ (of - at), slope

    made = []
    for own in (True, False):
        z, covariance = ahead[:, 0], ahead[:, 1:]
        expected, c = linear(z, z if own else along)
        # a censored sample counts where the estimate lies on the measured side of its limit: that of all samples, once
        # there is one, since later samples may draw an earlier state across
        estimate = expected if own else equations.output(along[:n_x], u, w, p)
        counts = seen * (1 - ca.logic_and(censored != 0, censored * (estimate - y) > 0))
        e, c = counts * (y - expected), ca.diag(counts) @ c
        s = c @ covariance @ c.T + ca.diag(counts * r + (1 - counts))
        gain = ca.solve(s, c @ covariance).T if n_y > 1 else (covariance @ c.T) / s
        rest = ca.SX.eye(n_z) - gain @ c  # Joseph's form: rounding leaves no variance negative
        covariance = rest @ covariance @ rest.T + gain @ ca.diag(counts * r) @ gain.T
        z, covariance = z + gain @ e, 0.5 * (covariance + covariance.T)
        after, slope = moved(z, z if own else along)
        later = ca.horzcat(after, slope @ covariance @ slope.T + ca.diag(noise))
        outputs = [ca.densify(v) for v in (later, ca.horzcat(z, covariance), slope, e, s, counts)]
        given = [ahead, y, seen, censored, u, w, *([] if own else [along]), p, r, noise]
        made.append(ca.Function("filter" if own else "again", given, [ca.cse(v) for v in outputs]))
    return made[0], made[1]


@lru_cache(maxsize=64)
def _run(period: ca.Function, n: int, b: int) -> ca.Function:
    """A filter over ``n`` samples of ``b`` trajectories; the last three inputs are constant."""
    signals = range(1, period.n_in() - 3)
    held = [
        ca.MX.sym(f"a{i}", period.size1_in(i), period.size2_in(i) * (n if i in signals else 1))
        for i in range(period.n_in())
    ]
    over = period.mapaccum(n)(*held[:-3], *(ca.repmat(v, 1, n) for v in held[-3:]))
    return ca.Function("run", held, list(over)).map(b)


@lru_cache(maxsize=64)
def _backward(n_z: int, n: int) -> ca.Function:
    """``z_k = offset_k + back_k z_{k+1}`` over ``n`` samples."""
    z, offset, back = ca.SX.sym("z", n_z), ca.SX.sym("offset", n_z), ca.SX.sym("back", n_z, n_z)
    return ca.Function("earlier", [z, offset, back], [offset + back @ z]).mapaccum(n)
