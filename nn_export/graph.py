"""Program to CasADi: no torch in here."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import casadi as ca

from nn_export.budget import Budget, Limits, place, resolve
from nn_export.errors import ProgramError, ShapeError, last_line
from nn_export.operators import OPERATORS, PLAIN, cells, recurrent
from nn_export.operators.value import Value, constant, matrix_shape
from nn_export.program import Node, Program

_IDENTIFIER = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")
_BAD_NAME = "{!r} is no name for CasADi: use letters, digits and single underscores"


def valid_name(name: str) -> bool:
    """True if CasADi takes the name.

    Example:
        >>> valid_name("x_next"), valid_name("x next"), valid_name("a__b")
        (True, False, False)
    """
    return _IDENTIFIER.fullmatch(name) is not None and name not in ("null", "jac", "hess")


def build(
    program: Program, name: str | None = None, *, plain: bool = False, limits: Limits | None = None
) -> ca.Function:
    """The program as a CasADi function of MX with the program's names.

    A tensor of shape (n,) becomes n x 1, (r, c) becomes r x c; axes of size 1 are dropped.

    Args:
        program: What :func:`nn_export.trace` made or :func:`nn_export.load_programs` read.
        name: Name of the function. Default: ``"program"``.
        plain: One graph of matrices, all derivatives by CasADi. Default: each recurrent cell is a call of a
            function that brings its exact Jacobian, and small parts between are scalar code: both values
            and derivatives are faster.
        limits: What it may cost; more is refused before anything is built. Default: :class:`nn_export.Limits`.

    Returns:
        Function with dense inputs and outputs.

    Raises:
        ProgramError: If it would cost more than the limits, an operator gets arguments it does not know, or a result
            has another shape than the program says: the message names the node and the line of the module.

    Example:
        >>> from nn_export import Node, Port
        >>> node = Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),))
        >>> build(Program((Port("x", (2,)),), (Port("y", (2,), {"node": "tanh"}),), (node,)))
        Function(program:(x[2])->(y[2]) MXFunction)
    """
    name = "program" if name is None else name
    outputs, budget = [p.name for p in program.outputs], Budget(limits)
    with named(name):
        if plain:
            symbols, values = graph(program, PLAIN, budget)
            return function(name, symbols, [v.mx for v in values], program, outputs)
        pieces = Pieces()
        symbols, values = graph(program, {**OPERATORS, **recurrent.table(pieces.cell)}, budget, pieces)
        return function(name, symbols, pieces.evaluate([v.mx for v in values]), program, outputs)


@contextmanager
def named(name: str) -> Iterator[None]:
    """CasADi's errors, and a lack of memory, as errors of the program."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        raise ProgramError(f"{name}: CasADi cannot build it: {last_line(error)}") from error


def graph(
    program: Program, table: Mapping[str, Callable[..., Any]], budget: Budget, pieces: Pieces | None = None
) -> tuple[list[ca.MX], list[Value]]:
    """Symbols of the inputs and values of the outputs, with the operators of a table.

    The program must be within the budget. The pieces, if given, are told the inputs before the first operator.
    """
    budget.add(program)
    values: dict[tuple[str, str], Any] = {}
    symbols = []
    for port in program.inputs:
        if not valid_name(port.name):
            raise ProgramError(_BAD_NAME.format(port.name))
        symbols.append(ca.MX.sym(port.name, *_size(f"input {port.name}", port.shape)))
        values["input", port.name] = Value(port.shape, symbols[-1])
        if pieces is not None and symbols[-1].numel():
            pieces.add(symbols[-1], symbols[-1])
    for weight, array in program.weights.items():
        values["weight", weight] = constant(array)
    for node in program.nodes:
        values["node", node.name] = _evaluate(node, values, table)
    results = []
    for port in program.outputs:
        value = resolve(port.source, values)
        _size(f"output {port.name}", port.shape)
        if not isinstance(value, Value) or value.shape != port.shape:
            raise ProgramError(
                f"output {port.name}: {port.source} has not its shape {port.shape}; export again"
            )
        results.append(value)
    return symbols, results


def function(
    name: str, symbols: list[ca.MX], results: list[ca.MX], program: Program, outputs: list[str]
) -> ca.Function:
    """A function of the program's inputs."""
    for text in (name, *outputs):
        if not valid_name(text):
            raise ProgramError(_BAD_NAME.format(text))
    names = [p.name for p in program.inputs], outputs
    try:
        return ca.Function(name, symbols, results, *names, {"allow_duplicate_io_names": True})
    except RuntimeError as error:
        raise ProgramError(f"CasADi refuses the function: {error}") from error


def _size(what: str, shape: tuple[int, ...]) -> tuple[int, int]:
    try:
        return matrix_shape(shape)
    except ShapeError as error:
        raise ShapeError(f"{what}: {error}") from error


def _evaluate(node: Node, values: dict[tuple[str, str], Any], table: Mapping[str, Callable[..., Any]]) -> Any:
    try:
        args, kwargs = resolve(node.args, values), resolve(node.kwargs, values)
        result = table[node.op](*args, **kwargs)
        given = tuple(v.shape for v in (result if isinstance(result, tuple) else (result,)))
    except ShapeError as error:
        raise ShapeError(f"{place(node)}: {error}") from error
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RuntimeError) as error:
        raise ProgramError(f"{place(node)}: arguments that nn_export does not know: {error}") from error
    except (NotImplementedError, MemoryError) as error:
        raise ProgramError(f"{place(node)}: cannot be built: {error}") from error
    if given != node.shapes:
        raise ProgramError(
            f"{place(node)}: gives shapes {given}, the program says {node.shapes}; export again"
        )
    return result


PIECE_LIMIT = 3000
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
            scalar = operations(piece) <= PIECE_LIMIT
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
