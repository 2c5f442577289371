"""Friction in a linearization: the slope at rest, and the secant at working speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.analyze.linearize import column, control_toolbox, hidden_fixed_point, jacobians, signal_names
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
Kind: TypeAlias = Literal["secant", "harmonic"]
ANGLES = 64
"""Points of a sinusoid's period over which the harmonic mean is taken; exact for polynomials of degree 62."""


@dataclass(frozen=True)
class FrictionSlopes:
    """How much damping a speed sees, by three linearizations, at rest position ``q`` under the input ``u``.

    All are ``-d(acceleration) / d(speed)`` [1/s] for the sizes ``speed``; times the inertia they are a viscous
    damping coefficient.

    Args:
        speed: Speeds ``(n,)`` [unit of v].
        tangent: Slope at rest, the same for all speeds: what :func:`linearize` takes.
        secant: ``(n,)``: slope of the line through the accelerations at ``+speed`` and ``-speed``.
        harmonic: ``(n,)``: describing function of a sinusoid of that amplitude.
        moving: ``(n,)``: slope at the speed itself, as :func:`linearize_at_speed` takes it.
        per_input: Acceleration per unit of the input [unit of a / input unit], to turn slopes into input units.
    """

    speed: Array
    tangent: float
    secant: Array
    harmonic: Array
    moving: Array
    per_input: float


def friction_slopes(
    model: HybridModel, q: ArrayLike, speeds: ArrayLike, u: ArrayLike | None = None, *, axis: int = 0
) -> FrictionSlopes:
    """Damping of one axis as tangent, secant, describing function and tangent in motion.

    Args:
        model: The model, state ``[q, v]``.
        q: Positions ``(n_x / 2,)``.
        speeds: Sizes of the speed ``(n,)``, positive.
        u: Input ``(n_u,)``. Default: zero.
        axis: Number of the axis. Default: the first.

    Raises:
        InputError: If a size is wrong, a speed is not positive, or the hidden state finds no rest.

    Source: the describing function: Gelb and Vander Velde, *Multiple-Input Describing Functions and Nonlinear System
    Design*, 1968, section 2.2.

    Example:
        ``friction_slopes(model, [0.0], [0.1, 1.0]).secant``
    """
    n_q = model.n_x // 2
    size = np.asarray(speeds, dtype=float).reshape(-1)
    if not size.size or not np.all(np.isfinite(size)) or not np.all(size > 0):
        raise InputError(f"friction: speeds must be positive, got {size.tolist()}")
    if not 0 <= axis < n_q:
        raise InputError(f"friction: axis {axis} given, model {model.name} has axes 0 to {n_q - 1}")
    held = np.zeros(model.n_u) if u is None else column(model, "u", u, model.n_u)
    x = np.concatenate([column(model, "q", q, n_q), np.zeros(n_q)])
    h, i = hidden_fixed_point(model, x, held), n_q + axis
    e = np.eye(model.n_x)[i]

    def acceleration(v: float) -> float:
        return float(model.xdot(x + v * e, h, held, model.w, model.p)[i])

    slope = _slope_of(model, i)
    secant = np.array([_chord(acceleration, v, "secant") for v in size])
    harmonic = np.array([_chord(acceleration, v, "harmonic") for v in size])
    moving = np.array([slope(x + v * e, h, held)[0] for v in size])
    tangent, per_input = slope(x, h, held)
    return FrictionSlopes(size, -tangent, -secant, -harmonic, -moving, per_input)


def linearize_secant(
    model: HybridModel, x: ArrayLike, u: ArrayLike, speed: ArrayLike, h: ArrayLike | None = None,
    *, kind: Kind = "harmonic",
) -> Any:  # fmt: skip
    """Linearization at rest whose damping is that of motions of a given size.

    A smoothed Coulomb friction has a slope at rest that no motion feels. Here the columns of A by the velocities are
    chords: of the step from ``v = +speed`` and ``-speed`` (``"secant"``), or the mean over a sinusoid of that
    amplitude (``"harmonic"``, the describing function; 4/pi of the secant for Coulomb friction). All other columns
    are the tangents. The point stays a point of rest, so poles, loops and margins of it mean something.

    Args:
        model: The model, state ``[q, v]``.
        x: Operating point ``(n_x,)``, at rest.
        u: Input ``(n_u,)``.
        speed: Size of the motion ``(n_x / 2,)`` [units of v], positive.
        h: Hidden state ``(n_h,)``, held while the speed varies. Default: its fixed point at rest.
        kind: See above. Default: ``"harmonic"``.

    Returns:
        ``control.StateSpace`` as from :func:`linearize`.

    Raises:
        InputError: If a size is wrong, a speed is not positive, or the hidden state finds no rest.

    Example:
        ``linearize_secant(model, [0.0, 0.0], [0.0], [0.5])``
    """
    n_q, n_z = model.n_x // 2, model.n_x + model.n_h
    x0, u0 = column(model, "x", x, model.n_x), column(model, "u", u, model.n_u)
    h0 = hidden_fixed_point(model, x0, u0) if h is None else column(model, "h", h, model.n_h)
    size = column(model, "speed", speed, n_q)
    if not np.all(size > 0):
        raise InputError(f"secant: speeds must be positive, got {size.tolist()}")
    if kind not in ("secant", "harmonic"):
        raise InputError(f"secant: kind must be 'secant' or 'harmonic', got {kind!r}")
    a, b, c, d = (m.full() for m in jacobians(model)(x0, h0, u0))
    for j, v in enumerate(size):
        e = np.eye(model.n_x)[n_q + j]

        def after(w: float, e: Array = e) -> Array:
            return np.concatenate(
                [m.full().ravel() for m in model.step(x0 + w * e, h0, u0, model.w, model.p)]
            )

        a[:, n_q + j] = np.reshape(_chord(after, v, kind), n_z)
    return control_toolbox().ss(a, b, c, d, model.dt, remove_useless_states=False, **signal_names(model))


def _chord(f: Any, v: float, kind: Kind) -> Any:
    if kind == "secant":
        return (f(v) - f(-v)) / (2 * v)
    theta = (np.arange(ANGLES // 2) + 0.5) * (2 * np.pi / ANGLES)  # half the period; the other mirrors it
    points = v * np.cos(theta)
    return sum(f(p) * p for p in points) / float(np.sum(points**2))


def _slope_of(model: HybridModel, i: int) -> Any:
    """``(x, h, u)`` to the derivatives of ``xdot[i]`` by ``x[i]`` and by the first input."""
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    rate = model.xdot(x, h, u, model.w, model.p)[i]
    f = ca.Function("slope", [x, h, u], [ca.jacobian(rate, x)[i], ca.jacobian(rate, u)[0]])
    return lambda *point: tuple(float(m) for m in f(*point))
