"""Files are written whole or not at all, read within limits, and folders are held by one job at a time."""

import io
import json
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from patience import HANGS

import hybrid_mpc.files
import hybrid_mpc.records
from hybrid_mpc import InputError, write_arrays
from hybrid_mpc.errors import StorageError
from hybrid_mpc.files import (
    check_folder,
    check_npz,
    check_writable,
    is_empty,
    locked,
    read_arrays,
    read_document,
    read_document_arrays,
    read_json,
    write_document,
    write_json,
    write_text,
)

LIMITED = """
import resource, signal, sys
from pathlib import Path
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
sys.argv = ["hybrid-mpc", *sys.argv[1:]]
from hybrid_mpc.cli.main import main
main()
"""
"""The command line on a disk that is full after 20 kB of any file."""


def test_what_the_file_system_refuses_is_one_clear_line(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(StorageError, match=r"Is a directory.*HM-FILES-019"):
        write_text(tmp_path / "folder", "x")
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageError, match="HM-FILES-019"):
        write_json(tmp_path / "file" / "a.json", {})
    with pytest.raises(StorageError, match="HM-FILES-019"):
        write_text(tmp_path / ("x" * 300) / "a.txt", "x")
    with pytest.raises(InputError, match=r"is a directory.*HM-FILES-011"):
        read_json(tmp_path / "folder")
    with pytest.raises(InputError, match="HM-FILES-010"):
        read_json(tmp_path / "none.json")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match=r"named pipe.*HM-FILES-011"):
        read_json(tmp_path / "pipe")
    with pytest.raises(InputError, match=r"is a device.*HM-FILES-011"):
        read_json(type(tmp_path)("/dev/zero"))


@pytest.mark.parametrize("text", ["", '{"a": NaN}', "\xff"])  # tests/nn_export/test_files.py has all of them
def test_json_that_is_none(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"a.json: the file is damaged"):
        read_json(path)


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def claimed(shape, descr="<f8", content=b""):
    """An archive of one array whose header claims a shape."""
    header = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}}}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content)
    return file.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        b"", b"rubbish", npz(a=np.zeros(3))[:-30], npz(a=np.zeros(300_000_000 // 8)), claimed((10**12,)),
        claimed((10**9, 10**9)), claimed((-1,)), claimed((0, 10**30), content=b"x"), claimed((2,), "|O", b"x" * 16),
        claimed((2,), "|V99999999999", b"x"), claimed((2,)).replace(b"NUMPY", b"NIMPY"),
    ],
)  # fmt: skip
def test_arrays_that_are_damaged_or_too_large(tmp_path, monkeypatch, content):
    monkeypatch.setattr(hybrid_mpc.files, "MOST_ARRAYS", 2**27)
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a.npz"):
        read_arrays(path)


def test_arrays_within_the_limit_pass():
    check_npz(npz(a=np.zeros((3, 4)), b=np.float64(2.0), c=np.zeros((0, 5))), 1000)


def test_a_document_tells_any_change(tmp_path):
    path = tmp_path / "a.json"
    write_document(path, {"dt": 0.02, "inf": float("inf")}, {"x": np.arange(3.0)})
    assert read_document(path) == {"dt": 0.02, "inf": "inf"}
    np.testing.assert_array_equal(read_document_arrays(path)["x"], np.arange(3.0))
    whole = path.read_text()
    path.write_text(whole.replace("0.02", "0.03"))
    with pytest.raises(InputError, match="HM-FILES-004"):
        read_document(path, "train anew")
    path.write_text(whole)
    write_arrays(path.with_suffix(".npz"), {"x": np.arange(4.0)})
    with pytest.raises(InputError, match=r"a\.npz.*a\.json.*HM-FILES-003.*again"):
        read_document_arrays(path, "again")
    path.with_suffix(".npz").unlink()
    with pytest.raises(InputError, match=r"a\.npz.*HM-FILES-010.*again"):
        read_document_arrays(path, "again")


def test_a_folder_is_held_by_one_process(tmp_path):
    """And by no one after it was killed; what it had half written is removed by the next."""
    out = tmp_path / "out"
    child = subprocess.Popen(
        [sys.executable, "-c",
         "import sys, time; from pathlib import Path; from hybrid_mpc.files import locked, replacing\n"
         "with locked(Path(sys.argv[1])), replacing(Path(sys.argv[1]) / 'sub' / 'a.json') as file:\n"
         "    file.write(b'half'); print('held', flush=True); time.sleep(60)", str(out)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert child.stdout.readline() == "held\n"
    with pytest.raises(InputError, match="HM-FILES-016"), locked(out):
        pass
    child.kill()
    child.wait()
    assert len(list((out / "sub").glob(".a.json.*.part"))) == 1
    with locked(out):
        assert list((out / "sub").iterdir()) == []
    assert is_empty(tmp_path / "none")
    (out / "sub").rmdir()
    assert is_empty(out)


def test_a_folder_for_results_is_checked_and_not_made(tmp_path):
    check_folder(tmp_path / "new" / "deeper")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="HM-FILES-013"):
        check_folder(tmp_path / "file")
    with pytest.raises(InputError, match="HM-FILES-013"):
        check_folder(tmp_path)
    for bad in (tmp_path / "file" / "below", tmp_path / ("x" * 300), "/proc/nowhere", "/dev/null/x", "a\0b"):
        with pytest.raises(InputError, match=r"HM-FILES-01[2345]"):
            check_folder(type(tmp_path)(bad))
    with pytest.raises(InputError, match="HM-FILES-015"):
        check_writable(type(tmp_path)("/proc"))


@pytest.mark.full
def test_a_full_disk_ends_a_command_with_a_line_and_no_damage(tmp_path):
    """``data`` writes recordings of more than 20 kB: the first is refused, whole, and the command says so."""
    words = ["data", "golf_robot", "--out", str(tmp_path / "out"), "--budget", "quick"]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *words], capture_output=True, text=True, timeout=HANGS
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "File too large" in done.stderr
    assert "repeat the command with another --out" in done.stderr
    assert not [p for p in (tmp_path / "out").rglob("*") if p.is_file()]


def test_results_of_control_are_refused_before_the_loops(call, golf_artifact, tmp_path):
    (tmp_path / "file").write_text("x")
    for out in (tmp_path / "file" / "out", "/proc/out"):
        code, _, message = call("control", "golf_robot", "--model", golf_artifact, "--out", out)
        assert code == 2
        assert "cannot" in message
        assert "HM-FILES-015" in message


def test_write_of_plain_text_is_json(tmp_path):
    write_json(tmp_path / "a.json", {"x": np.float64(1.0), "y": (1, 2)})
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": 1.0, "y": [1, 2]}
