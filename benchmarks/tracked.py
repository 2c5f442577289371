"""Does an observer that tracks parameters predict better? Horizons ahead from its state, over held-out recordings.

    python benchmarks/tracked.py --data ../shared/data [--machines temperature_lab ...] [--folds 5] [--declared 0.1]

Recordings are left out in the groups of ``benchmarks/no_harm.py``. In each the prior is fitted to the others, which
also decide which parameters vary, whether tracking them improves predictions, and their drift. Then two observers of
the fitted prior, with the same noise, watch what was left out: one tracks these parameters, one does not. At starts a
quarter of a horizon apart both predict the horizon under the measured inputs. ``ratio`` is the tracking observer's root
mean square error over the other's, by output; 1 where nothing is tracked. ``tracked`` has the standard deviation of
each parameter and the time constant [s] of its drift. ``temperature_lab_prbs`` fits to the identification recording
alone and leaves out the other days. With ``--declared`` the recordings decide nothing: all free parameters are declared
to vary by this relative standard deviation.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from no_harm import RECORDINGS, folds
from parts import arguments, report

from hybrid_mpc import InputError, Scenario, fit_prior, load_scenario, load_trajectories
from hybrid_mpc.compare.tracked import find_tracked, observer_of
from hybrid_mpc.estimate.tracking import TrackedParameter, TrackingFilter
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.identify.ahead import errors_ahead
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.machine.specification import Window
from hybrid_mpc.records import plain, record

HORIZONS: Mapping[str, float] = {
    "temperature_lab": 600.0, "temperature_lab_prbs": 600.0, "heat_exchanger": 120.0, "race_car": 1.0,
    "coupled_drives": 1.0,
}  # fmt: skip
"""Horizon [s] of the predictions, by machine."""
DAYS = "_prbs"
"""Ending of a machine whose identification recording alone is fitted."""
WATCHED = 3000
"""Periods of a held-out recording at most."""


def other_days(scenario: Scenario, files: Sequence[Path]) -> Scenario:
    """The scenario whose first recording trains and validates; the others are held out."""
    spec, windows = scenario.data, {}
    whole = load_trajectories(
        files, scenario.prior(), replace(spec, windows={}, fractions=(1.0, 0.0, 0.0)), needed=("train",)
    )
    for t in whole.whole:
        start, end = float(t.t[0]), float(t.t[-1]) + t.dt
        cut = end - 0.25 * (end - start)
        held = (Window(start, end, "test"),)
        windows[t.file] = (
            held
            if t.file != "prbs"
            else (Window(start, cut, "train"), Window(cut + spec.warm_up, end, "valid"))
        )
    return replace(scenario, data=replace(spec, windows=windows))


def row(
    name: str, fold: int, scenario: Scenario, files: list[Path], declared: float, work: Path
) -> dict[str, object]:
    """One group that was left out."""
    spec, horizon = scenario.data, HORIZONS[name]
    data = load_trajectories(files, scenario.prior(), spec)
    train, valid, test = (list(data.by_role(role)) for role in ("train", "valid", "test"))
    length = spec.free_run or max(len(t.t) * spec.dt - spec.warm_up for t in (*valid, *test))
    path = work / f"{name}_{fold}.json"
    if path.is_file():
        fit = record(PriorFit, read_json(path), "the fit")
    else:
        fit = fit_prior(
            scenario.prior, train, valid, dt=spec.dt, length=length, largest_delay=spec.largest_delay
        )
        write_json(path, plain(fit))
    observer = observer_of(scenario, fit, train)
    begun = time.process_time()
    if declared:
        tracked: Sequence[TrackedParameter] = [
            TrackedParameter(
                p.name, declared if p.value else 0.5 * declared * (p.upper - p.lower), bool(p.value)
            )
            for p in observer.model.parameters
            if not p.fixed
        ]
    else:
        varying, chosen = find_tracked(scenario, fit, train, valid, length=length, horizon=horizon)
        print(
            "  ",
            {p.name: (p.std, p.alone, p.gain) for p in varying.parameters},
            chosen.tried,
            file=sys.stderr,
        )
        tracked = chosen.tracked
    seconds = time.process_time() - begun
    held = [t.part(slice(WATCHED)) for t in test]
    before = errors_ahead(observer, held, horizon, warm_up=spec.warm_up).pooled
    ratio = np.ones(len(before))
    if tracked:
        ratio = (
            errors_ahead(TrackingFilter(observer, tracked), held, horizon, warm_up=spec.warm_up).pooled
            / before
        )
    outputs = [s.name for s in observer.model.outputs]
    made: dict[str, object] = {
        "machine": name, "fold": fold,
        "untracked": {o: round(float(e), 4) for o, e in zip(outputs, before, strict=True)},
        "ratio": {o: round(float(r), 3) for o, r in zip(outputs, ratio, strict=True)},
        "tracked": {one.name: (round(one.std, 4), round(one.time, 1)) for one in tracked}, "seconds": round(seconds, 1),
    }  # fmt: skip
    print("  ", made, file=sys.stderr, flush=True)
    return made


def summary(rows: Sequence[dict[str, object]]) -> dict[str, object]:
    """Of all folds of a machine: geometric mean and largest ratio by output."""
    ratios = [r["ratio"] for r in rows]
    assert all(isinstance(r, dict) for r in ratios)
    by_output = {o: np.array([r[o] for r in ratios]) for o in ratios[0]}  # type: ignore[index, attr-defined]
    return {
        "machine": rows[0]["machine"],
        "folds": len(rows),
        "mean ratio": {o: round(float(np.exp(np.log(v).mean())), 3) for o, v in by_output.items()},
        "largest": {o: round(float(v.max()), 3) for o, v in by_output.items()},
        "tracked in": sum(bool(r["tracked"]) for r in rows),
    }


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the machines' recordings")
    parser.add_argument("--machines", nargs="+", default=[*HORIZONS], choices=[*HORIZONS])
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument(
        "--declared", type=float, default=0.0, help="relative standard deviation of all parameters"
    )
    parser.add_argument("--work", type=Path, default=Path("runs/tracked"), help="where fits are kept")
    given = parser.parse_args()
    found = []
    for name in given.machines:
        machine = name.removesuffix(DAYS)
        scenario = load_scenario(machine)
        files = sorted(p for pattern in RECORDINGS[machine] for p in given.data.glob(pattern))
        if not files:
            raise InputError(f"{name}: no recordings in {given.data}")
        of = [other_days(scenario, files)] if name != machine else folds(scenario, files, given.folds)
        given.work.mkdir(parents=True, exist_ok=True)
        rows = [row(name, k, one, files, given.declared, given.work) for k, one in enumerate(of)]
        found.append(summary(rows))
    report(found, given.out)


if __name__ == "__main__":
    main()
