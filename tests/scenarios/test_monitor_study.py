"""The study ``monitor``: its loops, its bookkeeping, what it makes of rows."""

import json
import sys
from functools import partial
from types import SimpleNamespace

import pytest
import trivial_runs

from hybrid_mpc import ChannelLimit, InputError, WatchLimits
from hybrid_mpc.compare.study_run import run_batch
from scenarios.golf_robot.monitor_study import run as room
from scenarios.golf_robot.monitor_study.__main__ import main
from scenarios.golf_robot.monitor_study.detection import METHODS, Detectors
from scenarios.golf_robot.monitor_study.plan import CASES, MonitorStudy, monitor_study

SMALL = MonitorStudy("golf_robot", "nowhere", nominal_hours=0.5, seeds=3, guard_seeds=2, rates=(1.0,))


def test_seeds_are_common_only_where_they_shall_be():
    jobs = list(SMALL.jobs())
    seeds = {
        k: {p.seed for j in jobs if j.kind == k for p in j.plans}
        for k in ("learn", "nominal", "fault", "guard")
    }
    assert not seeds["learn"] & seeds["nominal"]
    assert not (seeds["learn"] | seeds["nominal"]) & seeds["fault"]
    assert seeds["guard"] <= seeds["fault"]
    assert len({j.id for j in jobs}) == len(jobs) == SMALL.size
    plans = [p for j in jobs if j.kind == "nominal" for p in j.plans]
    assert 3 * sum(p.case != "none" for p in plans) <= len(plans) + 2
    assert {p.case for p in plans} == {"none", "drift_up", "drift_down"}


def row_of(job):
    """What a job might find: the guard sees all faults, the innovations none; a false alarm of one method."""
    if job.kind == "guard":
        cost = 2.0 if job.arm == "backup" else 1.0
        return {"cost": cost, "excess": {"x0": 0.0, "u": 0.0}, "switches": 1, "early_switches": 0}
    if job.kind == "fault":
        delays = {m: 0.1 if m.startswith("guard") else float("inf") for m in METHODS}
        return {
            "delays": {"1": delays}, "early": {"1": dict.fromkeys(METHODS, False)},
            "scores": {m: 2.0 if m.startswith("guard") else 0.5 for m in METHODS}, "cost": 1.0,
            "excess": {"x0": 0.2, "u": 0.0},
        }  # fmt: skip
    counts = {m: int(m == "level" and p.seed % 10 == 0) for m in METHODS for p in job.plans[:1]}
    loop = {"seconds": 180.0, "alarms": {"1": counts}, "blocks": {m: [0.3, 0.6] for m in METHODS}}
    return {"loops": [{"case": p.case, **loop} for p in job.plans]}


@pytest.fixture
def stand_in(monkeypatch):
    """No loop is run; says which jobs were asked for."""
    asked = []

    def run(job):
        asked.append(job)
        return row_of(job)

    model = SimpleNamespace(dt=0.02, n_p=1, delay_states=0)
    force = ChannelLimit("force of phi", "N m", 0, 1.0, 0.5, (0.01, 0.0, 0.0, 0.0), 2.0)
    limits = WatchLimits("energy", 0.02, (force,), (3e-3,), (0,))
    learned = Detectors(limits, {"forces": (3.0, 0.5)}, (1e-3,), 1.0, 700)
    monkeypatch.setattr(
        room, "load_inputs", lambda *given: (SimpleNamespace(models=[SimpleNamespace(folder="")]), {})
    )
    monkeypatch.setattr(room, "load", lambda folder: SimpleNamespace(models={"hybrid": model}))
    monkeypatch.setattr(
        room, "make_engine", lambda *given, **named: trivial_runs.Here(partial(run_batch, run))
    )

    def learn(study, paths, dt):
        for path in paths:
            path.parent.mkdir(exist_ok=True)
        return learned

    monkeypatch.setattr(room, "learn", learn)
    return asked


@pytest.mark.full
def test_run_resume_report(stand_in, tmp_path, monkeypatch, capsys):
    out = tmp_path / "study"
    results = room.run_monitor_study(SMALL, out)
    assert {"report.html", "table.md", "delays.png", "roc.png", "results.json"} <= {
        p.name for p in out.iterdir()
    }
    push = results["delays"]["1"]["push"]
    assert (push["guard"]["median"], push["guard"]["misses"]) == (0.1, 0)
    assert (push["innovation_rms"]["median"], push["innovation_rms"]["misses"]) == (float("inf"), 3)
    assert results["false_alarms"]["1"]["level"]["count"] == sum(
        len(j.plans) for j in stand_in if j.kind == "nominal" and j.plans[0].seed % 10 == 0
    )
    backup = results["guard"]["push"]["backup"]
    assert (backup["n"], backup["ratio"], backup["violations_off"]["x0"]["loops"]) == (2, 2.0, 2)
    assert "| push | 0.10 [0.10, 0.10], 0 % |" in (out / "table.md").read_text()
    before = len(stand_in)
    assert before == SMALL.size
    again = room.run_monitor_study(SMALL, out, resume=True)
    assert len(stand_in) == before
    assert json.loads((out / "results.json").read_text())["nominal_hours"] == again["nominal_hours"] == 0.5
    (out / "report.html").unlink()
    monkeypatch.setattr(sys, "argv", ["monitor_study", "report", str(out)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    assert (out / "report.html").is_file()
    assert "report.html" in capsys.readouterr().out


@pytest.mark.full
def test_another_size_is_another_study(stand_in, tmp_path):
    room.run_monitor_study(SMALL, tmp_path / "a")
    with pytest.raises(InputError, match="seeds"):
        room.run_monitor_study(
            MonitorStudy("golf_robot", "nowhere", nominal_hours=0.5, seeds=4, guard_seeds=2, rates=(1.0,)),
            tmp_path / "a", resume=True,
        )  # fmt: skip


def test_command_refuses(tmp_path, monkeypatch, capsys):
    words = ["monitor_study", "run", "m", "--budget", "huge", "--out", str(tmp_path / "x")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert "no budget 'huge'" in capsys.readouterr().err.replace("\n", " ")


def test_budgets_and_numbers():
    assert monitor_study("m").nominal_hours >= 10  # what the bound of one false alarm an hour asks for
    assert monitor_study("m", "quick").size < monitor_study("m").size
    assert len({case.name for case in CASES}) == len(CASES)
    with pytest.raises(InputError, match=r"nominal_hours = -1.*HM-SCENARIOS-011"):
        MonitorStudy("golf_robot", "m", nominal_hours=-1)
