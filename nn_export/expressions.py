"""CasADi functions of scalar operations as programs: what a user writes as an expression, kept as plain data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca

from nn_export.budget import EACH_OPERATOR, Budget, Limits
from nn_export.errors import ProgramError, SignatureError, UnsupportedOperatorError, last_line
from nn_export.graph import build
from nn_export.program import Node, Port, Program

_NAMES = {code: name for name, code in vars(ca).items() if name.startswith("OP_")}
_SAME = (ca.OP_ASSIGN, ca.OP_LIFT)
"""Operations that give their first argument."""
_COMMUTATIVE = {
    ca.OP_ADD, ca.OP_MUL, ca.OP_EQ, ca.OP_NE, ca.OP_FMIN, ca.OP_FMAX, ca.OP_AND, ca.OP_OR, ca.OP_HYPOT
}  # fmt: skip
"""Operations of which CasADi writes a number first when it builds them; so do programs, to be the same again."""
_OPERATORS: dict[int, str] = {
    ca.OP_ADD: "add.Tensor", ca.OP_SUB: "sub.Tensor", ca.OP_MUL: "mul.Tensor", ca.OP_DIV: "div.Tensor",
    ca.OP_POW: "pow.Tensor_Tensor", ca.OP_CONSTPOW: "pow.Tensor_Scalar", ca.OP_FMOD: "fmod.Tensor",
    ca.OP_LT: "lt.Tensor", ca.OP_LE: "le.Tensor", ca.OP_EQ: "eq.Tensor", ca.OP_NE: "ne.Tensor",
    **{getattr(ca, f"OP_{name.upper()}"): f"{name}.default" for name in (
        "neg", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh",
        "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "hypot", "sign", "floor", "ceil",
    )},
    ca.OP_SQ: "square.default", ca.OP_INV: "reciprocal.default", ca.OP_FABS: "abs.default",
    ca.OP_FMIN: "minimum.default", ca.OP_FMAX: "maximum.default", ca.OP_COPYSIGN: "copysign.Tensor",
    ca.OP_AND: "logical_and.default", ca.OP_OR: "logical_or.default",
}  # fmt: skip
"""What stands for an operation with the same arguments in the same order."""

PASSES = 4
"""CasADi simplifies as it builds, e.g. ``(-a)**2``; so often it is asked whether it finds more. It rarely does once."""


@dataclass(frozen=True)
class Step:
    """One scalar operation (CasADi's ``code``) of a function: values are numbered registers, which are used again.

    ``taken`` are registers; for an input ``(input, nonzero)``, for a constant its value alone. ``given`` is a
    register; for an output ``(output, nonzero)``.
    """

    code: int
    taken: tuple[Any, ...]
    given: Any


def scalar_steps(function: ca.Function, most: int) -> list[Step]:
    """The function as scalar operations, one after the other."""
    # An estimate first: a dense network is not written out in scalars to be counted.
    if scalar_size(function) <= 4 * most:
        calls = ", ".join(dict.fromkeys(_without_form(function)))
        try:
            f = function.expand()
        except RuntimeError as error:
            calls = calls or last_line(error)
        if calls:
            raise UnsupportedOperatorError(
                f"{function.name()}: {calls} cannot be written in scalar operations; use scalar operations only "
                "[NN-024]"
            )
        if f.n_instructions() <= most:
            return [_step(f, k) for k in range(f.n_instructions())]
    raise ProgramError(
        f"{function.name()}: more than {most} scalar operations; use fewer, or export a network as a module [NN-025]"
    )


def _step(f: ca.Function, k: int) -> Step:
    code, taken, given = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
    if code == ca.OP_CONST:
        return Step(code, (f.instruction_constant(k),), given[0])
    return Step(code, tuple(taken), tuple(given) if code == ca.OP_OUTPUT else given[0])


def scalar_size(f: ca.Function) -> float:
    """Scalar operations of a function, about; 0 for what has none.

    Example:
        >>> a, b = ca.MX.sym("a", 3, 4), ca.MX.sym("b", 4)
        >>> scalar_size(ca.Function("f", [a, b], [a @ b]))
        27.0
    """
    if not f.is_a("MXFunction"):
        return float(f.n_instructions()) if f.is_a("SXFunction") else 0.0
    total = 0.0
    for k in range(f.n_instructions()):
        code = f.instruction_id(k)
        if code not in (ca.OP_INPUT, ca.OP_OUTPUT):
            node = f.instruction_MX(k)
            inner = 2.0 * node.dep(1).size2() if code == ca.OP_MTIMES else 1.0
            total += scalar_size(node.which_function()) if code == ca.OP_CALL else node.nnz() * inner
    return total


def _without_form(f: ca.Function) -> Iterator[str]:
    """Names of what a function calls that is neither a graph of matrices nor of scalars."""
    if f.is_a("MXFunction"):
        for k in range(f.n_instructions()):
            if f.instruction_id(k) == ca.OP_CALL:
                yield from _without_form(f.instruction_MX(k).which_function())
    elif not f.is_a("SXFunction"):
        yield f"{f.name()} ({f.class_name()})"


def program_of(function: ca.Function, limits: Limits | None = None) -> Program:
    """A function as a program of scalar operators: plain data, which :func:`nn_export.build` makes a function again.

    For expressions of some dozen or hundred operations, as people write them; a network is exported as a module
    (:func:`nn_export.trace`), which keeps its matrices. What is built of the program gives the same program again.

    Args:
        function: A CasADi function of SX or MX.
        limits: What the program may cost. Default: :class:`nn_export.Limits`, as for :func:`nn_export.build`.

    Returns:
        The program, with the function's names; its inputs and outputs are dense.

    Raises:
        SignatureError: If it is no CasADi function, or depends on symbols that are no inputs of it.
        UnsupportedOperatorError: If an operation cannot be stated, by its name.
        ProgramError: If it would cost more than the limits.

    Example:
        >>> x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
        >>> power = program_of(ca.Function("power", [x, u], [u * x[1]], ["x", "u"], ["p"]))
        >>> [node.op for node in power.nodes]
        ['aten.select.int', 'aten.select.int', 'aten.mul.Tensor', 'aten.stack.default']
    """
    if not isinstance(function, ca.Function):
        raise SignatureError(
            f"program_of: a casadi.Function is needed, got {type(function).__name__} [NN-026]"
        )
    if function.has_free():
        raise SignatureError(
            f"program_of: {function.name()} depends on {', '.join(function.get_free())}; make them inputs [NN-027]"
        )
    limits = Limits() if limits is None else limits
    program = _written(function, limits)
    for _ in range(PASSES):
        again = _written(build(program, limits=limits), limits)
        if again == program:
            break
        program = again
    return program


def _written(function: ca.Function, limits: Limits) -> Program:
    writer = _Writer(function)
    for step in scalar_steps(function, limits.nodes // EACH_OPERATOR):
        writer.take(step)
    program = writer.program()
    Budget(limits).add(program, f"{function.name()}: ")
    return program


class _Writer:
    """A program as it is written, a scalar operation after the other."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._nodes: list[Node] = []
        self._registers: dict[int, Any] = {}
        self._elements: dict[tuple[int, int], Any] = {}
        self._results: dict[tuple[int, int], Any] = {}

    def take(self, step: Step) -> None:
        """One operation more."""
        code, taken = step.code, step.taken
        if code == ca.OP_OUTPUT:
            self._results[step.given] = self._registers[taken[0]]
        elif code == ca.OP_CONST:
            self._registers[step.given] = _number(taken[0])
        elif code == ca.OP_INPUT:
            self._registers[step.given] = self._element(taken)
        else:
            self._registers[step.given] = self._operation(code, [self._registers[i] for i in taken])

    def _operation(self, code: int, args: list[Any]) -> Any:
        if code in _SAME:
            return args[0]
        if code == ca.OP_TWICE:
            return self._node("aten.add.Tensor", [args[0], args[0]])
        if code == ca.OP_NOT:  # what CasADi itself makes of it when the program is built
            return self._node("aten.eq.Tensor", [0.0, args[0]])
        if code == ca.OP_IF_ELSE_ZERO:
            return self._node("aten.where.self", [*args, 0.0])
        if code not in _OPERATORS:
            raise UnsupportedOperatorError(
                f"{self._function.name()}: {_NAMES.get(code, code)} is not supported; use other operations [NN-028]"
            )
        if code in _COMMUTATIVE and not _is_reference(args[1]):
            args = args[::-1]
        return self._node(f"aten.{_OPERATORS[code]}", args)

    def _element(self, place: tuple[int, int]) -> Any:
        """One nonzero of an input."""
        if place not in self._elements:
            port, k = place
            sparsity = self._function.sparsity_in(port)
            found: Any = {"input": self._function.name_in(port)}
            shape = _shape(sparsity)
            for index in (sparsity.row(k), sparsity.get_col()[k])[: len(shape)]:
                shape = shape[1:]
                found = self._node("aten.select.int", [found, 0, index], shape)
            self._elements[place] = found
        return self._elements[place]

    def _node(self, op: str, args: list[Any], shape: tuple[int, ...] = ()) -> dict[str, str]:
        name = f"n{len(self._nodes)}"
        self._nodes.append(Node(name, op, args, {}, (shape,)))
        return {"node": name}

    def _output(self, port: int) -> dict[str, str]:
        """All elements of an output joined, row by row."""
        sparsity = self._function.sparsity_out(port)
        shape, rows, columns = _shape(sparsity), *sparsity.shape
        at = {(row, column): k for k, (row, column) in enumerate(zip(*sparsity.get_triplet(), strict=True))}
        values = [
            self._results.get((port, at.get((row, column), -1)), 0.0)  # a structural zero has no result
            for row in range(rows)
            for column in range(columns)
        ]
        if not values:
            return self._node("aten.full.default", [list(shape), 0.0], shape)
        tensors = [v if _is_reference(v) else self._node("aten.scalar_tensor.default", [v]) for v in values]
        joined = self._node("aten.stack.default", [tensors], (len(tensors),))
        return joined if len(shape) == 1 else self._node("aten.view.default", [joined, list(shape)], shape)

    def program(self) -> Program:
        """What was written."""
        f = self._function
        inputs = tuple(Port(f.name_in(i), _shape(f.sparsity_in(i))) for i in range(f.n_in()))
        outputs = tuple(
            Port(f.name_out(i), _shape(f.sparsity_out(i)), self._output(i)) for i in range(f.n_out())
        )
        return Program(inputs, outputs, tuple(self._nodes))


def _shape(sparsity: ca.Sparsity) -> tuple[int, ...]:
    rows, columns = sparsity.shape
    return (rows,) if columns == 1 else (rows, columns)


def _number(value: float) -> Any:
    return value if math.isfinite(value) else {"float": str(value)}


def _is_reference(value: Any) -> bool:
    return isinstance(value, dict) and "node" in value
