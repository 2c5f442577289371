"""The log of finished runs: durable, whole after a kill, unharmed by a full disk."""

import errno
import json
import os

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.compare import study_log as log_module
from hybrid_mpc.compare.study_log import RunLog, RunRow, compact, provenance_of, rows, segments


def row(i, **more):
    status, error = more.pop("status", "done"), more.pop("error", "")
    return RunRow(f"{i:04}", status, error, {"cost": 0.1 * i, **more})


def test_floats_come_back_bit_by_bit(tmp_path):
    values = [0.1 + 0.2, 1e-320, float("inf"), -float("inf"), 5e300]
    with RunLog(tmp_path) as log:
        log.append([row(i, value=v) for i, v in enumerate(values)])
        log.append([])
    assert [r.columns["value"] for r in rows(tmp_path)] == values


def test_segments_are_rolled(tmp_path, monkeypatch):
    monkeypatch.setattr(log_module, "SEGMENT_ROWS", 10)
    for _ in range(2):
        with RunLog(tmp_path) as log:
            for k in range(5):
                log.append([row(k) for _ in range(4)])
    assert len(segments(tmp_path)) == 4  # 40 rows in appends of 4: a file takes 12
    assert len(list(rows(tmp_path))) == 40


@pytest.mark.parametrize("cut", [1, 5, 20])
def test_a_torn_line_is_cut_off(tmp_path, cut):
    with RunLog(tmp_path) as log:
        log.append([row(i) for i in range(3)])
    (path,) = segments(tmp_path)
    path.write_bytes(path.read_bytes()[:-cut])
    assert [r.id for r in rows(tmp_path)] == ["0000", "0001"]
    with RunLog(tmp_path) as log:
        log.append([row(9)])
    assert [r.id for r in rows(tmp_path)] == ["0000", "0001", "0009"]


def test_damage_within_is_named(tmp_path):
    with RunLog(tmp_path) as log:
        log.append([row(i) for i in range(3)])
    (path,) = segments(tmp_path)
    path.write_bytes(path.read_bytes().replace(b'"0001"', b'"00"1"'))
    with pytest.raises(InputError, match=r"000000\.jsonl.*HM-COMPARE-048"):
        list(rows(tmp_path))


def test_one_process_at_a_time(tmp_path):
    with RunLog(tmp_path), pytest.raises(InputError, match="HM-FILES-016"):
        RunLog(tmp_path)
    RunLog(tmp_path).close()


@pytest.mark.parametrize("written", [0, 7, 60])
def test_a_full_disk_leaves_whole_rows(tmp_path, monkeypatch, written):
    log = RunLog(tmp_path)
    log.append([row(1)])
    real, calls = os.write, []

    def full(file, data):
        calls.append(len(data))
        if written and len(calls) == 1:
            return real(file, bytes(data[:written]))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(InputError, match="HM-COMPARE-045"):
        log.append([row(2), row(3)])
    monkeypatch.undo()
    assert [r.id for r in rows(tmp_path)] == ["0001"]
    log.append([row(4)])  # there is room again
    log.close()
    assert [r.id for r in rows(tmp_path)] == ["0001", "0004"]


def test_parquet_has_the_last_row_of_a_run_and_the_provenance(tmp_path):
    import pyarrow.parquet as pq

    with RunLog(tmp_path / "runs") as log:
        log.append([row(1, status="failed", error="x"), row(2, n=3, flag=True, horizon=None)])
        log.append([row(1, cost=7, mixed=1), row(3, mixed=0.5)])
    path = tmp_path / "results.parquet"
    compact(tmp_path / "runs", path, {"study": {"name": "s"}, "noise": float("inf")})
    table = pq.read_table(path).to_pylist()
    assert [(r["id"], r["cost"], r["status"]) for r in table] == [
        ("0002", 0.2, "done"), ("0001", 7.0, "done"), ("0003", 0.1 * 3, "done"),
    ]  # fmt: skip
    assert [(r["n"], r["flag"], r["mixed"]) for r in table] == [
        (3, True, None), (None, None, 1.0), (None, None, 0.5),
    ]  # fmt: skip
    assert provenance_of(path) == {"study": {"name": "s"}, "noise": "inf"}
    other = tmp_path / "other.parquet"
    import pyarrow as pa

    pq.write_table(pa.table({"a": [1]}), other)
    with pytest.raises(InputError, match="HM-COMPARE-050"):
        provenance_of(other)
    other.write_text("nonsense")
    with pytest.raises(InputError, match="HM-COMPARE-049"):
        provenance_of(other)


def test_a_full_disk_at_the_end_keeps_the_log(tmp_path, monkeypatch):
    with RunLog(tmp_path / "runs") as log:
        log.append([row(1)])
    path = tmp_path / "results.parquet"
    path.write_bytes(b"before")

    def full(*given):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="HM-FILES-019"):
        compact(tmp_path / "runs", path, {})
    monkeypatch.undo()
    assert path.read_bytes() == b"before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["results.parquet", "runs"]
    compact(tmp_path / "runs", path, {})
    assert json.dumps(provenance_of(path)) == "{}"
