"""Monitor, guard and detector on axes whose periods are 0.1 ms, 1 ms, 2 s or an hour."""

import numpy as np
import pytest
from linear_axes import Axis, kalman

from hybrid_mpc import Diagnoser, make_monitor, make_readings, replay, rest_speeds
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.watch.learn import limits_of
from hybrid_mpc.watch.lengths import seconds, settling_samples
from hybrid_mpc.watch.monitor import Monitor


def axis(dt, swing, unit=1.0, speed=0.1, push=0.0, viscous=1.0):
    """An axis that 1 N swings at ``speed`` [m/s] in a time ``swing`` [s]; half of the force goes into damping."""
    damping = 0.5 / speed
    return Axis(dt, mass=swing / (2 * np.pi) * damping, viscous=viscous * damping, push=push, time_unit=unit)


@pytest.mark.parametrize(
    ("dt", "swing"),
    [pytest.param(1e-4, 5e-3, marks=pytest.mark.full), pytest.param(1e-3, 0.05, marks=pytest.mark.full),
     pytest.param(2.0, 120.0, marks=pytest.mark.full), pytest.param(3600.0, 2e5, marks=pytest.mark.full)],
    ids=lambda v: f"{v:g}",
)  # fmt: skip
def test_a_detector_is_learned_and_finds_a_fault_at_any_period(dt, swing):
    speed, noise = 0.1, 1e-5 * 0.1 * swing
    plain, n = axis(dt, swing), 3600
    runs = [plain.run(plain.swings(swing, n, seed=s), noise=noise, seed=s) for s in range(2)]
    unit = time_unit(runs, dt)
    assert unit >= 10 * dt * 0.95  # to two digits
    model = axis(dt, swing, unit).model()
    rest = rest_speeds(runs, model)
    assert rest[0] < 0.2 * speed
    readings, estimator = make_readings(model, rest_speed=rest), kalman(model, noise, speed)
    assert readings.kind == "energy"
    traces = [replay(Monitor(readings), estimator, run) for run in runs]
    # little data: short blocks, and an alarm in five of them, each of the two alarms in ten
    block = 100 * dt
    limits = limits_of(
        readings, [run.y for run in runs], traces, false_alarms_per_hour=0.2 * 3600.0 / block, trusted=True,
        block_s=block,
    )  # fmt: skip
    assert limits.hours * 3600 == pytest.approx(2 * (n - settling_samples(model)) * dt)
    # a push of a tenth of the force from the middle of another run on
    pushed = plain.run(
        plain.swings(swing, 800, seed=7), noise=noise, seed=7, fault=axis(dt, swing, push=0.1), at=400
    )
    armed, estimates = make_monitor(model, limits, resolution=[3.5 * noise]), []
    trace = replay(armed, estimator, pushed, on_sample=lambda k, estimate: estimates.append(estimate))
    assert trace.alarm[400:].any()
    first = np.flatnonzero(trace.alarm[400:])[0]
    assert first * dt < 2 * swing
    assert (trace.validity[armed.readings.window - 1 :] == 0).all()
    assert Diagnoser(model).of_alarm(400 + int(first), trace, pushed, estimates)


def test_the_main_monitor_runs_at_any_period():
    for dt, swing in ((1e-4, 5e-3), (3600.0, 2e5)):
        plain = axis(dt, swing)
        run = plain.run(plain.swings(swing, 600))
        model = axis(dt, swing, time_unit([run], dt)).model()
        monitor = make_monitor(model, rest_speed=rest_speeds([run], model))
        trace = replay(monitor, kalman(model, 1e-9, 0.1), run)
        assert np.isfinite(trace.values[3 * monitor.readings.window :]).all()
        assert seconds(0.3, model) >= 5 * dt
