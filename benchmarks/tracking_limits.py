"""What limits tracking: prediction or estimation? Prior and hybrid on estimates of different quality.

``python benchmarks/tracking_limits.py --model DIR [--task NAME ...] [--seeds 5]``. The golf
robot's tasks under the controllers of the main job; only the estimate changes: the plant's true state (the model's
hidden state run along it), the filter without observer, and with it. What is left with the true state is what the model
predicts wrongly; what comes on top is the estimate. Printed: mean costs and their standard deviations over the seeds,
which are none of the main job's.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_mpc import Estimate, HybridModel, TrueState, load, make_controller, make_estimator, simulate
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

FIRST_SEED = 8001


class TrueX(TrueState):
    """The plant's true x; the model's hidden state follows from its own step along it."""

    def start(self, y, t=0.0) -> Estimate:
        """Truth with a hidden state of zero, as at the start of every training window."""
        m = self.model
        p, empty = np.zeros((m.n_x + m.n_h + m.n_u,) * 2), np.full(m.n_y, np.nan)
        x = np.asarray(y, dtype=float).ravel()[: m.n_x]
        return Estimate(float(t), x, np.zeros(m.n_h), np.zeros(m.n_u), p, empty, float("nan"))

    def predict(self, estimate, u) -> Estimate:
        """The model's step."""
        x, h = (
            v.full().ravel()
            for v in self.model.step(
                estimate.x, estimate.h, np.asarray(u, dtype=float), self.model.w, self.model.p
            )
        )
        return replace(estimate, t=estimate.t + self.model.dt, x=x, h=h)

    def correct(self, estimate, y, u=None) -> Estimate:
        """The true x at the estimate's own instant."""
        return replace(estimate, x=np.asarray(y, dtype=float).ravel()[: self.model.n_x])

    def update(self, estimate, y, u_prev) -> Estimate:
        """The truth one period later."""
        return self.correct(self.predict(estimate, u_prev), y)


def costs(models: dict[str, HybridModel], name: str, kind: str, noise, task, seeds) -> list[float]:
    """Costs of a task's loops; ``kind`` is ``truth``, ``filter`` or ``observer``."""
    model, control = models[name], task.control or CONTROL
    key = f"{name}_observer" if kind == "observer" else name
    estimator = (
        TrueX(model)
        if kind == "truth"
        else make_estimator(model, scenario, np.array(noise[key]), control, observer=kind == "observer")
    )
    controller = make_controller(model, models["prior"], control)
    return [
        simulate(
            scenario.plant(), estimator, controller, task.reference, weight=task.weight, dt=model.dt,
            duration=task.duration, x0=np.array(task.x0), seed=seed, faults=task.faults,
        ).cost
        for seed in seeds
    ]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder")
    parser.add_argument("--task", nargs="+", default=["track_sine", "track_step"])
    parser.add_argument("--seeds", type=int, default=5)
    given = parser.parse_args()
    kit = load(given.model)
    models, noise = kit.models, kit.loop.process_noise
    seeds = range(FIRST_SEED, FIRST_SEED + given.seeds)
    print("| task | model | true state | filter | filter with observer |\n| --- | --- | ---: | ---: | ---: |")
    for task in (t for t in scenario.tasks if t.name in given.task):
        for name in ("prior", "hybrid"):
            found = [
                costs(models, name, kind, noise, task, seeds) for kind in ("truth", "filter", "observer")
            ]
            cells = " | ".join(f"{np.mean(c):.4f} ± {np.std(c, ddof=1):.4f}" for c in found)
            print(f"| {task.name} | {name} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
