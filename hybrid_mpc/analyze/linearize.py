"""Linearizations of a model: at a point, for friction at an amplitude of motion, and along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.model.equilibrium import hidden_equilibrium
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel, positions_of

Array = NDArray[np.float64]
Kind: TypeAlias = Literal["secant", "harmonic"]
ANGLES = 64
"""Points of a sinusoid's period at which the describing function is evaluated; exact for polynomials of degree 62."""


def control_toolbox() -> Any:
    """Import python-control; an InputError says how to install it if it is missing."""
    with named_extra("linear analysis"):
        import control
    return control


def period(sys: Any) -> float:
    """Period [s] of a discrete system; InputError for a continuous system."""
    dt = sys.dt
    if dt is None or dt is True or not dt > 0:
        raise InputError(
            f"linear analysis: give a discrete system with a period; its dt is {dt} [HM-ANALYZE-010]"
        )
    return float(dt)


def operating_point(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Check ``x`` ``(n_x,)``, ``u`` ``(n_u,)`` and ``h`` ``(n_h,)``; default of ``h``: its equilibrium."""
    x0, u0 = vector(x, model.n_x, "x"), vector(u, model.n_u, "u")
    return x0, u0, hidden_equilibrium(model, x0, u0) if h is None else vector(h, model.n_h, "h")


def jacobians(model: HybridModel, *, continuous: bool = False) -> ca.Function:
    """Exact Jacobians ``(x, h, u) -> (A, B, C, D)`` over ``z = (x, h)``, as a function that is differentiable again.

    Args:
        model: The model.
        continuous: True: Jacobians of ``xdot`` instead of the step; the model has no hidden state. Default: False.

    Returns:
        ``A`` ``(n_z, n_z)``, ``B`` ``(n_z, n_u)``, ``C`` ``(n_y, n_z)``, ``D`` ``(n_y, n_u)``, all dense.

    Raises:
        InputError: If ``continuous`` is requested for a model with hidden state, which is discrete with period ``dt``.

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
            f"model {model.name}: its {model.n_h} hidden states are discrete with a period of {model.dt:g} s and "
            "have no rate. Omit continuous=True, or linearize the prior [HM-ANALYZE-011]"
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


def linearize(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None, *, continuous: bool = False
) -> Any:
    """Linearize a model at ``(x, h, u)`` with exact derivatives.

    Args:
        model: The model.
        x: Operating point ``(n_x,)``; it need not be an equilibrium.
        u: Input ``(n_u,)``.
        h: Hidden state ``(n_h,)``. Default: its equilibrium while ``x`` and ``u`` are held.
        continuous: True: linearize the ODE instead of its step; the model must have no hidden state. Default: False.

    Returns:
        ``control.StateSpace`` with period ``model.dt`` (0 if continuous) over the states ``[x; h]``; no state is
        removed.

    Raises:
        InputError: If a size is wrong, the hidden state has no equilibrium, or python-control is not installed.

    Example:
        ``control.damp(linearize(model, x, u))``
    """
    x0, u0, h0 = operating_point(model, x, u, h)
    matrices = (m.full() for m in jacobians(model, continuous=continuous)(x0, h0, u0))
    return _state_space(model, *matrices, dt=0 if continuous else None)


def _state_space(model: HybridModel, *matrices: Array, dt: float | None = None) -> Any:
    """``control.StateSpace`` over ``[x; h]`` with the signals' names; repeated names are numbered."""
    names = [s.name for s in model.outputs]
    return control_toolbox().ss(
        *matrices, model.dt if dt is None else dt, remove_useless_states=False, name=model.name,
        states=[s.name for s in model.states] + [f"h{i}" for i in range(model.n_h)],
        inputs=[s.name for s in model.inputs],
        outputs=[n if names.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(names)],
    )  # fmt: skip


def linearize_at_speed(model: HybridModel, q: ArrayLike, v_work: ArrayLike, u: ArrayLike) -> Any:
    """Linearize a mechanical model in motion, at ``x = (q, v_work)``.

    At rest, smoothed Coulomb friction ``tanh(v / v_s)`` has a very steep slope, which is only valid for ``|v| << v_s``.
    At several ``v_s``, the slope is that of the motion. The point is not an equilibrium: the result describes small
    deviations from the motion, over times that are short compared with the motion. Compare models at the same
    ``(q, v_work, u)``.

    Args:
        model: The model, state ``[q, v]``.
        q: Positions ``(n_x / 2,)``.
        v_work: Working speeds ``(n_x / 2,)``.
        u: Input ``(n_u,)`` at that point.

    Returns:
        ``control.StateSpace`` as from :func:`linearize`.

    Raises:
        InputError: If a size is wrong, or the hidden state has no equilibrium.
    """
    n_q = positions_of(model)
    x = np.concatenate([vector(q, n_q, "q"), vector(v_work, n_q, "v_work")])
    return linearize(model, x, u)


def linearize_secant(
    model: HybridModel, x: ArrayLike, u: ArrayLike, speed: ArrayLike, h: ArrayLike | None = None,
    *, kind: Kind = "harmonic",
) -> Any:  # fmt: skip
    """Linearize a mechanical model at rest, with the damping of motions of a given amplitude.

    Velocity columns of A: with ``"secant"`` the slope of the step between ``v = +speed`` and ``-speed``; with
    ``"harmonic"`` the describing function of a sinusoid of that amplitude (4/pi times the secant for Coulomb friction).

    All other columns are means of the tangents over the same motion, with all axes in phase. The tangent at rest would
    be wrong for these columns: friction that stops a motion within less than a period also removes the effect of
    positions and inputs. The point remains an equilibrium, so poles, loops and margins are defined.

    Args:
        model: The model, state ``[q, v]``.
        x: Operating point ``(n_x,)``, at rest.
        u: Input ``(n_u,)``.
        speed: Amplitude of the speeds ``(n_x / 2,)`` [units of v], positive.
        h: Hidden state ``(n_h,)``, held while the speed varies. Default: its equilibrium.
        kind: ``"secant"`` or ``"harmonic"``. Default: ``"harmonic"``.

    Returns:
        ``control.StateSpace`` as from :func:`linearize`.

    Raises:
        InputError: If a size is wrong, a speed is not positive, or the hidden state has no equilibrium.

    Source: Gelb and Vander Velde, *Multiple-Input Describing Functions and Nonlinear System Design*, 1968, section 2.2.
    """
    n_q, n_z = positions_of(model), model.n_x + model.n_h
    size = _positive(speed, n_q)
    if kind not in ("secant", "harmonic"):
        raise InputError(f"secant: kind must be 'secant' or 'harmonic', got {kind!r} [HM-ANALYZE-012]")
    x0, u0, h0 = operating_point(model, x, u, h)
    in_phase = np.concatenate([np.zeros(n_q), size])
    around = [x0 + share * in_phase for share in _shares(kind)]
    points = [jacobians(model)(x, h0, u0) for x in (*around, *(2 * x0 - x for x in around))]
    a, *others = (np.mean([m.full() for m in column], axis=0) for column in zip(*points, strict=True))
    for j, v in enumerate(size):
        e = np.eye(model.n_x)[n_q + j]

        def after(w: float, e: Array = e) -> Array:
            return np.concatenate(
                [m.full().ravel() for m in model.step(x0 + w * e, h0, u0, model.w, model.p)]
            )

        a[:, n_q + j] = np.reshape(_chord(after, v, kind), n_z)
    return _state_space(model, a, *others)


@dataclass(frozen=True)
class FrictionSlopes:
    """Damping ``-d(acceleration) / d(speed)`` [1/s] of one axis, for motions of the amplitudes ``speed``.

    The damping times the inertia is a viscous damping coefficient.

    Args:
        speed: Speeds ``(n,)`` [unit of v].
        tangent: Damping from the slope at rest, as in :func:`linearize`; the same for all speeds.
        secant: ``(n,)``: from the line through the accelerations at ``+speed`` and ``-speed``.
        harmonic: ``(n,)``: from the describing function of a sinusoid of that amplitude.
        moving: ``(n,)``: from the slope at the speed itself, as in :func:`linearize_at_speed`.
        per_input: Acceleration per unit of the input [unit of a / input unit]; converts damping to input units.
    """

    speed: Array
    tangent: float
    secant: Array
    harmonic: Array
    moving: Array
    per_input: float


def friction_slopes(model: HybridModel, q: ArrayLike, speeds: ArrayLike) -> FrictionSlopes:
    """Compute the damping of the first axis for zero input: tangent, secant, describing function, tangent in motion.

    Args:
        model: The model, state ``[q, v]``.
        q: Positions ``(n_x / 2,)``.
        speeds: Amplitudes of the speed ``(n,)``, positive.

    Raises:
        InputError: If a size is wrong, a speed is not positive, or the hidden state has no equilibrium.

    Source: the describing function: Gelb and Vander Velde, *Multiple-Input Describing Functions and Nonlinear System
    Design*, 1968, section 2.2.
    """
    n_q = positions_of(model)
    size = _positive(speeds, np.size(speeds))
    held = np.zeros(model.n_u)
    x = np.concatenate([vector(q, n_q, "q"), np.zeros(n_q)])
    h, i = hidden_equilibrium(model, x, held), n_q
    e = np.eye(model.n_x)[i]

    def acceleration(v: float) -> float:
        return float(model.xdot(x + v * e, h, held, model.w, model.p)[i])

    slope = _slope_of(model, i)
    secant = np.array([_chord(acceleration, v, "secant") for v in size])
    harmonic = np.array([_chord(acceleration, v, "harmonic") for v in size])
    moving = np.array([slope(x + v * e, h, held)[0] for v in size])
    tangent, per_input = slope(x, h, held)
    return FrictionSlopes(size, -tangent, -secant, -harmonic, -moving, per_input)


def _positive(speed: ArrayLike, n: int) -> Array:
    size = vector(speed, n, "speed")
    if not n or not np.all(size > 0):
        raise InputError(f"speed: sizes of a motion must be positive, got {size.tolist()} [HM-ANALYZE-014]")
    return size


def _shares(kind: Kind) -> Array:
    """Evaluation points of a motion over its amplitude, for half a period; the other half is its mirror image."""
    if kind == "secant":
        return np.ones(1)
    return np.asarray(np.cos((np.arange(ANGLES // 2) + 0.5) * (2 * np.pi / ANGLES)))


def _chord(f: Any, v: float, kind: Kind) -> Any:
    """Slope of ``f`` over the amplitude ``v``: secant, or gain of the first harmonic."""
    if kind == "secant":
        return (f(v) - f(-v)) / (2 * v)
    # describing function N(v) = mean(f(p) p) / mean(p^2) over p = v cos(phase), by the midpoint rule
    points = v * _shares(kind)
    return sum(f(p) * p for p in points) / float(np.sum(points**2))


def _slope_of(model: HybridModel, i: int) -> Any:
    """Function of ``(x, h, u)``: derivatives of ``xdot[i]`` with respect to ``x[i]`` and to the first input."""
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    rate = model.xdot(x, h, u, model.w, model.p)[i]
    f = ca.Function("slope", [x, h, u], [ca.jacobian(rate, x)[i], ca.jacobian(rate, u)[0]])
    return lambda *point: tuple(float(m) for m in f(*point))


@dataclass(frozen=True)
class AlongTrajectory:
    """Linear time-varying system around a trajectory of n periods, with ``z = (x, h)``.

    ``dz_{k+1} = A_k dz_k + B_k du_k``, ``dy_k = C_k dz_k + D_k du_k``. States ``x``, hidden states ``h``, inputs ``u``
    and the matrices have one row for each period.
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
        """Return the frozen system of period ``k`` as ``control.StateSpace``."""
        return _state_space(self.model, self.A[k], self.B[k], self.C[k], self.D[k])

    def mean(self, skip: int = 0) -> Any:
        """Return the mean matrices over the trajectory as ``control.StateSpace`` (statistical linearization).

        For Gaussian deviations, the mean Jacobian is the linear map with the least mean squared error. So the result
        describes friction, networks and all other nonlinear effects as they act on motions like this trajectory.

        Args:
            skip: Number of periods to leave out at the start. Default: none.

        Raises:
            InputError: If no period remains.

        Source: Roberts and Spanos, *Random Vibration and Statistical Linearization*, 1990, section 5.3.
        """
        if not 0 <= skip < len(self.A):
            raise InputError(
                f"mean: skip of {skip} periods is too large; the trajectory has {len(self.A)} [HM-ANALYZE-015]"
            )
        return _state_space(self.model, *(m[skip:].mean(axis=0) for m in (self.A, self.B, self.C, self.D)))

    def transition(self, start: int, end: int) -> Array:
        """Transition matrix ``A_{end-1} ... A_start`` ``(n_z, n_z)`` from ``start`` to ``end``."""
        if not 0 <= start <= end <= len(self.A):
            raise InputError(
                f"transition: give 0 <= start <= end <= {len(self.A)}, got {start} and {end} [HM-ANALYZE-016]"
            )
        product = np.eye(self.A.shape[1])
        for a in self.A[start:end]:
            product = a @ product
        return product


def linearize_along(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None
) -> AlongTrajectory:
    """Linearize a model exactly at every period of a trajectory.

    Args:
        model: The model.
        x: Initial state ``(n_x,)`` of a free run of the model, or a trajectory ``(n, n_x)``, for example a measured
            one; the hidden state follows the trajectory.
        u: Inputs ``(n, n_u)``.
        h: Initial hidden state ``(n_h,)``. Default: zero, as in training.

    Raises:
        InputError: If a shape does not fit, or the free run is not finite.

    Example:
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
            f"model {model.name}: got the shapes {inputs.shape} of u and {start.shape} of h; give (n, {model.n_u}) "
            f"with n > 0 and ({model.n_h},) [HM-ANALYZE-017]"
        )
    if not free and given.shape != (n, model.n_x):
        raise InputError(
            f"model {model.name}: got the shape {given.shape} of x; give ({model.n_x},) or ({n}, {model.n_x}) "
            "[HM-ANALYZE-018]"
        )
    states, hidden = np.empty((n, model.n_x)), np.empty((n, model.n_h))
    now, h_now = given if free else given[0], start
    for k in range(n):
        states[k], hidden[k] = (now if free else given[k]), h_now
        now, h_now = (m.full().ravel() for m in model.step(states[k], h_now, inputs[k], model.w, model.p))
    if not (np.all(np.isfinite(states)) and np.all(np.isfinite(hidden))):
        raise InputError(
            f"model {model.name}: the free run is not finite. Use a shorter run or other inputs [HM-ANALYZE-019]"
        )
    every = jacobians(model).map(n)(states.T, hidden.T, inputs.T)
    a, b, c, d = (m.full().reshape(m.shape[0], n, -1).transpose(1, 0, 2) for m in every)
    return AlongTrajectory(model, states, hidden, inputs, a, b, c, d)
