"""Free runs of models over whole trajectories, and their errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import in_parts
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.settings import TrainingSettings
from hybrid_mpc.identify.simulation import measured_as
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.sound import constant_runs, growth_time
from hybrid_mpc.identify.step import PriorStep, Step
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal

Array = NDArray[np.float64]
STARTS = 5
"""Number of short free runs that start within the length of one run."""
ROUNDING = 1e-9
"""Standard deviation over the largest value of a signal below which the signal is constant up to rounding."""


@dataclass(frozen=True)
class FreeRun:
    """A free run over one trajectory after its warm-up, and the measurement, over n periods.

    Args:
        name: Name of the trajectory.
        t: Times ``(n,)`` [s].
        u: Inputs ``(n, n_u)``.
        x: Smoothed states ``(n, n_x)``.
        x_hat: States of the free run ``(n, n_x)``.
        y: Measured outputs ``(n, n_y)``, not smoothed.
        y_hat: Outputs of the free run ``(n, n_y)``.
        xdot: Mean rates of ``x`` over each period ``(n, n_x)``.
        xdot_hat: Mean rates of ``x_hat`` over each period ``(n, n_x)``.
        balances: Residuals of the prior's balances on the measurement ``(n, n_b)``, in the balance's ``rate_unit``; the
            paper's ΔE_S.
        balances_hat: Residuals on the free run ``(n, n_b)``; the paper's ΔE_M.
        w: Disturbances ``(n, n_w)``.
    """

    name: str
    t: Array
    u: Array
    x: Array
    x_hat: Array
    y: Array
    y_hat: Array
    xdot: Array
    xdot_hat: Array
    balances: Array
    balances_hat: Array
    w: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def squared_errors(self, spread: Sequence[float]) -> Array:
        """Mean over the outputs of the squared error over ``spread`` ``(n_y,)``, for measured samples ``(m,)``."""
        return np.asarray(np.nanmean(self.squares_by_output(spread), axis=1))

    def squares_by_output(self, spread: Sequence[float]) -> Array:
        """Squared error over ``spread`` ``(n_y,)`` of each output, for measured samples ``(m, n_y)``; NaN where an
        output is not measured, infinite where the run diverged.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            squares = np.square((self.y_hat - self.y) / np.array(spread))
        squares = np.where(np.isfinite(self.y) & ~np.isfinite(squares), np.inf, squares)
        return np.asarray(squares[np.isfinite(self.y).any(axis=1)])


@dataclass(frozen=True)
class OutputErrors:
    """Errors of predicted outputs over all measured samples; infinite if a run diverges.

    Args:
        error: Root mean square over the outputs of the error over the output's spread [-]; compares models.
        rmse: Root mean square error by output, ``"phi [rad]"``.
        fit_percent: ``100 (1 - RMSE / standard deviation of the measurement)`` by output: 100 for a perfect prediction,
            0 for the mean. A constant output has no entry.

    Source of ``fit_percent``: Ljung, *System Identification Toolbox User's Guide* (NRMSE fit).
    """

    error: float
    rmse: Mapping[str, float]
    fit_percent: Mapping[str, float]


@dataclass(frozen=True)
class Scores(OutputErrors):
    """Errors of one model over several free runs; infinite if a run diverges.

    Args:
        e_sim: Simulation error: time mean of ``|xdot - xdot_hat|``, each rate over its standard deviation in the
            measurement, averaged over the states [-]. Constant rates are left out.
        violation: Time mean of ``|residual of the model - residual of the measurement|`` by balance, ``"energy [W]"``.
    """

    e_sim: float
    violation: Mapping[str, float]


@dataclass(frozen=True)
class RunLength:
    """Length of the free runs that evaluate models, and why.

    Args:
        seconds: Length [s]; None: whole recordings.
        growth: Time [s] in which small errors grow tenfold; infinite if they do not grow.
        limited: Whether the growth limits the length.
    """

    seconds: float | None
    growth: float
    limited: bool = False

    @property
    def warnings(self) -> tuple[str, ...]:
        """A warning if the growth limits the length."""
        return (
            f"small errors grow tenfold in {self.growth:.2g} s, so long free runs do not compare models. Models are "
            "trained and compared by free runs of that length; free_run of the DataSpec sets another length",
        ) if self.limited else ()  # fmt: skip


def run_length(
    make: Callable[..., Prior],
    fit: PriorFit,
    train: Sequence[Trajectory],
    held_out: Sequence[Trajectory],
    *,
    dt: float,
    warm: int,
    longest: float | None,
    free_run: float | None = None,
) -> RunLength:
    """Length of the free runs of all commands that evaluate models.

    ``free_run`` if it is given. Else whole recordings, unless small errors grow tenfold in less time, and the fitted
    prior is worse than the training mean in whole free runs: then that time, at least two periods.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        fit: The fit.
        train: Smoothed training trajectories.
        held_out: Smoothed trajectories of the other roles; the last role decides: test, else validation.
        dt: Model period [s].
        warm: Samples of the warm-up.
        longest: Length [s] of the longest whole free run; None: no held-out recordings.
        free_run: Length [s] that the user set (:attr:`DataSpec.free_run`). Default: none.
    """
    growth = growth_time(make, fit, [*train, *held_out], dt)
    if free_run is not None or longest is None or growth >= longest:
        return RunLength(free_run, growth)
    prior = make(fit.values)
    smoother = fit.smoother(prior, dt)
    judged = [t for t in held_out if t.role == "test"] or held_out
    runs, spread = evaluation_trajectories(judged, smoother, warm), smoother.sizes.y
    own = score(free_runs(PriorStep(prior, dt, fit.substeps), prior, runs, warm), prior, spread)
    mean = [measured_as(prior, y) for y in constant_runs(train, runs, warm + 1)]
    constant = output_errors(mean, [t.y[warm + 1 :] for t in runs], prior.outputs, spread)
    if own.error <= constant.error:
        return RunLength(None, growth)
    return RunLength(max(growth, 2 * dt), growth, limited=True)


def evaluation_trajectories(
    trajectories: Sequence[Trajectory], smoother: Smoother, warm: int, length: float | None = None
) -> list[Trajectory]:
    """Trajectories for the evaluation of models: their initial states are smoothed from the warm-up alone.

    Args:
        trajectories: Test trajectories, smoothed with all their samples (the models' rates are compared with these).
        smoother: Smoother of the warm-ups; the same for every model.
        warm: Samples of the warm-up.
        length: Length [s] of a run after its warm-up; runs start at intervals of a fifth of this length. A shorter
            trajectory is one run. Default: every trajectory is one run.

    Returns:
        Trajectories whose first ``warm + 1`` states are estimated from the measurements up to sample ``warm`` only.
    """
    pieces = []
    for t in trajectories:
        n = len(t.t) if length is None else min(len(t.t), warm + round(length / t.dt) + 1)
        stride = len(t.t) if length is None else max(1, round(length / t.dt / STARTS))
        pieces += [t.part(slice(a, a + n)) for a in range(0, len(t.t) - n + 1, stride)]
    starts = smoother.smooth([t.part(slice(0, warm + 1)) for t in pieces])
    return [
        replace(t, x=np.vstack([s.x, t.x[warm + 1 :]]), xdot=np.vstack([s.xdot, t.xdot[warm + 1 :]]))
        for t, s in zip(pieces, starts, strict=True)
    ]


def unseen_runs(
    settings: TrainingSettings,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    smoother: Smoother,
    length: float | None = None,
) -> list[tuple[int | None, list[Trajectory]]]:
    """Held-out trajectories of a training: for each network the part of the training data that it left out.

    Validation trajectories are not held out, because they selected the networks' weights. They are used only if no
    network left a part out.

    Args:
        settings: Settings of the training.
        training: Training trajectories, smoothed.
        validation: Validation trajectories.
        smoother: Smoother of the warm-ups; the same for every model.
        length: As in :func:`evaluation_trajectories`.

    Returns:
        Pairs of a network's number (None: the mean of all networks) and the trajectories for its free runs. Pairs
        without trajectories are left out.
    """
    pieces, part = in_parts(training, settings.parts, settings.shortest)
    unseen: list[tuple[int | None, list[Trajectory]]] = [
        (i, [t for t, own in zip(pieces, part, strict=True) if own == i]) for i in range(settings.networks)
    ]
    if not any(t for _, t in unseen):
        unseen = [(None, list(validation))]
    return [(own, evaluation_trajectories(t, smoother, settings.warm, length)) for own, t in unseen if t]


def free_runs(
    step: Step, prior: Prior, trajectories: Sequence[Trajectory], warm: int, h0: Tensor | None = None
) -> list[FreeRun]:
    """Compute free runs of one model over trajectories; the warm-up is given and not evaluated.

    Args:
        step: The model.
        prior: The prior that defines balances and outputs (the fitted one).
        trajectories: The trajectories (:func:`evaluation_trajectories`); they may differ in length.
        warm: Samples of the warm-up.
        h0: Hidden state before the warm-up ``(n_h,)``. Default: zero.

    Example:
        >>> from hybrid_mpc import PriorStep
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> prior = PendulumPrior()
        >>> runs = free_runs(PriorStep(prior, 0.01), prior, exact_runs("test", 1), warm=10)
        >>> runs[0].x_hat.shape
        (490, 2)
    """
    x_hat = model_states(step, trajectories, warm, h0)
    return [_free_run(prior, t, x_hat[i], warm) for i, t in enumerate(trajectories)]


def stacked_free_runs(
    trained: Trained, prior: Prior, dt: float, balance: Prior, trajectories: Sequence[Trajectory], warm: int
) -> list[list[FreeRun]]:
    """:func:`free_runs` of all networks of a training at once, by network."""
    step = trained.stacked_step(prior, dt)
    x_hat = model_states(step, trajectories, warm)
    return [[_free_run(balance, t, x[i], warm) for i, t in enumerate(trajectories)] for x in x_hat]


def model_states(
    step: Step, trajectories: Sequence[Trajectory], warm: int, h0: Tensor | None = None
) -> Array:
    """States of a model's free runs from sample ``warm`` on, ``(..., runs, samples - warm + 1, n_x)``.

    Shorter trajectories continue with their last input. ``h0`` is the hidden state before the warm-up ``(n_h,)``, for a
    stack ``(networks, 1, n_h)``. Default: zero.
    """
    h0 = step.h0 if h0 is None else h0
    longest = max(len(t.t) for t in trajectories)
    h = h0.expand(*h0.shape[:-2], len(trajectories), h0.shape[-1])
    x_all, u_all, w_all = (
        torch.tensor(np.stack([_padded(getattr(t, key), longest) for t in trajectories]))
        for key in ("x", "u", "w")
    )
    x_all, u_all, w_all = (a.expand(*h.shape[:-2], *a.shape) for a in (x_all, u_all, w_all))
    with torch.no_grad():
        for k in range(warm):
            _, h = step(x_all[..., k, :], h, u_all[..., k, :], w_all[..., k, :])
        held = (a[..., warm:, :].movedim(-2, 0) for a in (u_all, w_all))
        x_hat: Array = step.free_run(x_all[..., warm, :], h, *held).movedim(0, -2).numpy()
    return x_hat


def score(runs: Sequence[FreeRun], prior: Prior, spread: Sequence[float] | None = None) -> Scores:
    """Compute the errors over all samples of free runs, by names and units of the prior's signals and balances.

    Args:
        runs: Free runs (:func:`free_runs`).
        prior: The prior that defines outputs and balances.
        spread: Spread of each output ``(n_y,)`` [output units], which scales ``error``, e.g. ``fit.sizes.y``. Default:
            the standard deviations of the measurement in these runs.

    Raises:
        InputError: If there is no run, or an output was never measured in the runs.

    Example:
        >>> from hybrid_mpc import PriorStep
        >>> from scenarios.pendulum.data import exact_runs
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> prior = PendulumPrior()
        >>> found = score(free_runs(PriorStep(prior, 0.01), prior, exact_runs("test", 1), warm=10), prior)
        >>> list(found.rmse), list(found.violation)
        (['phi [rad]'], ['energy [W]'])
    """
    outputs = output_errors([run.y_hat for run in runs], [run.y for run in runs], prior.outputs, spread)
    xdot, off = np.concatenate([run.xdot for run in runs]), [run.xdot_hat - run.xdot for run in runs]
    sizes = xdot.std(axis=0)
    changing = sizes > ROUNDING * np.abs(xdot).max(axis=0)
    e_sim = np.abs(np.concatenate(off)[:, changing] / sizes[changing]).mean() if changing.any() else 0.0
    gaps = np.concatenate([run.balances_hat - run.balances for run in runs])
    violation = {
        f"{b.name} [{b.rate_unit}]": _finite(np.abs(gap).mean())
        for b, gap in zip(prior.equations.balances, gaps.T, strict=True)
    }
    return Scores(outputs.error, outputs.rmse, outputs.fit_percent, _finite(e_sim), violation)


def output_errors(
    y_hat: Sequence[Array],
    y: Sequence[Array],
    outputs: Sequence[Signal],
    spread: Sequence[float] | None = None,
) -> OutputErrors:
    """Compute the errors of predicted outputs over all runs.

    Args:
        y_hat: Predictions of each run ``(n, n_y)``.
        y: Measurement of each run ``(n, n_y)``; NaN where a sample is missing.
        outputs: Signals of ``y``.
        spread: As in :func:`score`.

    Raises:
        InputError: If there is no run, or an output was never measured in the runs.

    Example:
        >>> y = np.array([[0.0], [1.0], [2.0]])
        >>> found = output_errors([y + 0.1], [y], [Signal("level", "m")])
        >>> found.rmse["level [m]"].__round__(6), found.fit_percent["level [m]"].__round__(2)
        (0.1, 87.75)
    """
    if not y:
        raise InputError("evaluation: no free run; give longer recordings [HM-IDENTIFY-009]")
    measured, predicted = np.concatenate(y), np.concatenate(y_hat)
    rmse, sizes = [], []
    for signal, truth, guess in zip(outputs, measured.T, predicted.T, strict=True):
        seen = np.isfinite(truth)
        if not seen.any():
            raise InputError(
                f"output {signal.label}: never measured in the evaluated free runs. Give recordings with it "
                "[HM-IDENTIFY-010]"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging run has an infinite error
            rmse.append(_finite(np.sqrt(np.mean(np.square(guess[seen] - truth[seen])))))
        size = float(truth[seen].std())
        sizes.append(size if size > ROUNDING * float(np.abs(truth[seen]).max()) else 0.0)
    scale = sizes if spread is None else [float(s) for s in spread]
    known = [(e, s) for e, s in zip(rmse, scale, strict=True) if s > 0]
    return OutputErrors(
        float(np.sqrt(np.mean([(e / s) ** 2 for e, s in known]))) if known else float("inf"),
        {signal.label: e for signal, e in zip(outputs, rmse, strict=True)},
        {signal.label: 100 * (1 - e / s) for signal, e, s in zip(outputs, rmse, sizes, strict=True) if s > 0},
    )


def _finite(value: Any) -> float:
    """The number; infinite if a run has diverged."""
    return float(value) if np.isfinite(value) else float("inf")


def _free_run(prior: Prior, trajectory: Trajectory, x_hat: Array, warm: int) -> FreeRun:
    n, dt = len(trajectory.t) - warm - 1, trajectory.dt
    part = slice(warm, warm + n)
    u, w, x = trajectory.u[part], trajectory.w[part], trajectory.x[part]
    xdot, xdot_hat = np.diff(trajectory.x[warm:], axis=0) / dt, np.diff(x_hat[: n + 1], axis=0) / dt
    equations, held = prior.equations, (u.T, w.T, prior.p)
    y_hat = measured_as(prior, equations.output(x_hat[:n].T, *held).full().T)
    measured, model = (
        np.array([b.residual(*(z.T for z in point), *held).full()[0] for b in equations.balances])
        .reshape(len(equations.balances), n)
        .T
        for point in ((x, xdot), (x_hat[:n], xdot_hat))
    )
    return FreeRun(
        name=trajectory.name,
        t=trajectory.t[part],
        u=u,
        x=x,
        x_hat=x_hat[:n],
        y=trajectory.y[part],
        y_hat=y_hat,
        xdot=xdot,
        xdot_hat=xdot_hat,
        balances=measured,
        balances_hat=model,
        w=w,
    )


def _padded(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])


def input_correlation(errors: Sequence[Array], inputs: Sequence[Array], lags: int) -> tuple[Array, float]:
    """Correlation of free-run errors with an earlier input, and the band of independent signals.

    A correlation outside the band means that the model lacks an effect of this input, or has a wrong gain or delay.
    Both signals are autocorrelated, so the band is Bartlett's: ``1.96 sqrt(sum_k rho_e(k) rho_u(k) / n)``.

    Args:
        errors: Errors of an output in each run ``(n,)``; NaN for a missing sample.
        inputs: The input in each run ``(n,)``.
        lags: Largest lag [samples].

    Returns:
        Correlations at lags 0 to ``lags`` ``(lags + 1,)``, and half the width of the 95 % band; NaN if one of the two
        signals is constant.

    Source: Box, Jenkins, Reinsel, Ljung, *Time Series Analysis*, 5th edition, 2015, section 12.1; Ljung, *System
    Identification*, 2nd edition, 1999, section 16.6.

    Example:
        >>> u = np.random.default_rng(0).standard_normal(4000)
        >>> rho, band = input_correlation([np.roll(u, 3)], [u], 5)
        >>> int(np.argmax(rho)), round(float(rho[3]), 2), round(band, 2)
        (3, 1.0, 0.04)
    """
    pairs = [(e[np.isfinite(e)], u[np.isfinite(e)]) for e, u in zip(errors, inputs, strict=True)]
    pairs = [(e - e.mean(), u - u.mean()) for e, u in pairs if len(e) > lags + 1]
    n = sum(len(e) for e, _ in pairs)
    size = np.sqrt(sum(float(e @ e) for e, _ in pairs) * sum(float(u @ u) for _, u in pairs))
    if not size > 0:
        return np.full(lags + 1, np.nan), float("nan")

    def at(lag: int, first: int, second: int) -> float:
        return sum(float(p[first][lag:] @ p[second][: len(p[second]) - lag]) for p in pairs)

    rho = np.array([at(k, 0, 1) for k in range(lags + 1)]) / size
    far = max(lags, min(len(e) for e, _ in pairs) // 4)
    own = [np.array([at(k, i, i) for k in range(far + 1)]) for i in (0, 1)]
    memory = 2.0 * float((own[0][1:] / own[0][0]) @ (own[1][1:] / own[1][0])) + 1.0
    return rho, 1.96 * float(np.sqrt(max(memory, 1.0) / n))
