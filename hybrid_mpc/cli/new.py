"""``hybrid-mpc new``: write a first scenario from recordings."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from hybrid_mpc.cli.options import DisturbanceColumns, InputColumns, OutputColumns, TimeColumn
from hybrid_mpc.rules import counted

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc new my_machine.py --data monday.csv\n\n"
    "  hybrid-mpc new my_machine.py --data monday.csv --data tuesday.csv\n\n"
    "  hybrid-mpc new my_machine.py --data monday.csv --input-column u --output-column level "
    "--disturbance-column inflow"
)


def new(
    path: Annotated[Path, typer.Argument(metavar="FILE.py", help="Python file to create.")],
    data: Annotated[list[Path], typer.Option(help="A recording of the machine; may be repeated.")],
    time_column: TimeColumn = "",
    input_column: InputColumns = None,
    output_column: OutputColumns = None,
    disturbance_column: DisturbanceColumns = None,
) -> None:
    """Write a scenario for recordings: columns, sampling, ranges, units, and a first prior of linear lags.

    Lines marked TODO are for you to decide; 'hybrid-mpc check' lists them.
    """
    from hybrid_mpc.check.new import KINDS, horizon_of, left_to_decide, loop_lines, printable, write_scenario

    named = (tuple(columns or ()) for columns in (input_column, output_column, disturbance_column))
    inputs, outputs, disturbances = named
    draft = write_scenario(path, data, inputs, outputs, time_column, disturbances)
    lines = [
        *(f"{name}: {note}" for name, notes in draft.notes.items() for note in notes),
        f"time: {draft.time.full if draft.time else 'none found'}, sampled every {draft.sampling}",
        *([f"  decide: {draft.doubt}"] if draft.doubt else []),
        f"inputs: {', '.join(c.full for c in draft.inputs)}",
        f"outputs: {', '.join(c.full for c in draft.outputs)}",
    ]
    if draft.disturbances:
        lines.append(f"measured disturbances: {', '.join(c.full for c in draft.disturbances)}")
    if draft.set_points:
        lines.append(f"set-points, not used: {', '.join(c.full for c in draft.set_points)}")
    lines += [
        f"  check that {name} is {KINDS[draft.verdicts[name].kind]}: {reason}"
        for name, reason in draft.unsure.items()
        if draft.verdicts[name].kind in KINDS
    ]
    lines += [f"  decide: {line}" for line in loop_lines(draft)]
    lines.append(f"horizon: {horizon_of(draft)[1]}")
    lines += [f"not used: {name} ({reason})" for name, reason in draft.left_out.items()]
    count = len(left_to_decide(path))
    words = [shlex.quote(str(path)), *(f"--data {shlex.quote(str(file))}" for file in data)]
    lines.append(
        f"{path}: {counted(count, 'line is', 'lines are')} left to decide. Next: hybrid-mpc check {' '.join(words)}"
    )
    for line in lines:
        print(printable(line))
