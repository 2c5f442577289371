"""Jobs and batches for the tests of engines. A worker imports this module alone, which takes it no time."""

import os
import pickle
import signal
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

THREADS = "OMP_NUM_THREADS"
LEFT = []
"""What jobs before this one have left in its process: none may."""


def double(x, report):
    report(1, 2, "half")
    return 2 * x


def bad_input(report):
    from hybrid_mpc.errors import StorageError

    raise StorageError("cannot write there")


def defect(report):
    return 1 / 0


def dies(report):
    os.kill(os.getpid(), signal.SIGKILL)


def lasts(path, report):
    with open(path, "a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(3600)


def fails_beside(path, report):
    while not os.path.exists(path):
        time.sleep(0.01)
    raise ValueError("too bad")


def fails_after(go, failing, report):
    while not os.path.exists(go):
        time.sleep(0.01)
    Path(failing).touch()
    raise ValueError("too bad")


def leaves(report):
    LEFT.append("here")
    return os.getpid(), len(LEFT), os.environ[THREADS]


def tells(n, report):
    for i in range(n):
        report(i, n, "")
    return n


def stops(report):
    sys.exit(3)


def locked(*given):
    return threading.Lock()


def place(batch):
    """Where a batch is computed, with how many threads; one that holds 0 kills its process."""
    if 0 in batch:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid(), os.environ[THREADS], sum(batch)


def raises(batch):
    raise batch[0]("not a worker's death")


def waits(batch):
    time.sleep(1.0)


def one_by_one(jobs, on_progress, workers, on_result=lambda name, result: None, *, fresh=True, cluster=None):
    """``run_jobs`` in this process: others of their own take longer to start than small jobs to end.

    Jobs and results are what would reach another process, and come back from it.
    """
    results = {}
    for name, job in jobs.items():
        function, arguments = pickle.loads(pickle.dumps(job))
        result = function(*arguments, lambda *told, name=name: on_progress(name, *told))
        results[name] = pickle.loads(pickle.dumps(result))
        on_result(name, results[name])
    return results


@contextmanager
def jobs_in_this_process():
    """Networks are trained and loops of a comparison computed in this process."""
    import pytest

    from hybrid_mpc.workflow.stages import compare, identify

    with pytest.MonkeyPatch.context() as patch:
        for stage in (compare, identify):
            patch.setattr(stage, "run_jobs", one_by_one)
        yield
