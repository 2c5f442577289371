"""Gains of controller and filter, loops and margins, reduction: against LQR, python-control and each other."""

from dataclasses import replace

import casadi as ca
import control
import numpy as np
import pytest
from analyze_parts import response, system
from online_models import linear_model, pendulum_model, random_linear

from hybrid_mpc import (
    OCP,
    CondensedController,
    Disturbance,
    Estimate,
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    Signal,
    balanced_truncation,
    linearize,
    mpc_gain,
    mpc_loop,
    physical_states,
    solved_gain,
    steady_filter,
    system_structure,
)
from hybrid_mpc.analyze.margins import LEAST_GAIN, LinearLoop
from hybrid_mpc.analyze.properties import hankel_singular_values


def controller_of(model, n=20, r_delta=0.0, **options):
    n_x, n_u = model.n_x, model.n_u
    weights = np.linspace(1, 2, n_x), np.full(n_u, 0.3), np.full(n_u, r_delta)
    return CondensedController(model, OCP(n, *weights, [-50.0] * n_u, [50.0] * n_u, **options))


def filter_of(model, sigma_d=None):
    n_x = model.n_x
    return ExtendedKalmanFilter(
        model, sigma_y=[0.1] * model.n_y, sigma_x=np.linspace(0.1, 0.3, n_x), sigma_x0=np.ones(n_x),
        sigma_d=None if sigma_d is None else [sigma_d] * model.n_u,
    )  # fmt: skip


def lq_weights(controller):
    ocp, dt = controller.ocp, controller.model.dt
    return np.diag(ocp.q) * dt, np.diag(ocp.r) * dt


def test_gain_of_an_lq_problem_is_lqr_s():
    model, a, b, _ = random_linear(0, n_x=3, n_u=2)
    controller = controller_of(model)
    k, _, _ = control.dlqr(a, b, *lq_weights(controller))
    found = mpc_gain(controller, np.zeros(3), np.zeros(2))
    # The terminal weight is the Riccati matrix, so any horizon gives LQR; condition of H about 1e3.
    assert np.abs(found.by_state + k).max() < 1e-9
    assert np.abs(found.by_before).max() == 0.0


def test_gain_with_a_weight_on_changes_is_lqr_s_with_the_input_as_a_state():
    model, a, b, _ = random_linear(1, n_x=2, n_u=1, radius=0.9)
    controller = controller_of(model, n=150, r_delta=2.0)
    q, r = lq_weights(controller)
    s = 2.0 * model.dt
    f, g = np.block([[a, b], [np.zeros((1, 2)), np.eye(1)]]), np.vstack([b, np.eye(1)])
    weight = np.block([[q, np.zeros((2, 1))], [np.zeros((1, 2)), r]])
    # u = u_prev + v costs r u^2 + s v^2: a cross term r between u_prev and v.
    k, _, _ = control.dlqr(f, g, weight, r + s, np.vstack([np.zeros((2, 1)), r]))
    found = mpc_gain(controller, np.zeros(2), np.zeros(1))
    # Horizon 150 with closed-loop poles below 0.95: 0.95^150 = 5e-4, squared in the cost.
    assert np.abs(found.by_state + k[:, :2]).max() < 1e-5
    assert np.abs(found.by_before - (1 - k[:, 2:])).max() < 1e-5


@pytest.mark.parametrize("blocks", [None, (1, 2, 3, 4)])
def test_gain_is_the_derivative_of_the_controller_s_own_answer(blocks):
    model = pendulum_model(4, correction=0.2)
    controller = controller_of(model, n=10, r_delta=0.5, working_point=([0.0, 1.0], [0.0]), blocks=blocks)
    x, u = np.array([0.1, 0.0]), np.array([0.2])
    h = 0.1 * np.arange(4.0)
    plan, z = np.tile(u, (10, 1)), np.tile(np.concatenate([x, h]), (11, 1))

    def first(x, h, d, before, r):
        prepared = controller.linearize(plan, z, np.zeros(1), before, np.ones((11, 2)))
        estimate = Estimate(0.0, x, h, d, np.eye(7), np.zeros(1), 0.0)
        answer = controller.feedback(prepared, estimate, r[None])
        assert answer.status.name == "SOLVED"
        return answer.u[0]

    at = (x, h, np.zeros(1), u, np.zeros(2))
    numeric = []
    for i, part in enumerate(at):
        for e in np.eye(part.size) * 1e-2:
            ends = [first(*at[:i], part + s * e, *at[i + 1 :]) for s in (1, -1)]
            numeric.append((ends[0] - ends[1]) / 2e-2)
    found = mpc_gain(controller, x, u, h)
    whole = np.hstack([found.by_state, found.by_load, found.by_before, found.by_reference])
    # The answer is affine in all of these, so the step is no matter; the QP solver's own error is 1e-8 or so.
    assert np.abs(whole - np.array(numeric).T).max() < 1e-5


def test_the_gain_of_solves_is_that_of_the_qp():
    model, *_ = random_linear(0, n_x=3, n_u=2)
    controller = controller_of(model, r_delta=0.5)
    own, solved = (
        mpc_gain(controller, np.zeros(3), np.zeros(2)),
        solved_gain(controller, np.zeros(3), np.zeros(2), np.zeros(3)),
    )
    for name in ("by_state", "by_load", "by_before", "by_reference"):
        # solves are right to 1e-8 of the inputs' scale (50), over differences of 1e-4 of the signals' sizes
        np.testing.assert_allclose(getattr(solved, name), getattr(own, name), atol=1e-4)


@pytest.mark.parametrize("at", ["rate", "output"])
def test_loops_of_outputs_and_of_any_disturbance_model_leave_no_offset(at):
    model, *_ = random_linear(3, n_x=2, n_u=1, radius=0.9)
    place = model.states[0].name if at == "rate" else model.outputs[0].name
    model = replace(model, disturbance_model=(Disturbance(at, place, 1.0),))
    problem = OCP(20, [0.0, 0.0], [0.0], [0.3], [-50.0], [50.0], q_y=[1.0])
    gain = solved_gain(CondensedController(model, problem), np.zeros(2), np.zeros(1), np.zeros(1))
    if at == "output":  # an offset of the sensor is a set-point that lies lower
        np.testing.assert_allclose(gain.by_load, -gain.by_reference, atol=1e-5)
    ekf = ExtendedKalmanFilter(model, sigma_y=[0.1], sigma_x=[0.1, 0.1], sigma_x0=[1.0, 1.0], sigma_d=[0.05])
    filter, estimate = steady_filter(ekf, np.zeros(2), np.zeros(1)), ekf.start(np.zeros(1))
    for _ in range(600):
        before = ekf.predict(estimate, np.zeros(1))
        estimate = ekf.correct(before, np.zeros(1))
    settled = before.P @ filter.C.T / (filter.C @ before.P @ filter.C.T + 0.01)
    np.testing.assert_allclose(filter.gain, settled, atol=1e-6)
    loop = mpc_loop(gain, filter, linearize(model, np.zeros(2), np.zeros(1)))
    assert loop.stable
    # integral action: a constant load at the input is gone in the end
    closed = loop.closed
    a, b, c = (np.asarray(m) for m in (closed.A, closed.B, closed.C))
    from_load = c[:1] @ np.linalg.solve(np.eye(len(a)) - a, b[:, :1])
    assert abs(from_load.item()) < 1e-4


def test_a_measured_disturbance_moves_the_input_to_its_new_steady_state():
    x, u, g = (ca.MX.sym(name) for name in "xug")
    signal, gain = (Signal("x", "-", -5.0, 5.0),), Signal("g", "-", 0.5, 2.0)
    model = HybridModel.of(
        "tank", 0.1, signal, (Signal("u", "-"),), signal, x=x, u=u, w=g, x_next=0.9 * x + 0.1 * g * u,
        xdot=g * u - x, y=x, disturbances=(gain,), nominal_w=(1.0,),
    )  # fmt: skip
    problem = OCP(20, [0.0], [0.0], [1e-6], [-50.0], [50.0], q_y=[10.0])
    found = solved_gain(CondensedController(model, problem), [0.3], [0.3], [0.3])
    # at the set-point the input x / g holds it: its derivative is -x / g^2; the weight of changes is all but zero
    np.testing.assert_allclose(found.by_measured, [[-0.3]], atol=1e-4)


def test_gain_of_solves_at_a_bound_is_refused():
    with pytest.raises(InputError, match="HM-ANALYZE-024"):
        solved_gain(controller_of(pendulum_model()), [0.0, 0.0], [0.0], [40.0, 0.0])


def test_gain_where_a_bound_acts_is_refused():
    model = pendulum_model()
    with pytest.raises(InputError, match="HM-ANALYZE-020"):
        mpc_gain(controller_of(model), [0.0, 0.0], [50.0])
    with pytest.raises(InputError, match="HM-ANALYZE-022"):
        mpc_gain(controller_of(model, x_max=[0.3, 1.0]), [0.5, 0.0], [0.0])


def test_steady_gain_is_where_the_filter_settles_and_python_control_s():
    model, a, _, c = random_linear(2, n_x=3, n_u=1)
    for sigma_d in (None, 0.2):
        ekf = filter_of(model, sigma_d)
        found = steady_filter(ekf, np.zeros(3), np.zeros(1))
        estimate = ekf.start(np.zeros(1))
        for _ in range(400):
            before = ekf.predict(estimate, np.zeros(1))
            estimate = ekf.correct(before, np.zeros(1))
        gain = before.P @ found.C.T / (found.C @ before.P @ found.C.T + 0.01)
        # 400 steps of a filter with poles below 0.97: 1e-5 of the covariance.
        assert np.abs(found.gain - gain).max() < 1e-4
        assert np.abs(found.P - estimate.P).max() < 1e-4
    found = steady_filter(filter_of(model), np.zeros(3), np.zeros(1))
    predicting, _, _ = control.dlqe(a, np.eye(3), c, np.diag(np.linspace(0.1, 0.3, 3) ** 2), 0.01 * np.eye(1))
    assert np.abs(a @ found.gain[:3] - predicting).max() < 1e-9  # python-control's gain predicts
    assert np.all(found.gain[3:] == 0)  # no disturbance is followed


def test_poles_of_the_loop_are_lqr_s_and_the_filter_s():
    model, a, b, _ = random_linear(3, n_x=3, n_u=1, radius=1.05)
    controller = controller_of(model)
    gain = mpc_gain(controller, np.zeros(3), np.zeros(1))
    steady = steady_filter(filter_of(model), np.zeros(3), np.zeros(1))
    loop = mpc_loop(gain, steady, linearize(model, np.zeros(3), np.zeros(1)))
    _, _, lqr = control.dlqr(a, b, *lq_weights(controller))
    known = np.concatenate([lqr, np.linalg.eigvals((np.eye(3) - steady.gain[:3] @ steady.C[:, :3]) @ a)])
    # Separation principle; beside them the input's memory, which nothing uses (0).
    for pole in known:
        assert np.abs(loop.poles - pole).min() < 1e-6
    left = sorted(np.abs(loop.poles).tolist())
    assert np.abs(np.sort(np.abs(known)) - [p for p in left if p > 1e-6]).max() < 1e-6


def stable_loop(seed=4, sigma_d=0.2, r_delta=0.5):
    model, *_ = random_linear(seed, n_x=2, n_u=1, radius=0.95)
    gain = mpc_gain(controller_of(model, r_delta=r_delta), np.zeros(2), np.zeros(1))
    steady = steady_filter(filter_of(model, sigma_d), np.zeros(2), np.zeros(1))
    return gain, steady, linearize(model, np.zeros(2), np.zeros(1))


def radius(gain, steady, plant, factor=1.0, delay=0):
    scaled = system(plant.A, plant.B * factor, plant.C, plant.dt)
    return float(np.abs(mpc_loop(gain, steady, scaled, delay=delay).poles[0]))


@pytest.mark.parametrize("seed", [4, 5, 6])
def test_margins_are_where_the_loop_loses_stability(seed):
    parts = stable_loop(seed)
    loop = mpc_loop(*parts)
    assert loop.stable
    m = loop.margins()
    # The crossing is interpolated on 2,000 frequencies: a few parts in ten thousand.
    if np.isfinite(m.gain_up):
        assert radius(*parts, factor=m.gain_up * 0.998) < 1 < radius(*parts, factor=m.gain_up * 1.002)
    if m.gain_down > 0:
        assert radius(*parts, factor=m.gain_down * 1.002) < 1 < radius(*parts, factor=m.gain_down * 0.998)
    assert radius(*parts, delay=m.delay_periods) < 1 <= radius(*parts, delay=m.delay_periods + 1)
    assert m.delay_periods <= m.delay / parts[2].dt < m.delay_periods + 1.0001
    low, high = 1 / m.disk_gain, m.disk_gain
    for factor in (low * 1.001, high * 0.999):  # the disk margin is a promise
        assert radius(*parts, factor=factor) < 1
    assert m.disk_phase <= m.phase + 1e-3
    assert (
        abs(m.modulus * np.abs(loop.sensitivity(np.geomspace(0.01, np.pi / 0.1, 4000))["S"]).max() - 1) < 1e-3
    )


@pytest.mark.parametrize("seed", [4, 8, 11])
def test_margins_are_python_control_s_from_polynomials(seed):
    loop = mpc_loop(*stable_loop(seed))
    gm, pm, sm, _, _, _ = control.stability_margins(loop.broken(), method="poly")
    m = loop.margins()
    # Polynomials of degree 6 against frequencies that are interpolated.
    assert abs(m.gain_up / gm - 1) < 1e-3
    assert abs(m.phase / abs(np.radians(pm)) - 1) < 1e-3
    assert abs(m.modulus / sm - 1) < 1e-3


def test_sensitivity_functions_fit_each_other_and_the_closed_loop():
    loop = mpc_loop(*stable_loop())
    omega = np.geomspace(0.1, 30.0, 50)
    found = loop.sensitivity(omega)
    assert np.abs(found["S"] + found["T"] - 1.0).max() < 1e-12
    g = response(loop.closed, omega)
    assert np.allclose(g[0, 0], found["GS"][0, 0], rtol=1e-8)  # from a load to the output
    assert np.allclose(g[1, 1], found["KS"][0, 0], rtol=1e-8)  # from noise to the input
    assert np.allclose(g[1, 0], -found["T"][0, 0], rtol=1e-8)
    assert abs(found["S"][0, 0, 0]) < 0.5  # the disturbance is followed


@pytest.mark.parametrize("growth", [1e-13, 1e-4, 1e-2])
def test_a_gain_margin_that_only_rounding_shows_is_zero(growth):
    """An integrator whose pole is moved by ``growth``, with the gain 0.5: stable for factors above ``2 growth``."""
    plant = control.ss(1 + growth, 1.0, 1.0, 0.0, 0.02)
    feedback = control.ss(0.0, 0.0, 0.0, -0.5, 0.02, remove_useless_states=False)
    loop = LinearLoop(plant, feedback, plant, np.array([0.5 + growth]))
    down = 2 * growth if 2 * growth > LEAST_GAIN else 0.0
    assert loop.margins().gain_down == pytest.approx(down, rel=1e-3, abs=0.0)


def test_an_unstable_loop_has_no_margins():
    gain, steady, plant = stable_loop()
    wild = control.ss(plant.A, -30 * plant.B, plant.C, 0.0, plant.dt)
    loop = mpc_loop(gain, steady, wild)
    assert not loop.stable
    with pytest.raises(InputError, match="HM-ANALYZE-029"):
        loop.margins()


def test_each_input_can_be_cut_open():
    model, *_ = random_linear(7, n_x=3, n_u=2, n_y=2, radius=0.9)
    gain = mpc_gain(controller_of(model), np.zeros(3), np.zeros(2))
    steady = steady_filter(filter_of(model), np.zeros(3), np.zeros(2))
    plant = linearize(model, np.zeros(3), np.zeros(2))
    loop = mpc_loop(gain, steady, plant)
    for j in (0, 1):
        m = loop.margins(j)
        k = min(m.gain_up, 1e3)
        for factor, stable in ((0.998 * k, True), (1.002 * k, not np.isfinite(m.gain_up))):
            scaled = plant.B * np.where(np.arange(2) == j, factor, 1.0)
            assert mpc_loop(gain, steady, system(plant.A, scaled, plant.C, plant.dt)).stable == stable


def test_truncation_keeps_its_bound_and_unstable_poles():
    rng = np.random.default_rng(0)
    for unstable in (False, True):
        a = rng.normal(size=(6, 6))
        a *= (1.1 if unstable else 0.9) / np.abs(np.linalg.eigvals(a)).max()
        sys = control.ss(a, rng.normal(size=(6, 2)), rng.normal(size=(2, 6)), 0.0, 0.1)
        omega = np.geomspace(0.05, np.pi / 0.1, 300)
        fixed = int(np.isinf(hankel_singular_values(sys)).sum())
        assert fixed == np.sum(np.abs(np.linalg.eigvals(a)) >= 1)
        for order in range(max(fixed, 1), 7):
            reduced = balanced_truncation(sys, order)
            off = response(sys, omega) - response(reduced.system, omega)
            worst = max(np.linalg.norm(off[:, :, k], 2) for k in range(omega.size))
            assert worst <= reduced.bound * (1 + 1e-9) + 1e-9
            outside = [p for p in np.linalg.eigvals(a) if abs(p) >= 1]
            for pole in outside:
                assert np.abs(reduced.system.poles() - pole).min() < 1e-9


def test_a_hidden_state_that_does_nothing_is_reduced_away_exactly():
    a = np.block(
        [[np.array([[0.9, 0.1], [-0.2, 0.8]]), np.zeros((2, 2))], [0.3 * np.ones((2, 2)), 0.5 * np.eye(2)]]
    )
    model = linear_model(a, [[0.0], [1.0], [0.2], [0.1]], [[1.0, 0.0]], n_h=2)
    found = physical_states(model, np.zeros(2), [0.0], x_scale=[0.5, 2.0], u_scale=[0.3])
    assert found.bound < 1e-9
    assert np.abs(found.system.A - a[:2, :2]).max() < 1e-7  # the Gramian's square root has half the digits
    assert np.abs(found.system.B.ravel() - [0.0, 1.0]).max() < 1e-7


def test_reduced_hybrid_keeps_the_meaning_of_its_states_and_its_bound():
    model = pendulum_model(8, correction=0.3)
    sys = linearize(model, [0.2, 0.0], [0.0])
    found = physical_states(model, [0.2, 0.0], [0.0], x_scale=[1.0, 1.0])
    assert found.system.state_labels == ["phi", "phi_dot"]
    omega = np.geomspace(0.1, np.pi / model.dt, 200)
    assert 0 < np.abs(response(sys, omega) - response(found.system, omega)).max() <= found.bound


def test_modes_are_python_control_s_and_pbh_says_what_it_should():
    sys = linearize(pendulum_model(5), [0.1, 0.5], [0.0])
    found = system_structure(sys)
    wn, zeta, poles = control.damp(sys, doprint=False)
    order = np.argsort(-np.abs(poles), kind="stable")
    assert np.abs(np.sort([m.frequency for m in found.modes]) - np.sort(wn)).max() < 1e-6 * wn.max()
    assert np.abs(np.sort([m.damping for m in found.modes]) - np.sort(zeta)).max() < 1e-9
    assert np.abs(np.abs(poles[order]) - [abs(m.pole) for m in found.modes]).max() < 1e-12
    blind = system_structure(system(np.diag([1.2, 0.5]), [[1.0], [1.0]], [[0.0, 1.0]]))
    assert (blind.stabilisable, blind.detectable) == (True, False)
    assert np.isinf(blind.hankel[0])
