"""Figures of all networks of a reproduction: means, standard deviations, and how many diverged. No torch in here."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn", "hybrid", "sindy")
"""Rows in their order. ``hybrid`` is the MOPGRNN trained on free runs too."""
METRICS: Mapping[str, str] = {
    "e_sim_s": "E_sim [s]",
    "e_sim_lambda1_s": "E_sim, λ = 1 [s]",
    "e_sim_literal_s": "E_sim, literal [s]",
    "rmse_rad": "RMSE [rad]",
    "energy_violation_w": "violation [W]",
}
"""Figures on test free runs, with units."""


@dataclass(frozen=True)
class Divergence:
    """Where a network's free run left all bounds.

    Args:
        run: Name of the first test run in which it did.
        step: Sample of that run, counted from the end of the warm-up.
        time_s: The same [s].
        runs: Number of test runs in which it did.
    """

    run: str
    step: int
    time_s: float
    runs: int


@dataclass(frozen=True)
class Network:
    """One network on the test runs.

    Args:
        figures: Figures by name (``METRICS``); empty if it diverged.
        validation: Its best validation error, or None (infinite, or there was none).
        converged_step: Optimiser steps until its validation error was within 10 % of its best. Default: none.
        diverged: Where it diverged. Default: nowhere.
    """

    figures: Mapping[str, float]
    validation: float | None = None
    converged_step: int | None = None
    diverged: Divergence | None = None


@dataclass(frozen=True)
class Row:
    """All networks of one model, trained on one amount of data.

    Args:
        data_set: Name of the data set.
        sequences: Number of training runs.
        model: One of ``MODELS``.
        networks: Its networks.
    """

    data_set: str
    sequences: int
    model: str
    networks: tuple[Network, ...]

    def plain(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)

    @staticmethod
    def of(value: Mapping[str, Any]) -> Row:
        """From what :meth:`plain` gave.

        Example:
            >>> row = Row("exact", 3, "rnn", (Network({}, diverged=Divergence("test_01", 7, 0.07, 1)),))
            >>> Row.of(row.plain()) == row
            True
        """
        networks = tuple(
            Network(
                dict(n["figures"]),
                n["validation"],
                n["converged_step"],
                None if n["diverged"] is None else Divergence(**n["diverged"]),
            )
            for n in value["networks"]
        )
        return Row(value["data_set"], value["sequences"], value["model"], networks)


@dataclass(frozen=True)
class Cell:
    """One figure over the networks of a row.

    Args:
        mean: Mean over the networks that did not diverge; None if all did.
        std: Standard deviation over these (n - 1); None if there are fewer than two.
        median: Median over all networks, a diverged one counting as infinite; None if infinite.
        networks: Number of networks, diverged ones included.
        diverged: Number of diverged ones.
    """

    mean: float | None
    std: float | None
    median: float | None
    networks: int
    diverged: int


class Table:
    """Rows with their statistics.

    Args:
        rows: In any order.

    Example:
        >>> good, bad = Network({"e_sim_s": 2.0}), Network({}, diverged=Divergence("test_01", 7, 0.07, 1))
        >>> table = Table([Row("exact", 3, "rnn", (good, good, bad))])
        >>> table.cell("exact", 3, "rnn")
        Cell(mean=2.0, std=0.0, median=2.0, networks=3, diverged=1)
        >>> print(table.cell("exact", 6, "rnn"))
        None
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        self._rows = {(row.data_set, row.sequences, row.model): row for row in rows}

    @property
    def data_sets(self) -> list[str]:
        """Data sets in order of appearance."""
        return list(dict.fromkeys(key[0] for key in self._rows))

    @property
    def sequences(self) -> list[int]:
        """Amounts of training data, rising."""
        return sorted({key[1] for key in self._rows})

    @property
    def models(self) -> list[str]:
        """Models that have a row, in the order of ``MODELS``."""
        there = {key[2] for key in self._rows}
        return [model for model in MODELS if model in there]

    def cell(self, data_set: str, sequences: int, model: str, metric: str = "e_sim_s") -> Cell | None:
        """One figure of one row, or None if there is no such row or it has no such figure.

        Args:
            data_set: Name of the data set.
            sequences: Number of training runs.
            model: One of ``MODELS``.
            metric: One of ``METRICS``, or ``"converged_step"``.
        """
        row = self._rows.get((data_set, sequences, model))
        if row is None:
            return None
        kept = [n for n in row.networks if n.diverged is None]
        if metric == "converged_step":
            found = [None if n.converged_step is None else float(n.converged_step) for n in kept]
        else:
            found = [n.figures.get(metric) for n in kept]
        values = [v for v in found if v is not None]
        if len(values) < len(kept):
            return None
        n, diverged = len(row.networks), len(row.networks) - len(kept)
        median = float(np.median([*values, *[math.inf] * diverged]))
        return Cell(
            float(np.mean(values)) if values else None,
            float(np.std(values, ddof=1)) if len(values) > 1 else None,
            median if math.isfinite(median) else None,
            n,
            diverged,
        )

    def summary(self) -> list[dict[str, Any]]:
        """A flat line a row: mean, standard deviation and median of every figure."""
        lines = []
        for data_set, sequences, model in sorted(self._rows, key=self._order):
            line: dict[str, Any] = {"data_set": data_set, "sequences": sequences, "model": model}
            for metric in METRICS:
                cell = self.cell(data_set, sequences, model, metric)
                assert cell is not None
                line |= {"networks": cell.networks, "diverged": cell.diverged}
                line |= {f"{metric}_{name}": getattr(cell, name) for name in ("mean", "std", "median")}
            lines.append(line)
        return lines

    def csv(self) -> str:
        """:meth:`summary` as CSV text; what is not known is empty."""
        lines, text = self.summary(), io.StringIO()
        writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
        return text.getvalue()

    def _order(self, key: tuple[str, int, str]) -> tuple[int, int, int]:
        return self.data_sets.index(key[0]), key[1], MODELS.index(key[2])
