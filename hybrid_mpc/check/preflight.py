"""Pre-flight check: everything that a scenario defines is built and called once, and all errors are listed together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analyze.equilibria import Equilibrium, equilibria
from hybrid_mpc.check.default_tasks import default_tasks
from hybrid_mpc.check.operating_point import both_ways, drift_at_rest, place_of, sizes_of
from hybrid_mpc.check.prior import Report, check_prior
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.data.excitation import check_excitation, short_runs
from hybrid_mpc.data.recording import COARSE, check_unit, count_problems
from hybrid_mpc.errors import InputError, named_extra, no_exit, refuse
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.identify.simulation import flow_slope, required_substeps, rest_of
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.kit.assembly import make_controller, make_estimator
from hybrid_mpc.kit.disturbances import default_disturbances
from hybrid_mpc.kit.parts import loop_settings
from hybrid_mpc.loop.faults import check_channels, install
from hybrid_mpc.loop.loop import Loop
from hybrid_mpc.loop.plant import Plant
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.specification import DataSpec
from hybrid_mpc.machine.terms import EXPLANATIONS
from hybrid_mpc.machine.units import turn_in
from hybrid_mpc.model.equilibrium import Range, RateEquations, rate_search
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.records import known
from hybrid_mpc.rules import counted
from hybrid_mpc.scenario import Budget, Scenario, Task

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Dataset

Array = NDArray[np.float64]
QUIET = 1e-4
"""Process noise per period of the trial observer, over the states' sizes: small, as for a good prior."""
STARTS = 32
"""Starts of the search for equilibria."""
REACHED = 0.01
"""Largest deviation of a state from a set-point that is still regarded as held, over the state's size."""
ANSWER = 10
"""Periods of the plant's response to a step of an input that is compared with the prior's."""


@dataclass(frozen=True)
class Rest:
    """A prior at its operating point.

    Args:
        x: States ``(n_x,)``: the operating point, else the middle of the signals' ranges.
        u: Inputs ``(n_u,)`` there.
        w: Disturbances ``(n_w,)`` there.
        modes: Eigenvalues ``(n_x,)`` [1/s] of the rates' Jacobian by the states.
        substeps: Runge-Kutta steps per period.
        equilibria: Steady states under ``u`` within the signals' ranges.
    """

    x: Array
    u: Array
    w: Array
    modes: NDArray[np.complex128]
    substeps: int
    equilibria: tuple[Equilibrium, ...]


@dataclass(frozen=True)
class Preflight:
    """The result of a scenario's pre-flight check.

    Args:
        scenario: The scenario.
        prior: Its prior; None if it cannot be made.
        problems: Errors, one line each; a run needs them corrected.
        warnings: Warnings about the scenario.
        doubts: Warnings about the recordings.
        rest: The prior at its operating point; None if its equations cannot be evaluated there.
        dataset: The recordings; None if there are none, or they cannot be read.
        default_tasks: Default tasks of a scenario that has neither tasks nor a plant.
    """

    scenario: Scenario
    prior: Prior | None
    problems: tuple[str, ...]
    warnings: tuple[str, ...]
    doubts: tuple[str, ...]
    rest: Rest | None
    dataset: Dataset | None
    default_tasks: tuple[Task, ...] = ()


@no_exit()
@named_extra("the check")
def check_scenario(
    scenario: Scenario, budget: Budget | None = None, recordings: Callable[[], Dataset] | None = None
) -> Preflight:
    """Build and call everything that a scenario defines; arguments as for :func:`preflight`.

    Raises:
        InputError: With all errors, one line each.
    """
    found = preflight(scenario, budget, recordings)
    refuse(found.problems)
    return found


@no_exit()
def preflight(
    scenario: Scenario, budget: Budget | None = None, recordings: Callable[[], Dataset] | None = None
) -> Preflight:
    """Build and call everything that a scenario defines, and collect errors and warnings.

    The prior is evaluated at the origin, at random points within its signals' ranges and at their ends, and exported;
    model, controllers, estimators, plant, tasks and references are built and called. An error in one part does not
    prevent the check of the parts that do not depend on it.

    Args:
        scenario: The scenario.
        budget: The effort to check. Default: all efforts of the scenario.
        recordings: Function that reads the recordings. Default: none yet.
    """
    report = Report()
    prior, asked = check_prior(report, scenario.prior)
    if prior is not None:
        _check_columns(report, scenario, prior)
    for law in (term for term in scenario.terms if isinstance(term, str)):
        with report.part("terms"):
            known(law, EXPLANATIONS, "law of a term")
    before = len(report.problems)
    rest = model = None
    if prior is not None and asked:
        rest, model = _check_rest(report, scenario, prior)
    _check_control(report, scenario, prior, model if len(report.problems) == before else None, rest)
    _check_plant(report, scenario, prior, model, rest)
    tasks: tuple[Task, ...] = ()
    if len(report.problems) == before and model is not None:
        tasks = _default_tasks(report, scenario)
    dataset, n_warnings = None, len(report.warnings)
    if recordings is not None and prior is not None:
        dataset = _check_recordings(report, prior, recordings, rest, scenario.data)
    problems, warnings = (
        tuple(f"scenario {scenario.name}: {text}" for text in texts)
        for texts in (report.problems, report.warnings)
    )
    general, doubts = warnings[:n_warnings], warnings[n_warnings:]
    return Preflight(scenario, prior, problems, general, doubts, rest, dataset, tasks)


def _default_tasks(report: Report, scenario: Scenario) -> tuple[Task, ...]:
    """Default tasks of a scenario without plant and tasks; if none can be made, that is only a warning."""
    if scenario.plant is not None or scenario.control is None or scenario.tasks:
        return ()
    with report.part("default tasks"):
        try:
            return default_tasks(scenario)
        except InputError as none:
            report.warn(f"tasks: none given, so no closed loop will run: {str(none).partition(': ')[2]}")
    return ()


def _check_rest(report: Report, scenario: Scenario, prior: Prior) -> tuple[Rest | None, HybridModel | None]:
    """The prior at its operating point, with speed and observability; and the prior as a deployed model."""
    from hybrid_mpc.identify.fit import check_observable

    dt = scenario.data.dt
    second = max(10 * dt, scenario.data.warm_up)
    x, u, w = rest_of(prior)
    with report.part("prior"):
        check_observable(prior, dt, second)
    _check_equilibrium(report, prior, second)
    model, substeps = None, 0
    with report.part("prior"):
        substeps = required_substeps(prior, dt)
        programs = {f"prior/{name}": p for name, p in prior_programs(prior, dt).items()}
        model = build_model("prior", programs, model_info(prior, dt))
        chosen = scenario.disturbance_model
        if chosen is None and scenario.control is not None and scenario.control.n_x == model.n_x:
            chosen = default_disturbances(model, scenario.control)
        model = replace(model, disturbance_model=chosen)
    if model is None:
        return None, None
    modes = np.linalg.eigvals(flow_slope(prior.equations.xdot)(x, u, w, prior.p).full()).astype(np.complex128)
    found = _equilibria(prior, model, x, u)
    # most equilibria that are listed; more are usually a continuum
    if prior.operating_point is None and 1 < len(found) <= 6:
        points = "; ".join(f"x = {(p.x.round(6) + 0.0).tolist()} ({p.stability})" for p in found)
        report.warn(
            f"prior: several equilibria under u = {u.tolist()}: {points}. Give the operating point of the machine: "
            "operating_point = OperatingPoint(x=(...), u=(...)). Without it, the middle of the signals' ranges is used"
        )
    return Rest(x, u, w, modes, substeps, found), model


def _check_equilibrium(report: Report, prior: Prior, second: float) -> None:
    if moving := drift_at_rest(prior, second):
        x, u, _ = rest_of(prior)
        report.add(
            f"prior: operating_point is not an equilibrium: at x = {x.tolist()}, u = {u.tolist()} {moving}. "
            f"{both_ways(prior)}. Write one of these pairs into {place_of(prior)} [HM-CHECK-015]"
        )


def warn_of_drift(prior: Prior, second: float) -> tuple[str, ...]:
    """A warning if a fitted prior has no steady state at its operating point, with the nearest steady state."""
    moving = drift_at_rest(prior, second)
    if not moving:
        return ()
    return (
        f"operating_point is not an equilibrium with the fitted parameters ({moving}), but observers start there. "
        f"Write the fitted values into the prior's parameters, and their steady state into {place_of(prior)}. "
        f"{both_ways(prior)}",
    )


def _equilibria(prior: Prior, model: HybridModel, x: Array, u: Array) -> tuple[Equilibrium, ...]:
    region = []
    for signal, near in zip(prior.states, x, strict=True):
        turn = turn_in(signal.unit)
        reach = 10.0 * max(1.0, abs(near)) if turn is None else turn / 2
        low, high = (-math.inf, math.inf) if signal.periodic else (signal.lower, signal.upper)
        region.append(
            (low if math.isfinite(low) else near - reach, high if math.isfinite(high) else near + reach)
        )
    return equilibria(model, u, region, starts=STARTS).points


def _check_recordings(
    report: Report, prior: Prior, recordings: Callable[[], Dataset], rest: Rest | None, spec: DataSpec
) -> Dataset | None:
    """Check that the recordings can be read, excite the machine, and cover the operating point."""
    dataset, read = None, Report()
    with read.part("recordings"):
        dataset = recordings()
    for problem in _each_once(read.problems, report.problems):
        report.add(problem)
    if dataset is None:
        return None
    for doubtful in dataset.warnings:
        report.warn(f"recordings: {doubtful}")
    late = {
        n: shift for file in dataset.files for n, shift in spec.delays_in(Path(file).stem).items() if shift
    }
    if late:
        report.warn(
            f"delays: {', '.join(f'{name} {shift:g} s' for name, shift in late.items())} are removed from the "
            "recordings, and the deployed model does not contain them. Inputs that act late in operation too: set "
            "largest_delay instead. Outputs that arrive late in operation: use DelayCompensation (docs/clocks.md)"
        )
    for file, sampling in zip(dataset.files, dataset.sampling, strict=True):
        if sampling > COARSE * spec.dt:
            report.warn(
                f"recordings: {file} is sampled every {sampling:.3g} s, but the model period is {spec.dt:g} s, so "
                "samples in between are interpolated. Raise dt in the DataSpec, or record faster"
            )
    train = dataset.by_role("train")
    free = sum(not p.fixed for p in prior.parameters)
    with report.part("recordings"):
        for warning in check_excitation(train, inputs=prior.inputs, outputs=prior.outputs, parameters=free):
            report.warn(f"recordings: {warning}")
    for warning in short_runs(spec, dataset.by_role("test")):
        report.warn(f"recordings: {warning}")
    if rest is not None and prior.operating_point is not None:
        y = prior.equations.output(rest.x, rest.u, rest.w, prior.p).full().ravel()
        for signals, values, key in ((prior.inputs, rest.u, "u"), (prior.outputs, y, "y")):
            every = np.concatenate([getattr(t, key) for t in dataset.whole])
            for j, (signal, value) in enumerate(zip(signals, values, strict=True)):
                known = every[np.isfinite(every[:, j]), j]
                low, high = (known.min(), known.max()) if len(known) else (value, value)
                beyond = max(low - value, value - high)
                if beyond > 0.5 * (high - low) and not signal.periodic:
                    report.warn(
                        f"recordings: {signal.label} ranges from {low:.4g} to {high:.4g}, but is {value:.4g} at the "
                        "operating point. Record at the operating point, or correct this point or a unit"
                    )
    return dataset


def _each_once(found: Sequence[str], known: Sequence[str]) -> list[str]:
    """Errors of recordings, each once: those of several files together, without ``known`` ones of the DataSpec.

    Example:
        >>> a, b = "recordings: a.csv: column 'u' is in 'K'", "recordings: b.csv: column 'u' is in 'K'"
        >>> _each_once([a, b], [])
        ["recordings: a.csv and 1 more file: column 'u' is in 'K'"]
        >>> _each_once([a, b], ["data: column 'u' is in 'K'"])
        []
        >>> _each_once(["recordings raised TypeError: no", "recordings: none"], [])
        ['recordings raised TypeError: no', 'recordings: none']
    """
    files: dict[str, list[str]] = {}
    for problem in found:
        file, _, text = problem.removeprefix("recordings: ").partition(": ")
        of_file = problem.startswith("recordings: ") and text and Path(file).suffix
        files.setdefault(text if of_file else problem, []).append(file if of_file else "")
    reported = {problem.removeprefix("data: ") for problem in known}
    each = []
    for text, (first, *others) in files.items():
        more = f" and {counted(len(others), 'more file')}" if others else ""
        if text not in reported:
            each.append(f"recordings: {first}{more}: {text}" if first else text)
    return each


def _check_columns(report: Report, scenario: Scenario, prior: Prior) -> None:
    """Check that there is one column per signal, in a convertible unit, and that causes name parameters."""
    spec = scenario.data
    for problem in count_problems(spec, prior):
        report.add(problem)
    roles = (
        (spec.inputs, prior.inputs),
        (spec.outputs, prior.outputs),
        (spec.disturbances, prior.disturbances),
    )
    for columns, signals in roles:
        for column, signal in zip(columns, signals, strict=True) if len(columns) == len(signals) else ():
            with report.part("data"):
                check_unit(spec, column, signal)
    unknown = [
        name
        for names in scenario.causes.values()
        for name in names
        if name not in prior.values and name not in {f"gain of {s.name}" for s in prior.inputs}
    ]
    if unknown:
        report.add(
            f"causes: the prior has no parameter {', '.join(unknown)}; it has {', '.join(prior.values)} [HM-CHECK-017]"
        )


def _check_control(
    report: Report, scenario: Scenario, prior: Prior | None, model: HybridModel | None, rest: Rest | None
) -> None:
    control = scenario.control
    if control is None:
        if scenario.tasks:
            report.add("tasks: the scenario has no control problem. Give control=OCP(...). [HM-CHECK-018]")
        return
    before = len(report.problems)
    _check_sensors(report, scenario, prior)
    if len(report.problems) > before:  # errors of the sensors would only repeat themselves in the observer
        model = None
    _check_problem(report, scenario, "control", control, prior, model, rest)
    built = {_structure(control)}
    with report.part("safe_input"):
        loop_settings(replace(scenario, sensor_sigma=(), first_sigma=None))
    for task in scenario.tasks:
        if task.control is not None:  # one controller is built for all problems that differ only in numbers
            new = _structure(task.control) not in built
            built.add(_structure(task.control))
            what = f"control of task {task.name}"
            _check_problem(report, scenario, what, task.control, prior, model if new else None, rest)


def _structure(control: OCP) -> tuple[Any, ...]:
    """Key that is equal only for controllers that are built alike."""
    bounded = tuple(np.isfinite([control.x_min, control.x_max]).ravel())
    expressions = control.soft, control.hard, id(control.economic)
    return control.horizon, control.blocks, control.du_max is None, bounded, expressions


def _check_sensors(report: Report, scenario: Scenario, prior: Prior | None) -> None:
    if prior is not None and len(scenario.sensor_sigma) != len(prior.outputs):
        given = scenario.sensor_sigma
        report.add(
            f"sensor_sigma: must have {len(prior.outputs)} numbers, got {len(given)}: {given} [HM-CHECK-019]"
        )
    for name in ("sensor_sigma", "first_sigma"):
        values = getattr(scenario, name)
        if values is not None and not all(s > 0 for s in values):
            report.add(f"{name}: must be positive, got {values} [HM-CHECK-020]")
    for name, sigma in scenario.state_noise.items():
        if prior is not None and name not in [s.name for s in prior.states]:
            names = ", ".join(s.name for s in prior.states)
            report.add(f"state_noise: no state {name!r}; the prior has {names} [HM-CHECK-021]")
        if not sigma > 0:
            report.add(f"state_noise: {name} must be positive, got {sigma} [HM-CHECK-022]")


def _check_problem(
    report: Report,
    scenario: Scenario,
    what: str,
    control: OCP,
    prior: Prior | None,
    model: HybridModel | None,
    rest: Rest | None,
) -> None:
    before = len(report.problems)
    if prior is None:
        return
    for name, size in {"q": len(prior.states), "r": len(prior.inputs)}.items():
        values = getattr(control, name)
        if len(values) != size:
            report.add(f"{what}: {name} must have {size} numbers, got {len(values)}: {values} [HM-CHECK-023]")
    if model is None or rest is None or len(report.problems) > before:
        return
    # searching from each start takes seconds, and the starts' shapes are checked already
    control = control.changed(starts=())
    with report.part(f"{what}: estimator"):
        estimator = make_estimator(model, scenario, QUIET * Sizes(model, control).states, control)
    with report.part(f"{what}: controller"):
        controller = make_controller(model, model, control)
    if len(report.problems) > before:
        return
    with report.part(f"{what}: one period of the loop"):
        loop = Loop(estimator, controller)
        y = model.output(rest.x, rest.u, rest.w, model.p).full().ravel()
        loop.start(y)
        loop.step(y)


def _check_plant(
    report: Report, scenario: Scenario, prior: Prior | None, model: HybridModel | None, rest: Rest | None
) -> None:
    plant: Plant | None = None
    if scenario.plant is not None and prior is not None:
        with report.part("plant"):
            plant = scenario.plant()
            _check_methods(plant, prior, scenario.data.dt)
            if model is not None and rest is not None:
                _check_answer(report, plant, model, rest)
    for task in scenario.tasks if prior is not None else ():
        assert prior is not None
        _check_task(report, task, scenario, prior, plant, rest)
    if scenario.oracle is not None and model is not None:
        with report.part("oracle"):
            oracle = scenario.oracle(model.dt)
            sizes = oracle.n_x, oracle.n_u, oracle.n_y
            if sizes != (model.n_x, model.n_u, model.n_y):
                raise InputError(
                    f"its model has (states, inputs, outputs) = {sizes}, but the prior has "
                    f"{(model.n_x, model.n_u, model.n_y)} [HM-CHECK-024]"
                )


def _check_methods(plant: Plant, prior: Prior, dt: float) -> None:
    n_x, n_u, n_y = len(prior.states), len(prior.inputs), len(prior.outputs)
    point = prior.operating_point
    x, u = (np.zeros(n_x), np.zeros(n_u)) if point is None else (np.array(point.x), np.array(point.u))
    if (len(x), len(u)) != (n_x, n_u):  # reported by the check of the prior
        return
    step: Any = plant.step
    state = step(plant.reset(x, 0), u, dt, *((rest_of(prior)[2],) if prior.disturbances else ()))
    y, x = plant.measure(state, np.random.default_rng(0)), plant.truth(state)
    for name, found, size in (("measure", y, n_y), ("truth", x, n_x)):
        if np.shape(found) != (size,):
            raise InputError(
                f"{name}: must return an array of shape ({size},), got {np.shape(found)} [HM-CHECK-025]"
            )
        if not np.all(np.isfinite(found)):
            raise InputError(
                f"{name}: must return finite numbers, got {found} one period after the operating point [HM-CHECK-026]"
            )


def _check_answer(report: Report, plant: Plant, model: HybridModel, rest: Rest) -> None:
    """Check that plant and prior respond to a step of each input in the same direction."""
    ranges = np.array([s.upper - s.lower for s in model.inputs])
    steps = np.where(np.isfinite(ranges), 0.1 * ranges, 1.0)
    room = np.array([s.upper for s in model.inputs]) - rest.u
    steps = np.where(room >= steps, steps, -steps)
    sizes = sizes_of(model.states, rest.x)
    step: Any = plant.step
    held = (rest.w,) if len(rest.w) else ()

    def after(u: Array) -> tuple[Array, Array]:
        state, x = plant.reset(rest.x, 0), rest.x
        for _ in range(ANSWER):
            state = step(state, u, model.dt, *held)
            x = model.step(x, np.zeros(0), u, rest.w, model.p)[0].full().ravel()
        return np.asarray(plant.truth(state), dtype=np.float64), x

    base = after(rest.u)
    for j, signal in enumerate(model.inputs):
        moved = after(rest.u + steps * (np.arange(model.n_u) == j))
        own, expected = ((one - other) / sizes for one, other in zip(moved, base, strict=True))
        lengths = float(np.linalg.norm(own)), float(np.linalg.norm(expected))
        # cosine between the responses of plant and prior below which they have different directions
        if min(lengths) > 0 and float(own @ expected) < -0.3 * lengths[0] * lengths[1]:
            moves = ", ".join(
                f"{s.name} by {a * k:.3g} and {b * k:.3g} {s.unit}"
                for s, a, b, k in zip(model.states, own, expected, sizes, strict=True)
            )
            report.warn(
                f"plant: a step of {signal.label} by {steps[j]:g} moves plant and prior in different directions within "
                f"{ANSWER} periods: {moves}. Check signs and units in both"
            )


def _check_task(
    report: Report, task: Task, scenario: Scenario, prior: Prior, plant: Plant | None, rest: Rest | None
) -> None:
    n_x, dt, what = len(prior.states), scenario.data.dt, f"task {task.name}"
    control = task.control or scenario.control
    n_p = 0 if control is None else control.n_p
    if len(task.x0) != n_x:
        report.add(f"{what}: x0 must have {n_x} numbers, got {task.x0} [HM-CHECK-027]")
    else:
        with report.part(what):
            _check_within("x0", np.array([task.x0]), np.zeros(1), prior.states)
    if plant is not None:
        with report.part(what):
            names = ([s.name for s in signals] for signals in (prior.outputs, prior.inputs))
            check_channels(install(plant, task.faults)[1], *names)
    if task.duration < dt:
        report.add(
            f"{what}: duration must be at least one period of {dt} s, got {task.duration} [HM-CHECK-028]"
        )
        return
    t = np.arange(0.0, task.duration, dt)
    by_output = control is not None and control.n_y > 0
    signals = prior.outputs if by_output else prior.states
    n_r = len(signals) + n_p
    last = f"; the last {n_p} columns are parameters of the economic cost and of bounds"
    for name, preview, columns in (("reference", task.reference, n_r), ("weight", task.weight, n_x)):
        if preview is None:
            continue
        with report.part(what):
            values = np.asarray(preview(t))
            if values.shape != (len(t), columns):
                raise InputError(
                    f"{name}: must return shape {(len(t), columns)} for {len(t)} times, got {values.shape}"
                    f"{last if columns > len(signals) else ''} [HM-CHECK-059]"
                )
            if not np.all(np.isfinite(values)):
                k = int(np.argmax(~np.isfinite(values).all(axis=1)))
                raise InputError(
                    f"{name}: must be finite during the task, got {values[k]} at {t[k]:g} s [HM-CHECK-029]"
                )
            if name == "weight" and np.any(values < 0):
                raise InputError("weight: factors must be zero or positive [HM-CHECK-030]")
            if name == "reference":
                _check_within(name, values[:, : len(signals)], t, signals)
                if control is not None and rest is not None:
                    set_points = values[:, : len(signals)]
                    _check_set_point(report, task, set_points, control, prior, rest, by_output)


def _check_within(name: str, values: Array, t: Array, signals: Sequence[Signal]) -> None:
    for j, signal in enumerate(signals):
        beyond = signal.outside(values[:, j])
        if beyond.any():
            k = int(np.argmax(beyond))
            raise InputError(
                f"{name}: {signal.label} is {values[k, j]:g} at {t[k]:g} s, outside its range {signal.lower:g} to "
                f"{signal.upper:g}. Correct the value or its unit, or the bounds of the signal. [HM-CHECK-031]"
            )


def _check_set_point(
    report: Report, task: Task, reference: Array, control: OCP, prior: Prior, rest: Rest, by_output: bool
) -> None:
    """Check that inputs within their limits can hold the final set-point of a reference of states or outputs."""
    n_x, n_u = len(prior.states), len(prior.inputs)
    last = reference[-max(2, len(reference) // 10) :]
    weights, signals = (control.q_y, prior.outputs) if by_output else (control.q, prior.states)
    if len(weights) != len(signals) or len(control.q) != n_x or len(control.u_min) != n_u:
        return
    tied = weights > 0
    if np.ptp(last, axis=0)[tied].any() or not tied.any():
        return
    target, sizes, wanted = last[-1], sizes_of(prior.states, rest.x), sizes_of(signals, last[-1])
    first = np.concatenate([rest.x, np.clip(rest.u, control.u_min, control.u_max)])
    if not by_output:
        sizes, first[:n_x] = wanted, np.where(tied, target, rest.x)
    equations = RateEquations(
        prior.equations.xdot, rest.w, prior.p, prior.equations.output if by_output else None
    )
    none = Range.none(n_x + n_u, len(signals))
    low = np.concatenate([none.lower[:n_x], control.u_min])
    high = np.concatenate([none.upper[:n_x], control.u_max])
    search = rate_search(
        equations, np.concatenate([sizes, control.input_range]), first, np.where(tied, 1.0 / wanted, 0.0),
        bounds=replace(none, lower=low, upper=high),
    )  # fmt: skip
    found = search.descend(first, target)
    if not found.steady:
        found = search.follow(first, equations.shown(first)[0], target, sure=False) or found
    nearest, what = found.y, "y" if by_output else "x"
    if (np.abs(nearest - target)[tied] / wanted[tied] > REACHED).any():
        report.warn(
            f"task {task.name}: the reference ends at {what} = {target.round(6).tolist()}, but no input within its "
            f"limits can hold this value; the nearest steady state is {what} = {(nearest.round(4) + 0.0).tolist()} "
            f"under u = {found.v[n_x:].round(4).tolist()}"
        )
