"""Keep the results of machine benchmarks beside this file and print them as tables for docs/results/real_machines.md.

``python docs/results/machines/table.py`` prints the tables of all that are here;
``python docs/results/machines/table.py --take runs/disk24 --name unbalanced_disk_2024`` first takes ``results.json``
and the figures of a folder that ``hybrid-mpc benchmark`` wrote.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from hybrid_mpc.files import read_json, write_json
from hybrid_mpc.records import plain
from hybrid_mpc.workflow.benchmark import read_benchmark

HERE = Path(__file__).parent
IMAGES = HERE.parents[1] / "images"
MODELS = ("phy", "rnn", "pgrnn", "mopgrnn", "hybrid")
LINEAR = ("ARX", "N4SID")


def take(folder: Path, name: str) -> None:
    """Write the results that the tables need here, and copy the figures to docs/images."""
    found = read_benchmark(folder / "results.json")
    fit, nominal = found.prior.fit, found.prior.nominal
    kept = {
        "schema": 3,
        "budget": found.budget,
        "seed": found.seed,
        "data": found.data,
        "warnings": found.warnings,
        "model": {
            "prior": [
                {
                    "parameter": name, "unit": found.prior.units[name], "nominal": nominal[name], "fitted": value,
                    "standard_error": fit.standard_errors.get(name),
                }
                for name, value in fit.values.items()
            ],
            "delay_s": fit.delay,
            "hybrid": found.hybrid,
            "choice": found.choice.choice,
            "validation": found.choice.validation,
            "long": found.choice.long,
        },
        "test": {file: {**own.errors, "scored_s": own.scored_s} for file, own in found.test.items()},
    }  # fmt: skip
    write_json(HERE / f"{name}.json", plain(kept))
    for path in sorted((folder / "figures").glob("*.png")):
        stem = path.stem.replace(" ", "_")
        shutil.copyfile(path, IMAGES / f"machine_{name}_{stem}.png")


def digits(value: float) -> str:
    """Three significant digits.

    Example:
        >>> digits(0.012345), digits(123.4)
        ('0.0123', '123')
    """
    return f"{value:.3g}"


def errors(results: dict[str, Any]) -> list[str]:
    """Free runs: a row a test file, the validation part first."""
    model, chosen = results["model"], results["model"]["hybrid"]
    if results["schema"] == 1:  # the first output alone
        found = model["validation"]
        unit, known, long = found["unit"], found["rmse"], found.get("long_rmse", {})
        tests = {
            name: {m: own["rmse"] for m, own in by.items() if m in MODELS}
            for name, by in results["test"].items()
        }
        outputs = {f"[{unit}]": (known, long, tests)}
    else:
        outputs = {
            label: (
                {m: own["rmse"][label] for m, own in model["validation"].items()},
                {m: own["rmse"][label] for m, own in model["long"].items()},
                {
                    name: {m: by[m]["rmse"][label] for m in (*MODELS, *LINEAR) if m in by}
                    for name, by in results["test"].items()
                },
            )
            for label in model["validation"]["phy"]["rmse"]
        }
    lines: list[str] = []
    for label, (known, long, tests) in outputs.items():
        rows = {"validation": {**known, "hybrid": known[chosen]}}
        if long:
            rows |= {"whole recordings, mostly trained on": {**long, "hybrid": long[chosen]}}
        rows |= tests
        names = [m for m in (*MODELS, *LINEAR) if all(m in row for row in rows.values())]
        lines += [
            f"| free runs {label} | {' | '.join(names)} | hybrid / phy |",
            "| --- |" + " ---: |" * (len(names) + 1),
        ]
        for name, row in rows.items():
            cells = [digits(row[m]) for m in names]
            lines.append(f"| {name} | {' | '.join(cells)} | {row['hybrid'] / row['phy']:.2f} |")
        lines.append("")
    return [*lines, f"Recommended: {chosen}."]


def parameters(results: dict[str, Any]) -> list[str]:
    """The fitted prior: a row a parameter that was fitted."""
    lines = ["| parameter | unit | nominal | fitted | standard error |", "| --- | --- | ---: | ---: | ---: |"]
    for row in results["model"]["prior"]:
        if row["standard_error"] is not None:
            cells = [digits(row[key]) for key in ("nominal", "fitted", "standard_error")]
            lines.append(f"| {row['parameter']} | {row['unit']} | {' | '.join(cells)} |")
    delay = results["model"]["delay_s"]
    return [*lines, *([f"| delay | ms | | {1e3 * delay:.1f} | |"] if delay else [])]


def main() -> None:
    """Take results where asked; print the tables of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--take", type=Path, help="folder of a benchmark")
    parser.add_argument("--name", help="stem of its files here, e.g. emps")
    given = parser.parse_args()
    if given.take is not None:
        if not given.name:
            parser.error("--take needs --name")
        take(given.take, given.name)
    for path in sorted(HERE.glob("*.json")):
        results = read_json(path)
        seconds = results.get("data", {}).get("seconds", {})
        parts = ", ".join(f"{role} {length:.0f} s" for role, length in seconds.items() if length)
        print(f"#### {path.stem}, budget {results['budget']}, seed {results['seed']} ({parts})\n")
        print("\n".join([*parameters(results), "", *errors(results), ""]))


if __name__ == "__main__":
    main()
