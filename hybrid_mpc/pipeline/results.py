"""What a run found, as ``results.json`` holds it (docs/results-schema.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hybrid_mpc.job.loops import LoopRow
from hybrid_mpc.job.table import by_task, summaries
from hybrid_mpc.pipeline.contest import kept
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.pipeline.guard_report import guard_results
from hybrid_mpc.records import plain
from hybrid_mpc.report.schema import CONTROLLERS, MODELS, OBSERVERS, SCHEMA, SCHEMA_VERSION, validate_results

LOOP_FIGURES = ("cost", "tracking_rmse")
ENERGY = "energy [W]"
"""Name of the only balance that there is so far, with the unit of its rate."""
BASELINES = ("prior", "prior_observer")
REPORTED = {"prior": "prior_observer", "hybrid": "hybrid_observer", "oracle": "oracle"}
"""Contenders behind the three names of the schema: all with the same kind of estimator."""


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
            name: dict.fromkeys(LOOP_FIGURES) | {"reason": control["reason"]} for name in CONTROLLERS
        }
        return {**groups, "gap_closed": None, "gap_closed_reason": control["reason"]}
    rows = kept(context, "control")
    table, found = by_task(rows), summaries(rows)
    out: dict[str, Any] = {}
    for name, contender in REPORTED.items():
        own = [cells[contender] for cells in found.values() if contender in cells]
        loops = [row for row in rows if row.controller == contender]
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
        cells: Loops by contender.
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
