"""Readings of any machine: residuals of the model for every output and every balance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import periods
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.watch.lengths import LONG_S, SHORT_S, machine_second, settling_samples
from hybrid_mpc.watch.readings import RESIDUALS, Channel, Sample, Test, Validity

Array = NDArray[np.float64]
FREE_RUN_S = 1.0
"""Length of the model's free runs [time constants of the machine]. A jump of a sensor, which the estimator follows
within a few samples, remains visible in a free run until the next run begins."""
RUNS = 2
"""Number of free runs, which begin half a length apart: the older one has always run for at least half a length."""


def free_run_of(name: str) -> str:
    """Name of the channel of an output's free run."""
    return f"free run of {name}"


@dataclass(frozen=True)
class ResidualState:
    """State of the readings, never changed in place.

    Args:
        x: State of the latest estimate ``(n_x,)``; ``h`` its hidden state, ``w`` its disturbances; NaN before the
            first.
        y: The latest measurement ``(n_y,)``.
        travel: Predicted motion of each output since its reading last changed ``(n_y,)``.
        repeats: Number of samples since that change ``(n_y,)``.
        runs: States, hidden states and unmeasured disturbances of the free runs ``(2, n_x + n_h + n_d)``.
        age: Periods since the begin of each free run; negative before its begin.
        seen: Number of processed samples, up to the settling time.
    """

    x: Array
    h: Array
    w: Array
    y: Array
    travel: Array
    repeats: NDArray[np.int_]
    runs: Array
    age: tuple[int, ...]
    seen: int = 0


class ResidualReadings:
    """Compares a model with its machine, output by output and balance by balance; for any model.

    Its channels, in this order:

    - Each **output**: measurement minus the model's one-step prediction from the last estimate, with the applied input
      and without the estimated disturbance [its unit].
    - Each **balance**: the change of the estimate over the period minus the model's is an unexplained rate,
      ``r = (x_hat - x_predicted) / dt``. It contains the correction by the measurement and the estimated load, so a
      constant load is always visible. The residual is ``dS/dx r`` [unit of the rate], for a mechanical prior the power
      that the model lacks.
    - Each **measured disturbance**: its distance from the operating point [its unit]. No model predicts it, but a value
      outside the nominal data is an alarm, because models are unreliable there.
    - The **free run** of each output: measurement minus a free run of the model over up to one time constant of the
      machine, with the applied inputs and the disturbance that was estimated at its start [unit of the output]. The
      one-step prediction starts at an estimate that partly follows the fault; the free run does not. Of two free runs
      in turn, the older one is read.

    The first time unit does not count, because the estimates settle. **Travel**: the sum of the
    one-step predictions while an output repeats its reading exactly. A sensor at the end of its range is not frozen.

    For a mechanical model with measured positions, :class:`~hybrid_mpc.watch.energy.EnergyReadings` detect more,
    because they account for dry friction. Not thread-safe (buffers are reused).

    Args:
        model: The model that is compared with the machine.

    Example:
        >>> from types import SimpleNamespace
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("level", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("inflow", "m/s"),), level,
        ...     x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> readings = ResidualReadings(tank)
        >>> none, memory = np.zeros(0), readings.initial()
        >>> for measured in (0.0, 0.1, 0.4):  # 0.1 m flow in each period, and 0.2 m more in the last one
        ...     known = SimpleNamespace(x=np.array([measured]), h=none, w=none)
        ...     memory, sample = readings.update(memory, np.array([measured]), np.array([0.1]), known)
        >>> [channel.name for channel in readings.channels], sample.values.round(6).tolist()
        (['level', 'free run of level'], [0.2, nan])
    """

    kind = RESIDUALS

    def __init__(self, model: HybridModel) -> None:
        self.model = model
        self.channels = (
            *(Channel(s.name, s.unit, "measurement minus one-step prediction") for s in model.outputs),
            *(
                Channel(b.name, b.rate_unit, "residual of the balance for the change of the estimate")
                for b in model.balances
            ),
            *(Channel(s.name, s.unit, "distance from the operating point") for s in model.disturbances),
            *(Channel(free_run_of(s.name), s.unit, "measurement minus free run") for s in model.outputs),
        )
        unit = machine_second(model.dt, model.time_unit)
        self.settling = settling_samples(model)
        """Number of samples at the beginning that do not count."""
        self.free_run = periods(FREE_RUN_S * unit, model.dt, RUNS)
        """Length of a free run [periods]."""
        self.short, self.long = (periods(length * unit, model.dt) for length in (SHORT_S, LONG_S))
        """Lengths of the averages [samples]."""
        self.patience = 2 * self.short
        self.n_terms = 0
        first = model.n_y + len(model.balances)
        self.tests = tuple(
            Test(c, length, may_be_zero=first <= c < first + model.n_w)
            for c in range(len(self.channels))
            for length in (self.short, self.long)
        )
        ends = [s.saturation or (-np.inf, np.inf) for s in model.outputs]
        self.sensor_ends = np.array(ends, dtype=float).T
        """Ends of the sensors' ranges ``(2, n_y)``."""
        self._function = BufferedFunction(_residuals(model))

    def initial(self) -> ResidualState:
        """State before the first sample."""
        m = self.model
        x, h, w, y = (np.full(size, np.nan) for size in (m.n_x, m.n_h, m.n_w, m.n_y))
        runs = np.full((RUNS, m.n_x + m.n_h + m.n_d), np.nan)
        age = tuple(-self.settling - i * self.free_run // RUNS for i in range(RUNS))
        return ResidualState(x, h, w, y, np.zeros(m.n_y), np.zeros(m.n_y, dtype=int), runs, age)

    def update(
        self, state: ResidualState, y: Array, u_prev: Array, estimate: Any
    ) -> tuple[ResidualState, Sample]:
        """Process one sample; see :class:`~hybrid_mpc.watch.readings.Readings`.

        The estimate's ``x``, ``h``, ``w`` and, if present, ``d`` are used.
        """
        m = self.model
        y = np.array(y, dtype=np.float64).ravel()
        x, h = (np.array(values, dtype=np.float64).ravel() for values in (estimate.x, estimate.h))
        given = estimate.w if np.size(estimate.w) == m.n_w else m.w
        w, d = np.array(given, dtype=np.float64).ravel(), np.ravel(getattr(estimate, "d", ()))
        ins, outs = self._function.inputs, self._function.outputs
        for place, values in zip(ins, (state.x, state.h, u_prev, state.w, y, x, state.runs), strict=True):
            place[:] = values.ravel()
        self._function()
        moved, ahead, free = outs[1].copy(), outs[2].reshape(RUNS, -1).copy(), outs[3].reshape(RUNS, -1)
        begun = np.concatenate([x, h, d if d.size == m.n_d else np.zeros(m.n_d)])
        runs, age, error = self._turned(ahead, free, begun, state.age)
        residual = np.concatenate([outs[0], w - m.w, error])
        residual[~np.isfinite(residual)] = np.nan
        seen = min(state.seen + 1, self.settling + 2)
        settled = seen > self.settling
        still = (y == state.y) & np.isfinite(moved) & settled
        travel = np.where(still, state.travel + moved, 0.0)
        repeats = np.where(still, state.repeats + 1, 0)
        inside = (y > self.sensor_ends[0]) & (y < self.sensor_ends[1])
        following = ResidualState(
            x=x, h=h, w=w, y=y, travel=travel, repeats=repeats, runs=runs, age=age, seen=seen
        )
        validity = self._validity(residual[: -m.n_y], y, u_prev, seen)
        return following, Sample(residual, (), travel, repeats, inside, settled, validity)

    def _turned(
        self, ahead: Array, free: Array, begun: Array, age: tuple[int, ...]
    ) -> tuple[Array, tuple[int, ...], Array]:
        """Free runs and their ages after restarting those that have ended or diverged; error of the older run."""
        running = [k for k in range(RUNS) if age[k] >= 0]
        older = max(running, key=lambda k: age[k], default=None)
        error = np.full(self.model.n_y, np.nan) if older is None else free[older].copy()
        following = []
        for k, periods_ago in enumerate(age):
            now = periods_ago + 1
            lost = now > 0 and not np.isfinite(ahead[k]).all()
            if now == 0 or now >= self.free_run or lost:
                ahead[k] = begun
                now = 0 if np.isfinite(begun).all() else -1  # else try again at the next sample
            following.append(now)
        return ahead, tuple(following), error

    def _validity(self, residual: Array, y: Array, u_prev: Array, seen: int) -> Validity:
        if np.isfinite(residual).all():
            return Validity.VALID
        if seen < 2:
            return Validity.WARM_UP
        missing = not (np.isfinite(y).all() and np.isfinite(u_prev).all())
        return Validity.MISSING if missing else Validity.NOT_FINITE


def _residuals(model: HybridModel) -> ca.Function:
    """``(x, h, u, w, y, x_hat, runs) -> residuals of outputs and balances, predicted changes of the outputs, free runs
    a period on, and their errors``; ``x`` and ``h`` of a period ago.
    """
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    w, y, x_hat = ca.MX.sym("w", model.n_w), ca.MX.sym("y", model.n_y), ca.MX.sym("x_hat", model.n_x)
    x_next, _ = model.step(x, h, u, w, model.p)
    predicted = model.output(x_next, u, w, model.p)
    r = (x_hat - x_next) / model.dt
    none = ca.MX.zeros(model.n_x)
    violations = [
        b.residual(x, r, u, w, model.p) - b.residual(x, none, u, w, model.p) for b in model.balances
    ]
    moved = predicted - model.output(x, u, w, model.p)
    n_z = model.n_x + model.n_h
    runs, ahead, errors = ca.MX.sym("runs", n_z + model.n_d, RUNS), [], []
    on_u, on_x, on_y = (ca.DM(matrix) for matrix in model.disturbed)
    for k in range(RUNS):
        x_k, h_k, d = ca.vertsplit(runs[:, k], [0, model.n_x, n_z, n_z + model.n_d])
        acting = u + on_u @ d
        x_k, h_k = model.step(x_k, h_k, acting, w, model.p)
        x_k += on_x @ d
        ahead.append(ca.vertcat(x_k, h_k, d))
        errors.append(y - model.output(x_k, acting, w, model.p) - on_y @ d)
    outs = [ca.vertcat(y - predicted, *violations), moved, ca.vertcat(*ahead), ca.vertcat(*errors)]
    return ca.Function("residuals", [x, h, u, w, y, x_hat, runs], [ca.densify(values) for values in outs])
