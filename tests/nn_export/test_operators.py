"""Every operator of the table against torch."""

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch

from nn_export import Node, Port, Program, build
from nn_export.operators import OPERATORS
from nn_export.operators.elementwise import OPERATORS as ELEMENTWISE
from nn_export.operators.table import GROUPS, NOTES, document, short
from nn_export.operators.value import constant, matrix_shape

A = torch.ops.aten
A34, B34 = (
    torch.linspace(0.11, 0.93, 12).double().reshape(3, 4),
    torch.linspace(0.9, 0.2, 12).double().reshape(3, 4),
)
V4, V3, M43 = B34[0].clone(), A34[:, 0].clone(), B34.T.clone()
I2 = torch.tensor([2.0, 0.0]).double()
ROWS = torch.tensor([[0.0], [1.0], [3.0]]).double()
G33 = torch.tensor(
    [[0.1, 2.0, -0.3], [1.5, 0.4, 0.2], [0.3, -0.6, 1.1]]
).double()  # the second row is the first pivot
S33, L33 = G33 @ G33.T + torch.eye(3).double(), torch.tril(G33) + torch.eye(3).double()
W244 = torch.linspace(-1, 1, 32).double().reshape(2, 4, 4)


def _gates(k):
    torch.manual_seed(k)
    shapes = [(k * 2, 4), (k * 2, 2), (k * 2,), (k * 2,)]
    return [torch.randn(s, dtype=torch.float64) for s in shapes]


def _layer(k):
    torch.manual_seed(k)
    sizes = (4, 4, 4, 4)  # two layers of two directions: the second takes both outputs
    return [torch.randn(s).double() for n in sizes for s in ((k * 2, n), (k * 2, 2), (k * 2,), (k * 2,))]


X314, H = A34[:, None], torch.linspace(-1, 1, 8).double().reshape(4, 1, 2)
FLAGS = (True, 2, 0.0, False, True, False)
CASES = {
    "add.Tensor": (A34, V4), "sub.Tensor": (A34, V4), "rsub.Tensor": (A34, V4),
    "div.Tensor_mode": ((A34, V4), {"rounding_mode": "floor"}),
    "div.Scalar_mode": ((A34, 0.3), {"rounding_mode": "trunc"}), "clamp.default": (A34, 0.3, 0.6),
    "clamp.Tensor": (A34, V4), "clamp_min.default": (A34, 0.5), "where.self": (A34.round(), A34, V4),
    "hardtanh.default": (A34, 0.2, 0.5), "elu.default": (A34 - 0.5, 1.2, 0.9, 1.1),
    "celu.default": (A34 - 0.5, 1.3),
    "leaky_relu.default": (A34 - 0.5, 0.1), "relu.default": (A34 - 0.5,), "softplus.default": (A34, 2.0, 1.0),
    "gelu.default": ((A34 - 0.5,), {"approximate": "tanh"}), "acosh.default": (A34 + 1,),
    "_to_copy.default": (A34,), "round.default": (4 * A34 - 2,), "trunc.default": (4 * A34 - 2,),
    "slice.Tensor": (A34, 1, 0, 4, 2), "select.int": (A34, 1, -1), "unsqueeze.default": (A34, 1),
    "squeeze.dims": (X314, [1]), "squeeze.dim": (X314, 1),
    "view.default": (A34, [2, 6]), "reshape.default": (A34, [6, -1]),
    "_unsafe_view.default": (A34, [12]), "permute.default": (A34, [1, 0]), "transpose.int": (A34, 0, -1),
    "expand.default": (V4, [3, 4]), "repeat.default": (V4, [2, 3]), "flip.default": (A34, [0]),
    "diagonal.default": (A34, 1), "index_select.default": (A34, 1, I2), "index.Tensor": (A34, [None, I2]),
    "cat.default": ([A34, B34], 1), "stack.default": ([V4, V4], 1),
    "split_with_sizes.default": (A34, [1, 3], 1),
    "constant_pad_nd.default": (A34, [1, 2, 0, 1], 0.5), "full.default": ([2, 3], 0.1),
    "full_like.default": (A34, 0.1), "scalar_tensor.default": (0.1,), "arange.start_step": (1, 5, 2),
    "mm.default": (A34, M43), "bmm.default": (A34[None], M43[None]), "mv.default": (A34, V4),
    "dot.default": (V4, V4), "addmm.default": ((V3, A34, M43), {"beta": 0.5, "alpha": 2.0}),
    "addmv.default": ((V3, A34, V4), {"beta": 0.5, "alpha": 2.0}), "linear.default": (A34, B34, V3),
    "layer_norm.default": (A34, [4], V4, V4), "sum.dim_IntList": (A34, [1], True),
    "_native_batch_norm_legit_no_training.default": (A34, V4, V4, V4, V4, 0.1, 1e-5),
    "mean.dim": (A34, [0]), "var.correction": ((A34, [1]), {"correction": 0.0}),
    "std.correction": ((A34, [0]), {"correction": 1.0}),
    "amax.default": (A34, [0]),
    "amin.default": (A34, [1], True), "prod.dim_int": (A34, 0), "linalg_vector_norm.default": (A34, 2.0, [1]),
    "logsumexp.default": (A34, [1]), "_softmax.default": (A34, 0, False),
    "_log_softmax.default": (A34, 1, False),
    "cumsum.default": (A34, 0), "gru.input": (X314, H, _layer(3), *FLAGS),
    "rnn_tanh.input": (X314, H, _layer(1), *FLAGS), "rnn_relu.input": (X314, H, _layer(1), *FLAGS),
    "lstm.input": (X314, [H, H / 2], _layer(4), *FLAGS), "gru_cell.default": (A34, A34[:, :2], *_gates(3)),
    "rnn_tanh_cell.default": (A34, A34[:, :2], *_gates(1)),
    "rnn_relu_cell.default": (A34, A34[:, :2], *_gates(1)),
    "unfold.default": (V4, 0, 2, 1), "gather.default": (A34, 1, ROWS), "embedding.default": (A34, I2),
    "slice_scatter.default": (A34, B34[:, :2], 1, 0, 4, 2), "select_scatter.default": (A34, V3, 1, 2),
    "index_put.default": (A34, [None, I2], B34[:, :2]), "scatter.src": (A34, 1, ROWS, B34),
    "copy.default": (A34, V4), "std.dim": (A34, [1]), "std_mean.dim": (A34, [1]),
    "var_mean.correction": ((A34, [1]), {"correction": 1.0}), "max.dim": (A34, 1), "min.dim": (A34, 0, True),
    "any.dim": (A34.round(), 1), "any.dims": (A34.round(), [0]), "dist.default": (A34, B34, 3.0),
    "cumprod.default": (A34, 0), "_trilinear.default": (A34, W244, B34, [1, 3], [0], [1, 2], [2, 3]),
    "native_group_norm.default": (A34[None], V3, V3 + 1, 1, 3, 4, 3, 1e-5),
    "lstm_cell.default": (A34, [A34[:, :2], A34[:, 1:3]], *_gates(4)),
    "linalg_solve.default": (G33, V3), "linalg_inv.default": (G33,), "linalg_det.default": (G33,),
    "linalg_cholesky.default": (S33,), "cholesky_solve.default": (A34, L33), "cholesky_inverse.default": (L33,),
    "linalg_solve_triangular.default": ((L33, A34), {"upper": False}),
}  # fmt: skip


def _case(name):
    short = name.removeprefix("aten.")
    if short in CASES:
        case = CASES[short]
        return case if len(case) == 2 and isinstance(case[1], dict) else (case, {})
    if "Scalar" in short and short != "pow.Scalar":
        return (A34, 0.4), {}
    if short == "pow.Scalar":
        return (0.4, A34), {}
    many = [
        "Tensor",
        "atan2",
        "fmax",
        "fmin",
        "hypot",
        "imum",
        "logical_and",
        "logical_or",
        "logical_xor",
        "pow",
    ]
    if name in ELEMENTWISE and any(m in short for m in many):
        return (A34, V4), {}
    return (A34,), {}  # operators of one tensor


# test_operator_slopes
NAMES = [name for name in OPERATORS if name not in ("getitem", "aten.empty.memory_format")]
RECURRENT = ("gru", "lstm", "rnn")
INDEXED = ("index", "gather", "scatter", "embedding")
# test_operator_slopes
OWN_SLOPES = {
    "aten.celu.default",
    "aten.detach.default",
    "aten.native_group_norm.default",
    "aten.copy.default",
    # torch's slopes by the elements above the diagonal, which neither reads, are not zero: see test_systems
    "aten.cholesky_solve.default",
    "aten.cholesky_inverse.default",
}


class Setup:
    """One operator as torch calls it, and as a program whose first tensors are inputs."""

    def __init__(self, name, inputs):
        self.name = name
        self.args, self.kwargs = _case(name)
        self.base, overload = name.removeprefix("aten.").split(".")
        self.op = getattr(getattr(A, self.base), overload)
        self.extra = {"dtype": torch.float64} if self.base in ("full", "scalar_tensor", "arange") else {}
        self.tensors, self.free, self.weights = [], [], {}
        self.data = [self.reference(a, inputs and self.may_be_input(k)) for k, a in enumerate(self.args)]
        self.expected = self.torch(*self.tensors)
        shapes = tuple(tuple(e.shape) for e in self.expected)
        nodes, ports = (
            [Node("n", name, self.data, self.kwargs, shapes)],
            [Port("y", shapes[0], {"node": "n"})],
        )
        if len(shapes) > 1:
            nodes += [Node(f"g{i}", "getitem", [{"node": "n"}, i], {}, (s,)) for i, s in enumerate(shapes)]
            ports = [Port(f"y{i}", s, {"node": f"g{i}"}) for i, s in enumerate(shapes)]
        symbols = [Port(f"x{i}", tuple(t.shape)) for i, t in enumerate(self.tensors)]
        self.program = Program(tuple(symbols), tuple(ports), tuple(nodes), self.weights)

    def may_be_input(self, k):
        return not (
            self.base.startswith(("bitwise", "logical"))
            or (self.base == "where" and k == 0)
            or (self.base.startswith(INDEXED) and k > 0)
            or (self.base == "_trilinear" and k == 1)  # three axes
            or (self.base.startswith(RECURRENT) and k > 1)  # weights are constant
            # statistics: no slope in torch
            or (self.base == "_native_batch_norm_legit_no_training" and k > 2)
        )

    def torch_side(self, a, k):
        if self.base.startswith(INDEXED) and (a is I2 or a is ROWS):
            return a.long()
        if isinstance(a, torch.Tensor) and (
            self.base.startswith("bitwise") or (self.base == "where" and k == 0)
        ):
            return a > 0.5
        return [self.torch_side(v, k) for v in a] if isinstance(a, list) else a

    def reference(self, a, free):
        if isinstance(a, list | tuple):
            return [self.reference(v, free) for v in a]
        if not isinstance(a, torch.Tensor):
            return a
        if free:
            self.tensors.append(a)
            return {"input": f"x{len(self.tensors) - 1}"}
        key = f"w{len(self.weights)}"
        value = (a > 0.5) if self.base.startswith("bitwise") else a
        self.weights[key] = value.double().numpy()
        return {"weight": key}

    def torch(self, *tensors):
        left = list(tensors)

        def fill(a, data):
            if isinstance(a, list):
                return [fill(v, d) for v, d in zip(a, data, strict=True)]
            return left.pop(0) if isinstance(data, dict) and "input" in data else a

        sides = [self.torch_side(a, k) for k, a in enumerate(self.args)]
        filled = [fill(a, d) for a, d in zip(sides, self.data, strict=True)]
        result = self.op(*filled, **self.kwargs, **self.extra)
        return tuple(result) if isinstance(result, tuple | list) else (result,)


@pytest.mark.parametrize("name", NAMES)
def test_operator_against_torch(name):
    setup = Setup(name, inputs=False)
    results = build(setup.program).call([])
    for result, e in zip(results, setup.expected, strict=True):
        assert result.shape == matrix_shape(tuple(e.shape))
        ours = result.full().flatten(order="F")[constant(e.double().numpy()).positions]
        # Both sides round a few operations on numbers of order 1.
        np.testing.assert_allclose(ours, e.double().numpy(), rtol=1e-13, atol=1e-14)


def _differentiable(name):
    setup = Setup(name, inputs=True)
    return bool(setup.tensors) and setup.expected[0].is_floating_point()


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("name", [n for n in NAMES if _differentiable(n) and n not in OWN_SLOPES])
def test_derivative_against_torch(name, plain):
    setup = Setup(name, inputs=True)
    kept = [i for i, e in enumerate(setup.expected) if e.numel() and e.is_floating_point()]
    exact = torch.autograd.functional.jacobian(
        lambda *t: tuple(setup.torch(*t)[i] for i in kept), tuple(setup.tensors)
    )
    held = [constant(t.numpy()) for t in setup.tensors]
    function = build(setup.program, plain=plain)
    symbols = [ca.MX.sym("x", *v.mx.shape) for v in held]
    outputs = function.call(symbols)
    blocks = [ca.densify(ca.jacobian(outputs[i], x)) for i in kept for x in symbols]
    values = ca.Function("slopes", symbols, blocks).call([ca.evalf(v.mx) for v in held])
    for k, i in enumerate(kept):
        rows = constant(setup.expected[i].numpy()).positions.reshape(-1)
        for j, x in enumerate(held):
            ours = values[k * len(held) + j].full()[rows][:, x.positions.reshape(-1)]
            # Derivatives round some more operations than values; slopes of this set are below 100.
            np.testing.assert_allclose(ours, exact[k][j].reshape(ours.shape), rtol=1e-12, atol=1e-13)


def test_all_operators_are_in_a_group_and_in_the_document():
    grouped = [name for group in GROUPS.values() for name in group]
    assert sorted([*grouped, "getitem"]) == sorted(OPERATORS)
    cells = [line.split("|")[1] for line in document().splitlines() if line.startswith("| `")]
    shown = [name.strip(" `") for cell in cells for name in cell.split(",")]
    assert sorted(shown) == sorted(set(map(short, grouped)))
    assert {name for names in NOTES for name in names.split()} <= set(shown)
    assert (Path(__file__).parents[2] / "docs/operators.md").read_text() == document()
