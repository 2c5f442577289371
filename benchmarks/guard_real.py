"""The guard's monitor on the torque pendulum's real recordings: ``python benchmarks/guard_real.py --model RUN
[--data ../shared/data/torque_pendulum] [--models hybrid prior] [--rate 12] [--out FILE.json] [--pictures FOLDER]``.

RUN is what ``hybrid-mpc run torque_pendulum`` has left. Each recording is judged by limits learned from the clean
windows of the other five alone, from blocks of 1 s (there is a minute of clean data in all). A window is clean where
the recordings' own description says that no hand was on the pendulum. Printed by recording: alarms that begin in clean
windows, and the highest that the scores get there, as shares of their thresholds; samples of clean windows in which an
alarm from before is still on; the alarms outside. With ``--pictures`` a figure of each recording.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from hybrid_mpc import (
    InputError,
    Trace,
    WatchLimits,
    load,
    load_trajectories,
    make_estimator,
    make_monitor,
    make_readings,
    replay,
    rest_speeds,
)
from hybrid_mpc.files import write_json
from hybrid_mpc.records import plain
from hybrid_mpc.watch.learn import limits_of
from hybrid_mpc.watch.lengths import SETTLING_S
from hybrid_mpc.watch.monitor import Monitor
from hybrid_mpc.watch.replay import with_alarms
from scenarios.torque_pendulum import scenario

CLEAN = {
    "energy_shaping_0p9Nm": ((0.0, 5.0), (8.0, 11.0), (13.0, 16.0)),
    "energy_shaping_1p5Nm": ((0.0, 20.0),),
    "sac_0p9Nm": ((0.0, 7.0),),
    "ilqr_0p9Nm": ((0.0, 2.0), (4.0, 9.0), (11.0, 18.0)),
    "ddp_closed_loop": ((0.0, 6.0),),
    "dircol_closed_loop": ((0.0, 3.5),),
}
"""Windows [s] without a hand on the pendulum, as the recordings are described."""
RESOLUTION = 0.0029
"""Step of the encoder [rad]."""
BLOCK_S = 1.0
RATE = 12.0
"""False alarms an hour: the fewest that half a minute of other recordings can be drawn on to (a twentieth of the time
between two of them must be there, for either alarm)."""
TINY = 1e-6
"""Tolerance [s] of comparisons between times: far below a period, above rounding."""


@dataclass(frozen=True)
class HeldOut:
    """A recording, watched with the limits of all others; ``clean`` ``(n,)`` is true in its own clean windows."""

    name: str
    limits: WatchLimits
    trace: Trace
    clean: np.ndarray

    @property
    def inside(self) -> list[tuple[float, float]]:
        """Alarms ``(first, last)`` [s] that begin in a clean window: false ones."""
        return [a for a in self.trace.intervals() if self._begins_clean(a)]

    @property
    def outside(self) -> list[tuple[float, float]]:
        """Alarms ``(first, last)`` [s] that begin outside."""
        return [a for a in self.trace.intervals() if not self._begins_clean(a)]

    @property
    def left_over(self) -> int:
        """Samples of clean windows in which an alarm that began outside is still on."""
        t, clean = self.trace.t, self.clean
        inside = sum(int(np.sum(clean & (t >= a) & (t <= b))) for a, b in self.inside)
        return int(np.sum(self.trace.alarm & clean)) - inside

    @property
    def highest(self) -> tuple[float, float]:
        """Largest shares of the thresholds, forces and power, in clean windows but for their beginning."""
        tops = [one.threshold for one in self.limits.channels]
        scores = np.abs(self.trace.levels / tops)[
            settled_windows(self.trace.t, self.clean, SETTLING_S * self.limits.time_unit)
        ]
        return (float(scores[:, 0].max()), float(scores[:, 1].max())) if len(scores) else (0.0, 0.0)

    def _begins_clean(self, interval: tuple[float, float]) -> bool:
        return bool(self.clean[int(np.argmin(np.abs(self.trace.t - interval[0])))])


def leave_one_out(
    model, estimator, recordings, windows: Mapping[str, Sequence[tuple[float, float]]], *, rate: float,
    resolution: Sequence[float], block_s: float, data_hash: str,
) -> list[HeldOut]:  # fmt: skip
    """Every recording by limits that were learned from the clean windows of all others.

    Each is replayed as a whole, as it would have run online: what happens between the windows is in the monitor's
    memory when the next one begins. Nothing is learned from the first time units of a window.
    """
    stems = [r.file for r in recordings]
    if len(set(stems)) < 2:
        raise InputError(f"leave_one_out: {len(recordings)} recordings given, at least two files are needed")
    if unknown := sorted(set(stems) - set(windows)):
        raise InputError(
            f"leave_one_out: no clean windows given for {unknown}; name them, or leave these out"
        )
    clean = [clean_samples(np.asarray(r.t), windows[stem]) for r, stem in zip(recordings, stems, strict=True)]
    undisturbed = [
        SimpleNamespace(y=y) for r, c in zip(recordings, clean, strict=True) for y in stretches(r.y, c)
    ]
    readings = make_readings(model, rest_speed=rest_speeds(undisturbed, model))
    traces = [replay(Monitor(readings), estimator, r) for r in recordings]
    found = []
    for recording, stem, trace, inside in zip(recordings, stems, traces, clean, strict=True):
        others = [i for i, other in enumerate(stems) if other != stem]
        limits = limits_of(
            readings, [recordings[i].y for i in others], [traces[i] for i in others], false_alarms_per_hour=rate,
            nominal=[clean[i] for i in others], resolution=resolution, data_hash=data_hash, block_s=block_s,
        )  # fmt: skip
        found.append(HeldOut(recording.name, limits, with_limits(model, limits, trace), inside))
    return found


def with_limits(model, limits: WatchLimits, trace: Trace) -> Trace:
    """The trace with the levels and alarms of other limits."""
    return with_alarms(make_monitor(model, limits), trace)


def clean_samples(t, windows: Sequence[tuple[float, float]]):
    """True where ``t`` ``(n,)`` lies in one of the windows; a window's end is no longer in it."""
    inside = np.zeros(len(t), dtype=bool)
    for start, end in windows:
        inside |= (t >= start - TINY) & (t < end - TINY)
    return inside


def settled_windows(t, clean, settling: float):
    """The clean samples but for the first ``settling`` seconds of each window, in which the monitor remembers."""
    begun, settled = float("nan"), np.zeros(len(t), dtype=bool)
    for k, inside in enumerate(clean):
        begun = float("nan") if not inside else t[k] if begun != begun else begun
        settled[k] = inside and t[k] >= begun + settling - TINY
    return settled


def stretches(rows, chosen) -> list:
    """The rows of each stretch that is chosen."""
    cuts = np.flatnonzero(np.diff(chosen.astype(int))) + 1
    pieces = zip(np.split(rows, cuts), np.split(chosen, cuts), strict=True)
    return [part for part, inside in pieces if inside.any()]


def read(folder: Path, model):
    """All recordings, whole, on the model's grid."""
    files = [folder / f"{name}.csv" for name in CLEAN]
    return load_trajectories(files, model, replace(scenario.data, windows={}))


def judge(model, sigma_x, data, rate: float = RATE) -> list[HeldOut]:
    """Every recording, by the limits of the others."""
    return leave_one_out(
        model, make_estimator(model, scenario, np.asarray(sigma_x)), data.whole, CLEAN,
        rate=rate, resolution=[RESOLUTION], block_s=BLOCK_S, data_hash=data.hash,
    )  # fmt: skip


def row_of(found: HeldOut, dt: float) -> dict:
    """What a table says of a recording."""
    return {
        "recording": found.name,
        "clean_s": float(found.clean.sum() * dt),
        "false_alarms": found.inside,
        "highest_forces": found.highest[0],
        "highest_power": found.highest[1],
        "left_over_s": found.left_over * dt,
        "outside_s": float((~found.clean).sum() * dt),
        "alarms_outside": found.outside,
        "share_outside": float(found.trace.alarm[~found.clean].mean()) if not found.clean.all() else None,
        "limits": plain(found.limits),
    }


def table(rows) -> list[str]:
    """Markdown lines."""
    lines = [
        "| recording | clean | false alarms | highest: forces, power | left over | alarms outside [s] |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for r in rows:
        outside = ", ".join(f"{a:.2f} to {b:.2f}" for a, b in r["alarms_outside"]) or "–"
        lines.append(
            f"| `{r['recording']}` | {r['clean_s']:.1f} s | {len(r['false_alarms'])} | {r['highest_forces']:.2f}, "
            f"{r['highest_power']:.2f} | {r['left_over_s']:.2f} s | {outside} |"
        )
    seconds, alarms = sum(r["clean_s"] for r in rows), sum(len(r["false_alarms"]) for r in rows)
    # Poisson: no event in T bounds the rate at 3.00 / T with 95 %
    bound = f", at most {-np.log(0.05) / seconds * 3600:.0f} an hour (95 %)" if not alarms else ""
    return [*lines, f"{alarms} false alarms in {seconds:.1f} s of clean windows{bound}"]


def picture(found: HeldOut, y, path: Path, title: str) -> None:
    """Everything the monitor says, alarms shaded; clean windows as bars at the bottom."""
    from hybrid_mpc.plots.monitor import channels
    from hybrid_mpc.plots.style import save
    from scenarios.torque_pendulum.prior import TorquePendulumPrior

    figure = channels(
        found.trace,
        y,
        outputs=TorquePendulumPrior.outputs,
        limits=found.limits,
        windows=CLEAN[found.name],
        title=title,
    )
    save(figure, path)


def main() -> None:
    """Print tables; write JSON and figures where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="folder of a run of torque_pendulum")
    parser.add_argument("--data", type=Path, default=Path("../shared/data/torque_pendulum"))
    parser.add_argument("--models", nargs="+", default=["hybrid", "prior"], choices=["hybrid", "prior"])
    parser.add_argument("--rate", type=float, default=RATE, help="wanted false alarms an hour")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--pictures", type=Path, help="folder for a figure of each recording")
    given = parser.parse_args()
    artifact = load(given.model / "model")
    noise = artifact.loop.process_noise
    result = {}
    for name in given.models:
        model = artifact.models[name]
        data = read(given.data, model)
        found = judge(model, noise[f"{name}_observer"], data, given.rate)
        rows = [row_of(f, model.dt) for f in found]
        print(f"\n{name}, {given.rate:g} false alarms an hour wanted\n")
        print("\n".join(table(rows)), flush=True)
        result[name] = {"rate": given.rate, "data_hash": data.hash, "recordings": rows}
        if given.pictures is not None:
            for f, recording in zip(found, data.whole, strict=True):
                path = given.pictures / f"guard_torque_pendulum_{f.name}_{name}.png"
                picture(f, recording.y, path, f"{f.name}, {name}, calibrated on the others")
    if given.out is not None:
        write_json(given.out, result)


if __name__ == "__main__":
    main()
