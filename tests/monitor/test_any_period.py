"""Monitor, guard and detector on axes whose periods are 0.1 ms, 1 ms, 2 s or an hour."""

import numpy as np
import pytest
from linear_axes import Axis, kalman

from hybrid_mpc import Diagnoser, guard_monitor, make_monitor, replay, rest_speeds
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.monitor.learn import learn_detector
from hybrid_mpc.monitor.lengths import SETTLING_S, samples, seconds


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
    monitor, estimator = guard_monitor(model, rest_speed=rest), kalman(model, noise, speed)
    skipped = samples(SETTLING_S, model)
    numbers = [replay(monitor, estimator, run).numbers[skipped:] for run in runs]
    # little data: short blocks, and an alarm in five of them, each of the two alarms in ten
    block = 100 * dt
    detector = learn_detector(
        numbers, dt, 1, false_alarms_per_hour=0.2 * 3600.0 / block, rest_speed=rest, time_unit=unit, trusted=True,
        block_s=block,
    )  # fmt: skip
    assert detector.hours * 3600 == pytest.approx(2 * (n - skipped) * dt)
    # a push of a tenth of the force from the middle of another run on
    pushed = plain.run(
        plain.swings(swing, 800, seed=7), noise=noise, seed=7, fault=axis(dt, swing, push=0.1), at=400
    )
    armed = guard_monitor(model, detector, resolution=[3.5 * noise], diagnose=True)
    trace = replay(armed, estimator, pushed)
    assert trace.alarm[400:].any()
    first = np.flatnonzero(trace.alarm[400:])[0]
    assert first * dt < 2 * swing
    assert (trace.validity[armed.window - 1 :] == 0).all()
    # what explains it is looked for in whole windows; a push is none of the parameters
    assert Diagnoser(armed).diagnose(trace.state).text


def test_the_main_monitor_runs_at_any_period():
    for dt, swing in ((1e-4, 5e-3), (3600.0, 2e5)):
        plain = axis(dt, swing)
        run = plain.run(plain.swings(swing, 600))
        model = axis(dt, swing, time_unit([run], dt)).model()
        monitor = make_monitor(model, None, rest_speed=rest_speeds([run], model))
        trace = replay(monitor, kalman(model, 1e-9, 0.1), run)
        assert np.isfinite(trace.level_w[monitor.window + monitor.average :]).all()
        assert seconds(0.3, model) >= 5 * dt
