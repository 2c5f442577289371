"""A hybrid_mpc prior whose acceleration is written in CasADi: fitted, stepped, exported like one in torch."""

from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
import torch

from hybrid_mpc import HybridStep, Parameter, Prior, Scaling, Signal, n_features, trace_model
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.step import required_substeps
from nn_export import build, from_casadi, parity

torch.set_num_threads(1)


def acceleration():
    x, u, J, d = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("J"), ca.SX.sym("d")
    drag = ca.if_else(x[1] >= 0, 1, -1) * d * x[1] ** 2
    return ca.Function(
        "acceleration", [x, u, J, d], [(u - 3 * ca.sin(x[0]) - drag) / J], ["x", "u", "J", "d"], ["a"]
    )


class Signals(Prior):
    states: ClassVar = (Signal("phi", "rad", periodic=True), Signal("phi_dot", "rad/s"))
    inputs: ClassVar = (Signal("torque", "N m"),)
    outputs: ClassVar = (Signal("phi", "rad"),)
    parameters_spec: ClassVar = (
        Parameter("J", 0.15, "kg m^2", 0.1, 0.3),
        Parameter("d", 0.01, "N m s^2", 0.0, 0.1),
    )

    def inertia(self, x):
        return self.J


class InCasadi(Signals):
    def __init__(self, values=None):
        super().__init__(values)
        self.ode = from_casadi(acceleration())

    def acceleration(self, x, u):
        return self.ode(x, u, self.J, self.d)


class InTorch(Signals):
    def acceleration(self, x, u):
        v = x[..., 1:2]
        drag = torch.where(v >= 0, self.d, -self.d) * v**2
        return (u - 3 * torch.sin(x[..., 0:1]) - drag) / self.J


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_prior_is_the_one_written_in_torch(dtype):
    ours, theirs = InCasadi().to(dtype), InTorch().to(dtype)
    x, u = torch.randn(7, 3, 2, dtype=dtype), torch.randn(7, 3, 1, dtype=dtype)
    digits = {"rtol": 1e-5, "atol": 1e-4} if dtype is torch.float32 else {"rtol": 1e-13, "atol": 1e-12}
    xdot = ours(x, u)
    assert xdot.dtype is dtype
    assert torch.allclose(xdot, theirs(x, u), **digits)  # a few operations, values up to 50
    assert torch.allclose(ours.energy_balance(x, xdot, u), torch.zeros(7, 3, dtype=dtype), atol=1e-4)
    assert required_substeps(ours, 0.05) == required_substeps(theirs, 0.05)


def test_free_runs_and_their_gradients_agree():
    """Back-propagation through 40 Runge-Kutta steps, as in training, by both parameters."""
    slopes = []
    for prior in (InCasadi(), InTorch()):
        stack = StackedGRU(1, n_features(prior, True), 4, 1, seed=3)
        step = HybridStep(prior, stack.member(0), Scaling((1.0, 3.0), (0.3,), (5.0,), (0.5,)), 0.02)
        for parameter in step.parameters():
            parameter.requires_grad_(True)
        generator = torch.Generator().manual_seed(0)
        u = 0.3 * torch.randn(40, 8, 1, generator=generator, dtype=torch.float64)
        x, h = torch.zeros(8, 2, dtype=torch.float64), torch.zeros(8, 4, dtype=torch.float64)
        total = torch.zeros((), dtype=torch.float64)
        for k in range(40):
            x, h = step(x, h, u[k])
            total = total + (x**2).sum()
        total.backward()
        slopes.append(np.array([prior.J.grad.item(), prior.d.grad.item()]))
    # The same operations in another order, over 160 stages.
    assert np.allclose(*slopes, rtol=1e-10)


def test_the_hybrid_step_is_exported():
    prior = InCasadi()
    stack = StackedGRU(1, n_features(prior, True), 4, 1, seed=3)
    step = HybridStep(prior, stack.member(0), Scaling((1.0, 3.0), (0.3,), (5.0,), (0.5,)), 0.02)
    programs = trace_model(step.requires_grad_(False))
    examples = tuple(torch.zeros(n, dtype=torch.float64) for n in (2, 4, 1))
    x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", 4), ca.MX.sym("u")
    after = build(programs["step"])(x, h, u, [], list(prior.values.values()))
    report = parity(step, ca.Function("step", [x, h, u], after), examples, n=5, scale=(1.0, 1.0, 0.3))
    assert report.value_rel < 1e-12  # the package's promise
    assert report.jacobian_rel < 1e-10
