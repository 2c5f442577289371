"""Fit of a prior to measured outputs: multiple shooting with free first states, exact derivatives, a robust loss.

Recordings are cut into windows. The state at the start of each is an unknown that is eliminated from every
Gauss-Newton step, so that no measured state is taken for exact and states that no sensor sees need no measurement.
All windows and all directions are one batch of array operations (:mod:`~hybrid_mpc.identify.simulation`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data import scales
from hybrid_mpc.data.scales import robust_spread
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.closed_loop import feedback, fit_by_prediction
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.fit_warnings import late_inputs, warnings_of
from hybrid_mpc.identify.identifiable import Fitted, correlations, standard_errors
from hybrid_mpc.identify.output_fit import GROWN, OutputFit
from hybrid_mpc.identify.prior_result import ENOUGH, PREDICTIONS, PriorFit, winner
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.simulation import (
    MAX_SUBSTEPS,
    flow_slope,
    required_substeps,
    rest_of,
    simulation_of,
    visited,
)
from hybrid_mpc.identify.smooth import Smoother, fit_smoother, rough_smoother, unseen_states
from hybrid_mpc.identify.starts import further_starts, promising, promising_starts
from hybrid_mpc.identify.windows import (
    FEW,
    FREE,
    LONGEST,
    WINDOWS,
    FirstStates,
    continued,
    cut_outputs,
    most_samples,
    place_among,
)
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
LENGTHS = (0.5, 2.0, 5.0)
"""Lengths of the windows [time units, :func:`~hybrid_mpc.data.scales.time_unit`], one after the other: short
ones have one optimum, long ones are what counts."""
APART = 4.0
"""Ratio of one length to the next at most."""
QUIET = 3.0
"""Ratio of what is left to the sensors' noise up to which windows grow on beyond that."""
SHIFT, EXACT = 0.2, 1e-5
"""Shift of a parameter by half as long integration steps that is small enough: standard errors, and share of it."""
Progress = Callable[[int, int, str], None]


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
    first_states: FirstStates = FREE,
    on_progress: Progress = lambda done, total, text: None,
) -> PriorFit:
    """Fit parameters and delay to the measured outputs over longer and longer windows, and find what smooths states.

    Each length starts from what explains its windows best of what is known: the nominal values, the best of several
    starts between the bounds, and what shorter windows found; up to ``FOLLOWED`` of them are followed where they do
    about as well. A machine on which small errors grow gets windows no longer than these take to grow a hundredfold,
    unless little more than the sensors' noise is left; where that is all that is left, whole recordings come last. Of
    the nominal values and all lengths the one wins that explains the longest windows best, over training and validation
    recordings together: few parameters do not overfit, and where a machine drifts a short validation part alone
    misleads. A prior without free parameters stays as it is.

    Parameters are held loosely at their nominal values, so that what the data do not tell stays where it is. At the end
    integration steps are halved until that moves no parameter by what counts. The order of the recordings is no matter,
    and those that follow each other within a period count as one (:func:`continued`).

    Recordings whose inputs answer to the outputs (:func:`feedback`) warn, and the errors of predictions are fitted too.
    Inputs that seem to act late warn where parameters are fitted and no delay is, and first states are not known ones.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (chosen by, not fitted to).
        dt: Model period [s].
        length: Length [s] of the longest windows: that of the runs that the model will be evaluated by. Default: 5 of
            time units, or 3 of the nominal prior's largest time constant where that is more.
        largest_delay: Longest delay [s] of the inputs. Default 0: they act at once.
        start: Values [their units] by name to try as a start besides the nominal ones, e.g. those of a global search;
            fixed parameters are left out. Default: none.
        time_unit: The machine's time unit [s]. Default: that of the training trajectories.
        first_states: What is known of the states that free runs start from. Default: nothing, they are free.
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
    if first_states.kind not in ("known", "shared"):  # which are those of each trajectory's first sample
        train, valid = continued(train), continued(valid)
    train, valid = (
        sorted(part, key=place_among) for part in (train, valid)
    )  # the order of files is no matter
    fit = OutputFit(make, dt, largest_delay)
    unit = scales.time_unit(train, dt) if time_unit is None else time_unit
    check_observable(fit.prior, dt, unit)
    first_states.check(fit.prior, largest_delay)
    if most_samples(train) < fit.lead + 3:
        raise InputError(
            f"recordings: too short to fit {type(fit.prior).__name__}. The longest has {most_samples(train)} samples, "
            f"but at least {fit.lead + 3} are needed. Give longer recordings [HM-IDENTIFY-017]"
        )
    if length is None:
        # three times the largest time constant of the nominal prior
        length = max(LENGTHS[-1] * unit, 3.0 * slowest(fit.prior))
    on_progress(0, 1, "smoothing by the nominal prior")
    smoother = rough_smoother(fit.prior, shifted(train, fit.delay(fit.nominal)), dt, time_unit=unit)
    noise = np.array(smoother.sizes.noise)
    every = with_states([*train, *valid], smoother, fit.delay(fit.nominal))
    fit.points = visited(every)
    if fit.substeps(fit.nominal) > smoother.substeps:  # stiff where the recordings go
        smoother = replace(smoother, substeps=fit.substeps(fit.nominal))
        every = with_states([*train, *valid], smoother, fit.delay(fit.nominal))
        fit.points = visited(every)
    guesses = every[: len(train)], every[len(train) :]
    moved = [robust_spread(column) for column in np.concatenate([t.x for t in guesses[0]]).T]
    sizes = np.maximum(smoother.sizes.x, moved)  # a rough guess is no measurement
    lengths = _lengths(train, dt, unit, length, fit.lead, fit.reach(fit.nominal))
    total = len(lengths) + 2

    def problem_of(part: Sequence[Trajectory], periods: int | None, most: int = WINDOWS) -> Shooting:
        known = fit.prior.states, fit.prior.outputs, first_states
        return Shooting(fit, cut_outputs(part, periods, fit.lead, most, *known), sizes)

    def parts_of(periods: int | None) -> list[Shooting]:
        """Training and validation windows by which candidates are compared, as far as recordings hold them."""
        return [
            problem_of(part, periods) for part in guesses if most_samples(part) > (periods or 2) + fit.lead
        ]

    periods, scoring = lengths[-1], parts_of(lengths[-1])
    found: list[tuple[str, list[Fitted], Shooting]] = []
    if len(fit.nominal):
        on_progress(1, total, "several starts")
        far = max(p for p in lengths if p == lengths[0] or 0.8 * p * dt <= fit.reach(fit.nominal))
        short, long = (problem_of(guesses[0], own, FEW) for own in (lengths[0], far))
        begun = promising_starts(fit, short, long, start)
        followed, problem = begun, short
        for i, own in enumerate(lengths):
            beyond = i > 0 and 0.8 * own * dt > fit.reach(followed[0])
            if beyond and not _quiet(problem, followed[0], noise):
                break
            name, longer = f"free runs of {own * dt:.3g} s", problem_of(guesses[0], own)
            on_progress(2 + i, total, name)
            every_start = [fit.nominal, *begun, *followed]  # short windows may have led astray
            solved = [longer.solve(one) for one in promising(fit, longer, every_start)]
            if beyond and not any(_quiet(longer, one.theta, noise) for one in solved):
                break  # first states that explain so long windows were not found
            periods, problem = own, longer
            if own == lengths[-1]:
                solved += further_starts(fit, problem, solved)
            scoring = parts_of(own) or [problem]
            errors = _errors_of([one.theta for one in solved], scoring)
            solved = [solved[k] for k in np.argsort(errors, kind="stable")]
            found.append((name, solved, problem))
            followed = [one.theta for one in solved]
            # errors grow within ten windows: the nominal prior's states are no start for longer windows
            if fit.reach(followed[0]) < 10.0 * lengths[-1] * dt:
                again = rough_smoother(
                    make(fit.values(followed[0])), shifted(train, fit.delay(followed[0])), dt, time_unit=unit
                )
                again = replace(again, substeps=fit.substeps(followed[0]))
                every = with_states([*train, *valid], again, fit.delay(followed[0]))
                guesses = every[: len(train)], every[len(train) :]
        whole = most_samples(guesses[0]) - fit.lead - 1
        # whole recordings pay from 1.2 times the windows before on
        more = whole > 1.2 * periods and 0.8 * min(whole, LONGEST) * dt < fit.reach(followed[0])
        if more and _quiet(problem, followed[0], noise):  # each window spends some numbers on its first state
            on_progress(total - 1, total, "whole recordings")
            longer = problem_of(guesses[0], None)
            solution = longer.solve(followed[0])
            if _quiet(longer, solution.theta, noise):
                problem, scoring = longer, parts_of(None)
                found.append(("whole recordings", [solution], longer))
    candidates = [("nominal", Fitted(fit.nominal, np.zeros((0, 0)), ()))]
    problems = {}
    for name, solved, problems[name] in found:  # of each length what is best over the longest windows
        errors = _errors_of([one.theta for one in solved], scoring)
        candidates.append((name, solved[int(np.argmin(errors))]))
    scores = _errors_of([c.theta for _, c in candidates], scoring)
    on_progress(total - 1, total, "smoothing with the fitted prior")

    if not np.isfinite(min(scores)):
        raise InputError(
            "prior: it diverges with all tested parameters. Check its signs and units [HM-IDENTIFY-018]"
        )

    def smoother_of(found: Fitted) -> Smoother:
        acting = shifted([*train, *valid], fit.delay(found.theta))
        fitted, substeps = make(fit.values(found.theta)), fit.substeps(found.theta)
        return fit_smoother(fitted, acting, dt, time_unit=unit, substeps=substeps)

    name, chosen = candidates[winner([name for name, _ in candidates], scores)]
    if len(chosen.covariance):
        chosen = _with_enough_substeps(fit, problems[name], chosen)
        settled = problems[name].settled(chosen.theta)
        before, after = problems[name].explained([chosen.theta, settled.theta])
        chosen = settled if after <= ENOUGH * before else chosen  # weights that follow may favour one output
    smoother = smoother_of(chosen)
    acting = shifted(train, fit.delay(chosen.theta))
    answered = feedback(acting, smoother.prediction_errors(acting, smoother.prior.p[None])[1])
    if fit.free and (answered > 1.0 or fit.reach(chosen.theta) < length):
        on_progress(total - 1, total, PREDICTIONS)
        known = [replace(t, x=s.x) for t, s in zip(acting, smoother.smooth(acting), strict=True)]
        # after two time units an observer has forgotten where it began
        forgotten = min(scales.periods(2.0 * unit, dt, 2), lengths[-1], most_samples(known) - 1)
        windows = cut_outputs(known, forgotten, 0, FEW, fit.prior.states)
        candidates.append((PREDICTIONS, fit_by_prediction(fit, chosen.theta, windows, smoother)))
        scores += _errors_of([candidates[-1][1].theta], scoring)
        if winner([name for name, _ in candidates], scores) == len(scores) - 1:
            chosen = candidates[-1][1]
            smoother = smoother_of(chosen)
    stages = tuple({"stage": c[0], "validation_error": s} for c, s in zip(candidates, scores, strict=True))
    warnings = warnings_of(fit, chosen, answered, min(scores) / max(scores[0], 1e-300))
    if fit.free and not largest_delay and first_states.kind not in ("known", "shared"):
        warnings += late_inputs(fit, chosen.theta, guesses, periods, sizes, first_states)
    on_progress(total, total, "done")
    return PriorFit(
        values=fit.values(chosen.theta),
        standard_errors=standard_errors(fit, chosen),
        warnings=warnings,
        stages=stages,
        correlations=correlations(fit, chosen),
        delay=fit.delay(chosen.theta),
        sigma=smoother.sigma,
        walk=smoother.walk,
        sizes=smoother.sizes,
        fading=smoother.fading,
        substeps=smoother.substeps,
        unidentified=chosen.unidentified,
    )


def refit(
    make: Callable[..., Prior],
    fit: PriorFit,
    trajectories: Sequence[Trajectory],
    *,
    dt: float,
    lengths: Sequence[float],
) -> PriorFit:
    """Parameters fitted anew to recordings of a machine that has changed, from those of an earlier fit on.

    The delay and what smooths states stay. ``lengths`` [s] are those of the windows, one after the other; none
    is longer than the longest recording.
    """
    known = smoothed(make, fit, trajectories, dt)
    own, sizes, stages = OutputFit(make, dt), np.array(fit.smoother(make(fit.values), dt).sizes.x), []
    own.points = visited(known)
    found = Fitted(own.scaled(fit.values), np.zeros((0, 0)), ())
    for length in lengths:
        periods = min(scales.periods(length, dt, 2), most_samples(known) - 1)
        windows = cut_outputs(known, periods, 0, WINDOWS)
        problem = Shooting(own, windows, sizes)
        found = problem.solve(found.theta)
        (error,) = problem.explained([found.theta])
        stages.append({"stage": f"free runs of {length:g} s", "validation_error": error})
    return replace(
        fit, values=own.values(found.theta), standard_errors=standard_errors(own, found),
        warnings=warnings_of(own, found),
        stages=tuple(stages), correlations=correlations(own, found), substeps=own.substeps(found.theta),
    )  # fmt: skip


def smoothed(
    make: Callable[..., Prior], fit: PriorFit, trajectories: Sequence[Trajectory], dt: float
) -> list[Trajectory]:
    """Trajectories with the inputs that act and the states that the fitted prior smooths: what networks train on."""
    return fit.smoother(make(fit.values), dt).smooth(shifted(trajectories, fit.delay))


def beyond_ranges(prior: Prior, smoothed: Sequence[Trajectory]) -> tuple[str, ...]:
    """A warning for each state that leaves its declared range where the prior smooths recordings.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> beyond_ranges(PendulumPrior(), exact_runs("train", 1))
        ()
    """
    x = np.concatenate([t.x for t in smoothed])
    # 5 % of its own span: a smoother overshoots
    return tuple(
        f"{s.label} goes from {low:.4g} to {high:.4g} with the fitted values, beyond its range [{s.lower:g}, "
        f"{s.upper:g}]: the range is wrong, or the prior lacks what keeps it within"
        for s, low, high in zip(prior.states, x.min(0), x.max(0), strict=True)
        if low < s.lower - 0.05 * (high - low) or high > s.upper + 0.05 * (high - low)
    )


def parameter_variance(
    prior: Prior, covariance: Array, x: Array, u: Array, w: Array, dt: float, substeps: int = 0
) -> Array:
    """Variance of the outputs of free runs by that of the parameters ``(b, n, n_y)`` [output units^2].

    Args:
        prior: The fitted prior.
        covariance: Covariance of its parameters ``(n_p, n_p)``; empty where it is not known, which counts as none.
        x: First states ``(b, n_x)``.
        u: Inputs ``(b, n, n_u)``.
        w: Disturbances ``(b, n, n_w)``.
        dt: Period [s].
        substeps: Runge-Kutta sub-steps a period. Default 0: as many as the prior needs at rest.
    """
    if not covariance.size:
        return np.zeros((*u.shape[:2], len(prior.outputs)))
    free = tuple(range(len(prior.parameters)))
    simulation = simulation_of(prior.equations.xdot, dt, free, prior.equations.output)
    with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is as uncertain as can be
        _, slope = simulation.by_parameters(x, u, w, prior.p, substeps or required_substeps(prior, dt))
        variance = np.sum((slope @ covariance) * slope, axis=-1)
    return np.asarray(np.nan_to_num(np.maximum(variance, 0.0), nan=np.inf))


def check_observable(prior: Prior, dt: float, time_unit: float) -> None:
    """Refuse a prior with unobservable states.

    Raises:
        InputError: Naming the states.
    """
    unseen = unseen_states(prior, dt, time_unit)
    if unseen:
        are, them = ("are", "them") if len(unseen) > 1 else ("is", "it")
        raise InputError(
            f"{type(prior).__name__}: {', '.join(unseen)} {are} not observable: no output "
            f"({', '.join(s.name for s in prior.outputs)}) depends on {them}. Measure {them}, remove {them} from the "
            "states, or check output() [HM-IDENTIFY-019]"
        )


def with_states(trajectories: Sequence[Trajectory], smoother: Smoother, delay: float) -> list[Trajectory]:
    """Trajectories with states smoothed roughly, inputs as commanded, and without the samples that a delay costs."""
    made = []
    for t, s in zip(trajectories, smoother.smooth(shifted(trajectories, delay)), strict=True):
        made.append(replace(t.part(slice(len(t.t) - len(s.t), None)), x=s.x, xdot=s.xdot))
    return made


def slowest(prior: Prior) -> float:
    """Largest time constant [s] of the prior at rest; that of an integrator or an unstable mode is none."""
    modes = np.linalg.eigvals(flow_slope(prior.equations.xdot)(*rest_of(prior), prior.p).full())
    rates = -modes.real[-modes.real > 1e-9 * np.abs(modes).max(initial=0.0)]
    return float(1.0 / rates.min()) if len(rates) else 0.0


def _lengths(
    train: Sequence[Trajectory], dt: float, unit: float, length: float, lead: int, reach: float
) -> list[int]:
    """Periods of the windows, the longest last; what the recordings do not hold is cut to half of the longest.

    Of a machine on which a small error grows by the larger of ``GROWN`` over ``reach`` [s] two shorter ones come first.
    """
    longest = most_samples(train) - 2 * lead - 1  # smoothing under a delay costs as many samples again
    length = min(length, longest * dt)
    wanted = [own for own in (unit * own for own in LENGTHS) if own < 0.7 * length]
    while wanted and length > 1.5 * APART * wanted[-1]:  # from one length to the next errors must stay small
        wanted.append(wanted[-1] * APART)
    wanted.append(length)
    grown = [reach * math.log(own) / math.log(GROWN[-1]) for own in GROWN]
    # beyond three times that growth, first states are lost in rounding
    slow = sorted({min(own, 3.0 * grown[-1]) for own in wanted if own > 1.5 * grown[-1]})
    if slow:
        wanted = [*grown, *slow]
    fitting = [p for p in (scales.periods(own, dt, 2) for own in wanted) if p <= longest]
    return sorted(dict.fromkeys(fitting)) or [max(2, longest // 2)]


def _quiet(problem: Shooting, theta: Array, noise: Array) -> bool:
    """Whether of the windows little more is left than the sensors' noise ``(n_y,)``."""
    share = problem.seen.sum(axis=(0, 1)) / max(problem.seen.sum(), 1)
    least = math.sqrt(float(share @ np.square(noise / problem.spread)))
    return problem.explained([theta])[0] <= QUIET * least


def _with_enough_substeps(fit: OutputFit, problem: Shooting, found: Fitted) -> Fitted:
    """The same fit with integration steps so short that halving them moves no parameter by what counts.

    Their number stays the least of this fit. The move is that of a Gauss-Newton step by the change of the outputs.
    """
    while (substeps := fit.substeps(found.theta)) <= MAX_SUBSTEPS // 2:
        error = np.sqrt(np.diag(found.covariance))
        if (
            problem.shift(found.theta, 2 * substeps) <= np.maximum(SHIFT * error, EXACT * np.abs(found.theta))
        ).all():
            break
        fit.least = 2 * substeps
        problem.forget()
        found = problem.solve(found.theta)
    return found


def _errors_of(thetas: Sequence[Array], parts: Sequence[Shooting]) -> list[float]:
    """Root mean squares of the outputs' errors over their spread, with the first states free, over several parts."""
    squares = np.square([part.explained(thetas) for part in parts])
    return np.sqrt(np.average(squares, axis=0, weights=[part.windows.y.size for part in parts])).tolist()
