"""``.npz`` and ``.mat`` files: the same data and the same checks as CSV."""

import io
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_array

from hybrid_mpc import DataSpec, InputError, Signal, Window, write_csv
from hybrid_mpc.data.mat_structure import check_structure, version
from hybrid_mpc.data.tables import read_table

SPEC = DataSpec("time_s", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2)
SIGNALS = {"outputs": (Signal("phi", "rad", -10, 10),), "inputs": (Signal("torque", "N m", -5, 5),)}
T = np.arange(60) * 0.01
GOOD = {"time_s": T, "tau": np.cos(T), "phi": np.sin(T), "note": np.eye(3)}
WRITERS = {
    "npz": lambda path, columns: np.savez(path, **columns),
    "mat": lambda path, columns: savemat(path, columns, do_compression=True),
}
FIRST = {"npz": ("index", 0), "mat": ("row", 1)}


@pytest.fixture(params=WRITERS)
def kind(request):
    return request.param


def wrote(tmp_path, kind, columns):
    path = tmp_path / f"run.{kind}"
    WRITERS[kind](path, columns)
    return path


def refused(path, match, spec=SPEC):
    with pytest.raises(InputError, match=match) as caught:
        read_table(path, spec, **SIGNALS)
    assert path.name in str(caught.value)


def test_same_numbers_as_from_csv(tmp_path, kind):
    columns = {name: column for name, column in GOOD.items() if column.ndim == 1}
    csv = read_table(write_csv(tmp_path / "run.csv", columns), SPEC, **SIGNALS)
    table = read_table(wrote(tmp_path, kind, GOOD), SPEC, **SIGNALS)
    assert table.name == "run"
    assert table.sha256 != csv.sha256
    for one, two in ((table.t, csv.t), (table.u, csv.u), (table.y, csv.y)):
        assert one.shape == two.shape
        np.testing.assert_allclose(one, two, rtol=1e-9)  # CSV is written with ten digits
    np.testing.assert_array_equal(table.y[:, 0], np.sin(T))


def test_integers_singles_and_either_direction_of_a_vector(tmp_path, kind):
    columns = {"time_s": T[:, None], "tau": np.arange(60, dtype=np.uint8)[None] % 3, "phi": np.float32(T)}
    table = read_table(wrote(tmp_path, kind, columns), SPEC, **SIGNALS)
    assert table.u.dtype == table.y.dtype == np.float64
    np.testing.assert_array_equal(table.u[:4, 0], [0, 1, 2, 0])


def test_a_single_number_as_time_is_the_sampling_time(tmp_path, kind):
    spec = replace(SPEC, time="Ts")
    table = read_table(wrote(tmp_path, kind, {**GOOD, "Ts": 0.01}), spec, **SIGNALS)
    np.testing.assert_allclose(table.t, T, atol=1e-15)  # the same product
    refused(wrote(tmp_path, kind, {**GOOD, "Ts": 0.0}), "as a sampling time .* must be positive", spec)


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("phi", np.nan, "column 'phi' is nan, not a finite number \\(1 such\\)"),
        ("tau", np.inf, "column 'tau' is inf"),
        ("phi", 11.0, "column 'phi': 11 is outside the plausible range -10 to 10 rad"),
        ("time_s", 0.1, "column 'time_s': time repeats"),
        ("time_s", 0.05, "column 'time_s': time decreases"),
        ("phi", 1e307, "column 'phi': 1e\\+307 is outside the plausible range -10 to 10 rad of phi. Check"),
    ],
)
def test_a_bad_number_is_named_as_the_files_own_tools_count(tmp_path, kind, name, value, match):
    columns = {key: column.copy() for key, column in GOOD.items()}
    columns[name][11] = value
    word, first = FIRST[kind]
    refused(wrote(tmp_path, kind, columns), rf"{word} {11 + first}, {match}")


def test_bad_columns(tmp_path, kind):
    without = {key: column for key, column in GOOD.items() if key != "phi"}
    for columns, match in (
        ({**without, "ph": T}, "no column 'phi'; it has .*'ph'.* Did you mean 'ph'"),
        ({**GOOD, "phi": T[:-1]}, "differ in length: 'time_s' 60, 'tau' 60, 'phi' 59"),
        ({**GOOD, "phi": np.ones((60, 2))}, r"column 'phi' has the shape \(60, 2\)"),
        ({**GOOD, "phi": T + 1j}, "'phi' holds complex numbers"),
        ({**GOOD, "phi": "text"}, "'phi' holds text"),
        ({**GOOD, "time_s": [], "tau": [], "phi": []}, "0 row"),
    ):
        refused(wrote(tmp_path, kind, columns), match)
    good = wrote(tmp_path, kind, GOOD)
    refused(good, "sampling is 0.01 s, declared max_gap", replace(SPEC, max_gap=0.005))
    refused(good, "not within the recording", replace(SPEC, windows={"run": (Window(0, 9, "train"),)}))


def test_objects_are_refused_and_never_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    path = tmp_path / "run.npz"
    objects = {**GOOD, "phi": np.array([Trap()], dtype=object)}
    np.savez(path, allow_pickle=True, **objects)
    refused(path, "column 'phi' cannot be read .*objects are refused")
    np.save(tmp_path / "one.npy", np.array([Trap()], dtype=object), allow_pickle=True)
    path.write_bytes((tmp_path / "one.npy").read_bytes())
    refused(path, "is no .npz file")
    assert not (tmp_path / "ran").exists()
    np.save(tmp_path / "one.npy", T)
    path.write_bytes((tmp_path / "one.npy").read_bytes())
    refused(path, "one array without a name")
    ignored = {**GOOD, "log": np.array([{}], dtype=object)}
    np.savez(path, allow_pickle=True, **ignored)
    assert read_table(path, SPEC, **SIGNALS).y.shape == (60, 1)  # what nobody names is not touched


def test_fields_of_structs(tmp_path):
    path = tmp_path / "run.mat"
    run = {"time_s": T, "tau": np.cos(T), "phi": np.sin(T), "deep": {"phi": T}}
    savemat(path, {"run": run})
    assert read_table(path, SPEC, **SIGNALS).y.shape == (60, 1)
    savemat(path, {"run": run, "old": {"phi": T}})
    refused(path, "column 'phi' may be 'run.phi' or 'old.phi'")
    table = read_table(path, replace(SPEC, outputs=("old.phi",)), **SIGNALS)
    np.testing.assert_array_equal(table.y[:, 0], T)
    refused(path, "no column 'deep.*Not read are structs in structs", replace(SPEC, outputs=("deep",)))
    two = np.array([(1.0,), (2.0,)], dtype=[("phi", object)])
    savemat(path, {"time_s": T, "tau": T, "runs": two, "sparse": csc_array(np.eye(3))})
    refused(path, "no column 'phi'.*Not read are arrays of structs and sparse matrices")


def test_hdf5_is_refused_with_what_to_type(tmp_path):
    path = tmp_path / "run.mat"
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM"
    path.write_bytes(header.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n" + bytes(100))
    refused(path, r"version 7.3 \(HDF5\).*save\('run.mat', ..., '-v7'\)")
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(600))
    refused(path, "version 7.3")


def test_no_such_format(tmp_path, kind):
    path = tmp_path / f"run.{kind}"
    for content in (b"time_s,tau,phi\n0,0,0\n", b"\xff" * 300, b"PK\x03\x04" + bytes(200), bytes(300)):
        path.write_bytes(content)
        refused(path, "damaged|empty|no column")
    path.write_bytes(b"")
    refused(path, "empty")
    whole = wrote(tmp_path, kind, GOOD).read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused(path, "damaged|cannot be read")
    path.rename(tmp_path / "run.csv")
    refused(tmp_path / "run.csv", "no UTF-8 text.*name the file .npz or .mat|cells|no column")
    refused(tmp_path / f"walk.{kind}", "no such file; that folder has: run.csv")


def test_bytes_that_crash_loadmat_are_refused_before_it(tmp_path):
    """Each of these ends the process in scipy 1.17: flags, type of the numbers, dimensions of a text."""
    text = io.BytesIO()
    savemat(text, {"t": T, "note": "ab"})
    whole = text.getvalue()
    assert version(whole) == "5"
    check_structure(whole, 10**6)
    path = tmp_path / "run.mat"
    size = whole.index(b"note") - 16  # the number of bytes of its dimensions
    for place, value in ((145, 255), (176, 0), (177, 255), (size, 0), (size, 14)):
        damaged = bytearray(whole)
        assert damaged[place] != value
        damaged[place] = value
        path.write_bytes(bytes(damaged))
        refused(path, "damaged")


@pytest.mark.parametrize("order", ["<", ">"])
def test_versions_and_byte_orders(order):
    mark = b"IM" if order == "<" else b"MI"
    for number, told in ((1, "5"), (2, "7.3")):
        pair = bytes([0, number]) if order == "<" else bytes([number, 0])
        assert version(b"MATLAB 5.0 MAT-file".ljust(124) + pair + mark) == told
    assert version(bytes(20)) == "4"


def test_damage_gives_an_input_error_or_finite_increasing_data(tmp_path, kind):
    rng = np.random.default_rng(0)
    whole = wrote(tmp_path, kind, GOOD).read_bytes()
    path, outcomes = tmp_path / f"run.{kind}", set()
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), 2):
            damaged[place] = rng.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            table = read_table(path, SPEC, **SIGNALS)
        except InputError as error:
            assert path.name in str(error)  # noqa: PT017  (both outcomes are right)
            outcomes.add("refused")
            continue
        assert (np.diff(table.t) > 0).all()
        np.testing.assert_array_equal(table.y[:, 0], np.sin(T))  # checksums: what is read is what was written
        outcomes.add("read")
    assert "refused" in outcomes
