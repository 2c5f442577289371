"""What a run found, as ``results.json`` holds it (docs/results-schema.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_mpc.errors import InputError
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import LoopRow, by_task, summaries
from hybrid_mpc.job.stages.compare import kept
from hybrid_mpc.job.stages.export import versions
from hybrid_mpc.records import plain

# The schema of ``results.json``; ``docs/results-schema.md`` describes it in words.

SCHEMA_VERSION = 4
MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn")
REPORTED = {"prior": "prior_observer", "hybrid": "hybrid_observer", "oracle": "oracle"}
"""Controllers behind the three names of the schema: all with the same kind of estimator."""
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
                **{name: Group({"cost": _number(), "tracking_rmse": _SIZES}) for name in REPORTED},
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


LOOP_FIGURES = ("cost", "tracking_rmse")
ENERGY = "energy [W]"
"""Name of the only balance that there is so far, with the unit of its rate."""
BASELINES = ("prior", "prior_observer")


def collect(context: Context) -> dict[str, Any]:
    """Results of all stages in the schema's form; checked before they are returned."""
    data = context.result("data")
    results = {
        "schema_version": SCHEMA_VERSION,
        "scenario": context.scenario.name,
        "seed": context.settings.seed,
        "budget": context.settings.budget,
        "versions": versions(),
        "data": {
            "files": data["files"],
            "hash": data["hash"],
            "cuts": [{"file": c["file"], "start_s": c["from_s"], "end_s": c["to_s"]} for c in data["cuts"]],
            "details": {
                "seconds": data["seconds"],
                "why_cut": [c["why"] for c in data["cuts"]],
                "warnings": data.get("warnings", []),  # older runs have none
            },
        },
        "identification": _identification(context),
        "export": context.result("export"),
        "control": _control(context),
        "estimation": _estimation(context),
        "timing": _timing(context),
        "monitor": _monitor(context),
        "guard": guard_results(context),
        "analysis": _analysis(context),
    }
    validate_results(results)
    return results


def _identification(context: Context) -> dict[str, Any]:
    scores, prior = context.result("evaluation")["scores"], context.result("prior")
    output = context.scenario.prior().outputs[0].label
    own = {
        key: {name: _finite(scores[name]["best"][found]) for name in MODELS}
        for key, found in (
            ("e_sim_s", "e_sim_s"),
            ("rmse", "rmse_rad"),
            ("balance_violation", "energy_violation_w"),
        )
    }
    figures = {
        "e_sim_s": _or_reason(own["e_sim_s"]),
        "rmse": _or_reason(own["rmse"], output),
        "balance_violation": _or_reason(own["balance_violation"], ENERGY),
    }
    details = {
        "prior_parameters": {
            k: prior[k] for k in ("values", "standard_errors", "nominal", "warnings", "stages")
        },
        "scores_of_all_networks": {name: scores[name]["networks"] for name in MODELS},
        "by_file": {
            stem: {m: _finite(context.result("evaluation")["by_file"][m][stem]["rmse_rad"]) for m in MODELS}
            for stem in context.result("evaluation")["by_file"]["phy"]
        },
        "smoother": prior["smoother"],
        "hybrid_over_phy": {key: _ratio(own[key]["mopgrnn"], own[key]["phy"]) for key in ("e_sim_s", "rmse")},
    }
    if network := context.settings.network():  # what replaced the budget's
        details["network_settings"] = network
    return {**figures, "details": details}


def _or_reason(values: Mapping[str, float | None], label: str = "") -> dict[str, Any]:
    """Values by model, under a label where one is given; those that are none with their reason."""
    group: dict[str, Any] = {}
    for name, value in values.items():
        group[name] = {label: value} if label and value is not None else value
        if value is None:
            group[f"{name}_reason"] = "a free run diverged"
    return group


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(float(value)) else None


def _ratio(value: float | None, baseline: float | None) -> float | None:
    return None if value is None or not baseline else value / baseline


def _control(context: Context) -> dict[str, Any]:
    control = context.result("control")
    if "reason" in control:
        groups: dict[str, Any] = {
            name: dict.fromkeys(LOOP_FIGURES) | {"reason": control["reason"]} for name in REPORTED
        }
        return {**groups, "gap_closed": None, "gap_closed_reason": control["reason"]}
    rows = kept(context, "control")
    table, found = by_task(rows), summaries(rows)
    out: dict[str, Any] = {}
    for name, controller in REPORTED.items():
        own = [cells[controller] for cells in found.values() if controller in cells]
        loops = [row for row in rows if row.controller == controller]
        if own:
            costs = [cell.cost.mean for cell in own]
            out[name] = {
                "cost": None if None in costs else float(sum(c for c in costs if c is not None)),
                "tracking_rmse": {
                    signal: _root_mean_square([row.tracking_rmse[signal] for row in loops])
                    for signal in loops[0].tracking_rmse
                },
            }
            if None in costs:
                out[name]["cost_reason"] = "a loop diverged"
        else:
            out[name] = dict.fromkeys(LOOP_FIGURES) | {"reason": "the scenario has no oracle"}
    gaps = {task: gap_closed(cells) for task, cells in table.items()}
    defined = [gap for gap, _ in gaps.values() if gap is not None]
    out["gap_closed"] = float(np.mean(defined)) if defined else None
    if not defined:
        out["gap_closed_reason"] = "; ".join(dict.fromkeys(why for _, why in gaps.values()))
    details = {
        "tasks": plain(found),
        "gap_closed_by_task": {
            t: {"value": gap, **({"reason": why} if why else {})} for t, (gap, why) in gaps.items()
        },
    }
    return {**out, "details": details}


def _root_mean_square(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def gap_closed(cells: Mapping[str, Sequence[LoopRow]]) -> tuple[float | None, str]:
    """Share of the distance from the better baseline to the measuring oracle that the hybrid covers in a task.

    The baselines are the fitted prior with and without disturbance observer; the hybrid is the one with it. None,
    with a reason, where the distance is below twice its standard error; one seed has no standard error.

    Args:
        cells: Loops by controller.
    """
    if "oracle" not in cells:
        return None, "the scenario has no oracle"
    costs = {name: np.array([row.cost for row in rows]) for name, rows in cells.items()}
    baseline = min((costs[n] for n in BASELINES if n in costs), key=lambda c: float(c.mean()))
    hybrid, oracle = costs[REPORTED["hybrid"]], costs["oracle"]
    if min(len(baseline), len(oracle)) < 2:
        return None, "one seed has no standard error: more oracle_seeds are needed (budget full)"
    if not all(np.all(np.isfinite(c)) for c in (baseline, hybrid, oracle)):
        return None, "a loop diverged"
    gap = float(baseline.mean() - oracle.mean())
    error = math.sqrt(sum(float(c.var(ddof=1)) / len(c) for c in (baseline, oracle)))
    if gap <= 2.0 * error:
        return None, f"baseline {baseline.mean():.4g} and oracle {oracle.mean():.4g} do not differ enough"
    return float(baseline.mean() - hybrid.mean()) / gap, ""


def _estimation(context: Context) -> dict[str, Any]:
    found = context.result("estimation")
    if "reason" in found:
        return {**dict.fromkeys(OBSERVERS), "reason": found["reason"]}
    out: dict[str, Any] = {}
    for name in OBSERVERS:
        keys = _keys("estimation", name)
        own = found[name]
        out[name] = dict.fromkeys(keys) | own if "reason" in own else {key: own[key] for key in keys}
    return {**out, "details": {"recordings": found["recordings"]}}


def _keys(*path: str) -> tuple[str, ...]:
    group: Any = SCHEMA
    for key in path:
        group = group.keys[key]
    return tuple(group.keys)


def step_times(context: Context) -> dict[str, Any]:
    """Durations [ms] of whole controller steps by controller."""
    arrays = context.arrays("control")
    if "step_ms" in arrays:
        return {"hybrid": arrays["step_ms"]}
    if "reason" in context.result("control"):
        return {}
    timed = [row for row in kept(context, "control") if "step_ms" in row.arrays]
    own = {
        n: [r.arrays["step_ms"] for r in timed if r.controller == REPORTED[n]] for n in ("prior", "hybrid")
    }
    return {name: np.concatenate(times) for name, times in own.items() if times}


def _timing(context: Context) -> dict[str, Any]:
    period = 1e3 * context.spec.dt
    ms = step_times(context).get("hybrid")
    if ms is None:
        reason = context.result("control")["reason"]
        none = dict.fromkeys(("median", "p95", "p99", "max"))
        return {"controller_step_ms": {**none, "reason": reason}, "period_ms": period, "misses": None,
                "misses_reason": reason}  # fmt: skip
    quantiles = {
        name: float(np.quantile(ms, q)) for name, q in (("median", 0.5), ("p95", 0.95), ("p99", 0.99))
    }
    return {
        "controller_step_ms": {**quantiles, "max": float(ms.max())},
        "period_ms": period,
        "misses": int((ms > period).sum()),
    }


def _monitor(context: Context) -> dict[str, Any]:
    monitor = context.result("monitor")
    # how much of each recording was judged, and how much not; runs of earlier versions did not count it
    covered = {"recordings": monitor["recordings"]} if "recordings" in monitor else {}
    if "reason" in monitor:
        return {
            **dict.fromkeys(("threshold", "false_alarms_per_hour", "alarms")),
            "reason": monitor["reason"],
            "details": covered,
        }
    clean = monitor["clean"]
    return {
        "threshold": {ENERGY: monitor["calibration"]["threshold_w"]},
        "false_alarms_per_hour": clean["alarms"] / (clean["seconds"] / 3600.0),
        "alarms": monitor["alarms"],
        "details": {"calibration": monitor["calibration"], "clean": clean, **covered},
    }


def _analysis(context: Context) -> dict[str, Any]:
    analysis = context.result("analysis")
    if "reason" in analysis:
        none = dict.fromkeys(("eigenvalues", "stabilisable", "detectable"))
        return {**none, "reason": analysis["reason"], "details": {}}
    hybrid = analysis["hybrid"]["rest"]
    return {
        "eigenvalues": hybrid["poles"],
        "stabilisable": hybrid["stabilisable"],
        "detectable": hybrid["detectable"],
        "details": analysis,
    }


LEARNED = ("false_alarms_per_hour", "hours", "force_threshold", "energy_threshold", "data_hash")
"""Fields of the detector that the schema names."""


def guard_results(context: Context) -> dict[str, Any]:
    """The group ``guard`` of results.json."""
    found = context.result("guard")
    if "detector" not in found:
        none = dict.fromkeys((*LEARNED, "test_seconds", "test_alarms", "faults"))
        details = {
            key: found[key] for key in ("source", "plausibility", "plausibility_reason") if key in found
        }
        return {**none, "reason": found["reason"], "details": details}
    detector, test = found["detector"], found["test"]
    out = {key: detector[key] for key in LEARNED}
    out |= {"test_seconds": test["seconds"], "test_alarms": test["alarms"], "faults": None}
    if "faults" in found:
        keys = ("fault", "start_s", "delay_s", "diagnosis")
        out["faults"] = [{key: row[key] for key in keys} for row in found["faults"]]
    else:
        lacks = (
            "plant that could break" if context.scenario.plant is None else "task in which nothing goes wrong"
        )
        out["faults_reason"] = f"scenario {context.scenario.name} has no {lacks}"
    kept = ("source", "loops", "detector", "plausibility", "plausibility_reason", "test", "faults")
    return {**out, "details": {key: found[key] for key in kept if key in found}}
