"""Find the parameters that an observer should track, judged by recordings that its prior was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import robust_spread, time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.estimate.switching import Filter
from hybrid_mpc.estimate.tuning import process_noise
from hybrid_mpc.identify.ahead import Tracking, choose_tracked
from hybrid_mpc.identify.delay import lost_samples
from hybrid_mpc.identify.fit import fit_prior, smoothed
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.varying import Varying, find_varying
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.kit.assembly import make_estimator, tuned_noise
from hybrid_mpc.kit.disturbances import default_disturbances
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
FITS = 4
"""Groups of recordings at most that are left out of a fit in turn."""


def spread_of(recordings: Sequence[Array]) -> tuple[float, ...]:
    """Spread of each column of recordings ``(n, m)``; 0 for a column that varies by rounding only."""
    found = [
        (robust_spread(c), float(np.nanmax(np.abs(c), initial=0.0))) for c in np.concatenate(recordings).T
    ]
    return tuple(spread if spread > 1e-9 * largest else 0.0 for spread, largest in found)


def observer_of(scenario: Scenario, fit: PriorFit, train: Sequence[Trajectory]) -> Filter:
    """The observer that a run's kit has of the fitted prior."""
    dt, prior = scenario.data.dt, scenario.prior(fit.values)
    known = smoothed(scenario.prior, fit, train, dt)
    info = replace(
        model_info(prior, dt), input_delay=fit.delay, time_unit=time_unit(train, dt),
        state_spread=spread_of([t.x for t in known]), output_spread=spread_of([t.y for t in known]),
    )  # fmt: skip
    programs = {f"prior/{name}": p for name, p in prior_programs(prior, dt, fit.substeps).items()}
    model, chosen = build_model("prior", programs, info), scenario.disturbance_model
    if chosen is None and scenario.control is not None:
        chosen = default_disturbances(model, scenario.control)
    model = replace(model, disturbance_model=chosen)
    late = slice(lost_samples(fit.delay, dt), None)
    commanded = [replace(t.part(late), x=s.x, xdot=s.xdot) for t, s in zip(train, known, strict=True)]
    base = process_noise(model, commanded)
    noise = tuned_noise(model, scenario, base, commanded, observer=True, known=scenario.state_noise)
    return make_estimator(model, scenario, noise)


def find_tracked(
    scenario: Scenario,
    fit: PriorFit,
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    length: float,
    horizon: float,
) -> tuple[Varying, Tracking]:
    """Find the parameters that vary between recordings, and those of them that an observer should track.

    Observers are judged by predictions along the recordings (:func:`~hybrid_mpc.identify.ahead.choose_tracked`): the
    observer of the given fit, and, in turn, that of a fit without a group of recordings, by these recordings. A single
    recording has no second set.

    Args:
        scenario: Prior, data specification, sensor noise and control problem.
        fit: The fit to all these recordings.
        train: Training trajectories, inputs as commanded.
        valid: Validation trajectories.
        length: Length [s] of the free runs of the fit.
        horizon: Length [s] of the predictions.
    """
    spec, recordings = scenario.data, [*train, *valid]
    varying = find_varying(scenario.prior, fit, recordings, dt=spec.dt, length=length)
    files = sorted({t.file for t in recordings})
    groups = [set(files[k::FITS]) for k in range(min(FITS, len(files)))]
    held: list[tuple[Filter, Sequence[Trajectory]]] = []
    for out in groups if len(files) > 1 else []:
        kept = [[t for t in part if t.file not in out] for part in (train, valid)]
        if kept[0]:
            own = fit_prior(
                scenario.prior,
                *kept,
                dt=spec.dt,
                length=length,
                largest_delay=spec.largest_delay,
                warm_up=spec.warm_up,
                start=fit.values,
            )
            held.append((observer_of(scenario, own, kept[0]), [t for t in recordings if t.file in out]))
    watched: list[list[tuple[Filter, Sequence[Trajectory]]]] = [
        [(observer_of(scenario, fit, train), recordings)]
    ]
    watched += [held] if held else []
    return varying, choose_tracked(watched, varying, horizon, warm_up=spec.warm_up)
