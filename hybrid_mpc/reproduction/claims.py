"""Claims of the paper and goals of this project, beside what was found. No torch in here.

A check is made by one of the static methods of :class:`Claim` and judges a
:class:`~hybrid_mpc.reproduction.table.Table`. It compares means over the networks that did not diverge; a model of
which all diverged is infinitely worse than any other. A model that is claimed to be better, and of which a network
diverged, is not better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from hybrid_mpc.reproduction.table import Cell, Table

At = Literal["every", "least", "most", "some"]


@dataclass(frozen=True)
class Verdict:
    """What was found of a claim.

    Args:
        holds: Whether it was reproduced; None if the results do not tell.
        found: The numbers.
    """

    holds: bool | None
    found: str


Check = Callable[[Table], Verdict]


@dataclass(frozen=True)
class Claim:
    """A claim and how it is judged.

    Args:
        name: Short and unique within an experiment.
        text: In words, with its numbers.
        source: Who says so, e.g. ``"paper, Fig. 3"``.
        check: Judges it; made by :meth:`below`, :meth:`above`, :meth:`level`, ... or by a function of one's own.

    Example:
        >>> from hybrid_mpc.reproduction.table import Network, Row
        >>> rows = [Row("exact", 3, m, (Network({"e_sim_s": e}),)) for m, e in (("rnn", 1.0), ("pgrnn", 0.5))]
        >>> claim = Claim("halved", "PGRNN 40 % below RNN", "paper", Claim.below("pgrnn", "rnn", 0.4, "exact"))
        >>> claim.line(Table(rows))
        'reproduced: PGRNN 40 % below RNN (paper). Found: pgrnn to rnn −50 % (with 3 sequences).'
    """

    name: str
    text: str
    source: str
    check: Check

    def line(self, table: Table) -> str:
        """One line: verdict, claim, numbers."""
        return said(self.text, self.source, self.check(table))

    @staticmethod
    def below(
        model: str, reference: str, share: float, data_set: str, *, at: At = "every", metric: str = "e_sim_s"
    ) -> Check:
        """``model`` lies at least ``share`` below ``reference``; a negative share allows it to lie above.

        Args:
            model: Which is better.
            reference: Than which.
            share: Of the reference's figure.
            data_set: Where.
            at: With every amount of data, the least, the most, or any of them (``"some"``).
            metric: Figure. Default E_sim.
        """

        def check(table: Table) -> Verdict:
            changes, note = _changes(table, data_set, model, reference, metric, at)
            if not changes:
                return Verdict(None, note)
            fine = [change <= -share for change in changes.values()]
            clean = not any(_cell(table, data_set, n, model, metric).diverged for n in changes)
            return Verdict(
                (any(fine) if at == "some" else all(fine)) and clean, _told(model, reference, changes, note)
            )

        return check

    @staticmethod
    def above(model: str, reference: str, share: float, data_set: str, *, at: At = "every") -> Check:
        """``model`` lies at least ``share`` above ``reference`` in E_sim; one that diverged does too."""

        def check(table: Table) -> Verdict:
            changes, note = _changes(table, data_set, model, reference, "e_sim_s", at)
            if not changes:
                return Verdict(None, note)
            return Verdict(all(c >= share for c in changes.values()), _told(model, reference, changes, note))

        return check

    @staticmethod
    def level(model: str, reference: str, share: float, data_set: str, *, at: At = "every") -> Check:
        """``model`` and ``reference`` differ by at most ``share`` of the reference's E_sim."""

        def check(table: Table) -> Verdict:
            changes, note = _changes(table, data_set, model, reference, "e_sim_s", at)
            if not changes:
                return Verdict(None, note)
            return Verdict(
                all(abs(c) <= share for c in changes.values()), _told(model, reference, changes, note)
            )

        return check

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


def said(text: str, source: str, verdict: Verdict) -> str:
    """A claim with its verdict as one line."""
    word = {True: "reproduced", False: "not reproduced", None: "not tested"}[verdict.holds]
    return f"{word}: {text} ({source}). Found: {verdict.found}."


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


def _told(model: str, reference: str, changes: dict[int, float], note: str) -> str:
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
