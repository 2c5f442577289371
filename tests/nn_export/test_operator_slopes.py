"""Slopes where an operator has none of its own, at kinks, far out, and where torch rounds them."""

import casadi as ca
import numpy as np
import pytest
import torch
from export_parts import Call
from torch.nn import functional as F

from nn_export import parity, to_casadi


def slopes(f, point):
    """Diagonal of the exported function's Jacobian."""
    x = torch.tensor(point, dtype=torch.float64)
    symbol = ca.MX.sym("x", len(point))
    jacobian = ca.jacobian(to_casadi(Call(f), (x,))(symbol), symbol)
    return ca.Function("slopes", [symbol], [ca.diag(jacobian)])(point).full().ravel()


def test_slopes_that_torch_rounds_to_float32_are_exact():
    # torch 2.13 keeps 1/6 and 1/alpha of these derivatives in float32: off by 3e-8.
    assert slopes(F.hardsigmoid, [0.5]) == 1 / 6
    expected = np.exp(np.array([-0.4, -2.0]) / 1.3)
    np.testing.assert_allclose(slopes(lambda x: F.celu(x, 1.3), [-0.4, -2.0]), expected, rtol=1e-15)


def test_detach_is_no_barrier_to_derivatives():
    assert slopes(lambda x: x.detach() * 2 + x, [0.7]) == 3.0


@pytest.mark.parametrize(
    ("f", "point", "expected"),
    [
        (lambda x: x.clamp(min=0.0), [0.0, -1.0, 1.0], [1, 0, 1]),
        (lambda x: x.clamp(-1, 1), [-1.0, 1.0, 2.0], [1, 1, 0]),
        (F.relu, [0.0], [0]),
        (F.relu6, [0.0, 6.0, 3.0], [0, 0, 1]),
        (torch.abs, [0.0], [0]),
        (F.hardtanh, [-1.0, 1.0], [0, 0]),
        (lambda x: torch.std(x).expand(2), [0.3, 0.3], [0, 0]),
        (lambda x: torch.linalg.vector_norm(x).expand(2), [0.0, 0.0], [0, 0]),
    ],
)
def test_slopes_at_kinks_follow_torch(f, point, expected):
    x = torch.tensor(point, dtype=torch.float64)
    assert torch.autograd.functional.jacobian(f, x).diagonal().tolist() == expected
    assert slopes(f, point).tolist() == expected


def test_the_logistic_function_far_out():
    point = torch.tensor([-800.0, -300.0, -40.0, 0.0, 40.0, 800.0], dtype=torch.float64)
    ours = to_casadi(Call(torch.sigmoid), (point,))(point.numpy()).full().ravel()
    # Relative to itself where it is above exp(-350), absolute below; three roundings.
    np.testing.assert_allclose(ours, torch.sigmoid(point).numpy(), rtol=1e-15, atol=1e-150)
    assert np.isfinite(slopes(torch.sigmoid, point.numpy())).all()
    assert slopes(torch.sigmoid, [0.0]) == 0.25
    assert np.isnan(to_casadi(Call(torch.sigmoid), (point[:1],))(np.nan).full()).all()


class Filled(torch.nn.Module):
    """Writes into memory of its own, which becomes copies with parts replaced."""

    def forward(self, x):
        y = torch.empty(3, 4, dtype=x.dtype)
        y[:] = x
        y[0], y[1, 2], y[:, 3] = x[1], x[0, 0], 1.0
        return y


class Normed(torch.nn.Module):
    """Axes beyond two inside the graph, none outside."""

    def __init__(self):
        super().__init__()
        self.group, self.attention = torch.nn.GroupNorm(2, 4), torch.nn.MultiheadAttention(4, 2)

    def forward(self, x):
        return self.group(x), self.attention(x, x, x, need_weights=False)[0], x.repeat_interleave(2, 1)


@pytest.mark.parametrize("module", [Filled(), Normed()])
def test_modules_whose_operators_have_no_slope_alone(module):
    torch.manual_seed(0)
    inputs = (torch.zeros(3, 4),)
    # torch has no second derivative of its fused attention
    report = parity(module, to_casadi(module, inputs), inputs, n=6, hessians=False)
    # The package's promise for values and Jacobians.
    assert report.value_rel < 1e-12
    assert report.jacobian_rel < 1e-10


def test_memory_that_is_never_written_shows():
    function = to_casadi(Call(lambda x: torch.empty(2, dtype=x.dtype) + x), (torch.zeros(2),))
    assert np.isnan(function([1.0, 2.0]).full()).all()


@pytest.mark.parametrize("f", [torch.amax, torch.amin, torch.max, torch.min])
def test_equal_extremes_share_the_slope_as_in_torch(f):
    x = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
    expected = torch.autograd.functional.jacobian(f, x).numpy()
    symbol = ca.MX.sym("x", 4)
    jacobian = ca.jacobian(to_casadi(Call(f), (x,))(symbol), symbol)
    # Quarters are exact.
    assert np.array_equal(ca.Function("j", [symbol], [jacobian])(x.numpy()).full().ravel(), expected)
