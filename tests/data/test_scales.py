"""The machine's own scales: noise, time scale and unit of time, from made-up and from real recordings."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import load_scenario, load_trajectories
from hybrid_mpc.data.scales import noise_of, time_scale, time_unit

SHARED = Path(__file__).parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Outputs:
    y: np.ndarray


def sinusoid(period, dt, n=4000, noise=0.0, size=1.0):
    rng = np.random.default_rng(0)
    y = size * np.sin(2 * np.pi * dt * np.arange(n) / period) + noise * rng.normal(size=n)
    return Outputs(y[:, None])


@pytest.mark.parametrize("dt", [1e-4, 0.02, 2.0, 3600.0])
def test_of_a_sinusoid_it_is_the_period_whatever_the_sampling(dt):
    # the first window holds 11 of 100 samples a period: a cubic flattens the curvature there by 3 %
    assert time_scale([sinusoid(100 * dt, dt)], dt) == pytest.approx(100 * dt, rel=0.05)


def test_what_never_stands_out_of_the_noise_has_no_scale_and_a_second_of_its_own_none():
    noise = Outputs(np.random.default_rng(0).normal(size=(3000, 1)))
    assert np.isnan(time_scale([noise], 0.02))
    assert time_unit([noise], 0.02) == 1.0
    assert time_unit([], 0.02) == 1.0


@pytest.mark.parametrize(
    ("period", "dt", "unit"),
    [
        (1.0, 0.02, 1.0), (0.25, 0.01, 1.0), (4.0, 0.02, 1.0),  # a second is a second
        (40.0, 0.02, 10.0), (600.0, 2.0, 150.0),  # so many times slower than 4 s
        (0.025, 1e-4, 0.1), (0.01, 1e-4, 0.04),  # so many times faster than 0.25 s
        (1.0, 0.1, 1.0), (1.0, 0.2, 2.0), (60.0, 2.0, 20.0),  # at least 10 periods
    ],
)  # fmt: skip
def test_the_unit_of_time(period, dt, unit):
    # to two digits; the window flattens fast swings
    assert time_unit([sinusoid(period, dt)], dt) == pytest.approx(unit, rel=0.15)


SLOW = (pytest.param(name, marks=pytest.mark.full) for name in ("torque_pendulum", "xl330_pendulum"))


@pytest.mark.parametrize("name", ["unbalanced_disk", "emps", *SLOW])
def test_on_the_real_machines_a_second_is_a_second(name):
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip("the real recordings are not on this machine")
    scenario = load_scenario(name)
    prior = scenario.prior()
    files = sorted(p for p in folder.iterdir() if p.suffix in (".csv", ".npz", ".mat"))
    data = load_trajectories(files, prior, scenario.data, needed=())
    for part in (data.by_role("train"), data.whole):
        assert time_unit(part, scenario.data.dt) == 1.0


@pytest.mark.parametrize("name", [pytest.param("golf_robot", marks=pytest.mark.full), "pendulum"])
def test_on_the_simulated_machines_a_second_is_a_second(name, tmp_path):
    scenario = load_scenario(name)
    prior = scenario.prior()
    files = scenario.make_data(tmp_path, 0, "quick")
    data = load_trajectories(files, prior, scenario.data)
    assert time_unit(data.by_role("train"), scenario.data.dt) == 1.0


def test_the_steps_of_a_coarse_sensor_are_no_motion():
    """0.1 mm at 1 mm/s, five samples a step: no white noise, and up to half of it would pass for swings of a second."""
    exact = sinusoid(60.0, 0.02, n=12_000, size=6e-2 / (2 * np.pi)).y
    coarse = Outputs(1e-4 * np.round(exact / 1e-4))
    assert time_scale([coarse], 0.02) == pytest.approx(60.0, rel=0.1)


@pytest.mark.parametrize("missing", ["half", "the first and the last", "every other", "a stretch"])
def test_missing_samples_leave_the_scales(missing):
    run = sinusoid(2.0, 0.02, noise=1e-3)
    y = np.hstack([run.y, sinusoid(40.0, 0.02, noise=1e-3).y])
    n = len(y)
    if missing == "half":
        y[np.random.default_rng(1).uniform(size=y.shape) < 0.5] = np.nan
    elif missing == "the first and the last":
        y[: n // 10] = y[-n // 10 :] = np.nan
    elif missing == "every other":  # two sensors by turns: no row is whole
        y[::2, 0] = y[1::2, 1] = np.nan
    else:
        y[1000:1400] = np.nan
    # a sensor that is there at every other row is a slower one: its motion between counts as noise, a little
    noise = noise_of([Outputs(y)])
    assert noise == pytest.approx(1e-3, rel=0.6 if missing in ("half", "every other") else 0.15)
    # straight lines over the holes bend the motion at their ends: a tenth of the scale, and a time unit stays
    assert time_scale([Outputs(y)], 0.02) == pytest.approx(2.0, rel=0.2)
    assert time_unit([Outputs(y)], 0.02) == 1.0
