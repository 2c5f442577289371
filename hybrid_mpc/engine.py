"""Where work is computed: processes of this machine through joblib's loky, or a cluster through dask."""

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

WORKERS = min(2, os.cpu_count() or 1)
"""Processes side by side: the machine this is made for has two cores."""
WATCH_S = 0.5
"""How often a worker looks whether its parent is still there."""
REPORT_S = 0.02
"""How long :func:`run_jobs` waits for a report before it looks whether a job has ended."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What tells numerical libraries how many threads to take."""
CONNECT_S = 5.0
"""How long a scheduler is waited for."""
ADDRESS = re.compile(r"(tcp://)?(\[[0-9a-fA-F:]+\]|[A-Za-z0-9_.-]+):[0-9]{1,5}")
"""Addresses of schedulers that need nothing else to be known."""
LOOK_S = 2.0
"""How often the workers of a cluster are counted."""
ALONE_S = 60.0
"""How long a cluster may be without any."""
B = TypeVar("B")
R = TypeVar("R")


class Progress:
    """Where a job reports to; this one says nothing."""

    def start(self, title: str) -> None:
        """A stage begins."""

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Part ``key`` of the stage has done ``done`` of ``total``."""

    def warn(self, text: str) -> None:
        """Something that the user should know of, and that stops nothing."""

    def finish(self, text: str) -> None:
        """The stage is done."""


class Lost(Exception):
    """A batch whose worker died; ``final`` where the engine has tried several times already."""

    def __init__(self, why: str, final: bool) -> None:
        super().__init__(why)
        self.final = final


class Engine(ABC, Generic[B, R]):
    """Computes batches side by side, each in some worker, by a function of the batch; results depend on no worker.

    ``workers`` is the number of batches side by side, ``name`` is for the record, ``died`` counts workers that died.
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
        """Begin a batch; RuntimeError if no worker can be started for it."""

    def next(self, timeout: float) -> tuple[B, R | Lost] | None:
        """A batch that has ended, with its result or how it was lost; None if none ends within ``timeout`` [s].

        What the work itself raises is raised here.
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
        """End what still runs."""

    def _watch(self, future: Any, batch: B) -> None:
        self._batches[future] = batch
        future.add_done_callback(self._ended.put)

    @abstractmethod
    def _result(self, future: Any) -> R | Lost: ...


class LocalEngine(Engine[B, R]):
    """Processes of this machine; each computes one batch after the other. Work, batches and results must pickle.

    Numerical libraries take ``threads`` in each process; default: what the environment says. ``begin`` is called in
    each process before its first batch; connections in it are inherited.

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
            except BrokenExecutor as error:  # one of its processes has just died; what it was at tells of it
                self._pool, broken = None, error
        else:
            raise RuntimeError(
                f"new processes end as they begin ({type(broken).__name__}: {broken}); out of memory, or of processes?"
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
            # what happened, and the exit codes; or the traceback of what could not be unpickled
            why = [line for line in str(error).splitlines() if line][:2]
            why += [str(error.__cause__)] if error.__cause__ else []
            return Lost(f"{type(error).__name__}: {' '.join(why)}", False)

    def close(self) -> None:
        """See :class:`Engine`."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=bool(self._batches))
            self._pool = None


class DaskEngine(Engine[B, R]):
    """Workers of a dask cluster, by its scheduler's address or a ``distributed.Client``; ``work`` is sent to each once.

    A worker that dies is the scheduler's affair: it gives the batch to another, and gives it up when several workers
    died of it.

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
                    f"the scheduler {self._address} has no worker; start some: dask worker ADDRESS [HM-ENGINE-001]"
                )
        except BaseException:
            self.close()
            raise
        self.workers, self.name = len(self._seen), f"dask, {len(self._seen)} workers"
        self._looked = self._manned = time.monotonic()

    @property
    def _address(self) -> str:
        return str(self._client.scheduler.address)

    def next(self, timeout: float) -> tuple[B, R | Lost] | None:
        """See :class:`Engine`; InputError if the cluster has had no worker for a while."""
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
            f"the scheduler {self._address} has had no worker for {ALONE_S:g} s; what has finished is kept, "
            "--resume goes on when there are some [HM-ENGINE-006]"
        )

    def _result(self, future: Any) -> R | Lost:
        from distributed.scheduler import KilledWorker

        try:
            result: R = future.result()
            return result
        except KilledWorker as error:
            return Lost(f"KilledWorker: {str(error).splitlines()[0]}", True)
        except Exception as error:
            if future.status == "error":  # what the work itself has raised
                raise
            if self._client.status != "running":
                raise InputError(
                    f"the scheduler {self._address} is gone; what has finished is kept, --resume goes on"
                    " [HM-ENGINE-002]"
                ) from error
            if not isinstance(error, (CancelledError, OSError)):  # a result that does not unpickle
                raise
            self._shared = None  # the shared inputs went with their last worker, or a connection did
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
    """The engine of a cluster, or of this machine where there is none.

    Threads of a cluster's workers are set where they are started.
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

    A job calls ``report(done, total, text)`` as it goes, which ``on_progress`` gets with its name. Jobs start in the
    order given, ``workers`` at a time, each in a fresh process with the environment's number of threads, so results do
    not depend on how many run side by side. ``on_result`` is called as each job ends, also beside one that fails.
    ``fresh=False``: a process computes one job after the other, for jobs that leave nothing behind that the next would
    notice and that load the same things for seconds.

    On a ``cluster`` (address of a dask scheduler or a ``distributed.Client``) all jobs are handed to its workers, which
    must see the files that the jobs name under the same paths; ``on_progress`` is then told of ends alone.

    Raises:
        InputError: If a job raises one: bad input that shows only then. Or if ``workers`` is less than 1.
        RuntimeError: If a job fails otherwise; the message holds its traceback. In either case the others are ended.

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
            if failed:  # raised only now, after the results of others that had ended by then
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
    """:func:`run_jobs` on the workers of a cluster; what a lost worker was at is handed out again."""
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

    It has an engine of its own: the number of threads that a training sets in torch, what modules keep, and the memory
    of one process must not reach another.
    """

    def __init__(self) -> None:
        self.reports, self._theirs = Pipe(duplex=False)
        self._engine = LocalEngine(_run, 1, begin=partial(_report_to, self._theirs))

    def start(self, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
        """Begin a job; the one before has ended."""
        self._engine.submit((function, args))

    def ended(self) -> tuple[Any, Exception | None] | None:
        """The job's value, or what it failed by; None while it runs."""
        try:
            found = self._engine.next(timeout=0.0)
        except Exception:  # arguments or a result that do not pickle
            return None, RuntimeError(traceback.format_exc())
        if found is None:
            return None
        ended = found[1]
        return (None, RuntimeError(f"its process ended ({ended})")) if isinstance(ended, Lost) else ended

    def new_reports(self, *, rest: bool) -> Iterator[tuple[int, int, str]]:
        """The next report, if there is one; the ``rest`` of them once the job has ended."""
        try:
            while self.reports.poll():
                yield self.reports.recv()
                if not rest:
                    return
        except EOFError:
            return

    def close(self) -> None:
        """End it if it still runs."""
        self._engine.close()
        self._theirs.close()
        self.reports.close()


_REPORTS: ContextVar[Connection] = ContextVar("reports")
"""In a worker of :func:`run_jobs`: the pipe to its parent, which it inherited as it started."""


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
    except BaseException:  # every failure travels to the parent, which raises it
        return None, RuntimeError(traceback.format_exc())


def _began(parent: int, begin: Callable[[], None] | None) -> None:
    """Tie a worker to the process of its parent: it leaves Ctrl-C to it, and ends with it, even if it was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    if begin is not None:
        begin()


def _check(workers: int) -> None:
    if workers < 1:
        raise InputError(f"workers must be 1 or more, got {workers} [HM-ENGINE-003]")


def _connected(address: str) -> Any:
    with named_extra("a scheduler"):
        from distributed import Client
    if not ADDRESS.fullmatch(address):
        raise InputError(
            f"the scheduler's address must be tcp://HOST:PORT, got {address!r}; for another kind (tls://) connect a "
            "distributed.Client yourself, and give it in place of the address [HM-ENGINE-004]"
        )
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no dask scheduler at {address} within {CONNECT_S:g} s ({type(error).__name__}); start one with "
            "'dask scheduler', or leave --scheduler out to use this machine [HM-ENGINE-005]"
        ) from error
