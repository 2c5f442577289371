"""Names that a user writes: the nearest valid one for those that do not exist, and dataclasses from mappings."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from typing import TypeVar

from hybrid_mpc.errors import InputError

T = TypeVar("T")


def known(word: object, names: Iterable[str], what: str) -> str:
    """``word`` if it is one of ``names``.

    Args:
        word: What was given.
        names: What there is.
        what: Says what kind of name it is, for the message.

    Raises:
        InputError: If it is none of them; with the nearest one, and all.

    Example:
        >>> known("sqq", ("rti", "sqp"), "solver")
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: no solver 'sqq'; did you mean 'sqp'? There are: rti, sqp
    """
    names = list(names)
    if isinstance(word, str) and word in names:
        return word
    near = difflib.get_close_matches(str(word), names, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? There are" if near else "there are"
    raise InputError(f"no {what} {word!r}; {hint}: {', '.join(names) or 'none'}")


def built(kind: type[T], mapping: object, where: str) -> T:
    """A dataclass from a mapping of its fields, as YAML gives it.

    Args:
        kind: The dataclass.
        mapping: Values by field; only fields without default are needed.
        where: Says what it is, for the message.

    Raises:
        InputError: If it is no mapping, a key is unknown (with the nearest valid one) or missing, or a value does not
            fit.

    Example:
        >>> from hybrid_mpc.closed_loop import Fault
        >>> built(Fault, {"start": 0.0, "end": 1.0, "target": "input_gain", "value": 0.8}, "fault").value
        0.8
    """
    if not isinstance(mapping, Mapping):
        raise InputError(f"{where}: a mapping of keys to values is needed, got {mapping!r}")
    taken = {f.name: f for f in fields(kind) if f.init}  # type: ignore[arg-type]
    for key in mapping:
        known(key, taken, f"key in {where}")
    missing = [
        name
        for name, f in taken.items()
        if f.default is MISSING and f.default_factory is MISSING and name not in mapping
    ]
    if missing:
        raise InputError(f"{where}: {', '.join(missing)} is missing")
    try:
        return kind(**mapping)
    except (TypeError, AttributeError) as error:
        raise InputError(f"{where}: {error}") from error
