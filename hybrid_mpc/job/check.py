"""Everything that a scenario defines, built and called once before any work; all that is wrong is reported at once."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.kit.artifact import build_model, loop_settings
from hybrid_mpc.kit.assembly import make_controller, make_estimator
from hybrid_mpc.loop.faults import check_channels, install
from hybrid_mpc.loop.loop import Loop
from hybrid_mpc.loop.plant import Plant
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.scenario import Budget, Scenario, Task
from nn_export import ExportError

if TYPE_CHECKING:
    import torch

    from hybrid_mpc.machine.torch_prior import Prior

Array = NDArray[np.float64]
POINTS = 16
"""Points at which a prior is asked, beside the origin."""
BALANCE = 1e-6
"""Largest energy balance along the prior's own flow, as a share of its terms' size: rounding is 1e9 times less."""
SAME = 1e-9
"""Largest relative difference of a prior on a batch and on one sample at a time; rounding is 1e5 times less."""


@dataclass
class _Report:
    """What was found wrong so far."""

    problems: list[str] = field(default_factory=list)

    def add(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)

    @contextmanager
    def part(self, what: str) -> Iterator[None]:
        """A part of the scenario; what it raises is a problem of its own, and the next part is looked at."""
        try:
            yield
        except InputError as error:
            self.add(f"{what}: {error}")
        except Exception as error:  # the user's own code may raise anything, and this is where it is reported
            self.add(f"{what} raised {type(error).__name__}: {_first_line(error)}{_place(error)}")


def check_scenario(scenario: Scenario, budget: Budget | None = None) -> None:
    """Build and call everything that a scenario defines, before any work is done.

    The prior is asked at the origin and at random points within its signals' ranges, as a batch and one by one;
    exported; and the model, controllers, estimators, plant, tasks and their references are built of it and called.
    Budgets are all of the scenario's where none is given.

    Raises:
        InputError: Naming everything that is wrong, a line each.
    """
    report = _Report()
    prior = _check_prior(report, scenario)
    _check_data(report, scenario, prior)
    for name, one in scenario.budgets.items() if budget is None else [("budget", budget)]:
        _check_budget(report, name, one)
    model = None
    if prior is not None and not report.problems:
        model = _check_export(report, scenario, prior)
    _check_control(report, scenario, prior, model)
    _check_plant(report, scenario, prior, model)
    refuse([f"scenario {scenario.name}: {text}" for text in report.problems])


def _check_prior(report: _Report, scenario: Scenario) -> Prior | None:
    """The prior, if it can be made and gives numbers of the right shape."""
    import torch

    from hybrid_mpc.machine.torch_prior import Prior

    prior: Prior | None = None
    with report.part("prior"):
        prior = scenario.prior()
        if not isinstance(prior, Prior):
            raise InputError(
                f"it makes a {type(prior).__name__}; needed is a hybrid_mpc Prior, e.g. prior=MyPrior"
            )
        again = scenario.prior(dict(prior.values))
        if again.values != prior.values:
            raise InputError(f"prior(values) must take its values over; {prior.values} became {again.values}")
    if prior is None or report.problems:
        return None
    _check_signals(report, prior)
    if report.problems:
        return None
    x, u = (
        torch.from_numpy(_points(signals, seed)) for seed, signals in enumerate((prior.states, prior.inputs))
    )
    if xdot := _called(report, "prior: xdot(x, u)", prior, (x, u), len(prior.states), x):
        with report.part("prior: energy_balance(x, xdot, u)"):
            _check_balance(report, prior, x, u, xdot[0])
    _called(report, "prior: output(x, u)", prior.output, (x, u), len(prior.outputs), x)
    return None if report.problems else prior


def _check_signals(report: _Report, prior: Prior) -> None:
    for role in ("states", "inputs", "outputs"):
        signals = getattr(prior, role)
        if not signals or not all(isinstance(s, Signal) for s in signals):
            report.add(f"prior: {role} must be a tuple of one Signal or more, got {signals!r}")
        elif len({s.name for s in signals}) < len(signals):
            report.add(f"prior: two of the {role} have the same name: {[s.name for s in signals]}")
    names = [p.name for p in prior.parameters_spec]
    if len(set(names)) < len(names):
        report.add(f"prior: two parameters have the same name: {names}")
    with report.part("prior: parameters"):
        wrong = [n for n, p in prior.named_parameters() if str(p.dtype) != "torch.float64"]
        wrong += [
            n for n, b in prior.named_buffers() if b.is_floating_point() and str(b.dtype) != "torch.float64"
        ]
        if wrong:
            raise InputError(f"{', '.join(wrong)} must be float64; give dtype=torch.float64")


def _called(
    report: _Report,
    what: str,
    function: Callable[..., Any],
    arguments: tuple[torch.Tensor, ...],
    size: int,
    x: torch.Tensor,
) -> list[torch.Tensor]:
    """What a function of the prior gives on a batch, in a list; empty where it is not what is needed."""
    import torch

    before = len(report.problems)
    with report.part(what):
        found = function(*arguments)
        if not isinstance(found, torch.Tensor):
            raise InputError(f"it must return a tensor, got {type(found).__name__}; is a 'return' missing?")
        needed = (*x.shape[:-1], size)
        if tuple(found.shape) != needed:
            raise InputError(
                f"it must return the shape {needed} for a batch of {len(x)} samples, got {tuple(found.shape)}; index "
                "the last axis (x[..., 0:1]), and keep it"
            )
        if found.dtype != torch.float64:
            raise InputError(f"it must compute in float64, got {found.dtype}; make constants without a dtype")
        bad = ~torch.isfinite(found).all(-1)
        if bool(bad.any()):
            k = int(torch.nonzero(bad)[0])
            points = ", ".join(f"{name} = {a[k].tolist()}" for name, a in zip("xu", arguments, strict=False))
            raise InputError(
                f"it is {found[k].tolist()} at {points}; it must be finite within the signals' ranges"
            )
        single = torch.stack([function(*(a[k] for a in arguments)) for k in range(len(x))])
        if not torch.allclose(single, found, rtol=SAME, atol=SAME):
            raise InputError("it gives other values for one sample than for the same sample in a batch")
    return [found] if len(report.problems) == before else []


def _check_balance(
    report: _Report, prior: Prior, x: torch.Tensor, u: torch.Tensor, xdot: torch.Tensor
) -> None:
    """The energy balance: a number a sample, zero along the prior's own flow, growing with the acceleration."""
    import torch

    along, beyond = prior.energy_balance(x, xdot, u), xdot.clone()
    n = prior.n_q
    beyond[..., n : 2 * n] += x[..., n : 2 * n]  # pushed along its own motion
    pushed = prior.energy_balance(x, beyond, u)
    for found in (along, pushed):
        if not isinstance(found, torch.Tensor) or tuple(found.shape) != tuple(x.shape[:-1]):
            shape = tuple(found.shape) if isinstance(found, torch.Tensor) else type(found).__name__
            raise InputError(f"it must return one number a sample, shape {tuple(x.shape[:-1])}, got {shape}")
        if not bool(torch.isfinite(found).all()):
            raise InputError("it must be finite within the signals' ranges")
    moving = x[..., n : 2 * n].abs().amax(-1) > 0
    if not bool((pushed > along)[moving].all()):
        raise InputError(
            "it must grow where the machine is pushed along its motion: inertia(x) must be positive, and the energy "
            "balance power of inertia less power of all forces"
        )
    size = float((pushed - along).abs().max())
    if float(along.abs().max()) > BALANCE * max(size, 1e-300):
        raise InputError(
            f"it is up to {float(along.abs().max()):.3g} W along the prior's own flow, where it must be 0; are a force "
            "or a sign left out?"
        )


def _check_data(report: _Report, scenario: Scenario, prior: Prior | None) -> None:
    spec = scenario.data
    if prior is not None:
        for what, columns, signals in (
            ("inputs", spec.inputs, prior.inputs),
            ("outputs", spec.outputs, prior.outputs),
        ):
            if len(columns) != len(signals):
                report.add(
                    f"data: {len(columns)} columns of {what} {list(columns)}, the prior has {len(signals)}: "
                    f"{[s.name for s in signals]}"
                )
        unknown = [
            name
            for names in scenario.causes.values()
            for name in names
            if name not in prior.values and name not in {f"gain of {s.name}" for s in prior.inputs}
        ]
        if unknown:
            report.add(
                f"causes: the prior has no parameter {', '.join(unknown)}; it has: {', '.join(prior.values)}"
            )


def _check_budget(report: _Report, name: str, budget: Budget) -> None:
    least = {
        "hidden": 1,
        "networks": 1,
        "teacher_steps": 0,
        "free_run_steps": 0,
        "seeds": 1,
        "oracle_seeds": 0,
    }
    for key, lowest in least.items():
        value = getattr(budget, key)
        if not isinstance(value, int) or isinstance(value, bool) or value < lowest:
            report.add(f"budget {name}: {key} must be a whole number of at least {lowest}, got {value!r}")
    if not 0 <= budget.decay < math.inf:
        report.add(f"budget {name}: decay must be 0 or more, got {budget.decay!r}")


def _check_export(report: _Report, scenario: Scenario, prior: Prior) -> HybridModel | None:
    """The prior as a deployed model."""
    from hybrid_mpc.identify.export import model_info, trace_model
    from hybrid_mpc.identify.step import PriorStep

    with report.part("prior: export to CasADi"):
        try:
            programs = trace_model(PriorStep(prior, scenario.data.dt))
        except ExportError as error:
            raise InputError(str(error)) from error
        return build_model(
            "prior", {f"prior/{name}": p for name, p in programs.items()}, model_info(prior, scenario.data.dt)
        )
    return None


def _check_control(
    report: _Report, scenario: Scenario, prior: Prior | None, model: HybridModel | None
) -> None:
    control = scenario.control
    if control is None:
        if scenario.tasks:
            report.add("tasks: there is no control problem to run them with; give control=OCP(...)")
        return
    _check_sensors(report, scenario, prior)
    _check_problem(report, scenario, "control", control, prior, model)
    built = {_structure(control)}
    with report.part("safe_input"):
        loop_settings(replace(scenario, sensor_sigma=(), first_sigma=None))
    for task in scenario.tasks:
        if task.control is not None:  # a controller is built once for all that differ in numbers alone
            new = _structure(task.control) not in built
            built.add(_structure(task.control))
            what = f"control of task {task.name}"
            _check_problem(report, scenario, what, task.control, prior, model if new else None)


def _structure(control: Any) -> tuple[Any, ...]:
    """What tells controllers apart that are built differently; an object that is no OCP is reported elsewhere."""
    if not isinstance(control, OCP):
        return ()
    bounded = tuple(np.isfinite([control.x_min, control.x_max]).ravel())
    expressions = control.soft, id(control.economic)
    return control.horizon, control.blocks, control.du_max is None, bounded, expressions, len(control.starts)


def _check_sensors(report: _Report, scenario: Scenario, prior: Prior | None) -> None:
    n_y, n_x = (0, 0) if prior is None else (len(prior.outputs), len(prior.states))
    for name, needed in (("sensor_sigma", n_y), ("first_sigma", n_x - n_y)):
        values = getattr(scenario, name)
        if values is None:
            continue
        if prior is not None and len(values) != needed:
            report.add(f"{name} needs {needed} numbers, got {len(values)}: {values}")
        if not all(math.isfinite(s) and s > 0 for s in values):
            report.add(f"{name} must be positive and finite, got {values}")


def _check_problem(
    report: _Report,
    scenario: Scenario,
    what: str,
    control: OCP,
    prior: Prior | None,
    model: HybridModel | None,
) -> None:
    before = len(report.problems)
    if not isinstance(control, OCP):
        report.add(f"{what}: OCP(...) needed, got {control!r:.60}")
        return
    if prior is None:
        return
    for name, size in {"q": len(prior.states), "r": len(prior.inputs)}.items():
        values = getattr(control, name)
        if len(values) != size:
            report.add(f"{what}: {name} needs {size} numbers, got {len(values)}: {values}")
    if model is None or len(report.problems) > before:
        return
    with report.part(f"{what}: estimator"):
        estimator = make_estimator(model, scenario, np.ones(model.n_x), control)
    with report.part(f"{what}: controller"):
        controller = make_controller(model, model, control)
    if len(report.problems) > before:
        return
    with report.part(f"{what}: a period of the loop"):
        loop = Loop(estimator, controller)
        loop.start(np.zeros(model.n_y))
        loop.step(np.zeros(model.n_y))


def _check_plant(report: _Report, scenario: Scenario, prior: Prior | None, model: HybridModel | None) -> None:
    names = [task.name for task in scenario.tasks]
    if len(set(names)) < len(names):
        report.add(f"tasks: two have the same name: {names}")
    plant: Plant | None = None
    if scenario.plant is not None and prior is not None:
        with report.part("plant"):
            plant = scenario.plant()
            _check_methods(plant, prior, scenario.data.dt)
    for task in scenario.tasks:
        if prior is not None:
            with report.part(f"task {task.name}"):
                _check_task(task, scenario, prior, plant)
    if scenario.oracle is not None and model is not None:
        with report.part("oracle"):
            oracle = scenario.oracle(model.dt)
            sizes = oracle.n_x, oracle.n_u, oracle.n_y
            if sizes != (model.n_x, model.n_u, model.n_y):
                raise InputError(
                    f"its model has (states, inputs, outputs) = {sizes}, the prior "
                    f"{(model.n_x, model.n_u, model.n_y)}"
                )


def _check_methods(plant: Plant, prior: Prior, dt: float) -> None:
    n_x, n_u, n_y = len(prior.states), len(prior.inputs), len(prior.outputs)
    state = plant.step(plant.reset(np.zeros(n_x), 0), np.zeros(n_u), dt)
    y, x = plant.measure(state, np.random.default_rng(0)), plant.truth(state)
    for name, found, size in (("measure", y, n_y), ("truth", x, n_x)):
        if np.shape(found) != (size,):
            raise InputError(f"{name} must return the shape ({size},), got {np.shape(found)}")
        if not np.all(np.isfinite(found)):
            raise InputError(f"{name} gives {found} one period after rest; it must be finite")


def _check_task(task: Task, scenario: Scenario, prior: Prior, plant: Plant | None) -> None:
    n_x, dt = len(prior.states), scenario.data.dt
    if not (math.isfinite(task.duration) and task.duration >= dt):
        raise InputError(f"duration must be at least a period of {dt} s and finite, got {task.duration}")
    if len(task.x0) != n_x or not all(math.isfinite(v) for v in task.x0):
        raise InputError(f"x0 needs {n_x} finite numbers, got {task.x0}")
    t = np.arange(0.0, task.duration, dt)
    control = task.control or scenario.control
    n_p = control.n_p if isinstance(control, OCP) else 0
    for name, preview, columns in (("reference", task.reference, n_x + n_p), ("weight", task.weight, n_x)):
        if preview is None:
            continue
        values = np.asarray(preview(t))
        if values.shape != (len(t), columns):
            raise InputError(
                f"{name} must return the shape {(len(t), columns)} for {len(t)} times, got {values.shape}"
                + (f"; the last {n_p} for the economic cost's parameters" if columns > n_x else "")
            )
        if not np.all(np.isfinite(values)):
            k = int(np.argmax(~np.isfinite(values).all(axis=1)))
            raise InputError(f"{name} is {values[k]} at {t[k]:g} s; it must be finite during the task")
        if name == "weight" and np.any(values < 0):
            raise InputError("weight: factors must not be negative")
    if plant is not None:
        check_channels(install(plant, task.faults)[1], len(prior.outputs), len(prior.inputs))


def _points(signals: Sequence[Signal], seed: int) -> Array:
    """The origin, or what of the range is next to it, and random points within the range."""
    rng = np.random.default_rng(seed)
    columns = []
    for signal in signals:
        low = signal.lower if math.isfinite(signal.lower) else min(-1.0, signal.upper - 1.0)
        high = signal.upper if math.isfinite(signal.upper) else max(1.0, signal.lower + 1.0)
        columns.append(np.concatenate([[min(max(0.0, low), high)], rng.uniform(low, high, POINTS)]))
    return np.column_stack(columns)


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or "no message").splitlines()[0]


def _place(error: BaseException) -> str:
    """The last line of the user's own code that an error came through."""
    frames = traceback.extract_tb(error.__traceback__)
    library = Path(__file__).parents[1]
    own = [f for f in frames if library not in Path(f.filename).parents and "site-packages" not in f.filename]
    return f" ({own[-1].filename}:{own[-1].lineno})" if own else ""
