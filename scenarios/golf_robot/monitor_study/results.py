"""What the study ``monitor`` found, with intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.watch.lengths import BLOCK_S
from scenarios.golf_robot.monitor_study.detection import METHODS, Detectors
from scenarios.golf_robot.monitor_study.plan import ARMS, CASES, FAULT, GUARD, NOMINAL

Array = NDArray[np.float64]
Rows = Sequence[Mapping[str, Any]]
RESAMPLES = 2000
ROC_POINTS = 60
TOLERANCE = 1e-6
"""Excess over a limit that is rounding."""


def monitor_results(study: Mapping[str, Any], detectors: Detectors, rows: Rows) -> dict[str, Any]:
    """Everything that report and table show."""
    done = [row for row in rows if row["status"] == "done"]
    of = {kind: [row for row in done if row["kind"] == kind] for kind in (NOMINAL, FAULT, GUARD)}
    loops = [loop for row in of[NOMINAL] for loop in row["loops"]]
    rates = [f"{rate:g}" for rate in study["rates"]]
    return {
        "study": dict(study),
        "jobs": {"done": len(done), "failed": len(rows) - len(done)},
        "learned": {"hours": detectors.hours, "blocks": detectors.blocks, "tails": dict(detectors.tails)},
        "nominal_hours": sum(loop["seconds"] for loop in loops) / 3600,
        "false_alarms": {rate: {m: false_alarms(loops, rate, m) for m in METHODS} for rate in rates},
        "delays": {rate: {c.name: _delays(of[FAULT], rate, c.name) for c in CASES} for rate in rates},
        "roc": {
            c.name: {m: roc(loops, _case(of[FAULT], c.name), m, detectors.block_s) for m in METHODS}
            for c in CASES
        },
        "guard": {c.name: _guard(_case(of[FAULT], c.name), _case(of[GUARD], c.name)) for c in CASES},
    }


def _case(rows: Rows, case: str) -> list[Mapping[str, Any]]:
    return sorted((row for row in rows if row["case"] == case), key=lambda row: row["seed"])


def false_alarms(loops: Rows, rate: str, method: str) -> dict[str, Any]:
    """False alarms of a method: number, rate [1/h] and its upper 95 % Poisson bound; also where friction drifts.

    Example:
        >>> loops = [{"case": "none", "seconds": 3600.0, "alarms": {"1": {"guard": 1}}}]
        >>> round(false_alarms(loops, "1", "guard")["upper_95"], 2)
        4.74
    """
    drifting = [loop for loop in loops if loop["case"] != "none"]
    count, hours = (
        sum(loop["alarms"][rate][method] for loop in loops),
        sum(v["seconds"] for v in loops) / 3600,
    )
    return {
        "count": count, "hours": hours, "per_hour": count / hours if hours else math.nan,
        "upper_95": poisson_upper(count, hours),
        "drifting": {
            "count": sum(loop["alarms"][rate][method] for loop in drifting),
            "hours": sum(loop["seconds"] for loop in drifting) / 3600,
        },
    }  # fmt: skip


def poisson_upper(count: int, hours: float) -> float:
    """Upper 95 % bound of a Poisson rate [1/h].

    Example:
        >>> round(poisson_upper(0, 10.0), 3), round(poisson_upper(4, 10.0), 3)
        (0.3, 0.915)
    """
    from scipy.stats import chi2

    return float(chi2.ppf(0.95, 2 * count + 2) / 2 / hours) if hours else math.inf


def _delays(rows: Rows, rate: str, case: str) -> dict[str, Any]:
    loops, found = _case(rows, case), {}
    for method in METHODS:
        delays = sorted(float(row["delays"][rate][method]) for row in loops)
        early = sum(bool(row["early"][rate][method]) for row in loops)
        found[method] = {**delay_figures(delays), "early": early, "delays": delays}
    return found


def delay_figures(delays: Sequence[float]) -> dict[str, float]:
    """Median of delays [s], infinite for a miss, with its 95 % interval, and the share of misses with its own.

    Order statistics for the median (exact, whatever the distribution), Wilson's interval for the share.

    Source: Wilson, *Probable inference, the law of succession, and statistical inference*, JASA 22 (1927).

    Example:
        >>> found = delay_figures([0.1, 0.2, 0.2, 0.3, 0.3, 0.3, 0.4, 0.4, 0.5, float("inf")])
        >>> found["median"], found["low"], found["high"], found["misses"]
        (0.3, 0.2, 0.5, 1)
    """
    from scipy.stats import binom

    n = len(delays)
    misses = sum(math.isinf(d) for d in delays)
    if not n:
        return {
            "n": 0,
            "median": math.nan,
            "low": math.nan,
            "high": math.nan,
            "largest": math.nan,
            "misses": 0,
        }
    first = max(int(binom.ppf(0.025, n, 0.5)) - 1, 0)
    low, high = wilson(misses, n)
    lower, upper = delays[(n - 1) // 2], delays[n // 2]  # infinity less infinity is no number
    return {
        "n": n, "median": upper if lower == upper else 0.5 * (lower + upper),
        "low": delays[first], "high": delays[n - 1 - first], "largest": delays[-1], "misses": misses,
        "miss_rate": misses / n, "miss_low": low, "miss_high": high,
    }  # fmt: skip


def wilson(count: int, n: int) -> tuple[float, float]:
    """95 % interval of a share.

    Example:
        >>> [round(v, 3) for v in wilson(0, 40)]
        [0.0, 0.088]
    """
    z, p = 1.959963984540054, count / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def roc(loops: Rows, faulted: Rows, method: str, block_s: float = BLOCK_S) -> dict[str, list[float]]:
    """Share of faults found within a second against false alarms an hour, as all thresholds grow together.

    A false alarm is a block whose largest score passes.
    """
    blocks = np.array([b for loop in loops for b in loop["blocks"][method]])
    scores = np.array([row["scores"][method] for row in faulted])
    if not (blocks.size and scores.size):
        return {"factor": [], "per_hour": [], "found": []}
    ranks = np.unique(np.geomspace(1, blocks.size, ROC_POINTS).round().astype(int))[::-1]
    passed = np.sort(blocks)[blocks.size - ranks]  # so many blocks pass just below these
    top = max(blocks.max(), scores.max())
    factors = np.array([*(passed * (1 - 1e-9)), blocks.max(), top])
    hours = blocks.size * block_s / 3600
    return {
        "factor": factors.tolist(),
        "per_hour": [float((blocks > f).sum() / hours) for f in factors],
        "found": [float((scores > f).mean()) for f in factors],
    }


def _guard(off: Rows, guarded: Rows) -> dict[str, Any]:
    """A guard's reactions against none, on common seeds."""
    found: dict[str, Any] = {}
    for arm in ARMS:
        by_seed = {row["seed"]: row for row in guarded if row["arm"] == arm}
        pairs = [(row, by_seed[row["seed"]]) for row in off if row["seed"] in by_seed]
        if pairs:
            costs = np.array([[a["cost"], b["cost"]] for a, b in pairs], dtype=float)
            found[arm] = {
                **cost_ratio(costs), "violations_off": _violations([a for a, _ in pairs]),
                "violations_on": _violations([b for _, b in pairs]),
                "switches": sum(b["switches"] for _, b in pairs),
                "early_switches": sum(b["early_switches"] for _, b in pairs),
            }  # fmt: skip
    return found


def cost_ratio(costs: Array) -> dict[str, float]:
    """Ratio of mean costs of pairs ``(n, 2)``, second over first, with a 95 % bootstrap interval over pairs.

    Example:
        >>> found = cost_ratio(np.array([[1.0, 0.5], [2.0, 1.0], [3.0, 1.5]]))
        >>> found["ratio"], found["low"], found["high"]
        (0.5, 0.5, 0.5)
    """
    n = len(costs)
    drawn = np.random.default_rng(0).integers(0, n, size=(RESAMPLES, n))
    means = costs[drawn].mean(axis=1)
    low, high = np.quantile(means[:, 1] / means[:, 0], [0.025, 0.975])
    off, on = costs.mean(axis=0)
    return {
        "n": n, "off": float(off), "on": float(on), "ratio": float(on / off), "low": float(low), "high": float(high),
    }  # fmt: skip


def _violations(rows: Rows) -> dict[str, Any]:
    """By limit: loops that left it, and by how much at most."""
    names = dict.fromkeys(name for row in rows for name in row["excess"])
    values = {name: [float(row["excess"][name]) for row in rows] for name in names}
    return {
        name: {"loops": sum(v > TOLERANCE for v in found), "largest": max(found)}
        for name, found in values.items()
    }
