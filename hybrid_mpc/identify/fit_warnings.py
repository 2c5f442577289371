"""Warnings of a fit: bounds, feedback, no improvement, delayed inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.starts import START_ITERATIONS
from hybrid_mpc.identify.windows import FEW, FirstStates, cut_outputs, most_samples

Array = NDArray[np.float64]
AT_BOUND = 1e-3
"""Share of its range within which a parameter counts as at its bound."""
NEARLY = 0.05
"""Largest change of an identified parameter over its nominal value that confirms the nominal value."""
LATE = 4.0
"""Longest delay of the inputs [model periods] that is tested if no delay is fitted."""
SHORT = 2.0
"""Length of short free runs, in the longest tested delays. Over many time constants a short delay hardly matters, but a
controller answers within few periods."""
SHORTEST = 0.01
"""Shortest delay that causes a warning [periods]. With noise-free data only the integration error remains, most of
which a delay of 4e-5 periods can explain."""
TELLING = 0.9
"""Share of the training error and of the validation error below which a delay causes a warning; the delay must also be
at least twice its standard error."""
ADD_DELAY = "Fit the delay (largest_delay of the data), or add the lag of the actuator to the prior"
"""Remedy for late inputs."""


def warnings_of(
    fit: OutputFit, chosen: Fitted, answered: float = 0.0, gained: float = 0.0
) -> tuple[str, ...]:
    """Warnings of a fit; ``gained`` is its error over that of the nominal values."""
    warnings = []
    if answered > 1.0:
        warnings.append(
            "inputs respond to the outputs, as in a closed loop: disturbances may bias the parameters, so prediction "
            "errors were fitted, too; validation data selected the fit"
        )
    if not len(chosen.covariance):
        return (*warnings, "no fit improved on the nominal parameters") if fit.free else ()
    # error of a fit over that of the nominal values above which the fit is no improvement
    if gained > 0.98 and not _confirmed(fit, chosen):
        warnings.append(
            f"the fit hardly improves on the nominal parameters (error ratio {gained:.3f}): either the nominal "
            "parameters are right, or the prior lacks an effect that no parameter describes"
        )
    warnings += [str(one) for one in chosen.unidentified]
    for p, value, low, high in zip(fit.free, chosen.theta, fit.lower, fit.upper, strict=False):
        if min(value - low, high - value) < AT_BOUND * (high - low):
            warnings.append(f"{p.label} ends at a bound ({value * (abs(p.value) or p.upper - p.lower):.4g})")
    return tuple(warnings)


def _confirmed(fit: OutputFit, chosen: Fitted) -> bool:
    """Whether the fit confirms the nominal values, as after they were taken from an earlier fit."""
    nominal = fit.nominal[: len(fit.free)]
    near = np.abs(chosen.theta[: len(nominal)] - nominal) <= NEARLY * np.abs(nominal)
    return not chosen.unidentified and bool(near.all())


def late_inputs(
    fit: OutputFit,
    theta: Array,
    parts: Sequence[Sequence[Trajectory]],
    periods: int,
    sizes: Array,
    first_states: FirstStates,
) -> tuple[float, tuple[str, ...]]:
    """The delay [s] and a warning if a delay of the inputs explains the first part, and every other part that is long
    enough, better than the parameters alone; both are fitted to the same windows of the first part. Otherwise 0.
    """
    late, short = fit.with_delay(LATE * fit.dt), round(SHORT * LATE)
    for most in (periods, short) if periods > 2 * short else (periods,):
        problems: list[Shooting] = []
        for part in parts:
            if (longest := min(most, most_samples(part) - late.lead - 1)) >= 2:
                windows = cut_outputs(
                    part, longest, late.lead, FEW, fit.prior.states, fit.prior.outputs, first_states
                )
                problems.append(Shooting(late, windows, sizes))
            elif not problems:
                return 0.0, ()
        found = fitted_delay(fit, theta, problems)
        if found is not None and found.significant:
            ratios = " and ".join(f"{ratio:.2f}" for ratio in found.ratios)
            warning = (
                f"{found}: such a delay would reduce the errors over {longest} periods of training and validation "
                f"recordings by the factors {ratios}. {ADD_DELAY} [HM-IDENTIFY-080]"
            )
            return found.delay, (warning,)
    return 0.0, ()


@dataclass(frozen=True)
class FittedDelay:
    """A delay of the inputs that the prior lacks.

    Args:
        delay: The delay [s].
        error: Its standard error [s].
        ratios: Errors of free runs with the delay over those without, of each part of the recordings [-].
        longest: Whether it is the longest delay that was tested.
    """

    delay: float
    error: float
    ratios: tuple[float, ...]
    longest: bool

    @property
    def significant(self) -> bool:
        """Whether the delay is distinct from zero and reduces the error of every part."""
        return max(self.ratios) < TELLING and self.delay > 2.0 * self.error

    def __str__(self) -> str:
        least = "at least " if self.longest else ""
        return f"inputs seem to act {least}{self.delay:.2g} s later than recorded (standard error {self.error:.1g} s)"


def fitted_delay(fit: OutputFit, theta: Array, problems: Sequence[Shooting]) -> FittedDelay | None:
    """Fit a delay and the parameters to the first problem, and compare the errors of all problems.

    Args:
        fit: The fit without a delay.
        theta: Parameters to start from.
        problems: Windows of parts of the recordings, of the fit with a delay (:meth:`OutputFit.with_delay`).

    Returns:
        The delay; None if a linear step shows that it does not reduce the error, or if it is as short as an error of
        the integration.
    """
    without_delay = Shooting(fit, problems[0].windows, problems[0].sizes)
    # error after a linear step with a delay over that without, above which no delay is fitted
    if _share_with_delay(problems[0], theta, without_delay.first_states(theta)) > 0.98:
        return None
    at_once = without_delay.solve(theta, START_ITERATIONS)
    found = problems[0].solve(np.append(theta, 0.5), START_ITERATIONS)
    both = np.array([problem.explained([np.append(at_once.theta, 0.0), found.theta]) for problem in problems])
    delay, error = found.theta[-1] * fit.dt, math.sqrt(max(found.covariance[-1, -1], 0.0)) * fit.dt
    if not delay > SHORTEST * fit.dt:
        return None
    ratios = tuple(float(then / max(before, 1e-300)) for before, then in both)
    return FittedDelay(float(delay), error, ratios, bool(found.theta[-1] > (1.0 - AT_BOUND) * LATE))


def _share_with_delay(problem: Shooting, theta: Array, x: Array) -> float:
    """Error after a linear step of parameters and delay, over that after a step of the parameters alone."""
    slopes, error = problem.linear(np.append(theta, 0.0), x)
    b, r = slopes.reshape(-1, len(theta) + 1), error.ravel()
    without, with_delay = (
        float(np.linalg.norm(r - some @ np.linalg.lstsq(some, r, rcond=None)[0])) for some in (b[:, :-1], b)
    )
    return with_delay / max(without, 1e-300)
