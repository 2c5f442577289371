"""Processes and a real dask cluster: the same results, and workers that die."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import trivial_runs

from hybrid_mpc.errors import InputError
from hybrid_mpc.pipeline.context import Silent
from hybrid_mpc.studies import StudyResults, engines, run_study
from hybrid_mpc.studies.inputs import TIMING

ROOT, TESTS = (
    str(Path(__file__).parents[i]) for i in (2, 1)
)  # the root first: tests/ has a folder nn_export


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """Workers import the runs of the tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([ROOT, TESTS, os.environ.get("PYTHONPATH", "")]))


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, each a process of its own: ``(address, workers)``."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    file = tmp_path / "scheduler.json"
    words = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    started = [subprocess.Popen([*words, *options], cwd=tmp_path, **quiet)]
    for i in range(2):
        words = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file)]
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--name", f"w{i}"]
        started.append(subprocess.Popen([*words, *options], cwd=tmp_path, **quiet))
    from distributed import Client

    end = time.monotonic() + 120.0
    while not file.is_file() and time.monotonic() < end:
        time.sleep(0.1)
    with Client(scheduler_file=str(file), timeout=60, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=120)
        address = client.scheduler.address
    yield address, started[1:]
    for process in started:
        process.kill()
        process.wait()


def comparable(results):
    """The table without durations and places, by id."""
    table = results.table
    return table[[c for c in table if not c.startswith(TIMING)]].set_index("id").sort_index()


def test_unreachable_scheduler(tmp_path, monkeypatch):
    trivial_runs.stand_in(monkeypatch, trivial_runs.trivial)
    monkeypatch.setattr(engines, "CONNECT_S", 0.5)
    begin = time.monotonic()
    with pytest.raises(InputError, match=r"no dask scheduler at tcp://127\.0\.0\.1:9"):
        run_study(trivial_runs.study(3), tmp_path / "s", cluster="tcp://127.0.0.1:9")
    assert time.monotonic() - begin < 30.0
    for address in ("nonsense://x", "tls://127.0.0.1:8786", "tcp://", "tcp://[::1"):
        with pytest.raises(InputError, match="must be tcp://HOST:PORT"):
            run_study(trivial_runs.study(3), tmp_path / "s", cluster=address)
    assert not (tmp_path / "s").exists()
    with pytest.raises(InputError, match="1 or more"):
        run_study(trivial_runs.study(3), tmp_path / "s", workers=0)


class Killer(Silent):
    """Kills a process after some runs."""

    def __init__(self, process):
        self._process, self.killed = process, False

    def update(self, key, done, total, text):
        if done >= 6 and not self.killed:
            self._process.send_signal(signal.SIGKILL)
            self.killed = True


def test_a_cluster_computes_the_same_and_loses_its_workers(tmp_path, monkeypatch, cluster):
    address, workers = cluster
    trivial_runs.stand_in(monkeypatch, trivial_runs.slow)
    monkeypatch.setattr(engines, "LOOK_S", 0.0)
    study, killer = trivial_runs.study(40), Killer(workers[0])  # both workers are at a run all the time
    far = run_study(study, tmp_path / "far", cluster=address, progress=killer)
    assert killer.killed
    assert far.note.workers_died == 1
    assert (far.missing, len(far.failed)) == (0, 0)
    assert far.table["id"].is_unique
    assert len(set(far.table["timing_pid"])) == 2
    # the one that lives on has done the rest, and what the other was at
    assert len(set(far.table["timing_pid"].tolist()[-8:])) == 1
    near = run_study(study, tmp_path / "near", workers=2)
    assert comparable(far).equals(comparable(near))

    monkeypatch.setattr(engines, "ALONE_S", 1.0)
    with pytest.raises(InputError, match="has had no worker for 1 s"):
        run_study(study, tmp_path / "alone", cluster=address, progress=Killer(workers[1]))
    with pytest.raises(InputError, match="has no worker; start some"):
        run_study(study, tmp_path / "alone", cluster=address, resume=True)
    kept = StudyResults.load(tmp_path / "alone")
    assert 6 <= len(kept.table) < 40


@pytest.mark.full
def test_one_worker_two_workers(tmp_path, monkeypatch):
    trivial_runs.stand_in(monkeypatch, trivial_runs.trivial)
    study = trivial_runs.study(300)
    one, two = (run_study(study, tmp_path / str(n), workers=n) for n in (1, 2))
    assert comparable(one).equals(comparable(two))


@pytest.mark.parametrize("how", [pytest.param("once", marks=pytest.mark.full), "always"])
def test_a_local_worker_that_dies(tmp_path, monkeypatch, how):
    trivial_runs.stand_in(monkeypatch, trivial_runs.deadly)
    monkeypatch.setenv("DEADLY", how)
    monkeypatch.setenv("MARK", str(tmp_path / "mark"))
    results = run_study(trivial_runs.study(12), tmp_path / "s")
    assert results.missing == 0
    assert results.table["id"].is_unique
    assert results.note.workers_died == {"once": 1, "always": 3}[how]
    if how == "once":
        assert len(results.failed) == 0
    else:
        assert results.failed["seed"].tolist() == [3]
        assert "its worker died 3 times" in results.failed["error"].iloc[0]


@pytest.mark.full
def test_a_run_that_kills_every_worker_of_a_cluster_is_given_up(tmp_path, monkeypatch):
    from distributed import Client, LocalCluster

    trivial_runs.stand_in(monkeypatch, trivial_runs.deadly)
    monkeypatch.setenv("DEADLY", "always")
    monkeypatch.setenv("MARK", str(tmp_path / "mark"))
    with (
        LocalCluster(
            2, threads_per_worker=1, dashboard_address=None
        ) as local,  # with nannies, who start others
        Client(local, set_as_default=False) as client,
    ):
        results = run_study(trivial_runs.study(12), tmp_path / "s", cluster=client)
    assert results.failed["seed"].tolist() == [3]
    assert "died" in results.failed["error"].iloc[0]
    assert len(results.table) == 12
