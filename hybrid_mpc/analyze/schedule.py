"""LQR gains over a grid of operating points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from hybrid_mpc.analyze.friction import Kind, linearize_secant
from hybrid_mpc.analyze.linearize import (
    RESIDUAL,
    column,
    hidden_fixed_point,
    linearize,
    newton,
    settled_hidden,
)
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.riccati import dare, vector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GainSchedule:
    """LQR gains by operating point: ``du = -gain[k] @ dz`` with ``z = (x, h)``.

    Args:
        x: Operating points ``(n, n_x)``.
        u: Inputs there ``(n, n_u)``.
        gain: ``(n, n_u, n_x + n_h)`` [input unit / state unit].
        radius: Spectral radius of each closed loop ``(n,)``.
        open_radius: That of each open loop ``(n,)``.
    """

    x: Array
    u: Array
    gain: Array
    radius: Array
    open_radius: Array


def gain_schedule(
    model: HybridModel, points: Iterable[tuple[ArrayLike, ArrayLike]], q: ArrayLike, r: ArrayLike,
    *, speed: ArrayLike | None = None, kind: Kind = "harmonic",
) -> GainSchedule:  # fmt: skip
    """LQR of the linearization at each point, hidden states (at their fixed points) without weight.

    Args:
        model: The model.
        points: Operating points ``(x, u)``.
        q: Weights of the states ``(n_x,)``.
        r: Weights of the inputs ``(n_u,)``, positive.
        speed: Size of the motion that the friction is linearized for, see :func:`linearize_secant`. Default: the
            tangent at the point.
        kind: How, see there.

    Raises:
        InputError: If there is no point, a size is wrong, or a linearization is not stabilisable.

    Source: Rugh and Shamma, *Research on gain scheduling*, Automatica 36 (2000).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> gain_schedule(model, [([0.0], [0.0])], [1.0], [1.0]).gain.round(6).ravel()
        array([0.618034])
    """
    given = [(column(model, "x", x, model.n_x), column(model, "u", u, model.n_u)) for x, u in points]
    if not given:
        raise InputError("gain schedule: no operating point given")
    weights = np.diag(np.concatenate([vector(q, model.n_x, "q"), np.zeros(model.n_h)]))
    costs = np.diag(vector(r, model.n_u, "r"))
    gains, radii, before = [], [], []
    for x, u in given:
        h = hidden_fixed_point(model, x, u)
        chord = None if speed is None else linearize_secant(model, x, u, speed, h, kind=kind)
        system = linearize(model, x, u, h) if chord is None else chord
        _, k = dare(system.A, system.B, weights, costs)
        gains.append(k)
        radii.append(_radius(system.A - system.B @ k))
        before.append(_radius(system.A))
    xs, us = np.stack([x for x, _ in given]), np.stack([u for _, u in given])
    return GainSchedule(xs, us, np.stack(gains), np.array(radii), np.array(before))


def holding_input(model: HybridModel, q: ArrayLike, *, u_guess: ArrayLike | None = None) -> Array:
    """Input ``(n_u,)`` that holds a machine at rest at positions ``q`` ``(n_x / 2,)``, with its hidden state settled.

    Args:
        model: The model, state ``[q, v]``, with as many inputs as positions.
        q: The positions.
        u_guess: Start ``(n_u,)``. Default: zero.

    Raises:
        InputError: If the numbers of inputs and positions differ, or no such input is found.

    Example:
        ``gain_schedule(model, [(np.append(q, 0.0), holding_input(model, [q])) for q in angles], weights, costs)``
    """
    n_q = model.n_x // 2
    if model.n_u != n_q:
        raise InputError(
            f"model {model.name}: {model.n_u} inputs cannot be found from {n_q} positions; give them"
        )
    x = np.concatenate([column(model, "q", q, n_q), np.zeros(n_q)])
    start = np.zeros(model.n_u) if u_guess is None else column(model, "u_guess", u_guess, model.n_u)
    h, u, v = ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u), ca.MX.sym("x", model.n_x)
    x_next, h_next = model.step(v, h, u, model.w, model.p)
    unknown, change = ca.vertcat(h, u), ca.vertcat(h_next - h, x_next[n_q:] - v[n_q:])
    residual = ca.Function("hold", [unknown, v], [change, ca.densify(ca.jacobian(change, unknown))])
    found, size = newton(residual, np.concatenate([settled_hidden(model, x, start), start]), x)
    if size > RESIDUAL and model.n_u == 1 and (near := _between(model, x, float(start[0]))) is not None:
        found, size = newton(residual, np.concatenate([settled_hidden(model, x, near), near]), x)
    if size > RESIDUAL:
        raise InputError(
            f"model {model.name}: no input found that holds q = {x[:n_q].tolist()} (residual {size:.2g})"
        )
    return found[model.n_h :]


def _between(model: HybridModel, x: Array, guess: float) -> Array | None:
    """An input near which the speed changes sign with the hidden state settled, if one is found around a guess."""
    n_q = model.n_x // 2

    def gained(u: float) -> float:
        held = np.array([u])
        return float(model.step(x, settled_hidden(model, x, held), held, model.w, model.p)[0][n_q])

    for reach in 0.01 * 2.0 ** np.arange(12):
        low, high = guess - reach, guess + reach
        if gained(low) * gained(high) < 0:
            return np.array([brentq(gained, low, high, xtol=1e-9)])
    return None


def _radius(a: Array) -> float:
    return float(np.abs(np.linalg.eigvals(a)).max())
