"""Files are read with a limit, and replaced whole; JSON with traps is refused."""

import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from patience import HANGS

from nn_export.files import MAX_DEPTH, MAX_VALUES, parse_json, read_bytes, replacing, sweep, write_bytes

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX files")
linux = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
ROOT = str(Path(__file__).parents[2])


def refused(path, limit=1000):
    """The reason for which a file is not read, as a message says it."""
    start = time.monotonic()
    with pytest.raises(OSError, match=r"\w") as caught:
        read_bytes(path, limit)
    assert time.monotonic() - start < HANGS  # none of them waits
    assert caught.value.filename == str(path)
    return caught.value.strerror


def test_a_file_is_read_up_to_its_limit(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(range(256)) * 600)  # more than a block
    assert read_bytes(path, 256 * 600) == path.read_bytes()
    assert refused(path, 256 * 600 - 1) == "has 153600 bytes, at most 153599 bytes are read"
    assert refused(path, 2**10) == "has 150 KiB, at most 1 KiB are read"
    path.write_bytes(b"")
    assert read_bytes(path, 0) == b""
    with path.open("rb+") as file:
        file.truncate(5 * 2**30)  # sparse: takes no space on the disk
    assert refused(path, 64 * 2**20) == "has 5 GiB, at most 64 MiB are read"


@posix
def test_what_is_no_file_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a socket's name must be short
    os.mkfifo(tmp_path / "pipe")  # nobody writes: a plain open would wait for ever
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "loop").symlink_to("loop")
    assert refused(tmp_path) == "is a directory"
    assert refused(tmp_path / "pipe") == "is a named pipe, not a file"
    assert refused(Path("/dev/zero")) == "is a device, not a file"
    assert refused(tmp_path / "zero") == "is a device, not a file"
    assert "symbolic link" in refused(tmp_path / "loop")
    assert refused(tmp_path / "none") == "No such file or directory"
    assert "too long" in refused(tmp_path / ("a" * 300))
    assert "no name of a file" in refused(tmp_path / "a\0b")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        assert refused(tmp_path / "socket") == "is a socket, not a file"


@posix
def test_a_file_of_somebody_else(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"secret")
    path.chmod(0)
    root = os.geteuid() == 0
    if root:  # root may read anything
        for folder in (tmp_path, *tmp_path.parents[:2]):
            folder.chmod(0o755)
        os.seteuid(65534)
    try:
        assert refused(path) == "Permission denied"
    finally:
        if root:
            os.seteuid(0)


@linux
def test_a_file_that_grows_while_it_is_read():
    grows = Path("/proc/self/maps")  # says that it has 0 bytes, and then gives thousands
    assert grows.stat().st_size == 0
    assert refused(grows, 1000).startswith("grew while it was read: has ")
    assert read_bytes(Path("/proc/version"), 10_000) == Path("/proc/version").read_bytes()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "Expecting value"),
        (b"{", "Expecting property name"),
        (b"[1] 2", "Extra data"),
        (b"\xef\xbb\xbf{}", "BOM"),
        (b'"\xff"', "NN-030"),
        (b'"\xed\xa0\x80"', "NN-030"),  # half a surrogate pair, in bytes
        (rb'{"a": "\ud800"}', "NN-033"),
        (rb'{"\udc00\ud800": 1}', "NN-033"),
        (b'{"a": NaN}', r"NaN.*NN-034"),
        (b"[-Infinity]", r"-Infinity.*NN-034"),
        (b"1e400", r"1e400.*NN-035"),
        (b"-1e400", r"-1e400.*NN-035"),
        (b"1" * 21, r"20.*NN-036"),
        (b"[-" + b"1" * 5000 + b"]", r"20.*NN-036"),
        (b"1" * 10**6, r"20.*NN-036"),
        (b'{"a": 1, "b": {"c": 1, "d": 2, "c": 1}}', r"'c'.*NN-037"),
        (b'{"a": 1, "\\u0061": 1}', r"'a'.*NN-037"),
        (b"[" * (MAX_DEPTH + 1) + b"]" * (MAX_DEPTH + 1), "nested deeper than 40 levels"),
        (b'{"a":' * 50 + b"1" + b"}" * 50, "nested deeper than 40 levels"),
        (b"[" * 10**6 + b"]" * 10**6, "nested deeper than 40 levels"),
        (b"[" * 10**6, "nested deeper than 40 levels"),
        (b'{"a":' * 10**6 + b"1" + b"}" * 10**6, "nested deeper than 40 levels"),
        (b"[" + b"[]," * (MAX_VALUES // 2) + b"0]", f"more than {MAX_VALUES} values"),
    ],
    ids=lambda value: repr(value[:16]) if isinstance(value, bytes) else "",
)
def test_json_with_traps_is_refused(content, reason):
    start = time.process_time()
    with pytest.raises(ValueError, match=reason) as caught:
        parse_json(content)
    assert (
        time.process_time() - start < 10.0
    )  # [s] of the processor; reading without limits takes minutes and all memory
    assert len(str(caught.value)) < 120  # a reason, not the content


def test_json_that_is_in_order_is_read():
    deep = b"[" * MAX_DEPTH + b"]" * MAX_DEPTH
    for content in (deep, b"{}", b"-0", b"[-0.0, 1e308, 1e-400, 18446744073709551615, -9223372036854775808]"):
        assert parse_json(content) == json.loads(content)
    # a pair; and a backslash before text
    assert parse_json(rb'"\ud83d\ude00 \\ud800"') == "\U0001f600 \\ud800"


def _stop_within(path, error):
    with replacing(path) as file:
        file.write(b"half")
        raise error


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new" / "folder" / "a.bin"
    write_bytes(path, b"old")
    assert path.read_bytes() == b"old"
    with replacing(path) as file:
        file.write(b"new")
        (part,) = (p for p in path.parent.iterdir() if p != path)
        assert part.name.startswith(".a.bin.")
        assert part.name.endswith(".part")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            _stop_within(path, error)
    assert path.read_bytes() == b"new"
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_bytes(tmp_path / "folder", b"a file cannot take a folder's place")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "new"]
    assert [p.name for p in path.parent.iterdir()] == ["a.bin"]
    long = tmp_path / ("ü" * 125)  # of 250 bytes: the temporary name must not be longer than 255
    write_bytes(long, b"")
    assert long.exists()


@posix
@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o000, 0o644), (0o027, 0o640)])
def test_the_umask_says_who_may_read(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        write_bytes(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == mode


def _write_often(path, letter):
    for _ in range(40):
        write_bytes(Path(path), letter.encode() * 200_000)


def test_a_reader_sees_whole_files_of_many_writers(tmp_path):
    path = tmp_path / "a"
    write_bytes(path, b"a" * 200_000)
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_often, args=(str(path), letter)) for letter in "bcd"]
    for writer in writers:
        writer.start()
    seen = set()
    while any(writer.is_alive() for writer in writers):
        content = read_bytes(path, 200_000)
        assert content == content[:1] * 200_000
        seen.add(content[:1])
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert len(seen) > 1  # else it saw nothing change
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


KILLED = """
import sys, time
from pathlib import Path
from nn_export.files import replacing
with replacing(Path(sys.argv[1])) as file:
    file.write(b"half")
    file.flush()
    print("half", flush=True)
    time.sleep(60)
"""


@posix
def test_a_killed_writer_leaves_the_old_file_and_what_sweep_removes(tmp_path):
    path = tmp_path / "a"
    write_bytes(path, b"old")
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as writer:
        assert writer.stdout.readline() == "half\n"
        writer.send_signal(signal.SIGKILL)
    assert path.read_bytes() == b"old"
    (part,) = (p for p in tmp_path.iterdir() if p != path)
    sweep(tmp_path)
    assert part.exists()  # it may still be written
    os.utime(part, (time.time() - 3601,) * 2)
    sweep(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_sweep_touches_nothing_else(tmp_path):
    names = ["a.part", ".a", ".part", "results.json", ".a.part.json"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / ".folder.part").mkdir()
    os.utime(tmp_path / ".folder.part", (0, 0))
    sweep(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*names, ".folder.part"])
    sweep(tmp_path / "none")
