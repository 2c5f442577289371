"""Stage track, only with ``--track``: parameters that differ between recordings, and which of them to track."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_mpc.compare.tracked import find_tracked
from hybrid_mpc.identify.ahead import Tracking
from hybrid_mpc.identify.varying import Varying
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR


@dataclass(frozen=True)
class TrackResult:
    """The parameters that vary between recordings, and those that the observer tracks.

    Args:
        varying: Variation of each parameter.
        tracking: Tracked parameters, and what tracking gains.
    """

    varying: Varying
    tracking: Tracking


def what_track_reads(context: Context) -> dict[str, object]:
    """Whether tracking is requested; then everything that the observers depend on."""
    if not context.settings.track:
        return {"asked for": False}
    scenario, control = context.scenario, context.scenario.control
    return {
        "asked for": True,
        "sensors": (scenario.sensor_sigma, scenario.first_sigma),
        "noise of the states": dict(scenario.state_noise),
        "control problem": control,
        "disturbance model": scenario.disturbance_model,
        "data specification": context.spec,
    }


def track_stage(context: Context) -> TrackResult | Absent:
    """Find the parameters that vary between recordings, and those whose tracking improves predictions."""
    if not context.settings.track:
        return Absent("--track was not given")
    scenario, spec = context.scenario, context.spec
    if scenario.control is None:
        return Absent(f"scenario {scenario.name} defines no control problem, which gives the horizon")
    train, valid = context.trajectories("train"), context.trajectories("valid")
    longest = max(
        (len(t.t) * spec.dt - spec.warm_up for t in (*valid, *context.trajectories("test"))), default=None
    )
    length = context.prior.longest_run or spec.free_run or longest or spec.dt * scenario.control.horizon
    found = find_tracked(
        scenario, context.prior.fit, train, valid, length=length, horizon=scenario.control.horizon * spec.dt
    )
    for doubt in found[1].doubts:
        context.progress.warn(doubt)
    return TrackResult(*found)


TRACK = Stage(
    "track", "looking for parameters that change", TrackResult, track_stage, what_track_reads, (DATA, PRIOR),
    optional=True,
)  # fmt: skip
