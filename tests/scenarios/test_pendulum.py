import subprocess
import sys

import numpy as np
import pytest
from energy_checks import rates
from scipy.integrate import solve_ivp

from hybrid_mpc import InputError, load_trajectories
from hybrid_mpc.workflow.stages.results import read_results
from scenarios.pendulum import scenario
from scenarios.pendulum.data import AMPLITUDE, DURATION, exact_runs, make_data, recordings, run, stems
from scenarios.pendulum.oracle import oracle
from scenarios.pendulum.plant import DampedPendulum, PendulumParameters
from scenarios.pendulum.prior import PendulumPrior

P = PendulumParameters()
DT = scenario.data.dt
QUIET = DampedPendulum(noise=0.0)
S_AS_PRIOR = PendulumPrior({"l": P.l, "d": P.d})


def test_prior_plant_and_oracle_are_one_equation():
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-3, 3, (20, 2)), rng.uniform(-20, 20, (20, 1))
    by_hand = (u[:, 0] - 50 * 9.81 * 0.045 * np.sin(x[:, 0]) - 2.1 * x[:, 1]) / (50 * 0.045**2)
    # rounding of terms of up to 300 rad/s^2
    np.testing.assert_allclose(QUIET.acceleration(x, u[:, 0]), by_hand, rtol=0, atol=1e-12)
    mine = rates(S_AS_PRIOR, x, u)
    np.testing.assert_allclose(mine[:, 1], by_hand, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(mine[:, 0], x[:, 1])
    model, nominal = oracle(DT), PendulumPrior()
    for k in range(20):
        xdot = model.xdot(x[k], [], u[k], model.w, model.p).full().ravel()
        np.testing.assert_allclose(xdot, [x[k, 1], by_hand[k]], rtol=0, atol=1e-12)
        # the balance's terms reach 50 W
        balance = float(model.balances[0].residual(x[k], xdot, u[k], model.w, model.p))
        expected = nominal.equations.balances[0].residual(x[k], xdot, u[k], [], nominal.p)
        assert balance == pytest.approx(float(expected), abs=1e-12)


def swing(plant, seconds=5.0, x0=(1.2, -3.0)):
    """States and torques of a run under a sinusoid, a plant state every period."""
    u = 15.0 * np.sin(2 * np.pi * 0.9 * DT * np.arange(round(seconds / DT)))
    states = [plant.reset(np.array(x0), seed=0)]
    for torque in u:
        states.append(plant.step(states[-1], np.array([torque]), DT))
    return states, u


def test_integrator_keeps_its_stated_tolerance():
    states, u = swing(QUIET)
    x = np.array([1.2, -3.0])
    worst = 0.0
    for k, torque in enumerate(u):  # a new start at every step of the torque keeps the tolerance
        x = solve_ivp(
            lambda _, z, t=torque: [z[1], float(QUIET.acceleration(z, t))],
            (0, DT), x, method="DOP853", rtol=1e-12, atol=1e-13,
        ).y[:, -1]  # fmt: skip
        worst = max(worst, abs(states[k + 1].z[0] - x[0]))
    assert worst < 1e-9  # rad: what the plant's docstring states


def test_energy_s_books_close():
    states, _ = swing(QUIET)
    first = QUIET.stored_energy(states[0])
    for state in states:
        _, _, work, heat = state.z
        assert QUIET.stored_energy(state) - first == pytest.approx(work - heat, abs=1e-8)  # as stated
    assert states[-1].z[3] > 10.0  # J; the books hold something
    heat = np.array([state.z[3] for state in states])
    assert (np.diff(heat) >= 0).all()


def test_measurement_has_the_stated_noise():
    plant, rng = DampedPendulum(noise=1e-3), np.random.default_rng(0)
    state = plant.reset(np.array([0.5, 0.0]), 0)
    seen = np.array([plant.measure(state, rng)[0] for _ in range(20_000)]) - 0.5
    assert seen.std() == pytest.approx(1e-3, rel=0.03)  # standard error of 0.5 %, six of them
    assert QUIET.measure(state, rng)[0] == 0.5
    assert plant.hidden(state).shape == (0,)


@pytest.mark.parametrize(("options", "words"), [({"sub_step": 0.0}, "sub_step"), ({"noise": -1.0}, "noise")])
def test_bad_options_are_refused(options, words):
    with pytest.raises(InputError, match=words):
        DampedPendulum(**options)


@pytest.mark.full
def test_files_hold_what_was_measured_and_load_with_every_role(tmp_path):
    files = make_data(tmp_path, 3, "quick")
    assert [f.stem for f in files] == stems("quick")
    data = load_trajectories(files, scenario.prior(), scenario.data)
    assert {role: len(data.by_role(role)) for role in ("train", "valid", "test")} == {
        "train": 6, "valid": 3, "test": 4,
    }  # fmt: skip
    assert data.cuts == ()
    _, u, x = run(QUIET, "train", 1, 3)
    piece = data.by_role("train")[0]
    # six digits in the file and a mean over ten of them
    np.testing.assert_allclose(piece.u[:, 0], u[::10][: len(piece.u)], rtol=0, atol=1e-6)
    error = piece.y[:, 0] - x[::10, 0][: len(piece.y)]
    assert error.std() == pytest.approx(1e-4, rel=0.5)  # the noise; the loader may interpolate it
    again = (tmp_path / "train_01.csv").read_bytes()
    make_data(tmp_path, 3, "quick")
    assert (tmp_path / "train_01.csv").read_bytes() == again
    make_data(tmp_path, 4, "quick")
    assert (tmp_path / "train_01.csv").read_bytes() != again


def test_no_two_runs_are_alike_and_fewer_are_the_first_of_more():
    tables = dict(recordings(0, "quick"))
    torques = {tuple(table[:100, 3]) for table in tables.values()}
    assert len(torques) == len(tables)
    assert max(np.abs(table[:, 3]).max() for table in tables.values()) <= AMPLITUDE[1]
    three, six = exact_runs("train", 3), exact_runs("train", 6)
    for a, b in zip(three, six, strict=False):
        np.testing.assert_array_equal(a.x, b.x)


@pytest.mark.parametrize("dt", [1e-3, 5e-3, 1e-2])
def test_exact_runs_are_the_plant_s_motion(dt):
    (piece,) = exact_runs("test", 1, dt=dt)
    assert piece.t[-1] == pytest.approx(DURATION)
    # the next state follows from the plant at the held torque: the same sub-steps
    for k in (0, 77, 400):
        state = QUIET.step(QUIET.reset(piece.x[k], 0), piece.u[k], dt)
        np.testing.assert_allclose(piece.x[k + 1], QUIET.truth(state), rtol=0, atol=1e-10)
    # and a prior with the plant's parameters gives its derivative
    xdot = rates(S_AS_PRIOR, piece.x, piece.u)
    np.testing.assert_allclose(piece.xdot, xdot, rtol=0, atol=1e-11)  # terms of up to 500 rad/s^2


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match="HM-SCENARIOS-042"):
        exact_runs("test", 1, dt=0.003)
    with pytest.raises(InputError, match="HM-SCENARIOS-043"):
        exact_runs("nominal", 1)
    with pytest.raises(InputError, match=r"quick, full.*HM-SCENARIOS-001"):
        stems("none")


@pytest.mark.parametrize("task", scenario.tasks, ids=lambda task: task.name)
def test_references_are_feasible_and_consistent(task):
    t = np.linspace(0, task.duration, 8001)
    ref = task.reference(t)
    assert ref[0] == pytest.approx(np.array(task.x0), abs=1e-9)
    # second order differences: (dt^2 / 6) times the third derivative, 1e3 rad/s^3 where a move begins
    assert np.gradient(ref[:, 0], t)[1:-1] == pytest.approx(ref[1:-1, 1], abs=2e-4)
    needed = P.inertia * np.gradient(ref[:, 1], t) + P.gravity * np.sin(ref[:, 0]) + P.d * ref[:, 1]
    load = max((abs(f.value) for f in task.faults), default=0.0)
    assert np.abs(needed).max() + load < scenario.control.u_max[0]


@pytest.mark.full
def test_the_whole_job(tmp_path):
    command = [sys.executable, "-m", "hybrid_mpc", "run", "pendulum", "--out", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1500)
    assert done.returncode == 0, done.stdout + done.stderr
    results = read_results(tmp_path / "run" / "results.json")
    assert results.export.parity_max_abs_error <= 1e-12
    error = {name: scores.model.error for name, scores in results.evaluation.scores.items()}
    assert error["phy"] == error["phy_nominal"]  # the prior is not fitted
    assert error["mopgrnn"] < 0.1 * error["phy"]  # docs/results/simulated_machines.md: 0.01 of the prior's
    assert results.control.cost("hybrid_observer") < 0.5 * results.control.cost("prior_observer")
