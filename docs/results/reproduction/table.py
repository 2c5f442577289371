"""Keep the results of reproductions beside this file, small, and print them as tables for docs/results/reproduction.md.

``python docs/results/reproduction/table.py`` prints the tables of all that are here;
``python docs/results/reproduction/table.py --take runs/reproduce_pendulum`` first takes the results of a folder that
``hybrid-mpc reproduce`` wrote: ``SCENARIO_BUDGET[_paper].json`` (all networks, without the details of their
trainings), ``.csv`` (means, standard deviations, medians) and the figures.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from hybrid_mpc.files import write_text
from scenarios.paper.run import cell_text, claim_lines, read_results, table_of
from scenarios.paper.table import METRICS

HERE = Path(__file__).parent
SHOWN = ("e_sim_s", "rmse_rad", "energy_violation_w")
"""The figures in the tables; the others stand in the CSV."""
IMAGES = HERE.parents[1] / "images"


def name_of(results: dict[str, Any]) -> str:
    """Stem of the files of a reproduction."""
    settings = results["settings"]
    form = "" if settings["form"] == "hybrid" else f"_{settings['form']}"
    return f"{results['scenario']}_{settings['budget']}{form}"


def take(folder: Path) -> None:
    """Copy the results of a folder here and its figures to docs/images."""
    results = read_results(folder / "results.json")
    name = name_of(results)
    rows, rest = results.pop("rows"), {k: v for k, v in results.items() if k != "details"}
    head = json.dumps(rest, indent=1)[:-2]  # without the closing brace: a row a line follows
    lines = ",\n  ".join(json.dumps(row) for row in rows)
    write_text(HERE / f"{name}.json", f'{head},\n "rows": [\n  {lines}\n ]\n}}\n')
    shutil.copyfile(folder / "results.csv", HERE / f"{name}.csv")
    for path in sorted((folder / "figures").glob("*.png")):
        shutil.copyfile(path, IMAGES / f"reproduction_{name}_{path.name}")


def command(results: dict[str, Any]) -> str:
    """What made the results."""
    s = results["settings"]
    amounts = ",".join(map(str, s["sequences"]))
    text = f"hybrid-mpc reproduce {results['scenario']} --budget {s['budget']} --networks {s['networks']}"
    text += f" --sequences {amounts} --seed {s['seed']}"
    return text + (f" --form {s['form']}" if s["form"] != "hybrid" else "")


def tables(results: dict[str, Any]) -> list[str]:
    """A table a data set and figure: a row a model, a column an amount of data."""
    table, lines = table_of(results), []
    for data_set, title in results["data_sets"].items():
        for metric in SHOWN:
            counts = table.sequences
            lines += [f"{title}: {METRICS[metric]}", "", f"| model | {' | '.join(map(str, counts))} |"]
            lines.append("|" + " --- |" * (len(counts) + 1))
            for model in table.models:
                cells = [cell_text(table, data_set, n, model, metric) for n in counts]
                lines.append(f"| {model} | {' | '.join(cells)} |")
            lines.append("")
    return lines


def summary(results: dict[str, Any]) -> list[str]:
    """Command, processor time, tables and claims of one reproduction."""
    seconds = sum(results["timing"]["seconds_of_jobs"].values())
    return [
        f"### {name_of(results)}",
        "",
        f"`{command(results)}`; its jobs took {seconds / 60:.0f} min in all, two of them side by side, on a machine "
        "with other work.",
        "",
        *tables(results),
        *(f"- {line}" for line in claim_lines(results)),
        "",
    ]


def main() -> None:
    """Take what is asked for, print everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--take", type=Path, action="append", default=[], help="folder of a reproduction")
    for folder in parser.parse_args().take:
        take(folder)
    for path in sorted(HERE.glob("*.json")):
        print("\n".join(summary(read_results(path))))


if __name__ == "__main__":
    main()
