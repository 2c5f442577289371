"""The commands of the page on wrong priors run, and find what the page shows."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/prior-wrong.md").read_text()
COMMANDS = [
    line
    for block in re.findall(r"^```sh\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
]
COUPLING = "cos(alpha) in the mass matrix (theta, alpha): its sign seems wrong"


def done(command, folder):
    """Exit code and output of a command of the page."""
    words = {"python": sys.executable, "hybrid-mpc": f"{sys.executable} -m hybrid_mpc"}
    for name, word in words.items():
        command = re.sub(rf"^{name} ", f"{word} ", command)
    command = command.replace("docs/examples", str(ROOT / "docs/examples"))
    found = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env={**os.environ, "COLUMNS": "110"},
        capture_output=True,
        text=True,
    )
    return found.returncode, found.stdout


def test_there_are_commands():
    assert len(COMMANDS) == 4
    assert COUPLING in PAGE


@pytest.mark.full
def test_the_commands_of_the_page_find_what_it_shows(tmp_path):
    recorded, wrong, mended, checked = COMMANDS
    assert done(recorded, tmp_path)[0] == 0
    code, told = done(wrong, tmp_path)
    assert code == 2
    first = next(line for line in told.splitlines() if "seems wrong" in line)
    assert first.lstrip().startswith("1. ")
    assert COUPLING in first
    assert done(mended, tmp_path)[0] == 0
    code, told = done(checked, tmp_path)
    assert code == 0
    assert "seems wrong" not in told
    assert "No errors" in told
