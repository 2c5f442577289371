"""The runner in processes that get real signals: what the actuator was handed last, and how the process ended."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from closed_loop_parts import Rig, make_runner
from patience import HANGS

from hybrid_mpc import SafeEnd

if not Path("/proc/self/stat").exists():
    pytest.skip("signals between processes, and their states, as Linux has them", allow_module_level=True)

HERE = Path(__file__).parent
SAFE = "0.250000"


class Child:
    """A case under way."""

    def __init__(self, server, case, folder):
        self._folder = folder
        server.stdin.write(f"{case} {folder}\n")
        server.stdin.flush()
        self.pid = int(self._read("pid"))
        assert self.pid > 1

    def log(self):
        path = self._folder / "log"
        return path.read_text().split("\n")[:-1] if path.exists() else []

    def errors(self):
        return (self._folder / "errors").read_text()

    def until(self, text):
        """Wait until the log has this line."""
        eventually(lambda: text in self.log())

    def send(self, *names):
        """Each once the process stands: asleep, stopped, or at its end, as where nothing stops a group of orphans."""
        for name in names:
            assert name == "SIGCONT" or not self.ended
            eventually(self._stands)
            if not self.ended:
                os.kill(self.pid, getattr(signal, name))

    def _stands(self):
        try:
            state = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return self.ended
        return state in "ST"

    @property
    def ended(self):
        return (self._folder / "status").exists()

    def end(self):
        """Exit status, negative for a signal."""
        return int(self._read("status"))

    def _read(self, name):
        path = self._folder / name
        eventually(path.exists)
        return path.read_text()


def eventually(true):
    """Wait until something is true."""
    end = time.monotonic() + HANGS
    while not true():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture(scope="module")
def server():
    paths = [str(HERE.parent), str(HERE), str(HERE.parents[1])]
    with subprocess.Popen(
        [sys.executable, str(HERE / "signalled_runs.py")], stdin=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
    ) as process:  # fmt: skip
        yield process
        process.stdin.close()


@pytest.fixture
def start(server, tmp_path):
    children = []

    def begin(case):
        children.append(Child(server, case, tmp_path))
        return children[-1]

    yield begin
    for child in children:  # one that a failed test has left
        if not child.ended:
            child.send("SIGKILL")
            child.end()


MOMENTS = (
    "running", "in_measure", "final_wait", "swallowed",
    "warm_up", "first_sample", "first_plan", "in_a_read", "in_actuate",
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "case"),
    [("SIGTERM", case) for case in MOMENTS] + [(n, c) for n in ("SIGINT", "SIGHUP") for c in MOMENTS[:4]],
)
def test_a_signal_ends_the_process_after_the_safe_input(start, name, case):
    child = start(case)
    child.until("here")
    child.send(name)
    assert child.end() == -getattr(signal, name), child.errors()
    assert child.log()[-1] == SAFE
    assert child.log().count(SAFE) == 1
    assert ("KeyboardInterrupt" in child.errors()) == (name == "SIGINT")


TERM = -signal.SIGTERM


@pytest.mark.parametrize(
    ("case", "first", "then", "others", "status", "log"),
    [
        ("slow_hand_over", "SIGTERM", "handing over", ["SIGTERM", "SIGTERM"], TERM, [SAFE]),
        ("slow_hand_over", "SIGTERM", "handing over", ["SIGINT", "SIGINT"], TERM, [SAFE]),
        ("slow_hand_over", "SIGTERM", "handing over", ["SIGHUP", "SIGHUP"], TERM, [SAFE]),
        ("slow_hand_over", "SIGINT", "handing over", ["SIGTERM"], TERM, [SAFE]),  # it still has its effect
        ("after_an_error", "SIGTERM", "here", [], TERM, [SAFE]),
        ("ignored", "SIGHUP", "here", ["SIGTERM"], TERM, [SAFE]),
        ("own_handler", "SIGTERM", "here", [], 0, [SAFE, "handler", "SIGTERM"]),
        ("suspended", "SIGTSTP", SAFE, ["SIGCONT"], 0, [SAFE, "SIGTSTP"]),  # safe before it stands still
        ("stopped_thread", "SIGTERM", "here", [], 0, [SAFE, "stop"]),
    ],
)
def test_the_safe_input_comes_before_the_effect_of_signals(start, case, first, then, others, status, log):
    child = start(case)
    child.until("here")
    child.send(first)
    child.until(then)
    child.send(*others)
    assert child.end() == status, child.errors()
    assert child.log()[-len(log) :] == log


def test_where_the_actuator_stays_broken_the_error_is_printed_before_the_signal(start):
    child = start("broken_actuator")
    child.until("here")
    child.send("SIGTERM")
    assert child.end() == -signal.SIGTERM
    assert "HM-LOOP-053" in child.errors()
    assert "the bus is gone" in child.errors()


def test_ctrl_c_leaves_a_run_in_another_thread_alone_until_the_interpreter_ends(start):
    child = start("thread")
    child.until("here")
    child.send("SIGINT")
    count = len(child.log())
    eventually(lambda: len(child.log()) > count + 20)  # periods
    assert SAFE not in child.log()
    child.send("SIGINT")  # the interpreter no longer waits for the thread
    assert child.end() == -signal.SIGINT, child.errors()
    assert child.log()[-1] == SAFE


def test_the_end_of_the_interpreter_ends_the_run_of_a_daemon_thread(start):
    child = start("daemon_thread")
    assert child.end() == 0, child.errors()
    assert child.log()[-1] == SAFE


def test_no_instant_lets_a_signal_past_the_hand_over(start):
    child = start("any_instant")
    assert child.end() == 0, child.errors()
    assert child.log() == ["True"]


@pytest.fixture
def foreground():
    """Handlers as of a program in the foreground: in the background SIGINT is ignored, under ``nohup`` SIGHUP."""
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)}
    for number in before:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_signal_that_is_ignored_stays_so(foreground, number):
    signal.signal(number, signal.SIG_IGN)
    with SafeEnd(lambda: None) as end:
        assert signal.getsignal(number) is signal.SIG_IGN
        os.kill(os.getpid(), number)
        assert not end.cause
    assert signal.getsignal(number) is signal.SIG_IGN


@pytest.mark.parametrize("error", [None, OSError])
def test_handlers_are_those_of_before(model, safe, foreground, error):
    names = [s for s in signal.Signals if s not in (signal.SIGKILL, signal.SIGSTOP)]
    before, during = [signal.getsignal(s) for s in names], []

    def on_step(step):
        during.append([signal.getsignal(s) for s in names])
        if error is not None:
            raise error

    runner = make_runner(model, safe, Rig(), on_step=on_step)
    if error is None:
        runner.run(0.1)
    else:
        with pytest.raises(error):
            runner.run(0.1)
    assert [signal.getsignal(s) for s in names] == before
    changed = {s.name for s, a, b in zip(names, before, during[0], strict=True) if a != b}
    assert changed >= {"SIGTERM", "SIGHUP", "SIGQUIT"}
    assert changed <= {"SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGXCPU", "SIGTSTP"}


def test_in_another_thread_no_handler_is_touched():
    seen = []

    def block():
        with SafeEnd(lambda: None):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=block)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGTERM)]
