"""Stages export and control: the artifact, and closed loops with the models that it holds."""

from __future__ import annotations

import platform
from dataclasses import replace
from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import __version__
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import SwitchingFilter
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.controllers import noise_of
from hybrid_mpc.job.stages.compare import compare, keep
from hybrid_mpc.kit.artifact import Kit, Provenance, loop_settings, save_artifact, set_process_noise
from hybrid_mpc.loop.loop import Loop
from hybrid_mpc.monitor.energy import EnergyMonitor

if TYPE_CHECKING:
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
DEPLOYED = "mopgrnn"
TIMED_PERIODS = 1000
"""Periods timed on recordings, where there is no plant; enough for a 99th percentile."""


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    packages = ("casadi", "numpy", "scipy", "safetensors", "torch", "control", "pandas")
    own = {"hybrid-mpc": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in packages}


def export_stage(context: Context) -> None:
    """Write the hybrid and the fitted prior as one artifact; measure both against torch."""
    from hybrid_mpc.identify.export import check_parity, model_info, trace_model
    from hybrid_mpc.identify.prior_result import PriorFit
    from hybrid_mpc.identify.step import PriorStep, RecurrentStep
    from hybrid_mpc.job.stages.identify import trained_models as load_trained

    dt, settings = context.spec.dt, context.settings
    phy = context.scenario.prior(context.result("prior")["values"])
    steps: dict[str, RecurrentStep | PriorStep] = {
        "hybrid": load_trained(context, DEPLOYED).step(phy, dt),
        "prior": PriorStep(phy, dt),
    }
    found = context.result("prior")
    fit = PriorFit(found["values"], found["standard_errors"], (), (), found["correlations"])
    info = model_info(phy, dt, fit.covariance(phy.parameters_spec))
    deployed = replace(info, input_delay=context.delay, time_unit=context.time_unit)
    programs, parities = {}, []
    for i, (name, step) in enumerate(steps.items()):
        context.progress.update("models", i, len(steps), name)
        programs[name] = trace_model(step)
        parities.append(
            check_parity(step, programs[name], info, context.smoothed("train"), seed=settings.seed)
        )
    provenance = Provenance(
        context.scenario.name,
        settings.seed,
        settings.budget,
        context.result("data")["hash"],
        versions(),
        phy.values,
        context.result("evaluation")["scores"][DEPLOYED]["best"],
    )
    save_artifact(
        context.out / "model", programs, deployed, provenance=provenance, loop=loop_settings(context.scenario)
    )
    context.save(
        "export",
        {
            "parity_max_abs_error": max(p.max_abs_error for p in parities),
            "jacobian_max_abs_error": max(p.jacobian_max_abs_error for p in parities),
        },
    )


def control_stage(context: Context) -> None:
    """Closed loops of every task with prior, hybrid and oracle; or only timing where there is no plant."""
    folder, scenario = context.out / "model", context.scenario
    if scenario.control is None:
        context.save("control", {"reason": f"scenario {scenario.name} defines no control problem"}, {})
        return
    noise = noise_of(scenario, context.kit, context.commanded("train"))
    set_process_noise(folder, noise)
    if scenario.plant is None:
        _only_timing(context, context.kit)
    else:
        keep(context, "control", compare(context))


def _only_timing(context: Context, kit: Kit) -> None:
    whole = context.dataset.whole
    most = max(2, TIMED_PERIODS // len(whole))
    controller, estimator, durations = kit.controller(), kit.observer(), []
    for i, recording in enumerate(whole):
        context.progress.update("recordings", i, len(whole), f"timing on {recording.name}")
        monitor = kit.monitor(kind="own")
        durations.append(time_on_recording(controller, estimator, monitor, recording, most))
    reason = f"scenario {context.scenario.name} has no plant to close the loop with"
    context.save("control", {"reason": reason}, {"step_ms": np.concatenate(durations)})


def time_on_recording(
    controller: SafeController,
    estimator: ExtendedKalmanFilter | SwitchingFilter,
    monitor: EnergyMonitor,
    trajectory: Trajectory,
    most: int,
) -> Array:
    """Durations [ms] of a loop's steps on at most ``most`` recorded samples, without a plant.

    The controller is asked to hold the rest position from wherever the recording is; the loop is told
    that the recorded input acted, not its own.
    """
    loop = Loop(estimator, controller, monitor=monitor)
    loop.start(trajectory.y[0])
    durations = []
    for k in range(1, min(most, len(trajectory.t))):
        loop.finish()
        loop.step(trajectory.y[k], applied=trajectory.u[k - 1])
        loop.finish()
        durations.append(1e3 * sum(loop.spent.values()))
    return np.array(durations)
