"""``hybrid-mpc new``: a scenario to begin with, written from a recording."""

from __future__ import annotations

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
    from hybrid_mpc.job.new import left_to_decide, write_scenario

    named = (tuple(columns or ()) for columns in (input_column, output_column, disturbance_column))
    inputs, outputs, disturbances = named
    draft = write_scenario(path, data, inputs, outputs, time_column, disturbances)
    time = draft.time.full if draft.time else "none found"
    print(f"time: {time}, sampled every {draft.period:.4g} s")
    print(f"inputs: {', '.join(c.full for c in draft.inputs)}")
    print(f"outputs: {', '.join(c.full for c in draft.outputs)}")
    if draft.disturbances:
        print(f"measured disturbances: {', '.join(c.full for c in draft.disturbances)}")
    if draft.left_out:
        print(f"not used: {', '.join(draft.left_out)}")
    print(
        f"{path}: {len(left_to_decide(path))} lines are left to decide. Next: hybrid-mpc check {path} --data {data}"
    )
