"""What a study costs beside its runs: ``python benchmarks/studies.py overhead|short|strokes|scale|dask [--runs N]``.

``overhead``: runs that do nothing, in 2 processes: time a run of the parent and as a whole, and the memory of parent
and workers as runs go by. ``short --model DIR``: memory of a process that runs loops of 5 periods, each with a plant of
its own. ``strokes --model DIR``: stroke runs against ``runs x single-run time / workers``. ``scale``: what a run takes
in the log and in Parquet, and how long rows take to be named, written, read and compacted. ``dask``: runs that do
nothing on a local cluster, one a batch, which is what the scheduler's time goes into.

Wall times count on an idle machine only; CPU times beside them say what was computed.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import resource
import sys
import tempfile
from functools import partial
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from hybrid_mpc import LoopSpec, Study, StudyResults, run_study
from hybrid_mpc.job.context import Silent
from hybrid_mpc.job.engine import DaskEngine, LocalEngine
from hybrid_mpc.job.study_log import RunLog, compact, rows, segments
from hybrid_mpc.job.study_run import THREADS, TIMING, execute, load_inputs, run_batch


def nothing(config: LoopSpec) -> dict:
    """A run of a usual number of figures that computes none; with its process' memory."""
    values = np.random.default_rng(config.noise_seed).random(20).tolist()  # as hard to compress as real ones
    figures = {f"figure_{i}": value for i, value in enumerate(values)}
    return {"cost": 0.5, "share_MPC": 1.0, **figures, f"{TIMING}rss_mb": resident_mb()}


def resident_mb() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


class Memory(Silent):
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


def overhead(runs: int) -> dict:
    """Time and memory of runs that do nothing, in 2 processes."""
    study, memory = many(runs), Memory()
    with tempfile.TemporaryDirectory() as folder, RunLog(Path(folder)) as log:
        engine = LocalEngine(partial(run_batch, nothing), 2, threads=THREADS)
        execute(many(4).runs(), log, engine, Silent(), 4)  # processes have started
        begin, cpu = perf_counter(), process_time()
        execute(study.runs(), log, engine, memory, runs)
        wall, parent = perf_counter() - begin, process_time() - cpu
        engine.close()
        found = list(rows(Path(folder)))[4:]
    tenth = max(1, runs // 10)
    of_workers = [row.columns[f"{TIMING}rss_mb"] for row in found]
    of_parent = [mb for done, mb in memory.at if done >= tenth]
    return {
        "runs": runs,
        "wall_ms_a_run": 1e3 * wall / runs,
        "parent_cpu_ms_a_run": 1e3 * parent / runs,
        "in_runs_cpu_ms_a_run": 1e3 * sum(row.columns[f"{TIMING}cpu_s"] for row in found) / runs,
        "worker_mb_at_tenth": float(np.median(of_workers[tenth : 2 * tenth])),
        "worker_mb_at_end": float(np.median(of_workers[-tenth:])),
        "parent_mb_at_tenth": of_parent[0],
        "parent_mb_at_end": of_parent[-1],
    }


def short(runs: int, model: Path) -> dict:
    """Memory of this process while it runs loops of 5 periods."""
    study = Study(
        "golf_robot", model, tasks=["track_sine"], controllers=["prior_observer"], vary={"m": 0.2}, draws=runs,
        seeds=1, duration=0.1,
    )  # fmt: skip
    run, _ = load_inputs(study)
    at, begin = [], process_time()
    for config in study.runs():
        run(config)
        at.append(resident_mb())
    spent = process_time() - begin
    places = {f"mb_at_{share}%": at[max(0, runs * share // 100 - 1)] for share in (10, 25, 50, 75, 100)}
    return {"runs": runs, **places, "cpu_ms_a_run": 1e3 * spent / runs}


def strokes(runs: int, model: Path, workers: int) -> dict:
    """Stroke runs in processes against one run after the other."""
    study = Study("golf_robot", model, tasks=["stroke_1.4"], controllers=["prior_observer"], seeds=runs)
    run, _ = load_inputs(study)
    first = next(study.runs())
    run(first)  # models and controllers are built
    alone = []
    for _ in range(5):
        begin, cpu = perf_counter(), process_time()
        run(first)
        alone.append((perf_counter() - begin, process_time() - cpu))
    single, single_cpu = np.median(alone, axis=0)
    with tempfile.TemporaryDirectory() as folder:
        begin, cpu = perf_counter(), process_time()
        results = run_study(study, Path(folder) / "s", workers=workers)
        wall, parent = perf_counter() - begin, process_time() - cpu
    spent = float(results.table[f"{TIMING}cpu_s"].sum())
    return {
        "runs": runs,
        "workers": workers,
        "single_s": float(single),
        "single_cpu_s": float(single_cpu),
        "wall_s": wall,
        "wall_over_ideal": wall * workers / (runs * float(single)),
        "runs_cpu_over_ideal": spent / (runs * float(single_cpu)),
        "parent_cpu_share": parent / spent,
    }


def scale(runs: int) -> dict:
    """Bytes and times a run of the parts that see all runs."""
    study = many(runs)
    begin = process_time()
    ids = [run.id for run in study.runs()]
    named = process_time() - begin
    with tempfile.TemporaryDirectory() as place:
        folder, path = Path(place) / "runs", Path(place) / "results.parquet"
        lines = [
            {"id": run.id, **run.columns(), "status": "done", "error": "", **nothing(run)}
            for run in study.runs()
        ]
        begin = process_time()
        with RunLog(folder) as log:
            for i in range(0, runs, 100):
                log.append(lines[i : i + 100])
        logged = process_time() - begin
        with RunLog(Path(place) / "single") as log:
            begin = perf_counter()
            for line in lines[:200]:
                log.append([line])
            single = perf_counter() - begin
        del lines
        begin = process_time()
        seen = sum(1 for _ in rows(folder))
        read = process_time() - begin
        before, begin = resident_mb(), process_time()
        compact(folder, path, {})
        compacted = process_time() - begin
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        sizes = sum(p.stat().st_size for p in segments(folder)), path.stat().st_size
        (Path(place) / "study.json").write_text("{}")
        begin = process_time()
        table = StudyResults.load(place).table
        loaded = process_time() - begin
    return {
        "runs": runs,
        "distinct_ids": len(set(ids)),
        "ids_bytes": (sys.getsizeof(set(ids)) + sum(map(sys.getsizeof, ids))) / runs,
        "rows_read": seen,
        "name_us": 1e6 * named / runs,
        "log_us": 1e6 * logged / runs,
        "append_one_wall_ms": 1e3 * single / min(200, runs),
        "read_us": 1e6 * read / runs,
        "compact_us": 1e6 * compacted / runs,
        "load_us": 1e6 * loaded / runs,
        "log_bytes": sizes[0] / runs,
        "parquet_bytes": sizes[1] / runs,
        "log_files": -(-runs // 10_000),
        "table_bytes": float(table.memory_usage(deep=True).sum()) / runs,
        "mb_before_compaction": before,
        "mb_peak": peak,
    }


def dask(runs: int) -> dict:
    """Runs that do nothing on a local cluster of 2 processes, one a batch."""
    from distributed import Client, LocalCluster

    from hybrid_mpc.job import study_run as runner

    runner.BATCH_MOST = 1
    with (
        LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
        tempfile.TemporaryDirectory() as folder,
        RunLog(Path(folder)) as log,
    ):
        engine = DaskEngine(partial(run_batch, nothing), client)
        execute(many(4).runs(), log, engine, Silent(), 4)
        begin, cpu = perf_counter(), process_time()
        execute(many(runs).runs(), log, engine, Silent(), runs)
        wall, parent = perf_counter() - begin, process_time() - cpu  # the scheduler lives in this process
        engine.close()
    return {
        "runs": runs,
        "wall_ms_a_batch": 1e3 * wall / runs,
        "scheduler_cpu_ms_a_batch": 1e3 * parent / runs,
    }


def main() -> int:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("overhead", "short", "strokes", "scale", "dask"))
    parser.add_argument("--runs", type=int)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--model", type=Path, help="artifact folder, for short and strokes")
    given = parser.parse_args()
    if given.what in ("short", "strokes") and given.model is None:
        parser.error(f"{given.what} needs --model")
    if given.what == "short":
        found = short(given.runs or 10_000, given.model)
    elif given.what == "strokes":
        found = strokes(given.runs or 1000, given.model, given.workers)
    else:
        measure, usual = {"overhead": (overhead, 10_000), "scale": (scale, 20_000), "dask": (dask, 1000)}[
            given.what
        ]
        found = measure(given.runs or usual)
    print(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
