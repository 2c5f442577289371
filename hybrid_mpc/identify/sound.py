"""Checks of a fitted prior: reasons to stop a run, and reasons to doubt the prior's structure. No torch here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data import scales
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.choose import recommend
from hybrid_mpc.identify.fit import LENGTHS
from hybrid_mpc.identify.fit_warnings import AT_BOUND
from hybrid_mpc.identify.output_fit import GROWN, OutputFit
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.simulation import visited
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.starts import POOR
from hybrid_mpc.identify.windows import FEW, cut_outputs
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
NEAR = 1e-3
"""Distance from a bound, over the range, that counts as at the bound."""
CLEARLY = 0.75
"""Error of a linear model over the fitted prior's below which the prior lacks an effect: two models of the same
structure, fitted to the same recordings, differ by less."""
NEGATIVE = -25.0
"""FIT [%] of an output below which the prior is worse than the mean of the output."""
COSTLY = 0.95
"""Error without a bound over the error with it below which the bound is relevant."""
WORSE = 1.5
"""Error of an output after the fit, over the error before, from which on a warning names it: test recordings
are few, and smaller changes come by chance."""
ITERATIONS = 12
"""Largest number of Gauss-Newton steps of a trial fit, enough for the size of the error."""


@dataclass(frozen=True)
class BoundCost:
    """A fitted parameter at a bound, and the error due to the bound.

    Args:
        parameter: Name of the parameter.
        value: The bound [unit of the parameter].
        free: Fitted value without this bound [unit of the parameter].
        ratio: Free-run error without the bound over the error with it [-]; 1 if the bound is irrelevant.

    Example:
        >>> print(BoundCost("k", 2.0, 2.6, 0.8))
        k ends at its bound 2; with a wider bound the fit gives 2.6, and the error falls to 80 %
    """

    parameter: str
    value: float
    free: float
    ratio: float

    @property
    def costs(self) -> bool:
        """Whether the bound increases the error."""
        return self.ratio < COSTLY

    def __str__(self) -> str:
        ends = f"{self.parameter} ends at its bound {self.value:.4g}"
        if not self.costs:
            return f"{ends}; without the bound, the error changes by less than {100 * (1 - COSTLY):.0f} %"
        return (
            f"{ends}; with a wider bound the fit gives {self.free:.4g}, and the error falls to "
            f"{100 * self.ratio:.0f} %"
        )


def problems(smoother: Smoother, fit: PriorFit, smoothed: Sequence[Trajectory]) -> tuple[str, ...]:
    """Errors of a fit that later stages must not use: non-finite numbers, and states far out of range.

    Args:
        smoother: Smoother of the fitted prior (:meth:`~hybrid_mpc.identify.prior_result.PriorFit.smoother`).
        fit: The fit.
        smoothed: All trajectories with smoothed states.
    """
    prior, found = smoother.prior, []
    numbers = {
        "value": fit.values, "standard error": fit.standard_errors,
        "noise of sensor": dict(zip((s.name for s in prior.outputs), fit.sigma, strict=False)),
        "process noise of state": dict(zip((prior.states[i].name for i in prior.corrected), fit.walk, strict=False)),
    }  # fmt: skip
    for what, values in numbers.items():
        found += [
            f"{what} {name} is not finite ({v}) [HM-IDENTIFY-075]"
            for name, v in values.items()
            if not math.isfinite(v)
        ]
    for i, (state, low, high) in enumerate(zip(prior.states, *smoother.bounds, strict=True)):
        x = np.concatenate([t.x[:, i] for t in smoothed])
        lost = ~np.isfinite(np.concatenate([t.xdot[:, i] for t in smoothed])) | ~np.isfinite(x)
        if lost.any():
            found.append(
                f"{state.label} or its rate is not finite in {lost.sum()} smoothed samples [HM-IDENTIFY-076]"
            )
            continue
        near = NEAR * (high - low) if math.isfinite(high - low) else 0.0
        away = float(np.mean((x <= low + near) | (x >= high - near)))
        # largest share of samples at the bounds of the smoothed states that can be outliers
        if away > 0.05:
            found.append(
                f"{state.label}: three times its range [{state.lower:g}, {state.upper:g}] or more in {away:.0%} of the "
                f"smoothed samples ({x.min():.4g} to {x.max():.4g}). Either the state is not observable, or its range "
                "or an equation is wrong [HM-IDENTIFY-077]"
            )
    return tuple(found)


def correlation_of_errors(errors: Sequence[Array]) -> Array:
    """Correlation of successive one-step prediction errors, by output ``(n_y,)``; zero is white.

    Args:
        errors: Errors of each trajectory ``(n, n_y)``, NaN where nothing was measured.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> white = rng.standard_normal((4000, 1))
        >>> correlation_of_errors([white, white + np.roll(white, 1)]).round(1)
        array([0.3])
    """
    products = np.concatenate([e[1:] * e[:-1] for e in errors])
    squares = np.concatenate([np.square(e) for e in errors])
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.nanmean(products, axis=0) / np.nanmean(squares, axis=0)
    return np.asarray(np.nan_to_num(found))


def growth_time(
    make: Callable[..., Prior], fit: PriorFit, smoothed: Sequence[Trajectory], dt: float
) -> float:
    """Time [s] in which small errors grow tenfold along the recordings; infinite if they do not grow."""
    own = OutputFit(make, dt)
    own.points = visited(smoothed)
    return own.reach(own.scaled(fit.values), GROWN[0])


def warn_of_stability(
    make: Callable[..., Prior], fit: PriorFit, smoothed: Sequence[Trajectory], dt: float
) -> tuple[str, ...]:
    """A warning if the prior is unstable with nominal parameters and far less with fitted ones, or the reverse.

    Recordings in closed loop hardly show whether the machine alone is stable.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        fit: The fit.
        smoothed: Trajectories with smoothed states.
        dt: Model period [s].
    """
    longest = max(float(t.t[-1] - t.t[0]) for t in smoothed)
    nominal, fitted = (
        growth_time(make, one, smoothed, dt) for one in (replace(fit, values=make().values), fit)
    )
    # growth in five times the time counts as none
    if max(nominal, fitted) < 5.0 * min(nominal, fitted) or min(nominal, fitted) > longest:
        return ()
    which, other = ("nominal", "fitted") if nominal < fitted else ("fitted", "nominal")
    return (
        f"the prior is unstable with {which} parameters (small errors grow tenfold in {min(nominal, fitted):.2g} s), "
        f"but hardly or not with {other} parameters. Recordings in closed loop do not show which is right, and a "
        "controller for the wrong parameters may fail. Compare with the machine without control, and narrow the "
        "bounds of the parameters that decide stability (docs/unstable.md) [HM-IDENTIFY-085]",
    )


def trial_length(
    make: Callable[..., Prior],
    fit: PriorFit,
    smoothed: Sequence[Trajectory],
    dt: float,
    longest: float | None,
    time_unit: float,
) -> float:
    """Length [s] of the free runs of trial fits: two time constants of the machine, but at most twice the time in which
    small errors grow tenfold (initial states are free in a fit).
    """
    nominal = replace(fit, values=make().values)
    reach = min(growth_time(make, one, smoothed, dt) for one in (fit, nominal))
    return max(2 * dt, min(LENGTHS[1] * time_unit, 2 * reach, math.inf if longest is None else longest))


def bound_costs(
    make: Callable[..., Prior], fit: PriorFit, smoothed: Sequence[Trajectory], dt: float, length: float
) -> tuple[BoundCost, ...]:
    """Error due to each bound at which a fitted parameter lies.

    The bound is moved by the parameter's whole range, all parameters are fitted again to windows of ``length`` [s], and
    the free-run errors over these windows are compared.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        fit: The fit.
        smoothed: Training trajectories with smoothed states and delayed inputs.
        dt: Model period [s].
        length: Length [s] of the windows.
    """
    own = OutputFit(make, dt)
    own.points = visited(smoothed)
    theta, span = own.scaled(fit.values), own.upper - own.lower
    low, high = theta - own.lower < AT_BOUND * span, own.upper - theta < AT_BOUND * span
    if not (low | high).any():
        return ()
    sizes = np.array(fit.smoother(make(fit.values), dt).sizes.x)
    problem, found = shooting(own, smoothed, sizes, length), []
    bounded = problem.solve(theta, ITERATIONS).theta  # over these windows, as without the bound
    (before,) = problem.explained([bounded])
    for i in np.flatnonzero(low | high):
        free = OutputFit(make, dt)
        free.points = own.points
        free.lower[i] -= span[i] * low[i]
        free.upper[i] += span[i] * high[i]
        problem = shooting(free, smoothed, sizes, length)
        try:
            solved = problem.solve(bounded, ITERATIONS).theta
            (after,) = problem.explained([solved])
        except InputError:  # the equations are invalid or too stiff beyond this bound
            solved, after = bounded, before
        outside = solved[i] < own.lower[i] or solved[i] > own.upper[i]
        name, unit = own.names[i], own.unit[i]
        ratio = after / before if before and outside else 1.0
        found.append(BoundCost(name, float(theta[i] * unit), float(solved[i] * unit), ratio))
    return tuple(found)


def shooting(
    fit: OutputFit, known: Sequence[Trajectory], sizes: Array, length: float, most: int = FEW
) -> Shooting:
    """A shooting problem with at most ``most`` windows of ``length`` [s], or of the length of the recordings."""
    longest = max(len(t.t) for t in known) - 1
    periods = min(scales.periods(length, fit.dt, 2), longest)
    return Shooting(fit, cut_outputs(known, periods, 0, most, fit.prior.states), sizes)


def constant_runs(train: Sequence[Trajectory], test: Sequence[Trajectory], warm: int) -> list[Array]:
    """Outputs of the constant model: the mean of the training outputs, in each test trajectory after its warm-up."""
    mean = np.nanmean(np.concatenate([t.y for t in train]), axis=0)
    return [np.tile(mean, (len(t.t) - warm, 1)) for t in test]


def structure_doubt(error: float, baselines: Mapping[str, float]) -> str:
    """Why a simpler model puts the structure of the fitted prior in doubt; empty if none does.

    Args:
        error: Free-run error of the prior on test recordings, over the outputs' spread.
        baselines: Errors of simpler models on the same runs, by name: ``"constant"`` for the training mean, and linear
            input-output models.

    Example:
        >>> structure_doubt(0.35, {"constant": 1.1, "ARX": 0.3, "N4SID": 0.22})
        'the linear model N4SID has an error of 0.22 on test recordings, the fitted prior 0.35'
        >>> structure_doubt(0.35, {"constant": 1.1, "ARX": 0.3})
        ''
    """
    if not baselines:
        return ""
    name = min(baselines, key=lambda one: baselines[one])
    model = "a constant" if name == "constant" else f"the linear model {name}"
    if name == "constant" and error < baselines[name]:
        return ""
    if name != "constant" and baselines[name] >= CLEARLY * error:
        return ""
    return f"{model} has an error of {baselines[name]:.3g} on test recordings, the fitted prior {error:.3g}"


def bounds_doubt(bounds: Sequence[BoundCost], fitted: int) -> str:
    """Why parameters at bounds put the structure of the fitted prior in doubt; empty if they do not.

    Args:
        bounds: Error due to each bound (:func:`bound_costs`).
        fitted: Number of fitted parameters.

    Example:
        >>> own = [BoundCost("k", 2.0, 2.6, 0.9), BoundCost("d", 0.0, 0.0, 1.0)]
        >>> bounds_doubt(own, 3)
        '2 of 3 fitted parameters end at a bound: k at 2, d at 0'
        >>> bounds_doubt(own, 6)
        ''
        >>> bounds_doubt([BoundCost("k", 2.0, 2.6, 0.5)], 6)
        'k ends at its bound 2; with a wider bound the fit gives 2.6, and the error falls to 50 %'
    """
    # share of the fitted parameters at bounds from which on they compensate a missing effect
    if len(bounds) > 1 and len(bounds) >= 0.5 * fitted:
        ends = ", ".join(f"{one.parameter} at {one.value:.4g}" for one in bounds)
        return f"{len(bounds)} of {fitted} fitted parameters end at a bound: {ends}"
    return "; ".join(str(one) for one in bounds if one.ratio < CLEARLY)


def warn_of_worse_outputs(nominal: Mapping[str, float], fitted: Mapping[str, float]) -> tuple[str, ...]:
    """A warning for each output whose error on test recordings is larger with fitted than with nominal parameters.

    The fit minimises the error over all outputs, each over its spread. One output may get worse for the sake of others.

    Args:
        nominal: Root mean square error by output with nominal parameters, ``"phi [rad]"``.
        fitted: The same with fitted parameters.

    Example:
        >>> warn_of_worse_outputs({"x [mm]": 0.2, "p [bar]": 1.6}, {"x [mm]": 1.2, "p [bar]": 1.1})
        ('x [mm]: the error on test recordings is 1.2 with fitted and 0.2 with nominal parameters',)
    """
    return tuple(
        f"{name}: the error on test recordings is {fitted[name]:.3g} with fitted and {error:.3g} with nominal "
        "parameters"
        for name, error in nominal.items()
        if math.isfinite(error) and fitted[name] > WORSE * error
    )


def warn_of_worse_fit(
    nominal: Sequence[Array], fitted: Sequence[Array], recordings: Sequence[str], samples: int = 1
) -> tuple[str, ...]:
    """A warning if the nominal parameters are significantly better than the fitted ones on the same test runs.

    The statistics are those of the choice of a model (:func:`~hybrid_mpc.identify.choose.recommend`).

    Args:
        nominal: Squared errors of each run ``(n,)`` [-] with nominal parameters.
        fitted: The same with fitted parameters.
        recordings: Recording of each run.
        samples: Minimum samples of a block; errors within a block are correlated. Default: 1.

    Example:
        >>> own = [np.full(50, size) for size in (0.9, 1.0, 1.1, 1.0)]
        >>> len(warn_of_worse_fit(own, [1.4 * one for one in own], ["a", "b", "c", "d"]))
        1
        >>> warn_of_worse_fit(own, own[::-1], ["a", "b", "c", "d"])
        ()
    """
    found = recommend(
        {"fitted": fitted, "nominal": nominal}, prior="fitted", samples=samples, recordings=recordings
    )
    own = found.candidates["nominal"]
    if "nominal" not in found.sure or own.ratio > COSTLY:
        return ()
    return (
        f"on the test recordings the error with nominal parameters is {own.ratio:.2f} times that with fitted ones "
        f"(upper bound {own.upper:.2f}; {found.blocks} {'recordings' if len(set(recordings)) > 1 else 'blocks'}). "
        "Either the training recordings do not cover the conditions of the test recordings, or the prior lacks an "
        "effect. Add training recordings of these conditions, search the effect with 'hybrid-mpc explain', or keep "
        "known values: Parameter(..., fixed=True), or narrower bounds [HM-IDENTIFY-084]",
    )


def fit_doubt(fit_percent: Mapping[str, float], share: Mapping[str, float]) -> str:
    """Which outputs the fitted prior predicts worse than their means; empty if there are none.

    Args:
        fit_percent: FIT [%] of each output, ``"phi [rad]"``, in free runs on test recordings.
        share: Error over the spread of each output in all recordings [-]: an output that hardly moves in a run can have
            a poor FIT and a small error.

    Example:
        >>> fit_doubt({"phi [rad]": -60.0, "level [m]": -40.0}, {"phi [rad]": 1.4, "level [m]": 0.1})
        'free runs of phi have a FIT of -60 % on test recordings: the mean of the output has a smaller error'
    """
    poor = [name for name, fit in fit_percent.items() if fit < NEGATIVE and share[name] > POOR]
    return "; ".join(
        f"free runs of {name.partition(' [')[0]} have a FIT of {fit_percent[name]:.0f} % on test recordings: the mean "
        "of the output has a smaller error"
        for name in poor
    )


def no_gain(unseen: Mapping[str, float], training: Mapping[str, float]) -> str:
    """Why later stages must not use a fitted prior: a constant or the nominal parameters are better; empty otherwise.

    A constant must be better on test and training recordings, since one of them may contain a machine at rest.

    Args:
        unseen: Free-run errors on test recordings, over the outputs' spread, of the fitted prior (``"phy"``), of the
            prior with nominal parameters (``"phy_nominal"``) and of the training mean (``"constant"``).
        training: Errors of ``"phy"`` and ``"constant"`` on the training recordings.

    Example:
        >>> no_gain({"phy": 1.2, "phy_nominal": 2.0, "constant": 0.8}, {"phy": 1.1, "constant": 1.0})
        'on test recordings a constant has an error of 0.8, the fitted prior 1.2; on training recordings 1 and 1.1'
        >>> no_gain({"phy": 0.5, "phy_nominal": 0.3, "constant": 1.0}, {})
        'on test recordings the nominal parameters have an error of 0.3, the fitted ones 0.5'
        >>> no_gain({"phy": 0.05, "phy_nominal": 0.03, "constant": 1.0}, {})
        ''
    """
    error, nominal, constant = (unseen[name] for name in ("phy", "phy_nominal", "constant"))
    if error >= constant and training["phy"] >= training["constant"]:
        return (
            f"on test recordings a constant has an error of {constant:.3g}, the fitted prior {error:.3g}; on training "
            f"recordings {training['constant']:.3g} and {training['phy']:.3g}"
        )
    if error > POOR and nominal < CLEARLY * error:
        return f"on test recordings the nominal parameters have an error of {nominal:.3g}, the fitted ones {error:.3g}"
    return ""
