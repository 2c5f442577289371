"""``hybrid-mpc new``: a scenario to begin with, written from a recording."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from hybrid_mpc.cli.options import DisturbanceColumns, InputColumns, OutputColumns, TimeColumn

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc new my_machine.py --data monday.csv\n\n"
    "  hybrid-mpc new my_machine.py --data monday.csv --input-column u --output-column level "
    "--disturbance-column inflow"
)


def new(
    path: Annotated[Path, typer.Argument(metavar="FILE.py", help="Python file to make.")],
    data: Annotated[Path, typer.Option(help="A recording of the machine.")],
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
    disturbance_column: DisturbanceColumns = None,
) -> None:
    """Write a scenario for a recording: its columns, sampling, ranges, units, and a first prior of linear lags.

    What only you can know is marked TODO; 'hybrid-mpc check' lists what is left.
    """
    from hybrid_mpc.job.new import left_to_decide, printable, write_scenario

    named = (tuple(columns or ()) for columns in (input_column, output_column, disturbance_column))
    inputs, outputs, disturbances = named
    draft = write_scenario(path, data, inputs, outputs, time_column, disturbances)
    lines = [
        f"time: {draft.time.full if draft.time else 'none found'}, sampled every {draft.period:.4g} s",
        *([f"  to decide: {draft.doubt}"] if draft.doubt else []),
        f"inputs: {', '.join(c.full for c in draft.inputs)}",
        f"outputs: {', '.join(c.full for c in draft.outputs)}",
    ]
    if draft.disturbances:
        lines.append(f"measured disturbances: {', '.join(c.full for c in draft.disturbances)}")
    lines += [f"not used: {name} ({reason})" for name, reason in draft.left_out.items()]
    count = len(left_to_decide(path))
    scenario, recording = shlex.quote(str(path)), shlex.quote(str(data))
    lines.append(
        f"{path}: {count} lines are left to decide. Next: hybrid-mpc check {scenario} --data {recording}"
    )
    for line in lines:
        print(printable(line))
