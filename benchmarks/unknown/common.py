"""What all machines share: how they are recorded, and the table of a benchmark of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import DataSpec, Prior

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Machine:
    """A machine as a new user has it: a prior, a data specification and recordings of a plant that differs from both.

    Args:
        name: Its name.
        prior: The prior as written by the user.
        spec: How recordings are read.
        record: ``seed -> columns (n, m)`` of a recording.
        header: Names of the columns.
        length: Length [s] of the free runs that are compared.
        truth: The plant's values of the prior's parameters, as far as there are such.
        seen: Whether the fit was changed with this machine known.
        closed: Whether it is unstable or recorded in closed loop.
    """

    name: str
    prior: type[Prior]
    spec: DataSpec
    record: Callable[[int], Array]
    header: str
    length: float
    truth: Mapping[str, float]
    seen: bool
    closed: bool = False

    def write(self, folder: Path, runs: int = 4) -> list[Path]:
        """Recordings as CSV files; the last ones are held out."""
        folder.mkdir(parents=True, exist_ok=True)
        files = []
        for seed in range(runs):
            files.append(folder / f"{self.name}_{seed + 1}.csv")
            rows = self.record(seed)
            with files[-1].open("w") as file:
                file.write(self.header + "\n")
                for row in rows:  # a blank cell is a missing sample
                    file.write(",".join("" if np.isnan(v) else f"{v:.7g}" for v in row) + "\n")
        return files


def quantised(y: Array, steps: float | Array) -> Array:
    """What a converter with such steps gives."""
    return np.asarray(np.round(y / steps) * steps)


def drop_outs(y: Array, rng: np.random.Generator, share: float, longest: int = 5) -> Array:
    """Outputs with a share of their samples missing, some in a row."""
    y = y.copy()
    for column in y.T:
        for start in rng.integers(0, len(y), round(share * len(y) / longest * 2)):
            column[start : start + int(rng.integers(1, longest + 1))] = np.nan
    return y


def levels(
    rng: np.random.Generator, samples: int, low: float, high: float, shortest: int, longest: int
) -> Array:
    """Steps between random levels that are held for random times."""
    out = np.zeros(samples)
    k = 0
    while k < samples:
        n = int(rng.integers(shortest, longest + 1))
        out[k : k + n] = rng.uniform(low, high)
        k += n
    return out


def report(rows: Sequence[Mapping[str, object]], out: Path | None) -> None:
    """Rows as a Markdown table, and as a JSON file."""
    if rows:
        print("\n| " + " | ".join(rows[0]) + " |\n|" + " --- |" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(str(v).replace("|", "\\|") for v in row.values()) + " |")
    if out is not None:
        out.write_text(json.dumps(rows, indent=1) + "\n")
