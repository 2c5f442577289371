"""Predictions of a recording from an artifact alone: a free run with its band, and one step ahead. No torch in here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.bands import run_variance
from hybrid_mpc.identify.delay import lost_samples, shifted
from hybrid_mpc.identify.fit import parameter_variance
from hybrid_mpc.identify.simulation import measured_as
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.prediction import SHARE, Predicting
from hybrid_mpc.machine.prior import OperatingPoint, Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.records import BESIDE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Predicted:
    """Predicted outputs, and their errors.

    Args:
        rmse: Root mean square of the residuals by output, ``"phi [rad]"``; None if a run diverged.
        fit_percent: ``100 (1 - RMSE / standard deviation of the measurement)`` by output; None if a run diverged or the
            output is constant.
        inside: Share of the measurements within the band, by output; None without a band.
        share: Nominal share of the band.
        y_hat: Predictions ``(n, n_y)`` [output units]; one-step predictions are NaN for missing samples. Empty if read
            from a file.
        half_width: Half widths of the band ``(n, n_y)`` [output units]; NaN without a band. Empty if read from a file.
    """

    rmse: Mapping[str, float | None]
    fit_percent: Mapping[str, float | None]
    inside: Mapping[str, float | None]
    share: float
    y_hat: Array = field(default_factory=lambda: np.zeros((0, 0)), compare=False, metadata=BESIDE)
    half_width: Array = field(default_factory=lambda: np.zeros((0, 0)), compare=False, metadata=BESIDE)


@dataclass(frozen=True)
class Prediction:
    """Predictions of a recording after its warm-up, ``n`` samples.

    Args:
        name: Name of the recording.
        model: Name of the model.
        outputs: Signals of ``y``.
        t: Times ``(n,)`` [s] in the recording's own time.
        y: Measurement ``(n, n_y)``; NaN where a sample is missing.
        free_run: Free runs with the measured inputs; each starts from the state after a warm-up.
        one_step: One-step predictions of the loops' observer; None if the artifact has no observer.
        reason: Why there are no one-step predictions. Default: there are one-step predictions.
        run_length: Length [s] of the free runs, one after the other. Default: one run over the recording.
    """

    name: str
    model: str
    outputs: tuple[Signal, ...]
    t: Array
    y: Array
    free_run: Predicted
    one_step: Predicted | None
    reason: str = ""
    run_length: float | None = None

    @property
    def seconds(self) -> float:
        """Length after the warm-up [s]."""
        return len(self.t) * float(self.t[1] - self.t[0])

    @property
    def title(self) -> str:
        """Name of the free runs, with their length if it is limited."""
        return "free run" if self.run_length is None else f"free runs of {self.run_length:.3g} s"

    def columns(self) -> dict[str, Array]:
        """Columns ``(n,)`` of a table of the prediction, with units in their names."""
        found = {"t_s": self.t}
        runs = (("", self.free_run), ("_one_step", self.one_step))
        for j, signal in enumerate(self.outputs):
            name, unit = signal.name, signal.unit
            found[f"{name}_{unit}"] = self.y[:, j]
            for kind, run in runs:
                if run is None:
                    continue
                hat, half = run.y_hat[:, j], run.half_width[:, j]
                parts = {"hat": hat, "lower": hat - half, "upper": hat + half, "residual": self.y[:, j] - hat}
                found |= {f"{name}{kind}_{what}_{unit}": values for what, values in parts.items()}
        return found


def predict(kit: Kit, trajectory: Trajectory, model: str = "") -> Prediction:
    """Compute a free run and one-step predictions of a recording, with bands.

    The first ``warm_up`` seconds of the recording determine the initial state (smoothed by the fitted prior) and the
    networks' hidden state; they are not predicted. Free runs are as long as those that evaluated the model in its run
    (``free_run`` of the artifact's data specification). Each starts at the end of the one before, with its own warm-up.
    The band of the free run was calibrated on validation runs (docs/predict.md). Beyond the longest of these runs, the
    band grows further without calibration. One-step predictions are those of ``kit.observer(model)``; their band comes
    from the observer's covariance.

    Args:
        kit: A loaded artifact.
        trajectory: A recording on the model's grid, with commanded inputs; its states are not used.
        model: ``"prior"`` or ``"hybrid"``. Default: the recommended model.

    Raises:
        InputError: If the model does not exist, the artifact lacks data for predictions, or the recording is shorter
            than the warm-up or has another period.

    Example:
        ``prediction = hm.predict(hm.load("runs/mine"), trajectory); prediction.free_run.fit_percent``
    """
    name, held = _checked(kit, trajectory, model)
    chosen, prior, dt = kit.models[name], stored_prior(kit, held), trajectory.dt
    warm, delay = round(held.data.warm_up / dt), kit.input_delay
    lost = lost_samples(delay, dt)
    if len(trajectory.t) < lost + warm + 2:
        raise InputError(
            f"{trajectory.name}: {len(trajectory.t) * dt:.4g} s are too short. Give at least "
            f"{(lost + warm + 2) * dt:.4g} s, including a warm-up of {warm * dt:.4g} s [HM-IDENTIFY-041]"
        )
    (acting,) = shifted([trajectory], delay)
    length = held.data.free_run
    n = len(acting.t) if length is None else max(1, round(length / dt))
    begins = range(0, len(acting.t) - warm, n)
    runs = [acting.part(slice(a, a + warm + n)) for a in begins]
    smoother = Smoother(prior, dt, **held.smoother_settings)
    starts = smoother.smooth([run.part(slice(0, warm + 1)) for run in runs])
    parts = [
        _banded(kit, name, prior, run, start.x, trajectory.part(slice(a, a + lost + warm + n)))
        for a, run, start in zip(begins, runs, starts, strict=True)
    ]
    outputs, half = (np.concatenate(part) for part in zip(*parts, strict=True))
    shown, bands = slice(warm, None), held.bands.get(name)
    y, t = acting.y[shown], acting.t[shown]
    free = _predicted(outputs, half, y, chosen.outputs, SHARE if bands is None else bands.share)
    one_step, reason = None, ""
    try:
        hat, width = _one_step(kit, name, trajectory.part(slice(lost, None)))
        one_step = _predicted(hat[shown], width[shown], y, chosen.outputs, SHARE)
    except InputError as none:
        reason = str(none)
    return Prediction(trajectory.name, name, chosen.outputs, t, y, free, one_step, reason, length)


def _banded(
    kit: Kit, name: str, prior: Prior, run: Trajectory, x: Array, commanded: Trajectory
) -> tuple[Array, Array]:
    """Outputs of one free run and half widths of its band, both ``(n, n_y)``.

    ``run`` has the inputs that act, ``commanded`` the commanded inputs, from the first that still acts. ``x``
    ``(warm + 1, n_x)`` are the states of the warm-up.
    """
    chosen, held = kit.models[name], kit.predicting
    assert held is not None
    warm, lost = len(x) - 1, len(commanded.t) - len(run.t)
    shown = slice(warm, None)
    u, w, t = run.u[shown], run.w[shown], run.t[shown]
    networks = [*kit.members.values()] if name == "hybrid" else []
    states = [_free_run(one, commanded, x, lost, warm) for one in (chosen, *networks)]
    output = prior.equations.output
    shown_y = [output(own.T, u.T, w.T, prior.p).full().T for own in states]
    outputs = measured_as(prior, np.stack(shown_y))
    bands = held.bands.get(name)
    if bands is None:
        return outputs[0], np.full(outputs[0].shape, np.nan)
    covariance = np.array(chosen.covariance)
    parameters = parameter_variance(prior, covariance, states[0][:1], u[None], w[None], run.dt, held.substeps)
    parts = run_variance(
        outputs[1:] if networks else outputs, parameters[0], t - t[0], np.array(held.sigma), np.array(held.sizes.y),
        longest=held.longest or np.inf,
    )  # fmt: skip
    return outputs[0], bands.half_width(parts)


def _checked(kit: Kit, trajectory: Trajectory, model: str) -> tuple[str, Predicting]:
    """Name of the model, and the settings of predictions."""
    name = model or kit.recommended
    if not isinstance(name, str) or name not in kit.models:
        raise InputError(
            f"model: no model {name!r}; choose one of: {', '.join(kit.models)} [HM-IDENTIFY-042]"
        )
    if kit.predicting is None or "prior" not in kit.models:
        raise InputError(
            f"model of scenario {kit.name or '(unnamed)'}: saved without settings of predictions (columns, smoother, "
            "bands), by an older version or by save_artifact without predicting. Run the scenario again"
            " [HM-IDENTIFY-043]"
        )
    chosen = kit.models[name]
    if abs(trajectory.dt - chosen.dt) > 1e-9 * chosen.dt:
        raise InputError(
            f"{trajectory.name}: its period is {trajectory.dt:g} s, but the model's is {chosen.dt:g} s. Resample it"
            " [HM-IDENTIFY-044]"
        )
    return name, kit.predicting


def stored_prior(kit: Kit, held: Predicting) -> Prior:
    """Create the fitted prior of an artifact from the stored programs."""
    model = kit.models["prior"]

    def expressions(self: Prior, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[Any, Any, tuple[()]]:
        return model.xdot(x, ca.SX.zeros(model.n_h), u, w, p), model.output(x, u, w, p), ()

    of_class = {
        "states": model.states, "inputs": model.inputs, "outputs": model.outputs, "disturbances": model.disturbances,
        "parameters": model.parameters, "corrects": held.corrects, "expressions": expressions,
        "operating_point": OperatingPoint(model.nominal_x, model.nominal_u, model.nominal_w),
    }  # fmt: skip
    made: Prior = type("StoredPrior", (Prior,), of_class)()
    return made


def _free_run(model: HybridModel, whole: Trajectory, x: Array, lost: int, warm: int) -> Array:
    """States ``(n, n_x)`` from the end of the warm-up on; ``x`` ``(warm + 1, n_x)`` are those of the warm-up."""
    step = BufferedFunction(model.step)
    step.inputs[4][:] = model.p
    h = np.zeros(model.n_h)
    if model.delay_states:  # the delayed inputs, the oldest first
        h[: model.delay_states] = whole.u[lost - model.delay_states // model.n_u : lost].ravel()
    u, w = whole.u[lost:], whole.w[lost:]
    states = np.empty((len(u) - warm, model.n_x))
    now = x[0]
    for k in range(len(u)):
        now = x[k] if k <= warm else step.outputs[0].copy()
        if k >= warm:
            states[k - warm] = now
        step.inputs[0][:], step.inputs[1][:], step.inputs[2][:], step.inputs[3][:] = now, h, u[k], w[k]
        step()
        h = step.outputs[1].copy()
    return states


def _one_step(kit: Kit, name: str, recording: Trajectory) -> tuple[Array, Array]:
    """One-step predictions of each sample, and half widths of their band, both ``(n, n_y)``."""
    observer, model = kit.observer(name), kit.models[name]
    n, n_y = recording.y.shape
    hat, variance = np.full((2, n, n_y), np.nan)
    for k in range(n):
        w = recording.w[k]
        if k == 0:
            estimate = observer.start(recording.y[0], float(recording.t[0]), w=w if model.n_w else None)
            continue
        u = recording.u[k - 1]
        ahead = observer.predict(estimate, u)
        if model.n_w:
            ahead = observer.measuring(ahead, w)
        variance[k] = np.diag(observer.innovation_covariance(ahead, u))
        estimate = observer.update(estimate, recording.y[k], u, w=w if model.n_w else None)
        hat[k] = recording.y[k] - estimate.innovation
    factor = float(norm.ppf(0.5 * (1 + SHARE)))
    return hat, factor * np.sqrt(np.maximum(variance, 0.0))


def _predicted(hat: Array, half: Array, y: Array, outputs: Sequence[Signal], share: float) -> Predicted:
    rmse: dict[str, float | None] = {}
    fit: dict[str, float | None] = {}
    inside: dict[str, float | None] = {}
    for j, signal in enumerate(outputs):
        seen = np.isfinite(y[:, j]) & ~np.isnan(hat[:, j])
        off = np.abs(hat[seen, j] - y[seen, j])
        with np.errstate(over="ignore", invalid="ignore"):
            error = float(np.sqrt(np.mean(np.square(off)))) if seen.any() else np.nan
        size = float(y[seen, j].std()) if seen.any() else 0.0
        rmse[signal.label] = error if np.isfinite(error) else None
        fit[signal.label] = 100 * (1 - error / size) if size > 0 and np.isfinite(error) else None
        banded = np.isfinite(half[seen, j])
        inside[signal.label] = float(np.mean(off[banded] <= half[seen, j][banded])) if banded.any() else None
    return Predicted(rmse, fit, inside, share, hat, half)
