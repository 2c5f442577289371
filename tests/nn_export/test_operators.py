"""Every operator of the table against torch."""

import numpy as np
import pytest
import torch

from nn_export import Node, Port, Program, build
from nn_export.operators import OPERATORS
from nn_export.operators.elementwise import OPERATORS as ELEMENTWISE
from nn_export.operators.value import constant, matrix_shape

A = torch.ops.aten
A34, B34 = (
    torch.linspace(0.11, 0.93, 12).double().reshape(3, 4),
    torch.linspace(0.9, 0.2, 12).double().reshape(3, 4),
)
V4, V3, M43 = B34[0].clone(), A34[:, 0].clone(), B34.T.clone()
I2 = torch.tensor([2.0, 0.0]).double()


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
    "squeeze.dims": (X314, [1]), "view.default": (A34, [2, 6]), "reshape.default": (A34, [6, -1]),
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
    "mean.dim": (A34, [0]), "var.correction": ((A34, [1]), {"correction": 0.0}), "amax.default": (A34, [0]),
    "amin.default": (A34, [1], True), "prod.dim_int": (A34, 0), "linalg_vector_norm.default": (A34, 2.0, [1]),
    "logsumexp.default": (A34, [1]), "_softmax.default": (A34, 0, False),
    "_log_softmax.default": (A34, 1, False),
    "cumsum.default": (A34, 0), "gru.input": (X314, H, _layer(3), *FLAGS),
    "rnn_tanh.input": (X314, H, _layer(1), *FLAGS), "rnn_relu.input": (X314, H, _layer(1), *FLAGS),
    "lstm.input": (X314, [H, H / 2], _layer(4), *FLAGS), "gru_cell.default": (A34, A34[:, :2], *_gates(3)),
    "rnn_tanh_cell.default": (A34, A34[:, :2], *_gates(1)),
    "rnn_relu_cell.default": (A34, A34[:, :2], *_gates(1)),
    "lstm_cell.default": (A34, [A34[:, :2], A34[:, 1:3]], *_gates(4)),
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
    many = ("Tensor", "atan2", "hypot", "imum", "logical_and", "logical_or", "logical_xor", "pow")
    if name in ELEMENTWISE and any(m in short for m in many):
        return (A34, V4), {}
    return (A34,), {}  # operators of one tensor


@pytest.mark.parametrize("name", [name for name in OPERATORS if name != "getitem"])
def test_operator_against_torch(name):
    args, kwargs = _case(name)
    base, overload = name.removeprefix("aten.").split(".")
    boolean, integer = base.startswith("bitwise"), base.startswith("index")

    def torch_side(a):
        if isinstance(a, list):
            return [torch_side(v) for v in a]
        is_index = integer and a is I2
        if isinstance(a, torch.Tensor):
            bool_where = base == "where" and a is args[0]
            return a.long() if is_index else (a > 0.5) if boolean or bool_where else a
        return a

    op = getattr(getattr(A, base), overload)
    extra = {"dtype": torch.float64} if base in ("full", "scalar_tensor", "arange") else {}
    expected = op(*[torch_side(a) for a in args], **kwargs, **extra)
    expected = list(expected) if isinstance(expected, tuple | list) else [expected]
    weights = {}

    def reference(a):
        if isinstance(a, list | tuple):
            return [reference(v) for v in a]
        if isinstance(a, torch.Tensor):
            key = f"w{len(weights)}"
            value = (a > 0.5) if boolean else a
            weights[key] = value.double().numpy()
            return {"weight": key}
        return a

    shapes = tuple(tuple(e.shape) for e in expected)
    nodes = [Node("n", name, reference(args), kwargs, shapes)]
    ports = [Port("y", shapes[0], {"node": "n"})]
    if len(expected) > 1:
        nodes += [Node(f"g{i}", "getitem", [{"node": "n"}, i], {}, (s,)) for i, s in enumerate(shapes)]
        ports = [Port(f"y{i}", s, {"node": f"g{i}"}) for i, s in enumerate(shapes)]
    results = build(Program((), tuple(ports), tuple(nodes), weights)).call([])
    for result, e in zip(results, expected, strict=True):
        assert result.shape == matrix_shape(tuple(e.shape))
        ours = result.full().flatten(order="F")[constant(e.double().numpy()).positions]
        # Both sides round a few operations on numbers of order 1.
        np.testing.assert_allclose(ours, e.double().numpy(), rtol=1e-13, atol=1e-14)
