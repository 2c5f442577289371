"""Recordings under feedback: a test for feedback, and a fit to the errors of predictions one period ahead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit, delayed
from hybrid_mpc.identify.shooting import OUTLIERS, Shooting
from hybrid_mpc.identify.simulation import Simulation, flow_slope, rest_of, with_unknown_rates
from hybrid_mpc.identify.smooth import Smoother, output_slope
from hybrid_mpc.identify.windows import OutputWindows
from hybrid_mpc.machine.prior import Equations
from hybrid_mpc.model.riccati import dare

Array = NDArray[np.float64]
GAIN = 1e3
"""Bound of an element of the observer's gain [sizes of a state per spread of an output]."""
QUIETLY = 0.01
"""Minimum noise of sensors and states for the observer's initial gain, over their spread and their size."""
PAST, ANSWERS = 10, 3
"""Samples of an input's own past, and of prediction errors, in the test for feedback."""
MEMORY = 200
"""Largest lag of the autocorrelations."""
CHANCE = 4.0
"""Standard deviations of a chance correlation that give the value 1: one of some dozen correlations exceeds it with a
probability of 0.1 %."""


class PredictionFit(OutputFit):
    """Fit of one-step predictions with an observer, instead of free runs.

    ``z+ = f(z + K (y - g(x, u)), u)`` with ``z = (x, d)``; ``d`` are unknown rates of the corrected states. ``theta``
    holds the parameters, then ``K`` ``(n_z, n_y)``. The delay is not fitted: the inputs are those that act.

    Args:
        fit: The fit of free runs.
        smoother: Smoother of the fitted prior. The gain of its filter at rest is the initial ``K``.
    """

    def __init__(self, fit: OutputFit, smoother: Smoother) -> None:
        super().__init__(fit.make, fit.dt)
        self.points, self.least, self.n = fit.points, fit.least, len(self.unit)
        self._corrected = smoother.prior.corrected
        self.sizes = np.concatenate([smoother.sizes.x, np.array(smoother.sizes.rate)[list(self._corrected)]])
        unit = np.outer(self.sizes, 1.0 / np.array(smoother.sizes.y)).ravel()
        self._gains = [f"gain {i}" for i in range(len(unit))]
        self.unit = np.concatenate([self.unit, unit])
        first = np.clip(_gain_at_rest(smoother, self.sizes).ravel() / unit, -GAIN, GAIN)
        self.nominal = np.concatenate([self.nominal, first])
        self.lower, self.upper = (
            np.concatenate([own, np.full(len(unit), limit)])
            for own, limit in ((self.lower, -GAIN), (self.upper, GAIN))
        )

    @property
    def names(self) -> list[str]:
        """Names of the fitted parameters and gains."""
        return [*super().names, *self._gains]

    def of(self, windows: OutputWindows) -> OutputWindows:
        """Windows with initial states ``z``; ``d`` starts at zero."""
        more = np.zeros((len(windows.x), len(self._corrected)))
        known = np.concatenate([windows.known, more > 0], axis=1)
        return replace(windows, x=np.concatenate([windows.x, more], axis=1), known=known)

    def _constants(self, theta: Array) -> list[float]:
        return [*super()._constants(theta), *(theta * self.unit)[self.n :].tolist()]

    @cached_property
    def _free(self) -> list[int]:
        every = [*(p.name for p in self.prior.parameters), "delay", *self._gains]
        return [every.index(name) for name in self.names]

    def _simulation(self, free: tuple[int, ...]) -> Simulation:
        if free not in self._simulations:
            xdot, output, correct = _observed(self.prior.equations, self._corrected)
            self._simulations[free] = Simulation(xdot, self.dt, free, output, correct)
        return self._simulations[free]

    def _acting(self, theta: Array, commanded: Array, windows: OutputWindows) -> Array:
        there = np.isfinite(windows.y)
        acting = super()._acting(theta, commanded, windows)
        return np.concatenate([acting, np.where(there, windows.y, 0.0), there], axis=-1)


@lru_cache(maxsize=32)
def _observed(
    equations: Equations, corrected: tuple[int, ...]
) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Rates and outputs of ``z``, and ``z`` corrected by a measurement, as functions ``(z, u, w, p)``.

    Inputs are ``[u, derivative by the delay, y, 1 or 0 for a missing y]``, parameters ``[p, change of the delay, K]``.
    """
    rates, late = delayed(with_unknown_rates(equations.xdot, corrected)), delayed(equations.output)
    n_y, n_z, n_x = late.size1_out(0), rates.size1_in(0), late.size1_in(0)
    z, u, w, p = (ca.SX.sym(rates.name_in(i), rates.size1_in(i)) for i in range(4))
    y, there, gain = ca.SX.sym("y", n_y), ca.SX.sym("there", n_y), ca.SX.sym("K", n_z * n_y)
    given = [z, ca.vertcat(u, y, there), w, ca.vertcat(p, gain)]
    shown = late(z[:n_x], u, w, p)
    corrected_z = z + ca.reshape(gain, n_y, n_z).T @ (there * (y - shown))
    values = {"rates": rates(z, u, w, p), "shown": shown, "corrected": corrected_z}
    found = [ca.Function(name, given, [value]) for name, value in values.items()]
    return found[0], found[1], found[2]


def _gain_at_rest(smoother: Smoother, sizes: Array) -> Array:
    """Gain ``(n_z, n_y)`` of a smoother's filter at rest; zero if not all states are observable there."""
    prior, n_x = smoother.prior, len(smoother.prior.states)
    x, u, w = rest_of(prior)
    z = np.concatenate([x, np.zeros(len(prior.corrected))])
    a = expm(
        flow_slope(with_unknown_rates(prior.equations.xdot, prior.corrected))(z, u, w, prior.p).full()
        * smoother.dt
    )
    c = np.zeros((len(smoother.sigma), len(z)))
    c[:, :n_x] = output_slope(prior.equations)(x, u, w, prior.p)[1].full()
    walk = np.concatenate([QUIETLY * sizes[:n_x], smoother.walk]) / sizes
    spread = np.array(smoother.sizes.y)
    c, a = c * sizes / spread[:, None], a * sizes / sizes[:, None]
    noise = np.diag(np.square(np.maximum(smoother.sigma / spread, QUIETLY)))
    try:
        p, _ = dare(a.T, c.T, np.diag(np.square(np.maximum(walk, QUIETLY * smoother.dt))), noise)
    except InputError:  # not observable at rest: the fit starts without a gain
        return np.zeros((len(z), len(spread)))
    return np.asarray(np.linalg.solve(c @ p @ c.T + noise, c @ p).T * np.outer(sizes, 1.0 / spread))


def fit_by_prediction(fit: OutputFit, theta: Array, windows: OutputWindows, smoother: Smoother) -> Fitted:
    """Fit ``theta`` and an observer's gain to one-step prediction errors; the delay is not fitted.

    Recordings of an unstable machine, or in closed loop with disturbances, bias a fit of free runs: the inputs respond
    to effects that a free run does not contain. One-step predictions use the measured past.

    Args:
        fit: The fit of free runs.
        theta: Result of that fit.
        windows: Windows of the recordings, with inputs that act.
        smoother: Smoother of the prior with ``theta``.

    Source: Ljung, *System Identification: Theory for the User*, 1999, sections 4.3 and 7.3.
    """
    n, own = len(fit.free), PredictionFit(fit, smoother)
    first = np.concatenate([theta[:n], own.nominal[n:]])
    # maximum Gauss-Newton steps of a fit of predictions, which starts near the optimum
    found = Shooting(own, own.of(windows), own.sizes).solve(first, 12)
    covariance = np.zeros((len(theta), len(theta)))
    covariance[:n, :n] = found.covariance[:n, :n]
    known = tuple(one for one in found.unidentified if set(one.parameters) <= set(fit.names))
    return Fitted(np.concatenate([found.theta[:n], theta[n:]]), covariance, known)


def feedback(inputs: Sequence[Array], errors: Sequence[Array]) -> float:
    """Test for feedback: largest correlation of inputs with earlier prediction errors, over its chance level.

    The part of an input that its own past does not predict is correlated with the prediction errors of the same sample
    and of the samples before. In open loop, this correlation is zero up to chance. A result well above 1 shows
    feedback.

    Args:
        inputs: Inputs ``(n, n_u)`` of each recording.
        errors: Prediction errors ``(n, n_y)`` of each recording; NaN for a missing sample.
    """
    largest = 0.0
    for j in range(inputs[0].shape[1]):
        rows, answers = [], []
        for all_u, e in zip(inputs, errors, strict=True):
            u = all_u[:, j]
            if len(u) <= 2 * PAST or not np.ptp(u) > 0:
                continue
            past = np.stack([u[PAST - k - 1 : len(u) - k - 1] for k in range(PAST)], axis=1)
            before = np.stack([np.nan_to_num(e[PAST - k : len(u) - k]) for k in range(ANSWERS)], axis=1)
            rows.append(np.column_stack([past, np.ones(len(past)), before.reshape(len(past), -1)]))
            answers.append(u[PAST:])
        if not rows:
            continue
        x, y = np.concatenate(rows), np.concatenate(answers)
        own = x[:, : PAST + 1]
        left = _without_jumps(y - own @ np.linalg.lstsq(own, y, rcond=None)[0])
        for column in x[:, PAST + 1 :].T:
            rest = _without_jumps(column - own @ np.linalg.lstsq(own, column, rcond=None)[0])
            size = float(np.linalg.norm(left) * np.linalg.norm(rest))
            if np.linalg.norm(left) > 1e-9 * np.linalg.norm(y) and size > 0:
                chance = math.sqrt(max(float(_memory(left) @ _memory(rest)), 1.0) / len(y))
                largest = max(largest, abs(float(left @ rest)) / size / chance)
    return largest / CHANCE


def _memory(values: Array) -> Array:
    """Autocorrelation of a series, at lags of up to ``MEMORY`` to either side.

    The correlation of two independent series has the variance ``sum_k rho_1(k) rho_2(k) / n`` (Bartlett, *On the
    theoretical specification and sampling properties of autocorrelated time-series*, 1946).
    """
    n = len(values)
    power = np.square(np.abs(np.fft.rfft(values, 2 * n)))
    own = np.fft.irfft(power)[: min(MEMORY, n - 1) + 1]
    own = own / max(float(own[0]), 1e-300)
    return np.concatenate([own, own[1:]])


def _without_jumps(values: Array) -> Array:
    """Clip values to three robust standard deviations, because jumps of a reference dominate an input's correlation."""
    limit = OUTLIERS * 1.4826 * float(np.median(np.abs(values)))
    return np.clip(values, -limit, limit)
