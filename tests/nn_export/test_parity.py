"""What parity reports where torch itself is not finite, and where the two sides disagree."""

import casadi as ca
import numpy as np
import torch
from torch import nn

from nn_export import parity, to_casadi

EXAMPLE = (torch.zeros(2),)


class Naive(nn.Module):
    """A logistic function that gives inf / inf at samples that are 1000 times as large, nowhere else."""

    def forward(self, x):
        return torch.exp(x) / (1 + torch.exp(x)), torch.tanh(x)


class Root(nn.Module):
    def forward(self, x):
        return torch.sqrt(torch.clamp(x, min=0.0)), torch.tanh(x)


def test_samples_that_overflow_in_torch_are_left_out_and_counted():
    report = parity(Naive(), to_casadi(Naive(), EXAMPLE), EXAMPLE, n=10, scale=(5.0,))
    # The one extreme sample: two values and both 2 x 2 Jacobians (reverse mode spreads NaN to all outputs).
    assert 0 < report.left_out <= 2 + 8
    # The package's promise for functions of a few operations.
    assert report.value_rel < 1e-12
    assert report.jacobian_rel < 1e-10
    assert f"{report.left_out} entries left out" in str(report)


def test_what_is_not_finite_on_one_side_only_is_an_infinite_error():
    x = ca.MX.sym("x", 2)
    ours_only = ca.Function("f", [x], [ca.sqrt(x), ca.tanh(x)])
    assert parity(Root(), ours_only, EXAMPLE, n=4).value_abs == np.inf
    theirs_only = ca.Function("f", [x], [0.5 + 0.5 * ca.tanh(x / 2), ca.tanh(x)])
    assert parity(Naive(), theirs_only, EXAMPLE, n=10, scale=(5.0,)).value_abs == np.inf
    slope_only = ca.Function("f", [x], [ca.tanh(x), ca.sqrt(x**4)])
    report = parity(Squares(), slope_only, EXAMPLE, n=4)
    assert report.value_abs < 1e-15 * 1e8  # rounding of squares of 1000 times a few
    assert report.jacobian_abs == np.inf


class Squares(nn.Module):
    def forward(self, x):
        return torch.tanh(x), x * x


def test_a_wrong_derivative_is_seen():
    x = ca.MX.sym("x", 2)
    wrong = ca.Function("f", [x], [ca.tanh(x) + 1e-6 * ca.sin(x), x * x])
    # The slope of the error is 1e-6 at the zero sample; tanh and its slope round to 1e-16.
    assert abs(parity(Squares(), wrong, EXAMPLE, n=2).jacobian_abs - 1e-6) < 1e-15


class Square(nn.Module):
    def forward(self, x):
        return x * x


def test_a_wrong_second_derivative_is_seen():
    x = ca.MX.sym("x", 2)
    ripple = 1e-14 * ca.sin(1e6 * x)  # of slope 1e-8 and curvature 1e-2
    rippled = ca.Function("f", [x], [x * x + ripple])
    report = parity(Square(), rippled, EXAMPLE, n=1)
    assert report.value_abs < 2e-14
    assert report.jacobian_abs < 2e-8
    assert 1e-4 < report.hvp_abs < 1
    right = parity(Square(), to_casadi(Square(), EXAMPLE), EXAMPLE, n=20)
    assert right.hvp_rel < 1e-15
    unasked = parity(Square(), rippled, EXAMPLE, n=1, hessians=False)
    assert np.isnan(unasked.hvp_rel)
    assert "Hessian" in str(report)
    assert "Hessian" not in str(unasked)


def test_shapes_are_read_off_the_function():
    class Product(nn.Module):
        def forward(self, a, b):
            return a @ b

    function = to_casadi(Product(), (torch.zeros(2, 3), torch.zeros(3)))
    report = parity(Product(), function, n=20, seed=1)
    assert max(report.value_rel, report.jacobian_rel, report.hvp_rel) < 1e-14  # sums of three products


def test_saturated_gates_are_among_the_samples():
    """A gate that gives NaN beyond 25 differs at the saturated sample alone."""
    x = ca.MX.sym("x", 2)
    fragile = ca.Function(
        "f", [x], [ca.if_else(ca.logic_and(ca.fabs(x) > 25, ca.fabs(x) < 35), np.nan, x * x)]
    )
    assert parity(Square(), fragile, EXAMPLE, n=5, hessians=False).value_rel < 1e-15
    assert parity(Square(), fragile, EXAMPLE, n=6, hessians=False).value_abs == np.inf
