"""Free runs of a prior over many windows at once, with exact sensitivities: one graph of scalar operations.

The prior is traced once. A period is a Runge-Kutta step beside its derivatives by the state and the parameters; it is
run over all periods and all windows in one call of CasADi, without Python in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray

import nn_export
from hybrid_mpc.identify.export import OfPrior
from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]


class Simulation:
    """Free runs of an ODE, as functions of its first states, its inputs and its parameters.

    Args:
        xdot: ``(x, u, p) -> xdot`` of scalar operations.
        dt: Period [s].
        free: Places in ``p`` of the parameters by which it is differentiated, in this order.
    """

    def __init__(self, xdot: ca.Function, dt: float, free: Sequence[int] = ()) -> None:
        self.dt, self.free, self._xdot = dt, list(free), xdot
        self.n_x, self.n_u, self.n_p = (xdot.size1_in(i) for i in range(3))
        self._runs = cache(self._run_function)

    def states(self, x0: Array, u: Array, p: Array, substeps: int) -> Array:
        """States ``(n, T + 1, n_x)`` of runs from ``x0`` ``(n, n_x)`` under ``u`` ``(n, T, n_u)``.

        Parameters ``p`` are those of all runs ``(n_p,)``, or of each ``(n, n_p)``.
        """
        return self._run(x0, u, p, substeps, 0)[0]

    def by_parameters(self, x0: Array, u: Array, p: Array, substeps: int) -> tuple[Array, Array]:
        """The same states, and their derivatives ``(n, T + 1, n_x, n_p)`` by the free parameters."""
        return self._run(x0, u, p, substeps, len(self.free))

    def by_all(self, x0: Array, u: Array, p: Array, substeps: int) -> tuple[Array, Array, Array]:
        """The same states, and their derivatives by the free parameters and by the first state."""
        x, s = self._run(x0, u, p, substeps, len(self.free) + self.n_x)
        return x, s[..., : len(self.free)], s[..., len(self.free) :]

    def _run(self, x0: Array, u: Array, p: Array, substeps: int, columns: int) -> tuple[Array, Array]:
        n, periods, _ = u.shape
        first = np.zeros((n, 1 + columns, self.n_x))
        first[:, 0] = x0
        if columns > len(self.free):
            first[:, 1 + len(self.free) :] = np.eye(self.n_x)
        run = self._runs(substeps, columns, periods, n)
        every_p = np.broadcast_to(p, (n, self.n_p))
        found = run(first.reshape(-1, self.n_x).T, u.reshape(-1, self.n_u).T, every_p.T)
        later = np.asarray(found.full().T.reshape(n, periods, 1 + columns, self.n_x))
        every = np.concatenate([first[:, None], later], axis=1)
        return every[:, :, 0], every[:, :, 1:].swapaxes(2, 3)

    def _run_function(self, substeps: int, columns: int, periods: int, n: int) -> ca.Function:
        """All runs in one call: ``(z0, u, p) -> z`` with ``z = [x, columns of derivatives]``."""
        z, u, p = (
            ca.SX.sym("z", self.n_x, 1 + columns),
            ca.SX.sym("u", self.n_u),
            ca.SX.sym("p", self.n_p),
        )
        x = z[:, 0]
        x_next = self._stepped(x, u, p, substeps)
        after = [x_next]
        if columns:
            by_x = ca.jacobian(x_next, x)
            slopes = by_x @ z[:, 1:]
            slopes[:, : len(self.free)] += ca.jacobian(x_next, p)[:, self.free]
            after.append(slopes)
        step = ca.Function("period", [z, u, p], [ca.cse(ca.densify(ca.horzcat(*after)))])
        held = (
            ca.MX.sym("z", self.n_x, 1 + columns),
            ca.MX.sym("u", self.n_u, periods),
            ca.MX.sym("p", self.n_p),
        )
        over = step.mapaccum(periods)(held[0], held[1], ca.repmat(held[2], 1, periods))
        return ca.Function("run", list(held), [over]).map(n)

    def _stepped(self, x: ca.SX, u: ca.SX, p: ca.SX, substeps: int) -> ca.SX:
        s = self.dt / substeps
        for _ in range(substeps):
            k1 = self._xdot(x, u, p)
            k2 = self._xdot(x + 0.5 * s * k1, u, p)
            k3 = self._xdot(x + 0.5 * s * k2, u, p)
            k4 = self._xdot(x + s * k3, u, p)
            x = x + (s / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
        return x


def traced(prior: Prior) -> ca.Function:
    """``(x, u, p) -> xdot`` of a prior, ``p`` in the order of its specification, as scalar operations."""
    return _traced(_Equations(prior))


class _Equations:
    """A prior without the values of its parameters: equal for two of one class whose own attributes are equal numbers
    or texts. Any other attribute, buffer or module makes it equal to nothing but itself.
    """

    def __init__(self, prior: Prior) -> None:
        module = vars(torch.nn.Module())
        own = {name: value for name, value in vars(prior).items() if name not in module}
        simple = all(isinstance(value, bool | int | float | str) for value in own.values())
        alone = not simple or any(True for _ in prior.buffers()) or any(True for _ in prior.children())
        self.prior = prior
        self._key = type(prior), prior.parameters_spec, id(prior) if alone else tuple(sorted(own.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Equations) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=16)
def _traced(equations: _Equations) -> ca.Function:
    prior = equations.prior
    n_x, n_u, n_p = len(prior.states), len(prior.inputs), len(prior.parameters_spec)
    examples = tuple(torch.zeros(n) for n in (n_x, n_u, 0, n_p))
    program = nn_export.trace(OfPrior(prior, "forward"), examples, input_names=["x", "u", "w", "p"])
    x, u, p = ca.SX.sym("x", n_x), ca.SX.sym("u", n_u), ca.SX.sym("p", n_p)
    xdot = nn_export.build(program).expand()(x, u, ca.SX(0, 1), p)
    return ca.Function("xdot", [x, u, p], [ca.densify(xdot)])


def with_acceleration(prior: Prior, dt: float) -> Simulation:
    """Runs of ``(q, v, d)``: the prior with the unknown accelerations ``d``, which are constant."""
    return _with_acceleration(_Equations(prior), dt)


@lru_cache(maxsize=16)
def _with_acceleration(equations: _Equations, dt: float) -> Simulation:
    prior, xdot = equations.prior, _traced(equations)
    n_x, n_q = xdot.size1_in(0), prior.n_q
    z, u, p = ca.SX.sym("z", n_x + n_q), ca.SX.sym("u", xdot.size1_in(1)), ca.SX.sym("p", xdot.size1_in(2))
    x, d = z[:n_x], z[n_x:]
    rate = ca.vertcat(xdot(x, u, p) + ca.vertcat(ca.SX.zeros(n_x - n_q), d), ca.SX.zeros(n_q))
    return Simulation(ca.Function("xdot", [z, u, p], [ca.densify(rate)]), dt)
