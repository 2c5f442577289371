"""What ``hybrid-mpc analyze`` writes: analysis.json, CSV tables, figures and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hybrid_mpc.analysis.study import POINTS, Findings, Subject
from hybrid_mpc.files import write_arrays, write_json, write_text
from hybrid_mpc.records import plain
from hybrid_mpc.report import KeyFigure, Report, Section, Table, write_report

MODES = 6
"""Modes of each linearisation in the page's table; the CSV has all."""


def write_analysis(
    out: Path, subject: Subject, findings: Findings, notes: Sequence[str], command: str
) -> list[Path]:
    """Write everything of an analysis into a folder.

    Args:
        out: Folder; made if missing.
        subject: What was analysed.
        findings: What was found.
        notes: Where the numbers came from.
        command: The command line that repeats it.

    Returns:
        The files.
    """
    from hybrid_mpc.analysis.drawing import figures

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
        "Modes of the linearisations; reach and see are distances from being uncontrollable and unobservable.",
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
        "Margins of the linearised loops (controller on machine), broken at the plant's input.",
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
    from hybrid_mpc.analysis.words import SECTIONS

    sections = []
    for title, part, names, figures, paragraphs in SECTIONS:
        notes = [f"Left out: {result[part]['reason']}."] if "reason" in result[part] else []
        shown = [made[n] if n != "modes" else _leading(made[n]) for n in names if n in made]
        sections.append(Section(title, paragraphs, [drawn[f] for f in figures if f in drawn], shown, notes))
    return sections


def _leading(modes: Table) -> Table:
    """The first modes of each linearisation."""
    rows: list[Any] = []
    for row in modes.rows:
        if sum(r[:2] == row[:2] for r in rows) < MODES:
            rows.append(row)
    return Table(modes.columns, rows, f"{modes.caption} The first {MODES} of each; modes.csv has all.")
