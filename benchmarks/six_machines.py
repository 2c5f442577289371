"""Fitted priors of six real machines against linear models, by free runs over what was held back.

    python benchmarks/six_machines.py DATA [NAME ...]

``DATA`` is the folder of the recordings, one folder a machine. The last quarter of a recording, or the named whole
recordings, enter neither fit nor choice. Runs follow each other without overlap; each starts from the scenario's
warm-up alone. Root mean squares over all runs, one number an output, and the median over the runs.

``least`` is the prior with the parameters that are best for the very runs that it is judged by, found by these from
the fitted ones on in a few steps: what fits of this equation could have there, and hardly less. The sum of the outputs'
mean squares, each over the fitted prior's, is least; a single output may be better elsewhere. Delay and smoother stay
those of the fit. Its parameters are printed.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from hybrid_mpc import InputError, Scenario, Trajectory, fit_prior, load_scenario
from hybrid_mpc.identify.linear import fit_arx, fit_subspace
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.workflow.benchmark_runs import benchmark_of, in_runs, read_test, read_training, run_freely

STEPS = 20
"""Steps at most to the least error."""
STEP = 0.02
"""Of the differences for its slopes [standard errors]: far above what the smoother's iterations leave open."""
INSIDE = 1e-9
"""Share of its bounds by which each parameter begins within them."""
DIVERGED = 1e3
"""What each sample of a run that diverges counts."""


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


def ahead(
    scenario: Scenario, fit: PriorFit, runs: list[Trajectory], length: float | None
) -> list[np.ndarray]:
    """Errors of the prior's free runs."""
    warm_up = scenario.data.warm_up
    found = run_freely(scenario.prior(fit.values), fit, {}, runs, warm_up=warm_up, length=length)
    return [run.y_hat["phy"] - run.y for run in found]


def least(scenario: Scenario, fit: PriorFit, runs: list[Trajectory], length: float | None) -> PriorFit:
    """The fit with the parameters that make these runs' errors least; the delay and what smooths states stay."""
    free = [p for p in scenario.prior().parameters if not p.fixed]
    low, high = (np.array(bounds) for bounds in zip(*((p.lower, p.upper) for p in free), strict=True))
    size = np.array([fit.standard_errors.get(p.name) or 0.01 * (p.upper - p.lower) for p in free])
    first = np.concatenate(ahead(scenario, fit, runs, length))
    scale = np.sqrt(np.nanmean(first**2, axis=0) * np.isfinite(first).sum(axis=0))

    def at(values: np.ndarray) -> PriorFit:
        return replace(fit, values=fit.values | {p.name: float(v) for p, v in zip(free, values, strict=True)})

    def errors(values: np.ndarray) -> np.ndarray:
        own = np.concatenate(ahead(scenario, at(values), runs, length))
        return np.nan_to_num(own / scale, nan=DIVERGED)[np.isfinite(first)]

    def slopes(values: np.ndarray) -> np.ndarray:
        here, steps = errors(values), np.where(values + STEP * size > high, -STEP, STEP) * size
        return np.stack(
            [(errors(v) - here) / d for v, d in zip(values + np.diag(steps), steps, strict=True)], axis=1
        )

    start = np.clip(
        [fit.values[p.name] for p in free], low + INSIDE * (high - low), high - INSIDE * (high - low)
    )
    return at(least_squares(errors, start, slopes, bounds=(low, high), x_scale=size, max_nfev=STEPS).x)


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
    fit = fit_prior(
        scenario.prior, known.train, known.valid, dt=dt, length=spec.length or spec.piece,
        largest_delay=scenario.data.largest_delay,
    )  # fmt: skip
    print(f"\n{name}\n{fit.table(scenario.prior().parameters)[['nominal', 'fitted', 'standard_error']]}")
    print(f"delay {fit.delay:.3g} s; {'; '.join(fit.identifiability) or 'all told apart'}")
    warm = max(4, round(scenario.data.warm_up / dt))
    linear = {}
    for key, method in (("ARX", fit_arx), ("N4SID", fit_subspace)):
        try:
            linear[key] = method(known.train, known.valid, dt, warm=warm)
        except InputError as error:
            print(f"{key}: {error}")
    judged = {"validation": list(known.valid)}
    judged |= {key: [t for path in paths for t in read_test(scenario, path)] for key, paths in tests.items()}
    for key, trajectories in judged.items():
        for length in split.lengths:
            n = warm + round((fit.delay + (length or 0.0)) / dt) + 2
            pieces = trajectories if length is None else in_runs(trajectories, n)
            rows = {"prior": ahead(scenario, fit, pieces, length)}
            for label, model in linear.items():
                straight = model.free_runs(pieces, warm)
                rows[label] = [y - p.y[warm:] for y, p in zip(straight, pieces, strict=True)]
            if key in tests:
                best = least(scenario, fit, pieces, length)
                rows["least"] = ahead(scenario, best, pieces, length)
            for label, errors in rows.items():
                seconds = "whole" if length is None else f"{length:g} s"
                print(f"{key}, {seconds}, {len(pieces)} runs, {label}: {told(errors)}", flush=True)
            if key in tests:
                print("  least at", " ".join(f"{k} {v:.4g}" for k, v in best.values.items()), flush=True)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        for one in sys.argv[2:] or list(SPLITS):
            judge(one, Path(sys.argv[1]), Path(made))
