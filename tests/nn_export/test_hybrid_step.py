"""The module this package is made for: a prior ODE with a recurrent correction, as one step."""

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from nn_export import build, load_programs, parity, save_programs, to_casadi, trace

torch.set_num_threads(1)


class Step(nn.Module):
    """(x, h, u) -> (x_next, h_next): a golf robot with a GRU that corrects its acceleration."""

    def __init__(self, z, torch_cell):
        super().__init__()
        self.torch_cell, self.cell, self.head = torch_cell, nn.GRUCell(5, z), nn.Linear(z, 1)
        self.register_buffer("scale", torch.tensor([0.3, 2.0], dtype=torch.float64))

    def acceleration(self, x, u):
        m, a, J, d, r, mu, g = 0.5241, 0.4702, 0.1445, 0.0132, 0.0245, 1.5136, 9.81
        v, phi = x[..., 1:2], x[..., 0:1]
        friction = r * mu * torch.tanh(20 * v) * torch.abs(m * v**2 * a + m * g * torch.cos(phi))
        return (-m * g * a * torch.sin(phi) - d * v - friction + 4 * u) / J

    def update(self, s, h):
        if self.torch_cell:
            return self.cell(s, h)
        c = self.cell
        gx, gh = F.linear(s, c.weight_ih, c.bias_ih), F.linear(h, c.weight_hh)
        (xz, xr, xn), (hz, hr, hn) = gx.chunk(3, -1), gh.chunk(3, -1)
        z, n = torch.sigmoid(xz + hz), torch.tanh(xn + torch.sigmoid(xr + hr) * hn)
        return (1 - z) * h + z * n

    def forward(self, x, h, u):
        phi, v = x[..., 0:1], x[..., 1:2]
        prior = self.acceleration(x, u)
        s = torch.cat([phi.sin(), phi.cos(), v * self.scale[0], u * self.scale[1], prior * 0.1], -1)
        h_next = self.update(s, h)
        correction, dt = self.head(h_next), 0.01

        def f(y):
            return torch.cat([y[..., 1:2], self.acceleration(y, u) + correction], -1)

        for _ in range(2):
            k1 = f(x)
            k2 = f(x + dt / 2 * k1)
            k3 = f(x + dt / 2 * k2)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + dt * k3))
        return x, h_next


def examples(z):
    return torch.zeros(2), torch.zeros(z), torch.zeros(1)


FULL = pytest.mark.full


@pytest.mark.parametrize(
    ("z", "torch_cell"),
    [
        (1, True),
        (4, False),
        *(
            pytest.param(*case, marks=FULL)
            for case in ((1, False), (8, True), (8, False), (32, True), (32, False))
        ),
    ],
)
def test_parity_of_the_step(z, torch_cell):
    torch.manual_seed(z)
    module = Step(z, torch_cell).double()
    function = to_casadi(module, examples(z), output_names=["x_next", "h_next"])
    assert (function.name_in(), function.name_out()) == (["x", "h", "u"], ["x_next", "h_next"])
    # Magnitudes where explicit RK4 stays finite; 1e-12 and 1e-10 are the package's promise.
    report = parity(module, function, examples(z), n=20, scale=(1e-3, 1.0, 1e-3))
    assert report.value_rel < 1e-12
    assert report.jacobian_rel < 1e-10
    assert report.hvp_rel < 1e-10


def test_a_saved_step_is_the_same_function(tmp_path):
    torch.manual_seed(2)
    program = trace(Step(8, True), examples(8))
    save_programs(tmp_path, {"step": program, "again": program})
    loaded = load_programs(tmp_path)
    point = [np.array([0.3, 0.5]), np.linspace(-1, 1, 8), 0.2]
    expected = build(program)(*point)
    for name in ("step", "again"):
        for a, b in zip(expected, build(loaded[name])(*point), strict=True):
            assert np.array_equal(a.full(), b.full())
    assert (tmp_path / "weights.safetensors").stat().st_size < 2 * 8 * 8 * (24 * 13 + 48 + 10)
