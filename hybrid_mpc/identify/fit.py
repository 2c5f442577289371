"""Fit of a prior to measured outputs: multiple shooting with free initial states, exact derivatives, a robust loss.

Recordings are cut into windows. The initial state of each window is unknown and is eliminated from every Gauss-Newton
step. So measured states need not be exact, and unmeasured states are estimated. All windows and all derivatives are one
batch of array operations (:mod:`~hybrid_mpc.identify.simulation`).
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
from hybrid_mpc.identify.prior_result import ENOUGH, FROM_WARM_UP, PREDICTIONS, PriorFit, winner
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
from hybrid_mpc.identify.warm_up import refitted
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
"""Lengths of the windows [time units, :func:`~hybrid_mpc.data.scales.time_unit`], one after the other. Short windows
have a single optimum; long windows match the use of the model."""
APART = 4.0
"""Maximum ratio of one length to the next."""
QUIET = 3.0
"""Ratio of the error to the sensors' noise below which longer windows or whole recordings are fitted."""
SHIFT, EXACT = 0.2, 1e-5
"""Tolerated change of a parameter when integration steps are halved: in standard errors, and relative to its value."""
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
    warm_up: float = 0.0,
    on_progress: Progress = lambda done, total, text: None,
) -> PriorFit:
    """Fit parameters and delay to the measured outputs over windows of increasing length, and fit the smoother.

    1. **Starts.** Each length starts from the best of: nominal values, several points between the bounds, and results
       of shorter windows. Up to ``FOLLOWED`` starts are followed if their errors are similar.
    2. **Lengths.** On an unstable machine, windows are not longer than the time in which small errors grow by a factor
       of 100, unless the error is close to the sensors' noise. If it is, whole recordings come last.
    3. **Selection.** Of the nominal values and all lengths, the result with the least error over the longest windows is
       used, on training and validation recordings together. (A few parameters hardly overfit, and on a drifting machine
       a short validation part alone would mislead.)
    4. **Warm-up.** If free runs from a ``warm_up`` have more than twice that error, the parameters are fitted to such
       runs; the result is used if it halves their error (:mod:`~hybrid_mpc.identify.warm_up`).
    5. **Regularization.** A weak pull towards the nominal values keeps parameters that are not identifiable there.
    6. **Integration.** At the end, integration steps are halved until this no longer changes a parameter significantly.

    The order of the recordings does not matter, and recordings that follow each other within a period are joined
    (:func:`continued`). A prior without free parameters stays unchanged.

    If inputs respond to outputs (:func:`feedback`), the fit warns and also fits one-step prediction errors. If inputs
    seem to act late although no delay is fitted, the fit warns, unless initial states are known or shared.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training trajectories.
        valid: Validation trajectories (used for the selection only).
        dt: Model period [s].
        length: Length [s] of the longest windows: that of the free runs of the model's evaluation. Default: 5 time
            units, or 3 times the largest time constant of the nominal prior if that is longer.
        largest_delay: Largest delay [s] of the inputs. Default 0: no delay is fitted.
        start: Values [their units] by name of another start, e.g. of a global search; fixed parameters are ignored.
            Default: none.
        time_unit: The machine's time unit [s]. Default: that of the training trajectories.
        first_states: Knowledge about the initial states of free runs. Default: none, all are free.
        warm_up: Length [s] of the past from which the evaluation determines the initial state of a free run. Default 0:
            no runs from a warm-up.
        on_progress: ``(done, total, text)`` after every stage.

    Raises:
        InputError: If a state is not observable, no trajectory is long enough, or the prior diverges with all tested
            parameters.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> runs = exact_runs("train", 1)
        >>> fit = fit_prior(PendulumPrior, runs, runs, dt=0.01)
        >>> round(fit.values["l"], 3)
        0.045

    Source: Bock, *Recent advances in parameter identification techniques for O.D.E.* (1983).
    """
    if first_states.kind not in ("known", "shared"):  # these belong to the first sample of each trajectory
        train, valid = continued(train), continued(valid)
    # the order of files does not matter
    train, valid = (sorted(part, key=place_among) for part in (train, valid))
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
    if fit.substeps(fit.nominal) > smoother.substeps:  # stiff in the region of the recordings
        smoother = replace(smoother, substeps=fit.substeps(fit.nominal))
        every = with_states([*train, *valid], smoother, fit.delay(fit.nominal))
        fit.points = visited(every)
    guesses = every[: len(train)], every[len(train) :]
    moved = [robust_spread(column) for column in np.concatenate([t.x for t in guesses[0]]).T]
    sizes = np.maximum(smoother.sizes.x, moved)  # a smoothed state is only a rough initial guess
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
            every_start = [fit.nominal, *begun, *followed]  # short windows may have led to a wrong optimum
            solved = [longer.solve(one) for one in promising(fit, longer, every_start)]
            if beyond and not any(_quiet(longer, one.theta, noise) for one in solved):
                break  # no initial states were found that explain windows of this length
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
        # whole recordings are used from 1.2 times the previous length on
        more = whole > 1.2 * periods and 0.8 * min(whole, LONGEST) * dt < fit.reach(followed[0])
        if more and _quiet(problem, followed[0], noise):  # fewer windows have fewer unknown initial states
            on_progress(total - 1, total, "whole recordings")
            longer = problem_of(guesses[0], None)
            solution = longer.solve(followed[0])
            if _quiet(longer, solution.theta, noise):
                problem, scoring = longer, parts_of(None)
                found.append(("whole recordings", [solution], longer))
    candidates = [("nominal", Fitted(fit.nominal, np.zeros((0, 0)), ()))]
    for name, solved, _ in found:  # of each length the result that is best over the longest windows
        errors = _errors_of([one.theta for one in solved], scoring)
        candidates.append((name, solved[int(np.argmin(errors))]))
    problems = {name: problem for name, _, problem in found}
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
        chosen = settled if after <= ENOUGH * before else chosen  # its updated weights may favour one output
    smoother = smoother_of(chosen)
    acting = shifted(train, fit.delay(chosen.theta))
    # a controller commands; acting inputs hold earlier commands, whose effects are in the errors if the delay is off
    commanded = [t.u[-len(own.u) :] for t, own in zip(train, acting, strict=True)]
    answered = feedback(commanded, smoother.prediction_errors(acting))
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
    if fit.free and first_states.kind == "free":
        from_past = refitted(
            fit, chosen, smoother, [one.theta for _, one in candidates],
            shifted([*train, *valid], fit.delay(chosen.theta)), min(scores),
            warm=round(warm_up / dt), periods=periods, smoother_of=smoother_of,
        )  # fmt: skip
        if from_past is not None:
            chosen, smoother = from_past
            candidates.append((FROM_WARM_UP, chosen))
            scores += _errors_of([chosen.theta], scoring)
    stages = tuple({"stage": c[0], "validation_error": s} for c, s in zip(candidates, scores, strict=True))
    warnings = warnings_of(fit, chosen, answered, min(scores) / max(scores[0], 1e-300))
    lacking, late = 0.0, tuple[str, ...]()
    if fit.free and not largest_delay and first_states.kind not in ("known", "shared"):
        lacking, late = late_inputs(fit, chosen.theta, guesses, periods, sizes, first_states)
    on_progress(total, total, "done")
    return PriorFit(
        values=fit.values(chosen.theta),
        standard_errors=standard_errors(fit, chosen),
        warnings=(*warnings, *late),
        stages=stages,
        correlations=correlations(fit, chosen),
        delay=fit.delay(chosen.theta),
        unidentified=chosen.unidentified,
        lacking_delay=lacking,
        **smoother.smoother_settings,
    )


def refit(
    make: Callable[..., Prior],
    fit: PriorFit,
    trajectories: Sequence[Trajectory],
    *,
    dt: float,
    lengths: Sequence[float],
) -> PriorFit:
    """Fit the parameters again to recordings of a machine that has changed, starting from an earlier fit.

    Delay and smoother stay unchanged. ``lengths`` [s] are the lengths of the windows, one after the other, limited by
    the longest recording.
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
    """Trajectories with the inputs that act, and with states smoothed by the fitted prior; networks train on these."""
    return fit.smoother(make(fit.values), dt).smooth(shifted(trajectories, fit.delay))


def beyond_ranges(prior: Prior, smoothed: Sequence[Trajectory]) -> tuple[str, ...]:
    """Warnings about states that leave their declared range in the smoothed recordings.

    Example:
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> beyond_ranges(PendulumPrior(), exact_runs("train", 1))
        ()
    """
    x = np.concatenate([t.x for t in smoothed])
    # 5 % of its own span: a smoother overshoots
    return tuple(
        f"with the fitted values, {s.label} reaches {low:.4g} to {high:.4g}, outside its range [{s.lower:g}, "
        f"{s.upper:g}]: the range is wrong, or the prior lacks an effect that limits {s.name}"
        for s, low, high in zip(prior.states, x.min(0), x.max(0), strict=True)
        if low < s.lower - 0.05 * (high - low) or high > s.upper + 0.05 * (high - low)
    )


def parameter_variance(
    prior: Prior, covariance: Array, x: Array, u: Array, w: Array, dt: float, substeps: int = 0
) -> Array:
    """Variance of the outputs of free runs due to the parameters' covariance ``(b, n, n_y)`` [output units^2].

    To first order: ``S C S'`` with the sensitivities ``S`` of the outputs and the covariance ``C``.

    Args:
        prior: The fitted prior.
        covariance: Covariance of its parameters ``(n_p, n_p)``; empty if unknown, which gives a variance of zero.
        x: Initial states ``(b, n_x)``.
        u: Inputs ``(b, n, n_u)``.
        w: Disturbances ``(b, n, n_w)``.
        dt: Period [s].
        substeps: Runge-Kutta sub-steps a period. Default 0: as many as the prior needs at rest.
    """
    if not covariance.size:
        return np.zeros((*u.shape[:2], len(prior.outputs)))
    free = tuple(range(len(prior.parameters)))
    simulation = simulation_of(prior.equations.xdot, dt, free, prior.equations.output)
    with np.errstate(over="ignore", invalid="ignore"):  # a diverging run has an infinite variance
        _, slope = simulation.by_parameters(x, u, w, prior.p, substeps or required_substeps(prior, dt))
        variance = np.sum((slope @ covariance) * slope, axis=-1)
    return np.asarray(np.nan_to_num(np.maximum(variance, 0.0), nan=np.inf))


def check_observable(prior: Prior, dt: float, time_unit: float) -> None:
    """Refuse a prior with unobservable states.

    Raises:
        InputError: If a state is not observable; names the states.
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
    """Trajectories with roughly smoothed states and commanded inputs, without the first samples under a delay."""
    made = []
    for t, s in zip(trajectories, smoother.smooth(shifted(trajectories, delay)), strict=True):
        made.append(replace(t.part(slice(len(t.t) - len(s.t), None)), x=s.x, xdot=s.xdot))
    return made


def slowest(prior: Prior) -> float:
    """Largest time constant [s] of the prior at rest; integrators and unstable modes are ignored."""
    modes = np.linalg.eigvals(flow_slope(prior.equations.xdot)(*rest_of(prior), prior.p).full())
    rates = -modes.real[-modes.real > 1e-9 * np.abs(modes).max(initial=0.0)]
    return float(1.0 / rates.min()) if len(rates) else 0.0


def _lengths(
    train: Sequence[Trajectory], dt: float, unit: float, length: float, lead: int, reach: float
) -> list[int]:
    """Lengths of the windows [periods], the longest last; half the longest recording if none of them fits.

    ``reach`` [s] is the time in which a small error grows by the larger of ``GROWN``; on an unstable machine, two
    windows within this time come first.
    """
    longest = most_samples(train) - 2 * lead - 1  # smoothing under a delay loses as many samples again
    length = min(length, longest * dt)
    wanted = [own for own in (unit * own for own in LENGTHS) if own < 0.7 * length]
    while wanted and length > 1.5 * APART * wanted[-1]:  # from one length to the next errors must stay small
        wanted.append(wanted[-1] * APART)
    wanted.append(length)
    grown = [reach * math.log(own) / math.log(GROWN[-1]) for own in GROWN]
    # beyond three times that growth, rounding errors hide the initial states
    slow = sorted({min(own, 3.0 * grown[-1]) for own in wanted if own > 1.5 * grown[-1]})
    if slow:
        wanted = [*grown, *slow]
    fitting = [p for p in (scales.periods(own, dt, 2) for own in wanted) if p <= longest]
    return sorted(dict.fromkeys(fitting)) or [max(2, longest // 2)]


def _quiet(problem: Shooting, theta: Array, noise: Array) -> bool:
    """Whether the error over the windows is close to the sensors' noise ``(n_y,)``."""
    share = problem.seen.sum(axis=(0, 1)) / max(problem.seen.sum(), 1)
    least = math.sqrt(float(share @ np.square(noise / problem.spread)))
    return problem.explained([theta])[0] <= QUIET * least


def _with_enough_substeps(fit: OutputFit, problem: Shooting, found: Fitted) -> Fitted:
    """Continue the fit with more sub-steps until halving the steps no longer changes a parameter significantly.

    The change is that of a Gauss-Newton step due to the change of the outputs.
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
    """Root mean squares of the outputs' errors over their spread, with free initial states, over several parts."""
    squares = np.square([part.explained(thetas) for part in parts])
    return np.sqrt(np.average(squares, axis=0, weights=[part.windows.y.size for part in parts])).tolist()
