"""Parts of a matrix graph as scalar code, faster to evaluate and differentiate while they are small."""

from __future__ import annotations

import math

import casadi as ca

from nn_export.operators import cells

SCALAR_LIMIT = 3000
"""Scalar operations up to which a piece becomes scalar code: dense layers are faster as matrices."""


class Pieces:
    """Evaluates expressions of cut symbols: what lies between recurrent cells becomes scalar code where small.

    Example:
        >>> pieces, x = Pieces(), ca.MX.sym("x", 2)
        >>> pieces.add(x, x)
        >>> pieces.evaluate([ca.sin(x)])[0].shape
        (2, 1)
    """

    def __init__(self) -> None:
        self._values: dict[str, ca.MX] = {}

    def add(self, symbol: ca.MX, value: ca.MX) -> None:
        """What a symbol stands for."""
        self._values[symbol.name()] = value

    def cell(self, kind: cells.Kind, x: ca.MX, state: cells.State, w: cells.Weights) -> cells.State:
        """The form of a cell: symbols that stand for the results of its call."""
        if not cells.simple(x, w):
            return cells.call(kind, x, state, w)
        at_x, *at_state = self.evaluate([x, *state])
        symbols = []
        for value in cells.call(kind, at_x, tuple(at_state), w):
            symbols.append(ca.MX.sym(f"cell {len(self._values)}", value.shape[0]))
            self.add(symbols[-1], value)
        return tuple(symbols)

    def evaluate(self, targets: list[ca.MX]) -> list[ca.MX]:
        """Expressions of the symbols at what these stand for."""
        moved = [k for k, t in enumerate(targets) if ca.symvar(t) and not t.is_symbolic()]
        values = [self._values[t.name()] if t.is_symbolic() else t for t in targets]
        if moved:
            symbols = ca.symvar(ca.veccat(*(targets[k] for k in moved)))
            piece = ca.Function("piece", symbols, [targets[k] for k in moved])
            scalar = operations(piece) <= SCALAR_LIMIT
            arguments = [self._values[s.name()] for s in symbols]
            results = (piece.expand() if scalar else piece).call(arguments, not scalar, False)
            for k, value in zip(moved, results, strict=True):
                values[k] = value
        return values


def operations(f: ca.Function) -> float:
    """Scalar operations of a matrix graph, about; infinite if it calls other functions."""
    total = 0
    for k in range(f.n_instructions()):
        kind = f.instruction_id(k)
        if kind == ca.OP_CALL:
            return math.inf
        if kind not in (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST):
            node = f.instruction_MX(k)
            total += node.numel() * (2 * node.dep(1).size2() if kind == ca.OP_MTIMES else 1)
    return total
