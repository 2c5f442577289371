"""A guard that reacts: nothing changes without an alarm, nothing jumps with one."""

from dataclasses import dataclass

import numpy as np
import pytest
from closed_loop_parts import DT, Rig, ScriptedMonitor, make_ekf, make_runner, make_safe, run
from monitor_parts import energy
from online_models import PendulumPlant, pendulum_model

from hybrid_mpc import Fault, Guard, InputError, Limits, Mode

DU = 0.4


def guarded(guard, monitor, **changes):
    model = pendulum_model(3)
    return run(model, make_safe(model, du_max=DU), guard=guard, monitor=monitor, duration=1.2, **changes)


def backup(**times):
    prior = pendulum_model()
    return Guard(backup=make_safe(prior, du_max=DU), backup_estimator=make_ekf(prior), **times)


def test_without_an_alarm_the_loop_is_bit_equal():
    plain, same = (
        guarded(None, ScriptedMonitor()),
        guarded(backup(limits=Limits([-0.5], [0.5])), ScriptedMonitor()),
    )
    for name in ("x", "u", "x_hat", "h", "stage_cost"):
        assert np.array_equal(getattr(plain, name), getattr(same, name)), name
    assert same.switches == ()
    assert set(same.mode) == {"NORMAL"}


@pytest.mark.parametrize("mode", [Mode.LIMITED, Mode.BACKUP, Mode.FALLBACK, Mode.REST])
def test_there_and_back_without_a_bump(mode):
    prior, limits = pendulum_model(), Limits([-1.0], [1.0])
    guard = Guard(
        mode, limits=limits, backup=make_safe(prior, du_max=DU), backup_estimator=make_ekf(prior),
        dwell=0.1, quiet=0.1,
    )  # fmt: skip
    result = guarded(guard, ScriptedMonitor([(20, 25)]))
    assert [(s.before.name, s.after.name) for s in result.switches] == [
        ("NORMAL", mode.name),
        (mode.name, "NORMAL"),
    ]
    first, last = (round(s.t / DT) for s in result.switches)
    assert first == 21  # the period after the reading
    assert last == 30  # the last alarm is that of period 24, five periods of quiet after it
    assert result.mode[first - 1 : first + 1] == ("NORMAL", mode.name)
    # rounding of sums of inputs of order 1
    assert np.max(np.abs(np.diff(result.u, axis=0))) <= DU + 1e-12
    inside = np.abs(result.u[first + 3 : last])  # three periods of du_max from anywhere into the limits
    assert np.max(inside) <= 1.0 + 1e-12
    if mode is Mode.REST:
        assert np.max(inside) == 0.0
    expected = {Mode.FALLBACK: "FALLBACK", Mode.REST: "SAFE"}.get(mode, "MPC")
    assert set(result.source[first:last]) == {expected}
    assert set(result.source[last:]) == {"MPC"}
    assert np.all(np.isfinite(result.x))


def test_the_backup_continues_the_plan():
    # the same model as main and backup: the first input after the switch is nearly that of the loop without it
    model = pendulum_model()
    guard = Guard(backup=make_safe(model, du_max=DU), backup_estimator=make_ekf(model), dwell=0.1, quiet=0.1)
    arguments = {"duration": 1.2, "sensor_delay": 0}
    plain = run(model, make_safe(model, du_max=DU), **arguments)
    switched = run(
        model, make_safe(model, du_max=DU), guard=guard, monitor=ScriptedMonitor([(30, 32)]), **arguments
    )
    assert len(switched.switches) == 2
    # same estimate, same plan but for its last period, one iteration: 1e-3 of inputs of order 1
    np.testing.assert_allclose(switched.u, plain.u, atol=5e-3)


PATIENT = {"dwell": 0.1, "quiet": 0.2, "patience": 0.3}


@pytest.mark.parametrize(
    ("times", "alarms", "frozen", "switches"),
    [
        # to a more careful mode at once, back not before 0.3 s in each, and one period after the reading
        ({"dwell": 0.3, "quiet": 0.04}, [(10, 40)], [(15, 17)],
         [(11, Mode.BACKUP), (16, Mode.REST), (32, Mode.BACKUP), (48, Mode.NORMAL)]),
        # the last reading is that of period 11; ten periods of quiet, and the period after
        ({"dwell": 0.1, "quiet": 0.2}, [], [(10, 12)], [(11, Mode.REST), (22, Mode.NORMAL)]),
        # a flickering alarm does not flicker through
        ({"dwell": 0.1, "quiet": 0.2}, [(k, k + 1) for k in range(10, 40, 4)], [],
         [(11, Mode.BACKUP), (49, Mode.NORMAL)]),
        # a patient guard waits for what lasts: an alarm of 0.26 s with a gap in it, two of 0.18 s more than quiet
        # apart, one that lasts (the reading 15 periods after the first, plus one), and not for a sensor
        (PATIENT, [(10, 15), (20, 24)], [], []),
        (PATIENT, [(10, 20), (32, 42)], [], []),
        (PATIENT, [(10, 15), (20, 40)], [], [(26, Mode.BACKUP), (50, Mode.NORMAL)]),
        (PATIENT, [], [(10, 12)], [(11, Mode.REST), (22, Mode.NORMAL)]),
    ],
)  # fmt: skip
def test_when_the_guard_goes_over_and_back(times, alarms, frozen, switches):
    result = guarded(backup(**times), ScriptedMonitor(alarms, frozen))
    assert [(round(s.t / DT), s.after) for s in result.switches] == switches


def test_no_estimate_and_no_solve_are_survived_in_every_mode():
    for mode in (Mode.LIMITED, Mode.BACKUP, Mode.FALLBACK, Mode.REST):
        prior = pendulum_model()
        guard = Guard(
            mode, limits=Limits([-1.0], [1.0]), backup=make_safe(prior, du_max=DU), backup_estimator=make_ekf(prior),
            dwell=0.1, quiet=0.1,
        )  # fmt: skip
        result = guarded(
            guard, ScriptedMonitor([(10, 20)]), late=lambda t: round(t / DT) % 3 == 0,
            faults=[Fault(0.2, 0.5, "measurement_dropout")],
        )  # fmt: skip
        assert np.all(np.isfinite(result.u))
        assert np.max(np.abs(np.diff(result.u, axis=0))) <= DU + 1e-12


def test_a_frozen_encoder_brings_the_machine_to_rest():
    step = 2e-3

    @dataclass(frozen=True)
    class Counting:
        plant: PendulumPlant

        def measure(self, state, rng):
            return step * np.round(self.plant.measure(state, rng) / step)

        def __getattr__(self, name):
            return getattr(self.plant, name)

    model = pendulum_model()
    monitor = energy(model, resolution=[step])
    results = [
        run(model, make_safe(model, du_max=DU), plant=Counting(PendulumPlant(noise=0.0)), duration=3.0,
            monitor=monitor, guard=guard, faults=[Fault(1.0, np.inf, "measurement_freeze")])
        for guard in (None, Guard())
    ]  # fmt: skip
    free, held = results
    assert [s.after.name for s in held.switches] == ["REST"]
    assert held.switches[0].t < 1.2
    assert np.max(np.abs(held.u[-50:])) == 0.0
    # nobody drives it: it swings out from at most 0.5 rad; the loop that believes the sensor pushes on
    assert np.max(np.abs(held.x[:, 0])) < 0.7
    assert np.max(np.abs(free.x[:, 0])) > np.max(np.abs(held.x[:, 0]))
    assert np.sum(free.stage_cost) > np.sum(held.stage_cost)


def test_the_runner_does_the_same():
    rig, model = Rig(PendulumPlant(noise=0.0)), pendulum_model(3)
    runner = make_runner(
        model, make_safe(model, du_max=DU), rig, monitor=ScriptedMonitor([(20, 25)]), guard=backup(dwell=0.1, quiet=0.1)
    )  # fmt: skip
    report = runner.run(duration=1.0)
    assert [(round(s.t / DT), s.after) for s in report.switches] == [(21, Mode.BACKUP), (30, Mode.NORMAL)]
    assert np.max(np.abs(np.diff(report.u, axis=0))) <= DU + 1e-12
    assert runner.run(duration=0.2).switches == ()  # a run remembers nothing of another


def test_bad_input_is_refused():
    for words, arguments, times in (
        ("HM-LOOP-010", (), {"backup": make_safe(pendulum_model())}),
        ("HM-LOOP-011", (Mode.BACKUP,), {}),
        ("HM-LOOP-012", (Mode.LIMITED,), {}),
        ("HM-LOOP-013", (), {"dwell": -1.0}),
        ("HM-LOOP-013", (), {"patience": -1.0}),
        ("HM-LOOP-014", (), {"quiet": 0.0, "patience": 0.5}),
    ):
        with pytest.raises(InputError, match=words):
            Guard(*arguments, **times)
    with pytest.raises(InputError, match="HM-LOOP-019"):
        guarded(Guard(), None)
    model, prior = pendulum_model(3), pendulum_model()
    shorter = Guard(backup=make_safe(prior, horizon=10), backup_estimator=make_ekf(prior))
    with pytest.raises(InputError, match="HM-LOOP-016"):
        run(model, make_safe(model), guard=shorter, monitor=ScriptedMonitor())
    mixed = Guard(backup=make_safe(prior), backup_estimator=make_ekf(model))
    with pytest.raises(InputError, match="HM-LOOP-017"):
        run(model, make_safe(model), guard=mixed, monitor=ScriptedMonitor())
