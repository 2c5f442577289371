"""The runner among absurd numbers and failing callbacks, and what it refuses."""

from collections import Counter

import numpy as np
import pytest
from closed_loop_parts import DT, FakeClock, Rig, make_ekf, make_runner, sine
from online_models import pendulum_model

from hybrid_mpc.closed_loop import Runner
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation import TrueState

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


@pytest.mark.parametrize("where", ["measure", "actuate", "reference", "stop", "on_step"])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failing_callback_leaves_the_safe_input(model, safe, where, error):
    rig, calls = Rig(), Counter()

    def guard(name, function):
        def call(*arguments):
            calls[name] += 1
            if name == where and calls[name] == 9:
                raise error("cable")
            return function(*arguments)

        return call

    callbacks = [guard("measure", rig.measure), guard("actuate", rig.actuate)]
    runner = Runner(
        *callbacks, make_ekf(model), safe, guard("reference", sine), clock=FakeClock(),
        on_step=guard("on_step", lambda step: None), safe_input=[0.25],
    )  # fmt: skip
    with pytest.raises(error, match="cable"):
        runner.run(N * DT, stop=guard("stop", lambda: False))
    np.testing.assert_array_equal(rig.u[-1], [0.25])
    assert 7 <= len(rig.u) <= 10


def test_the_first_failure_is_raised_if_the_actuator_stays_broken(model, safe):
    rig = Rig()

    def broken(u):
        raise OSError(f"no actuator, attempt {len(rig.u)}")

    with pytest.raises(OSError, match="no actuator"):
        Runner(rig.measure, broken, make_ekf(model), safe, sine, clock=FakeClock()).run(1.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"deadline": 0.03}, "deadline must lie within the period"),
        ({"deadline": 0.0}, "deadline"),
        ({"safe_input": [7.0]}, "outside the limits"),
        ({"safe_input": [np.nan]}, "finite"),
        ({"input_delay": -1}, "input_delay"),
        ({"sensor_delay": 0.5}, "sensor_delay"),
        ({"keep": 0}, "keep"),
        ({"estimator": "prior"}, "same model"),
        ({"estimator": "truth"}, "TrueState"),
        ({"estimator": "slower"}, "period is 0.04"),
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
    with pytest.raises(InputError, match=r"measure\(\) returns has shape \(2,\)"):
        runner.run(1.0)
    assert len(rig.u) == 1
