"""What a reproduction writes: results.json, results.csv, the claims and figures. No torch in here."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_arrays, read_json, write_json, write_text
from hybrid_mpc.pipeline.deploy import versions
from hybrid_mpc.reproduction.claims import said
from hybrid_mpc.reproduction.judging import RULE
from hybrid_mpc.reproduction.settings import case_key
from hybrid_mpc.reproduction.table import METRICS, Row, Table

if TYPE_CHECKING:
    from hybrid_mpc.reproduction.run import Work

SCHEMA = "hybrid-mpc reproduction"
SCHEMA_VERSION = 1
DRAWN = ("phy", "mopgrnn")
"""Models whose free run is drawn beside the measurement."""


def write_outputs(work: Work) -> dict[str, Any]:
    """Collect what the jobs left, judge the claims, write tables and figures.

    Args:
        work: A reproduction whose jobs are all done.

    Returns:
        What ``results.json`` holds.
    """
    rows = work.rows()
    table = Table(rows)
    results = collected(work, rows, table)
    draw(work, table)
    write_text(work.out / "results.csv", table.csv())
    write_text(work.out / "claims.txt", "".join(f"{line}\n" for line in claim_lines(results)))
    write_json(work.out / "results.json", results)
    return read_results(work.out / "results.json")


def collected(work: Work, rows: Sequence[Row], table: Table) -> dict[str, Any]:
    """The results in the form of the schema; ``timing`` is the only part that two equal runs do not share."""
    experiment, jobs = work.experiment, {p.stem: read_json(p) for p in sorted(work.folder.glob("*.json"))}
    claims = []
    for claim in experiment.claims:
        verdict = claim.check(table)
        claims.append({"name": claim.name, "text": claim.text, "source": claim.source, **asdict(verdict)})
    priors = {key: {"values": job["values"], "standard_errors": job["standard_errors"], "smoother": job["smoother"]}
              for key, job in jobs.items() if key.endswith("_prior")}  # fmt: skip
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        "scenario": work.scenario.name,
        "figure": experiment.figure,
        "data_sets": dict(experiment.data_sets),
        "settings": work.settings.identity(),
        "versions": versions(),
        "data": {name: _hash(work, name) for name in experiment.data_sets},
        "divergence_rule": RULE,
        "notes": work.notes(),
        "priors": priors,
        "summary": table.summary(),
        "claims": claims,
        "rows": [row.plain() for row in rows],
        "details": {key: job["details"] for key, job in jobs.items() if job.get("details")},
        "timing": {"seconds_of_jobs": {key: job["seconds"] for key, job in jobs.items()}},
    }


def read_results(path: Path) -> dict[str, Any]:
    """Results of a reproduction.

    Raises:
        InputError: If the file is missing, damaged, something else, or of another version of the schema.
    """
    results = read_json(path)
    if not isinstance(results, dict) or results.get("schema") != SCHEMA:
        raise InputError(f"{path} holds no results of 'hybrid-mpc reproduce'")
    if results.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{path} has schema version {results.get('schema_version')}, this program reads {SCHEMA_VERSION}; "
            "use the program that wrote it, or run 'hybrid-mpc reproduce' anew"
        )
    return results


def table_of(results: Mapping[str, Any]) -> Table:
    """The table of results that were read."""
    return Table([Row.of(row) for row in results["rows"]])


def claim_lines(results: Mapping[str, Any]) -> list[str]:
    """A line a claim, then a line a note."""
    from hybrid_mpc.reproduction.claims import Verdict

    lines = [said(c["text"], c["source"], Verdict(c["holds"], c["found"])) for c in results["claims"]]
    return [*lines, *results["notes"]]


def draw(work: Work, table: Table) -> None:
    """E_sim, RMSE and violation over the amount of data, and a free run of the last data set's most data."""
    from hybrid_mpc.plots.reproduction import errors_over_sequences, shown_free_run
    from hybrid_mpc.plots.style import save

    folder, titles = work.out / "figures", work.experiment.data_sets
    for i, metric in enumerate(("e_sim_s", "rmse_rad", "energy_violation_w")):
        work.progress.update("figures", i, 3 + len(titles), metric)
        figure = errors_over_sequences(panels(table, titles, metric), METRICS[metric])
        save(figure, folder / f"{metric.rsplit('_', 1)[0]}.png")
    for name, title in titles.items():
        runs = {model: _shown(work, name, model) for model in DRAWN}
        prior = work.scenario.prior()
        figure = shown_free_run(runs, prior.states, prior.inputs, model=DRAWN[-1], title=title)
        save(figure, folder / f"free_run_{name}.png")


def panels(table: Table, titles: Mapping[str, str], metric: str) -> dict[str, dict[str, dict[str, Any]]]:
    """Curves by panel title and model: amounts, means, standard deviations, and diverged networks of how many."""
    drawn: dict[str, dict[str, dict[str, Any]]] = {}
    for data_set, title in titles.items():
        curves = drawn.setdefault(title, {})
        for model in table.models:
            cells = {
                n: c for n in table.sequences if (c := table.cell(data_set, n, model, metric)) is not None
            }
            curves[model] = {
                "sequences": list(cells),
                "mean": [np.nan if c.mean is None else c.mean for c in cells.values()],
                "std": [0.0 if c.std is None else c.std for c in cells.values()],
                "diverged": [c.diverged for c in cells.values()],
                "networks": [c.networks for c in cells.values()],
            }
    return drawn


def _shown(work: Work, data_set: str, model: str) -> dict[str, Any]:
    """The drawn run of a model trained on most data; of an ensemble the network best on validation runs."""
    key = case_key(data_set, work.effort.sequences[-1], model)
    if model.startswith("phy"):
        arrays, prefix = read_arrays(work.folder / "physics.npz"), f"{key}/"
    else:
        arrays, prefix = read_arrays(work.folder / f"{key}.npz"), "shown."
    return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}


def _hash(work: Work, data_set: str) -> str:
    digest = hashlib.sha256()
    for t in work.recorded[data_set]:
        digest.update(t.name.encode())
        for array in (t.u, t.y):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def text_table(results: Mapping[str, Any]) -> list[str]:
    """E_sim of all rows as lines for a terminal: mean ± standard deviation, and diverged networks."""
    table = table_of(results)
    lines = []
    for data_set in table.data_sets:
        lines.append(f"E_sim [s] on test runs, {results['data_sets'][data_set]}")
        lines.append(f"  {'sequences':14}" + "".join(f"{n:>22}" for n in table.sequences))
        for model in table.models:
            cells = [said_cell(table, data_set, n, model) for n in table.sequences]
            lines.append(f"  {model:14}" + "".join(f"{cell:>22}" for cell in cells))
    return lines


def said_cell(table: Table, data_set: str, sequences: int, model: str, metric: str = "e_sim_s") -> str:
    """A figure as tables print it: mean ± standard deviation, and how many networks diverged."""
    cell = table.cell(data_set, sequences, model, metric)
    if cell is None:
        return "-"
    if cell.mean is None:
        return "all diverged"
    text = f"{cell.mean:.4g}" + ("" if cell.std is None else f" ± {cell.std:.2g}")
    return text + (f" ({cell.diverged} diverged)" if cell.diverged else "")
