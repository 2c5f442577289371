"""Horizons: the same numbers and derivatives as step by step, growing linearly (unroll) or less (fold)."""

import casadi as ca
import numpy as np
import pytest
import torch
from export_parts import Cell, traced_cell
from torch import nn

from nn_export import build, fold, to_casadi, unroll, with_jacobian
from nn_export.errors import SignatureError


@pytest.fixture(scope="module")
def program():
    return traced_cell(5)


def stacked(values):
    return np.vstack([v.full() if isinstance(v, ca.DM) else v.reshape(-1, 1) for v in values])


def roll(step, x, h, inputs):
    states = []
    for u in inputs.T:
        x, h = step(x, h, u)
        states.append(stacked([x, h]))
    return np.hstack(states)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 75])
def test_the_numbers_are_those_of_the_steps_in_a_row(program, n):
    step, rng = build(program), np.random.default_rng(n)
    x, h, u = rng.standard_normal(2), rng.standard_normal(5), rng.standard_normal((1, n))
    expected = roll(step, x, h, u)
    # The same operations in the same order: the same bits.
    assert np.array_equal(stacked(unroll(step, n)(x, h, u)), expected)
    assert np.array_equal(stacked(fold(step, n)(x, h, u)), expected[:, -1:])


def test_gradient_and_hessian_agree_between_unroll_fold_and_torch(program):
    step, n = build(program), 19
    module = Cell(5).double()
    rng = np.random.default_rng(0)
    x, h, u = rng.standard_normal(2), rng.standard_normal(5), rng.standard_normal((1, n))

    def cost(inputs):
        a, b = torch.tensor(x), torch.tensor(h)
        for k in range(n):
            a, b = module(a, b, inputs[k : k + 1])
        return (a**2).sum()

    point = torch.tensor(u[0])
    gradient, hessian = torch.func.grad(cost)(point), torch.func.hessian(cost)(point)
    for horizon in (unroll, fold):
        f, v = horizon(step, n), ca.MX.sym("u", 1, n)
        total = ca.sumsqr(f(x, h, v)[0][:, -1])
        second, first = ca.Function("d", [v], [*ca.hessian(total, v)])(u)
        # A few hundred operations in float64.
        assert np.abs(first.full().ravel() - gradient.detach().numpy()).max() < 1e-12 * gradient.abs().max()
        assert np.abs(second.full() - hessian.detach().numpy()).max() < 1e-11 * hessian.abs().max()


def test_a_step_with_jacobians_gives_those_of_all_steps(program):
    n = 6
    derived = with_jacobian(program, {"A": ("x", "h"), "B": ("u",)})
    rng = np.random.default_rng(0)
    x, h, u = rng.standard_normal(2), rng.standard_normal(5), rng.standard_normal((1, n))
    whole = unroll(derived, n)
    assert whole.name_out() == ["x_next", "h_next", "A", "B"]
    values = dict(zip(whole.name_out(), whole(x, h, u), strict=True))
    # The chain of the blocks is the Jacobian of the end by the start.
    chain = np.eye(7)
    for k in range(n):
        chain = values["A"].full()[:, 7 * k : 7 * (k + 1)] @ chain
    plain, s = unroll(build(program), n), ca.MX.sym("s", 7)
    end = ca.vertcat(*(v[:, -1] for v in plain(s[:2], s[2:], u)))
    expected = ca.Function("j", [s], [ca.jacobian(end, s)])(np.concatenate([x, h])).full()
    assert np.abs(chain - expected).max() < 1e-13  # six products of matrices of order one


def test_roles_of_inputs_matrices_and_extra_outputs():
    p, x, u = ca.MX.sym("p", 2, 2), ca.MX.sym("x", 2), ca.MX.sym("u", 2, 3)
    outputs = [ca.sum1(x), ca.mtimes(p, x) + ca.sum2(u)]
    step = ca.Function("step", [p, u, x], outputs, ["p", "u", "x"], ["y", "new"])
    rng, n = np.random.default_rng(0), 9
    at_p, at_u, at_x = rng.standard_normal((2, 2)), rng.standard_normal((2, 3 * n)), rng.standard_normal(2)
    settings = {"states": {"x": "new"}, "held": ["p"]}
    whole, last = unroll(step, n, **settings, name="whole"), fold(step, n, **settings)
    assert (whole.name(), whole.name_in(), whole.name_out()) == ("whole", ["p", "u", "x"], ["y", "new"])
    assert last.name_out() == ["new"]
    xs, ys, at = [], [], at_x
    for k in range(n):
        ys.append(at.sum())
        at = at_p @ at + at_u[:, 3 * k : 3 * k + 3].sum(1)
        xs.append(at)
    y, new = whole(at_p, at_u, at_x)
    # Sums of a few numbers in another order.
    assert np.allclose(y.full()[0], ys, rtol=1e-13)
    assert np.allclose(new.full().T, xs, rtol=1e-13)
    assert np.array_equal(last(at_p, at_u, at_x).full(), new.full()[:, -1:])


def test_an_empty_hidden_state():
    class Prior(nn.Module):
        def forward(self, x, h, u):
            return x + 0.1 * u, h

    step = to_casadi(
        Prior(), (torch.zeros(1), torch.zeros(0), torch.zeros(1)), output_names=["x_next", "h_next"]
    )
    x_next, h_next = unroll(step, 4)(0, np.zeros((0, 1)), np.ones((1, 4)))
    assert np.allclose(x_next.full(), [[0.1, 0.2, 0.3, 0.4]], rtol=1e-15)
    assert h_next.shape == (0, 4)


def test_graphs_grow_linearly_and_folds_hardly_at_all(program):
    step = build(program)
    count = {n: unroll(step, n).n_instructions() for n in (50, 100, 200)}
    assert count[200] - count[100] == 2 * (count[100] - count[50])  # one call and its outputs a step
    work = {n: unroll(step, n).sz_w() - n for n in (100, 200)}  # without the input sequence itself
    assert work[200] < 2.1 * work[100]
    long, short = fold(step, 4096), fold(step, 64)
    assert long.n_instructions() == short.n_instructions()
    # Beyond the states of two more levels: each level holds its part of the inputs twice, 2 (1 + 1/8 + 1/64 ...).
    assert long.sz_w() - short.sz_w() < 2.3 * 4096 + 200
    # A gradient holds the inputs' adjoints in the same way.
    reverse = long.reverse(1).sz_w() - short.reverse(1).sz_w()
    assert reverse < 2 * 2.3 * 4096 + 2 * 4096 + 1000


@pytest.mark.parametrize(
    ("n", "settings", "words"),
    [
        (0, {}, "NN-044"),
        (2.0, {}, "NN-044"),
        (3, {"states": {"q": "x_next"}}, "NN-046"),
        (3, {"states": {"x": "nothing"}}, r"nothing.*NN-046"),
        (3, {"held": ["x"]}, "NN-047"),
        (3, {"states": {"x": "h_next"}}, "NN-049"),
        (3, {"states": {"x": "x_next", "u": "x_next"}}, "NN-048"),
        (3, {"states": {}}, "states="),
    ],
)
def test_named_errors(program, n, settings, words):
    step = build(program)
    for horizon in (unroll, fold):
        with pytest.raises(SignatureError, match=words):
            horizon(step, n, **settings)
