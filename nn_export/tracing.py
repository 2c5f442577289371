"""Torch module to Program, by ``torch.export``. The only part that needs torch, with parity."""

from __future__ import annotations

import copy
import inspect
import re
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import casadi as ca
import torch
from torch.utils import _pytree as pytree

from nn_export.budget import Limits
from nn_export.convert import convert, understood
from nn_export.errors import ControlFlowError, ExportError, SignatureError, TraceError
from nn_export.graph import build, valid_name
from nn_export.program import Port, Program

# Kept whole: their decompositions lose structure, or derivatives at the far ends.
_WHOLE = re.compile(
    r"aten\.(gru|lstm|rnn_tanh|rnn_relu|gru_cell|lstm_cell|rnn_tanh_cell|rnn_relu_cell|linear|layer_norm"
    r"|softplus|silu|mish|celu|logsumexp|log_sigmoid|mv|dot|std|std_mean|xlogy"
    r"|linalg_solve|linalg_inv|linalg_det|linalg_cholesky)$"
)


def trace(
    module: torch.nn.Module,
    example_inputs: Sequence[Any],
    *,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> Program:
    """Record what a module computes, as plain data.

    The module is copied, cast to float64 and put in evaluation mode; it is itself not changed.

    Args:
        module: Any module; its ``forward`` takes tensors and returns a tensor or a tuple, list or
            dictionary of tensors.
        example_inputs: One tensor, or nested tuple, list or dictionary of tensors, for each argument of
            ``forward``; only their shapes matter.
        input_names: Names of the tensors. Default: the argument names of ``forward``, for a nested one
            followed by its keys or positions: ``state_h``, ``hx_0``.
        output_names: Names of the outputs. Default: dictionary keys, else ``output_0``, ``output_1`` ...
            (``output`` if there is one).

    Raises:
        UnsupportedOperatorError: Listing all operators that are not supported, with their source lines.
        ControlFlowError: If the module decides by values.
        TrainingModeError: If a layer draws random numbers or uses batch statistics.
        HiddenStateError: If the module writes into a buffer or an input.
        DynamicShapeError: If the size of a result depends on values.
        DtypeError: If an output is complex or integer, or a result is computed in float32.
        SignatureError: If inputs or names do not fit.
        TraceError: If torch cannot trace the module for another reason.

    Example:
        >>> program = trace(torch.nn.Linear(2, 1), (torch.zeros(2),))
        >>> [node.op for node in program.nodes]
        ['aten.linear.default']
    """
    examples = _examples(module, example_inputs)
    exported = _export(module, examples)
    names = list(input_names) if input_names is not None else _input_names(module, examples)
    outputs = list(output_names) if output_names is not None else _output_names(exported)
    nodes, sources, weights, inputs = convert(exported, names, len(outputs))
    if len(set(names)) < len(names) or len(set(outputs)) < len(outputs):
        raise SignatureError(f"names must differ: inputs {names}, outputs {outputs} [NN-106]")
    for name in (*names, *outputs):
        if not valid_name(name):
            raise SignatureError(
                f"{name!r} is no name for CasADi: use letters, digits and single underscores [NN-107]"
            )
    metadata = {"module": type(module).__name__, "torch": version("torch"), "casadi": version("casadi")}
    metadata["nn_export"] = _version()
    ports = tuple(Port(n, s, ref) for n, (ref, s) in zip(outputs, sources, strict=True))
    return Program(inputs, ports, nodes, weights, metadata)


def to_casadi(
    module: torch.nn.Module,
    example_inputs: Sequence[Any],
    *,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    name: str | None = None,
    limits: Limits | None = None,
) -> ca.Function:
    """A torch module as a CasADi function: :func:`trace`, then :func:`build`.

    Args:
        module: As in :func:`trace`.
        example_inputs: As in :func:`trace`.
        input_names: As in :func:`trace`.
        output_names: As in :func:`trace`.
        name: Name of the function. Default: the class of the module.
        limits: As in :func:`build`.

    Raises:
        ExportError: One of the named errors of :func:`trace` and :func:`build`.

    Example:
        >>> to_casadi(torch.nn.GRUCell(3, 4), (torch.zeros(3), torch.zeros(4)), output_names=["h_next"])
        Function(GRUCell:(input[3],hx[4])->(h_next[4]) MXFunction)
    """
    program = trace(module, example_inputs, input_names=input_names, output_names=output_names)
    return build(program, name if name is not None else _identifier(type(module).__name__), limits=limits)


def float64_copy(module: torch.nn.Module) -> torch.nn.Module:
    """A float64 copy in evaluation mode; the module itself is left as it is."""
    return copy.deepcopy(module).double().eval()


def _examples(module: Any, example_inputs: Any) -> tuple[Any, ...]:
    if not isinstance(module, torch.nn.Module):
        raise SignatureError(f"expected a torch.nn.Module, got {type(module).__name__} [NN-108]")
    if isinstance(example_inputs, torch.Tensor) or not isinstance(example_inputs, Sequence):
        raise SignatureError("example_inputs must be a tuple of tensors, e.g. (x, h) [NN-109]")
    for path, x in pytree.tree_flatten_with_path(tuple(example_inputs))[0]:
        if not isinstance(x, torch.Tensor) or not x.is_floating_point():
            kind = x.dtype if isinstance(x, torch.Tensor) else type(x).__name__
            at = "_".join(_words(path))
            raise SignatureError(
                f"example input {at} must be a tensor of real numbers, got {kind}; e.g. torch.zeros(3) [NN-110]"
            )
    copies: tuple[Any, ...] = pytree.tree_map(
        lambda x: x.detach().to(device="cpu", dtype=torch.float64).clone(), tuple(example_inputs)
    )
    return copies


def _export(module: torch.nn.Module, examples: tuple[Any, ...]) -> torch.export.ExportedProgram:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own notes on its internals
        try:
            exported = torch.export.export(float64_copy(module), examples)
            if understood(exported):
                return exported  # to decompose it would take as long again
            table = torch.export.default_decompositions()
            for op in [op for op in table if _WHOLE.match(str(op).rsplit(".", 1)[0])]:
                table.pop(op)
            return exported.run_decompositions(table)
        except Exception as error:
            raise _explain(module, examples, error) from error


def _explain(module: torch.nn.Module, examples: tuple[Any, ...], error: Exception) -> ExportError:
    name, text = type(module).__name__, f"{type(error).__name__}: {error}"
    signs = ("DataDependent", "data-dependent", "Dynamic control flow", "dynamic control flow", "aten.item")
    if any(sign in text for sign in signs):
        where = re.findall(r'File "([^"]+)", line (\d+)', text)
        at = f" (near {where[-1][0]}:{where[-1][1]})" if where else ""
        return ControlFlowError(
            f"{name} decides by the values of its inputs{at}; use torch.where instead of if, and tensors "
            f"instead of float(x) or x.item(). torch says: {text[:600]} [NN-113]"
        )
    try:
        float64_copy(module)(*examples)
    except Exception as own:  # whatever the module says of these inputs, the user is to read
        shapes = [tuple(x.shape) for x in pytree.tree_leaves(examples)]
        return SignatureError(
            f"{name} does not run on the example inputs of shapes {shapes}; give one tensor of the right shape "
            f"for each argument of forward(). torch says: {type(own).__name__}: {str(own)[:600]} [NN-114]"
        )
    return TraceError(
        f"{name} runs, but torch.export cannot trace it; simplify what it names. torch says: {text[:1500]} [NN-115]"
    )


def _identifier(text: str) -> str:
    clean = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", text)).strip("_")
    return clean if valid_name(clean) else f"v_{clean}".rstrip("_")


def _input_names(module: torch.nn.Module, examples: tuple[Any, ...]) -> list[str]:
    bound = inspect.signature(module.forward).bind(*examples)
    leaves = pytree.tree_flatten_with_path(tuple(bound.arguments.values()))[0]
    keys = list(bound.arguments)
    return [_identifier("_".join([keys[int(_words(path)[0])], *_words(path[1:])])) for path, _ in leaves]


def _words(path: Sequence[Any]) -> list[str]:
    return [str(getattr(k, "key", getattr(k, "name", getattr(k, "idx", "")))) for k in path]


def _output_names(exported: torch.export.ExportedProgram) -> list[str]:
    spec = exported.call_spec.out_spec
    assert spec is not None
    tree = pytree.tree_unflatten(list(range(spec.num_leaves)), spec)
    names = []
    for path, _ in pytree.tree_flatten_with_path(tree)[0]:
        text = "_".join(_words(path))
        names.append(_identifier(text if text and not text[0].isdigit() else f"output_{text}"))
    return names


def _version() -> str:
    try:
        return version("hybrid-mpc")
    except ModuleNotFoundError:  # a source tree that was never installed
        return "source"
