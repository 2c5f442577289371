"""Stage estimation: consistency of the observers' innovations on test recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.compare.controllers import CONTROLLERS, OBSERVERS
from hybrid_mpc.data.scales import evenly
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.consistency import Consistency, consistency
from hybrid_mpc.records import beside
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, observed
from hybrid_mpc.workflow.stages.identify import DATA

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
PERIODS = 1000
RECORDINGS = 4
"""Periods and number of the test recordings that are used; both observers then take a few seconds."""


@dataclass(frozen=True)
class ObservedRecording:
    """A recording, or its beginning, that the observers were tested on.

    Args:
        name: Name of the recording.
        samples: Number of its samples.
    """

    name: str
    samples: int


@dataclass(frozen=True)
class EstimationResult:
    """Tests of the observers.

    Args:
        recordings: The test recordings.
        observers: Statistics by observer, or why there are none.
        arrays: ``"OBSERVER/autocorrelation"``, and ``"OBSERVER/nis/k"`` of recording ``k``.
    """

    recordings: tuple[ObservedRecording, ...]
    observers: Mapping[str, Consistency | Absent]
    arrays: Mapping[str, Array] = beside()


def estimation_stage(context: Context) -> EstimationResult | Absent:
    """Test the innovations of the observers on prior and hybrid; skipped where no control problem tunes them."""
    if context.scenario.control is None:
        return Absent(
            "the scenario defines no control problem, which gives the observers input range and sensor noise"
        )
    context.read(NOISE)
    kit, parts = context.kit, parts_for_tests(context.trajectories("test"))
    found: dict[str, Consistency | Absent] = {}
    arrays: dict[str, Array] = {}
    for i, name in enumerate(OBSERVERS):
        context.progress.update("observers", i, len(OBSERVERS), name)
        estimator = kit.observer(CONTROLLERS[name].model, load=CONTROLLERS[name].observer)
        try:
            found[name] = tested = consistency(estimator, parts)
        except InputError as too_short:
            found[name] = Absent(str(too_short))
            continue
        arrays[f"{name}/autocorrelation"] = tested.autocorrelation
        arrays |= {f"{name}/nis/{k}": run.nis for k, run in enumerate(tested.runs)}
    return EstimationResult(tuple(ObservedRecording(p.name, len(p.t)) for p in parts), found, arrays)


def parts_for_tests(recordings: Sequence[Trajectory]) -> list[Trajectory]:
    """The first samples of a few evenly chosen recordings, to limit the time of the tests."""
    chosen = [recordings[i] for i in evenly(len(recordings), RECORDINGS)]
    return [r.part(slice(PERIODS // max(1, len(chosen)))) for r in chosen]


ESTIMATION = Stage(
    "estimation", "testing the observers", EstimationResult, estimation_stage, observed, (DATA, EXPORT, NOISE),
    optional=True,
)  # fmt: skip
