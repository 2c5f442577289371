"""Files of data loggers and robots: MDF, TDMS, ROS bags, MCAP, PX4 logs, CAN logs. Each signal keeps its own clock.

Each format is read by its own library, part of the extra ``loggers``; none of them runs code from a file.
"""

from __future__ import annotations

import io
import json
import sqlite3
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.names import said_by
from hybrid_mpc.data.source import LARGEST, LISTED, Series, Source, clocked, line_of
from hybrid_mpc.data.vectors import vector_source
from hybrid_mpc.errors import InputError, MissingPackage, named_extra
from hybrid_mpc.records import shown
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
NUMBERS = {"2": (0, 1, 2, 6, 7, 8, 9, 65535), "3": (0, 1, 2, 6, 7, 8, 9, 65535), "4": (0, 1, 2, 4, 5, 6)}
"""Conversions of raw to physical numbers that are used, by the version of an MDF file; tables of texts are not."""
FORMULAS = {"2": 10, "3": 10, "4": 3}  # the conversion that is a formula in a text


def logger_source(path: Path, content: bytes, sha256: str) -> Source:
    """Open a logger's file as a source."""
    begins = (one[1:] for one in _READERS if content.startswith(one[0]))
    reader, what = next(begins, (_can, "CAN log"))
    try:
        with named_extra(f"{path}: reading this {what}"):
            return reader(path, content, sha256)
    except (MissingPackage, InputError):
        raise
    except Exception as error:  # the libraries raise many kinds of exceptions for a damaged file
        raise InputError(
            f"{path}: not a valid {what}, or damaged ({line_of(error)}). Record or export it again. [HM-DATA-037]"
        ) from error


def _named(name: str, unit: object) -> str:
    text = str(unit).strip() if isinstance(unit, str) else ""
    return f"{name} [{text}]" if text else name


def _distinct(pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Distinct names of signals: prefixed by the group if several groups share a name, else numbered."""
    counts, seen, found = Counter(own for _, own in pairs), Counter[str](), list[str]()
    for group, own in pairs:
        name = own if counts[own] == 1 else f"{group}.{own}"
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name} #{seen[name]}")
    return found


def _source(
    path: Path,
    sha256: str,
    found: Sequence[tuple[str, str, str, Array, Array]],
    unread: Sequence[str] = (),
    note: str = "",
) -> Source:
    """A source of signals: group, name, unit, stamps [s], numbers; time begins at the file's first stamp."""
    found = [one for one in found if len(one[3])]
    if not found:
        raise InputError(
            f"{path}: no signal with numbers. Record numeric signals, or export them as CSV. [HM-DATA-038]"
        )
    names, twice, series = _distinct([(group, own) for group, own, *_ in found]), 0, list[Series]()
    for name, (_, _, unit, t, values) in zip(names, found, strict=True):
        last = np.r_[np.diff(t) != 0, True]  # the last of the samples with equal stamps
        twice += int((~last).sum())
        series.append(Series(_named(name, unit), t[last], np.asarray(values, np.float64)[last]))
    note = f" Not read: {', '.join(map(shown, unread[:LISTED]))}." if unread else ""
    clocks = len({(len(one.t), *one.t[[0, -1]]) for one in series})
    notes = (*([note] if note else []), f"{counted(len(series), 'signal')}, {counted(clocks, 'clock')}")
    if twice:
        notes = (*notes, f"{twice} samples are dropped: a later sample has the same time stamp")
    return replace(clocked(path, sha256, series, note=note), unread=tuple(unread), notes=notes)


# MDF and TDMS


def _mdf(path: Path, content: bytes, sha256: str) -> Source:
    from asammdf import MDF

    found, unread = [], []
    with MDF(io.BytesIO(content)) as file:
        for k, group in enumerate(file.groups):
            for j, channel in enumerate(group.channels):
                if j == file.masters_db.get(k):
                    continue
                kind = getattr(channel.conversion, "conversion_type", 0)
                if kind == FORMULAS[file.version[0]]:  # the library would evaluate the formula
                    unread.append(channel.name)
                    continue
                signal = file.get(group=k, index=j, raw=kind not in NUMBERS[file.version[0]])
                if signal.samples.ndim != 1 or signal.samples.dtype.kind not in "biuf":
                    unread.append(channel.name)
                    continue
                where = getattr(group.channel_group, "acq_name", "") or f"group {k}"
                found.append(
                    (where, channel.name, signal.unit, signal.timestamps, signal.samples.astype(np.float64))
                )
    return _source(path, sha256, found, unread)


def _tdms(path: Path, content: bytes, sha256: str) -> Source:
    from nptdms import TdmsFile

    file = TdmsFile.read(io.BytesIO(content))
    found, plain = [], []
    starts = [one.properties.get("wf_start_time") for group in file.groups() for one in group.channels()]
    begin = min((one for one in starts if one is not None), default=None)
    for group in file.groups():
        channels = {one.name: one for one in group.channels() if len(one) and one.dtype.kind in "biufM"}
        clock = next(
            (name for name in channels if said_by(name).kind == "time" and not said_by(name).perhaps), None
        )
        for name, one in channels.items():
            unit = one.properties.get("unit_string", "")
            if one.properties.get("wf_increment", 0):
                start = one.properties.get("wf_start_time")
                late = 0.0 if start is None else float((start - begin) / np.timedelta64(1, "ns")) / 1e9
                step, offset = one.properties["wf_increment"], one.properties.get("wf_start_offset", 0.0)
                t = late + offset + step * np.arange(len(one))
                found.append((group.name, name, unit, t, one[:]))
            elif clock is not None and name != clock and len(one) == len(channels[clock]):
                found.append((group.name, name, unit, _seconds(channels[clock][:], clock), one[:]))
            else:
                plain.append((group.name, _named(name, unit), one))
    if found:
        return _source(path, sha256, found, [name for _, name, _ in plain if said_by(name).kind != "time"])
    names = _distinct([(group, name) for group, name, _ in plain])
    by_name = {name: one for name, (_, _, one) in zip(names, plain, strict=True)}
    return vector_source(path, sha256, LARGEST, tuple(by_name), lambda name: by_name[name][:], "index", 0)


def _seconds(stamps: NDArray[Any], name: str) -> Array:
    """Time stamps [s]: dates since the first stamp, numbers in the unit of their name."""
    if stamps.dtype.kind == "M":
        return (stamps - stamps[0]).astype("timedelta64[ns]").astype(np.float64) / 1e9
    return np.asarray(stamps, np.float64) * (said_by(name).seconds or 1.0)


# Messages: ROS, MCAP, PX4, CAN


def _of_messages(path: Path, sha256: str, messages: Iterable[tuple[str, str, Any, int, bytes]]) -> Source:
    """Numbers of messages by topic and field; a message is its topic, encoding, schema, stamp [ns] and bytes."""
    from mcap_ros1.decoder import DecoderFactory as First
    from mcap_ros2.decoder import DecoderFactory as Second

    factories, unread, left = (First(), Second()), set[str](), LARGEST // 64
    decoders: dict[tuple[str, str], Callable[[bytes], Any] | None] = {}
    numbers: dict[str, dict[str, tuple[list[int], list[float]]]] = {}
    for topic, encoding, schema, stamp, data in messages:
        key = encoding, schema.name if schema else ""
        if key not in decoders:
            made = [factory.decoder_for(encoding, schema) for factory in factories] if schema else []
            found = next((one for one in made if one is not None), None)
            decoders[key] = json.loads if encoding == "json" else found
        decode = decoders[key]
        if decode is None:
            unread.add(topic)
            continue
        fields = numbers.setdefault(topic, {})
        for field, value in _fields_of(decode(data), ""):
            left -= 1
            if left < 0:
                raise InputError(
                    "more numbers than are read from one file. Split the recording [HM-DATA-039]"
                )
            stamps, values = fields.setdefault(field, ([], []))
            stamps.append(stamp)
            values.append(value)
    begin = min((stamps[0] for fields in numbers.values() for stamps, _ in fields.values()), default=0)
    signals = []
    for topic, fields in numbers.items():
        for field, (stamps, values) in fields.items():
            t = (np.array(stamps, dtype=np.int64) - begin) / 1e9
            order = np.argsort(t, kind="stable")
            signals.append((topic, f"{topic}.{field}", "", t[order], np.array(values)[order]))
    return _source(path, sha256, signals, sorted(unread), "times since the first message, as recorded")


def _fields_of(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Numbers in a message, each with the path of its field."""
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _fields_of(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple | np.ndarray):
        # longest array in a message that is read as signals
        if len(value) <= 64:
            for k, inner in enumerate(value):
                yield from _fields_of(inner, f"{name}[{k}]")
    elif hasattr(value, "__slots__"):
        for key in value.__slots__:
            if not key.startswith("_"):
                yield from _fields_of(getattr(value, key), f"{name}.{key}" if name else key)


def _mcap(path: Path, content: bytes, sha256: str) -> Source:
    from mcap.reader import make_reader

    read = make_reader(io.BytesIO(content), validate_crcs=True).iter_messages()
    return _of_messages(
        path, sha256, ((c.topic, c.message_encoding, schema, m.log_time, m.data) for schema, c, m in read)
    )


def _bag(path: Path, content: bytes, sha256: str) -> Source:
    from mcap.records import Schema
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        schemas = {
            one.id: Schema(one.id, one.msgdef.data.encode(), "ros1msg", one.msgtype.replace("/msg/", "/"))
            for one in reader.connections
        }
        messages = ((c.topic, "ros1", schemas[c.id], stamp, data) for c, stamp, data in reader.messages())
        return _of_messages(path, sha256, messages)


def _db3(path: Path, content: bytes, sha256: str) -> Source:
    """The database of a ROS 2 bag; message definitions that it lacks are taken from ROS 2."""
    from mcap.records import Schema
    from rosbags.typesys import Stores, get_typestore

    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(content)
        tables = {name for (name,) in base.execute("select name from sqlite_master where type = 'table'")}
        own, store, topics = dict[str, str](), get_typestore(Stores.LATEST), dict[int, tuple[str, Any]]()
        if "message_definitions" in tables:
            own = dict(base.execute("select topic_type, encoded_message_definition from message_definitions"))
        for key, name, kind in base.execute("select id, name, type from topics"):
            text = own.get(kind) or (store.generate_msgdef(kind)[0] if kind in store.types else "")
            topics[key] = name, text and Schema(id=key, name=kind, encoding="ros2msg", data=text.encode())
        rows = base.execute("select topic_id, timestamp, data from messages order by timestamp")
        messages = ((topics[key][0], "cdr", topics[key][1], stamp, data) for key, stamp, data in rows)
        return _of_messages(path, sha256, messages)


def _ulog(path: Path, content: bytes, sha256: str) -> Source:
    from pyulog import ULog

    log = ULog(io.BytesIO(content))
    several = {one.name for one in log.data_list if one.multi_id > 0}
    begin = min(
        (int(one.data["timestamp"][0]) for one in log.data_list if len(one.data["timestamp"])), default=0
    )
    found = []
    for one in log.data_list:
        topic = f"{one.name}_{one.multi_id}" if one.name in several else one.name
        t = (one.data["timestamp"].astype(np.int64) - begin) / 1e6
        for field, values in one.data.items():
            if field != "timestamp" and values.dtype.kind in "biuf":
                found.append((topic, f"{topic}.{field}", "", t, values.astype(np.float64)))
    return _source(path, sha256, found, (), "times since the first message")


def _can(path: Path, content: bytes, sha256: str) -> Source:
    """A CAN log, decoded by the database beside it: the file of the same name, or the only one in the folder."""
    import can
    import cantools

    near = sorted(path.parent.glob("*.dbc"))
    own = [one for one in near if one.stem == path.stem] or near
    if len(own) != 1:
        there = f"; its folder contains {', '.join(shown(one.name) for one in near[:LISTED])}" if near else ""
        raise InputError(
            f"{path}: the database of the CAN messages is missing{there}. Put {path.stem}.dbc beside the log; without "
            "the database the messages cannot be decoded. [HM-DATA-040]"
        )
    base = cantools.database.load_string(own[0].read_text(encoding="cp1252"), "dbc", strict=False)
    known = {message.frame_id: message for message in base.messages}
    kinds = (
        (b"LOGG", can.BLFReader), (b"date", can.ASCReader), (b"(", can.CanutilsLogReader), (b";", can.TRCReader)
    )  # fmt: skip
    kind = next(one for begin, one in kinds if content.startswith(begin))
    file = io.BytesIO(content) if kind is can.BLFReader else io.StringIO(content.decode("cp1252"))
    numbers: dict[tuple[str, str], tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    unread = dict[str, None]()
    for frame in kind(file):
        message = known.get(frame.arbitration_id)
        if message is None or frame.is_error_frame or frame.is_remote_frame:
            unread[f"0x{frame.arbitration_id:x}"] = None
            continue
        for name, value in message.decode(bytes(frame.data), decode_choices=False).items():
            stamps, values = numbers[message.name, name]
            stamps.append(frame.timestamp)
            values.append(float(value))
    begin = min((stamps[0] for stamps, _ in numbers.values()), default=0.0)
    units = {(m.name, s.name): s.unit or "" for m in base.messages for s in m.signals}
    found = [(*key, units[key], np.array(one) - begin, np.array(two)) for key, (one, two) in numbers.items()]
    return _source(path, sha256, found, list(unread), f"messages decoded by {own[0].name}")


_READERS = (  # first bytes, function that reads the file, name of the format; all other logs are CAN logs
    (b"MDF     ", _mdf, "MDF file"), (b"TDSm", _tdms, "TDMS file"), (b"\x89MCAP0", _mcap, "MCAP file"),
    (b"#ROSBAG", _bag, "ROS bag"), (b"SQLite", _db3, "ROS 2 bag"), (b"ULog", _ulog, "PX4 log"),
)  # fmt: skip
