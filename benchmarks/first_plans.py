"""First plans of a run's tasks by `sqp`: iterations, time and cost, with and without the phase that keeps the states.

    hybrid-mpc run golf_robot --budget quick --out runs/golf_robot
    python benchmarks/first_plans.py --run runs/golf_robot [--tasks stroke_1.9 stroke_3 stroke_4]

Every plan starts from rest and from inputs that hold it there, with the model that the run calls ``hybrid``. *runs
alone*: every iterate is a run of the model, as all of later plans are.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

import numpy as np
from parts import arguments, report

import hybrid_mpc as hm
from hybrid_mpc.control import sqp


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--run", type=Path, required=True, help="folder of a run")
    parser.add_argument("--tasks", nargs="+", help="only these")
    given = parser.parse_args()
    kit = hm.load(given.run)
    scenario = hm.load_scenario(kit.name)
    kit, rows, phase = kit.on(scenario), [], sqp.LIFTED
    model = kit.models["hybrid"]
    for task in scenario.tasks:
        if given.tasks and task.name not in given.tasks:
            continue
        ocp, observer = kit.problem(task.name), kit.observer("hybrid", task=task.name)
        t = model.dt * np.arange(ocp.horizon + 1)
        estimate = observer.start(model.output(task.x0, model.u0, model.w, model.p).full().ravel())
        row = {"task": task.name}
        for name, most in (("runs alone", 0), ("", phase)):
            sqp.LIFTED = most
            controller = hm.SQPController(model, ocp)
            begin = perf_counter()
            plan = controller.solve(
                controller.initial(estimate),
                estimate,
                task.reference(t),
                task.weight(t) if task.weight else None,
            )
            found = {"iterations": plan.iterations, "s": f"{perf_counter() - begin:.2f}", "cost": f"{plan.cost:.4g}",
                     "status": plan.status.name}  # fmt: skip
            row |= {f"{key}, {name}".strip(", "): value for key, value in found.items()}
        rows.append(row)
    report(rows, given.out)


if __name__ == "__main__":
    main()
