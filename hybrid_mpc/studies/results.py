"""Results of a study: a table with one row a run, means with intervals, paired differences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_mpc.errors import InputError
from hybrid_mpc.job.table import interval
from hybrid_mpc.records import known
from hybrid_mpc.studies.log import rows
from hybrid_mpc.studies.note import StudyNote, note_of, read_note
from hybrid_mpc.studies.table import RESULTS, intact, provenance_of

if TYPE_CHECKING:
    import pandas as pd

FACTORS = ("model", "task", "controller", "solver", "horizon", "monitor", "faults")
PAIR = ("draw", "seed")


@dataclass(frozen=True, eq=False)
class StudyResults:
    """A study's runs.

    Args:
        table: One row a run: ``id``, the configuration, ``status``, ``error``, results, ``timing_...``.
        note: What the study is made of: configuration, digests of the models, versions.
        folder: Where it lies.

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
        """Results of a study's folder; of one that has not ended, what there is.

        Raises:
            InputError: If it is no folder of a study, or damaged.
        """
        import pandas as pd
        import pyarrow.parquet as pq

        folder = Path(folder)
        note = read_note(folder)
        if intact(folder / RESULTS):
            table = pq.read_table(folder / RESULTS).to_pandas()
            note = note_of(provenance_of(folder / RESULTS), str(folder / RESULTS))
        else:  # not written yet, or damaged: the log has every row
            table = pd.DataFrame({row["id"]: row for row in rows(folder / "runs")}.values())
        if "run" in table:  # they are kept in the order in which they ended
            table = table.sort_values("run", ignore_index=True)
        return cls(table, note, folder)

    @property
    def failed(self) -> pd.DataFrame:
        """Runs that raised, or whose workers died: with the traceback in ``error``."""
        return self.table[self.table["status"] == "failed"] if len(self.table) else self.table

    @property
    def missing(self) -> int:
        """Runs that have not run yet."""
        return max(0, self.note.runs - len(self.table))

    @property
    def factors(self) -> list[str]:
        """Columns of the configuration that differ between runs, without draw and seed."""
        return [c for c in FACTORS if c in self.table and self.table[c].nunique(dropna=False) > 1]

    @property
    def figures(self) -> list[str]:
        """Columns that are results and numbers."""
        known_ones = {*FACTORS, *PAIR, "id", "run", "hidden_units"}
        names = self.table.select_dtypes("number").columns
        return [c for c in names if c not in known_ones and not c.startswith("factor_")]

    def summary(self, value: str = "cost", by: Sequence[str] | None = None) -> pd.DataFrame:
        """Mean of a figure with its 95 % interval (Student's t).

        A unit of the statistics is a draw where there are several (its seeds are averaged first: they share the
        machine), else a seed.

        Args:
            value: Column of a figure.
            by: Columns to group by. Default: what differs between the runs.

        Returns:
            ``by``, ``n`` units, ``mean``, ``low``, ``high`` (NaN for one unit), and ``left_out``: runs that failed or
            whose figure is not finite.

        Raises:
            InputError: If there is no such column.
        """
        import pandas as pd

        table, by = self._checked(value), self.factors if by is None else list(by)
        found = []
        for key, group in _groups(table, by):
            units = self._units(group, value, [])
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
        """Differences to a base on common draws and seeds, with their 95 % intervals.

        Args:
            value: Column of a figure.
            over: Column whose levels are compared.
            base: Level that the others are compared with. Default: the first.
            by: Columns to group by. Default: what else differs between the runs.

        Returns:
            ``by``, ``over``, ``n`` pairs (of draws, where there are several), ``base`` (its mean), ``difference``,
            ``low``, ``high``, ``relative`` (difference over the base's mean), ``ratio`` (geometric mean of the pairs'
            ratios; NaN where a value is not positive) and ``better`` (share of pairs with a negative difference).

        Raises:
            InputError: If there is no such column or level.
        """
        import pandas as pd

        table = self._checked(value)
        known(over, table.columns, "column")
        levels = list(dict.fromkeys(table[over].tolist()))
        base = levels[0] if base is None else base
        if base not in levels:
            raise InputError(f"no {over} {base!r} in this study; there are: {', '.join(map(str, levels))}")
        by = [c for c in self.factors if c != over] if by is None else list(by)
        found = []
        for key, group in _groups(table, by):
            first = self._units(group[group[over] == base], value, [])
            for level in levels:
                if level != base:
                    second = self._units(group[group[over] == level], value, [])
                    found.append((*key, level, *_difference(first, second, value)))
        return pd.DataFrame(found, columns=[*by, over, *DIFFERENCE])

    def compare(self, other: StudyResults, value: str = "cost") -> pd.DataFrame:
        """Differences of another study to this one, run by run of the same configuration.

        What is one and the same within each study but not between them (the model's label, say) is what is compared;
        all else must agree for two runs to make a pair.

        Args:
            other: The other study.
            value: Column of a figure.

        Returns:
            As :meth:`paired`, of ``other`` against this one; attribute ``attrs["differs"]`` says in what they differ.

        Raises:
            InputError: If the studies have no run in common.
        """
        import pandas as pd

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
                f"{self.folder} and {other.folder} have no run in common: their tasks, controllers, draws or seeds "
                "differ"
            )
        found = []
        for key, group in _groups(joined, by):
            first = self._units(group, value, [])
            second = self._units(group.assign(**{value: group[value + " "]}), value, [])
            found.append((*key, *_difference(first, second, value)))
        result = pd.DataFrame(found, columns=[*by, *DIFFERENCE])
        result.attrs["differs"] = {c: (str(mine[c].iloc[0]), str(theirs[c].iloc[0])) for c in differs}
        return result

    def _checked(self, value: str) -> pd.DataFrame:
        known(value, self.figures, "figure")
        return self.table

    def _units(self, group: pd.DataFrame, value: str, by: list[str]) -> pd.DataFrame:
        """One row a unit: a draw where there are several, else a draw and seed."""
        finite = group[np.isfinite(group[value])]
        keys = [c for c in PAIR if c in finite]
        if "draw" in self.table and self.table["draw"].nunique() > 1:
            keys = ["draw"]
        return finite.groupby([*by, *keys], as_index=False, sort=True)[value].mean()


DIFFERENCE = ("n", "base", "difference", "low", "high", "relative", "ratio", "better")


def _groups(table: pd.DataFrame, by: Sequence[str]) -> Any:
    """Groups in the order in which they come, with their keys; one group for no columns."""
    if not by:
        return [((), table)]
    return table.groupby(list(by), sort=False, dropna=False)


def _interval(values: Any) -> tuple[float, float]:
    """Mean and half width of its 95 % interval; NaN where there is none."""
    found = interval(np.asarray(values, dtype=float).tolist())
    return (
        math.nan if found.mean is None else found.mean,
        math.nan if found.ci95 is None else found.ci95,
    )


def _difference(first: pd.DataFrame, second: pd.DataFrame, value: str) -> tuple[float, ...]:
    """Of units that both have: number, mean of the first, difference with interval, relative, ratio, better."""
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
