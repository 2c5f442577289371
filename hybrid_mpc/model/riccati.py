"""Linearization of a model with its hidden state settled; Riccati equation and LQR gain."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.limits import floats, vector
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
DOUBLINGS, REFINED = 60, 3
"""Most doublings, which reach 2^60 periods ahead, and number of Newton steps, each of which squares the error."""
ROUNDING = 1e-16
"""Relative size of a further term below which it is rounding."""
UNDAMPED = 1e-9
"""Largest distance from the unit circle of an undamped mode, and largest singular value, over the largest one, of a
mode that no input reaches."""


def dare(a: ArrayLike, b: ArrayLike, q: ArrayLike, r: ArrayLike) -> tuple[Array, Array]:
    """Riccati matrix and LQR gain of ``z+ = A z + B u`` with the cost ``sum z'Qz + u'Ru``.

    Args:
        a: ``(n, n)``.
        b: ``(n, m)``.
        q: Symmetric positive semi-definite ``(n, n)``.
        r: Symmetric positive definite ``(m, m)``.

    Returns:
        ``P`` ``(n, n)`` and ``K`` ``(m, n)``; the optimal input is ``u = -K z``.

    Raises:
        InputError: If (A, B) is not stabilisable, or a mode on the unit circle has no weight.

    The solution does not depend on units: ``P`` is the limit of a structured doubling algorithm, which only adds
    positive semi-definite matrices, refined by Newton's method. A general solver of generalised eigenvalue problems is
    wrong by several times the gain at ``r = 1e14 q``, where the modes are close to the unit circle.

    Source: Anderson and Moore, *Optimal Control: Linear Quadratic Methods*, 1990, section 2.4; Chu, Fan, Lin, Wang,
    *Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations*, 2004; Hewer, *An iterative
    technique for the computation of the steady state gains for the discrete optimal regulator*, 1971.

    Example:
        >>> p, k = dare([[1.0]], [[1.0]], [[1.0]], [[1.0]])
        >>> round(float(p[0, 0]), 6), round(float(k[0, 0]), 6)
        (1.618034, 0.618034)
    """
    given = {"A": a, "B": b, "Q": q, "R": r}
    a, b, q, r = (np.atleast_2d(floats(m, f"Riccati equation: {name}")) for name, m in given.items())
    hint = "Check the pair (A, B), give every undamped state a positive q and every input a positive r."
    if not all(np.all(np.isfinite(m)) for m in (a, b, q, r)):
        raise InputError("Riccati equation: A, B, Q or R contains NaN or infinity [HM-MODEL-039]")
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # checked below
            p = _doubled(a, b, q, r)
            for _ in range(REFINED):
                k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)  # K = (R + B'PB)^-1 B'PA
                closed = a - b @ k
                if not np.max(np.abs(np.linalg.eigvals(closed))) < 1.0:
                    break
                p = _lyapunov(closed, q + k.T @ r @ k)
            k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
            radius = float(np.max(np.abs(np.linalg.eigvals(a - b @ k))))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"Riccati equation: no stabilising solution ({error}). {hint} [HM-MODEL-040]"
        ) from error
    if not radius < 1.0:
        raise InputError(
            f"Riccati equation: not stabilisable, spectral radius {radius:.6f} in closed loop. {hint} [HM-MODEL-041]"
        )
    return p, np.asarray(k, dtype=np.float64)


def _doubled(a: Array, b: Array, q: Array, r: Array) -> Array:
    """``P`` by doubling: with ``W = I + GH``, ``A+ = A W^-1 A``, ``G+ = G + A W^-1 G A'``, ``H+ = H + A' H W^-1 A``,
    from ``G = B R^-1 B'`` and ``H = Q``, of which ``H`` goes to ``P``.
    """
    size = np.sqrt(np.diag(r))
    if not np.all(size > 0):
        raise ValueError("R is not positive definite [HM-MODEL-042]")
    scaled = b / size
    g, h, eye = scaled @ np.linalg.solve(r / np.outer(size, size), scaled.T), q, np.eye(len(a))
    for _ in range(DOUBLINGS):
        both = np.linalg.solve(eye + g @ h, np.hstack([a, g]))
        more, g = a.T @ h @ both[:, : len(a)], g + a @ both[:, len(a) :] @ a.T
        a = a @ both[:, : len(a)]
        h, g = h + 0.5 * (more + more.T), 0.5 * (g + g.T)
        if not np.max(np.abs(more)) > ROUNDING * np.max(np.abs(h)):
            break
    return h


def _lyapunov(a: Array, q: Array) -> Array:
    """``P = A'PA + Q``: the sum of ``A'^k Q A^k``, with twice as many terms after each step."""
    p = q
    for _ in range(DOUBLINGS):
        more = a.T @ p @ a
        p, a = p + 0.5 * (more + more.T), a @ a
        if not np.max(np.abs(more)) > ROUNDING * np.max(np.abs(p)):
            break
    return p


def linearization(model: HybridModel, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """``A``, ``B``: derivatives of the next ``z = (x, h)`` by ``z`` and ``u`` at ``(x, u)``; and the settled ``h``."""
    h = hidden_fixed_point(model, x, u)
    _, _, a, b = model.with_jacobian(x, h, u, model.w, model.p)
    return a.full(), b.full(), h


def unmoved_states(model: HybridModel, a: Array, b: Array) -> tuple[str, ...]:
    """Names of states that no input affects and that do not return to rest by themselves.

    They belong to modes of ``z+ = A z + B u`` on or outside the unit circle that ``B`` does not reach (Hautus test):
    then set-points have no steady state, and the Riccati equation has no stabilising solution.

    Args:
        model: The model.
        a: ``(n_z, n_z)`` by ``z = (x, h)``.
        b: ``(n_z, n_u)``.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> v, u = ca.MX.sym("v", 2), ca.MX.sym("u")
        >>> room = HybridModel.of("room", 1.0, (Signal("oven", "degC"), Signal("room", "degC")), (Signal("u", "W"),),
        ...     (Signal("oven", "degC"),), x=v, u=u, y=v[0], x_next=ca.vertcat(0.9 * v[0] + 0.1 * v[1] + u, v[1]),
        ...     xdot=ca.vertcat(u, 0))
        >>> unmoved_states(room, *linearization(room, [20.0, 20.0], [0.0])[:2])
        ('room',)
    """
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return ()
    size = np.concatenate([np.where(model.x0 != 0, np.abs(model.x0), 1.0), np.ones(model.n_h)])
    a, b = a * size / size[:, None], b / size[:, None]
    share = np.zeros(len(a))
    for mode in np.linalg.eigvals(a):
        if abs(mode) < 1.0 - UNDAMPED:
            continue
        left, sizes, _ = np.linalg.svd(np.hstack([a - mode * np.eye(len(a)), b]))
        share = np.maximum(share, np.max(np.abs(left) * (sizes < UNDAMPED * sizes[0]), axis=1))
    least = 0.5 * max(np.max(share), 1e-3)
    return tuple(s.name for s, part in zip(model.states, share, strict=False) if part > least)


def remedy_for_unmoved(names: tuple[str, ...]) -> str:
    """A remedy for states from :func:`unmoved_states`; empty for none."""
    if not names:
        return ""
    name = names[0]
    return (
        f"no input affects {', '.join(names)}, and the dynamics do not return to a steady value. Let the state return "
        f"slowly to its usual value in xdot, e.g. (usual - x.{name}) / 86400 for one day in seconds, or make it a "
        "measured disturbance"
    )


def lqr(
    model: HybridModel,
    x_target: ArrayLike,
    u_target: ArrayLike,
    q: ArrayLike,
    r: ArrayLike,
    *,
    working_point: tuple[ArrayLike, ArrayLike] | None = None,
) -> Array:
    """Gain ``K`` ``(n_u, n_x + n_h)`` of ``u = u_target - K (z - z_target)`` with ``z = (x, h)``.

    The model is linearized with its exact Jacobian and its hidden state settled. At rest the steep slope of a smoothed
    friction law (tanh) dominates the linearization and looks like strong damping; ``working_point`` linearizes at a
    moving point instead.

    Args:
        model: The model; ``n_h`` may be 0.
        x_target: ``(n_x,)`` [SI].
        u_target: ``(n_u,)`` [SI].
        q: Weights of the states ``(n_x,)``; hidden states have none.
        r: Weights of the inputs ``(n_u,)``, positive.
        working_point: ``(x, u)`` to linearize at. Default: the target.

    Raises:
        InputError: If a shape does not fit, or the linearized model is not stabilisable.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> lqr(model, [0.0], [0.0], [1.0], [1.0]).round(6)
        array([[0.618034]])
    """
    target = vector(x_target, model.n_x, "x_target"), vector(u_target, model.n_u, "u_target")
    q_v, r_v = vector(q, model.n_x, "q"), vector(r, model.n_u, "r")
    x, u = target if working_point is None else working_point
    x, u = vector(x, model.n_x, "working_point x"), vector(u, model.n_u, "working_point u")
    a, b, _ = linearization(model, x, u)
    return dare(a, b, np.diag(np.concatenate([q_v, np.zeros(model.n_h)])), np.diag(r_v))[1]
