"""Three routes to the Jacobian agree: composed, CasADi's own on the plain graph, finite differences."""

import casadi as ca
import numpy as np
import pytest
import torch
from export_parts import Call
from test_hybrid_step import Step, examples
from torch import nn

from nn_export import Node, Port, Program, ProgramError, build, to_casadi, trace, with_jacobian

torch.set_num_threads(1)


def by_casadi(program):
    function = build(program, plain=True)
    symbols = [ca.MX.sym(port.name, *function.size_in(i)) for i, port in enumerate(program.inputs)]
    outputs = function.call(symbols)
    return ca.Function("f", symbols, [*outputs, ca.jacobian(ca.veccat(*outputs), ca.veccat(*symbols))])


def by_differences(function, n_out, point):
    """Central differences with the step that balances rounding and truncation, eps^(1/3)."""
    sizes = np.cumsum([0] + [p.size for p in point])
    flat, step = np.concatenate([p.flatten(order="F") for p in point]), 6e-6

    def value(v):
        parts = [v[a:b].reshape(p.shape, order="F") for a, b, p in zip(sizes, sizes[1:], point, strict=False)]
        return np.concatenate([r.full().flatten(order="F") for r in function.call(parts)[:n_out]])

    return np.stack([(value(flat + d) - value(flat - d)) / (2 * step) for d in step * np.eye(flat.size)], 1)


def compare(module, inputs, seed=0, size=1.0):
    program = trace(module, inputs)
    n_out = len(program.outputs)
    ours, plain, called = with_jacobian(program), by_casadi(program), build(program)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        point = [size * rng.standard_normal(ours.size_in(i)) for i in range(ours.n_in())]
        results, expected = ours.call(point), plain.call(point)
        assert [r.shape for r in results] == [e.shape for e in expected]
        for given, exact in zip(results, expected, strict=True):
            scale = max(1.0, np.abs(exact.full()).max(initial=0.0))
            # The same real function in another order of a few hundred roundings.
            np.testing.assert_allclose(given.full(), exact.full(), rtol=0, atol=1e-12 * scale)
        slope = results[-1].full()
        differences = by_differences(called, n_out, point)
        # Central differences: eps^(2/3) = 4e-11 of the scale, times third derivatives of up to 1e3.
        assert np.abs(slope - differences).max() < 1e-7 * max(1.0, np.abs(slope).max())


class TwoLayers(nn.Module):
    """Cells in series, their states mixed, as rows of one sample."""

    def __init__(self):
        super().__init__()
        self.first, self.second, self.head = nn.GRUCell(3, 5), nn.GRUCell(5, 4), nn.Linear(9, 2)

    def forward(self, x, h):
        a = self.first(torch.cat([torch.sin(x), x[:1] * h[:1]]), 0.9 * h[:5])
        b = self.second(a, torch.tanh(h[5:] + x.sum()))
        return self.head(torch.cat([a, b])) + x * a[:2], torch.cat([a, b])


class Layer(nn.Module):
    """A whole GRU layer over a sequence (1, T, F), and a cell on a batch of two."""

    def __init__(self):
        super().__init__()
        self.layer, self.batch = nn.GRU(2, 3, num_layers=2, batch_first=True), nn.GRUCell(3, 2)

    def forward(self, x, h):
        y, last = self.layer(x[None], h[:, None])
        return self.batch(y[0]), last


class Several(nn.Module):
    """Two LSTM cells, the second with the first one's output as input and cell state."""

    def __init__(self, cell):
        super().__init__()
        self.first, self.second = cell(2, 4), cell(4, 4, bias=False)

    def forward(self, x, h):
        a, c = self.first(torch.sin(x), (h[:4], h[4:]))
        b, d = self.second(a * x.sum(), (h[:4], a + c))
        return b, d, c


class Twice(nn.Module):
    """The same value as input and as hidden state."""

    def __init__(self):
        super().__init__()
        self.cell, self.long = nn.GRUCell(3, 3), nn.LSTMCell(3, 3)

    def forward(self, h):
        return self.cell(h, h), self.long(h, (h, h))


MODULES = {
    "hybrid step": (lambda: Step(6, True), examples(6)),
    "paper's cell": (lambda: Step(2, False), examples(2)),
    "cells in series": (TwoLayers, (torch.zeros(2), torch.zeros(9))),
    "layer and batch": (Layer, (torch.zeros(2, 2), torch.zeros(2, 3))),
    "bare cell": (lambda: nn.GRUCell(2, 3, bias=False), (torch.zeros(1, 2), torch.zeros(1, 3))),
    "no cell": (lambda: nn.Sequential(nn.Linear(3, 70), nn.LayerNorm(70), nn.SiLU(), nn.Linear(70, 2)),
                (torch.zeros(3),)),
    "lstm": (lambda: nn.LSTMCell(2, 3), (torch.zeros(2),)),
    "lstm in series": (lambda: Several(nn.LSTMCell), (torch.zeros(2), torch.zeros(8))),
    "lstm layers": (lambda: nn.LSTM(2, 3, 2, proj_size=2), (torch.zeros(3, 2),)),
    "rnn layers": (lambda: nn.RNN(2, 3, 2, bidirectional=True), (torch.zeros(3, 2),)),
    "rnn cell": (lambda: nn.RNNCell(2, 3, nonlinearity="relu"), (torch.zeros(2), torch.zeros(3))),
    "one value twice": (lambda: Twice(), (torch.zeros(3),)),
}  # fmt: skip


ALIKE = ("cells in series", "lstm in series", "lstm layers", "rnn cell")
"""Modules whose parts others of the table have: for the full set."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full) if name in ALIKE else name for name in MODULES]
)
def test_three_routes_agree(name):
    torch.manual_seed(0)
    make, inputs = MODULES[name]
    compare(make().double(), inputs, size=0.5)


class Empty(nn.Module):
    def forward(self, x, h, u):
        return torch.stack([x[1], x[0] * u[0]]), h


def test_blocks_and_an_empty_hidden_state():
    program = trace(
        Empty(), (torch.zeros(2), torch.zeros(0), torch.zeros(1)), output_names=["x_next", "h_next"]
    )
    function = with_jacobian(program, {"A": ("x", "h"), "B": ("u",)}, "stage")
    assert function.name_out() == ["x_next", "h_next", "A", "B"]
    _, h, a, b = function([2.0, 3.0], [], 5.0)
    assert h.shape == (0, 1)
    assert a.full().tolist() == [[0, 1], [5, 0]]
    assert b.full().tolist() == [[0], [2]]


def test_outputs_that_are_inputs_or_constants():
    ports = (Port("x", (2,), {"input": "x"}), Port("w", (2,), {"weight": "w"}))
    program = Program((Port("x", (2,)),), ports, (), {"w": np.array([1.0, 2.0])})
    x, w, slope = with_jacobian(program)([5, 6])
    assert (x.full().tolist(), w.full().tolist()) == ([[5], [6]], [[1], [2]])
    assert slope.full().tolist() == [[1, 0], [0, 1], [0, 0], [0, 0]]


def test_an_unknown_input_is_named():
    node = Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),))
    program = Program((Port("x", (2,)),), (Port("y", (2,), {"node": "tanh"}),), (node,))
    with pytest.raises(ProgramError, match="NN-050"):
        with_jacobian(program, {"A": ("x", "v")})


def test_an_exported_cell_still_expands_to_scalars():
    program = trace(nn.GRUCell(2, 3), (torch.zeros(2), torch.zeros(3)))
    point = [0.1, 0.2], [0.3, 0.4, 0.5]
    # The same operations one by one.
    np.testing.assert_allclose(build(program).expand()(*point), build(program)(*point), rtol=0, atol=1e-15)


@pytest.mark.parametrize("kind", ["gru", "lstm", "rnn_tanh", "rnn_relu"])
@pytest.mark.parametrize("route", ["composed", "called"])
def test_hessians_of_all_cells_against_torch(kind, route):
    torch.manual_seed(4)
    cells = {
        "gru": nn.GRUCell(2, 3),
        "lstm": Long(),
        "rnn_tanh": nn.RNNCell(2, 3),
        "rnn_relu": nn.RNNCell(2, 3, nonlinearity="relu"),
    }
    module, n = cells[kind].double(), 6 if kind == "lstm" else 3
    program = trace(module, (torch.zeros(2), torch.zeros(n)))
    z = ca.MX.sym("z", 2 + n)
    parts = ca.vertsplit(z, [0, 2, 2 + n])
    weights = np.linspace(-1, 1, n) + 0.3
    value = build(program)(*parts).T @ weights
    if route == "called":
        hessian = ca.hessian(ca.sin(value), z)[0]
    else:
        slope = with_jacobian(program)(*parts)[-1].T @ weights
        hessian = ca.jacobian(ca.cos(value) * slope, z)
    point = torch.linspace(-0.9, 0.8, 2 + n, dtype=torch.float64)
    expected = torch.func.hessian(lambda p: torch.sin(module(p[:2], p[2:]) @ torch.tensor(weights)))(point)
    given = ca.Function("hessian", [z], [hessian])(point.numpy()).full()
    # Some fifty roundings of numbers of order one.
    np.testing.assert_allclose(given, expected.detach().numpy(), rtol=0, atol=1e-13)


class Long(nn.Module):
    """An LSTM cell with both states as one vector."""

    def __init__(self):
        super().__init__()
        self.cell = nn.LSTMCell(2, 3)

    def forward(self, x, s):
        return torch.cat(self.cell(x, (s[:3], s[3:])))


def test_a_sum_added_to_its_vector_has_the_right_jacobian():
    function = to_casadi(Call(lambda x: x + x.sum()), (torch.zeros(4),))
    x = ca.MX.sym("x", 4)
    jacobian = ca.Function("jacobian", [x], [ca.jacobian(function(x), x)])(np.ones(4)).full()
    assert np.array_equal(jacobian, np.eye(4) + 1)
