"""Program to CasADi: no torch in here."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import casadi as ca

from nn_export.budget import Budget, Limits, check_arguments, place, resolve
from nn_export.chain import Chain, operations
from nn_export.errors import ProgramError, ShapeError, last_line
from nn_export.operators import OPERATORS, PLAIN, cells, recurrent
from nn_export.operators.value import Value, constant, matrix_shape
from nn_export.program import Node, Program

_IDENTIFIER = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")
_BAD_NAME = "{!r} is no name for CasADi: use letters, digits and single underscores [NN-111]"


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
    """The program as a CasADi function of MX with the program's names and dense inputs and outputs.

    A tensor of shape (n,) becomes n x 1, (r, c) becomes r x c; axes of size 1 are dropped.

    Args:
        program: What :func:`nn_export.trace` made or :func:`nn_export.load_programs` read.
        name: Name of the function. Default: ``"program"``.
        plain: One graph of matrices, all derivatives by CasADi. Default: each recurrent cell is a call of a
            function that brings its exact Jacobian, and small parts between are scalar code: both values
            and derivatives are faster.
        limits: What it may cost; more is refused before anything is built. Default: :class:`nn_export.Limits`.

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
        chain = _Calls(budget)
        symbols, values = graph(program, {**OPERATORS, **recurrent.table(chain.cell)}, budget)
        for symbol in (s for s in symbols if s.numel()):  # CasADi has no empty symbols
            chain.add(symbol, symbol)
        chain.settle()
        return function(name, symbols, chain.derive([v.mx for v in values]), program, outputs)


@contextmanager
def named(name: str) -> Iterator[None]:
    """CasADi's errors, and a lack of memory, as errors of the program."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        raise ProgramError(f"{name}: CasADi cannot build it: {last_line(error)} [NN-038]") from error


def graph(
    program: Program, table: Mapping[str, Callable[..., Any]], budget: Budget
) -> tuple[list[ca.MX], list[Value]]:
    """Symbols of the inputs and values of the outputs, with the operators of a table.

    The program must be within the budget.
    """
    budget.add(program)
    values: dict[tuple[str, str], Any] = {}
    symbols = []
    for port in program.inputs:
        if not valid_name(port.name):
            raise ProgramError(_BAD_NAME.format(port.name))
        symbols.append(ca.MX.sym(port.name, *_size(f"input {port.name}", port.shape)))
        values["input", port.name] = Value(port.shape, symbols[-1])
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
                f"output {port.name}: {port.source} does not have the shape {port.shape}; export again [NN-039]"
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
        raise ProgramError(f"CasADi refuses the function: {error} [NN-040]") from error


def _size(what: str, shape: tuple[int, ...]) -> tuple[int, int]:
    try:
        return matrix_shape(shape)
    except ShapeError as error:
        raise ShapeError(f"{what}: {error}") from error


def _evaluate(node: Node, values: dict[tuple[str, str], Any], table: Mapping[str, Callable[..., Any]]) -> Any:
    try:
        args, kwargs = resolve(node.args, values), resolve(node.kwargs, values)
        check_arguments(node.op, args, kwargs)
        result = table[node.op](*args, **kwargs)
        given = tuple(v.shape for v in (result if isinstance(result, tuple) else (result,)))
    except ShapeError as error:
        raise ShapeError(f"{place(node)}: {error}") from error
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RuntimeError) as error:
        raise ProgramError(
            f"{place(node)}: arguments that nn_export does not support: {error} [NN-041]"
        ) from error
    except (NotImplementedError, MemoryError) as error:
        raise ProgramError(f"{place(node)}: cannot be built: {error} [NN-042]") from error
    if given != node.shapes:
        raise ProgramError(
            f"{place(node)}: gives shapes {given}, but the program declares {node.shapes}; export again [NN-043]"
        )
    return result


PIECE_LIMIT = 3000
"""Scalar operations up to which a piece becomes scalar code: dense layers are faster as matrices."""


class _Calls(Chain[ca.MX]):
    """Values alone: cells are calls, what lies between them becomes scalar code where small."""

    def _constant(self, target: ca.MX) -> ca.MX:
        return target

    def _piece(self, symbols: list[ca.MX], targets: list[ca.MX], arguments: list[ca.MX]) -> list[ca.MX]:
        piece = ca.Function("piece", symbols, targets)
        scalar = operations(piece) <= PIECE_LIMIT
        results: list[ca.MX] = (piece.expand() if scalar else piece).call(arguments, not scalar, False)
        return results

    def _after(
        self, symbols: list[ca.MX], kind: cells.Kind, x: ca.MX, state: list[ca.MX], w: cells.Weights
    ) -> list[ca.MX]:
        return list(cells.call(kind, x, tuple(state), w))
