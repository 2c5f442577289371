"""Signals of one file that have clocks of their own, brought to one table by the rules of their roles."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.source import LARGEST, Columns, Source
from hybrid_mpc.errors import InputError
from hybrid_mpc.records import shown

Array = NDArray[np.float64]
ROUNDING, SHARE = 5e-7, 1e-3
"""Stamps of two clocks are one where they differ by less: in their unit, and in steps of the fastest clock."""
TIME = "time [s]"  # name of the time of files whose signals have clocks of their own


@dataclass(frozen=True)
class Series:
    """A signal of a file: its time stamps ``t`` ``(m,)`` [s] and numbers ``(m,)``; ``fault`` is what is wrong."""

    name: str
    t: Array
    values: Array
    fault: str = ""


def clocked(path: Path, sha256: str, series: Sequence[Series], time: str = TIME, note: str = "") -> Source:
    """A source of signals with clocks of their own.

    The rows are all stamps of the signals that are asked for. A column that may have blank cells (an output, a
    disturbance) has a number where it was sampled, and none between; all others (inputs) hold their last number, and
    rows before their first one are left out.
    """
    series = [_once(one) for one in series]
    by_name = {one.name: one for one in series}
    found = {one.name: fault for one in series if (fault := one.fault or _disorder(one))}

    def read(asked: str | None, wanted: Sequence[str], blanks: Collection[str]) -> Columns:
        names = [*([] if asked is None else [asked]), *wanted]
        faults = {name: found[name] for name in names if name in found}
        sound = [by_name[name] for name in names if name != time and name not in found]
        stamps = [one.t for one in sound] or [one.t for one in series if one.name not in found]
        t = _joined(stamps)
        if 8 * len(t) * len(names) > LARGEST:
            raise InputError(
                f"{path}: {len(names)} signals at {len(t)} stamps are more numbers than are read. Name fewer of them."
            )
        values = np.full((len(t), len(names)), np.nan)
        first = t[0] if len(t) else 0.0
        for j, name in enumerate(names):
            if name == time:
                values[:, j] = t
                continue
            one = by_name[name]
            if name in faults or not len(one.t):
                continue
            if name in blanks:
                values[np.searchsorted(t, _onto(one.t, t)), j] = one.values
                continue
            known = np.isfinite(one.values)
            at = np.searchsorted(_onto(one.t[known], t), t, side="right") - 1
            values[:, j] = (
                np.where(at >= 0, one.values[known][np.maximum(at, 0)], np.nan) if known.any() else np.nan
            )
            first = max(first, float(t[np.argmax(at >= 0)])) if known.any() else first
        rows = t >= first
        return Columns(values[rows], "sample", range(1, int(rows.sum()) + 1), faults)

    if len(by_name) < len(series):
        raise InputError(f"{path}: two signals have the same name and the same clock. Rename one.")
    return Source(path, sha256, (time, *by_name), read, note)


def _once(one: Series) -> Series:
    """A signal without samples that stand twice."""
    again = (one.t[1:] == one.t[:-1]) & (one.values[1:] == one.values[:-1])
    keep = np.r_[np.ones(min(1, len(one.t)), bool), ~again]
    return one if keep.all() else replace(one, t=one.t[keep], values=one.values[keep])


def _joined(stamps: Sequence[Array]) -> Array:
    """All stamps of several clocks; those that differ by rounding alone are one."""
    t = np.unique(np.concatenate([np.zeros(0), *stamps]))
    steps = [float(np.median(np.diff(one))) for one in stamps if len(one) > 1]
    least = min([ROUNDING, *(SHARE * step for step in steps if step > 0)])
    return t[np.r_[True, np.diff(t) > least]] if len(t) else t


def _onto(stamps: Array, t: Array) -> Array:
    """Stamps as they stand among those of all clocks."""
    found: Array = t[np.searchsorted(t, stamps, side="right") - 1]
    return found


def _disorder(one: Series) -> str:
    """Where the stamps of a signal do not increase; empty where all do."""
    falls = np.diff(one.t) <= 0
    if not falls.any():
        return ""
    k = int(np.argmax(falls))
    return (
        f"column {shown(one.name)}: sample {k + 2} is at {one.t[k + 1]:.10g} s, the one before at {one.t[k]:.10g} s. "
        "Time stamps must increase: delete the repeated samples, or split the file."
    )
