"""Many points in one call give the values and Jacobians of one call a point."""

import casadi as ca
import numpy as np
import pytest
import torch
from test_jacobian import MODULES
from torch import nn

from nn_export import ProgramError, SideBySide, trace, with_jacobian
from nn_export.errors import ShapeError
from nn_export.vectorised import MOST_INSTRUCTIONS, vectorised

torch.set_num_threads(1)


class WideHead(nn.Module):
    """A read-out too large for scalar code between two cells of a kind each."""

    def __init__(self):
        super().__init__()
        self.rnn, self.lstm = nn.RNNCell(2, 20, nonlinearity="relu"), nn.LSTMCell(30, 3)
        self.head = nn.Sequential(nn.Linear(20, 60), nn.Tanh(), nn.Linear(60, 30))

    def forward(self, x, h):
        a = self.rnn(x, h[:20])
        b, c = self.lstm(self.head(a), (h[20:23], h[23:]))
        return torch.cat([b, c]), a


class Separate(nn.Module):
    """Outputs that are an input, a constant, one value twice, and nothing of an input that is not used."""

    def __init__(self):
        super().__init__()
        self.cell = nn.GRUCell(2, 3)
        self.register_buffer("fixed", torch.tensor([1.0, 2.0]))

    def forward(self, x, h, p):
        a = self.cell(self.fixed, torch.tanh(h))
        return x, 2.0 * self.fixed, a, 3.0 * h, a


ALL = {
    **MODULES,
    "wide head": (WideHead, (torch.zeros(2), torch.zeros(26))),
    "nothing between": (Separate, (torch.zeros(2), torch.zeros(3), torch.zeros(1))),
    "four layers": (lambda: nn.GRU(2, 3, 4), (torch.zeros(1, 2), torch.zeros(4, 3))),
}


def compare(program, blocks, n, seed=0, size=1.0):
    one, many, rng = (
        with_jacobian(program, blocks),
        SideBySide(program, n, blocks),
        np.random.default_rng(seed),
    )
    for _ in range(2):  # nothing of a call stays for the next
        points = [size * rng.standard_normal((n, one.numel_in(i))) for i in range(one.n_in())]
        results = many(*points)
        assert len(results) == one.n_out()
        for k in range(n):
            shaped = [ca.reshape(ca.DM(p[k]), *one.size_in(i)) for i, p in enumerate(points)]
            for i, (given, exact) in enumerate(zip(results, one.call(shaped), strict=True)):
                exact = exact.full() if i >= len(program.outputs) else exact.full().flatten(order="F")
                assert given[k].shape == exact.shape
                scale = max(1.0, np.abs(exact).max(initial=0.0))
                # The same real function in another order of a few hundred roundings.
                np.testing.assert_allclose(given[k], exact, rtol=0, atol=1e-12 * scale)


KINDS = ("hybrid step", "no cell", "lstm layers", "wide head", "nothing between")
"""The quick set's: a cell with a prior, networks without one, layers, and what does not become scalar code."""


@pytest.mark.parametrize(
    "name", [name if name in KINDS else pytest.param(name, marks=pytest.mark.full) for name in ALL]
)
def test_many_points_are_as_single_ones(name):
    torch.manual_seed(3)
    make, inputs = ALL[name]
    program = trace(make().double(), tuple(v.double() for v in inputs))
    names = [port.name for port in program.inputs]
    compare(program, None, 5)
    compare(program, {"a": names[::-1], "b": names[:1]}, 3, seed=1)
    compare(program, {i: [i] for i in names}, 1, seed=2, size=50.0)  # saturated
    compare(program, {}, 2)


def test_results_stay_when_it_is_called_again():
    make, inputs = ALL["cells in series"]
    many = SideBySide(trace(make().double(), tuple(v.double() for v in inputs)), 2)
    first = many(np.ones((2, 2)), np.ones((2, 9)))
    kept = [r.copy() for r in first]
    many(np.zeros((2, 2)), np.zeros((2, 9)))
    for now, before in zip(first, kept, strict=True):
        np.testing.assert_array_equal(now, before)


def test_what_is_not_finite_is_told_by_the_result_and_by_nothing_else():
    make, inputs = ALL["cells in series"]
    many = SideBySide(trace(make().double(), tuple(v.double() for v in inputs)), 2)
    with np.errstate(all="raise"):
        results = many(np.array([[np.inf, 0.0], [0.1, 0.2]]), np.ones((2, 9)))
    assert all(np.isnan(r[0]).any() and np.isfinite(r[1]).all() for r in results)


def test_wrong_arguments_are_named():
    make, inputs = ALL["rnn cell"]
    program = trace(make().double(), tuple(v.double() for v in inputs))
    with pytest.raises(ProgramError, match="NN-082"):
        SideBySide(program, 0)
    with pytest.raises(ProgramError, match="NN-050"):
        SideBySide(program, 1, {"A": ["y"]})
    with pytest.raises(ShapeError, match=r"\(2, 3\).*NN-083"):
        SideBySide(program, 2)(np.zeros((2, 2)), np.zeros((3, 3)))


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_vectorised_functions_are_the_functions(kind):
    a, x = kind.sym("a", 2, 2), kind.sym("x", 2)
    y = ca.vertcat(ca.mtimes(a, ca.sin(x)), ca.if_else(x[0] > 0, ca.fmax(x[0], x[1]), 3.0))
    f = ca.Function("f", [a, x], [y, kind(ca.DM([[0.0, 1.0]])), kind(0, 1), ca.diag(x)])
    rng = np.random.default_rng(0)
    given = [rng.standard_normal((7, 4)), rng.standard_normal((7, 2))]
    results = vectorised(f, 7).call(given)
    for k in range(7):
        for i, exact in enumerate(f.call([given[0][k].reshape(2, 2, order="F"), given[1][k]])):
            np.testing.assert_array_equal(results[i].full()[k], exact.full().flatten(order="F"))


def test_very_long_scalar_code_is_mapped():
    x = ca.SX.sym("x")
    y = x
    for _ in range(MOST_INSTRUCTIONS):
        y = ca.sin(y)
    many = vectorised(ca.Function("f", [x], [y]), 2)
    assert many.n_instructions() < 100
    np.testing.assert_array_equal(many(np.zeros(2)).full(), np.zeros((2, 1)))
