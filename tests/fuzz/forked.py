"""The command line in a forked process of its own, with what it cost: seconds, and memory beyond what was loaded."""

import io
import os
import pickle
import resource
import signal
import sys
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

MOST_S, MOST_MB = 5.0, 500.0
"""Processor time and memory that it may take to refuse a small file; most take less than a second."""
HANGS_S = 120


class Ended(NamedTuple):
    """How a command ended: exit code (None: it raised), what it said, seconds, MB."""

    code: int | None
    told: str
    seconds: float
    megabytes: float


def command(*words: object) -> Ended:
    """Run ``hybrid-mpc`` with some words; an exception that gets out of it is told by its traceback."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(ours)
            _in_child(theirs, [str(word) for word in words])
        finally:
            os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        content = pipe.read()
    _, status = os.waitpid(child, 0)
    if not content:
        return Ended(None, f"no answer, status {status}", HANGS_S, 0.0)
    return Ended(*pickle.loads(content))


def _in_child(pipe: int, words: list[str]) -> None:
    from hybrid_mpc.cli.main import main

    signal.alarm(HANGS_S)
    out, code = io.StringIO(), None
    before, begin = _resident(), time.process_time()
    with redirect_stdout(out), redirect_stderr(out):
        try:
            sys.argv = ["hybrid-mpc", *words]
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 0
        except BaseException:
            out.write(traceback.format_exc())
    spent = time.process_time() - begin  # of a busy machine, too; what waits, the alarm ends
    most = max(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before, 0.0)
    with os.fdopen(pipe, "wb") as file:
        pickle.dump((code, out.getvalue(), spent, most), file)


def _resident() -> float:
    """Memory [MB] of this process now; a forked one begins with its parent's."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmRSS")) / 1024


def refused(ended: Ended, what: object) -> None:
    """Assert that a command has refused its input: a message, exit code 2, quickly, in little memory."""
    assert ended.code is not None, f"{what}:\n{ended.told}"
    assert "Traceback" not in ended.told, f"{what}:\n{ended.told}"
    assert ended.code == 2, f"{what}: exit code {ended.code}\n{ended.told}"
    assert "error:" in ended.told, f"{what}:\n{ended.told}"
    cheap(ended, what)


def cheap(ended: Ended, what: object) -> None:
    """Assert that a command has taken little time and memory."""
    assert ended.seconds <= MOST_S, f"{what}: {ended.seconds:.1f} s\n{ended.told}"
    assert ended.megabytes <= MOST_MB, f"{what}: {ended.megabytes:.0f} MB\n{ended.told}"
