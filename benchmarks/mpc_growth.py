"""How the solvers' times grow: ``python benchmarks/mpc_growth.py [--times mpc_step.json] [--out docs/images]``.

Draws what ``mpc_step.py --growth --out mpc_step.json`` measured, over the horizon N and over the hidden units z, both
axes logarithmic, with the exponents (slopes by least squares) in the legend: ``mpc_growth.png``.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

import numpy as np

from hybrid_mpc.plots.style import COLOURS, new_figure, save, title_axes

SOLVERS = {"rti": COLOURS["hybrid"], "sqp": COLOURS["prior"]}
KEY = re.compile(r"(\w+)_ms at z=(\d+) n=(\d+)")
FIXED = {"n": ("z", 32), "z": ("n", 50)}
"""What stays while the other grows."""


def series(row: dict, solver: str, letter: str) -> tuple[np.ndarray, np.ndarray]:
    """Sizes and times [ms] of a solver where ``letter`` grows."""
    other, value = FIXED[letter]
    found = [(m[1], {"z": int(m[2]), "n": int(m[3])}, ms) for k, ms in row.items() if (m := KEY.fullmatch(k))]
    points = sorted((size[letter], ms) for name, size, ms in found if name == solver and size[other] == value)
    sizes, times = zip(*points, strict=True)
    return np.array(sizes), np.array(times)


def draw(row: dict):
    """Two panels: over N and over z."""
    figure, axes = new_figure(1, 2, size=(10, 4.2))
    words = {"n": "horizon N [periods], 32 hidden units", "z": "hidden units z, 50 periods"}
    for ax, letter in zip(axes[0], FIXED, strict=True):
        for solver, colour in SOLVERS.items():
            sizes, times = series(row, solver, letter)
            slope, _ = np.polyfit(np.log(sizes), np.log(times), 1)
            ax.loglog(sizes, times, "o-", color=colour, label=f"{solver}, exponent {slope:.1f}")
        ax.set_xticks(sizes, [str(s) for s in sizes])
        ax.minorticks_off()
        ax.set_xlabel(words[letter])
        ax.set_ylabel("a solve, median [ms]")
        ax.legend(frameon=False)
        title_axes(ax, f"growth in {letter.upper() if letter == 'n' else letter}")
    return figure


def main() -> None:
    """Draw."""
    here = Path(__file__).parent
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--times", type=Path, default=here / "mpc_step.json", help="JSON of mpc_step.py --growth"
    )
    parser.add_argument("--out", type=Path, default=here.parent / "docs" / "images", help="folder of the PNG")
    given = parser.parse_args()
    rows = [row for row in json.loads(given.times.read_text()) if row.get("part") == "growth"]
    if not rows:
        raise SystemExit(
            f"{given.times} holds no growth; make it with mpc_step.py --growth --out {given.times}"
        )
    print(save(draw(rows[-1]), given.out / "mpc_growth.png"))


if __name__ == "__main__":
    main()
