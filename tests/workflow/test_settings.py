"""Settings of a run: columns in place of the scenario's, and the device of the training."""

from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc import InputError, load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings, check_device


def test_units_and_delays_of_replaced_columns_are_left_out():
    golf = load_scenario("golf_robot")
    (u,), y = golf.data.inputs, golf.data.outputs
    own = replace(
        golf.data, units={u: 2.0, y[0]: "deg"}, delays={u: 0.1, y[0]: 0.2}, delays_of={"a": {u: 0.3}}
    )
    settings = RunSettings("golf_robot", (Path("a.csv"),), inputs=("other",))
    spec = Context(settings, replace(golf, data=own), Path()).spec
    assert spec.inputs == ("other",)
    assert (spec.units, spec.delays, spec.delays_of) == ({y[0]: "deg"}, {y[0]: 0.2}, {"a": {}})
    assert Context(RunSettings("golf_robot"), replace(golf, data=own), Path()).spec == own


def test_cpu_is_there():
    check_device("cpu")


@pytest.mark.parametrize("device", ["toaster", "cuda:77", "meta"])
def test_a_device_that_is_not_there_is_refused_by_name(device):
    with pytest.raises(InputError, match=rf"--device {device}: .*HM-WORKFLOW-036"):
        check_device(device)


@pytest.mark.parametrize("words", [("run", "golf_robot"), ("reproduce", "pendulum")])
def test_the_commands_refuse_it_before_they_make_a_folder(call, tmp_path, words):
    code, _, error = call(*words, "--device", "toaster", "--out", tmp_path / "out")
    assert code == 2
    assert "--device toaster" in error
    assert not (tmp_path / "out").exists()
