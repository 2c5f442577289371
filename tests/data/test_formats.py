"""Files of every format, written by the format's own library, are read to the last digit."""

import datetime
import io

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from hybrid_mpc import InputError
from hybrid_mpc.data.files import opened

K = np.arange(200)
T = 0.005 * K
U, Y = np.cos(3 * T), 20 + np.sin(T) / 3
BEGIN = datetime.datetime(2024, 3, 30, 23, 59, 59, 500_000)
STAMPS = [BEGIN + datetime.timedelta(microseconds=5000 * int(k)) for k in K]
FRAME = pd.DataFrame({"t": T, "u [V]": U, "y": Y})
DATED = pd.DataFrame(
    {"time": pd.to_datetime(STAMPS), "u": U, "y": np.where(K % 3, np.nan, Y), "n": K, "on": K % 2 == 0}
)


def read(path, time, inputs=(), outputs=()):
    """Columns of a file, the time first; none may have a fault."""
    source = opened(path)
    names = [source.find(name) for name in (time, *inputs, *outputs)]
    columns = source.read(names[0], names[1:], names[1 + len(inputs) :])
    assert not columns.problems
    return columns.values.T


def same(found, *expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def near(t, expected):
    np.testing.assert_allclose(t, expected, rtol=0, atol=1e-7)  # a tenth of 1 us


# Excel, Parquet, Feather, HDF5


def test_a_workbook(tmp_path):
    pytest.importorskip("openpyxl", reason="openpyxl is not installed")
    path = tmp_path / "run.xlsx"
    FRAME.to_excel(path, index=False)
    np.testing.assert_allclose(
        read(path, "t", ["u"], ["y"]), (T, U, Y), rtol=1e-15
    )  # openpyxl writes 16 digits
    DATED.to_excel(path, index=False)
    t, u, n, y = read(path, "time", ["u", "n"], ["y"])
    np.testing.assert_allclose(t, T, atol=5.1e-4)  # Excel's dates are read to a millisecond
    np.testing.assert_allclose((u, n, y), (U, K, DATED.y), rtol=1e-15)


def test_a_sheet_with_a_preamble_units_and_closing_rows(tmp_path):
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed")
    path, book = tmp_path / "run.xlsx", openpyxl.Workbook()
    rows = [
        ["Test bench 5"],
        [None],
        ["t", "u", "y"],
        ["s", "V", "degC"],
        *FRAME.to_numpy().tolist(),
        ["Mean", 1.0, 2.0],
    ]
    book.active.title = "data"
    for row in rows:
        book.active.append(row)
    book.create_sheet("notes").append(["nothing here"])
    book.save(path)
    source = opened(path)
    assert source.header == ("t [s]", "u [V]", "y [degC]")
    np.testing.assert_allclose(read(path, "t", ["u"], ["y"]), (T, U, Y), rtol=1e-15)
    told = " ".join(source.notes)
    assert all(words in told for words in ("'data'", "header in row 3", "row 4 is a row of units", "205"))
    other = book.create_sheet("more")
    for row in rows:
        other.append(row)
    book.save(path)
    with pytest.raises(InputError, match="2 sheets have tables"):
        opened(path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match="HM-DATA-076"):
        opened(path)


@pytest.mark.parametrize("ending", ["parquet", "feather"])
def test_columns_of_arrow(tmp_path, ending):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    path = tmp_path / f"run.{ending}"
    write = pd.DataFrame.to_parquet if ending == "parquet" else pd.DataFrame.to_feather
    write(FRAME, path)
    same(read(path, "t", ["u"], ["y"]), T, U, Y)
    write(DATED, path)
    t, u, n, on, y = read(path, "time", ["u", "n", "on"], ["y"])
    near(t, T)
    same((u, n, on, y), U, K, K % 2 == 0, DATED.y)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match="HM-DATA-082"):
        opened(path)


def test_an_index_of_dates_with_a_zone(tmp_path):
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    frame = DATED.set_index(DATED.time.dt.tz_localize("Europe/Berlin"))[["u", "y"]]
    frame.to_parquet(tmp_path / "run.parquet")
    t, u = read(tmp_path / "run.parquet", "time", ["u"])
    near(t, T)
    same((u,), U)


def test_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["bench/t"] = T
        file.create_dataset("bench/u", data=U[:, None], compression="gzip").attrs["units"] = "V"
        file["bench/xy"] = np.c_[U, Y]
        file["table"] = np.rec.fromarrays([T, Y], names="time,level")
        file["elsewhere"] = h5py.ExternalLink("/etc/hostname", "/")
        file["name"] = "a text"
    source = opened(path)
    assert source.header == (
        "bench.t",
        "bench.u [V]",
        "bench.xy(:,1)",
        "bench.xy(:,2)",
        "table.time",
        "table.level",
    )
    same(read(path, "bench.t", ["u"], ["xy(:,2)", "level"]), T, U, Y, Y)


def test_links_that_lead_to_one_group_again_and_again(tmp_path):
    """A hundred links at each of eight depths are 1e16 ways."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        for k in range(100):
            group[f"again{k}"] = group
    with pytest.raises(InputError, match=r"run.h5: .*more than 10000 groups"):
        opened(path)


# MATLAB


def test_matrices_structs_in_structs_and_vectors_of_other_lengths(tmp_path):
    path = tmp_path / "run.mat"
    inner = {"t": T[:, None], "xy": np.c_[U, Y], "wide": np.vstack([U, Y]), "deep": {"y": Y[None]}}
    runs = np.empty((2,), dtype=[("v", object)])
    runs["v"] = [U, Y]
    savemat(path, {"log": inner, "short": np.arange(3.0), "runs": runs, "text": "abc", "dt": 0.005})
    found = read(path, "log.t", ["log.xy(:,1)"], ["log.xy(:,2)", "log.wide(2,:)", "deep.y", "runs(2).v"])
    same(found, T, U, Y, Y, Y, Y)
    same(read(path, "dt", ["runs(1).v"]), T, U)
    with pytest.raises(InputError, match="HM-DATA-110"):
        read(path, "log.t", ["short"])


def test_vectors_of_different_lengths_with_times_of_their_own(tmp_path):
    """A time in each struct, or one of each length: inputs are held, outputs have their own samples."""
    path, slow = tmp_path / "run.mat", T[::4] + 0.002
    named = {"t_fast": T, "u": U, "t_slow": slow, "y": Y[::4]}
    structs = {"a": {"t": T, "log": {"u": U}}, "b": {"t": slow, "y": Y[::4]}}
    for content, time in ((named, "time"), (structs, "t")):
        savemat(path, {**content, "k": 3.0})
        rules(path, time, "u", "y")
        assert opened(path).unread == ("k",)
    same(read(path, "a.t", ["a.log.u"]), T, U)  # one clock by its own name
    savemat(path, {"t": T, "u": U, "y": Y[::4]})  # which samples have which time?
    with pytest.raises(InputError, match="HM-DATA-110"):
        read(path, "t", ["u"], ["y"])


def test_version_7_3(tmp_path):
    """As MATLAB writes it: HDF5 behind 512 bytes, transposed, structs as groups, objects marked."""
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    path = tmp_path / "run.mat"
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, array, kind=b"double"):
            file[name] = array
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)

        put("t", T[None])
        put("xy", np.vstack([U, Y]))
        put("log/deep/y", Y[None])
        put("note", np.array([[97, 98]], dtype=np.uint16), b"char")
        put("#refs#/a", U[None])
        file["runs/v"] = np.array([[file["#refs#/a"].ref]], dtype=h5py.ref_dtype)
        put("#refs#/b", Y[None])
        file["#refs#/s/w"] = np.array([[file["#refs#/a"].ref, file["#refs#/b"].ref]], dtype=h5py.ref_dtype)
        put("c", np.array([[file["#refs#/b"].ref, file["#refs#/s"].ref]], dtype=h5py.ref_dtype), b"cell")
        put("run", np.array([[1, 2]], dtype=np.uint32), b"timetable")
        file["run"].attrs["MATLAB_object_decode"] = np.int32(3)
    content = bytearray(path.read_bytes())
    content[:128] = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    path.write_bytes(bytes(content))
    same(read(path, "t", ["xy(:,1)", "runs(1).v"], ["xy(:,2)", "log.deep.y"]), T, U, U, Y, Y)
    same(read(path, "t", ["c{2}(1).w"], ["c{1}", "c{2}(2).w"]), T, U, Y, Y)
    source = opened(path)
    assert source.unread == ("run",)
    assert "timetable2table(run" in source.note
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match="HM-DATA-034"):
        opened(path)


# Loggers: two clocks each, the second one late and slower

SLOW = T[::4] + 0.002


def rules(path, time, u, y):
    """The input is held between its samples, the output is there at its own stamps alone."""
    t, held, seen = read(path, time, [u], [y])
    near(t, np.unique(np.round(np.r_[T, SLOW], 6)))
    near(t[np.isfinite(seen)], SLOW)
    same((seen[np.isfinite(seen)],), Y[::4])
    same((held,), U[np.searchsorted(T, t + 1e-9, side="right") - 1])


def test_mdf(tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed")
    path = tmp_path / "run.mf4"
    with asammdf.MDF(version="4.10") as file:
        file.append(
            [asammdf.Signal(U, T, unit="V", name="u"), asammdf.Signal(K.astype(np.uint8), T, name="n")]
        )
        file.append([asammdf.Signal(Y[::4], SLOW, unit="degC", name="y")])
        formula = {"formula": "X1 + 1"}
        file.append([asammdf.Signal(K, T, name="f", conversion=formula)])
        file.save(path, overwrite=True)
    rules(path, "time", "u", "y")
    source = opened(path)
    assert source.header == ("time [s]", "u [V]", "n", "y [degC]")
    assert source.unread == ("f",)
    path.write_bytes(path.read_bytes()[:700])
    with pytest.raises(InputError, match="MDF"):
        opened(path).read("time [s]", ["u [V]"], [])


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed")
    path = tmp_path / "run.tdms"
    begin = np.datetime64("2024-03-30T23:59:59.5")
    wave = {"wf_increment": 0.005, "wf_start_offset": 0.0, "wf_start_time": begin, "unit_string": "V"}
    late = {
        **wave,
        "wf_increment": 0.02,
        "wf_start_time": begin + np.timedelta64(2, "ms"),
        "unit_string": "degC",
    }
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("fast", "u", U, properties=wave),
                nptdms.ChannelObject("slow", "y", Y[::4], properties=late),
            ]
        )
    rules(path, "time", "u [V]", "y [degC]")
    stamps = begin + (5000 * K).astype("timedelta64[us]")
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("g", name, x) for name, x in (("Time", stamps), ("u", U), ("y", Y))]
        )
    t, u, y = read(path, "time", ["u"], ["y"])
    near(t, T)
    same((u, y), U, Y)
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("g", name, x) for name, x in (("u", U), ("y", Y))])
    same(read(path, "u", [], ["y"]), U, Y)


def ns(t):
    return (1711843199500000000 + 1000 * np.round(1e6 * np.asarray(t)).astype(np.int64)).tolist()


def test_a_bag_of_ros_1(tmp_path):
    rosbags = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed")
    pytest.importorskip("mcap_ros1", reason="mcap-ros1-support is not installed")
    from rosbags.typesys import Stores, get_typestore

    store, path = get_typestore(Stores.ROS1_NOETIC), tmp_path / "run.bag"
    kind = store.types["std_msgs/msg/Float64"]
    with rosbags.Writer(path) as bag:
        for topic, stamps, values in (("/u", T, U), ("/y", SLOW, Y[::4])):
            connection = bag.add_connection(topic, kind.__msgtype__, typestore=store)
            for stamp, value in zip(ns(stamps), values, strict=True):
                bag.write(connection, stamp, store.serialize_ros1(kind(data=float(value)), kind.__msgtype__))
    rules(path, "time", "/u.data", "/y.data")


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_bag_of_ros_2(tmp_path, storage):
    rosbags = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed")
    from rosbags.typesys import Stores, get_typestore

    store, folder = get_typestore(Stores.LATEST), tmp_path / "run"
    kind, header, stamp_of = (
        store.types[f"{name}"]
        for name in ("sensor_msgs/msg/Temperature", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with rosbags.Writer(folder, version=9, storage_plugin=rosbags.StoragePlugin[storage]) as bag:
        for topic, stamps, values in (("/u", T, U), ("/y", SLOW, Y[::4])):
            connection = bag.add_connection(topic, kind.__msgtype__, typestore=store)
            for stamp, value in zip(ns(stamps), values, strict=True):
                head = header(stamp=stamp_of(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="base")
                message = kind(header=head, temperature=float(value), variance=0.0)
                bag.write(connection, stamp, store.serialize_cdr(message, kind.__msgtype__))
    (path,) = [one for one in folder.iterdir() if one.suffix in (".db3", ".mcap")]
    rules(path, "time", "/u.temperature", "/y.temperature")


def test_mcap_of_json(tmp_path):
    writers = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    pytest.importorskip("mcap_ros1", reason="mcap-ros1-support is not installed")
    import json

    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = writers.Writer(file)
        writer.start()
        for topic, stamps, values in (("u", T, U), ("y", SLOW, Y[::4])):
            channel = writer.register_channel(topic, "json", 0)
            for stamp, value in zip(ns(stamps), values, strict=True):
                content = json.dumps({"value": value, "name": "a", "raw": [1, 2]}).encode()
                writer.add_message(channel, stamp, content, stamp)
        writer.finish()
    rules(path, "time", "u.value", "y.value")
    assert "u.raw[1]" in opened(path).header


def ulog(topics):
    """A PX4 log as its format says: header, formats, subscriptions, data."""
    import struct

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    file = io.BytesIO()
    file.write(b"ULog\x01\x125\x01" + struct.pack("<Q", 0) + message("B", bytes(40)))
    for name in topics:
        file.write(message("F", f"{name}:uint64_t timestamp;double x;".encode()))
    for k, name in enumerate(topics):
        file.write(message("A", struct.pack("<BH", 0, k) + name.encode()))
    for k, (stamps, values) in enumerate(topics.values()):
        for stamp, value in zip(np.round(1e6 * stamps).astype(int).tolist(), values, strict=True):
            file.write(message("D", struct.pack("<HQd", k, 7_000_000 + stamp, value)))
    return file.getvalue()


def test_a_log_of_px4(tmp_path):
    pytest.importorskip("pyulog", reason="pyulog is not installed")
    path = tmp_path / "run.ulg"
    path.write_bytes(ulog({"actuator": (T, U), "air": (SLOW, Y[::4])}))
    rules(path, "time", "actuator.x", "air.x")


DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Drive: 8 ECU
 SG_ u : 0|32@1- (0.0001,0) [-100|100] "V" ECU
 SG_ mode : 32|8@1+ (1,0) [0|3] "" ECU
BO_ 257 Heat: 4 ECU
 SG_ y : 0|32@1- (0.0001,0) [-100|100] "degC" ECU
VAL_ 256 mode 0 "off" 1 "on" ;
"""


@pytest.mark.parametrize("ending", ["blf", "asc", "log"])
def test_can_with_its_database(tmp_path, ending):
    can = pytest.importorskip("can", reason="python-can is not installed")
    cantools = pytest.importorskip("cantools", reason="cantools is not installed")
    base, path = cantools.database.load_string(DBC, "dbc"), tmp_path / f"run.{ending}"
    u, y = np.round(U, 4), np.round(Y[::4], 4)
    frames = [(t, 256, base.encode_message(256, {"u": a, "mode": 1})) for t, a in zip(T, u, strict=True)]
    frames += [(t, 257, base.encode_message(257, {"y": a})) for t, a in zip(SLOW, y, strict=True)]
    frames.append((0.5, 999, b"\1"))
    with can.Logger(str(path)) as log:
        for t, key, data in sorted(frames):
            log(can.Message(timestamp=1711843199.5 + t, arbitration_id=key, data=data, is_extended_id=False))
    with pytest.raises(InputError, match=r"run\.dbc.*HM-DATA-040"):
        opened(path)
    (tmp_path / "run.dbc").write_text(DBC)
    t, held, mode, seen = read(path, "time", ["u", "mode"], ["y"])
    np.testing.assert_allclose(t, np.unique(np.round(np.r_[T, SLOW], 6)), rtol=0, atol=1e-6)
    np.testing.assert_allclose(seen[np.isfinite(seen)], y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(held, u[np.searchsorted(T, t + 1e-6, side="right") - 1], rtol=0, atol=1e-12)
    assert (mode == 1).all()
    assert opened(path).unread == ("0x3e7",)


@pytest.mark.parametrize(
    ("name", "begin", "package"),
    [
        ("a.mf4", b"MDF     4.10", "asammdf"), ("a.tdms", b"TDSm", "nptdms"), ("a.bag", b"#ROSBAG V2.0\n", "mcap"),
        ("a.ulg", b"ULog\x01\x125", "pyulog"), ("a.blf", b"LOGG", "can"), ("a.mcap", b"\x89MCAP0\r\n", "mcap"),
        ("a.h5", b"\x89HDF\r\n\x1a\n", "h5py"), ("a.parquet", b"PAR1", "pyarrow"), ("a.xlsx", b"PK\3\4", "openpyxl"),
    ],
)  # fmt: skip
def test_without_its_library_a_format_is_refused_by_name(tmp_path, monkeypatch, name, begin, package):
    import sys

    for module in [key for key in sys.modules if key.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(begin + bytes(600))
    with pytest.raises(InputError, match=rf"(?s){package}.*pip install 'hybrid-mpc\[(tables|loggers)\]'"):
        opened(tmp_path / name)


def test_formats_that_are_not_read_are_named(tmp_path):
    path = tmp_path / "run.xls"
    path.write_bytes(b"\xd0\xcf\x11\xe0" + bytes(500))
    with pytest.raises(InputError, match="HM-DATA-023"):
        opened(path)
