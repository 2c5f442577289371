"""Torch modules as CasADi functions: exact, without a compiler, readable on disk.

Nothing is imported before it is used: ``trace``, ``to_casadi``, ``from_casadi`` and ``parity`` need torch, ``Limits``,
``Program`` and the errors neither torch nor casadi, all else casadi and numpy.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nn_export.budget import Limits
    from nn_export.codegen import CFiles, compile_function, generate_c
    from nn_export.comparison import ParityReport, parity
    from nn_export.errors import ExportError, ProgramError
    from nn_export.expressions import program_of
    from nn_export.graph import build
    from nn_export.horizon import fold, unroll
    from nn_export.jacobian import with_jacobian
    from nn_export.program import Node, Port, Program
    from nn_export.side_by_side import SideBySide
    from nn_export.storage import load_programs, save_programs
    from nn_export.torch_bridge import CasadiModule, from_casadi
    from nn_export.tracing import to_casadi, trace

__all__ = [
    "to_casadi",
    "trace",
    "program_of",
    "build",
    "with_jacobian",
    "SideBySide",
    "unroll",
    "fold",
    "from_casadi",
    "CasadiModule",
    "compile_function",
    "generate_c",
    "CFiles",
    "parity",
    "ParityReport",
    "Program",
    "Node",
    "Port",
    "Limits",
    "save_programs",
    "load_programs",
    "ExportError",
    "ProgramError",
]
_MODULES = {
    "budget": ("Limits",),
    "codegen": ("CFiles", "compile_function", "generate_c"),
    "comparison": ("ParityReport", "parity"),
    "errors": ("ExportError", "ProgramError"),
    "expressions": ("program_of",),
    "graph": ("build",),
    "horizon": ("fold", "unroll"),
    "jacobian": ("with_jacobian",),
    "program": ("Node", "Port", "Program"),
    "side_by_side": ("SideBySide",),
    "storage": ("load_programs", "save_programs"),
    "torch_bridge": ("CasadiModule", "from_casadi"),
    "tracing": ("to_casadi", "trace"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'nn_export' has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"nn_export.{_HOME[name]}"), name)
    except ModuleNotFoundError as missing:
        if (missing.name or "").partition(".")[0] != "torch":
            raise
        raise ModuleNotFoundError(
            f"nn_export.{name} needs torch, which is not installed: pip install 'hybrid-mpc[train]'",
            name="torch",
        ) from missing
