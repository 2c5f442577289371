"""A sensor that freezes where the machine hardly moves: the estimate stands, the controller pulls ever stronger."""

from dataclasses import replace

import numpy as np
import pytest
from monitor_parts import DT, Estimate, Exact, J, pendulum, simulate

from hybrid_mpc.monitor import EnergyMonitor
from hybrid_mpc.signals import Signal

STEP, LIMIT = 1e-3, 1.0
"""Step of the sensor [rad]; input from -1 to 1 N m, a quarter of that is 0.5 N m."""


def monitor(limit=LIMIT):
    signal = Signal("tau", "N m") if limit is None else Signal("tau", "N m", -limit, limit)
    return EnergyMonitor(replace(pendulum(), inputs=(signal,)), window=5, average=1, resolution=[STEP])


def frozen(u, y, watching):
    """Where a reading says frozen; the estimate stands at the reading."""
    state, found = watching.initial(), []
    for k in range(len(u)):
        estimate = Estimate(np.array([y[k], 0.0]), np.zeros(0), np.zeros(1))
        u_prev = u[k - 1 : k] if k else np.zeros(1)
        state, reading = watching.update(state, y[k : k + 1], u_prev, estimate)
        found.append(reading.frozen)
    return np.flatnonzero(found).tolist()


def pulling(before, after, at=50, n=100):
    return np.where(np.arange(n) < at, before, after), np.zeros(n)


def test_a_pull_that_should_have_moved_it_tells():
    u, y = pulling(0.1, 0.7)
    # 0.6 N m more are 6 rad/s^2: after 1, 2 periods 2.4 and 7.2 mrad of travel, three steps are 3 mrad
    assert [0.6 / J * DT**2 * n for n in (1, 3)] == pytest.approx([2.4e-3, 7.2e-3])
    # sample 51 is the first after a period with it
    assert frozen(u, y, monitor()) == list(range(52, 100))


def test_it_counts_from_the_input_at_the_last_step_of_the_sensor():
    u, y = pulling(0.4, 0.7)
    y[:20] = STEP  # moves at sample 20 under 0.4 N m: 0.3 N m more since then
    assert frozen(u, y, monitor()) == []
    assert frozen(u - 0.6, y, monitor()) == []


@pytest.mark.parametrize("limit", [None, 1.3])
def test_what_friction_may_hold_or_nobody_has_bounded_does_not(limit):
    u, y = pulling(0.1, 0.7)  # 0.7 N m since the beginning, a quarter of 2.6 would be 0.65: 0.6 is not
    y[:20] = STEP
    assert frozen(u, y, monitor(limit)) == []


def test_it_stays_frozen_without_input_until_the_sensor_moves():
    u, y = pulling(0.1, 0.7)
    u[60:], y[80:] = 0.0, STEP
    assert frozen(u, y, monitor()) == list(range(52, 80))


def test_a_machine_that_moves_is_never_taken_for_one():
    run = simulate(600, kind="steps")
    limit = float(np.abs(run.u).max())
    run = replace(run, y=STEP * np.round(run.y / STEP))
    estimator, watching = Exact(run), monitor(limit)
    state, estimate = watching.initial(), estimator.start(run.y[0], 0.0)
    for k in range(1, len(run.t)):
        estimate = estimator.update(estimate, run.y[k], run.u[k - 1])
        state, reading = watching.update(state, run.y[k], run.u[k - 1], estimate)
        assert not reading.frozen, k


def test_a_missing_estimate_or_sample_begins_anew():
    u, y = pulling(0.1, 0.7)
    watching, found = monitor(), []
    state = watching.initial()
    for k in range(100):
        x = np.array([y[k], np.nan if 50 <= k < 55 else 0.0])
        y_k = np.array([np.nan]) if k == 60 else y[k : k + 1]
        u_prev = u[k - 1 : k] if k else np.zeros(1)
        state, reading = watching.update(state, y_k, u_prev, Estimate(x, np.zeros(0), np.zeros(1)))
        found.append(reading.frozen)
    # The last period that begins at a missing estimate ends at sample 55. From the missing sample on 0.7 N m are what
    # the input was.
    assert np.flatnonzero(found).tolist() == [57, 58, 59]


def test_a_missing_estimate_does_not_hide_a_sensor_that_freezes_in_motion():
    watching, found = EnergyMonitor(pendulum(), window=5, average=1, resolution=[STEP]), []
    state = watching.initial()
    for k in range(30):  # 1 rad/s are 20 mrad a period
        x = np.array([0.0, np.nan if k == 10 else 1.0])
        state, reading = watching.update(
            state, np.zeros(1), np.zeros(1), Estimate(x, np.zeros(0), np.zeros(1))
        )
        found.append(reading.frozen)
    assert [k for k in range(1, 30) if not found[k]] == [11]
