"""Stage on_model: closed loops on a model, for a scenario without plant. They say nothing about the machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hybrid_mpc.compare.controllers import OBSERVERS
from hybrid_mpc.compare.loops import DRAWN, MODEL, LoopSpec, arrays_of, stand_in
from hybrid_mpc.compare.summary import ClosedLoops
from hybrid_mpc.compare.tasks import tasks_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.parts import loop_settings
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.compare import run_or_read, task_content
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, observed


@dataclass(frozen=True)
class OnModelResult(ClosedLoops):
    """Closed loops for a scenario without plant, each on another model than the controller's own.

    They show whether two models agree, and nothing about the machine. Each controller has another plant, so do not
    compare their figures.

    Args:
        left_out: Why a controller has no loops, by controller.
        default_tasks: Whether the tasks are default ones: the scenario declares none.
    """

    left_out: Mapping[str, str]
    default_tasks: bool


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
    left_out: dict[str, str] = {}
    for name in OBSERVERS:
        try:
            stand_in(context.kit, name)
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
        for name in OBSERVERS
        if name not in left_out
    }  # fmt: skip
    found = run_or_read(context, parts)
    rows = [row for part in parts for row in found[part]]
    return OnModelResult(tuple(rows), left_out, not context.scenario.tasks, arrays=arrays_of(rows))


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


LOOPS_ON_MODEL = Stage(
    "on_model", "closing the loop on the model", OnModelResult, on_model_stage, what_on_model_reads, (EXPORT, NOISE),
    optional=True,
)  # fmt: skip
