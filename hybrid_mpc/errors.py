"""Errors for the user: what is wrong, where, what to do, and a code.

A message ends with its code in brackets, ``[HM-DATA-085]``: the room that found the problem and a number. A code stays
with its problem when the words change; a number is used once. ``docs/errors.md`` lists all codes.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
CODE = re.compile(r"\[((?:HM-[A-Z]+|NN)-\d{3})\]")
"""A code in a message; ``NN`` codes belong to ``nn_export``."""


class InputError(ValueError):
    """Bad input of the user: a file, a field, a setting. The command line ends with exit code 2.

    The message names the place (file, row, field), what is wrong, and a remedy.

    Example:
        >>> raise InputError("run.csv: no column 'pos_rad'; it has 'time_s', 'angle'. Rename one.")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: run.csv: no column 'pos_rad'; it has 'time_s', 'angle'. Rename one.
    """

    _problems: tuple[str, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """All problems, one by one."""
        return self._problems or (str(self),)

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of all problems, in the order of the message.

        Example:
            >>> InputError("run.csv: no column 'pos_rad'; it has 'time_s'. Rename one. [HM-DATA-085]").codes
            ('HM-DATA-085',)
        """
        return tuple(CODE.findall("\n".join(self.problems)))


class MissingPackage(InputError, ImportError):
    """A package of an extra is not installed; the message names the extra."""


EXTRAS = {
    **dict.fromkeys(("torch", "optuna"), "train"),
    **dict.fromkeys(("typer", "rich", "filelock"), "cli"),
    **dict.fromkeys(("matplotlib", "PIL", "bokeh", "jinja2", "markupsafe"), "report"),
    **dict.fromkeys(("pandas", "openpyxl", "pyarrow", "h5py"), "tables"),
    **dict.fromkeys(
        ("asammdf", "nptdms", "rosbags", "mcap", "mcap_ros1", "mcap_ros2", "pyulog", "can", "cantools"),
        "loggers",
    ),
    "control": "analysis",
    **dict.fromkeys(("dask", "distributed", "yaml"), "studies"),
    "pysindy": "sindy",
    "mujoco": "mujoco",
}
"""Extra that installs a module."""


@contextmanager
def named_extra(what: str = "") -> Iterator[None]:
    """Context in which the import of a missing package becomes an error that names its extra.

    Also a decorator of functions that import such packages.

    Args:
        what: What needs the package, for the message. Default: "this".

    Raises:
        MissingPackage: If a package of :data:`EXTRAS` is not installed.

    Example:
        >>> with named_extra("a table"):
        ...     raise ModuleNotFoundError("No module named 'pandas'", name="pandas")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.MissingPackage: a table needs pandas, ... pip install 'hybrid-mpc[tables]'
    """
    try:
        yield
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise MissingPackage(
            f"{what or 'this'} needs the package {package}, which is not installed. Install it with: "
            f"pip install 'hybrid-mpc[{EXTRAS[package]}]' [HM-ERRORS-001]"
        ) from missing


def said_by(error: BaseException) -> str:
    """The message of an error; empty if it has none, or a user's own class raises in ``__str__``.

    Example:
        >>> said_by(ValueError(" no level "))
        'no level'
    """
    try:
        return str(error).strip()
    except Exception:  # __str__ of a user's class may raise any exception
        return ""


@contextmanager
def no_exit(what: str = "") -> Iterator[None]:
    """Context in which code that ends Python (``sys.exit``, ``SystemExit``, ``GeneratorExit``, a bare
    ``BaseException``) becomes an error with the code's file and line.

    Otherwise a scenario could end a job silently, with exit code 0. Also a decorator of functions that call user code.

    Args:
        what: What runs, for the message. Default: not named.

    Raises:
        InputError: If the code raises one of these exceptions.

    Example:
        >>> with no_exit("my_machine.py"):
        ...     raise SystemExit(0)
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: my_machine.py: SystemExit(0) ...
    """
    try:
        yield
    except BaseException as stop:
        if not isinstance(stop, SystemExit | GeneratorExit) and type(stop) is not BaseException:
            raise
        # without frames of this module and of Python's start-up, where exit() is defined
        passed = [frame for frame in traceback.extract_tb(stop.__traceback__) if frame.filename != __file__]
        frames = [frame for frame in passed if not frame.filename.startswith("<frozen")]
        place = f"{frames[-1].filename}:{frames[-1].lineno}: " if frames else ""
        of = f"{what}: " if what and not place.startswith(what) else ""
        ending = f"SystemExit({stop.code!r})" if isinstance(stop, SystemExit) else type(stop).__name__
        raise InputError(
            f"{of}{place}{ending} would end Python. Remove sys.exit or exit, or move the script's code "
            'under if __name__ == "__main__": [HM-ERRORS-002]'
        ) from stop


SHOWN = 20
"""Most problems that a message lists; the others are counted."""


def refuse(problems: Sequence[str]) -> None:
    """Raise one error with all problems, each a message of its own; without problems do nothing.

    Raises:
        InputError: If there is a problem.

    Example:
        >>> refuse([])
        >>> refuse(["a.csv: is empty. Record it again.", "b.csv: is empty. Record it again."])
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: 2 problems:
          a.csv: is empty. Record it again.
          b.csv: is empty. Record it again.
    """
    distinct = tuple(dict.fromkeys(problems))
    if not distinct:
        return
    if len(distinct) == 1:
        raise InputError(distinct[0])
    more = [f"and {len(distinct) - SHOWN} more"] if len(distinct) > SHOWN else []
    error = InputError("\n  ".join([f"{len(distinct)} problems:", *distinct[:SHOWN], *more]))
    error._problems = distinct
    raise error


class Collected:
    """Collects problems of several checks: each check is made even if another has failed.

    Example:
        >>> def positive(value: float, name: str) -> float:
        ...     refuse([] if value > 0 else [f"{name}: {value} is not positive"])
        ...     return value
        >>> own = Collected()
        >>> found = own(positive, 1.0, "a"), own(positive, -1.0, "b")
        >>> found
        (1.0, None)
        >>> own.refuse()
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: b: -1.0 is not positive
    """

    def __init__(self) -> None:
        self._problems: list[str] = []

    def __call__(self, check: Callable[P, T], *args: P.args, **options: P.kwargs) -> T | None:
        """The result of a check; None if it raises InputError."""
        try:
            return check(*args, **options)
        except InputError as error:
            self._problems += error.problems
            return None

    def add(self, problem: str) -> None:
        """Add a problem."""
        self._problems.append(problem)

    def refuse(self) -> None:
        """Raise InputError with all problems, if there are any."""
        refuse(self._problems)


class StorageError(InputError):
    """Writing failed: a full disk, a folder in place of a file, no permission.

    The message says what, where and why. The command line adds what is saved, and how to continue.

    Example:
        >>> raise StorageError("cannot write run/a.json: No space left on device")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.StorageError: cannot write run/a.json: No space left on device
    """


class SafeInputError(RuntimeError):
    """A run on a machine has ended, but its actuator did not accept the safe input: the last input may still act.

    Raised from the actuator's first failure, whose context is the error that ended the run.

    Example:
        >>> raise SafeInputError("the safe input could not be handed over: cut the machine's power")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.SafeInputError: the safe input could not be handed over: cut the machine's power
    """
