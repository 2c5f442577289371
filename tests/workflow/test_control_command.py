"""``hybrid-mpc control``: loops of an artifact without training, and what it refuses."""

import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hybrid_mpc import (
    Bench,
    ChannelLimit,
    Fault,
    InputError,
    Study,
    WatchLimits,
    load_scenario,
    set_limits,
    set_process_noise,
)
from hybrid_mpc.compare.study_run import load_models
from hybrid_mpc.compare.tasks import selected_tasks
from hybrid_mpc.loop.faults import parsed_fault
from hybrid_mpc.records import record
from hybrid_mpc.workflow.control import read_control

GOLF = load_scenario("golf_robot")
MINE = """
import dataclasses
from scenarios.golf_robot import scenario as golf
scenario = dataclasses.replace(golf, {change})
"""


SHORT = "tasks=tuple(dataclasses.replace(task, duration=2.5) for task in golf.tasks)"


@pytest.fixture
def short(tmp_path):
    """The golf robot with tasks of 2.5 s."""
    (tmp_path / "short.py").write_text(MINE.format(change=SHORT))
    return tmp_path / "short.py"


@pytest.fixture
def call(call):
    """Run the command in this process: ``(exit code, stdout, stderr)``."""
    return partial(call, "control")


def test_loops_of_two_controllers(call, run_folder, tmp_path):
    out = tmp_path / "loops"
    words = ["--task", "stroke_1.4", "--controller", "prior", "--controller", "hybrid_observer", "--seeds", 2]
    code, told, _ = call("golf_robot", "--model", run_folder, "--out", out, *words)
    assert code == 0
    assert "hybrid_observer" in told
    results = read_control(out / "results.json")
    assert results.note.study["solvers"] == ["rti"]
    (model,) = results.note.models.values()
    assert model.noise.source == "the model's own"
    assert set(model.noise.sigma_x) == {"prior", "hybrid_observer"}
    assert [(r.controller, r.seed) for r in results.loops.rows] == [
        ("prior", 0), ("prior", 1), ("hybrid_observer", 0), ("hybrid_observer", 1),
    ]  # fmt: skip
    cell = results.loops.means["stroke_1.4"]["prior"]
    costs = [r.cost for r in results.loops.rows if r.controller == "prior"]
    # Two values: mean +- t(0.975, 1) |difference| / 2, the table's t is 12.7062.
    assert cell.cost.mean == pytest.approx(np.mean(costs), rel=1e-12)
    assert cell.cost.ci95 == pytest.approx(12.7062 * abs(costs[0] - costs[1]) / 2, rel=1e-5)
    assert {"speed_error_rel", "timing_error_s"} <= set(cell.figures)
    assert sum(cell.sources.values()) == pytest.approx(1.0)
    times = results.step_ms["prior"]
    assert 0 < times.median <= times.p95 <= times.p99 <= times.max
    assert times.period == pytest.approx(20.0)
    assert all(v <= 0.2 for r in results.loops.rows for v in r.largest_u.values())  # a putt's limit
    drawn = {p.name for p in (out / "figures").iterdir()}
    assert drawn == {"stroke_1.4.png", "stroke_1.4.gif", "step_times.png"}
    again = tmp_path / "again"
    words = [*words[:4], *words[6:]]  # without the hybrid
    assert call("golf_robot", "--model", run_folder / "model", "--out", again, "--no-gif", *words)[0] == 0
    assert not (again / "figures" / "stroke_1.4.gif").exists()
    repeated = read_control(again / "results.json")
    first, second = (
        [replace(r, timing_ms={}) for r in rows[:2]] for rows in (results.loops.rows, repeated.loops.rows)
    )
    assert first == second
    assert "arrays" not in (again / "results.json").read_text()
    assert repeated.loops.means["stroke_1.4"]["prior"] == cell


@pytest.mark.full
def test_ctrl_c_loses_no_finished_loop(call, run_folder, tmp_path, monkeypatch):
    out, real, begun = tmp_path / "loops", Bench.run, []

    def stopped(self, spec, **more):
        begun.append(spec.seed)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return real(self, spec, **more)

    words = [
        "golf_robot",
        "--model",
        run_folder,
        "--out",
        out,
        "--task",
        "stroke_1.4",
        "--controller",
        "prior",
    ]
    words += ["--seeds", 2, "--no-gif"]
    monkeypatch.setattr(Bench, "run", stopped)
    code, _, error = call(*words)
    assert (code, "--resume" in error) == (130, True)
    code, _, error = call(*words)
    assert (code, "already contains a control" in error) == (2, True)
    code, _, error = call(*words[:-2], 3, "--no-gif", "--resume")
    assert (code, "seeds differ" in error) == (2, True)
    assert call(*words, "--resume")[0] == 0
    assert begun == [0, 1, 1]
    results = read_control(out / "results.json")
    assert [row.seed for row in results.loops.rows] == [0, 1]
    assert results.step_ms["prior"].median > 0


def test_a_fault_from_the_command_line_acts(call, short, run_folder, tmp_path):
    costs = {}
    for name, words in (("healthy", []), ("worn", ["--fault", "plant_friction=4@0.5"])):
        out = tmp_path / name
        options = ["--task", "track_sine", "--controller", "prior", "--seeds", 1, "--no-gif", *words]
        assert call(short, "--model", run_folder, "--out", out, *options)[0] == 0
        results = read_control(out / "results.json")
        costs[name] = results.loops.rows[0].cost
    ((fault,),) = results.note.study["faults"]
    assert record(Fault, fault, "") == Fault(0.5, np.inf, "plant_friction", 4.0)
    assert results.note.study["guard"] == ""
    assert results.loops.rows[0].alarms is None  # nothing could alarm
    assert results.loops.rows[0].switches == ()
    assert costs["worn"] > 2 * costs["healthy"]  # four times the friction on a filter without observer
    assert results.loops.means["track_sine"]["prior"].cost.ci95 is None  # one seed


def test_a_guarded_loop_lets_go_of_a_frozen_sensor(call, short, run_folder, tmp_path):
    folder = shutil.copytree(run_folder, tmp_path / "run")
    # Wide scales: only the test for freezing is to speak.
    force = ChannelLimit("force of phi", "N m", 0, 50.0, 25.0, (9.0, 0.0, 0.0, 0.0), 2.0)
    limits = WatchLimits("energy", 0.02, (force,), (5e-3,), (0,), 1.0)
    (folder / "model" / "watch" / "hybrid.json").unlink()
    options = ["--task", "track_sine", "--seeds", 1, "--no-gif", "--fault", "measurement_freeze@1"]
    words = [short, "--model", folder, "--out"]
    code, _, error = call(*words, tmp_path / "none", *options, "--guard")
    assert (code, "HM-KIT-010" in error) == (2, True)
    set_limits(folder / "model", {"hybrid": [limits]})
    code, told, _ = call(*words, tmp_path / "guarded", *options, "--guard")
    assert code == 0
    assert "rest from" in told
    results = read_control(tmp_path / "guarded" / "results.json")
    assert results.note.study["guard"] == "rest"
    (loop,) = results.loops.rows
    assert loop.controller == "hybrid_observer"  # what the guard watches, where none is named
    assert loop.switches[0].after == "REST"
    assert 1.0 <= loop.alarms[0].start_s < 1.5  # in motion: three steps are predicted at once
    assert loop.sources["SAFE"] > 0.5


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--guard", "--controller", "prior"], ["controller prior has another model", "hybrid_observer"]),
        (["--adapt", "--controller", "prior"], ["controller prior has another model", "hybrid_observer"]),
        (["--task", "golf"], ["HM-COMPARE-058", "track_sine", "stroke_1.4"]),
        (["--controller", "pid"], ["no controller 'pid'", "hybrid_observer"]),
        (["--solver", "newton"], ["no solver 'newton'", "rti, native, sqp, ipopt"]),
        (["--controller", "oracle", "--solver", "sqp"], ["oracle", "its own solver"]),
        (["--fault", "fire=1"], ["'fire'", "measurement_offset"]),
        (["--fault", "plant_fire=1@1"], ["plant_fire", "plant_friction"]),
        (["--fault", "input_gain=lots"], ["input_gain=lots", "TARGET:CHANNEL=VALUE@START:END"]),
        (["--fault", "input_gain=0.5@2:1"], ["interval"]),
        (["--seeds", "0"], ["seeds"]),
    ],
)
def test_bad_options(call, run_folder, tmp_path, words, told):
    code, _, error = call("golf_robot", "--model", run_folder, "--out", tmp_path / "o", *words)
    assert code == 2
    for word in told:
        assert word in error
    assert not (tmp_path / "o").exists()


def test_bad_models(call, run_folder, tmp_path):
    code, _, error = call("golf_robot", "--model", tmp_path / "none", "--out", tmp_path / "o")
    assert (code, "none: does not exist" in error) == (2, True)
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("dear")
    code, _, error = call("golf_robot", "--model", tmp_path / "letters", "--out", tmp_path / "o")
    assert (code, "HM-KIT-038" in error) == (2, True)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [("plant=None", "HM-COMPARE-014"), ("control=None", "HM-COMPARE-015"),
     ("tasks=()", "no task"),
     ("make_data=None", "HM-COMPARE-002"), ("oracle=None", "has no oracle")],
)  # fmt: skip
def test_scenarios_without_what_is_needed(call, golf_artifact, tmp_path, change, told):
    path = tmp_path / "machine.py"
    path.write_text(MINE.format(change=change))
    words = ["--controller", "oracle"] if "oracle" in change else []
    code, _, error = call(path, "--model", golf_artifact, "--out", tmp_path / "o", *words)
    assert code == 2
    assert told in error


def test_noise_that_does_not_fit(call, run_folder, tmp_path):
    folder = shutil.copytree(run_folder / "model", tmp_path / "model")
    set_process_noise(folder, {"prior_observer": [1e-3], "hybrid_observer": [1e-4, 2e-2]})
    code, _, error = call("golf_robot", "--model", folder, "--out", tmp_path / "o")
    assert (code, "HM-KIT-009" in error) == (2, True)


def test_the_folder_must_be_empty(call, run_folder, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    code, _, error = call("golf_robot", "--model", run_folder, "--out", tmp_path)
    assert code == 2
    assert "not the folder of a control" in error
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_names_and_beginnings_of_tasks():
    names = lambda *given: [t.name for t in selected_tasks(GOLF, given)]  # noqa: E731
    assert len(names()) == len(GOLF.tasks)
    assert all(name.startswith("stroke_") for name in names("stroke"))
    assert len(names("stroke")) == 7
    assert names("stroke_4", "track") == ["track_sine", "track_step", "stroke_4"]
    with pytest.raises(InputError, match=r"''.*HM-COMPARE-058"):
        names("")


def test_faults_as_text():
    fault = parsed_fault("measurement_freeze@1")
    assert (fault.target, fault.value, fault.start, fault.end) == ("measurement_freeze", 0.0, 1.0, np.inf)
    with pytest.raises(InputError, match="HM-LOOP-008"):
        parsed_fault("input_gain=1@nan")


@pytest.mark.full
def test_noise_is_estimated_where_there_is_no_run(golf_artifact):
    study = Study("golf_robot", golf_artifact, tasks=["track_sine"], controllers=["prior"])
    (model,) = load_models(study).values()
    assert "recordings of the simulated machine" in model.noise_source
    angle, speed = model.kit.noise("prior")
    # The rig accelerates by some rad/s^2 otherwise than the nominal prior: some 1e-2 rad/s within 20 ms.
    assert 1e-6 < angle < 5e-3
    assert 1e-3 < speed < 0.2
