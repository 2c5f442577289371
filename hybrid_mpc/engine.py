"""Engines that compute jobs: local processes through joblib's loky, or a cluster through dask."""

from __future__ import annotations

import operator
import os
import re
import signal
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError
from contextvars import ContextVar
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from queue import Empty, Queue
from typing import Any, Generic, TypeVar

from hybrid_mpc.errors import InputError, named_extra, no_exit
from hybrid_mpc.rules import counted

WORKERS = min(2, os.cpu_count() or 1)
"""Number of parallel processes: at most two, the cores of the reference machine."""
REPORT_S = 0.02
"""Time [s] that :func:`run_jobs` waits for a report before it checks whether a job has ended."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that set the number of threads of numerical libraries."""
CONNECT_S = 5.0
"""Longest wait [s] for a scheduler."""
ADDRESS = re.compile(r"(tcp://)?(\[[0-9a-fA-F:]+\]|[A-Za-z0-9_.-]+):[0-9]{1,5}")
"""Addresses of schedulers that need no further configuration."""
LOOK_S = 2.0
"""Time [s] between counts of a cluster's workers."""
ALONE_S = 60.0
"""Longest time [s] that a cluster may have no worker."""
B = TypeVar("B")
R = TypeVar("R")


class Progress:
    """Receives progress reports of a job; this class ignores them."""

    def start(self, title: str) -> None:
        """A stage begins."""

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Part ``key`` of the stage has finished ``done`` of ``total``."""

    def warn(self, text: str) -> None:
        """A warning that does not stop the job."""

    def note(self, text: str) -> None:
        """A remark that asks for nothing, e.g. how a file was read."""

    def finish(self, text: str) -> None:
        """The stage has ended."""


class Lost(Exception):
    """A batch whose worker died; ``final`` if the engine has already retried it several times."""

    def __init__(self, why: str, final: bool) -> None:
        super().__init__(why)
        self.final = final


class Engine(ABC, Generic[B, R]):
    """Computes batches in parallel workers by a function of the batch; results do not depend on the worker.

    ``workers`` is the number of parallel batches, ``name`` describes the engine, ``died`` counts dead workers.
    """

    workers: int
    name: str
    died: int

    def __init__(self) -> None:
        self.died = 0
        self._ended: Queue[Any] = Queue()
        self._batches: dict[Any, B] = {}

    @abstractmethod
    def submit(self, batch: B) -> None:
        """Start a batch; RuntimeError if no worker can be started."""

    def next(self, timeout: float) -> tuple[B, R | Lost] | None:
        """A finished batch with its result or the reason of its loss; None if none finishes within ``timeout`` [s].

        Exceptions of the work itself are raised here.
        """
        try:
            future = self._ended.get(timeout=timeout)
        except Empty:
            return None
        if future not in self._batches:
            return None
        return self._batches.pop(future), self._result(future)

    @abstractmethod
    def close(self) -> None:
        """Stop running batches."""

    def _watch(self, future: Any, batch: B) -> None:
        self._batches[future] = batch
        future.add_done_callback(self._ended.put)

    @abstractmethod
    def _result(self, future: Any) -> R | Lost: ...


class LocalEngine(Engine[B, R]):
    """Local processes, each of which computes one batch after the other. Work, batches and results must pickle.

    ``threads`` is the number of threads of numerical libraries in each process (default: from the environment).
    ``begin`` is called in each process before its first batch; connections in it are inherited.

    Example:
        >>> engine = LocalEngine(sum, workers=1, threads=1)
        >>> engine.submit((1, 2, 3))
        >>> engine.next(timeout=60.0)
        ((1, 2, 3), 6)
        >>> engine.close()
    """

    def __init__(
        self,
        work: Callable[[B], R],
        workers: int,
        *,
        threads: int | None = None,
        begin: Callable[[], None] | None = None,
    ) -> None:
        super().__init__()
        _check(workers)
        self._work, self.workers, self.name = work, workers, f"joblib, {workers} processes"
        self._environment = {} if threads is None else dict.fromkeys(THREADS, str(threads))
        self._begin = begin
        self._pool: Any = None
        self._pools: dict[Any, Any] = {}
        self._broken: list[Any] = []

    def submit(self, batch: B) -> None:
        """See :class:`Engine`."""
        for _ in range(2):
            self._pool = self._pool or self._started()
            try:
                future = self._pool.submit(self._work, batch)
                break
            except BrokenExecutor as error:  # a process has just died; its own batch reports the loss
                self._pool, broken = None, error
        else:
            raise RuntimeError(
                f"new processes end immediately ({type(broken).__name__}: {broken}). Check memory and the process limit"
            ) from broken
        self._pools[future] = self._pool
        self._watch(future, batch)

    def _started(self) -> Any:
        from joblib.externals.loky import ProcessPoolExecutor

        return ProcessPoolExecutor(
            self.workers, env=self._environment, initializer=_began, initargs=(os.getpid(), self._begin)
        )

    def _result(self, future: Any) -> R | Lost:
        pool = self._pools.pop(future)
        try:
            result: R = future.result()
            return result
        except (BrokenExecutor, CancelledError) as error:
            self.died += pool not in self._broken
            self._broken.append(pool)
            self._pool = None if pool is self._pool else self._pool
            # the event and the exit codes; or the traceback of a failed unpickling
            why = [line for line in str(error).splitlines() if line][:2]
            why += [str(error.__cause__)] if error.__cause__ else []
            return Lost(f"{type(error).__name__}: {' '.join(why)}", False)

    def close(self) -> None:
        """See :class:`Engine`."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=bool(self._batches))
            self._pool = None


class DaskEngine(Engine[B, R]):
    """Workers of a dask cluster, given by its scheduler's address or a ``distributed.Client``.

    ``work`` is sent to each worker once. The scheduler gives the batch of a dead worker to another one, and gives it up
    after several deaths.

    Raises:
        InputError: If dask is missing, the scheduler cannot be reached, or it has no worker.
    """

    def __init__(self, work: Callable[[B], R], cluster: Any) -> None:
        super().__init__()
        self._own = isinstance(cluster, str)
        self._client = _connected(cluster) if isinstance(cluster, str) else cluster
        self._work = work
        self._shared: Any = None
        try:
            self._seen = set(self._client.nthreads())
            if not self._seen:
                raise InputError(
                    f"scheduler {self._address}: has no worker. Start one with: dask worker ADDRESS [HM-ENGINE-001]"
                )
        except BaseException:
            self.close()
            raise
        self.workers, self.name = len(self._seen), f"dask, {counted(len(self._seen), 'worker')}"
        self._looked = self._manned = time.monotonic()

    @property
    def _address(self) -> str:
        return str(self._client.scheduler.address)

    def next(self, timeout: float) -> tuple[B, R | Lost] | None:
        """See :class:`Engine`; InputError if the cluster has had no worker for ``ALONE_S``."""
        now = time.monotonic()
        if now - self._looked >= LOOK_S:
            self._looked, there = now, set(self._client.nthreads())
            self.died, self._seen = self.died + len(self._seen - there), there
            self._manned = now if there else self._manned
        if now - self._manned > ALONE_S:
            raise self._alone()
        return super().next(timeout)

    def submit(self, batch: B) -> None:
        """See :class:`Engine`."""
        if self._shared is None:
            try:
                self._shared = self._client.scatter(self._work, broadcast=True, hash=False, timeout=ALONE_S)
            except TimeoutError as error:
                raise self._alone() from error
        self._watch(self._client.submit(operator.call, self._shared, batch, pure=False), batch)

    def _alone(self) -> InputError:
        return InputError(
            f"scheduler {self._address}: no worker for {ALONE_S:g} s. Finished jobs are saved; continue with --resume "
            "once workers run. [HM-ENGINE-006]"
        )

    def _result(self, future: Any) -> R | Lost:
        from distributed.scheduler import KilledWorker

        try:
            result: R = future.result()
            return result
        except KilledWorker as error:
            return Lost(f"KilledWorker: {str(error).splitlines()[0]}", True)
        except Exception as error:
            if future.status == "error":  # an exception of the work itself
                raise
            if self._client.status != "running":
                raise InputError(
                    f"scheduler {self._address}: the connection is lost. Finished jobs are saved; continue "
                    "with --resume. [HM-ENGINE-002]"
                ) from error
            if not isinstance(error, (CancelledError, OSError)):  # the result cannot be unpickled
                raise
            self._shared = None  # the shared inputs were lost with their last worker or a connection
            return Lost(f"{type(error).__name__}: {error}", False)

    def close(self) -> None:
        """See :class:`Engine`."""
        self._client.cancel(list(self._batches))
        self._shared = None
        if self._own:
            self._client.close()


def make_engine(
    work: Callable[[B], R], workers: int, cluster: Any = None, *, threads: int | None = None
) -> Engine[B, R]:
    """The engine of a cluster, or local processes without one.

    Threads of a cluster's workers are set when these are started.
    """
    return LocalEngine(work, workers, threads=threads) if cluster is None else DaskEngine(work, cluster)


def run_jobs(
    jobs: Mapping[str, tuple[Callable[..., Any], tuple[Any, ...]]],
    on_progress: Callable[[str, int, int, str], None],
    workers: int,
    on_result: Callable[[str, Any], None] = lambda name, result: None,
    *,
    fresh: bool = True,
    cluster: Any = None,
) -> dict[str, Any]:
    """Run ``function(*args, report)`` for each job and return the results by name.

    A job calls ``report(done, total, text)``, which is passed to ``on_progress`` with the job's name. Jobs start in the
    given order, ``workers`` at a time, each in a fresh process with the environment's number of threads, so results do
    not depend on the number of parallel jobs. ``on_result`` is called when a job ends, even if another one fails.
    ``fresh=False`` reuses processes, for jobs without side effects on later ones that import the same slow modules.

    On a ``cluster`` (address of a dask scheduler or a ``distributed.Client``) all jobs go to its workers, which must
    see the jobs' files under the same paths; ``on_progress`` is then called only at the end of each job.

    Raises:
        InputError: If a job raises one. Or if ``workers`` is less than 1.
        RuntimeError: If a job fails otherwise, with its traceback. In both cases the other jobs are stopped.

    Example:
        >>> def double(x, report):
        ...     report(1, 1, "doubled")
        ...     return 2 * x
        >>> run_jobs({"a": (double, (1,)), "b": (double, (2,))}, lambda *report: None, workers=1)
        {'a': 2, 'b': 4}
    """
    _check(workers)
    if cluster is not None:
        return _on_cluster(jobs, on_progress, cluster, on_result)
    queue, results = list(jobs), {}
    running: dict[str, _Worker] = {}
    idle: list[_Worker] = []
    try:
        while queue or running:
            while queue and len(running) < workers:
                name = queue.pop(0)
                running[name] = idle.pop() if idle else _Worker()
                running[name].start(*jobs[name])
            wait([worker.reports for worker in running.values()], REPORT_S)
            failed: dict[str, Exception] = {}
            for name, worker in list(running.items()):
                ended = worker.ended()
                for report in worker.new_reports(rest=ended is not None):
                    on_progress(name, *report)
                if ended is None:
                    continue
                idle.append(running.pop(name))
                if fresh:
                    idle.pop().close()
                value, error = ended
                if error is None:
                    results[name] = value
                    on_result(name, value)
                else:
                    failed[name] = error
            if failed:  # raised only after the results of other finished jobs
                name, error = next(iter(failed.items()))
                raise error if isinstance(error, InputError) else RuntimeError(f"{name} failed:\n{error}")
    finally:
        for worker in (*running.values(), *idle):
            worker.close()
    return results


def _on_cluster(
    jobs: Mapping[str, tuple[Callable[..., Any], tuple[Any, ...]]],
    on_progress: Callable[[str, int, int, str], None],
    cluster: Any,
    on_result: Callable[[str, Any], None],
) -> dict[str, Any]:
    """:func:`run_jobs` on a cluster; jobs of lost workers are submitted again."""
    results: dict[str, Any] = {}
    engine: Engine[tuple[str, Any, Any], Any] = DaskEngine(_run_named, cluster)
    try:
        for name, (function, args) in jobs.items():
            engine.submit((name, function, args))
        while len(results) < len(jobs):
            found = engine.next(LOOK_S)
            if found is None:
                continue
            batch, ended = found
            if isinstance(ended, Lost):
                if ended.final:
                    raise RuntimeError(f"{batch[0]} failed:\n{ended}")
                engine.submit(batch)
                continue
            value, error = ended
            if error is not None:
                raise error if isinstance(error, InputError) else RuntimeError(f"{batch[0]} failed:\n{error}")
            results[batch[0]] = value
            on_progress(batch[0], 1, 1, engine.name)
            on_result(batch[0], value)
    finally:
        engine.close()
    return results


def _run_named(job: tuple[str, Callable[..., Any], tuple[Any, ...]]) -> tuple[Any, Exception | None]:
    return _computed(job[1], job[2], lambda done, total, text: None)


class _Worker:
    """A process that computes one job after the other, and its reports.

    Each worker has its own engine: torch's number of threads, state of modules and memory must not reach other jobs.
    """

    def __init__(self) -> None:
        self.reports, self._theirs = Pipe(duplex=False)
        self._engine = LocalEngine(_run, 1, begin=partial(_report_to, self._theirs))

    def start(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        """Start a job; the previous one has ended."""
        self._engine.submit((function, args))

    def ended(self) -> tuple[Any, Exception | None] | None:
        """The job's value or its error; None while it runs."""
        try:
            found = self._engine.next(timeout=0.0)
        except Exception:  # arguments or a result that do not pickle
            return None, RuntimeError(traceback.format_exc())
        if found is None:
            return None
        ended = found[1]
        return (None, RuntimeError(f"its process ended ({ended})")) if isinstance(ended, Lost) else ended

    def new_reports(self, *, rest: bool) -> Iterator[tuple[int, int, str]]:
        """The next report, if any; all ``rest`` after the job has ended."""
        try:
            while self.reports.poll():
                yield self.reports.recv()
                if not rest:
                    return
        except EOFError:
            return

    def close(self) -> None:
        """Stop a running job and close the worker."""
        self._engine.close()
        self._theirs.close()
        self.reports.close()


_REPORTS: ContextVar[Connection] = ContextVar("reports")
"""In a worker of :func:`run_jobs`: the inherited pipe to its parent."""


def _report_to(reports: Connection) -> None:
    _REPORTS.set(reports)


def _run(job: tuple[Callable[..., Any], tuple[Any, ...]]) -> tuple[Any, Exception | None]:
    """Run a job in its worker."""
    (function, args), reports = job, _REPORTS.get()

    def report(done: int, total: int, text: str) -> None:
        reports.send((done, total, text))

    return _computed(function, args, report)


def _computed(
    function: Callable[..., Any], args: tuple[Any, ...], report: Callable[[int, int, str], None]
) -> tuple[Any, Exception | None]:
    try:
        with no_exit():
            return function(*args, report), None
    except InputError as error:
        return None, error
    except BaseException:  # the parent raises every failure
        return None, RuntimeError(traceback.format_exc())


def _began(parent: int, begin: Callable[[], None] | None) -> None:
    """Tie a worker to its parent: the worker ignores Ctrl-C, and ends when the parent ends or is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            # time [s] between a worker's checks that its parent is alive
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    if begin is not None:
        begin()


def _check(workers: int) -> None:
    if workers < 1:
        raise InputError(f"workers: must be at least 1, got {workers} [HM-ENGINE-003]")


def _connected(address: str) -> Any:
    with named_extra("a scheduler"):
        from distributed import Client
    if not ADDRESS.fullmatch(address):
        raise InputError(
            f"scheduler: the address must be tcp://HOST:PORT, got {address!r}. For another protocol (tls://) connect a "
            "distributed.Client and pass it instead of the address. [HM-ENGINE-004]"
        )
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"scheduler {address}: no answer within {CONNECT_S:g} s ({type(error).__name__}). Start one with 'dask "
            "scheduler', or omit --scheduler to use this machine. [HM-ENGINE-005]"
        ) from error
