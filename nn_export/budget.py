"""What a program may cost, and what it would: settled from shapes and arguments before anything is built."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nn_export.errors import ProgramError
from nn_export.operators import OPERATORS
from nn_export.operators.costs import COSTS, NUMBER, Cost, Tensor, product
from nn_export.operators.value import Value

if TYPE_CHECKING:
    from nn_export.program import Node, Program


@dataclass(frozen=True)
class Limits:
    """What programs may cost; what costs more is refused before it is built.

    The defaults leave room for networks of a thousand hidden units and for artifacts of some dozen programs; to build
    all that they allow takes some ten seconds and a gigabyte. Raise one for a larger network, if you know where it is
    from.

    Args:
        json_bytes: Bytes of ``programs.json``. Default: 16 MiB.
        elements: Numbers in one value. Default: 2**22, a matrix of 2048 x 2048.
        memory: Bytes of all constants, positions and results of a program, of a folder's programs together. Default:
            512 MiB.
        work: Elements touched while the graph is made and evaluated once, of a folder's programs together. Default:
            2**30.
        nodes: Operations of CasADi's graph, of a folder's programs together. An operator counts for 12 at least, a step
            of a recurrent layer for 600. Default: 2**20.

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
EACH_PROGRAM, EACH_PORT, EACH_OPERATOR = 500, 12, 12
"""Nodes that a function, a symbol or constant, and any operator count for at least: one takes some 5 microseconds."""

LOOK = 4
"""Nodes that are looked at in the time in which one is made."""


class Budget:
    """What is left of limits."""

    def __init__(self, limits: Limits | None = None) -> None:
        self.limits = Limits() if limits is None else limits
        self._spent = Cost(0, 0, 0, 0)

    def spend(self, what: str, *, elements: int = 0, memory: int = 0, work: int = 0, nodes: int = 0) -> None:
        """Take off what something costs."""
        cost = Cost(elements, memory, work, nodes)
        if not self._take(cost):
            raise self._refusal(what, cost)

    def add(self, program: Program, where: str = "") -> None:
        """Take off what a program costs as a function."""
        if program.known_cost is not None and self._take(program.known_cost):
            return
        self.check_count(len(program.nodes), where)
        before, largest = self._spent, 0
        try:
            for part, cost in costs(program):
                largest = max(largest, cost.elements)
                if not self._take(cost):
                    raise self._refusal(part if isinstance(part, str) else place(part), cost)
        except ProgramError as error:
            raise ProgramError(f"{where}{error}") from error
        memory, work, nodes = (a - b for a, b in zip(self._spent[1:4], before[1:4], strict=True))
        # Settled once for all that is made of the program.
        object.__setattr__(program, "known_cost", Cost(largest, memory, work, nodes))

    def check_count(self, operators: int, where: str = "") -> None:
        """Refuse a number of operators that is too large whatever they are."""
        if EACH_OPERATOR * operators > self.limits.nodes:
            raise self._refusal(f"{where}{operators} operators", Cost(0, 0, 0, EACH_OPERATOR * operators))

    def _take(self, cost: Cost) -> bool:
        """Take off a cost if there is as much left."""
        spent, limits = self._spent, self.limits
        memory, work, nodes = spent.memory + cost.memory, spent.work + cost.work, spent.nodes + cost.nodes
        if (
            cost.elements > limits.elements
            or memory > limits.memory
            or work > limits.work
            or nodes > limits.nodes
        ):
            return False
        self._spent = Cost(max(spent.elements, cost.elements), memory, work, nodes)
        return True

    def _refusal(self, what: str, cost: Cost) -> ProgramError:
        """What to say of a cost that is too large."""
        before = self._spent._replace(elements=0)
        measure = next(
            m for m in _MEASURES if getattr(before, m) + getattr(cost, m) > getattr(self.limits, m)
        )
        earlier, limit = getattr(before, measure), getattr(self.limits, measure)
        return ProgramError(
            f"{what}: it would come to {_count(getattr(cost, measure))} {_MEASURES[measure]}"
            + (f" with {_count(earlier)} before it" if earlier else "")
            + f", the limit is {_count(limit)}; if you know where it is from, raise the limit: "
            f"limits=nn_export.Limits({measure}=...)"
        )


def _count(n: int) -> str:
    return str(n) if n < 10**7 else f"{n:.3g}"


def costs(program: Program) -> Iterator[tuple[str | Node, Cost]]:
    """What each part of a program costs, in order: its inputs and weights, its nodes, and all outputs together."""
    walk = _Walk()
    yield "the program", Cost(0, 0, 0, EACH_PROGRAM)
    for port in program.inputs:
        yield f"input {port.name}", walk.given("input", port.name, port.shape, False)
    for name, array in program.weights.items():
        yield f"weight {name}", walk.given("weight", name, np.shape(array), True)
    for node in program.nodes:
        yield node, walk.node(node)
    yield "the outputs", walk.outputs([port.source for port in program.outputs])


def place(node: Node) -> str:
    """Where an operator stands, for messages."""
    return f"node {node.name:.80} ({node.op})" + (f" from {node.line:.200}" if node.line else "")


class _Walk:
    """The values of a program so far, as :class:`Tensor`."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str], Any] = {}
        self._work = self._nodes = 0

    def given(self, kind: str, name: str, shape: tuple[int, ...], constant: bool) -> Cost:
        """An input or a weight."""
        size = product(shape)
        self._values[kind, name] = Tensor(tuple(shape), size, constant)
        return Cost(size, NUMBER * size, 4 * size, EACH_PORT)

    def node(self, node: Node) -> Cost:
        """One operator."""
        try:
            args = resolve(node.args, self._values)
            kwargs = resolve(node.kwargs, self._values) if node.kwargs else {}
            tensors = _BOUND[node.op](args, kwargs)
            sizes = [product(shape) for shape in node.shapes]
            made = sum(sizes)
            elements, memory, work, nodes, cut, again = COSTS[node.op](made, *args, **kwargs)
        except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError) as error:
            raise ProgramError(
                f"{place(node)}: arguments that nn_export does not know: {error!s:.300}"
            ) from error
        if nodes < EACH_OPERATOR:
            nodes = EACH_OPERATOR
        self._work += work
        self._nodes += nodes
        constant, behind_work, behind_nodes = True, work, nodes
        for t in tensors:
            constant = constant and t.constant
            behind_work += t.work
            behind_nodes += t.nodes
        if cut:
            behind_work = behind_nodes = 0
        if (
            behind_work > self._work
        ):  # what is behind two arguments was counted twice, but there is no more than all
            behind_work = self._work
        if behind_nodes > self._nodes:
            behind_nodes = self._nodes
        pairs = zip(node.shapes, sizes, strict=True)
        results = [Tensor(shape, size, constant, behind_work, behind_nodes) for shape, size in pairs]
        self._values["node", node.name] = results[0] if len(results) == 1 else tuple(results)
        for t, times in again:
            work += times * t.work
            nodes += times * t.nodes // LOOK
        return Cost(elements if elements > made else made, memory, work, nodes)

    def outputs(self, sources: Sequence[Any]) -> Cost:
        """All outputs, which are looked through once more."""
        tensors = [t for t in resolve(list(sources), self._values) if isinstance(t, Tensor)]
        work, nodes = (
            min(sum(t.work for t in tensors), self._work),
            min(sum(t.nodes for t in tensors), self._nodes),
        )
        return Cost(0, 0, work, nodes // LOOK + EACH_PORT * len(sources))


Kinds = dict[type, Any]
"""Types that an argument may have; those of a sequence with the kinds of what is in it, others with None."""


def _bound(op: str) -> Callable[[list[Any], dict[str, Any]], list[Tensor]]:
    """A function that checks arguments by the operator's signature and gives the tensors among them.

    No operator has to think of a list where a number belongs: it would be repeated to matrices of any size.
    """
    signature = inspect.signature(OPERATORS[op])
    hints = typing.get_type_hints(OPERATORS[op])
    kinds = {name: _kinds(hints[name]) for name in signature.parameters}
    parameters = signature.parameters.values()
    least = sum(p.default is p.empty for p in parameters)
    most = sum(p.kind is not p.KEYWORD_ONLY for p in parameters)
    in_order = list(kinds.items())

    def tensors(args: list[Any], kwargs: dict[str, Any]) -> list[Tensor]:
        named, values = in_order, args
        if kwargs or not least <= len(args) <= most:
            bound = signature.bind(*args, **kwargs).arguments
            named, values = [(name, kinds[name]) for name in bound], list(bound.values())
        found = []
        for (name, allowed), value in zip(named, values, strict=False):
            kind = type(value)
            if kind not in allowed or not (
                allowed[kind] is None or all(_is(v, allowed[kind]) for v in value)
            ):
                needed = signature.parameters[name].annotation
                raise TypeError(f"{name} is {_said(value)}, {needed} is needed")
            if kind is Tensor:
                found.append(value)
            elif kind is list or kind is tuple:
                found += [v for v in value if type(v) is Tensor]
        return found

    return tensors


def _kinds(hint: Any) -> Kinds:
    """What an annotation allows."""
    plain: dict[Any, Kinds] = {Value: {Tensor: None}, float: {float: None, int: None, bool: None}}
    if hint in plain:
        return plain[hint]
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
    if isinstance(value, Tensor):
        return f"a tensor of shape {value.shape}"
    if isinstance(value, tuple):
        return f"all {len(value)} results of an operator"
    return f"a list of {len(value)}" if isinstance(value, list) else f"{value!r:.100}"


# here, as Python evaluates annotations: loading is to evaluate nothing
_BOUND = {op: _bound(op) for op in OPERATORS}


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
