"""Torch modules as CasADi functions: exact, without a compiler, readable on disk.

``trace``, ``to_casadi``, ``from_casadi`` and ``parity`` need torch and import it when first used; all else
(``build``, ``with_jacobian``, ``SideBySide``, ``unroll``, ``compile_function``, ``load_programs`` ...) needs casadi
and numpy only.
"""

from typing import TYPE_CHECKING, Any

from nn_export.budget import Limits
from nn_export.build import build
from nn_export.codegen import CFiles, compile_function, generate_c
from nn_export.errors import ExportError, ProgramError
from nn_export.horizon import fold, unroll
from nn_export.jacobian import with_jacobian
from nn_export.program import Node, Port, Program
from nn_export.side_by_side import SideBySide
from nn_export.storage import load_programs, save_programs

if TYPE_CHECKING:
    from nn_export.comparison import ParityReport, parity
    from nn_export.torch_bridge import CasadiModule, from_casadi
    from nn_export.tracing import to_casadi, trace

__all__ = [
    "to_casadi",
    "trace",
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
_LAZY = {"trace": "tracing", "to_casadi": "tracing", "parity": "comparison", "ParityReport": "comparison"}
_LAZY |= {"from_casadi": "torch_bridge", "CasadiModule": "torch_bridge"}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'nn_export' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"nn_export.{_LAZY[name]}"), name)
