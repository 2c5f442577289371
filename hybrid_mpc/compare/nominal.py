"""Nominal loops of a simulated machine, from which limits are learned, and the faults that are simulated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hybrid_mpc.compare.loops import MODEL, LoopSpec
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.loop.faults import Fault, install
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.scenario import Budget, Scenario, Task
from hybrid_mpc.watch.lengths import block_seconds, settling_samples

CONTROLLER = "hybrid_observer"
"""The controller of these loops."""
BLOCKS = 9
"""Whole blocks (of five time constants of the machine) in a loop. Four such loops suffice for a threshold of two false
alarms an hour, eight loops for one."""
FEWEST, MOST = 4, 16
"""Smallest and largest number of loops; in between, one loop for each seed of the budget."""
SMALLEST = 0.6
"""The reference of each round is scaled by a random factor from here to 1, so rounds differ."""
AGEING, DRIFT_S = (1.0, 1.1, 0.9), 30.0
"""If the plant has friction, it drifts by these factors in turn, within 30 time constants of the machine. A monitor
must not alarm because of such ageing."""
WEAKER = 0.8
"""Remaining share of the force of a weakened actuator."""
LOAD = 0.2
"""Unknown load at the first input, as a share of half the input's range."""


def nominal_tasks(scenario: Scenario) -> list[Task]:
    """Tracking tasks without faults; if there are none, other tasks without faults.

    Raises:
        InputError: If every task has a fault.
    """
    calm = [task for task in scenario.tasks if not task.faults]
    tasks = [task for task in calm if task.weight is None] or calm
    if not tasks:
        raise InputError(
            f"scenario {scenario.name}: every task has a fault. Add a task without faults to learn limits from "
            "[HM-COMPARE-019]"
        )
    return tasks


def nominal_loops(
    scenario: Scenario, budget: Budget, model: HybridModel, *, named: str = "", run_seed: int = 0
) -> list[LoopSpec]:
    """The nominal loops of a budget: fault-free tasks in turn, each round with its own factor.

    Raises:
        InputError: If every task has a fault.

    Example:
        >>> from types import SimpleNamespace
        >>> from hybrid_mpc.scenario import load_scenario
        >>> golf, model = load_scenario("golf_robot"), SimpleNamespace(dt=0.02, time_unit=1.0)
        >>> loops = nominal_loops(golf, golf.budgets["quick"], model)
        >>> [(loop.task, [fault.value for fault in loop.faults]) for loop in loops]  # doctest: +NORMALIZE_WHITESPACE
        [('track_sine', []), ('track_step', [1.1]), ('track_sine', [0.9]), ('track_step', []), ('track_sine', [1.1]),
         ('track_step', [0.9])]
    """
    tasks, unit = nominal_tasks(scenario), model.time_unit
    ages = AGEING if knows(scenario, "plant_friction") else AGEING[:1]
    blocks = BLOCKS * max(round(block_seconds(model.dt, unit) / model.dt), 1)
    seconds, found = (settling_samples(model) + blocks) * model.dt, []
    for i in range(min(max(budget.seeds, FEWEST), MOST)):
        # first seed of these loops; compared loops have smaller seeds
        task, friction, seed = tasks[i % len(tasks)], ages[i % len(ages)], 500 + i
        drift = Fault(0.0, math.inf, "plant_friction", friction, ramp=DRIFT_S * unit)
        shares = np.random.default_rng([run_seed, seed]).uniform(
            SMALLEST, 1.0, math.ceil(seconds / task.duration)
        )
        found.append(
            LoopSpec(
                named or scenario.name, MODEL, task.name, CONTROLLER, monitor="none", seed=seed, duration=seconds,
                faults=() if friction == 1.0 else (drift,), run_seed=run_seed, rounds=tuple(shares.tolist()),
                keep=("t", "y", "u", "w"),
            )
        )  # fmt: skip
    return found


def stage_of(spec: LoopSpec) -> str:
    """Name of a nominal loop's file in ``checkpoints``."""
    return f"nominal/{spec.task}-{spec.seed}"


def knows(scenario: Scenario, target: str) -> bool:
    """Whether the scenario's plant supports a fault ``target`` of its own."""
    if scenario.plant is None:
        return False
    try:
        install(scenario.plant(), (Fault(0.0, 1.0, target, 1.0),))
    except InputError:
        return False
    return True


@dataclass(frozen=True)
class Broken:
    """A simulated fault: short name, description, and the fault."""

    name: str
    title: str
    fault: Fault


def broken(scenario: Scenario, model: HybridModel, control: OCP, start: float) -> list[Broken]:
    """The simulated faults, which begin at ``start`` [s]: friction doubles (if the plant supports it), each actuator
    loses a fifth of its force, an unknown load at the first input, each sensor freezes.

    Example:
        >>> from types import SimpleNamespace as Some
        >>> model = Some(inputs=[Some(name="u")], outputs=[Some(name="phi")])
        >>> ocp = OCP(9, [1.0], [1.0], [1.0], u_min=[-1.0], u_max=[1.0])
        >>> for one in broken(Some(plant=None), model, ocp, 3.0):
        ...     print(one.title, one.fault.target, one.fault.value)
        u loses a fifth of its force input_gain 0.8
        a load of 0.2 at u input_offset 0.2
        the sensor of phi freezes measurement_freeze 0.0
    """
    load, first = LOAD * 0.5 * float(control.input_range[0]), model.inputs[0].name
    friction = [("friction", "friction doubles", "plant_friction", 2.0, "")]
    cases = [
        *(friction if knows(scenario, "plant_friction") else []),
        *(
            (f"weak_{s.name}", f"{s.name} loses a fifth of its force", "input_gain", WEAKER, s.name)
            for s in model.inputs
        ),
        ("load", f"a load of {load:.3g} at {first}", "input_offset", load, first),
        *(
            (f"freeze_{s.name}", f"the sensor of {s.name} freezes", "measurement_freeze", 0.0, s.name)
            for s in model.outputs
        ),
    ]
    return [
        Broken(name, title, Fault(start, math.inf, target, value, channel))
        for name, title, target, value, channel in cases
    ]
