"""Error of free runs over unseen recordings, by the processor time that a model was identified in, against rivals.

``python benchmarks/identification.py --data FOLDER [--machines ...] [--methods ...] [--seeds 3] [--limit 60] [--out
FILE.json]``, where FOLDER holds ``unbalanced_disk/multisine_2024.npz`` and ``torque_pendulum/*.csv``; without it only
the simulated golf robot. Rivals that are not installed are left out; they want an environment of their own
(``pip install -c benchmarks/constraints.txt -e '.[bench]'``).

All methods get the same training and validation recordings. A model is judged by free runs over test recordings from
the same measured warm-up: root mean square of the first output's error. What counts at a budget is the model that
*validates* best of all that the method had by then. The clock is processor time of one process on one core, from the
recordings in memory on; compilation counts, and stands apart as well; looking at models does not count. Methods that
draw are run with several seeds; figures are medians, least and largest beside. ``--runs FILE.jsonl`` keeps every run
as soon as it is there, and makes none again that the file has.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy, torch and jax are loaded
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("TQDM_DISABLE", "1")

import importlib.util
import json
import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

import torch
from identifiers import BUDGETS, DRAWS, METHODS, NEEDS, Problem, watched
from parts import arguments, report

from hybrid_mpc import Scenario, Trajectory, load_scenario, load_trajectories
from hybrid_mpc.identify.evaluate import STARTS
from hybrid_mpc.workflow.benchmark_runs import read_training

FILES = {
    "golf_robot": (),
    "unbalanced_disk": ("unbalanced_disk/multisine_2024.npz",),
    "torque_pendulum": tuple(
        f"torque_pendulum/{name}.csv"
        for name in ("energy_shaping_0p9Nm", "energy_shaping_1p5Nm", "sac_0p9Nm", "ilqr_0p9Nm")
    ),
}
"""Recordings below the data folder; none where the machine is simulated."""
SETTINGS = {
    "golf_robot": {"hidden": 16, "networks": 2, "teacher_steps": 300, "free_run_steps": 150},
    "unbalanced_disk": {
        "hidden": 16,
        "networks": 2,
        "teacher_steps": 200,
        "free_run_steps": 120,
        "horizon": 60,
    },
    "torque_pendulum": {
        "hidden": 16,
        "networks": 4,
        "teacher_steps": 300,
        "free_run_steps": 150,
        "decay": 6000.0,
    },
}
"""Of the library's networks: the machines' own quick budgets, with fewer steps where these take more than a minute."""


def problem_of(machine: str, files: list[Path]) -> Problem:
    """The recordings of a machine, read and cut as its own scenario says."""
    scenario: Scenario = load_scenario(machine)
    spec, prior = scenario.data, scenario.prior()
    if scenario.benchmark is None:
        data = load_trajectories(files, prior, spec)
        train, valid, test = (data.by_role(role) for role in ("train", "valid", "test"))
    else:
        read = read_training(scenario, files)
        train, valid, test = read.train, read.valid, read.held_back
    warm = round(spec.warm_up / spec.dt)
    valid_runs, test_runs = (runs_of(part, warm, scenario) for part in (valid, test))
    longest = max(len(t.t) - warm for t in (*valid, *test)) * spec.dt
    return Problem(
        scenario, spec.dt, warm, tuple(train), tuple(valid), valid_runs, test_runs, spec.free_run or longest,
        spec.largest_delay, SETTINGS[machine],
    )  # fmt: skip


def runs_of(trajectories: Any, warm: int, scenario: Scenario) -> tuple[Trajectory, ...]:
    """The runs that judge: whole recordings, or short ones that start every fifth of their length."""
    length, dt, runs = scenario.data.free_run, scenario.data.dt, []
    for t in trajectories:
        n = len(t.t) if length is None else min(len(t.t), warm + round(length / dt) + 1)
        stride = len(t.t) if length is None else max(1, round(length / dt / STARTS))
        runs += [t.part(slice(a, a + n)) for a in range(0, len(t.t) - n + 1, stride)]
    return tuple(runs)


def one(machine: str, files: list[Path], method: str, seed: int, limit: float, core: int) -> dict[str, Any]:
    """A method's run in a process of its own, on one core."""
    os.sched_setaffinity(0, {core})
    torch.set_num_threads(1)
    if method in NEEDS:  # imports do not count
        importlib.import_module(NEEDS[method])
    watch = watched(problem_of(machine, files), method, seed, limit)
    return {
        "machine": machine,
        "method": method,
        "seed": seed,
        "test": {f"{b:g}": watch.at(b) for b in BUDGETS if b <= limit},
        "compiling_s": watch.compiling,
        "seconds": watch.points[-1][0] if watch.points else None,
        "points": watch.points,
    }


def table(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row a machine and method: median over seeds at each budget, and over the library's."""
    rows = []
    for machine in dict.fromkeys(run["machine"] for run in runs):
        of = [run for run in runs if run["machine"] == machine]
        medians = {}
        for method in dict.fromkeys(run["method"] for run in of):
            own = [run for run in of if run["method"] == method]
            found = {b: [run["test"][b] for run in own] for b in own[0]["test"]}
            known = {b: None if None in v else median(v) for b, v in found.items()}
            medians[method] = known
            ours = medians.get("hybrid-mpc", known)
            row = {"machine": machine, "method": method, "seeds": len(own)}
            for b, value in known.items():
                spread = (
                    f" ({min(found[b]):.3g} to {max(found[b]):.3g})"
                    if value is not None and len(own) > 1
                    else ""
                )
                row[f"{b} s"] = "–" if value is None else f"{value:.3g}{spread}"
                row[f"/ ours, {b} s"] = "–" if value is None or ours[b] is None else f"{value / ours[b]:.2f}"
            rows.append({**row, "compiling [s]": median(run["compiling_s"] for run in own)})
    return rows


def main() -> None:
    """Run all methods on all machines."""
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--machines", nargs="+", choices=list(FILES), default=list(FILES))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of each run")
    parser.add_argument("--runs", type=Path, help="JSON lines: runs that are kept from one call to the next")
    parser.add_argument("--workers", type=int, default=1, help="runs side by side, each on a core of its own")
    given = parser.parse_args()
    cores, runs = sorted(os.sched_getaffinity(0)), []
    if given.runs is not None and given.runs.is_file():
        runs = [json.loads(line) for line in given.runs.read_text().splitlines()]
    made = {(run["machine"], run["method"], run["seed"]) for run in runs}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HOME"] = folder  # deepSI writes its checkpoints there
        jobs = []
        for machine in given.machines:
            files = [given.data / name for name in FILES[machine]] if given.data else []
            if not FILES[machine]:
                files = load_scenario(machine).make_data(Path(folder), 0, "quick")
            if not files:
                print(f"{machine}: left out, no recordings")
                continue
            for method in given.methods:
                if method in NEEDS and importlib.util.find_spec(NEEDS[method]) is None:
                    print(f"{method}: left out, {NEEDS[method]} is not installed")
                    continue
                seeds = range(given.seeds if method in DRAWS else 1)
                jobs += [
                    (machine, files, method, seed, given.limit)
                    for seed in seeds
                    if (machine, method, seed) not in made
                ]
        jobs.sort(key=lambda job: job[3])
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(given.workers, spawn, max_tasks_per_child=1) as pool:
            waiting = [pool.submit(one, *job, cores[i % len(cores)]) for i, job in enumerate(jobs)]
            for future in as_completed(waiting):
                runs.append(future.result())
                print(*(runs[-1][key] for key in ("machine", "method", "seed", "test")), flush=True)
                if given.runs is not None:
                    with given.runs.open("a") as file:
                        file.write(json.dumps(runs[-1]) + "\n")
    rivals = [name for name in ("scipy", "jax-sysid", "jax", "deepSI") if _installed(name)]
    report(table(sorted(runs, key=_order)), given.out, rivals, runs=runs)


def _order(run: dict[str, Any]) -> tuple[int, int, int]:
    return list(FILES).index(run["machine"]), list(METHODS).index(run["method"]), run["seed"]


def _installed(name: str) -> bool:
    try:
        return bool(version(name))
    except PackageNotFoundError:
        return False


if __name__ == "__main__":
    main()
