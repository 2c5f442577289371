"""Tracked parameters and the blend in C: a period is one of Python's loop, on tanks that change."""

import ctypes
import subprocess
from dataclasses import replace
from functools import cache

import casadi as ca
import embedded_parts as parts
import machines
import numpy as np
import pytest
import replay_parts as replays
from embedded_parts import needs_compiler
from online_models import rk4
from replay_parts import Case, Whole, replay

from hybrid_mpc import (
    OCP,
    ChannelLimit,
    CondensedController,
    Disturbance,
    HybridModel,
    InputError,
    Monitor,
    Parameter,
    ResidualReadings,
    SafeController,
    Signal,
    TrackedParameter,
    WatchLimits,
)
from hybrid_mpc.embedded.generate import make_sources, sources_of
from hybrid_mpc.embedded.native import NativeController, load_library
from hybrid_mpc.estimate.tracking import TrackingFilter, with_tracked
from hybrid_mpc.kit.artifact import drift_limits
from hybrid_mpc.kit.assembly import make_resting_guard
from hybrid_mpc.model.blend import BLEND_SHARE, blended, with_share

TOLERANCE = 1e-9
"""As in ``test_whole_loops``: sums of another order, and steady states to 1e-9 of their scales; 4e-15 was found."""
DT, SPAN, REST = 5.0, 2 * machines.PUMP, machines.rest_levels()
PIPE = Parameter("pipe", machines.PIPE, "m^2", 0.8e-4, 1.33e-4)
LEAK = Parameter("leak", 0.0, "m^3/s", -2e-5, 2e-5, "of the upper tank")
OUTLETS = TrackedParameter("pipe", 0.4, relative=True)
LEAKING = TrackedParameter("leak", 5e-6, time=7200.0)
SHARE = TrackedParameter(BLEND_SHARE.name, 0.3)


def tanks(network=None):
    """Two tanks whose outlets and leak are parameters; a network, which sees a rate, corrects the lower level."""
    x, u, w, p = (ca.MX.sym(name, n) for name, n in (("x", 2), ("u", 1), ("w", 1), ("p", 2)))
    level = Signal("upper", "m", 0.0, 2.0), Signal("lower", "m", 0.0, 2.0)

    def rates(x):
        upper, lower = (p[0] * ca.sqrt(2 * machines.GRAVITY * ca.fmax(at, 1e-4)) for at in ca.vertsplit(x))
        return ca.vertcat(u - upper - p[1], upper + w - lower) / machines.AREA

    own, correction = {}, ca.MX.zeros(2)
    if network is not None:
        h = ca.MX.sym("h", network.size1_in(1))
        extra, h_next = network(ca.vertcat(x - ca.DM(REST), u / SPAN, 1e3 * rates(x)[0]), h)
        own, correction = {"h": h, "h_next": h_next}, 2e-3 * ca.vertcat(0, ca.tanh(extra))
    return HybridModel.of(
        "tanks", DT, level, (Signal("pump", "m^3/s"),), level[1:], x=x, u=u, w=w, p=p, y=x[1],
        x_next=rk4(rates, x, DT) + correction, xdot=rates(x) + correction / DT, parameters=(PIPE, LEAK),
        disturbances=(Signal("inflow", "m^3/s"),), nominal_x=REST, nominal_u=(machines.PUMP,),
        nominal_w=(machines.INFLOW,), disturbance_model=(Disturbance("rate", "lower", 1e-4),), **own,
    )  # fmt: skip


class Changing(replays.MachinePlant):
    """Tanks that differ as between two recordings; in the last third the outlets are wider than the bound."""

    def __init__(self, periods):
        super().__init__(with_tracked(tanks(), [OUTLETS, LEAKING]), sigma=1e-3)
        self._periods = periods

    def reset(self, x0, seed):
        self._k = 0
        return super().reset(x0, seed)

    def step(self, state, u, dt, w=None):
        self._k += 1
        pipe = 1.05 * PIPE.value if self._k < 2 * self._periods / 3 else 2.0 * PIPE.upper
        return super().step(state, u, dt, np.array([w[0], pipe, 4e-6]))


def case_of(model, prior, tracked, periods):
    """A loop with a forecast, lost and frozen samples, and a set-point that rests for a third of the time."""
    ocp = OCP(
        12, [0.0, 0.0], [0.025 / SPAN**2], [0.1 / SPAN**2], [0.0], [SPAN], q_y=[25.0], y_max=[0.55], preview_w=True
    )  # fmt: skip
    estimator = TrackingFilter(parts.filters_of(model, ocp), tracked)
    controller = CondensedController(estimator.model, ocp)
    safe = SafeController(controller, with_tracked(prior, tracked), safe_input=model.u0)
    t = DT * periods

    def reference(times):
        moves = (times < 0.3 * t) | (times > 0.6 * t)
        return REST[1] + 0.05 * np.where(moves, np.sin(times / 150.0), 0.0)[:, None]

    def inflow(times):
        return machines.INFLOW * (1.0 + 0.3 * np.sin(times / 90.0))[:, None]

    lower = ChannelLimit("lower", "m", 1, 0.01, 5e-3)
    limits = WatchLimits("residuals", DT, (lower, *drift_limits(model, tracked)), (4e-3,), (3,))
    return Case(
        estimator, safe, Monitor(ResidualReadings(estimator.model), limits), make_resting_guard(model),
        Changing(periods), reference, model.x0, periods, w=inflow,
        faults=(replays.lost(0.4 * t, 0.45 * t), replays.freezes(0.62 * t, 0.7 * t)),
    )  # fmt: skip


@cache
def changing():
    """The prior's parameters are tracked."""
    case = case_of(tanks(), tanks(), (OUTLETS, LEAKING), 240)
    return case, replays.run(case)


def blend(cell):
    """Prior and hybrid side by side, with a network of torch's ``cell``."""
    torch = pytest.importorskip("torch")
    from test_network_layers import Cells

    from nn_export import to_casadi

    torch.manual_seed(0)
    net = Cells(getattr(torch.nn, cell), 6).double().eval()
    none = torch.zeros(4, dtype=torch.double), torch.zeros(net.hidden, dtype=torch.double)
    return blended(tanks(), tanks(to_casadi(net, none)))


@cache
def side_by_side():
    """The share of the correction and the outlets are tracked."""
    case = case_of(blend("GRUCell"), with_share(tanks()), (OUTLETS, SHARE), 120)
    return case, replays.run(case)


@needs_compiler
@pytest.mark.parametrize("make", [changing, side_by_side])
def test_a_loop_that_tracks_replayed(make, tmp_path):
    """From Python's plan in each period, and from C's own ones: nothing adds up."""
    case, known = make()
    whole, w = Whole(tmp_path, case), known[1].w
    for own in (False, True):
        told = replay(whole, case, own=own, known=known)
        assert told.frozen > 0
        assert told.alarms > 10
        assert told.input < TOLERANCE
        assert told.estimate < TOLERANCE
        assert told.reading < TOLERANCE
    n = len(w)
    assert np.max(w[:, 1]) <= PIPE.upper
    assert w[-1, 1] > 0.98 * PIPE.upper  # at its bound
    assert np.ptp(w[n // 2 : 3 * n // 5, 1]) < 0.02 * PIPE.value  # rests without excitation
    assert np.ptp(w[:, 2]) > 0.1 * case.estimator.tracked[1].std


@needs_compiler
@pytest.mark.parametrize("cell", ["GRUCell", "LSTMCell"])
def test_slopes_by_tracked_parameters(cell):
    """Through the network, which sees a rate of the prior; an LSTM is written as layers."""
    base = blend(cell)
    model, ocp = with_tracked(base, (OUTLETS, SHARE)), OCP(4, [1.0, 1.0], [1.0], [1.0], [0.0], [SPAN])
    estimator = TrackingFilter(parts.filters_of(base, ocp), (OUTLETS, SHARE))
    c, rng = (
        load_library(make_sources(model, ocp, estimator=estimator), parts.QUICK).c,
        np.random.default_rng(0),
    )
    point = [ca.MX.sym(name, n) for name, n in (("x", 2), ("h", base.n_h), ("u", 1), ("w", 3))]
    z_next = ca.vertcat(*model.step(*point, model.p))
    slopes = ca.Function("slopes", point, [ca.jacobian(z_next, by) for by in point])
    n = 2 + base.n_h
    wide = -(-n // 8) * 8
    for _ in range(3):
        z, u, w = (
            np.zeros(wide),
            rng.uniform(0.3, 1.0, 1) * SPAN,
            np.array([4e-5, 1.1e-4, rng.uniform(0.2, 1.8)]),
        )
        z[:2], z[2:n] = rng.uniform(0.2, 0.5, 2), rng.uniform(-0.9, 0.9, base.n_h)
        after, slope = np.zeros(wide), np.zeros((n, wide + 3))
        c.hmpc_model_slope(*(ctypes.c_void_p(v.ctypes.data) for v in (z, u, w, after, slope)))
        wanted = np.hstack([v.full() for v in slopes(z[:2], z[2:n], u, w)])
        wanted = np.delete(wanted, n + 1, axis=1)  # by the inflow
        found = np.delete(slope, np.s_[n:wide], axis=1)
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-11 * np.max(np.abs(wanted)))
        assert np.all(wanted[2:, n + 1] != 0.0)  # the hidden state follows the outlets


@needs_compiler
def test_the_native_controller_plans_with_tracked_parameters():
    case, (steps, wanted) = changing()
    own = case.safe.controller
    native = SafeController(
        NativeController(own.model, own.ocp, flags=parts.QUICK), case.safe.fallback, first=own,
        safe_input=case.safe.safe_input,
    )  # fmt: skip
    found = replays.run(replace(case, safe=native))[1]
    assert found.source == wanted.source
    np.testing.assert_allclose(found.u, wanted.u, atol=TOLERANCE * SPAN)
    np.testing.assert_allclose(found.w, wanted.w, rtol=TOLERANCE, atol=TOLERANCE * LEAK.upper)
    assert len(steps) == len(found.u)


@needs_compiler
@pytest.mark.parametrize("single", [False, True], ids=["double", "float"])
def test_vectors_and_no_warning(single, tmp_path):
    """The test program's machine has other parameters; changed fitted values are noticed."""
    from test_export import STRICT

    found = parts.write(tmp_path, changing()[0], single=single)
    words = ["cc", "-O1", *STRICT, *sources_of(found), "hmpc_test.c", "-lm", "-o", "test"]
    subprocess.run(words, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "test"], capture_output=True, check=False).returncode == 0
    assert "pipe, leak" in (tmp_path / "README.md").read_text()
    text = (tmp_path / "hmpc_estimator.c").read_text()
    changed = text.replace("tracked_values(z + HMPC_NZ", "tracked_values(z")
    assert changed != text
    (tmp_path / "hmpc_estimator.c").write_text(changed)
    subprocess.run(words, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "test"], capture_output=True, check=False).returncode == 1


@needs_compiler
@pytest.mark.full
def test_rubbish_leaves_inputs_within_their_limits(tmp_path):
    from test_whole_loops import survives

    survives(changing()[0], tmp_path, 1500)


def test_a_controller_that_does_not_track_is_refused():
    case = changing()[0]
    with pytest.raises(InputError, match=r"tracks pipe, leak beside.*HM-EMBEDDED-011"):
        make_sources(tanks(), case.safe.controller.ocp, estimator=case.estimator)
