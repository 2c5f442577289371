"""``hybrid-mpc control``: closed loops of a finished model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import ScenarioName
from hybrid_mpc.rules import MOST_SEED, time_text

if TYPE_CHECKING:
    from hybrid_mpc.compare.loops import LoopRow
    from hybrid_mpc.workflow.control import ControlResults

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc control golf_robot --model runs/golf/model --out loops\n\n"
    "  hybrid-mpc control golf_robot --model runs/golf/model --task stroke --controller prior_observer "
    "--controller hybrid_observer --solver sqp --seeds 5 --out strokes\n\n"
    "  hybrid-mpc control golf_robot --model runs/golf/model --task track_sine --fault plant_friction=2@1.5 "
    "--out worn\n\n"
    "  hybrid-mpc control golf_robot --model runs/golf/model --task track_sine --fault measurement_freeze@3 --guard "
    "--out frozen"
)


def control(
    scenario: ScenarioName,
    model: Annotated[Path, typer.Option(help="Artifact folder, e.g. model/ of a finished run.")],
    out: Annotated[Path, typer.Option(help="Folder to create.")],
    task: Annotated[
        list[str] | None,
        typer.Option(help="A task, or the beginning of task names; may be repeated. Default: all."),
    ] = None,
    controller: Annotated[
        list[str] | None,
        typer.Option(
            help="A controller; may be repeated. Default: prior_observer (not with --guard) and hybrid_observer."
        ),
    ] = None,
    solver: Annotated[str, typer.Option(help="rti, native, sqp or ipopt.")] = "rti",
    seeds: Annotated[int, typer.Option(help="Number of loops per task and controller.", min=1)] = 10,
    seed: Annotated[int, typer.Option(help="First seed of the loops.", min=0, max=MOST_SEED)] = 0,
    fault: Annotated[
        list[str] | None, typer.Option(help="TARGET:CHANNEL=VALUE@START:END, in every loop; may be repeated.")
    ] = None,
    guard: Annotated[
        bool,
        typer.Option(
            "--guard", help="Use the model's fault monitor; the safe input acts while a sensor is frozen."
        ),
    ] = False,
    adapt: Annotated[
        bool,
        typer.Option(
            "--adapt",
            help="As --guard, with a backup model that adapts mass and friction (the scenario's causes).",
        ),
    ] = False,
    share: Annotated[
        float | None,
        typer.Option(
            help=(
                "Initial share of the network's correction in blended_observer, from 0 to 2. Default: 1, if the hybrid "
                "is recommended."
            )
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Finish the loops in an existing folder.")] = False,
    gif: Annotated[bool, typer.Option("--gif/--no-gif", help="Draw animations.")] = True,
) -> None:
    """Close the loop around the simulated machine with a trained model; nothing is trained.

    If the machine has no plant, a model replaces it; the results then describe that model, not the machine.
    """
    from hybrid_mpc.cli.progress import make_progress, print_summary
    from hybrid_mpc.compare.study import DEFAULT_CONTROLLERS, Study
    from hybrid_mpc.kit.promises import promise_lines
    from hybrid_mpc.workflow.control import run_control

    guarded = guard or adapt
    controllers = controller or (("hybrid_observer",) if guarded else DEFAULT_CONTROLLERS)
    study = Study(
        scenario, model, tuple(task or ()), tuple(dict.fromkeys(controllers)), (solver,),
        monitors=("guard" if guarded else "own",), faults=(" + ".join(fault or ()),), seeds=seeds, run_seed=seed,
        guard="adapt" if adapt else "rest" if guard else "", share=share,
    )  # fmt: skip
    with make_progress() as progress:
        results = run_control(study, out, progress, gif=gif, resume=resume)
    print_summary([*summary(results), *promise_lines(results.promises)], out / "results.json")


def summary(results: ControlResults) -> list[str]:
    """One line per task and controller; for loops on models, a table per controller."""
    if len(results.loops.plants) > 1:
        parts = (_of_controller(results, name) for name in results.loops.plants)
        return [line for part in parts for line in summary(part)]
    said = [f"{name} on the model {plant}, not the machine:" for name, plant in results.loops.plants.items()]
    cells = [cell for row in results.loops.means.values() for cell in row.values()]
    signals = {s: max(len(s) + 5, 11) for s in dict.fromkeys(s for cell in cells for s in cell.tracking_rmse)}
    heads = " ".join(f"{'RMSE ' + s:>{width}}" for s, width in signals.items())
    lines = [*said, f"{'task':16} {'controller':16} {'cost':>10} {'95 %':>10} {heads} {'solved':>8}"]
    for task, row in results.loops.means.items():
        for name, cell in row.items():
            cost = cell.cost
            means = {s: found.mean for s, found in cell.tracking_rmse.items()}
            errors = " ".join(f"{_number(means.get(s)):>{width}}" for s, width in signals.items())
            lines.append(
                f"{task:16} {name:16} {_number(cost.mean):>10} {_number(cost.ci95, '±'):>10} {errors} "
                f"{100 * cell.sources['MPC']:>6.1f} %"
            )
    lines += [line for row in results.loops.rows if results.note.study["guard"] for line in _guarded(row)]
    for name, times in results.step_ms.items():
        lines.append(
            f"step time of {name}: median {time_text(times.median)}, 99 % within {time_text(times.p99)}, period "
            f"{time_text(times.period)}"
        )
    return lines


def _of_controller(results: ControlResults, name: str) -> ControlResults:
    rows = tuple(row for row in results.loops.rows if row.controller == name)
    return replace(results, step_ms={name: results.step_ms[name]}, loops=replace(results.loops, rows=rows))


def _guarded(row: LoopRow) -> list[str]:
    """Alarms and mode switches of the guard in one loop."""
    invalid = row.invalid_s or 0.0
    rest = f"; no valid reading for {invalid:.2f} s" if invalid else ""
    if not row.alarms:
        return [f"guard, {row.task}, seed {row.seed}: no alarm{rest}"]
    when = ", ".join(f"{a.start_s:.2f} to {a.end_s:.2f} s" for a in row.alarms)
    modes = "".join(f"; {s.after.lower()} from {s.t_s:.2f} s on" for s in row.switches)
    return [f"guard, {row.task}, seed {row.seed}: alarm {when}{modes}{rest}"]


def _number(value: float | None, sign: str = "") -> str:
    return "-" if value is None else f"{sign}{value:.4g}"
