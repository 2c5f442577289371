"""The graph of ``torch.export`` as plain data. What the export would get wrong is refused by name."""

from __future__ import annotations

import inspect
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.export.graph_signature import InputKind, OutputKind

from nn_export.errors import (
    DtypeError,
    DynamicShapeError,
    HiddenStateError,
    SignatureError,
    TrainingModeError,
    UnsupportedOperatorError,
)
from nn_export.operators import OPERATORS
from nn_export.operators.shape import OPERATORS as MOVEMENTS
from nn_export.program import Node, Port

_SKIPPED = {"aten._assert_tensor_metadata.default", "aten.sym_constrain_range_for_size.default"}
Reference = dict[str, str]
Graph = tuple[
    tuple[Node, ...], list[tuple[Reference, tuple[int, ...]]], dict[str, np.ndarray], tuple[Port, ...]
]


def convert(exported: torch.export.ExportedProgram, input_names: list[str], n_outputs: int) -> Graph:
    """Nodes, output references with shapes, weights and inputs of an exported program."""
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
        raise SignatureError(
            f"{n_outputs} output names, but the module returns {len(found)} tensors [NN-017]"
        )
    sources = [_output(i, value, refs) for i, value in enumerate(found)]
    used = {ref["weight"] for n in nodes for ref in _weight_refs([n.args, n.kwargs])}
    used |= {ref["weight"] for ref, _ in sources if "weight" in ref}
    return tuple(nodes), sources, {k: v for k, v in weights.items() if k in used}, inputs


def understood(exported: torch.export.ExportedProgram) -> bool:
    """Whether every operator of a program that was not decomposed is one of :data:`OPERATORS`.

    What writes into a tensor is none of them, so nothing is missed that decomposing would bring to light.
    """
    calls = (n for n in exported.graph.nodes if n.op not in ("placeholder", "output"))
    return all(str(n.target) in _SKIPPED or op_name(n) in OPERATORS for n in calls)


def _weight_refs(data: Any) -> list[Reference]:
    if isinstance(data, dict):
        return [data] if set(data) == {"weight"} else [r for v in data.values() for r in _weight_refs(v)]
    return [r for v in data for r in _weight_refs(v)] if isinstance(data, list) else []


def _check_mutations(exported: torch.export.ExportedProgram) -> None:
    changed = (OutputKind.BUFFER_MUTATION, OutputKind.USER_INPUT_MUTATION)
    names = [str(s.target) for s in exported.graph_signature.output_specs if s.kind in changed]
    if names:
        raise HiddenStateError(
            f"the module writes into {', '.join(names)}: make the state an input, and return the new state [NN-018]"
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
        raise SignatureError(
            f"{len(input_names)} input names, but the module takes {n_inputs} tensors [NN-019]"
        )
    for spec in specs:
        name = str(getattr(spec.arg, "name", ""))
        if spec.kind is InputKind.USER_INPUT:
            refs[name] = {"input": input_names[len(ports)]}
            ports.append(Port(input_names[len(ports)], tuple(nodes[name].meta["val"].shape)))
            continue
        tensor = tensors[str(spec.target)]
        if tensor.is_complex():
            raise DtypeError(f"{spec.target} is complex; split it into real and imaginary parts [NN-020]")
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
        f"an argument of type {type(value).__name__} ({value!r:.60}); use a number [NN-021]"
    )


def _output(index: int, value: Any, refs: dict[str, Reference]) -> tuple[Reference, tuple[int, ...]]:
    if not isinstance(value, torch.fx.Node):
        raise SignatureError(
            f"output {index} of the module is {value!r}, not a tensor; do not return it [NN-022]"
        )
    tensor = value.meta["val"]
    if not tensor.is_floating_point():
        raise DtypeError(
            f"output {index} of the module is {tensor.dtype}; return real numbers, e.g. x.double() [NN-023]"
        )
    return refs[value.name], tuple(int(n) for n in tensor.shape)


_RANDOM = re.compile(
    r"aten\.(native_dropout|dropout|bernoulli|rand|randn|normal|uniform|.*batch_norm_legit)\w*\."
)
LIKE_NOTHING = {"layout", "device", "pin_memory", "memory_format", "non_blocking"}
"""Arguments that say where data lie, not what they are."""
_LOGICAL = {"any", "all", "where", "mul", "maximum", "minimum", "amax", "amin", "max", "min", "_to_copy"}
_LOGICAL |= {"gt", "ge", "lt", "le", "eq", "ne", "isnan", "isinf", "signbit", "prod", "getitem"}
_EXACT = {torch.float64, torch.int64, torch.int32, torch.bool}
_TORCH = str(Path(torch.__file__).parent)


def check_operators(calls: list[torch.fx.Node]) -> None:
    """Refuse a graph that cannot be repeated exactly; all operators of a kind are listed at once."""
    _raise(DynamicShapeError, _DYNAMIC, [n for n in calls if _dynamic(n)])
    _raise(DtypeError, _COMPLEX, [n for n in calls if any(v.is_complex() for v in results(n))])
    unknown = [n for n in calls if op_name(n) not in OPERATORS]
    drawn = [n for n in unknown if _RANDOM.match(op_name(n))]
    _raise(TrainingModeError, _DRAWN, drawn)
    known = [n for n in calls if op_name(n) in OPERATORS]
    problems = {n: _misfit(n, op_name(n)) for n in known} | dict.fromkeys(unknown, "")
    bad = [n for n in calls if n in unknown or problems[n]]
    _raise(UnsupportedOperatorError, _UNKNOWN, bad, problems)
    narrow = {n: text for n in known if (text := _narrow(n))}
    _raise(DtypeError, _NARROW, list(narrow), narrow)


_DYNAMIC = (
    "sizes that depend on the values of the inputs cannot be exported; use torch.where, a product with a "
    "mask, or constant integer positions instead [NN-116]:"
)
_COMPLEX = "complex numbers cannot be exported; write real and imaginary parts as real numbers [NN-117]:"
_DRAWN = (
    "the module is random or uses batch statistics even in evaluation mode; remove these calls "
    "(F.dropout needs training=self.training, BatchNorm track_running_stats=True) [NN-118]:"
)
_UNKNOWN = (
    "operators or arguments that nn_export does not support; use other operators (docs/operators.md), or compute them "
    "outside the module [NN-119]:"
)
_NARROW = (
    "results computed in less than float64, which the export would not repeat; use dtype=torch.float64 or "
    "x.dtype there [NN-120]:"
)


def _raise(
    error: type[Exception],
    text: str,
    found: list[torch.fx.Node],
    problems: dict[torch.fx.Node, str] | None = None,
) -> None:
    lines = []
    for n in found:
        problem = (problems or {}).get(n, "")
        lines.append(f"  {op_name(n)} at {source_line(n)}" + (f": {problem}" if problem else ""))
    if lines:
        raise error("\n".join([text, *dict.fromkeys(lines)]))


def _dynamic(n: torch.fx.Node) -> bool:
    sizes = [size for value in results(n) for size in value.shape]
    return str(n.target).startswith("aten.sym_size") or any(not isinstance(size, int) for size in sizes)


def _misfit(n: torch.fx.Node, op: str) -> str:
    kwargs = {k: v for k, v in n.kwargs.items() if k not in LIKE_NOTHING and k != "dtype"}
    if "dtype" in n.kwargs and "dtype" not in inspect.signature(OPERATORS[op]).parameters:
        kwargs["dtype"] = n.kwargs["dtype"]
    try:
        inspect.signature(OPERATORS[op]).bind(*n.args, **kwargs)
    except TypeError as error:
        return f"{error}; leave this argument at its default"
    return _miscount(n, op)


def _miscount(n: torch.fx.Node, op: str) -> str:
    """Types for which the operator does something else than for real numbers."""
    base = op.split(".")[1] if "." in op else op
    dtypes = {v.dtype for v in results(n)}
    logical = base.startswith("logical") or base in _LOGICAL or op in MOVEMENTS
    if base.startswith("bitwise") and dtypes != {torch.bool}:
        return "bits of integers; only true and false can be exported"
    if torch.bool in dtypes and not (logical or base.startswith("bitwise")):
        return "arithmetic of true and false; convert with .to(x.dtype) first"
    if op.startswith(("aten.index", "aten.gather", "aten.scatter")):
        lists = [a for a in n.args[1:] if isinstance(a, list | tuple)]
        if any(_dtype(v) is torch.bool for part in lists for v in part):
            return "a mask as index; use torch.where or integer positions"
    return ""


def _dtype(value: object) -> torch.dtype | None:
    found = value.meta.get("val") if isinstance(value, torch.fx.Node) else None
    return found.dtype if isinstance(found, torch.Tensor) else None


def _narrow(n: torch.fx.Node) -> str:
    """Type in which a call loses digits; empty if it loses none."""
    lossy = [v.dtype for v in results(n) if v.dtype not in _EXACT]
    if not lossy:
        return "float64 to integer" if _copies_to_integer(n) else ""
    inputs = [d for a in n.all_input_nodes if (d := _dtype(a)) is not None]
    op = op_name(n)
    moves = op in MOVEMENTS or op in ("aten.where.self", "getitem")
    if moves and torch.float64 not in inputs:
        return ""
    if lossy == [torch.float32] and op == "aten._to_copy.default" and inputs[0] is not torch.float64:
        return ""
    if lossy == [torch.float32] and op in ("aten.mul.Tensor", "aten.mul.Scalar") and inputs == [torch.bool]:
        factor = n.args[1]
        if isinstance(factor, int | float) and float(np.float32(factor)) == factor:
            return ""  # a product of 0 or 1 with it is exact
    return f"in {lossy[0]}"


def _copies_to_integer(n: torch.fx.Node) -> bool:
    into = [v.dtype for v in results(n)]
    return op_name(n) == "aten.copy.default" and torch.float64 not in into and _dtype(n.args[1]) not in into


def op_name(n: torch.fx.Node) -> str:
    """Name of the operator in the table."""
    name = str(n.target)
    return "getitem" if name == "<built-in function getitem>" else name


def results(n: torch.fx.Node) -> list[torch.Tensor]:
    """Tensors that a call gives."""
    value = n.meta.get("val")
    found = value if isinstance(value, list | tuple) else [value]
    return [v for v in found if isinstance(v, torch.Tensor)]


def source_line(n: torch.fx.Node) -> str:
    """Line of the user's module that a call came from; of torch's layer if the module is one."""
    frames = re.findall(r'File "([^"]+)", line (\d+), in \S+\n\s*(.*)', n.meta.get("stack_trace") or "")
    own = [f for f in frames if not f[0].startswith(_TORCH)] or frames
    return f"{Path(own[-1][0]).name}:{own[-1][1]}: {own[-1][2].strip()}" if own else "an unknown line"
