"""The fitted prior of a benchmark: parameters, the input's delay, and the smoother that starts every free run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.lags import delayed
from hybrid_mpc.identification.prior_long_runs import OutputErrorFit, Runs, cut_runs
from hybrid_mpc.identification.prior_result import PriorFit
from hybrid_mpc.identification.smoothing import Smoother, fit_smoother
from hybrid_mpc.physics import Prior

STAGES = ((1.0, 15, 48), (5.0, 10, 48))
"""Free runs from polynomially smoothed states: length [the machine's seconds], most simulations, most runs."""
LAST = (12, 40)
"""The last stage's, over the benchmark's own length from states that the fitted prior has smoothed."""
NONE = 0.05
"""Share of a period below which a delay counts as none."""
Report = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Physics:
    """The fitted prior.

    Args:
        fit: Parameters and what is known of their confidence.
        delay: Delay of the input [s], zero for none.
        sigma: Standard deviation of the measurement that the smoother assumes [output unit].
        walk: Standard deviation of the unexplained acceleration's change per period.
    """

    fit: PriorFit
    delay: float
    sigma: tuple[float, ...]
    walk: tuple[float, ...]

    def smoother(self, prior: Prior, dt: float) -> Smoother:
        """The smoother around the fitted prior."""
        return Smoother(prior, dt, self.sigma, self.walk)


def fit_physics(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    length: float,
    largest_delay: float = 0.0,
    on_progress: Report = lambda done, total, text: None,
) -> Physics:
    """Fit parameters and delay to longer and longer free runs; the last ones start from states smoothed by the prior.

    All stages compete on free runs over training and validation pieces, in the length that judges: a handful of
    parameters follows no noise, and where friction drifts a short validation part alone misleads.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training pieces.
        valid: Validation pieces: nothing is fitted to them.
        dt: Model period [s].
        length: Length [s] of the longest free runs.
        largest_delay: Longest delay searched for [s]. Default: zero, none is searched.
        on_progress: ``(done, total, text)``.
    """
    fit = OutputErrorFit(make, dt, largest_delay)
    theta, total, unit = fit.nominal, len(STAGES) + 1, time_unit(train, dt)
    found: list[tuple[str, Any, Any]] = []
    for i, (own_seconds, evaluations, most) in enumerate(STAGES):
        seconds = unit * own_seconds
        if _periods(train, min(seconds, length), dt, fit.lead) < 2:
            continue
        on_progress(i, total, f"free runs of {min(seconds, length):g} s")
        runs = cut_runs(train, _periods(train, min(seconds, length), dt, fit.lead), fit.lead, most)
        theta, slope = fit.fit(theta, runs, evaluations, robust=True)
        found.append((f"free runs of {seconds:g} s", theta, slope))
    delay = _delay(fit.delay(theta), dt)
    smoother = fit_smoother(make(fit.values(theta)), [*shifted(train, delay), *shifted(valid, delay)], dt)
    starts, others = (with_states(part, smoother, delay) for part in (train, valid))
    on_progress(total - 1, total, "the longest free runs")
    runs = cut_runs(starts, _periods(starts, length, dt, fit.lead), fit.lead, LAST[1])
    theta, slope = fit.fit(theta, runs, LAST[0], robust=False)
    found.append((f"free runs of {length:g} s at most", theta, slope))
    judges = [runs, cut_runs(others, _periods(others, length, dt, fit.lead), fit.lead, LAST[1])]
    scores = [_together([fit.rmse(theta, judge) for judge in judges], judges) for _, theta, _ in found]
    best = int(np.argmin(scores))
    stages = [{"stage": f[0], "validation_error": s} for f, s in zip(found, scores, strict=True)]
    _, theta, slope = found[best]
    delay = _delay(fit.delay(theta), dt)
    smoother = fit_smoother(make(fit.values(theta)), [*shifted(train, delay), *shifted(valid, delay)], dt)
    return Physics(fit.result(theta, slope, stages), delay, smoother.sigma, smoother.walk)


def smoothed(
    make: Callable[..., Prior], physics: Physics, trajectories: Sequence[Trajectory], dt: float
) -> list[Trajectory]:
    """Trajectories with the inputs that act and the states that the fitted prior smooths: what networks train on."""
    return physics.smoother(make(physics.fit.values), dt).smooth(shifted(trajectories, physics.delay))


def with_states(trajectories: Sequence[Trajectory], smoother: Smoother, delay: float) -> list[Trajectory]:
    """Trajectories with smoothed states but the inputs as they were commanded, without the samples a delay costs."""
    made = []
    for t, s in zip(trajectories, smoother.smooth(shifted(trajectories, delay)), strict=True):
        lost = len(t.t) - len(s.t)
        kept = t.part(np.arange(len(t.t)) >= lost, t.name, t.role)
        made.append(Trajectory(t.name, t.role, t.dt, kept.t, kept.u, kept.y, s.x, s.xdot))
    return made


def shifted(trajectories: Sequence[Trajectory], delay: float) -> list[Trajectory]:
    """Trajectories with the inputs that act; as they are without a delay."""
    return [delayed(t, delay) for t in trajectories] if delay else list(trajectories)


def lost_samples(delay: float, dt: float) -> int:
    """Samples at the start of a trajectory whose acting input is not known.

    Example:
        >>> lost_samples(0.0, 0.025), lost_samples(0.025, 0.025), lost_samples(0.03, 0.025)
        (0, 1, 2)
    """
    return math.ceil(delay / dt - 1e-6)


def _together(errors: Sequence[float], parts: Sequence[Runs]) -> float:
    """Root mean square over several parts."""
    sizes = [part.y.numel() for part in parts]
    return float(np.sqrt(np.average(np.square(errors), weights=sizes)))


def _delay(delay: float, dt: float) -> float:
    return delay if delay >= NONE * dt else 0.0


def _periods(trajectories: Sequence[Trajectory], length: float, dt: float, lead: int) -> int:
    """Periods of a run: the length asked for, or what the longest trajectory has."""
    return min(round(length / dt), max((len(t.t) for t in trajectories), default=0) - lead - 1)
