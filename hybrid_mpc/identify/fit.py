"""Fit of a prior's parameters to states: equation error, output error over free runs, multiple shooting.

Residuals are errors of free runs over the states' spread, with exact derivatives: forward sensitivities of all windows
in one call (:mod:`~hybrid_mpc.identify.simulation`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import Windows, cut_windows
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.simulation import Simulation, traced
from hybrid_mpc.identify.step import required_substeps
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]
LARGEST = 1e3
"""Residuals beyond this many spreads of the data count as much: a free run that diverges stays finite."""


class ParameterFit:
    """A prior's free parameters ``theta``, each over its nominal size, and the residuals that are fitted."""

    def __init__(self, make: Callable[..., Prior], dt: float) -> None:
        self.make, self.prior, self.dt = make, make(), dt
        self.free = [p for p in self.prior.parameters_spec if not p.fixed]
        self.unit = np.array([abs(p.value) if p.value else (p.upper - p.lower) for p in self.free])
        self.nominal = np.array([p.value for p in self.free]) / self.unit
        self.lower = np.array([p.lower for p in self.free]) / self.unit
        self.upper = np.array([p.upper for p in self.free]) / self.unit

    @cached_property
    def simulation(self) -> Simulation:
        """Free runs of the prior, with derivatives by the free parameters."""
        names = [p.name for p in self.prior.parameters_spec]
        return Simulation(traced(self.prior), self.dt, [names.index(p.name) for p in self.free])

    def values(self, theta: Array) -> dict[str, float]:
        """Values [SI] of all parameters by name, fixed ones included."""
        fitted = {p.name: float(v) for p, v in zip(self.free, theta * self.unit, strict=True)}
        return {**self.prior.values, **fitted}

    def scaled(self, values: Mapping[str, float]) -> Array:
        """The free ones of ``values`` [SI] as ``theta``."""
        return np.array([values[p.name] for p in self.free]) / self.unit

    def inside(self, theta: Array) -> Array:
        """``theta`` just within its bounds: a start on one would stall a trust-region reflective search."""
        return np.clip(theta, self.lower + 1e-6, self.upper - 1e-6)

    def equation_error(self, windows: Windows) -> tuple[Array, Any]:
        """Fit from the nominal values to windows of one period: the state a period later is all there is."""
        return self.output_error(self.nominal, windows, 40)

    def output_error(self, start: Array, windows: Windows, evaluations: int) -> tuple[Array, Any]:
        """Fit from ``start`` to free runs over the windows, each from its first measured state.

        Gives ``theta`` and the Jacobian of the residuals over their standard deviation.
        """
        substeps = self.substeps(start)
        result = least_squares(
            lambda theta: self.residual(theta, windows, substeps),
            self.inside(start),
            jac=lambda theta: self.slope(theta, windows, substeps),
            bounds=(self.lower, self.upper),
            loss="soft_l1",
            max_nfev=evaluations,
        )
        return result.x, result.jac / np.sqrt(max(2 * result.cost / max(1, result.fun.size), 1e-30))

    def jacobian(self, theta: Array, windows: Windows) -> Array:
        """Jacobian at ``theta`` of the residuals over their standard deviation, for :meth:`confidence`."""
        substeps = self.substeps(theta)
        residual, slope = (f(theta, windows, substeps) for f in (self.residual, self.slope))
        return np.asarray(slope / max(float(np.sqrt(np.mean(residual**2))), 1e-15))

    def error(self, theta: Array, windows: Windows) -> float:
        """Mean absolute error of free runs over the windows [spreads of the data]; infinite if one diverges."""
        residual = self.residual(theta, windows, self.substeps(theta))
        return float(np.abs(residual).mean()) if np.isfinite(residual).all() else float("inf")

    def confidence(self, theta: Array, jacobian: Any) -> tuple[dict[str, float], list[str]]:
        """Standard errors [SI] by name and warnings, from a Jacobian as the fits return it."""
        if jacobian is None:
            return {}, ["no fit improved on the nominal parameters"]
        warnings = []
        _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] < 1e-6 * singular[0]:
            names = [p.name for p, w in zip(self.free, np.abs(rows[-1]), strict=True) if w > 0.2]
            warnings.append(f"the data cannot tell apart: {', '.join(names)}")
        errors = np.sqrt(np.diag(covariance_of(singular, rows))) * self.unit
        for p, value, low, high in zip(self.free, theta, self.lower, self.upper, strict=True):
            if min(value - low, high - value) < 1e-3 * (high - low):
                warnings.append(f"{p.label} ends at a bound ({value * abs(p.value or 1):.4g})")
        return {p.name: float(e) for p, e in zip(self.free, errors, strict=True)}, warnings

    def correlations(self, jacobian: Any) -> dict[str, float]:
        """Correlation of the errors of every two fitted parameters, by ``"a, b"``."""
        if jacobian is None:
            return {}
        _, singular, rows = np.linalg.svd(jacobian, full_matrices=False)
        return correlations([p.name for p in self.free], covariance_of(singular, rows))

    def substeps(self, theta: Array) -> int:
        """Sub-steps a period that the stiffness at ``theta`` asks for."""
        return required_substeps(self.make(self.values(theta)), self.dt)

    def parameters(self, theta: Array) -> Array:
        """Values [SI] of all parameters in the order of the specification, for each row of ``theta``."""
        rows = np.atleast_2d(theta)
        every = np.tile(list(self.prior.values.values()), (len(rows), 1))
        every[:, self.simulation.free] = rows * self.unit
        return every[0] if theta.ndim == 1 else every

    def residual(self, theta: Array, windows: Windows, substeps: int) -> Array:
        """Errors of all states of all free runs over the states' spread, as one vector."""
        x = self.simulation.states(
            windows.x[:, 0].numpy(), windows.u.numpy(), self.parameters(theta), substeps
        )
        return np.clip(_errors(x, windows), -LARGEST, LARGEST).ravel()

    def slope(self, theta: Array, windows: Windows, substeps: int) -> Array:
        """Jacobian of :meth:`residual`; zero where that is at its limit."""
        x, by_p = self.simulation.by_parameters(
            windows.x[:, 0].numpy(), windows.u.numpy(), self.parameters(theta), substeps
        )
        beyond = np.abs(_errors(x, windows)) > LARGEST
        slope = by_p[:, 1:] / spread_of(windows)[:, None] * self.unit
        return np.where(beyond[..., None], 0.0, slope).reshape(-1, len(self.unit))


def _errors(x: Array, windows: Windows) -> Array:
    return np.asarray((x[:, 1:] - windows.x[:, 1:].numpy()) / spread_of(windows))


def spread_of(windows: Windows) -> Array:
    """Standard deviation of each state over all windows ``(n_x,)`` [SI]: the unit of all residuals."""
    return np.asarray(windows.x.reshape(-1, windows.x.shape[-1]).std(0).clamp_min(1e-9).numpy())


def covariance_of(singular: Array, rows: Array) -> Array:
    """Covariance of the parameters, from singular values and right vectors of a Jacobian over its noise."""
    return np.asarray((rows.T / np.maximum(singular, 1e-12 * singular[0]) ** 2) @ rows)


def correlations(names: Sequence[str], covariance: Array) -> dict[str, float]:
    """Correlation of the errors of every two parameters, by ``"a, b"``."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return {
        f"{names[i]}, {names[j]}": float(covariance[i, j] / (sigma[i] * sigma[j]))
        for i in range(len(names))
        for j in range(i + 1, len(names))
    }


MOST_SEGMENTS = 60
"""Unknown states grow with the segments, and the time of a step with their cube."""
CONTINUITY = (1.0, 10.0, 100.0)
"""Weights, one after the other, of the gaps between segments: first they may gape, in the end they are closed to a
ten-thousandth of a measurement's share."""
EVALUATIONS = 15


@dataclass(frozen=True)
class Segments:
    """Adjacent segments of trajectories; ``joined`` ``(n,)`` is true where a segment's end is the next one's start."""

    windows: Windows
    joined: NDArray[np.bool_]


def cut_segments(trajectories: Sequence[Trajectory], periods: int, most: int = MOST_SEGMENTS) -> Segments:
    """Adjacent segments of ``periods``, of evenly chosen trajectories if there are more than ``most``."""
    counts = [(len(t.t) - 1) // periods for t in trajectories]
    fitting = [i for i, count in enumerate(counts) if count]
    if not fitting:
        raise InputError(
            f"multiple shooting: no trajectory holds a segment of {periods} periods; the longest has "
            f"{max((len(t.t) for t in trajectories), default=0)} samples. Take shorter segments or longer runs."
        )
    take = max(1, min(len(fitting), most // max(counts)))
    chosen = [fitting[i] for i in evenly(len(fitting), take)]
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

    Gives ``theta`` and the Jacobian by it with the states projected out, over the residuals' standard deviation: the
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
        self.u = segments.windows.u.numpy()
        scaled = segments.windows.x.numpy() / self.spread
        self.measured, self.later = scaled[:, 0], scaled[:, 1:]
        self.measurements = self.later.size
        self.substeps = fit.substeps(near)

    def residual(self, z: Array, weight: float) -> Array:
        theta, nodes = self._split(z)
        p, simulation = self.fit.parameters(theta), self.fit.simulation
        ahead = simulation.states(nodes * self.spread, self.u, p, self.substeps)[:, 1:] / self.spread
        errors = _limited(ahead - self.later)
        gaps = _limited(ahead[:, -1])[self.joined] - nodes[self.joined + 1]
        starts = (nodes - self.measured)[self.first]
        return np.concatenate([errors.ravel(), starts.ravel(), weight * gaps.ravel()])

    def jacobian(self, z: Array, weight: float) -> Array:
        theta, nodes = self._split(z)
        n_x = nodes.shape[1]
        _, by_p, by_x = self.fit.simulation.by_all(
            nodes * self.spread, self.u, self.fit.parameters(theta), self.substeps
        )
        by_theta, by_node = (
            np.clip(
                np.nan_to_num(s[:, 1:] / self.spread[:, None], nan=0.0, posinf=0.0, neginf=0.0), -1e6, 1e6
            )
            for s in (by_p * self.fit.unit, by_x * self.spread)
        )
        n, periods = by_theta.shape[:2]
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


def _limited(values: Array) -> Array:
    return np.clip(np.nan_to_num(values, nan=LARGEST, posinf=LARGEST, neginf=-LARGEST), -LARGEST, LARGEST)


STAGES = ((0.5, 20), (2.0, 10), (5.0, 6))
"""Lengths [the machine's seconds, :func:`~hybrid_mpc.data.scales.time_unit`] of the free runs that are fitted, from
short (convex) to long (what counts), each with its most evaluations: the long ones start near their optimum."""
MAX_WINDOWS = 48
METHODS = ("equation_error", "output_error", "multiple_shooting")
"""What :func:`fit_prior` can do."""
DEFAULT_METHODS = ("equation_error", "output_error")
SEGMENT = 0.5
"""Length [the machine's seconds] of a segment of multiple shooting: that of the first free runs."""
Candidate: TypeAlias = tuple[str, NDArray[np.float64], Any]
"""Name of a stage, its parameters over their nominal sizes, and the Jacobian that its confidence comes from."""


def fit_prior(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    before: PriorFit | None = None,
    methods: Sequence[str] = DEFAULT_METHODS,
    start: Mapping[str, float] | None = None,
    time_unit: float | None = None,
    on_progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> PriorFit:
    """Fit by each of the methods; the best of all on free runs of the validation trajectories wins.

    ``equation_error``: states one period ahead. ``output_error``: longer and longer free runs from measured
    states. ``multiple_shooting``: adjacent segments of 0.5 s whose first states are unknowns too. They run in this
    order; output error and shooting start from the best so far. Residuals are the states' errors over their spread in
    the data. A prior without free parameters stays as it is.

    The lengths are in the machine's seconds (:func:`~hybrid_mpc.data.scales.time_unit`): seconds on machines that swing
    in 0.25 to 4 s, and longer or shorter on slower or faster ones.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (chosen by, not fitted to).
        dt: Model period [s].
        before: An earlier fit to the same recordings, smoothed otherwise: only the length of free run that
            was best then is fitted, from its parameters on (or multiple shooting, if that was). Default: all lengths,
            from the nominal ones.
        methods: Some of ``METHODS``. Default: equation error and output error.
        start: Values [SI] by name to try as a start besides the nominal ones, e.g. those of a global search; fixed
            parameters are left out. Default: none.
        time_unit: The machine's second [s]. Default: that of the training trajectories.
        on_progress: ``(done, total, text)`` after every stage.

    Raises:
        InputError: If no trajectory is long enough, the prior diverges with all parameters tried, or there is no such
            method.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> runs = exact_runs("train", 1)
        >>> fit = fit_prior(PendulumPrior, runs, runs, dt=0.01, methods=("equation_error",))
        >>> round(fit.values["l"], 3)
        0.045
    """
    _check_methods(methods)
    fit = ParameterFit(make, dt)
    unit = scales.time_unit(train, dt) if time_unit is None else time_unit
    stages = [(unit * length, most) for length, most in STAGES]
    stages = [s for s in stages if _fits(train, s[0], dt)] or [(_shortest(train, dt), 20)]
    lengths = [s for s, _ in stages]
    longest = scales.periods(_longest(valid or train, lengths), dt)
    scored = _sample(cut_windows(valid or train, 0, longest, scales.periods(unit * STAGES[0][0], dt)))
    if not fit.free:
        row = {"stage": "nominal", "validation_error": fit.error(fit.nominal, scored)}
        return PriorFit(fit.prior.values, {}, (), (row,))
    candidates: list[Candidate]
    if before is None:
        candidates = [("nominal", fit.nominal, None)]
        if start is not None:
            candidates.append(("start", fit.scaled(start), None))
        if "equation_error" in methods:
            theta, jacobian = fit.equation_error(_sample(cut_windows(train, 0, 1, 3), 4000))
            candidates.append(("equation error", theta, jacobian))
    else:
        candidates = [("the fit before", fit.scaled(before.values), None)]
        stages, methods = _again(before, stages, methods)
    if "output_error" not in methods:
        stages = []
    for i, (length, evaluations) in enumerate(stages):
        on_progress(i, len(stages), f"output error over {length:g} s")
        windows = _sample(cut_windows(train, 0, scales.periods(length, dt), scales.periods(length / 4, dt)))
        best = min(candidates, key=lambda c: fit.error(c[1], windows))[1]
        theta, jacobian = fit.output_error(best, windows, evaluations)
        candidates.append((f"output error {length:g} s", theta, jacobian))
    if "multiple_shooting" in methods:
        on_progress(len(stages), len(stages) + 1, "multiple shooting")
        candidates.append(_shooting(fit, train, candidates, min(unit * SEGMENT, *lengths)))
    on_progress(len(stages), len(stages), "done")
    return _winner(fit, candidates, scored, before)


def _winner(
    fit: ParameterFit, candidates: Sequence[Candidate], scored: Windows, before: PriorFit | None
) -> PriorFit:
    """The candidate with the least validation error, with what is known of its confidence."""
    scores = [fit.error(theta, scored) for _, theta, _ in candidates]
    if not np.isfinite(min(scores)):
        raise InputError("the prior diverges with every set of parameters tried; check its signs and units")
    best = int(np.argmin(scores))
    _, theta, jacobian = candidates[best]
    if best == 0 and before is not None:
        errors, warnings = dict(before.standard_errors), list(before.warnings)
        correlations = dict(before.correlations)
    else:
        errors, warnings = fit.confidence(theta, jacobian)
        correlations = fit.correlations(jacobian)
    table = tuple({"stage": c[0], "validation_error": s} for c, s in zip(candidates, scores, strict=True))
    return PriorFit(fit.values(theta), errors, tuple(warnings), table, correlations)


def _shooting(
    fit: ParameterFit, train: Sequence[Trajectory], candidates: Sequence[Candidate], length: float
) -> Candidate:
    """Multiple shooting over segments of ``length`` [s] from the candidate that is best on them."""
    segments = cut_segments(train, scales.periods(length, fit.dt))
    start = min(candidates, key=lambda c: fit.error(c[1], segments.windows))[1]
    return (f"multiple shooting {length:g} s", *multiple_shooting(fit, start, segments))


def _again(
    before: PriorFit, stages: list[tuple[float, int]], methods: Sequence[str]
) -> tuple[list[tuple[float, int]], Sequence[str]]:
    """What is fitted again after an earlier fit: the length or the method that won, of the methods asked for."""
    won = before.best.startswith("multiple shooting")
    if "multiple_shooting" in methods and (won or "output_error" not in methods):
        return [], ("multiple_shooting",)
    stages = [s for s in stages if before.best == f"output error {s[0]:g} s"] or stages[:1]
    return stages, tuple(m for m in methods if m == "output_error")


def _check_methods(methods: Sequence[str]) -> None:
    unknown = [m for m in methods if m not in METHODS]
    if isinstance(methods, str) or unknown or not methods:
        raise InputError(
            f"fit of the prior: methods must be some of {', '.join(METHODS)}, in a tuple; got {methods!r}"
        )


def _sample(windows: Windows, most: int = MAX_WINDOWS) -> Windows:
    """At most ``most`` windows, evenly spread."""
    return windows.take(torch.linspace(0, len(windows) - 1, min(most, len(windows))).round().long())


def _fits(trajectories: Sequence[Trajectory], seconds: float, dt: float) -> bool:
    return any(len(t.t) > round(seconds / dt) for t in trajectories)


def _shortest(trajectories: Sequence[Trajectory], dt: float) -> float:
    return max((len(t.t) - 1) * dt for t in trajectories) * 0.5


def _longest(trajectories: Sequence[Trajectory], lengths: Sequence[float]) -> float:
    dt = trajectories[0].dt
    fitting = [s for s in lengths if _fits(trajectories, s, dt)]
    return max(fitting) if fitting else _shortest(trajectories, dt)
