"""Faults in recordings of real machines: found by the monitor's residuals or not, by which channel, how late.

    python benchmarks/recorded_faults.py DATA [--out FILE.json]

``DATA`` is the folder of the recordings, one folder a machine. The fitted prior is the model (no network); prior and
observer are fitted to the machine's recordings for identification alone. Limits are learned from its last part, which
the prior was not fitted to, and from one clean recording of another day; the other clean one tells false alarms, and
then the two change places. Which faults there are, and when, is read from the recordings' own columns and description,
and nothing of them is used but to judge.

A fault is found where a channel begins to alarm that did not just before, between its onset and its end. It is *named*
where the diagnosis has the broken component among what it says, the sensor (its gain or offset) or the actuator
(alike); a measured disturbance, where its own channel is the one that alarms.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_mpc import (
    Diagnoser,
    ExtendedKalmanFilter,
    HybridModel,
    Monitor,
    ResidualReadings,
    Scenario,
    Trace,
    Trajectory,
    fit_prior,
    learn_limits,
    load_scenario,
    model_info,
    process_noise,
    replay,
)
from hybrid_mpc.data.scales import noise_of, time_unit
from hybrid_mpc.estimate.tuning import choose_most_likely
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.fit import with_states
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.kit.assembly import first_deviations
from hybrid_mpc.watch.replay import stretches
from hybrid_mpc.workflow.benchmark_runs import benchmark_of, read_test, read_training
from hybrid_mpc.workflow.stages.watch import rates

SCALES = (0.3, 1.0, 3.0, 10.0)
"""Candidate factors on the model's errors of a period; the likeliest on the training recording gives the noise."""


@dataclass(frozen=True)
class Machine:
    """Files of a machine: to identify, clean ones that change places, with faults; and what is watched."""

    train: tuple[str, ...]
    clean: tuple[str, str]
    faulty: tuple[str, ...]
    measured: bool = True
    """Whether the measured disturbance is given to the model, or the operating point's value in place of it."""


MACHINES = {
    "temperature_lab": Machine(("prbs",), ("setpoints_1", "setpoints_5"), ("faults_1", "faults_5")),
    "heat_exchanger": Machine(
        ("random_steps_jun16",), ("staircase_jun10", "staircase_jun11"), ("fault_jun09_heater_off",)
    ),
    "heat_exchanger, reservoir not measured": Machine(
        ("random_steps_jun16",), ("staircase_jun10", "staircase_jun11"), ("fault_jun09_heater_off",), False
    ),
    "double_pendulum": Machine(
        ("sines_143339", "sines_143524", "sines_143601", "sines_143704"),
        ("sines_143747", "sines_144003"),
        ("acrobot_pushed_01", "pendubot_pushed_01"),
    ),
}
PUSHED = 0.02
"""Torque [N m] beyond which a push of the double pendulum counts: its recorded pulses are bells."""
LEFT = 0.5
"""Time [s] after a push in which an alarm counts neither as found nor as false."""
HEATER_OFF = 4500.0
"""Time [s] from which on the heat exchanger's reservoir is no longer heated (README of the recordings)."""


@dataclass(frozen=True)
class Known:
    """A fault that a recording is known to hold."""

    start: float
    end: float
    components: tuple[str, ...]
    """Signals of the model that are broken."""
    words: str


@dataclass(frozen=True)
class Row:
    """What became of a fault; of a clean recording ``fault`` is empty, and ``alarms`` are the false ones."""

    machine: str
    limits_from: str
    recording: str
    fault: str
    start_s: float
    delay_s: float | None
    channels: str
    diagnosis: str
    named: str
    alarms: int
    hours: float


def faults_of(path: Path) -> list[Known]:
    """The faults that a recording holds, from its columns: offsets of the temperature lab, torques that push the double
    pendulum; else the reservoir's.
    """
    if "_pushed_" in path.stem:
        return pushes_of(path)
    if path.stem.startswith("fault_"):
        return [Known(HEATER_OFF, np.inf, ("reservoir",), "reservoir's heater off")]
    with path.open() as file:
        rows = list(csv.DictReader(file))
    columns = [name for name in rows[0] if name.endswith(("_offset_degc", "_offset_pct"))]
    found: list[Known] = []
    before: dict[str, float] = {}
    for row in rows:
        now = {name: float(row[name]) for name in columns if float(row[name])}
        if now != before:
            if before:
                found[-1] = replace(found[-1], end=float(row["time_s"]))
            if now:
                parts = [
                    (re.sub(r"sensor(\d).*", r"temperature\1", re.sub(r"heater(\d).*", r"power\1", k)), v)
                    for k, v in now.items()
                ]
                words = ", ".join(f"{name} {v:+g}" for name, v in parts)
                found.append(Known(float(row["time_s"]), np.inf, tuple(n for n, _ in parts), words))
            before = now
    return found


def pushes_of(path: Path) -> list[Known]:
    """Every push that a recording of the double pendulum holds, in the order of time."""
    table, found = np.genfromtxt(path, delimiter=",", names=True), []
    for joint in (1, 2):
        push, t = table[f"push{joint}_nm"], table["time_s"]
        for first, last in zip(*stretches(np.abs(push) > PUSHED), strict=True):
            pulse = push[first : last + 1]
            most = pulse[np.argmax(np.abs(pulse))]
            found.append(
                Known(float(t[first]), float(t[last]), (f"tau{joint}",), f"push at tau{joint} {most:+.2f}")
            )
    return sorted(found, key=lambda known: known.start)


@dataclass(frozen=True)
class Assumed:
    """What the filter's first deviations are made of."""

    sensor_sigma: tuple[float, ...]
    first_sigma: None = None


def identified(
    scenario: Scenario, paths: list[Path]
) -> tuple[HybridModel, ExtendedKalmanFilter, tuple[Trajectory, ...]]:
    """The fitted prior as a model, its filter, and the part of the recording that the prior was not fitted to."""
    dt, spec = scenario.data.dt, benchmark_of(scenario)
    known = read_training(scenario, paths)
    fit = fit_prior(
        scenario.prior, known.train, known.valid, dt=dt, length=spec.length or spec.piece,
        largest_delay=scenario.data.largest_delay,
    )  # fmt: skip
    prior = scenario.prior(fit.values)
    info = replace(model_info(prior, dt), input_delay=fit.delay, time_unit=time_unit(known.dataset.whole, dt))
    programs = {f"prior/{name}": program for name, program in prior_programs(prior, dt, fit.substeps).items()}
    model = build_model("prior", programs, info)
    smoothed = with_states(known.train, fit.smoother(prior, dt), fit.delay)
    base, sigma = process_noise(model, smoothed), noise_of(known.train)
    first = first_deviations(model, Assumed(tuple(sigma.tolist())))  # type: ignore[arg-type]

    def filter_of(scale: float) -> ExtendedKalmanFilter:
        return ExtendedKalmanFilter(model, sigma_y=sigma, sigma_x=scale * base, sigma_x0=first)

    chosen = choose_most_likely(filter_of, shifted(known.train, 0.0), SCALES)
    print(
        f"{scenario.name}: {fit.values}, delay {fit.delay:.3g} s; filter: sensors {sigma}, states {chosen * base}"
    )
    return model, filter_of(chosen), known.valid


def watched(monitor: Monitor, estimator: ExtendedKalmanFilter, recording: Trajectory) -> tuple[Trace, list]:
    """Trace and estimates of a recording."""
    estimates: list = []
    trace = replay(monitor, estimator, recording, on_sample=lambda k, e: estimates.append(e))
    return trace, estimates


def judged(
    known: Known, trace: Trace, estimates: list, recording: Trajectory, diagnoser: Diagnoser
) -> tuple[float | None, str, str, str]:
    """Delay [s], channels, diagnosis and what of the fault it names."""
    on = np.hstack([trace.on, trace.frozen])
    names = trace.names
    rises = on & ~np.vstack([np.zeros_like(on[:1]), on[:-1]])
    within = (trace.t >= known.start - 1e-6) & (trace.t < known.end - 1e-6)
    found = np.flatnonzero(rises.any(axis=1) & within)
    if not found.size:
        return None, "", "", ""
    k = int(found[0])
    channels = ", ".join(name for name, rose in zip(names, rises[k], strict=True) if rose)
    text = diagnoser.of_alarm(k, trace, recording, estimates)
    said = "" if text.startswith("none") else text
    measured = {s.name for s in diagnoser.model.disturbances}.intersection(channels.split(", "))
    named = [
        name
        for name in known.components
        if name in measured or re.search(rf"(gain|offset) of {name}\b", said)
    ]
    return float(trace.t[k]) - known.start, channels, text, ", ".join(named)


def study(name: str, data: Path) -> list[Row]:
    """All rows of a machine."""
    machine, folder = MACHINES[name], data / name.split(",")[0]
    scenario = load_scenario(name.split(",")[0])
    model, estimator, held = identified(scenario, [folder / f"{stem}.csv" for stem in machine.train])

    def read(stem: str) -> list[Trajectory]:
        return [given(run) for run in read_test(scenario, folder / f"{stem}.csv")]

    def given(run: Trajectory) -> Trajectory:
        return run if machine.measured else replace(run, w=np.tile(model.w, (len(run.t), 1)))

    clean = {stem: read(stem) for stem in machine.clean}
    rows: list[Row] = []
    for own, other in (machine.clean, machine.clean[::-1]):
        learned = [given(run) for run in held] + clean[own]
        readings = ResidualReadings(model)
        limits = learn_limits(readings, estimator, learned, false_alarms_per_hour=rates(scenario, model))
        monitor, diagnoser = Monitor(readings, limits), Diagnoser(model, limits)
        told = "; ".join(f"{c.channel} {c.words(limits.dt)}" for c in limits.channels)
        print(f"limits from {own}: {limits.method}; {told}")
        label = f"{', '.join(machine.train)} (not fitted to), {own}"
        for run in clean[other]:
            trace, _ = watched(monitor, estimator, run)
            starts, _ = stretches(trace.alarm)
            told = "; ".join(f"{c} at {i[0][0]:g} s" for c, i in trace.by_channel().items())
            hours = len(run.t) * model.dt / 3600
            rows.append(Row(name, label, run.name, "", 0.0, None, told, "", "", len(starts), hours))
        for stem in machine.faulty:
            for run in read(stem):
                trace, estimates = watched(monitor, estimator, run)
                every = faults_of(folder / f"{stem}.csv")
                first = every[0].start
                before, words = trace.t < first - 1e-6, "before its faults"
                if (
                    "_pushed_" in stem
                ):  # pulses: what lies between them is clean, too, but for what a push leaves
                    inside = [(trace.t >= f.start - 1e-6) & (trace.t < f.end + LEFT) for f in every]
                    before, words = ~np.any(inside, axis=0), f"but its pushes and {LEFT:g} s after each"
                starts, _ = stretches(trace.alarm & before)
                told = "; ".join(
                    f"{c} at {i[0][0]:g} s" for c, i in trace.by_channel().items() if i[0][0] < first
                )
                hours = float(before.sum()) * model.dt / 3600
                if before.any():
                    rows.append(
                        Row(
                            name,
                            label,
                            f"{run.name} {words}",
                            "",
                            0.0,
                            None,
                            told,
                            "",
                            "",
                            len(starts),
                            hours,
                        )
                    )
                for fault in every:
                    if trace.t[0] <= fault.start <= trace.t[-1]:
                        outcome = judged(fault, trace, estimates, run, diagnoser)
                        rows.append(Row(name, label, run.name, fault.words, fault.start, *outcome, 0, 0.0))
    return rows


def table(rows: list[Row]) -> str:
    """Faults and clean recordings as Markdown."""
    lines = [
        "| machine | limits from | recording | fault | at [s] | delay [s] | first channels | diagnosis | named |"
    ]
    lines.append("| " + " | ".join(["---"] * 9) + " |")
    for r in (r for r in rows if r.fault):
        delay = "not found" if r.delay_s is None else f"{r.delay_s:g}"
        words = (
            r.machine,
            r.limits_from,
            r.recording,
            r.fault,
            f"{r.start_s:g}",
            delay,
            r.channels,
            r.diagnosis,
            r.named,
        )
        lines.append("| " + " | ".join(w or "–" for w in words) + " |")
    lines += [
        "",
        "| machine | limits from | clean recording | hours | false alarms | of |",
        "| " + " | ".join(["---"] * 6) + " |",
    ]
    for r in (r for r in rows if not r.fault):
        words = (r.machine, r.limits_from, r.recording, f"{r.hours:.2g}", str(r.alarms), r.channels or "–")
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines)


def summary(rows: list[Row]) -> list[str]:
    """Counts by machine."""
    found = []
    for name in dict.fromkeys(r.machine for r in rows):
        faults = [r for r in rows if r.machine == name and r.fault]
        seen = [r for r in faults if r.delay_s is not None]
        clean = [r for r in rows if r.machine == name and not r.fault]
        wanted = sum(len(r.fault.split(", ")) for r in faults)
        named = sum(len(r.named.split(", ")) for r in faults if r.named)
        delay = f", median delay {np.median([r.delay_s for r in seen]):g} s" if seen else ""
        found.append(
            f"{name}: {len(seen)} of {len(faults)} faults found{delay}; {named} of {wanted} broken components named; "
            f"{sum(r.alarms for r in clean)} false alarms in {sum(r.hours for r in clean):.2g} h"
        )
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the machines' recordings")
    parser.add_argument("--machines", nargs="+", default=[*MACHINES], choices=[*MACHINES])
    parser.add_argument("--out", type=Path, help="JSON file to write; without it, JSON follows the table")
    given = parser.parse_args()
    rows = [row for name in given.machines for row in study(name, given.data)]
    print("", table(rows), "", *summary(rows), sep="\n")
    text = json.dumps({"rows": [asdict(r) for r in rows], "summary": summary(rows)}, indent=1)
    if given.out is None:
        print(text)
    else:
        given.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
