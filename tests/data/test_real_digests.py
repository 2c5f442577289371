"""The real recordings are read to the same numbers, bit by bit, by every version of the reader."""

import hashlib
from pathlib import Path

import pytest

from hybrid_mpc.data.files import opened

SHARED = Path(__file__).parents[3] / "shared" / "data"
DIGESTS = {
    "cascaded_tanks": "60b9e80aed7ddc40",
    "coupled_drives": "e9fa14e0125635a0",
    "double_pendulum": "be98a058b3735883",
    "emps": "dfb21cd6d15a5c4d",
    "heat_exchanger": "f59b1ad279faf393",
    "quarter_drone": "3afe7abf9dd54528",
    "race_car": "9868e0125ba993a2",
    "temperature_lab": "1fc93f5a516de984",
    "torque_pendulum": "abe5650a7a3f60a6",
    "unbalanced_disk": "e2f3aee40e8e2c16",
    "xl330_pendulum": "b30941407f443824",
}  # fmt: skip
"""SHA-256, shortened, of names and numbers of all columns of a machine's files, in the order of their names."""


def digest(folder):
    """Of every column of every recording in a folder."""
    found = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        if path.suffix not in (".csv", ".npz", ".mat"):
            continue
        source = opened(path)
        for name in source.header:
            columns = source.read(None, [name], [name])
            assert not columns.problems
            found.update(f"{path.name} {name} {columns.place(0)}".encode())
            found.update((columns.values + 0.0).tobytes())  # a zero has no sign
    return found.hexdigest()[:16]


QUICK = ("cascaded_tanks", "coupled_drives", "emps", "quarter_drone", "unbalanced_disk")


@pytest.mark.parametrize(
    "machine", [name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in DIGESTS]
)
def test_real_recordings_have_the_numbers_that_they_had(machine):
    if not (SHARED / machine).is_dir():
        pytest.skip("the real recordings are not on this machine")
    assert digest(SHARED / machine) == DIGESTS[machine]
