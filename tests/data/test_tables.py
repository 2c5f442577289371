import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid_mpc import DataSpec, InputError, Signal, Window, write_csv
from hybrid_mpc.data.tables import read_table

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
        read_table(path, spec, **SIGNALS)
    assert "run.csv" in str(caught.value)


def test_round_trip_and_same_bytes(tmp_path):
    one, two = write_csv(tmp_path / "a.csv", GOOD), write_csv(tmp_path / "sub" / "b.csv", GOOD)
    assert one.read_bytes() == two.read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["a.csv"]  # no part file is left
    table = read_table(one, SPEC, **SIGNALS)
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
        ("1e307", r"row 12, column 'phi': 1e\+307 is outside .* -10 to 10 rad of phi\. Check"),
        (
            "90",
            r"row 12, column 'phi': 90 is outside .* -10 to 10 rad of phi\. Check",
        ),  # one row is no wrong unit
    ],
)
def test_bad_cell_is_named_by_row_and_column(tmp_path, cell, match):
    rows = lines(tmp_path)
    cells = rows[11].split(",")
    rows[11] = ",".join([*cells[:2], cell, *cells[3:]])
    refused(tmp_path, rows, match)


def test_a_unit_is_proposed_where_it_would_explain_the_column(tmp_path):
    write = lambda phi: write_csv(tmp_path / "run.csv", {**GOOD, "phi": phi}).read_text()  # noqa: E731
    degrees = np.rad2deg(np.sin(3 * T))
    refused(tmp_path, write(degrees), r"In deg it would be plausible: say units=\{'phi': 'deg'\}")
    absurd = np.where(np.arange(60) == 40, 1e307, degrees)
    refused(tmp_path, write(absurd), r"the largest 1e\+307 in row 42\)\. Check unit")  # in no unit
    refused(
        tmp_path,
        write(12 * np.sin(3 * T)),
        r"of phi \(\d+ such rows, the largest 1\d.* in row \d+\)\. Check unit",
    )
    refused(tmp_path, write(1e7 * np.sin(3 * T)), r"in row \d+\)\. Check unit")


def test_an_absurd_value_is_named_where_its_signal_has_no_range(tmp_path):
    columns = {**GOOD, "phi": np.where(np.arange(60) == 40, -1e307, np.sin(T))}
    path = write_csv(tmp_path / "run.csv", columns)
    free = {"outputs": (Signal("phi", "rad"),), "inputs": (Signal("torque", "N m"),)}
    with pytest.raises(
        InputError, match=r"row 42, column 'phi': -1e\+307 is outside the plausible range -1e\+100"
    ):
        read_table(path, SPEC, **free)
    write_csv(path, {**columns, "phi": np.sin(T), "time_s": np.where(np.arange(60) == 59, 1e307, T)})
    with pytest.raises(InputError, match=r"row 61, column 'time_s': 1e\+307"):
        read_table(path, SPEC, **free)


def test_all_that_is_wrong_with_a_file_is_told_at_once(tmp_path):
    rows = lines(tmp_path)
    rows[5] = "0.04,broken,0.1,0"
    rows[11], rows[12] = "0.1,0.9,nan,0", "0.11,0.9,,0"
    rows[20] = "0.19,77,0.1,0"
    refused(
        tmp_path,
        rows,
        r"3 problems:\n.*row 6, column 'tau' is 'broken'(.|\n)*row 12, column 'phi' is 'nan'.*\(2 such rows\)(.|\n)*"
        r"row 21, column 'tau': 77 is outside",
    )
    refused(
        tmp_path, ["time_s,ta,ph,note", *rows[1:]], r"2 problems:\n.*no column 'tau'.*\n.*no column 'phi'"
    )
    refused(tmp_path, [*rows[:5], "1,2", "1,2", *rows[7:]], r"row 6 has 2 cells, .* has 4 \(2 such rows\)")


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
        read_table(tmp_path / "walk.csv", SPEC, **SIGNALS)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2000), st.integers(0, 12), st.binary(max_size=6))
def test_damage_gives_an_input_error_or_finite_increasing_data(place, removed, inserted):
    with tempfile.TemporaryDirectory() as folder:
        path = write_csv(Path(folder) / "run.csv", GOOD)
        content = path.read_bytes()
        damaged = content[:place] + inserted + content[place + removed :]
        path.write_bytes(damaged)
        try:
            table = read_table(path, SPEC, **SIGNALS)
        except InputError as error:
            assert "run.csv" in str(error)  # noqa: PT017  (both outcomes are right)
            return
        assert (np.diff(table.t) > 0).all()
        assert np.abs(table.y).max() <= 10
        assert math.isfinite(table.u.sum())
        # a few bytes touch a few rows: all others are read as they were written
        same = np.isin(np.round(table.t, 9), np.round(T, 9)).sum()
        assert same >= len(T) - 6
