"""One run of a study, and its name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from hybrid_mpc.closed_loop.faults import Fault
from hybrid_mpc.files import digest
from hybrid_mpc.studies.draws import Intervals


@dataclass(frozen=True)
class RunConfig:
    """One closed loop of a study: all that decides what it computes, but for the content of its model.

    Args:
        scenario: Registered name or path of a user's file.
        model: Label of the model in the study.
        task: Name of the task.
        controller: Name of the contender, with its estimator.
        solver: ``"rti"``, ``"sqp"`` or ``"ipopt"``.
        horizon: Periods; None for the task's own.
        monitor: Name in :data:`hybrid_mpc.studies.configuration.MONITORS`.
        faults: Beside what the task itself brings.
        drawn_faults: Those that the draw takes at random.
        late: Intervals [s] in which solves miss their deadline.
        parameters: Parameters of the plant and their factors.
        draw: Number of the draw that ``parameters`` and random faults are from.
        seed: Number of the loop; the same number, the same sensor noise for all that share the draw.
        duration: Longest duration [s]; None for the task's own.
        number: Place in the study, no part of the run's identity.

    Example:
        >>> RunConfig("golf_robot", "model", "track_sine", "prior").id
        '63b99f88c2a7316b97ed'
    """

    scenario: str
    model: str
    task: str
    controller: str
    solver: str = "rti"
    horizon: int | None = None
    monitor: str = "own"
    faults: tuple[Fault, ...] = ()
    drawn_faults: tuple[Fault, ...] = ()
    late: Intervals = ()
    parameters: tuple[tuple[str, float], ...] = ()
    draw: int = 0
    seed: int = 0
    duration: float | None = None
    number: int = field(default=0, compare=False)

    @cached_property
    def id(self) -> str:
        """The first 20 hexadecimal digits of the SHA-256 of the configuration's JSON form."""
        return digest({key: value for key, value in asdict(self).items() if key != "number"})[:20]

    @property
    def noise_seed(self) -> int:
        """Seed of plant and sensor noise; of the first draw that of ``hybrid-mpc control --seed 0``."""
        if self.draw == 0:
            return self.seed
        return int(np.random.SeedSequence([self.seed, self.draw]).generate_state(1)[0])

    def columns(self) -> dict[str, Any]:
        """The configuration as the columns of a table."""
        return {
            "run": self.number,
            "model": self.model,
            "task": self.task,
            "controller": self.controller,
            "solver": self.solver,
            "horizon": self.horizon,
            "monitor": self.monitor,
            "faults": fault_text(self.faults),
            "drawn_faults": fault_text(self.drawn_faults, self.late),
            "draw": self.draw,
            "seed": self.seed,
            **{f"factor_{name}": value for name, value in self.parameters},
        }


def fault_text(faults: Sequence[Fault], late: Intervals = ()) -> str:
    """Faults in the form in which the command line takes them; ``"none"`` for none.

    Example:
        >>> fault_text([Fault(1.5, math.inf, "plant_friction", 2.0)], late=((1.0, 1.2),))
        'plant_friction=2@1.5 + late@1:1.2'
    """
    parts = []
    for f in faults:
        end = "" if math.isinf(f.end) else f":{f.end:g}"
        more = (f" channel {f.channel}" if f.channel else "") + (f" ramp {f.ramp:g}" if f.ramp else "")
        parts.append(f"{f.target}={f.value:g}@{f.start:g}{end}{more}")
    parts += [f"late@{a:g}" + ("" if math.isinf(b) else f":{b:g}") for a, b in late]
    return " + ".join(parts) or "none"
