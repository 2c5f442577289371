"""The model along a horizon with its Jacobians: all periods in parallel, or as one run."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel, inlined
from nn_export import compile_function
from nn_export.errors import CompileError

Array = NDArray[np.float64]
Derivatives = tuple[Array, Array, Array]
"""Successors ``(N, n_z)``, transposed ``A_k`` ``(N, n_z, n_z)`` and ``B_k`` ``(N, n_z, n_u)``."""
Run = Callable[[Array, Array], Array]
"""Trajectory ``(N + 1, n_z)`` of a model from ``z0`` ``(n_z,)`` with all inputs ``(N, n_v)``
(:meth:`~hybrid_mpc.model.model.HybridModel.acting`); without disturbances these are the inputs ``u``."""
Slopes = Callable[[Array, Array], Array]
"""Jacobians of the successors ``(m, n_z, n_x + n_u)`` by ``(x, u)`` at ``z`` ``(m, n_z)`` and all inputs; with
``hidden`` by ``(x, u, h)``."""


class Linearization(Protocol):
    """The periods of a model over a horizon, values and Jacobians in one call."""

    def at(self, z: Array, v: Array) -> Derivatives:
        """Every period from its own ``z`` ``(N, n_z)`` with all inputs ``v`` ``(N, n_v)``."""

    run: Run
    """The trajectory from one ``z``."""

    def slopes(self, times: int, *, hidden: bool = False) -> Slopes:
        """A function for ``m = times N`` periods, made once and called often."""


def stages(model: HybridModel, n: int, *, compiled: bool = False) -> Linearization:
    """The fastest linearization of a model: all periods in parallel with ``side_by_side``, else one after the other.

    ``compiled``: functions that are evaluated period by period are compiled as C.

    Raises:
        InputError: If compilation is requested and fails, or there is no compiler.
    """
    kind = Stages if model.side_by_side is None else VectorisedStages
    return kind(model, n, compiled=compiled)


class Stages:
    """One period after the other, interpreted by CasADi or compiled."""

    def __init__(self, model: HybridModel, n: int, *, compiled: bool = False) -> None:
        stage = _compiled(_stage(model)) if compiled else _stage(model)
        self._side_by_side = BufferedFunction(stage.map(n))
        self.run = free_run(model, n, compiled=compiled)
        self._shape, self._n_x = (n, model.n_x + model.n_h), model.n_x

    def at(self, z: Array, v: Array) -> Derivatives:
        """See :class:`Linearization`."""
        z_next, a_t, b = self._call(z, v)
        return z_next.copy(), a_t.copy(), b.copy()  # the next call overwrites them

    def slopes(self, times: int, *, hidden: bool = False) -> Slopes:
        """See :class:`Linearization`."""
        n, n_x = self._shape[0], self._n_x

        def evaluate(z: Array, v: Array) -> Array:
            parts = []
            for k in range(0, times * n, n):
                _, a_t, b = self._call(z[k : k + n], v[k : k + n])
                a = a_t.transpose(0, 2, 1)
                blocks = [a[:, :, :n_x], b, a[:, :, n_x:]] if hidden else [a[:, :, :n_x], b]
                parts.append(np.concatenate(blocks, axis=2))
            return np.concatenate(parts)

        return evaluate

    def _call(self, z: Array, v: Array) -> Derivatives:
        (n, n_z), f = self._shape, self._side_by_side
        f.inputs[0][:], f.inputs[1][:] = z.ravel(), v.ravel()
        f()
        z_next, a, b = f.outputs
        return z_next.reshape(n, n_z), a.reshape(n, n_z, n_z), b.reshape(n, -1, n_z).transpose(0, 2, 1)


class VectorisedStages:
    """All periods in parallel, for a model with ``side_by_side``; a run uses ``step``."""

    def __init__(self, model: HybridModel, n: int, *, compiled: bool = False) -> None:
        assert model.side_by_side is not None
        self._many, self._n, self._n_x = model.side_by_side, n, model.n_x
        self._model, self._ends = model, (model.n_u, model.n_u + model.n_w)
        self._at, self._held = self._many(n, {"A": ("x", "h"), "B": ("u",)}), self._tiled(n)
        self.run = free_run(model, n, compiled=compiled)

    def at(self, z: Array, v: Array) -> Derivatives:
        """See :class:`Linearization`."""
        _, more = self._ends
        x_next, h_next, a, b = self._at(*self._point(z, v, self._held))
        if v.shape[1] > more:
            x_next = x_next + v[:, more:]
        return np.hstack([x_next, h_next]), a.transpose(0, 2, 1), b

    def slopes(self, times: int, *, hidden: bool = False) -> Slopes:
        """See :class:`Linearization`."""
        by = ("x", "u", "h") if hidden else ("x", "u")
        points = times * self._n
        many, held = self._many(points, {"slopes": by}), self._tiled(points)
        return lambda z, v: many(*self._point(z, v, held))[2]

    def _point(self, z: Array, v: Array, held: tuple[Array, Array]) -> tuple[Array, ...]:
        """Arguments of the model's step at many points."""
        n_u, more = self._ends
        w = v[:, n_u:more] if more > n_u else held[0]
        u = v if v.shape[1] == n_u else np.ascontiguousarray(v[:, :n_u])
        return z[:, : self._n_x], z[:, self._n_x :], u, w, held[1]

    def _tiled(self, n: int) -> tuple[Array, Array]:
        """Empty disturbances, and the parameters, for all points."""
        return np.zeros((n, 0)), np.tile(self._model.p, (n, 1))


def free_run(model: HybridModel, n: int, *, compiled: bool = False) -> Run:
    """The model run freely over ``n`` periods."""
    step = stage_step(model)
    f = BufferedFunction((_compiled(step) if compiled else step).mapaccum("run", n))

    def run(z0: Array, v: Array) -> Array:
        f.inputs[0][:], f.inputs[1][:] = z0, v.ravel()
        f()
        return np.concatenate([z0[None], f.outputs[0].reshape(n, -1)])

    return run


def stage_step(model: HybridModel) -> ca.Function:
    """``(z, v) -> z_next``: one period of the model with all inputs."""
    z, v = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("v", model.n_v)
    x_next, h_next = inlined(model.step, _point(model, z, v))
    return ca.Function("z_step", [z, v], [ca.vertcat(_moved(model, x_next, v), h_next)])


def _stage(model: HybridModel) -> ca.Function:
    z, v = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("v", model.n_v)
    x_next, h_next, a, b = inlined(model.with_jacobian, _point(model, z, v))
    z_next = ca.vertcat(_moved(model, x_next, v), h_next)
    return ca.Function("stage", [z, v], [z_next, ca.densify(a), ca.densify(b)])


def _point(model: HybridModel, z: ca.MX, v: ca.MX) -> list[ca.MX]:
    n_u, more = model.n_u, model.n_u + model.n_w
    u = v if v.numel() == n_u else v[:n_u]
    w = v[n_u:more] if model.n_w else ca.MX(ca.DM(model.w))
    return [z[: model.n_x], z[model.n_x :], u, w, ca.MX(ca.DM(model.p))]


def _moved(model: HybridModel, x_next: ca.MX, v: ca.MX) -> ca.MX:
    """The next state with the effect of unmeasured disturbances."""
    more = model.n_u + model.n_w
    return x_next + v[more:] if v.numel() > more else x_next


def _compiled(stage: ca.Function) -> ca.Function:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # a missing compiler is a warning
            return compile_function(stage)
    except (RuntimeWarning, CompileError) as error:
        raise InputError(
            f"compiled=True: the model could not be compiled: {error}. Install a C compiler (cc, gcc, clang or the one "
            "named by the variable CC), or omit compiled. [HM-MODEL-043]"
        ) from error
