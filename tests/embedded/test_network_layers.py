"""Networks of every kind in a model become C: steps, Jacobians, rates and inputs are Python's."""

import ctypes

import casadi as ca
import embedded_parts as parts
import numpy as np
import pytest
from embedded_parts import needs_compiler
from online_models import pendulum_rhs, rk4

from hybrid_mpc import OCP, CondensedController, HybridModel, Signal, TrueState, make_monitor
from hybrid_mpc.embedded.cut import cut
from hybrid_mpc.embedded.generate import make_sources
from hybrid_mpc.embedded.native import NativeController, load_library
from nn_export import to_casadi

torch = pytest.importorskip("torch")
nn = torch.nn
pytestmark = needs_compiler
FEATURES = 4


class Cells(nn.Module):
    """Recurrent cells one behind the other; ``h`` holds all their states."""

    def __init__(self, kind, *sizes, **options):
        super().__init__()
        ends = [FEATURES, *sizes]
        self.cells = nn.ModuleList(kind(a, b, **options) for a, b in zip(ends, sizes, strict=False))
        self.long = kind is nn.LSTMCell
        self.head = nn.Linear(sizes[-1], 1)
        self.hidden = sum(sizes) * (2 if self.long else 1)

    def forward(self, s, h):
        kept, at = [], 0
        for cell in self.cells:
            n = cell.hidden_size
            if self.long:
                s, c = cell(s, (h[at : at + n], h[at + n : at + 2 * n]))
                kept += [s, c]
            else:
                s = cell(s, h[at : at + n])
                kept.append(s)
            at += n * (2 if self.long else 1)
        return self.head(s), torch.cat(kept)


class Memory(nn.Module):
    """The latest samples, which ``inner`` looks at: attention, dense layers."""

    def __init__(self, inner, length=4):
        super().__init__()
        self.inner, self.hidden = inner, length * FEATURES

    def forward(self, s, h):
        rows = torch.cat([h[FEATURES:], s])
        return self.inner(rows.reshape(-1, FEATURES)), rows


class Attention(nn.Module):
    """Attention among the samples, then a layer."""

    def __init__(self):
        super().__init__()
        self.q, self.k, self.v = (nn.Linear(FEATURES, 12) for _ in range(3))
        self.norm, self.out = nn.LayerNorm(12), nn.Linear(12, 1)

    def forward(self, rows):
        share = torch.softmax(self.q(rows) @ self.k(rows).T / 12**0.5, dim=-1)
        return self.out(self.norm(share @ self.v(rows))[-1])


class Deep(nn.Module):
    """A GRU whose input is normalised and which is read through further layers."""

    def __init__(self, units=10, wide=110):
        super().__init__()
        self.norm, self.cell = nn.LayerNorm(FEATURES), nn.GRUCell(FEATURES, units)
        self.head = nn.Sequential(
            nn.Linear(units, wide), nn.SiLU(), nn.Linear(wide, wide), nn.Tanh(), nn.Linear(wide, 1)
        )
        self.hidden = units

    def forward(self, s, h):
        h = self.cell(self.norm(s), h)
        return self.head(h), h


def dense():
    """Layers without a memory of their own, on the latest four samples."""
    return Memory(nn.Sequential(
        nn.Flatten(0), nn.Linear(16, 24), nn.SiLU(), nn.Linear(24, 24), nn.ReLU(), nn.Linear(24, 1)
    ))  # fmt: skip


NETWORKS = {
    "gru": lambda: Cells(nn.GRUCell, 12),
    "lstm": lambda: Cells(nn.LSTMCell, 12),
    "two grus": lambda: Cells(nn.GRUCell, 10, 8),
    "two lstms": lambda: Cells(nn.LSTMCell, 6, 8),
    "rnn": lambda: Cells(nn.RNNCell, 12),
    "relu rnn": lambda: Cells(nn.RNNCell, 12, nonlinearity="relu"),
    "deep": Deep,
    "dense": dense,
    "attention": lambda: Memory(Attention()),
}
ONE_CELL = ("gru",)


def model_of(name):
    """A pendulum whose acceleration a network with random weights corrects."""
    torch.manual_seed(3)
    net = NETWORKS[name]().double().eval()
    f = to_casadi(
        net, (torch.zeros(FEATURES, dtype=torch.double), torch.zeros(net.hidden, dtype=torch.double))
    )
    x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", net.hidden), ca.MX.sym("u")
    extra, h_next = f(ca.vertcat(ca.sin(x[0]), ca.cos(x[0]), x[1], u), h)
    rhs = lambda v: pendulum_rhs(v, u) + ca.vertcat(0, extra)  # noqa: E731
    rate = ca.MX.sym("rate", 2)
    return HybridModel.of(
        name.replace(" ", "_"), 0.02, (Signal("phi", "rad", periodic=True), Signal("phi_dot", "rad/s")),
        (Signal("torque", "N m"),), (Signal("phi", "rad"),), x=x, h=h, u=u, x_next=rk4(rhs, x, 0.02, 2),
        h_next=h_next, xdot=rhs(x), y=x[0], rate=rate, energy=(0.14 * rate[1] - u) * x[1],
    )  # fmt: skip


OCP_ = OCP(12, [40.0, 0.5], [1.0], [0.5], [-2.0], [2.0], working_point=([0.0, 1.0], [0.0]))
SHORT = ("gru", "lstm", "deep")


@pytest.mark.parametrize(
    "name", [n if n in SHORT else pytest.param(n, marks=pytest.mark.full) for n in NETWORKS]
)
def test_steps_slopes_rates_and_inputs(name):
    model = model_of(name)
    assert (cut(model).cell is not None) == (name in ONE_CELL)
    found = make_sources(
        model, OCP_, estimator=parts.filters_of(model, OCP_), fallback=None, monitor=make_monitor(model)
    )
    c, rng = load_library(found, parts.QUICK).c, np.random.default_rng(0)
    n, wide = 2 + model.n_h, -(-(2 + model.n_h) // 8) * 8
    none = ctypes.c_void_p(np.zeros(1).ctypes.data)
    for _ in range(4):
        z, z_next, xdot, slope = np.zeros(wide), np.zeros(wide), np.zeros(2), np.zeros((n, wide + 1))
        z[:2], z[2:n], u = rng.standard_normal(2), rng.uniform(-0.9, 0.9, model.n_h), rng.standard_normal(1)
        z_at, u_at, next_at, slope_at, rate_at = (
            ctypes.c_void_p(v.ctypes.data) for v in (z, u, z_next, slope, xdot)
        )
        x_next, h_next, by_z, by_u = (m.full() for m in model.with_jacobian(z[:2], z[2:n], u, [], []))
        wanted = np.vstack([x_next, h_next]).ravel()
        for name_of, more in (("model", ()), ("model_slope", (slope_at,))):
            z_next[:] = np.nan
            getattr(c, f"hmpc_{name_of}")(z_at, u_at, none, next_at, *more)
            np.testing.assert_allclose(z_next[:n], wanted, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(slope[:, :n], by_z, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(slope[:, wide:], by_u, rtol=1e-12, atol=1e-13)
        c.hmpc_rates(z_at, u_at, none, rate_at)
        np.testing.assert_allclose(
            xdot, model.xdot(z[:2], z[2:n], u, [], []).full().ravel(), rtol=1e-12, atol=1e-13
        )
    python, native = CondensedController(model, OCP_), NativeController(model, OCP_, flags=parts.QUICK)
    e = TrueState(model).start(np.concatenate([[0.5, 0.0], np.zeros(model.n_h)]))
    plan = python.initial(e)
    for k in range(12):
        e = TrueState(model).start(np.concatenate([plan.x[1], plan.h[1]]) + 0.01 * rng.standard_normal(n))
        goal = np.array([[0.5 * (-1) ** k, 0.0]])
        wanted, got = (solver.solve(plan, e, goal) for solver in (python, native))
        assert got.status is wanted.status
        assert np.max(np.abs(got.u - wanted.u)) / 4.0 < 1e-9
        np.testing.assert_allclose(got.h, wanted.h, atol=1e-9)
        plan = wanted


def test_equal_weights_are_there_once():
    """Of a step and its rates, which hold the same network: less than twice the size of one."""
    model = model_of("lstm")
    with_rates = make_sources(
        model, OCP_, estimator=parts.filters_of(model, OCP_), monitor=make_monitor(model)
    )
    text = with_rates.texts["hmpc_expressions.h"]
    assert text.count("_weight[48][12]") == 1
    assert text.count("_weight[48][4]") == 1
