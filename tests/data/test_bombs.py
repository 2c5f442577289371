"""Files that would take gigabytes or minutes are refused before, and what is no regular file is not waited for."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import recording_bombs as bombs
from patience import HANGS

from hybrid_mpc import InputError, write_csv
from hybrid_mpc.data.recording import read_recording
from hybrid_mpc.files import check_npz

ROOT = Path(__file__).parents[2]
SECONDS = 5.0
"""Time of a processor that a refusal may take: the slowest (`fast.csv`) took 1.6 to 2.1 s beside the other tests."""


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and counted as Linux does")
def test_bombs_are_refused_in_little_memory_and_time(tmp_path):
    bombs.write(tmp_path)
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-m", "recording_bombs", str(tmp_path)],
        capture_output=True, text=True, timeout=HANGS, cwd=ROOT, env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = {name: rest for name, *rest in map(json.loads, done.stdout.splitlines())}
    assert set(told) == {*bombs.BOMBS, *bombs.HOLES}
    words = {name: words for name, (_, words) in bombs.BOMBS.items()}
    words |= {
        "nothing.csv": "has 3 GiB, at most 2 GiB are read",
        "one_line.csv": "a row is longer than 1.049 MB",
    }
    words["second_line.csv"] = words["one_line.csv"]
    for name, (outcome, seconds) in told.items():
        assert re.search(rf"^refused: (.|\n)*{name}(.|\n)*{words[name]}", outcome), (name, outcome)
        assert len(outcome) < 3000, name
        assert seconds < SECONDS, (name, seconds)


def test_a_large_array_that_nobody_names_is_left_alone(tmp_path):
    content = bombs.npz_bomb(bombs.header((2**26,)), 512).replace(b"phi.npy", b"log.npy")
    with pytest.raises(ValueError, match=r"536\.9.*HM-FILES-006"):
        check_npz(content, 10**6)
    check_npz(content, 10**6, ("time_s", "tau"))
    with pytest.raises(KeyError, match="phi"):
        check_npz(content, 10**6, ("phi",))


@pytest.mark.full
def test_two_million_rows_are_read(tmp_path):
    m = 2_000_000
    t = 0.001 * np.arange(m)
    path = tmp_path / "long.csv"
    rows = np.c_[t, np.round(np.cos(3 * t), 4), np.round(np.sin(3 * t), 4)]
    np.savetxt(path, rows, delimiter=",", header="time_s,tau,phi", comments="", fmt=("%.3f", "%.4f", "%.4f"))
    write_csv(tmp_path / "short.csv", bombs.GOOD)
    read_recording(
        tmp_path / "short.csv", bombs.SIGNALS, bombs.SPEC
    )  # what is loaded at the first use is loaded now
    begin = time.process_time()
    table = read_recording(path, bombs.SIGNALS, bombs.SPEC)
    assert time.process_time() - begin < SECONDS  # 1.8 s on an idle machine; the promise is 3 s
    assert table.y.shape == (m, 1)
    np.testing.assert_array_equal(table.t, np.round(t, 3))


def refused(path, match):
    with pytest.raises(InputError, match=match):
        read_recording(path, bombs.SIGNALS, bombs.SPEC)


@pytest.mark.parametrize("ending", ["csv", "npz", "mat"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, ending):
    pipe = tmp_path / f"pipe.{ending}"
    os.mkfifo(pipe)
    done = []
    reader = threading.Thread(target=lambda: done.append(refused(pipe, "HM-DATA-026")), daemon=True)
    reader.start()
    reader.join(10.0)
    assert done == [None], "opening a pipe waited for a writer, or was not refused"
    device = tmp_path / f"zero.{ending}"
    device.symlink_to("/dev/zero")
    refused(device, "HM-DATA-026")
    folder = tmp_path / f"folder.{ending}"
    folder.mkdir()
    refused(folder, r"is a directory.*HM-DATA-026")
    loop = tmp_path / f"loop.{ending}"
    loop.symlink_to(loop)
    refused(loop, "HM-DATA-026")
    refused(tmp_path / f"{5000 * 'a'}.{ending}", "HM-DATA-026")
    refused(tmp_path / f"a\0b.{ending}", "HM-DATA-026")
    refused(tmp_path / "none" / f"run.{ending}", "HM-DATA-025")
    refused(Path(f"/proc/self/clear_refs.{ending}") / "x", "HM-DATA-025")
    empty = tmp_path / f"empty.{ending}"
    empty.touch()
    refused(empty, r"is empty.*HM-DATA-027")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_no_permission(tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes(bombs.text())
    path.chmod(0)
    refused(path, "cannot be read .Permission denied")
