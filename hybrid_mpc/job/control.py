"""What ``hybrid-mpc control`` writes: results.json (docs/control.md) and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import check_folder, write_json
from hybrid_mpc.job.controllers import CONTROLLERS, ORACLES, find_noise
from hybrid_mpc.job.loops import (
    MODEL,
    Bench,
    LoopRow,
    LoopSpec,
    check_complete,
    check_faults,
    check_kit,
    summaries,
)
from hybrid_mpc.job.stages.export import versions
from hybrid_mpc.kit.artifact import Kit, artifact_folder, load
from hybrid_mpc.kit.assembly import SOLVERS, adaptable
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.loop.realtime import percentiles
from hybrid_mpc.loop.simulate import ClosedLoopResult, Step
from hybrid_mpc.records import plain
from hybrid_mpc.scenario import Scenario, Task

if TYPE_CHECKING:
    from hybrid_mpc.job.context import Progress


# Closed loops of an artifact that exists, without the run that made it: settings, parts and loops.

Array = NDArray[np.float64]
DEFAULT_CONTROLLERS = ("prior_observer", "hybrid_observer")
GUARDED_CONTROLLERS = ("hybrid_observer",)
WITHOUT_VALUE = ("measurement_freeze", "measurement_dropout")
"""Faults that are not large or small."""
REACTIONS = ("rest", "adapt")
"""What ``hybrid-mpc control --guard`` and ``--adapt`` do."""


@dataclass(frozen=True)
class ControlSettings:
    """What ``hybrid-mpc control`` runs.

    Args:
        tasks: Names, or beginnings of names, of tasks. Default: all.
        controllers: Names of controllers.
        solver: ``"rti"``, ``"sqp"`` or ``"ipopt"``; oracles have their own.
        seeds: Loops of each task and controller.
        seed: Seed of the first loop, times 1000, as in the main job.
        faults: What goes wrong in every loop beside what the task itself brings.
        guard: ``"rest"``: the artifact's detector watches, and a frozen sensor takes the input away; ``"adapt"``: and
            an alarm that lasts hands over to a backup that estimates the prior's parameters. Default: not watched.

    Raises:
        InputError: If a controller or solver is unknown, an oracle is asked for with another solver, or a number
            is too small.

    Example:
        >>> ControlSettings(solver="newton")
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: no solver 'newton'; there are: rti, sqp, ipopt
    """

    tasks: tuple[str, ...] = ()
    controllers: tuple[str, ...] = DEFAULT_CONTROLLERS
    solver: str = "rti"
    seeds: int = 10
    seed: int = 0
    faults: tuple[Fault, ...] = field(default=())
    guard: str = ""

    def __post_init__(self) -> None:
        unknown = [name for name in self.controllers if name not in CONTROLLERS]
        if unknown or not self.controllers:
            given = f"no controller {', '.join(unknown)}" if unknown else "no controller is given"
            raise InputError(f"{given}; there are: {', '.join(CONTROLLERS)}")
        if self.solver not in SOLVERS:
            raise InputError(f"no solver {self.solver!r}; there are: {', '.join(SOLVERS)}")
        if self.guard not in ("", *REACTIONS):
            raise InputError(f"no guard {self.guard!r}; there are: {', '.join(REACTIONS)}")
        oracles = [name for name in self.controllers if name in ORACLES]
        if oracles and self.solver != "rti":
            raise InputError(
                f"controller {oracles[0]} has a solver of its own (several starts); leave --solver out or it"
            )
        others = [name for name in self.controllers if CONTROLLERS[name].model != "hybrid"]
        if self.guard and others:
            raise InputError(
                f"the guard watches with the hybrid, controller {others[0]} has another model; with --guard or --adapt "
                "give --controller hybrid_observer or hybrid alone"
            )
        if self.seeds < 1 or self.seed < 0:
            raise InputError(f"seeds must be 1 or more and seed not negative, got {self.seeds}, {self.seed}")


def selected_tasks(scenario: Scenario, names: Sequence[str]) -> tuple[Task, ...]:
    """The tasks of these names or, where there is none of a name, those whose names begin so; all for none.

    Raises:
        InputError: If nothing fits a name.

    Example:
        >>> from hybrid_mpc.scenario import load_scenario
        >>> [task.name for task in selected_tasks(load_scenario("golf_robot"), ["track", "stroke_4"])]
        ['track_sine', 'track_step', 'stroke_4']
    """
    if not names:
        return scenario.tasks
    chosen: dict[str, Task] = {}
    for name in names:
        fitting = [t for t in scenario.tasks if t.name == name] or [
            t for t in scenario.tasks if name and t.name.startswith(name)
        ]
        if not fitting:
            known = ", ".join(t.name for t in scenario.tasks) or "none"
            raise InputError(
                f"scenario {scenario.name}: no task {name!r}, none begins so; there are: {known}"
            )
        chosen |= {t.name: t for t in fitting}
    return tuple(t for t in scenario.tasks if t.name in chosen)


def parsed_fault(text: str) -> Fault:
    """A fault from ``TARGET[=VALUE][@START[:END]]``, times in seconds.

    Args:
        text: e.g. ``"input_gain=0.8@1.0"``; start 0 by default, end never. A sensor that freezes or drops out has no
            value, every other fault needs one.

    Raises:
        InputError: If it has another form, or there is no such fault.

    Example:
        >>> fault = parsed_fault("plant_friction=2@1:2.5")
        >>> fault.target, fault.value, fault.start, fault.end
        ('plant_friction', 2.0, 1.0, 2.5)
    """
    head, _, when = text.partition("@")
    target, _, value = head.partition("=")
    start, _, end = when.partition(":")
    try:
        numbers = [float(v) if v else d for v, d in ((start, 0.0), (end, math.inf), (value, 0.0))]
    except ValueError as error:
        raise InputError(
            f"fault {text!r}: {error}; the form is TARGET=VALUE@START:END, e.g. input_gain=0.8@1.0:2.5"
        ) from error
    if math.isnan(numbers[0]) or math.isnan(numbers[1]):
        raise InputError(f"fault {text!r}: times must be numbers of seconds")
    fault = Fault(numbers[0], numbers[1], target, numbers[2])
    if not value and target not in WITHOUT_VALUE:
        raise InputError(f"fault {text!r} has no value; write how large it is, e.g. {target}=1.5@1.0")
    return fault


@dataclass(frozen=True)
class Job:
    """A scenario and an artifact that fit each other, and what to run.

    Args:
        bench: The machine and its model.
        named: Registered name of the scenario, or path of its file.
        tasks: The tasks.
        settings: What to run.
        noise_source: Where the filters' process noise came from, in words.
    """

    bench: Bench
    named: str
    tasks: tuple[Task, ...]
    settings: ControlSettings
    noise_source: str

    @property
    def scenario(self) -> Scenario:
        """The machine."""
        return self.bench.scenario

    @property
    def kit(self) -> Kit:
        """The artifact, with the filters' process noise."""
        return self.bench.kits[MODEL]

    def spec(self, task: Task, controller: str, seed: int) -> LoopSpec:
        """One of its loops; the first of a task and controller keeps its plans."""
        s = self.settings
        return LoopSpec(
            self.named, MODEL, task.name, controller, s.solver, monitor="guard" if s.guard else "own", faults=s.faults,
            seed=seed, run_seed=s.seed, guard=s.guard, keep=("plans",) if seed == 0 else (),
        )  # fmt: skip


def prepared(
    scenario: Scenario,
    model: Path,
    settings: ControlSettings,
    noise: Mapping[str, Array] | None = None,
    *,
    named: str = "",
) -> Job:
    """Load and check everything before the first loop.

    Args:
        scenario: The machine.
        model: Artifact folder, or the folder of the run that holds it as ``model``.
        settings: What to run.
        noise: Process noise by controller. Default: the artifact's; where it holds none, it is estimated on recordings
            that the scenario makes (budget quick, the settings' seed).
        named: Registered name of the scenario, or path of its file. Default: its own name.

    Raises:
        InputError: If the scenario has nothing to run, the folder holds no artifact, the artifact belongs to another
            machine, or a task or fault does not fit.
    """
    check_complete(scenario)
    if scenario.oracle is None and (oracles := [c for c in settings.controllers if c in ORACLES]):
        raise InputError(f"scenario {scenario.name} has no oracle; leave --controller {oracles[0]} out")
    tasks, folder = selected_tasks(scenario, settings.tasks), artifact_folder(model)
    kit = load(folder)
    check_kit(scenario, kit, str(folder))
    if settings.guard:
        kit.detector()
    if settings.guard == "adapt":
        adaptable(kit.models["hybrid"], scenario.causes)
    check_faults(scenario, settings.faults)
    if noise is None:
        noise, source = find_noise(scenario, kit, settings.controllers, settings.seed)
    else:
        source = "given"
    bench = Bench(scenario, {MODEL: kit.with_noise(noise)})
    return Job(bench, named or scenario.name, tasks, settings, source)


def run_loops(
    job: Job, report: Callable[[str, int, int, str], None]
) -> Iterator[tuple[LoopRow, ClosedLoopResult]]:
    """All loops one after the other, alone on the machine, so that the durations of their steps count.

    Args:
        job: What to run.
        report: Called with ``(task, done, total, text)`` as the loops go on.

    Yields:
        The row of each, the first of a task and controller with its ``plans``, and its record.
    """
    settings, dt = job.settings, job.kit.models["prior"].dt
    for task in job.tasks:
        periods = round(task.duration / dt)
        total = len(settings.controllers) * settings.seeds * periods
        for i, name in enumerate(settings.controllers):
            for seed in range(settings.seeds):
                done = (i * settings.seeds + seed) * periods
                say = partial(_report, report, task.name, done, total, f"{name}, seed {seed}")
                yield job.bench.run(job.spec(task, name, seed), on_step=say)
        report(task.name, total, total, "")


def _report(
    report: Callable[[str, int, int, str], None], key: str, done: int, total: int, text: str, step: Step
) -> None:
    if step.k % 25 == 0:
        report(key, done + step.k, total, text)


SCHEMA_VERSION = 2


def run_control(job: Job, out: Path, progress: Progress, *, gif: bool = True) -> dict[str, Any]:
    """Run a job and write its results and figures.

    Args:
        job: What to run.
        out: Folder to make; an existing one must be empty.
        progress: Where to report.
        gif: Whether a moving picture of each task is drawn, if the scenario draws. Default: yes.

    Returns:
        What ``results.json`` holds.

    Raises:
        InputError: If the folder is not empty, or nothing can be written in it.
    """
    check_folder(out)
    rows: list[LoopRow] = []
    steps: dict[str, list[Array]] = {}
    progress.start("closing the loop")
    firsts: dict[str, dict[str, tuple[ClosedLoopResult, Array]]] = {}
    for row, result in run_loops(job, progress.update):
        rows.append(row)
        steps.setdefault(row.controller, []).append(result.timing_ms["total"])
        if row.seed == 0:
            firsts.setdefault(row.task, {})[row.controller] = (result, row.arrays["plans"])
    times = {name: np.concatenate(parts) for name, parts in steps.items()}
    results = collected(job, rows, times)
    write_json(out / "results.json", results)
    progress.finish("")
    progress.start("drawing")
    figures(job, out / "figures", firsts, times, progress, gif)
    progress.finish("")
    return results


def collected(job: Job, rows: Sequence[LoopRow], times: Mapping[str, Array]) -> dict[str, Any]:
    """The content of results.json: what was run, every loop, and means with intervals."""
    settings, kit = job.settings, job.kit
    return {
        "schema": "hybrid-mpc control",
        "schema_version": SCHEMA_VERSION,
        "scenario": job.scenario.name,
        "solver": settings.solver,
        "controllers": list(settings.controllers),
        "tasks": [task.name for task in job.tasks],
        "seeds": settings.seeds,
        "seed": settings.seed,
        "faults": [
            {"target": f.target, "value": f.value, "start_s": f.start, "end_s": f.end}
            for f in settings.faults
        ],
        "guard": plain(kit.detector()) if settings.guard else None,
        "reaction": settings.guard,
        "model": {"provenance": kit.provenance},
        "noise": {
            "source": job.noise_source,
            "sigma_x": {n: kit.noise(n).tolist() for n in settings.controllers if not CONTROLLERS[n].truth},
        },
        "versions": versions(),
        "period_ms": 1e3 * kit.models["prior"].dt,
        "step_ms": {name: percentiles(values) for name, values in times.items()},
        "summary": plain(summaries(rows)),
        "loops": [row.plain() for row in rows],
    }


def figures(
    job: Job,
    folder: Path,
    firsts: Mapping[str, Mapping[str, tuple[ClosedLoopResult, Array]]],
    times: Mapping[str, Array],
    progress: Progress,
    gif: bool,
) -> list[Path]:
    """Figures of the first loop of every task and controller, and the durations of steps."""
    from hybrid_mpc.plots import animation, loops
    from hybrid_mpc.plots.style import save

    model, scenario, written = job.kit.models["prior"], job.scenario, []
    for i, task in enumerate(job.tasks):
        progress.update("figures", i, len(job.tasks), task.name)
        control = task.control or scenario.control
        assert control is not None
        limits, first = (control.u_min, control.u_max), firsts[task.name]
        some = next(iter(first.values()))[0]
        drawn = {name: loops.Motion(r.t, r.x, r.u) for name, (r, _) in first.items()}
        figure = loops.closed_loops(
            task.title, some.t, some.reference, drawn, states=model.states, inputs=model.inputs, limits=limits
        )
        written.append(save(figure, folder / f"{task.name}.png"))
        name = next((n for n in ("hybrid_observer", "hybrid") if n in first), next(iter(first)))
        result, plans = first[name]
        if gif and scenario.draw is not None and np.all(np.isfinite(result.x)):
            path = folder / f"{task.name}.gif"
            animation.animate(
                path, result.t, result.x, plans, dt=result.dt, draw=scenario.draw, u=result.u,
                title=f"{task.title} ({name})", position=model.states[0], inputs=model.inputs, limits=limits,
            )  # fmt: skip
            written.append(path)
    written.append(save(loops.solve_times(times, 1e3 * model.dt), folder / "step_times.png"))
    return written
