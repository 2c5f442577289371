"""Runs on a make-believe machine in processes of their own, to be ended by real signals; for test_runner_signals.

Takes lines "case folder" on its input and runs each case in a fork (everything is imported already), one after the
other. Leaves in the folder: "pid" with the process id; "log", what the actuator was handed, unbuffered; "errors", what
was written to stderr; and at the end "status", the exit status.
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

from closed_loop_parts import DT, Rig, make_runner, make_safe, sine
from online_models import pendulum_model

from hybrid_mpc import SafeEnd
from hybrid_mpc.files import write_text
from hybrid_mpc.loop import realtime
from hybrid_mpc.loop.realtime import RealClock

SAFE = 0.25
LONG = 60.0
"""Seconds for which what blocks would block."""
NAP = 0.05


class LoggedRig(Rig):
    """The rig with a log; blocks where a case wants it to."""

    def __init__(self, folder):
        super().__init__()
        self.log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self.looks = 0
        self.shown = False

    def note(self, text):
        os.write(self.log, f"{text}\n".encode())

    def actuate(self, u):
        self.note(f"{u[0]:.6f}")
        super().actuate(u)

    def block(self):
        self.note("here")
        self.sleep()

    def sleep(self):
        """Sleep long, in naps: a signal in the instant before the call of a nap is seen after it."""
        for _ in range(round(LONG / NAP)):
            time.sleep(NAP)

    def at(self, count, function):
        """``function``, blocked in its call number ``count``."""
        calls = iter(range(10**9))

        def call(*arguments):
            if next(calls) == count:
                self.block()
            return function(*arguments)

        return call

    def run(self, duration=LONG, stop=None, **options):
        return make_runner(MODEL, SAFE_CONTROLLER, self, RealClock(), safe_input=[SAFE], **options).run(
            duration, stop
        )

    def here(self, step):
        """A line once some periods are over; on a loaded machine not every period has a step."""
        if step.k >= 5 and not self.shown:
            self.shown = True
            self.note("here")


def running(machine):
    machine.run(on_step=machine.here)


def warm_up(machine):
    machine.run(reference=machine.at(0, sine))


def first_plan(machine):
    machine.run(reference=machine.at(1, sine))


def first_sample(machine):
    machine.measure = machine.at(0, machine.measure)
    machine.run()


def in_measure(machine):
    machine.measure = machine.at(5, machine.measure)
    machine.run()


def in_a_read(machine):
    """Blocked in a system call that Python takes up again after a signal."""
    ordinary, (end, _) = machine.measure, os.pipe()

    def measure():
        if len(machine.y) == 5:
            machine.note("here")
            os.read(end, 1)
        return ordinary()

    machine.measure = measure
    machine.run()


def in_actuate(machine):
    machine.actuate = machine.at(5, machine.actuate)
    machine.run()


def final_wait(machine):
    class Clock(RealClock):
        def sleep_until(self, t):
            if machine.u:
                machine.block()
            super().sleep_until(t)

    # a single period: where a loaded machine passes some over, the number of a later one is not known
    make_runner(MODEL, SAFE_CONTROLLER, machine, Clock(), safe_input=[SAFE]).run(DT)


def swallowed(machine):
    """A callback that lets nothing out, not even what a signal raises."""
    ordinary = machine.measure

    def measure():
        try:
            if len(machine.y) == 5:
                machine.note("here")
                machine.sleep()
        except BaseException:
            machine.note("swallowed")
        return ordinary()

    machine.measure = measure
    machine.run()


def slow_hand_over(machine):
    """The safe input takes a while to hand over: time for a second signal."""
    ordinary = machine.actuate

    def actuate(u):
        if u[0] == SAFE:
            machine.note("handing over")
            time.sleep(0.3)
        ordinary(u)

    machine.actuate = actuate
    machine.run(on_step=machine.here)


def broken_actuator(machine):
    ordinary = machine.actuate

    def actuate(u):
        if u[0] == SAFE:
            raise OSError("the bus is gone")
        ordinary(u)

    machine.actuate = actuate
    realtime.PAUSES_S = (0.0,)
    machine.run(on_step=machine.here)


def ignored(machine):
    """As under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    machine.run(on_step=machine.here)


def own_handler(machine):
    signal.signal(signal.SIGTERM, lambda *_: machine.note("handler"))
    machine.note(machine.run(on_step=machine.here).stopped)


def suspended(machine):
    machine.note(machine.run(on_step=machine.here).stopped)


def after_an_error(machine):
    """The signal comes while the safe input of a failed run is handed over."""

    def on_step(step):
        if step.k >= 5:
            machine.note("here")
            raise OSError("a full disk")

    slow = machine.actuate

    def actuate(u):
        if u[0] == SAFE:
            time.sleep(0.3)
        slow(u)

    machine.actuate = actuate
    machine.run(on_step=on_step)


def stopped_thread(machine):
    """The way of docs/hardware.md."""
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: asked.set())
    thread = threading.Thread(
        target=lambda: machine.note(machine.run(None, asked.is_set, on_step=machine.here).stopped)
    )
    thread.start()
    thread.join()


def thread(machine):
    threading.Thread(target=machine.run, kwargs={"on_step": machine.here}).start()
    time.sleep(LONG)


def daemon_thread(machine):
    """The program ends without a word to the thread."""
    threading.Thread(target=machine.run, kwargs={"on_step": machine.here}, daemon=True).start()
    while b"here" not in Path(f"/proc/self/fd/{machine.log}").resolve().read_bytes():
        time.sleep(DT)


def any_instant(machine):
    """A signal at every microsecond of short blocks: each hands over once."""
    realtime.ENDING = (signal.SIGALRM,)
    came, handed = [], []
    signal.signal(signal.SIGALRM, lambda *_: came.append(1))
    for i in range(6000):
        signal.setitimer(signal.ITIMER_REAL, 1e-6 * (1 + i % 60))
        with SafeEnd(lambda i=i: handed.append(i)) as end:
            if i % 2:
                end.check()
            else:
                for _ in range(20):
                    pass
        signal.setitimer(signal.ITIMER_REAL, 0)
    machine.note(handed == list(range(6000)) and len(came) > 1000)


def main():
    for line in sys.stdin:
        case, folder = line.split()[0], Path(line.split()[1])
        if child := os.fork():
            write_text(folder / "pid", str(child))
            write_text(folder / "status", str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])))
        else:
            os.dup2(os.open(folder / "errors", os.O_WRONLY | os.O_CREAT), 2)
            for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP):
                signal.signal(number, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            return globals()[case](LoggedRig(folder))


MODEL = pendulum_model(z=2)
SAFE_CONTROLLER = make_safe(MODEL, horizon=10)
if __name__ == "__main__":
    main()
