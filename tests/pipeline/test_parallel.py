"""Jobs in processes of their own: what they raise, and that they end with their parent."""

import os
import signal
import subprocess
import sys
import time

import pytest

from hybrid_mpc.errors import InputError, StorageError
from hybrid_mpc.pipeline.parallel import run_jobs


def quiet(*given):
    pass


def double(x, report):
    report(1, 2, "half")
    return 2 * x


def bad_input(report):
    raise StorageError("cannot write there")


def defect(report):
    return 1 / 0


def dies(report):
    os.kill(os.getpid(), signal.SIGKILL)


def lasts(path, report):
    with open(path, "a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(60)


def test_results_by_name_whatever_ends_first():
    seen = []
    assert run_jobs({"a": (double, (1,)), "b": (double, (2,))}, lambda *p: seen.append(p), 2) == {
        "a": 2,
        "b": 4,
    }
    assert ("a", 1, 2, "half") in seen


def test_a_workers_bad_input_is_the_users_and_a_defect_is_ours():
    with pytest.raises(StorageError, match=r"^cannot write there$"):
        run_jobs({"a": (bad_input, ())}, quiet, 1)
    with pytest.raises(RuntimeError, match=r"(?s)a failed:\n.*ZeroDivisionError"):
        run_jobs({"a": (defect, ())}, quiet, 1)
    with pytest.raises(RuntimeError, match="ended with exit code -9"):
        run_jobs({"a": (dies, ())}, quiet, 1)


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
        "import sys; from tests.pipeline.test_parallel import *\n"
        "if __name__ == '__main__': run_jobs({n: (lasts, (sys.argv[1],)) for n in 'ab'}, quiet, 2)"
    )
    (tmp_path / "main.py").write_text(code)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "main.py"), str(path)], stderr=subprocess.PIPE, text=True,
        start_new_session=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    until = time.monotonic() + 60
    while not (path.is_file() and len(path.read_text().split()) == 2):
        assert time.monotonic() < until
        time.sleep(0.1)
    pids = [int(word) for word in path.read_text().split()]
    if end == signal.SIGKILL:
        parent.kill()
    else:
        os.killpg(parent.pid, end)
    _, told = parent.communicate(timeout=30)
    until = time.monotonic() + 10
    while not all(gone(pid) for pid in pids):
        assert time.monotonic() < until
        time.sleep(0.1)
    assert "in lasts" not in told  # no worker's traceback
    if end == signal.SIGINT:
        assert told.count("Traceback") == 1


def test_an_input_error_is_one():
    assert issubclass(StorageError, InputError)
