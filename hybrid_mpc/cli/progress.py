"""Progress on the terminal: rich bars; plain lines if the output is not a terminal."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Self

from rich import progress as rich_progress
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hybrid_mpc.engine import Progress
from hybrid_mpc.rules import printable

LINE_EVERY_S = 5.0
"""Least time between two plain lines of one stage."""


class Bars(Progress):
    """Rich progress bars, one per part of the stage."""

    def __init__(self, console: Console) -> None:
        self._bars = rich_progress.Progress(
            TextColumn("{task.description:28}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}"),
            console=console,
        )
        self._parts: dict[str, TaskID] = {}
        self._stage: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def start(self, title: str) -> None:
        """Add a bar for the stage; bars of its parts follow below."""
        self._stage = self._bars.add_task(title, total=1, text="")

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Move the bar of one part."""
        if key not in self._parts:
            self._parts[key] = self._bars.add_task(f"  {key}", total=total, text="")
        self._bars.update(self._parts[key], completed=done, total=total, text=text)

    def warn(self, text: str) -> None:
        """Print a line above the bars."""
        self._bars.console.print(
            printable(f"warning: {text}"), style="yellow", markup=False, highlight=False, soft_wrap=True
        )

    def note(self, text: str) -> None:
        """Print a line above the bars."""
        self._bars.console.print(printable(f"note: {text}"), markup=False, highlight=False, soft_wrap=True)

    def finish(self, text: str) -> None:
        """Complete the stage and its parts."""
        for task in self._parts.values():
            self._bars.remove_task(task)
        self._parts.clear()
        if self._stage is not None:
            self._bars.update(self._stage, completed=1, text=text)


class Lines(Progress):
    """Plain lines for logs and pipes."""

    def __init__(self) -> None:
        self._stage = self._last = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        return None

    def start(self, title: str) -> None:
        """Print the stage."""
        self._stage = time.monotonic()
        say(f"{title} ...")

    def update(self, key: str, done: int, total: int, text: str) -> None:
        """Print a line from time to time."""
        now = time.monotonic()
        if now - self._last >= LINE_EVERY_S:
            self._last = now
            say(f"  {key}: {done}/{total} {text}")

    def warn(self, text: str) -> None:
        """Print a line."""
        say(f"  warning: {text}")

    def note(self, text: str) -> None:
        """Print a line."""
        say(f"  note: {text}")

    def finish(self, text: str) -> None:
        """Print the result and the duration of the stage."""
        say(f"  {text or 'done'} after {time.monotonic() - self._stage:.1f} s")


class Unwarned(Progress):
    """Passes progress on and drops warnings and notes, which the command prints after its results."""

    def __init__(self, progress: Progress) -> None:
        self.start, self.update, self.finish = progress.start, progress.update, progress.finish  # type: ignore[method-assign]


def say(text: str) -> None:
    """Print any text, e.g. a finding or the name of a file, without control characters for the terminal."""
    print(printable(text), flush=True)


def make_progress() -> Bars | Lines:
    """Bars on a terminal, lines otherwise."""
    console = Console()
    return Bars(console) if console.is_terminal else Lines()


def print_summary(lines: Iterable[str], result: Path, name: str = "results") -> None:
    """Print a command's results and where they are written."""
    for line in lines:
        say(line)
    say(f"{name}: {result.resolve()}")
