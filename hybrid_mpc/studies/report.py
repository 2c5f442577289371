"""Report of a study: one HTML page in the look of the main job's."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_mpc.errors import InputError
from hybrid_mpc.plots import save
from hybrid_mpc.plots.style import name_of
from hybrid_mpc.report import KeyFigure, Report, Section, Table, write_report
from hybrid_mpc.studies.results import StudyResults
from hybrid_mpc.studies.runner import duration_text

if TYPE_CHECKING:
    import pandas as pd

STEP = "timing_step_median_ms"
NEEDED = ("cost", "task", "controller", "share_MPC", "timing_cpu_s", STEP)
"""Columns that the report is made of, beside those that a study may have."""
SHOWN_FAILURES = 20


def write_study_report(results: StudyResults, path: str | Path | None = None) -> Path:
    """Write the report of a study.

    Args:
        results: The study; it may still run.
        path: File to write. Default: ``report.html`` in the study's folder.

    Returns:
        The path.

    Raises:
        InputError: If no run has finished yet.

    Example: ``write_study_report(StudyResults.load("studies/first"))``
    """
    if len(results.table) == len(results.failed):
        raise InputError(f"{results.folder}: no run has been done yet, there is nothing to report")
    if lacking := [column for column in NEEDED if column not in results.table]:
        raise InputError(
            f"{results.folder}: its rows have no {', '.join(lacking)}; another version wrote them"
        )
    with tempfile.TemporaryDirectory() as folder:
        report = _report(results, Path(folder))
        return write_report(path or results.folder / "report.html", report)


def _report(results: StudyResults, folder: Path) -> Report:
    study, note = results.note.study, results.note
    sections = [
        _what(results),
        Section("Costs", COST_TEXT, _figure(_distributions, results, folder), [_summary_table(results)]),
        *_comparison(results, folder),
        Section("Cost against computing time", TIME_TEXT, _figure(_pareto, results, folder)),
        *_task_figures(results),
        *_failures(results),
    ]
    return Report(
        f"Study {study['name']}", note.title, note.description,
        f"hybrid-mpc study run {study['name']} --out {results.folder.name}", _head(results), sections,
        f"hybrid-mpc {note.versions['hybrid-mpc']}, {note.engine or 'not finished'}",
    )  # fmt: skip


COST_TEXT = (
    "Closed-loop cost on the plant's true state, with the 95 % interval of the mean (Student's t). A unit of the "
    "statistics is a draw where there are several, for its seeds share one machine; else a seed.",
)
PAIRED_TEXT = (
    "Differences between runs that met the same draw and the same sensor noise: what varies from draw to draw alike "
    "for all cancels, so that the interval is that of the difference itself.",
)
TIME_TEXT = (
    "Median duration of a whole step (estimate, solve, monitor), averaged over the runs. Runs were computed side by "
    "side: durations are comparable among each other, and longer than on a machine of one's own.",
)


def _head(results: StudyResults) -> list[KeyFigure]:
    table, failed = results.table, len(results.failed)
    solved, spent = float(table["share_MPC"].mean()), float(table["timing_cpu_s"].sum())
    figures = [
        KeyFigure("Runs", len(table), "", f"{results.missing} missing" if results.missing else "all"),
        KeyFigure(
            "Failed runs", failed, "", "tracebacks below" if failed else "", "bad" if failed else "good"
        ),
        KeyFigure("Periods solved", 100 * solved, "%"),
        KeyFigure("Computing time", duration_text(spent), "", "of all processes together"),
    ]
    if "controller" in results.factors:
        base = name_of(str(table["controller"].iloc[0]))
        for name, rows in results.paired().groupby("controller", sort=False):
            ratio = float(np.exp(np.log(rows["ratio"]).mean()))
            text = f"of its cost with {base}: geometric mean over pairs"
            figures.append(KeyFigure(f"Cost: {name_of(str(name))}", 100 * ratio, "%", text))
    return figures


def _what(results: StudyResults) -> Section:
    study = results.note.study
    defaults: tuple[Any, ...] = (None, [], [None], ["own"], [[]], {})
    rows = [(key, _short(value)) for key, value in study.items() if value not in defaults]
    rows += [(f"model {k}: noise", m.noise.source) for k, m in results.note.models.items()]
    return Section("Configuration", (), (), [Table(("setting", "value"), rows)])


def _short(value: Any) -> str:
    if isinstance(value, list) and len(value) > 12:
        return f"{len(value)} values, {_short(value[0])} to {_short(value[-1])}"
    if isinstance(value, list):
        return ", ".join(_short(v) for v in value)
    if isinstance(value, dict):
        return "; ".join(f"{k}: {_short(v)}" for k, v in value.items() if v not in (None, 0.0, False))
    return str(value)


def _summary_table(results: StudyResults, value: str = "cost") -> Table:
    found = results.summary(value)
    return Table(
        tuple(found.columns), _cells(found), f"{value}: mean, ends of the 95 % interval, runs left out."
    )


def _cells(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    return [tuple(_cell(v) for v in row) for row in table.itertuples(index=False)]


def _cell(value: Any) -> Any:
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _over(results: StudyResults) -> str | None:
    """The column whose levels are compared: controllers where there are several, else what else differs."""
    order = ("controller", "model", "solver", "horizon", "faults", "monitor")
    return next((c for c in order if c in results.factors), None)


def _comparison(results: StudyResults, folder: Path) -> list[Section]:
    over = _over(results)
    if over is None:
        return []
    found = results.paired(over=over)
    table = Table(tuple(found.columns), _cells(found), f"Cost of each {over} less that of the first.")
    return [Section("Paired differences", PAIRED_TEXT, _figure(_differences, results, folder), [table])]


def _task_figures(results: StudyResults) -> list[Section]:
    names = [c for c in results.figures if c.startswith("task_")]
    tables = []
    for name in names:
        found = results.summary(name)
        found = found[found["n"] > 0]
        if len(found):
            tables.append(Table(tuple(found.columns), _cells(found), f"{name.removeprefix('task_')}: mean."))
    return [Section("The tasks' own figures", (), (), tables)] if tables else []


def _failures(results: StudyResults) -> list[Section]:
    failed = results.failed
    if not len(failed):
        return []
    columns = ["model", "task", "controller", "draw", "seed"]
    rows = [
        (*(_cell(row[c]) for c in columns), row["error"].strip().splitlines()[-1])
        for _, row in failed.iterrows()
    ]
    text = f"{len(failed)} runs have failed; the first are listed. The column 'error' of the table has the tracebacks."
    return [Section("Failed runs", (text,), (), [Table((*columns, "error"), rows[:SHOWN_FAILURES])])]


def _figure(draw: Any, results: StudyResults, folder: Path) -> Sequence[tuple[Path, str]]:
    try:
        figure, caption = draw(results)
    except InputError:  # no finite value: the table says so
        return ()
    return [(save(figure, folder / f"{draw.__name__.strip('_')}.png"), caption)]


def _levels(results: StudyResults, table: pd.DataFrame, without: str = "task") -> Any:
    """Groups of rows by task, and within by all else that differs, with one name each."""
    others = [c for c in results.factors if c != without]
    for task, group in table.groupby("task", sort=False):
        named = group[others].astype(str).agg(", ".join, axis=1) if others else group["controller"]
        yield str(task), group.groupby(named, sort=False)


def _distributions(results: StudyResults) -> tuple[Any, str]:
    from hybrid_mpc.plots import studies

    values = {
        task: {str(level): g["cost"].to_numpy() for level, g in rows}
        for task, rows in _levels(results, results.table)
    }
    return studies.distributions(
        values, "cost [-]"
    ), "How the cost is distributed over the runs of each task."


def _differences(results: StudyResults) -> tuple[Any, str]:
    from hybrid_mpc.plots import studies

    over = _over(results)
    found = results.paired(over=over or "controller")
    others = [c for c in results.factors if c not in ("task", over)]
    rows: dict[str, dict[str, tuple[float, float, float]]] = {}
    for _, row in found.iterrows():
        level = ", ".join(str(row[c]) for c in (over or "controller", *others))
        scale = 100.0 / row["base"] if row["base"] else math.nan
        ends = scale * row["difference"], scale * row["low"], scale * row["high"]
        rows.setdefault(str(row.get("task", "all runs")), {})[level] = ends
    return studies.differences(rows, "difference of cost [% of the first]"), "Paired differences of the cost."


def _pareto(results: StudyResults) -> tuple[Any, str]:
    from hybrid_mpc.plots import studies

    points = {
        task: {str(level): (float(g[STEP].mean()), float(g["cost"].mean())) for level, g in rows}
        for task, rows in _levels(results, results.table)
    }
    return studies.pareto(
        points, "cost [-]"
    ), "Mean cost against the duration of a step; the line joins the front."
