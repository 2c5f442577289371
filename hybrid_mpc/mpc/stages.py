"""The model along a horizon with its Jacobians: all periods side by side, or as one run. Compiled on request."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.buffered import BufferedFunction
from nn_export import compile_function
from nn_export.errors import CompileError

Array = NDArray[np.float64]
Derivatives = tuple[Array, Array, Array]
"""Successors ``(N, n_z)``, transposed ``A_k`` ``(N, n_z, n_z)`` and ``B_k`` ``(N, n_z, n_u)``."""


class Stages:
    """A model's periods over a horizon, values and Jacobians in one call.

    Args:
        model: The model.
        n: Periods N.
        compiled: Whether one period is compiled as C. Default: no; CasADi's machine needs no compiler.

    Raises:
        InputError: If it is to be compiled and there is no compiler, or it fails.

    Example:
        >>> from hybrid_mpc.signals import Signal
        >>> x, h, u, w = ca.MX.sym("x"), ca.MX.sym("h", 0), ca.MX.sym("u"), ca.MX.sym("w")
        >>> model = HybridModel("sum", 1.0, (Signal("x", "-"),), (Signal("u", "-"),), (Signal("x", "-"),),
        ...     ca.Function("f", [x, h, u], [x + u, h]), ca.Function("g", [x, h, u], [u]),
        ...     ca.Function("y", [x, u], [x]), ca.Function("e", [x, w, u], [w - u]))
        >>> Stages(model, 3).run(np.zeros(1), np.ones((3, 1)))[0].ravel().tolist()
        [1.0, 2.0, 3.0]
    """

    side_by_side: BufferedFunction
    """``(z, u) -> (z_next, A, B)`` of N periods that know nothing of each other."""

    def __init__(self, model: HybridModel, n: int, *, compiled: bool = False) -> None:
        stage = _compiled(_stage(model)) if compiled else _stage(model)
        self.side_by_side = BufferedFunction(stage.map(n))
        self._along = BufferedFunction(stage.mapaccum("run_with_jacobian", n))
        self._shape = n, model.n_x + model.n_h

    def at(self, z: Array, u: Array) -> Derivatives:
        """Every period from its own ``z`` ``(N, n_z)`` on ``u`` ``(N, n_u)``."""
        return self._call(self.side_by_side, z, u)

    def run(self, z0: Array, u: Array) -> Derivatives:
        """A run of the model from ``z0`` ``(n_z,)`` on ``u`` ``(N, n_u)``."""
        return self._call(self._along, z0, u)

    def _call(self, f: BufferedFunction, z: Array, u: Array) -> Derivatives:
        n, n_z = self._shape
        f.inputs[0][:], f.inputs[1][:] = z.ravel(), u.ravel()
        f()
        z_next, a, b = (out.copy() for out in f.outputs)  # the next call overwrites them
        return z_next.reshape(n, n_z), a.reshape(n, n_z, n_z), b.reshape(n, -1, n_z).transpose(0, 2, 1)


def _stage(model: HybridModel) -> ca.Function:
    z, u = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("u", model.n_u)
    assert model.with_jacobian is not None
    # Written into the caller's graph where that is possible: a call less a stage.
    inline = model.with_jacobian.is_a("MXFunction")
    x_next, h_next, a, b = model.with_jacobian.call([z[: model.n_x], z[model.n_x :], u], inline, False)
    return ca.Function("stage", [z, u], [ca.vertcat(x_next, h_next), ca.densify(a), ca.densify(b)])


def _compiled(stage: ca.Function) -> ca.Function:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # that is how a missing compiler is told
            return compile_function(stage)
    except (RuntimeWarning, CompileError) as error:
        raise InputError(
            f"compiled=True given, but the model could not be compiled: {error}; needed: a C compiler (cc, gcc, "
            "clang or the one that the variable CC names); leave compiled out to do without"
        ) from error
