"""Random stacks of layers: values and Jacobians agree with torch."""

from itertools import pairwise

import casadi as ca
import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nn_export import build, parity, trace, with_jacobian

torch.set_num_threads(1)
SMOOTH = [nn.Tanh, nn.Sigmoid, nn.SiLU, nn.GELU, nn.Softplus, nn.Mish, nn.ELU, nn.Softsign]


class Stack(nn.Module):
    """Linear layers with activations, optionally a recurrent cell or layer and a residual connection."""

    def __init__(self, n, sizes, activations, recurrent, norm):
        super().__init__()
        widths = [n, *sizes]
        pairs = list(pairwise(widths))
        layers = [m for (a, b), f in zip(pairs, activations, strict=False) for m in (nn.Linear(a, b), f())]
        self.body = nn.Sequential(*layers, *([nn.LayerNorm(sizes[-1])] if norm else []))
        self.recurrent = recurrent(sizes[-1], sizes[-1]) if recurrent else None
        self.head = nn.Linear(sizes[-1], n)

    def forward(self, x):
        y = self.body(x)
        if isinstance(self.recurrent, nn.GRUCell | nn.RNNCell):
            y = self.recurrent(y)
        elif self.recurrent is not None:
            y = self.recurrent(y.expand(3, -1))[0][-1]
        return x + self.head(y)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    n=st.integers(1, 6),
    sizes=st.lists(st.integers(2, 16), min_size=1, max_size=3),
    activations=st.lists(st.sampled_from(SMOOTH), min_size=3, max_size=3),
    recurrent=st.sampled_from([None, nn.GRUCell, nn.RNNCell, nn.GRU, nn.LSTM, nn.RNN]),
    norm=st.booleans(),
    seed=st.integers(0, 99),
)
def test_random_stack(n, sizes, activations, recurrent, norm, seed):
    torch.manual_seed(seed)
    module, x = Stack(n, sizes, activations, recurrent, norm), (torch.zeros(n),)
    program = trace(module, x)
    function = build(program)
    report = parity(module, function, x, n=4, seed=seed)
    # The package's promise: rounding of a few hundred operations, relative to the output's scale.
    assert report.value_rel < 1e-12
    assert report.jacobian_rel < 1e-10
    point = np.random.default_rng(seed).standard_normal(n)
    symbol = ca.MX.sym("x", n)
    plain = ca.Function("plain", [symbol], [ca.jacobian(build(program, plain=True)(symbol), symbol)])
    exact = plain(point).full()
    # The same derivative in another order of operations.
    assert np.abs(with_jacobian(program)(point)[1] - exact).max() < 1e-12 * max(1.0, np.abs(exact).max())
