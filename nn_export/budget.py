"""What a program may cost: counted from the shapes that it declares, before anything is built."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from nn_export.errors import ProgramError
from nn_export.operators import OPERATORS, recurrent
from nn_export.operators.value import Value, size_of

if TYPE_CHECKING:
    from nn_export.program import Node, Program

NUMBER = 8
"""Bytes of a number."""
EACH_PROGRAM, EACH_PORT, EACH_OPERATOR, EACH_STEP = 500, 12, 12, 600
"""Nodes that a function, a symbol or constant, an operator, and a step of a recurrent layer count for: one takes some 5
microseconds."""


@dataclass(frozen=True)
class Limits:
    """What programs may cost; what costs more is refused.

    The defaults leave room for networks of a thousand hidden units and for artifacts of some dozen programs; to build
    all that they allow takes some ten seconds and a gigabyte. Raise one for a larger network, if you know where it is
    from.

    Args:
        json_bytes: Bytes of ``programs.json``. Default: 16 MiB.
        elements: Numbers in one value. Default: 2**22, a matrix of 2048 x 2048.
        memory: Bytes of all constants and results of a program, of a folder's programs together. Default: 512 MiB.
        work: Elements touched by the sweeps that make Jacobians. Default: 2**30.
        nodes: Operations of CasADi's graph, of a folder's programs together. An operator counts for 12, a step of a
            recurrent layer for 600. Default: 2**20.

    Example:
        >>> Limits(elements=2**24).elements
        16777216
    """

    json_bytes: int = 2**24
    elements: int = 2**22
    memory: int = 2**29
    work: int = 2**30
    nodes: int = 2**20


_MEASURES = {
    "elements": "numbers in one value",
    "memory": "bytes of constants and results",
    "work": "elements to be touched",
    "nodes": "operations of CasADi's graph",
}


class Budget:
    """What is left of limits."""

    def __init__(self, limits: Limits | None = None) -> None:
        self.limits = Limits() if limits is None else limits
        self._spent = dict.fromkeys(_MEASURES, 0)

    def spend(self, what: str, *, elements: int = 0, memory: int = 0, work: int = 0, nodes: int = 0) -> None:
        """Take off what something costs.

        Raises:
            ProgramError: If there is not as much left.
        """
        spent, limits = self._spent, self.limits
        spent["memory"] += memory
        spent["work"] += work
        spent["nodes"] += nodes
        if (
            elements <= limits.elements
            and spent["memory"] <= limits.memory
            and spent["work"] <= limits.work
            and spent["nodes"] <= limits.nodes
        ):
            return
        cost = {"elements": elements, "memory": memory, "work": work, "nodes": nodes}
        totals = {**spent, "elements": elements}
        measure = next(m for m in _MEASURES if totals[m] > getattr(limits, m))
        earlier = totals[measure] - cost[measure]
        raise ProgramError(
            f"{what} needs {_count(cost[measure])} {_MEASURES[measure]}"
            + (f" with {_count(earlier)} before it" if earlier else "")
            + (
                f", the limit is {_count(getattr(limits, measure))}; if you trust the source of the file, raise the "
                f"limit: limits=nn_export.Limits({measure}=...) [NN-112]"
            )
        )

    def add(self, program: Program, where: str = "") -> None:
        """Take off what a program costs as a function."""
        self.check_count(len(program.nodes), where)
        ports = [(f"input {port.name}", port.shape) for port in program.inputs]
        ports += [(f"weight {name}", array.shape) for name, array in program.weights.items()]
        self.spend(
            f"{where}the program", nodes=EACH_PROGRAM + EACH_PORT * (len(ports) + len(program.outputs))
        )
        for what, shape in ports:
            size = size_of(shape)
            self.spend(f"{where}{what}", elements=size, memory=NUMBER * size)
        for node in program.nodes:
            sizes = [size_of(shape) for shape in node.shapes]
            steps = size_of(node.shapes[0][:-1]) if node.op in recurrent.OPERATORS and node.shapes else 0
            self.spend(
                f"{where}{place(node)}", elements=max(sizes, default=0), memory=NUMBER * sum(sizes),
                nodes=EACH_OPERATOR + EACH_STEP * steps,
            )  # fmt: skip

    def check_count(self, operators: int, where: str = "") -> None:
        """Refuse a number of operators that is too large whatever they are."""
        if EACH_OPERATOR * operators > self.limits.nodes:
            Budget(self.limits).spend(f"{where}{operators} operators", nodes=EACH_OPERATOR * operators)


def _count(n: int) -> str:
    return str(n) if n < 10**7 else f"{n:.3g}"


def place(node: Node) -> str:
    """Where an operator stands, for messages."""
    return f"node {node.name:.80} ({node.op})" + (f" from {node.line:.200}" if node.line else "")


def resolve(data: Any, values: Mapping[tuple[str, str], Any]) -> Any:
    """Arguments of a node with values in the place of references, and numbers in that of ``{"float": "inf"}``."""
    if type(data) is list:
        return [resolve(item, values) if type(item) in (dict, list) else item for item in data]
    if type(data) is dict:
        if len(data) != 1:
            return {key: resolve(value, values) for key, value in data.items()}
        key, value = next(iter(data.items()))
        if key == "float":
            return float(value)
        known = isinstance(value, str) and (key, value) in values
        return values[key, value] if known else {key: resolve(value, values)}
    return data


def check_arguments(op: str, args: list[Any], kwargs: dict[str, Any]) -> None:
    """Refuse arguments that are not of the types of the operator's signature.

    No operator has to think of a list where a number belongs: it would be repeated to matrices of any size.

    Raises:
        TypeError: If one is of another type, or their number does not fit.
    """
    signature, kinds, least, most = _signature(op)
    named: Iterable[tuple[str, Any]] = zip(kinds, args, strict=False)
    if kwargs or not least <= len(args) <= most:
        named = signature.bind(*args, **kwargs).arguments.items()
    for name, value in named:
        if not _is(value, kinds[name]):
            raise TypeError(
                f"{name} is {_said(value)}, {signature.parameters[name].annotation} is needed [NN-004]"
            )


Kinds = dict[type, Any]
"""Types that an argument may have; those of a sequence with the kinds of what is in it, others with None."""


@cache
def _signature(op: str) -> tuple[inspect.Signature, dict[str, Kinds], int, int]:
    """An operator's signature, what its arguments may be, and how many there are in order, at least and at most."""
    signature, hints = inspect.signature(OPERATORS[op]), typing.get_type_hints(OPERATORS[op])
    parameters = signature.parameters.values()
    least = sum(p.default is p.empty for p in parameters)
    most = sum(p.kind is not p.KEYWORD_ONLY for p in parameters)
    return signature, {name: _kinds(hints[name]) for name in signature.parameters}, least, most


def _kinds(hint: Any) -> Kinds:
    """What an annotation allows."""
    if hint is float:
        return {float: None, int: None, bool: None}
    if typing.get_origin(hint) is Sequence:
        (inner,) = (_kinds(h) for h in typing.get_args(hint))
        return {list: inner, tuple: inner}
    parts = typing.get_args(hint)
    return {kind: inner for part in parts for kind, inner in _kinds(part).items()} if parts else {hint: None}


def _is(value: Any, kinds: Kinds) -> bool:
    kind = type(value)
    if kind not in kinds:
        return False
    inner = kinds[kind]
    return inner is None or all(_is(v, inner) for v in value)


def _said(value: Any) -> str:
    if isinstance(value, Value):
        return f"a tensor of shape {value.shape}"
    if isinstance(value, tuple):
        return f"all {len(value)} results of an operator"
    return f"a list of {len(value)}" if isinstance(value, list) else f"{value!r:.100}"
