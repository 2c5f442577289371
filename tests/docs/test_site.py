"""The site builds, its links lead somewhere, and every page of docs/ is in it."""

import itertools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from patience import HANGS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LINK = re.compile(r"\]\(([^)\s]+)\)")


def pages(nav):
    for entry in nav:
        for value in [entry] if isinstance(entry, str) else entry.values():
            yield from pages(value) if isinstance(value, list) else [value]


def test_every_page_is_in_the_navigation():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    assert sorted(pages(nav)) == sorted(str(p.relative_to(DOCS)) for p in DOCS.rglob("*.md"))


@pytest.mark.parametrize("page", ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_links_of_the_pages_beside_the_site(page):
    for link in LINK.findall((ROOT / page).read_text()):
        assert link.startswith("http") or (ROOT / link.partition("#")[0]).exists(), link


def searched(site, words):
    """What the search of the built site finds, opened from its folder."""
    address = f"{(site / 'index.html').as_uri()}?q={words.replace(' ', '+')}"
    done = subprocess.run(
        ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom", "--virtual-time-budget=8000",
         address],
        capture_output=True, text=True, timeout=HANGS,
    )  # fmt: skip
    return re.findall(r'<a href="([^"]*)" class="md-search-result__link"', done.stdout)


MEASURED = """<script>addEventListener("load", () => {
document.documentElement.setAttribute("data-wide", document.documentElement.scrollWidth) })</script></body>"""


def widest(page, width):
    """Width [px] that a page needs in a window of a width; more than the window's is scrolled sideways."""
    copy = page.with_name(f"measured-{page.name}")
    copy.write_text(page.read_text().replace("</body>", MEASURED))
    done = subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},800", "--dump-dom",
         "--virtual-time-budget=4000", copy.as_uri()],
        capture_output=True, text=True, timeout=HANGS,
    )  # fmt: skip
    return int(re.search(r'data-wide="(\d+)"', done.stdout)[1])


PICTURE = re.compile(r"!\[([^\]]*)\]\(([^)\s]+)\)")


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))], ids=lambda p: p.stem)
def test_pictures_say_what_is_to_be_seen(page):
    """Who does not see a picture is told what it shows: a subject, and what of it."""
    text = page.read_text()
    assert "<img" not in text
    for words, target in PICTURE.findall(text):
        assert len(words.split()) >= 4, f"{page.name}: {words!r} of {target}"
        assert (page.parent / target).is_file()


@pytest.mark.full
def test_the_site_builds_and_a_broken_link_stops_it(tmp_path):
    build = [sys.executable, "-m", "mkdocs", "build", "--site-dir"]
    done = subprocess.run([*build, tmp_path / "site"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "api" / "control.html").read_text()
    assert "CondensedController" in page
    assert "&gt;&gt;&gt;" in page  # examples are shown as code
    assert not re.findall(
        r'(?:src|href)="(?:https?:)?//[^"]*[.](?:js|css)"', page
    )  # it needs nothing from elsewhere
    if shutil.which("chromium"):
        found = searched(tmp_path / "site", "offset disturbance")
        assert any("disturbances.html" in link for link in found)
        assert not searched(tmp_path / "site", "xyzzyplugh")
        for name, width in itertools.product(
            ("machines/race_car", "mpc", "data", "results/explain"), (1280, 500)
        ):
            assert widest(tmp_path / "site" / f"{name}.html", width) <= width, name
    settings = (ROOT / "mkdocs.yml").read_text().replace("docs_dir: docs", f"docs_dir: {tmp_path}/docs")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[nowhere](none.md)\n")
    settings = settings[: settings.index("nav:")] + settings[settings.index("markdown_extensions:") :]
    (tmp_path / "mkdocs.yml").write_text(settings.replace("docs/site/", f"{DOCS}/site/"))
    broken = subprocess.run(
        [*build, tmp_path / "other", "-f", tmp_path / "mkdocs.yml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert broken.returncode != 0
    assert "none.md" in broken.stderr
