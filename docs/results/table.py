"""Print the tables of docs/results/README.md from the results beside this file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn")
KEYS = ("e_sim_s", "rmse_rad", "energy_violation_w")


def identification(results: dict[str, Any]) -> list[str]:
    """Errors of free runs on unseen data, the deployed network of each kind, and its share of ``phy``."""
    found = results["identification"]
    lines = [
        "| model | E_sim [s] | RMSE [rad] | violation [W] | E_sim / phy | RMSE / phy |",
        "|" + " --- |" * 6,
    ]
    for model in MODELS:
        values = [found[key][model] for key in KEYS]
        shares = [found[key][model] / found[key]["phy"] for key in KEYS[:2]]
        lines.append(f"| {model} | " + " | ".join(f"{v:.4g}" for v in values + shares) + " |")
    return lines


def control(results: dict[str, Any]) -> list[str]:
    """Closed-loop costs by task, with 95 % intervals over the seeds."""
    tasks = results["control"].get("details", {}).get("tasks", {})
    lines = ["| task | prior | hybrid | oracle |", "|" + " --- |" * 4] if tasks else []
    for task, cells in tasks.items():
        row = [f"{cells[n]['cost']:.4g} ± {cells[n]['cost_ci95']:.2g}" for n in ("prior", "hybrid", "oracle")]
        lines.append(f"| {task} | " + " | ".join(row) + " |")
    return lines


def rest(results: dict[str, Any]) -> list[str]:
    """Export, timing and monitor in a line each."""
    export, timing, monitor = results["export"], results["timing"], results["monitor"]
    gap = results["control"]["gap_closed"]
    ms, clean = timing["controller_step_ms"], monitor["details"]["clean"]
    return [
        f"Export parity {export['parity_max_abs_error']:.1e}, Jacobians {export['jacobian_max_abs_error']:.1e}. "
        f"Controller step: median {ms['median']:.2f} ms, p99 {ms['p99']:.2f} ms of {timing['period_ms']:g} ms, "
        f"{timing['misses']} misses. Monitor: {len(monitor['alarms'])} alarms in all, {clean['alarms']} in "
        f"{clean['seconds']:.0f} s of clean data. Gap closed: {'undefined' if gap is None else f'{gap:.3f}'}."
    ]


def main() -> None:
    """Print all tables."""
    for path in sorted(HERE.glob("*.json")):
        results = json.loads(path.read_text())
        print(f"\n### {path.name}\n")
        for part in (identification(results), control(results), rest(results)):
            print("\n".join([*part, ""]))


if __name__ == "__main__":
    main()
