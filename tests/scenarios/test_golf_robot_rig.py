"""The golf robot's rig as a machine: accuracy, energy, stiction, sensor."""

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc.errors import InputError
from scenarios.golf_robot.nominal import GEAR
from scenarios.golf_robot.rig import Rig, RigParameters, rhs, rk4


def drive(rig: Rig, seconds: float = 20.0) -> np.ndarray:
    state = rig.reset(np.array([0.3, 0.0]), seed=0)
    states = [state]
    for k in range(round(seconds / 0.02)):
        state = rig.step(state, np.array([0.15 * np.sin(2 * np.pi * 0.6 * 0.02 * k)]), 0.02)
        states.append(state)
    return np.array(states)


@pytest.fixture(scope="module")
def driven() -> np.ndarray:
    return drive(Rig())


def test_halving_the_step_changes_a_trajectory_of_20_s_by_less_than_0_1_mrad(driven):
    assert np.abs(driven[:, 0]).max() > 0.5  # it does move
    # 1e-4 rad: a fifth of the encoder's quantisation noise, so no data set can show the difference
    assert np.abs(drive(Rig(sub_step=0.125e-3))[:, 0] - driven[:, 0]).max() < 1e-4


def test_energy_bookkeeping_closes():
    p = RigParameters()
    s, u, h = ca.SX.sym("s", 6), ca.SX.sym("u"), ca.SX.sym("h")
    ds, torques = rhs(s[:4], u, p)
    lost = -sum(torques[name] for name in ("viscous", "friction", "drag")) * s[1]
    f = ca.Function("f", [s, u], [ca.vertcat(ds, torques["motor"] * s[1], lost)])
    chain = ca.Function("one", [s, u, h], [rk4(f, s, u, h)]).fold(100)
    order = GEAR * p.cogging_order

    def energy(state: np.ndarray) -> float:
        gravity = -p.m * p.g * p.a * np.cos(state[0])
        return p.J * state[1] ** 2 / 2 + gravity + GEAR * p.cogging / order * np.cos(order * state[0])

    state = start = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    for k in range(500):
        state = np.array(chain(state, 0.15 * np.sin(2 * np.pi * 0.6 * 0.02 * k), 0.2e-3)).ravel()
    gap = energy(state) - energy(start) - (state[4] - state[5])
    assert state[5] > 0.5  # J lost to friction: the books have entries
    assert abs(gap) < 1e-6 * state[5]  # integration error alone; a wrong sign or a lost term gives order 1


def test_torque_below_break_away_does_not_move_the_club():
    rig, p = Rig(), RigParameters()
    hold = p.r * p.m * p.g * p.mu_c * (1 - p.asymmetry)  # Coulomb level: below the static one
    state = rig.reset(np.zeros(2), 0)
    state = rig.step(state, np.array([0.7 * hold / GEAR]), 2.0)
    stuck = state[0]
    # presliding: the deflection of the bristles at the Coulomb level, plus a cogging period's share
    assert 0 < stuck < 2 * p.mu_s / p.sigma0
    assert abs(rig.step(state, np.array([0.7 * hold / GEAR]), 5.0)[0] - stuck) < 1e-5  # no creep
    state = rig.step(state, np.array([3 * hold / GEAR]), 2.0)
    assert state[0] > 0.05  # above break-away it does


def test_static_friction_holds_the_club_off_the_bottom():
    rig, p = Rig(), RigParameters()
    angle = 0.5 * p.r * p.mu_c * (1 - p.asymmetry) / p.a  # gravity is half of what friction holds there
    end = rig.step(rig.reset(np.array([angle, 0.0]), 0), np.zeros(1), 5.0)
    assert abs(end[0] - angle) < 2 * p.mu_s / p.sigma0  # settles within the bristles' deflection
    assert abs(end[1]) < 1e-6  # at rest; a viscous model would have gone to the bottom


def test_friction_never_feeds_energy_into_a_free_swing():
    rig, p = Rig(), RigParameters()
    state, peak = rig.reset(np.array([1.0, 0.0]), 0), 1.0
    for _ in range(250):
        state = rig.step(state, np.zeros(1), 0.02)
        # cogging potential (0.4 mJ against 2.4 J/rad of gravity at this height) allows 1 mrad
        assert abs(state[0]) < peak + 1e-3
    assert abs(state[1]) < 1e-3
    assert abs(state[0]) < 2 * p.r * p.mu_s / p.a  # at rest within the friction's reach


def test_motor_torque_follows_with_its_lag():
    p = RigParameters()
    state = Rig().step(np.zeros(4), np.array([0.1]), p.lag)
    assert state[3] == pytest.approx(0.1 * p.motor_gain * (1 - np.exp(-1)), rel=1e-6)  # exact solution, RK4


def test_sensor_has_the_encoder_s_and_the_noise_s_variance():
    rig, p = Rig(), RigParameters()
    rng = np.random.default_rng(1)
    angles = rng.uniform(-1, 1, 20_000)
    error = np.array([rig.measure(np.array([phi, 9.0, 9.0, 9.0]), rng)[0] for phi in angles]) - angles
    count = 2 * np.pi / p.counts
    expected = np.hypot(p.noise, count / np.sqrt(12))
    assert error.std() == pytest.approx(expected, rel=0.03)  # 20,000 draws: 0.5 % standard error, 6 of them
    assert abs(error.mean()) < 5 * expected / np.sqrt(len(error))
    assert rig.measure(np.array([count * 7, 0, 0, 0]), rng).shape == (1,)


def test_plant_is_deterministic_and_splits_its_state(driven):
    rig = Rig()
    state = rig.reset(np.array([0.2, -1.0]), seed=3)
    assert rig.truth(state).tolist() == [0.2, -1.0]
    assert rig.hidden(state).tolist() == [0.0, 0.0]
    u = np.array([0.1])
    kept = state.copy()
    assert np.array_equal(rig.step(state, u, 0.02), rig.step(state, u, 0.02))
    assert np.array_equal(state, kept)  # step changes no argument
    halves = rig.step(rig.step(state, u, 0.01), u, 0.01)
    assert np.array_equal(halves, rig.step(state, u, 0.02))  # the same sub-steps


def test_sub_step_must_be_positive():
    with pytest.raises(InputError, match="sub_step"):
        Rig(sub_step=0.0)
