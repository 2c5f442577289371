"""Value and Jacobian of a program in one function, composed by the chain rule.

The graph is cut at its recurrent cells, whose Jacobians are known (:mod:`nn_export.operators.cells`). What lies
between the cuts (features, integrators, read-outs) has few inputs and becomes scalar code with its own
small Jacobian; pieces too large for that keep CasADi's derivatives of the matrix graph. No torch in here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from nn_export.budget import NUMBER, Budget, Limits
from nn_export.chain import Chain, Piece, differentiated
from nn_export.errors import ProgramError
from nn_export.graph import function, graph, named
from nn_export.operators import OPERATORS, cells, recurrent
from nn_export.operators.value import Value
from nn_export.program import Program


def with_jacobian(
    program: Program,
    blocks: Mapping[str, Sequence[str]] | None = None,
    name: str | None = None,
    *,
    limits: Limits | None = None,
) -> ca.Function:
    """The program's outputs followed by their Jacobians.

    Args:
        program: What :func:`nn_export.trace` made or :func:`nn_export.load_programs` read.
        blocks: For each Jacobian its name and the inputs it is by, e.g. ``{"A": ("x", "h"), "B": ("u",)}``.
            Default: one, ``"jacobian"``, by all inputs.
        name: Name of the function. Default: ``"with_jacobian"``.
        limits: What it may cost with its Jacobians. Default: :class:`nn_export.Limits`.

    Returns:
        Function of the program's inputs. Its outputs are the program's and the dense Jacobians: of all
        outputs, one below the other, by the inputs named, side by side. Matrices count column by column,
        as in ``casadi.jacobian``.

    Raises:
        ProgramError: If an input named is not the program's, the Jacobians would cost more than the limits, or as
            :func:`nn_export.build`.

    Example:
        >>> from nn_export import Node, Port
        >>> node = Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),))
        >>> program = Program((Port("x", (2,)),), (Port("y", (2,), {"node": "tanh"}),), (node,))
        >>> y, slope = with_jacobian(program)([0.0, 1.0])
        >>> slope.full().round(3).tolist()
        [[1.0, 0.0], [0.0, 0.42]]
    """
    blocks, name = checked_blocks(program, blocks), name or "with_jacobian"
    inputs, wanted = [port.name for port in program.inputs], {i for names in blocks.values() for i in names}
    with named(name):
        chain = _Chain(budget := Budget(limits))
        symbols, outputs = graph(program, {**OPERATORS, **recurrent.table(chain.cell)}, budget)
        sizes = {name: symbol.numel() for name, symbol in zip(inputs, symbols, strict=True)}
        spend_results(budget, outputs, blocks, sizes)
        budget.spend("the slopes of the inputs", memory=4 * NUMBER * sum(sizes.values()))  # sparse identities
        for symbol in (s for s in symbols if s.numel()):  # CasADi has no empty symbols
            slopes = {symbol.name(): ca.MX.eye(symbol.numel())} if symbol.name() in wanted else {}
            chain.add(symbol, _Known(symbol, slopes))
        chain.settle()
        results = chain.derive([v.mx for v in outputs])
        stacked = [_stack(results, {i: sizes[i] for i in names}) for names in blocks.values()]
        names = [*(port.name for port in program.outputs), *blocks]
        values = [known.value for known in results]
        return function(name, symbols, [*values, *stacked], program, names)


def checked_blocks(
    program: Program, blocks: Mapping[str, Sequence[str]] | None
) -> Mapping[str, Sequence[str]]:
    """The Jacobians asked for, by default one by all inputs; ProgramError if one is by an input that there is not."""
    inputs = [port.name for port in program.inputs]
    blocks = {"jacobian": inputs} if blocks is None else blocks
    if unknown := sorted({i for names in blocks.values() for i in names} - set(inputs)):
        raise ProgramError(f"no inputs {', '.join(unknown)}; the program has {', '.join(inputs)} [NN-050]")
    return blocks


def spend_results(
    budget: Budget, outputs: Sequence[Value], blocks: Mapping[str, Sequence[str]], sizes: Mapping[str, int]
) -> None:
    """Take off what the dense Jacobians of all outputs cost."""
    rows = sum(v.mx.numel() for v in outputs)
    for block, names in blocks.items():
        count = rows * sum(sizes[name] for name in names)
        nodes = 8 * len(outputs) * len(names)
        budget.spend(f"the Jacobian {block}", elements=count, memory=NUMBER * count, nodes=nodes)


@dataclass(frozen=True)
class _Known:
    """A value and its Jacobians by the inputs that it depends on, by their names."""

    value: ca.MX
    slopes: dict[str, ca.MX]


class _Chain(Chain[_Known]):
    """Values and slopes as graphs of MX."""

    def _constant(self, target: ca.MX) -> _Known:
        return _Known(target, {})

    def _piece(self, symbols: list[ca.MX], targets: list[ca.MX], arguments: list[_Known]) -> list[_Known]:
        piece = differentiated(symbols, targets, [bool(a.slopes) for a in arguments], self.budget)
        values, jacobians = _evaluated(piece, [a.value for a in arguments])
        known = []
        for value, row in zip(values, jacobians, strict=True):
            slopes: dict[str, ca.MX] = {}
            for factor, argument in zip(row, arguments, strict=True):
                for name, slope in argument.slopes.items() if factor.nnz() else ():
                    term = _times(factor, slope)
                    slopes[name] = slopes[name] + term if name in slopes else term
            known.append(_Known(value, slopes))
        return known

    def _after(
        self, symbols: list[ca.MX], kind: cells.Kind, x: _Known, state: list[_Known], w: cells.Weights
    ) -> list[_Known]:
        self.spend(symbols, [x.slopes, *(s.slopes for s in state)])
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
                    matrix: Any = ca.diag(diagonal)
                    whole = ca.repmat(diagonal, 1, slope.shape[1])
                    add(k, name, matrix if slope.is_eye() else whole * slope)
        return [_Known(value, s) for value, s in zip(at.state, slopes, strict=True)]


def _evaluated(piece: Piece, arguments: list[ca.MX]) -> tuple[list[ca.MX], list[list[ca.MX]]]:
    """A piece and its Jacobians at the arguments."""
    n, m = len(piece.values), len(arguments)
    flat = [block for row in piece.blocks for block in row]
    function = ca.Function("piece", piece.inner, [*piece.values, *flat])
    results = function.call(arguments, not piece.scalar, False)
    blocks = [ca.MX.eye(p.size1()) if p.is_eye() else b for p, b in zip(flat, results[n:], strict=True)]
    return results[:n], [blocks[i * m : (i + 1) * m] for i in range(n)]


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
