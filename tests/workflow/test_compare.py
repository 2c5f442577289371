"""What the closed loops of a run are summed up to, and what they are made of."""

import math
import shutil
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop_parts import loop_row

from hybrid_mpc import InputError, RunSettings, Signal, load, load_scenario, set_limits, set_process_noise
from hybrid_mpc.compare.controllers import COMPARED, CONTROLLERS, ORACLES
from hybrid_mpc.compare.loops import MODEL, LoopSpec, limits_used
from hybrid_mpc.compare.sequential import looks
from hybrid_mpc.compare.summary import by_task, interval, summaries
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stages import compare as stage
from hybrid_mpc.workflow.stages.compare import (
    TIMED,
    _seeds,
    compare,
    control_stage,
    gap_closed,
    parts_of,
    run_specs,
)

GOLF = load_scenario("golf_robot")
SIGNALS = SimpleNamespace(
    inputs=(Signal("tau", "N m"),), states=(Signal("phi", "rad"), Signal("phi_dot", "rad/s")),
    outputs=(Signal("phi", "rad"),), x0=np.zeros(2), u0=np.zeros(1), n_y=1,
)  # fmt: skip


def cells(**costs):
    return {
        name: [loop_row(controller=name, seed=i, cost=cost) for i, cost in enumerate(values)]
        for name, values in costs.items()
    }


def test_gap_is_measured_from_the_better_baseline():
    found = cells(
        prior=[3.0, 3.0],
        prior_observer=[2.0, 2.0],
        hybrid=[0.0, 0.0],
        hybrid_observer=[1.25, 1.25],
        oracle=[1.0, 1.0],
    )
    assert gap_closed(found) == (pytest.approx(0.75), "")
    found |= cells(hybrid_observer=[2.5, 2.5])  # worse than the baseline shows as a negative share
    assert gap_closed(found)[0] == pytest.approx(-0.5)


def test_gap_needs_a_baseline_and_an_oracle_that_differ():
    # means 1.5 and 1, standard errors sqrt(0.5 / 2) = 0.5 and 0: the distance is below twice the error
    noisy = cells(prior=[1.0, 2.0], prior_observer=[9.0, 9.0], hybrid_observer=[1.0, 1.0], oracle=[1.0, 1.0])
    value, why = gap_closed(noisy)
    assert value is None
    assert "do not differ" in why
    single = {**noisy, **cells(oracle=[0.1])}
    assert gap_closed(single)[0] is None
    assert "standard error" in gap_closed(single)[1]
    assert gap_closed(cells(prior=[1.0], prior_observer=[1.0], hybrid_observer=[1.0])) == (
        None,
        "no oracle ran",
    )


def test_an_interval_is_student_s_and_none_for_one_value():
    # n = 2: t(0.975, 1) = 12.706, standard error 0.5
    assert interval([1.0, 2.0]).ci95 == pytest.approx(12.706 * 0.5, rel=1e-4)
    assert interval([1.0]).ci95 is None
    assert interval([1.0, np.inf]) == interval([np.inf, np.nan])  # neither has a mean
    assert interval([]).mean is None


def test_rows_become_tables():
    rows = [
        loop_row(
            seed=i,
            cost=c,
            tracking_rmse={"phi [rad]": 0.1},
            figures={"speed_error_rel": e},
            limits={"u": 0.5 + i},
        )
        for i, (c, e) in enumerate(((1.0, -0.02), (3.0, 0.04)))
    ]
    assert [r.cost for r in by_task(rows)["a"]["prior"]] == [1.0, 3.0]
    found = summaries(rows)["a"]["prior"]
    assert (found.cost.mean, found.cost.n) == (2.0, 2)
    assert found.tracking_rmse["phi [rad]"].mean == pytest.approx(0.1)
    assert found.figures["speed_error_rel"].mean == pytest.approx(0.01)
    assert found.mean_abs_figures["speed_error_rel"].mean == pytest.approx(0.03)
    assert found.sources["MPC"] == 1.0
    assert found.limits == {"u": 1.5}
    # a stroke that never came is not averaged away
    lost = [rows[0], replace(rows[1], figures={"speed_error_rel": np.inf})]
    assert summaries(lost)["a"]["prior"].mean_abs_figures["speed_error_rel"].mean is None


def test_limits_are_shares_of_the_side_that_they_bound():
    control = GOLF.control.changed(
        u_min=(-0.2,), u_max=(0.5,), du_max=(0.4,), x_min=(-1.0, -np.inf), x_max=(2.0, np.inf)
    )
    loop = SimpleNamespace(
        u=np.array([[0.1], [0.25], [-0.1]]), x=np.array([[0.5, 9.0], [-0.75, 0.0], [1.0, 0.0]])
    )
    used = limits_used(control, loop, SIGNALS)
    assert used == {
        "tau": pytest.approx(0.5),
        "change of tau": pytest.approx(0.875),
        "phi": pytest.approx(0.75),
    }


@pytest.mark.parametrize(
    ("u_min", "u_max", "u", "shares"),
    [(0.0, 5.0, [0.0, 2.5, 0.0], (0.5, 0.625)), (-5.0, 0.0, [0.0, -2.5, 0.0], (0.5, 0.625)),
     (2.0, 5.0, [2.0, 3.5, 2.0], (0.5, 0.375)), (-5.0, -2.0, [-2.0, -3.5, -2.0], (0.5, 0.375))],
)  # fmt: skip
def test_limits_beside_zero_are_used_from_rest_on(u_min, u_max, u, shares):
    control = GOLF.control.changed(
        u_min=(u_min,), u_max=(u_max,), du_max=(4.0,), x_min=None, x_max=(2.0, np.inf)
    )
    used = limits_used(
        control, SimpleNamespace(u=np.array(u)[:, None], x=np.array([[1.0, 9.0], [-7.0, 0.0]])), SIGNALS
    )
    assert used == pytest.approx({"tau": shares[0], "change of tau": shares[1], "phi": 0.5})


def test_tasks_are_found_by_name():
    assert tasks_of(GOLF, None) == GOLF.tasks
    assert [t.name for t in tasks_of(GOLF, ("stroke_3", "track_sine"))] == ["stroke_3", "track_sine"]
    with pytest.raises(InputError, match=r"nothing.*track_sine.*HM-COMPARE-057"):
        tasks_of(GOLF, ("nothing",))
    for budget in GOLF.budgets.values():
        tasks_of(GOLF, budget.tasks)


def test_parts_are_every_loop_once_and_the_timed_ones_come_first():
    budget = GOLF.budgets["full"]
    parts = parts_of(GOLF, GOLF.tasks, budget, range(budget.seeds))
    loops = [(p.task.name, p.controller, seed) for p in parts for seed in p.seeds]
    per_task = sum(_seeds(n, GOLF, budget.seeds, budget.oracle_seeds) for n in COMPARED)
    assert len(loops) == len(set(loops)) == per_task * len(GOLF.tasks)
    assert len({p.stage for p in parts}) == len(parts)
    assert [p.timed for p in parts] == sorted((p.timed for p in parts), reverse=True)
    assert all(len(p.seeds) == 1 for p in parts if p.controller in ORACLES)  # a kill loses one slow loop


def test_parts_of_all_looks_are_those_of_one():
    budget = GOLF.budgets["full"]
    bounds = [0, *looks(budget.seeds)]
    parts = [part for a, b in pairwise(bounds) for part in parts_of(GOLF, GOLF.tasks, budget, range(a, b))]
    loops = {(p.task.name, p.controller, seed) for p in parts for seed in p.seeds}
    whole = parts_of(GOLF, GOLF.tasks, budget, range(budget.seeds))
    assert loops == {(p.task.name, p.controller, seed) for p in whole for seed in p.seeds}
    assert sum(len(p.seeds) for p in parts) == len(loops)
    assert len({p.stage for p in parts}) == len(parts)


def test_a_task_that_is_decided_runs_no_further(monkeypatch):
    """Track_sine is decided at the first look of six seeds; the stroke's costs scatter, so it goes on to the last."""
    tasks, asked = ("track_sine", "stroke_3"), []
    budget = replace(GOLF.budgets["quick"], seeds=9, oracle_seeds=1, tasks=tasks)

    def run(context, specs, *, alone):
        asked.append({spec.task for own in specs.values() for spec in own})
        rng = np.random.default_rng(0)
        return {part: [loop_row(
            task=s.task, controller=s.controller, seed=s.seed,
            cost=(0.5 if (s.task, s.controller) == ("track_sine", "hybrid_observer") else 1.0)
            * math.exp(rng.normal(0.0, 0.01 if s.task == "track_sine" else 1.0)),
        ) for s in own] for part, own in specs.items()}  # fmt: skip

    monkeypatch.setattr("hybrid_mpc.workflow.stages.compare.run_or_read", run)
    context = SimpleNamespace(scenario=GOLF, budget=budget, settings=RunSettings("golf_robot"))
    table = by_task(compare(context))
    assert asked == [set(tasks), {"stroke_3"}]
    assert list(table) == list(tasks)
    for task, n in (("track_sine", 6), ("stroke_3", 9)):
        assert [row.seed for row in table[task]["hybrid_observer"]] == list(range(n))
        assert len(table[task]["prior"]) == n
        assert len(table[task]["oracle"]) == budget.oracle_seeds


def test_every_controller_runs_and_oracles_less_often():
    assert [_seeds(n, GOLF, 10, 2) for n in COMPARED] == [10, 10, 10, 10, 2, 1]
    assert [_seeds(n, GOLF, 10, 10) for n in COMPARED] == [10, 10, 10, 10, 10, 1]
    assert set(ORACLES) < set(COMPARED)
    own = [CONTROLLERS[name] for name in COMPARED]
    assert len({(c.model, c.observer, c.truth) for c in own}) == len(own)


SHORT = """
from dataclasses import replace
from hybrid_mpc import Budget
from scenarios.golf_robot import scenario
task = replace(scenario.tasks[0], name="short", duration=0.2)
budget = Budget(hidden=8, networks=1, teacher_steps=1, free_run_steps=1, seeds=2)
scenario = replace(scenario, tasks=(task,), oracle=None, budgets={"quick": budget})
"""


@pytest.mark.full
def test_a_comparison_that_was_killed_goes_on_from_what_it_kept(golf_artifact, jobs_here, tmp_path):
    out, file = tmp_path / "run", tmp_path / "short.py"
    file.write_text(SHORT)
    shutil.copytree(golf_artifact, out / "model")
    scenario = load_scenario(str(file))
    context = Context(RunSettings(str(file)), scenario, out)
    set_process_noise(out / "model", {name: np.array([1e-4, 1e-2]) for name in COMPARED})
    rows = compare(context)
    assert [(r.controller, r.seed) for r in rows] == [
        (name, seed) for name in sorted(set(COMPARED) - set(ORACLES)) for seed in (0, 1)
    ]
    kept = sorted((out / "checkpoints" / "loops").glob("*.json"))
    assert len(kept) == 6  # two timed loops, what is left of their controllers, and two controllers whole
    for lost in kept[1::3]:  # as a kill in between leaves them: arrays perhaps, but no JSON
        lost.unlink()
    stamps = {path: path.stat().st_mtime_ns for path in kept if path.exists()}
    again = compare(context)
    untimed = [[replace(r, timing_ms={}) for r in found] for found in (rows, again)]
    assert untimed[0] == untimed[1]
    for one, other in zip(rows, again, strict=True):
        assert one.arrays.keys() == other.arrays.keys()
        assert ("plans" in one.arrays) == (one.controller in TIMED and one.seed == 0)
        for key in one.arrays:
            if key != "step_ms":
                np.testing.assert_array_equal(one.arrays[key], other.arrays[key])
    assert all(path.is_file() for path in kept)
    assert stamps == {path: path.stat().st_mtime_ns for path in stamps}
    set_process_noise(out / "model", {name: np.array([1e-4, 2e-2]) for name in COMPARED})
    other = compare(context)  # loops of another filter: none of those that are kept
    assert [r.controller for r in other] == [r.controller for r in rows]
    assert all(a.cost != b.cost for a, b in zip(other, rows, strict=True))


def test_loops_leave_the_limits_in_the_artifact_and_do_not_depend_on_them(run_folder, tmp_path, monkeypatch):
    out = shutil.copytree(run_folder, tmp_path / "run")
    context = Context(RunSettings("golf_robot", budget="quick"), GOLF, out)
    learned = load(out).limits("hybrid")
    spec = LoopSpec("golf_robot", MODEL, "track_sine", "hybrid_observer", duration=0.5, keep=("step_ms",))
    monkeypatch.setattr(type(context), "read", lambda self, stage: None)
    monkeypatch.setattr(stage, "compare", lambda context: run_specs("golf_robot", out / "model", [spec]))
    found = []
    for rest in ((0.3,), (0.02,)):
        limits = replace(learned, rest_speed=rest)
        set_limits(out / "model", {"hybrid": [limits]})
        found.append(control_stage(context).rows[0])
        assert load(out).limits("hybrid") == limits
    assert found[0].largest_violation > 0
    assert found[0].largest_violation == found[1].largest_violation
