"""What a traced graph must not hold: everything the export would get wrong is refused here, by name."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import numpy as np
import torch

from nn_export.errors import DtypeError, DynamicShapeError, TrainingModeError, UnsupportedOperatorError
from nn_export.operators import OPERATORS
from nn_export.operators.shape import OPERATORS as MOVEMENTS

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
    """Refuse a graph that cannot be repeated exactly; all operators of a kind are listed at once.

    Args:
        calls: Calls of the graph in order.

    Raises:
        DynamicShapeError: If a size depends on values.
        DtypeError: If a result is complex, or computed in less than float64.
        TrainingModeError: If a call draws random numbers or uses batch statistics.
        UnsupportedOperatorError: If an operator or one of its arguments is not known.
    """
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
    "mask, or constant integer positions instead:"
)
_COMPLEX = "complex numbers cannot be exported; write real and imaginary parts as real numbers:"
_DRAWN = (
    "the module is random or uses batch statistics even in evaluation mode; remove these calls "
    "(F.dropout needs training=self.training, BatchNorm track_running_stats=True):"
)
_UNKNOWN = (
    "operators or arguments that nn_export does not know; write them with others (docs/operators.md is the "
    "table), or compute them outside the module:"
)
_NARROW = (
    "results computed in less than float64, which the export would not repeat; use dtype=torch.float64 or "
    "x.dtype there:"
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
