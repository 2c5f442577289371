import subprocess
import sys

import numpy as np
import pytest
import torch

from hybrid_mpc import Scenario, load_trajectories, write_csv
from scenarios.torque_pendulum import WINDOWS, scenario
from scenarios.torque_pendulum.prior import TorquePendulumPrior

RNG = np.random.default_rng(0)
X = torch.tensor(RNG.uniform(-6, 6, (20, 2)))
U = torch.tensor(RNG.uniform(-1.5, 1.5, (20, 1)))


def test_scenario_needs_no_torch():
    code = (
        "import sys; sys.modules['torch'] = None; import scenarios.torque_pendulum as s; s.scenario.data.dt"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert isinstance(scenario, Scenario)


def test_energy_balance_is_zero_along_the_flow_and_is_power_beside_it():
    prior = TorquePendulumPrior()
    flow = prior(X, U)
    # rounding of a sum of terms of up to 10 W
    np.testing.assert_allclose(prior.energy_balance(X, flow, U), 0.0, atol=1e-12)
    # an unmodelled acceleration a leaves the power J a phi_dot
    push = flow + torch.tensor([0.0, 2.0])
    np.testing.assert_allclose(prior.energy_balance(X, push, U), 0.15 * 2.0 * X[:, 1], atol=1e-12)


def test_energy_is_conserved_without_friction_and_torque():
    prior = TorquePendulumPrior({"d": 0.0, "F_c": 0.0})
    x = X.clone().requires_grad_()
    energy = 0.5 * prior.J * x[:, 1] ** 2 - prior.mgl * torch.cos(x[:, 0])
    (gradient,) = torch.autograd.grad(energy.sum(), x)
    rate = (gradient * prior(x, 0 * U)).sum(dim=1)
    np.testing.assert_allclose(rate.detach(), 0.0, atol=1e-12)  # rounding


def test_friction_takes_energy_and_scaling_all_but_j_scales_the_motion():
    with_friction, without = TorquePendulumPrior(), TorquePendulumPrior({"d": 0.0, "F_c": 0.0})
    lost = (with_friction.acceleration(X, U) - without.acceleration(X, U))[:, 0] * X[:, 1]
    assert (lost < 0).all()
    scaled = TorquePendulumPrior({name: 2 * value for name, value in with_friction.values.items()})
    # J, mgl, d, F_c, k_u show in the motion by their ratios only: the reason why J is fixed
    np.testing.assert_allclose(scaled.acceleration(X, U), with_friction.acceleration(X, U), rtol=1e-12)
    assert [spec.name for spec in with_friction.parameters_spec if spec.fixed] == ["J"]


@pytest.mark.parametrize("stem", sorted(WINDOWS))
def test_no_training_within_the_smoothing_of_a_test_window(stem):
    for test in (window for window in WINDOWS[stem] if window.role == "test"):
        for other in (window for window in WINDOWS[stem] if window.role != "test"):
            distance = max(test.start - other.end, other.start - test.end)
            assert distance >= scenario.data.smoothing - 1e-9


def test_recordings_of_that_name_load_with_every_role(tmp_path):
    files = []
    for stem, dt in (("energy_shaping_0p9Nm", 0.005), ("energy_shaping_1p5Nm", 0.01)):
        t = np.arange(0, 20, dt)
        columns = {"time_s": t, "pos_rad": 2 * np.sin(3 * t), "tau_cmd_Nm": np.sign(np.cos(3 * t))}
        files.append(write_csv(tmp_path / f"{stem}.csv", columns))
    prior = TorquePendulumPrior
    data = load_trajectories(files, scenario.data, outputs=prior.outputs, inputs=prior.inputs)
    assert {piece.role for piece in data.trajectories} == {"train", "valid", "test", "nominal"}
    names = {role: {p.name.split("#")[0] for p in data.by_role(role)} for role in ("train", "test")}
    assert names["train"] == {"energy_shaping_0p9Nm", "energy_shaping_1p5Nm"}  # both torques are trained on
    assert names["test"] == {"energy_shaping_0p9Nm"}
    assert data.cuts == ()
