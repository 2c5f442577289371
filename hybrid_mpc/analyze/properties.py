"""Properties of a linear model: modes, stabilisability, detectability, frequency response, reduction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky, schur, solve_discrete_lyapunov, solve_sylvester

from hybrid_mpc.analyze.equilibria import poles_of
from hybrid_mpc.analyze.linearize import control_toolbox, linearize, period
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrices = tuple[Array, Array, Array, Array]
RANK_TOLERANCE = 1e-8
"""Relative distance below which a mode is uncontrollable (unobservable). Rounding of an SVD is about 1e-14; a mode at
this distance would need inputs 1e8 times larger than other modes."""
EDGE = 1e-9
"""Distance of a pole from the unit circle below which the pole has no Gramian and is kept."""


@dataclass(frozen=True)
class Mode:
    """One mode of a discrete system.

    Args:
        pole: Pole z.
        frequency: Natural frequency of the continuous equivalent ``s = log(z) / dt`` [rad/s]; infinite for z = 0.
        damping: Damping ratio of the continuous equivalent [-]; 1 for z = 0 and z = 1.
        reach: Controllability [-]: smallest singular value of the Popov-Belevitch-Hautus pencil ``[A - z I, B]`` over
            the largest singular value of ``[A, B]``. Columns of B are scaled to the norm of A, so units do not matter.
        see: Observability [-]: the same for ``(A', C')``.
    """

    pole: complex
    frequency: float
    damping: float
    reach: float
    see: float


def modes(sys: Any) -> tuple[Mode, ...]:
    """Compute the modes of a discrete ``control.StateSpace``, largest pole first."""
    dt = period(sys)
    a, b, c, _ = matrices(sys)
    poles = poles_of(a)
    frequency, damping = np.full(poles.size, np.inf), np.ones(poles.size)
    moving = np.abs(poles) > 0
    s = np.log(poles[moving]) / dt
    frequency[moving] = np.abs(s)
    damping[moving] = np.where(s == 0, 1.0, -s.real / np.where(s == 0, 1.0, np.abs(s)))
    shapes = zip(poles, frequency, damping, strict=True)
    return tuple(
        Mode(complex(z), float(w), float(d), _hautus(a, b, z), _hautus(a.T, c.T, z)) for z, w, d in shapes
    )


def _hautus(a: Array, b: Array, z: complex) -> float:
    size = max(float(np.linalg.norm(a, 2)), 1.0)
    norms = np.linalg.norm(b, axis=0)
    scaled = b * np.where(norms > 0, size / np.where(norms > 0, norms, 1.0), 0.0)
    pencil = np.hstack([a - z * np.eye(len(a)), scaled])
    smallest = float(np.linalg.svd(pencil, compute_uv=False)[-1])
    return smallest / float(np.linalg.norm(np.hstack([a, scaled]), 2))


def stabilisable_detectable(found: tuple[Mode, ...]) -> tuple[bool, bool]:
    """Whether all modes on or outside the unit circle are controllable, and whether all of them are observable."""
    risky = [m for m in found if abs(m.pole) >= 1.0 - RANK_TOLERANCE]
    return all(m.reach > RANK_TOLERANCE for m in risky), all(m.see > RANK_TOLERANCE for m in risky)


@dataclass(frozen=True)
class Structure:
    """Modes of a discrete system, largest pole first, and its Hankel singular values ``(n,)``, largest first.

    Hankel singular values are those of the stable part, in the units of inputs and outputs; infinite for each mode on
    or outside the unit circle. ``stabilisable`` and ``detectable``: all these modes are controllable, observable.
    """

    dt: float
    modes: tuple[Mode, ...]
    hankel: Array
    stabilisable: bool
    detectable: bool

    @property
    def poles(self) -> Complex:
        """Poles ``(n,)``, largest first."""
        return np.array([m.pole for m in self.modes])


def system_structure(sys: Any) -> Structure:
    """Compute the modes of a discrete ``control.StateSpace``, their PBH tests and the Hankel singular values.

    A PBH test shows whether a mode is controllable (observable) at all. A Hankel singular value is the contribution of
    a state to the response from past inputs to future outputs. Most modes of a network's hidden state are controllable
    and observable, but their Hankel singular values are negligible.

    Args:
        sys: The discrete system.

    Raises:
        InputError: If the system has no period.

    Example:
        >>> import control
        >>> found = system_structure(control.ss(np.diag([1.2, 0.5]), [[0.0], [1.0]], [[1.0, 1.0]], 0.0, 0.1,
        ...     remove_useless_states=False))
        >>> [round(m.reach, 3) for m in found.modes], found.stabilisable, found.detectable
        ([0.0, 0.538], False, True)
    """
    found = modes(sys)
    return Structure(period(sys), found, hankel_singular_values(sys), *stabilisable_detectable(found))


@dataclass(frozen=True)
class FrequencyResponse:
    """Magnitude [output unit / input unit] and unwrapped phase [rad], each ``(n_y, n_u, n)``; ``omega`` in rad/s."""

    omega: Array
    magnitude: Array
    phase: Array


def frequency_response(sys: Any, omega: ArrayLike) -> FrequencyResponse:
    """Compute ``C (e^{i w dt} I - A)^-1 B + D`` at the frequencies ``omega`` ``(n,)`` [rad/s].

    Raises:
        InputError: If the system has no period, or a frequency lies outside (0, pi / dt].

    Example:
        >>> import control
        >>> sys = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
        >>> round(float(frequency_response(sys, [1e-6]).magnitude[0, 0, 0]), 6)
        2.0
    """
    dt = period(sys)
    w = np.asarray(omega, dtype=np.float64).reshape(-1)
    if w.size == 0 or not (w.min() > 0 and w.max() <= np.pi / dt * (1 + 1e-9)):
        raise InputError(
            f"frequency response: give frequencies in (0, {np.pi / dt:.6g}] rad/s (Nyquist) [HM-ANALYZE-050]"
        )
    a, b, c, d = matrices(sys)
    z = np.exp(1j * w * dt)
    response = c @ np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, b.astype(complex)) + d
    g = np.moveaxis(response, 0, -1)
    return FrequencyResponse(w, np.abs(g), np.unwrap(np.angle(g), axis=-1))


@dataclass(frozen=True)
class SteadyGain:
    """Steady-state gain: change of the outputs for constant inputs.

    Args:
        gain: Gain ``(n_y, n_u)`` [output unit / input unit].
        relative: Relative gains ``(n_y, n_u)`` [-]; None unless the gain is square and not singular. Near 1: the input
            can be paired with the output. Negative: the sign of the gain changes when the other loops are closed.
    """

    gain: Array
    relative: Array | None


def steady_gain(sys: Any) -> SteadyGain:
    """Compute the gain ``G = C (I - A)^-1 B + D`` of a discrete system, and its relative gains ``G * (G^-1)'``.

    Raises:
        InputError: If the system has no period, or has a pole at 1 (an integrator has no steady state).

    Example:
        >>> import control
        >>> a, b = 0.5 * np.eye(2), np.array([[1.0, 0.5], [0.25, 1.0]])
        >>> found = steady_gain(control.ss(a, b, np.eye(2), np.zeros((2, 2)), 0.1))
        >>> found.gain.round(6).tolist(), found.relative.round(4).tolist()
        ([[2.0, 1.0], [0.5, 2.0]], [[1.1429, -0.1429], [-0.1429, 1.1429]])

    Source: Bristol, *On a new measure of interaction for multivariable process control*, IEEE Transactions on
    Automatic Control 11 (1966).
    """
    period(sys)
    a, b, c, d = matrices(sys)
    away = np.eye(a.shape[0]) - a
    if a.size and np.linalg.cond(away) > 1.0 / EDGE:
        raise InputError(
            "steady gain: not defined, because a pole lies at 1 and the outputs do not settle. Choose another output "
            "or point [HM-ANALYZE-051]"
        )
    gain = np.asarray(c @ np.linalg.solve(away, b) + d)
    square = gain.shape[0] == gain.shape[1] and np.linalg.cond(gain) < 1.0 / EDGE
    return SteadyGain(gain, np.asarray(gain * np.linalg.inv(gain).T) if square else None)


@dataclass(frozen=True)
class Reduced:
    """A reduced ``control.StateSpace`` of ``order`` states, and the error of the reduction.

    ``hankel`` are the Hankel singular values ``(n,)`` of the full system; infinite for poles on or outside the unit
    circle. ``bound`` is an upper bound of the difference of the two frequency responses: twice the sum of the truncated
    singular values.
    """

    system: Any
    hankel: Array
    order: int
    bound: float


def hankel_singular_values(sys: Any) -> Array:
    """Compute the Hankel singular values ``(n,)`` of a discrete system, largest first; infinite for unstable poles."""
    period(sys)
    _, stable = _split(matrices(sys))
    values = _balance(*stable[:3])[0]
    return np.concatenate([np.full(len(sys.A) - values.size, np.inf), values])


def balanced_truncation(sys: Any, order: int) -> Reduced:
    """Reduce a system to ``order`` states by balanced truncation.

    Poles on or outside the unit circle are kept. Of the stable part, the states with the smallest Hankel singular
    values are truncated. If units differ, scale inputs and outputs first (:func:`physical_states` does).

    Args:
        sys: Discrete ``control.StateSpace``.
        order: Number of states to keep, at least the number of poles on or outside the unit circle.

    Raises:
        InputError: If the system has no period, or the order does not fit.

    Source: Moore, *Principal component analysis in linear systems*, IEEE TAC 26 (1981); square-root form of Tombs and
    Postlethwaite, Int. J. Control 46 (1987); error bound for discrete systems of Al-Saggaf and Franklin, IEEE TAC 32
    (1987).

    Example:
        >>> import control
        >>> sys = control.ss(np.diag([0.9, 0.1]), [[1.0], [0.01]], [[1.0, 0.01]], 0.0, 0.1)
        >>> reduced = balanced_truncation(sys, 1)
        >>> reduced.system.nstates, bool(reduced.bound < 3e-4)
        (1, True)
    """
    dt = period(sys)
    kept, stable = _split(matrices(sys))
    values, left, right = _balance(*stable[:3])
    fixed, n = len(kept[0]), len(sys.A)
    if not fixed <= order <= n:
        raise InputError(
            f"balanced truncation: order {order} is not possible. The system has {n} states, of which {fixed} are not "
            f"stable and must be kept; give {fixed} to {n} [HM-ANALYZE-052]"
        )
    r = min(order - fixed, right.shape[1])
    t, w = right[:, :r], left[:r]
    a = np.zeros((fixed + r, fixed + r))
    a[:fixed, :fixed], a[fixed:, fixed:] = kept[0], w @ stable[0] @ t
    b = np.vstack([kept[1], w @ stable[1]])
    c = np.hstack([kept[2], stable[2] @ t])
    small = control_toolbox().ss(
        a, b, c, stable[3], dt, remove_useless_states=False,
        inputs=list(sys.input_labels), outputs=list(sys.output_labels), name=str(sys.name) + "_reduced",
    )  # fmt: skip
    hankel = np.concatenate([np.full(fixed, np.inf), values])
    return Reduced(small, hankel, fixed + r, float(2 * values[r:].sum()))


def physical_states(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None,
    *, x_scale: ArrayLike | None = None, u_scale: ArrayLike | None = None, system: Any = None,
) -> Reduced:  # fmt: skip
    """Reduce a linearization over ``(x, h)`` to the physical states ``x``.

    First, balanced truncation of the response from inputs to all physical states (scaled by ``x_scale``, ``u_scale``).
    Then a change of coordinates, so that the states of the reduced system approximate the physical states. The slow
    part of the hidden state is included; the rest is within the bound.

    Args:
        model: The model.
        x: Operating point ``(n_x,)``.
        u: Input ``(n_u,)``.
        h: Hidden state ``(n_h,)``. Default: its equilibrium.
        x_scale: Scale of each state ``(n_x,)``. Default: 1.
        u_scale: Scale of each input ``(n_u,)``. Default: 1.
        system: Linearization over ``(x, h)`` to reduce instead of the tangent at the point. Default: none.

    Returns:
        The reduced system over ``x``, with the model's outputs; the bound is that of the scaled states' response.

    Raises:
        InputError: If a size is wrong, or there are more poles on or outside the unit circle than physical states.

    Example:
        ``physical_states(model, [0.0, 0.0], [0.0], x_scale=[0.5, 2.0], u_scale=[0.2]).system.A``
    """
    sys = linearize(model, x, u, h) if system is None else system
    n_x = model.n_x
    by_x = _scale(x_scale, n_x, "x_scale")
    by_u = _scale(u_scale, model.n_u, "u_scale")
    a, b, c, d = matrices(sys)
    states = np.hstack([np.diag(1.0 / by_x), np.zeros((n_x, len(a) - n_x))])
    control = control_toolbox()
    scaled = control.ss(a, b * by_u, states, 0.0, sys.dt, remove_useless_states=False)
    reduced = balanced_truncation(scaled, n_x)
    turn = by_x[:, None] * np.asarray(reduced.system.C)  # reduced state to physical states
    if reduced.order < n_x or np.linalg.cond(turn / by_x[:, None]) > 1.0 / np.sqrt(np.finfo(float).eps):
        raise InputError(
            f"model {model.name}: the {n_x} states of the reduced system do not determine the physical states "
            "(one of them is not controllable). Keep the full linearization [HM-ANALYZE-053]"
        )
    small = control.ss(
        turn @ reduced.system.A @ np.linalg.inv(turn), turn @ reduced.system.B / by_u, c[:, :n_x], d, sys.dt,
        remove_useless_states=False, states=[s.name for s in model.states], inputs=list(sys.input_labels),
        outputs=list(sys.output_labels), name=model.name + "_reduced",
    )  # fmt: skip
    return Reduced(small, reduced.hankel, n_x, reduced.bound)


def _scale(value: ArrayLike | None, n: int, name: str) -> Array:
    scale = np.ones(n) if value is None else np.asarray(value, dtype=float).reshape(-1)
    if scale.shape != (n,) or not np.all(np.isfinite(scale)) or not np.all(scale > 0):
        raise InputError(f"{name}: give {n} positive numbers, got {scale.tolist()} [HM-ANALYZE-054]")
    return scale


def matrices(sys: Any) -> Matrices:
    """A, B, C and D of a ``control.StateSpace``."""
    a, b, c, d = (np.asarray(m, dtype=float) for m in (sys.A, sys.B, sys.C, sys.D))
    return a, b, c, d


def _split(given: Matrices) -> tuple[Matrices, Matrices]:
    """Split a system into the part with poles on or outside the unit circle, and the stable part with D.

    An ordered real Schur form ``[[A1, A12], [0, A2]]`` is decoupled by the solution X of ``A1 X - X A2 = -A12``.
    """
    a, b, c, d = given
    t, q, kept = schur(a, sort=lambda re, im: np.hypot(re, im) >= 1.0 - EDGE)
    if len(t) - kept == 0 or kept == 0:
        whole = q.T @ a @ q, q.T @ b, c @ q, d
        none = np.zeros((0, 0)), np.zeros((0, b.shape[1])), np.zeros((c.shape[0], 0)), d
        return (none, whole) if kept == 0 else (whole, none)
    first, second, cross = t[:kept, :kept], t[kept:, kept:], t[:kept, kept:]
    x = solve_sylvester(first, -second, -cross)
    b, c = q.T @ b, c @ q
    upper = (first, b[:kept] - x @ b[kept:], c[:, :kept], np.zeros_like(d))
    return upper, (second, b[kept:], c[:, kept:] + c[:, :kept] @ x, d)


def _balance(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
    """Hankel singular values, and the projections ``W`` (rows) and ``T`` (columns) with ``W T = I``.

    With the Gramians ``P = R R'`` (controllability) and ``Q = S S'`` (observability), the singular values are those of
    ``S' R`` (square-root method of Tombs and Postlethwaite).
    """
    if not len(a):
        return np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))
    reach = _root(solve_discrete_lyapunov(a, b @ b.T, method="bilinear"))
    see = _root(solve_discrete_lyapunov(a.T, c.T @ c, method="bilinear"))
    left, values, right = np.linalg.svd(see.T @ reach)
    # share of the largest Hankel singular value below which a value is rounding; such states are always truncated
    there = int(np.sum(values > 1e-14 * values[0])) if values.size and values[0] > 0 else 0
    scale = 1.0 / np.sqrt(values[:there])
    return values, (see @ left[:, :there] * scale).T, reach @ right[:there].T * scale


def _root(gramian: Array) -> Array:
    """``R`` with ``R R' = gramian``; negative eigenvalues, which are rounding errors, are set to zero."""
    symmetric = 0.5 * (gramian + gramian.T)
    try:
        return np.asarray(cholesky(symmetric, lower=True))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(symmetric)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
