"""Parameters as states: the model stays exact, filters find what changed, a guard goes over to them."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from monitor_parts import DT, J, pendulum, simulate

from hybrid_mpc import (
    HybridModel,
    InputError,
    Signal,
    load,
    parameter_factors,
    parameter_filter,
    parameter_states,
    with_parameter_states,
)

GROUPS = {"mass": ("m", "J"), "friction": ("d", "mu")}


@pytest.fixture(scope="module")
def golf(golf_artifact):
    return load(golf_artifact).models["hybrid"]


@pytest.fixture(scope="module")
def adaptive(golf):
    return with_parameter_states(golf, GROUPS)


def points(model, n, seed=0):
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(n, model.n_x)), 0.3 * rng.normal(size=(n, model.n_u))
    return x, 0.4 * rng.normal(size=(n, model.n_h)), u


def test_at_zero_the_model_is_the_one_given_to_the_last_bit(golf, adaptive):
    for x, h, u in zip(*points(golf, 20), strict=True):
        whole = np.append(h, [0.0, 0.0])
        x_next, h_next = golf.step(x, h, u)
        x_same, h_same = adaptive.step(x, whole, u)
        assert np.array_equal(x_next.full(), x_same.full())
        assert np.array_equal(h_next.full(), h_same.full()[: golf.n_h])
        assert np.array_equal(h_same.full()[golf.n_h :], np.zeros((2, 1)))
        assert np.array_equal(golf.xdot(x, h, u).full(), adaptive.xdot(x, whole, u).full())


def test_jacobians_by_three_routes(adaptive):
    x, h, u = points(adaptive, 6)
    z = ca.MX.sym("z", adaptive.n_x + adaptive.n_h + 1)
    n_x = adaptive.n_x
    after = ca.vertcat(*adaptive.step(z[:n_x], z[n_x:-1], z[-1]))
    step, by_ad = ca.Function("f", [z], [after]), ca.Function("j", [z], [ca.jacobian(after, z)])
    blocks = {"A": ("x", "h"), "B": ("u",), "s": ("x", "u", "h")}
    x_many, h_many, a_many, b_many, s_many = adaptive.side_by_side(6, blocks)(x, h, u)
    for k in range(6):
        point = np.concatenate([x[k], h[k], u[k]])
        x_next, h_next, a, b = (m.full() for m in adaptive.with_jacobian(x[k], h[k], u[k]))
        own, value = np.hstack([a, b]), np.vstack([x_next, h_next]).ravel()
        # exact routes agree to rounding of sums of terms of order 10
        np.testing.assert_allclose(own, by_ad(point).full(), atol=1e-12)
        np.testing.assert_allclose(np.hstack([a_many[k], b_many[k]]), own, atol=1e-12)
        np.testing.assert_allclose(s_many[k], np.hstack([a[:, :n_x], b, a[:, n_x:]]), atol=1e-12)
        np.testing.assert_allclose(np.append(x_many[k], h_many[k]), value, atol=1e-12)
        np.testing.assert_allclose(step(point).full().ravel(), value, atol=1e-12)
        e = 1e-6 * np.eye(point.size)
        central = [(step(point + d).full() - step(point - d).full()) / 2e-6 for d in e]
        # central differences: truncation e^2 times third derivatives (steep friction: 80^2), rounding 1e-10
        np.testing.assert_allclose(own, np.hstack(central), atol=1e-6)


def test_changed_parameters_move_the_model_as_another_machine_would():
    model = pendulum()
    adaptive = with_parameter_states(model, {"mass": ("J", "mgl"), "friction": ("gamma",)})
    broken = pendulum(inertia=1.5 * J, mgl=1.5 * 1.5, friction=2 * 0.15)
    theta, x, same = parameter_states([1.5, 2.0]), np.array([0.3, -0.5]), np.array([0.3, -0.5])
    for k in range(100):
        u = np.array([0.8 * np.sin(0.1 * k)])
        x = adaptive.step(x, theta, u)[0].full().ravel()
        same = broken.step(same, [], u)[0].full().ravel()
    # a second order in dt of the change: 2 s of motion of order 1 to a few parts in a thousand
    np.testing.assert_allclose(x, same, atol=5e-3)


def test_steep_friction_stays_stable(adaptive):
    # at rest the changed friction's slope times dt is 9: explicit integration would shake
    x, h, u = (
        np.array([0.0, 0.02]),
        np.append(np.zeros(adaptive.n_h - 2), parameter_states([1.0, 3.9])),
        np.zeros(1),
    )
    for _ in range(50):
        x, h = (v.full().ravel() for v in adaptive.step(x, h, u))
    assert abs(x[1]) < 0.02


def test_a_filter_finds_a_changed_mass():
    # The machine is the adaptive model itself at 1.5 times the mass from 1 s on, and nothing is noisy
    adaptive = with_parameter_states(pendulum(), {"mass": ("J", "mgl"), "friction": ("gamma",)})
    n, at, rng = 250, 50, np.random.default_rng(0)
    u = np.column_stack([0.8 * np.sin(3.1 * DT * np.arange(n)) + 0.2 * rng.normal(size=n)])
    x, h, y = np.zeros(2), np.zeros(2), []
    for k in range(n):
        y.append(x[:1])
        x = adaptive.step(x, parameter_states([1.5, 1.0]) if k >= at else h, u[k])[0].full().ravel()
    kalman = parameter_filter(adaptive, 2, sigma_y=[1e-4], sigma_x=[1e-6, 1e-4], sigma_x0=[1e-4, 0.1])
    estimate, found = kalman.start(y[0]), []
    for k in range(1, n):
        estimate = kalman.update(estimate, y[k], u[k - 1])
        found.append(parameter_factors(estimate.h))
    before, after = found[at - 2], found[-1]
    np.testing.assert_allclose(before, 1.0, atol=0.02)  # no more than what it did not know at first
    # exact measurements, a filter that takes them for noisy by 1e-4: a few deviations of 1 %
    np.testing.assert_allclose(after, [1.5, 1.0], atol=0.03)
    half = next(k for k in range(at, n) if found[k - 1][0] > 1.25)
    assert (half - at) * DT < 0.5


def test_a_filter_finds_what_the_real_equations_do():
    run_ = simulate(200, fault=pendulum(inertia=1.3 * J, mgl=1.3 * 1.5), at=0, noise=1e-4)
    adaptive = with_parameter_states(pendulum(), {"mass": ("J", "mgl")})
    kalman = parameter_filter(adaptive, 1, sigma_y=[1e-4], sigma_x=[1e-5, 1e-3], sigma_x0=[1e-4, 0.1])
    estimate = kalman.start(run_.y[0])
    for k in range(1, 200):
        estimate = kalman.update(estimate, run_.y[k], run_.u[k - 1])
    assert parameter_factors(estimate.h)[0] == pytest.approx(1.3, abs=0.03)  # noise of 1e-4 rad


def test_no_estimate_leaves_the_bounds():
    wild = parameter_factors([-1e6, -3.0, 0.0, 3.0, 1e6], most=2.0)
    assert wild[0] == pytest.approx(0.5)
    assert wild[-1] == pytest.approx(2.0)
    assert np.all((wild >= 0.5 - 1e-12) & (wild <= 2.0 + 1e-12))
    assert np.all(np.diff(wild) > 0)
    assert np.all(np.isfinite(parameter_states([1e-9, 1e9])))


def test_bad_input_speaks(golf):
    with pytest.raises(InputError, match="export it again"):
        with_parameter_states(replace(golf, parametric=None), GROUPS)
    with pytest.raises(InputError, match="no parameter 'weight'; there are: m, g,"):
        with_parameter_states(golf, {"mass": ("weight",)})
    with pytest.raises(InputError, match="group 'mass' is empty"):
        with_parameter_states(golf, {"mass": ()})
    with pytest.raises(InputError, match="at least one group"):
        with_parameter_states(golf, {})
    with pytest.raises(InputError, match="must be above 1"):
        with_parameter_states(golf, GROUPS, most=1.0)
    with pytest.raises(InputError, match="must be positive"):
        parameter_states([1.0, -0.5])
    with pytest.raises(InputError, match="3 groups given"):
        parameter_filter(pendulum(), 3, sigma_y=[1.0], sigma_x=[1.0, 1.0], sigma_x0=[1.0, 1.0])
    with pytest.raises(InputError, match="no lags"):
        with_parameter_states(lagged(), {"mass": ("m",)})


def lagged():
    x, u, p, h, w = (ca.MX.sym(name, n) for name, n in (("x", 3), ("u", 1), ("p", 1), ("h", 0), ("w", 3)))
    rhs = ca.vertcat(x[1], x[2], u - x[2])
    return HybridModel(
        "lagged", DT, tuple(Signal(name, "-") for name in ("q", "v", "f")), (Signal("u", "-"),), (Signal("q", "-"),),
        ca.Function("f", [x, h, u], [x + DT * rhs, h]), ca.Function("g", [x, h, u], [rhs]),
        ca.Function("y", [x, u], [x[0]]), ca.Function("e", [x, w, u], [w[1] - x[2]]),
        parameters={"m": 1.0}, parametric=ca.Function("a", [x, u, p], [x[2] / p]),
    )  # fmt: skip


def test_an_input_gain_is_a_parameter_too(golf):
    adaptive = with_parameter_states(golf, {"motor": ("gain of u",)})
    x, h, u = np.array([0.2, 0.5]), np.zeros(golf.n_h), np.array([0.3])
    weaker = adaptive.xdot(x, np.append(h, parameter_states([0.8])), u) - golf.xdot(x, h, u)
    slope = golf.parametric(x, u, list(golf.parameters.values())) - golf.parametric(
        x, 0.8 * u, list(golf.parameters.values())
    )
    assert float(weaker[1]) == pytest.approx(
        -float(slope), rel=1e-9
    )  # the inverse of tanh and exp, to rounding
    assert float(slope) > 0.1
