"""Tables as engineers have them: known content is read to the last digit, what is ambiguous is refused in a line."""

import datetime
import math
from dataclasses import replace

import numpy as np
import pytest
from machine_signals import machine

from hybrid_mpc import DataSpec, InputError, Signal, load_trajectories
from hybrid_mpc.check.new import draft_scenario
from hybrid_mpc.data.files import opened
from hybrid_mpc.data.recording import read_recording

K = np.arange(40)
T = np.array([float(f"{0.01 * k:.2f}") for k in K])
U = np.array([float(f"{np.cos(0.3 * k):.6f}") for k in K])
Y = np.array([float(f"{20 + 5 * np.sin(0.1 * k):.4f}") for k in K])
PLAIN = [[f"{0.01 * k:.2f}", f"{np.cos(0.3 * k):.6f}", f"{20 + 5 * np.sin(0.1 * k):.4f}"] for k in K]
GERMAN = [[cell.replace(".", ",") for cell in row] for row in PLAIN]
NAMES = ("t", "u", "y")
BEGIN = datetime.datetime(2024, 3, 30, 23, 59, 59, 700_000)  # passes midnight after 0.3 s
ALIGNED = [[cell.rjust(14) for cell in row] for row in PLAIN]
LABVIEW = ("X_Value", "u", "y", "Comment")
SWAPPED = str.maketrans(",.", ".,")
STAMPS = [BEGIN + datetime.timedelta(milliseconds=10 * int(k)) for k in K]
PAST = datetime.timedelta(days=26)
TRUE = {"t": T, "u": U, "y": Y}


def text(rows, separator=",", above=(), header=NAMES, below=(), end="\n"):
    """Rows of cells as a text file."""
    lines = [*above, *([separator.join(header)] if header else []), *map(separator.join, rows), *below]
    return end.join(lines) + end


def first(stamp, form=None):
    """The table with stamps in place of the time."""
    return [
        [stamp(s) if form is None else s.strftime(form), *row[1:]]
        for s, row in zip(STAMPS, PLAIN, strict=True)
    ]


def with_cells(make, column=1, rows=None):
    """The table with other cells in a column: ``make(k)``, or of the old one, ``make(k, cell)``."""
    rows = PLAIN if rows is None else rows
    return [[make(k, c) if j == column else c for j, c in enumerate(row)] for k, row in enumerate(rows)]


def ms(stamp):
    return f"{stamp:%Y-%m-%d %H:%M:%S}.{stamp.microsecond // 1000:03d}"


LVM = [
    "LabVIEW Measurement\t", "Writer_Version\t2", "Separator\tTab", "Date\t2024/03/30", "Time\t10:11:12,5",
    "***End_of_Header***\t", "\t", "Channels\t2\t\t", "Samples\t40\t40\t", "X_Dimension\tTime\tTime\t",
    "***End_of_Header***\t\t\t",
]  # fmt: skip
SECONDS = {"t [s]": T, "u": U, "y": Y}
NUMBERED = {"column 1": T, "column 2": U, "column 3": Y}
UNITS = {"t [s]": T, "u [V]": U, "y [degC]": Y}

TABLES = {
    "plain": (text(PLAIN), TRUE),
    "semicolons": (text(PLAIN, ";"), TRUE),
    "tabs": (text(PLAIN, "\t"), TRUE),
    "vertical bars": (text(PLAIN, "|"), TRUE),
    "blanks": (text(PLAIN, " "), TRUE),
    "columns of one width": (text(ALIGNED, "", header=("t   u   y",)), TRUE),
    "names with blanks over columns": (
        text(ALIGNED, "", header=("time (s)   u (V)     level (m)",)),
        {"time (s)": T, "u (V)": U, "level (m)": Y},
    ),
    "commas and blanks": (text(PLAIN, ", "), TRUE),
    "decimal commas": (text(GERMAN, ";"), TRUE),
    "decimal commas, tabs": (text(GERMAN, "\t"), TRUE),
    "quoted decimal commas": (text([[f'"{c}"' for c in row] for row in GERMAN], ","), TRUE),
    "ends of Windows": (text(PLAIN, end="\r\n"), TRUE),
    "ends of an old Mac": (text(PLAIN, end="\r"), TRUE),
    "BOM": ("\ufeff" + text(PLAIN), TRUE),
    "UTF-16": (text(GERMAN, "\t").encode("utf-16"), TRUE),
    "UTF-16 without a mark": (text(PLAIN, "\t").encode("utf-16-le"), TRUE),
    "Latin-1": (text(GERMAN, ";", header=("t", "u", "Füllstand [°C]")).encode("latin-1"), {"Füllstand [°C]": Y}),
    "quoted names": (text(PLAIN, header=('"t"', '"u, first"', '"y ""inner"""')), {"u, first": U, 'y "inner"': Y}),
    "no header": (text(PLAIN, header=()), NUMBERED),
    "no header below a preamble": (text(PLAIN, header=(), above=["Logger 5", "", "-----"]), NUMBERED),
    "preamble": (text(PLAIN, above=["Logger 5", "Rate: 10 Hz", "", "Operator: Ann, Bob"]), TRUE),
    "preamble of keys": (text(PLAIN, above=[f"Key {k},{k}" for k in range(12)]), TRUE),
    "long preamble": (text(PLAIN, above=[f"# setting {k} = {k}" for k in range(300)]), TRUE),
    "header as a remark": (text(PLAIN, " ", header=("# t", "u", "y")), TRUE),
    "LabVIEW": (text([[*row, ""] for row in GERMAN], "\t", above=LVM, header=LABVIEW), {"y": Y}),
    "LabVIEW without comments": (text(PLAIN, "\t", above=LVM, header=LABVIEW), {"X_Value": T}),
    "row of units": (text(PLAIN, header=NAMES, below=()).replace("t,u,y", "t,u,y\ns,V,degC", 1), UNITS),
    "units in brackets": (text(PLAIN, ";").replace("t;u;y", "t;u;y\n[s];[V];[degC]", 1), UNITS),
    "units of which some are numbers": (text(PLAIN).replace("t,u,y", "t,u,y\ns,1,degC", 1), {"y [degC]": Y}),
    "separators at the ends of rows": (text([[*row, ""] for row in PLAIN]), TRUE),
    "separators everywhere": (text([[*row, ""] for row in PLAIN], header=(*NAMES, "")), TRUE),
    "a separator behind the header": (text(PLAIN, header=(*NAMES, "")), TRUE),
    "closing rows": (text(PLAIN, below=["Mean,1,2", "Std. dev.,1,2", "", "# end"]), TRUE),
    "blank rows": (text([row for pair in zip(PLAIN, [["", "", ""]] * 40, strict=True) for row in pair]), TRUE),
    "remarks between": (text([*PLAIN[:9], ["# a pause"], *PLAIN[9:]]), TRUE),
    "header again, soon": (text([*PLAIN[:5], list(NAMES), *PLAIN[5:]]), TRUE),
    "header again": (text([*PLAIN[:20], list(NAMES), *PLAIN[20:]]), TRUE),
    "words for a switch": (
        text(with_cells(lambda k, c: "ON" if k % 3 else "off")),
        {"u": np.where(K % 3, 1.0, 0.0)},
    ),
    "true and false": (text(with_cells(lambda k, c: str(bool(k % 3)))), {"u": np.sign(K % 3)}),
    "cells with units": (text([[row[0], f"{row[1]} V", f"{row[2]}°C"] for row in PLAIN]), {"u [V]": U, "y [°C]": Y}),
    "missing ones": (
        text(with_cells(lambda k, c: ("n/a", "---", "NaN", "", c)[k % 5], 2)),
        {"y": np.where(K % 5 == 4, Y, np.nan)},
    ),
    "thousands": (
        text(with_cells(lambda k, c: f"{1234567.25 + k:,}"), ";"),
        {"u": 1234567.25 + K, "y": Y},
    ),
    "German thousands": (
        text(with_cells(lambda k, c: f"{4567.25 + k:,}".translate(SWAPPED), rows=GERMAN), ";"),
        {"u": 4567.25 + K, "y": Y},
    ),
    "Swiss thousands": (text(with_cells(lambda k, c: f"{4567 + k:,}".replace(",", "'"))), {"u": 4567.0 + K}),
    "ISO": (text(first(ms)), SECONDS),
    "ISO with T and zone": (text(first(lambda s: s.isoformat(timespec="microseconds") + "+02:00")), SECONDS),
    "ISO in UTC": (text(first(lambda s: ms(s) + "Z"), header=("t [UTC]", "u", "y")), SECONDS),
    "two zones": (
        text(first(lambda s: ms(s) + "+01:00" if s.day == 30 else ms(s + datetime.timedelta(hours=1)) + "+02:00")),
        SECONDS,
    ),
    "days with points": (
        text(first(lambda s: f"{s:%d.%m.%Y %H:%M:%S},{s.microsecond // 1000:03d}"), ";"),
        SECONDS,
    ),
    "day first": (text(first(lambda s: f"{s:%d/%m/%Y %H:%M:%S}.{s.microsecond // 1000:03d}")), SECONDS),
    "month first": (text(first(lambda s: f"{s:%m/%d/%Y %I:%M:%S}.{s.microsecond // 1000:03d} {s:%p}")), SECONDS),
    "month first over midnight": (text(first(lambda s: f"{s - PAST:%m/%d/%Y %H:%M:%S.%f}")), SECONDS),
    "two digits of a year": (text(first(lambda s: f"{s:%y-%m-%d %H:%M:%S.%f}")), SECONDS),
    "months by name": (text(first(lambda s: f"{s:%d-%b-%Y %H:%M:%S}.{s.microsecond // 1000:03d}")), SECONDS),
    "milliseconds behind a colon": (
        text(first(lambda s: f"{s:%Y-%m-%d %H:%M:%S}:{s.microsecond // 1000:03d}")),
        SECONDS,
    ),
    "date and time": (
        text([[f"{s:%Y-%m-%d}", f"{s:%H:%M:%S.%f}", *row[1:]] for s, row in zip(STAMPS, PLAIN, strict=True)],
             header=("Date", "t", "u", "y")),
        SECONDS,
    ),
    "time of day past midnight": (text(first(lambda s: f"{s:%H:%M:%S.%f}")), {"t [s]": 86399.7 + T}),
    "minutes and seconds": (
        text(with_cells(lambda k, c: f"{k // 6:02d}:{k % 6 * 10:02d}.5", 0)),
        {"t [s]": 10.0 * K + 0.5},
    ),
    "microseconds since 1970": (
        text(with_cells(lambda k, c: f"{1711843199700000 + 10000 * k}", 0)),
        {"t": 1711843199.7e6 + 1e4 * K},
    ),
    "an oscilloscope's": (
        text([[str(k), row[1], row[2], ""] for k, row in enumerate(PLAIN)], header=(),
             above=["X,CH1,CH2,Start,Increment,", "Sequence,Volt,Volt,-1.5e-01,2.5e-03"]),
        {"time [s]": -0.15 + 2.5e-3 * K, "CH1 [Volt]": U, "CH2 [Volt]": Y},
    ),
    "sixteen digits": (
        text(with_cells(lambda k, c: repr(math.pi * 10.0 ** (k - 20)))),
        {"u": [math.pi * 10.0 ** (k - 20) for k in range(40)]},
    ),
}  # fmt: skip
"""Contents by kind, and columns as they are read."""


@pytest.fixture
def wrote(tmp_path):
    def write(content, name="run.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def numbers(path, names=None):
    """All columns of a file by name; none may have a fault."""
    source = opened(path)
    found = {}
    for name in source.header if names is None else names:
        columns = source.read(None, [name], [name])
        assert not columns.problems
        found[name] = columns.values[:, 0]
    return found


@pytest.mark.parametrize("kind", TABLES)
def test_a_table_is_read_to_the_last_digit(wrote, kind):
    content, expected = TABLES[kind]
    path = wrote(content)
    found = numbers(path, expected)
    assert set(expected) <= set(opened(path).header)
    assert len(opened(path).header) == 3
    for name, values in expected.items():
        exact = {"rtol": 0, "atol": 1e-9} if name == "t [s]" else {"rtol": 0, "atol": 0}  # far below 1 us
        np.testing.assert_allclose(found[name], np.asarray(values), **exact)


LONG = [
    [ms(s), tag, row[j]]
    for s, row in zip(STAMPS, PLAIN, strict=True)
    for j, tag in ((1, "FIC-1.OP"), (2, "TI-7"))
]


def test_long_form_is_a_column_a_tag(wrote):
    path = wrote(text(LONG, header=("timestamp", "tag", "value")))
    source = opened(path)
    assert source.header == ("timestamp [s]", "FIC-1.OP", "TI-7")
    columns = source.read("timestamp [s]", ["FIC-1.OP", "TI-7"], ["TI-7"])
    np.testing.assert_allclose(columns.values, np.c_[T, U, Y], atol=1e-9)
    units = [[*row, "%" if "OP" in row[1] else "degC"] for row in LONG]
    assert opened(wrote(text(units, header=("timestamp", "tag", "value", "unit")))).header[1:] == (
        "FIC-1.OP [%]",
        "TI-7 [degC]",
    )


def test_clocks_of_their_own_meet_by_the_rules_of_their_roles(wrote):
    """The input holds its last number; the output has one where it was sampled; rows before the first input go."""
    rows = [[f"{0.5 * k:.1f}", "u", f"{k}"] for k in range(1, 9)] + [
        [f"{0.3 * k:.1f}", "y", f"{k}"] for k in range(15)
    ]
    columns = opened(wrote(text(rows, header=("time", "tag", "value")))).read("time", ["u", "y"], ["y"])
    t, u, y = columns.values.T
    np.testing.assert_array_equal(
        t, np.unique(np.round([*0.5 * np.arange(1, 9), *0.3 * np.arange(2, 15)], 1))
    )
    np.testing.assert_array_equal(u, np.minimum(np.floor(t / 0.5 + 1e-9), 8))
    sampled = np.isclose(t / 0.3, np.round(t / 0.3))
    np.testing.assert_allclose(y[sampled], np.round(t[sampled] / 0.3))
    assert np.isnan(y[~sampled]).all()


def test_a_signal_is_no_tag(wrote):
    """A column of numbers that is called a signal, and words that do not repeat, name no signals."""
    path = wrote(
        text(
            [[row[0], str(k % 2), row[2]] for k, row in enumerate(PLAIN)], header=("time", "signal", "value")
        )
    )
    same = numbers(path)
    np.testing.assert_array_equal(same["signal"], K % 2)
    np.testing.assert_array_equal(same["value"], Y)


def cell(row, column, value, rows=PLAIN):
    return [[value if (k, j) == (row, column) else c for j, c in enumerate(r)] for k, r in enumerate(rows)]


AMBIGUOUS = {
    "no table": ("nothing here\nis a number\n", "HM-DATA-093"),
    "day or month": (
        text(with_cells(lambda k, c: f"0{1 + k % 2}/0{2 + k % 3}/2024 10:00:{k:02d}", 0)),
        "with the day or with the month",
    ),
    "hours or minutes": (text(with_cells(lambda k, c: f"10:{k:02d}", 0)), "hours and minutes"),
    "no such day": (text(with_cells(lambda k, c: f"30.02.2024 10:00:{k:02d}", 0), ";"), "do not exist"),
    "two zones by name": (
        text(with_cells(lambda k, c: f"2024-03-31 10:00:{k:02d} {'CET' if k < 9 else 'CEST'}", 0)),
        "time zones",
    ),
    "thousands or decimals": (
        text(with_cells(lambda k, c: f"{800 + 10 * k:,}".replace(",", "."), rows=GERMAN), ";"),
        "row 2[23], .*thousands",
    ),
    "two decimal marks": (text(cell(7, 1, "0,25"), ";"), r"0,25.*HM-DATA-097"),
    "a decimal comma between commas": (text(cell(7, 1, "0,25")), "HM-DATA-093"),
    "two units in cells": (text(with_cells(lambda k, c: f"{c} {'V' if k else 'mV'}")), "row 2, .*unit"),
    "a word": (text(cell(7, 1, "overload")), "row 9, column 'u' is 'overload'"),
    "three positions": (text(with_cells(lambda k, c: ("on", "off", "auto")[k % 3])), "row 2, column 'u'"),
    "a row of words": (text([*PLAIN[:9], ["off", "line", "now"], *PLAIN[9:]]), "row 11, column 't'"),
    "a switch among numbers": (text(cell(7, 1, "ON")), "row 9, .*such as on or true"),
    "a short row": (text([*PLAIN[:9], PLAIN[9][:2], *PLAIN[10:]]), r"11.*HM-DATA-093"),
    "a long row": (text([*PLAIN[:9], [*PLAIN[9], "1"], *PLAIN[10:]]), r"11.*HM-DATA-093"),
    "a header of numbers": (text(PLAIN, header=("0", "1", "2")), r"row 1 .*HM-DATA-089"),
    "decimal commas between commas": (text(GERMAN), "HM-DATA-089"),
    "a month a row": (
        text(with_cells(lambda k, c: f"0{1 + k % 9}/0{1 + k // 9}/2024", 0)), "with the day or with the month"
    ),
    "a header too short": (text(PLAIN, header=("t", "u")), "HM-DATA-089"),
    "a header by other separators": (text(PLAIN, ";", header=("t,u,y,z",)), "HM-DATA-089"),
    "units that contradict": (
        text(PLAIN, header=("t", "u", "y [K]")).replace("]", "]\ns,V,degC", 1),
        "HM-DATA-089",
    ),
    "an open quotation mark": (text(cell(7, 1, '"0.5')), "HM-DATA-092"),
    "bytes": (text(PLAIN).encode()[:200] + b"\0\1\2" + text(PLAIN).encode()[200:], "HM-DATA-091"),
    "cut in two": (text(PLAIN)[:-4], "row 41, .*cut in two"),
    "infinite": (text(cell(7, 2, "inf")), "row 9, column 'y' is 'inf'"),
    "a blank input": (text(cell(7, 1, "")), "row 9, column 'u' is empty"),
    "AM beside 13 h": (text(with_cells(lambda k, c: f"1/31/2024 {9 + k // 8}:00:{k:02d} AM", 0)), "AM and PM"),
    "a date among numbers": (text(cell(7, 1, "2024-01-31")), "row 9, .*date"),
}  # fmt: skip
"""Damaged or ambiguous contents, and what the refusal says."""


@pytest.mark.parametrize("kind", AMBIGUOUS)
def test_what_is_ambiguous_is_refused_in_a_line(wrote, kind):
    content, match = AMBIGUOUS[kind]
    path = wrote(content)
    with pytest.raises(InputError, match=match) as caught:  # noqa: PT012  (opening or reading refuses)
        source = opened(path)
        time = source.find("t") if kind != "no table" else "t"
        columns = source.read(time, [source.find("u"), source.find("y")], [source.find("y")])
        if columns.problems:
            raise InputError(f"{path}: {columns.problems[0]}")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


# Time


LOOSE = machine((Signal("y", "-"),), (Signal("u", "-"),))
SPEC = DataSpec("t", ("u",), ("y",), dt=0.01, max_gap=0.05, smoothing=0.1, warm_up=0.05)


def test_a_logger_that_was_started_again_is_cut_there(wrote):
    path = wrote(text([*PLAIN, *PLAIN[:30]]))
    recording = read_recording(path, LOOSE, SPEC)
    (finding,) = recording.findings
    assert (finding.kind, finding.count, finding.refused) == ("clock", 1, False)
    assert finding.message.startswith("row 42, ")
    np.testing.assert_array_equal(recording.y[:, 0], np.r_[Y, Y[:30]])
    np.testing.assert_allclose(
        np.diff(recording.t), np.r_[np.full(39, 0.01), 0.15, np.full(29, 0.01)], atol=1e-12
    )
    whole = load_trajectories([path], LOOSE, SPEC, needed=()).whole
    assert [len(one.t) for one in whole] == [39, 29]
    assert draft_scenario([opened(path)], ("u",), ("y",), "t").period == pytest.approx(0.01)


def test_rows_that_stand_twice_are_left_out(wrote):
    recording = read_recording(wrote(text([*PLAIN[:10], PLAIN[9], *PLAIN[10:]])), LOOSE, SPEC)
    np.testing.assert_array_equal(recording.t, T)
    assert recording.findings[0].message.startswith("row 12, ")
    other = [*PLAIN[:10], [PLAIN[9][0], "0.5", "1"], *PLAIN[10:]]
    with pytest.raises(InputError, match=r"row 12, column 't': time repeats"):
        read_recording(wrote(text(other)), LOOSE, SPEC)


def test_a_slow_output_of_a_long_table_is_mostly_missing(wrote):
    """A laboratory sample each second with a delay, beside an input at 100 Hz."""
    rows = [[f"{0.01 * k:.2f}", "u", f"{np.sin(0.02 * k):.5f}"] for k in range(900)]
    rows += [[f"{k + 0.003:.3f}", "y", f"{k}"] for k in range(9)]
    spec = replace(SPEC, time="time", delays={"y": 0.5}, max_gap=0.1)
    (whole,) = load_trajectories(
        [wrote(text(rows, header=("time", "tag", "value")))], LOOSE, spec, needed=()
    ).whole
    known = np.isfinite(whole.y[:, 0])
    assert 7 <= known.sum() <= 9
    assert np.isfinite(whole.u).all()
    np.testing.assert_allclose(whole.t[known], whole.y[known, 0] + 0.003 - 0.5, atol=0.005)
