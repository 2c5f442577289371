"""Linear models of a nonlinear one: at a point, at a size of motion (friction), along a trajectory."""

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
"""Points of a sinusoid's period over which the harmonic mean is taken; exact for polynomials of degree 62."""


def control_toolbox() -> Any:
    """The module ``control``; an InputError says how to install it where it is missing."""
    with named_extra("linear analysis"):
        import control
    return control


def period(sys: Any) -> float:
    """Period [s] of a discrete system; an InputError for a continuous one."""
    dt = sys.dt
    if dt is None or dt is True or not dt > 0:
        raise InputError(
            f"linear analysis: give a discrete system with a period; its dt is {dt} [HM-ANALYZE-010]"
        )
    return float(dt)


def operating_point(
    model: HybridModel, x: ArrayLike, u: ArrayLike, h: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """``x`` ``(n_x,)``, ``u`` ``(n_u,)`` and ``h`` ``(n_h,)``, checked; default of ``h``: its equilibrium."""
    x0, u0 = vector(x, model.n_x, "x"), vector(u, model.n_u, "u")
    return x0, u0, hidden_equilibrium(model, x0, u0) if h is None else vector(h, model.n_h, "h")


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
    """State space of small deviations around ``(x, h, u)``, from exact derivatives.

    Args:
        model: The model.
        x: Operating point ``(n_x,)``; it need not be an equilibrium.
        u: Input ``(n_u,)``.
        h: Hidden state ``(n_h,)``. Default: its equilibrium while ``x`` and ``u`` are held.
        continuous: The ODE itself instead of its step, where there is no hidden state. Default: no.

    Returns:
        ``control.StateSpace`` with period ``model.dt`` (0 if continuous) over the states ``[x; h]``; no state is
        removed.

    Raises:
        InputError: If a size is wrong, the hidden state finds no rest, or python-control is not installed.

    Example:
        ``control.damp(linearize(model, x, u))``
    """
    x0, u0, h0 = operating_point(model, x, u, h)
    matrices = (m.full() for m in jacobians(model, continuous=continuous)(x0, h0, u0))
    return _state_space(model, *matrices, dt=0 if continuous else None)


def _state_space(model: HybridModel, *matrices: Array, dt: float | None = None) -> Any:
    """``control.StateSpace`` over ``[x; h]`` with the signals' names; names that occur several times are numbered."""
    names = [s.name for s in model.outputs]
    return control_toolbox().ss(
        *matrices, model.dt if dt is None else dt, remove_useless_states=False, name=model.name,
        states=[s.name for s in model.states] + [f"h{i}" for i in range(model.n_h)],
        inputs=[s.name for s in model.inputs],
        outputs=[n if names.count(n) == 1 else f"{n}_{i}" for i, n in enumerate(names)],
    )  # fmt: skip


def linearize_at_speed(model: HybridModel, q: ArrayLike, v_work: ArrayLike, u: ArrayLike) -> Any:
    """Linearization with friction as it is at working speed, at ``x = (q, v_work)``.

    At rest the slope of a smoothed Coulomb friction ``tanh(v / v_s)`` is a huge viscous damper that no motion feels. At
    ``|v_work|`` of several ``v_s`` the slope is that of the motion. The point is no equilibrium: the result describes
    small deviations from the motion over times short against it. Compare models at the same ``(q, v_work, u)``.

    Args:
        model: The model, state ``[q, v]``.
        q: Positions ``(n_x / 2,)``.
        v_work: Working speeds ``(n_x / 2,)``.
        u: Input ``(n_u,)`` there.

    Returns:
        ``control.StateSpace`` as from :func:`linearize`.

    Raises:
        InputError: If a size is wrong or the hidden state finds no rest.
    """
    n_q = positions_of(model)
    x = np.concatenate([vector(q, n_q, "q"), vector(v_work, n_q, "v_work")])
    return linearize(model, x, u)


def linearize_secant(
    model: HybridModel, x: ArrayLike, u: ArrayLike, speed: ArrayLike, h: ArrayLike | None = None,
    *, kind: Kind = "harmonic",
) -> Any:  # fmt: skip
    """Linearization at rest whose damping is that of motions of a given size.

    The columns of A by the velocities are chords: of the step from ``v = +speed`` and ``-speed`` (``"secant"``), or
    the mean over a sinusoid of that amplitude (``"harmonic"``, the describing function; 4/pi of the secant for Coulomb
    friction). All other columns are means of the tangents over the same motion, of all axes in phase: friction at rest
    that brakes within less than a period would brake what positions and inputs do, too. The point stays a point of
    rest, so poles, loops and margins of it mean something.

    Args:
        model: The model, state ``[q, v]``.
        x: Operating point ``(n_x,)``, at rest.
        u: Input ``(n_u,)``.
        speed: Size of the motion ``(n_x / 2,)`` [units of v], positive.
        h: Hidden state ``(n_h,)``, held while the speed varies. Default: its equilibrium.
        kind: See above. Default: ``"harmonic"``.

    Returns:
        ``control.StateSpace`` as from :func:`linearize`.

    Raises:
        InputError: If a size is wrong, a speed is not positive, or the hidden state finds no rest.
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
    """Damping ``-d(acceleration) / d(speed)`` [1/s] of one axis at rest, for motions of sizes ``speed``.

    Times the inertia it is a viscous damping coefficient.

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
    """
    n_q = positions_of(model)
    size = _positive(speeds, np.size(speeds))
    if not 0 <= axis < n_q:
        raise InputError(
            f"friction: no axis {axis}; model {model.name} has axes 0 to {n_q - 1} [HM-ANALYZE-013]"
        )
    held = np.zeros(model.n_u) if u is None else vector(u, model.n_u, "u")
    x = np.concatenate([vector(q, n_q, "q"), np.zeros(n_q)])
    h, i = hidden_equilibrium(model, x, held), n_q + axis
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
    """Shares of the largest speed at which a motion is looked at, of half a period; the other mirrors it."""
    if kind == "secant":
        return np.ones(1)
    return np.asarray(np.cos((np.arange(ANGLES // 2) + 0.5) * (2 * np.pi / ANGLES)))


def _chord(f: Any, v: float, kind: Kind) -> Any:
    if kind == "secant":
        return (f(v) - f(-v)) / (2 * v)
    points = v * _shares(kind)
    return sum(f(p) * p for p in points) / float(np.sum(points**2))


def _slope_of(model: HybridModel, i: int) -> Any:
    """``(x, h, u)`` to the derivatives of ``xdot[i]`` by ``x[i]`` and by the first input."""
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    rate = model.xdot(x, h, u, model.w, model.p)[i]
    f = ca.Function("slope", [x, h, u], [ca.jacobian(rate, x)[i], ca.jacobian(rate, u)[0]])
    return lambda *point: tuple(float(m) for m in f(*point))


@dataclass(frozen=True)
class AlongTrajectory:
    """``dz_{k+1} = A_k dz_k + B_k du_k``, ``dy_k = C_k dz_k + D_k du_k`` around a trajectory, ``z = (x, h)``.

    States ``x``, hidden states ``h``, inputs ``u`` and the matrices have a row for each of the n periods.
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
        return _state_space(self.model, self.A[k], self.B[k], self.C[k], self.D[k])

    def mean(self, skip: int = 0) -> Any:
        """The matrices' means over the trajectory as ``control.StateSpace``: statistical linearization.

        For a Gaussian deviation the mean slope is the linear map that predicts a function best: what motions like this
        one see of friction and of all else that is nonlinear, networks included.

        Args:
            skip: Periods left out at the start.

        Raises:
            InputError: If nothing is left.

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
