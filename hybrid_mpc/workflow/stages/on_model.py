"""Stage on_model: closed loops on a model, for a scenario without plant. They say nothing about the machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.controllers import OBSERVERS
from hybrid_mpc.compare.loops import DRAWN, MODEL, LoopRow, LoopSpec, arrays_of, stand_in, with_arrays
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.parts import loop_settings
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.compare import run_or_read, task_content
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, observed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OnModelResult:
    """Closed loops on models.

    Args:
        plants: Name of the model in place of the machine, by controller.
        left_out: Why a controller has no loops, by controller.
        default_tasks: Whether the tasks are default ones: the scenario declares none.
        rows: The loops by task, controller and seed.
        arrays: Signals that are drawn, ``"NUMBER/NAME"`` with the number of the row.
    """

    plants: Mapping[str, str]
    left_out: Mapping[str, str]
    default_tasks: bool
    rows: tuple[LoopRow, ...]
    arrays: Mapping[str, Array] = field(default_factory=dict)

    @property
    def drawn(self) -> list[LoopRow]:
        """The loops whose signals were kept, with their signals."""
        return [row for row in with_arrays(self.rows, self.arrays) if row.arrays]


def on_model_stage(context: Context) -> OnModelResult | Absent:
    """Every task on another model than the controller's; only for a scenario without plant."""
    if context.scenario.control is None:
        return Absent(f"scenario {context.scenario.name} defines no control problem")
    if context.scenario.plant is not None:
        return Absent("the scenario has a plant; its closed loops are in section Closed loops")
    context.read(NOISE)
    try:
        tasks = tasks_of(context.ready, context.budget.tasks)
    except InputError as none:
        return Absent(str(none))
    settings = context.settings
    plants: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for name in OBSERVERS:
        try:
            plants[name] = stand_in(context.kit, name).model.name
        except InputError as none:
            left_out[name] = str(none)
    parts = {
        f"on_model/{task.name}-{name}": [
            LoopSpec(
                settings.scenario, MODEL, task.name, name, seed=seed, run_seed=settings.seed,
                keep=DRAWN if seed == 0 else (),
            )
            for seed in range(context.budget.seeds)
        ]
        for task in tasks
        for name in plants
    }  # fmt: skip
    found = run_or_read(context, parts)
    rows = [row for part in parts for row in found[part]]
    return OnModelResult(
        plants,
        left_out,
        not context.scenario.tasks,
        tuple(replace(row, arrays={}) for row in rows),
        arrays_of(rows),
    )


def what_on_model_reads(context: Context) -> dict[str, object]:
    """Tasks, estimators, control problem, and number of the loops."""
    scenario, budget = context.scenario, context.budget
    read: dict[str, object] = {
        **observed(context),
        "control problem": scenario.control,
        "a plant": scenario.plant is not None,
        "seed": context.settings.seed,
        "number of loops": (budget.seeds, budget.tasks),
    }
    if scenario.plant is not None or scenario.control is None:
        return read
    try:
        whole = context.ready
    except InputError as none:  # the stage says so
        return {**read, "tasks": str(none)}
    loop = loop_settings(whole)
    for task in tasks_of(whole, budget.tasks):
        read[f"task {task.name}"] = task_content(task, context.spec.dt, loop)
    return read


def by_controller(rows: Sequence[LoopRow]) -> dict[str, list[LoopRow]]:
    """The loops by controller: each controller has another plant, so they must not be compared."""
    return {name: [row for row in rows if row.controller == name] for name in OBSERVERS}


LOOPS_ON_MODEL = Stage(
    "on_model", "closing the loop on the model", OnModelResult, on_model_stage, what_on_model_reads, (EXPORT, NOISE),
    optional=True,
)  # fmt: skip
