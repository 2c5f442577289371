"""One recording read: the same data and the same checks from CSV, ``.npz`` and ``.mat``."""

import io
import math
import struct
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from machine_signals import machine
from recording_bombs import GOOD, SIGNALS, SPEC, T
from scipy.io import savemat
from scipy.sparse import csc_array

from hybrid_mpc import InputError, Signal, Window, write_csv
from hybrid_mpc.data.files import opened
from hybrid_mpc.data.matlab import leaves_of, version
from hybrid_mpc.data.recording import read_recording

MORE = {**GOOD, "note": T}
WRITERS = {
    "csv": write_csv,
    "npz": lambda path, columns: np.savez(path, **columns),
    "mat": lambda path, columns: savemat(path, columns, do_compression=True),
}
FIRST = {"csv": ("row", 2), "npz": ("index", 0), "mat": ("row", 1)}


@pytest.fixture(params=WRITERS)
def kind(request):
    return request.param


@pytest.fixture(params=["npz", "mat"])
def vectors(request):
    return request.param


def wrote(tmp_path, kind, columns):
    path = tmp_path / f"run.{kind}"
    WRITERS[kind](path, columns)
    return path


def refused(path, match, spec=SPEC, signals=SIGNALS):
    with pytest.raises(InputError, match=match) as caught:
        read_recording(path, signals, spec)
    assert path.name in str(caught.value)


def test_the_numbers_are_those_that_were_written(tmp_path, kind):
    path = wrote(tmp_path, kind, MORE)
    table = read_recording(path, SIGNALS, SPEC)
    assert table.name == "run"
    for read, written in ((table.t, T), (table.u[:, 0], np.cos(T)), (table.y[:, 0], np.sin(T))):
        np.testing.assert_allclose(read, written, rtol=1e-9 if kind == "csv" else 0)  # CSV has ten digits
    first = path.read_bytes()
    assert wrote(tmp_path, kind, {**MORE, "note": 2 * T}).read_bytes() != first
    assert read_recording(path, SIGNALS, SPEC).sha256 != table.sha256


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("tau", np.nan, "column 'tau' is '?nan'?, not a finite number"),
        ("time_s", np.nan, "column 'time_s' is '?nan'?, not a finite number"),
        ("phi", -np.inf, "column 'phi' is '?-inf"),
        ("tau", np.inf, "column 'tau' is '?inf"),
        ("phi", 10.21, r"column 'phi': 10\.21 is outside the plausible range -10 to 10 rad of phi\. Check"),
        ("phi", 11.0, r"column 'phi': 11 is outside the plausible range -10 to 10 rad of phi\. Check"),
        ("phi", 90.0, r"column 'phi': 90 is outside .*rad of phi\. Check"),  # one row is no wrong unit
        ("phi", 1e307, r"column 'phi': 1e\+307 is outside the plausible range -10 to 10 rad of phi\. Check"),
        ("time_s", 0.1, "column 'time_s': time repeats"),
        ("time_s", 0.05, "column 'time_s': time decreases"),
    ],
)
def test_a_bad_number_is_named_as_the_files_own_tools_count(tmp_path, kind, name, value, match):
    columns = {key: column.copy() for key, column in GOOD.items()}
    columns[name][11] = value
    word, first = FIRST[kind]
    refused(wrote(tmp_path, kind, columns), rf"{word} {11 + first}, {match}")


def test_noise_at_the_end_of_a_range_is_plausible(tmp_path, kind):
    phi = np.where(np.arange(60) == 11, 10.19, GOOD["phi"])  # within 1 % of the range of 20 rad
    assert read_recording(wrote(tmp_path, kind, {**GOOD, "phi": phi}), SIGNALS, SPEC).y[11, 0] == 10.19


def test_bad_columns(tmp_path, kind):
    path = wrote(tmp_path, kind, {"time_s": T, "tau": T, "ph": T, "note": T})
    refused(path, "HM-DATA-085")
    refused(wrote(tmp_path, kind, {name: np.zeros(0) for name in GOOD}), "0 row")
    refused(wrote(tmp_path, kind, {name: column[:30] for name, column in GOOD.items()}), "HM-DATA-074")
    path = wrote(tmp_path, kind, GOOD)
    refused(path, r"0\.01.*HM-DATA-073", replace(SPEC, max_gap=0.005))
    late = replace(SPEC, windows={"run": (Window(0, 9, "train"),)})
    refused(path, "window 0 to 9 s is not within the recording", late)
    path.rename(tmp_path / "walk.csv")
    refused(path, "HM-DATA-025")


@pytest.mark.parametrize(
    ("phi", "match"),
    [
        (np.rad2deg(np.sin(3 * T)), r"The values are plausible in deg: write units=\{'phi': 'deg'\}"),
        (
            np.where(np.arange(60) == 40, 1e307, np.rad2deg(np.sin(3 * T))),
            r"1e\+307 in row 42\)\. Check unit",
        ),
        (12 * np.sin(3 * T), r"of phi \(\d+ rows in all; the largest is 1\d.* in row \d+\)\. Check unit"),
        (1e7 * np.sin(3 * T), r"in row \d+\)\. Check unit"),
    ],
)
def test_a_unit_is_proposed_where_it_would_explain_the_column(tmp_path, phi, match):
    refused(wrote(tmp_path, "csv", {**GOOD, "phi": phi}), match)


@pytest.mark.parametrize(("name", "place", "row"), [("phi", 40, 42), ("time_s", 59, 61)])
def test_an_absurd_value_is_named_where_its_signal_has_no_range(tmp_path, name, place, row):
    free = machine((Signal("phi", "rad"),), (Signal("torque", "N m"),))
    columns = {**GOOD, name: np.where(np.arange(60) == place, 1e307, GOOD[name])}
    match = rf"row {row}, column '{name}': 1e\+307 is outside the plausible range -1e\+100"
    refused(wrote(tmp_path, "csv", columns), match, signals=free)


def test_bad_rows_of_csv(tmp_path):
    path = tmp_path / "run.csv"
    rows = write_csv(path, MORE).read_text().splitlines()

    def with_rows(changed):
        path.write_text("\n".join(changed.get(i, row) for i, row in enumerate(rows)))
        return path

    refused(with_rows({11: "0.1,1,abc,0"}), "row 12, column 'phi' is 'abc'")
    refused(with_rows({11: "0.1,,1,0"}), "row 12, column 'tau' is empty")
    refused(with_rows({0: "time_s,tau,phi,phi"}), "HM-DATA-083")
    refused(with_rows({5: "1,2", 6: "1,2"}), r"4 \(2 rows in all\).*HM-DATA-093")
    refused(with_rows({0: "time_s,ta,ph,note"}), "HM-DATA-085")
    several = {5: "0.04,broken,0.1,0", 11: "0.1,0.9,none,0", 12: "0.11,0.9,?,0", 20: "0.19,77,0.1,0"}
    refused(
        with_rows(several),
        r"3 problems:\n.*row 6, column 'tau' is 'broken'(.|\n)*row 13, column 'phi' is '\?'(.|\n)*"
        r"row 21, column 'tau': 77 is outside",
    )


def test_bad_vectors(tmp_path, vectors):
    for columns, match in (
        ({**GOOD, "phi": T[:-1]}, r"'time_s' 60, 'tau' 60, 'phi' 59.*HM-DATA-110"),
        ({**GOOD, "phi": np.ones((60, 2))}, "HM-DATA-112" if vectors == "npz" else "HM-DATA-085"),
        ({**GOOD, "phi": T + 1j}, r"'phi'.*complex numbers.*HM-DATA-111"),
        ({**GOOD, "phi": "text"}, r"'phi'.*text.*HM-DATA-111"),
        ({**GOOD, "time_s": 0.0}, "HM-DATA-113"),
    ):
        refused(wrote(tmp_path, vectors, columns), match)


def test_integers_singles_directions_and_a_sampling_time(tmp_path, vectors):
    columns = {"time_s": 0.01, "tau": np.arange(60, dtype=np.uint8)[None] % 3, "phi": np.float32(T)[:, None]}
    table = read_recording(wrote(tmp_path, vectors, columns), SIGNALS, SPEC)
    assert table.u.dtype == table.y.dtype == np.float64
    np.testing.assert_array_equal(table.u[:4, 0], [0, 1, 2, 0])
    np.testing.assert_allclose(table.t, T, atol=1e-15)  # the same product


def test_objects_are_refused_and_never_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    path, trap = tmp_path / "run.npz", np.array([Trap()], dtype=object)
    np.savez(path, allow_pickle=True, **{**GOOD, "phi": trap})
    refused(path, r"'phi'.*HM-DATA-107")
    for array, match in ((trap, "HM-DATA-105"), (T, "HM-DATA-105")):
        with path.open("wb") as file:
            np.save(file, array, allow_pickle=True)
        refused(path, match)
    assert not (tmp_path / "ran").exists()
    np.savez(path, allow_pickle=True, **GOOD, log=trap)
    assert read_recording(path, SIGNALS, SPEC).y.shape == (60, 1)  # what nobody names is not touched


def test_fields_of_structs(tmp_path):
    path = tmp_path / "run.mat"
    run = {**GOOD, "deep": {"phi": T}}
    savemat(path, {"run": run})
    assert read_recording(path, SIGNALS, SPEC).y.shape == (60, 1)
    savemat(path, {"run": run, "old": {"phi": T}})
    refused(path, r"'phi'.*'run\.phi' or 'old\.phi'.*HM-DATA-084")
    table = read_recording(path, SIGNALS, replace(SPEC, outputs=("old.phi",)))
    np.testing.assert_array_equal(table.y[:, 0], T)
    assert read_recording(path, SIGNALS, replace(SPEC, outputs=("deep.phi",))).y.shape == (60, 1)
    many = np.array([(1.0,)] * 101, dtype=[("phi", object)])
    savemat(path, {"time_s": T, "tau": T, "runs": many, "sparse": csc_array(np.eye(3))})
    refused(path, "HM-DATA-085")


def test_no_such_format(tmp_path, vectors):
    path = tmp_path / f"run.{vectors}"
    for content in (b"time_s,tau,phi\n0,0,0\n", b"\xff" * 300, b"PK\x03\x04" + bytes(200), bytes(300)):
        path.write_bytes(content)
        refused(path, "damaged|empty|no column")
    path.write_bytes(b"")
    refused(path, "empty")
    whole = wrote(tmp_path, vectors, GOOD).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused(path, "damaged|cannot be read")
    path.rename(tmp_path / "run.csv")
    refused(tmp_path / "run.csv", "not text|damaged")


@pytest.mark.parametrize("packed", [False, True])
def test_numbers_of_every_kind_of_mat(tmp_path, packed):
    path = tmp_path / "run.mat"
    kinds = [np.dtype(kind) for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")]
    given = {f"v{k}": (100 * np.sin(np.arange(70) + k)).astype(kind) for k, kind in enumerate(kinds)}
    given["v1"][:] = np.arange(70)
    savemat(
        path,
        {**given, "grid": np.arange(140.0).reshape(70, 2), "z": 1j + np.arange(70)},
        do_compression=packed,
    )
    source = opened(path)
    for name, values in given.items():
        np.testing.assert_array_equal(source.read(None, [name], ()).values[:, 0], values.astype(float))
    np.testing.assert_array_equal(source.read(None, ["grid(:,2)"], ()).values[:, 0], 2 * np.arange(70) + 1)
    with pytest.raises(InputError, match=r"'z'.*complex numbers.*HM-DATA-111"):
        source.read(None, ["z"], ())


def test_bytes_that_crash_loadmat_are_refused_before_it(tmp_path):
    """Each of these ends the process in scipy 1.17: flags, type of the numbers, dimensions of a text."""
    text = io.BytesIO()
    savemat(text, {"t": T, "note": "ab"})
    whole = text.getvalue()
    assert version(whole) == "5"
    leaves_of(whole, 10**6)
    path = tmp_path / "run.mat"
    size = whole.index(b"note") - 16  # the number of bytes of its dimensions
    for place, value in ((145, 255), (176, 0), (177, 255), (size, 0), (size, 14)):
        damaged = bytearray(whole)
        assert damaged[place] != value
        damaged[place] = value
        path.write_bytes(bytes(damaged))
        refused(path, "damaged")


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2000), st.integers(0, 12), st.binary(max_size=6))
def test_damaged_csv_is_an_input_error_or_finite_increasing_data(place, removed, inserted):
    with tempfile.TemporaryDirectory() as folder:
        path = write_csv(Path(folder) / "run.csv", MORE)
        content = path.read_bytes()
        path.write_bytes(content[:place] + inserted + content[place + removed :])
        try:
            table = read_recording(path, SIGNALS, SPEC)
        except InputError as error:
            assert "run.csv" in str(error)  # noqa: PT017  (both outcomes are right)
            return
        assert (np.diff(table.t) > 0).all()
        assert not (np.abs(table.y) > 10).any()  # a blank cell is a missing sample
        assert math.isfinite(table.u.sum())
        # a few bytes touch a few rows: all others are read as they were written
        same = np.isin(np.round(table.t, 9), np.round(T, 9)).sum()
        assert same >= len(T) - 6


def test_damaged_vectors_are_an_input_error_or_what_was_written(tmp_path, vectors):
    rng = np.random.default_rng(0)
    whole = wrote(tmp_path, vectors, GOOD).read_bytes()
    path, outcomes = tmp_path / f"run.{vectors}", set()
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), 2):
            damaged[place] = rng.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            table = read_recording(path, SIGNALS, SPEC)
        except InputError as error:
            assert path.name in str(error)  # noqa: PT017  (both outcomes are right)
            outcomes.add("refused")
            continue
        np.testing.assert_array_equal(table.t, T)  # checksums: what is read is what was written
        np.testing.assert_array_equal(table.y[:, 0], np.sin(T))
        outcomes.add("read")
    assert "refused" in outcomes


@pytest.mark.parametrize(
    ("cell", "match"),
    [
        ("ON", "a word such as on"), ("2 V", r"a unit.*'name \[V\]'"),
        ("5m/s", "a unit"), ('"1,5"', "a decimal comma"), ('"1.200,5"', "a thousands separator"),
        ("2024-01-31 10:00:00", "a date or a time"),
        ("31.01.2024", "a date or a time"), ("31-Jan-2024 10:00:00", "a date or a time"),
        ("10:00:00.5", "a date or a time"), ("abc", "Correct the value"), ("0x1f", "Correct the value"),
    ],
)  # fmt: skip
def test_a_cell_that_is_no_number_is_named_with_what_it_is(tmp_path, cell, match):
    path = tmp_path / "run.csv"
    rows = write_csv(path, GOOD).read_text().splitlines()
    rows[30] = f"0.29,{cell},0.1"
    path.write_text("\n".join(rows))
    refused(path, f"row 31, column 'tau' is .* not a finite number.*{match}")


@pytest.mark.parametrize("tail", ["Mean,1,2", "0.9,,", "", "# end"])
@pytest.mark.parametrize("note", [False, True])
def test_a_header_stays_one_whatever_stands_below(tmp_path, tail, note):
    """Names of many kinds over rows with text, an odd last row, or few rows: the columns are there."""
    path = tmp_path / "run.csv"
    rows = [f"{k},{0.5 * k},{k + 1}" + ",a long note" * note for k in range(30)]
    for header in ("time_s,tau,phi", "1,tau [2 V],0 x", "phase 1,2024,3", '"a\n1",b,c', "x y z,2 x,nan"):
        for body in ([*rows, tail + ",ok" * (note and "," in tail)], rows[:1], []):
            path.write_text("\n".join([header + ",note" * note, *body]))
            assert len(opened(path).header) == 3 + note


def opaque(name):
    """An object as MATLAB writes it in level 5: class 17, names and a reference of numbers."""

    def element(kind, content):
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    numbers = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 2, 1)) + element(1, b"")
    numbers += element(6, struct.pack("<II", 0xDD000000, 2))
    texts = b"".join(element(1, text) for text in (name.encode(), b"MCOS", b"timeseries"))
    return element(14, element(6, struct.pack("<II", 17, 0)) + texts + element(14, numbers))


def test_vectors_beside_objects_are_read_and_the_objects_named(tmp_path):
    path = tmp_path / "run.mat"
    savemat(path, {"time_s": T, "tau": np.cos(T)})
    path.write_bytes(path.read_bytes() + opaque("phi") + opaque("stamp"))
    refused(path, "HM-DATA-085")
    table = read_recording(path, SIGNALS, replace(SPEC, inputs=("time_s",), time=0.01, outputs=("tau",)))
    np.testing.assert_array_equal(table.y[:, 0], np.cos(T))
