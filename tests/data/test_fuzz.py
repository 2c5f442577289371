"""Recordings of any content: read, or refused with an InputError that names the file; nothing else, and no warning."""

import io
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from machine_signals import machine
from recording_bombs import GOOD, SIGNALS, SPEC
from scipy.io import savemat

from hybrid_mpc import DataSpec, InputError, Signal, load_trajectories

STRANGE = (
    0.0, -0.0, 5e-324, -1e-300, 1e-9, 1.0, 6.283, 1e9, -1e99, 1e101, 1e200, 1.7e308, np.inf, -np.inf, np.nan,
)  # fmt: skip
PHI = Signal("phi", "rad", periodic=True)
ANY = machine((PHI,), (Signal("torque", "N m"),), (PHI, Signal("phi_dot", "rad/s", -30, 30)))


def to_csv(columns):
    rows = np.column_stack(list(columns.values()))
    return "\n".join([",".join(columns), *(",".join(f"{x:.17g}" for x in row) for row in rows)]).encode()


def saved(write, columns, **options):
    file = io.BytesIO()
    write(file, columns, **options)
    return file.getvalue()


def saved_npz(columns, write=np.savez):
    return saved(lambda file, columns: write(file, **columns), columns)


MAKERS = {
    "csv": ("csv", to_csv),
    "npz": ("npz", saved_npz),
    "packed npz": ("npz", lambda columns: saved_npz(columns, np.savez_compressed)),
    "mat": ("mat", lambda columns: saved(savemat, columns)),
    "packed mat": ("mat", lambda columns: saved(savemat, columns, do_compression=True)),
    "struct": ("mat", lambda columns: saved(savemat, {"run": {**columns, "note": "a", "deep": {"x": 1.0}}})),
    "level 4": ("mat", lambda columns: saved(savemat, columns, format="4")),
}


def tried(ending, content, spec=SPEC, signals=SIGNALS):
    """``"read"`` or ``"refused"``; anything else fails."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        path = Path(folder) / f"run.{ending}"
        path.write_bytes(content)
        try:
            data = load_trajectories([path], signals, spec, needed=())
        except InputError as error:
            assert "run" in str(error)  # noqa: PT017  (both outcomes are right)
            assert len(str(error)) < 5000  # noqa: PT017
            return "refused"
    for run in data.whole:
        assert np.isfinite(run.t).all()
        assert np.isfinite(run.u).all()
        for array in (run.y, run.x, run.xdot):
            assert not np.isinf(array).any()
        if not any(finding.kind == "missing" for finding in data.findings):
            for array in (run.y, run.x, run.xdot):
                assert np.isfinite(array).all()
    for finding in data.findings:
        assert str(finding).startswith(f"run.{ending}: ")
        assert finding.count > 0
    return "read"


def mutated(content, rng, times):
    """Bytes changed, cut out, put in and doubled."""
    damaged = bytearray(content)
    for _ in range(times):
        place, kind = int(rng.integers(0, max(1, len(damaged)))), rng.integers(0, 4)
        if kind == 0 and damaged:
            damaged[place] = rng.integers(256)
        elif kind == 1:
            del damaged[place : place + int(rng.integers(1, 40))]
        elif kind == 2:
            damaged[place:place] = rng.integers(0, 256, int(rng.integers(1, 10)), dtype=np.uint8).tobytes()
        else:
            damaged[place:place] = damaged[place : place + int(rng.integers(1, 200))]
    return bytes(damaged)


def strange(rng, rows):
    """A table of which some parts are sound and others are anything."""
    t = 0.01 * np.arange(rows)
    columns = {
        "time_s": t,
        "tau": np.cos(7 * t),
        "phi": np.sin(3 * t) * rng.choice([1e-12, 1.0, 3.0, 1e6, 1e90]),
    }
    for name in columns:
        kind = rng.integers(0, 6)
        places = rng.integers(0, max(1, rows), rng.integers(0, 4)) if rows else []
        if kind == 1:
            columns[name][places] = rng.choice(STRANGE, len(places))
        elif kind == 2:
            columns[name] = columns[name] * rng.choice(STRANGE)
        elif kind == 3 and len(places):
            columns[name][places[0] :] = columns[name][places[0]]
        elif kind == 4:
            columns[name] = np.round(columns[name], int(rng.integers(0, 4)))
    if rng.integers(0, 3) == 0:
        columns["phi"] = (columns["phi"] + np.pi) % (2 * np.pi) - np.pi
    if rng.integers(0, 4) == 0:
        columns["time_s"] = np.cumsum(rng.choice([1e-9, 0.001, 0.01, 0.04, 0.06, 3.0], rows))
    return {name: np.nan_to_num(column) if rng.integers(0, 3) else column for name, column in columns.items()}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", MAKERS)
def test_damaged_files(name):
    ending, make = MAKERS[name]
    assert tried(ending, make(GOOD)) == "read"
    rng = np.random.default_rng(1)
    outcomes = [tried(ending, mutated(make(GOOD), rng, 1 + k % 4)) for k in range(24)]
    assert "refused" in outcomes


def test_a_text_that_holds_nothing_but_its_mark():
    for mark in ("\ufeff", "\ufeff\n", "\ufeff  \t\n"):
        assert tried("csv", mark.encode()) == tried("csv", mark.encode("utf-16")) == "refused"


@pytest.mark.parametrize("name", ["csv", "npz", "mat"])
def test_strange_tables(name):
    ending, make = MAKERS[name]
    rng = np.random.default_rng(2)
    with np.errstate(all="ignore"):
        tables = [strange(rng, int(rng.integers(0, 300))) for _ in range(30)]
    outcomes = [tried(ending, make(table), signals=ANY) for table in tables]
    assert {"read", "refused"} <= set(outcomes)


FUZZ = settings(max_examples=500, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.mark.full
@FUZZ
@given(st.sampled_from(sorted(MAKERS)), st.integers(0, 2**32), st.integers(1, 30))
def test_any_damage(name, seed, times):
    ending, make = MAKERS[name]
    tried(ending, mutated(make(GOOD), np.random.default_rng(seed), times))


@pytest.mark.full
@FUZZ
@given(st.sampled_from(["csv", "npz", "packed mat", "level 4"]), st.integers(0, 2**32), st.integers(0, 400))
def test_any_table(name, seed, rows):
    ending, make = MAKERS[name]
    with np.errstate(all="ignore"):
        table = strange(np.random.default_rng(seed), rows)
    tried(ending, make(table), signals=ANY)


@pytest.mark.full
@FUZZ
@given(
    st.text(alphabet=st.sampled_from("0123456789.,;-+eE_ \t\"'\r\n\x00nainf\ufeffµ²٣"), max_size=400),
    st.booleans(),
)
def test_any_text(text, with_header):
    tried("csv", (("time_s,tau,phi\n" if with_header else "") + text).encode())


LENGTH = st.floats(1e-6, 1e3)


@pytest.mark.full
@FUZZ
@given(st.lists(st.tuples(*3 * [st.floats(width=64)]), max_size=60), LENGTH, LENGTH, LENGTH, LENGTH)
def test_any_numbers_and_lengths(rows, dt, max_gap, smoothing, warm_up):
    spec = DataSpec("time_s", ("tau",), ("phi",), dt, max_gap, smoothing, warm_up)
    table = np.array(rows).reshape(len(rows), 3)
    table[:, 0] = np.sort(table[:, 0])
    tried("npz", saved_npz(dict(zip(GOOD, table.T, strict=True))), spec, ANY)


@pytest.mark.full
@FUZZ
@given(
    st.binary(max_size=600),
    st.sampled_from(["csv", "npz", "mat"]),
    st.sampled_from([b"", b"PK\3\4", b"\x93NUMPY"]),
)
def test_any_bytes(content, ending, begin):
    tried(ending, begin + content)
    tried(ending, b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + content)
