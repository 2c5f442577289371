"""Free runs of a prior over many windows at once, with exact sensitivities: one graph of scalar operations.

The prior is traced once. A period is a Runge-Kutta step beside its derivatives by the state and the parameters; it is
run over all periods and all windows in one call of CasADi, without Python in between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal

Array = NDArray[np.float64]
MAX_SUBSTEPS = 20
"""A prior stiffer than this many Runge-Kutta sub-steps a period can follow needs another dt."""


class Simulation:
    """Free runs of an ODE, as functions of its first states, its inputs and its parameters.

    Args:
        xdot: ``(x, u, w, p) -> xdot`` of scalar operations, as :class:`~hybrid_mpc.machine.prior.Equations` has it.
        dt: Period [s].
        free: Places in ``p`` of the parameters by which it is differentiated, in this order.
    """

    def __init__(self, xdot: ca.Function, dt: float, free: Sequence[int] = ()) -> None:
        self.dt, self.free, self._xdot = dt, list(free), xdot
        self.n_x, self.n_u, self.n_w, self.n_p = (xdot.size1_in(i) for i in range(4))
        self._runs = cache(self._run_function)

    def states(self, x0: Array, u: Array, w: Array, p: Array, substeps: int) -> Array:
        """States ``(n, T + 1, n_x)`` of runs from ``x0`` ``(n, n_x)`` under ``u`` ``(n, T, n_u)``, ``w`` ``(n, T,
        n_w)``.

        Parameters ``p`` are those of all runs ``(n_p,)``, or of each ``(n, n_p)``.
        """
        return self._run(x0, u, w, p, substeps, 0)[0]

    def by_parameters(self, x0: Array, u: Array, w: Array, p: Array, substeps: int) -> tuple[Array, Array]:
        """The same states, and their derivatives ``(n, T + 1, n_x, n_p)`` by the free parameters."""
        return self._run(x0, u, w, p, substeps, len(self.free))

    def by_all(self, x0: Array, u: Array, w: Array, p: Array, substeps: int) -> tuple[Array, Array, Array]:
        """The same states, and their derivatives by the free parameters and by the first state."""
        x, s = self._run(x0, u, w, p, substeps, len(self.free) + self.n_x)
        return x, s[..., : len(self.free)], s[..., len(self.free) :]

    def _run(
        self, x0: Array, u: Array, w: Array, p: Array, substeps: int, columns: int
    ) -> tuple[Array, Array]:
        n, periods, _ = u.shape
        first = np.zeros((n, 1 + columns, self.n_x))
        first[:, 0] = x0
        if columns > len(self.free):
            first[:, 1 + len(self.free) :] = np.eye(self.n_x)
        run = self._runs(substeps, columns, periods, n)
        every_p = np.broadcast_to(p, (n, self.n_p))
        held = u.reshape(-1, self.n_u).T, w.reshape(n * periods, self.n_w).T
        found = run(first.reshape(-1, self.n_x).T, *held, every_p.T)
        later = np.asarray(found.full().T.reshape(n, periods, 1 + columns, self.n_x))
        every = np.concatenate([first[:, None], later], axis=1)
        return every[:, :, 0], every[:, :, 1:].swapaxes(2, 3)

    def _run_function(self, substeps: int, columns: int, periods: int, n: int) -> ca.Function:
        """All runs in one call: ``(z0, u, w, p) -> z`` with ``z = [x, columns of derivatives]``."""
        sizes = {"z": (self.n_x, 1 + columns), "u": (self.n_u, 1), "w": (self.n_w, 1), "p": (self.n_p, 1)}
        z, u, w, p = (ca.SX.sym(name, *size) for name, size in sizes.items())
        x = z[:, 0]
        x_next = stepped(self._xdot, x, u, w, p, self.dt, substeps)
        after = [x_next]
        if columns:
            by_x = ca.jacobian(x_next, x)
            slopes = by_x @ z[:, 1:]
            slopes[:, : len(self.free)] += ca.jacobian(x_next, p)[:, self.free]
            after.append(slopes)
        step = ca.Function("period", [z, u, w, p], [ca.cse(ca.densify(ca.horzcat(*after)))])
        held = [
            ca.MX.sym(name, rows, periods if name in ("u", "w") else columns)
            for name, (rows, columns) in sizes.items()
        ]
        over = step.mapaccum(periods)(*held[:3], ca.repmat(held[3], 1, periods))
        return ca.Function("run", held, [over]).map(n)


def stepped(xdot: ca.Function, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX, dt: float, substeps: int) -> ca.SX:
    """The state a period later, by Runge-Kutta of order 4 in equal sub-steps; ``u`` and ``w`` are held."""
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
    """``xdot`` of ``(x, d)``: the rates of the corrected states have an unknown, constant ``d`` added to them."""
    n_x, n_d = xdot.size1_in(0), len(corrected)
    z = ca.SX.sym("z", n_x + n_d)
    u, w, p = (ca.SX.sym(xdot.name_in(i), xdot.size1_in(i)) for i in (1, 2, 3))
    added = ca.SX(n_x, 1)
    for k, i in enumerate(corrected):
        added[i] = z[n_x + k]
    rate = ca.vertcat(xdot(z[:n_x], u, w, p) + added, ca.SX.zeros(n_d))
    return ca.Function("xdot", [z, u, w, p], [ca.densify(rate)], ["x", "u", "w", "p"], ["xdot"])


def required_substeps(prior: Prior, dt: float) -> int:
    """Sub-steps a period that keep every eigenvalue of the prior at rest within 1 / sub-step.

    Rest is the operating point, or else the middle of the signals' ranges (:func:`rest_of`).
    Runge-Kutta of order 4 is stable up to 2.8 and accurate to per cents of the fast mode at 1.
    """
    return substeps_for(
        prior.equations.xdot, *rest_of(prior), prior.p, dt, f"{type(prior).__name__}: the prior"
    )


def rest_of(prior: Prior) -> tuple[Array, Array, Array]:
    """States, inputs and disturbances at the operating point, or else in the middle of their ranges.

    What has no range is zero, or the limit next to it.
    """
    signals = prior.states, prior.inputs, prior.disturbances
    nearest = [np.array([_middle(s) for s in group], dtype=np.float64) for group in signals]
    point = prior.operating_point
    given = (None, None, None) if point is None else (point.x, point.u, point.w)
    x, u, w = (near if own is None else np.array(own) for own, near in zip(given, nearest, strict=True))
    return x, u, w if len(w) == len(prior.disturbances) else nearest[2]


def _middle(signal: Signal) -> float:
    both = 0.5 * (signal.lower + signal.upper)
    return both if math.isfinite(both) else min(max(0.0, signal.lower), signal.upper)


def substeps_for(xdot: ca.Function, x: Any, u: Any, w: Any, p: Any, dt: float, name: str) -> int:
    """:func:`required_substeps` of any ``xdot(x, u, w, p)`` at a point; an error says that ``name`` is too stiff."""
    slope = flow_slope(xdot)(x, u, w, p).full()
    rate = float(np.abs(np.linalg.eigvals(slope)).max()) if np.isfinite(slope).all() else math.inf
    substeps = max(1, math.ceil(rate * dt)) if math.isfinite(rate) else MAX_SUBSTEPS + 1
    if substeps > MAX_SUBSTEPS:
        raise InputError(
            f"{name}'s fastest mode at rest is {rate:.3g} 1/s; a period of {dt} s "
            f"would need {rate * dt:.3g} sub-steps (at most {MAX_SUBSTEPS}). Smooth its friction (lower the slope "
            f"at zero speed) or take a smaller dt."
        )
    return substeps


@lru_cache(maxsize=32)
def flow_slope(xdot: ca.Function) -> ca.Function:
    """``(x, u, w, p)`` to the derivative of ``xdot`` by ``x`` ``(n_x, n_x)``."""
    point = [ca.SX.sym(xdot.name_in(i), xdot.size1_in(i)) for i in range(4)]
    return ca.Function("slope", point, [ca.densify(ca.jacobian(xdot(*point), point[0]))])
