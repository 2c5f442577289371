"""How fast an observer estimates loads: as fast as noise allows, whatever the controller's horizon."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter
from hybrid_mpc.estimate.tuning import rest_and_motion
from hybrid_mpc.model.riccati import dare, lyapunov

Array = NDArray[np.float64]
QUIET_SHARE, MOST_SHARE = 0.0003, 0.04
"""Least standard deviation of the load's random walk per period in the quiet filter, as a share of the load's size
(drift, temperature), and the largest one: the jump filter allows 0.05."""
ADDED = 0.25
"""Share by which faster estimates of all loads together may raise the variance of the input's changes that noise
causes (docs/results/unknown_machines.md compares values)."""
HALVINGS = 6
"""Number of halvings of the interval of a share: its error is then 8 %."""
SMALL = 1e-6
"""Weight, over the largest one, of a deviation as large as its signal: modes without weight must come to rest, too."""


def quiet_shares(filter_of: Callable[[Array], ExtendedKalmanFilter], control: OCP, n_d: int) -> Array:
    """Random walk ``(n_d,)`` of the loads per period in the quiet filter, as shares of their sizes.

    A faster estimate finds a load sooner, but passes more noise on to the inputs. Each share is the largest one from
    :data:`QUIET_SHARE` to :data:`MOST_SHARE` that raises the variance of the input's changes by no more than its part
    of :data:`ADDED`, at rest and in motion, with the other shares at :data:`QUIET_SHARE`.

    Args:
        filter_of: The filter with such shares ``(n_d,)``.
        control: The control problem.
        n_d: Number of loads.
    """
    least = np.full(n_d, QUIET_SHARE)
    most = (1.0 + ADDED / max(n_d, 1)) * noise_of_inputs(filter_of(least), control)

    def bearable(j: int, share: float) -> bool:
        found = noise_of_inputs(filter_of(np.where(np.arange(n_d) == j, share, least)), control)
        return bool(np.any(found <= most) and not np.any(found > most))

    shares = least.copy()
    for j in range(n_d):
        low, high = QUIET_SHARE, MOST_SHARE
        for _ in range(HALVINGS):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if bearable(j, middle) else (low, middle)
        shares[j] = low
    return shares


def noise_of_inputs(ekf: ExtendedKalmanFilter, control: OCP) -> Array:
    """Variance per period of the input's changes, over half the input's range, that noise of sensors and states causes
    in a loop without loads: the sum of all inputs, at rest and in motion ``(2,)``.

    The loop is linear: the model at either point of :func:`~hybrid_mpc.estimate.tuning.rest_and_motion`, the settled
    filter, and the regulator of the problem's weights on states, outputs, inputs and their changes over an infinite
    horizon, which compensates the estimated load. So the horizon of ``control`` does not matter. NaN if the filter's
    covariance does not settle, or no regulator stabilises the linearized model.

    Args:
        ekf: The filter, with the loads of its model.
        control: The control problem.

    Source: Anderson and Moore, *Optimal Control: Linear Quadratic Methods*, 1990, section 8.1.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> from hybrid_mpc.model.model import HybridModel
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-", -1.0, 1.0),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> problem = OCP(20, [1.0], [0.0], [1.0], [-1.0], [1.0])
        >>> slow, quick = (ExtendedKalmanFilter(model, sigma_y=[0.1], sigma_x=[0.01], sigma_x0=[0.1], sigma_d=[step])
        ...                for step in (0.001, 0.1))
        >>> noise_of_inputs(slow, problem) < noise_of_inputs(quick, problem)
        array([ True,  True])
    """
    return np.array([_noise_at(ekf, control, at) for at in rest_and_motion(ekf)])


def _noise_at(ekf: ExtendedKalmanFilter, control: OCP, at: Estimate) -> float:
    """:func:`noise_of_inputs` at one point."""
    model = ekf.model
    f, c = ekf.tangent(at, model.u0)
    noise, noise_y = ekf.noise
    n_x, n_z, n_u, n_y = model.n_x, model.n_x + model.n_h, model.n_u, model.n_y
    assert model.with_jacobian is not None
    b = model.with_jacobian(at.x, at.h, model.u0, model.w, model.p)[3].full()
    c_z, c_d, b_d = c[:, :n_z], c[:, n_z:], np.vstack([f[:n_z, n_z:], np.zeros((n_u, model.n_d))])
    # regulator over s = (x, h, last input), input: its change
    a_s = np.block([[f[:n_z, :n_z], b], [np.zeros((n_u, n_z)), np.eye(n_u)]])
    b_s = np.vstack([b, np.eye(n_u)])
    q_y = np.diag(control.q_y if control.n_y else np.zeros(n_y))
    weight = np.diag(np.concatenate([control.q, np.zeros(model.n_h), control.r]))
    weight[:n_z, :n_z] += c_z.T @ q_y @ c_z
    sizes = Sizes(model, control)
    size = np.concatenate([sizes.states, sizes.hidden, control.input_scale])
    largest = float(np.max(np.concatenate([np.diag(weight) * size**2, control.r_delta * size[n_z:] ** 2])))
    small = SMALL * largest or 1.0  # an economic problem may have no weights
    r = np.diag(control.r_delta + small / size[n_z:] ** 2)
    try:
        p, k = dare(a_s, b_s, weight + np.diag(small / size**2), r)
        covariance, _ = dare(f.T, c.T, np.diag(noise), np.diag(noise_y))
    except InputError:
        return math.nan
    # a constant load d adds 2 s'V d to the cost-to-go s'P s: V = C'Q C_d + (A - B K)'(P B_d + V)
    closed = a_s - b_s @ k
    to_go = np.linalg.solve(
        np.eye(len(closed)) - closed.T, np.vstack([c_z.T @ q_y @ c_d, np.zeros((n_u, model.n_d))]) + closed.T @ p @ b_d
    )  # fmt: skip
    k_d = np.linalg.solve(r + b_s.T @ p @ b_s, b_s.T @ (p @ b_d + to_go))
    gain = np.linalg.solve(c @ covariance @ c.T + np.diag(noise_y), c @ covariance).T
    # the loop: s of the machine, then the estimates of (x, h, d) after the measurement
    change = np.hstack([np.zeros((n_u, n_z)), -k[:, n_z:], -k[:, :n_z], -k_d])
    machine = np.hstack([a_s, np.zeros((len(a_s), len(f)))]) + b_s @ change
    model_input = np.vstack([b, np.zeros((model.n_d, n_u))])
    last = np.hstack([np.zeros((n_u, n_z)), np.eye(n_u), np.zeros((n_u, len(f)))])
    ahead = np.hstack([np.zeros((len(f), n_z + n_u)), f]) + model_input @ (last + change)
    loop = np.vstack([machine, ahead - gain @ (c @ ahead - c_z @ machine[:n_z])])
    enters = np.zeros((len(loop), n_x + n_y))
    enters[:n_x, :n_x] = np.eye(n_x)
    enters[n_z + n_u :] = gain @ np.hstack([c_z[:, :n_x], np.eye(n_y)])
    found = lyapunov(loop.T, enters * np.concatenate([noise[:n_x], noise_y]) @ enters.T)
    return float(np.sum(np.diag(change @ found @ change.T) / control.input_scale**2))
