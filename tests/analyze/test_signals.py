"""Measured responses, interval bounds, contraction, exponents and sensitivities."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from analyze_parts import response
from online_models import linear_model, pendulum_model

import nn_export
from hybrid_mpc import (
    HybridModel,
    InputError,
    Signal,
    contraction,
    feature_box,
    gru_weights,
    linearize,
    load,
    lyapunov_exponent,
    multisine_response,
    parameter_sensitivities,
    run_model,
)
from hybrid_mpc.analyze.measured import welch_response
from hybrid_mpc.analyze.memory import GruWeights, interval_bounds

LAG = linear_model([[0.95, 0.1], [-0.1, 0.9]], [[0.0], [0.1]], [[1.0, 0.0]], dt=0.1)


def exact(omega):
    return response(linearize(LAG, [0.0, 0.0], [0.0]), omega)[0, 0]


def test_multisine_finds_the_response_of_a_linear_model():
    found = multisine_response(run_model(LAG, [0.0, 0.0]), 0.1, amplitude=1.0, band=(0.1, 4.0), settle=3)
    # What is left of the transient after 30 s: 0.93^300 = 1e-9.
    assert np.abs(found.response / exact(found.omega) - 1).max() < 1e-6
    assert found.coherence.min() > 1 - 1e-9


@pytest.mark.full
def test_welch_finds_it_too_and_knows_how_well():
    rng = np.random.default_rng(0)
    u = rng.normal(size=20000)
    y = run_model(LAG, [0.0, 0.0])(u)
    noisy = welch_response([(u, y + 0.02 * rng.normal(size=u.size))], 0.1, length=20.0)
    clean = welch_response([(u[:9000], y[:9000]), (u[9000:], y[9000:])], 0.1, length=20.0)
    low = noisy.omega < 10
    # Windows of 20 s against a ringing of 1.4 s; of the estimates 95 % lie within two deviations.
    assert np.median(np.abs(clean.response[low] / exact(clean.omega[low]) - 1)) < 0.02
    off = np.abs(np.abs(noisy.response) - np.abs(exact(noisy.omega)))
    trusted = noisy.coherence > 0.2
    assert np.mean(off[trusted] < 2 * noisy.deviation[trusted] + 0.01) > 0.85
    assert noisy.coherence[-1] < clean.coherence[-1]


def test_no_coherence_without_a_connection():
    rng = np.random.default_rng(1)
    found = welch_response([(rng.normal(size=20000), rng.normal(size=20000))], 0.1, length=10.0)
    assert np.median(found.coherence) < 3 / found.averages  # its mean is 1 / averages


@pytest.mark.full
@pytest.mark.parametrize("length", [700.0, 50.0])  # 4 and 79 windows
def test_unrelated_signals_are_trusted_as_rarely_as_it_is_said(length):
    """One line in a hundred, or fewer: 4 windows that overlap are a little more than 9/11 of 4 (here 0.25 %)."""
    rng = np.random.default_rng(2)
    found = [welch_response([tuple(rng.normal(size=(2, 20000)))], 0.1, length=length) for _ in range(20)]
    trusted = np.concatenate([one.trusted for one in found])
    assert trusted.size > 4000
    assert 0.001 < trusted.mean() < 0.02


@pytest.mark.full
def test_a_response_is_trusted_where_there_is_one():
    rng = np.random.default_rng(3)
    u = rng.normal(size=20000)
    y = run_model(LAG, [0.0, 0.0])(u) + 0.3 * rng.normal(size=u.size)
    found = welch_response([(u, y)], 0.1, length=20.0)
    assert found.trusted[found.omega < 2].all()  # where the lag passes
    assert not found.trusted[found.omega > 25].all()  # where noise is a hundred times what it passes
    assert not replace(found, averages=1.0).trusted.any()  # the coherence of one piece is 1 whatever it is


def test_too_little_data_is_said():
    with pytest.raises(InputError, match="HM-ANALYZE-034"):
        welch_response([(np.zeros(50), np.zeros(50))], 0.1, length=3.0)
    with pytest.raises(InputError, match="HM-ANALYZE-035"):
        multisine_response(lambda u: u, 0.1, amplitude=1.0, band=(0.1, 1.0), periods=1)


@pytest.mark.parametrize("last", [np.inf, np.nan, 1e200])
def test_a_signal_that_diverges_is_refused(last):
    u = np.random.default_rng(0).normal(size=2000)
    y = np.append(u[:-1], last)
    with pytest.raises(InputError, match=r"1999.*HM-ANALYZE-038"):
        welch_response([(u, y)], 0.1, length=20.0)
    driven = {"amplitude": 1.0, "band": (0.1, 1.0), "period": 10.0}
    with pytest.raises(InputError, match="HM-ANALYZE-038"):
        multisine_response(lambda u: np.append(u[:-1], last), 0.1, **driven)


def test_interval_bounds_hold_and_are_tight_where_each_variable_appears_once():
    x = ca.SX.sym("x", 3)
    once = x[0] * x[1] - 2 * x[2], ca.tanh(x[0]) / (3 + x[1]), ca.fabs(x[0]) + x[2] ** 2, ca.sin(2 * x[1])
    f = ca.Function("f", [x], [ca.vertcat(*once)])
    low, high = np.array([-1.0, -0.5, 0.2]), np.array([2.0, 1.0, 0.7])
    bounds = interval_bounds(f, low, high)
    axes = np.linspace(low, high, 61).T
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    values = f.map(len(grid))(grid.T).full()
    assert np.all(values.min(1) >= bounds[0] - 1e-12)
    assert np.all(values.max(1) <= bounds[1] + 1e-12)
    # The grid's own coarseness: a step of 0.05 at slopes of up to 2, less at the smooth extrema.
    assert np.abs(values.min(1) - bounds[0]).max() < 0.06
    assert np.abs(values.max(1) - bounds[1]).max() < 0.06


def test_interval_refuses_what_it_cannot_bound():
    x = ca.SX.sym("x")
    with pytest.raises(InputError, match="HM-ANALYZE-041"):
        interval_bounds(ca.Function("f", [x], [1 / x]), [-1.0], [1.0])
    with pytest.raises(InputError, match="HM-ANALYZE-039"):
        interval_bounds(ca.Function("f", [x], [ca.erf(x)]), [-1.0], [1.0])


def gru(seed, size, n=5, n_s=3):
    rng = np.random.default_rng(seed)
    return GruWeights(
        0.5 * rng.normal(size=(3 * n, n_s)), size * rng.normal(size=(3 * n, n)) / n, 0.1 * rng.normal(size=3 * n),
        0.1 * rng.normal(size=3 * n),
    )  # fmt: skip


def gru_step(c, s, h):
    sig = lambda v: 1 / (1 + np.exp(-v))  # noqa: E731
    a, b = np.split(c.w @ s + c.b_w, 3), np.split(c.r @ h + c.b_r, 3)
    r, z = sig(a[0] + b[0]), sig(a[1] + b[1])
    n = np.tanh(a[2] + r * b[2])
    return (1 - z) * n + z * h


@pytest.mark.parametrize("seed", range(4))
def test_a_certified_network_contracts_as_promised(seed):
    cell = gru(seed, 0.4)
    found = contraction(cell, -np.ones(3), np.ones(3))
    assert found.certified
    assert found.rate < 1
    rng = np.random.default_rng(seed)
    worst = 0.0
    for _ in range(300):
        h = found.reach * rng.uniform(-1, 1, size=(2, 5))
        s = rng.choice([-1.0, 1.0], size=3)
        before, after = h[0] - h[1], gru_step(cell, s, h[0]) - gru_step(cell, s, h[1])
        worst = max(worst, np.max(np.abs(after) / found.weights) / np.max(np.abs(before) / found.weights))
        assert np.all(np.abs(gru_step(cell, s, h[0])) <= found.reach + 1e-12)
    assert 0.3 < worst <= found.rate


def test_a_network_with_two_points_of_rest_is_not_certified():
    r = np.zeros((3, 1))
    r[2] = 5.0  # n = tanh(2.5 h): h = 0 and two more
    cell = GruWeights(np.zeros((3, 1)), r, np.zeros(3), np.zeros(3))
    ends = []
    for h in (0.5, -0.5):
        state = np.array([h])
        for _ in range(200):
            state = gru_step(cell, np.zeros(1), state)
        ends.append(state[0])
    assert ends[0] - ends[1] > 1.5  # it does not forget where it began
    found = contraction(cell, [-1.0], [1.0])
    assert not found.certified
    assert found.margin < 0
    assert contraction(GruWeights(cell.w, 0.3 * r, cell.b_w, cell.b_r), [-1.0], [1.0]).certified


def test_weights_and_features_are_read_from_an_artifact(golf_artifact):
    program = nn_export.load_programs(golf_artifact / "models")["hybrid/step"]
    cell = gru_weights(program)
    low, high = feature_box(program, [(-0.5, 0.5), (-1.0, 2.0)], [(-0.1, 0.3)])
    assert low.size == cell.w.shape[1] == 4
    # phi / 0.5, v / 1.5, u / 0.2 as they are scaled; the prior's acceleration 4 u / J and more, over 5.
    assert np.allclose(low[:3], [-1.0, -1 / 1.5, -0.5])
    assert np.allclose(high[:3], [1.0, 2 / 1.5, 1.5])
    assert high[3] >= 4 * 0.3 / 0.1445 / 5
    f = nn_export.build(program)
    h = np.zeros(8)
    for s in ([-0.5, -1.0, -0.1], [0.5, 2.0, 0.3]):
        after = f(s[:2], h, s[2], [], np.zeros(8))[1].full().ravel()
        assert np.all(np.abs(after) <= contraction(cell, low, high).reach)
    with pytest.raises(InputError, match="HM-ANALYZE-046"):
        gru_weights(nn_export.load_programs(golf_artifact / "models")["prior/step"])


def test_exponent_of_the_logistic_map_is_log_two():
    x, u, one = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
    chaos = HybridModel.of(
        "logistic", 0.5, one, (Signal("u", "-"),), one, x=x, u=u, x_next=4 * x * (1 - x), xdot=u, y=x
    )
    found = lyapunov_exponent(chaos, [0.3], np.zeros((4000, 1)))
    # ln 2 a period of 0.5 s; 3,200 periods of a mean with deviation 0.9 or so.
    assert abs(found.value - np.log(2) / 0.5) < 5 * found.deviation + 0.02
    assert found.deviation < 0.1


def test_exponent_of_a_linear_run_is_its_slowest_pole_s():
    model = linear_model(
        [[0.99, 0.1, 0.0], [0.0, 0.7, 0.0], [0.1, 0.0, 0.5]], np.ones((3, 1)), [[1.0, 0.0]], n_h=1
    )
    u = np.random.default_rng(0).normal(size=(500, 1))
    assert abs(lyapunov_exponent(model, [0.0, 0.0], u).value - np.log(0.99) / 0.1) < 1e-6
    assert abs(lyapunov_exponent(model, [0.0, 0.0], u, part="hidden").value - np.log(0.5) / 0.1) < 1e-9
    with pytest.raises(InputError, match="HM-ANALYZE-047"):
        lyapunov_exponent(pendulum_model(), [0.0, 0.0], u, part="hidden")


def test_sensitivities_agree_with_central_differences(golf_artifact):
    u = 0.2 * np.sin(0.1 * np.arange(60))[:, None]
    for model in load(golf_artifact).models.values():
        found = parameter_sensitivities(model, [0.1, 0.0], u, names=["mu", "J"])
        for j, key in enumerate(found.names):
            ends = []
            for sign in (1, -1):
                size = [1 + sign * 1e-5 * (parameter.name == key) for parameter in model.parameters]
                x, h, run = np.array([0.1, 0.0]), np.zeros(model.n_h), [np.array([0.1, 0.0])]
                for held in u:
                    x, h = model.step(x, h, held, model.w, size * model.p)
                    run.append(x.full().ravel())
                ends.append(np.array(run))
            numeric = (ends[0] - ends[1]) / 2e-5
            # Relative step 1e-5: truncation 1e-10 of third derivatives up to 1e4, rounding 1e-11.
            assert np.abs(found.relative[:, :, j] - numeric).max() < 1e-5
    assert np.all(found.by[0] == 0)


def test_parameters_that_a_run_does_not_tell_apart_are_named(golf_artifact):
    model = load(golf_artifact).models["prior"]
    u = 0.25 * np.sin(0.1 * np.arange(300))[:, None]
    found = parameter_sensitivities(model, [0.0, 0.0], u)
    sigma = [1e-3, np.inf]
    with pytest.raises(InputError, match="HM-ANALYZE-055"):
        found.correlation(sigma)  # r and mu are one product
    apart = found.apart(sigma)
    assert not {"r", "mu"} <= set(apart.names)
    assert np.allclose(np.diag(apart.correlation(sigma)), 1.0)
    with pytest.raises(InputError, match=r"model prior.*\['nothing'\].*m, g,.*HM-ANALYZE-056"):
        parameter_sensitivities(model, [0.0, 0.0], u, names=["nothing"])
