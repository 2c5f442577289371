"""Bad input ends with exit code 2 and a message that names file, row or field, and a remedy; nothing is left."""

import sys

import numpy as np
import pytest
from machine_runs import recording, write

from hybrid_mpc import load_scenario


def rows(columns):
    """CSV lines of columns."""
    names = list(columns)
    return [
        ",".join(names),
        *(",".join(f"{columns[n][k]:.8g}" for n in names) for k in range(len(columns["time_s"]))),
    ]


def replaced(row):
    """The lines with another row 501."""
    return lambda lines: [*lines[:500], row, *lines[501:]]


def made(n, dt, u, phi):
    """The header, and n rows of functions of time."""
    return lambda lines: [lines[0], *(f"{t:.2f},{u(t):.4f},{phi(t):.4f}" for t in dt * np.arange(n))]


def constant(t):
    return 0.1


DAMAGE = {
    "nan": (replaced("4.99,nan,0.1"), ["bad.csv", "row 501", "tau_nm"]),
    "text": (replaced("4.99,0.1,broken"), ["bad.csv", "row 501", "phi_rad", "broken"]),
    "repeated": (replaced("4.98,0.7,0.9"), ["bad.csv", "row 501", "time_s"]),
    "decreasing": (lambda lines: [*lines[:500], lines[600], *lines[501:]], ["bad.csv", "time_s"]),
    "no_column": (lambda lines: ["time_s,torque,phi_rad", *lines[1:]], ["bad.csv", "tau_nm", "torque"]),
    "short": (lambda lines: lines[:40], ["bad.csv", "s"]),
    "coarse": (made(400, 0.2, constant, np.sin), ["bad.csv", "max_gap"]),
    "degrees": (made(2000, 0.01, constant, lambda t: 40 * np.sin(t)),
                ["bad.csv", "phi", "units={'phi_rad': 'deg'}"]),
    "empty": (lambda lines: [], ["bad.csv", "empty"]),
    "idle": (made(2000, 0.01, constant, lambda t: 0.3 * np.sin(t)), ["bad", "tau", "0.1", "HM-DATA-021"]),
    "still": (made(2000, 0.01, lambda t: 0.1 * np.sin(t), lambda t: 0.3), ["bad", "phi", "never moved"]),
}  # fmt: skip


def refused(call, out, words, *command):
    """A command ends with exit code 2 and a message of these words, and makes no folder."""
    code, _, message = call("run", *command, "--out", out)
    assert code == 2
    for word in words:
        assert word in message
    assert not out.exists()


@pytest.mark.parametrize(("damage", "words"), DAMAGE.values(), ids=DAMAGE)
def test_bad_recordings(call, machine, tmp_path, damage, words):
    lines = damage(rows(recording(5)))
    bad = tmp_path / "bad.csv"
    bad.write_text("\n".join(lines) + "\n" if lines else "")
    refused(call, tmp_path / "out", words, machine / "my_machine.py", "--data", bad)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["MACHINE", "--data", "none.csv"], ["none.csv"]),
        (["MACHINE"], ["--data"]),
        (["golf_robott"], ["golf_robot"]),
        (["MACHINE", "--data", "DATA", "--budget", "huge"], ["huge", "quick"]),
    ],
)
def test_what_is_not_there(call, machine, tmp_path, command, words):
    there = {"MACHINE": machine / "my_machine.py", "DATA": machine / "monday.csv"}
    refused(call, tmp_path / "out", words, *(there.get(word, word) for word in command))


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
            ["prior: a callable"],
        ),
    ],
)
def test_bad_scenario_files(call, tmp_path, source, words):
    path = tmp_path / "machine.py"
    path.write_text(source)
    refused(call, tmp_path / "o", words, path)


def test_a_machine_s_file_may_import_one_beside_it(machine, tmp_path, monkeypatch):
    """Its plant, say. Installed modules come first: a file cannot take their place."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "rig_of_mine.py").write_text("TITLE = 'From beside'\n")
    (tmp_path / "casadi.py").write_text("raise RuntimeError('not this one')\n")
    source = "import casadi\nfrom dataclasses import replace\nfrom rig_of_mine import TITLE\n"
    source += (machine / "my_machine.py").read_text() + "\nscenario = replace(scenario, title=TITLE)\n"
    path = tmp_path / "machine.py"
    path.write_text(source)
    assert load_scenario(str(path)).title == "From beside"
    assert sys.path[-1] == str(tmp_path)


def test_columns_by_option(call, machine, tmp_path):
    """Options name other columns; a wrong one is answered with those that there are."""
    renamed = dict(zip(("t", "torque", "angle"), recording(6).values(), strict=True))
    data = write(tmp_path / "renamed.csv", renamed)
    options = ["--time-column", "t", "--input-column", "torque", "--output-column", "angel"]
    refused(call, tmp_path / "o", ["'angle'"], machine / "my_machine.py", "--data", data, *options)


def test_ctrl_c_says_how_to_go_on(call, arguments, tmp_path, monkeypatch):
    from hybrid_mpc.workflow import run as job

    def stopped(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "run", stopped)
    code, _, told = call(*arguments, "--out", tmp_path / "run")
    assert code == 130
    assert "--resume" in told
