import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid_mpc.data import read_csv, write_csv
from hybrid_mpc.data_spec import DataSpec, Window
from hybrid_mpc.errors import InputError
from hybrid_mpc.signals import Signal

SPEC = DataSpec("time_s", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2)
SIGNALS = {"outputs": (Signal("phi", "rad", -10, 10),), "inputs": (Signal("torque", "N m", -5, 5),)}
T = np.arange(60) * 0.01
GOOD = {"time_s": T, "tau": np.cos(T), "phi": np.sin(T), "note": T}


def lines(tmp_path):
    return write_csv(tmp_path / "run.csv", GOOD).read_text().splitlines()


def refused(tmp_path, text, match, spec=SPEC):
    path = tmp_path / "run.csv"
    path.write_text(text if isinstance(text, str) else "\n".join(text))
    with pytest.raises(InputError, match=match) as caught:
        read_csv(path, spec, **SIGNALS)
    assert "run.csv" in str(caught.value)


def test_round_trip_and_same_bytes(tmp_path):
    one, two = write_csv(tmp_path / "a.csv", GOOD), write_csv(tmp_path / "sub" / "b.csv", GOOD)
    assert one.read_bytes() == two.read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["a.csv"]  # no part file is left
    table = read_csv(one, SPEC, **SIGNALS)
    np.testing.assert_allclose(table.y[:, 0], np.sin(T), rtol=1e-9)  # ten digits are written
    np.testing.assert_allclose(table.u[:, 0], np.cos(T), rtol=1e-9)
    assert table.name == "a"


@pytest.mark.parametrize(
    ("cell", "match"),
    [
        ("nan", r"row 12, column 'phi' is 'nan'"),
        ("inf", r"row 12, column 'phi' is 'inf'"),
        ("abc", r"row 12, column 'phi' is 'abc'"),
        ("", r"row 12, column 'phi' is empty"),
        ("11", r"row 12, column 'phi': 11 is outside .* -10 to 10 rad"),
        ("90", r"degrees"),
    ],
)
def test_bad_cell_is_named_by_row_and_column(tmp_path, cell, match):
    rows = lines(tmp_path)
    cells = rows[11].split(",")
    rows[11] = ",".join([*cells[:2], cell, *cells[3:]])
    refused(tmp_path, rows, match)


def test_bad_files(tmp_path):
    rows = lines(tmp_path)
    refused(tmp_path, "", "empty")
    refused(tmp_path, rows[0], "0 row")
    refused(tmp_path, ["time_s,tau,ph,note", *rows[1:]], "no column 'phi'.*'note'.*Did you mean 'ph'")
    refused(tmp_path, ["time_s,tau,phi,phi", *rows[1:]], "appears 2 times")
    refused(tmp_path, [*rows[:5], rows[4], *rows[5:]], "row 6, column 'time_s': time repeats")
    refused(tmp_path, [*rows[:5], rows[3], *rows[5:]], "row 6, column 'time_s': time decreases")
    refused(tmp_path, [*rows[:5], "1,2", *rows[5:]], "row 6 has 2 cells")
    refused(tmp_path, rows[:30], "fewer than")
    refused(tmp_path, rows, "sampling is 0.01 s, declared max_gap", replace(SPEC, max_gap=0.005))
    late = replace(SPEC, windows={"run": (Window(0, 9, "train"),)})
    refused(tmp_path, rows, "window 0 to 9 s is not within", late)
    with pytest.raises(InputError, match=r"no such file; that folder has: run.csv"):
        read_csv(tmp_path / "walk.csv", SPEC, **SIGNALS)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2000), st.integers(0, 12), st.binary(max_size=6))
def test_damage_gives_an_input_error_or_finite_increasing_data(place, removed, inserted):
    with tempfile.TemporaryDirectory() as folder:
        path = write_csv(Path(folder) / "run.csv", GOOD)
        content = path.read_bytes()
        damaged = content[:place] + inserted + content[place + removed :]
        path.write_bytes(damaged)
        try:
            table = read_csv(path, SPEC, **SIGNALS)
        except InputError as error:
            assert "run.csv" in str(error)  # noqa: PT017  (both outcomes are right)
            return
        assert (np.diff(table.t) > 0).all()
        assert np.abs(table.y).max() <= 10
        assert math.isfinite(table.u.sum())
        # a few bytes touch a few rows: all others are read as they were written
        same = np.isin(np.round(table.t, 9), np.round(T, 9)).sum()
        assert same >= len(T) - 6
