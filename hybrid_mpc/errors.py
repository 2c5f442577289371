"""Errors that speak to the user: what was given, what is needed, how to fix it."""

from __future__ import annotations

from collections.abc import Sequence


class InputError(ValueError):
    """Bad input of the user: a file, a field, a setting. The command line answers it with exit code 2.

    Its message names what was given (file, row, field), what is needed, and a remedy.

    Example:
        >>> raise InputError("run.csv: no column 'pos_rad'; it has 'time_s', 'angle'. Rename one.")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: run.csv: no column 'pos_rad'; it has 'time_s', 'angle'. Rename one.
    """

    _problems: tuple[str, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """What is wrong, one by one."""
        return self._problems or (str(self),)


SHOWN = 20
"""Most problems that one message lists; the others are counted."""


def refuse(problems: Sequence[str]) -> None:
    """Raise one error that names all problems, each a message of its own; no problem is no error.

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


class StorageError(InputError):
    """The file system refused to write: a full disk, a folder in place of a file, no permission.

    Its message says what, where and why. The command line adds what is kept, and how to go on.

    Example:
        >>> raise StorageError("cannot write run/a.json: No space left on device")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.StorageError: cannot write run/a.json: No space left on device
    """


class SafeInputError(RuntimeError):
    """A run on a machine has ended and its actuator did not take the safe input: the last input may still act.

    Raised from the actuator's first failure, behind which stands what had ended the run.

    Example:
        >>> raise SafeInputError("the safe input could not be handed over: cut the machine's power")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.SafeInputError: the safe input could not be handed over: cut the machine's power
    """
