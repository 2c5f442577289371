"""Parameters of the prior as constant states: estimated by a filter, used by a controller."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import SLIP, SWITCHES, SwitchingFilter
from hybrid_mpc.model.model import (
    HybridModel,
    ManyPoints,
    SideBySide,
    incidence,
    inlined,
    prior_acceleration,
    step_function,
    step_symbols,
)

Array = NDArray[np.float64]
LEAST = 1.0 - 1e-9
"""Largest state of a factor, as a share of its bound: at the bound itself it would be infinite."""


def with_parameter_states(
    model: HybridModel,
    groups: Mapping[str, Sequence[str]],
    *,
    prior: HybridModel | None = None,
    most: float = 4.0,
) -> HybridModel:
    """The same model with one further hidden state for each group of the prior's parameters.

    The states ``theta`` ``(n_g,)`` are constant and follow the model's own ``h``. The parameters of group i are
    multiplied by ``exp(L tanh(theta_i / L))`` with ``L = log(most)``: a small ``theta`` is the relative change, and no
    estimate leaves the bounds. A step adds the change of the prior's acceleration, ``a(x, u, p(theta)) - a(x, u, p)``
    in the middle of the model's own step, held over the period and damped like the changed prior (linearly implicit,
    so steep friction stays stable). The network's correction does not change. At zero the model equals the given one,
    to the last bit.

    A filter estimates ``theta`` with ``sigma_h`` and ``sigma_h0`` (:class:`ExtendedKalmanFilter`); a controller on this
    model uses the estimate. No input affects these states, so there is no LQR for them: give the problem the terminal
    weight of the given model, ``OCP.terminal_weight(model)``.

    Args:
        model: A model with parameters.
        groups: Names, and the parameters of each, which change in proportion; the gain of an input is
            ``"gain of <input>"``.
        prior: Model of the prior alone, whose parameters change. Default: the model itself, if it has no network.
        most: Largest factor; the smallest is its inverse. Default 4.

    Raises:
        InputError: If the model has no parameters, has a network and no prior is given, has states other than positions
            and velocities, or a delayed input; if a parameter is unknown, or ``most`` is not above 1.

    Source: Simon, *Optimal State Estimation*, 2006, section 13.4 (parameter estimation).

    Example:
        >>> from hybrid_mpc.machine.signals import Parameter, Signal
        >>> x, u, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p")
        >>> model = HybridModel.of("cart", 0.1,
        ...     (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
        ...     x=x, u=u, p=p, x_next=x + 0.1 * ca.vertcat(x[1], u / p), xdot=ca.vertcat(x[1], u / p), y=x[0],
        ...     parameters=(Parameter("m", 2.0, "kg", 1.0, 4.0),))
        >>> adaptive = with_parameter_states(model, {"mass": ["m"]})
        >>> x, w, p = np.zeros(2), adaptive.w, adaptive.p
        >>> heavier = parameter_states([1.25])  # 2.5 kg
        >>> [round(float(adaptive.step(x, h, 1.0, w, p)[0][1]), 6) for h in (np.zeros(1), heavier)]
        [0.05, 0.04]
    """
    given = prior_acceleration(model, prior)
    _check_model(model, prior or model)
    if not (math.isfinite(most) and most > 1):
        raise InputError(
            f"parameter states: most, the largest factor, must be above 1, e.g. 4, got {most} [HM-ESTIMATE-011]"
        )
    if not groups:
        raise InputError(
            'parameter states: at least one group is needed, e.g. {"mass": ("m", "J")} [HM-ESTIMATE-012]'
        )
    acceleration = _acceleration(model, given, groups, most)
    change, n_g = _change(model, acceleration), len(groups)
    x, _, u, w, p = step_symbols(model)
    h = ca.MX.sym("h", model.n_h + n_g)
    own, theta = h[: model.n_h], h[model.n_h :]
    x_next, h_next = inlined(model.step, [x, own, u, w, p])
    dx = change(0.5 * (x + x_next), theta, u, w, p)[0]
    more = acceleration(x, u, theta, w, p) - acceleration(x, u, ca.DM.zeros(n_g), w, p)
    xdot = model.xdot(x, own, u, w, p) + ca.vertcat(ca.MX.zeros(*more.shape), more)
    point = [x, h, u, w, p]
    return replace(
        model,
        name=f"{model.name} with {', '.join(groups)}",
        step=step_function("step", point, [x_next + dx, ca.vertcat(h_next, theta)]),
        xdot=ca.Function("xdot", point, [xdot]),
        with_jacobian=_with_jacobian(model, change, n_g),
        side_by_side=None
        if model.side_by_side is None
        else _side_by_side(model, model.side_by_side, change, n_g),
    )


def parameter_filter(
    model: HybridModel,
    groups: int,
    *,
    sigma_y: ArrayLike,
    sigma_x: ArrayLike,
    sigma_x0: ArrayLike,
    sigma_d: ArrayLike | None = None,
    sigma_d0: ArrayLike | None = None,
    drift: float = 1e-3,
    step: float = 0.1,
) -> SwitchingFilter:
    """The filter of a model with parameter states: quiet normally, quick after a fault.

    It switches between three filters: quiet, slip (ten times the process noise), and fault, in which parameters step.
    Keep ``sigma_d`` small: a load and heavier friction are indistinguishable until the motion reverses, and a change
    that a quick disturbance has explained is not attributed to a parameter.

    Args:
        model: The result of :func:`with_parameter_states`.
        groups: Number of its parameter states.
        sigma_y: See :class:`ExtendedKalmanFilter`.
        sigma_x: Likewise.
        sigma_x0: Likewise.
        sigma_d: Likewise. Default: no disturbance.
        sigma_d0: Likewise.
        drift: Step of the parameter states per period without a fault, a relative change [-]. Default 0.001.
        step: Their step per period during a fault [-]; a fault lasts two periods on average. Default 0.1.

    Raises:
        InputError: If there are fewer hidden states, or a standard deviation does not fit.

    Example: ``parameter_filter(adaptive, 2, sigma_y=[5e-4], sigma_x=[2e-5, 2e-3], sigma_x0=[5e-4, 0.1])``
    """
    if not 1 <= groups <= model.n_h:
        raise InputError(
            f"parameter filter: {groups} groups given, but model {model.name} has {model.n_h} hidden states"
            " [HM-ESTIMATE-013]"
        )
    own = np.zeros(model.n_h - groups)

    def filter_of(scale: float, size: float) -> ExtendedKalmanFilter:
        # a fitted model's parameters are known to a few per cent
        return ExtendedKalmanFilter(
            model, sigma_y=sigma_y, sigma_x=scale * np.asarray(sigma_x, dtype=float), sigma_x0=sigma_x0,
            sigma_d=sigma_d, sigma_d0=sigma_d0,
            sigma_h=np.append(own, np.full(groups, size)), sigma_h0=np.append(own, np.full(groups, 0.02)),
        )  # fmt: skip

    return SwitchingFilter([filter_of(1.0, drift), filter_of(SLIP, drift), filter_of(1.0, step)], SWITCHES)


def parameter_factors(theta: ArrayLike, most: float = 4.0) -> Array:
    """Factors on the parameters from states ``theta`` ``(..., n_g)``, see :func:`with_parameter_states`.

    Example:
        >>> parameter_factors([0.0, 0.1, 99.0]).round(3)
        array([1.   , 1.105, 4.   ])
    """
    bound = math.log(most)
    return np.asarray(np.exp(bound * np.tanh(np.asarray(theta, dtype=float) / bound)))


def parameter_states(factors: ArrayLike, most: float = 4.0) -> Array:
    """States ``theta`` ``(..., n_g)`` for factors on the parameters, clipped to the bounds.

    Raises:
        InputError: If a factor is not positive.

    Example:
        >>> parameter_factors(parameter_states([0.5, 1.0, 2.0])).round(6)
        array([0.5, 1. , 2. ])
    """
    values, bound = np.asarray(factors, dtype=float), math.log(most)
    if not np.all(values > 0):
        raise InputError(f"parameter states: factors must be positive, got {values} [HM-ESTIMATE-014]")
    return np.asarray(bound * np.arctanh(np.clip(np.log(values) / bound, -LEAST, LEAST)))


def _check_model(model: HybridModel, prior: HybridModel) -> None:
    point, n_q = step_symbols(prior), model.n_x // 2
    slope = ca.jacobian(prior.xdot(*point)[:n_q], ca.vertcat(point[0], point[2]))
    found = ca.Function("kinematics", point, [slope])(0, 0, 0, prior.w, prior.p).full()
    if model.n_x % 2 or not np.array_equal(found, np.eye(n_q, model.n_x + model.n_u, n_q)):
        raise InputError(
            f"parameter states: the states {[s.name for s in model.states]} of model {model.name} must be positions "
            "followed by their velocities; others, e.g. lags, are not supported [HM-ESTIMATE-015]"
        )
    if model.delay_states:
        raise InputError(
            f"parameter states: model {model.name} has delayed inputs; parameter states need a model "
            "without a delay [HM-ESTIMATE-016]"
        )


def _acceleration(
    model: HybridModel, given: ca.Function, groups: Mapping[str, Sequence[str]], most: float
) -> ca.Function:
    """``(x, u, theta, w, p) -> a`` of the prior; a single function, so that equal arguments give equal bits."""
    if empty := [group for group, names in groups.items() if not names]:
        raise InputError(f"parameter states: group {empty[0]!r} is empty [HM-ESTIMATE-017]")
    changed = ca.DM(incidence(model, groups, "parameter states"))
    x, _, u, w, p = step_symbols(model)
    theta, bound = ca.MX.sym("theta", len(groups)), math.log(most)
    factors = ca.exp(changed @ (bound * ca.tanh(theta / bound)))
    a = given(x, factors[model.n_p :] * u, w, factors[: model.n_p] * p)
    return _expanded(ca.Function("acceleration", [x, u, theta, w, p], [a]))


def _change(model: HybridModel, acceleration: ca.Function) -> ca.Function:
    """``(x, theta, u, w, p) -> dx``, the change over a period due to theta, and its Jacobian by ``x, theta, u``.

    Linearly implicit midpoint rule: ``(I - dt/2 da/dv) dv = dt (a(theta) - a(0))``, ``dq = dt/2 dv``.
    """
    n_g, n_q, dt = acceleration.size1_in(2), acceleration.size1_out(0), model.dt
    (x, _, u, w, p), theta = step_symbols(model), ca.MX.sym("theta", n_g)
    changed = acceleration(x, u, theta, w, p)
    by_v = ca.jacobian(changed, x)[:, n_q:]
    more = changed - acceleration(x, u, ca.DM.zeros(n_g), w, p)
    dv = ca.solve(ca.DM.eye(n_q) - dt / 2 * by_v, dt * more)
    dx = ca.vertcat(dt / 2 * dv, dv)
    slopes = ca.horzcat(*(ca.jacobian(dx, s) for s in (x, theta, u)))
    return _expanded(ca.Function("change", [x, theta, u, w, p], [ca.densify(dx), ca.densify(slopes)]))


def _expanded(f: ca.Function) -> ca.Function:
    """The function in scalar operations if possible: faster for a few numbers."""
    try:
        return f.expand()
    except RuntimeError:  # an operation without a scalar form
        return f


def _with_jacobian(model: HybridModel, change: ca.Function, n_g: int) -> ca.Function:
    x, _, u, w, p = step_symbols(model)
    h = ca.MX.sym("h", model.n_h + n_g)
    own, theta = h[: model.n_h], h[model.n_h :]
    f, n_x, n_h = model.with_jacobian, model.n_x, model.n_h
    x_next, h_next, a, b = inlined(f, [x, own, u, w, p])
    dx, slopes = change(0.5 * (x + x_next), theta, u, w, p)
    by_x, by_theta, by_u = ca.horzsplit(slopes, [0, n_x, n_x + n_g, slopes.size2()])
    onto = ca.DM.eye(n_x) + 0.5 * by_x  # derivative of the state plus its change in the middle of the step
    rows_x = ca.horzcat(onto @ a[:n_x, :] + 0.5 * ca.horzcat(by_x, ca.MX.zeros(n_x, n_h)), by_theta)
    rows_h = ca.horzcat(a[n_x:, :], ca.MX.zeros(n_h, n_g))
    rows_theta = ca.horzcat(ca.MX.zeros(n_g, n_x + n_h), ca.MX.eye(n_g))
    b = ca.vertcat(onto @ b[:n_x, :] + by_u, b[n_x:, :], ca.MX.zeros(n_g, model.n_u))
    outputs = [x_next + dx, ca.vertcat(h_next, theta), ca.vertcat(rows_x, rows_h, rows_theta), b]
    return step_function("with_jacobian", [x, h, u, w, p], [ca.densify(o) for o in outputs])


def _side_by_side(model: HybridModel, base: SideBySide, change: ca.Function, n_g: int) -> SideBySide:
    """The same at many points: the given model's own function, plus the change."""
    n_x, n_h, n_u = model.n_x, model.n_h, model.n_u
    sizes = {"x": n_x, "h": n_h, "u": n_u}

    def make(n: int, by: Mapping[str, Sequence[str]]) -> ManyPoints:
        own, changes = base(n, by), change.map(n)

        def evaluate(x: Array, h: Array, u: Array, w: Array, p: Array) -> tuple[Array, ...]:
            x_next, h_next, *jacobians = own(x, np.ascontiguousarray(h[:, :n_h]), u, w, p)
            theta = h[:, n_h:]
            dx, slopes = (m.full() for m in changes(0.5 * (x + x_next).T, theta.T, u.T, w.T, p.T))
            by_x, by_theta, by_u = np.split(
                slopes.reshape(n_x, n, -1).transpose(1, 0, 2), [n_x, n_x + n_g], axis=2
            )
            direct = {"x": 0.5 * by_x, "h": np.zeros((n, n_x, 0)), "u": by_u}
            wider = []
            for names, jacobian in zip(by.values(), jacobians, strict=True):
                jacobian[:, :n_x] += 0.5 * by_x @ jacobian[:, :n_x]
                ends = np.cumsum([sizes[name] for name in names])[:-1]
                parts = []
                for name, part in zip(names, np.split(jacobian, ends, axis=2), strict=True):
                    whole = np.zeros((n, n_x + n_h + n_g, sizes[name] + (n_g if name == "h" else 0)))
                    whole[:, : n_x + n_h, : sizes[name]] = part
                    if name == "h":
                        whole[:, :n_x, n_h:], whole[:, n_x + n_h :, n_h:] = by_theta, np.eye(n_g)
                    else:
                        whole[:, :n_x] += direct[name]
                    parts.append(whole)
                wider.append(parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2))
            return (x_next + dx.T, np.hstack([h_next, theta]), *wider)

        return evaluate

    return make
