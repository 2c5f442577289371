"""Does ``hybrid-mpc new`` tell inputs, outputs and set-points of machines from their recordings, without options?

    python benchmarks/new_scenarios.py machines   # eleven measured machines and four cases from outside the repository
    python benchmarks/new_scenarios.py nameless   # the same recordings, columns called c0, c1, ...
    python benchmarks/new_scenarios.py simulated  # scenarios that make their own recordings, and textbook machines
    python benchmarks/new_scenarios.py made-up    # small loops of known structure, nameless

A machine is right where inputs, outputs and set-points are those of ``MACHINES`` in all its groups of recordings: they
say what the README beside the recordings says; of simulated machines those of their own scenario. Measured torques of a
drive whose command is recorded, flags and faults are no signals. Measured disturbances are shown and not counted. A
machine whose recordings are not there is left out by name. Prints a Markdown table; ``--out FILE.json`` writes it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import DataSpec, InputError, load_scenario
from hybrid_mpc.check.new import Draft, draft_scenario
from hybrid_mpc.data.files import opened
from hybrid_mpc.data.names import said_by

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Group:
    """Recordings of a machine that are read together, by patterns of their names, and what their columns are."""

    files: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    set_points: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()


HEATERS, TEMPERATURES = ("heater1_pct", "heater2_pct"), ("temperature1_degc", "temperature2_degc")
STATES = ("pos_rad", "vel_rad_s")
DRONE = Group(("*.csv",), ("Controle_u",), ("Saida_y",), ("Referencia",))
MACHINES: dict[str, tuple[Group, ...]] = {
    "data/cascaded_tanks": (Group(("*.csv",), ("pump_v",), ("level_v",)),),
    "data/coupled_drives": (Group(("*.csv",), ("u_v",), ("speed",)),),
    "data/double_pendulum": (
        Group(
            ("*.csv",), ("tau1_command_nm", "tau2_command_nm"),
            ("q1_rad", "q2_rad", "dq1_rad_s", "dq2_rad_s"),
        ),
    ),
    "data/emps": (Group(("*.mat",), ("vir",), ("qm",), ("qg",)),),
    "data/heat_exchanger": (Group(("*.csv",), ("valve",), ("outlet_degc",), (), ("reservoir_degc",)),),
    "data/quarter_drone": (DRONE,),
    "data/race_car": (
        Group(
            ("*.csv",), ("steering_rad", "speed_command_m_s"), ("x_m", "y_m", "heading_rad", "speed_m_s")
        ),
    ),
    "data/temperature_lab": (
        Group(("prbs.csv",), HEATERS, TEMPERATURES),
        Group(("setpoints_*.csv",), HEATERS, TEMPERATURES, ("setpoint1_degc", "setpoint2_degc")),
        Group(("faults_*.csv",), HEATERS, TEMPERATURES),  # set-points that do not move
    ),
    "data/torque_pendulum": (
        Group(("energy*.csv", "sac*.csv", "ilqr*.csv"), ("tau_cmd_Nm",), STATES),
        Group(("*_closed_loop.csv",), ("tau_meas_Nm",), STATES),  # the drive adds to its feed-forward
    ),
    "data/unbalanced_disk": (Group(("*.npz",), ("u",), ("th",)),),
    "data/xl330_pendulum": (Group(("*.csv",), ("duty",), STATES, ("goal_rad",), ("supply_V",)),),
    "cases/propeller_arm": (Group(("*.csv",), ("command_pct",), ("angle_deg",), ("reference_deg",)),),
    "cases/quarter_drone": (DRONE,),
    "cases/rotary_pendulum": (Group(("*.csv",), ("voltage",), ("theta", "alpha")),),
    "cases/stirred_tank": (Group(("*.csv",), ("T_coolant_K",), ("T_reactor_K",), (), ("T_feed_K",)),),
}  # fmt: skip
"""By the folder of their recordings, eleven measured machines and four cases."""


def row_of(name: str, group: Group, files: Sequence[Path], names: Mapping[str, str]) -> dict[str, Any]:
    """What is found in a group of recordings beside what is true; ``names`` are the files' names by the true ones."""
    row: dict[str, Any] = {"machine": name, "recordings": len(files)}
    back = {there: true for true, there in names.items()}
    try:
        draft = draft_scenario([opened(file) for file in files], (), (), "")
    except InputError as error:
        return row | {"inputs": "refused", "outputs": str(error), "right": False}
    found = {
        "inputs": [c.full for c in draft.inputs],
        "outputs": [c.full for c in draft.outputs],
        "set_points": [c.full for c in draft.set_points],
        "disturbances": [c.full for c in draft.disturbances],
    }
    found = {key: [back.get(name, name) for name in group_of] for key, group_of in found.items()}
    counted = ("inputs", "outputs", "set_points")
    right = all(set(found[key]) == set(getattr(group, key)) for key in counted)
    return row | found | {"said": said_of(draft), "right": right}


def said_of(draft: Draft) -> str:
    """What is said of loop and stability."""
    return ("unstable, " if draft.growth else "") + ("closed loop" if draft.loop else "open loop")


def recordings_of(folder: Path, scratch: Path) -> Path:
    """Where a machine's recordings are; those of a case are simulated, or measured and beside it."""
    if (folder / "make.py").is_file():
        subprocess.run([sys.executable, str(folder / "make.py"), str(scratch)], check=True)
        return scratch
    return folder if folder.parent.name == "data" else folder.parents[1] / "data" / folder.name


def without_names(files: Sequence[Path], group: Group, scratch: Path) -> tuple[list[Path], dict[str, str]]:
    """The recordings with columns called c0, c1, ...; the time keeps its name. Returned are files and names."""
    scratch.mkdir(parents=True)
    written, names = [], dict[str, str]()
    for file in files:
        source = opened(file)
        kept = []
        for full in source.header:
            values = source.read(None, [full], [full]).values[:, 0]
            if said_by(full).kind:
                kept.append((full, values))
            elif len(values) > 1:
                names.setdefault(full, f"c{len(names)}")
                kept.append((names[full], values))
        written.append(scratch / f"{file.stem}.npz")
        np.savez(written[-1], **dict(kept))  # type: ignore[arg-type]
    return written, names


def machines(shared: Path, nameless: bool, only: Sequence[str] = ()) -> Iterator[dict[str, Any]]:
    """A row for each group of recordings of each machine that is there."""
    for name, groups in MACHINES.items():
        if only and name.split("/")[1] not in only and name not in only:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            if not (shared / name).is_dir():
                yield {"machine": name, "recordings": 0, "inputs": "left out: its folder is not there"}
                continue
            folder = recordings_of(shared / name, Path(scratch) / "made")
            for k, group in enumerate(groups):
                files = sorted({file for pattern in group.files for file in folder.glob(pattern)})
                names: dict[str, str] = {}
                if nameless:
                    files, names = without_names(files, group, Path(scratch) / f"nameless_{k}")
                yield row_of(name, group, files, names)


SIMULATED = (
    "cart_pole", "dc_motor", "golf_robot", "lever", "pendulum", "two_heaters", "two_link_arm", "two_tanks",
)  # fmt: skip
"""Scenarios that make their own recordings."""


def simulated() -> Iterator[dict[str, Any]]:
    """A row for each simulated machine: those of scenarios, and the textbook machines of ``unknown_machines.py``."""
    from unknown.motion import MOTION
    from unknown.processes import PROCESSES

    makers: list[tuple[str, DataSpec, Callable[[Path], Sequence[Path]]]] = [
        (machine.name, machine.spec, machine.write) for machine in (*PROCESSES, *MOTION)
    ]
    for name in SIMULATED:
        scenario = load_scenario(name)
        makers.append((name, scenario.data, partial(scenario.make_data, seed=0, budget="quick")))
    for name, spec, make in makers:
        with tempfile.TemporaryDirectory() as folder:
            group = Group((), spec.inputs, spec.outputs, (), spec.disturbances)
            yield row_of(name, group, make(Path(folder)), {})


# Made-up recordings


def lagged(
    u: Array, gain: float, steps: float, rng: np.random.Generator, noise: float, start: float = 0.0
) -> Array:
    """A lag of first order of an input that is held."""
    x, out = start, np.zeros(len(u))
    for k, value in enumerate(u):
        out[k] = x
        x += (gain * value - x) / steps
    return out + noise * rng.standard_normal(len(u))


def steps_of(rng: np.random.Generator, m: int, hold: int, low: float = -1.0, high: float = 1.0) -> Array:
    """Random steps."""
    return np.repeat(rng.uniform(low, high, m // hold + 1), hold)[:m]


def smooth_of(rng: np.random.Generator, m: int, slowest: float = 0.002, fastest: float = 0.03) -> Array:
    """A sum of sines."""
    t = np.arange(m)
    waves = [np.sin(2 * np.pi * f * t + rng.uniform(0, 6.3)) for f in rng.uniform(slowest, fastest, 8)]
    return np.sum(waves, axis=0) / 2


def process(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A heated tank: power in steps, a drifting inflow that is measured, a coarse sensor."""
    m = 3000
    power, inflow = steps_of(rng, m, 60, 0, 100), np.cumsum(0.05 * rng.standard_normal(m))
    heat = lagged(power, 0.4, 40, rng, 0.0) + lagged(inflow, 0.8, 15, rng, 0.0)
    sensor = np.round(20 + heat + 0.05 * rng.standard_normal(m), 1)
    return {"f": sensor, "g": power, "h": inflow}, Group((), ("g",), ("f",), (), ("h",))


def smooth_process(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A motor in open loop: a sum of sines in, two outputs one after the other."""
    u = smooth_of(rng, 4000)
    speed = lagged(u, 3.0, 12, rng, 0.005)
    place = np.cumsum(lagged(speed, 1.0, 30, rng, 0.0)) * 0.01 + 0.002 * rng.standard_normal(4000)
    return {"f": place, "g": speed, "h": u}, Group((), ("h",), ("f", "g"))


def servo(rng: np.random.Generator, reference: Array) -> dict[str, Array]:
    """A carriage with friction under a PID controller of 1 kHz; place, speed, reference, command."""
    x, v, whole, rows = 0.0, 0.0, 0.0, []
    before = 0.0
    for r in reference:
        y = x + 0.0005 * rng.standard_normal()
        whole += 0.02 * (r - y)
        u = float(np.clip(40 * (r - y) + 25 * whole - 60 * (y - before) / 1.0 - 8 * v, -10, 10))
        before = y
        rows.append((y, v + 0.01 * rng.standard_normal(), r, u))
        v += 0.02 * (u - 2.0 * v - 0.3 * np.tanh(v / 0.01))
        x += 0.02 * v
    return dict(zip("fghi", np.array(rows).T, strict=True))


def servo_smooth(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """The carriage follows a sum of sines."""
    return servo(rng, smooth_of(rng, 4000, 0.0005, 0.003)), Group((), ("i",), ("f", "g"), ("h",))


def servo_steps(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """The carriage follows steps."""
    return servo(rng, steps_of(rng, 4000, 250)), Group((), ("i",), ("f", "g"), ("h",))


def heating(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A room under a PI controller: set-point in steps, an outside temperature that is measured."""
    m, x, y, whole, rows = 4000, 15.0, 15.0, 0.0, []
    goal, outside = steps_of(rng, m, 200, 17, 24), 5 + 3 * smooth_of(rng, m, 0.0005, 0.002)
    for r, w in zip(goal, outside, strict=True):
        measured = y + 0.05 * rng.standard_normal()
        whole = float(np.clip(whole + 0.05 * (r - measured), 0, 100))
        u = float(np.clip(6 * (r - measured) + whole, 0, 100))
        rows.append((u, measured, w, r))
        x += (w + 0.3 * u - x) / 60
        y += (x - y) / 15
    return dict(zip("fghi", np.array(rows).T, strict=True)), Group((), ("f",), ("g",), ("i",), ("h",))


def loop_without_reference(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A level held against unmeasured outflow by a PI controller; no set-point is recorded."""
    x, whole, w, rows = 0.0, 0.0, 0.0, []
    for _ in range(4000):
        y = x + 0.01 * rng.standard_normal()
        whole -= 0.01 * y
        u = -2.0 * y + whole
        rows.append((y, u))
        w += 0.05 * (rng.standard_normal() - 0.2 * w)
        x += 0.1 * (u - w - 0.2 * x)
    return dict(zip("fg", np.array(rows).T, strict=True)), Group((), ("g",), ("f",))


def unstable(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A pole upright on a cart, held by state feedback with a binary signal on top; encoders."""
    x, v, a, w, rows = 0.0, 0.0, 0.02, 0.0, []
    last, dt = (0.0, 0.02), 0.01
    probe = np.repeat(rng.choice([-1.0, 1.0], 400), 15)
    for k in range(6000):
        y = round(x / 5e-4) * 5e-4, round(a / 1.5e-3) * 1.5e-3
        rate = (y[0] - last[0]) / dt, (y[1] - last[1]) / dt
        last = y
        u = 4 * y[0] + 5 * rate[0] + 60 * y[1] + 10 * rate[1] + probe[k]
        rows.append((y[1], u, y[0]))
        v, w = v + dt * (u - 2 * v), w + dt * (15 * a - 1.5 * (u - 2 * v) - 0.1 * w)
        x, a = x + dt * v, a + dt * w
    return dict(zip("fgh", np.array(rows).T, strict=True)), Group((), ("g",), ("f", "h"))


def copies(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A valve with its command before and after a limit and in another unit, a switch, an output in two units."""
    m = 2000
    wanted = steps_of(rng, m, 40, -20, 120)
    sent = np.clip(wanted, 0, 100)
    y = lagged(sent, 0.3, 20, rng, 0.05)
    switch = (np.arange(m) > m // 3) * 1.0
    return (
        {"e": wanted, "f": sent, "g": sent / 100, "h": y, "i": y + 273.15, "j": switch},
        Group((), ("f",), ("h",)),
    )


def relay(rng: np.random.Generator) -> tuple[dict[str, Array], Group]:
    """A heater that is on or off drives; two levels are no flag where nothing else drives."""
    u = np.repeat(rng.integers(0, 2, 120), 25).astype(float)
    return {"f": lagged(u, 50.0, 60, rng, 0.1), "g": u}, Group((), ("g",), ("f",))


Made = Callable[[np.random.Generator], tuple[dict[str, Array], Group]]
MADE_UP: tuple[Made, ...] = (
    process, smooth_process, servo_smooth, servo_steps, heating, loop_without_reference, unstable, copies, relay,
)  # fmt: skip


def made_up(seeds: int) -> Iterator[dict[str, Any]]:
    """A row for each made-up machine: how many of the seeds are right, and the last one's columns."""
    for make in MADE_UP:
        rows = []
        for seed in range(seeds):
            table, group = make(np.random.default_rng(seed))
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "made.npz"
                m = len(next(iter(table.values())))
                np.savez(file, t=0.01 * np.arange(m), **table)  # type: ignore[arg-type]
                rows.append(row_of(make.__name__, group, [file], {}))
        count = sum(row["right"] for row in rows)
        shown = next((row for row in rows if not row["right"]), rows[-1])
        yield shown | {"recordings": seeds, "right": count == seeds, "of_seeds": f"{count}/{seeds}"}


def table_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The rows in Markdown, and how many machines are right."""
    lines = [
        "| machine | inputs | outputs | set-points | disturbances | said | right |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        cells = [row.get(key, ()) for key in ("inputs", "outputs", "set_points", "disturbances")]
        told = [cell if isinstance(cell, str) else ", ".join(cell) or "–" for cell in cells]
        right = row.get("of_seeds") or {True: "yes", False: "no"}.get(row.get("right"), "–")
        lines.append(f"| {row['machine']} | {' | '.join(told)} | {row.get('said', '–')} | {right} |")
    judged = {name: all(r["right"] for r in rows if r["machine"] == name and "right" in r)
              for name in dict.fromkeys(row["machine"] for row in rows if "right" in row)}  # fmt: skip
    return [*lines, "", f"{sum(judged.values())} of {len(judged)} machines are right."]


def main() -> None:
    """Print the table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("machines", "nameless", "simulated", "made-up"))
    parser.add_argument(
        "--shared", type=Path, default=Path("../shared"), help="folder with the folders data and cases"
    )
    parser.add_argument("--only", nargs="+", default=(), help="machines by name")
    parser.add_argument("--seeds", type=int, default=5, help="recordings of each made-up machine")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    ways = {"made-up": lambda: made_up(given.seeds), "simulated": simulated}
    rows = list(ways.get(given.what, lambda: machines(given.shared, given.what == "nameless", given.only))())
    print("\n".join(table_of(rows)))
    if given.out is not None:
        given.out.write_text(json.dumps({"what": given.what, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
