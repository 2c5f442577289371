"""A network as plain data: operators, names, shapes and weights. Nothing in it can execute."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nn_export.errors import ProgramError

if TYPE_CHECKING:
    from nn_export.budget import Limits

Shape = tuple[int, ...]
_KINDS = ("input", "weight", "node")
_HOLDERS = (dict, list, tuple)


@dataclass(frozen=True)
class Port:
    """An input or output.

    Args:
        name: Its name in the CasADi function.
        shape: Its shape in torch.
        source: For an output: reference to what it returns, ``{"node": "tanh"}``, ``{"input": "h"}`` or
            ``{"weight": "b"}``. None for an input.

    Example:
        >>> Port("x", (2,)).shape
        (2,)
    """

    name: str
    shape: Shape
    source: dict[str, str] | None = None


@dataclass(frozen=True)
class Node:
    """One operator.

    Args:
        name: Unique among the nodes.
        op: ATen overload, e.g. ``"aten.tanh.default"``, or ``"getitem"``.
        args: Positional arguments as JSON data; a tensor is a reference (see :class:`Port`), an infinite
            or undefined number is ``{"float": "inf"}``.
        kwargs: Named arguments, likewise.
        shapes: Shapes of its results (one, except for operators with several).
        line: The line of the user's module it came from, for error messages.

    Example:
        >>> Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),)).op
        'aten.tanh.default'
    """

    name: str
    op: str
    args: list[Any]
    kwargs: dict[str, Any]
    shapes: tuple[Shape, ...]
    line: str = ""


@dataclass(frozen=True)
class Program:
    """A traced module.

    Args:
        inputs: Inputs in order.
        outputs: Outputs in order.
        nodes: Operators in an order in which they can be computed.
        weights: float64 arrays by name, e.g. ``"cell.weight_ih"``.
        metadata: Versions of the tools that made it.

    Raises:
        ProgramError: If a name is used twice, a reference leads nowhere or forward, or an operator is
            unknown.

    Example:
        >>> node = Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),))
        >>> Program((Port("x", (2,)),), (Port("y", (2,), {"node": "tanh"}),), (node,)).nodes[0].name
        'tanh'
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    nodes: tuple[Node, ...]
    weights: dict[str, np.ndarray] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        from nn_export.operators import OPERATORS

        known = {("input", p.name) for p in self.inputs} | {("weight", name) for name in self.weights}
        if len(known) < len(self.inputs) + len(self.weights):
            raise ProgramError("two inputs have the same name; rename one [NN-072]")
        for node in self.nodes:
            if node.op not in OPERATORS:
                raise ProgramError(
                    f"node {node.name:.80}: operator {node.op:.80} is unknown to this version of nn_export; "
                    "update nn_export or export the module again [NN-073]"
                )
            for reference in references((node.args, node.kwargs)):
                if reference not in known:
                    raise ProgramError(
                        f"node {node.name:.80}: {reference[0]} {reference[1]!r:.80} is not defined [NN-074]"
                    )
            if ("node", node.name) in known:
                raise ProgramError(f"node {node.name:.80}: its name is used twice [NN-075]")
            known.add(("node", node.name))
        for port in self.outputs:
            found = list(references(port.source))
            if len(found) != 1 or found[0] not in known:
                raise ProgramError(
                    f"output {port.name:.80}: its source {port.source!s:.80} is not defined [NN-076]"
                )

    def save(self, folder: str | Path) -> None:
        """Write ``programs.json`` and ``weights.safetensors`` into the folder (made if missing)."""
        from nn_export.storage import save_programs

        save_programs(folder, {"program": self})

    @staticmethod
    def load(folder: str | Path, limits: Limits | None = None) -> Program:
        """The only program of a folder.

        Args:
            folder: As in :func:`nn_export.load_programs`.
            limits: As there.

        Raises:
            ProgramError: If the files are damaged, cost more than the limits or hold several programs.
        """
        from nn_export.storage import load_programs

        programs = load_programs(folder, limits)
        if len(programs) != 1:
            raise ProgramError(
                f"{folder}: holds {sorted(programs)}; use load_programs and choose one [NN-077]"
            )
        return next(iter(programs.values()))


def references(data: Any) -> list[tuple[str, str]]:
    """All references within arguments, as (kind, name)."""
    found: list[tuple[str, str]] = []
    _collect(data, found)
    return found


def _collect(data: Any, found: list[tuple[str, str]]) -> None:
    if isinstance(data, dict):
        if len(data) == 1:
            kind, name = next(iter(data.items()))
            if kind in _KINDS and isinstance(name, str):
                found.append((kind, name))
                return
        data = data.values()
    elif not isinstance(data, _HOLDERS):
        return
    for value in data:
        if isinstance(value, _HOLDERS):
            _collect(value, found)


def to_json(program: Program) -> dict[str, Any]:
    """The program without its weights as JSON data."""
    return {
        "inputs": [{"name": p.name, "shape": list(p.shape)} for p in program.inputs],
        "outputs": [{"name": p.name, "shape": list(p.shape), "source": p.source} for p in program.outputs],
        "nodes": [{**vars(n), "shapes": [list(s) for s in n.shapes]} for n in program.nodes],
        "metadata": program.metadata,
    }


def from_json(data: Any, weights: dict[str, np.ndarray], where: str) -> Program:
    """Inverse of :func:`to_json`; every field is checked."""
    top = _fields(data, {"inputs": list, "outputs": list, "nodes": list, "metadata": dict}, where)
    inputs = [_port(p, f"{where}.inputs[{i}]", False) for i, p in enumerate(top["inputs"])]
    outputs = [_port(p, f"{where}.outputs[{i}]", True) for i, p in enumerate(top["outputs"])]
    nodes = [_node(n, f"{where}.nodes[{i}]") for i, n in enumerate(top["nodes"])]
    if not all(isinstance(v, str) for v in top["metadata"].values()):
        raise ProgramError(f"{where}.metadata: expected text; export the module again [NN-078]")
    try:
        return Program(tuple(inputs), tuple(outputs), tuple(nodes), weights, top["metadata"])
    except ProgramError as error:
        raise ProgramError(f"{where}: {error}") from error


def _fields(data: Any, types: Mapping[str, type], where: str) -> dict[str, Any]:
    if not isinstance(data, dict) or data.keys() != types.keys():
        given = sorted(data) if isinstance(data, dict) else type(data).__name__
        raise ProgramError(
            f"{where}: expected the fields {sorted(types)}, got {given!s:.200}; export again [NN-079]"
        )
    for name, kind in types.items():
        if not isinstance(data[name], kind):
            raise ProgramError(
                f"{where}.{name}: expected {kind.__name__}, got {data[name]!r:.60}; export again [NN-080]"
            )
    return data


def shape_of(data: Any, where: str) -> Shape:
    """A shape from JSON data."""
    if isinstance(data, list) and len(data) <= 16:
        for n in data:
            if type(n) is not int or not 0 <= n < 2**31:
                break
        else:
            return tuple(data)
    raise ProgramError(f"{where}: {data!r:.60} is no shape; export the module again [NN-081]")


def _port(data: Any, where: str, output: bool) -> Port:
    kinds: dict[str, type] = {"name": str, "shape": list, **({"source": dict} if output else {})}
    d = _fields(data, kinds, where)
    return Port(d["name"], shape_of(d["shape"], f"{where}.shape"), d.get("source"))


_NODE = {"name": str, "op": str, "args": list, "kwargs": dict, "shapes": list, "line": str}


def _node(data: Any, where: str) -> Node:
    d = _fields(data, _NODE, where)
    shapes = tuple([shape_of(s, where) for s in d["shapes"]])
    return Node(d["name"], d["op"], d["args"], d["kwargs"], shapes, d["line"])


def dumps(data: Any) -> str:
    """JSON text, refusing what JSON has no form for."""
    return json.dumps(data, indent=1, allow_nan=False, ensure_ascii=False)
