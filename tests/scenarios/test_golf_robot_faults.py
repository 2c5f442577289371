"""Each fault of the golf robot's catalogue does what it says inside a closed loop."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    CondensedController,
    Fault,
    HybridModel,
    InputError,
    SafeController,
    make_estimator,
    make_ocp,
    simulate,
)
from hybrid_mpc.loop.faults import install
from scenarios.golf_robot import scenario
from scenarios.golf_robot.faults import catalogue
from scenarios.golf_robot.nominal import GEAR, INPUTS, OUTPUTS, PARAMETERS, STATES
from scenarios.golf_robot.rig import Rig

DT, START, SECONDS = 0.02, 0.6, 1.6
QUIET = replace(Rig().parameters, noise=0.0, counts=10**8)


def fault_case(name, start):
    return {case.name: case for case in catalogue(start)}[name]


@dataclass(frozen=True)
class Recorded:
    """A rig that notes its states and the torques that reach it, and else is another rig."""

    rig: Rig
    states: list
    torques: list

    def step(self, state, u, dt):
        self.states.append(state)
        self.torques.append(float(u[0]))
        return self.rig.step(state, u, dt)

    def __getattr__(self, name):
        return getattr(self.rig, name)


def linear_model():
    """The pendulum of the published parameters without dry friction: enough to close a loop."""
    p = {spec.name: spec.value for spec in PARAMETERS}
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    a = (GEAR * u - p["m"] * p["g"] * p["a"] * ca.sin(x[0]) - 0.1 * x[1]) / p["J"]
    after = ca.vertcat(x[0] + DT * x[1] + DT**2 / 2 * a, x[1] + DT * a)
    return HybridModel.of(
        "pendulum", DT, STATES, INPUTS, OUTPUTS, x=x, u=u, x_next=after, xdot=ca.vertcat(x[1], a), y=x[0]
    )


@pytest.fixture(scope="module")
def loop():
    model, control = linear_model(), scenario.control
    ocp = make_ocp(model, control)
    safe = SafeController(CondensedController(model, ocp.changed(horizon=20)), model)
    ekf = make_estimator(model, scenario, np.array([1e-3, 3e-2]))

    def run(faults=(), rig=None):
        plant, rest = install(rig or Rig(QUIET), faults)
        seen = Recorded(plant, [], [])
        result = simulate(
            seen, ekf, safe, lambda t: np.column_stack([0.6 * np.sin(2 * t), 1.2 * np.cos(2 * t)]),
            dt=DT, duration=SECONDS, x0=[0.0, 0.0], seed=0, faults=rest,
        )  # fmt: skip
        return result, seen

    return run


@pytest.fixture(scope="module")
def healthy(loop):
    return loop()


@pytest.mark.parametrize("case", catalogue(START), ids=lambda case: case.name)
def test_every_case_leaves_the_past_alone_and_changes_the_future(loop, healthy, case):
    result, _ = loop(case.faults)
    first = round(START / DT)
    for name in ("x", "u", "y"):
        np.testing.assert_array_equal(getattr(result, name)[:first], getattr(healthy[0], name)[:first])
    assert not np.array_equal(result.x[first + 1 :], healthy[0].x[first + 1 :])
    assert np.isfinite(result.x).all()
    assert np.abs(result.u).max() <= 0.5  # what is commanded keeps to the limits, whatever fails


@pytest.mark.parametrize("percent", [10, 20, 50])
def test_heavier_club_falls_as_fast_and_accelerates_slower(percent):
    case = fault_case(f"mass_+{percent}", 0.0)
    free = {"mu_c": 1e-6, "mu_s": 1e-6, "d": 0.0, "drag": 0.0, "motor_friction": 0.0, "cogging": 0.0}
    p = replace(QUIET, **free, sigma0=1e-6, sigma1=0.0)
    gains = []
    for rig in (Rig(p), Rig(p).with_faults(case.faults)):
        ends = [rig.step(rig.reset(np.zeros(2), 0), np.array([u]), 0.2).z[1] for u in (0.0, 0.4)]
        gains.append(ends[1] - ends[0])
    # gravity at the small angle grows with the inertia too: the whole scales but for the rotor's 0.4 %
    assert gains[0] / gains[1] == pytest.approx(1 + percent / 100, rel=0.02)


def test_weaker_motor_and_encoder_faults_act_on_the_signals(loop, healthy):
    late = slice(round(START / DT), None)
    result, seen = loop(fault_case("motor_-20", START).faults)
    np.testing.assert_allclose(np.array(seen.torques)[late], 0.8 * result.u[late, 0], rtol=1e-12)
    for name, change in (
        ("encoder_offset", lambda phi: phi + 0.02),
        ("encoder_scale", lambda phi: 1.05 * phi),
        ("encoder_freeze", lambda phi: np.full(len(phi), healthy[0].y[round(START / DT) - 1, 0])),
    ):
        result, _ = loop(fault_case(name, START).faults)
        want = change(result.x[late, 0])
        np.testing.assert_allclose(result.y[late, 0], want, atol=1e-7)  # one count of 10^8
    gone = np.isnan(loop(fault_case("encoder_dropouts", START).faults)[0].y[:, 0])
    k = np.arange(len(gone))
    np.testing.assert_array_equal(gone, (k >= 30) & ((k - 30) % 25 < 5))


def test_push_gives_the_club_its_momentum(healthy):
    rig = Rig(QUIET).with_faults(fault_case("push", START).faults)
    states = [rig.reset(np.zeros(2), 0)]
    for torque in healthy[1].torques:  # of the healthy loop
        states.append(rig.step(states[-1], np.array([torque]), DT))
    kick = states[40].z[1] - healthy[1].states[40].z[1]
    # 1 N m for 0.2 s on 0.15 kg m^2: 1.33 rad/s, less what gravity and friction answer
    assert 0.6 < kick < 0.2 / QUIET.J
    np.testing.assert_array_equal(states[30].z, healthy[1].states[30].z)


def test_slipping_belt_holds_its_torque_and_gives_way():
    rig = Rig(replace(QUIET, cogging=0.0)).with_faults(fault_case("belt_slip", 0.0).faults)
    state = rig.reset(np.array([0.0, 0.0]), 0)
    for _ in range(100):
        state = rig.step(state, np.array([0.5]), DT)
        assert np.isfinite(state.z).all()
        assert state.z[4] <= QUIET.gap + 0.8 / QUIET.belt_stiffness + 1e-12
    phi, v, motor, p = state.z[0], state.z[1], state.z[5], QUIET
    held = p.m * p.g * p.a * np.sin(phi)
    friction = p.r * p.mu_s * (1 + p.asymmetry) * p.m * p.g
    assert abs(v) < 1e-3
    assert abs(held - 0.8) < friction  # the club hangs where 0.8 N m holds it, not 2
    assert motor > 50.0  # rad/s: the motor runs away


def test_growing_delay_reaches_its_size(loop):
    fault = fault_case("delay", 0.2).faults[0]
    assert fault.value_at(0.2 + 2.5, 0.0) == pytest.approx(0.03)
    rig = Rig(QUIET).with_faults([replace(fault, ramp=0.0)])
    state, true, seen = rig.reset(np.array([0.8, 0.0]), 0), [], []
    for _ in range(40):
        true.append(rig.truth(state)[0])
        seen.append(rig.measure(state, np.random.default_rng(0))[0])
        state = rig.step(state, np.zeros(1), DT)
    np.testing.assert_allclose(seen[:10], true[:10], atol=1e-7)
    np.testing.assert_allclose(seen[13:], true[10:-3], atol=1e-7)  # three periods late


def test_names_are_unique_and_faults_end():
    names = [case.name for case in catalogue()]
    assert len(set(names)) == len(names) == 16
    assert all(fault.end <= 3.0 for case in catalogue(2.0, 3.0) for fault in case.faults)
    for k in range(60, 160):  # 0.5 s later in the middle of a row of dropouts, up to rounding
        assert all(f.start < f.end for case in catalogue(0.02 * k, 0.02 * k + 0.5) for f in case.faults)
    with pytest.raises(InputError, match="HM-SCENARIOS-007"):
        catalogue(2.0, 2.0)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault(0.0, 1.0, "plant_fire", 1.0), "plant_friction"),
        (Fault(0.0, 1.0, "input_gain", 1.0), "HM-LOOP-005"),
        (Fault(0.0, 1.0, "plant_mass", 0.0), "positive"),
        (Fault(0.0, 1.0, "plant_delay", -0.1), "positive"),
    ],
)
def test_faults_that_no_rig_has_are_refused(fault, words):
    with pytest.raises(InputError, match=words):
        Rig().with_faults([fault])
