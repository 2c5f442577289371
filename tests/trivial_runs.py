"""Studies whose runs take no time, for tests of what is around the runs; as a script, one that may be killed."""

import os
import signal
import sys
import time
from pathlib import Path

from hybrid_mpc import Study, run_study
from hybrid_mpc.compare import study_run as runner
from hybrid_mpc.compare.study import generator
from hybrid_mpc.compare.study_log import ModelNote, NoiseNote

SCENARIO = "golf_robot"


def trivial(config):
    """A cost that depends on the configuration alone."""
    return {"cost": float(generator(config.noise_seed, config.draw, config.task).normal()), "share_MPC": 1.0}


def noted(config):
    """The same, a little later, with a line in the file EXECUTED."""
    with open(os.environ["EXECUTED"], "a") as file:
        file.write(config.id + "\n")
    time.sleep(0.01)
    return trivial(config)


def raising(config):
    """Every third seed raises."""
    if config.seed % 3 == 1:
        raise ZeroDivisionError(f"seed {config.seed} is cursed")
    return trivial(config)


def deadly(config):
    """Seed 3 kills its process; whoever takes it dies too, unless a file says that it did so before."""
    mark = Path(os.environ["MARK"])
    if config.seed == 3 and (os.environ["DEADLY"] == "always" or not mark.exists()):
        mark.write_text("killed")
        os.kill(os.getpid(), signal.SIGKILL)
    return trivial(config)


def slow(config):
    """A run that a killer has time to meet."""
    time.sleep(0.15)
    return {**trivial(config), "timing_pid": os.getpid()}


def study(n=60, **fields):
    """A study of ``n`` runs."""
    return Study(
        SCENARIO, "nowhere", **{"tasks": ["track_sine"], "controllers": ["prior"], "seeds": n, **fields}
    )


def stand_in(monkeypatch, run):
    """Have studies run ``run`` in place of closed loops."""
    monkeypatch.setattr(runner, "load_inputs", lambda *given: (run, {"model": NOTE}))


class Here:
    """An engine that computes in this process, a batch at a time."""

    name, workers, died = "here", 1, 0

    def __init__(self, work):
        self._work, self._batches = work, []

    def submit(self, batch):
        self._batches.append(batch)

    def next(self, timeout):
        batch = self._batches.pop(0)
        return batch, self._work(batch)

    def close(self):
        pass


NOTE = ModelNote("0", {}, NoiseNote("none", {}))

if __name__ == "__main__":
    import trivial_runs

    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background ignores it
    runner.load_inputs = lambda *given: (getattr(trivial_runs, sys.argv[2]), {"model": NOTE})
    out = Path(sys.argv[1])
    run_study(study(int(sys.argv[3])), out, workers=2, resume=(out / "study.json").is_file())
    print("finished", flush=True)
