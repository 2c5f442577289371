"""The golf robot's scenario: prior, oracle, data, tasks, and that it is worth learning."""

import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
import torch

from hybrid_mpc.errors import InputError
from scenarios.golf_robot import scenario
from scenarios.golf_robot.data import SIZES, make_data, record, stems
from scenarios.golf_robot.effects import measure_effects
from scenarios.golf_robot.nominal import GEAR, PARAMETERS
from scenarios.golf_robot.oracle import oracle
from scenarios.golf_robot.prior import GolfRobotPrior
from scenarios.golf_robot.rig import Rig


def test_scenario_imports_no_torch():
    code = (
        "import sys; sys.modules['torch'] = None; import scenarios.golf_robot as s; s.scenario.oracle(0.02)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_prior_loses_energy_to_nothing_along_its_own_flow():
    prior = scenario.prior()
    gen = torch.Generator().manual_seed(0)
    x = torch.randn(5, 4, 2, generator=gen, dtype=torch.float64)
    u = torch.randn(5, 4, 1, generator=gen, dtype=torch.float64)
    xdot = prior(x, u)
    assert xdot.shape == (5, 4, 2)
    assert prior.energy_balance(x, xdot, u).abs().max() < 1e-13  # rounding of terms of order 10 W
    assert torch.equal(prior(x[2, 1], u[2, 1]), xdot[2, 1])  # one sample as in a batch


def test_prior_agrees_with_the_oracle_s_energy_balance():
    model, prior = oracle(0.02), GolfRobotPrior()
    rng = np.random.default_rng(0)
    for x, w, u in zip(*(rng.normal(size=(20, n)) for n in (2, 2, 1)), strict=True):
        expected = prior.energy_balance(*(torch.from_numpy(a) for a in (x, w, u))).item()
        assert float(model.energy_balance(x, w, u)) == pytest.approx(expected, abs=1e-12)  # same formula


def test_friction_slope_at_rest_is_stable_at_all_bounds():
    p = {s.name: s for s in PARAMETERS}
    slope = p["r"].upper * p["mu"].upper * p["gamma"].upper * p["m"].upper * p["g"].upper / p["J"].lower
    assert slope * 0.01 < 2  # sub-steps of 10 ms


def test_oracle_follows_the_rig():
    model, rig = scenario.oracle(0.02), Rig()
    s = rig.reset(np.array([0.6, 0.0]), 0)
    x, h = rig.truth(s), rig.hidden(s)
    worst = 0.0
    for k in range(50):
        u = np.array([0.2 * np.sin(0.25 * k)])
        s, (x, h) = rig.step(s, u, 0.02), model.step(x, h, u)
        worst = max(worst, abs(float(x[0]) - s[0]))
    assert worst < 1e-5  # a 50th of the sensor's noise; both are of order 4 with steps of 0.25 and 0.4 ms
    assert np.array(h).ravel() == pytest.approx(rig.hidden(s), abs=1e-2)


def test_oracle_jacobian_is_the_derivative_of_its_step():
    model = oracle(0.02)
    z, u, e = np.array([0.3, 1.0, 1.3, 0.1]), np.array([0.1]), 1e-6
    a = np.array(model.with_jacobian(z[:2], z[2:], u)[2])
    step = ca.Function("z", [q := ca.MX.sym("q", 4)], [ca.vertcat(*model.step(q[:2], q[2:], u))])
    fd = np.column_stack([np.array(step(z + e * d) - step(z - e * d)).ravel() / (2 * e) for d in np.eye(4)])
    assert a == pytest.approx(fd, abs=1e-5)  # central differences: error e^2 f''' and 1e-16 / e


def test_data_files_are_reproducible_and_have_their_roles(tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.golf_robot.data.SIZES", {"full": {"train": 2, "valid": 1, "test": 1}})
    paths = make_data(tmp_path / "a", 3, "full")
    again = make_data(tmp_path / "b", 3, "full")
    other = make_data(tmp_path / "c", 4, "full")
    assert [p.read_bytes() for p in paths] == [p.read_bytes() for p in again]
    assert paths[0].read_bytes() != other[0].read_bytes()
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == sorted(p.name for p in paths)  # no leftovers
    assert paths[0].read_text().startswith("time_s,phi_rad,u_nm\n")
    t, phi, u = np.loadtxt(paths[0], delimiter=",", skiprows=1).T
    assert len(t) == 2001
    assert np.diff(t).min() > 0.007  # 10 ms less 8 standard deviations of jitter, clipped at 4 each
    assert np.std(t - 0.01 * np.arange(2001)) == pytest.approx(0.2e-3, rel=0.1)  # 1.6 % standard error
    assert np.abs(phi).max() < 3.0
    assert np.array_equal(u[:-1:2], u[1::2])  # the input changes on the model's grid


def test_every_recording_has_a_window():
    for budget in SIZES:
        for stem in stems(budget):
            (window,) = scenario.data.windows[stem]
            assert stem.startswith(window.role)
    with pytest.raises(InputError, match="quick"):
        stems("huge")


def test_recorded_angles_are_the_states_at_the_recorded_times():
    table, states = record(Rig(), "step", (0, 0, 2))
    error = table[:, 1] - states[:, 0]
    assert error.std() == pytest.approx(np.hypot(0.2e-3, 2 * np.pi / 4096 / np.sqrt(12)), rel=0.3)
    # a club at rest quantises to a constant error, hence the wide 30 %; a shift by one sample gives 10 times


def test_data_reach_what_they_promise_and_leave_something_to_learn():
    effects = measure_effects()
    assert 0.8 < effects.largest_angle < 2.0
    assert 2.0 < effects.largest_speed < 6.0
    assert effects.residual <= effects.residual_published
    # the criterion of a rig that is not too tame
    assert effects.residual > 3 * effects.noise_floor


@pytest.mark.parametrize("task", scenario.tasks, ids=lambda task: task.name)
def test_tasks_are_feasible_and_consistent(task):
    t = np.linspace(0, task.duration, 4001)
    ref = task.reference(t)
    assert ref.shape == (4001, 2)
    assert task.duration >= 8
    assert np.abs(ref[:, 0]).max() <= 0.8
    assert ref[0] == pytest.approx(np.array(task.x0), abs=1e-9)
    p = {s.name: s.value for s in PARAMETERS}
    smooth = task.name == "track_sine"
    if smooth:  # second order differences: error (dt^2 / 6) times the third derivative, below 1e-4 rad/s
        assert np.gradient(ref[:, 0], t)[1:-1] == pytest.approx(ref[1:-1, 1], abs=1e-4)
    acceleration = np.gradient(ref[:, 1], t) if smooth else 0.0
    load = np.abs(p["m"] * ref[:, 1] ** 2 * p["a"] + p["m"] * p["g"] * np.cos(ref[:, 0]))
    friction = p["r"] * 1.5 * p["mu"] * load
    torque = p["J"] * acceleration + p["m"] * p["g"] * p["a"] * np.sin(ref[:, 0])
    needed = (np.abs(torque) + friction).max() / GEAR  # with half as much friction again
    assert needed < scenario.control.u_max[0]
