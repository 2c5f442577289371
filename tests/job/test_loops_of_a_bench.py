"""What a bench refuses, and how it holds what it has built."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import Bench, InputError, LoopSpec, Provenance, load, load_scenario

GOLF = load_scenario("golf_robot")
SPEC = LoopSpec("golf_robot", "mine", "track_sine", "hybrid_observer", duration=0.1)


@pytest.fixture(scope="module")
def kit(golf_artifact):
    return load(golf_artifact).with_noise({"hybrid_observer": np.array([1e-4, 2e-2])})


@pytest.fixture(scope="module")
def bench(kit):
    return Bench(GOLF, {"mine": kit})


def test_what_is_built_serves_again(bench):
    first, _ = bench.run(SPEC)
    built = bench.parts(SPEC)
    again, _ = bench.run(replace(SPEC, seed=0))
    assert again.cost == first.cost
    assert bench.parts(replace(SPEC, seed=5)) is built
    assert bench.parts(replace(SPEC, horizon=7))[1].controller.ocp.horizon == 7
    assert bench.parts(SPEC) is built


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"controller": "hybird"}, "did you mean 'hybrid'"),
        ({"solver": "newton"}, "no solver 'newton'"),
        ({"monitor": "energi"}, "did you mean 'energy'"),
        ({"guard": "run"}, "no guard 'run'"),
    ],
)
def test_names_are_checked_where_they_are_given(change, told):
    with pytest.raises(InputError, match=told):
        replace(SPEC, **change)


def test_what_is_not_there_is_named(bench):
    with pytest.raises(InputError, match="no model on the bench 'yours'"):
        bench.run(replace(SPEC, model="yours"))
    with pytest.raises(InputError, match="no task nothing; there are: track_sine"):
        bench.run(replace(SPEC, task="nothing"))
    with pytest.raises(InputError, match="without process noise for prior"):
        bench.run(replace(SPEC, controller="prior"))
    with pytest.raises(InputError, match="holds no detector"):
        bench.run(replace(SPEC, monitor="guard", guard="rest"))


def test_another_machine_s_model_is_refused(kit):
    with pytest.raises(InputError, match=r"model mine was made for scenario emps, not for golf_robot"):
        Bench(GOLF, {"mine": replace(kit, provenance=Provenance("emps"))})
    with pytest.raises(InputError, match="model mine holds hybrid; needed is a model prior"):
        Bench(GOLF, {"mine": replace(kit, models={"hybrid": kit.models["hybrid"]})})
    with pytest.raises(InputError, match="has no plant"):
        Bench(replace(GOLF, plant=None), {})


def test_a_guard_brings_its_monitor():
    assert LoopSpec("golf_robot", "mine", "track_sine", "hybrid_observer", guard="rest").monitor == "guard"
    assert LoopSpec("golf_robot", "mine", "track_sine", "hybrid_observer").monitor == "own"
    for change in ({"monitor": "own"}, {"monitor": "none"}, {"controller": "prior_observer"}):
        with pytest.raises(InputError, match="a guard acts on alarms"):
            LoopSpec(
                "golf_robot",
                "mine",
                "track_sine",
                **{"controller": "hybrid_observer", "guard": "rest", **change},
            )


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"seed": -1}, "whole numbers from 0 on, got -1"),
        ({"seed": 1.5}, "whole numbers"),
        ({"duration": float("nan")}, "positive number of seconds needed, got nan"),
        ({"keep": ("xx",)}, "no array to keep 'xx'"),
    ],
)
def test_numbers_are_checked_where_they_are_given(change, told):
    with pytest.raises(InputError, match=told):
        replace(SPEC, **change)


def test_a_loop_of_another_scenario_is_refused(bench):
    with pytest.raises(InputError, match="a loop of scenario emps given, the bench has golf_robot"):
        bench.run(replace(SPEC, scenario="emps"))


def test_a_backup_plans_as_far_as_its_loop(kit):
    bench = Bench(
        GOLF, {"mine": kit.with_noise({n: [1e-4, 2e-2] for n in ("hybrid_observer", "prior_observer")})}
    )
    spec = replace(SPEC, guard="prior", monitor="energy", controller="hybrid_observer")
    for horizon, solver in ((7, "rti"), (9, "rti"), (9, "sqp")):
        own = replace(spec, horizon=horizon, solver=solver)
        backup = bench.guard(own).backup
        assert backup.controller.ocp.horizon == horizon
        assert type(backup.controller) is type(bench.parts(own)[1].controller)
    adapts = bench.guard(replace(spec, guard="adapt", horizon=7))
    assert adapts.backup.controller.ocp.horizon == 7


def test_one_period_has_its_excess(bench):
    row, _ = bench.run(replace(SPEC, duration=0.02))
    assert row.seconds == pytest.approx(0.02)
    assert all(value == 0.0 for name, value in row.excess.items() if name.startswith(("u", "change")))


def test_plans_are_kept(bench):
    row, _ = bench.run(replace(SPEC, keep=("plans", "u")))
    assert len(row.arrays["plans"]) == len(row.arrays["u"]) > 0
