"""Closed loops: from a loop's specification to its row, on a bench that holds the machine and its models."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.controllers import CONTROLLERS, build
from hybrid_mpc.compare.tasks import ready, repeated, tasks_of
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.safeguard import SafeController, Source
from hybrid_mpc.errors import InputError, no_exit
from hybrid_mpc.estimate.kalman import Estimator
from hybrid_mpc.files import digest, read_document, read_document_arrays, write_document
from hybrid_mpc.kit.artifact import WATCHES, Kit
from hybrid_mpc.kit.assembly import SOLVERS, make_adaptive_guard, make_backup_guard, make_resting_guard
from hybrid_mpc.loop.faults import Fault, check_channels, fault_text, install
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.loop.plant import ModelPlant, Plant
from hybrid_mpc.loop.realtime import percentiles
from hybrid_mpc.loop.simulate import ClosedLoopResult, Step, simulate
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.limits import share_used
from hybrid_mpc.model.model import HybridModel, kinematics
from hybrid_mpc.records import known, plain, record
from hybrid_mpc.scenario import Scenario, Task, load_scenario, registered_scenarios
from hybrid_mpc.watch.monitor import Monitor
from hybrid_mpc.watch.replay import alarm_intervals

Array = NDArray[np.float64]
Intervals: TypeAlias = tuple[tuple[float, float], ...]
MODEL = "model"
"""Label of the model on the bench where there is one."""
MONITORS = (*WATCHES, "none")
"""What watches a hybrid, see :meth:`~hybrid_mpc.kit.artifact.Kit.monitor`; or nothing does."""
ALARMING = ("guard", "energy", "residuals")
"""Monitors that alarm."""
GUARDS = ("", "rest", "adapt", "prior")
"""What an alarm does: nothing; a frozen sensor takes the input away; and a backup takes over, which estimates the
prior's parameters, or which plans with the fitted prior."""
ARRAYS = (
    "step_ms", "plans",
    *(f.name for f in fields(ClosedLoopResult) if f.name not in ("dt", "timing_ms", "switches", "given_way")),
)  # fmt: skip
"""What a row may hold of its loop."""
DRAWN = ("t", "x", "u", "y", "w", "reference", "y_ref")
"""Those that a figure of a loop needs."""
TIMES = ("total", "solve", "estimate")
MOST_BUILT = 64
"""Controllers that a bench holds; loops come ordered by controller, so few are asked for again."""
ON_MODEL = "on the model, not the machine"
"""What stands wherever a loop is shown in which a model stands in for the machine."""
DRAWN_PRIOR = "prior_drawn"
"""Name of the prior with parameters drawn from their fitted covariance, where it stands in for a machine."""
SAME_MOTION = 1e-6
"""Runs of two models that differ by less than this share of the motion are those of one model, but for rounding."""
REPORT_PERIODS = 25
"""Periods between two reports of :func:`run_loops`."""


@dataclass(frozen=True)
class LoopSpec:
    """One closed loop: all that decides what it computes, but for the content of its model.

    Args:
        scenario: Registered name or path of a user's file.
        model: Label of the model on the bench.
        task: Name of the task.
        controller: Name in :data:`~hybrid_mpc.compare.controllers.CONTROLLERS`.
        solver: ``"rti"``, ``"native"``, ``"sqp"`` or ``"ipopt"``.
        horizon: Periods. Default: the task's own.
        monitor: Name in :data:`MONITORS`; without a hybrid there is none. Default: ``"own"``, or ``"guard"`` with a
            guard.
        faults: Beside what the task itself brings.
        drawn_faults: Those that a draw takes at random.
        late: Intervals [s] in which solves miss their deadline.
        parameters: Parameters of the plant and their factors.
        draw: Number of the draw that ``parameters`` and ``drawn_faults`` are from.
        seed: Number of the loop: the same sensor noise for all that share it, ``draw`` and ``run_seed``.
        duration: Longest duration [s]. Default: the task's own.
        guard: Name in :data:`GUARDS`; it needs a monitor that alarms.
        run_seed: Seed of the run that the loop belongs to.
        rounds: The task is run over and over, its reference scaled by these factors, one a round. Default: once.
        keep: Arrays of its row, names in :data:`ARRAYS`: fields of
            :class:`~hybrid_mpc.loop.simulate.ClosedLoopResult`, ``"step_ms"`` ``(n,)``, ``"plans"``
            ``(n, N + 1, n_x)``. No part of the identity.
        number: Place in a study, no part of the identity.

    Raises:
        InputError: If a name is unknown, a value is of the wrong kind, or a guard has nothing that alarms.

    Example:
        >>> spec = LoopSpec("golf_robot", "model", "track_sine", "prior", seed=3)
        >>> spec.noise_seed, replace(spec, run_seed=2).noise_seed, replace(spec, number=7).id == spec.id
        (3, 2003, True)
    """

    scenario: str
    model: str
    task: str
    controller: str
    solver: str = "rti"
    horizon: int | None = None
    monitor: str = ""
    faults: tuple[Fault, ...] = ()
    drawn_faults: tuple[Fault, ...] = ()
    late: Intervals = ()
    parameters: tuple[tuple[str, float], ...] = ()
    draw: int = 0
    seed: int = 0
    duration: float | None = None
    guard: str = ""
    run_seed: int = 0
    rounds: tuple[float, ...] = ()
    keep: tuple[str, ...] = field(default=(), compare=False)
    number: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        known(self.controller, CONTROLLERS, "controller")
        known(self.solver, SOLVERS, "solver")
        object.__setattr__(self, "monitor", self.monitor or ("guard" if self.guard else "own"))
        known(self.monitor, MONITORS, "monitor")
        if self.guard:
            known(self.guard, GUARDS[1:], "guard")
        if self.guard and (self.monitor not in ALARMING or CONTROLLERS[self.controller].model != "hybrid"):
            raise InputError(
                f"a guard acts on alarms: give a controller with the hybrid and monitor {' or '.join(ALARMING)}, got "
                f"controller {self.controller} and monitor {self.monitor} [HM-COMPARE-003]"
            )
        for name in ("faults", "drawn_faults"):
            given = getattr(self, name)
            if not isinstance(given, tuple) or not all(isinstance(f, Fault) for f in given):
                raise InputError(
                    f"LoopSpec: {name} is a tuple of Fault, got {given!r}; write (Fault(start, end, target, value),), "
                    'or parsed_fault("TARGET:CHANNEL=VALUE@START:END") for a text [HM-COMPARE-004]'
                )
        seeds = (self.seed, self.run_seed)
        if not all(isinstance(seed, int) and seed >= 0 for seed in seeds):
            raise InputError(
                f"seed and run_seed are whole numbers from 0 on, got {self.seed!r} and {self.run_seed!r}"
                " [HM-COMPARE-005]"
            )
        if self.duration is not None and not self.duration > 0:
            raise InputError(
                f"duration: a positive number of seconds needed, got {self.duration} [HM-COMPARE-006]"
            )
        for name in self.keep:
            known(name, ARRAYS, "array to keep")

    @cached_property
    def id(self) -> str:
        """The first 20 hexadecimal digits of the SHA-256 of the specification's JSON form."""
        return digest({k: v for k, v in asdict(self).items() if k not in ("number", "keep")})[:20]

    @property
    def noise_seed(self) -> int:
        """Seed of plant and sensor noise."""
        seed = 1000 * self.run_seed + self.seed
        return seed if self.draw == 0 else int(np.random.SeedSequence([seed, self.draw]).generate_state(1)[0])

    def columns(self) -> dict[str, Any]:
        """The specification as the columns of a table."""
        names = ("model", "task", "controller", "solver", "horizon", "monitor")
        return {
            "run": self.number,
            **{name: getattr(self, name) for name in names},
            "faults": fault_text(self.faults),
            "drawn_faults": fault_text(self.drawn_faults, self.late),
            "draw": self.draw,
            "seed": self.seed,
            **{f"factor_{name}": value for name, value in self.parameters},
        }


@dataclass(frozen=True)
class Interval:
    """A stretch of time, from its first instant to its last [s]."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class ModeChange:
    """A change of the guard's mode: when [s], names of the mode before and from then on, and what led to it."""

    t_s: float
    before: str
    after: str
    why: str


@dataclass(frozen=True)
class LoopRow:
    """The figures of a closed loop. Signals are named with their unit, e.g. ``"phi [rad]"``.

    Args:
        task: Name of the task.
        controller: Name of the controller.
        seed: Number of the loop.
        seconds: Length [s].
        cost: Closed-loop cost on the plant's true state.
        tracking_rmse: Root mean square deviation from the reference by signal: of the true states, or, where references
            are the outputs', of the measured outputs that the problem weighs.
        largest_x: Largest magnitude of the true states, by signal.
        largest_u: Largest magnitude of the inputs, by signal.
        limits: Largest share of the way from rest to each limit that was used: 1 is the limit, more a violation.
        excess: By how much limits were left at most; ``change of`` an input where that is limited.
        sources: Share of periods by what gave the input.
        figures: The task's own figures.
        alarms: Alarms of the monitor; one that is on at the end ends there. None where nothing could alarm.
        alarm_share: Share of periods with an alarm; None where nothing could alarm.
        largest_violation: Largest violation of the energy balance [W]; None where the monitor does not read it.
        invalid_s: Time in which the monitor had no valid level [s]; None without one.
        switches: Changes of the guard's mode.
        timing_ms: ``median, p95, p99, max`` of the durations of ``total``, ``solve`` and ``estimate`` [ms].
        on_model: Name of the model that stood in for the machine; empty: the loop ran on the scenario's plant.
        given_way: Share of the periods in which a hard bound had to give way, by its name. Default: none did.
        arrays: What the specification asked to keep. Default: nothing.
    """

    task: str
    controller: str
    seed: int
    seconds: float
    cost: float
    tracking_rmse: Mapping[str, float]
    largest_x: Mapping[str, float]
    largest_u: Mapping[str, float]
    limits: Mapping[str, float]
    excess: Mapping[str, float]
    sources: Mapping[str, float]
    figures: Mapping[str, float]
    alarms: tuple[Interval, ...] | None
    alarm_share: float | None
    largest_violation: float | None
    invalid_s: float | None
    switches: tuple[ModeChange, ...]
    timing_ms: Mapping[str, Mapping[str, float]]
    on_model: str = ""
    given_way: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, Array] = field(default_factory=dict, compare=False)

    def plain(self) -> dict[str, Any]:
        """The row in JSON's own types, without its arrays."""
        found: dict[str, Any] = plain(replace(self, arrays={}))
        del found["arrays"]
        return found

    def columns(self) -> dict[str, Any]:
        """The row as flat columns of a table, without its arrays; durations begin with ``timing_``."""
        groups = ("tracking_rmse", "largest_x", "largest_u")
        times = (("step", "total"), ("solve", "solve"))
        nan = float("nan")
        return {
            "cost": self.cost,
            **{f"{name} {signal}": v for name in groups for signal, v in getattr(self, name).items()},
            **{f"share_{source}": share for source, share in self.sources.items()},
            **{f"task_{name}": float(value) for name, value in self.figures.items()},
            **{f"given_way {name}": share for name, share in self.given_way.items()},
            "alarm_share": nan if self.alarm_share is None else self.alarm_share,
            "first_alarm_s": self.alarms[0].start_s if self.alarms else nan,
            "largest_violation_w": nan if self.largest_violation is None else self.largest_violation,
            **{f"timing_{kind}_{k}_ms": v for kind, name in times for k, v in self.timing_ms[name].items()},
        }


class Bench:
    """What loops run on: a machine, its models, and the controllers that were built for them so far.

    Control problem and sensors are the scenario's, for all models; what was learned is the models' own. A machine
    without plant is stood in for by a model (:func:`stand_in`), and has default tasks if it has none.

    Args:
        scenario: The machine, with control problem; with a plant it needs tasks, too.
        kits: Loaded artifacts by label; their process noise is that of the filters.

    Raises:
        InputError: If the scenario has nothing to run, or a model is another machine's; or for a name in place of a
            scenario or of a kit.

    Example:
        ``row, result = Bench(scenario, {"model": hm.load("runs/golf")}).run(spec)``
    """

    @no_exit()
    def __init__(self, scenario: Scenario, kits: Mapping[str, Kit]) -> None:
        if not isinstance(scenario, Scenario):
            raise InputError(
                f"Bench: a Scenario is needed, got {scenario!r}; give load_scenario(NAME) [HM-COMPARE-007]"
            )
        if not isinstance(kits, Mapping):
            raise InputError(
                f'Bench: kits by label are needed, got a {type(kits).__name__}; give {{"model": hm.load(FOLDER)}}'
                " [HM-COMPARE-008]"
            )
        for label, kit in kits.items():
            if not isinstance(kit, Kit):
                raise InputError(
                    f"Bench: kit {label!r} is a {type(kit).__name__}; load it: hm.load(FOLDER)"
                    " [HM-COMPARE-009]"
                )
            check_kit(scenario, kit, f"model {label}")
        first = next(iter(kits.values()), None)  # all kits run the same tasks
        scenario = ready(scenario, None if first is None else first.fitted)
        check_complete(scenario)
        self.scenario = scenario
        self.kits = {label: kit.on(scenario) for label, kit in kits.items()}
        self._built: OrderedDict[tuple[object, ...], tuple[Estimator, SafeController]] = OrderedDict()
        self._guards: dict[tuple[object, ...], Guard] = {}

    def kit(self, spec: LoopSpec) -> Kit:
        """The model of a specification; refused if there is none, or the loop is another scenario's."""
        own = self.scenario.name
        others = () if spec.scenario == own else registered_scenarios()
        if spec.scenario in others and load_scenario(spec.scenario).name != own:
            raise InputError(
                f"a loop of scenario {spec.scenario} given, the bench has {own} [HM-COMPARE-010]"
            )
        return self.kits[known(spec.model, self.kits, "model on the bench")]

    def task(self, spec: LoopSpec) -> Task:
        """The task of a specification, with its rounds and its duration; refused if there is none of that name."""
        (task,) = tasks_of(self.scenario, (spec.task,))
        kit = self.kit(spec)
        if spec.rounds:
            model = kit.models["prior"]
            speeds = {} if self.kit(spec).problem(task.name).n_y else kinematics(model)
            task = repeated(task, model.dt, np.array(spec.rounds), model.time_unit, speeds)
        return task if spec.duration is None else replace(task, duration=min(task.duration, spec.duration))

    def problem(self, spec: LoopSpec) -> OCP:
        """The control problem of a specification."""
        problem = self.kit(spec).problem(spec.task)
        return problem if spec.horizon is None else problem.changed(horizon=spec.horizon)

    def parts(self, spec: LoopSpec) -> tuple[Estimator, SafeController]:
        """Estimator and controller of a specification; they remember nothing, so one serves many loops."""
        kit = self.kit(spec)
        key = (spec.model, spec.controller, spec.solver, spec.horizon, self._stated(spec))
        if key not in self._built:
            self._built[key] = build(
                spec.controller, self.scenario, kit, self.problem(spec), solver=spec.solver
            )
            if len(self._built) > MOST_BUILT:
                self._built.popitem(last=False)
        self._built.move_to_end(key)
        return self._built[key]

    def monitor(self, spec: LoopSpec) -> Monitor | None:
        """What watches the loop of a specification; refused if the model lacks what it needs."""
        if spec.monitor == "none" or CONTROLLERS[spec.controller].model != "hybrid":
            return None
        return self.kit(spec).monitor("hybrid", kind=spec.monitor, task=spec.task)

    def guard(self, spec: LoopSpec) -> Guard | None:
        """What an alarm does in the loop of a specification; None: nothing. Refused if the model lacks its parts."""
        if not spec.guard:
            return None
        kit = self.kit(spec)
        hybrid = kit.models["hybrid"]
        if spec.guard == "rest":
            return make_resting_guard(hybrid)
        key = (spec.model, spec.guard, spec.solver, spec.horizon, self._stated(spec))
        if key not in self._guards:
            if spec.guard == "prior":
                estimator, controller = self.parts(
                    replace(spec, controller="prior_observer", guard="", monitor="none")
                )
                self._guards[key] = make_backup_guard(controller, estimator)
            else:
                noise = kit.noise("hybrid_observer")
                self._guards[key] = make_adaptive_guard(
                    hybrid, kit.models["prior"], kit, noise, self.problem(spec)
                )
        return self._guards[key]

    def _stated(self, spec: LoopSpec) -> str:
        """Whose control problem it is: the task's own, or that of all tasks."""
        return spec.task if spec.task in self.kit(spec).loop.control else ""

    def plant(self, spec: LoopSpec) -> Plant:
        """The plant of a specification, with its parameters changed; without one the model that stands in."""
        if self.scenario.plant is None:
            return varied(stand_in(self.kit(spec), spec.controller), spec.parameters)
        return varied(self.scenario.plant(), spec.parameters)

    @no_exit()
    def run(
        self,
        spec: LoopSpec,
        *,
        task: Task | None = None,
        monitor: Monitor | None = None,
        on_step: Callable[[Step], None] | None = None,
    ) -> tuple[LoopRow, ClosedLoopResult]:
        """Run one loop.

        Args:
            spec: The loop.
            task: In place of the task that it names, e.g. with another reference.
            monitor: In place of the one that it names.
            on_step: Called after every period, e.g. to show progress.

        Returns:
            Its row, and its whole record.
        """
        plans: list[Array] = []

        def note(step: Step) -> None:
            plans.append(step.decision.solution.x)
            if on_step is not None:
                on_step(step)

        task = self.task(spec) if task is None else task
        estimator, controller = self.parts(spec)
        late = spec.late
        result = simulate(
            self.plant(spec), estimator, controller, task.reference, weight=task.weight, w=task.w,
            dt=self.kit(spec).models["prior"].dt, duration=task.duration, x0=np.array(task.x0),
            seed=spec.noise_seed, monitor=monitor or self.monitor(spec), guard=self.guard(spec),
            faults=(*task.faults, *spec.faults, *spec.drawn_faults), on_step=note if "plans" in spec.keep else on_step,
            late=(lambda t: any(a - 1e-9 <= t < b - 1e-9 for a, b in late)) if late else None,
        )  # fmt: skip
        row = row_of(spec, task, self.problem(spec), self.kit(spec).models["prior"], result)
        if self.scenario.plant is None:
            row = replace(row, on_model=stand_in(self.kit(spec), spec.controller).model.name)
        derived = {"step_ms": result.timing_ms["total"], "plans": np.array(plans)}
        arrays = {name: derived[name] if name in derived else getattr(result, name) for name in spec.keep}
        return replace(row, arrays=arrays), result


def run_loops(
    bench: Bench,
    specs: Sequence[LoopSpec],
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> Iterator[LoopRow]:
    """Run loops one after the other, alone in this process, so that the durations of their steps count.

    Args:
        bench: What they run on.
        specs: The loops.
        report: Called with ``(done, total, text)``, in periods of all loops, as they go on. Default: nothing.

    Yields:
        The row of each as it ends.

    Example: ``costs = [row.cost for row in run_loops(bench, specs)]``
    """
    lengths = [round(bench.task(s).duration / bench.kit(s).models["prior"].dt) for s in specs]
    for i, spec in enumerate(specs):
        before, text = sum(lengths[:i]), f"{spec.controller}, seed {spec.seed}"

        def on_step(step: Step, before: int = before, text: str = text) -> None:
            if step.k % REPORT_PERIODS == 0:
                report(before + step.k, sum(lengths), text)

        yield bench.run(spec, on_step=on_step)[0]
    report(sum(lengths), sum(lengths), "")


def write_rows(path: Path, rows: Sequence[LoopRow], of: str) -> None:
    """Write rows with their arrays, whole or not at all.

    Args:
        path: The file, ``.json``; arrays lie beside it as ``.npz``.
        rows: The loops.
        of: Digest of all that decides what they are.

    Raises:
        StorageError: If they cannot be written.
    """
    write_document(path, {"of": of, "rows": [row.plain() for row in rows]}, arrays_of(rows))


def read_rows(path: Path, of: str) -> list[LoopRow] | None:
    """Rows that :func:`write_rows` wrote; None if there are none of that digest.

    Raises:
        InputError: If the file is damaged.
    """
    if not path.is_file():
        return None
    remedy = "delete it, and its loops run again"
    document = read_document(path, remedy)
    if document.get("of") != of:
        return None
    rows = [record(LoopRow, row, str(path)) for row in document["rows"]]
    return with_arrays(rows, read_document_arrays(path, remedy))


def arrays_of(rows: Sequence[LoopRow]) -> dict[str, Array]:
    """The arrays of rows by ``"NUMBER/NAME"``, the number being that of the row."""
    return {f"{i}/{name}": values for i, row in enumerate(rows) for name, values in row.arrays.items()}


def with_arrays(rows: Sequence[LoopRow], arrays: Mapping[str, Array]) -> list[LoopRow]:
    """Rows with the arrays that :func:`arrays_of` took from them."""
    own: list[dict[str, Array]] = [{} for _ in rows]
    for key, values in arrays.items():
        i, _, name = key.partition("/")
        own[int(i)][name] = values
    return [replace(row, arrays=found) for row, found in zip(rows, own, strict=True)]


def row_of(spec: LoopSpec, task: Task, problem: OCP, model: HybridModel, result: ClosedLoopResult) -> LoopRow:
    """The row of a loop, from its task, its control problem, a model that names the signals, and its record."""
    r, labels = result, [signal.label for signal in model.states]
    tracked, errors = labels, result.tracking_rmse
    if r.tracks_outputs:  # those that nothing weighs have no reference
        tracked = [s.label for s, weight in zip(model.outputs, problem.q_y, strict=True) if weight > 0]
        errors = errors[problem.q_y > 0]
    inputs = [signal.label for signal in model.inputs]
    violation = r.violation[np.isfinite(r.violation)]
    watched = spec.monitor != "none" and CONTROLLERS[spec.controller].model == "hybrid"
    can_alarm = watched and spec.monitor in ALARMING
    return LoopRow(
        task=task.name,
        controller=spec.controller,
        seed=spec.seed,
        seconds=len(r.t) * r.dt,
        cost=r.cost,
        tracking_rmse=_by(tracked, errors),
        largest_x=_by(labels, np.abs(r.x).max(axis=0)),
        largest_u=_by(inputs, np.abs(r.u).max(axis=0)),
        limits=limits_used(problem, r, model),
        excess=excess(problem, r, model),
        sources={source.name: r.source.count(source.name) / len(r.source) for source in Source},
        figures=dict(task.figures(r)) if task.figures is not None else {},
        alarms=tuple(Interval(a, b) for a, b in alarm_intervals(r.alarm, r.dt)) if can_alarm else None,
        alarm_share=float(np.mean(r.alarm)) if can_alarm else None,
        largest_violation=float(violation.max()) if violation.size else None,
        invalid_s=float(np.sum(~r.valid)) * r.dt if watched else None,
        switches=tuple(ModeChange(s.t, s.before.name, s.after.name, s.why) for s in r.switches),
        timing_ms={key: percentiles(r.timing_ms[key]) for key in TIMES},
        given_way=share_given_way(r),
    )


def _by(labels: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(labels, values.tolist(), strict=True))


def limits_used(control: OCP, r: ClosedLoopResult, model: HybridModel) -> dict[str, float]:
    """Largest share of the way from rest to each limit that a loop used [-]: 1 is the limit, more a violation.

    By signal of the model: inputs and, where limited, ``change of`` an input, the plant's true states and, as
    ``output`` of a name, the measured outputs.
    """
    rest = np.clip(model.u0, control.u_min, control.u_max)
    changes = np.abs(np.diff(r.u, axis=0, prepend=rest[None]))
    used: dict[str, float] = {}
    for i, signal in enumerate(model.inputs):
        used[signal.name] = share_used(r.u[:, i], control.u_min[i], control.u_max[i], rest[i])
        if control.du_max is not None:
            used[f"change of {signal.name}"] = float(np.max(changes[:, i] / control.du_max[i]))
    low, high = control.state_range
    for i, signal in enumerate(model.states):
        if np.isfinite(low[i]) or np.isfinite(high[i]):
            used[signal.name] = share_used(r.x[:, i], low[i], high[i], model.x0[i])
    low, high = control.output_range(model.n_y)
    for i, signal in enumerate(model.outputs):
        if np.isfinite(low[i]) or np.isfinite(high[i]):
            seen = r.y[np.isfinite(r.y[:, i]), i]
            rest_y = model.output(model.x0, model.u0, model.w, model.p).full()[i, 0]
            used[f"output {signal.name}"] = share_used(seen, low[i], high[i], rest_y)
    return used


def share_given_way(r: ClosedLoopResult) -> dict[str, float]:
    """Share of a loop's periods in which each hard bound had to give way; empty where none did."""
    names = [name for period in r.given_way for name in period]
    return {name: names.count(name) / len(r.t) for name in sorted(set(names))}


def excess(control: OCP, r: ClosedLoopResult, model: HybridModel) -> dict[str, float]:
    """By how much a loop left its limits at most, in the signals' units: inputs and, where limited, changes, states,
    measured outputs.
    """
    beyond = np.maximum(r.u - control.u_max, control.u_min - r.u)
    over = {s.label: v for s, v in zip(model.inputs, beyond.T, strict=True)}
    low, high = control.state_range
    if np.any(np.isfinite([low, high])):
        beyond = np.maximum(r.x - high, low - r.x)
        over |= {s.label: v for s, v in zip(model.states, beyond.T, strict=True)}
    low, high = control.output_range(model.n_y)
    if np.any(np.isfinite([low, high])):
        beyond = np.where(np.isfinite(r.y), np.maximum(r.y - high, low - r.y), -np.inf)
        over |= {f"output {s.label}": v for s, v in zip(model.outputs, beyond.T, strict=True)}
    if control.du_max is not None:
        rest = np.clip(model.u0, control.u_min, control.u_max)
        changes = np.abs(np.diff(r.u, axis=0, prepend=rest[None])) - control.du_max
        over |= {f"change of {s.label}": v for s, v in zip(model.inputs, changes.T, strict=True)}
    return {name: max(0.0, float(values.max())) for name, values in over.items()}


def varied(plant: Any, factors: Sequence[tuple[str, float]]) -> Any:
    """The plant with some of its parameters multiplied.

    Args:
        plant: A dataclass with a dataclass ``parameters``, or with parameters of its own.
        factors: Parameters and factors; may be empty.

    Raises:
        InputError: If the plant is no dataclass, or has no number of that name.

    Example:
        >>> from scenarios.golf_robot.rig import Rig
        >>> round(varied(Rig(), [("m", 1.1)]).parameters.m, 5)
        0.58806
    """
    if not factors:
        return plant
    inner = getattr(plant, "parameters", None)
    holder = inner if is_dataclass(inner) else plant
    if not is_dataclass(holder) or isinstance(holder, type):
        raise InputError(
            f"the plant {type(plant).__name__} has no parameters to vary: it must be a dataclass, or have one "
            "named 'parameters' [HM-COMPARE-011]"
        )
    numbers = [f.name for f in fields(holder) if f.init and isinstance(getattr(holder, f.name), float)]
    changed = {
        known(name, numbers, f"parameter of {type(holder).__name__}"): getattr(holder, name) * factor
        for name, factor in factors
    }
    other = replace(holder, **changed)
    return replace(plant, parameters=other) if holder is inner else other


def stand_in(kit: Kit, controller: str) -> ModelPlant:
    """The model that a controller meets where there is no plant: the prior's meets the hybrid, the hybrid's the
    best of its networks alone.

    Where these move as the controller's own model does, as with a correction of zero, it is the prior with parameters
    drawn from what the fit knows of them (:data:`DRAWN_PRIOR`).

    Raises:
        InputError: If the controller is an oracle's, or the artifact holds no other model than the controller's.
    """
    of = CONTROLLERS[controller].model
    if of == "oracle":
        raise InputError(
            f"controller {controller} knows the equations of a plant, and there is none; leave it out [HM-COMPARE-012]"
        )
    held = kit.models.get("hybrid")
    others = kit.members.values() if of == "hybrid" else () if held is None else (held,)
    if not others:
        needed = "a hybrid" if of == "prior" else "a network of its training alone"
        raise InputError(
            f"there is no plant, and the model of scenario {kit.name} holds no model to stand in for the machine of "
            f"controller {controller}: needed is {needed}. Train 2 networks or more (networks of the budget) and run "
            "it again, leave this controller out, or write a plant [HM-COMPARE-013]"
        )
    own = kit.models[of]
    problem = next(iter(kit.loop.control.values()), None)
    inputs = None if problem is None else (problem.u_min, problem.u_max)
    for model in others:
        if moves_otherwise(own, model, inputs):
            return ModelPlant(model, kit.sensor_sigma)
    drawn = drawn_prior(kit.models["prior"])
    if drawn is None or not moves_otherwise(own, drawn, inputs):
        raise InputError(
            f"there is no plant, and all models of scenario {kit.name} move as that of controller {controller} does: "
            "the networks correct nothing, and the fit tells no spread of the prior's parameters. A loop on the "
            "controller's own model would tell nothing; leave this controller out, or write a plant [HM-COMPARE-014]"
        )
    return ModelPlant(drawn, kit.sensor_sigma)


def drawn_prior(prior: HybridModel) -> HybridModel | None:
    """The prior with parameters drawn from a normal distribution of their fitted covariance, within their bounds;
    always the same draw. None where the covariance is unknown or zero.
    """
    covariance = np.array(prior.covariance, dtype=np.float64)
    if not covariance.any():
        return None
    # scaled by the deviations: parameters of very different units are factored alike
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    normal = np.random.default_rng(0).standard_normal(prior.n_p)
    p = prior.p + scale * (vectors @ (np.sqrt(np.maximum(values, 0.0)) * normal))
    parameters = tuple(
        replace(own, value=float(np.clip(value, own.lower, own.upper)))
        for own, value in zip(prior.parameters, p, strict=True)
    )
    return replace(prior, name=DRAWN_PRIOR, parameters=parameters)


def moves_otherwise(
    one: HybridModel, other: HybridModel, inputs: tuple[Array, Array] | None = None, *, periods: int = 50
) -> bool:
    """Whether two models of a machine differ by more than rounding along a run from the operating point.

    Args:
        one: A model.
        other: Another one, of the same signals.
        inputs: Lower and upper bounds ``(n_u,)`` within which inputs are drawn. Default: one to either side of the
            operating point.
        periods: Length of the run.
    """
    low, high = (one.u0 - 1.0, one.u0 + 1.0) if inputs is None else inputs
    low, high = np.where(np.isfinite(low), low, one.u0 - 1.0), np.where(np.isfinite(high), high, one.u0 + 1.0)
    drawn = np.random.default_rng(0).uniform(low, high, (periods, one.n_u))
    runs = []
    for model in (one, other):
        x, h, run = one.x0, hidden_fixed_point(model, one.x0, one.u0), []
        for u in drawn:
            x, h = (part.full().ravel() for part in model.step(x, h, u, one.w, model.p))
            run.append(x)
        runs.append(np.array(run))
    both = np.isfinite(runs[0]) & np.isfinite(runs[1])
    moved = np.abs(np.where(both, runs[0] - one.x0, 0.0)).max(axis=0)
    # a state that stands still differs by rounding of its own size
    moved = np.maximum(moved, SAME_MOTION * np.abs(np.where(both, runs[0], 0.0)).max(axis=0))
    apart = np.abs(np.where(both, runs[0] - runs[1], 0.0)).max(axis=0)
    finite = np.isfinite(runs[0]), np.isfinite(runs[1])
    return bool(np.any(apart > SAME_MOTION * moved)) or not np.array_equal(*finite)


def check_complete(scenario: Scenario, *, plant: bool = False) -> None:
    """Refuse a scenario without control problem or task, or without ``plant`` where it takes the machine's own."""
    parts: dict[str, object] = {"control problem": scenario.control, "task": scenario.tasks or None}
    if plant:
        parts = {"plant": scenario.plant, **parts}
    if lacks := [name for name, part in parts.items() if part is None]:
        raise InputError(
            f"scenario {scenario.name} has no {lacks[0]}: there is no loop to close in simulation [HM-COMPARE-015]"
        )


def check_kit(scenario: Scenario, kit: Kit, where: str) -> None:
    """Refuse an artifact without prior or hybrid, of another scenario, or of other sizes; ``where`` names it."""
    assert scenario.control is not None
    if missing := [name for name in ("prior", "hybrid") if name not in kit.models]:
        raise InputError(
            f"{where} holds {', '.join(kit.models)}; needed is a model {missing[0]} too [HM-COMPARE-016]"
        )
    if kit.name and kit.name != scenario.name:
        raise InputError(
            f"{where} was made for scenario {kit.name}, not for {scenario.name} [HM-COMPARE-017]"
        )
    needed = scenario.control.n_x, scenario.control.n_u, len(scenario.sensor_sigma)
    for name, model in kit.models.items():
        if (sizes := (model.n_x, model.n_u, model.n_y)) != needed:
            raise InputError(
                f"{where}: model {name} has (states, inputs, outputs) = {sizes}, scenario {scenario.name} {needed}"
                " [HM-COMPARE-018]"
            )


def check_faults(scenario: Scenario, faults: Sequence[Fault], model: HybridModel) -> None:
    """Refuse faults that the machine, whose signals a ``model`` names, cannot show."""
    assert scenario.plant is not None
    outside = install(scenario.plant(), faults)[1]
    check_channels(outside, [s.name for s in model.outputs], [s.name for s in model.inputs])
