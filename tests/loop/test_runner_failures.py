"""The runner among absurd numbers and failing callbacks, and what it refuses."""

from collections import Counter

import numpy as np
import pytest
from closed_loop_parts import DT, FakeClock, Rig, ScriptedMonitor, make_ekf, make_runner, sine
from online_models import pendulum_model

from hybrid_mpc import InputError, Runner, SafeInputError, TrueState
from hybrid_mpc.loop import realtime

N = 30


@pytest.mark.parametrize("absurd", [np.nan, np.inf, -np.inf, 1e300, -1e200])
def test_no_number_raises(model, safe, absurd):
    rig = Rig()

    def measure():
        y = rig.measure()
        return [absurd] if 5 <= len(rig.y) < 12 else y

    reference = lambda t: np.where((t > 0.4)[:, None], absurd, sine(t))  # noqa: E731
    runner = Runner(measure, rig.actuate, make_ekf(model), safe, reference, clock=FakeClock())
    report = runner.run(N * DT)
    assert report.periods == N
    assert np.all(np.abs(np.array(rig.u)) <= 6.0)  # finite and within the limits
    assert Counter(report.source) == report.sources


@pytest.mark.parametrize(
    "where", ["measure", "actuate", "reference", "weight", "stop", "on_step", "now", "sleep_until", "update"]
)
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("call", [1, 9])
def test_a_failing_callback_leaves_the_safe_input(model, safe, where, error, call):
    rig, clock, monitor, calls = Rig(), FakeClock(), ScriptedMonitor(), Counter()

    def guard(name, function):
        def call_it(*arguments):
            calls[name] += 1
            if name == where and calls[name] == call:
                raise error("cable")
            return function(*arguments)

        return call_it

    clock.now, clock.sleep_until = guard("now", clock.now), guard("sleep_until", clock.sleep_until)
    monitor.update = guard("update", monitor.update)
    runner = Runner(
        guard("measure", rig.measure), guard("actuate", rig.actuate), make_ekf(model), safe,
        guard("reference", sine), weight=guard("weight", lambda t: np.ones((len(t), 2))), clock=clock,
        monitor=monitor, on_step=guard("on_step", lambda step: None), safe_input=[0.25],
    )  # fmt: skip
    with pytest.raises(error, match="cable"):
        runner.run(N * DT, stop=guard("stop", lambda: False))
    assert calls[where] >= call
    np.testing.assert_array_equal(rig.u[-1], [0.25])
    assert [u[0] for u in rig.u].count(0.25) == 1
    assert len(rig.u) <= 10


def test_an_actuator_that_fails_for_a_while_gets_the_safe_input(model, safe):
    rig, failures = Rig(), [OSError("busy"), KeyboardInterrupt(), SystemExit()]

    def actuate(u):
        if len(rig.u) == 3 and failures:
            raise failures.pop(0)
        rig.actuate(u)

    with pytest.raises(OSError, match="busy"):  # what ended the run
        Runner(rig.measure, actuate, make_ekf(model), safe, sine, clock=FakeClock(), safe_input=[0.25]).run(1)
    assert not failures
    assert [u[0] for u in rig.u].index(0.25) == 3


@pytest.mark.parametrize(("ends", "why"), [("duration", "None"), ("measure", "cable"), ("actuate", "no bus")])
def test_an_actuator_that_stays_broken_is_reported_with_what_ended_the_run(
    model, safe, ends, why, monkeypatch
):
    monkeypatch.setattr(realtime, "PAUSES_S", (0.0, 0.0))
    rig = Rig()

    def measure():
        if ends == "measure" and len(rig.u) == 3:
            raise RuntimeError("cable")
        return rig.measure()

    def actuate(u):
        if u[0] == 0.25 or (ends == "actuate" and len(rig.u) == 3):
            raise OSError(f"no bus for {u[0]:.2f}")
        rig.actuate(u)

    runner = Runner(measure, actuate, make_ekf(model), safe, sine, clock=FakeClock(), safe_input=[0.25])
    words = "HM-LOOP-053"
    with pytest.raises(SafeInputError, match=words) as raised:
        runner.run(0.2)
    first = raised.value.__cause__
    assert (type(first), str(first)) == (OSError, "no bus for 0.25")
    assert why in str(first.__context__)


class Dead:
    """Clocks that are none, from an instant on."""

    def __init__(self, kind):
        self.kind, self.t, self.reads = kind, 5.0, 0

    def now(self):
        self.reads += 1
        dead = self.t > 5.0 + 3.5 * DT
        if dead and self.kind == "back":
            return 4.0
        if dead and self.kind == "nan":
            return np.nan
        if dead and self.kind == "infinite":
            return np.inf
        if dead and self.kind == "raises":
            raise OSError("no clock")
        if self.kind == "spins":  # time passes, but nobody waits
            self.t += 1e-6
        return self.t

    def sleep_until(self, t):
        stands = self.kind == "stands" and t > 5.0 + 3.5 * DT
        if not stands and self.kind not in ("spins", "never"):
            self.t = max(self.t, t)


@pytest.mark.parametrize(
    ("kind", "error", "words", "periods"),
    [
        ("never", InputError, r"5\.02.*10.*5\.0.*HM-LOOP-042", 1),
        ("spins", InputError, r"10.*HM-LOOP-042", 1),
        ("stands", InputError, r"5\.08.*10.*5\.06.*HM-LOOP-042", 4),
        ("back", InputError, r"5\.06.*4\.0.*HM-LOOP-041", 4),
        ("nan", InputError, r"nan.*HM-LOOP-040", 4),
        ("infinite", InputError, r"inf.*HM-LOOP-040", 4),
        ("raises", OSError, "no clock", 4),
    ],
)
@pytest.mark.parametrize("end", [{"duration": 3600.0}, {"stop": lambda: False}])
def test_on_a_dead_clock_the_run_ends(model, safe, kind, error, words, periods, end):
    rig = Rig()
    runner = Runner(
        rig.measure, rig.actuate, make_ekf(model), safe, sine, clock=Dead(kind), safe_input=[0.25]
    )
    with pytest.raises(error, match=words):
        runner.run(**end)
    assert len(rig.u) == periods + 1
    assert rig.u[-1] == [0.25]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"deadline": 0.03}, "HM-LOOP-035"),
        ({"deadline": 0.0}, "deadline"),
        ({"safe_input": [7.0]}, "HM-CONTROL-042"),
        ({"safe_input": [np.nan]}, "finite"),
        ({"input_delay": -1}, "input_delay"),
        ({"sensor_delay": 0.5}, "sensor_delay"),
        ({"keep": 0}, "keep"),
        ({"estimator": "prior"}, "HM-LOOP-025"),
        ({"estimator": "truth"}, "TrueState"),
        ({"estimator": "slower"}, r"0\.04.*HM-LOOP-026"),
    ],
)
def test_bad_arguments_are_refused(model, safe, change, words):
    estimators = {
        "prior": lambda: make_ekf(pendulum_model()),
        "truth": lambda: TrueState(model),
        "slower": lambda: make_ekf(pendulum_model(z=2, dt=0.04)),
    }
    if "estimator" in change:
        change = {"estimator": estimators[change["estimator"]]()}
    with pytest.raises(InputError, match=words):
        make_runner(model, safe, Rig(), **change)


@pytest.mark.parametrize(("duration", "stop"), [(None, None), (0.0, None), (np.nan, None), (np.inf, None)])
def test_a_run_needs_an_end(model, safe, duration, stop):
    with pytest.raises(InputError, match=r"duration"):
        make_runner(model, safe, Rig()).run(duration, stop)


def test_a_measurement_of_another_shape_is_refused_after_the_safe_input(model, safe):
    rig = Rig()
    runner = Runner(lambda: [0.0, 0.0], rig.actuate, make_ekf(model), safe, sine, clock=FakeClock())
    with pytest.raises(InputError, match=r"measure\(\) returns.*\(2,\).*HM-MODEL-019"):
        runner.run(1.0)
    assert len(rig.u) == 1
