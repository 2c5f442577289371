"""Files of ``hybrid-mpc analyze``: analysis.json, curves.npz, a CSV for each table, figures and a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.analyze.analysis import (
    POINTS,
    AnalysisInput,
    AnalysisResult,
    FrictionAnalysis,
    Linearization,
    LoopAnalysis,
    MemoryAnalysis,
    Missing,
    Reduction,
    ResponseAnalysis,
    ScheduleAnalysis,
    SensitivityAnalysis,
    at_input,
)
from hybrid_mpc.analyze.equilibria import Equilibria
from hybrid_mpc.analyze.properties import SteadyGain
from hybrid_mpc.files import write_arrays, write_json, write_text
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.model import HybridModel, positions_of
from hybrid_mpc.plots import analysis as plots
from hybrid_mpc.plots.style import ratio_unit, save
from hybrid_mpc.records import plain
from hybrid_mpc.report.page import Cell, KeyFigure, Report, Section, Table, words, write_report
from hybrid_mpc.watch.lengths import machine_second

MODES = 6
"""Number of modes of each linearization in the page's table; the CSV file has all modes."""
Drawn = Mapping[str, tuple[Path, str]]


def write_analysis(
    out: Path, given: AnalysisInput, result: AnalysisResult, notes: Sequence[str], command: str
) -> list[Path]:
    """Write all files of an analysis into a folder; return their paths. ``notes`` name the source of the numbers."""
    numbers, curves = flattened(result)
    region = given.x_range if given.region is None else given.region
    head = {"schema_version": 1, "notes": list(notes), "region": region, "working_speed": given.speed}
    write_json(out / "analysis.json", {**plain(head), **numbers})
    write_arrays(out / "curves.npz", curves)
    files = [out / "analysis.json", out / "curves.npz"]
    tables = tables_of(given, result)
    for name, table in tables.items():
        files.append(out / f"{name}.csv")
        write_text(files[-1], table.csv())
    drawn = {
        name: (save(figure, out / "figures" / f"{name}.png"), caption)
        for name, figure, caption in figures_of(given, result)
    }
    files += [path for path, _ in drawn.values()]
    page = Report(
        "Linear analysis", ", ".join(given.models), _about(given), command, _key_figures(result),
        _sections(result, tables, drawn), "; ".join(notes),
    )  # fmt: skip
    return [*files, write_report(out / "analysis.html", page)]


def flattened(value: Any, path: str = "") -> tuple[Any, dict[str, Any]]:
    """Split a result into numbers for JSON and arrays by their path.

    Example:
        >>> numbers, arrays = flattened({"a": {"gain": np.ones(2), "pole": 0.5 + 0.1j}})
        >>> numbers, list(arrays)
        ({'a': {'pole': [0.5, 0.1]}}, ['a/gain'])
    """
    if isinstance(value, np.ndarray):
        return None, {path: value}
    items: list[tuple[str, Any]]
    if is_dataclass(value):
        items = [(f.name, getattr(value, f.name)) for f in fields(value)]
    elif isinstance(value, Mapping):
        items = list(value.items())
    elif isinstance(value, list | tuple):
        items = [(str(i), one) for i, one in enumerate(value)]
    else:
        return plain(value), {}
    numbers: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for name, one in items:
        own, curves = flattened(one, f"{path}/{name}".lstrip("/"))
        arrays |= curves
        if not isinstance(one, np.ndarray):
            numbers[name] = own
    return list(numbers.values()) if isinstance(value, list | tuple) else numbers, arrays


# Tables.


def tables_of(given: AnalysisInput, result: AnalysisResult) -> dict[str, Table]:
    """Tables by file name; a missing part has none."""
    parts: dict[str, tuple[Any, Callable[[HybridModel, Any], Table]]] = {
        "equilibria": (result.equilibria, _equilibria),
        "friction": (result.friction, _friction),
        "modes": (result.linear, _modes),
        "steady_gain": (result.linear, _steady_gain),
        "margins": (result.loops, _margins),
        "gain_schedule": (result.schedule, _schedule),
        "memory": (result.memory, _memory),
        "sensitivity": (result.sensitivity, _sensitivity),
    }
    some = _some(given)
    return {name: make(some, part) for name, (part, make) in parts.items() if not isinstance(part, Missing)}


def _equilibria(some: HybridModel, part: Mapping[str, Equilibria]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (model, *p.x.tolist(), p.stability, abs(p.poles[0]), p.residual, p.hits)
        for model, found in part.items()
        for p in found.points
    ]
    return Table(
        ("model", *(s.label for s in some.states), "stability", "spectral radius [-]",
         "largest residual of a state [its unit]", "hits"),
        rows, "Equilibria under the operating point's input, in the whole range of the states.",
    )  # fmt: skip


def _friction(some: HybridModel, part: Mapping[str, FrictionAnalysis]) -> Table:
    speed = some.states[positions_of(some)]
    rows: list[tuple[Cell, ...]] = []
    for model, friction in part.items():
        slopes = friction.working
        at_work = (slopes.secant[0], slopes.harmonic[0], slopes.moving[0])
        rows.append((model, slopes.tangent, *map(float, at_work), slopes.tangent / slopes.per_input))
    working = next(iter(part.values())).working.speed[0]
    return Table(
        ("model", "tangent at rest [1/s]", "secant [1/s]", "describing function [1/s]", "tangent in motion [1/s]",
         f"tangent at rest [{ratio_unit(some.inputs[0], speed)}]"), rows,
        f"Damping of {speed.name}: at rest, and for motions of {working:.3g} {speed.unit} (working speed).",
    )  # fmt: skip


def _modes(some: HybridModel, part: Mapping[str, Mapping[str, Linearization]]) -> Table:
    rows = [
        (model, point, m.pole.real, m.pole.imag, _finite(m.frequency), m.damping, m.reach, m.see, _finite(hankel))
        for model, points in part.items()
        for point in points
        for m, hankel in zip(points[point].structure.modes, points[point].structure.hankel.tolist(), strict=True)
    ]  # fmt: skip
    return Table(
        ("model", "point", "pole, real [-]", "pole, imaginary [-]", "frequency [rad/s]", "damping [-]",
         "controllability [-]", "observability [-]", "Hankel singular value [-]"), rows,
        "Modes of the linearizations. Controllability and observability are relative distances from an uncontrollable "
        "and from an unobservable mode. Hankel singular values (inputs and outputs over their working ranges) are "
        "sorted by size; they do not belong to the mode in their row.",
    )  # fmt: skip


def _steady_gain(some: HybridModel, part: Mapping[str, Mapping[str, Linearization]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for (model, points), (i, y), (j, u) in product(
        part.items(), enumerate(some.outputs), enumerate(some.inputs)
    ):
        for point, own in points.items():
            gain = own.gain
            if isinstance(gain, SteadyGain):
                relative = None if gain.relative is None else float(gain.relative[i, j])
                here = float(gain.gain[i, j]), ratio_unit(y, u)
                rows.append((model, point, f"{y.name} by {u.name}", *here, relative))
    return Table(
        ("model", "point", "channel", "steady gain [unit beside it]", "unit", "relative gain [-]"), rows,
        "Steady-state change of an output for a unit change of an input. A relative gain near 1: this input can be "
        "paired with this output. A negative relative gain: the sign of the gain changes when the other loops are "
        "closed.",
    )  # fmt: skip


def _margins(some: HybridModel, part: Mapping[str, Mapping[str, Mapping[str, LoopAnalysis]]]) -> Table:
    names = ("gain_up", "gain_down", "phase", "delay", "delay_periods", "modulus", "disk")
    rows: list[tuple[Cell, ...]] = []
    for loop, points in part.items():
        for point, modes in points.items():
            for mode, row in modes.items():
                margins = [None if row.margins is None else _finite(getattr(row.margins, k)) for k in names]
                rows.append((loop, point, mode, row.stable, row.radius, *margins))
    return Table(
        ("loop", "point", "filter", "stable", "spectral radius [-]", "gain up [-]", "gain down [-]", "phase [rad]",
         "delay [s]", "delay [periods]", "modulus [-]", "disk [-]"), rows,
        "Margins of the linearized loops (controller on machine), broken at one input of the plant at a time.",
    )  # fmt: skip


def _schedule(some: HybridModel, part: Mapping[str, ScheduleAnalysis]) -> Table:
    heads = [f"gain of {s.name}, {end} [{ratio_unit(some.inputs[0], s)}]" for s in some.states
             for end in ("lowest", "highest")]  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for model, found in part.items():
        for point, schedule in (("rest", found.rest), ("working", found.working)):
            gain = schedule.gain[:, 0, : some.n_x]
            ends = [float(v) for pair in zip(gain.min(axis=0), gain.max(axis=0), strict=True) for v in pair]
            rows.append((model, point, *ends, float(schedule.radius.max()), len(found.not_held)))
    return Table(
        ("model", "point", *heads, "largest spectral radius [-]", "positions that no input holds"), rows,
        "LQR gains over the working range.",
    )  # fmt: skip


def _memory(some: HybridModel, part: Mapping[str, MemoryAnalysis]) -> Table:
    rows = []
    for model, found in part.items():
        hidden, certificate = found.hidden, found.certificate
        known = None if certificate is None or isinstance(certificate, Missing) else certificate
        rows.append((
            model, found.whole.value, found.whole.deviation,
            None if hidden is None else hidden.value, None if hidden is None else hidden.deviation,
            None if known is None else known.certified, None if known is None else known.index,
        ))  # fmt: skip
    return Table(
        ("model", "largest Lyapunov exponent [1/s]", "deviation [1/s]", "hidden state alone [1/s]",
         "its deviation [1/s]", "contraction certified", "index (below 1 certifies) [-]"), rows,
        "Negative exponent: neighbouring free runs converge. Negative exponent of the hidden state alone: the network "
        "forgets its initial hidden state.",
    )  # fmt: skip


def _sensitivity(some: HybridModel, part: Mapping[str, SensitivityAnalysis]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (model, name, *map(float, rms), name in found.identifiable)
        for model, found in part.items()
        for name, rms in zip(found.parameters, found.rms.T, strict=True)
    ]
    heads = [f"{s.name} per 100 % [{s.unit}]" for s in some.states]
    length = 10 * machine_second(some.dt, some.time_unit)
    return Table(
        ("model", "parameter", *heads, "identifiable"), rows,
        f"Root mean square change of a free run of {length:.4g} s. The effect of a parameter that is not identifiable "
        "is also an effect of the other parameters.",
    )  # fmt: skip


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


# Figures.

Named = Iterator[tuple[str, Figure, str]]
TITLES = {
    "rest": "at rest, where the slope of dry friction dominates", "working": "with friction of working size",
    "moving": "in motion at working speed", "driven": "along a driven run, on average",
}  # fmt: skip


def figures_of(given: AnalysisInput, result: AnalysisResult) -> Named:
    """Names, figures and captions of all computed parts; a missing part has no figure."""
    parts: tuple[tuple[Any, Callable[[AnalysisInput, Any], Named]], ...] = (
        (result.friction, _draw_friction),
        (result.linear, _draw_linear),
        (result.measured, _draw_measured),
        (result.loops, _draw_loops),
        (result.schedule, _draw_schedule),
        (result.sensitivity, _draw_sensitivity),
    )
    for part, draw in parts:
        if not isinstance(part, Missing):
            yield from draw(given, part)


def _draw_friction(given: AnalysisInput, part: Mapping[str, FrictionAnalysis]) -> Named:
    curves = {name: vars(part[name].slopes) for name in _names(given)}
    some = _some(given)
    figure = plots.friction_damping(
        curves, working_speed=float(given.speed[0]), unit=some.states[positions_of(some)].unit
    )
    yield (
        "friction",
        figure,
        "Damping at rest, and over the amplitude of the speed; negative damping is left out.",
    )


def _draw_linear(given: AnalysisInput, part: Mapping[str, Mapping[str, Linearization]]) -> Named:
    some, names = _some(given), _names(given)
    here = [point for point in POINTS if point in part[names[0]]]
    for point, name in (("rest", "poles"), ("driven", "poles_driven")):
        poles = {n: part[n][point].structure.poles for n in names}
        zeros = {n: part[n][point].zeros for n in names}
        caption = f"Poles and zeros of the linearizations {TITLES[point]}."
        yield name, plots.pole_map(poles, some.dt, zeros=zeros), caption
    for point in here:
        responses = {}
        for name in names:
            reduced = part[name][point].reduced
            responses[name] = part[name][point].response
            if isinstance(reduced, Reduction):
                responses[f"{name}, reduced to {some.n_x} states"] = reduced.response
        note = " A phase that rises at the resonance means negative damping." if point == "moving" else ""
        curves = {label: (r.omega, r.magnitude, r.phase) for label, r in responses.items()}
        for named, channel, figure in plots.bodes(curves, some.inputs, some.outputs, some.dt):
            caption = f"Bode plot of the linearizations {TITLES[point]}{channel}.{note}"
            yield f"bode_{point}{named}", figure, caption
    for i, j in product(range(some.n_y), range(some.n_u)):
        steps = {point: {n: (part[n][point].t, part[n][point].step[i, j]) for n in names} for point in here}
        figure = plots.step_responses(steps, input_signal=some.inputs[j], output_signal=some.outputs[i])
        named, channel = plots.channel_words(some.inputs, some.outputs, i, j)
        yield f"steps{named}", figure, f"Unit step responses of the linearizations{channel}."


def _draw_measured(given: AnalysisInput, part: ResponseAnalysis) -> Named:
    some = _some(given)
    found = {"measured": part.machine} | {
        name: part.models[name] for name in _names(given) if name in part.models
    }
    curves = {name: vars(one) | {"trusted": one.trusted} for name, one in found.items()}
    figure = plots.measured_bode(
        curves, input_signal=some.inputs[0], output_signal=some.outputs[0], source=part.source
    )
    caption = (
        "Machine and models with the same inputs; band: two standard deviations. Faint parts: the coherence is not "
        "significant (significance level 1 %)."
    )
    yield "measured", figure, caption


def _draw_loops(given: AnalysisInput, part: Mapping[str, Mapping[str, Mapping[str, LoopAnalysis]]]) -> Named:
    some = _some(given)
    for signal in some.inputs:
        where = at_input(some, signal)
        named = f"{plots.CHANNEL}{signal.name}" if where else ""
        driven = {
            f"{loop}, {mode.removesuffix(where)}": row
            for loop, points in part.items()
            for mode, row in points["driven"].items()
            if mode.endswith(where)
        }
        shown = {label: {"omega": r.omega, "S": r.sensitivity["S"], "T": r.sensitivity["T"]}
                 for label, r in driven.items() if r.stable}  # fmt: skip
        if shown:
            caption = f"Sensitivity functions at the plant's input{where}, linearized along a driven run."
            yield f"sensitivity{named}", plots.sensitivity_functions(shown), caption
        caption = f"Nyquist curves of the loops broken{where or ' at the input'}, linearized along a driven run, for "
        curves = {label: r.open_loop for label, r in driven.items()}
        yield f"nyquist{named}", plots.nyquist(curves, modulus=0.5), f"{caption}positive frequencies."


def _draw_schedule(given: AnalysisInput, part: Mapping[str, ScheduleAnalysis]) -> Named:
    some = _some(given)
    curves = {
        name: {
            point: (schedule.x[:, 0], schedule.gain[:, 0, : some.n_x])
            for point, schedule in (("rest", part[name].rest), ("working", part[name].working))
        }
        for name in _names(given)
    }
    figure = plots.gain_schedules(
        curves, position=some.states[0], states=some.states, input_signal=some.inputs[0]
    )
    yield "schedule", figure, "LQR gains over the position: tangent at rest, and friction of working size."


def _draw_sensitivity(given: AnalysisInput, part: Mapping[str, SensitivityAnalysis]) -> Named:
    first = next(iter(part.values()))
    for i, state in enumerate(_some(given).states):
        relative = {name: part[name].relative[:, i] for name in _names(given)}
        figure = plots.sensitivities(first.t, relative, first.parameters, output_signal=state)
        caption = f"Change of {state.name} in a free run per relative change of the prior's parameters."
        yield f"sensitivity_parameters{plots.CHANNEL}parameters_to_{state.name}", figure, caption


def _names(given: AnalysisInput) -> list[str]:
    """Models in the order of drawing: priors first, so that models with a network lie above them."""
    return sorted(given.models, key=lambda name: given.models[name].n_h)


def _some(given: AnalysisInput) -> HybridModel:
    return next(iter(given.models.values()))


# The page.

SECTIONS: Mapping[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "equilibria": ("Equilibria", ("equilibria",), ()),
    "friction": ("Friction in a linearization", ("friction",), ("friction",)),
    "linear": (
        "Linearized models",
        ("modes", "steady_gain"),
        ("poles", "bode_rest", "bode_working", "bode_moving", "bode_driven", "steps"),
    ),
    "measured": ("Comparison with the machine", (), ("measured",)),
    "loops": ("Control loops", ("margins",), ("sensitivity", "nyquist")),
    "schedule": ("Gain schedule", ("gain_schedule",), ("schedule",)),
    "memory": ("Memory of the recurrent part", ("memory",), ()),
    "sensitivity": ("Parameters", ("sensitivity",), ("sensitivity_parameters",)),
}
"""Title, tables and figures by part of the result."""


def _sections(result: AnalysisResult, tables: Mapping[str, Table], drawn: Drawn) -> list[Section]:
    sections = []
    texts = words("analysis_words.html")
    for part, (title, names, figures) in SECTIONS.items():
        found = getattr(result, part)
        notes = [f"Left out: {found.reason}."] if isinstance(found, Missing) else []
        if isinstance(found, ResponseAnalysis):
            notes += [f"Left out: {name}: {why}." for name, why in found.left_out.items()]
        shown = [tables[n] if n != "modes" else _leading(tables[n]) for n in names if n in tables]
        pictures = [
            own for f in figures for name, own in drawn.items() if name.partition(plots.CHANNEL)[0] == f
        ]
        sections.append(Section(title, texts[part], pictures, shown, notes))
    return sections


def _leading(modes: Table) -> Table:
    rows: list[Sequence[Cell]] = []
    for row in modes.rows:
        if sum(r[:2] == row[:2] for r in rows) < MODES:
            rows.append(row)
    return Table(
        modes.columns, rows, f"{modes.caption} First {MODES} modes of each; modes.csv has all modes."
    )


def _about(given: AnalysisInput) -> str:
    some = _some(given)

    def labels(signals: Sequence[Signal]) -> str:
        return ", ".join(s.label for s in signals)

    return (
        f"States {labels(some.states)}; inputs {labels(some.inputs)}; outputs {labels(some.outputs)}; period "
        f"{1e3 * some.dt:g} ms."
    )


def _key_figures(result: AnalysisResult) -> list[KeyFigure]:
    keys = []
    if not isinstance(result.measured, Missing):
        for name, error in result.measured.errors.items():
            label = f"Error of the frequency response, {name} compared with the machine"
            keys.append(KeyFigure(label, 100 * error.median, "%", "median over the frequencies"))
    if not isinstance(result.loops, Missing):
        for name in ("prior on prior", "hybrid on hybrid"):
            for mode, row in (result.loops[name]["driven"] if name in result.loops else {}).items():
                if mode.startswith("quiet") and row.margins is not None:
                    where = mode.removeprefix("quiet")
                    keys.append(
                        KeyFigure(
                            f"Delay margin along a driven run, {name}{where}", 1e3 * row.margins.delay, "ms"
                        )
                    )
    return keys
