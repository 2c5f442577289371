"""Jobs in processes of their own that report their progress while they work."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait
from typing import Any

from hybrid_mpc.errors import InputError

WATCH_S = 0.5
"""How often a worker looks whether its parent is still there."""
WORKERS = min(2, os.cpu_count() or 1)
"""Processes side by side: the machine this is made for has two cores."""


def run_jobs(
    jobs: Mapping[str, tuple[Callable[..., Any], tuple[Any, ...]]],
    on_progress: Callable[[str, int, int, str], None],
    workers: int,
    on_result: Callable[[str, Any], None] = lambda name, result: None,
) -> dict[str, Any]:
    """Run ``function(*args, report)`` for each job and return the results by name.

    ``on_result(name, result)`` is called as each job ends, so that what is done can be kept.

    A job calls ``report(done, total, text)`` as it goes. Jobs start in the order given, ``workers`` at a
    time, each in a fresh process, so results do not depend on how many run side by side.

    Raises:
        InputError: If a job raises one: bad input that shows only then.
        RuntimeError: If a job fails otherwise; the message holds its traceback. In either case the others are ended.
    """
    context = multiprocessing.get_context("spawn")
    waiting, results = list(jobs), {}
    running: dict[Connection, tuple[str, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                name = waiting.pop(0)
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(theirs, *jobs[name]), daemon=True)
                process.start()
                theirs.close()
                running[ours] = (name, process)
            for connection in wait(list(running)):
                name, process = running[connection]  # type: ignore[index]
                kind, value = _receive(connection, process)  # type: ignore[arg-type]
                if kind == "progress":
                    on_progress(name, *value)
                    continue
                if kind == "input":
                    raise value[0](value[1])
                if kind == "error":
                    raise RuntimeError(f"{name} failed:\n{value}")
                results[name] = value
                on_result(name, value)
                process.join()
                del running[connection]  # type: ignore[arg-type]
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join()
    return results


def _receive(connection: Connection, process: Any) -> tuple[str, Any]:
    try:
        message: tuple[str, Any] = connection.recv()
    except EOFError:
        process.join()
        return "error", f"its process ended with exit code {process.exitcode}"
    return message


def _work(connection: Connection, function: Callable[..., Any], args: tuple[Any, ...]) -> None:
    def report(done: int, total: int, text: str) -> None:
        connection.send(("progress", (done, total, text)))

    parent = multiprocessing.parent_process()
    assert parent is not None
    assert parent.pid is not None
    follow(parent.pid)
    try:
        result = function(*args, report)
    except BrokenPipeError:  # the parent is gone, and with it whoever wanted the result
        return
    except InputError as error:
        connection.send(("input", (type(error), str(error))))
    except Exception:  # every failure travels to the parent, which raises it
        connection.send(("error", traceback.format_exc()))
    else:
        connection.send(("result", result))
    finally:
        connection.close()


def follow(parent: int) -> None:
    """Tie a worker to its parent: it leaves Ctrl-C to it, and ends with it, even if the parent was killed.

    Args:
        parent: The parent's process id.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
