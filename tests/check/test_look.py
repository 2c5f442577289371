"""``hybrid-mpc data FILE``: what is in a file, in one look."""

from functools import partial

import numpy as np
import pytest

from hybrid_mpc import write_csv
from hybrid_mpc.check.look import look, picture


@pytest.fixture
def call(call):
    """Run the command in this process: ``(exit code, stdout, stderr)``."""
    return partial(call, "data")


T = np.r_[0.01 * np.arange(100), 5 + 0.01 * np.arange(100)]
U = np.sin(T)
Y = np.where(np.arange(200) % 9, np.cos(T), np.nan)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "run.csv"
    write_csv(
        path,
        {
            "time [s]": T,
            "u [V]": U,
            "level_mm": Y,
            "code": np.where(np.arange(200) == 7, -9999, U),
            "k": 0 * T,
        },
    )
    path.write_text(
        "Logger 5\n\n" + path.read_text().replace("nan", "", 99).replace("level_mm", "level [mm]")
    )
    return path


def test_a_look_says_columns_time_gaps_and_what_stands_out(file):
    found = look(file)
    assert (found.rows, [one.name for one in found.columns]) == (
        200,
        ["time [s]", "u [V]", "level [mm]", "code", "k"],
    )
    time, u, level, code, k = found.columns
    assert (time.note, u.unit, level.unit, level.count, k.note) == ("time", "V", "mm", 177, "constant")
    assert abs(float(u.high) - U.max()) < 0.01 * np.ptp(U)
    assert code.count == 200
    told = "\n".join(found.findings)
    for words in ("-9999 in 1 row", "gaps in the time: 1", "4.01 s before row 104"):
        assert words in told
    assert "header in row 3" in " ".join(found.notes)
    np.testing.assert_allclose(found.t, T, rtol=1e-9)
    assert len(picture(found).axes) == 3


def test_the_command_prints_it_and_opens_a_picture(call, file, monkeypatch):
    opened = []
    monkeypatch.setattr("typer.launch", opened.append)
    code, said, _ = call(file)
    assert code == 0
    for words in (
        "200 rows, 5 columns",
        "sampled every 0.01 s",
        "header in row 3",
        "code for missing values",
    ):
        assert words in said
    assert not opened
    code, said, _ = call(file, "--plot")
    (path,) = opened
    assert (code, path in said.replace("\n", "")) == (0, True)


def test_what_cannot_be_read_is_refused_and_a_file_without_a_time_is_not(call, tmp_path):
    assert call(tmp_path / "none.csv")[0] == 2
    assert call("golf_robot")[0] == 2
    np.savez(tmp_path / "a.npz", u=U, y=np.cos(T), name=np.array("text"))
    code, said, _ = call(tmp_path / "a.npz")
    assert (code, "text" in said) == (0, True)
