"""Unbalanced disk, EMPS and the pendulum on a servo: priors, splits, and that their recordings are read."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from energy_checks import check_energy_balance

from hybrid_mpc import InputError, Trajectory, write_csv
from hybrid_mpc.identify.step import required_substeps
from hybrid_mpc.job.benchmark_runs import in_turn, read_test, read_training
from scenarios.emps import NEWTON_PER_VOLT
from scenarios.emps import scenario as emps
from scenarios.emps.prior import EmpsPrior
from scenarios.torque_pendulum import scenario as torque_pendulum
from scenarios.unbalanced_disk import scenario as disk
from scenarios.unbalanced_disk.prior import UnbalancedDiskPrior
from scenarios.xl330_pendulum import scenario as servo
from scenarios.xl330_pendulum.prior import Xl330PendulumPrior

MACHINES = (disk, emps, servo)
RECORDINGS = Path(__file__).parents[3] / "shared" / "data"
REAL = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not on this machine")


def test_the_scenarios_need_no_torch():
    modules = "scenarios.unbalanced_disk, scenarios.emps, scenarios.xl330_pendulum"
    code = f"import sys; import {modules}; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("scenario", MACHINES, ids=lambda s: s.name)
def test_priors_balance_their_energy_and_can_be_stepped(scenario):
    prior = scenario.prior()
    check_energy_balance(prior)
    # every sub-step costs a training its time; the friction speeds were chosen for this
    assert required_substeps(prior, scenario.data.dt) <= 4
    stiffest = scenario.prior(
        {p.name: p.upper for p in prior.parameters_spec if p.name in ("F_c", "d", "F_v")}
    )
    required_substeps(stiffest, scenario.data.dt)  # no fit may leave what can be stepped


def test_each_prior_is_the_equation_it_says():
    x = torch.tensor([0.3, -2.0], dtype=torch.float64)
    disk_prior = UnbalancedDiskPrior({"phi_0": 0.1})
    a = 28.1 * 0.5 - 11.34**2 * np.sin(0.4) + 1.33 * 2.0 + 6.06  # friction is saturated at this speed
    assert disk_prior(x, torch.tensor([0.5], dtype=torch.float64)).tolist() == pytest.approx(
        [-2.0, a], rel=1e-12
    )  # rounding
    a = (10.0 + (203.5 - 7.0) * 2.0 + 20.39 + 3.16) / 95.11
    assert EmpsPrior({"F_a": 7.0})(x, torch.tensor([10.0], dtype=torch.float64)).tolist() == pytest.approx(
        [-2.0, a], rel=1e-12
    )  # rounding
    driven, falling = torch.tensor([[0.4, 7.0, 1.0], [0.4, 7.0, 0.0]], dtype=torch.float64)
    passive = -0.4807 * np.sin(0.3) + 0.00366 * 2.0 + 0.0128
    motor = 0.387 / 4.02 * (0.4 * 7.0 + 0.387 * 2.0)
    servo_prior = Xl330PendulumPrior()
    assert servo_prior(x, driven)[1].item() == pytest.approx((passive + motor) / 0.00671, rel=1e-12)
    # switched off neither duty nor back-EMF acts
    assert servo_prior(x, falling)[1].item() == pytest.approx(passive / 0.00671, rel=1e-12)


def test_what_is_given_is_what_the_published_figures_give():
    assert round(disk.data.warm_up / disk.data.dt) + 1 == 50
    given = np.arange(20) * 1e-3  # EMPS: 20 samples of 1 ms
    assert round(emps.data.warm_up / emps.data.dt) == sum(given % emps.data.dt < 1e-9) - 1
    assert (disk.benchmark.unit, emps.benchmark.unit, emps.benchmark.scale) == ("rad", "mm", 1e3)
    assert torque_pendulum.benchmark.length == 2.5


def test_any_file_of_the_disks_columns_is_read(tmp_path):
    t = 0.025 * np.arange(4000)
    np.savez(tmp_path / "another.npz", u=np.sin(3 * t), th=0.1 * np.sin(3 * t), dt=0.025)
    data = read_training(disk, [tmp_path / "another.npz"])
    assert {p.role for p in (*data.train, *data.valid, *data.held_back)} == {"train", "valid", "test"}
    (whole,) = read_test(disk, tmp_path / "another.npz")
    assert len(whole.t) == len(t) - 1  # the last input is held for no known time


def test_volts_become_newtons(tmp_path):
    t = 1e-3 * np.arange(3000)
    file = write_csv(tmp_path / "axis.csv", {"t": t, "vir": 0 * t + 2.0, "qm": 0.1 * t})
    (run,) = read_test(emps, file)
    np.testing.assert_allclose(run.u, 2.0 * NEWTON_PER_VOLT, rtol=1e-12)  # rounding of a mean


def test_a_recording_that_is_too_short_is_refused(tmp_path):
    t = 0.025 * np.arange(60)
    np.savez(tmp_path / "short.npz", u=t, th=t, dt=0.025)
    with pytest.raises(InputError, match="too short to be cut into 7 pieces"):
        read_training(disk, [tmp_path / "short.npz"])


@REAL
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
