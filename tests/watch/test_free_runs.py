"""The model's free runs, and the sensor that stands still."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from monitor_parts import DT, GAMMA, Estimate, Exact, Observer, energy, pendulum, simulate

from hybrid_mpc import InputError, replay
from hybrid_mpc.model.model import Balance


def departure(trace):
    """Energy [J] by which the older free run departs, and over which time [s]; from 0.08 s on."""
    time = 1.0 / trace.terms[:, 2, 3]
    return trace.of("power of the free run") * time, time


def test_the_energy_is_what_a_push_takes():
    # the plant is pushed, the model is not: at each moment the balances differ by push * v
    run = simulate(400, fault=pendulum(push=0.05), at=0)
    monitor = energy(free_run=0.6)
    trace = replay(monitor, Exact(run), run)
    joule, seconds = departure(trace)
    power = np.concatenate([np.zeros(2), -0.05 * run.x[:-2, 1]])  # of the window's centre, 2 samples ago
    expected = np.array(
        [power[k + 1 - round(s / DT) : k + 1].sum() * DT for k, s in enumerate(np.nan_to_num(seconds))]
    )
    # Both balances are smoothed by the same cubic, but at states that the push drives apart: 2 % of what it takes.
    assert np.max(np.abs(joule - expected)[30:]) < 0.02 * np.max(np.abs(expected))
    assert np.max(np.abs(expected)) > 1e-2


def test_the_free_run_sees_more_than_the_followed_estimate():
    # Friction doubles. The observer follows the measurements, and its disturbance explains the loss away; the one
    # step from its estimate still lacks the friction, but in the noise. Accumulated, it stands out of it.
    nominal, worn = (
        simulate(1500, seed=3, noise=1e-3, fault=pendulum(friction=2 * GAMMA), at=at) for at in (9999, 0)
    )
    monitor = energy(window=11, free_run=0.8)
    no, yes = (replay(monitor, Observer(pendulum()), run) for run in (nominal, worn))
    step, free = (
        np.nanmean(np.abs(yes.of(name)[60:])) / np.nanmean(np.abs(no.of(name)[60:]))
        for name in ("violation", "power of the free run")
    )
    assert free > 2 * step


def test_a_missing_measurement_costs_the_energy_until_the_next_run_and_no_longer():
    run = simulate(300)
    y = run.y.copy()
    y[100] = np.nan
    monitor = energy(free_run=0.6)
    power = replay(monitor, Exact(run), replace(run, y=y)).of("power of the free run")
    gone = np.flatnonzero(np.isnan(power[10:])) + 10
    assert gone[0] == 100
    assert gone[-1] < 100 + 5 + 15  # its window, and until the younger run begins


def counted(run, step):
    return replace(run, y=step * np.round(run.y / step))


@pytest.mark.parametrize("at", [60, 75, 120])
def test_a_frozen_sensor_is_found_within_a_few_samples_of_motion(at):
    step = 1e-3
    run = counted(simulate(200), step)
    y = run.y.copy()
    y[at:] = y[at - 1]
    monitor = energy(resolution=[step])
    quiet, found = (replay(monitor, Exact(run), replace(run, y=values)) for values in (run.y, y))
    assert not quiet.frozen.any()
    first = np.flatnonzero(found.frozen[:, 0])[0]
    travelled = np.abs(run.x[:, 0] - run.x[at - 1, 0])
    moved = next(k for k in range(at, 200) if travelled[k] > 3 * step)
    assert first == moved  # three steps of predicted travel, not one sample more
    assert found.alarm[first]
    assert not found.alarm[first - 1]


def test_an_estimate_that_creeps_while_friction_sticks_is_no_frozen_sensor():
    """At 0.1 rad/s for 4 s: 400 steps of the sensor, which stands still; twice the speed of rest is motion."""
    run = simulate(200, kind="rest")

    class Creeping:
        def __init__(self, speed):
            self.x = np.array([0.0, speed])

        def start(self, y, t):
            return Estimate(self.x, np.zeros(0), np.zeros(1))

        def update(self, estimate, y, u_prev):
            return Estimate(self.x, np.zeros(0), np.zeros(1))

    monitor = energy(resolution=[1e-3], rest_speed=0.2)
    assert not replay(monitor, Creeping(0.1), run).frozen.any()
    assert replay(monitor, Creeping(0.4), run).frozen.any()


def test_a_sensor_that_moves_again_is_not_frozen():
    run = counted(simulate(200), 1e-3)
    y = run.y.copy()
    y[60:75] = y[59]
    monitor = energy(resolution=[1e-3])
    frozen = replay(monitor, Exact(run), replace(run, y=y)).frozen
    assert frozen[60:75].any()
    assert not frozen[75:].any()


def test_bad_input_is_refused():
    model = pendulum()
    with pytest.raises(InputError, match="HM-WATCH-012"):
        energy(model, window=11, free_run=0.3)
    with pytest.raises(InputError, match="HM-WATCH-031"):
        energy(model, window=11, resolution=[0.0])
    x, rate, u, w, p = (ca.MX.sym(f"s{i}", n) for i, n in enumerate((2, 2, 1, 0, 3)))
    silent = Balance("energy", "J", "W", ca.Function("e", [x, rate, u, w, p], [x[1] * u]))
    with pytest.raises(InputError, match="HM-WATCH-017"):
        energy(replace(model, balances=(silent,)))
    mass = replace(silent, name="mass", unit="kg", rate_unit="kg/s")
    with pytest.raises(InputError, match=r"'energy'.*mass.*HM-WATCH-015"):
        energy(replace(model, balances=(mass,)))
