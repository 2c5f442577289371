"""Everything that a scenario defines, built and called once before any work; all that is wrong is reported at once."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.kit.artifact import build_model, loop_settings
from hybrid_mpc.kit.assembly import make_controller, make_estimator
from hybrid_mpc.loop.faults import check_channels, install
from hybrid_mpc.loop.loop import Loop
from hybrid_mpc.loop.plant import Plant
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import POINT, BalanceEquations, OperatingPoint, Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.scenario import Budget, Scenario, Task
from nn_export import ExportError

Array = NDArray[np.float64]
POINTS = 16
"""Points at which a prior is asked, beside the origin."""
BALANCE = 1e-6
"""Largest residual of a balance along the prior's own flow, as a share of its terms: rounding is 1e9 times less."""


_FINITE = "; it must be within the signals' ranges. Keep a root, a logarithm or a division off its end"
IF = "Cannot compute the truth value"
"""What CasADi says where code decides by an expression."""


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
            hint = "; write ca.if_else(condition, one, other) instead of if" if IF in str(error) else ""
            self.add(f"{what} raised {type(error).__name__}: {_first_line(error)}{_place(error)}{hint}")


def check_scenario(scenario: Scenario, budget: Budget | None = None) -> None:
    """Build and call everything that a scenario defines, before any work is done.

    The prior is asked at the origin and at random points within its signals' ranges, and exported; the model,
    controllers, estimators, plant, tasks and their references are built of it and called.
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
    with report.part("prior"):
        try:
            prior.equations  # noqa: B018  made here, so that what fails is said here
        except ExportError as error:
            raise InputError(str(error)) from error
        _check_point(prior)
        _check_masses(prior)
        _check_equations(prior)
    return None if report.problems else prior


def _check_signals(report: _Report, prior: Prior) -> None:
    for role in ("states", "inputs", "outputs", "disturbances"):
        signals = getattr(prior, role)
        if not (signals or role == "disturbances"):
            report.add(f"prior: {role} must be a tuple of one Signal or more, got {signals!r}")
        elif len({s.name for s in signals}) < len(signals):
            report.add(f"prior: two of the {role} have the same name: {[s.name for s in signals]}")
    names = [p.name for p in prior.parameters]
    if len(set(names)) < len(names):
        report.add(f"prior: two parameters have the same name: {names}")


def _check_point(prior: Prior) -> None:
    """The operating point has the right sizes and lies within the ranges."""
    point = prior.operating_point
    if point is None:
        return
    if not isinstance(point, OperatingPoint):
        raise InputError(f"operating_point must be OperatingPoint(x=(...), u=(...)), got {point!r:.80}")
    for name, values, signals in (
        ("x", point.x, prior.states), ("u", point.u, prior.inputs), ("w", point.w, prior.disturbances),
    ):  # fmt: skip
        if len(values) != len(signals):
            raise InputError(
                f"operating_point: {name} needs {len(signals)} numbers ("
                f"{', '.join(s.name for s in signals) or 'there are none'}), got {len(values)}: {values}"
            )
        beyond = [
            f"{s.label} from {s.lower:g} to {s.upper:g}"
            for s, v in zip(signals, values, strict=True)
            if not (s.lower <= v <= s.upper and math.isfinite(v))
        ]
        if beyond:
            raise InputError(
                f"operating_point: {name} = {values} is outside the range of {', '.join(beyond)}; correct it, or the "
                "bounds of the signal"
            )


def _check_equations(prior: Prior) -> None:
    """Rates, outputs and their derivatives are finite within the signals' ranges, and balances hold along the flow."""
    points = _Points.of(prior)
    x, u, w = points.x, points.u, points.w
    p, equations = prior.p, prior.equations
    for what, f in (("xdot(x, u, w, p)", equations.xdot), ("output(x, u, w, p)", equations.output)):
        symbols = dict(zip(POINT, f.sx_in(), strict=True))
        value = f(*symbols.values())
        parts = {"it": value} | {
            f"its derivative by {key}": ca.vec(ca.densify(ca.jacobian(value, symbols[key]))) for key in "xup"
        }
        found = ca.Function("parts", [*symbols.values()], [*parts.values()])(x.T, u.T, w.T, p)
        for which, values in zip(parts, found, strict=True):
            bad = ~np.isfinite(values.full()).all(axis=0)
            if bad.any():
                where = points.named(int(np.argmax(bad)))
                raise InputError(
                    f"{what}: {which} is not finite at {where}{_FINITE}, e.g. sqrt(fmax(level, 1e-6))"
                )
    rates = equations.xdot(x.T, u.T, w.T, p).full()
    for balance in equations.balances:
        _check_balance(prior, balance, points, rates)


def _check_balance(prior: Prior, balance: BalanceEquations, points: _Points, rates: Array) -> None:
    """A balance tells something of the rates, is finite, holds along the flow, and loses what is not negative."""
    name = f"balance {balance.name} [{balance.rate_unit}]"
    symbols = balance.residual.sx_in()
    if not ca.depends_on(balance.residual(*symbols), symbols[1]):
        corrected = ", ".join(prior.states[i].name for i in prior.corrected)
        raise InputError(
            f"{name}: the storage does not change with {corrected or 'any state'}, whose rates a network may correct, "
            "so it tells nothing; store what changes with them, or leave the balance out"
        )
    x, u, w = points.x.T, points.u.T, points.w.T
    supply, loss = (f(x, u, w, prior.p).full()[0] for f in (balance.supply, balance.loss))
    residual = np.abs(balance.residual(x, rates, u, w, prior.p).full()[0])
    bad = ~np.isfinite([supply, loss, residual]).all(axis=0)
    if bad.any():
        raise InputError(f"{name}: it is not finite at {points.named(int(np.argmax(bad)))}{_FINITE}")
    size, k = float(np.max(np.abs([supply, loss, residual]))), int(np.argmax(residual))
    if residual[k] > BALANCE * size:
        raise InputError(
            f"{name}: dS/dt - supply + loss is {residual[k]:.3g} along the prior's own flow at {points.named(k)}, "
            "where it must be 0; is a term or a sign left out?"
        )
    k = int(np.argmin(loss))
    if loss[k] < -BALANCE * size:
        raise InputError(
            f"{name}: the loss is {loss[k]:.3g} at {points.named(k)}; it must not be negative. Put what may have "
            "either sign into the supply"
        )


def _check_masses(prior: Prior) -> None:
    """A mass matrix is symmetric and positive definite within the signals' ranges."""
    if not isinstance(prior, MechanicalPrior):
        return
    points, masses = _Points.of(prior), prior.masses
    for k, q in enumerate(points.x[:, : prior.n_q]):
        matrix = masses(q, prior.p).full()
        right = np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=BALANCE, atol=0)
        if not right or np.linalg.eigvalsh(matrix).min() <= 0:
            found = matrix.tolist() if prior.n_q > 1 else float(matrix[0, 0])
            raise InputError(
                f"mass_matrix(q, p) is {found} at {points.named(k)}; an inertia must be positive, a mass matrix "
                "symmetric and positive definite. Check its terms and their signs"
            )


def _check_data(report: _Report, scenario: Scenario, prior: Prior | None) -> None:
    spec = scenario.data
    if prior is not None:
        for what, columns, signals in (
            ("inputs", spec.inputs, prior.inputs),
            ("outputs", spec.outputs, prior.outputs),
            ("disturbances", spec.disturbances, prior.disturbances),
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
    from hybrid_mpc.identify.export import model_info, prior_programs
    from hybrid_mpc.identify.fit import check_observable

    with report.part("prior"):
        check_observable(prior, scenario.data.dt, max(10 * scenario.data.dt, scenario.data.warm_up))
        programs = prior_programs(prior, scenario.data.dt)
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


@dataclass(frozen=True)
class _Points:
    """Where a prior is asked: states ``(n, n_x)``, inputs and disturbances."""

    x: Array
    u: Array
    w: Array

    @classmethod
    def of(cls, prior: Prior) -> _Points:
        signals = prior.states, prior.inputs, prior.disturbances
        return cls(*(_points(group, seed) for seed, group in enumerate(signals)))

    def named(self, k: int) -> str:
        """One of them as text."""
        return ", ".join(f"{name} = {v[k].tolist()}" for name, v in vars(self).items() if v.size)


def _points(signals: Sequence[Signal], seed: int) -> Array:
    """The origin, or what of the range is next to it, and random points within the range: rows."""
    rng = np.random.default_rng(seed)
    columns = []
    for signal in signals:
        low = signal.lower if math.isfinite(signal.lower) else min(-1.0, signal.upper - 1.0)
        high = signal.upper if math.isfinite(signal.upper) else max(1.0, signal.lower + 1.0)
        columns.append(np.concatenate([[min(max(0.0, low), high)], rng.uniform(low, high, POINTS)]))
    return np.column_stack(columns) if columns else np.zeros((POINTS + 1, 0))


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or "no message").splitlines()[0]


def _place(error: BaseException) -> str:
    """The last line of the user's own code that an error came through."""
    frames = traceback.extract_tb(error.__traceback__)
    library = Path(__file__).parents[1]
    own = [f for f in frames if library not in Path(f.filename).parents and "site-packages" not in f.filename]
    return f" ({own[-1].filename}:{own[-1].lineno})" if own else ""
