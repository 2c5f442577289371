"""The page of a report: one self-contained HTML file of key figures, text, tables and embedded figures."""

from __future__ import annotations

import base64
import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from PIL import Image, UnidentifiedImageError

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_text
from hybrid_mpc.plots.style import number
from hybrid_mpc.rules import csv_cell

Cell = str | float | int | bool | None
Verdict = Literal["good", "bad", "plain"]


@dataclass(frozen=True)
class KeyFigure:
    """A number (or a word) at the head of the report; None shows a dash, ``comment`` says why."""

    label: str
    value: Cell
    unit: str = ""
    comment: str = ""
    verdict: Verdict = "plain"


@dataclass(frozen=True)
class Answer:
    """A question at the head of the report, its answer in a few words, and the figures behind it, a line each."""

    question: str
    verdict: Verdict
    short: str
    lines: Sequence[str] = ()


@dataclass(frozen=True)
class Hint:
    """What to do next: a verdict (``"bad"`` needs the reader), what was found, and a remedy, which may be empty."""

    verdict: Verdict
    finding: str
    remedy: str


@dataclass(frozen=True)
class Table:
    """A table: heads with units, cells (numbers get three significant digits, None a dash), a sentence about it."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise InputError(
                    f"table {self.caption!r}: row {i} has {len(row)} cells, "
                    f"its {len(self.columns)} columns need one each [HM-REPORT-001]"
                )

    def filled(self) -> Table:
        """The table without columns that have nothing but dashes.

        Example:
            >>> Table(("task", "rise [s]", "offset"), (("step", None, 0.1), ("hold", "–", None))).filled().columns
            ('task', 'offset')
        """
        kept = [i for i in range(len(self.columns)) if any(row[i] not in (None, "–") for row in self.rows)]
        rows = [tuple(row[i] for i in kept) for row in self.rows]
        return Table(tuple(self.columns[i] for i in kept), rows, self.caption)

    def csv(self) -> str:
        r"""The table as CSV: a header, numbers with all their digits, nothing for None.

        Example:
            >>> Table(("model", "x [rad]"), (("prior", 0.1), ("a, b", None))).csv()
            'model,x [rad]\nprior,0.1\n"a, b",\n'
        """
        text = io.StringIO()
        rows = [[csv_cell(c) if isinstance(c, str) else c for c in row] for row in (self.columns, *self.rows)]
        csv.writer(text, lineterminator="\n").writerows(rows)
        return text.getvalue()


@dataclass(frozen=True)
class Section:
    """A section: text, tables, figures with captions, and notes after them.

    A figure with a file ``NAME.json`` beside it (:func:`~hybrid_mpc.plots.interactive.write_interactive`) can be looked
    at more closely in the browser.

    Of the text a plain ``str`` is escaped; ``markupsafe.Markup`` is taken as HTML.
    """

    title: str
    paragraphs: Sequence[str] = ()
    figures: Sequence[tuple[str | Path, str]] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()

    @property
    def anchor(self) -> str:
        """Name of the section within the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


@dataclass(frozen=True)
class Report:
    """A page: titles, a paragraph about the machine, the command that made it, key figures, hints, sections.

    ``remark`` is a line under the title: seed, budget, versions. ``doubt`` stands above it: what a reader must know
    before anything else on the page; empty: nothing. ``answers`` come first, before the machine.
    """

    title: str
    scenario: str
    description: str
    command: str
    summary: Sequence[KeyFigure] = ()
    sections: Sequence[Section] = ()
    remark: str = ""
    hints: Sequence[Hint] = ()
    doubt: str = ""
    answers: Sequence[Answer] = ()


def write_report(path: str | Path, report: Report) -> Path:
    """Write a report as one self-contained HTML file, all of it or nothing; the path.

    Raises:
        InputError: If a figure is missing or is no PNG or GIF, or the page cannot be written.
    """
    path = Path(path)
    write_text(path, render(report))
    return path


def render(report: Report) -> str:
    """The report as HTML text.

    Example:
        >>> "<title>Report &amp; more</title>" in render(Report("Report & more", "", "", ""))
        True
    """
    figures = [[_figure(s, *f) for f in s.figures] for s in report.sections]
    sections = [
        {"section": s, "id": f"s{i}-{s.anchor}", "figures": own}
        for i, (s, own) in enumerate(zip(report.sections, figures, strict=True), 1)
    ]
    live = any(figure["live"] for own in figures for figure in own)
    return _template("report.html").render(
        report=report, sections=sections, library=_library() if live else ""
    )


def _library() -> Markup:
    """What draws interactive figures in a browser, as text: the page needs no network."""
    from bokeh.resources import Resources

    return Markup("\n".join(Resources(mode="inline", components=["bokeh"]).js_raw))


def words(file: str) -> dict[str, tuple[Markup, ...]]:
    """General texts of the sections of a page, from a template with a block for each section.

    Example:
        >>> len(words("run_words.html")["training"])
        2
    """
    template, texts = _template(file), {}
    for name, block in template.blocks.items():  # type: ignore[attr-defined]
        paragraphs = "".join(block(template.new_context())).split("\n\n")
        texts[name] = tuple(Markup(" ".join(paragraph.split())) for paragraph in paragraphs)
    return texts


def _template(file: str) -> Template:
    environment = Environment(
        loader=PackageLoader("hybrid_mpc.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"cell": cell, "is_number": is_number}
    return environment.get_template(file)


def cell(value: Cell) -> str:
    """A table's cell as text.

    Example:
        >>> cell(None), cell(True), cell(3), cell(0.0255), cell("RNN")
        ('–', 'yes', '3', '0.0255', 'RNN')
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    # a per cent sign stays with its number
    return number(value) if isinstance(value, float) else str(value).replace(" %", "\u00a0%")


def is_number(value: Cell) -> bool:
    """True for a cell that is set to the right."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _figure(section: Section, path: str | Path, caption: str) -> dict[str, Any]:
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"report, section {section.title!r}: no figure {path}; draw it first, or leave it out [HM-REPORT-002]"
        )
    try:
        with Image.open(path, formats=("PNG", "GIF")) as image:
            kind, (width, height) = str(image.format).lower(), image.size
    except UnidentifiedImageError:
        raise InputError(
            f"report, section {section.title!r}: figure {path} is not a PNG or GIF file; give one [HM-REPORT-003]"
        ) from None
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    live = path.with_suffix(".json")
    return {
        "uri": f"data:image/{kind};base64,{data}",
        "caption": caption,
        "width": width,
        "height": height,
        # nothing in the text ends the script that holds it
        "live": Markup(live.read_text("utf-8").replace("<", "\\u003c")) if live.is_file() else "",
    }
