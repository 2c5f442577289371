"""Poles, stabilisability, detectability and frequency responses of a linearised model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.analysis.toolbox import period
from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# Rank decisions: rounding of an SVD is about n * eps * norm ~ 1e-14; a mode this close (relative to the
# norm) to uncontrollable would need inputs a hundred million times the others'.
RANK_TOLERANCE = 1e-8


@dataclass(frozen=True)
class LinearAnalysis:
    """Poles and structural properties of a discrete linear model.

    Args:
        dt: Period [s].
        poles: Eigenvalues of A ``(n,)``, largest magnitude first.
        frequency: Natural frequency ``|log(z) / dt|`` ``(n,)`` [rad/s] of the continuous equivalent.
        damping: Damping ratio ``(n,)`` of the continuous equivalent; 1 for a pole at rest (z = 1).
        slow: True where the natural frequency lies below ``split`` ``(n,)``.
        split: Border [rad/s] between slow and fast poles.
        stable: All poles inside the unit circle.
        stabilisable: See :func:`stabilisable`.
        detectable: See :func:`detectable`.
    """

    dt: float
    poles: Complex
    frequency: Array
    damping: Array
    slow: NDArray[np.bool_]
    split: float
    stable: bool
    stabilisable: bool
    detectable: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON: complex as ``[re, im]``, an infinite frequency (z = 0) as None."""
        return {
            "dt": self.dt,
            "poles": [[float(z.real), float(z.imag)] for z in self.poles],
            "frequency_rad_s": [float(w) if np.isfinite(w) else None for w in self.frequency],
            "damping": [float(d) for d in self.damping],
            "slow": [bool(s) for s in self.slow],
            "split_rad_s": self.split,
            "stable": self.stable,
            "stabilisable": self.stabilisable,
            "detectable": self.detectable,
        }


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequency response for Bode plots.

    Args:
        omega: Frequencies ``(n,)`` [rad/s].
        magnitude: ``|G|`` ``(n_y, n_u, n)`` [output unit / input unit].
        phase: Unwrapped phase ``(n_y, n_u, n)`` [rad].
    """

    omega: Array
    magnitude: Array
    phase: Array


def analyze(sys: Any, *, split: float | None = None) -> LinearAnalysis:
    """Poles and properties of a discrete ``control.StateSpace``.

    Args:
        sys: The system, with a period.
        split: Border [rad/s] between slow and fast poles. Default: a tenth of the Nyquist frequency.

    Raises:
        InputError: If the system has no period.

    Example:
        >>> import control
        >>> analyze(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)).stable
        True
    """
    dt = period(sys)
    poles = np.linalg.eigvals(sys.A).astype(np.complex128)
    poles = poles[np.argsort(-np.abs(poles), kind="stable")]
    frequency, damping = np.full(poles.size, np.inf), np.ones(poles.size)
    moving = np.abs(poles) > 0
    s = np.log(poles[moving]) / dt
    frequency[moving] = np.abs(s)
    damping[moving] = np.where(s == 0, 1.0, -s.real / np.where(s == 0, 1.0, np.abs(s)))
    border = 0.1 * np.pi / dt if split is None else split
    return LinearAnalysis(
        dt,
        poles,
        frequency,
        damping,
        frequency < border,
        float(border),
        bool(np.all(np.abs(poles) < 1.0)),
        stabilisable(sys),
        detectable(sys),
    )


def stabilisable(sys: Any) -> bool:
    """True if the input reaches every mode on or outside the unit circle (Popov-Belevitch-Hautus).

    A mode z counts as unstable if ``|z| >= 1 - 1e-8``; it is reached if the smallest singular value of
    ``[A - z I, B]`` exceeds 1e-8 of the largest of ``[A, B]``, with B's columns scaled to the norm of A
    (input units must not decide).

    Args:
        sys: Discrete ``control.StateSpace``.

    Raises:
        InputError: If the system has no period.

    Example:
        >>> import control
        >>> stabilisable(control.ss([[2.0]], [[0.0]], [[1.0]], [[0.0]], 0.1, remove_useless_states=False))
        False
    """
    period(sys)
    return _hautus(np.asarray(sys.A), np.asarray(sys.B))


def detectable(sys: Any) -> bool:
    """True if the output shows every mode on or outside the unit circle; the dual of :func:`stabilisable`.

    Raises:
        InputError: If the system has no period.

    Example:
        >>> import control
        >>> detectable(control.ss([[2.0]], [[1.0]], [[1.0]], [[0.0]], 0.1))
        True
    """
    period(sys)
    return _hautus(np.asarray(sys.A).T, np.asarray(sys.C).T)


def frequency_response(sys: Any, omega: ArrayLike) -> FrequencyResponse:
    """``C (e^{i w dt} I - A)^-1 B + D`` at the frequencies ``omega`` ``(n,)`` [rad/s].

    Raises:
        InputError: If the system has no period or a frequency lies outside (0, pi / dt].

    Example:
        >>> import control
        >>> sys = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
        >>> round(float(frequency_response(sys, [1e-6]).magnitude[0, 0, 0]), 6)
        2.0
    """
    dt = period(sys)
    w = np.asarray(omega, dtype=np.float64).reshape(-1)
    if w.size == 0 or not (w.min() > 0 and w.max() <= np.pi / dt * (1 + 1e-9)):
        raise InputError(f"frequency response: give frequencies in (0, {np.pi / dt:.6g}] rad/s (Nyquist)")
    a, b, c, d = (np.asarray(m, dtype=np.float64) for m in (sys.A, sys.B, sys.C, sys.D))
    z = np.exp(1j * w * dt)
    response = c @ np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, b.astype(complex)) + d
    g = np.moveaxis(response, 0, -1)
    return FrequencyResponse(w, np.abs(g), np.unwrap(np.angle(g), axis=-1))


def _hautus(a: Array, b: Array) -> bool:
    size = max(float(np.linalg.norm(a, 2)), 1.0)
    norms = np.linalg.norm(b, axis=0)
    scaled = b * np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 0.0)
    largest = np.linalg.norm(np.hstack([a, scaled]), 2)
    for z in np.linalg.eigvals(a):
        if abs(z) < 1.0 - RANK_TOLERANCE:
            continue
        pencil = np.hstack([a - z * np.eye(a.shape[0]), scaled])
        if np.linalg.svd(pencil, compute_uv=False)[-1] <= RANK_TOLERANCE * largest:
            return False
    return True
