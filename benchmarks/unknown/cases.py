"""Machines from outside the repository, where their folder is: scenarios as they were first written down."""

from __future__ import annotations

import runpy
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hybrid_mpc import Scenario


@dataclass(frozen=True)
class Case:
    """A scenario with recordings.

    Args:
        name: Its name.
        scenario: As it was written down.
        files: Recordings, the last one held out if there are three or more.
        length: Length [s] of the free runs that are compared.
        truth: The plant's values of the prior's parameters, as far as there are such.
    """

    name: str
    scenario: Scenario
    files: tuple[Path, ...]
    length: float
    truth: Mapping[str, float]


TRUTH: dict[str, dict[str, float]] = {
    "quarter_drone": {},
    "rotary_pendulum": {"Jr": 7e-5, "Jp": 3.33e-5, "Dr": 2e-4, "Dp": 3e-5},
    "stirred_tank": {"UA": 4.2e4 / 23900 / 60},
    "propeller_arm": {"g": 9.3, "k": 0.0041, "d": 1.9, "T": 0.17, "off": -0.6},
}
LENGTHS = {"quarter_drone": 2.0, "rotary_pendulum": 0.3, "stirred_tank": 1200.0, "propeller_arm": 2.0}


def cases(folder: Path, data: Path, scratch: Path) -> tuple[list[Case], list[str]]:
    """The cases, and why one is left out.

    Args:
        folder: Of the cases, one folder each with ``scenario.py`` and perhaps ``make.py``.
        data: Of measured recordings.
        scratch: Where simulated recordings are written.
    """
    found, missing = [], []
    for name, length in LENGTHS.items():
        own = folder / name
        if not (own / "scenario.py").is_file():
            missing.append(f"{name}: {own / 'scenario.py'} is not there")
            continue
        if (own / "make.py").is_file():
            subprocess.run([sys.executable, str(own / "make.py"), str(scratch / name)], check=True)
            files = sorted((scratch / name).glob("*.csv"))
        else:
            files = sorted((data / name).glob("*.csv"))
        if not files:
            missing.append(f"{name}: no recordings in {data / name}")
            continue
        scenario = runpy.run_path(str(own / "scenario.py"))["scenario"]
        found.append(Case(name, scenario, tuple(files), length, TRUTH[name]))
        if name == "rotary_pendulum":
            text = (own / "scenario.py").read_text().replace("SIGN = 1.0", "SIGN = -1.0")
            wrong = scratch / "wrong_sign.py"
            wrong.write_text(text)
            scenario = runpy.run_path(str(wrong))["scenario"]
            found.append(Case("rotary_pendulum, wrong sign", scenario, tuple(files), length, TRUTH[name]))
    return found, missing
