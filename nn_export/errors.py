"""Named errors of the exporter; every message says what was given and what to do."""

from __future__ import annotations


class ExportError(ValueError):
    """Base of all errors of this package."""


class UnsupportedOperatorError(ExportError):
    """The module uses operators the exporter does not know; all of them are listed at once."""


class ControlFlowError(ExportError):
    """The module decides by the values of its inputs (``if x > 0``, ``float(x)``)."""


class TrainingModeError(ExportError):
    """A layer draws random numbers or uses batch statistics, even in evaluation mode."""


class HiddenStateError(ExportError):
    """The module writes into a buffer or into one of its inputs."""


class DtypeError(ExportError):
    """A value is complex, integer where a real one is needed, or computed in less than float64."""


class ShapeError(ExportError):
    """A value has more than two axes longer than one, or an array another shape than needed."""


class DynamicShapeError(ExportError):
    """The size of a result depends on the values of the inputs (``x[x > 0]``, ``nonzero``)."""


class SignatureError(ExportError):
    """Example inputs or names do not fit the module."""


class TraceError(ExportError):
    """torch could not trace the module for another reason; its own message is included."""


class ProgramError(ExportError):
    """A program or its file is damaged, foreign, too large, or not understood."""


class DerivativeError(ExportError):
    """A CasADi function has no derivative where torch asks for one."""


class CompileError(ExportError):
    """A function could not be written as C, or the C compiler failed; its message is included."""


def last_line(error: BaseException) -> str:
    r"""What CasADi says in the end, behind the places in its own source; the error's kind if it says nothing.

    Example:
        >>> last_line(RuntimeError("Error in Function::Function at function.cpp:285:\n std::bad_alloc"))
        'std::bad_alloc'
    """
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()
