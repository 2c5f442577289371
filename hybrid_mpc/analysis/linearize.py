"""Fixed points and exact linearisations of a model over ``[x; h]``."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.analysis.symbolic import jacobians
from hybrid_mpc.analysis.toolbox import control_toolbox, signal_names
from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel

Array = NDArray[np.float64]
RESIDUAL = 1e-10
ITERATIONS = 50


def fixed_point(model: HybridModel, u: ArrayLike, x_guess: ArrayLike) -> tuple[Array, Array]:
    """State and hidden state that one step under ``u`` leaves where they are.

    Damped Newton on ``step(x, h, u) - (x, h)`` with the exact Jacobian, from ``x_guess`` and the hidden
    state at rest for it.

    Args:
        model: The model.
        u: Held input ``(n_u,)``.
        x_guess: Start ``(n_x,)``.

    Returns:
        ``x`` ``(n_x,)`` and ``h`` ``(n_h,)``; largest residual at most 1e-10 in the units of the state.

    Raises:
        InputError: If a size is wrong or Newton finds none; try another guess or input.

    Example:
        ``x, h = fixed_point(model, [0.0], [3.0, 0.0])``
    """
    x0, u0 = column(model, "x_guess", x_guess, model.n_x), column(model, "u", u, model.n_u)
    start = np.concatenate([x0, settled_hidden(model, x0, u0)])
    found, size = newton(rest_residual(model), start, u0)
    if size > RESIDUAL:
        raise InputError(
            f"model {model.name}: no fixed point found from x = {x0.tolist()} under u = {u0.tolist()} "
            f"(residual {size:.2g}, needed {RESIDUAL:g}); give a nearer x_guess or an input it can rest under"
        )
    return found[: model.n_x], found[model.n_x :]


def hidden_fixed_point(model: HybridModel, x: ArrayLike, u: ArrayLike) -> Array:
    """Hidden state ``(n_h,)`` at rest while ``x`` ``(n_x,)`` and ``u`` ``(n_u,)`` are held.

    Raises:
        InputError: If a size is wrong or none is found (residual above 1e-10).

    Example:
        ``h = hidden_fixed_point(model, [0.0, 2.0], [0.1])``
    """
    x0, u0 = column(model, "x", x, model.n_x), column(model, "u", u, model.n_u)
    if model.n_h == 0:
        return np.zeros(0)
    h = ca.MX.sym("h", model.n_h)
    p = ca.MX.sym("p", model.n_x + model.n_u)
    r = model.step(p[: model.n_x], h, p[model.n_x :], model.w, model.p)[1] - h
    residual = ca.Function("residual", [h, p], [r, ca.densify(ca.jacobian(r, h))])
    found, size = newton(residual, settled_hidden(model, x0, u0), np.concatenate([x0, u0]))
    if size > RESIDUAL:
        raise InputError(
            f"model {model.name}: the hidden state finds no rest at x = {x0.tolist()} (residual {size:.2g}); "
            "give h"
        )
    return found


def linearize(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None, *, continuous: bool = False
) -> Any:
    """State space of small deviations around ``(x, h, u)``, from exact derivatives.

    Args:
        model: The model.
        x: Operating point ``(n_x,)``; it need not be an equilibrium.
        u: Input ``(n_u,)``.
        h: Hidden state ``(n_h,)``. Default: its fixed point while ``x`` and ``u`` are held.
        continuous: The ODE itself instead of its step, where there is no hidden state. Default: no.

    Returns:
        ``control.StateSpace`` with period ``model.dt`` (0 if continuous) over the states ``[x; h]``; no state is
        removed.

    Raises:
        InputError: If a size is wrong, the hidden state finds no rest, or python-control is not installed.

    Example:
        ``control.damp(linearize(model, x, u))``
    """
    control = control_toolbox()
    x0, u0 = column(model, "x", x, model.n_x), column(model, "u", u, model.n_u)
    h0 = hidden_fixed_point(model, x0, u0) if h is None else column(model, "h", h, model.n_h)
    a, b, c, d = (m.full() for m in jacobians(model, continuous=continuous)(x0, h0, u0))
    return control.ss(
        a, b, c, d, 0 if continuous else model.dt, remove_useless_states=False, **signal_names(model)
    )  # fmt: skip


def linearize_at_speed(model: HybridModel, q: ArrayLike, v_work: ArrayLike, u: ArrayLike) -> Any:
    """Linearisation with friction as it is at working speed, at ``x = (q, v_work)``.

    At rest the slope of a smoothed Coulomb friction ``tanh(v / v_s)`` dominates everything: it is a huge
    viscous damper that no motion ever feels. At ``|v_work|`` of several ``v_s`` the slope is that of the
    motion. Models are to be compared at the same ``(q, v_work, u)``; the point is no equilibrium, so the
    result describes small deviations from the motion over times short against it.

    Args:
        model: The model, state ``[q, v]``.
        q: Positions ``(n_x / 2,)``.
        v_work: Working speeds ``(n_x / 2,)``.
        u: Input ``(n_u,)`` there.

    Returns:
        ``control.StateSpace`` as from :func:`linearize`.

    Raises:
        InputError: If a size is wrong or the hidden state finds no rest.

    Example:
        ``linearize_at_speed(model, [0.0], [2.0], [0.1])``
    """
    n_q = model.n_x // 2
    x = np.concatenate([column(model, "q", q, n_q), column(model, "v_work", v_work, n_q)])
    return linearize(model, x, u)


def rest_residual(model: HybridModel) -> ca.Function:
    """``(z, u)`` to what one step changes of ``z = (x, h)``, and its Jacobian by ``z``."""
    x, h = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h)
    z, v = ca.vertcat(x, h), ca.MX.sym("u", model.n_u)
    r = ca.vertcat(*model.step(x, h, v, model.w, model.p)) - z
    return ca.Function("residual", [z, v], [r, ca.densify(ca.jacobian(r, z))])


def newton(residual: ca.Function, z: Array, p: Array) -> tuple[Array, float]:
    """Newton with step halving; the best point and its largest residual (inf if it is not finite)."""
    r, jacobian = (np.asarray(m.full()) for m in residual(z, p))
    for _ in range(ITERATIONS):
        size = float(np.abs(r).max(initial=0.0))
        if not np.isfinite(size) or size <= 1e-3 * RESIDUAL:
            break
        step = np.linalg.lstsq(jacobian, -r.ravel(), rcond=None)[0]
        scale, improved = 1.0, False
        while scale > 1e-4 and not improved:
            trial = z + scale * step
            r_new, j_new = (np.asarray(m.full()) for m in residual(trial, p))
            improved = bool(np.linalg.norm(r_new) < np.linalg.norm(r))
            scale *= 0.5
        if not improved:
            break
        z, r, jacobian = trial, r_new, j_new
    size = float(np.abs(r).max(initial=0.0))
    return z, size if np.isfinite(size) else float("inf")


def settled_hidden(model: HybridModel, x: Array, u: Array, steps: int = 100) -> Array:
    """Hidden state ``(n_h,)`` after some periods at held ``x`` and ``u``, from zero."""
    h = np.zeros(model.n_h)
    for _ in range(steps if model.n_h else 0):
        h = model.step(x, h, u, model.w, model.p)[1].full().ravel()
    return h


def column(model: HybridModel, name: str, value: ArrayLike, n: int) -> Array:
    """``n`` finite numbers.

    Raises:
        InputError: If they are not.
    """
    array = np.asarray(value, dtype=np.float64).reshape(-1)
    if array.size != n or not np.isfinite(array).all():
        raise InputError(f"model {model.name}: {name} must be {n} finite numbers, got {array.tolist()}")
    return array
