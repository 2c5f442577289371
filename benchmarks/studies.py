"""What a study costs beside its runs: ``python benchmarks/studies.py overhead|strokes|scale|dask [--runs N]``.

``overhead``: runs that do nothing, in 2 processes: time a run as a whole and of the parent, and the memory of parent
and workers as runs go by. ``strokes --model DIR``: stroke runs against ``runs x single-run time / workers``. ``scale``:
how long a run takes to be named, logged, read and compacted, and its bytes. ``dask``: runs that do nothing on a local
cluster, one a batch, which is what the scheduler's time goes into. Wall times count on an idle machine only.
"""

from __future__ import annotations

import resource
import tempfile
from functools import partial
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import pandas
from parts import arguments, report

from hybrid_mpc import LoopSpec, Study, run_study
from hybrid_mpc.compare import study_run
from hybrid_mpc.compare.study_log import RunLog, RunRow, compact, rows, segments
from hybrid_mpc.compare.study_run import THREADS, TIMING, execute, load_inputs, run_batch
from hybrid_mpc.engine import DaskEngine, LocalEngine, Progress


def nothing(config: LoopSpec) -> dict:
    """A run of a usual number of figures that computes none; with its process' memory."""
    values = np.random.default_rng(config.noise_seed).random(20).tolist()  # as hard to compress as real ones
    figures = {f"figure_{i}": value for i, value in enumerate(values)}
    return {"cost": 0.5, "share_MPC": 1.0, **figures, f"{TIMING}rss_mb": resident_mb()}


def resident_mb() -> float:
    """Memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


class Memory(Progress):
    """Notes the parent's memory as runs go by."""

    def __init__(self) -> None:
        self.at: list[tuple[int, float]] = []

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Note it."""
        self.at.append((done, resident_mb()))


def many(runs: int) -> Study:
    """A study of ``runs`` runs with the columns of plant variation."""
    vary = dict.fromkeys(("m", "a", "J", "d", "mu_c", "mu_s"), 0.2)
    return Study(
        "golf_robot", "model", tasks=["track_sine"], controllers=["prior"], vary=vary, draws=runs, seeds=1
    )


def timed(engine, runs: int, folder: Path, progress) -> tuple[float, float]:
    """Wall and processor time of this process [s] for runs that do nothing, once the workers have started."""
    with RunLog(folder) as log:
        execute(many(4).runs(), log, engine, Progress(), 4)
        begin, cpu = perf_counter(), process_time()
        execute(many(runs).runs(), log, engine, progress, runs)
        spent = perf_counter() - begin, process_time() - cpu
        engine.close()
    return spent


def overhead(runs: int, folder: Path) -> dict:
    """Time and memory of runs that do nothing, in 2 processes."""
    memory = Memory()
    wall, parent = timed(LocalEngine(partial(run_batch, nothing), 2, threads=THREADS), runs, folder, memory)
    found, tenth = list(rows(folder))[4:], max(1, runs // 10)
    of_workers = [row.columns[f"{TIMING}rss_mb"] for row in found]
    of_parent = [mb for done, mb in memory.at if done >= tenth]
    in_runs = sum(row.columns[f"{TIMING}cpu_s"] for row in found)
    return {
        "wall_ms_a_run": 1e3 * wall / runs,
        "parent_cpu_ms_a_run": 1e3 * parent / runs,
        "in_runs_cpu_ms_a_run": 1e3 * in_runs / runs,
        "parent / in runs": parent / in_runs,
        "worker_mb, end / tenth": float(
            np.median(of_workers[-tenth:]) / np.median(of_workers[tenth : 2 * tenth])
        ),
        "parent_mb, end / tenth": of_parent[-1] / of_parent[0],
    }


def dask(runs: int, folder: Path) -> dict:
    """Runs that do nothing on a local cluster of 2 processes, one a batch."""
    from distributed import Client, LocalCluster

    study_run.BATCH_MOST = 1
    with (
        LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        wall, scheduler = timed(DaskEngine(partial(run_batch, nothing), client), runs, folder, Progress())
    return {"wall_ms_a_batch": 1e3 * wall / runs, "scheduler_cpu_ms_a_batch": 1e3 * scheduler / runs}


def strokes(runs: int, folder: Path, model: Path, workers: int) -> dict:
    """Stroke runs in processes against one run after the other."""
    study = Study("golf_robot", model, tasks=["stroke_1.4"], controllers=["prior_observer"], seeds=runs)
    run, _ = load_inputs(study)
    first, alone = next(study.runs()), []
    run(first)  # models and controllers are built
    for _ in range(5):
        begin, cpu = perf_counter(), process_time()
        run(first)
        alone.append((perf_counter() - begin, process_time() - cpu))
    single, single_cpu = np.median(alone, axis=0)
    begin, cpu = perf_counter(), process_time()
    results = run_study(study, folder, workers=workers)
    wall, parent = perf_counter() - begin, process_time() - cpu
    spent = float(results.table[f"{TIMING}cpu_s"].sum())
    return {
        "workers": workers,
        "single_s": float(single),
        "wall_s": wall,
        "wall / ideal": wall * workers / (runs * float(single)),
        "cpu of runs / ideal": spent / (runs * float(single_cpu)),
        "parent / cpu of runs": parent / spent,
    }


def scale(runs: int, folder: Path) -> dict:
    """Times and bytes a run of the parts that see all runs."""
    study, spent = many(runs), {}

    def clocked(name, part):
        begin = process_time()
        value = part()
        spent[f"{name}_us"] = 1e6 * (process_time() - begin) / runs
        return value

    ids = clocked("name", lambda: [run.id for run in study.runs()])
    lines = [RunRow(run.id, "done", "", {**run.columns(), **nothing(run)}) for run in study.runs()]

    def log():
        with RunLog(folder / "runs") as to:
            for i in range(0, runs, 100):
                to.append(lines[i : i + 100])

    clocked("log", log)
    seen = clocked("read", lambda: sum(1 for _ in rows(folder / "runs")))
    if not seen == len(set(ids)) == runs:
        raise SystemExit(f"{runs} runs have {len(set(ids))} names, and {seen} of them were read back")
    path = folder / "results.parquet"
    clocked("compact", lambda: compact(folder / "runs", path, {}))
    table = clocked("load", lambda: pandas.read_parquet(path))
    logged = sum(p.stat().st_size for p in segments(folder / "runs"))
    return {
        **spent,
        "log_bytes": logged / runs,
        "log / parquet": logged / path.stat().st_size,
        "table_bytes": float(table.memory_usage(deep=True).sum()) / runs,
    }


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("what", choices=("overhead", "strokes", "scale", "dask"))
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--model", type=Path, help="artifact folder, for strokes")
    given = parser.parse_args()
    if given.what == "strokes" and given.model is None:
        parser.error("strokes needs --model DIR, the folder of a run's model")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "study"
        if given.what == "strokes":
            found = strokes(given.runs, folder, given.model, given.workers)
        else:
            folder.mkdir()
            found = {"overhead": overhead, "scale": scale, "dask": dask}[given.what](given.runs, folder)
    report([{"runs": given.runs, **found}], given.out)


if __name__ == "__main__":
    main()
