"""The double pendulum in MuJoCo: how it differs from its prior, that its tasks can be done, what works without."""

import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.artifact import build_model
from scenarios.double_pendulum import scenario
from scenarios.double_pendulum.plant import DoublePendulumPlant, simulation
from scenarios.double_pendulum.prior import DoublePendulumPrior
from scenarios.double_pendulum.tasks import UPRIGHT

# fitted to the recordings, as the machine's page has them
FITTED = {"I_1": 0.0267, "I_2": 0.0481, "mr_1": 0.0747, "mr_2": 0.146, "b_1": 0.0, "b_2": 0.0064, "F_1": 0.246,
          "F_2": 0.147}  # fmt: skip
DELAY = 0.004
"""The inputs' delay [s] that is fitted to the recordings along with the prior."""
SIGMA_X = (1e-4, 1e-4, 0.05, 0.08)
"""Process noise a period, of the size of the model's one-period errors on the recordings."""
TASKS = {task.name: task for task in scenario.tasks}


@pytest.fixture
def mujoco():
    return pytest.importorskip("mujoco", reason="the extra mujoco is not installed")


def closed(name, delay=DELAY):
    prior, dt, task = scenario.prior(FITTED), scenario.data.dt, TASKS[name]
    programs = {f"prior/{key}": program for key, program in prior_programs(prior, dt).items()}
    model = build_model("prior", programs, replace(hm.model_info(prior, dt), input_delay=delay))
    estimator = hm.make_estimator(model, scenario, np.array(SIGMA_X), task.control)
    controller = hm.make_controller(model, model, task.control, safe_input=scenario.safe_input)
    return hm.simulate(
        scenario.plant(), estimator, controller, task.reference, weight=task.weight, dt=dt, duration=task.duration,
        x0=task.x0, seed=0, faults=task.faults,
    )  # fmt: skip


def test_without_mujoco_the_plant_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)  # an import of it fails
    simulation.cache_clear()
    with pytest.raises(hm.InputError, match="HM-SCENARIOS-003"):
        scenario.plant().reset(np.zeros(4), 0)
    check_scenario(replace(scenario, plant=None))  # what benchmark, tune and the like ask for
    simulation.cache_clear()


def test_without_friction_the_links_are_those_of_the_prior(mujoco):
    """Accelerations in the first 0.5 ms. The prior's rotors couple the joints, by 0.6 % of M_12; the matrix is near
    singular, so 2 % come of it.
    """
    p = DoublePendulumPlant(b_1=0.0, b_2=0.0, F_1=0.0, F_2=0.0, late=0.0, rotor=36 * 6.29e-5)
    prior = DoublePendulumPrior({
        "I_1": p.J_1 + p.m_1 * p.r_1**2 + (p.m_2 - 0.6256) * p.l_1**2, "I_2": p.J_2 + p.m_2 * p.r_2**2,
        "mr_1": p.m_1 * p.r_1 + (p.m_2 - 0.6256) * p.l_1, "mr_2": p.m_2 * p.r_2, "b_1": 0.0, "b_2": 0.0,
        "F_1": 0.0, "F_2": 0.0,
    })  # fmt: skip
    x = np.array([0.7, -1.1, 2.0, -3.0])
    expected = prior.equations.xdot(list(x), [0.0, 0.0], [], prior.p).full().ravel()
    moved = p.truth(p.step(p.reset(x, 0), np.zeros(2), 0.0005)) - x
    np.testing.assert_allclose(moved / 0.0005, expected, rtol=0.04)


def test_dry_friction_holds_a_joint_until_it_is_overcome(mujoco):
    """A third of the dry friction moves the prior, whose law is smooth, by 10 mrad in 0.6 s; here nothing moves."""
    plant, x = DoublePendulumPlant(), np.array([0.02, 0.0, 0.0, 0.0])
    weight = 9.81 * (plant.m_1 * plant.r_1 + plant.m_2 * (plant.l_1 + plant.r_2)) * np.sin(0.02)
    assert 0.2 * plant.F_1 < weight < 0.6 * plant.F_1
    state = plant.reset(x, 0)
    for _ in range(60):
        state = plant.step(state, np.zeros(2), 0.01)
    np.testing.assert_allclose(plant.truth(state)[:2], x[:2], atol=1e-3)


def test_commands_act_late_and_sensors_have_steps(mujoco):
    plant, hanging = DoublePendulumPlant(), np.zeros(4)
    first = plant.step(plant.reset(hanging, 0), np.array([2.0, 0.0]), 0.0045)
    then = plant.step(first, np.array([2.0, 0.0]), 0.0045)
    assert abs(plant.truth(first)[2]) < 0.2 * abs(plant.truth(then)[2])  # of nine steps one acts, then all do
    y = plant.measure(then, np.random.default_rng(0))
    steps = y / np.repeat([plant.step_q, plant.step_v], 2)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    with pytest.raises(hm.InputError, match=r"0\.003.*HM-SCENARIOS-002"):
        plant.step(first, np.zeros(2), 0.003)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.full) for n in TASKS]
)  # fmt: skip
def test_the_priors_controller_stands(name, mujoco):
    """Both joints are within what the weights tolerate at the end; the acrobot rocks by two thirds of it."""
    result = closed(name)
    reached = TASKS[name].figures(result)
    assert reached["up_at_s"] < 2.0
    assert reached["hold_rmse_rad"] < 0.05
    control = TASKS[name].control
    assert np.all((result.u >= control.u_min) & (result.u <= control.u_max))
    assert set(result.source) == {"MPC"}


@pytest.mark.full
def test_a_delay_that_the_model_knows_is_not_taken_for_loads(mujoco):
    """Late commands look like loads to the observer, and a controller that answers these rocks the acrobot."""
    control = TASKS["acrobot_push"].control

    def errors(delay):
        return float((((closed("acrobot_push", delay).x - UPRIGHT) ** 2) @ control.q).sum())

    assert errors(DELAY) < 0.1 * errors(0.0)


def test_recorded_pushes_are_read_from_their_columns(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    t = 0.002 * np.arange(2000)
    bells = [0.5 * np.exp(-(((t - at) / 0.05) ** 2)) * sign for at, sign in ((1.0, 1.0), (2.0, -1.0))]
    path = tmp_path / "acrobot_pushed_01.csv"
    hm.write_csv(path, {"time_s": t, "push1_nm": bells[1], "push2_nm": bells[0]})
    found = import_module("recorded_faults").faults_of(path)
    assert [f.words for f in found] == ["push at tau2 +0.50", "push at tau1 -0.50"]
    assert [f.components for f in found] == [("tau2",), ("tau1",)]
    half = 0.05 * np.sqrt(np.log(0.5 / 0.02))  # where a bell falls below 0.02 N m, to a row
    np.testing.assert_allclose([f.start for f in found], [1.0 - half, 2.0 - half], atol=0.003)
    np.testing.assert_allclose([f.end for f in found], [1.0 + half, 2.0 + half], atol=0.003)
