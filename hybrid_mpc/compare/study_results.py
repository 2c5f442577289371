"""Results of a study: a table with one row for each run, means with intervals, paired differences, and the report."""

from __future__ import annotations

import math
import shlex
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hybrid_mpc.compare.study_log import (
    RESULTS,
    RUNS,
    StudyNote,
    intact,
    note_of,
    provenance_of,
    rows,
    study_note,
)
from hybrid_mpc.compare.summary import interval
from hybrid_mpc.errors import InputError
from hybrid_mpc.plots import studies
from hybrid_mpc.plots.style import name_of, save
from hybrid_mpc.records import known
from hybrid_mpc.report.page import KeyFigure, Report, Section, Table, write_report
from hybrid_mpc.rules import counted

FACTORS = ("model", "task", "controller", "solver", "horizon", "monitor", "faults")
PAIR = ("draw", "seed")


@dataclass(frozen=True, eq=False)
class StudyResults:
    """Results of a study.

    Args:
        table: One row for each run: ``id``, configuration, ``status``, ``error``, results, ``timing_...``.
        note: Configuration of the study, digests of the models, versions.
        folder: Folder of the study.

    Example:
        >>> import pandas as pd
        >>> runs = [{"controller": c, "seed": s, "cost": v + 0.1 * s, "status": "done"}
        ...     for c, v in (("prior", 2.0), ("hybrid", 1.0)) for s in (0, 1)]
        >>> results = StudyResults(pd.DataFrame(runs), StudyNote({}, "", "", {}, 4), Path("."))
        >>> results.summary()[["controller", "mean"]].values.tolist()
        [['prior', 2.05], ['hybrid', 1.05]]
        >>> float(results.paired(base="prior")["difference"].iloc[0])
        -1.0
    """

    table: pd.DataFrame
    note: StudyNote
    folder: Path

    @classmethod
    def load(cls, folder: str | Path) -> StudyResults:
        """Read the results of a study's folder; of an unfinished study the finished runs.

        Raises:
            InputError: If the folder belongs to no study, or is damaged.
        """
        import pyarrow.parquet as pq

        folder = Path(folder)
        note = study_note(folder)
        if intact(folder / RESULTS):
            table = pq.read_table(folder / RESULTS).to_pandas()
            note = note_of(provenance_of(folder / RESULTS), str(folder / RESULTS))
        else:  # not written yet, or damaged: the log has every row
            table = pd.DataFrame({row.id: row.plain() for row in rows(folder / RUNS)}.values())
        if "run" in table:  # the order in which they ended
            table = table.sort_values("run", ignore_index=True)
        return cls(table, note, folder)

    @property
    def failed(self) -> pd.DataFrame:
        """Failed runs (exception, or worker died), with the traceback in ``error``."""
        return self.table[self.table["status"] == "failed"] if len(self.table) else self.table

    @property
    def missing(self) -> int:
        """Number of runs that are not finished."""
        return max(0, self.note.runs - len(self.table))

    @property
    def factors(self) -> list[str]:
        """Columns of the configuration that differ between runs, without draw and seed."""
        return [c for c in FACTORS if c in self.table and self.table[c].nunique(dropna=False) > 1]

    @property
    def figures(self) -> list[str]:
        """Numeric columns with results."""
        others = {*FACTORS, *PAIR, "id", "run", "hidden_units"}
        names = self.table.select_dtypes("number").columns
        return [c for c in names if c not in others and not c.startswith("factor_")]

    def summary(self, value: str = "cost", by: Sequence[str] | None = None) -> pd.DataFrame:
        """Mean of a figure with its 95 % interval (Student's t).

        With several draws, a statistical unit is a draw (its seeds are averaged first, since they share the plant);
        else a seed.

        Args:
            value: Column of a figure. Default: cost.
            by: Columns to group by. Default: those that differ between the runs.

        Returns:
            ``by``, ``n`` units, ``mean``, ``low``, ``high`` (NaN for one unit), and ``left_out``: number of failed runs
            and of runs without a finite figure.

        Raises:
            InputError: If the column is unknown.
        """
        table, by = self._checked(value), self.factors if by is None else list(by)
        found = []
        for key, group in _group_rows(table, by):
            units = self._units(group, value)
            middle, half = _interval(units[value])
            left_out = len(group) - int(np.isfinite(group[value]).sum())
            found.append((*key, len(units), middle, middle - half, middle + half, left_out))
        return pd.DataFrame(found, columns=[*by, "n", "mean", "low", "high", "left_out"])

    def paired(
        self,
        value: str = "cost",
        over: str = "controller",
        base: object = None,
        by: Sequence[str] | None = None,
    ) -> pd.DataFrame:
        """Paired differences to a base on common draws and seeds, with their 95 % intervals.

        Args:
            value: Column of a figure. Default: cost.
            over: Column whose levels are compared. Default: controller.
            base: Level that the others are compared with. Default: the first.
            by: Columns to group by. Default: the other columns that differ between the runs.

        Returns:
            ``by``, ``over``, ``n`` pairs (of draws if there are several), ``base`` (its mean), ``difference``,
            ``low``, ``high``, ``relative`` (difference over the base's mean), ``ratio`` (geometric mean of the pairs'
            ratios; NaN if a value is not positive) and ``better`` (share of pairs with a negative difference).

        Raises:
            InputError: If the column or level is unknown.
        """
        table = self._checked(value)
        known(over, table.columns, "column")
        levels = list(dict.fromkeys(table[over].tolist()))
        base = levels[0] if base is None else base
        if base not in levels:
            raise InputError(
                f"{over}: no {base!r} in this study; choose from: {', '.join(map(str, levels))} [HM-COMPARE-051]"
            )
        by = [c for c in self.factors if c != over] if by is None else list(by)
        found = []
        for key, group in _group_rows(table, by):
            first = self._units(group[group[over] == base], value)
            for level in levels:
                if level != base:
                    second = self._units(group[group[over] == level], value)
                    found.append((*key, level, *_difference(first, second, value)))
        return pd.DataFrame(found, columns=[*by, over, *DIFFERENCE])

    def compare(self, other: StudyResults, value: str = "cost") -> pd.DataFrame:
        """Paired differences of another study to this one, for runs of the same configuration.

        Columns that are constant within each study but differ between both (e.g. the model's label) are compared; all
        other columns must agree in a pair.

        Args:
            other: The other study.
            value: Column of a figure. Default: cost.

        Returns:
            As :meth:`paired`, of ``other`` against this study; ``attrs["differs"]`` holds the compared columns.

        Raises:
            InputError: If the studies have no run in common.
        """
        mine, theirs = self._checked(value), other._checked(value)
        shared = [c for c in (*FACTORS, *PAIR, "drawn_faults") if c in mine and c in theirs]
        shared += sorted(str(c) for c in mine if str(c).startswith("factor_") and c in theirs)
        differs = [
            c
            for c in shared
            if mine[c].nunique(dropna=False) == 1 == theirs[c].nunique(dropna=False)
            and str(mine[c].iloc[0]) != str(theirs[c].iloc[0])
        ]
        on = [c for c in shared if c not in differs]
        by = [c for c in FACTORS if c in on and (c in self.factors or c in other.factors)]
        joined = mine.merge(theirs, on=on, suffixes=("", " "))
        if joined.empty:
            raise InputError(
                f"{self.folder} and {other.folder}: no run in common, because tasks, controllers, draws or seeds "
                "differ. Compare studies that share them [HM-COMPARE-052]"
            )
        found = []
        for key, group in _group_rows(joined, by):
            first = self._units(group, value)
            second = self._units(group.assign(**{value: group[value + " "]}), value)
            found.append((*key, *_difference(first, second, value)))
        result = pd.DataFrame(found, columns=[*by, *DIFFERENCE])
        result.attrs["differs"] = {c: (str(mine[c].iloc[0]), str(theirs[c].iloc[0])) for c in differs}
        return result

    def _checked(self, value: str) -> pd.DataFrame:
        known(value, self.figures, "figure")
        return self.table

    def _units(self, group: pd.DataFrame, value: str) -> pd.DataFrame:
        """One row for each statistical unit: a draw if there are several, else a draw and seed."""
        finite = group[np.isfinite(group[value])]
        keys = [c for c in PAIR if c in finite]
        if "draw" in self.table and self.table["draw"].nunique() > 1:
            keys = ["draw"]
        return finite.groupby(keys, as_index=False, sort=True)[value].mean()


DIFFERENCE = ("n", "base", "difference", "low", "high", "relative", "ratio", "better")


def _group_rows(table: pd.DataFrame, by: Sequence[str]) -> Any:
    """Groups with their keys, in the order of the table; a single group for no columns."""
    if not by:
        return [((), table)]
    return table.groupby(list(by), sort=False, dropna=False)


def _interval(values: Any) -> tuple[float, float]:
    found = interval(np.asarray(values, dtype=float).tolist())
    return (math.nan if found.mean is None else found.mean, math.nan if found.ci95 is None else found.ci95)


def _difference(first: pd.DataFrame, second: pd.DataFrame, value: str) -> tuple[float, ...]:
    """Figures of the common units: number, mean of the first, difference with interval, relative, ratio, better."""
    keys = [c for c in first.columns if c != value]
    both = first.merge(second, on=keys, suffixes=("", " "))
    change = both[f"{value} "] - both[value]
    middle, half = _interval(change)
    mean = float(both[value].mean()) if len(both) else math.nan
    relative = middle / mean if mean else math.nan
    values = both[[value, f"{value} "]].to_numpy()
    positive = len(both) > 0 and bool((values > 0).all())
    ratio = float(np.exp(np.mean(np.diff(np.log(values), axis=1)))) if positive else math.nan
    better = float((change < 0).mean()) if len(both) else math.nan
    return len(both), mean, middle, middle - half, middle + half, relative, ratio, better


STEP = "timing_step_median_ms"
NEEDED = ("cost", "task", "controller", "share_MPC", "timing_cpu_s", STEP)
"""Columns that the report needs; further columns are optional."""
SHOWN_FAILURES = 20


def write_study_report(results: StudyResults, path: str | Path | None = None) -> Path:
    """Write the report of a study.

    Args:
        results: Results of a finished or running study.
        path: File to write. Default: ``report.html`` in the study's folder.

    Returns:
        The path.

    Raises:
        InputError: If no run has succeeded yet.

    Example: ``write_study_report(StudyResults.load("studies/first"))``
    """
    if len(results.table) == len(results.failed):
        raise InputError(
            f"{results.folder}: no successful run yet, so there is nothing to report [HM-COMPARE-053]"
        )
    if lacking := [column for column in NEEDED if column not in results.table]:
        raise InputError(
            f"{results.folder}: rows without {', '.join(lacking)}; another version wrote them. Run the study again "
            "[HM-COMPARE-054]"
        )
    with tempfile.TemporaryDirectory() as folder:
        report = _build_report(results, Path(folder))
        return write_report(path or results.folder / "report.html", report)


def _build_report(results: StudyResults, folder: Path) -> Report:
    study, note = results.note.study, results.note
    costs = _make_table(results.summary(), "cost: mean, 95 % interval, number of excluded runs.")
    sections = [
        _describe_study(results),
        Section("Costs", COST_TEXT, _figure(_distributions, results, folder), [costs]),
        *_comparison(results, folder),
        *_tracking(results, folder),
        Section("Cost against computing time", TIME_TEXT, _figure(_pareto, results, folder)),
        *_task_figures(results),
        *_failures(results),
    ]
    return Report(
        f"Study {study['name']}", note.title, note.description,
        shlex.join(["hybrid-mpc", "study", "run", study["name"], "--out", results.folder.name]), _head(results),
        sections,
        f"hybrid-mpc {note.versions['hybrid-mpc']}, {note.engine or 'not finished'}",
    )  # fmt: skip


COST_TEXT = (
    "Closed-loop cost on the plant's true state: sum of the squared deviations of all signals, weighted as in the "
    "control problem, with the 95 % interval of the mean (Student's t). With several draws, a statistical unit is a "
    "draw, since its seeds share one plant; else a seed.",
)
PAIRED_TEXT = (
    "Differences between runs with the same draw and the same sensor noise. Variation between draws that affects all "
    "runs alike cancels, so the interval is that of the difference.",
)
TRACKING_TEXT = (
    "Root mean square deviations from the reference, each signal in its own unit: of true states, or of outputs if the "
    "reference is one of outputs.",
)
TIME_TEXT = (
    "Median duration of a controller step (estimate, solve, monitor), averaged over the runs. Runs were computed in "
    "parallel: durations are comparable with each other, but longer than on an idle computer.",
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
        KeyFigure("Computing time", duration_text(spent), "", "sum over all processes"),
    ]
    if "controller" in results.factors:
        base = name_of(str(table["controller"].iloc[0]))
        for name, rows in results.paired().groupby("controller", sort=False):
            ratio = float(np.exp(np.log(rows["ratio"]).mean()))
            text = f"of the cost of {base}: geometric mean over pairs"
            figures.append(KeyFigure(f"Cost: {name_of(str(name))}", 100 * ratio, "%", text))
    return figures


def _describe_study(results: StudyResults) -> Section:
    study = results.note.study
    defaults: tuple[Any, ...] = (None, "", [], [None], ["own"], [[]], {})
    rows = [(key, _shorten(value)) for key, value in study.items() if value not in defaults]
    rows += [(f"model {k}: noise", m.noise.source) for k, m in results.note.models.items()]
    return Section("Configuration", (), (), [Table(("setting", "value"), rows)])


def _shorten(value: Any) -> str:
    if isinstance(value, list) and len(value) > 12:
        return f"{len(value)} values, {_shorten(value[0])} to {_shorten(value[-1])}"
    if isinstance(value, list):
        return ", ".join(_shorten(v) for v in value)
    if isinstance(value, dict):
        return "; ".join(f"{k}: {_shorten(v)}" for k, v in value.items() if v not in (None, 0.0, False))
    return str(value)


def _make_table(found: pd.DataFrame, caption: str) -> Table:
    rows = [tuple(_cell(v) for v in row) for row in found.itertuples(index=False)]
    return Table(tuple(found.columns), rows, caption)


def _cell(value: Any) -> Any:
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _find_compared_column(results: StudyResults) -> str | None:
    """The column whose levels are compared: the controller if it varies, else another varying column."""
    order = ("controller", "model", "solver", "horizon", "faults", "monitor")
    return next((c for c in order if c in results.factors), None)


def _comparison(results: StudyResults, folder: Path) -> list[Section]:
    over = _find_compared_column(results)
    if over is None:
        return []
    table = _make_table(results.paired(over=over), f"Cost of each {over} minus the cost of the first.")
    return [Section("Paired differences", PAIRED_TEXT, _figure(_differences, results, folder), [table])]


TRACKING = "tracking_rmse "
"""Begin of the names of columns with tracking errors; the signal's label follows."""


def _tracking(results: StudyResults, folder: Path) -> list[Section]:
    tables, figures = [], []
    for i, column in enumerate(c for c in results.figures if c.startswith(TRACKING)):
        label = f"RMSE of {column.removeprefix(TRACKING)}"
        found = results.summary(column)
        if not (found["n"] > 0).any():
            continue
        tables.append(
            _make_table(found[found["n"] > 0], f"{label}: mean, 95 % interval, number of excluded runs.")
        )
        values = {
            task: {str(k): g[column].to_numpy() for k, g in rows} for task, rows in _group_levels(results)
        }
        some = {task: row for task, row in values.items() if any(np.isfinite(v).any() for v in row.values())}
        figure = save(studies.distributions(some, label), folder / f"tracking_{i}.png")
        figures.append((figure, f"Distribution of the {label} over the runs of each task."))
    return [Section("Tracking", TRACKING_TEXT, figures, tables)] if tables else []


def _task_figures(results: StudyResults) -> list[Section]:
    tables = []
    for name in (c for c in results.figures if c.startswith("task_")):
        found = results.summary(name)
        found = found[found["n"] > 0]
        if len(found):
            tables.append(_make_table(found, f"{name.removeprefix('task_')}: mean."))
    return [Section("Figures of the tasks", (), (), tables)] if tables else []


def _failures(results: StudyResults) -> list[Section]:
    failed = results.failed
    if not len(failed):
        return []
    columns = ["model", "task", "controller", "draw", "seed"]
    rows = [
        (*(_cell(row[c]) for c in columns), row["error"].strip().splitlines()[-1])
        for _, row in failed.iterrows()
    ]
    text = f"{counted(len(failed), 'run')} failed; the first are listed. "
    text += "Column 'error' of the table contains the tracebacks."
    return [Section("Failed runs", (text,), (), [Table((*columns, "error"), rows[:SHOWN_FAILURES])])]


def _figure(draw: Any, results: StudyResults, folder: Path) -> Sequence[tuple[Path, str]]:
    try:
        figure, caption = draw(results)
    except InputError:  # no finite value: the table says so
        return ()
    return [(save(figure, folder / f"{draw.__name__.strip('_')}.png"), caption)]


def _group_levels(results: StudyResults) -> Any:
    """Groups of rows by task and, within a task, by all other varying columns, with a name for each group."""
    others = [c for c in results.factors if c != "task"]
    for task, group in results.table.groupby("task", sort=False):
        named = group[others].astype(str).agg(", ".join, axis=1) if others else group["controller"]
        yield str(task), group.groupby(named, sort=False)


def _distributions(results: StudyResults) -> tuple[Any, str]:
    values = {task: {str(k): g["cost"].to_numpy() for k, g in rows} for task, rows in _group_levels(results)}
    caption = "Distribution of the cost over the runs of each task."
    return studies.distributions(values, "cost [-]"), caption


def _differences(results: StudyResults) -> tuple[Any, str]:
    over = _find_compared_column(results)
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
    points = {
        task: {str(level): (float(g[STEP].mean()), float(g["cost"].mean())) for level, g in rows}
        for task, rows in _group_levels(results)
    }
    caption = "Mean cost against the duration of a step; the line is the Pareto front."
    return studies.pareto(points, "cost [-]"), caption


def duration_text(seconds: float) -> str:
    """A duration with a suitable unit.

    Example:
        >>> duration_text(42.0), duration_text(600.0), duration_text(7300.0), duration_text(4e5)
        ('42 s', '10 min', '2.0 h', '4.6 d')
    """
    for size, unit, digits in ((86400.0, "d", 1), (3600.0, "h", 1), (60.0, "min", 0)):
        if seconds >= 2 * size or (unit != "min" and seconds >= 1.5 * size):
            return f"{seconds / size:.{digits}f} {unit}"
    return f"{seconds:.0f} s"
