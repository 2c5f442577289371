"""How near sound recordings come to being doubted, and how many faults put into them are told.

``python benchmarks/doubts.py MACHINE FILE [FILE ...]`` prints a row of the recording in docs/data.md: files, samples,
findings of the recordings as they are, the largest factor ``ABRUPT`` with which anything of them would be told (3 is
used), and of faults put into each file, 20 at random instants, how many are told: an output frozen for 0.1, 0.3 and
1 s, of those in which the machine moves by a tenth of its range; and the upper fifth of the range clipped, one a file.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_mpc import Scenario, load_scenario
from hybrid_mpc.data import findings as stillness
from hybrid_mpc.data.findings import findings_of
from hybrid_mpc.data.recording import Finding, Recording, read_recordings
from hybrid_mpc.errors import refuse

FROZEN = (0.1, 0.3, 1.0)
TIMES = 20


def findings(scenario: Scenario, recordings: Sequence[Recording]) -> tuple[Finding, ...]:
    """What is doubtful; speeds are left out."""
    none = np.zeros(0), np.zeros((0, 0))
    return findings_of(recordings, [none] * len(recordings), scenario.data, outputs=scenario.prior().outputs)


def nearest(scenario: Scenario, recordings: Sequence[Recording]) -> float:
    """Largest factor with which anything of sound recordings would be told."""
    used = stillness.ABRUPT
    for factor in np.arange(3.0, 0.0, -0.05):
        stillness.ABRUPT = float(factor)
        if findings(scenario, recordings):
            break
    stillness.ABRUPT = used
    return float(factor)


def frozen(scenario: Scenario, recordings: Sequence[Recording], seconds: float) -> tuple[int, int]:
    """Told, of all stretches in which the machine moves by a tenth of its range."""
    rng, told, all_of_them = np.random.default_rng(0), 0, 0
    for recording in recordings:
        length = round(seconds / recording.dt)
        for first in rng.integers(
            10, len(recording.t) - length - 10, TIMES if length >= stillness.SHORTEST else 0
        ):
            y = recording.y.copy()
            moved = np.ptp(y[first : first + length], axis=0) > 0.1 * np.ptp(y, axis=0)
            y[first : first + length] = y[first]
            if moved.any():
                all_of_them += 1
                told += bool(findings(scenario, [replace(recording, y=y)]))
    return told, all_of_them


def clipped(scenario: Scenario, recordings: Sequence[Recording]) -> tuple[int, int]:
    """Told, of all files."""
    cut = [replace(t, y=np.minimum(t.y, t.y.max(axis=0) - 0.2 * np.ptp(t.y, axis=0))) for t in recordings]
    return sum(any(f.kind == "clipped" for f in findings(scenario, [t])) for t in cut), len(cut)


def main() -> None:
    """Print the row of one machine."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("machine")
    parser.add_argument("files", nargs="+", type=Path)
    given = parser.parse_args()
    scenario = load_scenario(given.machine)
    prior = scenario.prior()
    recordings, problems = read_recordings(
        given.files, scenario.data, outputs=prior.outputs, inputs=prior.inputs
    )
    refuse(problems)
    cells = [len(recordings), sum(len(t.t) for t in recordings), len(findings(scenario, recordings))]
    cells += [f"{nearest(scenario, recordings):.2f}"]
    faults = [frozen(scenario, recordings, seconds) for seconds in FROZEN] + [clipped(scenario, recordings)]
    cells += ["" if not of else f"{told} of {of}" for told, of in faults]
    print(f"| `{scenario.name}` | " + " | ".join(map(str, cells)) + " |")


if __name__ == "__main__":
    main()
