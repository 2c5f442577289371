"""Value and Jacobian of a program in one function, composed by the chain rule.

The graph is cut at its recurrent cells, whose Jacobians are known (:mod:`nn_export.operators.cells`). What lies
between the cuts (features, integrators, read-outs) has few inputs and becomes scalar code with its own
small Jacobian; pieces too large for that keep CasADi's derivatives of the matrix graph. No torch in here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import casadi as ca

from nn_export.build import function, graph
from nn_export.errors import ProgramError
from nn_export.operators import OPERATORS, cells, recurrent
from nn_export.pieces import operations
from nn_export.program import Program

SCALAR_LIMIT = 50_000
"""Scalar operations, times sweeps of differentiation, up to which a piece becomes scalar code."""


def with_jacobian(
    program: Program, blocks: Mapping[str, Sequence[str]] | None = None, name: str | None = None
) -> ca.Function:
    """The program's outputs followed by their Jacobians.

    Args:
        program: What :func:`nn_export.trace` made or :func:`nn_export.load_programs` read.
        blocks: For each Jacobian its name and the inputs it is by, e.g. ``{"A": ("x", "h"), "B": ("u",)}``.
            Default: one, ``"jacobian"``, by all inputs.
        name: Name of the function. Default: ``"with_jacobian"``.

    Returns:
        Function of the program's inputs. Its outputs are the program's and the dense Jacobians: of all
        outputs, one below the other, by the inputs named, side by side. Matrices count column by column,
        as in ``casadi.jacobian``.

    Raises:
        ProgramError: If an input named is not the program's, or as :func:`nn_export.build`.

    Example:
        >>> from nn_export import Node, Port
        >>> node = Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),))
        >>> program = Program((Port("x", (2,)),), (Port("y", (2,), {"node": "tanh"}),), (node,))
        >>> y, slope = with_jacobian(program)([0.0, 1.0])
        >>> slope.full().round(3).tolist()
        [[1.0, 0.0], [0.0, 0.42]]
    """
    inputs = [port.name for port in program.inputs]
    blocks = {"jacobian": inputs} if blocks is None else blocks
    if unknown := sorted({i for names in blocks.values() for i in names} - set(inputs)):
        raise ProgramError(f"no inputs {', '.join(unknown)}; the program has {', '.join(inputs)}")
    chain = _Chain()
    symbols, outputs = graph(program, {**OPERATORS, **recurrent.table(chain.cell)})
    sizes = {name: symbol.numel() for name, symbol in zip(inputs, symbols, strict=True)}
    for symbol in (s for s in symbols if s.numel()):  # CasADi has no empty symbols
        chain.add(symbol, _Known(symbol, {symbol.name(): ca.MX.eye(symbol.numel())}))
    chain.settle()
    results = chain.derive([v.mx for v in outputs])
    stacked = [_stack(results, {i: sizes[i] for i in names}) for names in blocks.values()]
    names = [*(port.name for port in program.outputs), *blocks]
    values = [known.value for known in results]
    return function(name or "with_jacobian", symbols, [*values, *stacked], program, names)


@dataclass(frozen=True)
class _Known:
    """A value and its Jacobians by the inputs that it depends on, by their names."""

    value: ca.MX
    slopes: dict[str, ca.MX]


class _Chain:
    """The cuts of a graph: cells in order, each with its arguments; then what is known of their outputs."""

    def __init__(self) -> None:
        self._cells: list[tuple[list[ca.MX], cells.Kind, ca.MX, cells.State, cells.Weights]] = []
        self._known: dict[str, _Known] = {}

    def cell(self, kind: cells.Kind, x: ca.MX, state: cells.State, w: cells.Weights) -> cells.State:
        """The form of a cell: symbols instead of its results."""
        if not cells.simple(x, w):
            return cells.call(kind, x, state, w)
        number = len(self._cells)
        symbols = [ca.MX.sym(f"cell {number} {s}", kind.width(w)) for s in kind.states]
        self._cells.append((symbols, kind, x, state, w))
        return tuple(symbols)

    def add(self, symbol: ca.MX, known: _Known) -> None:
        """What a symbol stands for."""
        self._known[symbol.name()] = known

    def settle(self) -> None:
        """All cells in order."""
        for symbols, kind, x, state, w in self._cells:
            at_x, *at_state = self.derive([x, *state])
            for symbol, known in zip(symbols, _cell(kind, at_x, at_state, w), strict=True):
                self.add(symbol, known)

    def derive(self, targets: list[ca.MX]) -> list[_Known]:
        """Expressions of the symbols, as values and slopes."""
        known: dict[int, _Known] = {}
        rest = []
        for k, target in enumerate(targets):
            if target.is_symbolic():
                known[k] = self._known[target.name()]
            elif not ca.symvar(target):
                known[k] = _Known(target, {})
            else:
                rest.append(k)
        if rest:
            known |= dict(zip(rest, self._piece([targets[k] for k in rest]), strict=True))
        return [known[k] for k in range(len(targets))]

    def _piece(self, targets: list[ca.MX]) -> list[_Known]:
        symbols = ca.symvar(ca.veccat(*targets))
        arguments = [self._known[s.name()] for s in symbols]
        values, jacobians = _differentiate(symbols, targets, [a.value for a in arguments])
        known = []
        for value, row in zip(values, jacobians, strict=True):
            slopes: dict[str, ca.MX] = {}
            for factor, argument in zip(row, arguments, strict=True):
                for name, slope in argument.slopes.items() if factor.nnz() else ():
                    term = _times(factor, slope)
                    slopes[name] = slopes[name] + term if name in slopes else term
            known.append(_Known(value, slopes))
        return known


def _differentiate(
    symbols: list[ca.MX], targets: list[ca.MX], arguments: list[ca.MX]
) -> tuple[list[ca.MX], list[list[ca.MX]]]:
    """Targets and their Jacobians by each symbol, at the arguments."""
    piece = ca.Function("piece", symbols, targets)
    n, rows, columns = len(targets), _edges(targets), _edges(symbols)
    scalar = operations(piece) * min(rows[-1], columns[-1]) <= SCALAR_LIMIT
    inner: list[Any] = [(ca.SX if scalar else ca.MX).sym("v", *s.shape) for s in symbols]
    values = piece.call(inner, True, False)
    whole = ca.jacobian(ca.veccat(*values), ca.veccat(*inner))
    parts = [[whole[a:b, c:d] for c, d in pairwise(columns)] for a, b in pairwise(rows)]
    flat = [part for row in parts for part in row]
    results = ca.Function("piece", inner, [*values, *flat]).call(arguments, not scalar, False)
    blocks = [ca.MX.eye(p.size1()) if p.is_eye() else b for p, b in zip(flat, results[n:], strict=True)]
    return results[:n], [blocks[i * len(symbols) : (i + 1) * len(symbols)] for i in range(n)]


def _edges(parts: list[ca.MX]) -> list[int]:
    return list(accumulate((p.numel() for p in parts), initial=0))


def _cell(kind: cells.Kind, x: _Known, state: list[_Known], w: cells.Weights) -> list[_Known]:
    at = kind.step(x.value, tuple(s.value for s in state), w)
    gates = len(at.slopes[0].by_input)
    slopes: list[dict[str, ca.MX]] = [{} for _ in at.state]

    def add(k: int, name: str, term: ca.MX) -> None:
        slopes[k][name] = slopes[k][name] + term if name in slopes[k] else term

    for hidden, known, weight in ((False, x, w[0]), (True, state[0], w[1])):
        blocks = cells.rows(weight, gates) if known.slopes else []
        for name, slope in known.slopes.items():
            products = [_times(block, slope) for block in blocks]
            for k, by in enumerate(at.slopes):
                add(k, name, cells.scaled(by.by_hidden if hidden else by.by_input, products))
    for k, by in enumerate(at.slopes):
        for old, diagonal in by.diagonal.items():
            for name, slope in state[old].slopes.items():
                whole = ca.repmat(diagonal, 1, slope.shape[1])
                add(k, name, ca.diag(diagonal) if slope.is_eye() else whole * slope)
    return [_Known(value, s) for value, s in zip(at.state, slopes, strict=True)]


def _times(a: ca.MX, b: ca.MX) -> ca.MX:
    return b if a.is_eye() else a if b.is_eye() else ca.mtimes(a, b)


def _stack(results: list[_Known], sizes: dict[str, int]) -> ca.MX:
    """Dense Jacobian of all results by some inputs; written into place, which is faster than joining."""
    matrix = ca.MX(ca.DM.zeros(sum(k.value.numel() for k in results), sum(sizes.values())))
    row = 0
    for known in results:
        column, below = 0, row + known.value.numel()
        for name, size in sizes.items():
            if name in known.slopes and size:
                matrix[row:below, column : column + size] = ca.densify(known.slopes[name])
            column += size
        row = below
    return matrix
