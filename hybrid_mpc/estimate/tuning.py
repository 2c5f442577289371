"""Process noise of a filter: a model's one-period errors, scaled by maximum likelihood."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import START_LIMIT, Estimate, ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import Filter
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.riccati import dare

Array = NDArray[np.float64]
FOUND = math.exp(-1.0)
"""Remaining share of a constant disturbance that a filter has found: that of a first-order lag after one time
constant."""


class Recording(Protocol):
    """A recording on the model's grid."""

    @property
    def u(self) -> Array:
        """Inputs ``(n, n_u)``, each held over the period that begins with it."""

    @property
    def y(self) -> Array:
        """Measurements ``(n, n_y)``."""

    @property
    def w(self) -> Array:
        """Measured disturbances ``(n, n_w)``."""


class Known(Recording, Protocol):
    """A recording with known states, e.g. smoothed ones."""

    @property
    def x(self) -> Array:
        """States ``(n, n_x)``."""


def measured_disturbances(model: HybridModel, recording: Recording) -> Array:
    """Measured disturbances of a recording ``(n, n_w)``; empty if the model has none.

    Raises:
        InputError: If their number differs from the model's.
    """
    n = len(recording.u)
    if not model.n_w:
        return np.zeros((n, 0))
    w: Array = np.asarray(recording.w, dtype=np.float64)
    if w.shape != (n, model.n_w):
        raise InputError(f"recording: w must have shape {(n, model.n_w)}, got {w.shape} [HM-ESTIMATE-021]")
    return w


def process_noise(model: HybridModel, recordings: Sequence[Known], most: int = 4000) -> Array:
    """Standard deviations ``(n_x,)`` of the model's one-period errors on recordings [SI].

    The hidden state follows the measured states, starting at zero.

    Args:
        model: The model.
        recordings: Smoothed recordings on the model's grid (the training ones).
        most: Number of periods after which no further recording is used. Default 4000.

    Raises:
        InputError: If there is no period.

    Example:
        ``ExtendedKalmanFilter(model, sigma_x=process_noise(model, train), sigma_y=[1e-3], sigma_x0=[1e-3, 0.1])``
    """
    errors: list[Array] = []
    for recording in recordings:
        h, ws = np.zeros(model.n_h), measured_disturbances(model, recording)
        for k in range(len(recording.u) - 1):
            x_next, h = (
                m.full().ravel() for m in model.step(recording.x[k], h, recording.u[k], ws[k], model.p)
            )
            if k >= model.delay_states:  # earlier the delayed inputs are unknown
                errors.append(x_next - recording.x[k + 1])
        if len(errors) >= most:
            break
    if not errors:
        raise InputError(
            "process noise: a recording with at least two samples is needed. Pass training recordings."
            " [HM-ESTIMATE-022]"
        )
    sizes = np.sqrt(np.mean(np.square(np.concatenate([r.x for r in recordings])), axis=0))
    # errors below 1e-9 of a state's size are rounding: no filter assumes less noise
    return np.maximum(np.sqrt(np.mean(np.square(errors), axis=0)), 1e-9 * sizes)


def log_likelihood(estimator: Filter, recording: Recording, skip: int = 25) -> float:
    """Log-likelihood of the measured outputs under a filter's innovations and their variances.

    The sum over samples after the first ``skip``, without the constant; minus infinity if the filter diverges.

    Source: Schweppe, *Evaluation of likelihood functions for Gaussian signals*, IEEE T-IT 11 (1965).
    """
    ws = measured_disturbances(estimator.model, recording)
    estimate, total = estimator.start(recording.y[0], w=ws[0]), 0.0
    for k in range(1, len(recording.y)):
        ahead = estimator.measuring(estimator.predict(estimate, recording.u[k - 1]), ws[k])
        estimate, likelihood = estimator.assess(ahead, recording.y[k], recording.u[k - 1])
        if k >= skip:
            total += likelihood
        if not np.all(np.isfinite(estimate.x)):
            return -math.inf
    return total


def choose_most_likely(
    make: Callable[[float], Filter], recordings: Sequence[Recording], scales: Sequence[float]
) -> float:
    """The scale whose filter ``make(scale)`` gives undisturbed recordings the largest likelihood."""
    values = [sum(log_likelihood(make(s), r) for r in recordings) for s in scales]
    return float(scales[int(np.argmax(values))])


def remaining_load(ekf: ExtendedKalmanFilter, periods: int) -> Array:
    """Remaining share of each constant disturbance after ``periods`` of a filter, ``(n_d,)``.

    With the gain of the settled covariance, at the model's operating point and beside it, where every state is moved by
    a tenth of its range (without a range, by its first standard deviation). The smaller share counts, since dry
    friction at rest hides a load that motion reveals. NaN if the covariance settles at neither point.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> slow, quick = (ExtendedKalmanFilter(model, sigma_y=[1.0], sigma_x=[1.0], sigma_x0=[1.0], sigma_d=[step])
        ...                for step in (0.01, 0.1))
        >>> remaining_load(slow, 50).round(2), remaining_load(quick, 50).round(2)
        (array([0.61]), array([0.01]))

    Source: Anderson and Moore, *Optimal Filtering*, 1979, section 4.4.
    """
    return _left(_errors(ekf), periods, ekf.model.n_d)


def periods_to_find(ekf: ExtendedKalmanFilter, most: int) -> Array:
    """Periods ``(n_d,)`` after which a filter has found two thirds of each constant disturbance; infinite if not within
    ``most``, NaN if its covariance does not settle.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> steps = (0.1, 0.01, 1e-9)
        >>> filters = [ExtendedKalmanFilter(model, sigma_y=[1.0], sigma_x=[1.0], sigma_x0=[1.0], sigma_d=[s])
        ...            for s in steps]
        >>> [float(periods_to_find(one, 1000)[0]) for one in filters]
        [11.0, 101.0, inf]
    """
    errors, n_d = _errors(ekf), ekf.model.n_d
    low, high, last = np.zeros(n_d), np.full(n_d, float(most)), _left(errors, most, n_d)
    while np.any(high - low > 1.0):
        middle = np.where(high - low > 1.0, np.floor(0.5 * (low + high)), high)
        left = np.array([_left(errors, int(n), n_d)[i] for i, n in enumerate(middle)])
        found = left <= FOUND
        low, high = np.where(found, low, middle), np.where(found, middle, high)
    return np.where(np.isnan(last), np.nan, np.where(last <= FOUND, high, np.inf))


def _left(errors: Sequence[Array], periods: int, n_d: int) -> Array:
    """:func:`remaining_load` for the error matrices of several points."""
    powers = [np.linalg.matrix_power(one, periods) for one in errors]
    found = [np.abs(np.diag(power)[len(power) - n_d :]) for power in powers]
    return np.min(found, axis=0) if found else np.full(n_d, np.nan)


def _errors(ekf: ExtendedKalmanFilter) -> list[Array]:
    """Matrices ``(n, n)`` that propagate errors of a settled filter over one period, at the operating point and beside
    it; empty if its covariance does not settle.
    """
    model = ekf.model
    rest = ekf.start(np.full(model.n_y, np.nan))
    ranges = np.array([s.upper - s.lower for s in model.states])
    # a tenth of its range from the operating point: a load may be seen in motion only
    x = rest.x + np.where(np.isfinite(ranges), 0.1 * ranges, np.sqrt(ekf.first[: model.n_x]))
    moving = replace(rest, x=x, h=hidden_fixed_point(model, x, model.u0, limit=START_LIMIT))
    return [found for at in (rest, moving) if (found := _error(ekf, at)) is not None]


def _error(ekf: ExtendedKalmanFilter, at: Estimate) -> Array | None:
    """The matrix at one point; None if the covariance does not settle."""
    f, c = ekf.tangent(at, ekf.model.u0)
    noise, noise_y = ekf.noise
    try:
        # of the prediction: the dual Riccati equation
        p, _ = dare(f.T, c.T, np.diag(noise), np.diag(noise_y))
    except InputError:
        return None
    gain = np.linalg.solve(c @ p @ c.T + np.diag(noise_y), c @ p).T
    return f - gain @ c @ f
