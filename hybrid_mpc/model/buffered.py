"""CasADi functions on fixed numpy buffers, without allocations or copies per call."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class BufferedFunction:
    """A CasADi function whose arguments and results are fixed numpy arrays.

    Fill :attr:`inputs`, call, read :attr:`outputs`; the next call overwrites them. Not thread-safe.

    Args:
        function: The function; sparse arguments and results become dense.

    Example:
        >>> x = ca.MX.sym("x", 2)
        >>> double = BufferedFunction(ca.Function("double", [x], [2 * x]))
        >>> double.inputs[0][:] = 1.0, 2.0
        >>> double()
        >>> double.outputs[0]
        array([2., 4.])
    """

    inputs: tuple[Array, ...]
    """One array per argument, flat, column by column."""

    outputs: tuple[Array, ...]
    """One array per result, flat, column by column."""

    def __init__(self, function: ca.Function) -> None:
        function = _dense(function)
        self.inputs = tuple(np.zeros(function.numel_in(i)) for i in range(function.n_in()))
        self.outputs = tuple(np.zeros(function.numel_out(i)) for i in range(function.n_out()))
        buffer: Any
        buffer, self._evaluate = function.buffer()
        for i, array in enumerate(self.inputs):
            buffer.set_arg(i, memoryview(array.data))
        for i, array in enumerate(self.outputs):
            buffer.set_res(i, memoryview(array.data))
        self._buffer = buffer, function  # must live as long as this object

    def __call__(self) -> None:
        """Evaluate :attr:`inputs` into :attr:`outputs`."""
        self._evaluate()


def _dense(function: ca.Function) -> ca.Function:
    sparsities = [function.sparsity_in(i) for i in range(function.n_in())]
    sparsities += [function.sparsity_out(i) for i in range(function.n_out())]
    if all(sparsity.is_dense() for sparsity in sparsities):
        return function
    ins = [ca.MX.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    return ca.Function(f"{function.name()}_dense", ins, [ca.densify(out) for out in function.call(ins)])
