"""Faults: what each does, when it acts, and what a loop makes of it."""

import numpy as np
import pytest
from closed_loop_parts import Recorder, run
from online_models import PendulumPlant

from hybrid_mpc import Fault, InputError, check_plant_faults, corrupt_input, corrupt_measurement
from hybrid_mpc.loop.faults import check_channels, fault_text, install, parsed_fault

Y, BEFORE = np.array([1.0, 2.0]), np.array([7.0, 8.0])
NAMES = "first", "second"


@pytest.mark.parametrize(
    ("target", "channel", "want"),
    [
        ("measurement_offset", 0, [1.5, 2.0]),
        ("measurement_offset", 1, [1.0, 2.5]),
        ("measurement_scale", 1, [1.0, 1.0]),
        ("measurement_freeze", 1, [1.0, 8.0]),
        ("measurement_dropout", 0, [np.nan, 2.0]),
        ("input_gain", 0, [1.0, 2.0]),
    ],
)
def test_measurement_faults(target, channel, want):
    fault = Fault(1.0, 2.0, target, 0.5, NAMES[channel])
    np.testing.assert_array_equal(corrupt_measurement([fault], 1.5, Y, BEFORE, NAMES), want)
    np.testing.assert_array_equal(corrupt_measurement([fault], 2.5, Y, BEFORE, NAMES), Y)
    np.testing.assert_array_equal(Y, [1.0, 2.0])  # the argument is left alone


@pytest.mark.parametrize(
    ("target", "channel", "want"),
    [("input_gain", 1, [1.0, 1.0]), ("input_offset", 0, [1.5, 2.0]), ("measurement_offset", 0, [1.0, 2.0])],
)
def test_input_faults(target, channel, want):
    fault = Fault(1.0, 2.0, target, 0.5, NAMES[channel])
    np.testing.assert_array_equal(corrupt_input([fault], 1.5, Y, NAMES), want)
    np.testing.assert_array_equal(corrupt_input([fault], 0.5, Y, NAMES), Y)
    np.testing.assert_array_equal(Y, [1.0, 2.0])


def test_faults_act_in_their_order():
    gain, offset = Fault(0.0, 1.0, "input_gain", 2.0), Fault(0.0, 1.0, "input_offset", 1.0)
    assert corrupt_input([gain, offset], 0.0, np.array([3.0]))[0] == 7.0
    assert corrupt_input([offset, gain], 0.0, np.array([3.0]))[0] == 8.0


def test_start_counts_and_end_does_not_in_spite_of_rounding():
    t = 0.0  # summed up period by period, as a user's own loop would
    for k in range(2000):
        fault = Fault(k * 0.02, (k + 1) * 0.02, "input_offset", 1.0)
        assert [fault.active(0.02 * i) for i in range(k - 1, k + 3)] == [False, True, False, False]
        assert fault.active(t)
        t += 0.02
        assert not fault.active(t)
    assert Fault(0.0, np.inf, "input_gain", 0.0).active(1e9)  # for ever


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0, 1.0, "sensor_offset"), "measurement_offset"),
        ((1.0, 1.0, "input_gain"), "empty"),
        ((2.0, 1.0, "input_gain"), "empty"),
        ((np.nan, 1.0, "input_gain"), "start"),
        ((0.0, 1.0, "input_gain", np.nan), "finite"),
        ((0.0, 1.0, "input_gain", np.inf), "finite"),
        ((0.0, 1.0, "input_gain", 1.0, "", -1.0), "ramp"),
        ((0.0, 1.0, "input_gain", 1.0, 1), "channel"),
        ((0.0, 1.0, "inputs", 1.0), "plant_"),
    ],
)
def test_bad_faults_are_refused(arguments, words):
    with pytest.raises(InputError, match=words):
        Fault(*arguments)


@pytest.mark.parametrize(
    ("target", "channel", "words"),
    [
        ("input_gain", "valve", r"input.*'valve'.*power.*HM-LOOP-004"),
        ("measurement_offset", "power", r"output.*'power'.*level, flow.*HM-LOOP-004"),
        ("measurement_freeze", "", r"output.*level, flow.*level.*HM-LOOP-003"),
    ],
)
def test_channels_that_do_not_exist_are_refused(target, channel, words):
    names = ("level", "flow"), ("power",)
    check_channels([Fault(0.0, 1.0, "measurement_offset", channel="flow")], *names)
    check_channels([Fault(0.0, 1.0, "input_gain")], *names)  # the only one
    with pytest.raises(InputError, match=words):
        check_channels([Fault(0.0, 1.0, target, channel=channel)], *names)


def test_texts_name_channels_and_are_read_back():
    text = "measurement_offset:flow=0.5@1:2 + input_gain=0.8@0"
    assert fault_text([parsed_fault(part) for part in text.split(" + ")]) == text
    assert parsed_fault("measurement_freeze:level@3").channel == "level"


@pytest.mark.parametrize(
    ("target", "value", "want"),
    [
        ("measurement_offset", 0.4, [0.0, 0.1, 0.2, 0.4, 0.4]),
        ("measurement_scale", 1.4, [0.0, 0.1, 0.2, 0.4, 0.4]),
        ("input_offset", -0.8, [0.0, -0.2, -0.4, -0.8, -0.8]),
        ("input_gain", 0.6, [0.0, -0.1, -0.2, -0.4, -0.4]),
    ],
)
def test_a_ramp_grows_from_nothing_in_proportion(target, value, want):
    fault, one = Fault(2.0, 99.0, target, value, ramp=4.0), np.ones(1)
    times = (2.0, 3.0, 4.0, 6.0, 50.0)
    if fault.on_input:
        seen = [corrupt_input([fault], t, one)[0] - 1 for t in times]
    else:
        seen = [corrupt_measurement([fault], t, one, one)[0] - 1 for t in times]
    np.testing.assert_allclose(seen, want, atol=1e-15)


class BreakablePlant:
    def __init__(self, faults=()):
        self.faults = faults

    def with_faults(self, faults):
        check_plant_faults(faults, ["plant_load"])
        return BreakablePlant(tuple(faults))


def test_install_builds_the_plant_s_faults_in_and_leaves_the_rest():
    load, gain = Fault(0.0, 1.0, "plant_load", 2.0), Fault(0.0, 1.0, "input_gain", 0.5)
    plant, rest = install(BreakablePlant(), [gain, load])
    assert plant.faults == (load,)
    assert rest == (gain,)
    same = BreakablePlant()
    assert install(same, [gain]) == (same, (gain,))
    with pytest.raises(InputError, match=r"plant_load.*HM-LOOP-005"):
        install(BreakablePlant(), [Fault(0.0, 1.0, "plant_lode", 2.0)])
    with pytest.raises(InputError, match="HM-LOOP-006"):
        install(PendulumPlant(), [load])


def test_a_plant_s_fault_is_not_silently_ignored_by_a_loop(model, safe):
    with pytest.raises(InputError, match="HM-LOOP-006"):
        run(model, safe, faults=[Fault(0.0, 1.0, "plant_load", 2.0)])


def test_input_faults_act_behind_the_controller_when_they_say(model, safe):
    inputs = []
    faults = [Fault(0.1, 0.3, "input_gain", 0.25), Fault(0.2, 0.4, "input_offset", 0.5)]
    result = run(model, safe, plant=Recorder(PendulumPlant(), inputs), faults=faults)
    applied, u, k = np.array(inputs)[:, 0], result.u[:, 0], np.arange(30)
    want = np.where((k >= 5) & (k < 15), 0.25 * u, u) + np.where((k >= 10) & (k < 20), 0.5, 0.0)
    np.testing.assert_array_equal(applied, want)


@pytest.mark.parametrize(
    ("target", "change"),
    [
        ("measurement_offset", lambda y, free, k: free + 0.3),
        ("measurement_freeze", lambda y, free, k: np.full(len(k), y[9])),
        ("measurement_dropout", lambda y, free, k: np.full(len(k), np.nan)),
    ],
)
def test_measurement_faults_act_when_they_say(model, safe, target, change):
    sensed = []

    class Sensed(PendulumPlant):
        def measure(self, state, rng):
            sensed.append(super().measure(state, rng))
            return sensed[-1]

    y = run(model, safe, plant=Sensed(), faults=[Fault(0.2, 0.4, target, 0.3)]).y[:, 0]
    free, k = np.array(sensed)[:, 0], np.arange(10, 20)
    np.testing.assert_array_equal(y[k], change(y, free[k], k))
    rest = np.setdiff1d(np.arange(30), k)
    np.testing.assert_array_equal(y[rest], free[rest])
