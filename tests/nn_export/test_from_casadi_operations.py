"""Every operation of CasADi's scalar graphs as a torch operator."""

import casadi as ca
import numpy as np
import pytest
import torch

from nn_export.batched import OPERATORS, Batched


def example_of(op):
    """A function that contains one operation of the table, with a constant too."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    binary = {
        ca.OP_ADD: x + y, ca.OP_SUB: x - y, ca.OP_MUL: x * y, ca.OP_DIV: x / y, ca.OP_POW: ca.fabs(x) ** y,
        ca.OP_CONSTPOW: ca.fabs(x) ** 2.5, ca.OP_LT: x < y, ca.OP_LE: x <= y, ca.OP_EQ: x == y, ca.OP_NE: x != y,
        ca.OP_AND: ca.logic_and(x > 0, y > 0), ca.OP_OR: ca.logic_or(x > 0, y > 0), ca.OP_NOT: ca.logic_not(x > 0),
        ca.OP_FMIN: ca.fmin(x, 0.1), ca.OP_FMAX: ca.fmax(x, 0.1), ca.OP_FMOD: ca.fmod(x, 0.4),
        ca.OP_COPYSIGN: ca.copysign(0.3, x), ca.OP_ATAN2: ca.atan2(x, y), ca.OP_HYPOT: ca.hypot(x, y),
        ca.OP_IF_ELSE_ZERO: ca.if_else(x > 0, y, 3), ca.OP_NEG: -x, ca.OP_TWICE: 2 * x, ca.OP_SQ: x**2,
        ca.OP_INV: 1 / x, ca.OP_FABS: ca.fabs(x), ca.OP_SIGN: ca.sign(x), ca.OP_FLOOR: ca.floor(3 * x),
        ca.OP_CEIL: ca.ceil(3 * x), ca.OP_LOG: ca.log(ca.fabs(x)), ca.OP_LOG1P: ca.log1p(ca.fabs(x)),
        ca.OP_SQRT: ca.sqrt(ca.fabs(x)), ca.OP_EXP: ca.exp(x), ca.OP_EXPM1: ca.expm1(x), ca.OP_ERF: ca.erf(x),
        ca.OP_SIN: ca.sin(x), ca.OP_COS: ca.cos(x), ca.OP_TAN: ca.tan(x), ca.OP_SINH: ca.sinh(x),
        ca.OP_COSH: ca.cosh(x), ca.OP_TANH: ca.tanh(x), ca.OP_ASIN: ca.asin(ca.tanh(x)),
        ca.OP_ACOS: ca.acos(ca.tanh(x)),
        ca.OP_ATAN: ca.atan(x), ca.OP_ASINH: ca.asinh(x), ca.OP_ACOSH: ca.acosh(1 + x**2),
        ca.OP_ATANH: ca.atanh(ca.tanh(x) / 2),
    }  # fmt: skip
    return ca.Function("one", [x, y], [binary[op], 4.0]) if op in binary else None


@pytest.mark.parametrize("op", sorted(OPERATORS))
def test_every_operation_as_a_torch_operator(op):
    function = example_of(op)
    if op in (ca.OP_ASSIGN, ca.OP_LIFT):  # never made by a symbolic expression here
        assert OPERATORS[op](*[torch.ones(1)] * (1 + (op == ca.OP_LIFT))) == 1
        return
    codes = {function.instruction_id(k) for k in range(function.n_instructions())}
    assert op in codes
    batched = Batched(function)
    values = torch.tensor(np.random.default_rng(0).uniform(-1, 1, (2, 40, 1)))
    values[1, ::4] = values[0, ::4]  # equal ones too
    walked, run = batched.walk(list(values), (40,)), batched._run(list(values), 40)
    for a, b in zip(walked, run, strict=True):
        assert torch.allclose(a, b, rtol=1e-13, atol=0)  # two libraries' elementary functions
