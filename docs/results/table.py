"""Keep figures of runs beside this file, and print the tables of docs/results/README.md from them.

``python docs/results/table.py`` prints the tables of all that are here;
``python docs/results/table.py --take runs/demo --name golf_robot_quick`` first takes the figures of a run.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hybrid_mpc.compare.controllers import CONTROLLERS
from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.identify.evaluate import Scores
from hybrid_mpc.records import plain
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.compare import closed_loops
from hybrid_mpc.workflow.stages.results import Results, read_results

HERE = Path(__file__).parent
NOTE = "figures of a run"


def figures(results: Results) -> dict[str, Any]:
    """What the tables show of a run."""
    loops, watch = closed_loops(results.control), results.watch
    assert not isinstance(results.control, Absent)
    assert not isinstance(watch, Absent)
    return {
        "what": NOTE,
        "budget": results.budget,
        "seed": results.seed,
        "parameters": results.prior.fit.values,
        "models": {name: errors(own.model) for name, own in results.evaluation.scores.items()},
        "files": {
            file: {name: by[file].rmse for name, by in results.evaluation.by_file.items()}
            for file in results.evaluation.by_file["phy"]
        },
        "hybrid": results.choice.deployed,
        "tasks": {} if loops is None else plain(loops.means),
        "gaps": {} if loops is None else {task: gap for task, (gap, _) in loops.gaps.items()},
        "gap": None if loops is None else loops.gap[0],
        "export": plain(results.export),
        "step_ms": plain(results.control.step_ms),
        "alarms": len(watch.alarms),
        "clean": plain(watch.clean),
    }


def errors(scores: Scores) -> dict[str, float]:
    """Errors of a model by what they are, with unit; the signal's name where there are several."""
    row = {"error [spreads]": scores.error, "E_sim [spreads]": scores.e_sim}
    for word, values in (("RMSE", scores.rmse), ("violation", scores.violation)):
        for label, number in values.items():
            row[f"{word} {label if len(values) > 1 else label.partition(' ')[2]}"] = number
    return row


def identification(run: dict[str, Any]) -> list[str]:
    """Errors of free runs on unseen data, the deployed network of each kind, and its share of ``phy``."""
    base = run["models"]["phy"]
    shared = [head for head in base if not head.startswith("violation")]
    lines = [
        f"| model | {' | '.join(base)} | {' | '.join(head.partition(' [')[0] + ' / phy' for head in shared)} |",
        "|" + " --- |" * (1 + len(base) + len(shared)),
    ]
    for model, row in run["models"].items():
        values = [*row.values(), *(row[head] / base[head] for head in shared)]
        lines.append(f"| {model} | " + " | ".join(f"{v:.4g}" for v in values) + " |")
    return lines


def control(run: dict[str, Any]) -> list[str]:
    """Closed-loop costs by task, with 95 % intervals over the seeds, and the gap closed."""
    if not run["tasks"]:
        return []
    lines = ["| task | " + " | ".join(CONTROLLERS) + " | gap closed |", "|" + " --- |" * 8]
    for task, cells in run["tasks"].items():
        row = []
        for name in CONTROLLERS:
            cost = cells[name]["cost"] if name in cells else None
            half = "" if cost is None or cost["ci95"] is None else f" ± {cost['ci95']:.1g}"
            row.append("–" if cost is None else f"{cost['mean']:.3g}{half}")
        gap = run["gaps"][task]
        lines.append(f"| {task} | " + " | ".join(row) + f" | {'–' if gap is None else f'{gap:.2f}'} |")
    return lines


def strokes(run: dict[str, Any]) -> list[str]:
    """Mean absolute errors of the strokes, speed in % and instant in ms."""
    lines = []
    for task, cells in run["tasks"].items():
        row = []
        for name in CONTROLLERS:
            own = cells[name]["mean_abs_figures"] if name in cells else {}
            speed, time = (own.get(key, {}).get("mean") for key in ("speed_error_rel", "timing_error_s"))
            known = speed is not None and time is not None
            row.append(f"{100 * speed:.2f} %, {1e3 * time:.2f} ms" if known else "–")
        if any(cell["mean_abs_figures"] for cell in cells.values()):
            lines.append(f"| {task} | " + " | ".join(row) + " |")
    return ["| stroke | " + " | ".join(CONTROLLERS) + " |", "|" + " --- |" * 7, *lines] if lines else []


def limits(run: dict[str, Any]) -> list[str]:
    """Largest shares of the limits that the hybrid with observer used, and any controller of its inputs."""
    used = {
        task: {name: cell["limits"] for name, cell in cells.items()} for task, cells in run["tasks"].items()
    }
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


def files(run: dict[str, Any]) -> list[str]:
    """RMSE of the first output by recording."""
    by_file, hybrid = run["files"], run["hybrid"]
    if not 1 <= len(by_file) <= 8:
        return []
    label = next(iter(next(iter(by_file.values()))["phy"]))
    unit = label.partition(" ")[2]
    lines = [f"| recording | phy {unit} | {hybrid} {unit} | ratio |", "|" + " --- |" * 4]
    for name, row in by_file.items():
        one, other = row["phy"][label], row[hybrid][label]
        lines.append(f"| {name} | {one:.4f} | {other:.4f} | {other / one:.2f} |")
    return lines


def rest(run: dict[str, Any]) -> list[str]:
    """Export, timing and monitor in a line each."""
    export, ms, clean, gap = run["export"], run["step_ms"], run["clean"], run["gap"]
    return [
        f"Export parity {export['parity_max_abs_error']:.1e}, Jacobians {export['jacobian_max_abs_error']:.1e}. "
        f"Controller step: median {ms['median']:.2f} ms, p99 {ms['p99']:.2f} ms of {ms['period']:g} ms, "
        f"{ms['misses']} misses. Monitor: {run['alarms']} alarms in all, {clean['alarms']} in "
        f"{clean['seconds']:.0f} s of clean data. Gap closed: {'undefined' if gap is None else f'{gap:.3f}'}."
    ]


def main() -> None:
    """Take figures where asked; print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--take", type=Path, help="folder of a run")
    parser.add_argument("--name", help="stem of its file here, e.g. golf_robot_quick")
    given = parser.parse_args()
    if given.take is not None:
        if not given.name:
            parser.error("--take needs --name")
        write_json(HERE / f"{given.name}.json", plain(figures(read_results(given.take / "results.json"))))
    for path in sorted(HERE.glob("*.json")):
        run = read_json(path)
        if run.get("what") != NOTE:  # results of a benchmark
            continue
        print(f"\n### {path.name}\n")
        for part in (identification, files, control, strokes, limits, rest):
            print("\n".join([*part(run), ""]))


if __name__ == "__main__":
    main()
