"""Fit of a prior to measured outputs: multiple shooting with free first states, exact derivatives, a robust loss.

Recordings are cut into windows. The state at the start of each is an unknown that is eliminated from every
Gauss-Newton step, so that no measured state is taken for exact and states that no sensor sees need no measurement.
All windows and all directions are one batch of array operations (:mod:`~hybrid_mpc.identify.simulation`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import evenly, robust_spread, within
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.delay import NONE, shifted
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.simulation import Simulation, required_substeps
from hybrid_mpc.identify.smooth import Smoother, fit_smoother, sizes_of, unseen_states
from hybrid_mpc.machine.prior import Equations, Prior

Array = NDArray[np.float64]
LENGTHS = (0.5, 2.0, 5.0)
"""Lengths of the windows [the machine's seconds, :func:`~hybrid_mpc.data.scales.time_unit`], one after the other: short
ones have one optimum, long ones are what counts."""
WINDOWS = 48
"""Windows of a length at most, evenly chosen."""
ITERATIONS = 25
"""Gauss-Newton steps of a length at most."""
FIRST = 4
"""Steps at most before outputs and outliers are weighed by what is left of them."""
STARTS = 6
"""Starts between the bounds that are tried over the shortest windows, beside the nominal values."""
START_ITERATIONS = 6
"""Gauss-Newton steps from each start before the best is taken on."""
OUTLIERS = 3.0
"""Residuals beyond this many robust standard deviations count by their size, not by its square."""
SCALINGS = 4
"""Times at most that outputs are weighed by what is left of them: outliers hide how little that is."""
SETTLED = 0.8
"""Share to which what is left must fall for another time."""
FAR = 3.0
"""Errors beyond this many spreads of the data are as bad as this one where candidates are compared."""
LARGEST = 1e3
"""Residuals beyond this many spreads of the data count as much: a free run that diverges stays finite."""
CONVERGED = 0.01
"""A step that takes off less than this share of a window's mean cost is the last of a fit: what would come after it is
far less than a standard error."""
AT_BOUND = 1e-3
"""Share of its range within which a parameter counts as at its bound."""
UNKNOWN = 1e-6
"""Ratio of singular values below which a combination of parameters is not identified."""
Progress = Callable[[int, int, str], None]
Slopes: TypeAlias = Literal["", "x", "all"]
"""Which derivatives are asked for: none, by the first states, by the parameters too."""


@dataclass(frozen=True)
class OutputWindows:
    """Windows of recordings: ``y`` ``(n, T + 1, n_y)`` with NaN where nothing was measured, ``u`` ``(n, lead + T + 1,
    n_u)``, of which the first ``lead`` come before the window, ``w`` ``(n, T + 1, n_w)``, a guess ``x`` ``(n, n_x)`` of
    the first state, and which samples are censored ``(n, T + 1, n_y)``.
    """

    y: Array
    u: Array
    w: Array
    x: Array
    censored: Array
    lead: int

    @property
    def periods(self) -> int:
        """Periods T of a window."""
        return self.y.shape[1] - 1


def cut_outputs(trajectories: Sequence[Trajectory], periods: int, lead: int, most: int) -> OutputWindows:
    """At most ``most`` windows of ``periods``, one behind the other, evenly chosen.

    Raises:
        InputError: If no trajectory is long enough.
    """
    starts = [(t, k) for t in trajectories for k in range(lead, len(t.t) - periods, periods)]
    if not starts:
        longest = max((len(t.t) for t in trajectories), default=0)
        raise InputError(
            f"no recording is long enough: the longest has {longest} samples, a free run of {periods} periods with "
            f"{lead} samples before it needs {periods + lead + 1}"
        )
    chosen = [starts[i] for i in evenly(len(starts), most)]

    def cut(key: str, before: int) -> Array:
        return np.stack([getattr(t, key)[k - before : k + periods + 1] for t, k in chosen])

    censored = [getattr(t, "censored", np.zeros(t.y.shape)) for t, _ in chosen]
    return OutputWindows(
        cut("y", 0), cut("u", lead), cut("w", 0), np.stack([t.x[k] for t, k in chosen]),
        np.stack([c[k : k + periods + 1] for c, (_, k) in zip(censored, chosen, strict=True)]), lead,
    )  # fmt: skip


class OutputFit:
    """A prior's free parameters and its input's delay ``theta``, each over its size, and their fit to windows.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        dt: Model period [s].
        largest_delay: Longest delay [s] of the inputs. Default 0: it is not fitted.
    """

    def __init__(self, make: Callable[..., Prior], dt: float, largest_delay: float = 0.0) -> None:
        self.make, self.prior, self.dt, self.largest = make, make(), dt, largest_delay
        self.free = [p for p in self.prior.parameters if not p.fixed]
        late = [dt] if largest_delay else []
        own = [abs(p.value) if p.value else (p.upper - p.lower) for p in self.free]
        self.unit = np.array([*own, *late])
        self._simulations: dict[tuple[int, ...], Simulation] = {}
        self.nominal = (
            np.array([*(p.value for p in self.free), *(0.5 * largest_delay for _ in late)]) / self.unit
        )
        self.lower = np.array([*(p.lower for p in self.free), *(0.0 for _ in late)]) / self.unit
        self.upper = np.array([*(p.upper for p in self.free), *(largest_delay for _ in late)]) / self.unit

    @property
    def names(self) -> list[str]:
        """Names of what is fitted."""
        return [*(p.name for p in self.free), *(["delay"] if self.largest else [])]

    @property
    def lead(self) -> int:
        """Samples before a window that its delayed inputs may need."""
        return math.ceil(self.largest / self.dt) + 1 if self.largest else 0

    def values(self, theta: Array) -> dict[str, float]:
        """Values [their units] of all parameters by name, fixed ones included."""
        fitted = {p.name: float(v) for p, v in zip(self.free, theta * self.unit, strict=False)}
        return {**self.prior.values, **fitted}

    def scaled(self, values: Mapping[str, float], delay: float = 0.0) -> Array:
        """Values [their units] by name, and the delay [s], as ``theta``."""
        own = [values[p.name] for p in self.free]
        return np.array([*own, *([delay] if self.largest else [])]) / self.unit

    def delay(self, theta: Array) -> float:
        """Delay [s]; none where it is too short to count."""
        found = float(theta[-1] * self.unit[-1]) if self.largest else 0.0
        return found if found >= NONE * self.dt else 0.0

    def substeps(self, theta: Array) -> int:
        """Sub-steps a period that the stiffness at ``theta`` asks for."""
        return required_substeps(self.make(self.values(theta)), self.dt)

    def outputs(
        self, theta: Array, x: Array, windows: OutputWindows, substeps: int, slopes: Slopes
    ) -> tuple[Array, Array, Array]:
        """Outputs ``(n, T + 1, n_y)`` of free runs from ``x``, and their derivatives by ``theta`` and ``x``.

        Derivatives by ``theta`` have no columns if only those by ``x`` are asked for; there are none without slopes.
        """
        n, periods = len(x), windows.periods
        p = np.append(self._parameters(theta), 0.0)  # the last is a small change of the delay
        u, w = self._acting(theta, windows), windows.w
        free = self._free if slopes == "all" else []
        simulation = self._simulation(tuple(free))
        given = x, u[:, :periods], w[:, :periods], p, substeps
        states, by_p, by_x = simulation.by_all(*given) if slopes else (simulation.states(*given), None, None)
        held = (v.reshape(n * (periods + 1), -1).T for v in (states, u, w))
        count = n * (periods + 1)
        y, c, d = (
            v.full().reshape(v.shape[0], count, -1).swapaxes(0, 1)
            for v in _outputs(self.prior.equations, count)(*held, p[:-1])
        )
        y = y.reshape(n, periods + 1, -1)
        if by_p is None or by_x is None:
            return y, np.zeros(0), np.zeros(0)
        c, d = (v.reshape(n, periods + 1, y.shape[-1], -1) for v in (c, d))
        d = d[..., free]
        return y, (c @ by_p + d) * self.unit[: len(free)], c @ by_x

    @cached_property
    def _free(self) -> list[int]:
        """Places in ``p``, with the delay behind the parameters, of what is fitted."""
        every = [*(p.name for p in self.prior.parameters), "delay"]
        return [every.index(name) for name in self.names]

    def _simulation(self, free: tuple[int, ...]) -> Simulation:
        if free not in self._simulations:
            self._simulations[free] = Simulation(_delayed(self.prior.equations.xdot), self.dt, free)
        return self._simulations[free]

    def _parameters(self, theta: Array) -> Array:
        return np.array(list(self.values(theta).values()))

    def _acting(self, theta: Array, windows: OutputWindows) -> Array:
        """Inputs ``(n, T + 1, 2 n_u)`` that act, means over each period, and their derivative by the delay."""
        n, first = windows.y.shape[1], windows.lead
        if not self.largest:
            u = windows.u[:, first : first + n]
            return np.concatenate([u, np.zeros_like(u)], axis=-1)
        delay = float(theta[-1] * self.unit[-1]) / self.dt
        whole = min(math.floor(delay), first - 1)
        younger, older = (windows.u[:, first - whole - k : first - whole - k + n] for k in (0, 1))
        share = delay - whole
        return np.concatenate([(1 - share) * younger + share * older, (older - younger) / self.dt], axis=-1)

    def fit(
        self, theta: Array, windows: OutputWindows, sizes: Array, iterations: int, *, fixed: bool = False
    ) -> Fitted:
        """Fit ``theta`` and the first states to windows, by Levenberg-Marquardt with the states eliminated.

        ``sizes`` ``(n_x,)`` are the states' natural ones: the first states keep to their guess as if it were known to
        that. ``fixed`` fits the first states alone.
        """
        problem = _Shooting(self, windows, sizes, self.substeps(np.clip(theta, self.lower, self.upper)))
        return problem.solve(np.clip(theta, self.lower, self.upper), iterations, fixed)


@dataclass(frozen=True)
class Fitted:
    """What a fit to windows found: ``theta`` with its covariance, and names of what the windows do not identify.

    ``error`` is the root mean square of the outputs' errors, each over its spread and at most ``FAR``.
    """

    theta: Array
    covariance: Array
    unidentified: tuple[str, ...]
    error: float = math.nan


class _Shooting:
    """Windows of outputs as a least-squares problem over ``theta`` and the first states."""

    def __init__(self, fit: OutputFit, windows: OutputWindows, sizes: Array, substeps: int) -> None:
        self.own, self.windows, self.sizes, self.substeps = fit, windows, sizes, substeps
        y = windows.y
        self.seen = np.isfinite(y)
        self.spread = np.array([robust_spread(c) or 1.0 for c in y.reshape(-1, y.shape[-1]).T])
        self.scale = self.spread

    def residual(self, theta: Array, x: Array, slopes: Slopes) -> tuple[Array, Array, Array]:
        """Errors ``(n, (T + 1) n_y)`` over their scale, zero where nothing was measured; their derivatives."""
        windows, n = self.windows, len(x)
        y, by_theta, by_x = self.own.outputs(theta, x, windows, self.substeps, slopes)
        error = np.nan_to_num(y, nan=np.inf) - np.where(self.seen, windows.y, 0.0)
        beyond = (windows.censored != 0) & (windows.censored * error > 0)
        error, counts = error / self.scale, self.seen & ~beyond
        inside = counts & (np.abs(error) < LARGEST * self.spread / self.scale)
        limit = LARGEST * self.spread / self.scale
        error = np.where(counts, np.clip(error, -limit, limit), 0.0).reshape(n, -1)
        if not slopes:
            return error, by_theta, by_x
        by_theta, by_x = (
            np.where(inside[..., None], v / self.scale[:, None], 0.0).reshape(n, error.shape[1], -1)
            for v in (by_theta, by_x)
        )
        return error, np.nan_to_num(by_theta), np.nan_to_num(by_x * self.sizes)

    def cost(self, error: Array, moved: Array) -> float:
        """Robust sum of squares, and what the first states moved from their guess, in their sizes."""
        c2 = OUTLIERS**2
        own = 2 * c2 * (np.sqrt(1 + np.square(error) / c2) - 1)
        return float(own.sum() + np.square(moved).sum())

    def rescaled(self, error: Array) -> None:
        """Scale each output by what is left of it, robustly: outputs of any unit count alike, outliers little."""
        shape = self.windows.y.shape
        own = error.reshape(shape) * self.scale
        left = [np.abs(own[..., j][self.seen[..., j]]) for j in range(shape[-1])]
        robust = np.array([1.4826 * float(np.median(v)) if len(v) else 0.0 for v in left])
        whole = np.array([float(np.sqrt(np.mean(within(v) ** 2))) if len(v) else 0.0 for v in left])
        robust = np.maximum(robust, 0.1 * whole)  # where most samples are met exactly, the rest is no outlier
        self.scale = np.maximum(robust, 1e-9 * self.spread)

    def solve(self, theta: Array, iterations: int, fixed: bool) -> Fitted:
        """Fit the first states alone, then ``theta`` with them: by the spreads, then by what is left."""
        n_theta = 0 if fixed else len(theta)
        theta, x = self._descend(theta, self.windows.x, 0, iterations if fixed else FIRST)
        if n_theta:
            theta, x = self._descend(theta, x, n_theta, min(iterations, FIRST))
        for k in range(SCALINGS):
            before = self.scale
            self.rescaled(self.residual(theta, x, "")[0])
            if k and (self.scale > SETTLED * before).all():
                break
            theta, x = self._descend(theta, x, n_theta, iterations)
        error, by_theta, by_x = self.residual(theta, x, "all" if n_theta else "x")
        covariance, unidentified = self._covariance(error, by_theta[..., :n_theta], by_x)
        count = max(1, int(self.seen.sum()))
        over = np.clip(error.reshape(self.windows.y.shape) * self.scale / self.spread, -FAR, FAR)
        return Fitted(theta, covariance, unidentified, float(np.sqrt(np.square(over).sum() / count)))

    def _descend(self, theta: Array, x: Array, n_theta: int, iterations: int) -> tuple[Array, Array]:
        """Steps of Levenberg and Marquardt, of the first states and of ``theta`` where ``n_theta`` is not 0."""
        slopes: Slopes = "all" if n_theta else "x"
        guess, damping = self.windows.x, 1e-3
        error, by_theta, by_x = self.residual(theta, x, slopes)
        cost = self.cost(error, (x - guess) / self.sizes)
        for _ in range(iterations):
            normal = self._normal(error, by_theta[..., :n_theta], by_x, (x - guess) / self.sizes)
            better, last = False, False
            for _ in range(6):
                step, moved = self._step(normal, damping, theta, n_theta)
                last = self._promised(normal, step[:n_theta], moved) < CONVERGED * cost / len(x)
                trial = np.clip(theta + step, self.own.lower, self.own.upper)
                x_trial = x + moved * self.sizes
                tried, _, _ = self.residual(trial, x_trial, "")
                new = self.cost(tried, (x_trial - guess) / self.sizes)
                if new < cost:
                    better = True
                    damping = max(damping / 5, 1e-9)
                    break
                if last:
                    break
                damping = min(damping * 5, 1e9)
            if not better:
                break
            gain, theta, x, cost = cost - new, trial, x_trial, new
            if last or gain < CONVERGED * cost / len(x):
                break
            error, by_theta, by_x = self.residual(theta, x, slopes)
        return theta, x

    def _weighted(self, error: Array, *slopes: Array) -> tuple[Array, ...]:
        root = (1 + np.square(error / OUTLIERS)) ** -0.25
        return root * error, *(root[..., None] * s for s in slopes)

    def _normal(self, error: Array, by_theta: Array, by_x: Array, moved: Array) -> tuple[Array, ...]:
        """Blocks of the normal equations, window by window."""
        error, b, a = self._weighted(error, by_theta, by_x)
        at, bt = a.swapaxes(1, 2), b.swapaxes(1, 2)
        eye = np.eye(a.shape[-1])
        return (
            at @ a + eye, at @ b, bt @ b,
            (at @ error[..., None])[..., 0] + moved, (bt @ error[..., None])[..., 0],
        )  # fmt: skip

    @staticmethod
    def _promised(normal: tuple[Array, ...], step: Array, moved: Array) -> float:
        """How far a step takes the cost down to first order."""
        _, _, _, gx, gt = normal
        return -2.0 * float(gt.sum(0) @ step + np.sum(gx * moved))

    def _step(
        self, normal: tuple[Array, ...], damping: float, theta: Array, n_theta: int
    ) -> tuple[Array, Array]:
        """Step of ``theta``, of which those at a bound that would leave it rest, and of the first states."""
        xx, xt, tt, gx, gt = normal
        xx = xx * (1 + damping * np.eye(xx.shape[-1]))
        solved = np.linalg.solve(xx, np.concatenate([xt, gx[..., None]], axis=-1))
        by_theta, own = solved[..., :-1], solved[..., -1]
        reduced = (tt - xt.swapaxes(1, 2) @ by_theta).sum(0)
        slope = (gt - (xt.swapaxes(1, 2) @ own[..., None])[..., 0]).sum(0)
        step, free = np.zeros(len(theta)), np.arange(n_theta)
        reduced = reduced + damping * np.diag(np.maximum(np.diag(tt.sum(0)), 1e-30))
        for _ in range(n_theta + 1):
            step[:n_theta] = 0.0
            if len(free):
                step[free] = -np.linalg.lstsq(reduced[np.ix_(free, free)], slope[free], rcond=1e-14)[0]
            low = (theta[free] <= self.own.lower[free]) & (step[free] < 0)
            high = (theta[free] >= self.own.upper[free]) & (step[free] > 0)
            if not (low | high).any():
                break
            free = free[~(low | high)]
        return step, -own - (by_theta @ step[:n_theta, None])[..., 0]

    def _covariance(self, error: Array, by_theta: Array, by_x: Array) -> tuple[Array, tuple[str, ...]]:
        """Covariance of ``theta``, from the scatter of the windows' slopes: errors within one are no white noise.

        Source: Liang and Zeger, *Longitudinal data analysis using generalized linear models* (1986), of clusters.
        """
        root = (1 + np.square(error / OUTLIERS)) ** -0.25
        error, b, a = self._weighted(error, by_theta, by_x)
        at = a.swapaxes(1, 2)
        known = np.linalg.solve(
            at @ a + np.eye(a.shape[-1]), at @ np.concatenate([b, error[..., None]], axis=-1)
        )
        b, error = b - a @ known[..., :-1], error - (a @ known[..., -1:])[..., 0]
        information = (b.swapaxes(1, 2) @ b).sum(0)
        told = np.flatnonzero(np.diag(information) > 0)  # of the others the outputs say nothing at all
        unknown = set(range(len(information))) - set(told.tolist())
        covariance = np.full(information.shape, math.nan)
        if len(told):
            information, b = information[np.ix_(told, told)], b[..., told]
            size = np.sqrt(np.diag(information))
            values, directions = np.linalg.eigh(information / np.outer(size, size))
            weak = np.abs(directions[:, values < UNKNOWN * values[-1]]) > 0.2
            unknown |= set(told[weak.any(axis=1)].tolist())
            inverse = (
                directions / np.maximum(values, 1e-12 * values[-1]) @ directions.T / np.outer(size, size)
            )
            scores = (b.swapaxes(1, 2) @ error[..., None])[..., 0]
            n = len(scores)
            if n >= 2 * scores.shape[1]:  # fewer windows tell nothing of their scatter
                middle = n / (n - 1) * scores.T @ scores
            else:
                middle = information * float(np.mean(np.square(root * error)))
            covariance[np.ix_(told, told)] = inverse @ middle @ inverse
        return covariance, tuple(self.own.names[i] for i in sorted(unknown))


def fit_prior(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    length: float | None = None,
    largest_delay: float = 0.0,
    start: Mapping[str, float] | None = None,
    time_unit: float | None = None,
    on_progress: Progress = lambda done, total, text: None,
) -> PriorFit:
    """Fit parameters and delay to the measured outputs over longer and longer windows, and find what smooths states.

    Each length starts from what the one before found, the first from the best of several starts between the bounds. Of
    the nominal values and all lengths the one wins that explains the windows of the longest length best, over training
    and validation recordings together: few parameters do not overfit, and where a machine drifts a short validation
    part alone misleads. A prior without free parameters stays as it is.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (chosen by, not fitted to).
        dt: Model period [s].
        length: Length [s] of the longest windows: that of the runs that the model will be judged by. Default: 5 of the
            machine's seconds.
        largest_delay: Longest delay [s] of the inputs. Default 0: they act at once.
        start: Values [their units] by name to try as a start besides the nominal ones, e.g. those of a global search;
            fixed parameters are left out. Default: none.
        time_unit: The machine's second [s]. Default: that of the training trajectories.
        on_progress: ``(done, total, text)`` after every stage.

    Raises:
        InputError: If a state is seen by no output, no trajectory is long enough, or the prior diverges with all
            parameters tried.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> runs = exact_runs("train", 1)
        >>> fit = fit_prior(PendulumPrior, runs, runs, dt=0.01)
        >>> round(fit.values["l"], 3)
        0.045

    Source: Bock, *Recent advances in parameter identification techniques for O.D.E.* (1983).
    """
    fit = OutputFit(make, dt, largest_delay)
    unit = scales.time_unit(train, dt) if time_unit is None else time_unit
    check_observable(fit.prior, dt, unit)
    if _longest(train) < fit.lead + 3:
        raise InputError(
            f"no recording is long enough to fit {type(fit.prior).__name__} to: the longest has {_longest(train)} "
            f"samples, {fit.lead + 3} are needed at least"
        )
    lengths = _lengths(train, dt, unit, length, fit.lead)
    total = len(lengths) + 2
    on_progress(0, total, "smoothing by the nominal prior")
    sizes = np.array(sizes_of(fit.prior, shifted(train, fit.delay(fit.nominal)), dt, unit).x)
    guesses = _guesses(fit, fit.nominal, (train, valid), unit)
    found: list[tuple[str, Fitted]] = []
    theta = fit.nominal
    if len(theta):
        on_progress(1, total, "several starts")
        theta = _best_start(fit, guesses[0], lengths[0], sizes, start)
        guesses = _guesses(fit, theta, (train, valid), unit)
        for i, periods in enumerate(lengths):
            on_progress(2 + i, total, f"free runs of {periods * dt:.3g} s")
            windows = cut_outputs(guesses[0], periods, fit.lead, WINDOWS)
            result = fit.fit(theta, windows, sizes, ITERATIONS)
            theta = result.theta
            found.append((f"free runs of {periods * dt:.3g} s", result))
    scored = [
        cut_outputs(part, lengths[-1], fit.lead, WINDOWS)
        for part in guesses
        if _longest(part) > lengths[-1] + fit.lead
    ]
    candidates = [("nominal", Fitted(fit.nominal, np.zeros((0, 0)), ())), *found]
    scores = [_error(fit, c.theta, scored, sizes) for _, c in candidates]
    if min(scores) > 0.9 * FAR:  # four fifths of all samples are as far off as can be
        raise InputError("the prior diverges with every set of parameters tried; check its signs and units")
    best = int(np.argmin(scores))
    chosen = candidates[best][1]
    on_progress(total - 1, total, "smoothing by the fitted prior")
    fitted, delay = make(fit.values(chosen.theta)), fit.delay(chosen.theta)
    smoother = fit_smoother(fitted, shifted([*train, *valid], delay), dt, time_unit=unit)
    stages = tuple({"stage": c[0], "validation_error": s} for c, s in zip(candidates, scores, strict=True))
    on_progress(total, total, "done")
    return PriorFit(
        fit.values(chosen.theta), _errors(fit, chosen), _warnings(fit, chosen), stages, _correlations(fit, chosen),
        delay, smoother.sigma, smoother.walk, smoother.sizes,
    )  # fmt: skip


def refit(
    make: Callable[..., Prior],
    fit: PriorFit,
    trajectories: Sequence[Trajectory],
    *,
    dt: float,
    lengths: Sequence[float],
) -> PriorFit:
    """Parameters fitted anew to recordings of a machine that has changed, from those of an earlier fit on.

    The delay and what smooths states stay. ``lengths`` [s] are those of the windows, one after the other.
    """
    known = smoothed(make, fit, trajectories, dt)
    own, sizes, stages = OutputFit(make, dt), np.array(fit.smoother(make(fit.values), dt).sizes.x), []
    found = Fitted(own.scaled(fit.values), np.zeros((0, 0)), ())
    for length in lengths:
        windows = cut_outputs(known, scales.periods(length, dt, 2), 0, WINDOWS)
        found = own.fit(found.theta, windows, sizes, ITERATIONS)
        stages.append({"stage": f"free runs of {length:g} s", "validation_error": found.error})
    return replace(
        fit, values=own.values(found.theta), standard_errors=_errors(own, found), warnings=_warnings(own, found),
        stages=tuple(stages), correlations=_correlations(own, found),
    )  # fmt: skip


def smoothed(
    make: Callable[..., Prior], fit: PriorFit, trajectories: Sequence[Trajectory], dt: float
) -> list[Trajectory]:
    """Trajectories with the inputs that act and the states that the fitted prior smooths: what networks train on."""
    return fit.smoother(make(fit.values), dt).smooth(shifted(trajectories, fit.delay))


def check_observable(prior: Prior, dt: float, time_unit: float) -> None:
    """Refuse a prior with states that no output tells of.

    Raises:
        InputError: Naming the states.
    """
    unseen = unseen_states(prior, dt, time_unit)
    if unseen:
        raise InputError(
            f"{type(prior).__name__}: no output tells of {', '.join(unseen)} (outputs: "
            f"{', '.join(s.name for s in prior.outputs)}): nothing that is measured changes with "
            f"{'them' if len(unseen) > 1 else 'it'}. Measure it, leave it out of the states, or check output()"
        )


def with_states(trajectories: Sequence[Trajectory], smoother: Smoother, delay: float) -> list[Trajectory]:
    """Trajectories with smoothed states but the inputs as they were commanded, without the samples a delay costs."""
    made = []
    for t, s in zip(trajectories, smoother.smooth(shifted(trajectories, delay)), strict=True):
        made.append(replace(t.part(slice(len(t.t) - len(s.t), None)), x=s.x, xdot=s.xdot))
    return made


def _longest(trajectories: Sequence[Trajectory]) -> int:
    return max((len(t.t) for t in trajectories), default=0)


def _lengths(
    train: Sequence[Trajectory], dt: float, unit: float, length: float | None, lead: int
) -> list[int]:
    """Periods of the windows, the longest last; what the recordings do not hold is cut to half of the longest."""
    wanted = [unit * own for own in LENGTHS]
    if length is not None:
        wanted = [own for own in wanted if own < length] + [length]
    longest = _longest(train) - lead - 1
    fitting = [p for p in (scales.periods(own, dt, 2) for own in wanted) if p <= longest]
    return sorted(dict.fromkeys(fitting)) or [max(2, longest // 2)]


def _guesses(
    fit: OutputFit, theta: Array, parts: Sequence[Sequence[Trajectory]], unit: float
) -> list[list[Trajectory]]:
    """Trajectories with the states that the prior at ``theta`` smooths; the first part decides how."""
    prior, delay = fit.make(fit.values(theta)), fit.delay(theta)
    smoother = fit_smoother(prior, shifted(parts[0], delay), fit.dt, time_unit=unit)
    return [with_states(part, smoother, delay) for part in parts]


def _best_start(
    fit: OutputFit, train: Sequence[Trajectory], periods: int, sizes: Array, start: Mapping[str, float] | None
) -> Array:
    """The start from which a few steps over short windows lead furthest down."""
    windows = cut_outputs(train, periods, fit.lead, WINDOWS // 2)
    starts = [fit.nominal, *([] if start is None else [fit.scaled(start)])]
    if len(fit.nominal):
        between = qmc.Sobol(len(fit.nominal), seed=0).random_base2(3)[:STARTS]
        starts += list(fit.lower + between * (fit.upper - fit.lower))
    found = []
    for one in starts:
        try:
            found.append(fit.fit(one, windows, sizes, START_ITERATIONS))
        except InputError:  # too stiff for the period there
            continue
    if not found:
        return fit.nominal
    return min(found, key=lambda f: f.error if math.isfinite(f.error) else math.inf).theta


def _error(fit: OutputFit, theta: Array, parts: Sequence[OutputWindows], sizes: Array) -> float:
    """Root mean square of the outputs' errors over their spread, with the first states free, over several parts."""
    found = [fit.fit(theta, part, sizes, ITERATIONS, fixed=True).error for part in parts]
    return float(np.sqrt(np.average(np.square(found), weights=[part.y.size for part in parts])))


def _errors(fit: OutputFit, chosen: Fitted) -> dict[str, float]:
    """Standard errors of the parameters that the data tell of."""
    if not len(chosen.covariance):
        return {}
    sizes = np.sqrt(np.maximum(np.diag(chosen.covariance), 0.0)) * fit.unit
    return {p.name: float(e) for p, e in zip(fit.free, sizes, strict=False) if math.isfinite(e)}


def _correlations(fit: OutputFit, chosen: Fitted) -> dict[str, float]:
    """Correlation of the errors of every two parameters that the data tell of, by ``"a, b"``."""
    c = chosen.covariance
    sigma = np.sqrt(np.maximum(np.diag(c), 1e-300)) if len(c) else np.zeros(0)
    told = [i for i in range(min(len(c), len(fit.free))) if math.isfinite(sigma[i])]
    return {
        f"{fit.names[i]}, {fit.names[j]}": float(c[i, j] / (sigma[i] * sigma[j]))
        for k, i in enumerate(told)
        for j in told[k + 1 :]
    }


def _warnings(fit: OutputFit, chosen: Fitted) -> tuple[str, ...]:
    if not len(chosen.covariance):
        return ("no fit improved on the nominal parameters",) if fit.free else ()
    warnings = []
    if chosen.unidentified:
        warnings.append(f"the data cannot tell apart: {', '.join(chosen.unidentified)}")
    for p, value, low, high in zip(fit.free, chosen.theta, fit.lower, fit.upper, strict=False):
        if min(value - low, high - value) < AT_BOUND * (high - low):
            warnings.append(f"{p.label} ends at a bound ({value * (abs(p.value) or p.upper - p.lower):.4g})")
    return tuple(warnings)


@lru_cache(maxsize=32)
def _delayed(xdot: ca.Function) -> ca.Function:
    """``xdot`` of inputs ``[u, slope by the delay]`` and parameters ``[p, change of the delay]``."""
    x, u, w, p = (ca.SX.sym(xdot.name_in(i), xdot.size1_in(i)) for i in range(4))
    slope, change = ca.SX.sym("slope", u.shape[0]), ca.SX.sym("change")
    rates = xdot(x, u + change * slope, w, p)
    names = [xdot.name_in(i) for i in range(4)]
    return ca.Function("xdot", [x, ca.vertcat(u, slope), w, ca.vertcat(p, change)], [rates], names, ["xdot"])


@lru_cache(maxsize=64)
def _outputs(equations: Equations, n: int) -> ca.Function:
    """Outputs at ``n`` points and their slopes by state, and by parameters and delay; inputs as :func:`_delayed` has
    them.
    """
    f = equations.output
    x, u, w, p = (ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4))
    slope, y = ca.SX.sym("slope", u.shape[0]), f(x, u, w, p)
    by_p = ca.horzcat(ca.jacobian(y, p), ca.jacobian(y, u) @ slope)
    values = [ca.densify(v) for v in (y, ca.jacobian(y, x), by_p)]
    one = ca.Function("output", [x, ca.vertcat(u, slope), w, p], values)
    return one.map("outputs", "serial", n, [3], [])
