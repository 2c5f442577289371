"""The benchmarks run, and the routes that they time agree."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def rows(out, name, words):
    command = [sys.executable, str(ROOT / "benchmarks" / f"{name}.py"), *words.split(), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())["rows"]
    assert "| " + " | ".join(found[0]) + " |" in done.stdout
    return found


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "words", "least"),
    [("export", "--z 8 --n 20 --batch 1 512", 14), ("free_run", "--z 4 --samples 20 --rounds 1", 4)],
)
def test_routes_agree(name, words, least, tmp_path):
    found = rows(tmp_path / "out.json", name, words)
    assert len(found) >= least
    # One step, or a stable free run of at most 20 steps, in another order of operations.
    assert max(row["difference"] for row in found) < 1e-11


@pytest.mark.full
def test_solvers_find_the_same_plan(tmp_path):
    found = rows(tmp_path / "out.json", "rivals", "--z 4 --n 6 --rounds 1")
    assert len(found) >= 9
    assert all(row["solved"] == 1.0 for row in found)
    converged = [row["cost"] for row in found if row["solver"] != "rti"]  # that takes one iteration
    # L-BFGS stops at 1e-6 of its scaled gradient; a cost of the order of 1 is flat there
    assert max(converged) - min(converged) < 1e-5


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("steps", "--z 4 --n 8"),
        ("training", "--z 4 --steps 10 --batch 4 --rounds 1"),
        ("whole_period", "--z 4"),
        ("replay", "--share 0.05 --only double"),
        ("studies", "scale --runs 50"),
        ("studies", "overhead --runs 60"),
    ],
)
def test_the_others_run(name, words, tmp_path):
    assert rows(tmp_path / "out.json", name, words)


@pytest.mark.full
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
def test_the_controller_in_c_solves_what_python_solves(tmp_path):
    found = rows(tmp_path / "out.json", "native", "--sizes 4 --rounds 1")
    assert [row["solver"] for row in found] == ["rti, Python", "native, -O3 -march=native", "native, -O3"]
    # the same QP in another order of operations
    assert max(row["input differs"] for row in found) < 1e-11


@pytest.mark.full
@pytest.mark.skipif(None in map(shutil.which, ("cc", "valgrind")), reason="no C compiler (cc) or no valgrind")
def test_instructions_are_counted(tmp_path):
    found = rows(tmp_path / "out.json", "instructions", "--z 4 --n 6")
    assert len(found) == 6
    assert all(0 < row["decision"] < row["period"] <= row["largest"] for row in found)
