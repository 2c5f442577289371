"""Warnings of a fit: bounds, feedback, no improvement, inputs that act late."""

from __future__ import annotations

import math
from collections.abc import Sequence

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
HARDLY = 0.98
"""Share of the nominal values' error from which on a fit counts as none."""
LATE = 4.0
"""Longest delay of the inputs [model periods] that is looked for where none is fitted."""
SHORTEST = 0.01
"""Shortest delay that is told of [periods]. Exact data leave the integrator's error alone; a delay of 4e-5 periods
explained four fifths of that."""
TELLING = 0.9
"""Share of the error, of training and of validation, to which such a delay must bring it to be told; it must be twice
its standard error, too."""
HOPELESS = 0.98
"""Share of the error that a linear step with a delay must get below, over one without, for a delay to be fitted."""


def warnings_of(
    fit: OutputFit, chosen: Fitted, answered: float = 0.0, gained: float = 0.0
) -> tuple[str, ...]:
    """What is doubtful about a fit; ``gained`` is its error over that of the nominal values."""
    warnings = []
    if answered > 1.0:
        warnings.append(
            "inputs answer to the outputs, as in closed loop: parameters may be biased where the machine is disturbed; "
            "predictions were fitted too, and validation chose"
        )
    if not len(chosen.covariance):
        return (*warnings, "no fit improved on the nominal parameters") if fit.free else ()
    if gained > HARDLY:
        warnings.append(
            f"the fit hardly improves on the nominal parameters (its error is {gained:.3f} of theirs): they are right, "
            "or the prior lacks something that no parameter stands for"
        )
    warnings += [str(one) for one in chosen.unidentified]
    for p, value, low, high in zip(fit.free, chosen.theta, fit.lower, fit.upper, strict=False):
        if min(value - low, high - value) < AT_BOUND * (high - low):
            warnings.append(f"{p.label} ends at a bound ({value * (abs(p.value) or p.upper - p.lower):.4g})")
    return tuple(warnings)


def late_inputs(
    fit: OutputFit,
    theta: Array,
    parts: Sequence[Sequence[Trajectory]],
    periods: int,
    sizes: Array,
    first_states: FirstStates,
) -> tuple[str, ...]:
    """A warning where inputs that act later than they are recorded explain the first of the parts, and each other one
    that is long enough, better than parameters alone; both are fitted to the same windows of the first part.
    """
    late = fit.with_delay(LATE * fit.dt)
    known = fit.prior.states, fit.prior.outputs, first_states
    problems: list[Shooting] = []
    for part in parts:
        if (longest := min(periods, most_samples(part) - late.lead - 1)) >= 2:
            windows = cut_outputs(part, longest, late.lead, FEW, *known)
            problems.append(Shooting(late, windows, sizes))
        elif not problems:
            return ()
    without_delay = Shooting(fit, problems[0].windows, sizes)
    if _share_with_delay(problems[0], theta, without_delay.first_states(theta)) > HOPELESS:
        return ()
    at_once = without_delay.solve(theta, START_ITERATIONS)
    found = problems[0].solve(np.append(theta, 0.5), START_ITERATIONS)
    both = np.array([problem.explained([np.append(at_once.theta, 0.0), found.theta]) for problem in problems])
    delay, error = found.theta[-1] * fit.dt, math.sqrt(max(found.covariance[-1, -1], 0.0)) * fit.dt
    if not ((both[:, 1] < TELLING * both[:, 0]).all() and delay > max(2.0 * error, SHORTEST * fit.dt)):
        return ()
    left = " and ".join(f"{then / before:.2f}" for before, then in both)
    least = "at least " if found.theta[-1] > (1.0 - AT_BOUND) * LATE else ""
    return (
        f"inputs seem to act {least}{delay:.2g} s later than they are recorded (standard error {error:.1g} s): of the "
        f"error over training and validation recordings this would leave {left}. Let the fit find the delay "
        "(largest_delay of the data), or write the lag of the actuator into the prior",
    )


def _share_with_delay(problem: Shooting, theta: Array, x: Array) -> float:
    """Error after a linear step of parameters and delay, over that after a step of the parameters alone."""
    slopes, error = problem.linear(np.append(theta, 0.0), x)
    b, r = slopes.reshape(-1, len(theta) + 1), error.ravel()
    without, with_delay = (
        float(np.linalg.norm(r - some @ np.linalg.lstsq(some, r, rcond=None)[0])) for some in (b[:, :-1], b)
    )
    return with_delay / max(without, 1e-300)
