"""What programs cost is bounded before anything is built: from above, by limits that real networks keep."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
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
from nn_export.budget import EACH_OPERATOR, EACH_PORT, EACH_PROGRAM, Budget
from nn_export.operators.value import LARGEST, UNROLLED, broadcast_shape


def repeated(times, declared=None):
    """A program that repeats its input of two numbers."""
    shape = (2 * times,) if declared is None else declared
    node = Node(
        "again", "aten.repeat.default", [{"input": "x"}, [times]], {}, (shape,), "m.py:7: x.repeat(n)"
    )
    return Program((Port("x", (2,)),), (Port("y", shape, {"node": "again"}),), (node,))


def test_a_refusal_names_the_operator_what_it_would_cost_and_the_limit(tmp_path):
    program = repeated(3 * 10**6)
    words = r".*4194304.*elements=.*NN-112"
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
    for small in (Limits(elements=99), Limits(memory=100), Limits(nodes=100)):
        with pytest.raises(ProgramError, match="NN-112"):
            Program.load(tmp_path, small)
        with pytest.raises(ProgramError, match="NN-112"):
            build(program, limits=small)
    large = repeated(3 * 10**6)
    large.save(tmp_path)
    more = Limits(elements=2**23)
    assert build(Program.load(tmp_path, more), limits=more).size_out(0) == (6 * 10**6, 1)


def test_the_programs_of_a_folder_share_the_limits(tmp_path):
    one = EACH_PROGRAM + 2 * EACH_PORT + EACH_OPERATOR
    save_programs(tmp_path, {name: repeated(50) for name in "abc"})
    assert len(load_programs(tmp_path, Limits(nodes=3 * one))) == 3
    with pytest.raises(ProgramError, match="NN-112"):
        load_programs(tmp_path, Limits(nodes=3 * one - 1))


def one_node(op, args, shape, kwargs=None, inputs=(2,), weights=None):
    """A program of one operator on ``x`` of shape ``inputs`` that declares a result of ``shape``."""
    node = Node("n", op, args, {} if kwargs is None else kwargs, (shape,))
    return Program((Port("x", inputs),), (Port("y", shape, {"node": "n"}),), (node,), weights or {})


X, W, V = {"input": "x"}, {"weight": "w"}, {"weight": "v"}
MANY = 2**13  # squared it is more than an operator may make


@pytest.mark.parametrize(
    ("op", "args", "inputs", "weights"),
    [
        ("aten.repeat.default", [X, [MANY, MANY]], (2,), {}),
        ("aten.expand.default", [X, [MANY, MANY, 2]], (2,), {}),
        ("aten.full.default", [[MANY, MANY], 1.0], (2,), {}),
        ("aten.arange.start_step", [0, MANY**2], (2,), {}),
        ("aten.constant_pad_nd.default", [X, [0, MANY**2]], (2,), {}),
        ("aten.add.Tensor", [W, V], (2,), {"w": np.ones((MANY, 1)), "v": np.ones((1, MANY))}),
        ("aten.mm.default", [W, V], (2,), {"w": np.ones((MANY, 1)), "v": np.ones((1, MANY))}),
        ("aten.linear.default", [W, W], (2,), {"w": np.ones((MANY, 1))}),
        ("aten.unfold.default", [X, 0, MANY, 1], (2 * MANY,), {}),
        ("aten.cumsum.default", [X, 0], (MANY,), {}),
        ("aten.index.Tensor", [X, [W]], (MANY, 2), {"w": np.zeros((MANY, MANY // 2))}),
        ("aten.index.Tensor", [X, [W, V]], (2, 2), {"w": np.zeros((MANY, 1)), "v": np.zeros((1, MANY))}),
        ("aten.index_select.default", [X, 1, W], (MANY, 2), {"w": np.zeros(MANY)}),
        ("aten.embedding.default", [X, W], (2, MANY), {"w": np.zeros(MANY)}),
    ],
)
def test_a_shape_that_is_declared_too_small_is_no_way_around(op, args, inputs, weights):
    with pytest.raises(ProgramError, match=f"at most {LARGEST}"):
        build(one_node(op, args, (2,), inputs=inputs, weights=weights), limits=Limits(elements=2**26))


@pytest.mark.parametrize("op", ["aten.cumprod.default", "aten.max.dim", "aten.amax.default"])
def test_no_operator_goes_along_a_long_axis_step_by_step(op):
    along = [0] if op == "aten.amax.default" else 0
    with pytest.raises(ProgramError, match=f"at most {UNROLLED}"):
        build(one_node(op, [X, along], (1,), inputs=(UNROLLED + 1,)))


def test_results_of_other_shapes_than_declared_are_refused():
    with pytest.raises(ProgramError, match=r"\(\(100,\),\).*NN-043"):
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
def test_arguments_of_other_types_are_refused(op, args, kwargs, words):
    with pytest.raises(ProgramError, match=rf"node n .*arguments that nn_export does not support: .*{words}"):
        build(one_node(op, [X, *args], (2,), kwargs))


def test_dense_jacobians_are_refused_before_they_are_made():
    node = Node("n", "aten.cumsum.default", [{"input": "x"}, 0], {}, ((1500,),))
    bent = Node("b", "aten.sin.default", [{"node": "n"}], {}, ((1500,),))
    ports = (Port("x", (1500,)),), (Port("y", (1500,), {"node": "b"}),)
    program = Program(*ports, (node, bent))
    build(program)
    for use in (with_jacobian, lambda p: SideBySide(p, 2)):
        with pytest.raises(ProgramError, match="NN-112"):
            use(program)
    wide = Program((Port("x", (3000,)),), (Port("y", (3000,), {"input": "x"}),), ())
    for use in (with_jacobian, lambda p: SideBySide(p, 2)):
        with pytest.raises(ProgramError, match="NN-112"):
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


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(shapes=st.lists(st.lists(st.integers(0, 3), max_size=4).map(tuple), max_size=4))
def test_shapes_are_broadcast_as_in_numpy(shapes):
    try:
        expected = np.broadcast_shapes(*shapes)
    except ValueError:
        with pytest.raises(ValueError, match="NN-070"):
            broadcast_shape(shapes)
    else:
        assert broadcast_shape(shapes) == expected
