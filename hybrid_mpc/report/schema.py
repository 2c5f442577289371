"""The schema of ``results.json``; ``docs/results-schema.md`` describes it in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hybrid_mpc.errors import InputError

SCHEMA_VERSION = 4
MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn")
CONTROLLERS = ("prior", "hybrid", "oracle")
OBSERVERS = ("prior_observer", "hybrid_observer")


@dataclass(frozen=True)
class Leaf:
    """A value of the schema.

    Args:
        kind: What it must be, in words.
        fits: Whether a value is of that kind.
        nullable: True if a scenario may have none; then it is null and its reason stands beside it.
    """

    kind: str
    fits: Callable[[Any], bool]
    nullable: bool = True


@dataclass(frozen=True)
class Group:
    """An object of the schema.

    Args:
        keys: Its keys, all of them required.
        nullable: True if a scenario may have none of it.
    """

    keys: Mapping[str, Group | Leaf]
    nullable: bool = True


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _is_named(value: Any) -> bool:
    return _is_text(value) and value.endswith("]") and " [" in value


def _is_interval(value: Any) -> bool:
    keys = {"file", "start_s", "end_s"}
    return (
        isinstance(value, Mapping)
        and set(value) == keys
        and _is_text(value["file"])
        and all(_is_number(value[key]) for key in ("start_s", "end_s"))
        and value["start_s"] <= value["end_s"]
    )


def _is_broken(value: Any) -> bool:
    keys = {"fault", "start_s", "delay_s", "diagnosis"}
    return (
        isinstance(value, Mapping)
        and set(value) == keys
        and _is_text(value["fault"])
        and isinstance(value["diagnosis"], str)
        and _is_number(value["start_s"])
        and (value["delay_s"] is None or (_is_number(value["delay_s"]) and value["delay_s"] >= 0))
    )


def _is_pair(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) == 2 and all(_is_number(v) for v in value)


def _list_of(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list | tuple) and all(fits(v) for v in value)


def _number(*, positive: bool = False) -> Leaf:
    if positive:
        return Leaf("a finite number, zero or above", lambda v: _is_number(v) and v >= 0)
    return Leaf("a finite number", _is_number)


def _fixed(kind: str, fits: Callable[[Any], bool]) -> Leaf:
    return Leaf(kind, fits, nullable=False)


_TEXT = _fixed("a text that is not empty", _is_text)
_SIZE = _number(positive=True)
_COUNT = Leaf("a whole number, zero or above", _is_count)
_SHARE = Leaf("a number between 0 and 1", lambda v: _is_number(v) and 0 <= v <= 1)
_TRUTH = Leaf("true or false", lambda v: isinstance(v, bool))
_INTERVALS = "a list of {file, start_s, end_s} with start_s <= end_s"
_SIZES = Leaf(
    "an object of finite numbers, zero or above, by name with unit",
    lambda v: (
        isinstance(v, Mapping)
        and bool(v)
        and all(_is_named(k) and _is_number(x) and x >= 0 for k, x in v.items())
    ),
)
_PER_MODEL = Group(dict.fromkeys(MODELS, _SIZE))
_SIZES_PER_MODEL = Group(dict.fromkeys(MODELS, _SIZES))

SCHEMA = Group(
    {
        "schema_version": _fixed(
            f"the number {SCHEMA_VERSION}", lambda v: v == SCHEMA_VERSION and _is_count(v)
        ),
        "scenario": _TEXT,
        "seed": _fixed("a whole number, zero or above", _is_count),
        "budget": _TEXT,
        "versions": _fixed(
            "an object of texts by package name",
            lambda v: isinstance(v, Mapping) and all(_is_text(one) for one in v.values()),
        ),
        "data": Group(
            {
                "files": _fixed("a list of file names", _list_of(_is_text)),
                "hash": _TEXT,
                "cuts": _fixed(_INTERVALS, _list_of(_is_interval)),
            },
            nullable=False,
        ),
        "identification": Group(
            {"e_sim_s": _PER_MODEL, "rmse": _SIZES_PER_MODEL, "balance_violation": _SIZES_PER_MODEL}
        ),
        "export": Group({"parity_max_abs_error": _SIZE, "jacobian_max_abs_error": _SIZE}),
        "control": Group(
            {
                **{name: Group({"cost": _number(), "tracking_rmse": _SIZES}) for name in CONTROLLERS},
                "gap_closed": _number(),
            }
        ),
        "estimation": Group(
            {
                name: Group(
                    {
                        **dict.fromkeys(("mean_nis", "nis_low", "nis_high"), _SIZE),
                        "nis_inside": _SHARE,
                        **dict.fromkeys(("ljung_box", "ljung_box_limit"), _SIZE),
                        "samples": _COUNT,
                    }
                )
                for name in OBSERVERS
            }
        ),
        "timing": Group(
            {
                "controller_step_ms": Group(dict.fromkeys(("median", "p95", "p99", "max"), _SIZE)),
                "period_ms": _SIZE,
                "misses": _COUNT,
            }
        ),
        "monitor": Group(
            {
                "threshold": _SIZES,
                "false_alarms_per_hour": _SIZE,
                "alarms": Leaf(_INTERVALS, _list_of(_is_interval)),
            }
        ),
        "guard": Group(
            {
                **dict.fromkeys(
                    ("false_alarms_per_hour", "hours", "force_threshold", "energy_threshold"), _SIZE
                ),
                "data_hash": Leaf("a text that is not empty", _is_text),
                "test_seconds": _SIZE,
                "test_alarms": _COUNT,
                "faults": Leaf("a list of {fault, start_s, delay_s, diagnosis}", _list_of(_is_broken)),
            }
        ),
        "analysis": Group(
            {
                "eigenvalues": Leaf("a list of [real part, imaginary part]", _list_of(_is_pair)),
                "stabilisable": _TRUTH,
                "detectable": _TRUTH,
            }
        ),
    },
    nullable=False,
)


def validate_results(results: Mapping[str, Any]) -> None:
    """Check results against the schema.

    Args:
        results: The content of ``results.json``. Every key of the schema is there. A value that the
            scenario cannot have is None, with the reason beside it: ``"<key>_reason"``, or ``"reason"``
            for the whole object. Further keys lie under ``"details"`` of any object.

    Raises:
        InputError: With the path of the first key that is missing, unknown or of the wrong kind.

    Example:
        >>> validate_results({"schema_version": 4, "seed": 0})
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: results: 'scenario' is missing; it must be a text that is not empty
    """
    _check(results, SCHEMA, "", {})


def _check(value: Any, spec: Group | Leaf, path: str, parent: Mapping[str, Any]) -> None:
    key = path.rpartition(".")[2]
    if value is None and spec.nullable:
        if not (_is_text(parent.get(f"{key}_reason")) or _is_text(parent.get("reason"))):
            raise InputError(
                f"results: {path!r} is null without a reason; put '{key}_reason' or 'reason' beside it"
            )
        return
    if isinstance(spec, Leaf):
        if not spec.fits(value):
            raise InputError(f"results: {path!r} is {_short(value)}; it must be {spec.kind}")
        return
    if not isinstance(value, Mapping):
        raise InputError(f"results: {path or 'all of it'!r} is {_short(value)}; it must be an object")
    prefix = f"{path}." if path else ""
    for name, inner in spec.keys.items():
        if name not in value:
            kind = inner.kind if isinstance(inner, Leaf) else "an object with " + ", ".join(inner.keys)
            raise InputError(f"results: '{prefix}{name}' is missing; it must be {kind}")
        _check(value[name], inner, prefix + name, value)
    for name in value:
        if name not in spec.keys and name not in _beside(spec):
            raise InputError(
                f"results: {prefix + str(name)!r} is no key of the schema; put it under 'details'"
            )


def _beside(group: Group) -> set[str]:
    return {"details", "reason", *(f"{name}_reason" for name in group.keys)}


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
