"""Figures over time as interactive ones: the drawn values, their colours and units; pages that need no network."""

import base64
import gzip
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from patience import HANGS

from hybrid_mpc.plots.interactive import MOST, over_time, plain, thinned, write_interactive
from hybrid_mpc.plots.style import new_figure, save
from hybrid_mpc.report.page import Report, Section, render

T = np.linspace(0.0, 2.0, 41)


@pytest.fixture
def drawn():
    """Two panels over time: curves, a band, a marked stretch, lines across."""
    figure, axes = new_figure(2, 1, sharex=True, title="Free run")
    top, bottom = axes[:, 0]
    top.plot(T, np.sin(T), color="#0072B2", label="measured")
    top.plot(T, np.cos(T), "--", color="#009E73", label="hybrid <b>")
    top.fill_between(T, np.cos(T) - 0.1, np.cos(T) + 0.1, color="#009E73", alpha=0.2)
    top.axvspan(0.5, 1.0, color="#999999", alpha=0.3, lw=0)
    top.set_ylabel(r"$\varphi$ [rad]")
    top.legend()
    bottom.step(T, T > 1, where="post", label="measured")
    bottom.plot(T[::10], T[::10], "o", label="_hidden")
    bottom.axhline(0.5, color="#000000", linestyle=":")
    bottom.axvline(1.5, color="#D55E00")
    bottom.set_xlabel("time [s]")
    return figure


def models(text):
    """What stands in an interactive figure, by kind."""
    found = {}

    def walk(value):
        if isinstance(value, dict):
            if value.get("type") == "object" and "name" in value:
                found.setdefault(value["name"], []).append(value.get("attributes", {}))
            for part in value.values():
                walk(part)
        elif isinstance(value, list):
            for part in value:
                walk(part)

    walk(json.loads(text))
    return found


def numbers(array):
    data = base64.b64decode(array["array"]["data"])
    return np.frombuffer(gzip.decompress(data), dtype=array["dtype"])


def test_it_holds_what_was_drawn(drawn, tmp_path):
    text = write_interactive(drawn, tmp_path / "run.png").read_text()
    found = models(text)
    columns = [dict(source["data"]["entries"]) for source in found["ColumnDataSource"]]
    curves = [(numbers(c["x"]), numbers(c["y"])) for c in columns if "y" in c]
    assert len(curves) == 4
    for shown, values in ((T, np.sin(T)), (T, np.cos(T)), (T, T > 1), (T[::10], T[::10])):
        near = [
            np.allclose(y, values, atol=1e-7) and np.array_equal(x, shown)
            for x, y in curves
            if len(x) == len(shown)
        ]
        assert sum(near) == 1  # in single precision
    assert len(found["Patches"]) >= 1
    # dragging sideways enlarges a stretch of time in all panels, whose vertical axes stay
    assert [tool["dimensions"] for tool in found["BoxZoomTool"]] == ["width"] * 2
    assert [b["right"] for b in found["BoxAnnotation"] if b.get("left") == 0.5] == [
        1.0
    ]  # others are of the tools
    assert {(s.get("dimension", "width"), s["location"]) for s in found["Span"]} == {
        ("width", 0.5),
        ("height", 1.5),
    }
    assert {"φ [rad]", "time [s]"} <= {a.get("axis_label") for a in found["LinearAxis"]}
    assert {item["label"]["value"] for item in found["LegendItem"]} == {"measured", "hybrid <b>"}
    assert found["Line"][0]["line_color"] == "#0072b2"
    assert found["Step"][0]["mode"] == "after"


def test_a_signal_is_switched_in_all_panels(drawn, tmp_path):
    found = models(write_interactive(drawn, tmp_path / "run.png").read_text())
    switches = [c["code"] for c in found["CustomJS"]]
    assert switches == ["other.visible = cb_obj.visible"] * 2  # measured: from either panel to the other


def test_the_page_carries_all_it_needs(drawn, tmp_path):
    path = save(drawn, tmp_path / "run.png")
    plain = render(Report("r", "", "", "", sections=[Section("s", figures=[(path, "A run.")])]))
    assert "<script" not in plain
    write_interactive(drawn, path)
    page = render(Report("r", "", "", "", sections=[Section("s", figures=[(path, "A run.")])]))
    assert not re.search(r'<(script|link|img|iframe)[^>]* (src|href)="(?!data:)', page)
    assert "hybrid <b>" not in page  # nothing in a label ends the script, or becomes part of the page
    assert "hybrid \\u003cb>" in page
    assert page.count('<details class="live">') == 1
    assert len(page) < len(plain) + 1.3e6  # of the 6 MB that a report may have


@pytest.mark.full
@pytest.mark.skipif(shutil.which("chromium") is None, reason="there is no Chromium")
def test_a_browser_draws_it_without_an_error(drawn, tmp_path):
    path = save(drawn, tmp_path / "run.png")
    write_interactive(drawn, path)
    page = render(Report("r", "", "", "", sections=[Section("s", figures=[(path, "A run.")])]))
    file = tmp_path / "report.html"
    file.write_text(
        page.replace("</body>", '<script>document.querySelector(".live").open = true</script></body>')
    )
    done = subprocess.run(
        ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
         "--virtual-time-budget=8000", file.as_uri()],
        capture_output=True, text=True, timeout=HANGS,
    )  # fmt: skip
    told = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not [line for line in told if "rror" in line], told
    assert any("document idle" in line for line in told), told  # everything is drawn
    assert re.search(r'<div class="panels"[^>]*><div', done.stdout)


def test_only_figures_over_time_are_interactive(drawn):
    assert over_time(drawn)
    assert not over_time(new_figure(1, 1)[0])


def test_a_long_curve_keeps_its_peaks():
    x = np.arange(50_000.0)
    y = np.sin(x / 1e3)
    y[31_415], y[100] = 9.0, np.nan
    short, kept = thinned(x, y)
    assert len(short) == MOST
    assert np.all(np.diff(short) >= 0)
    assert short[np.nanargmax(kept)] == 31_415


def test_a_label_is_no_html_and_no_formula(tmp_path):
    """Tooltips are HTML that Bokeh fills in as it is; a recording's file name may be anything."""
    figure, axes = new_figure(1, 1, title="costs $1 and $2")
    axes[0, 0].plot([0.0, 1.0], [0.0, 1.0], label="<img src=x onerror=alert(1)>")
    axes[0, 0].set_xlabel("time [s]")
    axes[0, 0].set_ylabel(r"\(x\) [m]")
    assert figure.get_suptitle() == r"costs \$1 and \$2"
    save(figure, tmp_path / "a.png")  # a formula that is none would raise
    held = json.loads(write_interactive(figure, tmp_path / "a.png").read_text())
    names = [name for name in strings_of(held, "name") if "img" in name]
    assert names == ["&lt;img src=x onerror=alert(1)&gt;"]
    assert plain(r"\(x\) [m]") == "(x\\) [m]"


def strings_of(value, key):
    """All texts under a key, however deep."""
    if isinstance(value, list):
        return [found for one in value for found in strings_of(one, key)]
    if not isinstance(value, dict):
        return []
    own = [value[key]] if isinstance(value.get(key), str) else []
    return own + [found for one in value.values() for found in strings_of(one, key)]
