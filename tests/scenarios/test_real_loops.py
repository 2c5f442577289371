"""Loops of real machines on simulated plants: how each plant differs from its prior, and that its tasks can be done."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.model.delay import with_input_delay
from scenarios.cascaded_tanks import scenario as tanks
from scenarios.cascaded_tanks.plant import CascadedTanksPlant
from scenarios.coupled_drives import scenario as drives
from scenarios.coupled_drives.plant import CoupledDrivesPlant
from scenarios.heat_exchanger import scenario as exchanger
from scenarios.heat_exchanger.plant import HeatExchangerPlant
from scenarios.heat_exchanger.tasks import DAY
from scenarios.race_car import scenario as car
from scenarios.race_car.plant import RaceCarPlant
from scenarios.temperature_lab import scenario as lab
from scenarios.temperature_lab.plant import TemperatureLabPlant

# fitted to the recordings, as the machine's page has them
FITTED = {
    "temperature_lab": {"P1": 0.677, "P2": 0.375, "tau": 59.7, "tau_12": 173.0, "lag1": 108.0, "lag2": 77.9},
    "cascaded_tanks": {"k_1": 0.0417, "k_2": 0.0389, "k_p": 0.0365, "edge_1": 9.4, "edge_2": 10.45, "share": 1.0,
                       "bend": 0.0571},
    "heat_exchanger": {"k": 0.626, "slope": 4.71, "middle": 0.95, "tau": 36.9},
    "coupled_drives": {"gain": 0.331, "lag": 0.197, "w": 24.8, "zeta": 0.049, "zeta_v": 0.490, "F": 0.082, "bend": 4.9,
                       "window": 0.027},
    "race_car": {"k": 0.879, "offset": -0.0129, "tau_v": 0.235, "tau_s": 0.141, "a": 0.134, "psi_0": -0.0131},
}  # fmt: skip
SIGMA_X = {
    "temperature_lab": (0.5, 0.5, 0.03, 0.03, 1e-6),
    "cascaded_tanks": (0.05, 0.04),
    "heat_exchanger": (0.02, exchanger.state_noise["cold"]),
    "coupled_drives": (0.008, *drives.state_noise.values()),
    "race_car": (1e-3, 1e-3, 1e-3, 1e-2, 1e-2),
}
"""Process noise a period, of the size of the models' one-period errors on the recordings."""
SCENARIOS = {s.name: s for s in (lab, tanks, exchanger, car, drives)}


def rates(plant, z, u, w=()):
    return np.array([float(v) for v in plant.rates(list(z), list(u), list(w), plant)])


def fitted_model(name):
    scenario = SCENARIOS[name]
    prior, dt = scenario.prior(FITTED[name]), scenario.data.dt
    programs = {f"prior/{key}": program for key, program in prior_programs(prior, dt).items()}
    model = build_model("prior", programs, hm.model_info(prior, dt))
    model = replace(model, disturbance_model=scenario.disturbance_model)
    return with_input_delay(model, 3.0) if name == "heat_exchanger" else model  # fitted, too


def closed(name, task, periods):
    """A loop of the fitted prior's controller and observer, over the first periods of a task."""
    scenario, model = SCENARIOS[name], fitted_model(name)
    dt = model.dt
    control = task.control or scenario.control
    estimator = hm.make_estimator(model, scenario, np.array(SIGMA_X[name]), control)
    controller = hm.make_controller(model, model, control, safe_input=scenario.safe_input)
    return hm.simulate(
        scenario.plant(), estimator, controller, task.reference, dt=dt, duration=periods * dt, x0=task.x0, seed=0,
        w=task.w, faults=task.faults,
    )  # fmt: skip


def test_the_lab_radiates_and_its_power_lags():
    plant = TemperatureLabPlant()

    def loss(t):
        z = plant.start(np.array([t, t, t, t, 24.0]))
        z[5:7] = 0.0
        return -rates(plant, z, (0.0, 0.0))[0] / (t - 24.0)

    # the prior loses in proportion; a third of the loss is radiation, and this third is 1.27 times as much at 80 degC
    assert loss(80.0) > 1.08 * loss(30.0)
    z = plant.start(np.array(lab.tasks[0].x0))
    jump = rates(plant, z, (100.0, 30.0)) - rates(plant, z, (30.0, 30.0))
    assert np.flatnonzero(jump).tolist() == [5]
    assert jump[5] == pytest.approx(70.0 / plant.lag_power)


def test_the_tanks_have_sharp_edges_and_no_ideal_orifices():
    plant = CascadedTanksPlant()

    def upper(level):
        return rates(plant, (level, 4.0, 0.0), (0.0,))[0]

    assert upper(8.0) / upper(2.0) == pytest.approx(4.0**0.56)  # the prior's: 2
    over = -upper(8.6 + 0.25) - 0.034 * 8.85**0.56
    assert over == pytest.approx(0.4 * 0.25**1.5)
    assert upper(8.6 - 1e-6) == pytest.approx(-0.034 * 8.6**0.56)  # the prior runs over before its edge
    full = plant.reset(np.array([8.0, 10.1]), 0)
    readings = [plant.measure(full, np.random.default_rng(s))[0] for s in range(20)]
    assert max(readings) == 10.0
    assert min(readings) > 9.9


def test_the_exchanger_follows_its_valve_over_three_lags():
    plant = HeatExchangerPlant()
    z = plant.start(np.array(DAY))
    jump = rates(plant, z, (1.5,), (78.0,)) - rates(plant, z, (0.98,), (78.0,))
    assert np.flatnonzero(jump).tolist() == [3]  # the prior's outlet moves at once
    ends = [rates(plant, [*z[:3], v, *z[4:]], (v,), (78.0,))[2] for v in (-5.0, 5.0)]
    cold, hot = (r * plant.lag_plates + z[2] + plant.loss * (z[2] - 22.0) for r in ends)
    assert cold == pytest.approx(DAY[1], abs=1e-6)
    assert hot == pytest.approx(0.66 * 78.0 + 0.34 * DAY[1], abs=1e-6)


def test_the_belt_holds_the_drives_back_and_stiffens():
    plant = CoupledDrivesPlant()
    z = plant.start(np.array([0.4, 0.4, 0.0, 1.0]))
    jump = rates(plant, z, (2.0,)) - rates(plant, z, (1.0,))
    assert np.flatnonzero(jump).tolist() == [4]  # the amplifier lags
    pulled = z.copy()
    pulled[2] = plant.stiff
    change = rates(plant, pulled, (1.0,)) - rates(plant, z, (1.0,))
    assert change[0] == pytest.approx(-plant.share * plant.stiff)  # the prior's drives do not feel the belt
    z[1] = pulled[1] = 0.3
    assert rates(plant, pulled, (1.0,))[2] == pytest.approx(2 * rates(plant, z, (1.0,))[2])


def test_the_simulated_counter_does_not_see_the_sign_and_has_steps():
    plant = CoupledDrivesPlant()
    forth, back = (rates(plant, plant.start(np.array([s, s, 0.0, 0.0])), (0.0,))[3] for s in (0.4, -0.4))
    assert forth == back == pytest.approx(plant.scale * 0.4**plant.power / plant.window)
    y = plant.measure(plant.reset(np.array([0.3, 0.3, 0.0, 0.7123]), 0), np.random.default_rng(0))
    assert y / 0.005 == pytest.approx(np.round(y / 0.005), abs=1e-9)
    x = np.array([0.3, 0.2, 1.0, 0.5])
    np.testing.assert_allclose(plant.shown(plant.start(x)), x)


@pytest.mark.parametrize("speed", [0.3, 1.5])
def test_the_car_rolls_when_slow_and_slips_when_fast(speed):
    """Slip of the rear axle in a steady turn: sideways acceleration over stiffness and gravity, 0.1 and 2.5 degrees."""
    plant = RaceCarPlant(offset=0.0)
    state = plant.reset(np.array([0.0, 0.0, 0.0, speed, 0.3 * plant.k]), 0)
    for _ in range(120):
        state = plant.step(state, np.array([0.3, speed]), 0.025)
    _, _, _, v, _, side, turn = state.z
    slip = np.arctan((plant.rear * turn - side) / v)
    # the curve of the tyre bends by a few per cent, and slow wheels slip a little less than rolling ones by STANDING
    assert slip == pytest.approx(v * turn / (plant.stiffness * 9.81), rel=0.06)
    assert (slip > 0.03) == (speed > 1.0)


@pytest.mark.parametrize("name", SCENARIOS)
def test_plants_stay_within_a_fifth_of_what_was_fitted(name):
    """Parameters that plant and prior share."""
    plant, fitted = SCENARIOS[name].plant(), FITTED[name]
    shared = set(fitted) & set(plant.parameters_of) - {"k_1", "k_2"}  # of another exponent
    if name == "temperature_lab":
        assert plant.warming1 * fitted["tau"] == pytest.approx(fitted["P1"], rel=0.2)
        assert plant.warming2 * fitted["tau"] == pytest.approx(fitted["P2"], rel=0.2)
        assert plant.between * fitted["tau_12"] == pytest.approx(1.0, rel=0.2)
    if name == "cascaded_tanks":
        for key in ("k_1", "k_2"):
            assert getattr(plant, key) * 5**plant.exponent == pytest.approx(fitted[key] * 5**0.5, rel=0.2)
    for key in shared:
        assert getattr(plant, key) == pytest.approx(fitted[key], rel=0.2)
        assert getattr(plant, key) != fitted[key]


HELD = [
    ("temperature_lab", "weak_heater", 200),
    ("cascaded_tanks", "weak_pump", 400),
    ("heat_exchanger", "weak_valve", 375),
    ("coupled_drives", "weak_drive", 500),
]


@pytest.mark.parametrize(
    ("name", "task", "periods"), [HELD[0], *(pytest.param(*one, marks=pytest.mark.full) for one in HELD[1:])]
)
def test_the_priors_controller_holds_a_set_point_under_a_load(name, task, periods):
    """The mean error of the last fifth is below what steps of the sensor allow, and no input leaves its limits."""
    scenario = SCENARIOS[name]
    task = next(t for t in scenario.tasks if t.name == task)
    result = closed(name, task, periods)
    plant, late = scenario.plant(), slice(periods * 4 // 5, None)
    y = np.array(
        [np.ravel(plant.outputs(list(plant.start(x)), None, None, plant)).astype(float) for x in result.x]
    )
    error = (y - result.y_ref)[late].mean(axis=0)
    assert np.all(np.abs(error) < 2 * np.sqrt(12) * np.array(scenario.sensor_sigma))
    assert np.all((result.u >= scenario.control.u_min) & (result.u <= scenario.control.u_max))
    assert set(result.source) == {"MPC"}


@pytest.mark.parametrize("task", ["lanes", pytest.param("fast_slalom", marks=pytest.mark.full)])
def test_the_priors_controller_keeps_the_car_on_its_path(task):
    task = next(t for t in car.tasks if t.name == task)
    result = closed("race_car", task, round(task.duration / car.data.dt))
    off = np.hypot(*(result.x - result.reference)[:, :2].T)
    assert np.sqrt(np.mean(off**2)) < 0.05  # a path swings by 0.2 m
    assert np.all((result.u >= car.control.u_min) & (result.u <= car.control.u_max))


@pytest.mark.full
def test_the_benchmarks_linear_model_is_the_tangent_of_a_delayed_one(monkeypatch):
    """At the operating point both step alike, delayed input and all; beside it they part by the curvature alone."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    model = fitted_model("heat_exchanger")
    linear = import_module("simulated_machines").linear_model(model, exchanger.control)
    assert (linear.n_h, linear.delay_states) == (1, 1)

    def apart(size):
        x, u, w = model.x0 + size * np.array([1.0, 0.5]), model.u0 + 0.1 * size, model.w + size
        h = model.u0 - 0.05 * size
        after = [np.vstack([v.full() for v in m.step(x, h, u, w, m.p)]) for m in (linear, model)]
        return np.abs(after[0] - after[1]).max()

    assert apart(0.0) < 1e-12
    assert apart(0.1) == pytest.approx(apart(0.2) / 4, rel=0.3)  # of second order, and what comes after
