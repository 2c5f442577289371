"""Six simulated machines: balances, the prior's fit, and closed loops from an artifact of the prior alone."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from energy_checks import check_balances
from scipy.integrate import solve_ivp

import hybrid_mpc as hm
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.artifact import loop_settings
from scenarios.simulated import cart_pole, dc_motor, lever, two_heaters, two_link_arm, two_tanks
from scenarios.simulated.plant import windows

MACHINES = {m.scenario.name: m for m in (cart_pole, dc_motor, lever, two_heaters, two_link_arm, two_tanks)}
SHORT = {"two_tanks": 1500.0, "dc_motor": 3.0, "two_heaters": 3000.0}
"""Seconds of a short recording; 10 s of the others."""
each = pytest.mark.parametrize("name", MACHINES)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Machine -> scenario, fit of its prior to a short recording, and the artifact of that prior alone."""

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
        hm.save_artifact(
            folder / "model", {"prior": prior_programs(prior, dt, fit.substeps)}, hm.model_info(prior, dt),
            recommended="prior", loop=loop_settings(scenario),
        )  # fmt: skip
        kit = hm.load(folder / "model")
        noise = hm.process_noise(kit.models["prior"], smoothed(scenario.prior, fit, train, dt))
        return scenario, fit, kit.with_noise({"prior_observer": noise, "prior": noise})

    return make


@each
def test_balances_hold_along_the_flow(name):
    check_balances(MACHINES[name].scenario.prior())


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


def held(scenario):
    """The task in which an unknown constant load is held, the controlled outputs, and what error is allowed there."""
    task = next(t for t in scenario.tasks if t.faults)
    controlled = np.flatnonzero(scenario.control.q_y)
    return task, controlled, 2 * STEP * np.array(scenario.sensor_sigma)[controlled]


def closed(scenario, kit, task, seed=0, **options):
    return hm.simulate(
        scenario.plant(), kit.observer(task=task.name), kit.controller(task=task.name), task.reference,
        dt=scenario.data.dt, duration=task.duration, x0=task.x0, seed=seed, w=task.w,
        **{"faults": task.faults, **options},
    )  # fmt: skip


@each
def test_a_constant_load_leaves_no_offset(name, fitted):
    scenario, fit, kit = fitted(name)
    task, controlled, allowed = held(scenario)
    assert hm.offset_free(kit.models["prior"], controlled).promised
    result = closed(scenario, kit, task)
    model, last = kit.models["prior"], len(result.t) * 4 // 5
    shown = np.array([model.output(x, u, w, model.p).full().ravel() for x, u, w in
                      zip(result.x[last:], result.u[last:], result.w[last:], strict=True)])  # fmt: skip
    error = (shown - result.y_ref[last:])[:, controlled].mean(axis=0)
    print(name, error, allowed, result.sources if hasattr(result, "sources") else set(result.source), result.cost)
    assert np.all(np.abs(error) < allowed)
    assert set(result.source) == {"MPC"}
    assert np.all((result.u >= scenario.control.u_min) & (result.u <= scenario.control.u_max))
