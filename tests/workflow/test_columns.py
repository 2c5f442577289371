"""Columns that a user names on the command line in place of the scenario's."""

from dataclasses import replace
from pathlib import Path

from hybrid_mpc import load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings


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
