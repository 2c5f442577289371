"""Stage estimation: do the observers believe what they should, on recordings that nothing was tuned on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.consistency import Consistency, consistency
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.controllers import CONTROLLERS
from hybrid_mpc.job.stages.results import OBSERVERS

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

JUDGED_PERIODS = 1000
JUDGED_RECORDINGS = 4
"""So many periods of so many test recordings are judged: a few seconds of computing for both observers."""


def estimation_stage(context: Context) -> None:
    """Test the innovations of the observers on prior and hybrid; skipped where no control problem tunes them."""
    control = context.scenario.control
    if control is None:
        reason = "the observers need the scenario's control problem (input range, sensor noise)"
        context.save("estimation", {"reason": reason}, {})
        return
    kit = context.kit
    parts = judged_parts(context.trajectories("test"))
    result: dict[str, Any] = {"recordings": [{"name": p.name, "samples": len(p.t)} for p in parts]}
    arrays: dict[str, Any] = {}
    for i, name in enumerate(OBSERVERS):
        context.progress.update("observers", i, len(OBSERVERS), name)
        estimator = kit.observer(CONTROLLERS[name].model, load=CONTROLLERS[name].observer)
        try:
            found = consistency(estimator, parts)
        except InputError as too_short:
            result[name] = {"reason": str(too_short)}
            continue
        result[name] = figures_of(found)
        arrays[f"{name}/autocorrelation"] = found.autocorrelation
        arrays |= {f"{name}/nis/{k}": run.nis for k, run in enumerate(found.runs)}
    context.save("estimation", result, arrays)


def judged_parts(recordings: Sequence[Trajectory]) -> list[Trajectory]:
    """The first samples of a few recordings, evenly chosen, that the tests can take the time for.

    Args:
        recordings: Test recordings.
    """
    places = np.linspace(0, len(recordings) - 1, min(JUDGED_RECORDINGS, len(recordings))).round().astype(int)
    chosen = [recordings[i] for i in dict.fromkeys(places.tolist())]
    most = JUDGED_PERIODS // max(1, len(chosen))
    return [r.part(np.arange(len(r.t)) < most, r.name, r.role) for r in chosen]


def figures_of(found: Consistency) -> dict[str, Any]:
    """What ``results.json`` holds of one observer, and the band of one autocorrelation."""
    return {
        "mean_nis": found.mean_nis,
        "nis_low": found.nis_band[0],
        "nis_high": found.nis_band[1],
        "nis_inside": found.nis_inside,
        "ljung_box": found.ljung_box,
        "ljung_box_limit": found.ljung_box_limit,
        "samples": found.samples,
        "correlation_band": found.correlation_band,
    }
