"""Expressions of scalars as programs and back: the same numbers, the same slopes, plain data on the way."""

import json
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_from_casadi_operations import example_of

from nn_export import Limits, Program, build, load_programs, program_of, save_programs
from nn_export.batched import OPERATORS
from nn_export.errors import ProgramError, SignatureError, UnsupportedOperatorError
from nn_export.program import from_json, to_json

UNARY = (
    ca.sin, ca.cos, ca.tan, ca.tanh, ca.sinh, ca.cosh, ca.atan, ca.asinh, ca.erf, ca.fabs, ca.sign, ca.floor, ca.ceil,
    lambda a: ca.exp(ca.tanh(a)), lambda a: ca.log(1 + a**2), lambda a: ca.sqrt(1 + a**2), lambda a: -a,
    lambda a: 1 / (2 + ca.cos(a)), lambda a: ca.asin(ca.tanh(a) / 2), lambda a: ca.acos(ca.tanh(a) / 2),
    lambda a: ca.atanh(ca.tanh(a) / 2), lambda a: ca.acosh(2 + a**2), lambda a: ca.log1p(a**2), lambda a: 2 * a,
    lambda a: ca.expm1(ca.tanh(a)), lambda a: a**2, lambda a: (1 + a**2) ** 1.7, lambda a: ca.logic_not(a > 0.1),
)  # fmt: skip
BINARY = (
    lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / (1 + b**2), ca.fmin, ca.fmax,
    lambda a, b: (1 + a**2) ** ca.tanh(b), lambda a, b: ca.if_else(a < b, a**2, ca.sin(b)), ca.atan2, ca.hypot,
    lambda a, b: ca.if_else(ca.logic_and(a > 0, b <= 0.3), 1.5, b), ca.copysign,
    lambda a, b: ca.fmod(a, 1.5 + ca.cos(b)),
    lambda a, b: ca.if_else(ca.logic_or(a > b, a == b), b, -3.0),
    lambda a, b: ca.if_else(a != b, ca.sqrt(ca.fabs(a)), 0),
)  # fmt: skip


def expression(kind, choices):
    """A random function (x, u) of n values: each choice combines what there is."""
    x, u = kind.sym("x", 3), kind.sym("u")
    values = [x[0], x[1], u, x[2], kind(0.7)]
    for op, i, j in choices:
        a, b = values[i % len(values)], values[j % len(values)]
        # tanh keeps the numbers of order 1, whatever is combined with whatever
        made = UNARY[op](a) if op < len(UNARY) else BINARY[op - len(UNARY)](a, b)
        values.append(made if op % 3 else ca.tanh(made))
    return ca.Function("f", [x, u], [ca.vertcat(*values[-3:]), values[-1] * x[1]], ["x", "u"], ["e", "c"])


def with_slopes(f):
    x, u = ca.MX.sym("x", 3), ca.MX.sym("u")
    results = f(x, u)
    slopes = [ca.densify(ca.jacobian(r, v)) for r in results for v in (x, u)]
    return ca.Function("all", [x, u], [*map(ca.densify, results), *slopes])


CHOICES = st.lists(
    st.tuples(st.integers(0, len(UNARY) + len(BINARY) - 1), st.integers(0, 40), st.integers(0, 40)),
    min_size=1,
    max_size=25,
)


@settings(max_examples=25, deadline=None)
@given(choices=CHOICES, symbols=st.sampled_from([ca.SX, ca.MX]), seed=st.integers(0, 2**31))
def test_random_expressions_come_back(choices, symbols, seed):
    f = expression(symbols, choices)
    program = program_of(f)
    data = json.loads(json.dumps(to_json(program), allow_nan=False))
    g = build(from_json(data, {}, "here"))
    assert [g.name_in(i) for i in range(2)] == ["x", "u"]
    assert [g.name_out(i) for i in range(2)] == ["e", "c"]
    rng = np.random.default_rng(seed)
    for _ in range(3):
        point = rng.normal(size=3), rng.normal()
        for ours, theirs in zip(with_slopes(g)(*point), with_slopes(f)(*point), strict=True):
            # The same operations; SX and MX sum the terms of a slope in another order.
            np.testing.assert_allclose(ours.full(), theirs.full(), rtol=1e-13, atol=1e-13)
    # What was built gives the same program again, so that problems can be compared by it.
    assert to_json(program_of(g)) == data


@pytest.mark.parametrize("op", sorted(OPERATORS))
def test_every_operation_that_torch_has_is_stated(op):
    function = example_of(op)
    if function is None:  # never made by a symbolic expression
        assert op in (ca.OP_ASSIGN, ca.OP_LIFT)
        return
    built = build(program_of(function))
    for x, y in [*np.random.default_rng(0).uniform(-1, 1, (20, 2)).tolist(), [0.5, 0.5]]:
        for ours, theirs in zip(built(x, y), function(x, y), strict=True):
            assert float(ours) == float(theirs)


def test_programs_of_expressions_are_saved_with_others(tmp_path):
    x, p = ca.SX.sym("x", 2, 2), ca.SX.sym("p", 0)
    sparse = ca.SX(ca.Sparsity.upper(2))
    sparse[0, 1] = x[1, 0] ** 2
    f = ca.Function("f", [x, p], [sparse, ca.SX(np.inf), ca.SX(0, 1), x[:, 1]])
    save_programs(tmp_path, {"f": program_of(f)})
    (found,) = load_programs(tmp_path).values()
    built, at = build(found), np.array([[1.0, 2.0], [3.0, 4.0]])
    y, infinite, none, column = built(at, [])
    assert y.full().tolist() == [[1.0, 9.0], [0.0, 1.0]]
    assert float(infinite) == np.inf
    assert none.shape == (0, 1)
    assert column.full().ravel().tolist() == [2.0, 4.0]
    assert found.weights == {}


def test_what_cannot_be_stated_is_refused_by_name():
    x, p = ca.MX.sym("x"), ca.MX.sym("p")
    root = ca.rootfinder("root", "newton", {"x": x, "p": p, "g": x**3 - p})
    inner = ca.Function("inner", [p], [root(1.0, p)])
    with pytest.raises(UnsupportedOperatorError, match=r"cost.*root \(Newton\).*NN-024"):
        program_of(ca.Function("cost", [p], [inner(p) ** 2]))
    s = ca.SX.sym("s")
    with pytest.raises(UnsupportedOperatorError, match=r"OP_ERFINV.*NN-028"):
        program_of(ca.Function("cost", [s], [ca.erfinv(s)]))
    with pytest.raises(SignatureError, match=r"function.*NN-026"):
        program_of(lambda x, u: x)
    free = ca.Function("free", [s], [s * ca.SX.sym("price")], {"allow_free": True})
    with pytest.raises(SignatureError, match=r"price.*NN-027"):
        program_of(free)


def test_an_expression_within_the_budget_of_programs():
    s = ca.SX.sym("s")
    long = s
    for _ in range(1000):
        long = ca.sin(long)
    f = ca.Function("long", [s], [long])
    assert isinstance(program_of(f), Program)
    with pytest.raises(ProgramError, match=r"long.*1000.*NN-025"):
        program_of(f, Limits(nodes=12_000))
    with pytest.raises(ProgramError, match="NN-112"):
        program_of(f, Limits(nodes=12_100))
    a, b = ca.MX.sym("a", 400, 400), ca.MX.sym("b", 400)
    dense = ca.Function("dense", [a, b], [a @ (a @ (a @ b))])
    with pytest.raises(ProgramError, match="NN-025"):  # at once: it is not written out
        program_of(dense)


def test_nodes_stand_in_the_order_of_computation():
    x = ca.SX.sym("x")
    program = program_of(ca.Function("f", [x], [ca.sin(x) * ca.cos(x)]))
    assert [n.op.split(".")[1] for n in program.nodes] == ["select", "sin", "cos", "mul", "stack"]
    assert all(int(a.name[1:]) < int(b.name[1:]) for a, b in pairwise(program.nodes))
