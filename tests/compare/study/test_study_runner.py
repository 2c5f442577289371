"""A study runs every run once and loses none, whatever happens to the process."""

import errno
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trivial_runs
from patience import HANGS

from hybrid_mpc import InputError, StudyResults, run_study
from hybrid_mpc.compare import study_run as runner
from hybrid_mpc.compare.study_log import RunLog, RunRow, rows
from hybrid_mpc.files import read_document, write_document

ROOT, TESTS = (Path(__file__).parents[i] for i in (3, 2))  # the root first: tests/ has a folder nn_export
RUNS = 150


def values(folder):
    return {row.id: row.columns["cost"] for row in rows(folder / "runs")}


def test_all_runs_and_their_table(here, tmp_path):
    here(trivial_runs.trivial)
    study = trivial_runs.study(50, draws=2, vary={"m": 0.2})
    results = run_study(study, tmp_path / "s")
    assert results.table["id"].tolist() == [run.id for run in study.runs()]
    assert (results.missing, len(results.failed)) == (0, 0)
    assert results.note.study == study.identity()
    assert results.note.engine == "here"
    for run in study.runs():
        assert results.table.set_index("id").loc[run.id, "cost"] == trivial_runs.trivial(run)["cost"]
    with pytest.raises(InputError, match="HM-FOLDER-004"):
        run_study(study, tmp_path / "s")
    again = run_study(study, tmp_path / "s", resume=True)
    assert len(again.table) == 100


def test_runs_that_raise_are_kept_with_their_traceback(here, tmp_path):
    here(trivial_runs.raising)
    results = run_study(trivial_runs.study(9), tmp_path / "s")
    assert sorted(results.failed["seed"]) == [1, 4, 7]
    assert results.failed["error"].str.contains("ZeroDivisionError: seed").all()
    assert results.failed["error"].str.contains("Traceback").all()
    assert np.isfinite(results.table["cost"]).sum() == 6
    here(trivial_runs.trivial)
    assert len(run_study(trivial_runs.study(9), tmp_path / "s", resume=True).failed) == 3  # not asked for
    mended = run_study(trivial_runs.study(9), tmp_path / "s", resume=True, retry_failed=True)
    assert len(mended.failed) == 0
    assert len(mended.table) == 9
    assert len(list(rows(tmp_path / "s" / "runs"))) == 12  # the failed ones alone ran again


def test_short_runs_are_handed_over_together(here, tmp_path, monkeypatch):
    sizes = []
    here(trivial_runs.trivial)
    submit = trivial_runs.Here.submit
    monkeypatch.setattr(
        trivial_runs.Here, "submit", lambda self, batch: (sizes.append(len(batch)), submit(self, batch))
    )
    run_study(trivial_runs.study(2000), tmp_path / "s")
    assert sizes[:2] == [1, 1]
    assert sum(sizes) == 2000
    assert len(sizes) < 30  # doubling from 1 to at most 500


@pytest.mark.parametrize(("workers", "size"), [(2, 5), (100, 20)])
def test_batches_grow_with_the_workers(workers, size):
    pace = runner._Pace(workers)
    for _ in range(9):  # runs of 0.1 s: half a second a batch, or 2 s where 100 workers ask for 50 a second
        pace.learn([RunRow("a", "done", "", {"timing_total_s": 0.1})] * pace.size)
    assert pace.size == pytest.approx(size, abs=1)  # whole runs


def test_the_folder_of_another_study(here, tmp_path):
    here(trivial_runs.trivial)
    run_study(trivial_runs.study(3), tmp_path / "s")
    with pytest.raises(InputError, match=r"study.*seeds.*HM-FOLDER-005"):
        run_study(trivial_runs.study(4), tmp_path / "s", resume=True)
    path = tmp_path / "s" / "study.json"
    note = read_document(path)
    write_document(path, note | {"settings": note["settings"] | {"the content of model model": "1"}})
    with pytest.raises(InputError, match="HM-FOLDER-005"):
        run_study(trivial_runs.study(3), tmp_path / "s", resume=True)
    machine = tmp_path / "machine.py"
    machine.write_text("from scenarios.golf_robot import scenario\n")
    own = replace(trivial_runs.study(3), scenario=str(machine))
    run_study(own, tmp_path / "own")
    run_study(replace(own, name="another name"), tmp_path / "own", resume=True)
    machine.write_text("from scenarios.golf_robot import scenario  # another\n")
    with pytest.raises(InputError, match=r"content of the scenario's file.*HM-FOLDER-005"):
        run_study(own, tmp_path / "own", resume=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="HM-FOLDER-002"):
        run_study(trivial_runs.study(3), tmp_path / "mine")
    with pytest.raises(InputError, match=r"study.*HM-FOLDER-003"):
        run_study(trivial_runs.study(3), tmp_path / "none", resume=True)
    with pytest.raises(InputError, match="HM-COMPARE-043"):
        StudyResults.load(tmp_path / "mine")


def test_a_full_disk_stops_the_study_and_it_goes_on_later(here, tmp_path, monkeypatch):
    here(trivial_runs.trivial)
    written, real = [], os.fsync

    def full(file):
        written.append(file)
        if (
            len(written) == 4 + 4
        ):  # after two trials of the folder, its note, the note's folder: the fourth batch
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(file)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"No space left.*HM-COMPARE-045"):
        run_study(trivial_runs.study(40), tmp_path / "s")
    monkeypatch.setattr(os, "fsync", real)
    kept = values(tmp_path / "s")
    assert len(kept) == 1 + 1 + 2  # batches before the fourth
    partial = StudyResults.load(tmp_path / "s")
    assert partial.missing == 36
    results = run_study(trivial_runs.study(40), tmp_path / "s", resume=True)
    assert len(results.table) == 40
    assert len(list(rows(tmp_path / "s" / "runs"))) == 40


def begun(folder, run="noted", runs=RUNS, **environment):
    """A study in a process group of its own."""
    words = [sys.executable, str(TESTS / "trivial_runs.py"), str(folder), run, str(runs)]
    paths = os.pathsep.join([str(ROOT), str(TESTS), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, **environment}
    return subprocess.Popen(
        words, env=environment, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def wait_for(condition, process, most=HANGS):
    end = time.monotonic() + most
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        if process.poll() is not None:
            return
        time.sleep(0.01)


def count(folder):
    return len(list(rows(folder / "runs")))


def killed_and_resumed(tmp_path, kills, seed):
    """Kill a study ``kills`` times after a random number of rows; check what is kept and what runs again."""
    rng, folder, executed = random.Random(seed), tmp_path / "s", tmp_path / "executed"
    for _ in range(kills):
        kept = set()
        if (folder / "study.json").is_file():
            kept = {row.id for row in rows(folder / "runs")}
            executed.write_text("")
        process = begun(folder, EXECUTED=str(executed))
        goal = rng.choice([None, 0, 1, RUNS // 10, RUNS // 4])
        if goal is None:  # somewhere before the first row
            time.sleep(rng.uniform(0.0, 3.0))
        else:  # a little after so many new ones
            enough = len(kept) + goal
            wait_for(lambda enough=enough: count(folder) > enough, process)
            time.sleep(rng.uniform(0.0, 0.05))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        again = set(executed.read_text().split()) if executed.is_file() else set()
        assert not again & kept, "a finished run ran again"
        assert kept <= {row.id for row in rows(folder / "runs")}, "a finished run was lost"
    process = begun(folder, EXECUTED=str(executed))
    told, error = process.communicate(timeout=HANGS)
    assert "finished" in told, error
    ids = [row.id for row in rows(folder / "runs")]
    assert sorted(ids) == sorted(run.id for run in trivial_runs.study(RUNS).runs())
    expected = {run.id: trivial_runs.trivial(run)["cost"] for run in trivial_runs.study(RUNS).runs()}
    assert values(folder) == expected
    assert len(StudyResults.load(folder).table) == RUNS


@pytest.mark.full
def test_killed_in_the_middle(tmp_path):
    killed_and_resumed(tmp_path, 1, seed=9)  # after a tenth of the runs


@pytest.mark.full
def test_killed_many_times(tmp_path):
    for seed in range(4):
        killed_and_resumed(tmp_path / str(seed), 3, seed)


@pytest.mark.full
def test_ctrl_c_ends_the_workers_and_resumes(tmp_path):
    process = begun(tmp_path / "s", "slow", 60)
    wait_for(lambda: count(tmp_path / "s") > 4, process)
    pids = {int(row.columns["timing_pid"]) for row in rows(tmp_path / "s" / "runs")}
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    _, error = process.communicate(timeout=HANGS)
    assert "KeyboardInterrupt" in error
    assert not any(alive(pid) for pid in pids)
    kept = values(tmp_path / "s")
    assert 4 < len(kept) < 60
    process = begun(tmp_path / "s", "slow", 60)
    assert "finished" in process.communicate(timeout=HANGS)[0]
    assert count(tmp_path / "s") == 60  # none ran twice
    assert kept.items() <= values(tmp_path / "s").items()


@pytest.mark.full
def test_workers_end_with_a_parent_that_was_killed(tmp_path):
    process = begun(tmp_path / "s", "slow", 400)
    wait_for(lambda: count(tmp_path / "s") > 4, process)
    pids = {int(row.columns["timing_pid"]) for row in rows(tmp_path / "s" / "runs")}
    process.kill()
    process.communicate()
    end = time.monotonic() + HANGS  # they look once a second
    while any(alive(pid) for pid in pids) and time.monotonic() < end:
        time.sleep(0.1)
    assert not any(alive(pid) for pid in pids)
    RunLog(tmp_path / "s" / "runs").close()  # nobody holds the log


def alive(pid):
    """Whether a process runs; one that has ended and is not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
