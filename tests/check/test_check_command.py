"""``hybrid-mpc check``: what it understands, in units, and what it says is wrong."""

import subprocess
import sys

import pytest

from hybrid_mpc.cli import check

WITHOUT_TORCH = """
import sys
from hybrid_mpc.cli.main import app
app(standalone_mode=False)
assert "torch" not in sys.modules
"""


def checked(call, *words):
    code, told, _ = call("check", *words)
    return code, " ".join(told.split())


def test_it_says_what_it_understood(call, machine):
    data = [word for name in ("monday", "tuesday") for word in ("--data", machine / f"{name}.csv")]
    code, told = checked(call, machine / "my_machine.py", *data)
    assert code == 0
    for words in (
        "input tau N m -3 to 3 tau_nm -0.7 to 0.7",  # two signals of 0.4 and 0.3
        "state phi_dot rad/s any",
        "d 0.05 N m s 0 and 0.5",
        "J 0.1 kg m^2 fixed",
        "balances: energy (J, W)",
        "networks may correct the rates of: phi_dot",
        "operating point (given): phi = 0 rad, phi_dot = 0 rad/s, tau = 0 N m",
        "(-3.142, 0) unstable; (0, 0) stable; (3.142, 0) unstable",
        "4 s; 1 Runge-Kutta steps per period of 0.02 s",  # 2 J / d: the envelope of the swing
        "control: 50 periods, 1 s",
        "monday.csv 11.98 s 0.01 s",
        "No errors",
    ):
        assert words in told
    assert not list(machine.glob("runs"))


def test_machine_and_recordings_are_told_in_one_pass(call, machine, tmp_path):
    text = (machine / "my_machine.py").read_text()
    text = text.replace('Signal("phi_dot", "rad/s")', 'Signal("phi_dot", "deg/s")')
    text = text.replace("sensor_sigma=(1e-3,)", "sensor_sigma=(0.0,)")
    (tmp_path / "wrong.py").write_text(text)
    table = (machine / "monday.csv").read_text().replace("tau_nm", "torque")
    (tmp_path / "monday.csv").write_text(table)
    code, told = checked(call, tmp_path / "wrong.py", "--data", tmp_path / "monday.csv")
    assert code == 2
    assert "3 errors" in told
    for words in ("its unit must be rad/s", "sensor_sigma: must be positive", "no column 'tau_nm'"):
        assert words in told


def test_a_decimal_comma_that_is_read_is_a_note_and_no_warning(call, machine, tmp_path):
    words = []
    for name in ("monday", "tuesday"):
        table = (machine / f"{name}.csv").read_text().replace(",", ";").replace(".", ",")
        (tmp_path / f"{name}.csv").write_text(table)
        words += ["--data", tmp_path / f"{name}.csv"]
    code, told = checked(call, machine / "my_machine.py", *words)
    assert code == 0
    assert "2 notes" in told
    assert told.count("decimal comma") == 2
    assert "decimal comma" not in told.partition(" warning")[2]


@pytest.mark.parametrize("unit", ["", " [rad]"])
def test_swapped_columns_are_two_errors_however_many_files(call, machine, tmp_path, unit):
    """Whether the names of the DataSpec hold the units, or the files alone."""
    text = (machine / "my_machine.py").read_text()
    torque, angle = f"tau{' [N m]' if unit else ''}", f"phi{unit}"
    (tmp_path / "swapped.py").write_text(
        text.replace('"tau_nm"', f'"{angle}"').replace('"phi_rad"', f'"{torque}"')
    )
    words = []
    for name in ("monday", "tuesday"):
        table = (
            (machine / f"{name}.csv")
            .read_text()
            .replace("tau_nm", "tau [N m]")
            .replace("phi_rad", "phi [rad]")
        )
        (tmp_path / f"{name}.csv").write_text(table)
        words += ["--data", tmp_path / f"{name}.csv"]
    code, told = checked(call, tmp_path / "swapped.py", *words)
    assert code == 2
    assert "2 errors" in told
    assert told.count("[HM-DATA-128]") == 2


def test_what_is_marked_is_counted_at_the_end(call, machine, tmp_path):
    text = (machine / "my_machine.py").read_text()
    for marks in (1, 2):
        (tmp_path / "marked.py").write_text(text + "# TODO: decide this\n" * marks)
        code, told = checked(call, tmp_path / "marked.py", "--data", machine / "monday.csv")
        assert code == 0
        last = told.rpartition("No errors")[2]
        assert f"{marks} value" in last
        assert "TODO" in last
        assert f"{marks} left to decide" in told
    assert "1 errors" not in told


def test_declared_delays_are_not_in_the_deployed_model(call, machine, tmp_path):
    text = (machine / "my_machine.py").read_text()
    given = text.replace("dt=0.02", 'delays={"phi_rad": 0.04}, dt=0.02', 1)
    assert given != text
    (tmp_path / "late.py").write_text(given)
    for path, warned in ((machine / "my_machine.py", False), (tmp_path / "late.py", True)):
        code, told = checked(call, path, "--data", machine / "monday.csv")
        assert code == 0
        assert ("phi_rad 0.04 s" in told) == warned


@pytest.mark.full
def test_a_machine_in_casadi_is_checked_without_torch(machine):
    words = ["check", str(machine / "my_machine.py"), "--data", str(machine / "monday.csv")]
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("lacking", [(), ("k ends at its bound",)])
def test_a_doubt_that_a_missing_term_explains_names_the_search(call, machine, monkeypatch, lacking):
    monkeypatch.setattr(check, "_fit", lambda *given: ((), (), ("k ends at its bound",), lacking))
    code, told, _ = call("check", machine / "my_machine.py", "--data", machine / "monday.csv", "--fit")
    assert code == 0
    assert (f"hybrid-mpc explain {machine / 'my_machine.py'} " in told) == bool(lacking)
    assert (str(machine / "monday.csv") in told.splitlines()[-1]) == bool(lacking)
