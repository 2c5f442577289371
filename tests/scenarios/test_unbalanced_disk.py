"""The unbalanced disk in simulation: plant of another structure than the prior, recordings, closed loops."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import (
    InputError,
    PriorStep,
    load,
    load_trajectories,
    make_controller,
    make_estimator,
    model_info,
    save_artifact,
    simulate,
    trace_model,
)
from scenarios.unbalanced_disk import data, scenario
from scenarios.unbalanced_disk.dynamics import DiskParameters
from scenarios.unbalanced_disk.nominal import DT
from scenarios.unbalanced_disk.plant import DiskPlant
from scenarios.unbalanced_disk.prior import UnbalancedDiskPrior
from scenarios.unbalanced_disk.tasks import PEAK, UP_AT, standing

TASKS = {task.name: task for task in scenario.tasks}
FITTED = {"w_0": 11.67, "gamma": 1.113, "F_c": 6.36, "K_u": 28.55, "phi_0": -0.034}
"""The prior as fitted to the recording of 2024 (docs/results/real_machines.md): not shown to the plant."""
DELAY = 0.0248
NOISE = np.array([8e-4, 0.08])
"""Process noise a period: the prior's error over a period on the plant is of this size."""


def end_of_a_turn(sub_step):
    """The disk after 0.1 s of turning one way, where the bristle's equation is smooth."""
    plant = DiskPlant(sub_step=sub_step)
    state = plant.reset(np.array([0.2, 12.0]), 0)
    for _ in range(4):
        state = plant.step(state, np.array([PEAK]), DT)
    return state.z[:2]


def test_the_integrator_is_of_order_4():
    best = end_of_a_turn(2e-5)
    coarse, fine = (np.abs(end_of_a_turn(h) - best).max() for h in (4e-4, 2e-4))
    # order 4: 16 but for terms of higher order and the bristle, which relaxes within a few of the steps
    assert 11 < coarse / fine < 24
    assert coarse < 1e-5


def test_a_command_acts_after_the_delay_and_not_before():
    plant = DiskPlant()
    rest = plant.reset(np.array([0.5, 0.0]), 0)
    for time, acts in ((plant.parameters.delay - 1e-4, False), (plant.parameters.delay + 1e-3, True)):
        pushed, left = (plant.step(rest, np.array([u]), time) for u in (PEAK, 0.0))
        assert bool(abs(pushed.z[2] - left.z[2]) > 0.1) is acts  # a millisecond of 3 V: 0.4 A
    twice = plant.step(plant.step(rest, np.array([1.0]), DT), np.array([2.0]), DT)
    once = plant.step(plant.step(rest, np.array([1.0]), 0.4 * DT), np.array([1.0]), 0.6 * DT)
    assert twice.acting == 2.0
    assert plant.hidden(twice)[0] == 2.0
    np.testing.assert_allclose(once.z, plant.step(rest, np.array([1.0]), DT).z, atol=1e-7)  # other sub-steps


def test_its_structure_is_not_the_prior_s():
    """What happens next hangs on more than angle, speed and voltage: no parameters make the prior do that."""
    plant, ends = DiskPlant(), []
    for z in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.006)):  # current [A], bristle [rad]
        state = plant.reset(np.array([0.3, 0.0]), 0)
        state.z[2:] = z
        ends.append(plant.step(state, np.zeros(1), 2e-3).z[1])
    # 0.5 A decays within 1.2 ms: 0.03 * 0.5 / J * 1 ms; the bristle: friction at speed / J * 2 ms
    assert ends[1] - ends[0] > 0.03
    assert ends[0] - ends[2] > 0.005
    slower = []
    for phi in (0.6, 0.6 + np.pi):  # where the shaft's friction is largest and smallest
        state = plant.reset(np.array([phi, 20.0]), 0)
        state.z[2], state.z[3] = -plant.parameters.k * 20.0 / plant.parameters.R, 0.006
        before = state.z[1]
        weight = plant.parameters.weight * np.sin(phi - 0.034) / plant.parameters.J
        slower.append((before - plant.step(state, np.zeros(1), 2e-3).z[1]) / 2e-3 - weight)
    assert slower[0] - slower[1] > 0.5  # rad/s^2; 15 % of friction either way are 1.7


def test_bad_parameters_are_refused():
    for change in ({"L": 0.0}, {"stiction": 0.5}, {"eccentric": 1.0}, {"delay": -0.1}, {"J": np.nan}):
        with pytest.raises(InputError, match="disk"):
            DiskParameters(**change)
    with pytest.raises(InputError, match="HM-SCENARIOS-048"):
        DiskPlant(sub_step=0.0)


def test_recordings_are_files_like_the_real_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(data, "SIZES", {"quick": {"train": 1, "valid": 1, "test": 1}})
    files = data.make_data(tmp_path / "a", 0, "quick")
    again = data.make_data(tmp_path / "b", 0, "quick")
    assert [f.read_bytes() for f in files] == [f.read_bytes() for f in again]
    with np.load(files[0]) as arrays:
        assert sorted(arrays) == ["dt", "th", "u"]
        steps = arrays["th"] / DiskParameters().count
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)  # whole encoder steps
    read = load_trajectories(files, scenario.prior(), scenario.data)
    assert {t.role for t in read.trajectories} == {"train", "valid", "test"}
    # a file's last sample may fall off the grid by rounding
    assert {data.SAMPLES - len(t.t) for t in read.trajectories} <= {0, 1}
    assert max(abs(t.u).max() for t in read.trajectories) <= PEAK


def test_tasks_are_within_reach_and_their_speeds_are_derivatives():
    t = np.linspace(0.0, 5.0, 5001)
    for name in ("track_up", "track_down"):
        x = TASKS[name].reference(t)
        np.testing.assert_allclose(np.gradient(x[:, 0], t)[1:-1], x[1:-1, 1], atol=1e-4)  # of order (1 ms)^2
    # 3 V hold the disk nowhere near the top: it must be swung
    p = DiskParameters()
    assert PEAK * p.k / p.R < 0.7 * p.weight
    assert standing(np.array([UP_AT - DT, UP_AT]))[:, 0].tolist() == [0.0, 1.0]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """The fitted prior with its delay and without, as deployed."""
    prior, made = UnbalancedDiskPrior(FITTED), {}
    programs = {"prior": trace_model(PriorStep(prior, DT))}
    for name, delay in (("late", DELAY), ("at once", 0.0)):
        folder = tmp_path_factory.mktemp("model")
        save_artifact(folder, programs, replace(model_info(prior, DT), input_delay=delay))
        made[name] = load(folder).models["prior"]
    return made


def loop(model, task, duration, **options):
    parts = make_estimator(model, scenario, NOISE, task.control), make_controller(model, model, task.control)
    return simulate(
        DiskPlant(),
        *parts,
        task.reference,
        weight=task.weight,
        dt=DT,
        duration=duration,
        x0=task.x0,
        seed=1,
        **options,
    )


def test_the_prior_swings_the_plant_up(models):
    task = TASKS["swing_up"]
    # one start and a short hold keep the test quick; the task has twelve starts and 4 s
    task = replace(task, control=task.control.changed(starts=task.control.starts[:1]))
    result = loop(models["late"], task, 2.6)
    assert np.abs(result.u).max() <= PEAK
    assert task.figures(result)["up_at_s"] <= UP_AT
    assert np.abs(result.x[:, 0] - np.pi)[result.t > 2.0].max() < 0.1  # rad, twice the tolerated deviation
    assert set(result.source) == {"MPC"}


def test_a_model_without_the_delay_does_worse(models):
    costs = {name: loop(model, TASKS["track_up"], 1.0).cost for name, model in models.items()}
    # a period of delay is 0.3 of the upright disk's time constant
    assert costs["at once"] > 3 * costs["late"]


def test_the_fallback_knows_what_is_under_way(models):
    upright = replace(TASKS["reject_load"], faults=())
    ends = {}
    for name, model in models.items():
        result = loop(model, upright, 2.0, late=lambda t: t >= 0.5)
        assert result.source.count("FALLBACK") > 40
        ends[name] = np.abs(result.x[:, 0] - np.pi).max()
    assert ends["late"] < 0.15  # friction makes it sway
    assert ends["at once"] > 3 * ends["late"]  # it falls
