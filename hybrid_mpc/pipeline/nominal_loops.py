"""Nominal loops that the energy guard is learned from: the tasks, over and over, under the hybrid MPC."""

from __future__ import annotations

import math

import numpy as np

from hybrid_mpc.closed_loop.faults import Fault, install
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.loops import MODEL, LoopSpec
from hybrid_mpc.model import HybridModel
from hybrid_mpc.monitor.lengths import SETTLING_S, block_seconds, samples
from hybrid_mpc.scenario import Budget, Scenario, Task

CONTENDER = "hybrid_observer"
"""The controller that the guard is for."""
BLOCKS = 9
"""Whole blocks (of five of the machine's seconds) in a loop. Four such loops carry two false alarms an hour, eight
carry one."""
FEWEST, MOST = 4, 16
"""Loops: two for each seed of the budget, within these."""
FIRST_SEED = 500
"""Their numbers begin here, away from those of the compared loops."""
SMALLEST = 0.6
"""Every time round, the reference is scaled by a factor drawn from here to 1: no two rounds are alike."""
AGEING, DRIFT_S = (1.0, 1.1, 0.9), 30.0
"""Where the plant knows it, friction drifts to these shares, in turn, within so many of the machine's seconds:
ageing, of which the guard is to say nothing."""


def nominal_tasks(scenario: Scenario) -> list[Task]:
    """Tracking tasks in which nothing goes wrong; if there are none, other tasks without faults.

    Raises:
        InputError: If something goes wrong in every task.
    """
    calm = [task for task in scenario.tasks if not task.faults]
    tasks = [task for task in calm if task.weight is None] or calm
    if not tasks:
        raise InputError(
            f"scenario {scenario.name}: every task brings a fault; the guard is learned from one without"
        )
    return tasks


def nominal_loops(
    scenario: Scenario, budget: Budget, model: HybridModel, *, named: str = "", run_seed: int = 0
) -> list[LoopSpec]:
    """The loops of a budget: calm tasks in turn, each round of them scaled by its own share.

    Args:
        scenario: The machine.
        budget: Whose seeds tell how many.
        model: The model, whose period and unit of time count.
        named: Registered name or path of the scenario. Default: its own name.
        run_seed: Seed of the run. Default 0.

    Raises:
        InputError: If something goes wrong in every task.

    Example:
        >>> from types import SimpleNamespace
        >>> from hybrid_mpc.scenario import load_scenario
        >>> golf, model = load_scenario("golf_robot"), SimpleNamespace(dt=0.02, time_unit=1.0)
        >>> loops = nominal_loops(golf, golf.budgets["quick"], model)
        >>> [(loop.task, [fault.value for fault in loop.faults]) for loop in loops]
        [('track_sine', []), ('track_step', [1.1]), ('track_sine', [0.9]), ('track_step', [])]
    """
    tasks, unit = nominal_tasks(scenario), model.time_unit
    ages = AGEING if knows(scenario, "plant_friction") else AGEING[:1]
    blocks = BLOCKS * max(round(block_seconds(model.dt, unit) / model.dt), 1)
    seconds, found = (samples(SETTLING_S, model) + blocks) * model.dt, []
    for i in range(min(max(2 * budget.seeds, FEWEST), MOST)):
        task, friction, seed = tasks[i % len(tasks)], ages[i % len(ages)], FIRST_SEED + i
        drift = Fault(0.0, math.inf, "plant_friction", friction, ramp=DRIFT_S * unit)
        shares = np.random.default_rng([run_seed, seed]).uniform(
            SMALLEST, 1.0, math.ceil(seconds / task.duration)
        )
        found.append(
            LoopSpec(
                named or scenario.name, MODEL, task.name, CONTENDER, monitor="readings", seed=seed, duration=seconds,
                faults=() if friction == 1.0 else (drift,), run_seed=run_seed, rounds=tuple(shares.tolist()),
                keep=("numbers", "y", "u"),
            )
        )  # fmt: skip
    return found


def stage_of(spec: LoopSpec) -> str:
    """Name of a nominal loop's checkpoint.

    Args:
        spec: The loop.
    """
    return f"guard/{spec.task}-{spec.seed}"


def knows(scenario: Scenario, target: str) -> bool:
    """Whether the scenario's plant can show a fault of its own."""
    if scenario.plant is None:
        return False
    try:
        install(scenario.plant(), (Fault(0.0, 1.0, target, 1.0),))
    except InputError:
        return False
    return True
