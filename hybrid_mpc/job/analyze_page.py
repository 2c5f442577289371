"""What ``hybrid-mpc analyze`` writes: analysis.json, CSV tables, figures and a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.files import write_arrays, write_json, write_text
from hybrid_mpc.job.analyze import POINTS, Findings, Subject
from hybrid_mpc.plots import analysis
from hybrid_mpc.plots import analysis as analysis_loops
from hybrid_mpc.plots import analysis as analysis_models
from hybrid_mpc.plots.style import save
from hybrid_mpc.records import plain
from hybrid_mpc.report.page import KeyFigure, Report, Section, Table, write_report

# Texts of the analysis page: title, part of the results, tables, figures, paragraphs.

SECTIONS: Sequence[tuple[str, str, tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = (
    (
        "Points of rest",
        "equilibria",
        ("equilibria",),
        (),
        (
            "Newton's method from many starts finds states and hidden states that one step leaves where they are,"
            " to 1e-10. A point that was hit only once may have neighbours that were not hit at all.",
        ),
    ),
    (
        "Friction in a linearization",
        "friction",
        ("friction",),
        ("friction",),
        (
            "A smoothed dry friction tanh(v / v_s) has its steepest slope at rest, where the tangent takes it. No"
            " motion larger than v_s feels that slope. A chord from -v to v, or the describing function of a "
            "sinusoid of that size, says what damping such a motion sees; the tangent in motion says what small "
            "deviations from it see.",
        ),
    ),
    (
        "Linearized models",
        "linear",
        ("modes",),
        ("poles", "bode_rest", "bode_working", "bode_moving", "bode_driven", "steps"),
        (
            "Each model four times: the tangent at rest; at rest with friction of working size; the tangent in "
            "motion; the mean of the tangents along a run driven by a multisine (statistical linearization). The "
            "tangent in motion holds for deviations over times that are short against the motion. With friction "
            "of working size only the columns by the speeds are chords: what a network made of the other signals "
            "stays its tangent at rest, and that is stiction where the machine sticks.",
        ),
    ),
    (
        "Against the machine",
        "measured",
        (),
        ("measured",),
        (
            "The machine and the models were given the same inputs, and their responses estimated in the same "
            "way. That is the best linear approximation for inputs of this size: of a machine with friction it is"
            " no Jacobian of anything, and the only fair way to compare.",
        ),
    ),
    (
        "Control loops",
        "loops",
        ("margins",),
        ("sensitivity", "nyquist"),
        (
            "The gain of the MPC is the exact derivative of its QP's solution where no bound acts; the filter is "
            "the extended Kalman filter in its steady state, quiet, and as it is for a few periods after a load "
            "came or went. 'prior on hybrid' is the prior's controller and filter around the hybrid as the "
            "machine. A loop that is not stable here has no margins; the real loop is nonlinear, and bounded by "
            "what the linearization leaves out.",
        ),
    ),
    (
        "Gain schedule",
        "schedule",
        ("gain_schedule",),
        ("schedule",),
        ("LQR of the linearizations over the positions, with the weights of the control problem.",),
    ),
    (
        "Memory of the recurrent part",
        "memory",
        ("memory",),
        (),
        (
            "The certificate is sufficient for the network to forget, for all inputs in the working range. "
            "Trained networks mostly fail it and forget all the same: the exponents of a driven run say so for "
            "that run.",
        ),
    ),
    (
        "Parameters",
        "sensitivity",
        ("sensitivity",),
        ("sensitivity_parameters",),
        ("Exact derivatives of a free run by the prior's parameters, in the prior and within the hybrid.",),
    ),
)


# The figures of an analysis.

Named = Iterator[tuple[str, Figure, str]]
_TITLES = {
    "rest": "at rest, where the slope of dry friction dominates", "working": "with friction of working size",
    "moving": "in motion at working speed", "driven": "along a driven run, on average",
}  # fmt: skip

_NOTES = {"moving": " A phase that rises at the resonance tells of negative damping."}


def figures(folder: Path, subject: Subject, findings: Findings) -> dict[str, tuple[Path, str]]:
    """Draw what was found; parts that could not be had have no figure.

    Args:
        folder: Where the PNG files go; made if missing.
        subject: What was analyzed.
        findings: What was found.

    Returns:
        Path and caption by name.
    """
    parts: Mapping[str, Callable[[Subject, Findings], Named]] = {
        "friction": _draw_friction, "linear": _linear, "measured": _measured, "loops": _loops,
        "schedule": _draw_schedule, "sensitivity": _draw_sensitivity,
    }  # fmt: skip
    drawn = {}
    for part, draw in parts.items():
        if "reason" in findings.result[part]:
            continue
        for name, figure, caption in draw(subject, findings):
            drawn[name] = save(figure, folder / f"{name}.png"), caption
    return drawn


def _draw_friction(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    curves = {
        name: {k: f.arrays[f"friction/{name}/{k}"] for k in ("speed", "secant", "harmonic", "moving")}
        | {"tangent": np.asarray(f.result["friction"][name]["tangent_1_s"])}
        for name in _names(subject)
    }
    unit = some.states[some.n_x // 2].unit
    figure = analysis_models.friction_damping(curves, working_speed=float(subject.speed[0]), unit=unit)
    yield (
        "friction",
        figure,
        "Damping as seen at rest and by motions of a size; negative slopes are left out.",
    )


def _linear(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    for point, figure in (("rest", "poles"), ("driven", "poles_driven")):
        poles, zeros = (
            {n: f.arrays.get(f"linear/{n}/{point}/{kind}", ()) for n in _names(subject)}
            for kind in ("poles", "zeros")
        )
        caption = f"Poles and zeros of the linearizations {_TITLES[point]}."
        yield figure, analysis.pole_map(poles, some.dt, zeros=zeros), caption
    signals: dict[str, Any] = {"input_signal": some.inputs[0], "output_signal": some.outputs[0]}
    for point in POINTS:
        curves = {}
        for key in (f"{name}{suffix}" for name in _names(subject) for suffix in ("", "_reduced")):
            name = key.removesuffix("_reduced")
            at = f"linear/{name}/{point}{key[len(name) :]}"
            if f"{at}/omega" in f.arrays:
                label = name if key == name else f"{name}, reduced to {some.n_x} states"
                curves[label] = (
                    f.arrays[f"{at}/omega"], f.arrays[f"{at}/magnitude"][0, 0], f.arrays[f"{at}/phase"][0, 0]
                )  # fmt: skip
        drawn = analysis.bode(curves, **signals, nyquist=np.pi / some.dt)
        yield (
            f"bode_{point}",
            drawn,
            f"Bode plot of the linearizations {_TITLES[point]}.{_NOTES.get(point, '')}",
        )
    steps = {
        point: {
            name: (f.arrays[f"linear/{name}/{point}/t"], np.reshape(
                f.arrays[f"linear/{name}/{point}/step"], (some.n_y, some.n_u, -1))[0, 0])
            for name in _names(subject)
        }
        for point in POINTS
    }  # fmt: skip
    yield (
        "steps",
        analysis_models.step_responses(steps, **signals),
        "Unit step responses of the linearizations.",
    )


def _measured(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    keys = ("omega", "response", "coherence", "deviation")
    curves = {n: {k: f.arrays[f"measured/{n}/{k}"] for k in keys} for n in ("measured", *_names(subject))}
    figure = analysis_models.measured_bode(
        curves,
        input_signal=some.inputs[0],
        output_signal=some.outputs[0],
        source=f.result["measured"]["source"],
    )
    yield (
        "measured",
        figure,
        "Machine and models driven by the same inputs; band: two deviations.",
    )


def _loops(subject: Subject, f: Findings) -> Named:
    shown, curves = {}, {}
    for loop, points in f.result["loops"].items():
        for mode, row in points["driven"].items():
            at = f"loops/{loop}/driven/{mode}"
            label = f"{loop}, {mode}"
            curves[label] = f.arrays[f"{at}/L"]
            if row["stable"]:
                shown[label] = {k: f.arrays[f"{at}/{k}"] for k in ("omega", "S", "T")}
    if shown:
        caption = "Sensitivity functions at the plant's input, linearized along a driven run."
        yield "sensitivity", analysis_loops.sensitivity_functions(shown), caption
    caption = "Nyquist curves of the loops, linearized along a driven run; positive frequencies."
    yield "nyquist", analysis_loops.nyquist(curves, modulus=0.5), caption


def _draw_schedule(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    curves: dict[str, dict[str, Any]] = {}
    for name in _names(subject):
        for point in ("rest", "working"):
            x, gain = (f.arrays[f"schedule/{name}/{point}/{key}"] for key in ("x", "gain"))
            curves.setdefault(name, {})[point] = x[:, 0], gain[:, 0, : some.n_x]
    figure = analysis_loops.gain_schedules(curves, position=some.states[0], states=some.states)
    yield "schedule", figure, "LQR gains over the position: tangent at rest, and friction of working size."


def _draw_sensitivity(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    first = next(iter(subject.models))
    relative = {name: f.arrays[f"sensitivity/{name}/relative"][:, 0] for name in _names(subject)}
    names = f.result["sensitivity"][first]["parameters"]
    figure = analysis_models.sensitivities(
        f.arrays[f"sensitivity/{first}/t"], relative, names, output_signal=some.states[0]
    )
    yield (
        "sensitivity_parameters",
        figure,
        "Change of a free run per relative change of the prior's parameters.",
    )


def _names(subject: Subject) -> list[str]:
    """Models in the order they are drawn in: priors first, so that what has a network lies above them."""
    return sorted(subject.models, key=lambda name: subject.models[name].n_h)


def _some(subject: Subject) -> Any:
    return next(iter(subject.models.values()))


MODES = 6
"""Modes of each linearization in the page's table; the CSV has all."""


def write_analysis(
    out: Path, subject: Subject, findings: Findings, notes: Sequence[str], command: str
) -> list[Path]:
    """Write everything of an analysis into a folder.

    Args:
        out: Folder; made if missing.
        subject: What was analyzed.
        findings: What was found.
        notes: Where the numbers came from.
        command: The command line that repeats it.

    Returns:
        The files.
    """
    result = plain(findings.result)
    write_json(out / "analysis.json", {"schema_version": 1, "notes": list(notes), **result})
    write_arrays(out / "curves.npz", findings.arrays)
    files = [out / "analysis.json", out / "curves.npz"]
    made = tables(result)
    for name, table in made.items():
        files.append(out / f"{name}.csv")
        write_text(files[-1], as_csv(table))
    drawn = figures(out / "figures", subject, findings)
    files += [path for path, _ in drawn.values()]
    page = Report(
        "Linear analysis", ", ".join(subject.models), _about(subject), command, _key_figures(result),
        _sections(result, made, drawn), "; ".join(notes),
    )  # fmt: skip
    return [*files, write_report(out / "analysis.html", page)]


def as_csv(table: Table) -> str:
    r"""A table as CSV: a header, numbers with all their digits, texts with commas quoted.

    Example:
        >>> as_csv(Table(("model", "x [rad]"), (("prior", 0.1), ("a, b", None))))
        'model,x [rad]\nprior,0.1\n"a, b",\n'
    """
    rows = [table.columns, *table.rows]
    return "".join(",".join(_field(value) for value in row) + "\n" for row in rows)


def _field(value: Any) -> str:
    text = "" if value is None else repr(value) if isinstance(value, float) else str(value)
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text


def tables(result: dict[str, Any]) -> dict[str, Table]:
    """Tables by file name, from the plain numbers of an analysis; parts that could not be had are left out.

    Args:
        result: :attr:`Findings.result` in plain form.
    """
    makers = {
        "equilibria": _equilibria, "friction": _friction, "modes": _modes, "margins": _margins,
        "gain_schedule": _schedule, "memory": _memory, "sensitivity": _sensitivity,
    }  # fmt: skip
    parts = {"modes": "linear", "margins": "loops", "gain_schedule": "schedule"}
    found = {name: result[parts.get(name, name)] for name in makers}
    return {name: make(found[name]) for name, make in makers.items() if "reason" not in found[name]}


def _equilibria(part: dict[str, Any]) -> Table:
    rows = []
    for model, found in part.items():
        if model == "region":
            continue
        for p in found["points"]:
            x = ", ".join(f"{v:.6g}" if abs(v) > 1e-9 else "0" for v in p["x"])
            rows.append((model, x, p["stability"], p["radius"], p["residual"], p["hits"]))
    return Table(
        ("model", "state", "stability", "spectral radius", "residual", "hits"), rows,
        "Points of rest without input in the whole range of the states.",
    )  # fmt: skip


def _friction(part: dict[str, Any]) -> Table:
    rows = [
        (m, f["tangent_1_s"], f["secant_1_s"], f["harmonic_1_s"], f["moving_1_s"], f["tangent_1_s"] / f["per_input"])
        for m, f in part.items() if m != "working_speed"
    ]  # fmt: skip
    return Table(
        ("model", "tangent at rest [1/s]", "secant [1/s]", "describing function [1/s]", "tangent in motion [1/s]",
         "tangent at rest [input per speed]"), rows,
        f"Damping as seen at rest and by motions of {part['working_speed'][0]:.3g} (working speed).",
    )  # fmt: skip


def _modes(part: dict[str, Any]) -> Table:
    rows = []
    for model, points in part.items():
        for point in POINTS:
            for m, hankel in zip(points[point]["modes"], points[point]["hankel"], strict=True):
                infinite = isinstance(m["frequency"], str)
                rows.append((
                    model, point, m["pole"][0], m["pole"][1], None if infinite else m["frequency"], m["damping"],
                    m["reach"], m["see"], None if isinstance(hankel, str) else hankel,
                ))  # fmt: skip
    return Table(
        ("model", "point", "pole, real", "pole, imaginary", "frequency [rad/s]", "damping", "reach", "see",
         "Hankel singular value (own order)"), rows,
        "Modes of the linearizations; reach and see are distances from being uncontrollable and unobservable.",
    )  # fmt: skip


def _margins(part: dict[str, Any]) -> Table:
    rows = []
    for loop, points in part.items():
        for point, modes in points.items():
            for mode, row in modes.items():
                m = row.get("margins", {})
                numbers = (
                    m.get(k) for k in ("gain_up", "gain_down", "phase", "delay", "delay_periods", "modulus", "disk")
                )  # fmt: skip
                shown = [None if isinstance(v, str) else v for v in numbers]
                rows.append((loop, point, mode, row["stable"], row["radius"], *shown))
    return Table(
        ("loop", "point", "filter", "stable", "spectral radius", "gain up", "gain down", "phase [rad]", "delay [s]",
         "delay [periods]", "modulus", "disk"), rows,
        "Margins of the linearized loops (controller on machine), broken at the plant's input.",
    )  # fmt: skip


def _schedule(part: dict[str, Any]) -> Table:
    rows = []
    for model, found in part.items():
        for point in ("rest", "working"):
            f = found[point]
            low, high = f["gain_lowest"], f["gain_highest"]
            rows.append(
                (model, point, low[0], high[0], low[1], high[1], f["radius"], len(found["positions_lost"]))
            )
    return Table(
        ("model", "point", "position gain, lowest", "highest", "speed gain, lowest", "highest",
         "largest spectral radius", "positions that nothing holds"), rows,
        "LQR gains over the working range.",
    )  # fmt: skip


def _memory(part: dict[str, Any]) -> Table:
    rows = []
    for model, f in part.items():
        c = f.get("certificate", {})
        rows.append((
            model, f["lyapunov_all_1_s"], f["lyapunov_all_deviation"], f.get("lyapunov_hidden_1_s"),
            f.get("lyapunov_hidden_deviation"), c.get("certified"), c.get("index"),
        ))  # fmt: skip
    return Table(
        ("model", "largest Lyapunov exponent [1/s]", "deviation", "hidden state alone [1/s]", "deviation",
         "contraction certified", "index (below 1 certifies)"), rows,
        "Do neighbouring free runs part, and does the network forget where its hidden state began?",
    )  # fmt: skip


def _sensitivity(part: dict[str, Any]) -> Table:
    rows = [
        (model, name, rms, name in f["told_apart"])
        for model, f in part.items()
        for name, rms in zip(f["parameters"], f["rms_per_100_percent"][0], strict=True)
    ]
    return Table(
        ("model", "parameter", "first state per 100 %", "told apart"), rows,
        "Root mean square change of a 10 s free run; parameters not told apart are products of others to this run.",
    )  # fmt: skip


def _about(subject: Subject) -> str:
    some = next(iter(subject.models.values()))
    names = [", ".join(s.label for s in signals) for signals in (some.states, some.inputs, some.outputs)]
    return f"States {names[0]}; inputs {names[1]}; outputs {names[2]}; period {1e3 * some.dt:g} ms."


def _key_figures(result: dict[str, Any]) -> list[KeyFigure]:
    keys = []
    for name, row in result["measured"].items():
        if isinstance(row, dict):
            error = 100 * row["median_relative_error"]
            keys.append(
                KeyFigure(f"Response to the machine's inputs, {name} against machine", error, "%", "median")
            )
    for name in ("prior on prior", "hybrid on hybrid"):
        row = result["loops"].get(name, {}).get("driven", {}).get("quiet", {})
        if isinstance(row, dict) and "margins" in row:
            keys.append(KeyFigure(f"Delay margin, driven, {name}", 1e3 * row["margins"]["delay"], "ms"))
    return keys


def _sections(
    result: dict[str, Any], made: dict[str, Table], drawn: dict[str, tuple[Path, str]]
) -> list[Section]:
    sections = []
    for title, part, names, figures, paragraphs in SECTIONS:
        notes = [f"Left out: {result[part]['reason']}."] if "reason" in result[part] else []
        shown = [made[n] if n != "modes" else _leading(made[n]) for n in names if n in made]
        sections.append(Section(title, paragraphs, [drawn[f] for f in figures if f in drawn], shown, notes))
    return sections


def _leading(modes: Table) -> Table:
    """The first modes of each linearization."""
    rows: list[Any] = []
    for row in modes.rows:
        if sum(r[:2] == row[:2] for r in rows) < MODES:
            rows.append(row)
    return Table(modes.columns, rows, f"{modes.caption} The first {MODES} of each; modes.csv has all.")
