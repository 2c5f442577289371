"""Print the tables of docs/results/README.md from the results beside this file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn")
WORDS = {
    "error": "error [spreads]",
    "e_sim": "E_sim [spreads]",
    "e_sim_s": "E_sim [s]",
    "rmse": "RMSE",
    "balance_violation": "violation",
}
"""What errors are called, here and in results of schema 4, whose ``e_sim_s`` is a sum over states."""


def identification(results: dict[str, Any]) -> list[str]:
    """Errors of free runs on unseen data, the deployed network of each kind, and its share of ``phy``."""
    columns = {
        model: errors(results["identification"], model)
        for model in MODELS
        if results["identification"]["rmse"][model] is not None
    }
    heads = list(columns["phy"])
    shared = [head for head in heads if not head.startswith("violation")]
    lines = [
        f"| model | {' | '.join(heads)} | {' | '.join(head.partition(' [')[0] + ' / phy' for head in shared)} |",
        "|" + " --- |" * (1 + len(heads) + len(shared)),
    ]
    for model, row in columns.items():
        values = [*row.values(), *(row[head] / columns["phy"][head] for head in shared)]
        lines.append(f"| {model} | " + " | ".join(f"{v:.4g}" for v in values) + " |")
    return lines


def errors(found: dict[str, Any], model: str) -> dict[str, float]:
    """Errors of a model by what they are, with unit; the signal's name where there are several."""
    row = {}
    for key, word in WORDS.items():
        value = found.get(key, {}).get(model)
        by_signal = value if isinstance(value, dict) else {"": value}
        for label, number in by_signal.items():
            name = label if len(by_signal) > 1 else label.partition(" ")[2]
            if number is not None:
                row[f"{word} {name}".rstrip()] = float(number)
    return row


CONTROLLERS = ("prior", "prior_observer", "hybrid", "hybrid_observer", "oracle", "oracle_state")


def control(results: dict[str, Any]) -> list[str]:
    """Closed-loop costs by task, with 95 % intervals over the seeds, and the gap closed."""
    details = results["control"].get("details")
    if details is None:
        return []
    lines = ["| task | " + " | ".join(CONTROLLERS) + " | gap closed |", "|" + " --- |" * 8]
    for task, cells in details["tasks"].items():
        row = []
        for cell in (cells.get(name) for name in CONTROLLERS):
            half = None if cell is None else cell["cost"]["ci95"]
            row.append(
                "–"
                if cell is None
                else f"{cell['cost']['mean']:.3g}" + (f" ± {half:.1g}" if half is not None else "")
            )
        gap = details["gap_closed_by_task"][task]["value"]
        lines.append(f"| {task} | " + " | ".join(row) + f" | {'–' if gap is None else f'{gap:.2f}'} |")
    return lines


def strokes(results: dict[str, Any]) -> list[str]:
    """Mean absolute errors of the strokes, speed in % and instant in ms."""
    tasks = results["control"].get("details", {}).get("tasks", {})
    figures = {
        task: {name: cell["mean_abs_figures"] for name, cell in cells.items()}
        for task, cells in tasks.items()
    }
    figures = {task: row for task, row in figures.items() if any(row.values())}
    lines = ["| stroke | " + " | ".join(CONTROLLERS) + " |", "|" + " --- |" * 7] if figures else []
    for task, row in figures.items():
        cells = []
        for name in CONTROLLERS:
            f = row.get(name)
            speed, time = (
                (None, None) if not f else (f[k]["mean"] for k in ("speed_error_rel", "timing_error_s"))
            )
            cells.append(
                "–" if speed is None or time is None else f"{100 * speed:.2f} %, {1e3 * time:.2f} ms"
            )
        lines.append(f"| {task} | " + " | ".join(cells) + " |")
    return lines


def limits(results: dict[str, Any]) -> list[str]:
    """Largest shares of the limits that the hybrid with observer used, and any controller of its inputs."""
    tasks = results["control"].get("details", {}).get("tasks", {})
    used = {task: {name: cell["limits"] for name, cell in cells.items()} for task, cells in tasks.items()}
    names = list(dict.fromkeys(name for row in used.values() for limits in row.values() for name in limits))
    lines = (
        [f"| task | {' | '.join(names)} | {names[0]} of any |", "|" + " --- |" * (len(names) + 2)]
        if used
        else []
    )
    for task, row in used.items():
        shares = [row["hybrid_observer"].get(name) for name in names]
        shares.append(max(limits[names[0]] for limits in row.values()))
        lines.append(f"| {task} | " + " | ".join("–" if s is None else f"{s:.3f}" for s in shares) + " |")
    return lines


def files(results: dict[str, Any]) -> list[str]:
    """RMSE of the first output by recording."""
    by_file = results["identification"]["details"].get("by_file", {})
    if not 1 <= len(by_file) <= 8:
        return []
    label = next(iter(results["identification"]["rmse"]["phy"]))
    hybrid = results["identification"]["details"].get("choice", {}).get("hybrid", "mopgrnn")
    unit = label.partition(" ")[2]
    lines = [f"| recording | phy {unit} | {hybrid} {unit} | ratio |", "|" + " --- |" * 4]
    for name, row in by_file.items():
        one, other = (own[label] if isinstance(own, dict) else own for own in (row["phy"], row[hybrid]))
        lines.append(f"| {name} | {one:.4f} | {other:.4f} | {other / one:.2f} |")
    return lines


def rest(results: dict[str, Any]) -> list[str]:
    """Export, timing and monitor in a line each."""
    export, timing = results["export"], results["timing"]
    monitor = results.get("watch") or results["monitor"]
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
        if "identification" not in results:  # of a benchmark, not of a run
            continue
        print(f"\n### {path.name}\n")
        for part in (identification, files, control, strokes, limits, rest):
            print("\n".join([*part(results), ""]))


if __name__ == "__main__":
    main()
