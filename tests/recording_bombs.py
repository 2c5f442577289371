"""Small files that would take gigabytes or minutes, made byte by byte, and the recording that they are made from.

As a script it reads those of a folder as recordings, with little more memory than it starts with.
"""

import io
import json
import struct
import sys
import time
import zipfile
import zlib
from pathlib import Path

import numpy as np
from machine_signals import machine
from scipy.io import savemat

from hybrid_mpc import DataSpec, Signal

SPEC = DataSpec("time_s", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2)
SIGNALS = machine((Signal("phi", "rad", -10, 10),), (Signal("torque", "N m", -5, 5),))
T = np.arange(60) * 0.01
GOOD = {"time_s": T, "tau": np.cos(T), "phi": np.sin(T)}
MEMORY = 500 * 2**20
"""What reading may take beyond what the process has [byte]."""


def text(columns=3):
    """The good recording as CSV, with further columns of zeros."""
    rows = zip(*GOOD.values(), strict=True)
    lines = [[*GOOD, *(f"c{i}" for i in range(columns - 3))]]
    lines += [[f"{x:.6g}" for x in row] + (columns - 3) * ["0"] for row in rows]
    return "\n".join(",".join(line) for line in lines).encode()


def with_cell(cell):
    """The good recording with another cell in its row 21."""
    lines = text().split(b"\n")
    lines[20] = b"0.19," + cell + b",0.1"
    return b"\n".join(lines)


def uneven():
    """Half the stamps a nanosecond apart: smoothing at the median distance would take gigabytes."""
    t = np.r_[1e-9 * np.arange(200), 0.01 * np.arange(1, 199)]
    rows = [f"{x:.12g},{np.cos(x):.6g},{np.sin(x):.6g}" for x in t]
    return "\n".join([",".join(GOOD), *rows]).encode()


def fast():
    """A microsecond apart for a tenth of a second: the window of smoothing holds nearly all samples."""
    t = 1e-6 * np.arange(410_000)
    return b"\n".join([",".join(GOOD).encode(), *(b"%.7g,1,%.4g" % (x, x) for x in t)])


def npy(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def header(shape, descr="<f8"):
    """An array's begin without its numbers."""
    words = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(words)) + words


def npz(members, kind=zipfile.ZIP_STORED):
    """An archive of the good arrays, and of raw members, which may replace them."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as archive:
        for name, content in {**{f"{n}.npy": npy(column) for n, column in GOOD.items()}, **members}.items():
            archive.writestr(name, content)
    return file.getvalue()


def deflated(begin, mebibytes):
    """Raw deflate stream of some bytes and so many MiB of zeros, which takes no time to make."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packer.compress(begin) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + mebibytes * block + packer.flush()


def npz_bomb(begin, mebibytes):
    """An archive whose phi is a stream of zeros after ``begin``."""
    whole = npz({"phi.npy": b"x"})
    packed, size = deflated(begin, mebibytes), len(begin) + mebibytes * 2**20
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        entry = archive.getinfo("phi.npy").header_offset
        directory = archive.start_dir
    local = struct.pack("<4s5H3I2H", b"PK\3\4", 20, 0, 8, 0, 33, 0, len(packed), size, 7, 0) + b"phi.npy"
    old = whole[directory:]
    place = old.index(b"phi.npy") - 46
    central = struct.pack(
        "<4s6H3I5H2I", b"PK\1\2", 20, 20, 0, 8, 0, 33, 0, len(packed), size, 7, *(4 * [0]), 0, entry
    )
    listed = old[:place] + central + old[place + 46 :]
    before = whole[:entry] + local + packed
    end = listed.rindex(b"PK\5\6")
    return before + listed[: end + 16] + struct.pack("<I", len(before)) + listed[end + 20 :]


def many_members(count):
    return npz({f"{i}.npy": b"" for i in range(count)})


def element(kind, data):
    """An element of a .mat file of level 5."""
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def variable(name, dims, rest, kind=6):
    """Flags, dimensions, name, and what follows."""
    flags = element(6, struct.pack("<II", kind, 0))
    return element(14, flags + element(5, struct.pack(f"<{len(dims)}i", *dims)) + element(1, name) + rest)


def mat(*variables):
    """A .mat file of the good vectors and these variables."""
    file = io.BytesIO()
    savemat(file, GOOD)
    return file.getvalue() + b"".join(variables)


def packed(data):
    inner = zlib.compress(data, 9)
    return struct.pack("<II", 15, len(inner)) + inner


def mat_bomb(mebibytes):
    """A compressed variable of so many MiB of zeros."""
    size = mebibytes * 2**20
    begin = variable(b"z", (size // 8, 1), b"")[8:] + struct.pack("<II", 9, size)
    begin = struct.pack("<II", 14, len(begin) + size) + begin
    low, high = zlib.adler32(begin) & 0xFFFF, zlib.adler32(begin) >> 16
    check = ((high + size * low) % 65521) << 16 | low
    inner = b"\x78\x9c" + deflated(begin, mebibytes) + struct.pack(">I", check)
    return struct.pack("<II", 15, len(inner)) + inner


def nested(depth):
    inner = variable(b"", (1, 1), element(9, struct.pack("<d", 1.0)))
    for _ in range(depth):
        inner = variable(b"c", (1, 1), inner, kind=1)
    return inner


def level_4(rows, columns, name=b"t\0", length=None):
    """A variable of a .mat file of level 4, without its numbers."""
    return struct.pack("<5i", 0, rows, columns, 0, len(name) if length is None else length) + name


NUMBERS = element(9, np.ones(3).tobytes())
FIELDS = element(5, struct.pack("<i", 8)) + element(1, b"phi".ljust(8, b"\0"))
GIBIBYTE = 2**30

HOLES = {
    "nothing.csv": (b"", 3 * GIBIBYTE),
    "one_line.csv": (b"1", GIBIBYTE),
    "second_line.csv": (text() + b"\n0.6,", GIBIBYTE),
}
"""Begins of files, and how long a hole makes them."""

BOMBS = {
    "quote.csv": (lambda: text() + b'\n"' + 2**20 * b"1,\n", "quotation mark is not closed"),
    "columns.csv": (lambda: text(200_000), "a row is longer than"),
    "wide.csv": (lambda: text(5_000).replace(b"phi", b"ph", 1), "and 4970 more.* Did you mean 'ph'"),
    "digits.csv": (lambda: with_cell(100_000 * b"7"), r"row 21, column 'tau' is '7+' \(100000 characters\)"),
    "exponent.csv": (lambda: with_cell(b"1e" + 100_000 * b"9"), "row 21, column 'tau'"),
    "nul.csv": (lambda: with_cell(b"0.\x001"), "row 21 is not text"),
    "blank.csv": (lambda: 5 * 2**20 * b"\n", "empty"),
    "packed.csv": (lambda: b"\x1f\x8b\x08\x00" + text(), "unpack a packed file"),
    "uneven.csv": (uneven, "sampling is uneven"),
    "fast.csv": (fast, "too many to compute"),
    "bomb.npz": (lambda: npz_bomb(header((2**26,)), 512), "536.9 MB, more than the 67.11 MB"),
    "bytes.npz": (lambda: npz_bomb(header((2**26,), "|u1"), 64), "536.9 MB, more than the 67.11 MB"),
    "raw.npz": (lambda: npz_bomb(b"", 1024), "magic string"),
    "header.npz": (lambda: npz_bomb(b"\x93NUMPY\x02\x00\xff\xff\xff\x3f", 1024), "array header"),
    "shape.npz": (
        lambda: npz({"phi.npy": header((10**12,)) + bytes(480)}),
        r"\(1000000000000,\).* holds 5\d\d",
    ),
    "axes.npz": (lambda: npz({"phi.npy": header(tuple(900 * [2])) + bytes(480)}), r"\(2700 characters\)"),
    "negative.npz": (lambda: npz({"phi.npy": header((-60,)) + bytes(480)}), r"shape '\(-60,\)'"),
    "words.npz": (lambda: npz({"phi.npy": header((1,), "<U99999999") + bytes(480)}), "holds 5"),
    "nested.npz": (lambda: npz({"phi.npy": header((60,)).replace(b"(60,)", 5 * b"(")}), "cannot be read"),
    "minus.npz": (
        lambda: npz({"phi.npy": header((60,)).replace(b"60", 9000 * b"-" + b"1")}),
        "cannot be read",
    ),
    "fields.npz": (
        lambda: npz({"phi.npy": npy(np.zeros(60, dtype=[("a", "f8")]))}),
        "cells or other objects",
    ),
    "objects.npz": (lambda: npz({"phi.npy": npy(np.array(60 * [None]))}), "Object arrays cannot be loaded"),
    "fortran.npz": (lambda: npz({"phi.npy": npy(np.asfortranarray(np.ones((60, 2))))}), r"shape \(60, 2\)"),
    "zip_in_zip.npz": (lambda: npz({"phi.npy": npz({})}), "magic string"),
    "lzma.npz": (lambda: npz({}, zipfile.ZIP_LZMA), "not compressed like"),
    "members.npz": (lambda: many_members(20_000), "more than 10000 members"),
    "array.npz": (lambda: header((10**12,)) + bytes(480), "one array without a name"),
    "bomb.mat": (lambda: mat(mat_bomb(512)), "more than 67.11 MB"),
    "false.mat": (lambda: mat(packed(bytes(2**27))), "more than 67.11 MB"),
    "dimensions.mat": (lambda: mat(variable(b"z", (10**9, 10**9), NUMBERS)), "more than 67.11 MB"),
    "negative.mat": (lambda: mat(variable(b"z", (-3, -1), NUMBERS)), "negative dimension"),
    "text.mat": (lambda: mat(variable(b"z", (1, 2 * 10**9), element(16, b""), 4)), "more than 67.11 MB"),
    "cells.mat": (lambda: mat(variable(b"z", (10**5, 10**5), b"", 1)), "more than 67.11 MB"),
    "structs.mat": (lambda: mat(variable(b"z", (10**5, 10**5), FIELDS, 2)), "more than 67.11 MB"),
    "objects.mat": (
        lambda: mat(variable(b"z", (10**5, 10**5), element(1, b"a") + FIELDS, 3)),
        "more than 67.11 MB",
    ),
    "nameless.mat": (
        lambda: mat(variable(b"z", (1, 1), element(5, bytes(4)) + element(1, b"a"), 2)),
        "no field names",
    ),
    "nested.mat": (lambda: mat(nested(3_000)), "nested more than"),
    "variables.mat": (
        lambda: mat(*(variable(f"v{i}".encode(), (3, 1), NUMBERS) for i in range(45_000))),
        "more than 200000 elements",
    ),
    "many_cells.mat": (
        lambda: mat(packed(variable(b"z", (10**6, 1), 10**6 * variable(b"", (0, 0), element(9, b"")), 1))),
        "more than (200000 elements|67.11 MB)",
    ),
    "dimensions_4.mat": (lambda: level_4(2**31 - 1, 2**31 - 1), "more than 67.11 MB"),
    "negative_4.mat": (lambda: level_4(-1, 20) + bytes(160), "no dimensions"),
    "nameless_4.mat": (lambda: level_4(1, 1, length=-20) + bytes(8), "no dimensions or no name"),
    "variables_4.mat": (lambda: 10**5 * level_4(0, 0), "more than 200000 elements"),
}
"""Contents by name, whose ending tells the format, and what the refusal says."""


def write(folder):
    """All of them."""
    for name, (make, _) in BOMBS.items():
        (folder / name).write_bytes(make())
    for name, (begin, size) in HOLES.items():
        with (folder / name).open("wb") as file:
            file.write(begin)
            file.truncate(size)


def main(folder):
    """Read every file of a folder; a line of JSON for each: name, outcome, seconds."""
    import resource

    from hybrid_mpc import InputError, load_trajectories

    def read(path):
        begin = time.process_time()
        try:
            load_trajectories([path], SIGNALS, SPEC, needed=())
            outcome = "read"
        except InputError as error:
            outcome = f"refused: {error}"
        return outcome, time.process_time() - begin

    for path, make in (
        (folder / "a.mat", savemat),
        (folder / "a.npz", lambda path, good: np.savez(path, **good)),
    ):
        make(path, GOOD)
        assert read(path)[0] == "read"  # what is loaded at the first use is loaded now
        path.unlink()
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for path in sorted(folder.iterdir()):
        print(json.dumps([path.name, *read(path)]), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
