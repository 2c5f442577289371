"""The real-time iteration as compiled C against the same in Python, by turns in one process; no estimator in it.

The golf robot with a GRU of random weights, N = 50, |u| bounded: whole step (prepare and feedback) and feedback alone,
median and 99th percentile, along the states of one closed loop, each solver from its own last plan. "C alone" are the
C functions without what Python does around them. "Input differs" is the largest difference of a plan's inputs where
both are handed the same last plan; on random weights plans of their own part by and by.

    python benchmarks/native.py --out native.json
    python benchmarks/native.py --soft        # two soft bounds on states, active
"""

from __future__ import annotations

import ctypes
from time import perf_counter

import numpy as np
from parts import REFERENCE, SKIPPED, arguments, closed_loop, deployed, hybrid_step, problem, report

from hybrid_mpc import CondensedController
from hybrid_mpc.embedded.native import FLAGS, NativeController, goal_of

SOFT = {"x_min": [-0.35, -1.5], "x_max": [0.55, 1.2]}
PORTABLE = ("-std=c11", "-O3", "-ffp-contract=off")


def times(controller, states, rounds, clock=perf_counter):
    """Whole steps and feedbacks [ms] along the states."""
    whole, feedback = [], []
    for _ in range(rounds):
        plan = controller.initial(states[0])
        for k, e in enumerate(states):
            start = clock()
            prepared = controller.prepare(plan)
            middle = clock()
            plan = controller.finish(prepared, e, REFERENCE)
            end = clock()
            if k >= SKIPPED:
                whole.append(1e3 * (end - start))
                feedback.append(1e3 * (end - middle))
    return np.array(whole), np.array(feedback)


def bare(controller, states, rounds, clock=perf_counter):
    """The C functions alone [ms]: whole and feedback."""
    c, state, rows = controller._library.c, controller._state, np.ascontiguousarray(REFERENCE)
    goal = goal_of(rows)
    at = ctypes.byref(goal)
    whole, feedback = [], []
    for _ in range(rounds):
        plan = controller.initial(states[0])
        controller._load(plan)
        for k, e in enumerate(states):
            for name, value in zip("xhd", (e.x, e.h, e.d), strict=True):
                state.view[name][:] = value
            start = clock()
            c.hmpc_prepare(state.at, at)
            middle = clock()
            c.hmpc_feedback(state.at, at, None, 0)
            end = clock()
            if k >= SKIPPED:
                whole.append(1e3 * (end - start))
                feedback.append(1e3 * (end - middle))
    controller._ticket += 1
    return np.array(whole), np.array(feedback)


def difference(python, native, states):
    """Largest difference of the plans' inputs, from the same last plans."""
    plan, largest = python.initial(states[0]), 0.0
    for e in states:
        found, plan = native.solve(plan, e, REFERENCE), python.solve(plan, e, REFERENCE)
        largest = max(largest, float(np.max(np.abs(found.u - plan.u))))
    return largest


def main() -> None:
    """Time and print."""
    parser = arguments(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--soft", action="store_true", help="two soft bounds on states")
    given = parser.parse_args()
    rows = []
    for z in given.sizes:
        model, ocp = deployed(hybrid_step(z)), problem(50, **(SOFT if given.soft else {}))
        solvers = {
            "rti, Python": CondensedController(model, ocp),
            "native, -O3 -march=native": NativeController(model, ocp, flags=FLAGS),
            "native, -O3": NativeController(model, ocp, flags=PORTABLE),
        }
        states = closed_loop(model, ocp)
        found = {name: ([], []) for name in solvers}
        alone = {name: ([], []) for name in solvers}
        for _ in range(given.rounds):
            for name, solver in solvers.items():  # by turns
                for kept, values in zip(found[name], times(solver, states, 1), strict=True):
                    kept.append(values)
                if isinstance(solver, NativeController):
                    for kept, values in zip(alone[name], bare(solver, states, 1), strict=True):
                        kept.append(values)
        python = solvers["rti, Python"]
        for name in solvers:
            whole, feedback = (np.concatenate(v) for v in found[name])
            row = {"z": z, "solver": name}
            for what, spent in (("whole", whole), ("feedback", feedback)):
                row |= {
                    f"{what} [ms]": float(np.median(spent)),
                    f"{what} p99": float(np.quantile(spent, 0.99)),
                }
            inner = [float(np.median(np.concatenate(v))) if v else float("nan") for v in alone[name]]
            row |= {"C alone, whole": inner[0], "C alone, feedback": inner[1]}
            row["input differs"] = difference(python, solvers[name], states)
            rows.append(row)
    report(rows, given.out, soft=given.soft)


if __name__ == "__main__":
    main()
