"""The tables and claims in the pages are those of the results that are kept."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("page", "kept"), [("reproduction.md", "reproduction"), ("machines.md", "machines")])
def test_page_has_every_line_of_the_results(page, kept):
    script = ROOT / "docs" / "results" / kept / "table.py"
    done = subprocess.run([sys.executable, script], cwd=ROOT, capture_output=True, text=True, check=True)
    lines = set((ROOT / "docs" / page).read_text().splitlines())
    printed = [line for line in done.stdout.splitlines() if line]
    assert len(printed) > 40, "no results are kept"
    assert not [line for line in printed if line not in lines]
