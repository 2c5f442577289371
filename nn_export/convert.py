"""The graph of ``torch.export`` as plain data."""

from __future__ import annotations

import inspect
import math
from typing import Any

import numpy as np
import torch
from torch.export.graph_signature import InputKind, OutputKind

from nn_export.checks import LIKE_NOTHING, check_operators, op_name, results, source_line
from nn_export.errors import DtypeError, HiddenStateError, SignatureError, UnsupportedOperatorError
from nn_export.operators import OPERATORS
from nn_export.program import Node, Port

_SKIPPED = {"aten._assert_tensor_metadata.default", "aten.sym_constrain_range_for_size.default"}
Reference = dict[str, str]
Graph = tuple[
    tuple[Node, ...], list[tuple[Reference, tuple[int, ...]]], dict[str, np.ndarray], tuple[Port, ...]
]


def convert(exported: torch.export.ExportedProgram, input_names: list[str], n_outputs: int) -> Graph:
    """Nodes, output references with shapes, weights and inputs of an exported program.

    Raises:
        ExportError: One of the named errors that :func:`nn_export.trace` lists.
    """
    _check_mutations(exported)
    calls = [n for n in exported.graph.nodes if n.op not in ("placeholder", "output")]
    calls = [n for n in calls if str(n.target) not in _SKIPPED]
    check_operators(calls)
    refs, weights, inputs = _placeholders(exported, input_names)
    nodes = []
    for n in calls:
        op = op_name(n)
        kwargs = {k: _plain(v, refs) for k, v in n.kwargs.items() if k not in LIKE_NOTHING}
        if "dtype" in inspect.signature(OPERATORS[op]).parameters:
            kwargs["dtype"] = str(n.meta["val"].dtype).removeprefix("torch.")
        args = [_plain(a, refs) for a in n.args]
        nodes.append(Node(n.name, op, args, kwargs, _shapes(n), source_line(n)))
        refs[n.name] = {"node": n.name}
    output = next(n for n in exported.graph.nodes if n.op == "output")
    found = list(output.args[0])
    if n_outputs != len(found):
        raise SignatureError(f"{n_outputs} output names, but the module returns {len(found)} tensors")
    sources = [_output(i, value, refs) for i, value in enumerate(found)]
    used = {ref["weight"] for n in nodes for ref in _weight_refs([n.args, n.kwargs])}
    used |= {ref["weight"] for ref, _ in sources if "weight" in ref}
    return tuple(nodes), sources, {k: v for k, v in weights.items() if k in used}, inputs


def _weight_refs(data: Any) -> list[Reference]:
    if isinstance(data, dict):
        return [data] if set(data) == {"weight"} else [r for v in data.values() for r in _weight_refs(v)]
    return [r for v in data for r in _weight_refs(v)] if isinstance(data, list) else []


def _check_mutations(exported: torch.export.ExportedProgram) -> None:
    changed = (OutputKind.BUFFER_MUTATION, OutputKind.USER_INPUT_MUTATION)
    names = [str(s.target) for s in exported.graph_signature.output_specs if s.kind in changed]
    if names:
        raise HiddenStateError(
            f"the module writes into {', '.join(names)}: take the state as an input, return the new one"
        )


def _placeholders(
    exported: torch.export.ExportedProgram, input_names: list[str]
) -> tuple[dict[str, Reference], dict[str, np.ndarray], tuple[Port, ...]]:
    refs: dict[str, Reference] = {}
    weights: dict[str, np.ndarray] = {}
    ports: list[Port] = []
    tensors = {**exported.state_dict, **exported.constants}
    nodes = {n.name: n for n in exported.graph.nodes if n.op == "placeholder"}
    specs = exported.graph_signature.input_specs
    n_inputs = sum(s.kind is InputKind.USER_INPUT for s in specs)
    if n_inputs != len(input_names):
        raise SignatureError(f"{len(input_names)} input names, but the module takes {n_inputs} tensors")
    for spec in specs:
        name = str(getattr(spec.arg, "name", ""))
        if spec.kind is InputKind.USER_INPUT:
            refs[name] = {"input": input_names[len(ports)]}
            ports.append(Port(input_names[len(ports)], tuple(nodes[name].meta["val"].shape)))
            continue
        tensor = tensors[str(spec.target)]
        if tensor.is_complex():
            raise DtypeError(f"{spec.target} is complex; split it into real and imaginary parts")
        weights[str(spec.target)] = tensor.detach().cpu().to(torch.float64).numpy().copy()
        refs[name] = {"weight": str(spec.target)}
    return refs, weights, tuple(ports)


def _shapes(n: torch.fx.Node) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(int(size) for size in v.shape) for v in results(n))


def _plain(value: Any, refs: dict[str, Reference]) -> Any:
    if isinstance(value, torch.fx.Node):
        return dict(refs[value.name])
    if isinstance(value, list | tuple):
        return [_plain(v, refs) for v in value]
    if isinstance(value, torch.dtype):
        return str(value).removeprefix("torch.")
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise UnsupportedOperatorError(
        f"an argument of type {type(value).__name__} ({value!r:.60}); use a number"
    )


def _output(index: int, value: Any, refs: dict[str, Reference]) -> tuple[Reference, tuple[int, ...]]:
    if not isinstance(value, torch.fx.Node):
        raise SignatureError(f"output {index} of the module is {value!r}, not a tensor; do not return it")
    tensor = value.meta["val"]
    if not tensor.is_floating_point():
        raise DtypeError(
            f"output {index} of the module is {tensor.dtype}; return real numbers, e.g. x.double()"
        )
    return refs[value.name], tuple(int(n) for n in tensor.shape)
