"""Dataclasses to plain data and back: every field of JSON, YAML and checkpoints is checked when it is read.

CasADi functions are written as programs of ``nn_export`` (operators and numbers): the data cannot execute anything.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.rules import printable

T = TypeVar("T")
NUMBERS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
"""Spelling of numbers that JSON does not have."""
LARGEST = 2**63
"""Integers of this size or more are refused: no array, seed or count can hold them."""
LONGEST = 40
"""Most characters of a text in a message."""
MOST_NAMED = 20
"""Most problems of one file that are listed; a damaged file may have thousands."""
BESIDE = {"beside": True}
"""Metadata of a dataclass field that :func:`plain` leaves out: its arrays lie in a file beside the JSON."""


def beside() -> Any:
    """A dataclass field for arrays by name, which :func:`plain` leaves out; they lie in a file beside the JSON.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Row:
        ...     cost: float
        ...     arrays: Mapping[str, Any] = beside()
        >>> plain(Row(1.5, {"x": np.zeros(3)})), record(Row, {"cost": 1.5}, "a row").arrays
        ({'cost': 1.5}, {})
    """
    return dataclasses.field(default_factory=dict, compare=False, metadata=BESIDE)


def plain(value: Any) -> Any:
    """``value`` in JSON's own types.

    Dataclasses (without the fields marked :data:`BESIDE`) and mappings become objects, sequences and arrays lists,
    complex numbers lists of two, paths texts, non-finite numbers ``"inf"``, ``"-inf"`` and ``"nan"``, and a CasADi
    function its program (InputError if it has no program).

    Example:
        >>> plain({"x": np.array([1.0, np.inf]), "where": Path("a")})
        {'x': [1.0, 'inf'], 'where': 'a'}
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kept = [f.name for f in dataclasses.fields(value) if f.metadata != BESIDE]
        return {name: plain(getattr(value, name)) for name in kept}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if type(value) is _function():
        return _program(value)
    return value


def _function() -> Any:
    """The type of CasADi functions; None if casadi is not loaded."""
    casadi = sys.modules.get("casadi")
    return None if casadi is None else casadi.Function


def _program(function: Any) -> Any:
    from nn_export import ExportError, program_of
    from nn_export.program import to_json

    try:
        data = to_json(program_of(function))
    except ExportError as error:
        raise InputError(f"an expression cannot be written: {error} [HM-RECORDS-001]") from error
    data["metadata"] |= {"name": function.name()}
    return data


def record(kind: type[T], data: object, where: str) -> T:
    """The dataclass ``kind`` from plain data, as written by :func:`plain` or by a user.

    Every field is checked against its annotation: numbers, texts, flags, None, ``Literal``, tuples, sequences, arrays,
    mappings with text keys, CasADi functions, unions and dataclasses of these, callables, ``Any``, and the rules of
    ``Annotated`` (:mod:`hybrid_mpc.rules`). An integer fits a float, a flag fits no number. Fields with a default may
    be missing; ``where`` begins the messages.

    Raises:
        InputError: With all fields that are missing, unknown (with the nearest known name) or do not fit.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> record(Signal, {"name": "q", "unit": "m", "upper": "inf"}, "model.json").label
        'q [m]'
        >>> record(Signal, {"nam": "q", "unit": 3}, "model.json")
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: model.json: no field 'nam'; did you mean 'name'? Known names: name, unit, lower, \
upper, periodic, saturation; name is missing; unit: a text is needed, got 3
    """
    problems: list[str] = []
    found = _dataclass(kind, data, "", problems)
    if problems:
        more = len(problems) - MOST_NAMED
        raise InputError(
            f"{where}: " + "; ".join(problems[:MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")
        )
    return found


def known(word: object, names: Iterable[str], what: str) -> str:
    """Return ``word`` if it is one of ``names``, else raise InputError with the nearest one; ``what`` is their kind."""
    names = list(names)
    if isinstance(word, str) and word in names:
        return word
    raise InputError(_unknown(word, names, what))


def _unknown(word: object, names: Sequence[str], what: str) -> str:
    near = difflib.get_close_matches(_short(word).strip("'"), names, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? Known names" if near else "known names"
    return f"no {what} {_short(word)}; {hint}: {', '.join(names) or 'none'} [HM-RECORDS-011]"


def _short(value: object) -> str:
    """A short text for a value in a message."""
    if isinstance(value, Mapping):
        return f"an object of {len(value)} fields"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= LARGEST:
        return "an integer beyond 64 bits"
    if isinstance(value, str):
        return shown(value)
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:50]}... ({len(text)} characters)"


def shown(text: str) -> str:
    """A text in quotes for a message, shortened if it is long."""
    return repr(text) if len(text) <= LONGEST else f"{text[:LONGEST]!r} ({len(text)} characters)"


def _dataclass(kind: type[Any], data: object, where: str, problems: list[str]) -> Any:
    if isinstance(data, kind):
        return data
    head = f"{where}: " if where else ""
    if not isinstance(data, Mapping):
        problems.append(f"{head}an object (fields and values) is needed, got {_short(data)} [HM-RECORDS-002]")
        return None
    taken = {f.name: f for f in dataclasses.fields(kind) if f.init}
    hints = _hints(kind)  # type: ignore[arg-type]
    before = len(problems)
    problems += [head + _unknown(key, list(taken), "field") for key in data if key not in taken]
    problems += [
        f"{head}{name} is missing [HM-RECORDS-003]"
        for name, f in taken.items()
        if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING and name not in data
    ]
    values = {
        name: _value(hints[name], data[name], f"{where}.{name}" if where else name, problems)
        for name in taken
        if name in data
    }
    if len(problems) > before:
        return None
    try:
        return kind(**values)
    except InputError as error:  # checks of the dataclass itself
        problems += [f"{head}{problem}" for problem in error.problems]
    except OverflowError as error:
        problems.append(f"{head}{error}")
    return None


class Fields:
    """The fields of a new dataclass, checked against their annotations and further conditions of the class.

    For ``__post_init__``: every field takes the form of its annotation (a list becomes a tuple, an integer a float),
    and all problems of the record are reported together.

    Args:
        made: The record.
        what: Its description for messages, e.g. ``"signal 'phi'"``.

    Example: of a class with ``start: Bound`` and ``end: Bound``::

        def __post_init__(self):
            own = Fields(self, "window")
            own.need("start end", lambda: self.start < self.end, "its end must come after its start")
            own.refuse()
    """

    def __init__(self, made: Any, what: str) -> None:
        # most characters of a record's description in a message
        self._what = printable(what).replace("\n", " ")[:100]
        self._problems, self._wrong = list[str](), set[str]()
        hints = _hints(type(made))  # type: ignore[arg-type]
        for name in (f.name for f in dataclasses.fields(made)):
            own: list[str] = []
            value = _value(hints[name], getattr(made, name), name, own)
            if own:
                self._wrong.add(name)
                self._problems += own
            else:
                object.__setattr__(made, name, value)

    def need(self, names: str, holds: Callable[[], object], otherwise: str) -> None:
        """Check a further condition on some fields, if each of them fits by itself."""
        if self._wrong.isdisjoint(names.split()) and not holds():
            self._problems.append(otherwise)

    def distinct(self, names: str, values: Callable[[], Iterable[object]], what: str) -> None:
        """Check that values differ."""
        given = list(values()) if self._wrong.isdisjoint(names.split()) else []
        if twice := [value for i, value in enumerate(given) if value in given[:i]]:
            self._problems.append(
                f"{what} {_short(twice[0])} appears twice. Keep one of them. [HM-RECORDS-004]"
            )

    def add(self, problems: Iterable[str]) -> None:
        """Add problems found elsewhere."""
        self._problems += problems

    def refuse(self) -> None:
        """Raise InputError with all problems, if any."""
        refuse([f"{self._what}: {problem}" for problem in self._problems])


@cache
def _hints(kind: Any) -> dict[str, Any]:
    """Annotations of a dataclass. Names imported only for type checkers count as ``Any``."""
    unknown: dict[str, Any] = {}
    while True:
        try:
            return get_type_hints(kind, localns=unknown or None, include_extras=True)
        except NameError as error:
            if error.name is None or error.name in unknown:
                raise
            unknown[error.name] = Any


def _value(kind: Any, value: object, where: str, problems: list[str]) -> Any:
    """``value`` as ``kind``; problems are appended to ``problems``."""
    origin, arms = get_origin(kind), get_args(kind)
    if kind is Any or kind is object:
        return value
    if origin is Annotated:
        return _ruled(arms[0], arms[1:], value, where, problems)
    if origin in (Union, types.UnionType):
        return _union(arms, value, where, problems)
    if origin is Literal:
        if any(type(value) is type(arm) and value == arm for arm in arms):
            return value
        needed = f"one of {', '.join(repr(arm) for arm in arms)}"
    elif kind in _SIMPLE:
        fits, needed = _SIMPLE[kind]
        if (found := fits(value)) is not None:
            return found[0]
    elif origin is np.ndarray:
        if (array := _array(value)) is not None:
            return array
        needed = "numbers in a list, or in lists of the same length,"
    elif kind is _function():
        return _built(value, where, problems)
    elif dataclasses.is_dataclass(kind):
        return _dataclass(kind, value, where, problems)  # type: ignore[arg-type]
    elif origin is Callable:
        if callable(value):
            return value
        needed = "a callable"
    elif origin in (tuple, list, Sequence) or kind in (tuple, list, Sequence):
        return _sequence(kind, value, where, problems)
    elif origin in (dict, Mapping) or kind in (dict, Mapping):
        if isinstance(value, Mapping):
            key, inner = arms or (str, Any)
            return {
                _key(key, k, where, problems): _value(inner, v, f"{where}.{k}"[:200], problems)
                for k, v in value.items()
            }
        needed = "an object (names and values) is"
    else:
        raise TypeError(f"{where}: records know no {kind} [HM-RECORDS-005]")
    problems.append(
        f"{where}: {needed if needed.endswith('is') else needed + ' is'} needed, got {_short(value)} [HM-RECORDS-006]"
    )
    return None


def _ruled(kind: Any, rules: Sequence[Any], value: object, where: str, problems: list[str]) -> Any:
    """``value`` as ``kind`` that also satisfies ``rules``; each rule returns a problem or an empty text."""
    before = len(problems)
    found = _value(kind, value, where, problems)
    if len(problems) == before:
        problems += [f"{where}: {wrong} [HM-RECORDS-007]" for rule in rules if (wrong := rule(found))]
    return found


def _key(kind: Any, key: object, where: str, problems: list[str]) -> Any:
    """A key of a mapping; a number, as YAML may read it, becomes text."""
    text = str(key) if isinstance(key, int | float) and not isinstance(key, bool) else key
    return _value(kind, text, f"{where}: a name in it", problems)


def _union(arms: tuple[Any, ...], value: object, where: str, problems: list[str]) -> Any:
    tried: list[list[str]] = []
    # an integer stays an integer if int and float both fit
    for arm in sorted(arms, key=lambda arm: arm is float or get_args(arm)[:1] == (float,)):
        own: list[str] = []
        found = _value(arm, value, where, own)
        if not own:
            return found
        tried.append(own)

    deeper = [own for own in tried if not own[0].startswith(f"{where}: ") or " is missing" in own[0]]
    problems += sorted(deeper, key=_depth)[-1] if deeper else [_either(tried, where, value)]
    return None


def _depth(own: Sequence[str]) -> int:
    """Nesting depth of a value's first problem: the member of a union with the deepest problem explains most."""
    return len(re.findall(r"[.\[]", own[0].split(": ")[0]))


def _either(tried: Sequence[Sequence[str]], where: str, value: object) -> str:
    wanted = [own[0].removeprefix(f"{where}: ").split(" is needed")[0] for own in tried]
    return f"{where}: {' or '.join(dict.fromkeys(wanted))} is needed, got {_short(value)} [HM-RECORDS-012]"


def _sequence(kind: Any, value: object, where: str, problems: list[str]) -> Any:
    arms, make = get_args(kind), tuple if (get_origin(kind) or kind) is not list else list
    if isinstance(value, np.ndarray) and value.ndim:
        value = value.tolist()
    if not isinstance(value, list | tuple):
        problems.append(f"{where}: a list is needed, got {_short(value)} [HM-RECORDS-008]")
        return None
    fixed = make is tuple and (get_origin(kind) or kind) is tuple and arms and arms[-1] is not Ellipsis
    if fixed and len(value) != len(arms):
        problems.append(f"{where}: a list of {len(arms)} is needed, got {_short(value)} [HM-RECORDS-009]")
        return None
    kinds = arms if fixed else [arms[0] if arms else Any] * len(value)
    return make(
        _value(k, v, f"{where}[{i}]", problems) for i, (k, v) in enumerate(zip(kinds, value, strict=True))
    )


def _array(value: object) -> Any:
    """Lists of numbers as an array; None if they hold other values, or differ in length."""
    if isinstance(value, np.ndarray):
        return value.astype(np.float64) if value.dtype.kind in "iuf" else None
    if not isinstance(value, list | tuple) or not value:
        return np.zeros(0) if isinstance(value, list | tuple) else None
    if not isinstance(value[0], list | tuple):
        numbers = [_float(v) for v in value]
        return None if None in numbers else np.array([found[0] for found in numbers if found is not None])
    parts = [_array(v) for v in value if isinstance(v, list | tuple)]
    fit = [part for part in parts if part is not None and part.shape == getattr(parts[0], "shape", None)]
    return np.stack(fit) if len(fit) == len(value) else None


def _built(value: object, where: str, problems: list[str]) -> Any:
    """A CasADi function from its program, in scalar operations."""
    import casadi

    from nn_export import ExportError, build
    from nn_export.program import from_json

    if type(value) is _function():
        return value
    try:
        program = from_json(value, {}, "program")
        name = program.metadata.get("name", "")
        return build(program, name if casadi.Function.check_name(name) else None).expand()
    except ExportError as error:
        problems.append(f"{where}: {error}")
    except RuntimeError as error:  # an operator that CasADi only has for matrices
        problems.append(
            f"{where}: must be a program of scalar operators: {str(error).strip().splitlines()[-1]} [HM-RECORDS-010]"
        )
    return None


def _float(value: object) -> tuple[float] | None:
    if isinstance(value, str) and value in NUMBERS:
        return (NUMBERS[value],)
    if isinstance(value, float | np.floating):
        return (float(value),)
    whole = _int(value)
    return None if whole is None else (float(whole[0]),)


def _complex(value: object) -> tuple[complex] | None:
    parts = value if isinstance(value, list | tuple) and len(value) == 2 else ()
    numbers = [found[0] for part in parts if (found := _float(part)) is not None]
    return (complex(*numbers),) if len(numbers) == 2 else (value,) if isinstance(value, complex) else None


def _int(value: object) -> tuple[int] | None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        return None
    number = int(value)
    return (number,) if abs(number) < LARGEST else None


_SIMPLE: Mapping[Any, tuple[Any, str]] = {
    float: (_float, "a number"),
    int: (_int, "a whole number"),
    str: (lambda v: (v,) if isinstance(v, str) else None, "a text"),
    bool: (lambda v: (v,) if isinstance(v, bool) else None, "true or false"),
    type(None): (lambda v: (None,) if v is None else None, "null"),
    complex: (_complex, "a real and an imaginary part in a list"),
    Path: (lambda v: (Path(v),) if isinstance(v, str | Path) else None, "a path"),
}
