"""Six simulated machines: balances, and the whole way from a short recording to loops with faults."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hybrid_mpc as hm
from hybrid_mpc.identify.export import Parity, check_parity, trace_model
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.identify.train import Trained
from hybrid_mpc.kit.parts import loop_settings
from hybrid_mpc.scenario import Scenario
from scenarios.simulated import cart_pole, dc_motor, lever, two_heaters, two_link_arm, two_tanks
from scenarios.simulated.plant import windows

MACHINES = {m.scenario.name: m for m in (cart_pole, dc_motor, lever, two_heaters, two_link_arm, two_tanks)}
SHORT = {"two_tanks": 1500.0, "dc_motor": 6.0, "two_heaters": 3000.0}
"""Seconds of a short recording; 10 s of the others."""
each = pytest.mark.parametrize("name", MACHINES)
WHOLE = ("two_tanks", "two_heaters")
"""Of those that go the whole way in the quick set: a process with a measured inflow, and one with two inputs."""
each_whole = pytest.mark.parametrize(
    "name", [name if name in WHOLE else pytest.param(name, marks=pytest.mark.full) for name in MACHINES]
)


@dataclass(frozen=True)
class Whole:
    """What the whole way leaves, on a short recording."""

    scenario: Scenario
    train: list[hm.Trajectory]
    trained: Trained
    parity: Parity
    kit: hm.Kit


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Machine -> recordings, fitted prior, two small networks, and the artifact of both models with its noise."""

    @cache
    def make(name):
        machine, scenario = MACHINES[name], MACHINES[name].scenario
        experiment = replace(machine.EXPERIMENT, seconds=SHORT.get(name, 10.0))
        folder = tmp_path_factory.mktemp(name)
        files = [
            hm.write_csv(
                folder / f"{role}_01.csv",
                dict(zip(experiment.columns, experiment.table(role, 1, 0).T, strict=True)),
            )
            for role in ("train", "valid")
        ]
        spec, dt = replace(scenario.data, windows=windows(experiment.seconds)), scenario.data.dt
        data = hm.load_trajectories(files, scenario.prior(), spec, needed=("train", "valid"))
        train, valid = data.by_role("train"), data.by_role("valid")
        fit = hm.fit_prior(scenario.prior, train, valid, dt=dt, length=scenario.data.free_run)
        prior = scenario.prior(fit.values)
        train = smoothed(scenario.prior, fit, train, dt)
        settings = hm.TrainingSettings(
            "mopgrnn", 4, 2, teacher_steps=0, free_run_steps=60, seed=0, warm=5, horizon=60, every=10
        )
        trained = hm.train(prior, train, train, settings)  # so short a recording has none to spare
        step, info = trained.step(prior, dt), hm.model_info(prior, dt)
        programs = {"hybrid": trace_model(step), "prior": prior_programs(prior, dt, fit.substeps)}
        parity = check_parity(step, programs["hybrid"], info, train, seed=0, samples=10)
        hm.save_artifact(folder / "model", programs, info, recommended="prior", loop=loop_settings(scenario))
        kit = hm.load(folder / "model")
        noise = {m: hm.process_noise(kit.models[m], train) for m in kit.models}
        kit = kit.with_noise({**noise, **{f"{m}_observer": sigma for m, sigma in noise.items()}})
        return Whole(scenario, train, trained, parity, kit)

    return make


@each
def test_the_plant_is_integrated_to_its_tolerance(name):
    """An explicit method of order 8 with tolerances of 1e-10 gives the same states after a period."""
    machine = MACHINES[name]
    plant, experiment = machine.EXPERIMENT.plant(), machine.EXPERIMENT
    table = experiment.table("train", 1, 0)[:40]
    n_u, n_w = len(experiment.limits[0]), len(machine.scenario.prior().disturbances)
    state, rates = plant.reset(np.array(experiment.x0), 0), rates_of(plant)
    for row in table:
        u, w = row[1 : 1 + n_u], row[1 + n_u : 1 + n_u + n_w]
        state, before = plant.step(state, u, experiment.dt, w), state
    exact = solve_ivp(
        lambda t, z: rates(z, u, w), (0, experiment.dt), before.z, method="DOP853", rtol=1e-10, atol=1e-12
    )
    # Local errors of 1e-8 add over some dozen steps.
    np.testing.assert_allclose(state.z, exact.y[:, -1], rtol=1e-6, atol=1e-6)


def rates_of(plant):
    return lambda z, u, w: np.array([float(v) for v in plant.rates(list(z), list(u), list(w), plant)])


STEP = np.sqrt(12)
"""A sensor whose steps are this many standard deviations has the same noise as one of white noise."""


def closed(whole, task, model="prior", seed=0, **options):
    scenario, kit = whole.scenario, whole.kit
    return hm.simulate(
        scenario.plant(), kit.observer(model), kit.controller(model), task.reference,
        dt=scenario.data.dt, x0=task.x0, seed=seed, w=task.w,
        **{"faults": task.faults, "duration": task.duration, **options},
    )  # fmt: skip


def shown(plant, result):
    """What the sensors would show without noise ``(n, n_y)``."""
    rows = zip(result.x, result.u, result.w, strict=True)
    return np.array([[float(v) for v in plant.outputs(list(x), list(u), list(w), plant)] for x, u, w in rows])


@each_whole
def test_networks_learn_and_are_exported(name, made):
    """Sixty updates of two small networks already follow training windows better than the prior that was fitted to
    them, and the graph computes what torch does.
    """
    whole = made(name)
    loss = whole.trained.curve["loss_output"]
    assert (loss.min(axis=0) < 0.99 * loss[0]).all()
    assert whole.parity.max_abs_error < 1e-12
    assert whole.parity.jacobian_max_abs_error < 1e-10


MODELS = ("prior", "hybrid")


@pytest.mark.parametrize("model", ["prior", pytest.param("hybrid", marks=pytest.mark.full)])
@each_whole
def test_a_constant_load_leaves_no_offset(name, model, made):
    """The mean error of the last fifth is below two steps of the sensor."""
    whole = made(name)
    scenario, task = whole.scenario, next(t for t in whole.scenario.tasks if t.faults)
    controlled = np.flatnonzero(scenario.control.q_y)
    assert hm.offset_free(whole.kit.models[model], controlled).promised
    result = closed(whole, task, model)
    late = slice(len(result.t) * 4 // 5, None)
    error = (shown(scenario.plant(), result) - result.y_ref)[late, controlled].mean(axis=0)
    assert np.all(np.abs(error) < 2 * STEP * np.array(scenario.sensor_sigma)[controlled])
    assert set(result.source) == {"MPC"}
    assert np.all((result.u >= scenario.control.u_min) & (result.u <= scenario.control.u_max))


PERIODS = 30
"""Length of a loop with random faults."""


@pytest.mark.parametrize("loops", [2, pytest.param(34, marks=pytest.mark.full)])
@each_whole
def test_faulted_loops_keep_the_limits_and_raise_nothing(name, loops, made):
    """Loops of the prior's controller and the hybrid's, by turns, each watched by its residuals."""
    whole = made(name)
    scenario, kit = whole.scenario, whole.kit
    control, dt, task = scenario.control, scenario.data.dt, scenario.tasks[0]
    limits = {
        m: hm.learn_limits(hm.ResidualReadings(kit.models[m]), kit.observer(m), whole.train) for m in MODELS
    }
    rng = np.random.default_rng(sorted(MACHINES).index(name))
    for seed in range(loops):
        model, faults = MODELS[seed % 2], random_faults(scenario, rng, dt)
        monitor = hm.make_monitor(kit.models[model], limits[model])
        result = closed(whole, task, model, seed, faults=faults, duration=PERIODS * dt, monitor=monitor)
        assert np.all(np.isfinite(result.u))
        assert np.all((result.u >= control.u_min) & (result.u <= control.u_max))


def random_faults(scenario, rng, dt):
    """Two to four faults of sensors, actuators and the plant itself, of random sizes, within the loop."""
    plant, span, faults = scenario.plant(), scenario.control.u_max - scenario.control.u_min, []
    prior = scenario.prior()
    y, u = [s.name for s in prior.outputs], [s.name for s in prior.inputs]
    for _ in range(rng.integers(2, 5)):
        start = dt * float(rng.integers(2, PERIODS // 2))
        end = np.inf if rng.random() < 0.3 else start + dt * float(rng.integers(1, PERIODS // 2))
        j, i = int(rng.integers(len(y))), int(rng.integers(len(u)))
        kind = rng.integers(7)
        target, value, channel = [
            ("measurement_dropout", 0.0, y[j]),
            ("measurement_freeze", 0.0, y[j]),
            ("measurement_scale", rng.uniform(0.5, 2.0), y[j]),
            ("measurement_offset", 100 * scenario.sensor_sigma[j] * rng.normal(), y[j]),
            ("input_gain", rng.uniform(0.0, 1.5), u[i]),
            ("input_offset", 0.5 * span[i] * rng.uniform(-1, 1), u[i]),
            (f"plant_{rng.choice(plant.parameters_of)}", rng.uniform(0.5, 2.0), ""),
        ][kind]
        faults.append(hm.Fault(start, end, target, float(value), channel))
    return faults


def test_a_plant_refuses_faults_and_parameters_that_it_does_not_have():
    with pytest.raises(hm.InputError, match=r"plant_edge.*HM-LOOP-005"):
        two_tanks.TwoTanks().with_faults([hm.Fault(0.0, 1.0, "plant_hole", 2.0)])
    wider = hm.varied(two_tanks.TwoTanks(), [("area", 2.0)])
    assert wider.area == 2 * two_tanks.TwoTanks().area


def test_a_fault_of_the_plant_acts_while_it_lasts():
    plant = two_tanks.TwoTanks().with_faults([hm.Fault(5.0, 10.0, "plant_pipe_lower", 0.0)])
    state, levels = plant.reset(np.array(two_tanks.LEVELS), 0), []
    for _ in range(3):
        levels.append(plant.truth(state)[1])
        state = plant.step(state, np.array([two_tanks.PUMP]), 5.0, np.array([two_tanks.INFLOW]))
    levels.append(plant.truth(state)[1])
    rise = np.diff(levels)
    closed_pipe = (
        (two_tanks.outflow(plant.pipe_upper, plant.truth(state)[0]) + two_tanks.INFLOW) * 5 / plant.area
    )
    assert rise[1] == pytest.approx(closed_pipe, rel=0.05)  # the upper level moves a little
    assert rise[0] < 0.5 * rise[1]
    assert rise[2] < 0.5 * rise[1]
