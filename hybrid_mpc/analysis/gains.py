"""What controller and estimator are to first order: the gain of the MPC's QP, the steady Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_discrete_are

from hybrid_mpc.analysis.linearize import column, hidden_fixed_point, linearize
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate, ExtendedKalmanFilter
from hybrid_mpc.mpc.condensed import CondensedController
from hybrid_mpc.mpc.condensing import propagate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MpcGain:
    """An MPC to first order: ``du_0 = by_state dz + by_load dd + by_before du_before + by_reference dr``.

    It is exact as long as no bound acts and the prediction's linearisation stays the same.

    Args:
        by_state: By the estimate of ``z = (x, h)``, ``(n_u, n_z)``.
        by_load: By the estimated input disturbance ``(n_u, n_u)``.
        by_before: By the input held before ``(n_u, n_u)``; zero without ``r_delta``.
        by_reference: By a reference that is constant over the horizon ``(n_u, n_x)``.
    """

    by_state: Array
    by_load: Array
    by_before: Array
    by_reference: Array


def mpc_gain(
    controller: CondensedController, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None, *, system: Any = None
) -> MpcGain:  # fmt: skip
    """Derivative of the QP's solution where no bound acts, at an operating point that the whole plan holds.

    The condensed QP ``min 1/2 s'Hs + g's`` has the solution ``s = -H^{-1} g``, and ``g`` is affine in the estimate,
    the disturbance, the input before and the reference; so the derivative is a solve with the controller's own ``H``.

    Args:
        controller: The real-time iteration; its weights, horizon, terminal weight and move blocks are used.
        x: Operating point ``(n_x,)``.
        u: Input there ``(n_u,)``, within the bounds.
        h: Hidden state ``(n_h,)``. Default: its fixed point.
        system: Linearisation over ``(x, h)`` that the prediction is to have, e.g. of :func:`linearize_secant`.
            Default: the tangent at the point.

    Raises:
        InputError: If a size is wrong, the point violates a bound of the inputs or a soft one, or the problem has an
            economic stage cost (its curvature changes along the plan).

    Source: Fiacco, *Introduction to Sensitivity and Stability Analysis in Nonlinear Programming*, 1983, for bounds
    that do not act; Bemporad, Morari, Dua, Pistikopoulos, *The explicit linear quadratic regulator for constrained
    systems*, Automatica 38 (2002).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.model import HybridModel
        >>> from hybrid_mpc.mpc import OCP
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> controller = CondensedController(model, OCP(5, [1.0], [1.0], [0.0], [-9.0], [9.0]))
        >>> mpc_gain(controller, [0.0], [0.0]).by_state.round(6)
        array([[-0.618034]])
    """
    model, ocp = controller.model, controller.ocp
    n, n_x, n_u = ocp.horizon, model.n_x, model.n_u
    x0, u0 = column(model, "x", x, n_x), column(model, "u", u, n_u)
    h0 = hidden_fixed_point(model, x0, u0) if h is None else column(model, "h", h, model.n_h)
    if np.any(u0 <= ocp.u_min) or np.any(u0 >= ocp.u_max):
        raise InputError(
            f"MPC gain: the input {u0.tolist()} lies on or outside the bounds, where it does not move"
        )
    if ocp.economic is not None:
        raise InputError(
            "MPC gain: the problem has an economic stage cost; its gain depends on the whole plan"
        )
    z0 = np.concatenate([x0, h0])
    plan, z = np.tile(u0, (n, 1)), np.tile(z0, (n + 1, 1))
    if np.any(controller.problem.soft.excess(controller.problem.soft.values(z[:, :n_x], plan)) > 0):
        raise InputError(
            f"MPC gain: the point x = {x0.tolist()} violates a soft bound; take one where none acts"
        )
    sys = linearize(model, x0, u0, h0) if system is None else system
    a, b = np.asarray(sys.A, dtype=float), np.asarray(sys.B, dtype=float)
    derivatives = z[1:], np.tile(a.T, (n, 1, 1)), np.tile(b, (n, 1, 1))
    weight = np.ones((n + 1, n_x))
    prepared = controller.condense(plan, z, np.zeros(n_u), u0, weight, derivatives, perf_counter())
    none = np.zeros((n, len(a)))
    stages = list(prepared.a_t.transpose(0, 2, 1))
    by_z = np.stack([propagate(stages, none, e)[:, :n_x].ravel() for e in np.eye(len(a))], axis=1)
    every = np.tile(np.eye(n_u), (n, 1))
    hold = np.tile(np.eye(n_x), (n + 1, 1))
    before = np.zeros((n * n_u, n_u))
    before[:n_u] = -2 * model.dt * np.diag(ocp.r_delta)
    slopes = np.hstack([
        2 * prepared.weighted.T @ by_z, 2 * prepared.weighted.T @ (prepared.from_u @ every), before,
        -2 * prepared.weighted.T @ hold,
    ])  # fmt: skip
    hessian, slopes = _blocked(controller, prepared.hessian, slopes)
    first = -cho_solve(cho_factor(hessian), slopes)[:n_u]
    edges = np.cumsum([len(a), n_u, n_u])
    return MpcGain(*np.split(first, edges, axis=1))


def _blocked(controller: CondensedController, hessian: Array, slopes: Array) -> tuple[Array, Array]:
    if controller.ocp.blocks is None:
        return hessian, slopes
    qp = controller.qp
    return qp.blocked_hessian(hessian), qp.by_blocks(slopes.T).T


@dataclass(frozen=True)
class SteadyFilter:
    """A Kalman filter in its steady state over ``w = (x, h, d)``.

    ``w- = F w + G u``, then ``w = w- + gain (y - C w-)``.

    Args:
        F: ``(n_w, n_w)``.
        G: ``(n_w, n_u)``.
        C: ``(n_y, n_w)``.
        gain: ``(n_w, n_y)``.
        P: Covariance after a measurement ``(n_w, n_w)``.
    """

    F: Array
    G: Array
    C: Array
    gain: Array
    P: Array


def steady_filter(
    ekf: ExtendedKalmanFilter, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None, *, system: Any = None
) -> SteadyFilter:  # fmt: skip
    """The extended filter's gain once its covariance has settled at an operating point.

    Args:
        ekf: The filter; a disturbance that it takes for constant keeps a gain of zero.
        x: Operating point ``(n_x,)``.
        u: Input there ``(n_u,)``.
        h: Hidden state ``(n_h,)``. Default: its fixed point.
        system: Linearisation over ``(x, h)`` instead of the tangent at the point. Default: none.

    Raises:
        InputError: If a size is wrong, an output depends on the input at once, or the covariance does not settle.

    Source: Anderson and Moore, *Optimal Filtering*, 1979, section 4.4.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.model import HybridModel
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ekf = ExtendedKalmanFilter(model, sigma_y=[1.0], sigma_x=[1.0], sigma_x0=[1.0])
        >>> steady_filter(ekf, [0.0], [0.0]).gain[:1].round(6)
        array([[0.618034]])
    """
    model = ekf.model
    x0, u0 = column(model, "x", x, model.n_x), column(model, "u", u, model.n_u)
    h0 = hidden_fixed_point(model, x0, u0) if h is None else column(model, "h", h, model.n_h)
    sys = linearize(model, x0, u0, h0) if system is None else system
    if np.any(np.asarray(sys.D) != 0):
        raise InputError(
            f"model {model.name}: an output depends on the input at once; the loop here has no such path"
        )
    n_z, n_u = model.n_x + model.n_h, model.n_u
    n_w = n_z + n_u
    known = Estimate(
        0.0, x0, h0, np.zeros(n_u), np.zeros((n_w, n_w)), np.full(model.n_y, np.nan), float("nan")
    )
    noise = np.diag(ekf.predict(known, u0).P)  # of a state that was known exactly: what one period adds
    noise_y = ekf.innovation_covariance(known, u0)
    f, g = np.eye(n_w), np.zeros((n_w, n_u))
    f[:n_z, :n_z], f[:n_z, n_z:], g[:n_z] = sys.A, sys.B, sys.B
    c = np.hstack([np.asarray(sys.C, dtype=float), np.zeros((model.n_y, n_u))])
    alive = np.concatenate([np.ones(n_z, dtype=bool), noise[n_z:] > 0])
    gain, p = np.zeros((n_w, model.n_y)), np.zeros((n_w, n_w))
    where = np.ix_(alive, alive)
    try:
        before = solve_discrete_are(f[where].T, c[:, alive].T, np.diag(noise[alive]), noise_y)
    except (LinAlgError, ValueError) as error:
        raise InputError(
            f"model {model.name}: the filter's covariance does not settle ({error}); its noise must reach, and the "
            "outputs show, every mode on or outside the unit circle"
        ) from error
    seen = c[:, alive]
    gain[alive] = np.linalg.solve(seen @ before @ seen.T + noise_y, seen @ before).T
    p[where] = before - gain[alive] @ seen @ before
    return SteadyFilter(f, g, c, gain, p)
