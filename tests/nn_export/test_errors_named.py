"""What cannot be exported is refused by name, all of it at once, with the line and a remedy."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from export_parts import Call
from torch import nn
from torch.nn import functional as F

from nn_export import ExportError, Node, Port, Program, ProgramError, build, to_casadi, trace
from nn_export.errors import (
    ControlFlowError,
    DtypeError,
    DynamicShapeError,
    HiddenStateError,
    ShapeError,
    SignatureError,
    TrainingModeError,
    UnsupportedOperatorError,
)

X = torch.zeros(4)


class Unknown(nn.Module):
    def forward(self, x):
        a = torch.sort(x).values
        b = torch.special.i0(x)
        return a + b + torch.lgamma(x)


def test_all_unsupported_operators_at_once_with_lines():
    with pytest.raises(UnsupportedOperatorError) as caught:
        trace(Unknown(), (X,))
    text = str(caught.value)
    for name, line in (
        ("aten.sort", "torch.sort(x).values"),
        ("aten.i0", "torch.special.i0(x)"),
        ("aten.lgamma", "torch.lgamma(x)"),
    ):
        row = next(r for r in text.splitlines() if name in r)
        assert "test_errors_named.py:" in row
        assert line in row
    assert "docs/operators.md" in text


def _masked_write(x):
    y = x * 1
    y[torch.tensor([True, False, True, False])] = 0.0
    return y


def _twice(x):
    return x.index_put((torch.tensor([0, 0]),), x[:2], accumulate=True)


@pytest.mark.parametrize(
    ("f", "error", "words"),
    [
        (lambda x: x[x > 0], DynamicShapeError, "torch.where"),
        (lambda x: torch.nonzero(x).double(), DynamicShapeError, "depend on the values"),
        (lambda x: x * float(x[0]), ControlFlowError, "torch.where"),
        (lambda x: -x if x.sum() > 1 else x, ControlFlowError, "torch.where"),
        (lambda x: torch.view_as_real(torch.fft.fft(x)), DtypeError, "complex"),
        (lambda x: torch.complex(x, x), DtypeError, "complex"),
        (lambda x: x > 0, DtypeError, "bool"),
        (lambda x: x.long(), DtypeError, "int64"),
        (lambda x: x.half().double(), DtypeError, "float16"),
        (lambda x: x + torch.arange(0, 0.4, 0.1)[:4].sin(), DtypeError, "float64"),
        (lambda x: (x > 0) * 0.1 * x, DtypeError, "float32"),
        (lambda x: F.dropout(x), TrainingModeError, "training=self.training"),
        (lambda x: x + torch.rand(4, dtype=x.dtype), TrainingModeError, "random"),
        (lambda x: x + torch.randn_like(x), TrainingModeError, "random"),
        (lambda x: ((x > 0) + (x > 1)).double(), UnsupportedOperatorError, "true and false"),
        (lambda x: (x.long() & (2 * x).long()).double(), UnsupportedOperatorError, "bits of integers"),
        (_masked_write, ExportError, "where"),
        (_twice, UnsupportedOperatorError, "too many positional"),
        (lambda x: torch.linalg.svdvals(torch.diag(x)), UnsupportedOperatorError, "linalg_svd"),
        (lambda x: torch.round(x, decimals=2), UnsupportedOperatorError, "round.decimals"),
        (lambda x: x.mul_(2), HiddenStateError, "input"),
    ],
)
def test_named_errors(f, error, words):
    with pytest.raises(error, match=words):
        to_casadi(Call(f), (X,))


def test_a_factor_that_float32_holds_is_exact():
    # 0.5 (x > 0) is exact in float32, 0.1 (x > 0) is not: the one passes, the other is refused above.
    function = to_casadi(Call(lambda x: (x > 0) * 0.5 * x + torch.where(x > 1, 1.0, 0.0)), (X,))
    assert function([-1, 1, 2, 3]).full().ravel().tolist() == [0, 0.5, 2, 2.5]


def test_batch_statistics_are_refused():
    with pytest.raises(TrainingModeError, match="track_running_stats"):
        trace(nn.BatchNorm1d(4, track_running_stats=False), (torch.zeros(3, 4),))


class Counter(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("count", torch.zeros(4))

    def forward(self, x):
        self.count += x
        return self.count * 2


def test_hidden_state_is_refused_and_the_module_unchanged():
    module = Counter()
    with pytest.raises(HiddenStateError, match=r"count.*NN-018"):
        trace(module, (X,))
    assert torch.equal(module.count, torch.zeros(4))


@pytest.mark.parametrize(
    ("module", "inputs", "words"),
    [
        (nn.Linear(3, 2), (X,), "NN-114"),
        (nn.Linear(4, 2), (X, X), "NN-114"),
        (nn.GRUCell(3, 2), (torch.zeros(3), torch.zeros(5)), "NN-114"),
        (nn.Linear(4, 2), (X.long(),), "NN-110"),
        (nn.Linear(4, 2), (torch.zeros(4, dtype=torch.complex128),), "NN-110"),
        (nn.LSTMCell(4, 2), (X, (torch.zeros(2), 3)), r"1_1.*NN-110"),
        (nn.Linear(4, 2), X, "NN-109"),
        (torch.sin, (X,), "Module"),
        (Call(lambda x: (x, 3)), (X,), "NN-022"),
        (Call(lambda x: {"a b__": x, "a_b": x}), (X,), "differ"),
    ],
)
def test_inputs_that_do_not_fit(module, inputs, words):
    with pytest.raises(SignatureError, match=words):
        trace(module, inputs)


def test_three_axes_are_refused_by_name_outside_and_allowed_inside():
    with pytest.raises(ShapeError, match="NN-065"):
        to_casadi(Call(torch.sin), (torch.zeros(2, 3, 4),))
    with pytest.raises(ShapeError, match="NN-065"):
        to_casadi(Call(lambda x: x[:, :, None].expand(2, 2, 3)), (torch.zeros(2, 2),))
    function = to_casadi(Call(lambda x: x[:, :, None].expand(2, 2, 3).sum(0)), (torch.zeros(2, 2),))
    assert function(np.array([[1, 2], [3, 4]])).full().tolist() == [[4, 4, 4], [6, 6, 6]]


class Nested(nn.Module):
    def forward(self, state, u):
        x, h = state["x"], state["h"]
        return {"x": x + u, "more": (h[0] * 2, {"last": h[1]})}


def test_names_of_nested_inputs_and_outputs():
    state = {"x": torch.zeros(2), "h": (torch.zeros(3), torch.zeros(1, 4))}
    function = to_casadi(Nested(), (state, torch.zeros(1)))
    assert function.name_in() == ["state_x", "state_h_0", "state_h_1", "u"]
    assert function.name_out() == ["x", "more_0", "more_1_last"]
    results = function(state_x=[1, 2], state_h_0=[1, 1, 1], state_h_1=[4, 3, 2, 1], u=0.5)
    assert results["x"].full().ravel().tolist() == [1.5, 2.5]
    assert results["more_1_last"].full().ravel().tolist() == [4, 3, 2, 1]


def test_arguments_that_are_not_known_are_refused_in_programs_too():
    ports = (Port("x", (2,)),), (Port("y", (2,), {"node": "n"}),)
    node = Node(
        "n", "aten.gelu.default", [{"input": "x"}], {"approximate": "cubic"}, ((2,),), "m.py:3: gelu(x)"
    )
    with pytest.raises(ProgramError, match="NN-051"):
        build(Program(*ports, (node,)))
    node = Node("n", "aten.tanh.default", [{"input": "x"}], {"inplace": True}, ((2,),))
    with pytest.raises(ProgramError, match=r"inplace.*NN-041"):
        build(Program(*ports, (node,)))


def evaluate(program):
    """Bits of values and Jacobian of a program at a fixed point."""
    function = build(program)
    point = [np.linspace(-1, 1, function.size1_in(i)) for i in range(function.n_in())]
    results = [*function.call(point), *function.jacobian().call([*point, *function.call(point)])]
    return b"".join(r.full().tobytes() for r in results)


@pytest.fixture(scope="module")
def program():
    torch.manual_seed(0)
    return trace(nn.GRUCell(3, 16), (torch.zeros(3), torch.zeros(16)))


@pytest.mark.parametrize("how", ["threads", "fork", pytest.param("spawn", marks=pytest.mark.full)])
def test_pools_give_the_same_bits(program, how):
    expected = evaluate(program)
    if how == "threads":
        with ThreadPoolExecutor(2) as pool:
            assert list(pool.map(evaluate, [program] * 6)) == [expected] * 6
    else:
        with multiprocessing.get_context(how).Pool(2) as pool:
            assert pool.map(evaluate, [program] * 3) == [expected] * 3


def test_threads_share_one_function(program):
    function = build(program)
    points = [np.linspace(-k, 1, 16) for k in range(8)]
    expected = [function([1, 2, 3], p).full().tobytes() for p in points]
    with ThreadPoolExecutor(2) as pool:
        given = list(pool.map(lambda p: function([1, 2, 3], p).full().tobytes(), points * 5))
    assert given == expected * 5
