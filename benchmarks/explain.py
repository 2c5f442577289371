"""Does a search for missing terms make an expert's prior of a textbook's? Judged by recordings that were left out.

    python benchmarks/explain.py --data ../shared/data [--machines emps ...] [--priors textbook own] [--folds 5]

Recordings are left out in the groups of ``benchmarks/no_harm.py``. In each the prior is fitted and explained on what
remains, then free runs over what was left out are predicted. ``textbook`` is the prior of ``benchmarks/textbook.py``,
``own`` the scenario's. Errors are root mean squares over the outputs' spreads; ``ratio`` is the explained prior's error
over the fitted one's, ``over own`` over that of the scenario's fitted prior.

Fits of the priors and finished groups are kept in ``--work`` and are not computed twice; a change of the search leaves
the fits, and computes the groups anew.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from no_harm import RECORDINGS, folds
from parts import arguments, report
from textbook import TEXTBOOK

from hybrid_mpc import (
    InputError,
    Prior,
    PriorStep,
    Scenario,
    Trajectory,
    fit_prior,
    load_scenario,
    load_trajectories,
)
from hybrid_mpc.data.scales import robust_spread, time_unit
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.evaluate import evaluation_trajectories, free_runs, score
from hybrid_mpc.identify.explain import explain
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.simulation import required_substeps
from hybrid_mpc.identify.smooth import Smoother, fit_smoother
from hybrid_mpc.records import plain, record
from hybrid_mpc.workflow.stage import sources

GOLF = "golf_robot"


def error(
    prior: Prior,
    smoother: Smoother,
    held: Sequence[Trajectory],
    warm: int,
    length: float | None,
    spread: list[float],
) -> float:
    """Error of free runs over what was left out, from what the warm-up tells of the first state."""
    runs = evaluation_trajectories(smoother.smooth(held), smoother, warm, length)
    step = PriorStep(prior, held[0].dt, smoother.substeps)
    return float(score(free_runs(step, prior, runs, warm), prior, spread).error)


def row(
    name: str, fold: int, scenario: Scenario, files: list[Path], kind: str, work: Path
) -> dict[str, object]:
    """One group that was left out."""
    note = work / f"{name}_{fold}_{kind}.json"
    version = sources("hybrid_mpc.identify.explain")
    held = read_json(note) if note.is_file() else {}
    if held.get("version") == version:
        return dict(held["row"])
    own = type(scenario.prior())
    base = TEXTBOOK[scenario.name] if kind == "textbook" else own
    spec = scenario.data
    data = load_trajectories(files, own(), spec)
    train, valid, test = (data.by_role(role) for role in ("train", "valid", "test"))
    dt, warm = spec.dt, round(spec.warm_up / spec.dt)
    length = spec.free_run or max((len(t.t) - warm) * dt for t in (*valid, *test))
    unit = time_unit(train, dt)
    y = np.concatenate([t.y for t in (*train, *valid)])
    spread = [robust_spread(c) or 1.0 for c in y.T]
    found: dict[str, float] = {}
    terms, seconds, doubt = "", 0.0, ""
    for which, make in {"own": own, "fitted": base}.items():
        if which == "own" and kind == "own":
            continue
        path = work / f"{name}_{fold}_{make.__name__}.json"
        if path.is_file():
            fit = record(PriorFit, read_json(path), "the fit")
        else:
            fit = fit_prior(
                make, train, valid, dt=dt, length=length, largest_delay=spec.largest_delay, time_unit=unit,
                warm_up=spec.warm_up,
            )  # fmt: skip
            write_json(path, plain(fit))
        fitted = make(fit.values)
        held = shifted(test, fit.delay)
        found[which] = error(fitted, fit.smoother(fitted, dt), held, warm, spec.free_run, spread)
        if which == "fitted":
            began = time.process_time()
            known = smoothed(make, fit, [*train, *valid], dt)
            told = explain(make, fit.values, known, dt=dt, length=length, warm_up=spec.warm_up)
            seconds = time.process_time() - began
            better = told.prior(make)(told.values)
            acting, substeps = shifted([*train, *valid], fit.delay), required_substeps(better, dt)
            smoother = (
                fit_smoother(better, acting, dt, time_unit=unit, substeps=substeps)
                if told.found
                else fit.smoother(fitted, dt)
            )
            found["explained"] = (
                error(better, smoother, held, warm, spec.free_run, spread) if told.found else found["fitted"]
            )
            terms, doubt = "; ".join(term.name for term in told.found), told.reason
            promised = told.after.ratio
    found.setdefault("own", found["fitted"])
    made = {
        "machine": name, "fold": fold, "prior": kind, "fitted": round(found["fitted"], 4),
        "explained": round(found["explained"], 4), "own": round(found["own"], 4),
        "ratio": round(found["explained"] / found["fitted"], 3), "promised": round(promised, 3),
        "over own": round(found["explained"] / found["own"], 3), "seconds": round(seconds, 1), "terms": terms or doubt,
    }  # fmt: skip
    print("  ", made, file=sys.stderr, flush=True)
    write_json(note, {"version": version, "row": made})
    return made


def summary(rows: Sequence[dict[str, object]]) -> dict[str, object]:
    """Of all folds of a machine, or of all."""
    ratios, over = (np.array([float(str(r[key])) for r in rows]) for key in ("ratio", "over own"))
    one = len({r["machine"] for r in rows}) == 1
    return {
        "machine": rows[0]["machine"] if one else "all", "prior": rows[0]["prior"], "folds": len(rows),
        "ratio, geometric mean": round(float(np.exp(np.log(ratios).mean())), 3), "largest": float(ratios.max()),
        "at most 1.02": float(np.mean(ratios <= 1.02)), "over own": round(float(np.exp(np.log(over).mean())), 3),
        "seconds": max(float(str(r["seconds"])) for r in rows),
    }  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the machines' recordings")
    parser.add_argument("--machines", nargs="+", default=[*RECORDINGS, GOLF], choices=[*RECORDINGS, GOLF])
    parser.add_argument("--priors", nargs="+", default=["textbook"], choices=["textbook", "own"])
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument(
        "--work", type=Path, default=Path("runs/explain"), help="where fits and groups are kept"
    )
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    rows = []
    with tempfile.TemporaryDirectory() as made:
        for name in given.machines:
            scenario = load_scenario(name.rpartition("_")[0] if name[-1].isdigit() else name)
            if name == GOLF:
                files = sorted(scenario.make_data(Path(made), 0, "full"))
            else:
                files = sorted(p for pattern in RECORDINGS[name] for p in given.data.glob(pattern))
            if not files:
                raise InputError(f"{name}: no recordings in {given.data}")
            for fold, one in enumerate(folds(scenario, files, 5)[: given.folds]):
                bare = replace(one, plant=None)
                rows += [row(name, fold, bare, files, kind, given.work) for kind in given.priors]
    table = []
    for kind in given.priors:
        own = [r for r in rows if r["prior"] == kind]
        table += [summary([r for r in own if r["machine"] == name]) for name in given.machines]
        table += [summary(own)] if len(given.machines) > 1 else []
    report(table, given.out)


if __name__ == "__main__":
    main()
