"""Bad input ends with exit code 2 and a message that names file, row or field, and a remedy; nothing is left."""

import numpy as np
import pytest

from .conftest import recording, write


def rows(columns):
    """CSV lines of columns."""
    names = list(columns)
    return [
        ",".join(names),
        *(",".join(f"{columns[n][k]:.8g}" for n in names) for k in range(len(columns["time_s"]))),
    ]


def nan(lines):
    lines[500] = "4.99,nan,0.1"


def text(lines):
    lines[500] = "4.99,0.1,broken"


def repeated(lines):
    lines[500] = lines[499]


def decreasing(lines):
    lines[500], lines[600] = lines[600], lines[500]


def no_column(lines):
    lines[0] = "time_s,torque,phi_rad"


def short(lines):
    del lines[40:]


def coarse(lines):
    del lines[1:]
    lines += [f"{0.2 * k:.2f},0.1,{np.sin(0.2 * k):.4f}" for k in range(400)]


def degrees(lines):
    lines[1:] = [f"{0.01 * k:.2f},0.1,{40 * np.sin(0.01 * k):.4f}" for k in range(2000)]


def empty(lines):
    lines.clear()


def idle(lines):
    lines[1:] = [f"{0.01 * k:.2f},0.1,{0.3 * np.sin(0.01 * k):.4f}" for k in range(2000)]


def still(lines):
    lines[1:] = [f"{0.01 * k:.2f},{0.1 * np.sin(0.01 * k):.4f},0.3" for k in range(2000)]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (nan, ["bad.csv", "row 501", "tau_nm"]),
        (text, ["bad.csv", "row 501", "phi_rad", "broken"]),
        (repeated, ["bad.csv", "row 501", "time_s"]),
        (decreasing, ["bad.csv", "time_s"]),
        (no_column, ["bad.csv", "tau_nm", "torque"]),
        (short, ["bad.csv", "s"]),
        (coarse, ["bad.csv", "max_gap"]),
        (degrees, ["bad.csv", "phi", "In deg it would be plausible", "units={'phi_rad': 'deg'}"]),
        (empty, ["bad.csv", "empty"]),
        (idle, ["bad", "tau", "0.1 throughout"]),
        (still, ["bad", "phi", "never moved"]),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_bad_recordings(call, machine, tmp_path, damage, words):
    lines = rows(recording(5))
    damage(lines)
    bad, out = tmp_path / "bad.csv", tmp_path / "out"
    bad.write_text("\n".join(lines) + "\n" if lines else "")
    code, _, message = call("run", machine / "my_machine.py", "--data", bad, "--out", out)
    assert code == 2
    for word in words:
        assert word in message
    assert not out.exists()


def test_missing_file_and_missing_data(call, machine, tmp_path):
    code, _, message = call(
        "run", machine / "my_machine.py", "--data", tmp_path / "none.csv", "--out", tmp_path / "o"
    )
    assert code == 2
    assert "none.csv" in message
    code, _, message = call("run", machine / "my_machine.py", "--out", tmp_path / "o")
    assert code == 2
    assert "--data" in message
    assert not (tmp_path / "o").exists()


def test_unknown_scenario_and_budget(call, machine, tmp_path):
    code, _, message = call("run", "golf_robott", "--out", tmp_path / "o")
    assert code == 2
    assert "golf_robot" in message
    data = machine / "monday.csv"
    code, _, message = call(
        "run", machine / "my_machine.py", "--data", data, "--budget", "huge", "--out", tmp_path / "o"
    )
    assert code == 2
    assert "huge" in message
    assert "quick" in message


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("x = 1\n", ["defines no variable 'scenario'"]),
        ("scenario = 3\n", ["must be a hybrid_mpc Scenario"]),
        ("import numpy\nscenario = unknown\n", [":2", "NameError"]),
        ("def broken(:\n", [":1", "SyntaxError"]),
        (
            "from hybrid_mpc import DataSpec, Scenario\n"
            "spec = DataSpec('t', ('u',), ('y',), dt=0.02, max_gap=0.1, smoothing=0.1, warm_up=0.5)\n"
            "scenario = Scenario('mine', 'Mine', '', prior=None, data=spec)\n",
            ["has no prior"],
        ),
    ],
)
def test_bad_scenario_files(call, tmp_path, source, words):
    path = tmp_path / "machine.py"
    path.write_text(source)
    code, _, message = call("run", path, "--out", tmp_path / "o")
    assert code == 2
    for word in words:
        assert word in message
    assert not (tmp_path / "o").exists()


def test_columns_by_option(call, machine, tmp_path):
    """Options name other columns; a wrong one is answered with those that there are."""
    renamed = dict(zip(("t", "torque", "angle"), recording(6).values(), strict=True))
    data = write(tmp_path / "renamed.csv", renamed)
    options = ["--time-column", "t", "--input-column", "torque", "--output-column", "angel"]
    code, _, message = call(
        "run", machine / "my_machine.py", "--data", data, "--out", tmp_path / "o", *options
    )
    assert code == 2
    assert "'angle'" in message


def test_ctrl_c_says_how_to_go_on(call, arguments, tmp_path, monkeypatch):
    from hybrid_mpc.job import run as job

    def stopped(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "run", stopped)
    code, _, told = call(*arguments, "--out", tmp_path / "run")
    assert code == 130
    assert "--resume" in told
