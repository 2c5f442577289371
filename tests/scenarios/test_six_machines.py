"""Six machines with real recordings: what their priors say, and that short pieces of the recordings fit them."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import Scenario, fit_prior, load_trajectories
from hybrid_mpc.workflow.benchmark_runs import run_freely
from scenarios.cascaded_tanks import scenario as tanks
from scenarios.cascaded_tanks.prior import CascadedTanksPrior, above, root
from scenarios.coupled_drives import scenario as drives
from scenarios.coupled_drives.prior import CoupledDrivesPrior
from scenarios.double_pendulum import scenario as double_pendulum
from scenarios.double_pendulum.prior import DoublePendulumPrior
from scenarios.heat_exchanger import scenario as exchanger
from scenarios.heat_exchanger.prior import HeatExchangerPrior
from scenarios.race_car import scenario as car
from scenarios.race_car.prior import RaceCarPrior
from scenarios.temperature_lab import scenario as lab
from scenarios.temperature_lab.prior import TemperatureLabPrior

RECORDINGS = Path(__file__).parents[3] / "shared" / "data"


def xdot(prior, x, u, w=()):
    return prior.equations.xdot(list(x), list(u), list(w), prior.p).full().ravel()


def test_full_tanks_run_over_and_the_sensor_ends():
    tank = CascadedTanksPrior({"share": 0.25, "edge_1": 10.0, "edge_2": 10.0, "bend": 0.05})
    upper, lower = xdot(tank, (12.0, 11.0), (4.0,))
    outlet, spill = 0.054 * np.sqrt(12.0), 0.5 * 2.0
    # the roots are off by 1 / 4 (0.1 / h)^2, the edges by 1 / 4 0.2^2 / height: below 1 % here
    assert upper == pytest.approx(0.056 * 4.0 - outlet - spill, rel=0.02)
    assert lower == pytest.approx(outlet + 0.25 * spill - 0.067 * np.sqrt(11.0) - 0.5, rel=0.06)
    y = tank.equations.output([5.0, 10.0], [0.0], [], tank.p)
    assert float(y) == 10.0  # whatever the bend, the sensor's end stays where it is
    assert tank.outputs[0].saturation[1] == 10.0
    assert root(0.0) == 0.0
    assert float(above(-50.0, 0.0)) >= 0.0


def test_heat_goes_from_heater_to_heater_and_to_the_room():
    prior = TemperatureLabPrior()
    rates = xdot(prior, (50.0, 40.0, 48.0, 41.0, 20.0), (0.0, 0.0))
    assert rates[:2] == pytest.approx([-30 / 20 - 10 / 100, -20 / 20 + 10 / 100])
    assert rates[2:] == pytest.approx([2 / 140, -1 / 140, 4 / 86400])  # the room comes back within a day
    # the constants are those of the source: 200 W a per cent over 5720
    assert xdot(prior, (20.0, 20.0, 20.0, 20.0, 20.0), (100.0, 0.0))[0] == pytest.approx(
        200 * 100 / 5720, rel=0.01
    )


def test_an_open_valve_brings_the_outlet_towards_the_reservoir():
    prior = HeatExchangerPrior()
    closed, half, opened = (xdot(prior, (50.0, 40.0), (u,), (80.0,))[0] for u in (-0.5, 0.98, 2.5))
    assert half == pytest.approx((0.33 * 80 + 0.67 * 40 - 50) / 17)
    assert closed < half < opened


def test_the_double_pendulum_is_that_of_its_source():
    q1, q2, v1, v2 = 0.4, -0.7, 1.0, -2.0
    m2, l1, gear, rotor, g = 0.6256, 0.2, 6.0, 6.29e-5, 9.81
    i1, i2, mr1, mr2 = 0.0319, 0.0509, 0.1047, 0.16
    c = l1 * mr2 * np.cos(q2)
    off = i2 + c - gear * rotor
    mass = np.array(
        [[i1 + i2 + m2 * l1**2 + 2 * c + (gear**2 + 1) * rotor, off], [off, i2 + gear**2 * rotor]]
    )
    s = l1 * mr2 * np.sin(q2)
    coriolis = np.array([-2 * s * v1 * v2 - s * v2**2, s * v1**2])
    gravity = g * np.array(
        [(mr1 + m2 * l1) * np.sin(q1) + mr2 * np.sin(q1 + q2), mr2 * np.sin(q1 + q2)]
    )  # fmt: skip
    friction = np.array([0.001 * v1 + 0.2, 0.001 * v2 - 0.15])  # both joints turn fast
    expected = np.linalg.solve(mass, np.array([0.3, -0.2]) - coriolis - gravity - friction)
    found = xdot(DoublePendulumPrior(), (q1, q2, v1, v2), (0.3, -0.2))
    assert found == pytest.approx([v1, v2, *expected], rel=1e-9)


def test_the_drives_counter_does_not_see_the_sign():
    """In steady motion it shows ``|pulley| + bend pulley^2``, whichever way the pulley turns, and nothing at rest."""
    prior = CoupledDrivesPrior({"bend": 2.0})
    rates = [xdot(prior, (s, s, 0.0, 1.0), (0.0,))[3] * prior.values["window"] for s in (0.5, -0.5, 0.0)]
    assert rates[0] == rates[1]
    # the rounded corner takes off at most its width, 0.03
    assert rates[0] + 1.0 == pytest.approx(0.5 + 2.0 * 0.25, abs=0.03)
    assert rates[2] == -1.0


def test_the_measured_point_of_the_car_swings_out():
    prior = RaceCarPrior({"a": 0.1})
    rates = xdot(prior, (0.0, 0.0, 0.0, 0.4, 0.2), (0.2, 0.4))
    turn = 0.4 * np.tan(0.2) / 0.33
    assert rates == pytest.approx([0.4, 0.1 * turn, turn, 0.0, (0.8 * 0.2 - 0.2) / 0.10])


def cut(name: str, first: int, rows: int, folder: Path) -> Path:
    """A few rows of a recording as a file of the same name; skips where there is none."""
    source = RECORDINGS / name
    if not source.is_file():
        pytest.skip(f"the recording {name} is not here")
    with source.open() as file:
        lines = list(csv.reader(file))
    target = folder / source.name
    with target.open("w", newline="") as file:
        csv.writer(file).writerows([lines[0], *lines[1 + first : 1 + first + rows]])
    return target


@pytest.mark.parametrize(
    ("scenario", "name", "first", "rows", "length", "share"),
    [
        (tanks, "cascaded_tanks/estimation.csv", 0, 300, 400.0, 0.4),
        (lab, "temperature_lab/prbs.csv", 0, 1500, 300.0, 0.4),
        pytest.param(drives, "coupled_drives/uniform_low_first400.csv", 0, 300, 2.0, 0.6, marks=pytest.mark.full),
        pytest.param(double_pendulum, "double_pendulum/sines_143339.csv", 500, 600, 0.3, 0.5, marks=pytest.mark.full),
        (exchanger, "heat_exchanger/random_steps_jun16.csv", 1700, 700, 300.0, 0.5),
        (car, "race_car/run_07.csv", 0, 120, 2.0, 0.2),
    ],
    ids=lambda value: value.name if isinstance(value, Scenario) else "",
)  # fmt: skip
def test_a_few_hundred_samples_fit_the_prior(scenario, name, first, rows, length, share, tmp_path):
    """Free runs over the piece are off by less than a share of its motion, about twice what was found: a wrong sign,
    column or unit leaves the whole of it."""
    path = cut(name, first, rows, tmp_path)
    spec, prior = scenario.data, scenario.prior()
    data = load_trajectories([path], prior, replace(spec, fractions=(1.0, 0.0, 0.0)), needed=("train",))
    runs = list(data.trajectories)
    fit = fit_prior(scenario.prior, runs, runs, dt=spec.dt, length=length)
    (run,) = run_freely(scenario.prior(fit.values), fit, {}, runs[:1], warm_up=spec.warm_up, length=length)
    y, y_hat = run.y[:, 0], run.y_hat["phy"][:, 0]
    assert np.sqrt(np.mean((y - y_hat) ** 2)) < share * np.std(runs[0].y[:, 0])
    for p in prior.parameters:
        assert p.lower - 1e-12 <= fit.values[p.name] <= p.upper + 1e-12
