"""The table "What this kit promises": properties of its loops, which a run examines and writes beside the models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import is_file, read_document, write_document
from hybrid_mpc.records import Fields, plain, record
from hybrid_mpc.rules import Line, Text

PROMISES = "promises.json"
"""File of the promises in a model's folder; only stage ``promises`` of a run writes it."""
SCHEMA_VERSION = 1
Verdict: TypeAlias = Literal["shown", "doubted", "not promised"]
NONE_MADE = "promises"
"""Name of the only row of a kit without a valid table."""
REMEDY = "Run the scenario on this folder again: hybrid-mpc run SCENARIO --out FOLDER --resume."


@dataclass(frozen=True)
class Promise:
    """One row of the table "What this kit promises".

    Args:
        name: Name of the property, e.g. ``"no offset"``.
        verdict: ``"shown"``: the run has shown the property; ``"doubted"``: the run has found a reason why it may fail;
            ``"not promised"``: it does not hold, or the run could not examine it.
        evidence: Numbers with their units, or the reason.
        remedy: What to do. Default: empty, nothing.

    Raises:
        InputError: If a field is of another kind.

    Example:
        >>> print(Promise("step time", "shown", "99 % of the steps take 2.1 ms, the period is 20 ms"))
        step time: shown. 99 % of the steps take 2.1 ms, the period is 20 ms.
    """

    name: Line
    verdict: Verdict
    evidence: Text
    remedy: Text = ""

    def __post_init__(self) -> None:
        Fields(self, f"promise {self.name!r}").refuse()

    def __str__(self) -> str:
        return f"{self.name}: {self.verdict}. {self.evidence}." + f" {self.remedy}" * bool(self.remedy)


@dataclass(frozen=True)
class PromiseTable:
    """The table "What this kit promises", content of ``promises.json``.

    Args:
        rows: The promises, in the order of the table.
        of: Digest of the models and loop settings that the table belongs to.
    """

    rows: tuple[Promise, ...]
    of: Line


def write_promises(folder: Path, table: PromiseTable) -> None:
    """Write the table beside the models in ``folder``.

    Raises:
        StorageError: If it cannot be written.
    """
    write_document(folder / PROMISES, {"schema_version": SCHEMA_VERSION, **plain(table)})


def read_promises(folder: Path) -> PromiseTable | None:
    """Read the table of a model's folder; None without a table.

    Raises:
        InputError: If the file is damaged, was changed by hand, or has another schema version.
    """
    path = folder / PROMISES
    if not is_file(path):
        return None
    document = read_document(path, f"delete it; {REMEDY[0].lower()}{REMEDY[1:]}")
    if document.pop("schema_version", None) != SCHEMA_VERSION:
        raise InputError(
            f"{path}: field schema_version is not {SCHEMA_VERSION}, the only version that this hybrid-mpc reads. "
            f"{REMEDY} [HM-KIT-039]"
        )
    return record(PromiseTable, document, str(path))


def promise_lines(rows: Sequence[Promise]) -> list[str]:
    r"""The table for a terminal: one line for each row, those with verdict shown last.

    Example:
        >>> late = Promise("step time", "doubted", "99 % of the steps take 9 ms, the period is 10 ms", "Solver native.")
        >>> print(*promise_lines([Promise("horizon", "shown", "it holds 99 % of the cost"), late]), sep="\n")
        what this kit promises:
          doubted       step time: 99 % of the steps take 9 ms, the period is 10 ms. Solver native.
          shown         horizon: it holds 99 % of the cost.
    """
    order: tuple[Verdict, ...] = ("not promised", "doubted", "shown")
    lines = [
        f"  {one.verdict:12}  {one.name}: {one.evidence}." + f" {one.remedy}" * bool(one.remedy)
        for one in sorted(rows, key=lambda one: order.index(one.verdict))
    ]
    return ["what this kit promises:", *lines] if lines else []


def none_made(why: str) -> tuple[Promise, ...]:
    """The only row of a kit without a valid table: nothing is promised, and the reason."""
    return (Promise(NONE_MADE, "not promised", why, REMEDY),)
