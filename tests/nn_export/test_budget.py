"""What programs cost is bounded before anything is built: from above, by limits that real networks keep."""

import inspect
import typing
from collections.abc import Sequence

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_operators import NAMES, Setup
from torch import nn

from nn_export import (
    Limits,
    Node,
    Port,
    Program,
    ProgramError,
    SideBySide,
    build,
    load_programs,
    save_programs,
    trace,
    with_jacobian,
)
from nn_export.budget import _BOUND, EACH_PROGRAM, Budget, costs
from nn_export.chain import operations
from nn_export.operators import OPERATORS, PLAIN, elementwise, recurrent
from nn_export.operators.costs import COSTS, Cost, Tensor, product
from nn_export.operators.value import Value, broadcast_shape, constant, layout


def total(program):
    """What a program costs: the largest array, and the sums of the rest."""
    parts = [cost for _, cost in costs(program)]
    sums = (sum(getattr(cost, name) for cost in parts) for name in ("memory", "work", "nodes"))
    return Cost(max(cost.elements for cost in parts), *sums)


def repeated(times, declared=None):
    """A program that repeats its input of two numbers."""
    shape = (2 * times,) if declared is None else declared
    node = Node(
        "again", "aten.repeat.default", [{"input": "x"}, [times]], {}, (shape,), "m.py:7: x.repeat(n)"
    )
    return Program((Port("x", (2,)),), (Port("y", shape, {"node": "again"}),), (node,))


def test_a_refusal_names_the_operator_what_it_would_cost_and_the_limit(tmp_path):
    program = repeated(3 * 10**6)
    words = (
        r"node again \(aten.repeat.default\) from m.py:7: x.repeat\(n\): it would come to 6000000 numbers in one "
        r"value, the limit is 4194304;.* limits=nn_export.Limits\(elements=...\)"
    )
    for use in (build, with_jacobian, lambda p: SideBySide(p, 2)):
        with pytest.raises(ProgramError, match=words):
            use(program)
    program.save(tmp_path)
    with pytest.raises(ProgramError, match="programs.json: programs.program: " + words):
        Program.load(tmp_path)


def test_limits_can_be_raised_and_lowered(tmp_path):
    program = repeated(50)
    program.save(tmp_path)
    assert build(Program.load(tmp_path)).size_out(0) == (100, 1)
    for small in (Limits(elements=99), Limits(memory=100), Limits(work=100), Limits(nodes=100)):
        with pytest.raises(ProgramError, match="raise the limit"):
            Program.load(tmp_path, small)
        with pytest.raises(ProgramError, match="raise the limit"):
            build(program, limits=small)
    large = repeated(3 * 10**6)
    large.save(tmp_path)
    more = Limits(elements=2**23)
    assert build(Program.load(tmp_path, more), limits=more).size_out(0) == (6 * 10**6, 1)


def test_the_programs_of_a_folder_share_the_limits(tmp_path):
    one = total(repeated(50)).nodes
    save_programs(tmp_path, {name: repeated(50) for name in "abc"})
    assert len(load_programs(tmp_path, Limits(nodes=3 * one))) == 3
    with pytest.raises(ProgramError, match=r"programs\.c: the outputs: .* before it"):
        load_programs(tmp_path, Limits(nodes=3 * one - 1))


def test_a_shape_that_is_declared_too_small_is_no_way_around():
    with pytest.raises(ProgramError, match="6000000 numbers"):
        build(repeated(3 * 10**6, (2,)))
    with pytest.raises(ProgramError, match=r"gives shapes \(\(100,\),\)"):
        build(repeated(50, (2,)))


@pytest.mark.parametrize(
    ("op", "args", "kwargs", "words"),
    [
        ("aten.select.int", [0, [0, 0]], {}, "index is a list of 2, int is needed"),
        ("aten.add.Tensor", [{"input": "x"}], {"alpha": [1.0]}, "alpha is a list of 1, float is needed"),
        ("aten.elu.default", [{"input": "x"}], {}, r"alpha is a tensor of shape \(2,\), float is needed"),
        ("aten.repeat.default", [["2"]], {}, "repeats is a list of 1, .*int.* is needed"),
        ("aten.select.int", [0, 0.0], {}, "index is 0.0, int is needed"),
        ("aten.tanh.default", [1], {}, "too many"),
    ],
)
def test_arguments_of_other_types_are_refused_before_anything_is_built(op, args, kwargs, words):
    node = Node("n", op, [{"input": "x"}, *args], kwargs, ((2,),))
    program = Program((Port("x", (2,)),), (Port("y", (2,), {"node": "n"}),), (node,))
    with pytest.raises(ProgramError, match=rf"node n .*arguments that nn_export does not know: .*{words}"):
        total(program)


def test_dense_jacobians_are_refused_before_they_are_made():
    node = Node("n", "aten.cumsum.default", [{"input": "x"}, 0], {}, ((1500,),))
    bent = Node("b", "aten.sin.default", [{"node": "n"}], {}, ((1500,),))
    ports = (Port("x", (1500,)),), (Port("y", (1500,), {"node": "b"}),)
    program = Program(*ports, (node, bent))
    build(program)
    for use in (with_jacobian, lambda p: SideBySide(p, 2)):
        with pytest.raises(
            ProgramError, match=r"a Jacobian of 1500 values by 1500: .* elements to be touched"
        ):
            use(program)
    wide = Program((Port("x", (3000,)),), (Port("y", (3000,), {"input": "x"}),), ())
    for use in (with_jacobian, lambda p: SideBySide(p, 2)):
        with pytest.raises(ProgramError, match=r"the Jacobian jacobian: .* numbers in one value"):
            use(wide)


class Recurrent(nn.Module):
    """A network of the size that the defaults are to leave room for."""

    def __init__(self, kind, size, layers):
        super().__init__()
        self.layers = kind(6, size, layers, batch_first=True)
        self.head = nn.Sequential(nn.Linear(size, size), nn.Tanh(), nn.Linear(size, 4))

    def forward(self, x):
        y, _ = self.layers(x[None])
        return self.head(y[0, -1])


@pytest.mark.parametrize(
    ("kind", "size", "layers", "steps"),
    [
        (nn.GRU, 512, 1, 1),
        (nn.LSTM, 512, 2, 1),
        (nn.GRU, 1024, 1, 1),
        pytest.param(nn.GRU, 64, 2, 100, marks=pytest.mark.full),
        pytest.param(nn.LSTM, 32, 1, 400, marks=pytest.mark.full),
    ],
)
def test_real_networks_keep_the_limits_with_room_for_more(kind, size, layers, steps):
    program = trace(Recurrent(kind, size, layers), (torch.zeros(steps, 6),))
    budget = Budget()
    for _ in range(6 if size < 1024 and steps < 100 else 2):
        budget.add(program)


def test_every_operator_has_a_rule():
    assert set(COSTS) == set(OPERATORS)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("inputs", [True, False], ids=["inputs", "weights"])
def test_what_is_built_is_within_what_was_counted(name, inputs):
    program = Setup(name, inputs).program
    cost, function = total(program), build(program, plain=True)
    instructions = own_instructions(function)
    assert len(instructions) <= cost.nodes - EACH_PROGRAM
    assert operations(function) <= cost.work
    assert max(function.instruction_MX(k).numel() for k in instructions or [0]) <= cost.elements
    assert 8 * sum(function.numel_out(i) for i in range(function.n_out())) <= cost.memory


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(shapes=st.lists(st.lists(st.integers(0, 3), max_size=4).map(tuple), max_size=4))
def test_shapes_are_broadcast_as_in_numpy(shapes):
    try:
        expected = np.broadcast_shapes(*shapes)
    except ValueError:
        with pytest.raises(ValueError, match="cannot be broadcast"):
            broadcast_shape(shapes)
    else:
        assert broadcast_shape(shapes) == expected


SHAPES = st.lists(st.integers(0, 3), max_size=3).map(tuple)


@st.composite
def values(draw):
    """A value as the operators take it and as their rules do: a symbol, or small whole numbers."""
    shape = draw(SHAPES)
    size = product(shape)
    if draw(st.booleans()) and 0 not in shape:
        return Value(shape, ca.MX.sym("x", *layout(shape))), Tensor(shape, size, False)
    numbers = draw(st.lists(st.integers(-2, 2), min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
    return constant(np.reshape(np.array(numbers, float), shape)), Tensor(shape, size, True)


def arguments(hint):
    """Pairs of an argument for an operator and for its rule, by the annotation."""
    same = {int: st.integers(-3, 6), float: st.sampled_from([0.0, 1.0, 2, 0.5, -1.0, float("inf")]),
            bool: st.booleans(), str: st.sampled_from(["float64", "float32", "floor", "none"]),
            type(None): st.none(), None: st.none()}  # fmt: skip
    if hint is Value:
        return values()
    if hint in same:
        return same[hint].map(lambda v: (v, v))
    if typing.get_origin(hint) is Sequence:
        parts = st.lists(arguments(typing.get_args(hint)[0]), max_size=4)
        return parts.map(lambda pairs: ([a for a, _ in pairs], [b for _, b in pairs]))
    return st.one_of(*map(arguments, typing.get_args(hint)))


@st.composite
def calls(draw, name):
    hints = typing.get_type_hints(OPERATORS[name])
    args, kwargs = [], {}
    for parameter in inspect.signature(OPERATORS[name]).parameters.values():
        if parameter.default is not parameter.empty and draw(st.booleans()):
            break
        pair = draw(arguments(hints[parameter.name]))
        if parameter.kind is parameter.KEYWORD_ONLY:
            kwargs[parameter.name] = pair
        else:
            args.append(pair)
    return args, kwargs


def compare(name, args, kwargs):
    """An operator gives no more than its rule says."""
    given = [a for a, _ in args], {k: a for k, (a, _) in kwargs.items()}
    known = [t for _, t in args], {k: t for k, (_, t) in kwargs.items()}
    try:
        results = PLAIN[name](*given[0], **given[1])
        results = results if isinstance(results, tuple) else (results,)
        sizes = [product(r.shape) for r in results]
        _BOUND[name](*known)
        cost = COSTS[name](sum(sizes), *known[0], **known[1])
    except (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RuntimeError):
        return  # refused by one of them, as build does it
    assert max(sizes, default=0) <= cost.elements
    assert 8 * sum(sizes) <= cost.memory + 8 * sum(t.size for t in known[0] if isinstance(t, Tensor))
    found = [r.mx for r in results]
    function = ca.Function("f", ca.symvar(ca.veccat(*found)), found)
    assert len(own_instructions(function)) <= cost.nodes
    assert operations(function) <= cost.work + sum(sizes)


def own_instructions(function):
    """Instructions but for inputs and outputs, of which there is one an element that is repeated."""
    kinds = [function.instruction_id(k) for k in range(function.n_instructions())]
    return [k for k, kind in enumerate(kinds) if kind not in (ca.OP_INPUT, ca.OP_OUTPUT)]


ONE_BY_ONE = [n for n in OPERATORS if n != "getitem" and n not in recurrent.OPERATORS]


@pytest.mark.parametrize("share", [1, pytest.param(8, marks=pytest.mark.full)])
@pytest.mark.parametrize("name", ONE_BY_ONE)
def test_no_operator_gives_more_than_its_rule_says(name, share):
    count = share * (5 if name in elementwise.OPERATORS else 25)
    settings(max_examples=count, deadline=None, derandomize=True, database=None)(
        given(call=calls(name))(lambda call: compare(name, *call))
    )()
