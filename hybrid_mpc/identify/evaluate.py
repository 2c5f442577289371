"""Free runs of models over whole trajectories, and their figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import in_parts
from hybrid_mpc.identify.settings import TrainingSettings
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.identify.step import Step
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal

Array = NDArray[np.float64]
STARTS = 5
"""Starts of short free runs within the length of one."""
ROUNDING = 1e-9
"""Share of a signal's largest value below which its standard deviation is rounding: it does not change."""


@dataclass(frozen=True)
class FreeRun:
    """A free run over one trajectory after its warm-up, and the measurement; n scored periods.

    ``x`` are the measured, smoothed states, ``y`` the measured outputs, not smoothed; ``xdot`` and ``xdot_hat`` are
    mean rates over each period. ``balances`` ``(n, n_b)`` are the residuals of the prior's balances on the measurement,
    ``balances_hat`` on the model's own run, each in the balance's ``rate_unit``: the paper's ΔE_S and ΔE_M.
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
        """Mean over the outputs of the squared error over ``spread`` ``(n_y,)``, where any was measured ``(m,)``."""
        squares = np.square((self.y_hat - self.y) / np.array(spread))
        seen = np.isfinite(self.y).any(axis=1)
        with np.errstate(invalid="ignore"):
            squares = np.where(np.isfinite(self.y) & ~np.isfinite(squares), np.inf, squares)
        return np.asarray(np.nanmean(squares[seen], axis=1))


@dataclass(frozen=True)
class OutputErrors:
    """How far predicted outputs are off, over all samples that were measured; a diverging run makes them infinite.

    Args:
        error: Root mean square over the outputs of the error over the output's spread [-]: one number to compare
            models by, whatever the units.
        rmse: Root mean square error by output, ``"phi [rad]"``.
        fit_percent: ``100 (1 - RMSE / standard deviation of the measurement)`` by output: 100 is perfect, 0 what the
            mean alone gives. An output that does not change has none.

    Source of ``fit_percent``: Ljung, *System Identification Toolbox User's Guide* (NRMSE fit).
    """

    error: float
    rmse: Mapping[str, float]
    fit_percent: Mapping[str, float]


@dataclass(frozen=True)
class Scores(OutputErrors):
    """Figures of one model over several free runs; a diverging run makes them infinite.

    Args:
        e_sim: Simulation error in duration form: time mean of ``|xdot - xdot_hat|``, each rate over its standard
            deviation in the measurement, averaged over the states [-]. A rate that does not change is left out.
        violation: Time mean of ``|residual of the model - residual of the measurement|`` by balance, ``"energy [W]"``.
    """

    e_sim: float
    violation: Mapping[str, float]


def evaluation_trajectories(
    trajectories: Sequence[Trajectory], smoother: Smoother, warm: int, length: float | None = None
) -> list[Trajectory]:
    """The trajectories that a model is evaluated on: their starts are smoothed from their warm-ups alone.

    Args:
        trajectories: Test trajectories, smoothed with all their samples (the models' rates are compared with these).
        smoother: Smoother of the warm-ups; the same for every model.
        warm: Samples of the warm-up.
        length: Length [s] of a run after its warm-up; one starts every fifth of it. A shorter trajectory is one run.
            Default: every trajectory is one run.

    Returns:
        Trajectories whose first ``warm + 1`` states know the measurements up to sample ``warm`` and none after it.
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
    """Trajectories that a training is evaluated on, which its networks did not see: the parts that they left out.

    The validation is none of them: the networks' weights were chosen by it. It is where nothing could be left out.

    Args:
        settings: Of the training.
        training: Trajectories that it was given to train on, smoothed.
        validation: Those that its weights were chosen by.
        smoother: Smoother of the warm-ups; the same for every model.
        length: As in :func:`evaluation_trajectories`.

    Returns:
        Pairs of the network that is to run alone, None for the mean of all, and what over. There is no pair without
        trajectories.
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
    """Free runs of one model over trajectories; the warm-up is given and not scored.

    Args:
        step: The model.
        prior: The prior whose balances and outputs count (the fitted one).
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
    """:func:`free_runs` of all networks of a training at once: those of the first network, the second, ..."""
    step = trained.stacked_step(prior, dt)
    x_hat = model_states(step, trajectories, warm)
    return [[_free_run(balance, t, x[i], warm) for i, t in enumerate(trajectories)] for x in x_hat]


def model_states(
    step: Step, trajectories: Sequence[Trajectory], warm: int, h0: Tensor | None = None
) -> Array:
    """States of a model that runs freely from sample ``warm`` on, ``(..., runs, samples - warm + 1, n_x)``.

    Shorter trajectories go on under their last input. ``h0`` ``(n_h,)``, of a stack ``(networks, 1, n_h)``, is the
    hidden state before the warm-up; default zero.
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
    """Figures over all samples of free runs, by the names and units of the prior's signals and balances.

    Args:
        runs: Free runs (:func:`free_runs`).
        prior: The prior whose outputs and balances they have.
        spread: Spread of each output ``(n_y,)`` [output units] that ``error`` is over, e.g. ``fit.sizes.y``. Default:
            the standard deviations of the measurement in these runs.

    Raises:
        InputError: If there is no run, or an output was never measured in them.

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
    """How far predicted outputs are off the measured ones, over all runs.

    Args:
        y_hat: Predictions of each run ``(n, n_y)``, and
        y: the measurement; NaN where a sample is missing.
        outputs: Signals of ``y``.
        spread: As :func:`score` has it.

    Raises:
        InputError: If there is no run, or an output was never measured in them.

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
        with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is infinitely wrong
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
    """The number; infinite where a run has diverged."""
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


def measured_as(prior: Prior, y: Array) -> Array:
    """Outputs ``(..., n_y)`` as the sensors show them: within the ranges that they declare."""
    ends = [s.saturation or (-np.inf, np.inf) for s in prior.outputs]
    return np.asarray(np.clip(y, [low for low, _ in ends], [high for _, high in ends]))


def _padded(values: Array, length: int) -> Array:
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), axis=0)])


def input_correlation(errors: Sequence[Array], inputs: Sequence[Array], lags: int) -> tuple[Array, float]:
    """What of free runs' errors an input of before explains: their correlation, and the band of independent ones.

    Beyond the band something that this input drives is missing in the model, or has another size or delay there. Both
    signals remember, so the band is Bartlett's, ``1.96 sqrt(sum_k rho_e(k) rho_u(k) / n)``, with their own
    autocorrelations.

    Args:
        errors: Errors of an output in each run ``(n,)``; NaN where it was not measured.
        inputs: The input beside it ``(n,)``.
        lags: Longest lag [samples].

    Returns:
        Correlations at lags 0 to ``lags`` ``(lags + 1,)``, and half the width of the 95 % band; NaN where one of the
        two does not move.

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
