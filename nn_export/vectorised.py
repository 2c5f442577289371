"""A function of one point as a function of many: one instruction of CasADi's machine for all of them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_INSTRUCTIONS = 100_000
"""Longer scalar code is evaluated point by point, some nine times slower: its graph of vectors would take seconds to
build (half a second at this length)."""


def vectorised(f: ca.Function, n: int) -> ca.Function:
    """``f`` at ``n`` points, each a row of matrices.

    Scalar code (an ``SXFunction``) becomes a graph whose every operation runs over all points: the work of CasADi's
    machine is done once and not ``n`` times, and the same operations give the same numbers. Any other function is
    mapped: called point by point. In and out go dense matrices ``n x size``: a row has an argument's elements, column
    by column, or a result's.
    """
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    symbols = [kind.sym("v", *f.size_in(i)) for i in range(f.n_in())]
    dense = ca.Function(f.name(), symbols, [ca.densify(r) for r in f.call(symbols)])
    inputs = [ca.MX.sym(f"i{i}", n, f.numel_in(i)) for i in range(f.n_in())]
    results = None
    if kind is ca.SX and dense.n_instructions() <= MOST_INSTRUCTIONS:
        results = _walk(dense, n, inputs)
    if results is None:
        given = [ca.reshape(v.T, f.size1_in(i), f.size2_in(i) * n) for i, v in enumerate(inputs)]
        outputs = dense.map(n).call(given)
        results = [ca.reshape(r, f.numel_out(i), n).T for i, r in enumerate(outputs)]
    return ca.Function(f.name(), inputs, results)


def _walk(f: ca.Function, n: int, inputs: list[ca.MX]) -> list[ca.MX] | None:
    """The instructions on columns; None if there is one that is no operation of one or two numbers."""
    columns = [ca.horzsplit(v) if v.shape[1] > 1 else [v] for v in inputs]
    results: list[list[Any]] = [[None] * f.nnz_out(i) for i in range(f.n_out())]
    slots: dict[int, ca.MX] = {}
    for k in range(f.n_instructions()):
        code, i, o = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if code == ca.OP_CONST:
            slots[o[0]] = ca.MX(f.instruction_constant(k))
        elif code == ca.OP_INPUT:
            slots[o[0]] = columns[i[0]][i[1]]
        elif code == ca.OP_OUTPUT:
            results[o[0]][o[1]] = slots[i[0]]
        elif code == ca.OP_CALL or len(o) != 1 or len(i) not in (1, 2):
            return None
        else:
            operation: Any = ca.MX.unary if len(i) == 1 else ca.MX.binary
            slots[o[0]] = operation(code, *(slots[j] for j in i))
    filled = [[v if v.shape[0] == n else ca.repmat(v, n, 1) for v in values] for values in results]
    return [ca.horzcat(*values) if values else ca.MX(n, 0) for values in filled]


class OnArrays:
    """A dense CasADi function between numpy arrays that stay where they are."""

    def __init__(self, function: ca.Function, inputs: list[Array], outputs: list[Array]) -> None:
        buffer: Any
        buffer, self._evaluate = function.buffer()
        for set_, arrays in ((buffer.set_arg, inputs), (buffer.set_res, outputs)):
            for i, array in enumerate(arrays):
                if array.size:
                    set_(i, memoryview(array.data))
        self._kept = buffer, function, inputs, outputs  # all must live as long as this object

    def __call__(self) -> None:
        """Evaluate the inputs into the outputs."""
        self._evaluate()
