"""Closed loops: a bench with the machine and its models runs a loop's specification and returns its row."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import cached_property, lru_cache
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
from hybrid_mpc.kit.artifact import WATCHES, Kit, load
from hybrid_mpc.kit.assembly import SOLVERS, make_adaptive_guard, make_backup_guard, make_resting_guard
from hybrid_mpc.kit.parts import artifact_digest
from hybrid_mpc.loop.faults import Fault, check_channels, fault_text, install
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.loop.plant import ModelPlant, Plant
from hybrid_mpc.loop.realtime import percentiles
from hybrid_mpc.loop.simulate import ClosedLoopResult, Step, simulate
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.limits import share_used
from hybrid_mpc.model.model import HybridModel, kinematics
from hybrid_mpc.records import beside, known, plain, record
from hybrid_mpc.scenario import Scenario, Task, load_scenario, registered_scenarios
from hybrid_mpc.watch.monitor import Monitor
from hybrid_mpc.watch.replay import alarm_intervals

Array = NDArray[np.float64]
Intervals: TypeAlias = tuple[tuple[float, float], ...]
MODEL = "model"
"""Label of the model on a bench with a single model."""
MONITORS = (*WATCHES, "none")
"""Monitors of a hybrid, see :meth:`~hybrid_mpc.kit.artifact.Kit.monitor`, or none."""
ALARMING = ("guard", "energy", "residuals")
"""Monitors that alarm."""
GUARDS = ("", "rest", "adapt", "prior")
"""Reactions to an alarm: none; ``rest``: the safe input when a sensor freezes; ``adapt`` and ``prior`` also switch to a
backup controller, which estimates the prior's parameters, or plans with the fitted prior."""
ARRAYS = (
    "step_ms", "plans",
    *(f.name for f in fields(ClosedLoopResult) if f.name not in ("dt", "timing_ms", "switches", "given_way")),
)  # fmt: skip
"""Arrays of a loop that its row may keep."""
DRAWN = ("t", "x", "u", "y", "w", "reference", "y_ref")
"""Arrays that the figure of a loop needs."""
TIMES = ("total", "solve", "estimate")
MOST_BUILT = 64
"""Largest number of controllers that a bench keeps; loops are ordered by controller, so few are needed again."""
ON_MODEL = "on the model, not the machine"
"""Text beside every loop in which a model replaces the machine."""
DRAWN_PRIOR = "prior_drawn"
"""Name of the prior with parameters drawn from their fitted covariance, if it replaces the machine."""
SAME_MOTION = 1e-6
"""Relative difference of the motion below which two models count as the same, apart from rounding."""
REPORT_PERIODS = 25
"""Periods between two reports of :func:`run_loops`."""


@dataclass(frozen=True)
class LoopSpec:
    """Specification of a closed loop: everything that its result depends on, except for the content of its model.

    Args:
        scenario: Registered name or path of a user's file.
        model: Label of the model on the bench.
        task: Name of the task.
        controller: Name in :data:`~hybrid_mpc.compare.controllers.CONTROLLERS`.
        solver: ``"rti"``, ``"native"``, ``"sqp"`` or ``"ipopt"``.
        horizon: Periods. Default: the task's own.
        monitor: Name in :data:`MONITORS`; a controller without hybrid has none. Default: ``"own"``, or ``"guard"`` with
            a guard.
        faults: Faults in addition to those of the task. Default: none.
        drawn_faults: Random faults of a draw. Default: none.
        late: Intervals [s] in which solves miss their deadline. Default: none.
        parameters: Parameters of the plant and their factors. Default: none.
        draw: Number of the draw of ``parameters`` and ``drawn_faults``. Default: 0.
        seed: Seed of the loop: loops with the same ``seed``, ``draw`` and ``run_seed`` have the same noise. Default: 0.
        duration: Longest duration [s]. Default: the task's own.
        guard: Name in :data:`GUARDS`; it needs a monitor that alarms. Default: none.
        run_seed: Seed of the run that the loop belongs to. Default: 0.
        rounds: Factors of the reference, one a round of the repeated task. Default: a single round.
        share: Share of the network's correction that ``blended_observer`` starts with. Default: that of
            :meth:`~hybrid_mpc.kit.artifact.Kit.blended`.
        keep: Arrays of its row, names in :data:`ARRAYS`: fields of
            :class:`~hybrid_mpc.loop.simulate.ClosedLoopResult`, ``"step_ms"`` ``(n,)``, ``"plans"``
            ``(n, N + 1, n_x)``. Not part of the identity. Default: none.
        number: Number in a study, not part of the identity. Default: 0.

    Raises:
        InputError: If a name is unknown, a value is of the wrong kind, or a guard has no monitor that alarms.

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
    share: float | None = None
    keep: tuple[str, ...] = field(default=(), compare=False)
    number: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        known(self.controller, CONTROLLERS, "controller")
        known(self.solver, SOLVERS, "solver")
        object.__setattr__(self, "monitor", self.monitor or ("guard" if self.guard else "own"))
        known(self.monitor, MONITORS, "monitor")
        if self.guard:
            known(self.guard, GUARDS[1:], "guard")
        if self.guard and (self.monitor not in ALARMING or not _is_watched(self.controller)):
            raise InputError(
                "guard: a guard reacts to alarms, so it needs a controller with the hybrid and monitor "
                f"{' or '.join(ALARMING)}; got controller {self.controller} and monitor {self.monitor} [HM-COMPARE-003]"
            )
        for name in ("faults", "drawn_faults"):
            given = getattr(self, name)
            if not isinstance(given, tuple) or not all(isinstance(f, Fault) for f in given):
                raise InputError(
                    f"LoopSpec: {name} must be a tuple of Fault, got {given!r}. Write (Fault(start, end, target, "
                    'value),), or parsed_fault("TARGET:CHANNEL=VALUE@START:END") for a text [HM-COMPARE-004]'
                )
        seeds = (self.seed, self.run_seed)
        if not all(isinstance(seed, int) and seed >= 0 for seed in seeds):
            raise InputError(
                f"seed and run_seed: give whole numbers of at least 0, got {self.seed!r} and {self.run_seed!r}"
                " [HM-COMPARE-005]"
            )
        if self.duration is not None and not self.duration > 0:
            raise InputError(
                f"duration: give a positive number of seconds, got {self.duration} [HM-COMPARE-006]"
            )
        for name in self.keep:
            known(name, ARRAYS, "array to keep")

    @cached_property
    def id(self) -> str:
        """The first 20 hexadecimal digits of the SHA-256 of the specification's JSON form."""
        left_out = ("number", "keep", *(("share",) if self.share is None else ()))
        return digest({k: v for k, v in asdict(self).items() if k not in left_out})[:20]

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
    """An interval of time.

    Args:
        start_s: Start [s].
        end_s: End [s].
    """

    start_s: float
    end_s: float


@dataclass(frozen=True)
class ModeChange:
    """A change of the guard's mode.

    Args:
        t_s: Time [s].
        before: Name of the mode before it.
        after: Name of the mode after it.
        why: Its reason.
    """

    t_s: float
    before: str
    after: str
    why: str


@dataclass(frozen=True)
class LoopRow:
    """The figures of a closed loop. Names of signals contain their unit, e.g. ``"phi [rad]"``.

    Args:
        task: Name of the task.
        controller: Name of the controller.
        seed: Seed of the loop.
        seconds: Length [s].
        cost: Closed-loop cost on the plant's true state.
        tracking_rmse: Root mean square deviation from the reference by signal: of the true states, or of the measured
            outputs that the problem weights if the reference is one of outputs.
        largest_x: Largest magnitude of the true states, by signal.
        largest_u: Largest magnitude of the inputs, by signal.
        limits: Largest used share of the distance from the operating point to each limit: 1 is the limit, more a
            violation.
        excess: Largest violation of each limit, also for ``change of`` an input if that is limited.
        sources: Share of periods by the source of the input.
        figures: The task's own figures.
        alarms: Alarms of the monitor; an alarm that is on at the end ends there. None without a monitor that alarms.
        alarm_share: Share of periods with an alarm; None without a monitor that alarms.
        largest_violation: Largest violation of the energy balance [W]; None if the monitor does not compute it.
        invalid_s: Time without a valid level of the monitor [s]; None without a monitor.
        switches: Changes of the guard's mode.
        timing_ms: ``median, p95, p99, max`` of the durations of ``total``, ``solve`` and ``estimate`` [ms].
        on_model: Name of the model that replaced the machine. Default: empty, the loop ran on the scenario's plant.
        given_way: Share of the periods with a relaxed hard bound, by its name. Default: none.
        arrays: The arrays that the specification keeps. Default: none.
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
    arrays: Mapping[str, Array] = beside()

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


def _is_watched(controller: str) -> bool:
    """Whether a monitor can watch a controller: it watches the hybrid."""
    own = CONTROLLERS[controller]
    return own.model == "hybrid" and own.compared


class Bench:
    """Runs loops: holds a machine, its models, and the controllers that were built for them.

    Control problem and sensors are the scenario's for all models; learned limits are the models' own. Without a plant,
    a model replaces the machine (:func:`stand_in`), and default tasks are used if the scenario has none.

    Args:
        scenario: The machine with its control problem; with a plant it also needs tasks.
        kits: Loaded artifacts by label; the filters use their process noise.

    Raises:
        InputError: If the scenario has nothing to run, a model belongs to another machine, or a name is given in place
            of a scenario or of a kit.

    Example:
        ``row, result = Bench(scenario, {"model": hm.load("runs/golf")}).run(spec)``
    """

    @no_exit()
    def __init__(self, scenario: Scenario, kits: Mapping[str, Kit]) -> None:
        if not isinstance(scenario, Scenario):
            raise InputError(
                f"Bench: scenario must be a Scenario, got {scenario!r}; give load_scenario(NAME) [HM-COMPARE-007]"
            )
        if not isinstance(kits, Mapping):
            raise InputError(
                f'Bench: kits must be a mapping, got a {type(kits).__name__}; give {{"model": hm.load(FOLDER)}}'
                " [HM-COMPARE-008]"
            )
        for label, kit in kits.items():
            if not isinstance(kit, Kit):
                raise InputError(
                    f"Bench: kit {label!r} must be a Kit, got a {type(kit).__name__}; give hm.load(FOLDER)"
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
        """The kit of a specification; InputError if it is unknown, or the loop belongs to another scenario."""
        own = self.scenario.name
        others = () if spec.scenario == own else registered_scenarios()
        if spec.scenario in others and load_scenario(spec.scenario).name != own:
            raise InputError(
                f"loop: belongs to scenario {spec.scenario}, but the bench has {own}. Make a bench of its scenario "
                "[HM-COMPARE-010]"
            )
        return self.kits[known(spec.model, self.kits, "model on the bench")]

    def task(self, spec: LoopSpec) -> Task:
        """The task of a specification, with its rounds and its duration; InputError for an unknown name."""
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
        """Estimator and controller of a specification; they have no memory, so many loops can share them."""
        kit = self.kit(spec)
        key = (
            spec.model,
            spec.controller,
            spec.solver,
            spec.horizon,
            spec.share,
            self._find_own_problem(spec),
        )
        if key not in self._built:
            self._built[key] = build(
                spec.controller, self.scenario, kit, self.problem(spec), solver=spec.solver, share=spec.share
            )
            if len(self._built) > MOST_BUILT:
                self._built.popitem(last=False)
        self._built.move_to_end(key)
        return self._built[key]

    def monitor(self, spec: LoopSpec) -> Monitor | None:
        """The monitor of a specification, None without one; InputError if the model lacks its limits."""
        if spec.monitor == "none" or not _is_watched(spec.controller):
            return None
        return self.kit(spec).monitor("hybrid", kind=spec.monitor, task=spec.task)

    def guard(self, spec: LoopSpec) -> Guard | None:
        """The guard of a specification, None without one; InputError if the model lacks its parts."""
        if not spec.guard:
            return None
        kit = self.kit(spec)
        hybrid = kit.models["hybrid"]
        if spec.guard == "rest":
            return make_resting_guard(hybrid)
        key = (spec.model, spec.guard, spec.solver, spec.horizon, self._find_own_problem(spec))
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

    def _find_own_problem(self, spec: LoopSpec) -> str:
        """Name of the task if it has a control problem of its own; empty for that of all tasks."""
        return spec.task if spec.task in self.kit(spec).loop.control else ""

    def plant(self, spec: LoopSpec) -> Plant:
        """The plant of a specification with its changed parameters, or the model that replaces a missing plant."""
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
            task: Replaces the task of the specification, e.g. by one with another reference. Default: its own.
            monitor: Replaces the monitor of the specification. Default: its own.
            on_step: Called after every period, e.g. to show progress. Default: nothing.

        Returns:
            The loop's row, and its complete record.
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
    """Run loops one after the other in this process, so that the durations of their steps count.

    Args:
        bench: The bench.
        specs: The loops.
        report: Called with ``(done, total, text)``, counted in periods of all loops. Default: nothing.

    Yields:
        The row of each loop when it ends.

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


def run_specs(
    scenario: str,
    folder: Path,
    specs: Sequence[LoopSpec],
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> list[LoopRow]:
    """Rows of loops on a run's own model.

    Loops whose monitors use no learned limits run without limits, as in a run whose stage watch has not run yet.
    """
    learned = any(spec.monitor not in ("own", "none") for spec in specs)
    return list(run_loops(bench_of(scenario, folder, learned=learned), specs, report))


@lru_cache(maxsize=1)
def _last_model(folder: Path, content: str) -> tuple[Kit, dict[tuple[str, bool], Bench]]:
    """A kit, and its benches by scenario and ``learned``. The last one is kept: a process runs many parts with it."""
    return load(folder), {}


def kit_of(folder: Path) -> Kit:
    """The kit in a folder, read again only if one of its files has changed."""
    return _last_model(folder, artifact_digest(folder))[0]


def bench_of(scenario: str, folder: Path, *, learned: bool) -> Bench:
    """The bench of a scenario with the kit in a folder (:func:`kit_of`); ``learned``: with the monitor's limits."""
    kit, benches = _last_model(folder, artifact_digest(folder))
    if (scenario, learned) not in benches:
        own = kit if learned else replace(kit, watch={})
        benches[scenario, learned] = Bench(load_scenario(scenario), {MODEL: own})
    return benches[scenario, learned]


def write_rows(path: Path, rows: Sequence[LoopRow], of: str) -> None:
    """Write rows with their arrays, whole or not at all.

    Args:
        path: The file, ``.json``; arrays lie beside it as ``.npz``.
        rows: The loops.
        of: Digest of everything that the rows depend on.

    Raises:
        StorageError: If the file cannot be written.
    """
    write_document(path, {"of": of, "rows": plain(rows)}, arrays_of(rows))


def read_rows(path: Path, of: str) -> list[LoopRow] | None:
    """Read the rows that :func:`write_rows` wrote; None if the file is missing or has another digest.

    Raises:
        InputError: If the file is damaged.
    """
    if not path.is_file():
        return None
    remedy = "delete this file; then its loops run again"
    document = read_document(path, remedy)
    if document.get("of") != of:
        return None
    rows = [record(LoopRow, row, str(path)) for row in document["rows"]]
    return with_arrays(rows, read_document_arrays(path, remedy))


def arrays_of(rows: Sequence[LoopRow]) -> dict[str, Array]:
    """The arrays of rows by ``"NUMBER/NAME"``, with the number of the row."""
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
    if r.tracks_outputs:  # outputs without weight have no reference
        tracked = [s.label for s, weight in zip(model.outputs, problem.q_y, strict=True) if weight > 0]
        errors = errors[problem.q_y > 0]
    inputs = [signal.label for signal in model.inputs]
    violation = r.violation[np.isfinite(r.violation)]
    watched = spec.monitor != "none" and _is_watched(spec.controller)
    can_alarm = watched and spec.monitor in ALARMING
    return LoopRow(
        task=task.name,
        controller=spec.controller,
        seed=spec.seed,
        seconds=len(r.t) * r.dt,
        cost=r.cost,
        tracking_rmse=_name_values(tracked, errors),
        largest_x=_name_values(labels, np.abs(r.x).max(axis=0)),
        largest_u=_name_values(inputs, np.abs(r.u).max(axis=0)),
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


def _name_values(labels: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(labels, values.tolist(), strict=True))


def limits_used(control: OCP, r: ClosedLoopResult, model: HybridModel) -> dict[str, float]:
    """Largest used share of the distance from the operating point to each limit [-]: 1 is the limit, more a violation.

    By name: inputs, ``change of`` an input, the plant's true states, and ``output`` of a measured output.
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
    """Share of a loop's periods in which each hard bound was relaxed; empty if none was."""
    names = [name for period in r.given_way for name in period]
    return {name: names.count(name) / len(r.t) for name in sorted(set(names))}


def excess(control: OCP, r: ClosedLoopResult, model: HybridModel) -> dict[str, float]:
    """Largest violation of each limit in a loop, in the signals' units: inputs, their changes, states, measured
    outputs.
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
            f"plant {type(plant).__name__}: no parameters to vary. Make it a dataclass, or give it a dataclass "
            "'parameters' [HM-COMPARE-011]"
        )
    numbers = [f.name for f in fields(holder) if f.init and isinstance(getattr(holder, f.name), float)]
    changed = {
        known(name, numbers, f"parameter of {type(holder).__name__}"): getattr(holder, name) * factor
        for name, factor in factors
    }
    other = replace(holder, **changed)
    return replace(plant, parameters=other) if holder is inner else other


def stand_in(kit: Kit, controller: str) -> ModelPlant:
    """The model that replaces a missing plant: the hybrid for the prior's controller, and the best single network of
    the hybrid for the hybrid's controller.

    If the kit has none, or if they behave like the controller's own model (correction of zero), it is the prior with
    parameters drawn from their fitted covariance (:data:`DRAWN_PRIOR`).

    Raises:
        InputError: If the controller is an oracle's, or the artifact has no other model than the controller's.
    """
    of = CONTROLLERS[controller].model
    if of == "oracle":
        raise InputError(
            f"controller {controller}: an oracle needs a plant, but the scenario has none. Omit this controller "
            "[HM-COMPARE-012]"
        )
    held = kit.models.get("hybrid")
    others = kit.members.values() if of == "hybrid" else () if held is None else (held,)
    own = kit.models[of]
    problem = next(iter(kit.loop.control.values()), None)
    inputs = None if problem is None else (problem.u_min, problem.u_max)
    for model in others:
        if moves_otherwise(own, model, inputs):
            return ModelPlant(model, kit.sensor_sigma)
    drawn = drawn_prior(kit.models["prior"])
    if drawn is None or not moves_otherwise(own, drawn, inputs):
        raise InputError(
            f"controller {controller}: scenario {kit.name} has no plant, and all its models behave like the "
            "controller's own. The networks correct nothing, and the covariance of the prior's parameters is unknown. "
            "Omit this controller, or write a plant [HM-COMPARE-014]"
        )
    return ModelPlant(drawn, kit.sensor_sigma)


def drawn_prior(prior: HybridModel) -> HybridModel | None:
    """The prior with parameters ``p ~ N(p_fit, covariance)`` within their bounds, always the same draw; None if the
    covariance is unknown or zero.
    """
    covariance = np.array(prior.covariance, dtype=np.float64)
    if not covariance.any():
        return None
    # scale by the standard deviations, since the units of parameters differ widely
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


def moves_otherwise(one: HybridModel, other: HybridModel, inputs: tuple[Array, Array] | None = None) -> bool:
    """Whether two models of a machine differ by more than rounding along 50 periods from the operating point.

    Args:
        one: A model.
        other: Another model of the same signals.
        inputs: Lower and upper bounds ``(n_u,)`` of the random inputs. Default: the operating point plus and minus 1.
    """
    low, high = (one.u0 - 1.0, one.u0 + 1.0) if inputs is None else inputs
    low, high = np.where(np.isfinite(low), low, one.u0 - 1.0), np.where(np.isfinite(high), high, one.u0 + 1.0)
    drawn = np.random.default_rng(0).uniform(low, high, (50, one.n_u))
    runs = []
    for model in (one, other):
        x, h, run = one.x0, hidden_fixed_point(model, one.x0, one.u0), []
        for u in drawn:
            x, h = (part.full().ravel() for part in model.step(x, h, u, one.w, model.p))
            run.append(x)
        runs.append(np.array(run))
    both = np.isfinite(runs[0]) & np.isfinite(runs[1])
    moved = np.abs(np.where(both, runs[0] - one.x0, 0.0)).max(axis=0)
    # a constant state differs by rounding relative to its own size
    moved = np.maximum(moved, SAME_MOTION * np.abs(np.where(both, runs[0], 0.0)).max(axis=0))
    apart = np.abs(np.where(both, runs[0] - runs[1], 0.0)).max(axis=0)
    finite = np.isfinite(runs[0]), np.isfinite(runs[1])
    return bool(np.any(apart > SAME_MOTION * moved)) or not np.array_equal(*finite)


def check_complete(scenario: Scenario, *, plant: bool = False) -> None:
    """Refuse a scenario without control problem or task, or, with ``plant=True``, without a plant."""
    parts: dict[str, object] = {"control problem": scenario.control, "task": scenario.tasks or None}
    if plant:
        parts = {"plant": scenario.plant, **parts}
    if lacks := [name for name, part in parts.items() if part is None]:
        raise InputError(
            f"scenario {scenario.name}: no {lacks[0]}, so no closed loop can be simulated. Add it to the scenario "
            "[HM-COMPARE-015]"
        )


def check_kit(scenario: Scenario, kit: Kit, where: str) -> None:
    """Refuse an artifact without prior or hybrid, of another scenario, or of other sizes; ``where`` is its name."""
    assert scenario.control is not None
    if missing := [name for name in ("prior", "hybrid") if name not in kit.models]:
        raise InputError(
            f"{where}: no model {missing[0]}; it only has {', '.join(kit.models)}. Run the scenario again "
            "[HM-COMPARE-016]"
        )
    if kit.name and kit.name != scenario.name:
        raise InputError(
            f"{where}: made for scenario {kit.name}, not for {scenario.name}. Give a model of {scenario.name} "
            "[HM-COMPARE-017]"
        )
    needed = scenario.control.n_x, scenario.control.n_u, len(scenario.sensor_sigma)
    for name, model in kit.models.items():
        if (sizes := (model.n_x, model.n_u, model.n_y)) != needed:
            raise InputError(
                f"{where}: model {name} has (states, inputs, outputs) = {sizes}, but scenario {scenario.name} has "
                f"{needed}. Run the scenario again [HM-COMPARE-018]"
            )


def check_faults(scenario: Scenario, faults: Sequence[Fault], model: HybridModel) -> None:
    """Refuse faults that the plant does not support, or with channels that are not signals of the ``model``."""
    assert scenario.plant is not None
    outside = install(scenario.plant(), faults)[1]
    check_channels(outside, [s.name for s in model.outputs], [s.name for s in model.inputs])
