"""Free runs of a prior over many windows at once, with exact sensitivities.

The prior is traced once to a graph of scalar operations. A period consists of a Runge-Kutta step, the outputs at its
start, and their derivatives by state and parameters. Each operation is vectorized over all windows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal
from nn_export.vectorised import vectorised

Array = NDArray[np.float64]
MAX_SUBSTEPS = 20
"""Maximum Runge-Kutta sub-steps a period; a stiffer prior needs a smaller dt."""
USUALLY = 0.98
"""Share of the samples at which a prior must not be too stiff. At the others, such as near the square root of an empty
tank's level, the integration is less accurate."""
CHAINED = 20
"""Periods of a recursion in one call: a call from Python takes as long as some hundred operations."""
Points: TypeAlias = tuple[Array, Array, Array]
"""States ``(n, n_x)``, inputs ``(n, n_u)`` and disturbances ``(n, n_w)``."""


class Simulation:
    """Free runs of an ODE, as functions of initial states, inputs and parameters.

    Args:
        xdot: ``(x, u, w, p) -> xdot`` of scalar operations, as in :class:`~hybrid_mpc.machine.prior.Equations`.
        dt: Period [s].
        free: Indices in ``p`` of the parameters for the derivatives, in this order.
        output: ``(x, u, w, p) -> y``, the result at every sample. Default: the states.
        correct: ``(x, u, w, p) -> x``, correction of the state at the start of a period. Default: none.
    """

    def __init__(
        self,
        xdot: ca.Function,
        dt: float,
        free: Sequence[int] = (),
        output: ca.Function | None = None,
        correct: ca.Function | None = None,
    ) -> None:
        self.dt, self.free, self._xdot, self._output, self._correct = dt, list(free), xdot, output, correct
        self.n_x, self.n_p = xdot.size1_in(0), xdot.size1_in(3)
        self._period = cache(self._period_function)

    def values(self, x0: Array, u: Array, w: Array, p: Array, substeps: int) -> Array:
        """Outputs ``(n, T + 1, n_y)`` of runs from ``x0`` ``(n, n_x)``.

        ``u`` is ``(n, T + 1, n_u)``, ``w`` ``(n, T + 1, n_w)``; their last sample is used for the outputs only.
        Parameters ``p`` are ``(n_p,)`` for all runs, or ``(n, n_p)``.
        """
        return self._run(x0, u, w, p, substeps, 0)[0]

    def by_parameters(self, x0: Array, u: Array, w: Array, p: Array, substeps: int) -> tuple[Array, Array]:
        """The same outputs, and their derivatives ``(n, T + 1, n_y, n_p)`` by the free parameters."""
        return self._run(x0, u, w, p, substeps, len(self.free))

    def by_all(self, x0: Array, u: Array, w: Array, p: Array, substeps: int) -> tuple[Array, Array]:
        """The same outputs, and their derivatives by the free parameters, then by the initial state."""
        return self._run(x0, u, w, p, substeps, len(self.free) + self.n_x)

    def _run(
        self, x0: Array, u: Array, w: Array, p: Array, substeps: int, columns: int
    ) -> tuple[Array, Array]:
        first = np.zeros((1 + columns, self.n_x, len(x0)))
        first[0] = x0.T
        if columns > len(self.free):
            first[1 + len(self.free) :] = np.eye(self.n_x)[..., None]
        held = (np.moveaxis(v, 0, -1) for v in (u, w))
        every_p = np.broadcast_to(p, (len(x0), self.n_p)).T
        _, (y,) = over_time(self._period(substeps, columns), first, list(held), [every_p])
        y = np.moveaxis(y.reshape(len(y), 1 + columns, -1, len(x0)), (3, 0), (0, 1))
        return np.ascontiguousarray(y[:, :, 0]), np.ascontiguousarray(y[:, :, 1:].swapaxes(2, 3))

    def _period_function(self, substeps: int, columns: int) -> ca.Function:
        """A period ``(z, u, w, p) -> z, y`` with ``z = [x, columns of derivatives]``; ``y`` has the same form."""
        n_u, n_w = self._xdot.size1_in(1), self._xdot.size1_in(2)
        sizes = {"z": (self.n_x, 1 + columns), "u": (n_u, 1), "w": (n_w, 1), "p": (self.n_p, 1)}
        z, u, w, p = (ca.SX.sym(name, *size) for name, size in sizes.items())
        n = len(self.free) if columns else 0
        given = ca.horzcat(z[:, 0], ca.SX(self.n_x, n), ca.SX.eye(self.n_x)) if columns else z
        rate = _with_slopes(self._xdot, self.free, columns > 0)
        output, correct = (
            None if f is None else _with_slopes(f, self.free, columns > 0)
            for f in (self._output, self._correct)
        )
        y = given if output is None else output(given, u, w, p)
        begin = given if correct is None else correct(given, u, w, p)
        found = []
        for value in (stepped(rate, begin, u, w, p, self.dt, substeps), y):
            if columns:  # chain rule: derivatives of this period times those of the periods before
                slopes = value[:, 1 + n :] @ z[:, 1:]
                slopes[:, :n] += value[:, 1 : 1 + n]
                value = ca.horzcat(value[:, 0], slopes)
            found.append(ca.densify(value))
        return ca.Function("period", [z, u, w, p], ca.cse(found))


def _with_slopes(f: ca.Function, free: Sequence[int], wanted: bool) -> Callable[..., ca.SX]:
    """``f(x, u, w, p)`` for ``z = [x, derivatives by free parameters, derivatives by an initial state]``.

    The result has the same form. A Runge-Kutta step of these rates is the step of ``x`` and its exact derivative. The
    Jacobians are sparse expressions of one stage, so the step has fewer operations than the derivative of a whole step.

    Args:
        f: The function.
        free: Indices of the free parameters in ``p``.
        wanted: True: with derivatives; False: ``z`` is ``x``.
    """
    x, u, w, p = (ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4))
    value, n = f(x, u, w, p), len(free)
    by_p = ca.jacobian(value, p[list(free)]) if n else ca.SX(value.numel(), 0)
    parts = ca.Function("parts", [x, u, w, p], [value, ca.jacobian(value, x), by_p])

    def found(z: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
        if not wanted:
            return f(z, u, w, p)
        value, by_x, by_p = parts(z[:, 0], u, w, p)
        slopes = by_x @ z[:, 1:]
        return ca.horzcat(value, slopes[:, :n] + by_p, slopes[:, n:])

    return found


@lru_cache(maxsize=32)
def simulation_of(
    xdot: ca.Function, dt: float, free: tuple[int, ...] = (), output: ca.Function | None = None
) -> Simulation:
    """Cached :class:`Simulation`; its functions are built once."""
    return Simulation(xdot, dt, free, output)


def over_time(
    period: ca.Function, first: Array, signals: Sequence[Array], constants: Sequence[Array]
) -> tuple[Array, list[Array]]:
    """Evaluate the recursion ``z_{k+1}, others_k = period(z_k, signals_k, constants)`` for ``n`` parallel runs.

    Runs are the last axis. Each operation is vectorized over all runs, on numpy's memory. Matrix arguments and results
    are stored column by column.

    Args:
        period: The function, of scalar operations.
        first: ``z_0`` ``(..., n)``.
        signals: Time-varying arguments ``(T, size, n)``.
        constants: Constant arguments ``(..., n)``.

    Returns:
        ``z`` ``(T + 1, size, n)``, and each of the others ``(T, size, n)``.
    """
    steps, n = len(signals[0]), first.shape[-1]
    held = np.concatenate([np.zeros((0, n)), *(v.reshape(-1, n) for v in constants)])
    moving, fixed = (np.ascontiguousarray(v, np.float64) for v in (np.concatenate(signals, axis=1), held))
    sizes = [period.numel_out(i) for i in range(1, period.n_out())]
    z, others = np.empty((steps + 1, period.numel_in(0), n)), np.empty((steps, sum(sizes), n))
    z[0] = first.reshape(-1, n)
    one, done = _side_by_side(period, len(signals), n), 0
    for function, length in ((_chained(one), CHAINED), (one, 1)) if steps >= CHAINED else ((one, 1),):
        buffer: Any
        buffer, evaluate = function.buffer()
        if fixed.size:
            buffer.set_arg(2, memoryview(fixed.data))
        for k in range(done, steps - length + 1, length):
            buffer.set_arg(0, memoryview(z[k].data))
            buffer.set_arg(1, memoryview(moving[k : k + length].data))
            buffer.set_res(0, memoryview(z[k + 1 : k + 1 + length].data))
            if sizes:
                buffer.set_res(1, memoryview(others[k : k + length].data))
            evaluate()
            done = k + length
    return z, np.split(others, np.cumsum(sizes)[:-1], axis=1) if sizes else []


@lru_cache(maxsize=128)
def _side_by_side(period: ca.Function, signals: int, n: int) -> ca.Function:
    """``(z, signals, constants) -> z, others`` for ``n`` runs; each argument and result is one matrix."""
    kinds = [range(1), range(1, 1 + signals), range(1 + signals, period.n_in())]
    sizes = [[period.numel_in(i) for i in kind] for kind in kinds]
    given = [ca.SX.sym("v", sum(own)) for own in sizes]
    parts = [
        part
        for value, own in zip(given, sizes, strict=True)
        for part in (ca.vertsplit(value, [0, *np.cumsum(own).tolist()]) if own else [])
    ]
    z, *others = period.call([ca.reshape(v, *period.size_in(i)) for i, v in enumerate(parts)])
    found = [ca.vec(z), ca.vertcat(*(ca.vec(v) for v in others))]
    return vectorised(ca.Function(period.name(), given, found), n)


@lru_cache(maxsize=128)
def _chained(one: ca.Function) -> ca.Function:
    """``CHAINED`` periods as one function, to reduce the number of calls from Python."""
    z, constants = ca.MX.sym("z", *one.size_in(0)), ca.MX.sym("c", *one.size_in(2))
    signals = ca.MX.sym("s", one.size1_in(1), CHAINED * one.size2_in(1))
    found, after = [], z
    for now in ca.horzsplit(signals, one.size2_in(1)) if one.size2_in(1) else [signals] * CHAINED:
        found.append(one.call([after, now, constants]))
        after = found[-1][0]
    results = [ca.horzcat(*values) for values in zip(*found, strict=True)]
    return ca.Function(one.name(), [z, signals, constants], results)


def stepped(
    xdot: Callable[..., ca.SX], x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX, dt: float, substeps: int
) -> ca.SX:
    """State one period later, by the Runge-Kutta method of order 4 in equal sub-steps; ``u`` and ``w`` are constant."""
    s = dt / substeps
    for _ in range(substeps):
        k1 = xdot(x, u, w, p)
        k2 = xdot(x + 0.5 * s * k1, u, w, p)
        k3 = xdot(x + 0.5 * s * k2, u, w, p)
        k4 = xdot(x + s * k3, u, w, p)
        x = x + (s / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    return x


@lru_cache(maxsize=32)
def with_unknown_rates(xdot: ca.Function, corrected: tuple[int, ...]) -> ca.Function:
    """``xdot`` of ``(x, d)``: the rates of the corrected states have unknown, constant rates ``d`` added."""
    n_x, n_d = xdot.size1_in(0), len(corrected)
    z = ca.SX.sym("z", n_x + n_d)
    u, w, p = (ca.SX.sym(xdot.name_in(i), xdot.size1_in(i)) for i in (1, 2, 3))
    added = ca.SX(n_x, 1)
    for k, i in enumerate(corrected):
        added[i] = z[n_x + k]
    rate = ca.vertcat(xdot(z[:n_x], u, w, p) + added, ca.SX.zeros(n_d))
    return ca.Function("xdot", [z, u, w, p], [ca.densify(rate)], ["x", "u", "w", "p"], ["xdot"])


def required_substeps(prior: Prior, dt: float, points: Points | None = None) -> int:
    """Number of sub-steps a period so that |eigenvalue| times sub-step is at most 1, at rest and at points.

    Rest is the operating point, or the middle of the signals' ranges (:func:`rest_of`). Points are samples of the
    recordings (:func:`visited`); unstable modes are ignored there. At most 2 % of the points may need more than
    ``MAX_SUBSTEPS``; these points get ``MAX_SUBSTEPS``. The Runge-Kutta method of order 4 is stable up to 2.8, and its
    error at 1 is a few per cent of the fast mode.

    Raises:
        InputError: If more than ``MAX_SUBSTEPS`` are needed.
    """
    name = f"{type(prior).__name__}: the prior"
    substeps = substeps_for(prior.equations.xdot, *rest_of(prior), prior.p, dt, name)
    if points is None or not len(points[0]):
        return substeps
    modes = np.linalg.eigvals(_flow_slopes(prior, points))
    fastest = np.where(modes.real <= 0, np.abs(modes), 0.0).max(axis=1, initial=0.0)
    if not len(fastest):
        return substeps
    usual = _substeps(float(np.quantile(fastest, USUALLY)), dt, name, "in the region of the recordings")
    return max(substeps, usual, min(MAX_SUBSTEPS, math.ceil(float(fastest.max()) * dt)))


def growth_rate(prior: Prior, points: Points) -> float:
    """Mean growth rate [1/s] of the distance of two runs of the prior along the recordings; 0 for a stable prior.

    Mean over the points of the largest real part of an eigenvalue, or zero if that is negative. A short passage through
    an unstable region counts in proportion to its duration.
    """
    if not len(points[0]):
        return 0.0
    modes = np.linalg.eigvals(_flow_slopes(prior, points))
    return float(np.mean(np.maximum(modes.real.max(axis=1), 0.0))) if len(modes) else 0.0


def visited(trajectories: Sequence[Trajectory]) -> Points:
    """States, inputs and disturbances at evenly chosen samples of the recordings, and at the extreme samples.

    They determine the stiffness of a prior that is stiff only in a part of its range.
    """
    columns = [np.concatenate([getattr(t, key) for t in trajectories]) for key in ("x", "u", "w")]
    every = np.hstack(columns)[np.isfinite(np.hstack(columns)).all(axis=1)]
    if len(every):
        outermost = {int(i) for found in (every.argmin(axis=0), every.argmax(axis=0)) for i in found}
        # number of samples of the recordings at which the stiffness is computed, besides the extreme ones
        every = every[sorted({*evenly(len(every), 200), *outermost})]
    x, u, w = np.split(every, np.cumsum([v.shape[1] for v in columns])[:-1], axis=1)
    return x, u, w


def rest_of(prior: Prior) -> tuple[Array, Array, Array]:
    """States, inputs and disturbances at the operating point, or in the middle of their ranges.

    A signal without a finite range is zero, or its limit nearest to zero.
    """
    signals = prior.states, prior.inputs, prior.disturbances
    nearest = [np.array([_middle(s) for s in group], dtype=np.float64) for group in signals]
    point = prior.operating_point
    given = (None, None, None) if point is None else (point.x, point.u, point.w)
    x, u, w = (near if own is None else np.array(own) for own, near in zip(given, nearest, strict=True))
    return x, u, w if len(w) == len(prior.disturbances) else nearest[2]


def measured_as(prior: Prior, y: Array) -> Array:
    """Clip outputs ``(..., n_y)`` to the sensors' declared ranges."""
    low, high = np.array([s.saturation or (-math.inf, math.inf) for s in prior.outputs]).T
    return np.asarray(np.clip(y, low, high))


def _middle(signal: Signal) -> float:
    both = 0.5 * (signal.lower + signal.upper)
    return both if math.isfinite(both) else min(max(0.0, signal.lower), signal.upper)


def substeps_for(xdot: ca.Function, x: Any, u: Any, w: Any, p: Any, dt: float, name: str) -> int:
    """:func:`required_substeps` of any ``xdot(x, u, w, p)`` at a point; ``name`` is for the error message."""
    slope = flow_slope(xdot)(x, u, w, p).full()
    rate = float(np.abs(np.linalg.eigvals(slope)).max()) if np.isfinite(slope).all() else math.inf
    return _substeps(rate, dt, name, "at rest")


def _substeps(rate: float, dt: float, name: str, where: str) -> int:
    substeps = max(1, math.ceil(rate * dt)) if math.isfinite(rate) else MAX_SUBSTEPS + 1
    if substeps > MAX_SUBSTEPS:
        raise InputError(
            f"{name}: too stiff. Its fastest mode {where} is {rate:.3g} 1/s, so a period of {dt} s would need "
            f"{rate * dt:.3g} sub-steps (at most {MAX_SUBSTEPS}). Replace its fastest "
            "state by its steady-state equation, smooth a steep term (dry friction at zero speed), or use a smaller dt "
            "[HM-IDENTIFY-049]"
        )
    return substeps


def _flow_slopes(prior: Prior, points: Points) -> Array:
    """Jacobians of the rates by the state ``(m, n_x, n_x)``, at the points with finite Jacobians."""
    slopes = _slopes_at(prior.equations.xdot, len(points[0]))(*(v.T for v in points), prior.p).full()
    every = np.moveaxis(slopes.reshape(len(prior.states), -1, len(prior.states)), 1, 0)
    return np.asarray(every[np.isfinite(every).all(axis=(1, 2))])


@lru_cache(maxsize=64)
def _slopes_at(xdot: ca.Function, n: int) -> ca.Function:
    return flow_slope(xdot).map("slopes", "serial", n, [3], [])


@lru_cache(maxsize=32)
def flow_slope(xdot: ca.Function) -> ca.Function:
    """Function of ``(x, u, w, p)``: Jacobian of ``xdot`` by ``x`` ``(n_x, n_x)``."""
    point = [ca.SX.sym(xdot.name_in(i), xdot.size1_in(i)) for i in range(4)]
    return ca.Function("slope", point, [ca.densify(ca.jacobian(xdot(*point), point[0]))])
