"""What the diagnosis says of known faults: ``python benchmarks/guard_causes.py --model DIR
--detector FILE.json [--seeds 3] [--after 0.5 1.2 2.2] [--keep DIR]``.

Loops of guard_loops.py, replayed; what the diagnosis says so long [s] after the onset, of its whole history and of
the time since the onset alone. An artifact of an earlier version is completed with the prior's program of its
provenance (torch). The detector is that of ``hybrid-mpc monitor ... --learn`` or ``judges.json`` of
``python -m scenarios.golf_robot.monitor_study``.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from guard_loops import DT, FAULTS, Loops, fault_plans, noise_of

from hybrid_mpc import Diagnoser, guard_monitor, load
from hybrid_mpc.job.monitor import read_detector
from scenarios.golf_robot import scenario


def said(monitor, diagnoser, loop, onset: float, after) -> list[str]:
    """Texts at the instants."""
    state, texts, wanted = monitor.initial(), [], {round((onset + s) / DT): s for s in after}
    for k in range(len(loop["t"])):
        u_prev = loop["u"][k - 1] if k else np.zeros(1)
        estimate = SimpleNamespace(x=loop["x_hat"][k], h=loop["h"][k])
        state, _ = monitor.update(state, loop["y"][k], u_prev, estimate)
        if k in wanted:
            whole, recent = diagnoser.diagnose(state).text, diagnoser.diagnose(state, wanted[k]).text
            texts.append(f"{wanted[k]:g} s: {whole} [since the onset: {recent}]")
    return texts


def main() -> None:
    """Print what is said."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder with prior and hybrid")
    parser.add_argument("--detector", type=Path, required=True, help="JSON file with a field 'detector'")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--after", type=float, nargs="+", default=(0.5, 1.2, 2.2))
    parser.add_argument("--keep", type=Path, help="folder of the loops")
    given = parser.parse_args()
    artifact = load(given.model)
    monitor = guard_monitor(artifact.models["hybrid"], read_detector(given.detector), diagnose=True)
    diagnoser, loops = (
        Diagnoser(monitor, scenario.causes, prior=artifact.models["prior"]),
        Loops(artifact, noise_of(artifact), given.keep),
    )
    for plan in fault_plans(FAULTS, given.seeds, 500):
        for text in said(monitor, diagnoser, loops.run(plan), plan.onset, given.after):
            print(f"{plan.case} {plan.seed}, {text}", flush=True)


if __name__ == "__main__":
    main()
