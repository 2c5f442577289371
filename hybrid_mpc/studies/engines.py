"""Where runs are computed: processes of this machine through joblib, or a cluster through dask."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping
from queue import Empty, Queue
from typing import Any, Protocol

from hybrid_mpc.errors import InputError
from hybrid_mpc.pipeline.parallel import follow
from hybrid_mpc.studies.inputs import LoopRunner, run_batch

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
CONNECT_S = 5.0
"""How long a scheduler is waited for."""
ADDRESS = re.compile(r"(tcp://)?(\[[0-9a-fA-F:]+\]|[A-Za-z0-9_.-]+):[0-9]{1,5}")
"""Addresses of schedulers that need nothing else to be known."""
LOOK_S = 2.0
"""How often the workers of a cluster are counted."""
ALONE_S = 60.0
"""How long a cluster may be without any."""
Run = Callable[[Any], Mapping[str, Any]]
Batch = tuple[Any, ...]


class Lost(Exception):
    """A batch whose worker died; ``final`` where the engine has tried several times already."""

    def __init__(self, why: str, final: bool) -> None:
        super().__init__(why)
        self.final = final


class Engine(Protocol):
    """Computes batches, each in some worker; results do not depend on where."""

    @property
    def workers(self) -> int:
        """Batches that are computed side by side."""

    @property
    def name(self) -> str:
        """What it is, for the record."""

    @property
    def died(self) -> int:
        """Workers that have died so far; what they were at is begun again."""

    def submit(self, batch: Batch) -> None:
        """Begin a batch of configurations."""

    def next(self, timeout: float) -> tuple[Batch, list[dict[str, Any]] | Lost] | None:
        """A batch that has ended, with its rows or how it was lost; None if none ends within ``timeout`` [s]."""

    def close(self) -> None:
        """End what still runs."""


class _Futures:
    """Batches as futures that tell a queue when they are done."""

    def __init__(self) -> None:
        self._ended: Queue[Any] = Queue()
        self._batches: dict[Any, Batch] = {}

    def _watch(self, future: Any, batch: Batch) -> None:
        self._batches[future] = batch
        future.add_done_callback(self._ended.put)

    def next(self, timeout: float) -> tuple[Batch, list[dict[str, Any]] | Lost] | None:
        """See :class:`Engine`."""
        try:
            future = self._ended.get(timeout=timeout)
        except Empty:
            return None
        batch = self._batches.pop(future, None)
        return None if batch is None else (batch, self._result(future))

    def _result(self, future: Any) -> list[dict[str, Any]] | Lost:
        raise NotImplementedError


class LocalEngine(_Futures):
    """Processes of this machine, with one thread each.

    Args:
        run: Makes the results of one configuration; it must pickle.
        workers: Processes.

    Raises:
        InputError: If joblib is missing, or ``workers`` is less than 1.
    """

    def __init__(self, run: Run, workers: int) -> None:
        super().__init__()
        if workers < 1:
            raise InputError(f"study: workers must be 1 or more, got {workers}")
        self._run, self.workers, self.name = run, workers, f"joblib, {workers} processes"
        self.died = 0
        self._pool: Any = None
        self._pools: dict[Any, Any] = {}
        self._broken: list[Any] = []

    def submit(self, batch: Batch) -> None:
        """See :class:`Engine`."""
        from concurrent.futures import BrokenExecutor

        for _ in range(2):
            self._pool = self._pool or _pool(self.workers)
            try:
                future = self._pool.submit(run_batch, self._run, batch)
                break
            except BrokenExecutor:  # one of its processes has just died; what it was at tells of it
                self._pool = None
        self._pools[future] = self._pool
        self._watch(future, batch)

    def _result(self, future: Any) -> list[dict[str, Any]] | Lost:
        from concurrent.futures import BrokenExecutor, CancelledError

        pool = self._pools.pop(future)
        try:
            rows: list[dict[str, Any]] = future.result()
            return rows
        except (BrokenExecutor, CancelledError) as error:
            self.died += pool not in self._broken
            self._broken.append(pool)
            self._pool = None if pool is self._pool else self._pool
            return Lost(f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}", False)

    def close(self) -> None:
        """See :class:`Engine`."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=True)
            self._pool = None


class DaskEngine(_Futures):
    """Workers of a dask cluster; the models' files are sent to each of them once.

    A worker that dies is the scheduler's affair: it gives the batch to another, and gives it up when several workers
    died of it.

    Args:
        run: Makes the results of one configuration; it must pickle.
        cluster: Address of a scheduler, ``"tcp://host:8786"``, or a ``distributed.Client``.

    Raises:
        InputError: If dask is missing, the scheduler cannot be reached, or it has no worker.
    """

    def __init__(self, run: Run, cluster: Any) -> None:
        super().__init__()
        self._own = isinstance(cluster, str)
        self._client = _connected(cluster) if isinstance(cluster, str) else cluster
        self._run = run.with_files() if isinstance(run, LoopRunner) else run
        self._shared: Any = None
        self.workers = max(1, len(self._client.nthreads()))
        if not self._client.nthreads():
            raise InputError(
                f"study: the scheduler {self._address} has no worker; start some: dask worker ADDRESS"
            )
        self.name = f"dask, {len(self._client.nthreads())} workers"
        self.died = 0
        self._seen = set(self._client.nthreads())
        self._looked = self._manned = time.monotonic()

    @property
    def _address(self) -> str:
        return str(self._client.scheduler.address)

    def next(self, timeout: float) -> tuple[Batch, list[dict[str, Any]] | Lost] | None:
        """See :class:`Engine`.

        Raises:
            InputError: If the cluster has had no worker for a while.
        """
        now = time.monotonic()
        if now - self._looked >= LOOK_S:
            self._looked, there = now, set(self._client.nthreads())
            self.died, self._seen = self.died + len(self._seen - there), there
            self._manned = now if there else self._manned
        if now - self._manned > ALONE_S:
            raise self._alone()
        return super().next(timeout)

    def submit(self, batch: Batch) -> None:
        """See :class:`Engine`."""
        if self._shared is None:
            try:
                self._shared = self._client.scatter(self._run, broadcast=True, hash=False, timeout=ALONE_S)
            except TimeoutError as error:
                raise self._alone() from error
        self._watch(self._client.submit(run_batch, self._shared, batch, pure=False), batch)

    def _alone(self) -> InputError:
        return InputError(
            f"study: the scheduler {self._address} has had no worker for {ALONE_S:g} s; finished runs are kept, "
            "--resume goes on when there are some"
        )

    def _result(self, future: Any) -> list[dict[str, Any]] | Lost:
        from distributed.scheduler import KilledWorker

        try:
            rows: list[dict[str, Any]] = future.result()
            return rows
        except KilledWorker as error:
            return Lost(f"KilledWorker: {str(error).splitlines()[0]}", True)
        except Exception as error:  # the shared inputs went with their last worker, or the connection
            if self._client.status != "running":
                raise InputError(
                    f"study: the scheduler {self._address} is gone; finished runs are kept, --resume goes on"
                ) from error
            self._shared = None
            return Lost(f"{type(error).__name__}: {error}", False)

    def close(self) -> None:
        """See :class:`Engine`."""
        self._client.cancel(list(self._batches))
        self._shared = None
        if self._own:
            self._client.close()


def make_engine(run: Run, workers: int, cluster: Any) -> Engine:
    """The engine of a cluster, or of this machine where ``cluster`` is None."""
    return LocalEngine(run, workers) if cluster is None else DaskEngine(run, cluster)


def _pool(workers: int) -> Any:
    try:
        from joblib.externals.loky import ProcessPoolExecutor
    except ImportError as error:
        raise InputError(f"study: {error}; pip install 'hybrid-mpc[studies]'") from error
    return ProcessPoolExecutor(workers, env=ONE_THREAD, initializer=follow, initargs=(os.getpid(),))


def _connected(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(f"study: {error}; pip install 'hybrid-mpc[studies]'") from error
    if not ADDRESS.fullmatch(address):
        raise InputError(
            f"study: the scheduler's address must be tcp://HOST:PORT, got {address!r}; for another kind (tls://) "
            "connect a distributed.Client yourself, and give it to run_study(cluster=...)"
        )
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"study: no dask scheduler at {address} within {CONNECT_S:g} s ({type(error).__name__}); start one with "
            "'dask scheduler', or leave --scheduler out to use this machine"
        ) from error
