"""The fitted prior of a machine: parameters, the input's delay, and the smoother that gives states.

Two ways lead to it: :func:`fit_and_smooth` fits smoothed states; :func:`fit_physics` fits measured outputs over long
free runs and finds the delay of the input too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.delay import shifted, with_states
from hybrid_mpc.identify.fit import DEFAULT_METHODS, fit_prior
from hybrid_mpc.identify.output_error import OutputErrorFit, Runs, cut_runs
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.smooth import Smoother, fit_smoother
from hybrid_mpc.machine.torch_prior import Prior

ROUNDS = ("polynomially smoothed", "smoothed by the prior")
"""States that :func:`fit_and_smooth` fits, one after the other."""
STAGES = ((1.0, 15, 48), (5.0, 10, 48))
"""Free runs from polynomially smoothed states: length [the machine's seconds], most simulations, most runs."""
LAST = (12, 40)
"""Most simulations and runs of the last stage, over the length asked for, from states that the fitted prior smooths."""
NONE = 0.05
"""Share of a period below which a delay counts as none."""
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Physics:
    """The fitted prior: the fit, the input's delay [s] (zero for none), and what its smoother assumes.

    ``sigma`` is the standard deviation of the measurement [output unit], ``walk`` that of the unexplained
    acceleration's change per period.
    """

    fit: PriorFit
    delay: float
    sigma: tuple[float, ...]
    walk: tuple[float, ...]

    def smoother(self, prior: Prior, dt: float) -> Smoother:
        """The smoother around the fitted prior."""
        return Smoother(prior, dt, self.sigma, self.walk)


def smoothed(
    make: Callable[..., Prior], physics: Physics, trajectories: Sequence[Trajectory], dt: float
) -> list[Trajectory]:
    """Trajectories with the inputs that act and the states that the fitted prior smooths: what networks train on."""
    return physics.smoother(make(physics.fit.values), dt).smooth(shifted(trajectories, physics.delay))


def fit_and_smooth(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    dt: float,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    start: Mapping[str, float] | None = None,
    on_progress: Callable[[str, int, int, str], None] = lambda key, done, total, text: None,
) -> Physics:
    """Fit a prior to polynomially smoothed states, smooth by it, fit it to these states; there is no delay.

    ``methods`` and ``start`` are those of :func:`~hybrid_mpc.identify.fit.fit_prior`; ``on_progress`` takes
    ``(round, done, total, text)`` with a title of ``ROUNDS``.
    """
    physics: Physics | None = None
    unit = time_unit(train, dt)
    for title in ROUNDS:
        if physics is not None:
            train, valid = (smoothed(make, physics, part, dt) for part in (train, valid))
        fit = fit_prior(
            make, train, valid, dt=dt, before=physics.fit if physics else None, methods=methods, start=start,
            time_unit=unit,
            on_progress=lambda done, total, text, key=title: on_progress(key, done, total, text),  # type: ignore[misc]
        )  # fmt: skip
        smoother = fit_smoother(make(fit.values), [*train, *valid], dt, time_unit=unit)
        physics = Physics(fit, 0.0, smoother.sigma, smoother.walk)
    assert physics is not None
    return physics


def fit_physics(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    length: float,
    largest_delay: float = 0.0,
    on_progress: Progress = lambda done, total, text: None,
) -> Physics:
    """Fit parameters and delay to longer and longer free runs; the last ones start from states smoothed by the prior.

    The stage with the least error over training and validation runs of the longest length wins: few
    parameters do not overfit, and where friction drifts a short validation part alone misleads. ``length`` [s] is
    that of the longest runs; no delay is searched for where ``largest_delay`` [s] is zero.
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

    def smoothing(theta: Any) -> tuple[float, Smoother]:
        """The delay, none where it is too short to count, and the smoother of the recordings under it."""
        delay = fit.delay(theta) if fit.delay(theta) >= NONE * dt else 0.0
        recordings = [*shifted(train, delay), *shifted(valid, delay)]
        return delay, fit_smoother(make(fit.values(theta)), recordings, dt)

    delay, smoother = smoothing(theta)
    starts, others = (with_states(part, smoother, delay) for part in (train, valid))
    on_progress(total - 1, total, "the longest free runs")
    runs = cut_runs(starts, _periods(starts, length, dt, fit.lead), fit.lead, LAST[1])
    theta, slope = fit.fit(theta, runs, LAST[0], robust=False)
    found.append((f"free runs of {length:g} s at most", theta, slope))
    scored = [runs, cut_runs(others, _periods(others, length, dt, fit.lead), fit.lead, LAST[1])]
    scores = [_together([fit.rmse(theta, part) for part in scored], scored) for _, theta, _ in found]
    best = int(np.argmin(scores))
    stages = [{"stage": f[0], "validation_error": s} for f, s in zip(found, scores, strict=True)]
    _, theta, slope = found[best]
    delay, smoother = smoothing(theta)
    return Physics(fit.result(theta, slope, stages), delay, smoother.sigma, smoother.walk)


def _together(errors: Sequence[float], parts: Sequence[Runs]) -> float:
    """Root mean square over several parts."""
    sizes = [part.y.numel() for part in parts]
    return float(np.sqrt(np.average(np.square(errors), weights=sizes)))


def _periods(trajectories: Sequence[Trajectory], length: float, dt: float, lead: int) -> int:
    """Periods of a run: the length asked for, or what the longest trajectory has."""
    return min(round(length / dt), max((len(t.t) for t in trajectories), default=0) - lead - 1)
