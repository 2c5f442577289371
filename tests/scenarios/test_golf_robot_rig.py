"""The golf robot's rig as a machine: accuracy, energy, stiction, belt, ball, sensor."""

import copy
import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import InputError
from scenarios.common import rk4
from scenarios.golf_robot.dynamics import LOSSES, N_STATES, RigParameters, powers, rhs, stored_energy
from scenarios.golf_robot.nominal import GEAR
from scenarios.golf_robot.rig import Rig

P = RigParameters()
DT = 0.02


def drive(rig: Rig, u, x0=(0.3, 0.0)) -> np.ndarray:
    """Mechanical states ``(n + 1, 6)`` under the torques ``u`` of 20 ms each."""
    states = [rig.reset(np.array(x0), seed=0)]
    for value in u:
        states.append(rig.step(states[-1], np.array([value]), DT))
    return np.array([state.z for state in states])


def sine(amplitude: float, frequency: float, seconds: float = 20.0) -> np.ndarray:
    return amplitude * np.sin(2 * np.pi * frequency * DT * np.arange(round(seconds / DT)))


@pytest.mark.parametrize(
    ("amplitude", "frequency", "reach"), [(0.14, 0.6, 1.0), (0.5, 1.5, 0.4), (0.1, 0.3, 0.2)]
)
def test_halving_the_step_changes_a_trajectory_of_20_s_by_less_than_0_1_mrad(amplitude, frequency, reach):
    u = sine(amplitude, frequency)
    coarse, fine = drive(Rig(), u), drive(Rig(sub_step=0.25e-3), u)
    assert np.abs(coarse[:, 0]).max() > reach  # it does move: fast and far, at full torque, and with stops
    # 1e-4 rad: a fifth of the encoder's quantisation noise, so no data set can show the difference
    assert np.abs(fine - coarse)[:, 0].max() < 1e-4


def test_energy_bookkeeping_closes():
    """Work of the motor = change of stored energy + what each effect dissipates."""
    n = N_STATES + len(LOSSES) + 2
    s, u, h = ca.SX.sym("s", n), ca.SX.sym("u"), ca.SX.sym("h")
    ds, torques = rhs(s[:N_STATES], u, P)
    rates = powers(s[:N_STATES], torques)
    f = ca.Function("f", [s, u], [ca.vertcat(ds, *rates.values())])
    one = ca.Function("one", [s, u, h], [rk4(f, s, u, h)])
    run = one.fold(200)
    energy = ca.Function("energy", [s], [stored_energy(s, P)])
    start = np.zeros(n)
    start[0] = 0.3
    state, command = start, np.concatenate([sine(0.14, 0.6, 5.0), np.where(sine(1, 1.3, 5.0) > 0, 0.5, -0.5)])
    for value in command:
        state = run(state, value, DT / 200).full().ravel()
    books = dict(zip(rates, state[N_STATES:], strict=True))
    lost = sum(books[name] for name in LOSSES)
    assert all(books[name] > 1e-3 * lost for name in LOSSES)  # each effect has its entry, and takes energy
    gap = books["motor"] - float(energy(state) - energy(start)) - lost
    assert abs(gap) < 1e-6 * lost  # integration error alone; a wrong sign or a lost term gives order 1


def test_torque_below_break_away_does_not_move_the_club():
    hold = P.r * P.m * P.g * P.mu_c * (1 - P.asymmetry)  # Coulomb level: below the static one
    stuck = drive(Rig(), np.full(100, 0.7 * hold / GEAR), x0=(0.0, 0.0))[-1]
    # presliding: the deflection of the bristles at the Coulomb level
    assert 0 < stuck[0] < 2 * P.mu_s / P.sigma0
    later = drive(Rig(), np.full(350, 0.7 * hold / GEAR), x0=(0.0, 0.0))[-1]
    assert abs(later[0] - stuck[0]) < 1e-5  # no creep
    assert drive(Rig(), np.full(100, 3 * hold / GEAR), x0=(0.0, 0.0))[-1, 0] > 0.05  # above, it moves


def test_without_losses_and_gap_it_is_the_pendulum_of_both_inertias():
    none = {"mu_c": 1e-9, "mu_s": 1e-9, "d": 0.0, "drag": 0.0, "motor_friction": 0.0, "cogging": 0.0}
    rigid = replace(P, **none, gap=0.0, belt_stiffness=4000.0)
    # mu of 1e-9 makes the bristle infinitely fast: take it out by a stiffness that is as small
    states = drive(Rig(replace(rigid, sigma0=1e-6, sigma1=0.0)), np.zeros(300), x0=(0.05, 0.0))
    t = DT * np.arange(len(states))
    omega = np.sqrt(P.m * P.g * P.a / P.J) * (1 - 0.05**2 / 16)  # pendulum at a small amplitude
    # belt: J_rotor / stiffness changes the frequency by (omega / 2500)^2; rest: amplitude^4 and 6 s of phase
    assert np.abs(states[:, 0] - 0.05 * np.cos(omega * t)).max() < 1e-4


def test_ball_takes_momentum_once_and_only_forwards():
    push = np.full(60, 0.2)
    with_ball, without = drive(Rig(ball=True), push, x0=(-0.4, 0.0)), drive(Rig(), push, x0=(-0.4, 0.0))
    hit = int(np.argmax(without[:, 0] >= 0))
    np.testing.assert_array_equal(with_ball[:hit], without[:hit])
    before = np.interp(0.0, without[hit - 1 : hit + 1, 0], without[hit - 1 : hit + 1, 1])
    club, ball = P.J - P.rotor, P.ball_mass * P.ball_radius**2
    after = before * (club - P.restitution * ball) / (club + ball)
    # from the impact to the end of the period the club gains what it gains without a ball: to 2nd order
    assert with_ball[hit, 1] - without[hit, 1] == pytest.approx(after - before, abs=0.02 * before)
    back = Rig(ball=True)
    swing = drive(back, np.zeros(40), x0=(0.9, 0.0))
    np.testing.assert_array_equal(swing, drive(Rig(), np.zeros(40), x0=(0.9, 0.0)))
    assert swing[-1, 0] < -0.1  # it went through, backwards
    state = back.reset(np.array([-0.4, 0.0]), 0)
    assert state.ball
    for u in push:
        state = back.step(state, np.array([u]), DT)
    assert not state.ball


def test_impact_conserves_momentum_and_restitution():
    club, ball = P.J - P.rotor, P.ball_mass * P.ball_radius**2
    rig = Rig(ball=True)
    state = rig.reset(np.array([-1e-6, 2.0]), 0)  # a microsecond before the impact
    after = rig.step(state, np.zeros(1), 1e-6).z[1]
    flight = club * (2.0 - after) / ball  # angular momentum about the axis, as speed at the ball's radius
    assert flight - after == pytest.approx(P.restitution * 2.0, rel=1e-3)  # the speeds separate
    assert 1.3 < P.ball_radius * flight < 2.1  # m/s: a putt


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.04, 0.03])
def test_sensor_s_delay(delay):
    rig = Rig(replace(P, noise=0.0, counts=10**7), delay=delay)
    state, seen, true = rig.reset(np.array([0.5, 0.0]), 0), [], []
    for _ in range(30):
        seen.append(rig.measure(state, np.random.default_rng(0))[0])
        true.append(rig.truth(state)[0])
        assert len(state.past) <= 4  # does not grow
        state = rig.step(state, np.array([0.1]), DT)
    t = DT * np.arange(30)
    late = np.interp(t - delay, t, true)
    # whole periods: exact up to the counts; between them: linear interpolation's 20 rad/s^2 * (20 ms)^2 / 8
    assert np.abs(np.array(seen) - late).max() < (1e-6 if delay != 0.03 else 1e-3)


def test_sensor_has_the_encoder_s_and_the_noise_s_variance():
    rig, rng = Rig(), np.random.default_rng(1)
    angles = rng.uniform(-1, 1, 20_000)
    state = rig.reset(np.zeros(2), 0)
    seen = [rig.measure(replace(state, z=np.full(6, phi)), rng)[0] for phi in angles]
    error = np.array(seen) - angles
    expected = np.hypot(P.noise, P.count / np.sqrt(12))
    assert error.std() == pytest.approx(expected, rel=0.03)  # 20,000 draws: 0.5 % standard error, 6 of them
    assert abs(error.mean()) < 5 * expected / np.sqrt(len(error))


def test_plant_is_deterministic_and_splits_its_state():
    rig, u = Rig(), np.array([0.1])
    state = rig.reset(np.array([0.2, -1.0]), seed=3)
    assert rig.truth(state).tolist() == [0.2, -1.0]
    assert rig.hidden(state).tolist() == [0.0, 0.0, 0.0, -1.0]
    kept = state.z.copy()
    once = rig.step(state, u, DT).z
    assert np.array_equal(once, rig.step(state, u, DT).z)
    assert np.array_equal(state.z, kept)  # step changes no argument
    halves = rig.step(rig.step(state, u, DT / 2), u, DT / 2)
    assert np.abs(halves.z - once).max() < 1e-9  # the same sub-steps
    for other in (copy.deepcopy(rig), pickle.loads(pickle.dumps(rig))):
        assert other == rig
        assert np.array_equal(other.step(state, u, DT).z, once)


def test_sub_steps_follow_the_speed():
    fast = Rig().reset(np.array([0.0, 14.0]), 0)  # the bristle relaxes at 16,000 1/s: 0.5 ms would blow up
    end = Rig().step(fast, np.zeros(1), DT).z
    assert np.all(np.isfinite(end))
    assert end[2] == pytest.approx(P.mu_c * (1 + P.asymmetry), rel=1e-3)  # sliding friction's level


@pytest.mark.parametrize(
    ("arguments", "words"), [({"sub_step": 0.0}, "sub_step"), ({"delay": -0.02}, "HM-SCENARIOS-018")]
)
def test_bad_options_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        Rig(**arguments)
