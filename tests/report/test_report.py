"""The report: self-contained, escaped, complete."""

import base64
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.analyze.properties import Mode
from hybrid_mpc.report.page import KeyFigure, Report, Section, Table, render, words, write_report
from hybrid_mpc.workflow.stages.report import TITLES, _pole_table

sys.path.insert(0, str(Path(__file__).parent))
import report_example as example


class Page(HTMLParser):
    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    report = example.report(folder / "figures")
    return report, write_report(folder / "report.html", report).read_text(encoding="utf-8")


def test_it_needs_nothing_beside_it(made):
    page = Page(made[1])
    assert page.open == []
    names = {tag for tag, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object", "base"}
    for _, attrs in page.tags:
        for key in ("src", "href"):
            assert re.match(r"data:image/png;base64,|#", attrs.get(key, "#"))
        assert not any(key.startswith("on") for key in attrs)
    style = made[1].split("<style>")[1].split("</style>")[0]
    assert "url(" not in style
    assert "@import" not in style
    assert "@media print" in style


def test_every_figure_is_embedded_as_it_is(made):
    report, text = made
    images = [attrs for tag, attrs in Page(text).tags if tag == "img"]
    figures = [path for section in report.sections for path, _ in section.figures]
    assert len(images) == len(figures) == len(example.FIGURES)
    for attrs, path in zip(images, figures, strict=True):
        assert base64.b64decode(attrs["src"].split(",")[1]) == Path(path).read_bytes()
        assert attrs["alt"]


def test_the_contents_lead_to_every_section(made):
    page = Page(made[1])
    links = [attrs["href"][1:] for tag, attrs in page.tags if tag == "a"]
    ids = [attrs["id"] for tag, attrs in page.tags if "id" in attrs]
    assert len(links) == len(made[0].sections)
    assert set(links) <= set(ids)
    assert len(ids) == len(set(ids))


def test_text_of_users_is_escaped():
    evil = '<script>alert("1")</script>'
    table = Table((evil,), ((evil,),), evil)
    report = Report(
        evil, evil, evil, evil, (KeyFigure(evil, evil, evil, evil),), (Section(evil, (evil,)),), evil
    )
    text = render(report)
    assert "<script" not in text
    assert text.count("&lt;script&gt;") >= 11  # the title stands twice, a section's title in the contents too
    text = render(Report("t", "s", "d", "c", (), (Section("a", (evil,), (), (table,), (evil,)),)))
    assert "<script" not in text
    assert text.count("&lt;script&gt;") == 6  # the table's caption names its region, too


def test_the_same_report_is_the_same_text(made):
    assert render(made[0]) == made[1]


def test_two_sections_of_one_name_keep_their_own_anchors():
    page = Page(render(Report("t", "s", "d", "c", (), (Section("Data"), Section("Data")))))
    ids = [attrs["id"] for tag, attrs in page.tags if "id" in attrs]
    assert len(ids) == len(set(ids))


def test_a_missing_figure_is_named(tmp_path):
    report = Report("t", "s", "d", "c", (), (Section("Data", (), ((tmp_path / "none.png", "x"),)),))
    with pytest.raises(InputError, match=r"'Data'.*HM-REPORT-002"):
        write_report(tmp_path / "report.html", report)
    assert list(tmp_path.iterdir()) == []


def test_a_figure_that_is_no_png_is_named(tmp_path):
    (tmp_path / "a.png").write_text("no picture")
    with pytest.raises(InputError, match=r"a\.png.*HM-REPORT-003"):
        render(Report("t", "s", "d", "c", (), (Section("Data", (), ((tmp_path / "a.png", "x"),)),)))


def test_a_moving_picture_is_embedded_with_its_size(tmp_path):
    from PIL import Image

    frames = [Image.new("RGB", (30, 20), colour) for colour in ("white", "black")]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    text = render(Report("t", "s", "d", "c", (), (Section("Data", (), ((tmp_path / "a.gif", "x"),)),)))
    image = next(attrs for tag, attrs in Page(text).tags if tag == "img")
    assert image["src"].startswith("data:image/gif;base64,")
    assert (image["width"], image["height"]) == ("30", "20")


def test_a_table_with_a_short_row_is_refused():
    with pytest.raises(InputError, match="HM-REPORT-001"):
        Table(("a", "b"), ((1, 2), (3,)), "Numbers")


def test_general_texts_are_whole_html():
    texts = words("run_words.html")
    assert set(texts) == set(TITLES)
    for key, paragraphs in texts.items():
        page = Page(" ".join(paragraphs))
        assert page.open == [], key
        assert key == "glossary" or 2 <= len(re.findall(r"[.:](?:\s|<|$)", page.text)) <= 12


def test_the_table_of_poles_explains_models_of_which_only_one_is_stable():
    mode = Mode(0.99 + 0.1j, 4.0, 0.01, 1.0, 1.0)
    grown = replace(mode, pole=1.001 + 0.1j, damping=-0.01)

    def caption(other):
        models = {"prior": SimpleNamespace(points={"moving": (mode,)}),
                  "hybrid": SimpleNamespace(points={"moving": (other,)})}  # fmt: skip
        return _pole_table(SimpleNamespace(models=models)).caption

    assert "180" in caption(grown)
    assert "180" not in caption(mode)
