"""Linearizations, points of rest, friction and schedules against closed forms and python-control."""

import casadi as ca
import control
import numpy as np
import pytest
from analyze_parts import central_differences
from online_models import linear_model, pendulum_model

from hybrid_mpc import (
    HybridModel,
    InputError,
    Signal,
    equilibria,
    friction_slopes,
    gain_schedule,
    holding_input,
    jacobians,
    linearize,
    linearize_along,
    linearize_secant,
    load,
)
from hybrid_mpc.model.equilibrium import fixed_point
from scenarios.golf_robot.nominal import GEAR
from scenarios.golf_robot.nominal import PARAMETERS as GOLF

P = {p.name: p.value for p in GOLF}
REGION = [(-4.0, 4.0), (-2.0, 2.0)]


@pytest.fixture(scope="module")
def golf(golf_artifact):
    return load(golf_artifact).models


def golf_slopes(phi, v):
    """Derivatives of the golf robot's acceleration by angle and speed, by hand; the load is positive here."""
    load = P["m"] * v**2 * P["a"] + P["m"] * P["g"] * np.cos(phi)
    t = np.tanh(P["gamma"] * v)
    size = P["r"] * P["mu"]
    by_phi = -P["m"] * P["g"] * P["a"] * np.cos(phi) + size * t * P["m"] * P["g"] * np.sin(phi)
    by_v = -P["d"] - size * (P["gamma"] * (1 - t**2) * load + t * 2 * P["m"] * v * P["a"])
    return by_phi / P["J"], by_v / P["J"]


@pytest.mark.parametrize(("phi", "v"), [(0.0, 0.0), (0.4, 0.01), (-0.7, 1.3)])
def test_continuous_linearisation_of_the_golf_robot_is_the_one_by_hand(golf, phi, v):
    sys = linearize(golf["prior"], [phi, v], [0.1], continuous=True)
    by_phi, by_v = golf_slopes(phi, v)
    # Exact derivatives: rounding of numbers up to 70 is 1e-14.
    assert np.abs(sys.A - [[0.0, 1.0], [by_phi, by_v]]).max() < 1e-10
    assert np.abs(sys.B - [[0.0], [GEAR / P["J"]]]).max() < 1e-10
    assert sys.dt == 0


def test_a_hidden_state_has_no_continuous_form():
    with pytest.raises(InputError, match="HM-ANALYZE-011"):
        linearize(pendulum_model(4), [0.0, 0.0], [0.0], continuous=True)


@pytest.mark.parametrize("name", ["prior", "hybrid"])
def test_symbolic_matrices_agree_with_central_differences(golf, name):
    model = golf[name]
    w0 = np.concatenate([[0.3, 0.2], 0.1 * np.arange(model.n_h), [0.05]])

    def f(w):
        x, h, u = np.split(w, [2, 2 + model.n_h])
        after = *model.step(x, h, u, model.w, model.p), model.output(x, u, model.w, model.p)
        return np.concatenate([m.full().ravel() for m in after])

    numeric = central_differences(f, w0, 1e-5)
    x, h, u = np.split(w0, [2, 2 + model.n_h])
    a, b, c, d = (m.full() for m in jacobians(model)(x, h, u))
    # Truncation e^2 f''' / 6 with f''' up to 1e3, rounding 1e-16 / e: 1e-7 at most.
    assert np.abs(np.block([[a, b], [c, d]]) - numeric).max() < 1e-6


def test_along_a_free_run_the_product_of_the_maps_is_the_run_s_derivative():
    model, u = pendulum_model(3), 0.3 * np.sin(0.3 * np.arange(30))[:, None]

    def end(x):
        x, h = np.array(x), np.zeros(3)
        for held in u:
            x, h = (m.full().ravel() for m in model.step(x, h, held, model.w, model.p))
        return np.concatenate([x, h])

    along = linearize_along(model, [0.2, 0.0], u)
    numeric = central_differences(end, np.array([0.2, 0.0]), 1e-6)
    # Rounding 1e-16 / 1e-6 times the run's own amplification of about 10.
    assert np.abs(along.transition(0, 30)[:, :2] - numeric).max() < 1e-6
    here = linearize(model, along.x[7], along.u[7], along.h[7])
    assert np.array_equal(along.system(7).A, here.A)
    assert np.allclose(along.mean(10).A, along.A[10:].mean(axis=0), rtol=0, atol=1e-15)


def test_all_points_of_rest_of_a_pendulum_under_torque():
    model = pendulum_model(friction=0.05)
    found = equilibria(model, [1.2], REGION)
    # asin(1.2 / 2.4): one stable and one unstable point a turn; the angle is periodic, the region wider than a turn.
    angles = [p.x[0] for p in found.points]
    assert sorted(p.stability for p in found.points) == ["stable", "unstable"]
    for p in found.points:
        known = np.arcsin(0.5) if p.stability == "stable" else np.pi - np.arcsin(0.5)
        off = (p.x[0] - known + np.pi) % (2 * np.pi) - np.pi
        # The residual of 1e-10 over 1 - eigenvalue, about 1e-3 for friction's slow mode at rest.
        assert abs(off) < 1e-7
        assert p.residual <= 1e-10
    assert found.converged >= 8 * len(angles)
    assert found.unseen < 0.05


def test_more_torque_than_gravity_leaves_no_point_of_rest():
    found = equilibria(pendulum_model(), [2.5], REGION)
    assert (found.points, found.unseen) == ((), 1.0)


def test_points_of_rest_hold_the_hidden_state():
    model = pendulum_model(6, correction=0.1)
    found = equilibria(model, [0.0], REGION, starts=32)
    assert len(found.points) >= 2
    for p in found.points:
        x, h = (m.full().ravel() for m in model.step(p.x, p.h, p.u, model.w, model.p))
        assert np.abs(np.concatenate([x - p.x, h - p.h])).max() <= 1e-10
        x_near, h_near = fixed_point(model, [0.0], p.x)
        assert np.abs(np.concatenate([x_near - p.x, h_near - p.h])).max() < 1e-7


def test_a_continuum_of_points_of_rest_is_marginal():
    model = linear_model([[1.0, 0.1], [0.0, 0.9]], [[0.0], [1.0]], [[1.0, 0.0]])
    found = equilibria(model, [0.0], [(-1, 1), (-1, 1)])
    assert found.points[0].stability == "marginal"
    assert found.unseen > 0.5  # each start ends elsewhere: it says itself that these are not all


@pytest.mark.parametrize(("size", "stability"), [(0.9, "stable"), (1.1, "unstable")])
@pytest.mark.parametrize("angle", [0.3, 2.5])
def test_a_spiral_is_stable_where_its_poles_lie_inside_the_unit_circle(size, stability, angle):
    """Real parts say nothing: both signs of them occur inside the circle and outside."""
    turn = size * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    found = equilibria(linear_model(turn, [[0.0], [1.0]], [[1.0, 0.0]]), [0.0], [(-1, 1), (-1, 1)])
    assert [p.stability for p in found.points] == [stability]


def test_friction_at_rest_is_the_tanh_s_slope(golf):
    speeds = np.array([0.01, 0.2, 1.0])
    found = friction_slopes(golf["prior"], [0.0], speeds)
    assert (
        abs(P["r"] * P["mu"] * P["m"] * P["g"] - 0.19) < 1e-3
    )  # the 0.19 gamma N m s/rad of the documentation
    assert abs(found.tangent - (P["d"] + 0.19066 * P["gamma"]) / P["J"]) < 1e-3
    load = P["m"] * speeds**2 * P["a"] + P["m"] * P["g"]
    chord = (P["d"] + P["r"] * P["mu"] * load * np.tanh(P["gamma"] * speeds) / speeds) / P["J"]
    assert np.abs(found.secant - chord).max() < 1e-10
    assert np.abs(found.moving - [-golf_slopes(0.0, v)[1] for v in speeds]).max() < 1e-10


def test_describing_function_of_coulomb_friction_is_four_over_pi():
    found = friction_slopes(pendulum_model(damping=0.0, friction=0.05, slope=1e5), [0.0], [1.0])
    # 64 points of a jump: the mean of |cos| over them is off by (pi / 64)^2 / 6.
    assert abs(found.harmonic[0] * 0.14 / 0.05 - 4 / np.pi) < 1e-3
    assert abs(found.secant[0] * 0.14 / 0.05 - 1.0) < 1e-9


def test_secant_linearisation_of_a_linear_model_is_its_tangent():
    x, u, q = ca.MX.sym("x", 2), ca.MX.sym("u"), Signal("q", "m")
    rates = ca.vertcat(x[1], u - 2.0 * x[0] - 0.5 * x[1])
    model = HybridModel.of(
        "spring", 0.1, (q, Signal("v", "m/s")), (Signal("F", "N"),), (q,),
        x=x, u=u, x_next=x + 0.1 * rates, xdot=rates, y=x[0],
    )  # fmt: skip
    for kind in ("secant", "harmonic"):
        sys = linearize_secant(model, [0.0, 0.0], [0.0], [0.5], kind=kind)
        assert np.abs(sys.A - linearize(model, [0.0, 0.0], [0.0]).A).max() < 1e-12


def test_secant_frees_the_pendulum_of_the_friction_at_rest():
    rest = linearize(pendulum_model(), [0.0, 0.0], [0.0])
    working = linearize_secant(pendulum_model(), [0.0, 0.0], [0.0], [1.0])
    damped = [-np.log(abs(np.linalg.eigvals(s.A)).min()) / 0.02 for s in (rest, working)]
    # At rest 0.05 * 20 N m s/rad make 7.3 1/s; at 1 rad/s 4 / pi * 0.05 make 0.45 1/s, half of it each of a pair.
    assert damped[0] > 3.0
    assert 0.2 < damped[1] < 0.4


@pytest.mark.parametrize("kind", ["secant", "harmonic"])
def test_friction_that_stops_within_a_period_brakes_neither_stiffness_nor_inputs(kind):
    """At rest it brakes within a quarter of a period; in motion it is a constant force."""
    free = linearize(pendulum_model(friction=0.0), [0.0, 0.0], [0.0])
    stiff = linearize_secant(pendulum_model(slope=500.0), [0.0, 0.0], [0.0], [1.0], kind=kind)
    # the sinusoid is slower than 2 / slope for 0.3 % of its time, and there the step's tangent may be anything
    for given, wanted in ((stiff.B, free.B), (stiff.A[:, :1], free.A[:, :1])):
        np.testing.assert_allclose(given, wanted, rtol=0.02, atol=1e-4)


def test_schedule_is_python_control_s_lqr_at_each_point():
    model, q, r = pendulum_model(3), [10.0, 1.0], [0.5]
    points = [(np.array([a, 0.0]), holding_input(model, [a])) for a in (-0.6, 0.0, 0.9)]
    found = gain_schedule(model, points, q, r)
    for (x, u), gain, radius in zip(points, found.gain, found.radius, strict=True):
        sys = linearize(model, x, u)
        k, _, poles = control.dlqr(sys, np.diag([*q, 0, 0, 0]), np.diag(r))
        # Two solvers of the same equation, condition about 1e4.
        assert np.abs(gain - k).max() < 1e-8 * np.abs(k).max()
        assert abs(radius - np.abs(poles).max()) < 1e-9
    assert abs(points[1][1][0]) < 1.0  # the network's own torque at zero


def test_holding_input_of_a_pendulum_is_its_weight():
    u = holding_input(pendulum_model(), [0.5])
    # Residual 1e-10 of a speed that an input of 1 N m changes by 0.1 rad/s a period.
    assert abs(u[0] - 2.4 * np.sin(0.5)) < 1e-8


def test_bad_input_speaks():
    model = pendulum_model()
    for call, text in [
        (lambda: equilibria(model, [0.0], [(-1, 1)]), "region"),
        (lambda: equilibria(model, [0.0], REGION, starts=0), "start"),
        (lambda: friction_slopes(model, [0.0], [0.0]), "positive"),
        (lambda: linearize_secant(model, [0.0, 0.0], [0.0], [1.0], kind="chord"), "kind"),
        (lambda: gain_schedule(model, [], [1.0, 1.0], [1.0]), "HM-ANALYZE-025"),
        (lambda: linearize_along(model, [0.0], np.zeros((5, 1))), "HM-ANALYZE-018"),
    ]:
        with pytest.raises(InputError, match=text):
            call()
