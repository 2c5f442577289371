"""What a bench refuses, and how it holds what it has built."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import Bench, Fault, InputError, LoopSpec, Provenance, load, load_scenario
from hybrid_mpc.compare.loops import read_rows, run_loops, write_rows

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
        ({"controller": "hybird"}, r"did you mean 'hybrid'.*HM-RECORDS-011"),
        ({"solver": "newton"}, r"solver.*'newton'.*HM-RECORDS-011"),
        ({"monitor": "energi"}, r"did you mean 'energy'.*HM-RECORDS-011"),
        ({"guard": "run"}, r"guard.*'run'.*HM-RECORDS-011"),
        ({"seed": -1}, r"-1.*HM-COMPARE-005"),
        ({"seed": 1.5}, "HM-COMPARE-005"),
        ({"duration": float("nan")}, r"nan.*HM-COMPARE-006"),
        ({"keep": ("xx",)}, r"array.*to keep 'xx'.*HM-RECORDS-011"),
        ({"faults": ("plant_friction=2@1",)}, r"faults.*HM-COMPARE-004"),
        ({"drawn_faults": Fault(0.0, 1.0, "input_gain", 0.5)}, r"drawn_faults.*HM-COMPARE-004"),
        ({"guard": "rest", "monitor": "own"}, "HM-COMPARE-003"),
        ({"guard": "rest", "monitor": "none"}, "HM-COMPARE-003"),
        ({"guard": "rest", "controller": "prior_observer"}, "HM-COMPARE-003"),
    ],
)
def test_a_specification_is_checked_where_it_is_given(change, told):
    with pytest.raises(InputError, match=told):
        replace(SPEC, **change)


def test_what_is_not_there_is_named(bench):
    with pytest.raises(InputError, match=r"model.*on the bench 'yours'.*HM-RECORDS-011"):
        bench.run(replace(SPEC, model="yours"))
    with pytest.raises(InputError, match=r"nothing.*track_sine.*HM-COMPARE-057"):
        bench.run(replace(SPEC, task="nothing"))
    with pytest.raises(InputError, match=r"prior.*HM-KIT-008"):
        bench.run(replace(SPEC, controller="prior"))
    with pytest.raises(InputError, match=r"energy.*HM-KIT-010"):
        bench.run(replace(SPEC, monitor="guard", guard="rest"))


def test_another_machine_s_model_is_refused(kit):
    with pytest.raises(InputError, match=r"model mine.*emps.*golf_robot.*HM-COMPARE-017"):
        Bench(GOLF, {"mine": replace(kit, provenance=Provenance("emps"))})
    with pytest.raises(InputError, match=r"model mine.*prior.*hybrid.*HM-COMPARE-016"):
        Bench(GOLF, {"mine": replace(kit, models={"hybrid": kit.models["hybrid"]})})
    with pytest.raises(InputError, match=r"control problem.*HM-COMPARE-015"):
        Bench(replace(GOLF, control=None), {})
    with pytest.raises(InputError, match=r"'golf_robot'.*HM-COMPARE-007"):
        Bench("golf_robot", {"mine": kit})
    with pytest.raises(InputError, match=r"Kit.*HM-COMPARE-008"):
        Bench(GOLF, kit)
    with pytest.raises(InputError, match=r"'mine'.*str.*HM-COMPARE-009"):
        Bench(GOLF, {"mine": "runs/mine"})


def test_rows_come_back_from_a_file_with_their_arrays(bench, tmp_path):
    specs, reports = [replace(SPEC, seed=seed, keep=("plans", "u")) for seed in (0, 1)], []
    rows = list(run_loops(bench, specs, lambda *given: reports.append(given)))
    assert reports[0] == (0, 10, "hybrid_observer, seed 0")
    assert reports[-1] == (10, 10, "")
    path = tmp_path / "loops" / "a.json"
    assert read_rows(path, "mine") is None
    write_rows(path, rows, "mine")
    found = read_rows(path, "mine")
    assert found == rows
    for one, other in zip(found, rows, strict=True):
        assert one.arrays.keys() == other.arrays.keys() == {"plans", "u"}
        assert all(np.array_equal(one.arrays[name], other.arrays[name]) for name in one.arrays)
    assert read_rows(path, "another's") is None
    path.write_text(path.read_text().replace('"seed": 1', '"seed": 2'))
    with pytest.raises(InputError, match="HM-FILES-004"):
        read_rows(path, "mine")


def test_a_guard_brings_its_monitor():
    assert LoopSpec("golf_robot", "mine", "track_sine", "hybrid_observer", guard="rest").monitor == "guard"
    assert LoopSpec("golf_robot", "mine", "track_sine", "hybrid_observer").monitor == "own"


def test_a_loop_of_another_scenario_is_refused(bench):
    with pytest.raises(InputError, match=r"emps.*golf_robot.*HM-COMPARE-010"):
        bench.run(replace(SPEC, scenario="emps"))


@pytest.mark.full
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
