"""Multiple shooting: parameters and initial states of windows as one robust least-squares problem.

Initial states are eliminated from every Levenberg-Marquardt step. Parameters stay within their bounds.

With residuals r over their scales, initial states x, their guess x_0 over sizes s, the cost is
``sum 2 c^2 (sqrt(1 + r^2 / c^2) - 1) + held |(x - x_0) / s|^2 + |pull (theta - nominal)|^2`` with ``c = OUTLIERS``.

Source: Bock, *Recent advances in parameter identification techniques for O.D.E.* (1983).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import robust_spread, trim_outliers
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.identifiable import Fitted, covariance
from hybrid_mpc.identify.output_fit import GROWN, OutputFit, Slopes
from hybrid_mpc.identify.prior_result import Combination
from hybrid_mpc.identify.windows import OutputWindows

Array = NDArray[np.float64]
ITERATIONS = 25
"""Maximum Gauss-Newton steps for one length of the windows."""
FIRST = 4
"""Maximum steps before outputs and outliers are weighted by their residuals."""
LOOSELY = 1e-2
"""Weight of an initial state's distance from its guess, over its size, with errors in spreads. It is small: a wrong
nominal prior gives poor guesses, and errors are far below the spread if the initial states fit."""
ROUNDING = 1e-12
"""Relative increase of the diagonal of the normal equations: initial states with equal effects stay solvable."""
STEEP = 1e8
"""Limit of a derivative, in spreads of the output per size of an initial state or parameter. Larger derivatives belong
to a diverging run and are ignored."""
OUTLIERS = 3.0
"""Residual, in robust standard deviations, above which the loss is linear instead of quadratic."""
COMMON = 0.7
"""Minimum of the robust standard deviation of an output's errors, over their root mean square without gross outliers.
So large errors during a part of the time, from a wrong prior, are no outliers."""
GROSS = 10.0
"""Residual, in robust standard deviations, above which a sample is left out at the end of a fit."""
FAR = 3.0
"""Limit of an error, in spreads of the data, in the comparison of candidates."""
LARGEST = 1e3
"""Limit of a residual, in spreads of the data, so that a diverging free run stays finite."""
COMPARED = 10
"""Maximum steps of the initial states alone, in the comparison of candidates."""
ALIKE = 1e-3
"""Relative decrease of a candidate's cost below which these steps end."""
DAMPING, WORST = 1e-3, 1e9
"""First damping, and the damping at which the iteration ends."""
CONVERGED = 0.01
"""Decrease of the cost over a window's mean cost below which a fit ends; further steps are far smaller than a standard
error."""
CLOSELY = 1e-4
"""The same at the end of a fit, because steps along a narrow valley are short."""
SETTLING, DIGITS, SAME = 12, 1e-9, 1e-9
"""Last steps of a fit: maximum number; change of a parameter, over its half range, below which they end; tolerated
relative increase of the cost by rounding."""
SHARES = 1.0, 0.5, 0.2, 0.05
"""Fractions of such a step; the first one that does not increase the cost is used."""


@dataclass(frozen=True)
class Trial:
    """Result of a short fit: the number of its start, ``theta``, and the error of the windows over the spread."""

    start: int
    theta: Array
    error: float


@dataclass(frozen=True)
class _Point:
    """Errors of the outputs at ``theta`` and initial states ``x`` ``(n, n_x)``, and their Jacobians.

    Args:
        theta: Parameters.
        x: Initial states ``(n, n_x)``.
        substeps: Runge-Kutta sub-steps a period.
        scale: Scale of each output's errors ``(n_y,)``.
        error: Errors ``(n, (T + 1) n_y)``; zero for missing samples.
        slopes: Derivatives ``(n, (T + 1) n_y, columns)`` by ``theta`` (if requested), then by ``x`` over its sizes.
        held: Weight of an initial state's squared distance from its guess, in sizes, with errors in scales.
        far: Errors beyond this many scales have a constant cost. Default: no limit.
    """

    theta: Array
    x: Array
    substeps: int
    scale: Array
    error: Array
    slopes: Array
    held: float
    far: float = math.inf

    @property
    def scales(self) -> Array:
        """Scale of each error of a window."""
        return np.tile(self.scale, self.error.shape[1] // len(self.scale))

    @property
    def robust(self) -> Array:
        """Robust cost of each error."""
        c2, over = OUTLIERS**2, np.minimum(np.abs(self.error / self.scales), self.far)
        return np.asarray(2 * c2 * (np.sqrt(1 + np.square(over) / c2) - 1))

    def where(self, better: NDArray[np.bool_], other: _Point) -> _Point:
        """Replace windows by those of ``other`` where ``better``."""
        own, new = ((p.x, p.error, p.slopes) for p in (self, other))
        x, error, slopes = (
            np.where(better.reshape(-1, *(1 for _ in v.shape[1:])), n, v)
            for v, n in zip(own, new, strict=True)
        )
        return replace(self, x=x, error=error, slopes=slopes)


class Shooting:
    """Windows of outputs as a least-squares problem over ``theta`` and the initial states.

    ``sizes`` ``(n_x,)`` are the natural sizes of the states: the standard deviations of the initial guesses.
    """

    def __init__(
        self, fit: OutputFit, windows: OutputWindows, sizes: Array, spread: Array | None = None
    ) -> None:
        self.own, self.windows, self.sizes = fit, windows, sizes
        y = windows.y
        self.seen = np.isfinite(y)
        own = [robust_spread(c) or 1.0 for c in y.reshape(-1, y.shape[-1]).T]
        self.spread = np.array(own) if spread is None else spread
        warm = np.repeat(np.arange(y.shape[1]) < windows.warm, y.shape[2]).astype(float)
        self.tell: Array = warm if windows.warm else 1.0 - warm
        self.count: Array = 1.0 - warm
        members = np.bincount(windows.group)
        self.members, self.alone = members[windows.group].astype(float), bool((members == 1).all())
        self._known: dict[bytes, tuple[float, Array]] = {}

    def explained(self, thetas: Sequence[Array]) -> list[float]:
        """Root mean square error of each ``theta`` over the windows, with the best initial states for it.

        Errors are in spreads of the outputs, each at most ``FAR``. Infinite if the prior is too stiff.
        """
        unknown: dict[int, list[Array]] = {}
        for theta in {one.tobytes(): one for one in thetas if one.tobytes() not in self._known}.values():
            try:
                unknown.setdefault(self.own.substeps(theta), []).append(theta)
            except InputError:
                self._known[theta.tobytes()] = math.inf, self.windows.x
        n = len(self.windows.x)
        share = max(1.0, float((self.seen.reshape(n, -1) * self.count).sum()))
        for some in unknown.values():  # all at once, because windows are independent
            problem = Shooting(self.own, self.windows.times(len(some)), self.sizes, self.spread)
            x = problem.windows.x
            for periods in self._growing(some):
                begun = Shooting(self.own, problem.windows.beginning(periods), self.sizes, self.spread)
                x = begun._states(begun.start(np.stack(some), x, "x")).x
            point = problem._states(problem.start(np.stack(some), x, "x"))
            over = self.relative(point, FAR)
            for i, theta in enumerate(some):
                part = slice(i * n, (i + 1) * n)
                error = float(np.sqrt(np.square(over[part]).sum() / share))
                self._known[theta.tobytes()] = error, point.x[part]
        return [self._known[theta.tobytes()][0] for theta in thetas]

    def relative(self, point: _Point, far: float) -> Array:
        """Counted errors ``(n, (T + 1) n_y)`` in spreads of the outputs, each at most ``far``."""
        spreads = np.tile(self.spread, self.windows.y.shape[1])
        return np.asarray(np.clip(point.error / spreads, -far, far) * self.count)

    def _growing(self, thetas: Sequence[Array]) -> list[int]:
        """Increasing lengths [periods] over which initial states are estimated before the whole windows.

        Empty unless small errors grow more than tenfold in a window. Each estimate is the start of the next. (Over a
        window that multiplies errors by 100, Gauss-Newton from a smoothed state of a wrong prior ends far away.)
        """
        periods = self.windows.y.shape[1] - 1
        tenfold = min(self.own.reach(theta, GROWN[0]) for theta in thetas) / self.own.dt
        if self.windows.warm or 0.8 * periods <= tenfold:
            return []
        return [int(own) for own in np.arange(max(tenfold, 4.0), periods, max(tenfold, 2.0))]

    def first_states(self, theta: Array) -> Array:
        """Best initial states ``(n, n_x)`` for ``theta``."""
        self.explained([theta])
        return self._known[theta.tobytes()][1]

    def solve(self, theta: Array, iterations: int = ITERATIONS, first: Array | None = None) -> Fitted:
        """Fit ``theta`` and the initial states; errors are scaled by the spreads first, then by the residuals.

        ``first`` ``(n, n_x)`` are the best initial states for ``theta``, if they are known.
        """
        theta = np.clip(theta, self.own.lower, self.own.upper)
        point = self.start(theta, self.first_states(theta) if first is None else first, "all")
        if len(theta):
            point = self._descend(point, min(iterations, FIRST))
            # maximum number of times that the scales are estimated again; outliers hide small residuals at first
            for k in range(4):
                rescaled = self._rescaled(point)
                # ratio of new to old scales below which they are estimated again
                if k and (rescaled.scale > 0.8 * point.scale).all():
                    break
                point = self._descend(rescaled, iterations)
            if (np.abs(point.error) > GROSS * point.scales).any():
                point = self._descend(replace(point, far=GROSS), iterations)
        return Fitted(point.theta, *self._covariance(point))

    def several(self, fit: OutputFit, thetas: Array, steps: int, free: int | None = None) -> list[Trial]:
        """Short fits from several ``thetas`` ``(m, k)`` in one batch of free runs.

        Args:
            fit: The fit of several ``thetas``, whose windows lie one after the other.
            thetas: Starts.
            steps: Pairs of Gauss-Newton steps; 0: only initial states are fitted.
            free: Number of fitted parameters, from the first one on. Default: all.
        """
        m, n = len(thetas), len(self.windows.x)
        damping = np.full(m, DAMPING)
        share = max(1.0, float((self.seen.reshape(n, -1) * self.count).sum()))
        problem = Shooting(fit, self.windows.times(m), self.sizes, self.spread)

        def parts(point: _Point) -> list[_Point]:
            rows = [slice(i * n, (i + 1) * n) for i in range(len(point.theta))]
            return [
                replace(point, theta=theta, x=point.x[r], error=point.error[r], slopes=point.slopes[r])
                for theta, r in zip(point.theta, rows, strict=True)
            ]

        begun = problem._states(problem.start(thetas, problem.windows.x, "x"))
        found = parts(problem._at(begun, thetas, begun.x, "all") if steps else begun)
        for _ in range(2 * steps):
            theta, x = [], []
            for one, damped in zip(found, damping, strict=True):
                xx, xt, tt, gx, gt = self._normal(one)
                normal = xx, xt[..., :free], tt[:free, :free], gx, gt[:free]
                step, moved, _ = self._step(normal, damped, one.theta[:free])
                further = one.theta + np.pad(step, (0, thetas.shape[1] - len(step)))
                theta.append(np.clip(further, self.own.lower, self.own.upper))
                x.append(one.x + moved[self.windows.group] * self.sizes)
            for k, trial in enumerate(parts(problem._at(begun, np.stack(theta), np.concatenate(x), "all"))):
                better = self._cost(trial) < self._cost(found[k])
                found[k] = trial if better else found[k]
                damping[k] *= 0.2 if better else 5.0
        errors = (math.sqrt(float(np.square(self.relative(one, FAR)).sum()) / share) for one in found)
        return [Trial(k, one.theta, e) for k, (one, e) in enumerate(zip(found, errors, strict=True))]

    def settled(self, theta: Array) -> Fitted:
        """Continue the fit to full convergence, so that the result depends neither on the start nor on rounding."""
        point = self.start(theta, self.first_states(theta), "all")
        for _ in range(2):
            point = self._descend(self._rescaled(point), ITERATIONS, CLOSELY)
        if (np.abs(point.error) > GROSS * point.scales).any():
            point = replace(point, far=GROSS)
        for _ in range(SETTLING):
            point = replace(point, scale=self._left(point.error))
            normal = self._behind(point) if self.windows.warm else self._normal(point)
            step, moved, _ = self._step(normal, 0.0, point.theta)
            for share in SHARES:
                trial = self._along(point, share * step, share * moved)
                if better := self._cost(trial) <= self._cost(point) * (1 + SAME):
                    break
            if not better:
                break
            far, point = np.abs(trial.theta - point.theta), trial
            if (far <= DIGITS * self.own.half).all():
                break
        return Fitted(point.theta, *self._covariance(point))

    def _along(self, point: _Point, step: Array, moved: Array) -> _Point:
        """The point after a step; its initial states are estimated again if the cost would increase."""
        theta = np.clip(point.theta + step, self.own.lower, self.own.upper)
        x = point.x + moved[self.windows.group] * self.sizes
        if self.windows.warm:
            x = self._states(self._at(point, theta, x, "x")).x
        trial, cost = self._at(point, theta, x, "all"), self._cost(point)
        if self._cost(trial) <= cost * (1 + SAME) or self.windows.warm:
            return trial
        own = self._followed(point, trial)
        return self._at(point, theta, own.x, "all") if self._cost(own) <= cost * (1 + SAME) else trial

    def forget(self) -> None:
        """Clear the cached initial states, which belong to other integration steps."""
        self._known.clear()

    def shift(self, theta: Array, substeps: int) -> Array:
        """Change of ``theta`` by a Gauss-Newton step if the outputs are computed with other ``substeps``."""
        point = self._rescaled(self.start(theta, self.first_states(theta), "all"))
        finer = self._at(replace(point, substeps=substeps), theta, point.x, "")
        moved = [
            self._step(self._behind(p) if self.windows.warm else self._normal(p), 0.0, theta)[0]
            for p in (point, replace(point, error=finer.error))
        ]
        return np.abs(moved[1] - moved[0])

    def start(self, theta: Array, x: Array, slopes: Slopes) -> _Point:
        """Point at ``theta`` and ``x``, with the outputs' spreads as scales."""
        nothing = np.zeros(0)
        substeps = self.own.most_substeps(np.atleast_2d(theta))
        empty = _Point(theta, x, substeps, self.spread, nothing, nothing, LOOSELY**2)
        return self._at(empty, theta, x, slopes)

    def linear(self, theta: Array, x: Array) -> tuple[Array, Array]:
        """Jacobian ``(n, m, k)`` and errors ``(n, m)`` at ``theta`` and ``x``, with the initial states eliminated.

        Both are over the errors' scales and times the root of the robust weights.
        """
        return self._eliminated(self._rescaled(self.start(theta, x, "all")))[:2]

    def scaled_slopes(self, theta: Array) -> tuple[Array, Array, Array]:
        """Slopes ``(n, m, k)`` by ``theta`` and errors ``(n, m)`` at ``theta`` with the best initial states eliminated,
        by the root of their robust weights [output units]; and the scale of each output's errors ``(n_y,)``.
        """
        point = self._rescaled(self.start(theta, self.first_states(theta), "all"))
        slopes, error, *_ = self._eliminated(point)
        unit = point.scales
        return slopes * unit[:, None], error * unit, point.scale

    def _at(self, before: _Point, theta: Array, x: Array, slopes: Slopes) -> _Point:
        """Evaluate the outputs at another point; other fields are those of ``before``."""
        windows, seen, n, limit = self.windows, self.seen, len(x), LARGEST * self.spread
        y, by = self.own.outputs(theta, x, windows, before.substeps, slopes)
        error = np.nan_to_num(y, nan=np.inf) - np.where(seen, windows.y, 0.0)
        beyond = np.where(windows.censored > 0, error > 0, error < 0)
        counts = seen & ~((windows.censored != 0) & beyond)
        inside = counts & (np.abs(error) < limit)
        error = np.where(counts, np.clip(error, -limit, limit), 0.0).reshape(n, -1)
        if slopes:
            with np.errstate(over="ignore", invalid="ignore"):
                by[..., -x.shape[1] :] *= np.where(self.windows.known, 0.0, self.sizes)[:, None, None]
                inside &= np.abs(by).max(axis=-1) < STEEP * self.spread  # not where it is NaN
            by[~inside] = 0.0
            by = by.reshape(n, error.shape[1], by.shape[-1])
        return replace(before, theta=theta, x=x, error=error, slopes=by)

    def _rescaled(self, point: _Point) -> _Point:
        """The point with the residuals' robust scales, and with the full weight of the initial states' guesses."""
        return replace(point, scale=self._left(point.error), held=1.0)

    def _costs(self, point: _Point) -> Array:
        """Robust cost of each group of windows for its initial state, with the distance from the guess."""
        moved = self._moved(point) / np.sqrt(self.members)[:, None]
        return self._grouped((point.robust * self.tell).sum(axis=1) + np.square(moved).sum(axis=1))

    def _cost(self, point: _Point) -> float:
        """Cost of ``theta``: sum over all windows; with a warm-up, over the samples after it; and the pull's cost."""
        pulled = float(np.square(self.own.pull * (point.theta - self.own.nominal)).sum())
        own = point.robust * self.count if self.windows.warm else self._costs(point)
        return float(own.sum()) + pulled

    def _moved(self, point: _Point) -> Array:
        """Distance of the initial states from their guess, in sizes, times the root of its weight."""
        return np.asarray(math.sqrt(point.held) * (point.x - self.windows.x) / self.sizes)

    def _grouped(self, values: Array) -> Array:
        """Sums over the windows of each group."""
        if self.alone:
            return values
        total = np.zeros((int(self.windows.group.max()) + 1, *values.shape[1:]))
        np.add.at(total, self.windows.group, values)
        return total

    def _left(self, error: Array) -> Array:
        """Robust scale ``(n_y,)`` of each output's residuals."""
        own = error.reshape(self.windows.y.shape)
        left = [np.abs(own[..., j][self.seen[..., j]]) for j in range(len(self.spread))]
        robust = np.array([1.4826 * float(np.median(v)) if len(v) else 0.0 for v in left])
        whole = np.array([float(np.sqrt(np.mean(trim_outliers(v) ** 2))) if len(v) else 0.0 for v in left])
        # frequent errors are due to the prior; they are not outliers
        return np.maximum(np.maximum(robust, COMMON * whole), 1e-9 * self.spread)

    def _states(self, point: _Point, steps: int = COMPARED) -> _Point:
        """Initial states for a given ``theta``: Levenberg-Marquardt steps in each group of windows."""
        cost, eye, group = self._costs(point), np.eye(point.x.shape[1]), self.windows.group
        damping, candidates = np.full((len(cost), 1, 1), DAMPING), len(np.atleast_2d(point.theta))
        for _ in range(steps):
            xx, _, _, gx, _ = self._normal(point)
            moved = -np.linalg.solve(xx * (1 + damping * eye), gx[..., None])[..., 0]
            trial = self._at(point, point.theta, point.x + moved[group] * self.sizes, "x")
            new = self._costs(trial)
            better, promised = new < cost, -2.0 * np.sum(gx * moved, axis=1)
            gain = np.where(better, cost - new, np.where(damping[:, 0, 0] < WORST, promised, 0.0))
            point = point.where(better[group], trial)
            cost = np.minimum(cost, new)
            damping = damping * np.where(better, 0.2, 5.0)[:, None, None]
            gains, costs = (v.reshape(candidates, -1).sum(axis=1) for v in (gain, cost))
            if (gains <= ALIKE * costs).all():
                break
        return point

    def _followed(self, point: _Point, trial: _Point) -> _Point:
        """Estimate the trial's initial states again, in each window from the better one of the trial and the point."""
        moved = replace(trial, slopes=trial.slopes[..., -trial.x.shape[1] :])
        still = self._at(point, trial.theta, point.x, "x")
        better = self._costs(still) < self._costs(moved)
        # maximum steps of the initial states for a new ``theta`` that would be rejected without them
        return self._states(moved.where(better[self.windows.group], still), 4)

    def _descend(self, point: _Point, iterations: int, enough: float = CONVERGED) -> _Point:
        """Levenberg-Marquardt steps of ``theta`` and initial states.

        They end when a step reduces the cost by less than ``enough`` times a window's mean cost.
        """
        damping, cost, n = DAMPING, self._cost(point), len(point.x)
        for _ in range(iterations):
            better = followed = False
            normal = self._behind(point) if self.windows.warm else self._normal(point)
            while not better and damping < WORST:
                step, moved, promised = self._step(normal, damping, point.theta)
                last = promised < enough * cost / n
                theta = np.clip(point.theta + step, self.own.lower, self.own.upper)
                x = point.x + moved[self.windows.group] * self.sizes
                if self.windows.warm:  # the warm-up determines the initial states for every theta
                    x = self._states(self._at(point, theta, x, "x")).x
                trial = self._at(point, theta, x, "all")
                new = self._cost(trial)
                if not (new < cost or last or followed or self.windows.warm):
                    followed = True  # initial states may not fit the new theta yet
                    own = self._followed(point, trial)
                    if self._cost(own) < cost:
                        trial = self._at(point, theta, own.x, "all")
                        new = self._cost(trial)
                better = new < cost
                damping *= 0.2 if better else 5.0
                if last:
                    break
            if not better:
                break
            gain, point, cost = cost - new, trial, new
            if last or gain < enough * cost / n:
                break
        return point

    def _weighted(self, point: _Point) -> Array:
        """Jacobian and (last column) errors, over the scales and times the root of the robust weights.

        The weight of a residual r is ``1 / sqrt(1 + (r / OUTLIERS)^2)``, and 0 beyond ``far``.
        """
        error = point.error / point.scales
        root = np.where(np.abs(error) < point.far, (1 + np.square(error / OUTLIERS)) ** -0.25, 0.0)
        slopes = point.slopes * (root / point.scales)[..., None]
        return np.concatenate([slopes, (root * error)[..., None]], axis=-1)

    def _normal(self, point: _Point) -> tuple[Array, ...]:
        """Blocks of the normal equations: ``xx`` and ``xt`` by group, ``tt``, and the gradients."""
        rows, n_x = self._weighted(point) * np.sqrt(self.tell)[:, None], point.x.shape[1]
        every = rows.swapaxes(1, 2) @ rows
        t, x = slice(0, -1 - n_x), slice(-1 - n_x, -1)
        moved, n = self._moved(point) / self.members[:, None], rows.shape[-1] - 1 - n_x
        moved = math.sqrt(point.held) * moved
        pull, from_nominal = self._pull(point, n)
        return (
            _regular(self._grouped(every[:, x, x]), point.held), self._grouped(every[:, x, t]),
            every[:, t, t].sum(axis=0) + pull, self._grouped(every[:, x, -1] + moved),
            every[:, t, -1].sum(axis=0) + from_nominal,
        )  # fmt: skip

    def _pull(self, point: _Point, n: int) -> tuple[Array, Array]:
        """Part of the normal matrix and of the gradient that pulls ``theta`` towards the nominal values."""
        if not n:  # initial states alone
            return np.zeros((0, 0)), np.zeros(0)
        weights = np.square(self.own.pull)
        return np.diag(weights), weights * (point.theta - self.own.nominal)

    def _eliminated(self, point: _Point) -> tuple[Array, Array, Array, float]:
        """Jacobian of the counted errors with respect to ``theta``, and these errors, with initial states eliminated.

        Returns:
            Jacobian, errors, derivative of the initial states by ``theta`` (last column: their Gauss-Newton step), and
            the degrees of freedom of the initial states.
        """
        rows, n_x = self._weighted(point), point.x.shape[1]
        b, a, error = rows[..., : -1 - n_x], rows[..., -1 - n_x : -1], rows[..., -1:]
        at = (a * self.tell[:, None]).swapaxes(1, 2)
        xx = _regular(self._grouped(at @ a), point.held)
        follow = np.linalg.solve(xx, self._grouped(at @ np.concatenate([b, error], axis=-1)))
        left = np.concatenate([b, error], axis=-1) - a @ follow[self.windows.group]
        left *= self.count[:, None]
        taken = (
            0.0
            if self.windows.warm
            else float(np.trace(np.eye(n_x) - point.held * np.linalg.inv(xx), axis1=1, axis2=2).sum())
        )
        return left[..., :-1], left[..., -1], np.asarray(follow, dtype=np.float64), taken

    def _behind(self, point: _Point) -> tuple[Array, ...]:
        """As :meth:`_normal`, for the samples after the warm-up; the warm-up alone determines the initial states."""
        b, error, follow, _ = self._eliminated(point)
        n_x = point.x.shape[1]
        pull, from_nominal = self._pull(point, b.shape[-1])
        return (
            np.broadcast_to(np.eye(n_x), (len(follow), n_x, n_x)), follow[..., :-1],
            (b.swapaxes(1, 2) @ b).sum(axis=0) + pull, follow[..., -1],
            (b.swapaxes(1, 2) @ error[..., None])[..., 0].sum(axis=0) + from_nominal,
        )  # fmt: skip

    def _step(self, normal: tuple[Array, ...], damping: float, theta: Array) -> tuple[Array, Array, float]:
        """Step of ``theta`` within its bounds, step of the initial states by group, and first-order cost decrease.

        The Schur complement eliminates x: ``(tt - tx xx^-1 xt) dtheta = -(gt - tx xx^-1 gx)``.
        """
        xx, xt, tt, gx, gt = normal
        reduced, slope = tt, gt
        if not self.windows.warm:
            xx = xx * (1 + damping * np.eye(xx.shape[-1]))
        solved = np.linalg.solve(xx, np.concatenate([xt, gx[..., None]], axis=-1))
        by_theta, own = solved[..., :-1], solved[..., -1]
        if not self.windows.warm:
            reduced = tt - (xt.swapaxes(1, 2) @ by_theta).sum(axis=0)
            slope = gt - (xt.swapaxes(1, 2) @ own[..., None])[..., 0].sum(axis=0)
        step = bounded_step(
            reduced + damping * np.diag(np.maximum(np.diag(tt), 1e-30)), slope,
            self.own.lower[: len(theta)] - theta, self.own.upper[: len(theta)] - theta,
        )  # fmt: skip
        moved = -own - (by_theta @ step[:, None])[..., 0]
        of_states = 0.0 if self.windows.warm else float(np.sum(gx * moved))
        return step, moved, -2.0 * (float(gt @ step) + of_states)

    def _covariance(self, point: _Point) -> tuple[Array, tuple[Combination, ...]]:
        """Covariance of ``theta``, and the combinations that are not identifiable."""
        slopes, error, _, taken = self._eliminated(point)
        falling = 1.0 / (1.0 + np.square(point.error / point.scales / OUTLIERS))  # psi'(r) over psi(r) / r
        counted = float((self.seen.reshape(len(slopes), -1) * self.count).sum())
        return covariance(self.own, point.theta, slopes, error, falling, counted, taken, len(self.spread))


def bounded_step(matrix: Array, slope: Array, low: Array, high: Array) -> Array:
    """Step ``s`` ``(n,)`` that reduces ``s' matrix s / 2 + slope' s`` within ``low <= 0`` and ``high >= 0``.

    Of the components that would leave their bounds, the first one to reach its bound is fixed there, and the others are
    solved again. (Fixing all of them at once could stop two components along a valley in a corner.) A fixed component
    is not released again.
    """
    step, free = np.zeros(len(slope)), np.arange(len(slope))
    held = np.zeros(len(slope), dtype=bool)
    for _ in range(len(slope)):
        free = np.flatnonzero(~held)
        right = slope[free] + matrix[np.ix_(free, np.flatnonzero(held))] @ step[held]
        step[free] = -np.linalg.lstsq(matrix[np.ix_(free, free)], right, rcond=1e-14)[0]
        ends = np.clip(step, low, high)
        beyond = free[ends[free] != step[free]]
        if not len(beyond):
            break
        first = beyond[np.lexsort((-np.abs(step - ends)[beyond], (ends[beyond] / step[beyond])))[0]]
        held[first], step[first] = True, ends[first]
    return step


def _regular(xx: Array, held: float) -> Array:
    """Normal matrices of initial states ``(n, n_x, n_x)`` with the weight ``held`` of the distance from their guess."""
    eye = np.eye(xx.shape[-1])
    return np.asarray(xx * (1.0 + ROUNDING * eye) + held * eye)
