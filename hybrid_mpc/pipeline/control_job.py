"""Closed loops of an artifact that exists, without the run that made it: settings, parts and loops."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Kit, artifact_folder, load
from hybrid_mpc.assembly import SOLVERS, adaptable
from hybrid_mpc.closed_loop import ClosedLoopResult, Fault
from hybrid_mpc.closed_loop.simulate import Step
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.contenders import CONTENDERS, ORACLES, find_noise
from hybrid_mpc.job.loops import MODEL, Bench, LoopRow, LoopSpec, check_complete, check_faults, check_kit
from hybrid_mpc.scenario import Scenario, Task

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
        controllers: Names of contenders.
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
        unknown = [name for name in self.controllers if name not in CONTENDERS]
        if unknown or not self.controllers:
            given = f"no controller {', '.join(unknown)}" if unknown else "no controller is given"
            raise InputError(f"{given}; there are: {', '.join(CONTENDERS)}")
        if self.solver not in SOLVERS:
            raise InputError(f"no solver {self.solver!r}; there are: {', '.join(SOLVERS)}")
        if self.guard not in ("", *REACTIONS):
            raise InputError(f"no guard {self.guard!r}; there are: {', '.join(REACTIONS)}")
        oracles = [name for name in self.controllers if name in ORACLES]
        if oracles and self.solver != "rti":
            raise InputError(
                f"controller {oracles[0]} has a solver of its own (several starts); leave --solver out or it"
            )
        others = [name for name in self.controllers if CONTENDERS[name].model != "hybrid"]
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
        noise: Process noise by contender. Default: the artifact's; where it holds none, it is estimated on recordings
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
