"""Figures of all networks of a reproduction, and the claims that they are held against. No torch in here.

A check is made by one of the static methods of :class:`Claim` and looks at a
:class:`~scenarios.paper.table.Table`. It compares means over the networks that did not diverge; a model of
which all diverged is infinitely worse than any other. A model that is claimed to be better, and of which a network
diverged, is not better.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn", "hybrid", "sindy")
"""Rows in their order. ``hybrid`` is the MOPGRNN trained on free runs too."""
METRICS: Mapping[str, str] = {
    "e_sim_s": "E_sim [s]",
    "e_sim_lambda1_s": "E_sim, λ = 1 [s]",
    "e_sim_paper_s": "E_sim, paper form [s]",
    "rmse_rad": "RMSE [rad]",
    "energy_violation_w": "violation [W]",
}
"""Figures on test free runs, with units."""


@dataclass(frozen=True)
class Divergence:
    """Where a network's free run left all bounds, and in how many test ``runs``.

    ``run`` is the first of them; ``step`` and ``time_s`` [s] count from the end of the warm-up.
    """

    run: str
    step: int
    time_s: float
    runs: int


@dataclass(frozen=True)
class Network:
    """One network on the test runs: figures by name (``METRICS``), none if it diverged.

    ``validation`` is its best validation error, None if infinite or unknown; ``converged_step`` the optimiser steps
    until that error was within 10 % of its best.
    """

    figures: Mapping[str, float]
    validation: float | None = None
    converged_step: int | None = None
    diverged: Divergence | None = None


@dataclass(frozen=True)
class Row:
    """All networks of one model, trained on ``sequences`` runs of a data set."""

    data_set: str
    sequences: int
    model: str
    networks: tuple[Network, ...]


@dataclass(frozen=True)
class Cell:
    """One figure over the networks of a row; the mean and its deviation (n - 1) are over those that did not diverge.

    In the median a diverged one counts as infinite. What is infinite, or needs more networks, is None.
    """

    mean: float | None
    std: float | None
    median: float | None
    networks: int
    diverged: int


class Table:
    """Rows with their statistics."""

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
        """One figure of one row, or None if there is no such row or it has no such figure."""
        row = self._rows.get((data_set, sequences, model))
        if row is None:
            return None
        converging = [n for n in row.networks if n.diverged is None]
        if metric == "converged_step":
            found = [None if n.converged_step is None else float(n.converged_step) for n in converging]
        else:
            found = [n.figures.get(metric) for n in converging]
        values = [v for v in found if v is not None]
        if len(values) < len(converging):
            return None
        n, diverged = len(row.networks), len(row.networks) - len(converging)
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


At = Literal["every", "least", "most", "some"]


@dataclass(frozen=True)
class Verdict:
    """What was found of a claim; ``holds`` is None if the results do not tell."""

    holds: bool | None
    found: str


Check = Callable[[Table], Verdict]


@dataclass(frozen=True)
class Claim:
    """A claim, where it stands (``"paper, Fig. 3"``), and how it is checked.

    Checks are made by :meth:`below`, :meth:`above`, :meth:`level`, ... or by a function of one's own.
    """

    name: str
    text: str
    source: str
    check: Check

    @staticmethod
    def below(
        model: str, reference: str, share: float, data_set: str, *, at: At = "every", metric: str = "e_sim_s"
    ) -> Check:
        """``model`` lies at least ``share`` below ``reference``; a negative share allows it to lie above.

        That holds with every amount of data, the least, the most, or any of them (``at="some"``).
        """
        return _compared(model, reference, data_set, at, metric, lambda change: change <= -share, better=True)

    @staticmethod
    def above(model: str, reference: str, share: float, data_set: str) -> Check:
        """``model`` lies at least ``share`` above ``reference`` in E_sim; one that diverged does too."""
        return _compared(model, reference, data_set, "every", "e_sim_s", lambda change: change >= share)

    @staticmethod
    def level(model: str, reference: str, share: float, data_set: str, *, at: At = "every") -> Check:
        """``model`` and ``reference`` differ by at most ``share`` of the reference's E_sim."""
        return _compared(model, reference, data_set, at, "e_sim_s", lambda change: abs(change) <= share)

    @staticmethod
    def steady(model: str, share: float, data_set: str) -> Check:
        """``model`` is with least data at most ``share`` worse than with most."""

        def check(table: Table) -> Verdict:
            least, most = table.sequences[0], table.sequences[-1]
            cells = [table.cell(data_set, n, model) for n in (least, most)]
            if least == most or any(c is None or c.mean is None for c in cells):
                return Verdict(None, f"{model} is not there with two amounts of data")
            few, many = (c.mean for c in cells if c is not None and c.mean is not None)
            found = f"{model} {few:.4g} s with {least}, {many:.4g} s with {most} sequences ({_percent(few / many - 1)})"
            clean = not any(c.diverged for c in cells if c is not None)
            return Verdict(few / many - 1 <= share and clean, found + _diverged(table, data_set, model))

        return check

    @staticmethod
    def narrower(model: str, others: Sequence[str], data_set: str) -> Check:
        """The standard deviation of ``model``'s E_sim is below that of all ``others`` with every amount of data."""

        def check(table: Table) -> Verdict:
            found, fine = [], []
            for n in table.sequences:
                spread = [_std(table, data_set, n, name) for name in (model, *others)]
                own, rest = spread[0], [s for s in spread[1:] if s is not None]
                if own is None or len(rest) < len(others):
                    return Verdict(None, "fewer than two networks that did not diverge")
                fine.append(own < min(rest))
                found.append(f"{own:.2g} to {', '.join(f'{s:.2g}' for s in rest)} ({n})")
            names = f"{model} to {', '.join(others)}, by sequences"
            text = f"standard deviations [s] of {names}: {'; '.join(found)}"
            clean = not any(_cell(table, data_set, n, model, "e_sim_s").diverged for n in table.sequences)
            return Verdict(all(fine) and clean, text + _diverged(table, data_set, model, *others))

        return check

    @staticmethod
    def sooner(model: str, other: str, data_set: str) -> Check:
        """``model`` comes within 10 % of its best validation error after fewer steps than ``other``, on average."""

        def check(table: Table) -> Verdict:
            means = []
            for name in (model, other):
                cells = [table.cell(data_set, n, name, "converged_step") for n in table.sequences]
                known = [c.mean for c in cells if c is not None and c.mean is not None]
                if len(known) < len(cells):
                    return Verdict(None, f"steps of {name} are not known")
                means.append(sum(known) / len(known))
            return Verdict(
                means[0] < means[1], f"{model} {means[0]:.0f}, {other} {means[1]:.0f} steps on average"
            )

        return check

    @staticmethod
    def ordered(models: Sequence[str], data_set: str) -> Check:
        """E_sim falls along ``models``, and so does its standard deviation, with most data."""

        def check(table: Table) -> Verdict:
            n = table.sequences[-1]
            means = [c.mean if (c := table.cell(data_set, n, m)) is not None else None for m in models]
            spread = [_std(table, data_set, n, m) for m in models]
            a, b = [v for v in means if v is not None], [v for v in spread if v is not None]
            if len(a) < len(models) or len(b) < len(models):
                return Verdict(
                    None, "a model is missing, or has fewer than two networks that did not diverge"
                )
            cells = ", ".join(f"{m} {x:.3g} ± {y:.2g} s" for m, x, y in zip(models, a, b, strict=True))
            clean = not any(_cell(table, data_set, n, m, "e_sim_s").diverged for m in models)
            holds = clean and a == sorted(a, reverse=True) and b == sorted(b, reverse=True)
            return Verdict(holds, f"{cells} with {n} sequences" + _diverged(table, data_set, *models))

        return check


def verdict_line(text: str, source: str, verdict: Verdict) -> str:
    """A claim with its verdict as one line."""
    word = {True: "reproduced", False: "not reproduced", None: "not tested"}[verdict.holds]
    return f"{word}: {text} ({source}). Found: {verdict.found}."


def _compared(
    model: str,
    reference: str,
    data_set: str,
    at: At,
    metric: str,
    fine: Callable[[float], bool],
    *,
    better: bool = False,
) -> Check:
    """Whether the relative changes from reference to model are fine; no diverged network if it is to be better."""

    def check(table: Table) -> Verdict:
        changes, note = _changes(table, data_set, model, reference, metric, at)
        if not changes:
            return Verdict(None, note)
        found = [fine(change) for change in changes.values()]
        holds = any(found) if at == "some" else all(found)
        if better and any(_cell(table, data_set, n, model, metric).diverged for n in changes):
            holds = False
        return Verdict(holds, _numbers(model, reference, changes, note))

    return check


def _changes(
    table: Table, data_set: str, model: str, reference: str, metric: str, at: At
) -> tuple[dict[int, float], str]:
    """Relative changes from reference to model by amount of data, and a note; none if a figure is missing."""
    counts = table.sequences
    changes = {}
    for n in {"least": counts[:1], "most": counts[-1:]}.get(at, counts):
        a, b = (table.cell(data_set, n, name, metric) for name in (model, reference))
        if a is None or b is None:
            return {}, f"there is no {model if a is None else reference} with {n} sequences"
        if a.mean is None and b.mean is None:
            return {}, f"all networks of {model} and of {reference} diverged with {n} sequences"
        if a.mean is None or b.mean is None:  # all networks diverged: infinitely worse than any that did not
            changes[n] = math.inf if a.mean is None else -1.0
        else:
            changes[n] = a.mean / b.mean - 1.0
    return changes, _diverged(table, data_set, model, reference)


def _numbers(model: str, reference: str, changes: dict[int, float], note: str) -> str:
    numbers = ", ".join(_percent(c) for c in changes.values())
    counts = ", ".join(map(str, changes))
    return f"{model} to {reference} {numbers} (with {counts} sequences)" + note


def _diverged(table: Table, data_set: str, *models: str) -> str:
    """How many networks diverged, for the end of a line; nothing if none did."""
    parts = []
    for model in models:
        cells = [c for n in table.sequences if (c := table.cell(data_set, n, model)) is not None]
        if count := sum(c.diverged for c in cells):
            parts.append(f"{count} of {sum(c.networks for c in cells)} networks of {model} diverged")
    return f"; {' and '.join(parts)}" if parts else ""


def _percent(change: float) -> str:
    return f"{100 * change:+.0f} %".replace("inf", "∞").replace("-", "−")


def _std(table: Table, data_set: str, n: int, model: str) -> float | None:
    cell = table.cell(data_set, n, model)
    return None if cell is None else cell.std


def _cell(table: Table, data_set: str, n: int, model: str, metric: str) -> Cell:
    cell = table.cell(data_set, n, model, metric)
    assert cell is not None
    return cell
