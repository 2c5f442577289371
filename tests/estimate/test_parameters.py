"""Parameters as states: the model stays exact, filters find what changed, a guard goes over to them."""

import casadi as ca
import numpy as np
import pytest
from linear_axes import Axis
from monitor_parts import DT, J, pendulum
from online_models import pendulum_model

from hybrid_mpc import (
    HybridModel,
    InputError,
    Parameter,
    Signal,
    load,
    load_scenario,
    make_estimator,
    parameter_factors,
    parameter_filter,
    parameter_states,
    with_parameter_states,
)
from hybrid_mpc.estimate.switching import SLIP, SWITCHES, with_outliers

GROUPS = {"mass": ("m", "J"), "friction": ("d", "mu")}


@pytest.fixture(scope="module")
def models(golf_artifact):
    return load(golf_artifact).models


@pytest.fixture(scope="module")
def golf(models):
    return models["hybrid"]


@pytest.fixture(scope="module")
def adaptive(models):
    return with_parameter_states(models["hybrid"], GROUPS, prior=models["prior"])


def points(model, n, seed=0):
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=(n, model.n_x)), 0.3 * rng.normal(size=(n, model.n_u))
    return x, 0.4 * rng.normal(size=(n, model.n_h)), u


def test_at_zero_the_model_is_the_one_given_to_the_last_bit(golf, adaptive):
    for x, h, u in zip(*points(golf, 20), strict=True):
        whole = np.append(h, [0.0, 0.0])
        x_next, h_next = golf.step(x, h, u, golf.w, golf.p)
        x_same, h_same = adaptive.step(x, whole, u, adaptive.w, adaptive.p)
        assert np.array_equal(x_next.full(), x_same.full())
        assert np.array_equal(h_next.full(), h_same.full()[: golf.n_h])
        assert np.array_equal(h_same.full()[golf.n_h :], np.zeros((2, 1)))
        assert np.array_equal(
            golf.xdot(x, h, u, golf.w, golf.p).full(),
            adaptive.xdot(x, whole, u, adaptive.w, adaptive.p).full(),
        )


def test_jacobians_by_three_routes(adaptive):
    x, h, u = points(adaptive, 6)
    z = ca.MX.sym("z", adaptive.n_x + adaptive.n_h + 1)
    n_x = adaptive.n_x
    after = ca.vertcat(*adaptive.step(z[:n_x], z[n_x:-1], z[-1], adaptive.w, adaptive.p))
    step, by_ad = ca.Function("f", [z], [after]), ca.Function("j", [z], [ca.jacobian(after, z)])
    blocks = {"A": ("x", "h"), "B": ("u",), "s": ("x", "u", "h")}
    given = [np.tile(values, (6, 1)) for values in (adaptive.w, adaptive.p)]
    x_many, h_many, a_many, b_many, s_many = adaptive.side_by_side(6, blocks)(x, h, u, *given)
    for k in range(6):
        point = np.concatenate([x[k], h[k], u[k]])
        x_next, h_next, a, b = (
            m.full() for m in adaptive.with_jacobian(x[k], h[k], u[k], adaptive.w, adaptive.p)
        )
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
        x = adaptive.step(x, theta, u, adaptive.w, adaptive.p)[0].full().ravel()
        same = broken.step(same, [], u, broken.w, broken.p)[0].full().ravel()
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
        x, h = (v.full().ravel() for v in adaptive.step(x, h, u, adaptive.w, adaptive.p))
    assert abs(x[1]) < 0.02


def test_a_filter_finds_a_changed_mass():
    # The machine is the adaptive model itself at 1.5 times the mass from 1 s on, and nothing is noisy
    adaptive = with_parameter_states(pendulum(), {"mass": ("J", "mgl"), "friction": ("gamma",)})
    n, at, rng = 250, 50, np.random.default_rng(0)
    u = np.column_stack([0.8 * np.sin(3.1 * DT * np.arange(n)) + 0.2 * rng.normal(size=n)])
    x, h, y = np.zeros(2), np.zeros(2), []
    for k in range(n):
        y.append(x[:1])
        x = (
            adaptive.step(x, parameter_states([1.5, 1.0]) if k >= at else h, u[k], adaptive.w, adaptive.p)[0]
            .full()
            .ravel()
        )
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


def test_no_estimate_leaves_the_bounds():
    wild = parameter_factors([-1e6, -3.0, 0.0, 3.0, 1e6], most=2.0)
    assert wild[0] == pytest.approx(0.5)
    assert wild[-1] == pytest.approx(2.0)
    assert np.all((wild >= 0.5 - 1e-12) & (wild <= 2.0 + 1e-12))
    assert np.all(np.diff(wild) > 0)
    assert np.all(np.isfinite(parameter_states([1e-9, 1e9])))


REFUSED = (
    (lambda golf, prior: with_parameter_states(golf, GROUPS), "HM-MODEL-029"),
    (lambda golf, prior: with_parameter_states(golf, GROUPS, prior=Axis(0.02).model()), "HM-MODEL-030"),
    (lambda golf, prior: with_parameter_states(pendulum_model(), GROUPS), "HM-MODEL-030"),
    (lambda golf, prior: with_parameter_states(prior, {"mass": ("weight",)}), "HM-MODEL-032"),
    (lambda golf, prior: with_parameter_states(prior, {"mass": ()}), "HM-ESTIMATE-017"),
    (lambda golf, prior: with_parameter_states(prior, {}), "HM-ESTIMATE-012"),
    (lambda golf, prior: with_parameter_states(prior, GROUPS, most=1.0), "HM-ESTIMATE-011"),
    (lambda golf, prior: parameter_states([1.0, -0.5]), "HM-ESTIMATE-014"),
    (lambda golf, prior: parameter_filter(pendulum(), 3, sigma_y=[1.0], sigma_x=[1.0] * 2, sigma_x0=[1.0] * 2),
     "HM-ESTIMATE-013"),
    (lambda golf, prior: with_parameter_states(lagged(3), {"mass": ("m",)}), "HM-ESTIMATE-015"),
    (lambda golf, prior: with_parameter_states(lagged(4), {"mass": ("m",)}), "HM-ESTIMATE-015"),
)  # fmt: skip


@pytest.mark.parametrize(("use", "code"), REFUSED)
def test_bad_input_speaks(models, use, code):
    with pytest.raises(InputError, match=code):
        use(models["hybrid"], models["prior"])


def test_observer_and_parameter_filter_switch_by_the_same_numbers(adaptive, golf):
    sigma_x = np.array([1e-6, 1e-4])
    observer = make_estimator(golf, load_scenario("golf_robot"), sigma_x, input_noise=0.0)
    adapting = parameter_filter(adaptive, 2, sigma_y=[1e-4], sigma_x=sigma_x, sigma_x0=[1e-4, 0.1])
    for several, transition in ((observer, with_outliers(SWITCHES)), (adapting, SWITCHES)):
        np.testing.assert_array_equal(several.transition, transition)
        quiet, slip, *_ = (f.noise[0][:2] for f in several.filters)
        np.testing.assert_allclose(slip, SLIP**2 * quiet, rtol=1e-12)


def lagged(n):
    """A mass whose force lags, by one or two states that are no positions and velocities."""
    x, u, p = (ca.MX.sym(name, k) for name, k in (("x", n), ("u", 1), ("p", 1)))
    rate = ca.vertcat(x[1], x[2] / p, *([u - x[2]] if n == 3 else [x[3] - x[2], u - x[3]]))
    return HybridModel.of(
        "lagged", DT, [Signal(f"x{i}", "-") for i in range(n)], (Signal("u", "-"),), (Signal("x0", "-"),),
        x=x, u=u, p=p, x_next=x + DT * rate, xdot=rate, y=x[0], parameters=(Parameter("m", 1.0, "kg", 0.5, 2.0),),
    )  # fmt: skip


def test_an_input_gain_is_a_parameter_too(models):
    golf, prior = models["hybrid"], models["prior"]
    adaptive = with_parameter_states(golf, {"motor": ("gain of u",)}, prior=prior)
    x, h, u, given = np.array([0.2, 0.5]), np.zeros(golf.n_h), np.array([0.3]), (golf.w, golf.p)
    weaker = adaptive.xdot(x, np.append(h, parameter_states([0.8])), u, *given) - golf.xdot(x, h, u, *given)
    slope = prior.xdot(x, [], u, *given) - prior.xdot(x, [], 0.8 * u, *given)
    # the inverse of tanh and exp, to rounding
    assert float(weaker[1]) == pytest.approx(-float(slope[1]), rel=1e-9)


def test_the_parameters_given_are_those_that_change(adaptive):
    """Twice the mass given, and back by the state: the model of the fitted mass."""
    p = np.where([name.name in GROUPS["mass"] for name in adaptive.parameters], 2.0, 1.0) * adaptive.p
    x, u = np.array([0.2, 0.5]), np.array([0.3])
    h, half = np.zeros(adaptive.n_h), np.append(np.zeros(adaptive.n_h - 2), parameter_states([0.5, 1.0]))
    found, wanted = adaptive.xdot(x, half, u, adaptive.w, p), adaptive.xdot(x, h, u, adaptive.w, adaptive.p)
    np.testing.assert_allclose(found.full(), wanted.full(), rtol=1e-9)
    assert abs(float((adaptive.xdot(x, h, u, adaptive.w, p) - wanted)[1])) > 0.1
