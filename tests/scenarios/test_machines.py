"""What holds for every machine (no torch, priors whose balances hold), and the machines with real recordings."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from energy_checks import check_balances, random_points, random_values, rates, scenario_priors

from hybrid_mpc import InputError, Trajectory, load_trajectories, write_csv
from hybrid_mpc.identify.simulation import required_substeps
from hybrid_mpc.scenario import load_scenario, registered_scenarios
from hybrid_mpc.workflow.benchmark_runs import in_turn, read_test, read_training
from scenarios.emps import NEWTON_PER_VOLT
from scenarios.emps import scenario as emps
from scenarios.emps.prior import EmpsPrior
from scenarios.simulated import cart_pole, dc_motor, lever, two_heaters, two_link_arm, two_tanks
from scenarios.torque_pendulum import WINDOWS
from scenarios.torque_pendulum import scenario as torque_pendulum
from scenarios.torque_pendulum.prior import TorquePendulumPrior
from scenarios.unbalanced_disk import scenario as disk
from scenarios.unbalanced_disk.prior import UnbalancedDiskPrior
from scenarios.xl330_pendulum import scenario as servo
from scenarios.xl330_pendulum.prior import Xl330PendulumPrior

NAMES = ("emps", "golf_robot", "pendulum", "torque_pendulum", "unbalanced_disk", "xl330_pendulum")
RECORDINGS = Path(__file__).parents[3] / "shared" / "data"
WITHOUT_TORCH = f"""
import sys
class Refuse:
    def find_spec(self, name, *rest):
        if name.split(".")[0] == "torch":
            raise ImportError("torch is refused here")
sys.meta_path.insert(0, Refuse())
import numpy as np
from hybrid_mpc import load_scenario
for name in {NAMES}:
    scenario = load_scenario(name)
    if name != "pendulum":  # whose prior is written in torch
        prior = scenario.prior()
        prior.equations.xdot(0.1, 0, [], prior.p)
    if scenario.plant is not None:
        plant = scenario.plant()
        plant.step(plant.reset(np.zeros(2), 0), np.zeros(1), scenario.data.dt)
    if scenario.oracle is not None:
        scenario.oracle(scenario.data.dt)
    for task in scenario.tasks:
        task.reference(np.zeros(1))
from scenarios.golf_robot.faults import catalogue
load_scenario("golf_robot").plant().with_faults(catalogue()[0].faults)
"""


def test_priors_plants_and_oracles_work_without_torch():
    subprocess.run([sys.executable, "-c", WITHOUT_TORCH], check=True)
    assert set(NAMES) <= set(registered_scenarios())


WITHOUT_BALANCE = ("CoupledDrivesPrior", "HeatExchangerPrior", "RaceCarPrior")
"""Nothing that these machines' sensors tell of is stored."""


SIMULATED = (cart_pole, dc_motor, lever, two_heaters, two_link_arm, two_tanks)
PRIORS = (*scenario_priors(), *(m.scenario.prior for m in SIMULATED))


@pytest.mark.parametrize(
    "prior", [p for p in PRIORS if p.__name__ not in WITHOUT_BALANCE], ids=lambda p: p.__name__
)
def test_balances_hold_along_the_flow(prior):
    check_balances(prior())
    rng = np.random.default_rng(1)
    for seed in range(2):
        check_balances(prior(random_values(prior, rng)), seed)


@pytest.mark.parametrize(
    ("name", "most"),
    [*dict.fromkeys(("emps", "unbalanced_disk", "xl330_pendulum"), 4).items(),
     *dict.fromkeys(("cascaded_tanks", "coupled_drives", "double_pendulum", "heat_exchanger", "race_car",
                     "temperature_lab"), 6).items()],
)  # fmt: skip
def test_priors_of_real_machines_can_be_stepped(name, most):
    scenario = load_scenario(name)
    prior = scenario.prior()
    # every sub-step costs a training its time; the friction speeds were chosen for this
    assert required_substeps(prior, scenario.data.dt) <= most
    stiffest = {p.name: p.upper for p in prior.parameters if p.name in ("F_c", "d", "F_v")}
    required_substeps(scenario.prior(stiffest), scenario.data.dt)  # no fit may leave what can be stepped


DISK = 28.1 * 0.5 - 11.34**2 * np.sin(0.4) + 1.33 * 2.0 + 6.06
EMPS = (10.0 + (203.5 - 7.0) * 2.0 + 20.39 + 3.16) / 95.11
PASSIVE = -0.4807 * np.sin(0.3) + 0.00366 * 2.0 + 0.0128
MOTOR = 0.387 / 4.02 * (0.4 * 7.0 + 0.387 * 2.0)


@pytest.mark.parametrize(
    ("prior", "values", "u", "a"),
    [
        (UnbalancedDiskPrior, {"phi_0": 0.1}, [0.5], DISK),  # friction is saturated at this speed
        (EmpsPrior, {"F_a": 7.0}, [10.0], EMPS),
        (Xl330PendulumPrior, {}, [0.4, 7.0, 1.0], (PASSIVE + MOTOR) / 0.00671),
        (Xl330PendulumPrior, {}, [0.4, 7.0, 0.0], PASSIVE / 0.00671),  # off: neither duty nor back-EMF acts
    ],
)
def test_each_prior_is_the_equation_it_says(prior, values, u, a):
    found = rates(prior(values), np.array([[0.3, -2.0]]), np.array([u]))
    assert found[0] == pytest.approx([-2.0, a], rel=1e-12)  # rounding


def test_the_torque_pendulum_s_motion_shows_ratios_only():
    """The reason why J is fixed; and without friction and torque its energy is kept."""
    prior, free = TorquePendulumPrior(), TorquePendulumPrior({"d": 0.0, "F_c": 0.0})
    x, u, w = random_points(prior, np.random.default_rng(0), 20)
    scaled = TorquePendulumPrior({name: 2 * value for name, value in prior.values.items()})
    np.testing.assert_allclose(rates(scaled, x, u), rates(prior, x, u), rtol=1e-12)
    assert [spec.name for spec in prior.parameters if spec.fixed] == ["J"]
    assert ((rates(prior, x, u) - rates(free, x, u))[:, 1] * x[:, 1] < 0).all()  # friction brakes
    energy = free.equations.balances[0]
    flow = rates(free, x, 0 * u)
    kept = energy.residual(x.T, flow.T, 0 * u.T, w.T, free.p)
    np.testing.assert_allclose(kept, 0.0, atol=1e-12)  # rounding
    assert not energy.loss(x.T, u.T, w.T, free.p).full().any()
    by_hand = 0.5 * free.values["J"] * x[:, 1] ** 2 - free.values["mgl"] * np.cos(x[:, 0])
    np.testing.assert_allclose(energy.storage(x.T, free.p).full()[0], by_hand, rtol=1e-12)


def test_any_file_of_the_disks_columns_is_read(tmp_path):
    t = 0.025 * np.arange(4000)
    np.savez(tmp_path / "another.npz", u=np.sin(3 * t), th=0.1 * np.sin(3 * t), dt=0.025)
    data = read_training(disk, [tmp_path / "another.npz"])
    assert {p.role for p in (*data.train, *data.valid, *data.held_back)} == {"train", "valid", "test"}
    (whole,) = read_test(disk, tmp_path / "another.npz")
    assert len(whole.t) == len(t) - 1  # the last input is held for no known time
    np.savez(tmp_path / "short.npz", u=t[:60], th=t[:60], dt=0.025)
    with pytest.raises(InputError, match="HM-WORKFLOW-015"):
        read_training(disk, [tmp_path / "short.npz"])


def test_volts_become_newtons(tmp_path):
    t = 1e-3 * np.arange(3000)
    file = write_csv(tmp_path / "axis.csv", {"t": t, "vir": 0 * t + 2.0, "qm": 0.1 * t})
    (run,) = read_test(emps, file)
    np.testing.assert_allclose(run.u, 2.0 * NEWTON_PER_VOLT, rtol=1e-12)  # rounding of a mean


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not on this machine")
@pytest.mark.parametrize(
    ("scenario", "file", "seconds"),
    [
        (disk, "unbalanced_disk/multisine_2024.npz", 875.0),
        (emps, "emps/DATA_EMPS.mat", 24.84),
        (servo, "xl330_pendulum/kp200_sin_sin.csv", 6.0),
    ],
    ids=lambda v: getattr(v, "name", None),
)
def test_the_real_recordings_are_read_whole_and_split(scenario, file, seconds):
    path = RECORDINGS / file
    (whole,) = read_test(scenario, path)
    assert len(whole.t) * scenario.data.dt == pytest.approx(seconds, abs=3 * scenario.data.dt)
    data = read_training(scenario, [path])
    shares = [sum(len(p.t) for p in part) / len(whole.t) for part in (data.train, data.valid, data.held_back)]
    # the distance between the parts and the rest of cutting into equal pieces are a few per cent of short runs
    planned = [5 / 7, 1 / 7, 1 / 7] if scenario is disk else scenario.data.fractions
    np.testing.assert_allclose(shares, planned, atol=0.03)


def test_the_disks_parts_take_turns_and_share_no_smoothing():
    t = 0.025 * np.arange(8000)
    z = np.zeros((len(t), 1))
    run = Trajectory("run", "", 0.025, t, z, z, np.hstack([z, z]), np.hstack([z, z]))
    parts = in_turn(run, disk.benchmark, disk.data.smoothing)
    assert [p.role for p in parts][:7] == list(disk.benchmark.cycle)
    assert len(parts) == 8  # 200 s in pieces of 25 s
    for one, two in pairwise(parts):
        assert two.t[0] - one.t[-1] > disk.data.smoothing - 1e-9


@pytest.mark.parametrize("stem", sorted(WINDOWS))
def test_no_training_within_the_smoothing_of_a_test_window(stem):
    for test in (window for window in WINDOWS[stem] if window.role == "test"):
        for other in (window for window in WINDOWS[stem] if window.role != "test"):
            distance = max(test.start - other.end, other.start - test.end)
            assert distance >= torque_pendulum.data.smoothing - 1e-9


def test_recordings_of_the_torque_pendulum_load_with_every_role(tmp_path):
    files = []
    for stem, dt in (("energy_shaping_0p9Nm", 0.005), ("energy_shaping_1p5Nm", 0.01)):
        t = np.arange(0, 20, dt)
        columns = {"time_s": t, "pos_rad": 2 * np.sin(3 * t), "tau_cmd_Nm": np.sign(np.cos(3 * t))}
        files.append(write_csv(tmp_path / f"{stem}.csv", columns))
    prior = TorquePendulumPrior
    data = load_trajectories(files, prior, torque_pendulum.data)
    assert {piece.role for piece in data.trajectories} == {"train", "valid", "test", "nominal"}
    names = {role: {p.file for p in data.by_role(role)} for role in ("train", "test")}
    assert names["train"] == {"energy_shaping_0p9Nm", "energy_shaping_1p5Nm"}  # both torques are trained on
    assert names["test"] == {"energy_shaping_0p9Nm"}
    assert data.cuts == ()
