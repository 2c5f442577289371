"""``hybrid-mpc data``: show a recording's file, or write the recordings of a simulated machine."""

from __future__ import annotations

import csv
import inspect
import shlex
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.errors import InputError
from hybrid_mpc.rules import MOST_SEED, counted, markdown, printable, time_text

if TYPE_CHECKING:
    from hybrid_mpc.scenario import Scenario

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc data monday.csv\n\n"
    "  hybrid-mpc data monday.mf4 --plot\n\n"
    "  hybrid-mpc data golf_robot --out recordings\n\n"
    "  hybrid-mpc data golf_robot --out recordings_a --set a --seed 1 --budget quick"
)


def data(
    source: Annotated[
        str,
        typer.Argument(
            metavar="FILE|SCENARIO",
            help=("A recording to inspect; or, with --out, a machine whose recordings to simulate."),
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Folder to create; an existing one must be empty.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the recordings.", min=0, max=MOST_SEED)] = 0,
    budget: Annotated[str, typer.Option(help="Amount of recordings: quick or full.")] = "full",
    data_set: Annotated[str, typer.Option("--set", help="Data set of a scenario that has several.")] = "",
    plot: Annotated[bool, typer.Option("--plot", help="Open a figure of the recording.")] = False,
) -> None:
    """Show a recording: columns, units, ranges, time, gaps and warnings. Nothing is written.

    With --out: write a simulated machine's recordings as CSV or npz files, with a README on units, sampling and roles.
    """
    if out is None:
        if not Path(source).exists() and Path(source).suffix in ("", ".py"):
            raise typer.BadParameter(
                f"{source}: file not found. To write a machine's own recordings, give --out"
            )
        tell(Path(source), plot)
        return
    from hybrid_mpc.scenario import load_scenario

    files = write_data(load_scenario(source), out, seed, budget, data_set)
    print(f"{counted(len(files), 'recording')} and README.md in {out.resolve()}")


def tell(path: Path, plot: bool) -> None:
    """Print the contents of a file; open a figure if asked to."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from hybrid_mpc.check.look import look, picture

    found, console = look(path), Console(highlight=False)
    console.print(
        printable(f"{path.name}: {counted(found.rows, 'row')}, {counted(len(found.columns), 'column')}"),
        markup=False,
    )
    console.print(printable(f"time: {found.time}"), markup=False, soft_wrap=True)
    table = Table(
        "column", "unit", "numbers", "from", "to", "", box=None, header_style="bold", pad_edge=False
    )
    for one in found.columns:
        words = (one.name, one.unit, str(one.count), one.low, one.high, one.note)
        table.add_row(*(Text(printable(word)) for word in words))
    console.print(table)
    for title, texts in (("conversions while reading", found.notes), ("warnings", found.findings)):
        if texts:
            console.print(f"\n{title}")
        for text in texts:
            console.print(printable(f"  {text}"), markup=False, soft_wrap=True)
    if plot:
        with tempfile.NamedTemporaryFile(prefix=f"{path.stem}-", suffix=".png", delete=False) as file:
            picture(found).savefig(file, format="png")
        print(f"\nfigure: {file.name}")
        typer.launch(file.name)


def write_data(scenario: Scenario, out: Path, seed: int, budget: str, data_set: str = "") -> list[Path]:
    """Write the recordings of a scenario that simulates them, and a README; return the paths of the recordings.

    Raises:
        InputError: If the scenario has no simulated data, no such budget or data set, or the folder is not empty.
    """
    make = scenario.make_data
    if make is None:
        raise InputError(
            f"{scenario.name} has no simulated recordings. Give measured ones to 'hybrid-mpc run' with --data."
            " [HM-CLI-001]"
        )
    if budget not in scenario.budgets:
        raise InputError(
            f"{scenario.name} has no budget {budget!r}; it has {', '.join(scenario.budgets)} [HM-CLI-002]"
        )
    if data_set and "data_set" not in inspect.signature(make).parameters:
        raise InputError(f"{scenario.name} has only one data set. Omit --set {data_set}. [HM-CLI-003]")
    from hybrid_mpc.files import check_folder, write_text

    check_folder(out)
    options = {"data_set": data_set} if data_set else {}
    files = make(out, seed, budget, **options)
    words = ["hybrid-mpc", "data", scenario.name, "--out", out.name, "--seed", str(seed), "--budget", budget]
    words += ["--set", data_set] if data_set else []
    write_text(out / "README.md", readme(scenario, files, shlex.join(words)))
    return files


def readme(scenario: Scenario, files: Sequence[Path], command: str) -> str:
    """The README of ``files``, with the ``command`` that wrote them; the sampling is computed from the files."""
    from hybrid_mpc.data.differentiate import LocalPolynomial

    spec, prior = scenario.data, scenario.prior()
    signals = [*zip(spec.inputs, prior.inputs, strict=True), *zip(spec.outputs, prior.outputs, strict=True)]
    period, spread = _sampling(files, spec.time)
    band = LocalPolynomial(spec.smoothing).bandwidth(period)
    arrays = all(path.suffix == ".npz" for path in files)
    stamp = "one number, the sampling period" if arrays else "time stamp of the row"
    lines = [
        f"# Recordings: {markdown(scenario.title)}", "", markdown(scenario.description), "",
        f"Written by `{command}`.", "",
        "| column | unit | meaning |", "| --- | --- | --- |",
        *([f"| {markdown(spec.time)} | s | {stamp} |"] if isinstance(spec.time, str) else []),
        *(
            f"| {markdown(column)} | {markdown(s.unit)} | "
            f"{'input, held until the next row:' if column in spec.inputs else 'measured output:'} {markdown(s.name)} |"
            for column, s in signals
        ),
        "",
        f"Sampling: {time_text(1e3 * period)}, uniform; numpy arrays by these names."
        if arrays
        else (
            f"Sampling: {time_text(1e3 * period)}; the recorded time stamps jitter by {time_text(1e3 * spread)} (one "
            "standard deviation). Cells are separated by commas, decimals by points; the first row is the header."
        ),
        "",
        f"'hybrid-mpc run' smooths and differentiates the outputs by a local quartic over "
        f"{spec.smoothing:g} s (-3 dB at {band:.1f} Hz) and resamples them to {time_text(1e3 * spec.dt)}.",
        "", "| file | role |", "| --- | --- |",
        *(f"| {markdown(path.name)} | {_role(scenario, path)} |" for path in files), "",
    ]  # fmt: skip
    return "\n".join(lines)


def _role(scenario: Scenario, path: Path) -> str:
    """Roles of a file's windows, as text; a file without windows is split in order of time."""
    windows = scenario.data.windows.get(path.stem)
    if windows is None:
        train, valid, test = (f"{100 * share:.0f} %" for share in scenario.data.fractions)
        return f"first {train} training, next {valid} validation, last {test} test"
    if len(windows) == 1:
        return windows[0].role
    return ", ".join(f"{w.role} {w.start:g} to {w.end:g} s" for w in windows)


def _sampling(files: Sequence[Path], column: str | float) -> tuple[float, float]:
    """Median period of the files, and the time stamps' standard deviation around whole periods [s]."""
    import numpy as np

    if not isinstance(column, str):
        return column, 0.0
    times = []
    for path in files:
        if path.suffix == ".npz":  # one number, the sampling period
            with np.load(path) as arrays:
                times.append(float(arrays[column]) * np.arange(2))
            continue
        with path.open(encoding="utf-8", newline="") as file:
            times.append(np.array([float(row[column]) for row in csv.DictReader(file)]))
    lines = [np.polyfit(np.arange(len(t)), t, 1) for t in times]
    off = [t - np.polyval(line, np.arange(len(t))) for t, line in zip(times, lines, strict=True)]
    return float(np.median([line[0] for line in lines])), float(np.std(np.concatenate(off)))
