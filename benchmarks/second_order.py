"""L-BFGS on the full batch against AdamW on small ones, for the networks of a run.

``python benchmarks/second_order.py --run runs/demo [--seconds 30] [--windows 256]``: the PGRNNs of a golf robot's run,
trained again from its fitted prior. All begin with the teacher forcing of the budget. Then free runs: AdamW with its
steps, L-BFGS (history 20, strong Wolfe line search, one for all networks, which do not depend on each other) on
``--windows`` windows at once, until ``--seconds`` of processor time have passed. Validation error of each network,
looked at as in a training; one thread.
"""

from __future__ import annotations

from pathlib import Path
from time import process_time

import torch
from parts import arguments, report

from hybrid_mpc import RunSettings, load_scenario
from hybrid_mpc.identify.train import TrainingRun
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stages.identify import training_settings

EVERY = 25


def begun(context: Context) -> TrainingRun:
    """A training after its teacher forcing."""
    prior = context.scenario.prior(context.prior.fit.values)
    run = TrainingRun(
        prior, context.smoothed("train"), context.smoothed("valid"), training_settings(context, "pgrnn")
    )
    run.enter_stage()
    steps(run, run.settings.teacher_steps)
    run.enter_stage()
    return run


def steps(run: TrainingRun, count: int) -> None:
    """Steps of AdamW, looked at as a training does."""
    for k in range(count):
        run.update()
        if (k + 1) % EVERY == 0:
            run.evaluate()


def second_order(run: TrainingRun, windows: int, until: float) -> None:
    """L-BFGS on the mean error of windows of the whole training data, over that at its start."""
    chosen = torch.linspace(0, len(run.windows) - 1, windows).round().long().unique()
    batch, weights = run.windows.take(chosen), list(run.weights.values())
    first = run._losses(batch, 1)[:, 0].detach()
    optimizer = torch.optim.LBFGS(weights, max_iter=5, history_size=20, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = (run._losses(batch, 1)[:, 0] / first).sum()
        value = value + 0.5 * run.decay * sum(w.square().sum() for w in weights)
        value.backward()
        return value

    while process_time() < until:
        optimizer.step(closure)
        run.evaluate()


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--run", type=Path, required=True, help="folder of a run of the golf robot")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--windows", type=int, default=256)
    given = parser.parse_args()
    torch.set_num_threads(1)
    context = Context(RunSettings("golf_robot"), load_scenario("golf_robot"), given.run)
    rows = []
    for name in ("AdamW", "L-BFGS"):
        start = process_time()
        run = begun(context)
        if name == "AdamW":
            steps(run, run.settings.free_run_steps)
        else:
            second_order(run, given.windows, start + given.seconds)
        errors = {f"network {i}": round(float(e), 4) for i, e in enumerate(run.best)}
        rows.append({"optimizer": name, "processor time [s]": round(process_time() - start, 1), **errors})
    report(rows, given.out)


if __name__ == "__main__":
    main()
