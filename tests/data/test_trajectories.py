import re
from dataclasses import replace

import numpy as np
import pytest
from machine_signals import machine
from scipy.io import savemat

from hybrid_mpc import DataSpec, InputError, Signal, Window, load_trajectories, write_csv
from hybrid_mpc.data.excitation import short_runs
from hybrid_mpc.data.recording import check_unit, read_recording
from hybrid_mpc.data.trajectories import Trajectory, hold_mean

SPEC = DataSpec("t", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2)
SIGNALS = machine((Signal("phi", "rad"),), (Signal("torque", "N m"),))


def record(path, t, phi=np.sin):
    return write_csv(path, {"t": t, "tau": np.sign(np.cos(7 * t)), "phi": phi(t)})


def test_states_and_derivatives_of_a_known_motion(tmp_path):
    t = np.arange(0, 5, 0.005) + np.random.default_rng(0).uniform(0, 1e-4, 1000)  # jittered stamps
    data = load_trajectories([record(tmp_path / "run.csv", t)], SIGNALS, SPEC)
    whole = data.whole[0]
    # linear interpolation of the jitter: h j / 2 = 0.005 * 1e-4 / 2 = 2.5e-7, times filter gains (<= 1e3)
    np.testing.assert_allclose(whole.x, np.c_[np.sin(whole.t), np.cos(whole.t)], atol=2e-5)
    inner = slice(5, -5)
    np.testing.assert_allclose(whole.xdot[inner, 1], -np.sin(whole.t)[inner], atol=2.5e-3)
    np.testing.assert_allclose(np.diff(whole.t), SPEC.dt, atol=1e-12)
    assert [piece.role for piece in data.trajectories] == ["train", "valid", "test"]


def test_an_input_is_the_mean_of_its_hold_over_the_period_that_begins():
    t, u = np.array([0.0, 0.25, 1.0, 2.0]), np.array([[1.0], [3.0], [-1.0], [0.0]])
    assert hold_mean(t, u, np.array([0.0, 0.5, 1.0]), 0.5)[:, 0].tolist() == [2.0, 3.0, -1.0]


def test_gap_cuts_and_nothing_leaks_across_it(tmp_path):
    t = np.r_[np.arange(0, 3, 0.01), np.arange(3.2, 6, 0.01)]
    before = load_trajectories([record(tmp_path / "a.csv", t)], SIGNALS, SPEC)
    after = load_trajectories(
        [record(tmp_path / "a.csv", t, lambda t: np.where(t > 3.1, 5.0, np.sin(t)))], SIGNALS, SPEC
    )
    assert [(piece.name, piece.role) for piece in before.whole] == [("a", ""), ("a#2", "")]
    np.testing.assert_array_equal(before.whole[0].x, after.whole[0].x)
    assert before.hash != after.hash
    (cut,) = [cut for cut in before.cuts if "gap" in cut.why]
    assert (cut.file, cut.start_s, cut.end_s) == ("a.csv", 2.99, 3.2)


def test_windows_give_disjoint_roles_and_short_ones_are_reported(tmp_path):
    windows = Window(0, 2, "train"), Window(2.2, 2.4, "train"), Window(3, 4, "valid"), Window(4.2, 6, "test")
    spec = replace(SPEC, windows={"a": windows})
    data = load_trajectories([record(tmp_path / "a.csv", np.arange(0, 6.01, 0.01))], SIGNALS, spec)
    times = np.concatenate([piece.t for piece in data.trajectories])
    assert len(np.unique(times)) == len(times)
    assert [cut.start_s for cut in data.cuts] == pytest.approx([2.2])
    for piece, window in zip(data.trajectories, (windows[0], *windows[2:]), strict=True):
        assert piece.role == window.role
        assert piece.t[0] >= window.start - 1e-6
        assert piece.t[-1] + piece.dt <= window.end + 1e-6


def test_what_cannot_be_split_is_refused(tmp_path):
    file = record(tmp_path / "a.csv", np.arange(0, 6, 0.01))
    only = replace(SPEC, windows={"a": (Window(0, 5, "train"),)})
    with pytest.raises(InputError, match="HM-DATA-114"):
        load_trajectories([file], SIGNALS, only)
    double = replace(SPEC, windows={"a": (Window(0, 5, "train"), Window(4, 6, "test"))})
    with pytest.raises(InputError, match="HM-DATA-104"):
        load_trajectories([file], SIGNALS, double)
    with pytest.raises(InputError, match="HM-DATA-065"):
        load_trajectories([file, file], SIGNALS, SPEC)
    with pytest.raises(InputError, match="HM-DATA-099"):
        load_trajectories([], SIGNALS, SPEC)


def test_runs_of_different_length_sampling_and_format(tmp_path):
    slow, fast = np.arange(0, 9, 0.01), np.arange(0, 4, 0.005)
    long = record(tmp_path / "long.csv", slow)
    one = {"t": slow, "tau": np.sign(np.cos(7 * slow)), "phi": np.sin(slow) + 1e-6, "more": slow}
    savemat(tmp_path / "matlab.mat", {"run": one})
    np.savez(tmp_path / "short.npz", t=0.005, tau=np.sign(np.cos(7 * fast)), phi=np.sin(fast))
    files = [long, tmp_path / "matlab.mat", tmp_path / "short.npz"]
    data = load_trajectories(files, SIGNALS, SPEC)
    assert data.files == ("long.csv", "matlab.mat", "short.npz")
    csv, mat, short = data.whole
    assert (len(csv.t), len(mat.t), len(short.t)) == (449, 449, 199)
    for name in ("t", "u", "y", "x", "xdot"):
        # 1e-6 of the angle makes it another recording
        # ten digits in CSV: 1e-10 times the gain of the second derivative, about 1e3 at 10 ms over 0.1 s
        np.testing.assert_allclose(getattr(csv, name), getattr(mat, name), atol=2e-6)
    np.testing.assert_allclose(short.x, np.c_[np.sin(short.t), np.cos(short.t)], atol=2e-5)
    assert [t.role for t in data.trajectories] == 3 * ["train", "valid", "test"]
    assert data.hash == load_trajectories(files[::-1], SIGNALS, SPEC).hash


def test_units_of_columns(tmp_path):
    t = np.arange(0, 5, 0.01)
    plain = load_trajectories([record(tmp_path / "run.csv", t)], SIGNALS, SPEC).whole[0]
    columns = {"t": 1e3 * t, "tau": np.sign(np.cos(7 * t)), "phi": np.rad2deg(np.sin(t))}
    write_csv(tmp_path / "run.csv", columns)
    spec = replace(SPEC, units={"t": "ms", "phi": "deg", "tau": 0.5})
    got = load_trajectories([tmp_path / "run.csv"], SIGNALS, spec).whole[0]
    np.testing.assert_allclose(got.t, plain.t, atol=1e-12)
    np.testing.assert_allclose(got.y, plain.y, atol=1e-9)  # ten digits of CSV
    np.testing.assert_allclose(got.u, 0.5 * plain.u, atol=1e-12)
    for units, match in (({"phi": "Nm"}, "HM-DATA-073"), ({"tau": 0.0}, "HM-DATA-073")):
        with pytest.raises(InputError, match=match):
            load_trajectories([tmp_path / "run.csv"], SIGNALS, replace(SPEC, units=units))


def test_unequal_columns_are_refused_by_file_and_column(tmp_path):
    t = np.arange(0, 5, 0.01)
    monday = record(tmp_path / "monday.csv", t)
    other = write_csv(tmp_path / "tuesday.csv", {"t": t, "torque": t, "phi": t})
    np.savez(tmp_path / "sunday.npz", t=t, tau=t, angle=t)
    sunday = tmp_path / "sunday.npz"
    with pytest.raises(InputError) as caught:
        load_trajectories([monday, other, sunday], SIGNALS, SPEC)
    message = str(caught.value)
    assert "tuesday.csv: no column 'tau'" in message
    assert "'tau' is in monday.csv, sunday.npz and not in tuesday.csv" in message
    assert "'phi' is in monday.csv, tuesday.csv and not in sunday.npz" in message
    with pytest.raises(InputError) as caught:  # alone it lacks a column, but differs from none
        load_trajectories([other], SIGNALS, SPEC)
    assert "differ" not in str(caught.value)
    named = replace(SPEC, inputs_of={"tuesday": ("torque",)})
    assert len(load_trajectories([monday, other], SIGNALS, named).whole) == 2
    more = write_csv(tmp_path / "more.csv", {"x": t, "t": t, "tau": t, "phi": t})  # nobody reads x
    assert len(load_trajectories([monday, more], SIGNALS, SPEC).whole) == 2


def test_the_main_job_reads_mat_files(tmp_path):
    from hybrid_mpc import RunSettings, load_scenario
    from hybrid_mpc.workflow.context import Context

    t = np.arange(0, 30, 0.01)
    savemat(tmp_path / "mine.mat", {"time_s": t, "u_nm": 0.1 * np.cos(t), "angle": np.sin(t)})
    settings = RunSettings(
        "golf_robot", (tmp_path / "mine.mat",), 0, "quick", outputs=("angle",), inputs=("u_nm",)
    )
    data = Context(settings, load_scenario("golf_robot"), tmp_path).dataset
    assert data.files == ("mine.mat",)
    np.testing.assert_allclose(data.whole[0].y[:, 0], np.sin(data.whole[0].t), atol=1e-12)


def test_too_short_a_recording_is_told_how_long_one_must_be(tmp_path):
    """By the default shares of 60, 20 and 20 %; a sample more than said is enough, two less are not."""
    spec = replace(SPEC, smoothing=0.2, warm_up=0.5)

    def read(seconds):
        t = 0.02 * np.arange(round(seconds / 0.02) + 1)
        return load_trajectories([record(tmp_path / f"run{len(t)}.csv", t)], SIGNALS, spec)

    with pytest.raises(InputError, match="HM-DATA-114") as short:
        read(2.0)
    needed = float(re.search(r"needs (\S+) s", str(short.value))[1])
    assert {t.role for t in read(needed + 0.02).trajectories} == {"train", "valid", "test"}
    with pytest.raises(InputError, match=r"0\.7.*HM-DATA-114"):
        read(needed - 0.2)


def test_units_of_the_specification_are_those_of_a_header():
    """Whatever a column's header may name, ``units`` may name, too."""
    spec = DataSpec("t", ("heater",), ("flow",), dt=1.0, max_gap=2.0, smoothing=5.0, warm_up=5.0,
                    units={"heater": "W", "flow": "m^3/h"})  # fmt: skip
    check_unit(spec, "heater", Signal("heater", "kW"))
    check_unit(spec, "flow", Signal("flow", "l/min"))
    with pytest.raises(InputError, match=r"'heater'.*'W'.*HM-DATA-128"):
        check_unit(spec, "heater", Signal("heater", "K"))


@pytest.mark.parametrize("column", ["level [m]", "level (m)", "level_m"])
def test_a_unit_in_or_behind_a_name_counts_whatever_part_of_the_name_is_given(tmp_path, column):
    t = 0.01 * np.arange(200)
    spec = replace(SPEC, time="clock", inputs=("pump",), outputs=("level",))
    path = write_csv(
        tmp_path / "run.csv", {"clock_ms": 1000 * t, "pump_pct": 100 * (t > 1), column: 0.5 + 0.1 * t}
    )
    tank = machine((Signal("level", "mm"),), (Signal("pump", "-", 0, 1),))
    for one in (spec, replace(spec, time="clock_ms", inputs=("pump_pct",), outputs=(column,))):
        found = read_recording(path, tank, one)
        np.testing.assert_allclose(found.y[:, 0], 500 + 100 * t, rtol=1e-9)
        np.testing.assert_allclose(found.t, t, atol=1e-9)
        np.testing.assert_array_equal(found.u[:, 0], t > 1)
    given = replace(spec, units={"level": "cm", "clock": 0.002, "pump": 1.0})  # has the last word
    found = read_recording(path, machine(tank.outputs, (Signal("pump", "-", 0, 100),)), given)
    np.testing.assert_allclose(found.y[:, 0], 5 + t, rtol=1e-9)
    np.testing.assert_allclose(found.t, 2 * t, atol=1e-9)


def test_a_letter_behind_a_name_that_is_given_whole_may_be_an_index(tmp_path):
    t = 0.01 * np.arange(200)
    path = write_csv(tmp_path / "run.csv", {"t": t, "u_A": t, "T_m": 20 + t})
    two = machine((Signal("oil", "degC"),), (Signal("voltage", "V"),))
    found = read_recording(path, two, replace(SPEC, inputs=("u_A",), outputs=("T_m",)))
    np.testing.assert_array_equal(found.u[:, 0], found.t)
    with pytest.raises(InputError, match=r"'u_A'.*'A'.*HM-DATA-128"):
        read_recording(path, two, replace(SPEC, inputs=("u",), outputs=("T_m",)))


def test_free_runs_longer_than_any_test_piece_are_told():
    spec = DataSpec("t", ("u",), ("y",), dt=1.0, max_gap=2.0, smoothing=5.0, warm_up=10.0, free_run=100.0)
    z = np.zeros((80, 1))
    piece = Trajectory("run", "test", 1.0, np.arange(80.0), z, z, z, z)
    (told,) = short_runs(spec, [piece])
    assert "free_run is 100 s" in told
    assert "70 s after its warm-up of 10 s" in told
    assert short_runs(replace(spec, free_run=70.0), [piece]) == ()
    assert short_runs(replace(spec, free_run=None), [piece]) == ()
