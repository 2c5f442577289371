"""The runner beside simulate on a clock that only moves when told, and once on the real one."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
from closed_loop_parts import DT, FakeClock, LateRig, Rig, make_ekf, make_runner, make_safe, run, sine
from monitor_parts import by_hand, energy, of_force
from online_models import pendulum_model

from hybrid_mpc import (
    DelayCompensation,
    Fault,
    InputError,
    Monitor,
    ResidualReadings,
    Runner,
    SafeController,
)
from hybrid_mpc.loop.realtime import RealClock

N = 30


class Slow:
    """A controller whose solves of some periods take a time; it counts from the warm-up's two and the first plan on."""

    def __init__(self, controller, clock, seconds):
        self._controller, self._clock, self._seconds, self.k = controller, clock, seconds, -4

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def solve(self, *arguments, **others):
        self.k += 1
        self._clock.t += self._seconds.get(self.k, 0.0)
        return self._controller.solve(*arguments)


def watching(model):
    """A monitor that could alarm."""
    return energy(model, by_hand(of_force(1e9), dt=model.dt))


def test_a_monitor_without_limits_is_refused_and_the_stage_that_gives_them_is_named(model, safe):
    for monitor in (energy(model), Monitor(ResidualReadings(model))):
        with pytest.raises(InputError, match=r"stage watch.*HM-LOOP-034"):
            make_runner(model, safe, Rig(), monitor=monitor)
    make_runner(model, safe, Rig(), monitor=watching(model))
    make_runner(model, safe, Rig(), monitor=Monitor(ResidualReadings(model), resolution=[1e-3]))


def same(report, want, names=("y", "u", "x_hat")):
    for name in names:
        np.testing.assert_array_equal(getattr(report, name), getattr(want, name), name)
    assert (report.source, report.status) == (want.source, want.status)


def test_without_missed_deadlines_it_is_simulate(model, safe):
    rig = Rig()
    report = make_runner(model, safe, rig, monitor=watching(model)).run(N * DT)
    want = run(model, safe, monitor=watching(model))
    same(report, want)
    np.testing.assert_array_equal(report.t, want.t)
    np.testing.assert_array_equal(report.alarm, want.alarm)
    assert (report.periods, report.late, report.overruns, report.skipped, report.missing) == (N, 0, 0, 0, 0)
    assert report.sources == {"MPC": N}
    assert report.stopped == "duration"
    np.testing.assert_array_equal(rig.u[-1], [0.0])  # the safe input at the end, beside one input a period
    assert len(rig.u) == N + 1
    assert report.percentiles()["lateness"]["max"] < 1e-9  # ms; rounding of sums of periods


def test_missing_samples_are_nan_samples(model, safe):
    gaps = (7, 8, 9, 20)
    report = make_runner(model, safe, Rig(gaps=gaps)).run(N * DT)
    faults = [Fault(k * DT, (k + 1) * DT, "measurement_dropout") for k in gaps]
    same(report, run(model, safe, faults=faults))
    assert report.missing == len(gaps)
    same(make_runner(model, safe, Rig(gaps=range(N))).run(N * DT),
         run(model, safe, faults=[Fault(0.0, 9.0, "measurement_dropout")]))  # fmt: skip


def test_delays_known_to_the_estimator_are_those_of_simulate(model, safe):
    monitors = [watching(model) for _ in range(2)]
    ekf = DelayCompensation(make_ekf(model), input_delay=2)

    rig = LateRig(delay=2)
    report = make_runner(model, safe, rig, estimator=ekf, input_delay=2, monitor=monitors[0]).run(N * DT)
    want = run(model, safe, estimator=ekf, input_delay=2, monitor=monitors[1])
    same(report, want)
    np.testing.assert_array_equal(report.alarm, want.alarm)


@pytest.mark.parametrize("seconds", [0.011, 0.019])
def test_solves_that_come_late_are_shifted_plans(model, seconds):
    clock = FakeClock()
    late = {12: seconds, 13: seconds, 20: seconds}
    controller = Slow(make_safe(model, horizon=10).controller, clock, late)
    slow = SafeController(controller, pendulum_model(), safe_input=[0.0])
    report = make_runner(model, slow, Rig(), clock, deadline=0.01).run(N * DT)
    want = run(model, make_safe(model, horizon=10), late=lambda t: round(t / DT) in late)
    same(report, want)
    assert (report.late, report.overruns, report.skipped) == (3, 3, 0)
    assert [k for k, s in enumerate(report.status) if s == "LATE"] == [12, 13, 20]
    assert report.timing_ms["solve"].max() == pytest.approx(1e3 * seconds, rel=1e-6)
    assert report.applied_ms.max() == pytest.approx(1e3 * seconds, rel=1e-6)


def test_no_solve_is_begun_that_cannot_be_in_time(model):
    clock, rig = FakeClock(), Rig()
    controller = Slow(make_safe(model, horizon=10).controller, clock, dict.fromkeys(range(-2, 99), 0.004))
    ordinary = rig.measure

    def measure():
        if len(rig.u) == 15:
            clock.t += 0.017  # 3 ms are left for a solve of 4 ms
        return ordinary()

    runner = Runner(
        measure, rig.actuate, make_ekf(model), SafeController(controller, safe_input=[0.0]), sine, clock=clock
    )
    report = runner.run(N * DT)
    assert controller.k == N - 2  # one solve fewer than periods
    assert (report.status[15], report.late, report.overruns) == ("LATE", 1, 0)
    assert report.timing_ms["solve"][15] == 0.0


def test_after_a_long_solve_periods_are_skipped_on_the_grid(model):
    clock = FakeClock()
    controller = Slow(make_safe(model, horizon=10).controller, clock, {10: 3.3 * DT, 15: 1.3 * DT})
    report = make_runner(model, SafeController(controller, safe_input=[0.0]), Rig(), clock).run(N * DT)
    grid = np.round(report.t / DT).astype(int)
    # 3.3 periods: two are lost, the third is begun late; 1.3 periods: none is lost.
    np.testing.assert_array_equal(grid, [*range(11), *range(13, N)])
    assert (report.skipped, report.overruns, report.periods) == (2, 2, N - 2)
    assert report.lateness_ms[11] == pytest.approx(0.3 * 1e3 * DT, rel=1e-6)
    assert report.sources["PLAN"] == 2
    ekf = make_ekf(model)
    e = ekf.start(report.y[0])
    for k in range(1, N):  # the filter is led through the gap with the held input and no sample
        i = np.searchsorted(grid, k)
        y = report.y[i] if k in grid else [np.nan]
        e = ekf.update(e, y, report.u[np.searchsorted(grid, k, side="left") - 1])
        if k in grid:
            np.testing.assert_array_equal(e.x, report.x_hat[i])


def test_after_a_very_long_break_the_estimate_starts_anew(model):
    clock = FakeClock()
    controller = Slow(make_safe(model, horizon=10).controller, clock, {4: 3600.0})
    report = make_runner(model, SafeController(controller, safe_input=[0.0]), Rig(), clock).run(
        3600.0 + N * DT
    )
    assert report.skipped == round(3600.0 / DT) - 1
    assert report.x_hat[5, 1] == 0.0  # at rest at the first measurement
    assert report.x_hat[5, 0] == pytest.approx(report.y[5, 0], abs=1e-12)  # Newton's tolerance


def test_stop_and_the_rows_kept(model, safe):
    rig, steps = Rig(), []
    runner = make_runner(model, safe, rig, keep=4, on_step=steps.append)
    report = runner.run(stop=lambda: len(rig.u) == 11)
    assert (report.stopped, report.periods, len(report.t)) == ("stop", 11, 4)
    np.testing.assert_allclose(report.t, DT * np.arange(7, 11), atol=1e-12)
    assert [s.k for s in steps] == list(range(11))
    empty = make_runner(model, safe, Rig()).run(stop=lambda: True)
    assert empty.periods == 0
    assert np.isnan(empty.percentiles()["solve"]["p99"])


def test_in_real_time():
    model = pendulum_model()
    rig, begin = Rig(), time.perf_counter()
    report = make_runner(model, make_safe(model, horizon=10), rig, RealClock()).run(1.0)
    # 50 whole periods. Other load on the computer may delay any step, not hasten one.
    assert time.perf_counter() - begin >= 1.0
    assert report.periods + report.skipped == 50
    assert report.lateness_ms.min() >= 0.0
    # Steps of some ms in periods of 20 ms: most are in time even beside other work.
    assert report.periods >= 25
    assert np.median(report.lateness_ms) < 20.0
    assert report.sources["MPC"] >= 0.5 * report.periods
    assert isinstance(report.percentiles()["applied"]["p99"], float)


def test_the_examples_of_the_pages_run(capsys):
    docs = Path(__file__).parents[2] / "docs"
    names: dict[str, object] = {}
    exec((docs / "examples/runner.py").read_text(), names)
    report = names["report"]
    assert report.periods + report.skipped == 100
    assert "'median'" in capsys.readouterr().out
    # A double integrator under MPC for 2 s; other load on the computer may cost periods, so only roughly.
    assert abs(names["cart"]["q"] - 0.2) < 0.1
    (watched,) = re.findall(r"```python\n(.*?)```", (docs / "watchdog.md").read_text(), re.DOTALL)
    exec(watched, names)  # the actuator with a watchdog
    assert [names["watchdog"](k, 3.0) for k in (7, 8, 8, 8, 8, 9)] == [3.0, 3.0, 3.0, 3.0, 0.0, 0.0]
