"""Fitted priors of six real machines against linear models, by free runs over what was held back.

    python benchmarks/six_machines.py DATA [NAME ...]

``DATA`` is the folder of the recordings, one folder a machine. The last quarter of a recording, or the named whole
recordings, enter neither fit nor choice. Runs follow each other without overlap; each starts from the scenario's
warm-up alone. Root mean squares over all runs, one number an output, and the median over the runs.

``fitted to these`` is the prior fitted to the very recordings that it is judged by. Where it is much better, parameters
differ there. It is no floor: the fit minimizes another measure (all outputs over their noise, free first states).
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hybrid_mpc import InputError, fit_prior, load_scenario
from hybrid_mpc.identify.linear import fit_arx, fit_subspace
from hybrid_mpc.job.benchmark_runs import benchmark_of, in_runs, read_test, read_training, run_freely


@dataclass(frozen=True)
class Split:
    """Files to train on, whole or all but their last quarter (``cut``); files to judge by; lengths of runs [s]."""

    train: tuple[str, ...]
    test: dict[str, tuple[str, ...]]
    lengths: tuple[float | None, ...]
    cut: bool = True


UNIFORM = ("uniform_low_first400", "uniform_high_first400")
SINES = ("sines_143339", "sines_143524", "sines_143601", "sines_143704")
RUNS = (1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 18, 19, 21, 22, 24, 28, 29, 30)
SPLITS = {
    "cascaded_tanks": Split(("estimation",), {}, (None,)),
    "temperature_lab": Split(
        ("prbs",), {name: (name,) for name in ("setpoints_1", "setpoints_5")}, (600.0,)
    ),
    "coupled_drives": Split(UNIFORM, {}, (None,)),
    "double_pendulum": Split(
        SINES,
        {
            "two other sines": ("sines_143747", "sines_144003"),
            "swing-ups": tuple(f"{r}_swingup_{k:02d}" for r in ("acrobot", "pendubot") for k in (1, 2, 3)),
        },
        (0.5,),
        cut=False,
    ),
    "race_car": Split(
        tuple(f"run_{k:02d}" for k in RUNS),
        {"eight other runs": tuple(f"run_{k}" for k in range(34, 42))},
        (None,),
        cut=False,
    ),
    "heat_exchanger": Split(
        ("random_steps_jun16",),
        {name: (name,) for name in ("staircase_jun10", "staircase_jun11")},
        (60.0, 120.0, 300.0),
    ),
}  # fmt: skip


def cut(source: Path, folder: Path) -> tuple[Path, Path]:
    """A recording's first three quarters and its last one as files."""
    lines = source.read_text().splitlines()
    split = 1 + (len(lines) - 1) * 3 // 4
    parts = folder / f"{source.stem}.csv", folder / f"{source.stem}_last.csv"
    for path, rows in zip(parts, (lines[1:split], lines[split:]), strict=True):
        path.write_text("\n".join([lines[0], *rows]) + "\n")
    return parts


def told(errors: list[np.ndarray]) -> str:
    """Root mean square over all runs and the median over the runs, one number an output."""
    every = np.sqrt(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    each = np.median([np.sqrt(np.nanmean(e**2, axis=0)) for e in errors], axis=0)
    return f"{' '.join(f'{v:.3g}' for v in every)} (median {' '.join(f'{v:.3g}' for v in each)})"


def judge(name: str, data: Path, folder: Path) -> None:
    """Fit to the training part and print what free runs over the rest are off by."""
    scenario, split, folder = load_scenario(name), SPLITS[name], folder / name
    folder.mkdir()
    spec, dt = benchmark_of(scenario), scenario.data.dt
    files = [data / name / f"{stem}.csv" for stem in split.train]
    tests = {key: [data / name / f"{stem}.csv" for stem in stems] for key, stems in split.test.items()}
    if split.cut:
        parts = [cut(file, folder) for file in files]
        files = [first for first, _ in parts]
        tests = {f"last quarter of {last.stem.removesuffix('_last')}": [last] for _, last in parts} | tests
    known = read_training(scenario, files)
    fitted = partial(
        fit_prior, scenario.prior, dt=dt, length=spec.length or spec.piece,
        largest_delay=scenario.data.largest_delay,
    )  # fmt: skip
    fit = fitted(known.train, known.valid)
    print(f"\n{name}\n{fit.table(scenario.prior().parameters)[['nominal', 'fitted', 'standard_error']]}")
    print(f"delay {fit.delay:.3g} s; {'; '.join(fit.identifiability) or 'all told apart'}")
    warm_up = scenario.data.warm_up
    warm = max(4, round(warm_up / dt))
    linear = {}
    for key, method in (("ARX", fit_arx), ("N4SID", fit_subspace)):
        try:
            linear[key] = method(known.train, known.valid, dt, warm=warm)
        except InputError as error:
            print(f"{key}: {error}")
    judged = {"validation": list(known.valid)}
    judged |= {key: [t for path in paths for t in read_test(scenario, path)] for key, paths in tests.items()}
    for key, trajectories in judged.items():
        fits = {"prior": fit}
        if key in tests:
            fits["fitted to these"] = fitted(trajectories, trajectories)
        for length in split.lengths:
            n = warm + round((fit.delay + (length or 0.0)) / dt) + 2
            pieces = trajectories if length is None else in_runs(trajectories, n)
            rows = {}
            for label, own in fits.items():
                runs = run_freely(scenario.prior(own.values), own, {}, pieces, warm_up=warm_up, length=length)
                rows[label] = [run.y_hat["phy"] - run.y for run in runs]
            for label, model in linear.items():
                ahead = model.free_runs(pieces, warm)
                rows[label] = [y - p.y[warm:] for y, p in zip(ahead, pieces, strict=True)]
            for label, errors in rows.items():
                seconds = "whole" if length is None else f"{length:g} s"
                print(f"{key}, {seconds}, {len(pieces)} runs, {label}: {told(errors)}", flush=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        for one in sys.argv[2:] or list(SPLITS):
            judge(one, Path(sys.argv[1]), Path(made))
