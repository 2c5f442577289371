"""The report for everyone: contrast in light and dark, texts for pictures, headings, names of what can be operated."""

import json
import re
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc.plots.interactive import write_interactive
from hybrid_mpc.plots.style import INK, MUTED, finish_column, new_column, save
from hybrid_mpc.report.page import Hint, KeyFigure, Report, Section, Table, render, words

sys.path.insert(0, str(Path(__file__).parent))
import report_example as example
from patience import HANGS

LEAST = 4.5
"""Contrast of text of ordinary size, WCAG 2.2, criterion 1.4.3, level AA."""
DARK = "@media screen and (prefers-color-scheme: dark)"
ASK = """
const channel = v => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
const light = c => 0.2126 * channel(c[0]) + 0.7152 * channel(c[1]) + 0.0722 * channel(c[2]);
const parts = text => text.match(/[\\d.]+/g).map(Number);
const seen = c => c.length < 4 || c[3] > 0;
function behind(element) {
  for (; element; element = element.parentElement) {
    const ground = parts(getComputedStyle(element).backgroundColor);
    if (seen(ground)) return ground;
  }
  return [255, 255, 255];
}
const texts = [];
for (const element of document.querySelectorAll("body *")) {
  const own = [...element.childNodes].filter(n => n.nodeType === 3).map(n => n.textContent).join("").trim();
  if (!own || ["SCRIPT", "STYLE"].includes(element.tagName)) continue;
  const [a, b] = [light(parts(getComputedStyle(element).color)), light(behind(element))];
  const name = element.tagName + "." + element.className;
  texts.push([(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), name, own.slice(0, 40)]);
}
const said = document.createElement("pre");
said.id = "answer";
said.textContent = JSON.stringify(texts);
document.body.append(said);
"""


def page(folder):
    """A page with all that a page can have: cards and hints of every kind, tables, pictures, an interactive one."""
    t = np.linspace(0.0, 1.0, 50)
    figure, panels = new_column([1.0, 1.0])
    for ax in panels:
        ax.plot(t, np.sin(t), label="measured")
        ax.set_ylabel("q [m]")
    finish_column(figure, panels)
    live = save(figure, folder / "live.png")
    write_interactive(figure, live)
    made = example.report(folder / "figures")
    hints = [Hint(verdict, "A finding.", "A remedy.") for verdict in ("good", "bad", "")]
    cards = [KeyFigure("An error", 0.1, "m", verdict, "better") for verdict in ("good", "bad", "")]
    general = [Section(name, texts) for name, texts in words("run_words.html").items()]
    last = Section(
        "live", ("A text.",), [(live, "A run over time.")], [Table(("a", "b"), (("x", 1.0),), "Numbers.")]
    )
    return render(Report(made.title, made.scenario, made.description, made.command, cards,
                         (*made.sections, *general, last), "A remark.", hints))  # fmt: skip


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    return page(tmp_path_factory.mktemp("page"))


@pytest.mark.full
@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no Chromium")
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_all_text_stands_out_from_what_is_behind_it(text, tmp_path, dark):
    assert DARK in text
    shown = text.replace(DARK, "@media screen" if dark else "@media speech")
    file = tmp_path / "report.html"
    opened = 'for (const view of document.querySelectorAll("details")) view.open = true;'
    file.write_text(shown.replace("</body>", f"<script>{opened}{ASK}</script></body>"))
    done = subprocess.run(
        ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom", "--virtual-time-budget=4000",
         file.as_uri()],
        capture_output=True, text=True, timeout=HANGS,
    )  # fmt: skip
    told = re.search(r'<pre id="answer">(.*?)</pre>', done.stdout, re.DOTALL)
    assert told, done.stderr[-2000:]
    texts = json.loads(told[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&"))
    assert len(texts) > 100  # cards, tables, captions, words
    low = sorted(one for one in texts if one[0] < LEAST)
    assert not low, low[:10]


def contrast(one, other):
    """Of two colours ``#rrggbb``."""

    def light(colour):
        c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    high, low = sorted((light(one), light(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_text_within_pictures_stands_out_from_their_white():
    assert round(contrast("#000000", "#ffffff"), 3) == 21.0
    assert min(contrast(ink, "#ffffff") for ink in (INK, MUTED)) >= LEAST


def test_pictures_headings_and_names(text):
    assert '<html lang="en">' in text
    levels = [int(level) for level in re.findall(r"<h([1-6])[ >]", text)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))
    pictures = re.findall(r"<img [^>]*>", text)
    assert pictures
    for picture in pictures:
        alt = re.search(r'alt="([^"]*)"', picture)
        assert alt, picture[-200:]
        assert len(alt[1]) > 10 or " " in alt[1], alt[1]
    for tag in ("summary", "nav"):
        every = re.findall(rf"<{tag}[^>]*>", text)
        names = [re.search(r'aria-label="([^"]+)"', one) for one in every]
        assert every
        assert all(names)
    assert all('aria-label="' in one for one in re.findall(r'<div class="scroll"[^>]*>', text))
    assert all(
        'tabindex="0"' in one for one in re.findall(r'<div class="scroll"[^>]*>', text)
    )  # by keyboard, too
    assert all('aria-label="' in one for one in re.findall(r'<span class="mark"[^>]*>', text))
