"""Kill the main job at random moments; whatever the moment, --resume finishes it to the same results (full set)."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytestmark = [pytest.mark.full, pytest.mark.xdist_group("run")]


@pytest.mark.parametrize("seed", range(4))
def test_killed_several_times(finished, arguments, tmp_path, seed):
    rng, out = np.random.default_rng(seed), tmp_path / "run"
    command = [sys.executable, "-m", "hybrid_mpc.cli", *arguments, "--out", str(out)]
    for _ in range(3):
        resume = ["--resume"] if (out / "run.json").is_file() else []
        process = subprocess.Popen(
            [*command, *resume], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(float(rng.uniform(3.0, 25.0)))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    resume = ["--resume"] if (out / "run.json").is_file() else []
    done = subprocess.run([*command, *resume], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    ours, theirs = (json.loads((f / "results.json").read_text()) for f in (out, finished))
    assert {k: v for k, v in ours.items() if k != "timing"} == {
        k: v for k, v in theirs.items() if k != "timing"
    }
