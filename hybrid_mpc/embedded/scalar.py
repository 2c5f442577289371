"""C statements of CasADi's scalar expressions, and C tables of numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from hybrid_mpc.errors import InputError
from nn_export.errors import last_line

MOST = 30_000
"""Maximum operations of an expression that is exported as scalar code."""
SMALL = 32
"""Maximum entries of a constant matrix whose product is scalar code; products with larger matrices are layers."""
_BINARY = {
    ca.OP_ADD: "{} + {}", ca.OP_SUB: "{} - {}", ca.OP_MUL: "{} * {}", ca.OP_DIV: "{} / {}",
    ca.OP_FMIN: "hmpc_min({}, {})", ca.OP_FMAX: "hmpc_max({}, {})",
    ca.OP_LT: "{} < {} ? R(1.0) : R(0.0)", ca.OP_LE: "{} <= {} ? R(1.0) : R(0.0)",
    ca.OP_EQ: "hmpc_same({}, {})", ca.OP_NE: "R(1.0) - hmpc_same({}, {})",
    ca.OP_AND: "hmpc_true({0}) * hmpc_true({1})",
    ca.OP_OR: "hmpc_max(hmpc_true({0}), hmpc_true({1}))", ca.OP_IF_ELSE_ZERO: "hmpc_if({}, {})",
    ca.OP_ASSIGN: "{}", ca.OP_NEG: "-{}", ca.OP_SQ: "{0} * {0}", ca.OP_TWICE: "{0} + {0}", ca.OP_INV: "R(1.0) / {}",
    ca.OP_NOT: "R(1.0) - hmpc_true({})", ca.OP_FABS: "hmpc_abs({})", ca.OP_SQRT: "hmpc_sqrt({})",
    ca.OP_EXP: "hmpc_exp({})", ca.OP_LOG: "hmpc_log({})", ca.OP_TANH: "hmpc_tanh({})", ca.OP_SIN: "hmpc_sin({})",
    ca.OP_COS: "hmpc_cos({})", ca.OP_TAN: "hmpc_sin({0}) / hmpc_cos({0})", ca.OP_SIGN: "hmpc_sign({})",
}  # fmt: skip
_LIBM = {
    ca.OP_POW: "pow", ca.OP_CONSTPOW: "pow", ca.OP_ASIN: "asin", ca.OP_ACOS: "acos", ca.OP_ATAN: "atan",
    ca.OP_ATAN2: "atan2", ca.OP_SINH: "sinh", ca.OP_COSH: "cosh", ca.OP_ASINH: "asinh", ca.OP_ACOSH: "acosh",
    ca.OP_ATANH: "atanh", ca.OP_ERF: "erf", ca.OP_HYPOT: "hypot", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil",
    ca.OP_FMOD: "fmod", ca.OP_REMAINDER: "remainder", ca.OP_COPYSIGN: "copysign", ca.OP_LOG1P: "log1p",
    ca.OP_EXPM1: "expm1",
}  # fmt: skip
"""Functions of the C library; their last bits differ between libraries."""
_NAMES = {code: name for name, code in vars(ca).items() if name.startswith("OP_")}


def scalar_code(what: str, f: ca.Function) -> ca.Function:
    """A function as scalar code; InputError if it calls what has none, e.g. a solver."""
    try:
        return f.expand()
    except RuntimeError as error:
        raise InputError(
            f"{what}: the C export is not possible, because this cannot be written as scalar code: {last_line(error)}"
            " [HM-EMBEDDED-006]"
        ) from error


def number(value: float) -> str:
    """Write a number as C.

    Example:
        >>> number(0.5), number(float("-inf"))
        ('R(0.5)', '-R(INFINITY)')
    """
    if math.isfinite(value):
        return f"R({float(value)!r})"
    return "R(NAN)" if math.isnan(value) else "R(INFINITY)" if value > 0 else "-R(INFINITY)"


def comment(text: str) -> str:
    """Escape a user's text for a C comment of one line.

    All characters except letters, digits, blanks and ``_ . , : ; = + < > ( ) [ ] -`` become ``_``: no ``*/`` closes the
    comment, no backslash continues the line, and no ``?`` begins a trigraph.

    Example:
        >>> comment("level [0]"), comment("x */ system(1); //")
        ('level [0]', 'x __ system(1); __')
    """
    return re.sub(r"[^\w .,:;=+<>()\[\]-]", "_", text)


def table(name: str, values: ArrayLike, kind: str = "real") -> str:
    """Write a constant array of one or two axes; an empty axis has one element, because C has no empty arrays."""
    array = np.asarray(values)
    full = np.zeros([max(1, n) for n in array.shape])
    full[tuple(slice(n) for n in array.shape)] = array
    show = number if kind == "real" else lambda v: str(int(v))
    rows = [", ".join(map(show, row)) for row in np.atleast_2d(full)]
    inner = rows[0] if full.ndim == 1 else ",\n  ".join(f"{{{row}}}" for row in rows)
    size = "".join(f"[{n}]" for n in full.shape)
    return f"static const {kind} {name}{size} = {{\n  {inner}\n}};\n"


def c_function(
    name: str, arguments: Sequence[str], inputs: Mapping[str, ca.SX], results: Sequence[tuple[str, ca.SX]],
    before: Sequence[str] = (),
) -> tuple[str, int]:  # fmt: skip
    """Write a C function of scalar statements; return the text and its number of operations.

    Args:
        name: Name of the function.
        arguments: Parameters of the function, e.g. ``"const real *x"``.
        inputs: CasADi's symbols by their name in C: ``{"x": symbol}`` for ``x[0], x[1], ...``.
        results: Target of each scalar expression, e.g. ``("y[0]", expression)``.
        before: Statements before the first one. Default: none.

    Raises:
        InputError: If an operation cannot be written as C, or there are too many operations.

    Example:
        >>> x = ca.SX.sym("x", 2)
        >>> text, operations = c_function("f", ["const real *x", "real *y"], {"x": x}, [("y[0]", x[0] * x[1])])
        >>> operations, "t2 = t0 * t1" in text
        (1, True)
    """
    values = ca.densify(ca.vertcat(*(v for _, v in results))) if results else ca.SX(0, 1)
    f = ca.Function("f", list(inputs.values()), [values], {"cse": True})
    if f.n_instructions() > MOST:
        raise InputError(
            f"{name}: {f.n_instructions()} scalar operations, but the C export allows at most {MOST}. Products with "
            f"constant matrices of more than {SMALL} numbers do not count: write networks with them (torch's Linear, "
            "GRUCell, LSTM)"
            " [HM-EMBEDDED-008]"
        )
    lines, names = [], list(inputs)
    register: dict[int, str] = {}
    operations = 0
    for k in range(f.n_instructions()):
        code, taken, given = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if code == ca.OP_OUTPUT:
            lines.append(f"{results[given[1]][0]} = {register[taken[0]]};")
            continue
        if code == ca.OP_INPUT:
            text = f"{names[taken[0]]}[{taken[1]}]"
        elif code == ca.OP_CONST:
            register[given[0]] = number(f.instruction_constant(k))
            continue
        else:
            arguments_c = [register[i] for i in taken]
            if code in _BINARY:
                text = _BINARY[code].format(*arguments_c)
            elif code in _LIBM:
                text = f"HMPC_LIBM({_LIBM[code]})({', '.join(arguments_c)})"
            else:
                called = " (a lookup table or a solver)" if code == ca.OP_CALL else ""
                raise InputError(
                    f"{name}: the C export does not support {_NAMES.get(code, code)}{called}. Write the prior with "
                    "other operations"
                    " [HM-EMBEDDED-009]"
                )
            operations += 1
        register[given[0]] = f"t{k}"
        lines.append(f"const real t{k} = {text};")
    unused = [f"(void){a.split('*')[-1].strip()};" for a in arguments]
    body = "".join(f"  {line}\n" for line in (*unused, *before, *lines))
    return f"static inline void {name}({', '.join(arguments)}) {{\n{body}}}\n", operations
