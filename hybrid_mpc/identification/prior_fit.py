"""Fit of the prior's parameters to the training trajectories: the honest baseline ``phy``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from hybrid_mpc.data import scales
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.dataset import Windows, cut_windows
from hybrid_mpc.identification.prior_residuals import ParameterFit
from hybrid_mpc.identification.prior_result import PriorFit
from hybrid_mpc.identification.prior_shooting import cut_segments, multiple_shooting
from hybrid_mpc.identification.prior_swarm import SwarmSettings, particle_swarm
from hybrid_mpc.physics import Prior

STAGES = ((0.5, 20), (2.0, 10), (5.0, 6))
"""Lengths [the machine's seconds, :func:`~hybrid_mpc.data.time_unit`] of the free runs that are fitted, from short
(convex) to long (what is judged), each with its most evaluations: the long ones start near their optimum."""
MAX_WINDOWS = 48
METHODS = ("equation_error", "output_error", "multiple_shooting", "particle_swarm")
"""What :func:`fit_prior` can do."""
DEFAULT_METHODS = ("equation_error", "output_error")
SWARM_SECONDS = 2.0
SWARM_WINDOWS = 24
"""The swarm simulates every set of parameters over so many free runs of at most this length [the machine's seconds]."""
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
    swarm: SwarmSettings | None = None,
    time_unit: float | None = None,
    on_progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> PriorFit:
    """Fit by each of the methods; the best of all on free runs of the validation trajectories wins.

    ``equation_error``: states one period ahead. ``output_error``: longer and longer free runs from measured
    states. ``multiple_shooting``: adjacent segments of 0.5 s whose first states are unknowns too.
    ``particle_swarm``: free runs of up to 2 s, searched between the bounds without derivatives (the paper's; an
    optional extra). They run in the order swarm, equation error, output error, shooting, whatever the order given;
    output error and shooting start from the best so far. Residuals are the states' errors over their spread in the
    data, with exact derivatives (forward mode through the integrator). A prior without free parameters stays as it is.

    The lengths are in the machine's seconds (:func:`~hybrid_mpc.data.time_unit`): they are seconds on machines that
    swing in 0.25 to 4 s, and longer or shorter on slower or faster ones.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (chosen by, not fitted to).
        dt: Model period [s].
        before: An earlier fit to the same recordings, smoothed otherwise: only the length of free run that
            was best then is fitted, from its parameters on (or multiple shooting, if that was; a swarm does not
            search again). Default: all lengths, from the nominal ones.
        methods: Some of ``METHODS``. Default: equation error and output error.
        swarm: Effort of the particle swarm. Default: 24 particles, 40 generations.
        time_unit: The machine's second [s]. Default: that of the training trajectories.
        on_progress: ``(done, total, text)`` after every stage.

    Raises:
        InputError: If no trajectory is long enough, the inputs leave every parameter undetermined, there is no such
            method, or the particle swarm is asked for and pymoo is not installed.
    """
    _check_methods(methods)
    fit = ParameterFit(make, dt)
    unit = scales.time_unit(train, dt) if time_unit is None else time_unit
    stages = [(unit * length, most) for length, most in STAGES]
    stages = [s for s in stages if _fits(train, s[0], dt)] or [(_shortest(train, dt), 20)]
    lengths = [s for s, _ in stages]
    longest = scales.periods(_longest(valid or train, lengths), dt)
    judge = _sample(cut_windows(valid or train, 0, longest, scales.periods(unit * STAGES[0][0], dt)))
    if not fit.free:
        row = {"stage": "nominal", "validation_error": fit.judge(fit.nominal, judge)}
        return PriorFit(fit.prior.values, {}, (), (row,))
    candidates: list[Candidate]
    if before is None:
        candidates = [("nominal", fit.nominal, None)]
        found = _first_searches(fit, train, methods, swarm or SwarmSettings(), lengths, unit, on_progress)
        candidates += found
    else:
        candidates = [("the fit before", fit.scaled(before.values), None)]
        stages, methods = _again(before, stages, methods)
    if "output_error" not in methods:
        stages = []
    for i, (length, evaluations) in enumerate(stages):
        on_progress(i, len(stages), f"output error over {length:g} s")
        windows = _sample(cut_windows(train, 0, scales.periods(length, dt), scales.periods(length / 4, dt)))
        start = min(candidates, key=lambda c: fit.judge(c[1], windows))[1]
        theta, jacobian = fit.output_error(start, windows, evaluations)
        candidates.append((f"output error {length:g} s", theta, jacobian))
    if "multiple_shooting" in methods:
        on_progress(len(stages), len(stages) + 1, "multiple shooting")
        candidates.append(_shooting(fit, train, candidates, min(unit * SEGMENT, *lengths)))
    on_progress(len(stages), len(stages), "done")
    return _winner(fit, candidates, judge, before)


def _winner(
    fit: ParameterFit, candidates: Sequence[Candidate], judge: Windows, before: PriorFit | None
) -> PriorFit:
    """The candidate with the least validation error, with what is known of its confidence."""
    scores = [fit.judge(theta, judge) for _, theta, _ in candidates]
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


def _first_searches(
    fit: ParameterFit,
    train: Sequence[Trajectory],
    methods: Sequence[str],
    swarm: SwarmSettings,
    lengths: Sequence[float],
    unit: float,
    on_progress: Callable[[int, int, str], None],
) -> list[Candidate]:
    """What needs no start: the particle swarm and the equation error."""
    found: list[Candidate] = []
    if "particle_swarm" in methods:
        length = max((s for s in lengths if s <= unit * SWARM_SECONDS), default=min(lengths))
        periods = scales.periods(length, fit.dt)
        windows = _sample(cut_windows(train, 0, periods, max(1, periods // 4)), SWARM_WINDOWS)
        theta = particle_swarm(
            fit, windows, swarm, lambda done, total: on_progress(done, total, "particle swarm")
        )
        found.append(("particle swarm", theta, fit.jacobian(theta, windows)))
    if "equation_error" in methods:
        theta, jacobian = fit.equation_error(_sample(cut_windows(train, 0, 1, 3), 4000))
        found.append(("equation error", theta, jacobian))
    return found


def _shooting(
    fit: ParameterFit, train: Sequence[Trajectory], candidates: Sequence[Candidate], length: float
) -> Candidate:
    """Multiple shooting over segments of ``length`` [s] from the candidate that is best on them."""
    segments = cut_segments(train, scales.periods(length, fit.dt))
    start = min(candidates, key=lambda c: fit.judge(c[1], segments.windows))[1]
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
