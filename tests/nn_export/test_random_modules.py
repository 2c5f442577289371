"""Random stacks of layers: values and Jacobians agree with torch, by all routes."""

import copy

import casadi as ca
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nn_export import build, trace, with_jacobian

torch.set_num_threads(1)
# Hardsigmoid and CELU have own tests: torch rounds a factor of their slopes to float32.
SMOOTH = [nn.Tanh, nn.Sigmoid, nn.SiLU, nn.GELU, nn.Softplus, nn.Mish, nn.ELU, nn.Softsign, nn.LogSigmoid]
KINKED = [nn.ReLU, nn.LeakyReLU, nn.Hardtanh, nn.Hardswish, nn.SELU, nn.ReLU6]
WIDE = [lambda: nn.Softmax(-1), lambda: nn.LogSoftmax(-1), lambda: nn.GELU(approximate="tanh"), nn.Identity]
CELLS = [nn.GRUCell, nn.LSTMCell, nn.RNNCell, lambda a, b: nn.RNNCell(a, b, nonlinearity="relu")]
LAYERS = [nn.GRU, nn.LSTM, nn.RNN, lambda a, b, **kw: nn.RNN(a, b, nonlinearity="relu", **kw)]


class Block(nn.Module):
    """A linear layer, an activation, and one of: a norm, a cell, a recurrent layer, dropout, a residual."""

    def __init__(self, n, size, activation, extra, flags):
        super().__init__()
        bias, batch_first, deep = flags
        self.extra, self.batch_first = extra, batch_first
        self.linear, self.f = nn.Linear(n, size, bias=bias), activation()
        if extra == "norm":
            self.part = nn.LayerNorm(size, elementwise_affine=bias)
        elif extra == "batch norm":
            self.part = nn.BatchNorm1d(size, affine=bias)
            self.part.running_mean.uniform_(-1, 1)
            self.part.running_var.uniform_(0.5, 2)
        elif extra == "dropout":
            self.part = nn.Dropout(0.4)
        elif isinstance(extra, tuple):
            make = (CELLS if extra[0] == "cell" else LAYERS)[extra[1]]
            options = {"num_layers": 2 if deep else 1, "batch_first": batch_first, "bias": bias}
            self.part = make(size, size) if extra[0] == "cell" else make(size, size, **options)

    def forward(self, x):
        y = self.f(self.linear(x))
        if self.extra == "residual":
            return y + torch.cat([x, x, y])[: y.shape[0]]
        if self.extra == "batch norm":
            return self.part(y[None])[0]
        if not isinstance(self.extra, tuple):
            return self.part(y) if self.extra else y
        if self.extra[0] == "cell":
            new = self.part(y, None)
            return new[0] * new[1] if isinstance(new, tuple) else new
        long = torch.stack([y, y.flip(0), 0.5 * y])
        return self.part(long[None] if self.batch_first else long)[0].reshape(3, -1)[-1]


class Stack(nn.Module):
    """Blocks in series with a read-out."""

    def __init__(self, n, plans):
        super().__init__()
        widths = [n, *(p[0] for p in plans)]
        self.blocks = nn.Sequential(*(Block(w, *p) for w, p in zip(widths, plans, strict=False)))
        self.head = nn.Linear(widths[-1], 2)

    def forward(self, x):
        y = self.blocks(x)
        return {"y": self.head(y), "mean": y.mean()}


EXTRAS = [None, "norm", "batch norm", "dropout", "residual"]
EXTRAS += [(where, k) for where in ("cell", "layer") for k in range(4)]


@st.composite
def stacks(draw, widest=64):
    size = st.one_of(st.integers(1, 8), st.integers(1, widest))
    block = st.tuples(
        size,
        st.sampled_from([*SMOOTH, *KINKED, *WIDE]),
        st.sampled_from(EXTRAS),
        st.tuples(st.booleans(), st.booleans(), st.booleans()),
    )
    return draw(st.integers(1, 6)), draw(st.lists(block, min_size=1, max_size=4)), draw(st.integers(0, 999))


def check(n, plans, seed):
    torch.manual_seed(seed)
    module = Stack(n, plans)
    before = {k: v.clone() for k, v in module.state_dict().items()}
    program = trace(module, (torch.zeros(n),))
    assert module.training
    assert all(p.requires_grad for p in module.parameters())
    for key, value in module.state_dict().items():
        assert value.dtype == before[key].dtype
        assert torch.equal(value, before[key])
    function = build(program)
    assert function.name_out() == ["y", "mean"]
    rng = np.random.default_rng(seed)
    symbol = ca.MX.sym("x", n)
    outputs = ca.vertcat(*function(symbol))
    called = ca.Function("called", [symbol], [outputs, ca.jacobian(outputs, symbol)])
    composed = with_jacobian(program)
    exact = copy.deepcopy(module).double().eval().requires_grad_(False)

    def flat(x):
        return torch.cat([v.reshape(-1) for v in exact(x).values()])

    for _ in range(2):
        point = rng.standard_normal(n)
        x = torch.tensor(point)
        value, slope = flat(x).numpy(), torch.func.jacrev(flat)(x).numpy()
        results = called(point)
        *parts, third = composed(point)
        for given_value, given_slope in ((results[0], results[1]), (ca.vertcat(*parts), third)):
            # The package's promise, relative to the scale of the output: rounding of a few hundred operations.
            assert np.abs(given_value.full().ravel() - value).max() < 1e-12 * max(1.0, np.abs(value).max())
            assert np.abs(given_slope.full() - slope).max() < 1e-10 * max(1.0, np.abs(slope).max())


@pytest.mark.full
@settings(max_examples=6, deadline=None, derandomize=True)
@given(stacks(widest=24))
def test_random_stack(plan):
    check(*plan)


@pytest.mark.full
@settings(max_examples=100, deadline=None, derandomize=True)
@given(stacks())
def test_many_random_stacks(plan):
    check(*plan)
