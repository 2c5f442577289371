"""Linearized controllers and observers, their loop with a plant, and its margins and sensitivities."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_discrete_are

from hybrid_mpc.analyze.equilibria import poles_of
from hybrid_mpc.analyze.linearize import (
    Kind,
    control_toolbox,
    linearize,
    linearize_secant,
    operating_point,
    period,
)
from hybrid_mpc.analyze.properties import frequency_response, matrices
from hybrid_mpc.control.problem import Controller, Solution
from hybrid_mpc.control.rti import CondensedController, propagate
from hybrid_mpc.control.sizes import Sizes, disturbance_sizes
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.riccati import dare

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
FREQUENCIES = 2000
SETTLE = 10
"""Solves after which a real-time iteration has converged to its plan: each solve is one Newton step, which doubles the
number of correct digits."""
DIFFERENCE = 1e-4
"""Step of a central difference over a signal's size. The truncation error is proportional to the step squared; the
error of the solves (1e-9) is divided by the step."""
MOST_DELAY = 200
"""Maximum number of whole periods of delay that are tried."""
LEAST_GAIN = 1e-3
"""Factors on a loop's gain below which a margin counts as 0: rounding turns an integrator's infinite gain at frequency
zero into a large negative one."""


@dataclass(frozen=True)
class MpcGain:
    """Linearized MPC: ``du_0 = by_state dz + by_load dd + by_before du_before + by_reference dr + by_measured dw``.

    Exact while no bound is active and the linearization of the prediction does not change. ``z = (x, h)`` and the
    unmeasured disturbances ``d`` are estimates. ``u_before`` is the previous input (its gain is zero without
    ``r_delta``). ``r`` is a reference, and ``w`` measured disturbances, constant over the horizon; only
    :func:`solved_gain` computes ``by_measured``.
    """

    by_state: Array
    by_load: Array
    by_before: Array
    by_reference: Array
    by_measured: Array | None = None


def mpc_gain(
    controller: CondensedController, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None, *, system: Any = None
) -> MpcGain:  # fmt: skip
    """Derivative of the QP's solution without active bounds, at an operating point that the whole plan holds.

    The condensed QP ``min 1/2 s'Hs + g's`` has the solution ``s = -H^{-1} g``. ``g`` is affine in the estimate, the
    disturbance, the previous input and the reference. So the derivative is a solve with the controller's ``H``.

    Args:
        controller: The real-time iteration; its weights, horizon, terminal weight and move blocks are used.
        x: Operating point ``(n_x,)``.
        u: Input at that point ``(n_u,)``, within the bounds.
        h: Hidden state ``(n_h,)``. Default: its equilibrium.
        system: Linearization over ``(x, h)`` for the prediction, e.g. of :func:`linearize_secant`. Default: the tangent
            at the point.

    Raises:
        InputError: If a size is wrong, the point violates an input bound or a soft bound, or the problem has an
            economic stage cost (its curvature changes along the plan).

    Source: Fiacco, *Introduction to Sensitivity and Stability Analysis in Nonlinear Programming*, 1983; Bemporad,
    Morari, Dua, Pistikopoulos, *The explicit linear quadratic regulator for constrained systems*, Automatica 38 (2002).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.model.model import HybridModel
        >>> from hybrid_mpc.control.ocp import OCP
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> controller = CondensedController(model, OCP(5, [1.0], [1.0], [0.0], [-9.0], [9.0]))
        >>> mpc_gain(controller, [0.0], [0.0]).by_state.round(6)
        array([[-0.618034]])
    """
    model, ocp = controller.model, controller.ocp
    n, n_x, n_u = ocp.horizon, model.n_x, model.n_u
    x0, u0, h0 = operating_point(model, x, u, h)
    if np.any(u0 <= ocp.u_min) or np.any(u0 >= ocp.u_max):
        raise InputError(
            f"MPC gain: the input {u0.tolist()} lies on or outside the bounds, so its gain is zero. Choose another "
            "point [HM-ANALYZE-020]"
        )
    if ocp.economic is not None or ocp.n_y:
        raise InputError(
            "MPC gain: the problem has an economic stage cost or weights on outputs, so its gain depends on its plan"
            " [HM-ANALYZE-021]"
        )
    z0 = np.concatenate([x0, h0])
    plan, z = np.tile(u0, (n, 1)), np.tile(z0, (n + 1, 1))
    if np.any(controller.problem.soft.excess(controller.problem.soft.values(z[:, :n_x], plan)) > 0):
        raise InputError(
            f"MPC gain: the point x = {x0.tolist()} violates a soft bound. Choose a point without an active bound "
            "[HM-ANALYZE-022]"
        )
    sys = linearize(model, x0, u0, h0) if system is None else system
    a, b = np.asarray(sys.A, dtype=float), np.asarray(sys.B, dtype=float)
    derivatives = z[1:], np.tile(a.T, (n, 1, 1)), np.tile(b, (n, 1, 1))
    weight = np.ones((n + 1, n_x))
    prepared = controller.condense(plan, z, np.zeros(n_u), u0, weight, derivatives, perf_counter())
    none = np.zeros((n, len(a)))
    by_z = np.stack([propagate(prepared.a_t, none, e)[:, :n_x].ravel() for e in np.eye(len(a))], axis=1)
    every = np.tile(np.eye(n_u), (n, 1))
    hold = np.tile(np.eye(n_x), (n + 1, 1))
    before = np.zeros((n * n_u, n_u))
    before[:n_u] = -2 * model.dt * np.diag(ocp.r_delta)
    slopes = np.hstack([
        2 * prepared.weighted.T @ by_z, 2 * prepared.weighted.T @ (prepared.from_u @ every), before,
        -2 * prepared.weighted.T @ hold,
    ])  # fmt: skip
    hessian, slopes = controller.qp.blocked_hessian(prepared.hessian), controller.qp.by_blocks(slopes.T).T
    first = -cho_solve(cho_factor(hessian), slopes)[:n_u]
    edges = np.cumsum([len(a), n_u, n_u])
    return MpcGain(*np.split(first, edges, axis=1))


def solved_gain(
    controller: Controller, x: ArrayLike, u: ArrayLike, reference: ArrayLike, h: ArrayLike | None = None,
    *, w: ArrayLike | None = None,
) -> MpcGain:  # fmt: skip
    """Linearized MPC of any solver and problem, by central differences of its solves around the converged plan.

    Unlike :func:`mpc_gain`, this function supports weights on outputs, their targets, economic costs and any
    disturbance model.

    Args:
        controller: The solver.
        x: Operating point ``(n_x,)``.
        u: Input at that point ``(n_u,)``, within the bounds.
        reference: Reference, one row ``(columns,)``, constant over the horizon.
        h: Hidden state ``(n_h,)``. Default: its equilibrium.
        w: Measured disturbances ``(n_w,)``. Default: the operating point's.

    Raises:
        InputError: If a size is wrong, the plan's input lies on a bound, or a solve fails.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.model.model import HybridModel
        >>> from hybrid_mpc.control.ocp import OCP
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> controller = CondensedController(model, OCP(5, [1.0], [1.0], [0.0], [-9.0], [9.0]))
        >>> solved_gain(controller, [0.0], [0.0], [0.0]).by_state.round(6)
        array([[-0.618034]])
    """
    model, ocp = controller.model, controller.ocp
    x0, u0, h0 = operating_point(model, x, u, h)
    w0 = model.w if w is None else vector(w, model.n_w, "w")
    row, sizes = vector(reference, ocp.columns, "reference"), Sizes(model, ocp)
    n_z, n_d = model.n_x + model.n_h, model.n_d
    unknown = np.full((n_z + n_d,) * 2, np.nan)
    at = Estimate(0.0, x0, h0, np.zeros(n_d), unknown, np.full(model.n_y, np.nan), float("nan"), w=w0)
    plan = controller.initial(at, np.tile(u0, (ocp.horizon, 1)))

    def solved(estimate: Estimate, before: Array, goal: Array, last: Solution) -> Solution:
        found = controller.solve(last.beginning_with(before), estimate, np.tile(goal, (ocp.horizon + 1, 1)))
        if not found.status.ok:
            raise InputError(
                f"MPC gain: the solve at x = {x0.tolist()} failed: {found.status.value}. Choose another point "
                "[HM-ANALYZE-023]"
            )
        return found

    for _ in range(SETTLE):
        plan = solved(at, u0, row, plan)
    if np.any(plan.u[0] <= ocp.u_min) or np.any(plan.u[0] >= ocp.u_max):
        raise InputError(
            f"MPC gain: the input {plan.u[0].tolist()} lies on a bound, so its gain is zero. Choose another point"
            " [HM-ANALYZE-024]"
        )
    ranges = np.array([s.upper - s.lower for s in model.disturbances])
    steps = DIFFERENCE * np.concatenate([
        sizes.states, sizes.hidden, disturbance_sizes(model, ocp), ocp.input_scale, np.ones(row.size),
        np.where(np.isfinite(ranges), ranges, np.maximum(np.abs(w0), 1.0)),
    ])  # fmt: skip
    edges = np.cumsum([model.n_x, model.n_h, n_d, model.n_u, row.size])
    slopes = []
    for i, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.zeros(steps.size)
            moved[i] = sign * step
            dx, dh, dd, du, dr, dw = np.split(moved, edges)
            estimate = replace(at, x=x0 + dx, h=h0 + dh, d=dd, w=w0 + dw)
            ends.append(solved(estimate, u0 + du, row + dr, plan).u[0])
        slopes.append((ends[0] - ends[1]) / (2.0 * step))
    parts = np.split(np.array(slopes).T, [n_z, *edges[2:]], axis=1)
    return MpcGain(*parts)


@dataclass(frozen=True)
class GainSchedule:
    """LQR gains ``(n, n_u, n_x + n_h)`` by operating point: ``du = -gain[k] @ dz`` with ``z = (x, h)``.

    ``radius`` is the spectral radius of each closed loop ``(n,)``.
    """

    x: Array
    u: Array
    gain: Array
    radius: Array


def gain_schedule(
    model: HybridModel, points: Iterable[tuple[ArrayLike, ArrayLike]], q: ArrayLike, r: ArrayLike,
    *, speed: ArrayLike | None = None, kind: Kind = "harmonic",
) -> GainSchedule:  # fmt: skip
    """Compute LQR gains of the linearization at each point; hidden states are at their equilibrium and have no weight.

    Args:
        model: The model.
        points: Operating points ``(x, u)``.
        q: Weights of the states ``(n_x,)``.
        r: Weights of the inputs ``(n_u,)``, positive.
        speed: Amplitude of the motion for which friction is linearized (:func:`linearize_secant`). Default: the tangent
            at the point.
        kind: Kind of that linearization. Default: ``"harmonic"``.

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
    given = [operating_point(model, x, u, None) for x, u in points]
    if not given:
        raise InputError("gain schedule: give at least one operating point [HM-ANALYZE-025]")
    weights = np.diag(np.concatenate([vector(q, model.n_x, "q"), np.zeros(model.n_h)]))
    costs = np.diag(vector(r, model.n_u, "r"))
    gains, radii = [], []
    for x, u, h in given:
        secant = None if speed is None else linearize_secant(model, x, u, speed, h, kind=kind)
        system = linearize(model, x, u, h) if secant is None else secant
        _, k = dare(system.A, system.B, weights, costs)
        gains.append(k)
        radii.append(float(np.abs(np.linalg.eigvals(system.A - system.B @ k)).max()))
    xs, us, _ = zip(*given, strict=True)
    return GainSchedule(np.stack(xs), np.stack(us), np.stack(gains), np.array(radii))


@dataclass(frozen=True)
class SteadyFilter:
    """Steady-state Kalman filter over ``w = (x, h, d)``: ``w- = F w + G u``, ``w = w- + gain (y - C w-)``.

    ``P`` is the covariance after a measurement.
    """

    F: Array
    G: Array
    C: Array
    gain: Array
    P: Array


def steady_filter(
    ekf: ExtendedKalmanFilter, x: ArrayLike, u: ArrayLike, h: ArrayLike | None = None, *, system: Any = None
) -> SteadyFilter:  # fmt: skip
    """Compute the steady-state gain of the extended Kalman filter at an operating point.

    The covariance P- before a measurement solves ``P- = F (P- - P- C' (C P- C' + R)^-1 C P-) F' + Q``.

    Args:
        ekf: The filter; a disturbance without process noise has a gain of zero.
        x: Operating point ``(n_x,)``.
        u: Input at that point ``(n_u,)``.
        h: Hidden state ``(n_h,)``. Default: its equilibrium.
        system: Linearization over ``(x, h)`` instead of the tangent at the point. Default: none.

    Raises:
        InputError: If a size is wrong, an output depends directly on the input, or the covariance does not converge.

    Source: Anderson and Moore, *Optimal Filtering*, 1979, section 4.4.

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> ekf = ExtendedKalmanFilter(model, sigma_y=[1.0], sigma_x=[1.0], sigma_x0=[1.0])
        >>> steady_filter(ekf, [0.0], [0.0]).gain[:1].round(6)
        array([[0.618034]])
    """
    model = ekf.model
    x0, u0, h0 = operating_point(model, x, u, h)
    sys = linearize(model, x0, u0, h0) if system is None else system
    if np.any(np.asarray(sys.D) != 0):
        raise InputError(
            f"model {model.name}: an output depends directly on the input (feedthrough), which is not supported"
            " [HM-ANALYZE-026]"
        )
    n_z, n_u, n_d = model.n_x + model.n_h, model.n_u, model.n_d
    on_u, on_x, on_y = model.disturbed
    n_w = n_z + n_d
    known = Estimate(
        0.0, x0, h0, np.zeros(n_d), np.zeros((n_w, n_w)), np.full(model.n_y, np.nan), float("nan")
    )
    noise = np.diag(
        ekf.predict(known, u0).P
    )  # Q: the variance that one period adds to an exactly known state
    noise_y = ekf.innovation_covariance(known, u0)
    f, g = np.eye(n_w), np.zeros((n_w, n_u))
    f[:n_z, :n_z], f[:n_z, n_z:], g[:n_z] = sys.A, np.asarray(sys.B) @ on_u, sys.B
    f[: model.n_x, n_z:] += on_x
    c = np.hstack([np.asarray(sys.C, dtype=float), on_y])
    alive = np.concatenate([np.ones(n_z, dtype=bool), noise[n_z:] > 0])
    gain, p = np.zeros((n_w, model.n_y)), np.zeros((n_w, n_w))
    where = np.ix_(alive, alive)
    try:
        before = solve_discrete_are(f[where].T, c[:, alive].T, np.diag(noise[alive]), noise_y)
    except (LinAlgError, ValueError) as error:
        raise InputError(
            f"model {model.name}: the filter's covariance does not converge ({error}). Every mode on or outside the "
            "unit circle must be observable and excited by the process noise [HM-ANALYZE-027]"
        ) from error
    seen = c[:, alive]
    gain[alive] = np.linalg.solve(seen @ before @ seen.T + noise_y, seen @ before).T
    p[where] = before - gain[alive] @ seen @ before
    return SteadyFilter(f, g, c, gain, p)


@dataclass(frozen=True)
class Margins:
    """Stability margins of a loop, broken at one input.

    Args:
        gain_up: Smallest factor above 1 on the loop's gain that makes the loop unstable; infinite if there is none.
        gain_down: Largest such factor below 1; 0 if there is none above 0.001.
        phase: Smallest phase margin [rad]; infinite without gain crossover.
        delay: Smallest delay margin [s]: smallest ratio of phase margin to frequency over all gain crossovers.
        delay_periods: Largest number of whole periods of delay at the input for which the closed loop is stable.
        crossover: Highest gain crossover [rad/s]; NaN without gain crossover.
        modulus: Smallest distance of the Nyquist curve from -1: one over the peak of the sensitivity.
        disk: Symmetric disk margin [-]. At any frequency, the gain may vary by the factor ``disk_gain`` up or down, or
            the phase by ``disk_phase``, or both by less.
        disk_gain: ``(1 + disk / 2) / (1 - disk / 2)``.
        disk_phase: ``2 atan(disk / 2)`` [rad].
    """

    gain_up: float
    gain_down: float
    phase: float
    delay: float
    delay_periods: int
    crossover: float
    modulus: float
    disk: float
    disk_gain: float
    disk_phase: float


@dataclass(frozen=True)
class LinearLoop:
    """A linearized loop of plant and output feedback, both discrete ``control.StateSpace``, with ``u = feedback y``.

    ``closed`` is the closed loop from loads at the inputs and noise at the outputs to outputs and inputs. ``poles`` are
    the poles of ``closed``, largest first.
    """

    plant: Any
    feedback: Any
    closed: Any
    poles: Complex

    @property
    def stable(self) -> bool:
        """All poles of the closed loop are inside the unit circle."""
        return bool(np.abs(self.poles[0]) < 1.0)

    def broken(self, input: int = 0) -> Any:
        """Return the loop transfer function, broken at one input with the others closed, for negative feedback."""
        n_u = self.plant.ninputs
        if not 0 <= input < n_u:
            raise InputError(
                f"loop: no input {input}; the plant has {n_u} inputs, counted from 0 [HM-ANALYZE-028]"
            )
        a, b, c, d = _open(self.plant, self.feedback)
        others = [j for j in range(n_u) if j != input]
        if others:
            back = np.linalg.inv(np.eye(len(others)) - d[np.ix_(others, others)])
            a, b, c, d = (
                a + b[:, others] @ back @ c[others], b + b[:, others] @ back @ d[others],
                c + d[:, others] @ back @ c[others], d + d[:, others] @ back @ d[others],
            )  # fmt: skip
        one = slice(input, input + 1)
        return control_toolbox().ss(
            a, b[:, one], -c[one], -d[one, one], self.plant.dt, remove_useless_states=False, name="loop"
        )

    def margins(self, input: int = 0) -> Margins:
        """Compute the margins of the loop broken at one input, by python-control on a fine grid of frequencies.

        Raises:
            InputError: If the closed loop is unstable; then it has no margins.
        """
        if not self.stable:
            raise InputError(
                f"loop: the closed loop is unstable (spectral radius {abs(self.poles[0]):.6g}), so it has no margins"
                " [HM-ANALYZE-029]"
            )
        control, dt, broken = control_toolbox(), period(self.plant), self.broken(input)
        omega = _grid(broken, dt)
        response = frequency_response(broken, omega)
        given = (response.magnitude[0, 0], np.degrees(response.phase[0, 0]), omega)
        gains, phases, _, _, at_phase, _ = control.stability_margins(given, returnall=True)
        gains, phases = np.atleast_1d(gains), np.radians(np.atleast_1d(phases))
        g = response.magnitude[0, 0] * np.exp(1j * response.phase[0, 0])
        at_nyquist = float(g[-1].real)
        ends = [at_nyquist, _steady_gain(broken)]  # crossings of the real axis that python-control leaves out
        gains = np.append(gains, [-1.0 / end for end in ends if end < 0])
        at = np.atleast_1d(at_phase)
        delays = [(p % (2 * np.pi)) / w for p, w in zip(phases, at, strict=True)]
        if at_nyquist > 1:  # one period of delay turns it to below -1, without a gain crossover
            delays.append(dt)
        disk, _, _ = control.disk_margins(broken, omega, skew=0.0)
        size = min(float(disk), 2.0)
        return Margins(
            gain_up=float(min((k for k in gains if k > 1), default=np.inf)),
            gain_down=float(max((k for k in gains if LEAST_GAIN <= k < 1), default=0.0)),
            phase=float(np.abs(phases).min(initial=np.inf)),
            delay=float(min(delays, default=np.inf)),
            delay_periods=self._delay_periods(input),
            crossover=float(at.max()) if at.size else float("nan"),
            modulus=float(np.abs(1 + g).min()),
            disk=float(disk),
            disk_gain=(1 + size / 2) / (1 - size / 2) if size < 2 else float("inf"),
            disk_phase=2 * float(np.arctan(size / 2)),
        )

    def _delay_periods(self, input: int) -> int:
        """Largest number of periods of delay at an input for which the loop is stable, at most ``MOST_DELAY``."""
        loop = self.broken(input)
        a, b, c, d = matrices(loop)
        for periods in range(1, MOST_DELAY + 1):
            n = len(a)
            whole = np.zeros((n + periods, n + periods))
            # delay line: the newest element is -(C x + D oldest), and the oldest element is the input
            whole[:n, :n], whole[:n, n:][:, -1:] = a, b
            whole[n : n + 1, :n], whole[n, -1] = -c, -d.item()
            whole[n + 1 :, n:-1] += np.eye(periods - 1)
            if np.abs(np.linalg.eigvals(whole)).max() >= 1.0:
                return periods - 1
        return MOST_DELAY

    def sensitivity(self, omega: ArrayLike) -> Mapping[str, Complex]:
        """Compute sensitivity functions at frequencies ``(n,)`` [rad/s] in ``(0, pi / dt]``.

        With ``u = K y``: ``S = (I - K G)^-1``, ``T = I - S = -S K G``, ``S_y = (I - G K)^-1``.

        Returns:
            ``"S"`` and ``"T"`` ``(n_u, n_u, n)`` at the inputs: the remaining part of a load, and the part that the
            controller compensates; ``"KS"`` ``(n_u, n_y, n)`` from output noise to inputs; ``"GS"`` ``(n_y, n_u, n)``
            from loads to outputs; ``"S_y"`` ``(n_y, n_y, n)`` at the outputs.

        Raises:
            InputError: If a frequency lies outside.
        """
        g, k = (_response(s, omega) for s in (self.plant, self.feedback))
        n_u, n_y = self.plant.ninputs, self.plant.noutputs
        s = np.linalg.inv(np.eye(n_u) - k @ g)
        s_y = np.linalg.inv(np.eye(n_y) - g @ k)
        parts = {"S": s, "T": -s @ k @ g, "KS": s @ k, "GS": g @ s, "S_y": s_y}
        return MappingProxyType({name: np.moveaxis(v, 0, -1) for name, v in parts.items()})


def mpc_loop(gain: MpcGain, filter: SteadyFilter, plant: Any, *, delay: int = 0) -> LinearLoop:
    """Close the loop of an MPC's gain, a steady-state filter and a plant, in the order of ``simulate``.

    At ``t_k``: measure ``y_k``, ``w_k = w- + L (y_k - C w-)`` with ``w- = F w_{k-1} + G u_{k-1}``, then ``u_k`` from
    ``w_k`` and ``u_{k-1}``, held until ``t_{k+1}``.

    Args:
        gain: Gain of the controller (:func:`mpc_gain`).
        filter: Gain of the observer (:func:`steady_filter`).
        plant: Discrete ``control.StateSpace`` of the machine: the controller's model, or another one, for example the
            hybrid as plant of a controller on the prior.
        delay: Delay of the input in whole periods, unknown to the controller. Default: none.

    Raises:
        InputError: If sizes or periods do not fit, or the plant's outputs depend directly on its inputs.

    Example:
        >>> import control
        >>> plant = control.ss([[1.0]], [[1.0]], [[1.0]], 0.0, 1.0)
        >>> one, none = np.ones((1, 1)), np.zeros((1, 1))
        >>> gain = MpcGain(-0.5 * one, none, none, none)
        >>> known = SteadyFilter(np.diag([1.0, 0.0]), np.array([[1.0], [0.0]]), np.array([[1.0, 0.0]]),
        ...     np.array([[1.0], [0.0]]), np.zeros((2, 2)))
        >>> loop = mpc_loop(gain, known, plant)
        >>> loop.stable, round(loop.margins().gain_up, 6), round(loop.margins().modulus, 6)
        (True, 4.0, 0.75)
    """
    period(plant)
    (n_u, n_z), (n_w, n_y), n_d = gain.by_state.shape, filter.gain.shape, gain.by_load.shape[1]
    if (plant.ninputs, plant.noutputs, n_w) != (n_u, n_y, n_z + n_d):
        raise InputError(
            f"loop: plant with {plant.ninputs} inputs and {plant.noutputs} outputs, filter over {n_w} with {n_y} "
            f"outputs, gain of {n_u} inputs by {n_z} states and {n_d} disturbances: the sizes do not match"
            " [HM-ANALYZE-030]"
        )
    if np.any(np.asarray(plant.D) != 0):
        raise InputError(
            "loop: an output of the plant depends directly on the input (feedthrough), which is not supported "
            "[HM-ANALYZE-031]"
        )
    if delay < 0:
        raise InputError(
            f"loop: delay must be a whole number of periods, at least 0, got {delay} [HM-ANALYZE-032]"
        )
    # a disturbance with a gain of zero stays zero, so it is not a state of the loop
    alive = (np.arange(n_w) < n_z) | np.any(filter.gain != 0, axis=1)
    k, follow = np.hstack([gain.by_state, gain.by_load])[:, alive], filter.gain[alive]
    keep = np.eye(int(alive.sum())) - follow @ filter.C[:, alive]
    forward = np.hstack([keep @ filter.F[np.ix_(alive, alive)], keep @ filter.G[alive]])
    out = k @ forward
    out[:, len(keep) :] += gain.by_before
    a, b = np.vstack([forward, out]), np.vstack([follow, k @ follow])
    feedback = control_toolbox().ss(a, b, out, k @ follow, plant.dt, remove_useless_states=False)
    late = plant
    for _ in range(delay):
        late = _delay_inputs(late)
    closed = _closed(late, feedback)
    return LinearLoop(late, feedback, closed, poles_of(closed.A))


def _delay_inputs(plant: Any) -> Any:
    a, b, c, _ = matrices(plant)
    n, n_u = b.shape
    whole = np.block([[a, b], [np.zeros((n_u, n + n_u))]])
    into = np.vstack([np.zeros((n, n_u)), np.eye(n_u)])
    seen = np.hstack([c, np.zeros((len(c), n_u))])
    return control_toolbox().ss(whole, into, seen, 0.0, plant.dt, remove_useless_states=False)


def _open(plant: Any, feedback: Any) -> tuple[Array, Array, Array, Array]:
    """State space of the series of plant and feedback, from the plant's inputs to the controller's inputs."""
    a, b, c, _ = matrices(plant)
    f, g, h, k = matrices(feedback)
    whole = np.block([[a, np.zeros((len(a), len(f)))], [g @ c, f]])
    into = np.vstack([b, np.zeros((len(f), b.shape[1]))])
    return whole, into, np.hstack([k @ c, h]), np.zeros((len(h), b.shape[1]))


def _closed(plant: Any, feedback: Any) -> Any:
    """Closed loop from loads at the inputs and noise at the outputs to outputs and the controller's inputs."""
    a, b, c, _ = _open(plant, feedback)
    n, (n_y, n_u) = plant.nstates, (plant.noutputs, plant.ninputs)
    _, g, _, k = matrices(feedback)
    noise = np.vstack([b[:n] @ k, g])
    outputs = np.hstack([np.asarray(plant.C, dtype=float), np.zeros((n_y, feedback.nstates))])
    direct = np.block([[np.zeros((n_y, n_u + n_y))], [np.zeros((n_u, n_u)), k]])
    return control_toolbox().ss(
        a + b @ c, np.hstack([b, noise]), np.vstack([outputs, c]), direct, plant.dt, remove_useless_states=False,
        inputs=[f"load_{i}" for i in range(n_u)] + [f"noise_{i}" for i in range(n_y)],
        outputs=[f"y_{i}" for i in range(n_y)] + [f"u_{i}" for i in range(n_u)],
    )  # fmt: skip


def _response(sys: Any, omega: ArrayLike) -> Complex:
    response = frequency_response(sys, omega)
    return np.asarray(np.moveaxis(response.magnitude * np.exp(1j * response.phase), -1, 0))


def _steady_gain(sys: Any) -> float:
    """Gain of a single loop at frequency zero; 0 for a loop with an integrator, whose gain is infinite there."""
    a, b, c, d = matrices(sys)
    if not len(a):
        return float(d.item())
    # distance from 1 at which a pole counts as an integrator: rounding (1e-16) moves a triple pole by its third root
    if np.abs(np.linalg.eigvals(a) - 1.0).min() < 1e-5:
        return 0.0
    return float((c @ np.linalg.solve(np.eye(len(a)) - a, b) + d).item())


def _grid(sys: Any, dt: float) -> Array:
    """Frequencies up to the Nyquist frequency, denser near the poles."""
    poles = np.linalg.eigvals(sys.A).astype(np.complex128)
    sizes = np.abs(np.log(poles[np.abs(poles) > 0])) / dt
    moving = sizes[(sizes > 1e-6) & (sizes < np.pi / dt)]
    lowest = min(0.01 * float(moving.min(initial=np.pi / dt)), 1e-3 * np.pi / dt)
    near = (moving[:, None] * np.linspace(0.9, 1.1, 41)).ravel()
    omega = np.concatenate([np.geomspace(lowest, np.pi / dt, FREQUENCIES), near])
    return np.append(np.unique(omega[omega < (1 - 1e-12) * np.pi / dt]), np.pi / dt)
