"""The exporter's benchmarks run, and the routes that they time agree."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.full
@pytest.mark.parametrize("name", ["export_step", "export_horizon", "torch_prior"])
def test_quick_benchmark(name, tmp_path):
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / f"{name}.py"),
        "--quick",
        "--out",
        str(tmp_path / "out.json"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=600)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert len(rows) == 2
    for row in rows:
        differences = (
            row["difference"].values() if isinstance(row["difference"], dict) else [row["difference"]]
        )
        # One step, or a stable free run of at most 50 steps, in another order of operations.
        assert max(differences) < 1e-11
