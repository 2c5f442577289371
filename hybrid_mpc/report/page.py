"""The page of a report: one self-contained HTML file with key figures, text, tables and embedded figures."""

from __future__ import annotations

import base64
import csv
import io
import re
from collections.abc import Collection, Sequence
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
    """A number or word at the top of the report; None is shown as a dash, and ``comment`` gives the reason."""

    label: str
    value: Cell
    unit: str = ""
    comment: str = ""
    verdict: Verdict = "plain"


@dataclass(frozen=True)
class Answer:
    """A question at the top of the report: verdict, answer in a few words, and one line for each supporting figure."""

    question: str
    verdict: Verdict
    short: str
    lines: Sequence[str] = ()


@dataclass(frozen=True)
class Hint:
    """An entry of "What to do next": verdict (``"bad"``: the reader must act), finding, and remedy or ``""``."""

    verdict: Verdict
    finding: str
    remedy: str


@dataclass(frozen=True)
class Table:
    """A table: column heads with units, cells, and a caption. Numbers have three significant digits; None is a dash."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise InputError(
                    f"table {self.caption!r}: row {i} has {len(row)} cells; "
                    f"the {len(self.columns)} columns need one cell each [HM-REPORT-001]"
                )

    def filled(self) -> Table:
        """Return the table without the columns that hold only dashes.

        Example:
            >>> Table(("task", "rise [s]", "offset"), (("step", None, 0.1), ("hold", "–", None))).filled().columns
            ('task', 'offset')
        """
        kept = [i for i in range(len(self.columns)) if any(row[i] not in (None, "–") for row in self.rows)]
        rows = [tuple(row[i] for i in kept) for row in self.rows]
        return Table(tuple(self.columns[i] for i in kept), rows, self.caption)

    def csv(self) -> str:
        r"""Return the table as CSV: a header, numbers with all digits, an empty cell for None.

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

    A figure with a file ``NAME.json`` beside it (:func:`~hybrid_mpc.plots.interactive.write_interactive`) is also shown
    in its interactive form.

    A plain ``str`` is escaped; ``markupsafe.Markup`` is inserted as HTML.
    """

    title: str
    paragraphs: Sequence[str] = ()
    figures: Sequence[tuple[str | Path, str]] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()

    @property
    def anchor(self) -> str:
        """Anchor of the section within the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "section"


@dataclass(frozen=True)
class Report:
    """A page: titles, a paragraph about the machine, the command that made the page, key figures, hints, sections.

    ``remark`` is a line under the title: seed, budget, versions. ``doubt`` stands above ``remark``: a warning that a
    reader must see first; empty for none. ``answers`` come first, before the machine.
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
    """Write a report as one self-contained HTML file, completely or not at all; return its path.

    Raises:
        InputError: If a figure is missing or is not a PNG or GIF file.
        StorageError: If the page cannot be written.
    """
    path = Path(path)
    write_text(path, render(report))
    return path


def render(report: Report) -> str:
    """Convert a report to HTML text.

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
    """JavaScript of the library that draws interactive figures; the page holds it, so it needs no network."""
    from bokeh.resources import Resources

    return Markup("\n".join(Resources(mode="inline", components=["bokeh"]).js_raw))


def words(
    file: str, models: Collection[str] = ("rnn", "pgrnn", "mopgrnn", "oracle")
) -> dict[str, tuple[Markup, ...]]:
    """General texts of a page's sections, from a template with one block for each section.

    Args:
        file: Name of the template.
        models: Kinds of networks that the page describes, and ``"oracle"``. Default: all.

    Example:
        >>> len(words("run_words.html")["training"])
        2
    """
    template, texts = _template(file), {}
    for name, block in template.blocks.items():  # type: ignore[attr-defined]
        paragraphs = "".join(block(template.new_context({"models": models}))).split("\n\n")
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
    """Format a table's cell as text.

    Example:
        >>> cell(None), cell(True), cell(3), cell(0.0255), cell("RNN")
        ('–', 'yes', '3', '0.0255', 'RNN')
    """
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    # a no-break space keeps a per cent sign with its number
    return number(value) if isinstance(value, float) else str(value).replace(" %", "\u00a0%")


def is_number(value: Cell) -> bool:
    """True for a cell that is aligned right."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _figure(section: Section, path: str | Path, caption: str) -> dict[str, Any]:
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"report, section {section.title!r}: the figure {path} does not exist. Draw it first, or leave it out"
            " [HM-REPORT-002]"
        )
    try:
        with Image.open(path, formats=("PNG", "GIF")) as image:
            kind, (width, height) = str(image.format).lower(), image.size
    except UnidentifiedImageError:
        raise InputError(
            f"report, section {section.title!r}: the figure {path} is not a PNG or GIF file. Save it in one of these"
            " formats [HM-REPORT-003]"
        ) from None
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    live = path.with_suffix(".json")
    return {
        "uri": f"data:image/{kind};base64,{data}",
        "caption": caption,
        "width": width,
        "height": height,
        # without "<", no text can end the script element that holds it
        "live": Markup(live.read_text("utf-8").replace("<", "\\u003c")) if live.is_file() else "",
    }
