"""Processor time of an update of the monitor: ``python benchmarks/monitor_step.py [--model DIR] [--rounds 7]``.

A hybrid along 6 s of a sinusoid of 0.6 rad (a quarter of it near rest, where the force's dead band asks for more
accelerations), for the energy without and with limits and for residuals with limits, by turns: median and largest of
the rounds' means, and their ratio to the CasADi function alone [us]. Without ``--model`` a network of 32 random units.
"""

from __future__ import annotations

from pathlib import Path
from time import process_time

import numpy as np
from parts import arguments, deployed, estimate, hybrid_step, report

from hybrid_mpc import ChannelLimit, WatchLimits, load, make_monitor

SAMPLES = 300


def samples(model):
    """Measurements, inputs and estimates of the sinusoid."""
    phase = 2 * np.pi * 0.5 * model.dt * np.arange(SAMPLES)
    x = np.column_stack([0.6 * np.sin(phase), 0.6 * np.pi * np.cos(phase)])
    u = 0.3 * np.sin(phase + 0.5)[:, None]
    return [
        (row[:1].copy(), held, estimate(model, row, np.zeros(model.n_h)))
        for row, held in zip(x, u, strict=True)
    ]


def update_time(monitor, rows) -> float:
    """Mean processor time [us] of an update."""
    state = monitor.initial()
    begin = process_time()
    for y, u, e in rows:
        state, _ = monitor.update(state, y, u, e)
    return 1e6 * (process_time() - begin) / len(rows)


def casadi_time(monitor) -> float:
    """Mean processor time [us] of the CasADi function at its last arguments."""
    begin = process_time()
    for _ in range(SAMPLES):
        monitor.readings._function()
    return 1e6 * (process_time() - begin) / SAMPLES


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--model", type=Path, help="artifact folder")
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    model = load(given.model).models["hybrid"] if given.model else deployed(hybrid_step(32))
    scale = (0.01, 0.0, 0.0, 0.0)
    force = ChannelLimit("force of phi", "N m", 0, 20.0, 10.0, scale, 2.0)
    power = ChannelLimit("power of the free run", "W", 1, 4.0, 2.0, scale)
    energy = WatchLimits("energy", model.dt, (force, power), (4.5e-3,), (0,))
    readings = make_monitor(model, kind="residuals").readings
    channels = tuple(
        ChannelLimit(
            readings.channels[test.channel].name, readings.channels[test.channel].unit, test.length, 9.0, 4.5
        )
        for test in readings.tests
    )
    residuals = WatchLimits("residuals", model.dt, channels, (1.0,), (9,))
    monitors = {
        "energy, no limits": make_monitor(model),
        "energy": make_monitor(model, energy),
        "residuals": make_monitor(model, residuals),
    }
    rows, found = samples(model), {name: [] for name in monitors}
    for _ in range(given.rounds):
        for name, monitor in monitors.items():
            found[name].append((update_time(monitor, rows), casadi_time(monitor)))
    out = []
    for name, times in found.items():
        update, casadi = np.array(times).T
        median, alone = float(np.median(update)), float(np.median(casadi))
        row = {
            "median": median,
            "largest": float(update.max()),
            "CasADi": alone,
            "median / CasADi": median / alone,
        }
        out.append({"monitor": name, **row})
    report(out, given.out)


if __name__ == "__main__":
    main()
