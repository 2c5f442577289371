"""The benchmark against acados: both solve the same problem, and what can be checked without acados is."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import acados as own

N, SCRIPT = 6, Path(own.__file__)
compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler (cc)")
installed = pytest.mark.skipif(
    "ACADOS_SOURCE_DIR" not in os.environ, reason="ACADOS_SOURCE_DIR names no installation of acados"
)
softness = pytest.mark.parametrize("soft", [False, True])


def script(*words):
    command = [sys.executable, str(SCRIPT), *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def hard(tmp_path_factory):
    """The case without soft bounds, and its driver without acados."""
    case = own.made(4, N, soft=False)
    return case, own.Driver.build(case, tmp_path_factory.mktemp("driver"), None)


@pytest.mark.full
@compiler
@softness
def test_the_driver_finds_the_plans_of_the_controller_in_python(soft, hard, tmp_path):
    driver = own.Driver.build(own.made(4, N, soft=True), tmp_path, None) if soft else hard[1]
    (row,) = driver.run(["native"], 2)
    assert row["solved"] == 1.0
    assert row["differs"] < 1e-11  # the same QP in another order of operations
    assert 0 < row["feedback"] < row["whole"]


@pytest.mark.full
@compiler
def test_the_driver_sees_another_plan(hard, tmp_path):
    case, driver = hard
    rows = own.records(case)
    rows[70, -2] += 0.01  # the input before the last of one state's plan
    shutil.copy(driver.folder / "driver", tmp_path)
    rows.tofile(tmp_path / "records")
    (row,) = own.Driver(tmp_path, None).run(["native"], 1)
    assert row["differs"] == pytest.approx(0.01, abs=1e-11)


@pytest.mark.full
@compiler
def test_without_acados_the_driver_has_none_of_its_solvers(hard):
    with pytest.raises(own.DriverError):
        hard[1].run(["exported,full,0,SPEED,0,0"], 1)


@pytest.mark.full
@compiler
@installed
def test_acados_solves_what_the_library_solves(tmp_path):
    out = tmp_path / "out.json"
    words = ["--z", "4", "--n", str(N), "--rounds", "1", "--out", str(out)]
    done = script("--acados", os.environ["ACADOS_SOURCE_DIR"], *words)
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    solvers, ratios = found["rows"][:-2], found["rows"][-2:]
    assert [row["soft bounds"] for row in ratios] == [0, 2]
    assert all(np.isfinite(row["whole: acados / hybrid-mpc"]) for row in ratios)
    assert {row["solver"].split(", ")[1] for row in solvers if row["solver"].startswith("acados")} == {
        "full condensing DAQP", "full condensing HPIPM", "partial condensing HPIPM",
    }  # fmt: skip
    assert all(row["solved"] == 1.0 for row in solvers)
    active_set = [row for row in solvers if "DAQP" in row["solver"]]
    # exact solvers of one QP; an interior-point method ends at its tolerance
    assert max(row["differs [Nm]"] for row in active_set if not row["soft bounds"]) < 1e-11
    assert max(row["differs [Nm]"] for row in solvers) < 1e-3
