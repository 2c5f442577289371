"""A scenario: the complete description of one machine for all jobs. Does not import torch."""

from __future__ import annotations

import difflib
import importlib.util
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError, no_exit, said_by
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.machine.specification import (
    BenchmarkBudget,
    BenchmarkSpec,
    ChoiceRule,
    Count,
    CountOrNone,
    DataSpec,
)
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Line, Name, NotNegative, Number, Positive, Seconds, Text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hybrid_mpc.control.ocp import OCP
    from hybrid_mpc.loop.plant import Plant
    from hybrid_mpc.loop.simulate import ClosedLoopResult
    from hybrid_mpc.machine.prior import Prior
    from hybrid_mpc.machine.terms import Term
    from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]
SWITCHED = (
    "integer",
    "binary",
    "boolean",
    "discrete",
    "values",
    "levels",
    "options",
    "choices",
    "dtype",
    "kind",
)
"""Arguments with which users try to declare discrete inputs, which signals do not support."""


def _is_problem(control: object) -> bool:
    """Whether ``control`` is None or a control problem; casadi is loaded only for the latter."""
    if control is None:
        return True
    from hybrid_mpc.control.ocp import OCP

    return isinstance(control, OCP)


@dataclass(frozen=True)
class Task:
    """A closed-loop task.

    Args:
        name: Short name, e.g. ``"track_sine"``, by the rules of a signal's; part of file names.
        title: One line for plots and the report.
        duration: Length [s].
        x0: Initial state ``(n_x,)`` [units of the states], an equilibrium.
        reference: ``t (n,) [s] -> x_ref (n, n_x)`` [likewise], or ``y_ref (n, n_y)`` if the control problem weighs
            outputs; the controller previews it if the problem says so.
        weight: ``t (n,) [s] -> (n, n_x)``, nonnegative factors on the control problem's ``q``, previewed like the
            reference: zero where a state does not matter, large where it must be met. Instants must lie on the grid of
            model periods. Default: 1.
        control: The task's own control problem, e.g. with other limits. Default: the scenario's.
        faults: Faults and disturbances of the machine in this task, unknown to controllers. Default: none.
        figures: ``result -> {name with unit: number}``, the task's own results besides the cost. Default: none.
        w: ``t (n,) [s] -> (n, n_w)``, measured disturbances of the machine in this task: they act on the plant, are
            measured, and are known in advance if the control problem previews them. Default: the operating point's.

    Raises:
        InputError: With all fields of a wrong kind.

    Example:
        >>> def meet(t):  # a large weight at t = 1 s only, weight 1 afterwards
        ...     return np.where(np.abs(t - 1.0) < 0.01, 1e3, 1.0 * (t > 1.0))[:, None] * np.ones(2)
        >>> task = Task("hit", "Be there at 1 s", 2.0, (0.0, 0.0), lambda t: np.zeros((len(t), 2)), meet)
        >>> task.weight(np.array([0.5, 1.0, 1.5]))[:, 0].tolist()
        [0.0, 1000.0, 1.0]
    """

    name: Name
    title: Line
    duration: Seconds
    x0: tuple[Number, ...]
    reference: Callable[[Array], Array]
    weight: Callable[[Array], Array] | None = None
    control: OCP | None = None
    faults: tuple[Fault, ...] = ()
    figures: Callable[[ClosedLoopResult], dict[str, float]] | None = None
    w: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        own = Fields(self, f"task {self.name!r}")
        own.need(
            "control",
            lambda: _is_problem(self.control),
            f"control: must be OCP(...), got {self.control!r:.60} [HM-SCENARIO-001]",
        )
        own.refuse()


@dataclass(frozen=True, kw_only=True)
class Budget(BenchmarkBudget):
    """Effort of one run of the main job: of its training, and of its closed loops.

    Args:
        seeds: Most closed loops per task and controller; fewer if they suffice to distinguish the controllers' costs.
        oracle_seeds: Most closed loops per task of the oracles, which are slow; never more than of the others. Default:
            none, because a single loop has no interval.
        tasks: Names of the tasks to run. Default: all.

    Example:
        >>> Budget(8, 4, 200, 200, seeds=2).horizon
        50
    """

    seeds: Count
    oracle_seeds: CountOrNone = 0
    tasks: tuple[Name, ...] | None = None


DEFAULT_BUDGETS: Mapping[str, Budget] = {
    "quick": Budget(hidden=8, networks=4, teacher_steps=200, free_run_steps=200, seeds=2),
    "full": Budget(hidden=8, networks=4, teacher_steps=2500, free_run_steps=800, seeds=10),
}
"""Budgets of a scenario without its own: a first look in minutes, and one for results to report."""


@dataclass(frozen=True)
class Scenario:
    """One machine: prior, data, and the control problem.

    Args:
        name: Registered name.
        title: One line for the report.
        description: A paragraph for the report: the machine, its difficulties, the source of its data.
        prior: Prior class or factory ``(values=None) -> Prior``.
        data: How recordings are read.
        make_data: ``(folder, seed, budget name) -> CSV or npz paths`` for a simulated machine; default: none.
        plant: ``() -> Plant``; default: none. Then loops run on a trained model instead, and say nothing about the
            machine.
        oracle: ``(dt) -> HybridModel`` with the plant's own equations, its hidden states as ``h``.
        control: The control problem of all controllers; default: none.
        sensor_sigma: Standard deviations of the sensors ``(n_y,)`` [output units], for estimators. Required with a
            control problem.
        first_sigma: Initial standard deviations in the estimator of the states that are not measured directly [state
            units]. Default: ``sqrt(2) sensor_sigma / dt`` for speeds of measured states, else by their range.
        state_noise: Process noise of a state per period (standard deviation, state units), by the state's name, if the
            machine's builder knows it. Default: from the model's errors on the recordings. These attribute all
            unexplained rates to one state, so a filter would take every lag that the model lacks for noise of it.
        safe_input: Input ``(n_u,)`` [input units] that is safe for the machine: after the loss of a sensor, after
            non-finite results, at the end of a run. It has no default: a guard that rests and a run on the real machine
            need it. A simulated loop without it holds its last input.
        tasks: Closed-loop tasks. Default: none; without a plant a step and holding against a disturbance
            (:func:`~hybrid_mpc.check.default_tasks.default_tasks`).
        budgets: Effort by name.
        draw: ``x (n_x,) -> polylines (m, 2) [m]`` of the machine, for animations; default: none.
        figures: ``rows -> {file name: (figure, caption)}``, the machine's own figures of the comparison; a row is a
            :class:`~hybrid_mpc.compare.loops.LoopRow` (``task``, ``controller``, ``figures``). Default: none.
        causes: Possible faults, by name: the prior's parameters (or ``"gain of <input>"``) that change together, for
            :class:`~hybrid_mpc.watch.diagnose.Diagnoser`. Default: each parameter by itself.
        benchmark: How ``hybrid-mpc benchmark`` evaluates the machine's models on recordings; default: not at all.
        beyond_recordings: Whether tasks leave the range of the recordings. Filters on the hybrid then assume at least
            the process noise of those on the prior; see also ``Budget.prior_replay``. Default: no.
        disturbance_model: Unmeasured disturbances that estimators and controllers assume. As many as outputs give
            offset-free control (:func:`~hybrid_mpc.estimate.offset_free.offset_free`). Default: if the control problem
            weighs outputs, as many as outputs, one at each input and at each output without weight, as far as they are
            observable (:func:`~hybrid_mpc.kit.disturbances.default_disturbances`); else one at each input.
        terms: Candidates of ``hybrid-mpc explain``: names of laws of :mod:`hybrid_mpc.machine.terms`, e.g.
            ``"coulomb"``, and own terms (:class:`~hybrid_mpc.machine.terms.Term`). Default, if no law is named: all
            laws, besides the own terms.
        explained: Whether ``hybrid-mpc explain`` has searched for terms that the prior lacks, as in the files that it
            writes. Default: no.
        choice: How sure held-out data must show that a hybrid is better than the fitted prior. Default: 95 %.
        false_alarms_per_hour: Wanted rates of the monitor's false alarms [1/h], in rising order; limits are learned for
            the first rate that the undisturbed data are long enough for. A machine that stops at an alarm needs lower
            rates, and longer recordings. Default: 1, 2, 5 and 10, over the machine's time unit [s].

    Raises:
        InputError: With all fields of a wrong kind, equal names of tasks, and rates that do not rise.

    Example:
        >>> spec = DataSpec("time_s", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.5)
        >>> Scenario("mine", "My machine", "", prior=lambda values=None: None, data=spec).tasks
        ()
    """

    name: Name
    title: Line
    description: Text
    prior: Callable[..., Prior]
    data: DataSpec
    make_data: Callable[[Path, int, str], list[Path]] | None = None
    plant: Callable[[], Plant] | None = None
    oracle: Callable[[float], HybridModel] | None = None
    control: OCP | None = None
    sensor_sigma: tuple[NotNegative, ...] = ()
    first_sigma: tuple[NotNegative, ...] | None = None
    state_noise: Mapping[Name, NotNegative] = field(default_factory=dict)
    safe_input: tuple[Number, ...] | None = None
    tasks: tuple[Task, ...] = ()
    budgets: Mapping[Name, Budget] = field(default_factory=lambda: DEFAULT_BUDGETS)
    draw: Callable[[Array], Sequence[Array]] | None = None
    figures: Callable[[Sequence[Any]], Mapping[str, tuple[Figure, str]]] | None = None
    causes: Mapping[Name, tuple[str, ...]] = field(default_factory=dict)
    benchmark: BenchmarkSpec | None = None
    beyond_recordings: bool = False
    disturbance_model: tuple[Disturbance, ...] | None = None
    terms: tuple[Term | Name, ...] = ()
    explained: bool = False
    choice: ChoiceRule = field(default_factory=ChoiceRule)
    false_alarms_per_hour: tuple[Positive, ...] = ()

    def __post_init__(self) -> None:
        own = Fields(self, f"scenario {self.name!r}")
        own.need(
            "control",
            lambda: _is_problem(self.control),
            f"control: must be OCP(...), got {self.control!r:.60} [HM-SCENARIO-002]",
        )
        own.need(
            "false_alarms_per_hour",
            lambda: all(one < two for one, two in pairwise(self.false_alarms_per_hour)),
            f"false_alarms_per_hour: rates must rise, got {self.false_alarms_per_hour} [HM-SCENARIO-011]",
        )
        own.distinct("tasks", lambda: [task.name for task in self.tasks], "tasks: the name")
        own.refuse()


def registered_scenarios() -> dict[str, str]:
    """Registered scenario names, each with its module and attribute."""
    from importlib.metadata import entry_points

    return {e.name: e.value for e in sorted(entry_points(group="hybrid_mpc.scenarios"), key=lambda e: e.name)}


def scenario_of(named: str, where: Path, given: str = "") -> Scenario | None:
    """The scenario named in a file, if it is registered: a name from a file never runs code.

    ``given`` is the user's own registered name or Python file, which takes precedence; ``where`` is the file, for
    messages. None if neither names a scenario.

    Raises:
        InputError: If the file's scenario is not registered, or the user's scenario is another one.

    Example:
        >>> scenario_of("golf_robot", Path("model.json")).name
        'golf_robot'
        >>> scenario_of("mine.py", Path("model.json"))
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: model.json names the scenario 'mine.py', which is not registered. If it is ...
    """
    if given:
        scenario = load_scenario(given)
        if named and scenario.name != named:
            raise InputError(
                f"{where} belongs to the scenario {named!r}, not to {scenario.name!r} [HM-SCENARIO-003]"
            )
        return scenario
    if not named:
        return None
    if named not in registered_scenarios():
        raise InputError(
            f"{where} names the scenario {named!r}, which is not registered. For a scenario of your own, give its "
            "file: --scenario FILE.py [HM-SCENARIO-004]"
        )
    return load_scenario(named)


def load_scenario(name_or_path: str) -> Scenario:
    """The scenario of a registered name, or of a user's Python file that defines ``scenario``.

    Loading a Python file runs it, so ``name_or_path`` must come from the user; for names in files there is
    :func:`scenario_of`. The file may import other files of its folder, unless an installed module has the same name.

    Raises:
        InputError: If there is no such name or file, the file raises an exception, or it defines no ``scenario``.

    Example:
        >>> load_scenario("golf_robot").name
        'golf_robot'
    """
    from importlib.metadata import entry_points

    for entry in entry_points(group="hybrid_mpc.scenarios"):
        if entry.name == name_or_path:
            with no_exit(name_or_path):
                return _checked(entry.load(), name_or_path)
    path = Path(name_or_path)
    if path.suffix != ".py":
        names = ", ".join(registered_scenarios()) or "none is registered"
        raise InputError(
            f"no scenario {name_or_path!r}; registered: {names}. Or give the path of a .py file. [HM-SCENARIO-005]"
        )
    try:
        there = path.is_file()
    except OSError as error:  # e.g. a name that is too long for the file system
        raise InputError(f"no scenario file {path}: {error.strerror} [HM-SCENARIO-006]") from error
    if not there:
        raise InputError(f"no scenario file {path} [HM-SCENARIO-007]")
    spec = importlib.util.spec_from_file_location(f"hybrid_mpc_user_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and worker processes find the module by name
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)  # the file may import its neighbours; installed modules come first
    with no_exit(str(path)):
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            line = _line_in(error, path)
            raise InputError(f"{path}{line}: {_missing(error) or _told(error)} [HM-SCENARIO-008]") from error
    if not hasattr(module, "scenario"):
        raise InputError(
            f"{path} defines no variable 'scenario'. Add: scenario = Scenario(name=..., ...)"
            " [HM-SCENARIO-009]"
        )
    return _checked(module.scenario, str(path))


def _checked(scenario: object, where: str) -> Scenario:
    if not isinstance(scenario, Scenario):
        kind = type(scenario).__name__
        raise InputError(f"{where}: 'scenario' must be a hybrid_mpc Scenario, got {kind} [HM-SCENARIO-010]")
    return scenario


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {said_by(error)}{_hint(error)}"


def _missing(error: BaseException) -> str:
    """The missing arguments of a class, and how to write them; empty for any other error.

    Example:
        >>> _missing(TypeError("DataSpec.__init__() missing 2 required positional arguments: 'dt' and 'max_gap'"))
        'DataSpec lacks dt and max_gap. Write DataSpec(..., dt=..., max_gap=...)'
    """
    found = re.search(r"(\w+)\.__init__\(\) missing \d+ required [\w-]+ arguments?: (.*)", said_by(error))
    if found is None:
        return ""
    names = re.findall(r"'(\w+)'", found[2])
    said = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
    return f"{found[1]} lacks {said}. Write {found[1]}(..., {', '.join(f'{name}=...' for name in names)})"


def _hint(error: BaseException) -> str:
    """A remedy for an argument that the class does not have."""
    found = re.search(r"(\w+)\.__init__\(\) got an unexpected keyword argument '(\w+)'", said_by(error))
    kinds = {
        kind.__name__: kind for kind in (Signal, Parameter, DataSpec, BenchmarkSpec, Task, Budget, Scenario)
    }
    if found is None or found[1] not in kinds:
        return ""
    if found[1] == "Signal" and found[2] in SWITCHED:
        return ". Inputs that are integers, or on and off, are not supported. Use a continuous input, e.g. a duty cycle"
    names = [one.name for one in fields(kinds[found[1]])]
    near = difflib.get_close_matches(found[2], names, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known names: {', '.join(names)}"


def _line_in(error: BaseException, path: Path) -> str:
    """``:LINE`` of the file at which an error was raised, for a message."""
    if isinstance(error, SyntaxError):
        return f":{error.lineno}"
    line, trace = "", error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = f":{trace.tb_lineno}"
        trace = trace.tb_next
    return line
