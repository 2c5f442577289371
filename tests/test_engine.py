"""Jobs and batches in processes, and on a real dask cluster: the same results, and workers that die."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from contextlib import ExitStack
from pathlib import Path

import engine_jobs as work
import pytest
import trivial_runs
from patience import HANGS

from hybrid_mpc import InputError, StudyResults, engine, run_study
from hybrid_mpc.compare.study_run import TIMING
from hybrid_mpc.engine import Lost, Progress, make_engine, run_jobs
from hybrid_mpc.errors import StorageError

# the root first: tests/ has a folder nn_export
ROOT, TESTS = (str(Path(__file__).parents[i]) for i in (1, 0))


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

    end = time.monotonic() + HANGS
    while not file.is_file() and time.monotonic() < end:
        time.sleep(0.1)
    with Client(scheduler_file=str(file), timeout=HANGS, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=HANGS)
        address = client.scheduler.address
    yield address, started[1:]
    for process in started:
        process.kill()
        process.wait()


def quiet(*given):
    pass


def test_results_by_name_whatever_ends_first():
    seen = []
    assert run_jobs({"a": (work.double, (1,)), "b": (work.double, (2,))}, lambda *p: seen.append(p), 2) == {
        "a": 2,
        "b": 4,
    }
    assert ("a", 1, 2, "half") in seen


@pytest.mark.parametrize(
    ("job", "kind", "message"),
    [
        ((work.bad_input, ()), StorageError, r"^cannot write there$"),
        ((work.defect, ()), RuntimeError, r"(?s)a failed:\n.*ZeroDivisionError"),
        ((work.dies, ()), RuntimeError, r"(?s)a failed:\nits process ended .*SIGKILL\(-9\)"),
        ((work.stops, ()), InputError, r"SystemExit\(3\)"),
        ((work.locked, ()), RuntimeError, r"(?s)a failed:\n.*pickle"),
        ((work.double, (threading.Lock(),)), RuntimeError, r"(?s)a failed:\n.*pickle"),
    ],
)
def test_a_workers_bad_input_is_the_users_and_a_defect_is_ours(job, kind, message):
    with pytest.raises(kind, match=message):
        run_jobs({"a": job}, quiet, 1)
    with pytest.raises(InputError, match="HM-ENGINE-003"):
        run_jobs({"a": job}, quiet, 0)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_has_a_process_of_its_own_and_the_threads_of_the_environment(monkeypatch, workers):
    monkeypatch.setenv(work.THREADS, "3")
    pids, left, threads = zip(
        *run_jobs(dict.fromkeys("abc", (work.leaves, ())), quiet, workers).values(), strict=True
    )
    assert len({*pids, os.getpid()}) == 4
    assert left == (1, 1, 1)
    assert threads == ("3", "3", "3")


def test_processes_may_serve_one_job_after_the_other(monkeypatch):
    monkeypatch.setenv(work.THREADS, "1")
    found = run_jobs(dict.fromkeys("abcde", (work.leaves, ())), quiet, 2, fresh=False)
    pids, left, _ = zip(*found.values(), strict=True)
    assert len(set(pids)) == 2
    assert os.getpid() not in pids
    assert max(left) >= 3  # five jobs in two processes


@pytest.mark.parametrize("fresh", [True, False])
def test_all_reports_come_in_order_in_the_callers_thread_before_the_result(fresh):
    seen = []

    def told(name, *report):
        assert threading.current_thread() is threading.main_thread()
        seen.append((name, report))

    jobs = {
        "a": (work.tells, (3000,)),
        "b": (work.tells, (2,)),
        "c": (work.tells, (4,)),
    }  # more than a pipe holds
    results = run_jobs(jobs, told, 2, lambda name, result: seen.append((name, result)), fresh=fresh)
    for name, n in results.items():
        assert [what for who, what in seen if who == name] == [*((i, n, "") for i in range(n)), n]
    assert results == {"a": 3000, "b": 2, "c": 4}


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_one_that_fails_ends_the_others_at_once(tmp_path):
    path, begin = tmp_path / "pids", time.monotonic()
    with pytest.raises(RuntimeError, match="too bad"):
        run_jobs({"a": (work.lasts, (path,)), "b": (work.fails_beside, (path,))}, quiet, 2)
    assert gone(int(path.read_text()))
    assert time.monotonic() - begin < HANGS


def test_what_is_done_beside_one_that_fails_is_kept(tmp_path):
    go, failing, kept = tmp_path / "go", tmp_path / "failing", {}

    def told(name, *report):  # both end while the caller is busy; the one that fails is looked at first
        go.touch()
        until = time.monotonic() + HANGS
        while not failing.exists():
            assert time.monotonic() < until
            time.sleep(0.01)
        time.sleep(3.0)

    jobs = {"a": (work.fails_after, (str(go), str(failing))), "b": (work.double, (2,))}
    with pytest.raises(RuntimeError, match="too bad"):
        run_jobs(jobs, told, 2, kept.__setitem__)
    assert kept == {"b": 4}


def test_a_local_engine_computes_anything_and_survives_its_workers(monkeypatch):
    monkeypatch.setenv(work.THREADS, "3")
    for threads, expected in ((1, "1"), (None, "3")):
        local = make_engine(work.place, 1, threads=threads)
        pids = []
        for batch in ((1, 2), (3, 4), (5, 0), (6,)):
            local.submit(batch)
            ended = None
            while ended is None:
                ended = local.next(1.0)
            assert ended[0] == batch
            if 0 in batch:
                assert isinstance(ended[1], Lost)
                assert "SIGKILL(-9)" in str(ended[1])
                continue
            pid, environment, total = ended[1]
            assert (environment, total) == (expected, sum(batch))
            pids.append(pid)
        local.close()
        assert local.died == 1
        assert pids[0] == pids[1] != pids[2]  # one process for many batches


def gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    with open(f"/proc/{pid}/stat") as file:  # a zombie, whose parent has not asked yet, does nothing any more
        return file.read().rsplit(")", 1)[1].split()[0] == "Z"


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent_and_say_nothing(tmp_path, end):
    """Killed they end within seconds; at Ctrl-C, which reaches all of them, only the parent speaks."""
    path = tmp_path / "pids"
    code = (
        "import signal, sys\nfrom engine_jobs import lasts\nfrom hybrid_mpc.engine import run_jobs\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background job ignores it
        "if __name__ == '__main__': run_jobs({n: (lasts, (sys.argv[1],)) for n in 'ab'}, print, 2)"
    )
    (tmp_path / "main.py").write_text(code)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "main.py"), str(path)], stderr=subprocess.PIPE, text=True,
        start_new_session=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    until = time.monotonic() + HANGS
    while not (path.is_file() and len(path.read_text().split()) == 2):
        assert time.monotonic() < until
        time.sleep(0.1)
    pids = [int(word) for word in path.read_text().split()]
    if end == signal.SIGKILL:
        parent.kill()
    else:
        os.killpg(parent.pid, end)
    _, told = parent.communicate(timeout=HANGS)
    while not all(gone(pid) for pid in pids):
        assert time.monotonic() < until
        time.sleep(0.1)
    assert "in lasts" not in told  # no worker's traceback
    if end == signal.SIGINT:
        assert told.count("Traceback") == 1


def comparable(results):
    """The table without durations and places, by id."""
    table = results.table
    return table[[c for c in table if not c.startswith(TIMING)]].set_index("id").sort_index()


def test_unreachable_scheduler(tmp_path, monkeypatch):
    trivial_runs.stand_in(monkeypatch, trivial_runs.trivial)
    monkeypatch.setattr(engine, "CONNECT_S", 0.5)
    begin = time.monotonic()
    with pytest.raises(InputError, match="HM-ENGINE-005"):
        run_study(trivial_runs.study(3), tmp_path / "s", cluster="tcp://127.0.0.1:9")
    assert time.monotonic() - begin < HANGS
    for address in ("nonsense://x", "tls://127.0.0.1:8786", "tcp://", "tcp://[::1"):
        with pytest.raises(InputError, match="HM-ENGINE-004"):
            run_study(trivial_runs.study(3), tmp_path / "s", cluster=address)
    assert not (tmp_path / "s").exists()
    with pytest.raises(InputError, match="HM-ENGINE-003"):
        run_study(trivial_runs.study(3), tmp_path / "s", workers=0)


class Killer(Progress):
    """Kills a process after some runs."""

    def __init__(self, process):
        self._process, self.killed = process, False

    def update(self, key, done, total, text):
        if done >= 6 and not self.killed:
            self._process.send_signal(signal.SIGKILL)
            self.killed = True


@pytest.mark.full
def test_a_cluster_computes_the_same_and_loses_its_workers(tmp_path, monkeypatch, cluster):
    address, workers = cluster
    trivial_runs.stand_in(monkeypatch, trivial_runs.slow)
    monkeypatch.setattr(engine, "LOOK_S", 0.0)
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

    monkeypatch.setattr(engine, "ALONE_S", 1.0)
    with pytest.raises(InputError, match="no worker for 1 s"):
        run_study(study, tmp_path / "alone", cluster=address, progress=Killer(workers[1]))
    with pytest.raises(InputError, match="HM-ENGINE-001"):
        run_study(study, tmp_path / "alone", cluster=address, resume=True)
    kept = StudyResults.load(tmp_path / "alone")
    assert 6 <= len(kept.table) < 40


@pytest.fixture
def here_cluster():
    """``make(n)``: the address of a scheduler in this process, and a client of it with n workers in threads."""
    from distributed import Client, LocalCluster

    with ExitStack() as stack:

        def make(n):
            local = LocalCluster(
                n_workers=n, processes=False, threads_per_worker=1, protocol="tcp", host="127.0.0.1",
                dashboard_address=None,
            )  # fmt: skip
            stack.enter_context(local)
            return local.scheduler_address, stack.enter_context(Client(local, set_as_default=False))

        yield make


def test_a_cluster_computes_a_study(here_cluster, tmp_path, monkeypatch):
    trivial_runs.stand_in(monkeypatch, trivial_runs.trivial)
    study = trivial_runs.study(12)
    results = run_study(study, tmp_path / "far", cluster=here_cluster(2)[0])
    found = results.table.set_index("id")["cost"]
    assert {run.id: trivial_runs.trivial(run)["cost"] for run in study.runs()} == found.to_dict()
    assert results.note.engine == "dask, 2 workers"


def test_a_cluster_computes_jobs_by_name(here_cluster):
    ends, told = [], []
    jobs = {name: (work.double, (i,)) for i, name in enumerate("abc")}
    found = run_jobs(
        jobs, lambda *p: told.append(p), 1, lambda *p: ends.append(p), cluster=here_cluster(2)[0]
    )
    assert found == {"a": 0, "b": 2, "c": 4}
    assert sorted(ends) == sorted(found.items())
    assert sorted(told) == [(name, 1, 1, "dask, 2 workers") for name in "abc"]


@pytest.mark.parametrize(
    ("job", "kind"), [((work.bad_input, ()), StorageError), ((work.defect, ()), RuntimeError)]
)
def test_a_job_that_fails_on_a_cluster_fails_here(here_cluster, job, kind):
    with pytest.raises(kind):
        run_jobs({"a": job}, quiet, 1, cluster=here_cluster(1)[0])


@pytest.mark.parametrize("kind", [TypeError, OSError, CancelledError])
def test_what_the_work_raises_on_a_cluster_is_no_lost_worker(here_cluster, kind):
    far = make_engine(work.raises, 1, here_cluster(1)[1])
    far.submit((kind,))
    with pytest.raises(kind, match="not a worker's death"):
        far.next(60.0)
    far.close()


def test_what_a_cluster_has_forgotten_is_lost(here_cluster):
    from distributed import Future

    client = here_cluster(1)[1]
    far = make_engine(work.waits, 1, client)
    far.submit((1,))
    client.cancel([Future(key, client) for key in client.futures if "call" in key])
    batch, ended = far.next(60.0)
    assert batch == (1,)
    assert isinstance(ended, Lost)
    assert not ended.final
    far.close()


@pytest.mark.full
@pytest.mark.parametrize("how", ["once", pytest.param("always", marks=pytest.mark.full)])
def test_a_local_worker_that_dies(tmp_path, monkeypatch, how):
    trivial_runs.stand_in(monkeypatch, trivial_runs.deadly)
    monkeypatch.setenv("DEADLY", how)
    monkeypatch.setenv("MARK", str(tmp_path / "mark"))
    results = run_study(trivial_runs.study(12), tmp_path / "s", workers=1)
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
