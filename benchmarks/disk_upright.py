"""What the disk's models know of the top, where nothing was recorded: ``python benchmarks/disk_upright.py RUN``.

The MPC on the prior sways the simulated disk about the top (task ``track_up``, three seeds). Along these loops both
models of a run predict from the true state, every second sample, hidden state followed from the start. Printed: mean
and root mean square error of the angle after so many periods. RUN is the folder of ``hybrid-mpc run unbalanced_disk``;
for networks without prior_replay give that run ``--settings FILE`` with ``{"prior_replay": 0}`` in the file.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from pathlib import Path

import numpy as np

from hybrid_mpc import Bench, Study, load_scenario
from hybrid_mpc.job.study_run import load_models

AHEAD = (1, 4, 10, 20)
FOLLOWED = 20
"""Periods after which the hidden state has followed the loop."""


def errors(model, loop, ahead: int) -> np.ndarray:
    """Angle's error [rad] after ``ahead`` periods from every second state of a loop."""
    h, hidden = np.zeros(model.n_h), []
    for x, u in zip(loop.x, loop.u, strict=True):
        hidden.append(h)
        h = model.step(x, h, u, model.w, model.p)[1]
    found = []
    for k in range(FOLLOWED, len(loop.t) - ahead, 2):
        x, h = loop.x[k], hidden[k]
        for u in loop.u[k : k + ahead]:
            x, h = model.step(x, h, u, model.w, model.p)
        found.append(float(x[0]) - loop.x[k + ahead, 0])
    return np.array(found)


def main() -> None:
    """Print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of hybrid-mpc run unbalanced_disk")
    study = Study(
        "unbalanced_disk",
        parser.parse_args().run,
        tasks=("track_up",),
        controllers=("prior",),
        seeds=3,
        run_seed=5,
    )
    kit = load_models(study)["model"].kit
    bench = Bench(load_scenario("unbalanced_disk"), {"model": kit})
    loops = [bench.run(spec)[1] for spec in study.runs()]
    print("| periods ahead | model | mean [mrad] | RMS [mrad] |\n| ---: | --- | ---: | ---: |")
    for ahead in AHEAD:
        for name in ("prior", "hybrid"):
            e = 1e3 * np.concatenate([errors(kit.models[name], loop, ahead) for loop in loops])
            print(f"| {ahead} | {name} | {e.mean():.2f} | {np.sqrt(np.mean(e**2)):.2f} |")


if __name__ == "__main__":
    main()
