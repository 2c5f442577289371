"""How many instructions a period of the exported C controller takes, counted by Valgrind's callgrind.

``python benchmarks/instructions.py [--z 16 32] [--soft] [--out FILE.json]``, with ``apt-get install valgrind``. The
golf robot with a GRU of random weights, N = 50, |u| bounded, observer of three switching filters, the guard's energy
monitor; the controller's own test runs its 25 periods. A period is an estimate, a decision, a look of the monitor and
a preparation; each is counted call by call. Counts do
not depend on what else the machine does; they say nothing of caches. Valgrind knows no AVX-512: the widest that is
counted is AVX2 (``-march=haswell``).
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from native import SOFT
from parts import arguments, report
from whole_period import watched_controller

from hybrid_mpc.embedded.generate import SOURCES

PARTS = {
    "estimate": "hmpc_estimate_update", "decision": "hmpc_decide", "monitor": "hmpc_watch",
    "preparation": "hmpc_prepare",
}  # fmt: skip
COMPILED = ("-O2", "-O3", "-O3 -march=haswell")


def counted(program: Path, function: str) -> list[int]:
    """Instructions of each call of a function, without the first one."""
    with tempfile.TemporaryDirectory() as folder:
        out = f"--callgrind-out-file={folder}/out"
        only = [f"--toggle-collect={function}", f"--dump-after={function}"]
        command = ["valgrind", "--tool=callgrind", *only, out, str(program)]
        subprocess.run(command, check=True, capture_output=True)
        found = []
        for file in sorted(Path(folder).glob("out.*"), key=lambda f: int(f.suffix[1:])):
            if match := re.search(r"^(?:summary|totals): (\d+)", file.read_text(), re.MULTILINE):
                found.append(int(match[1]))
        return [n for n in found if n > 0][1:]


def periods(folder: Path, options: str) -> dict[str, float]:
    """Millions of instructions: medians of the parts, their sum, and the largest of each part together."""
    program = folder / "counted"
    words = ["-std=c11", "-ffp-contract=off", *options.split(), "-g", *SOURCES, "hmpc_test.c", "-lm"]
    subprocess.run(["cc", *words, "-o", str(program)], cwd=folder, check=True)
    counts = {part: 1e-6 * np.array(counted(program, function)) for part, function in PARTS.items()}
    row = {part: float(np.median(values)) for part, values in counts.items()}
    return {
        **row,
        "period": sum(row.values()),
        "largest": float(sum(values.max() for values in counts.values())),
    }


def main() -> None:
    """Count and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32], help="hidden units")
    parser.add_argument("--n", type=int, default=50, help="horizon")
    parser.add_argument("--soft", action="store_true", help="two soft bounds on states")
    given = parser.parse_args()
    if shutil.which("valgrind") is None:
        raise SystemExit("valgrind is not installed: apt-get install valgrind")
    rows = []
    for z in given.z:
        for single in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder)
                watched_controller(path, z, single, given.n, **(SOFT if given.soft else {}))
                for options in COMPILED:
                    kind = "float" if single else "double"
                    rows.append({"z": z, "numbers": kind, "compiled": options, **periods(path, options)})
    report(rows, given.out, soft=given.soft, unit="millions of instructions")


if __name__ == "__main__":
    main()
