"""What a run found, as ``results.json`` holds it (docs/results-schema.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.pipeline.guard_report import guard_results
from hybrid_mpc.report.schema import CONTROLLERS, MODELS, OBSERVERS, SCHEMA, SCHEMA_VERSION, validate_results

LOOP_FIGURES = ("cost", "tracking_rmse_rad")
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
    figures: dict[str, Any] = {}
    for key in ("e_sim_s", "rmse_rad", "energy_violation_w"):
        group: dict[str, Any] = {}
        for name in MODELS:
            value = float(scores[name]["best"][key])
            group[name] = value if math.isfinite(value) else None
            if not math.isfinite(value):
                group[f"{name}_reason"] = "a free run diverged"
        figures[key] = group
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
        "hybrid_over_phy": {
            key: _ratio(figures[key]["mopgrnn"], figures[key]["phy"]) for key in ("e_sim_s", "rmse_rad")
        },
    }
    if network := context.settings.network():  # what replaced the budget's
        details["network_settings"] = network
    return {**figures, "details": details}


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
    table = loop_table(control["loops"])
    out: dict[str, Any] = {}
    for name, contender in REPORTED.items():
        rows = [row[contender] for row in table.values() if contender in row]
        if rows:
            out[name] = {
                "cost": float(sum(np.mean(r["cost"]) for r in rows)),
                "tracking_rmse_rad": float(np.sqrt(np.mean([np.mean(np.square(r["rmse"])) for r in rows]))),
            }
        else:
            out[name] = dict.fromkeys(LOOP_FIGURES) | {"reason": "the scenario has no oracle"}
    gaps = {task: gap_closed(row) for task, row in table.items()}
    defined = [gap for gap, _ in gaps.values() if gap is not None]
    out["gap_closed"] = float(np.mean(defined)) if defined else None
    if not defined:
        out["gap_closed_reason"] = "; ".join(dict.fromkeys(why for _, why in gaps.values()))
    tasks = {task: {name: summary(r) for name, r in row.items()} for task, row in table.items()}
    names = dict.fromkeys(r["controller"] for r in control["loops"])
    solved = {
        n: float(np.mean([r["solved"] for r in control["loops"] if r["controller"] == n])) for n in names
    }
    details = {
        "tasks": tasks,
        "gap_closed_by_task": {
            t: {"value": gap, **({"reason": why} if why else {})} for t, (gap, why) in gaps.items()
        },
        "figures": task_figures(control["loops"]),
        "share_of_solved_steps": solved,
        "limits_used": limits_used(control["loops"]),
    }
    return {**out, "details": details}


def limits_used(loops: list[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Largest share of each limit that any loop used, ``[task][controller][limit]``; see ``contest.limits_used``."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for row in loops:
        cell = out.setdefault(row["task"], {}).setdefault(row["controller"], {})
        for key, share in row["limits"].items():
            cell[key] = max(float(share), cell.get(key, 0.0))
    return out


def loop_table(loops: list[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Costs and tracking errors ``table[task][controller]``, one entry a seed."""
    table: dict[str, dict[str, dict[str, list[float]]]] = {}
    for row in loops:
        cell = table.setdefault(row["task"], {}).setdefault(row["controller"], {"cost": [], "rmse": []})
        cell["cost"].append(float(row["cost"]))
        cell["rmse"].append(float(row["tracking_rmse_rad"]))
    return table


def task_figures(loops: list[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float | None]]]:
    """Mean absolute value over the seeds of each task's own figures, ``[task][controller][figure]``."""
    out: dict[str, dict[str, dict[str, float | None]]] = {}
    for row in loops:
        for key in row["figures"]:
            same = [r for r in loops if (r["task"], r["controller"]) == (row["task"], row["controller"])]
            values = [abs(float(r["figures"][key])) for r in same]  # "inf" after a round through JSON
            mean = _finite(float(np.mean(values)))
            out.setdefault(row["task"], {}).setdefault(row["controller"], {})[f"mean_abs_{key}"] = mean
    return out


def summary(cell: Mapping[str, list[float]]) -> dict[str, float | None]:
    """Mean and half width of the 95 % interval over seeds (Student's t; null for one seed)."""
    from scipy.stats import t as student

    cost, n = np.array(cell["cost"]), len(cell["cost"])
    half = float(student.ppf(0.975, n - 1) * cost.std(ddof=1) / np.sqrt(n)) if n > 1 else None
    return {"cost": float(cost.mean()), "cost_ci95": half, "tracking_rmse_rad": float(np.mean(cell["rmse"]))}


def gap_closed(row: Mapping[str, Mapping[str, list[float]]]) -> tuple[float | None, str]:
    """Share of the distance from the better baseline to the measuring oracle that the hybrid covers in a task.

    The baselines are the fitted prior with and without disturbance observer; the hybrid is the one with it. None,
    with a reason, where the distance is below twice its standard error; one seed has no standard error.

    Args:
        row: ``[controller]["cost"]``, one entry a seed.
    """
    if "oracle" not in row:
        return None, "the scenario has no oracle"
    costs = {name: np.array(cell["cost"]) for name, cell in row.items()}
    baseline = min((costs[n] for n in BASELINES if n in costs), key=lambda c: float(c.mean()))
    hybrid, oracle = costs[REPORTED["hybrid"]], costs["oracle"]
    if min(len(baseline), len(oracle)) < 2:
        return None, "one seed has no standard error: more oracle_seeds are needed (budget full)"
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
    arrays, times = context.arrays("control"), {}
    if "step_ms" in arrays:
        return {"hybrid": arrays["step_ms"]}
    for name in ("prior", "hybrid"):
        key_of = REPORTED[name]
        own = [v for key, v in arrays.items() if key.split("/")[1] == key_of and key.endswith("/step_ms")]
        if own:
            times[name] = np.concatenate(own)
    return times


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
            **dict.fromkeys(("threshold_w", "false_alarms_per_hour", "alarms")),
            "reason": monitor["reason"],
            "details": covered,
        }
    clean = monitor["clean"]
    return {
        "threshold_w": monitor["calibration"]["threshold_w"],
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
