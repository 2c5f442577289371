"""Linearization along a trajectory: a linear time-varying system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import HybridModel

# python-control, imported only where it is used, and the names of a model's signals in its manner.


def control_toolbox() -> Any:
    """The module ``control``.

    Raises:
        InputError: If python-control is not installed.

    Example:
        >>> control_toolbox().__name__
        'control'
    """
    try:
        import control
    except ImportError as missing:
        raise InputError(
            f"linear analysis needs python-control ({missing}); install it with: pip install 'hybrid-mpc[analysis]'"
        ) from None
    return control


def signal_names(model: HybridModel) -> dict[str, Any]:
    """Names of system, states, inputs and outputs as keyword arguments of ``control.ss``."""
    return {
        "name": model.name,
        "states": [s.name for s in model.states] + [f"h{i}" for i in range(model.n_h)],
        "inputs": [s.name for s in model.inputs],
        "outputs": distinct([s.name for s in model.outputs]),
    }


def distinct(names: Sequence[str]) -> list[str]:
    """Names that occur several times, numbered.

    Example:
        >>> distinct(["phi", "phi", "u"])
        ['phi_0', 'phi_1', 'u']
    """
    return [n if names.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(names)]


def period(sys: Any) -> float:
    """Period [s] of a discrete system.

    Raises:
        InputError: If it is continuous or has no period.
    """
    dt = sys.dt
    if dt is None or dt is True or not dt > 0:
        raise InputError(f"linear analysis: needs a discrete system with a period, its dt is {dt}")
    return float(dt)


# A, B, C, D as CasADi functions of the operating point.


def jacobians(model: HybridModel, *, continuous: bool = False) -> ca.Function:
    """``(x, h, u) -> (A, B, C, D)`` of ``z = (x, h)``, exact, as a function that can be differentiated again.

    Args:
        model: The model.
        continuous: Of ``xdot`` instead of the step; needs a model without hidden state. Default: no.

    Returns:
        ``A`` ``(n_z, n_z)``, ``B`` ``(n_z, n_u)``, ``C`` ``(n_y, n_z)``, ``D`` ``(n_y, n_u)``, all dense.

    Raises:
        InputError: If the continuous form of a model with hidden state is asked for: that lives in steps of ``dt``.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("cubic", 0.1, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=x + 0.1 * (u - x**3), xdot=u - x**3, y=x)
        >>> round(float(jacobians(model)(2.0, [], 0.0)[0]), 12)
        -0.2
        >>> float(jacobians(model, continuous=True)(2.0, [], 0.0)[0])
        -12.0
    """
    if continuous and model.n_h:
        raise InputError(
            f"model {model.name} has {model.n_h} hidden states, which step once a period of {model.dt:g} s and have "
            "no rate; leave continuous=True out, or linearize the prior"
        )
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    if continuous:
        f = model.xdot(x, h, u, model.w, model.p)
        a, b = ca.jacobian(f, x), ca.jacobian(f, u)
    else:
        assert model.with_jacobian is not None
        *_, a, b = model.with_jacobian(x, h, u, model.w, model.p)
    y = model.output(x, u, model.w, model.p)
    c = ca.horzcat(ca.jacobian(y, x), ca.MX.zeros(model.n_y, model.n_h))
    results = [ca.densify(m) for m in (a, b, c, ca.jacobian(y, u))]
    return ca.Function("jacobians", [x, h, u], results, ["x", "h", "u"], ["A", "B", "C", "D"])


# Fixed points and exact linearizations of a model over ``[x; h]``.

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
    """Linearization with friction as it is at working speed, at ``x = (q, v_work)``.

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
        """The matrices' means over the trajectory as ``control.StateSpace``: statistical linearization.

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
    """Exact linearizations at every period of a trajectory.

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
        >>> from hybrid_mpc.machine.signals import Signal
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
