"""``hybrid-mpc check``: report on a machine and its recordings, and list all errors, before any work."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from hybrid_mpc.cli.options import InputColumns, OutputColumns, Recordings, ScenarioName, TimeColumn
from hybrid_mpc.rules import counted, printable

if TYPE_CHECKING:
    import numpy as np

    from hybrid_mpc.check.preflight import Preflight, Rest
    from hybrid_mpc.machine.prior import Prior
    from hybrid_mpc.machine.signals import Signal
    from hybrid_mpc.machine.specification import DataSpec
    from hybrid_mpc.workflow.context import Context
    from hybrid_mpc.workflow.stages.identify import PriorResult

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc check my_machine.py\n\n"
    "  hybrid-mpc check my_machine.py --data monday.csv --data tuesday.csv\n\n"
    "  hybrid-mpc check my_machine.py --data monday.csv --data tuesday.csv --fit"
)
WRONG = 2
"""Exit code if there are errors."""
LISTED = 6
"""Most equilibria that are listed."""


def check(
    scenario: ScenarioName,
    data: Recordings = None,
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
    fit: Annotated[
        bool,
        typer.Option(
            "--fit", help="Also fit the prior, compare it with simpler models, and name wrong terms."
        ),
    ] = False,
) -> None:
    """Report on a machine and its recordings, and list all errors; nothing is computed without --fit.

    'run', 'tune' and 'benchmark' begin with the same check. With --fit the prior is fitted as in a run, and doubts
    about its structure are listed. No network is trained, no file is written. Exit code 2 if there are errors.
    """
    from hybrid_mpc.check.new import left_to_decide
    from hybrid_mpc.check.preflight import preflight
    from hybrid_mpc.scenario import load_scenario
    from hybrid_mpc.workflow.context import Context
    from hybrid_mpc.workflow.settings import RunSettings

    machine = load_scenario(scenario)
    settings = RunSettings(
        scenario, tuple(data or ()), inputs=tuple(input_column or ()), outputs=tuple(output_column or ()),
        time=time_column,
    )  # fmt: skip
    context = Context(settings, machine, Path())
    found = preflight(machine, None, (lambda: context.dataset) if data else None)
    console = Console(highlight=False)
    _tell(console, found, context.spec)
    problems, warnings = found.problems, (*found.warnings, *found.doubts)
    in_doubt: tuple[str, ...] = ()
    lacking: tuple[str, ...] = ()
    if fit and not problems:
        problems, found_warnings, in_doubt, lacking = _fit(console, context)
        warnings += found_warnings
    left = left_to_decide(Path(scenario)) if scenario.endswith(".py") else []
    notes = () if found.dataset is None else found.dataset.notes
    doubts = "doubt about the structure of the prior", "doubts about the structure of the prior"
    for texts, style, title in (
        (notes, "", ("note",)), (left, "cyan", ("left to decide", "left to decide")),
        (warnings, "yellow", ("warning",)), (in_doubt, "bold yellow", doubts), (problems, "bold red", ("error",)),
    ):  # fmt: skip
        if texts:
            console.print(f"\n{counted(len(texts), *title)}", style=style)
        for number, text in enumerate(texts, 1):
            console.print(printable(f"{number:3}. {text}"), markup=False, soft_wrap=True)
    if problems:
        raise typer.Exit(WRONG)
    if in_doubt:
        console.print("\nCorrect the prior before a run; docs/prior-wrong.md explains each doubt.")
    else:
        console.print(f"\n{_end(len(left), len(warnings), recorded=bool(data or fit))}")
    if lacking:
        words = ["hybrid-mpc", "explain", scenario, *settings.options(str)]
        console.print(
            f"{lacking[0]}: '{shlex.join(words)}' searches for a missing term (docs/explain.md).",
            markup=False, soft_wrap=True,
        )  # fmt: skip


def _end(left: int, warnings: int, *, recorded: bool) -> str:
    """The last line of a check without errors: what is left to do before a run.

    Example:
        >>> _end(2, 1, recorded=True)
        "No errors. 2 values are still marked TODO; 1 warning. Check these points, then continue with 'hybrid-mpc run'."
        >>> _end(0, 0, recorded=True)
        "No errors; continue with 'hybrid-mpc run'."
    """
    todo = [f"{counted(left, 'value is', 'values are')} still marked TODO"] if left else []
    todo += [counted(warnings, "warning")] if warnings else []
    if not todo:
        return "No errors; continue with 'hybrid-mpc run'." if recorded else "No errors."
    then = "Check these points, then continue with 'hybrid-mpc run'." if recorded else "Resolve these points."
    return f"No errors. {'; '.join(todo)}. {then}"


def _fit(console: Console, context: Context) -> tuple[tuple[str, ...], ...]:
    """Fit the prior and print the results; return errors, warnings, doubts about the structure, and the reason to
    search for missing terms.
    """
    from dataclasses import replace

    from hybrid_mpc.cli.progress import Unwarned, make_progress
    from hybrid_mpc.errors import InputError
    from hybrid_mpc.workflow.check_fit import fit_of
    from hybrid_mpc.workflow.stages.identify import stops

    with make_progress() as progress:
        try:
            found = fit_of(replace(context, progress=Unwarned(progress)))
        except InputError as error:
            return error.problems, (), (), ()
    prior = context.scenario.prior()
    console.print(_fitted_parameters(prior, found))
    console.print(_free_runs(prior, found))
    fitted = found.errors["phy"].error
    better = [n for n, one in found.baselines.items() if one.errors is not None and one.errors.error < fitted]
    why = f"{better[0]} predicts better" if better else ""
    if found.lacking:
        why = "A physical term may be missing"
    return stops(found, cause=False), found.fit.warnings, found.in_doubt, (why,) if why else ()


def _fitted_parameters(prior: Prior, found: PriorResult) -> Table:
    """Values before and after the fit, with standard errors and bounds."""
    table = make_table(
        "fitted parameters", "name", "nominal", "fitted", "standard error", "unit", "bounds", ""
    )
    ends = {one.parameter: f"at its bound {one.value:.4g}" for one in found.bounds}
    for one in prior.parameters:
        if not one.fixed:
            table.add_row(
                one.name, f"{one.value:.4g}", f"{found.fit.values[one.name]:.4g}",
                _error(found.fit.standard_errors.get(one.name)), one.unit, f"{one.lower:g} to {one.upper:g}",
                ends.get(one.name, ""),
            )  # fmt: skip
    if found.fit.delay:
        table.add_row("delay of the inputs", "", f"{found.fit.delay:.4g}", "", "s", "", "")
    return table


def _error(value: float | None) -> str:
    """A standard error; a fit that keeps the nominal values has none."""
    return "–" if value is None else f"{value:.2g}"


def _free_runs(prior: Prior, found: PriorResult) -> Table:
    length = "" if found.longest_run is None else f" of {found.longest_run:.3g} s"
    columns = [text for s in prior.outputs for text in (f"RMSE {s.label}", f"FIT {s.name} [%]")]
    table = make_table(f"free runs{length} on the test recordings", "model", "error [-]", *columns)
    names = {"phy_nominal": "prior, nominal", "phy": "prior, fitted"}
    simpler = {name: one.errors for name, one in found.baselines.items()}
    for name, errors in {**found.errors, **simpler}.items():
        if errors is None:
            table.add_row(name, f"no result: {found.baselines[name].reason}")
            continue
        cells = [
            text
            for s in prior.outputs
            for text in (
                _number(errors.rmse.get(s.label), "4g"),
                _number(errors.fit_percent.get(s.label), "0f"),
            )
        ]
        table.add_row(names.get(name, name), _number(errors.error, "3g"), *cells)
    return table


def _number(value: float | None, spec: str) -> str:
    if value is None:
        return "–"
    return f"{value:.{spec}}" if math.isfinite(value) else "diverged"


def _tell(console: Console, found: Preflight, spec: DataSpec) -> None:
    """Print the description of the machine."""
    scenario, prior = found.scenario, found.prior
    console.print(scenario.title, style="bold", markup=False)
    if prior is None:
        return
    console.print(_signals(found, prior, spec))
    if prior.parameters:
        console.print(_parameters(prior))
    text = "none, so no MOPGRNN is trained"
    if not found.problems and prior.equations.balances:
        text = ", ".join(f"{b.name} ({b.unit}, {b.rate_unit})" for b in prior.equations.balances)
    if not found.problems:
        _line(console, "balances", text)
    corrects = [prior.states[i].name for i in prior.corrected] if not found.problems else []
    if corrects:
        _line(console, "networks may correct the rates of", ", ".join(corrects))
    if found.rest is not None:
        for name, text in _rest_lines(prior, found.rest, spec.dt):
            _line(console, name, text)
    control = scenario.control
    if control is not None and hasattr(control, "horizon"):
        tasks = ", ".join(task.name for task in scenario.tasks) or "none"
        if found.default_tasks:
            tasks = f"none given; default tasks: {'; '.join(task.title for task in found.default_tasks)}"
        if scenario.plant is None:
            tasks += "; without a plant, loops run on a trained model"
        length = f"{control.horizon} periods, {control.horizon * spec.dt:.4g} s"
        _line(console, "control", f"{length}; tasks: {tasks}")
    if found.dataset is not None:
        console.print(_recordings(found))


def _line(console: Console, name: str, text: str) -> None:
    console.print(printable(f"{name}: {text}"), markup=False, soft_wrap=True)


def make_table(title: str, *columns: str) -> Table:
    """An empty table whose cells fold where they are too long."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _signals(found: Preflight, prior: Prior, spec: DataSpec) -> Table:
    recorded = found.dataset is not None
    table = make_table("signals", "", "name", "unit", "range", "column", *(["recorded"] if recorded else []))
    for role, signals, columns, key in (
        ("state", prior.states, (), ""), ("input", prior.inputs, spec.inputs, "u"),
        ("disturbance", prior.disturbances, spec.disturbances, "w"), ("output", prior.outputs, spec.outputs, "y"),
    ):  # fmt: skip
        for j, signal in enumerate(signals):
            column = columns[j] if j < len(columns) else ""
            more = [_span(found, key, j)] if recorded else []
            table.add_row(role, signal.name, signal.unit, _range(signal), column, *more)
    return table


def _range(signal: Signal) -> str:
    return (
        f"{signal.lower:g} to {signal.upper:g}"
        if any(map(math.isfinite, (signal.lower, signal.upper)))
        else "any"
    )


def _span(found: Preflight, key: str, j: int) -> str:
    if not key or found.dataset is None:
        return ""
    import numpy as np

    every = np.concatenate([getattr(t, key)[:, j] for t in found.dataset.whole])
    known = every[np.isfinite(every)]
    return f"{known.min():.4g} to {known.max():.4g}" if len(known) else "never"


def _parameters(prior: Prior) -> Table:
    table = make_table("parameters", "name", "value", "unit", "fitted between", "")
    for one in prior.parameters:
        bounds = "fixed" if one.fixed else f"{one.lower:g} and {one.upper:g}"
        table.add_row(one.name, f"{one.value:g}", one.unit, bounds, one.description)
    return table


def _rest_lines(prior: Prior, rest: Rest, dt: float) -> list[tuple[str, str]]:
    """The operating point, equilibria and time constants."""
    origin = "given" if prior.operating_point is not None else "not given: middle of the ranges"
    point = ", ".join(
        f"{s.name} = {v:.4g} {s.unit}"
        for signals, values in ((prior.states, rest.x), (prior.inputs, rest.u), (prior.disturbances, rest.w))
        for s, v in zip(signals, values, strict=True)
    )
    listed = "; ".join(
        f"({', '.join(f'{v + 0.0:.4g}' for v in p.x.round(9))}) {p.stability}"
        for p in rest.equilibria[:LISTED]
    )
    count = len(rest.equilibria)
    more = f" and {count - LISTED} more, perhaps a continuum" if count > LISTED else ""
    return [
        (f"operating point ({origin})", point),
        ("equilibria under these inputs", (listed + more) or "none found within the ranges"),
        (
            "time constants at this point",
            f"{_times(rest.modes)}; {rest.substeps} Runge-Kutta steps per period of {dt:g} s",
        ),
    ]


def _times(modes: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> str:
    """The slowest and the fastest time constant, and the numbers of integrating and unstable modes."""
    import numpy as np

    size = float(np.abs(modes).max(initial=0.0))
    rates = np.sort(-modes.real[modes.real < -1e-9 * size])
    parts = [f"{1 / rates[0]:.3g} s"] if len(rates) else []
    parts += [f"down to {1 / rates[-1]:.3g} s"] if len(rates) > 1 and rates[-1] > 1.001 * rates[0] else []
    integrators = int((np.abs(modes.real) <= 1e-9 * size).sum())
    unstable = int((modes.real > 1e-9 * size).sum())
    parts += [f"{integrators} undamped or integrating"] if integrators else []
    parts += [f"{unstable} unstable"] if unstable else []
    return ", ".join(parts) if parts else "none"


def _recordings(found: Preflight) -> Table:
    assert found.dataset is not None
    data = found.dataset
    table = make_table("recordings", "file", "length", "sampled every", "training", "validation", "test")
    seconds: dict[tuple[str, str], float] = {}
    for t in data.trajectories:
        seconds[t.file, t.role] = seconds.get((t.file, t.role), 0.0) + t.dt * len(t.t)
    for name, dt in zip(data.files, data.sampling, strict=True):
        stem = Path(name).stem
        length = sum(t.dt * len(t.t) for t in data.whole if t.file == stem)
        parts = (f"{seconds.get((stem, role), 0.0):.4g} s" for role in ("train", "valid", "test"))
        table.add_row(name, f"{length:.4g} s", f"{dt:.4g} s", *parts)
    return table
