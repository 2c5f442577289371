"""Linearisation along a trajectory: a linear time-varying system."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.analysis.symbolic import jacobians
from hybrid_mpc.analysis.toolbox import control_toolbox, signal_names
from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AlongTrajectory:
    """``dz_{k+1} = A_k dz_k + B_k du_k``, ``dy_k = C_k dz_k + D_k du_k`` around a trajectory, ``z = (x, h)``.

    Args:
        model: The model.
        x: States ``(n, n_x)``.
        h: Hidden states ``(n, n_h)``.
        u: Inputs ``(n, n_u)``.
        A: ``(n, n_z, n_z)``.
        B: ``(n, n_z, n_u)``.
        C: ``(n, n_y, n_z)``.
        D: ``(n, n_y, n_u)``.
    """

    model: HybridModel
    x: Array
    h: Array
    u: Array
    A: Array
    B: Array
    C: Array
    D: Array

    def system(self, k: int) -> Any:
        """The frozen system of period ``k`` as ``control.StateSpace``."""
        matrices = (self.A[k], self.B[k], self.C[k], self.D[k])
        names = signal_names(self.model)
        return control_toolbox().ss(*matrices, self.model.dt, remove_useless_states=False, **names)

    def mean(self, skip: int = 0) -> Any:
        """The matrices' means over the trajectory as ``control.StateSpace``: statistical linearisation.

        For a deviation that is Gaussian the mean slope is the linear map that predicts a function best; so this is
        what motions like this one see of a friction, and of all else that is nonlinear, networks included.

        Args:
            skip: Periods left out at the start.

        Raises:
            InputError: If nothing is left.

        Source: Roberts and Spanos, *Random Vibration and Statistical Linearization*, 1990, section 5.3.
        """
        if not 0 <= skip < len(self.A):
            raise InputError(f"mean: {skip} periods to leave out, the trajectory has {len(self.A)}")
        matrices = (m[skip:].mean(axis=0) for m in (self.A, self.B, self.C, self.D))
        names = signal_names(self.model)
        return control_toolbox().ss(*matrices, self.model.dt, remove_useless_states=False, **names)

    def transition(self, start: int, end: int) -> Array:
        """``A_{end-1} ... A_start`` ``(n_z, n_z)``: what a deviation at ``start`` has become at ``end``.

        Raises:
            InputError: If the range does not lie within the trajectory.
        """
        if not 0 <= start <= end <= len(self.A):
            raise InputError(f"transition: 0 <= start <= end <= {len(self.A)} needed, got {start} and {end}")
        product = np.eye(self.A.shape[1])
        for a in self.A[start:end]:
            product = a @ product
        return product


def linearize_along(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None
) -> AlongTrajectory:
    """Exact linearisations at every period of a trajectory.

    Args:
        model: The model.
        x: Start ``(n_x,)`` of a free run of the model, or a trajectory ``(n, n_x)`` (measured, say), along which the
            hidden state runs.
        u: Inputs ``(n, n_u)``.
        h: Hidden state ``(n_h,)`` at the start. Default: zero, as in training.

    Raises:
        InputError: If a shape does not fit, or the free run leaves the numbers.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("square", 1.0, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=x**2 + u, xdot=u, y=x)
        >>> ltv = linearize_along(model, [1.0], np.ones((3, 1)))
        >>> ltv.A.ravel().tolist(), ltv.transition(0, 3).item()
        ([2.0, 4.0, 10.0], 80.0)
    """
    inputs, given = np.asarray(u, dtype=float), np.asarray(x, dtype=float)
    n = len(inputs)
    start = np.zeros(model.n_h) if h is None else np.asarray(h, dtype=float).reshape(-1)
    free = given.shape == (model.n_x,)
    if inputs.shape != (n, model.n_u) or not n or start.shape != (model.n_h,):
        raise InputError(
            f"model {model.name}: u {inputs.shape} and h {start.shape} given, (n, {model.n_u}) with n > 0 and "
            f"({model.n_h},) needed"
        )
    if not free and given.shape != (n, model.n_x):
        raise InputError(
            f"model {model.name}: x {given.shape} given, ({model.n_x},) or ({n}, {model.n_x}) needed"
        )
    states, hidden = np.empty((n, model.n_x)), np.empty((n, model.n_h))
    now, h_now = given if free else given[0], start
    for k in range(n):
        states[k], hidden[k] = (now if free else given[k]), h_now
        now, h_now = (m.full().ravel() for m in model.step(states[k], h_now, inputs[k], model.w, model.p))
    if not (np.all(np.isfinite(states)) and np.all(np.isfinite(hidden))):
        raise InputError(
            f"model {model.name}: the free run is not finite; take a shorter one or other inputs"
        )
    every = jacobians(model).map(n)(states.T, hidden.T, inputs.T)
    a, b, c, d = (m.full().reshape(m.shape[0], n, -1).transpose(1, 0, 2) for m in every)
    return AlongTrajectory(model, states, hidden, inputs, a, b, c, d)
