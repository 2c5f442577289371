"""Recordings as they come from outside: what a reader takes for a number must be the number that was meant."""

from dataclasses import replace

import numpy as np
import pytest
from machine_signals import machine
from recording_bombs import GOOD, SPEC, T

from hybrid_mpc import DataSpec, InputError, Signal, Window, load_trajectories, write_csv
from hybrid_mpc.data.findings import find_folding
from hybrid_mpc.data.recording import read_recording

FREE = machine((Signal("phi", "rad"),), (Signal("torque", "N m"),))
PLAIN = machine((Signal("n", "rpm"),), (Signal("u", "V"),))


def read(path, content, signals=FREE, spec=SPEC):
    if isinstance(content, str):
        path.write_text(content)
    else:
        np.savez(path, **content)
    return read_recording(path, signals, spec)


def refused(path, content, match, signals=FREE, spec=SPEC):
    with pytest.raises(InputError, match=match):
        read(path, content, signals, spec)


@pytest.mark.parametrize("code", [-9999, -999.25, -999, 9.96921e36, 1e20, 32767, -3.4028235e38, -9999.9])
@pytest.mark.parametrize("column", ["phi", "tau"])
def test_one_code_for_a_missing_value_is_refused(tmp_path, code, column):
    columns = {**GOOD, column: np.where(np.arange(60) == 33, code, GOOD[column])}
    refused(tmp_path / "run.npz", columns, f"index 33, column '{column}'")
    single = {**columns, column: columns[column].astype(np.float32)}
    refused(tmp_path / "run.npz", single, f"index 33, column '{column}'")
    spec = replace(SPEC, units={"phi": "deg", "tau": 0.01})
    refused(tmp_path / "run.npz", columns, f"index 33, column '{column}'", spec=spec)


@pytest.mark.parametrize(
    ("numbers", "code"),
    [
        (101325 + 900 * np.sin(T), -9999.0),  # Pa
        (np.where(np.arange(60) % 7 == 0, -999.25, np.sin(T)), -9999.0),  # two codes
        (np.full(60, 0.5), -9999.0),  # a constant input
        (np.full(60, 0.5), 9.969209968386869e36),
    ],
)
def test_codes_beside_large_numbers_other_codes_and_constants(tmp_path, numbers, code):
    refused(tmp_path / "run.npz", {**GOOD, "tau": np.where(np.arange(60) == 9, code, numbers)}, "-?9")


@pytest.mark.parametrize(
    "numbers",
    [
        np.where(np.arange(60) < 30, 0.0, 9999.0),  # a switch
        np.where(np.arange(60) == 9, 9999.0, 9990 + 5 * np.sin(T)),
        np.linspace(-32768, 32767, 60),
        np.where(np.arange(60) == 9, -999.25, 900 * np.cos(30 * T)),
    ],
)
def test_numbers_that_look_like_codes_and_are_none(tmp_path, numbers):
    table = read(tmp_path / "run.npz", {**GOOD, "tau": numbers})
    np.testing.assert_array_equal(table.u[:, 0], numbers)


ROWS = [f"{1000 * k}" for k in range(60)]


def semicolons(*columns, names="t;u;n"):
    return "\n".join([names, *map(";".join, zip(*columns, strict=True))]) + "\n"


MILLI = DataSpec(
    "t", ("u",), ("n",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2, units={"t": "ms", "n": "rpm"}
)
MS = [f"{10 * k}" for k in range(60)]
RPM = [f"{800 + 10 * k:,}".replace(",", ".") for k in range(60)]  # 800 ... 990, 1.000 ... 1.390


def test_points_between_thousands_are_no_decimals(tmp_path):
    path = tmp_path / "run.csv"
    refused(path, semicolons(MS, ROWS, RPM), "thousands", PLAIN, MILLI)
    refused(path, semicolons(MS, ROWS, [n.replace(".", ",") for n in RPM]), "thousands", PLAIN, MILLI)
    large = [f"{2000 + k:,}".replace(",", ".") for k in range(60)]
    refused(path, semicolons(MS, ROWS, large, ["0,5"] * 60, names="t;u;n;x"), "thousands", PLAIN, MILLI)
    refused(path, semicolons(MS, ["0,5"] * 60, large), "thousands", PLAIN, MILLI)


@pytest.mark.parametrize("mark", ".,")
def test_decimals_with_three_digits_are_decimals(tmp_path, mark):
    cells = [f"{1 + 0.01 * k:.3f}".replace(".", mark) for k in range(60)]
    table = read(tmp_path / "run.csv", semicolons(MS, ROWS, cells), PLAIN, MILLI)
    np.testing.assert_allclose(table.y[:, 0], 1 + 0.01 * np.arange(60), rtol=1e-12)
    short = [f"{1 + 0.125 * k:.3f}".rstrip("0").rstrip(".").replace(".", mark) for k in range(60)]
    table = read(tmp_path / "run.csv", semicolons(MS, ROWS, short), PLAIN, MILLI)
    np.testing.assert_allclose(table.y[:, 0], 1 + 0.125 * np.arange(60), rtol=1e-12)
    seconds = [f"{0.01 * k:.2f}".replace(".", mark) for k in range(60)]  # the time shows what the mark is
    grouped = [n.replace(".", mark) for n in RPM]
    spec = replace(MILLI, units={})
    table = read(tmp_path / "run.csv", semicolons(seconds, ROWS, grouped), PLAIN, spec)
    assert table.y[-1, 0] == 1.39


def lines(form):
    rows = [f"{0.01 * k:.2f},{np.cos(0.01 * k):.4f},{form(20 + 10 * np.sin(0.1 * k))}" for k in range(60)]
    return "\n".join(["time_s,tau,phi", *rows])


@pytest.mark.parametrize("form", ["{:.6f}".format, "{:.5e}".format, "{:.9g}".format])
def test_a_last_number_that_was_cut_in_two_is_refused(tmp_path, form):
    path, whole = tmp_path / "run.csv", lines(form)
    for content in (whole, whole + "\n"):
        assert len(read(path, content).t) == 60
    last = whole.splitlines()[-1].rpartition(",")[2]
    tried = 0
    for n in range(1, len(last)):
        cut = whole[: len(whole) - n]
        try:
            table = read(path, cut)
        except InputError:
            tried += 1
            continue
        assert np.isnan(table.y[-1, 0]) or abs(table.y[-1, 0] - float(last)) < 3.1
    assert tried


def test_last_rows_without_an_end_are_read(tmp_path):
    """Programs write ``0.5`` after ``0.5564``, an input steps in the last row, and files end without an end of row."""
    for cells in (
        [f"{0.5 + 0.003 * k:.3g}" for k in range(58)] + ["0.674", "0.67"],
        ["0"] * 59 + ["1"],
        ["-1"] * 30 + ["1"] * 30,
    ):
        content = "\n".join(
            ["time_s,phi,tau", *(f"{0.01 * k:.2f},0.{k % 5},{c}" for k, c in enumerate(cells))]
        )
        assert read(tmp_path / "run.csv", content).u[-1, 0] == float(cells[-1])


def test_a_row_of_units_is_read_and_a_contradiction_with_the_header_is_named(tmp_path):
    path, rows = tmp_path / "run.csv", [f"{k},{k % 3},{k % 5}" for k in range(60)]
    spec = replace(SPEC, time=0.01)
    (told,) = read(path, "\n".join(["clock,tau,phi", "s,1,1", *rows]), spec=spec).findings
    assert told.kind == "read"
    assert told.is_note
    assert "row 2 is a row of units" in told.message
    refused(path, "\n".join(["time_s,tau,phi [deg]", "s,N m,rad", *rows]), "'deg'")
    refused(path, "\n".join(["time_s,tau,phi [degC]", "s,N m,K", *rows]), "'degC'")
    read(path, "\n".join(["note,tau,phi", "-,1,1", *rows]), spec=spec)


def test_a_quotation_mark_that_is_not_closed_swallows_no_rows(tmp_path):
    rows = [f"{0.01 * k:.2f},0.5,{k % 5},ok" for k in range(60)]
    whole = "time_s,tau,phi,note\n"
    for note in ('"see page 5', '"two\nlines"'):
        rows[20] = f"0.20,0.5,0,{note}"
        content = whole + "\n".join(rows)
        if note.endswith('"'):
            assert len(read(tmp_path / "run.csv", content).t) == 60
        else:
            rows[30] = '0.30,0.5,0,"end"'
            refused(tmp_path / "run.csv", whole + "\n".join(rows), "quotation|cells")


@pytest.mark.parametrize("begin", [0.0, 1000.0, 30000.0])
@pytest.mark.parametrize("dt", [0.01, 0.0125])
def test_time_in_single_precision_is_even_again(tmp_path, begin, dt):
    t = begin + dt * np.arange(2000)
    t = np.delete(t, [300, 301, 777])
    single = t.astype(np.float32)
    columns = {"time_s": single, "tau": np.cos(t), "phi": np.sin(t)}
    table = read(tmp_path / "run.npz", columns)
    np.testing.assert_allclose(table.t, t, atol=begin * 2e-8 + 2e-6)
    steps = np.diff(table.t) / dt
    assert np.abs(steps - np.round(steps)).max() < 1e-3
    content = "\n".join(
        ["time_s,tau,phi", *(f"{a},{b:.9f},{c:.9f}" for a, b, c in zip(*columns.values(), strict=True))]
    )
    np.testing.assert_allclose(
        read(tmp_path / "run.csv", content + "\n").t, table.t, atol=1e-9 * begin + 1e-9
    )


@pytest.mark.parametrize("parts", [2, 3, 4])
@pytest.mark.parametrize("speed", [0.4, 3.0, -3.0])
def test_an_angle_that_begins_anew_after_a_part_of_a_turn_is_refused(tmp_path, parts, speed):
    t, part = np.arange(0, 12, 0.01), 2 * np.pi / parts
    angle = (speed * t + 0.3 * np.sin(t)) % part - part / 2
    for periodic in (False, True):
        signals = machine((Signal("phi", "rad", periodic=periodic),), (Signal("torque", "N m"),))
        refused(
            tmp_path / "run.npz",
            {"time_s": t, "tau": np.cos(t), "phi": angle},
            f"1/{parts} of a turn",
            signals,
        )
    degrees = machine((Signal("phi", "deg", periodic=True),), (Signal("torque", "N m"),))
    columns = {"time_s": t, "tau": np.cos(t), "phi": np.rad2deg(angle)}
    refused(tmp_path / "run.npz", columns, f"1/{parts} of a turn", degrees)


def test_steps_swings_and_impacts_are_not_folded():
    t = np.arange(0, 12, 0.01)
    for angle in (
        np.where(np.sin(t) > 0, np.pi / 2, -np.pi / 2),
        np.where(np.sin(t) > 0, np.pi / 2, -np.pi / 2) + 1e-2 * np.sin(50 * t),
        np.pi / 2 * np.sin(3 * t),
        np.pi / 2 * np.abs(np.sin(3 * t)),
    ):
        assert find_folding(t, angle, 2 * np.pi, 0.05) is None


@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize("low", [0, 0.5])
def test_a_counter_that_overflows_is_refused(tmp_path, bits, low):
    t = np.arange(0, 12, 0.01)
    counts = np.round(2.0**bits * (0.4 * t + 0.2 * np.sin(t)))
    numbers = (counts + low * 2**bits) % 2**bits - low * 2**bits
    columns = {"time_s": t, "tau": np.cos(t), "phi": numbers}
    lengths = machine((Signal("x", "m"),), (Signal("torque", "N m"),))
    spec = replace(SPEC, units={"phi": 1e-6})
    refused(tmp_path / "run.npz", columns, f"counter of {bits} bits", lengths, spec)
    read(tmp_path / "run.npz", {**columns, "phi": counts}, lengths, spec)
    steps = np.where(np.sin(t) > 0, 2.0**bits - 1, 0)
    assert not read(tmp_path / "run.npz", {**columns, "phi": steps}, lengths, spec).findings


@pytest.mark.parametrize("value", [-7777, 888888, 99, 1e9])
@pytest.mark.parametrize("channel", ["phi", "tau"])
def test_a_few_values_far_from_all_others_are_told(tmp_path, value, channel):
    rows = np.arange(60)
    numbers = np.where(np.isin(rows, [17]), value, GOOD[channel])
    table = read(tmp_path / "run.npz", {**GOOD, channel: numbers})
    (found,) = table.findings
    assert (found.kind, found.channel, found.count, found.refused) == ("outlier", channel, 1, False)
    assert found.start == T[17]
    for sound in (np.where(rows > 50, 3.0, GOOD[channel]), np.where(rows == 17, 1.0, 0.0), np.exp(rows / 5)):
        assert not read(tmp_path / "run.npz", {**GOOD, channel: sound}).findings


def test_time_in_half_precision_is_refused(tmp_path):
    refused(tmp_path / "run.npz", {**GOOD, "time_s": T.astype(np.float16)}, "HM-DATA-108")
    read(tmp_path / "run.npz", {**GOOD, "phi": np.sin(T).astype(np.float16)})


def test_a_file_name_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "run\udcff.csv"
    try:
        write_csv(path, GOOD)
    except (OSError, InputError):
        pytest.skip("this file system has names of text alone")
    with pytest.raises(InputError, match="HM-DATA-063"):
        load_trajectories([path], FREE, SPEC)


def test_a_column_without_a_number_is_refused_whatever_its_unit(tmp_path):
    refused(tmp_path / "run.npz", {**GOOD, "phi": np.full(60, np.nan)}, "HM-DATA-070")


@pytest.mark.parametrize(
    ("setting", "match"),
    [
        ({"units": {"ph": "deg"}}, r"units.*'ph'.*HM-DATA-067"),
        ({"units": {"phi [deg]": "deg"}}, r"units.*HM-DATA-067"),
        ({"windows": {"run.npz": (Window(0, 0.3, "train"),)}}, r"windows.*'run\.npz'.*HM-DATA-068"),
        ({"windows": {"Run": (Window(0, 0.3, "train"),)}}, r"windows.*'Run'.*HM-DATA-068"),
        ({"inputs_of": {"run ": ("tau",)}}, r"inputs_of.*'run '.*HM-DATA-068"),
        ({"delays_of": {"RUN.NPZ": {"phi": 0.1}}}, r"delays_of.*'RUN\.NPZ'.*HM-DATA-068"),
    ],
)
def test_settings_of_nothing_are_refused(tmp_path, setting, match):
    refused(tmp_path / "run.npz", GOOD, match, spec=replace(SPEC, **setting))


@pytest.mark.parametrize("ends", [(-8.0, -7.5), (7.0, 9.0), (-1e-3, -5e-4), (0.9, 1.1)])
def test_a_sensor_that_is_always_at_an_end_of_its_range_measures_nothing(tmp_path, ends):
    signals = machine((Signal("phi", "rad", saturation=ends),), (Signal("torque", "N m"),))
    refused(tmp_path / "run.npz", GOOD, "HM-DATA-071", signals)
    known = machine((Signal("phi", "rad", saturation=(0.1, 0.3)),), (Signal("torque", "N m"),))
    assert {-1, 0, 1} == set(read(tmp_path / "run.npz", GOOD, known).censored.ravel())


@pytest.mark.parametrize(
    ("stem", "told"), [("mondya", 1), ("tuesday", 0), ("monday2", 0), ("monday", 0), ("monda", 1)]
)
def test_a_recording_whose_name_is_misspelt_in_the_settings_is_told(tmp_path, stem, told):
    np.savez(tmp_path / "monday.npz", **{k: np.tile(v, 1) for k, v in GOOD.items()})
    spec = replace(SPEC, windows={stem: (Window(0, 0.55, "train"),)})
    found = load_trajectories([tmp_path / "monday.npz"], FREE, spec, needed=()).findings
    assert [f.kind for f in found] == ["settings"] * told
