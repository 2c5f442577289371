"""Stages export and control: the artifact, and closed loops with the models that it holds."""

from __future__ import annotations

import platform
from dataclasses import replace
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import __version__
from hybrid_mpc.artifact import (
    Kit,
    LoopSettings,
    Provenance,
    load,
    save_artifact,
    set_process_noise,
)
from hybrid_mpc.mpc import OCP
from hybrid_mpc.pipeline.contenders import noise_of
from hybrid_mpc.pipeline.contest import contest
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.loops import make_controller, make_estimator, make_monitor, time_on_recording
from hybrid_mpc.scenario import Scenario

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
    from hybrid_mpc.identification.export import check_parity, model_info, trace_model
    from hybrid_mpc.identification.prior_result import PriorFit
    from hybrid_mpc.identification.step import PriorStep, RecurrentStep
    from hybrid_mpc.pipeline.identify import load_trained

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


def loop_settings(scenario: Scenario) -> LoopSettings:
    """What a scenario's loops need beside the models; their process noise is estimated later.

    Args:
        scenario: The machine.

    Example:
        >>> from scenarios.golf_robot import scenario
        >>> sorted(loop_settings(scenario).control)[:2]
        ['', 'track_limits']
    """
    problems = {"": scenario.control} | {task.name: task.control for task in scenario.tasks}
    given = {name: problem for name, problem in problems.items() if problem is not None}
    return LoopSettings(given, scenario.sensor_sigma, scenario.first_sigma, causes=dict(scenario.causes))


def control_stage(context: Context) -> None:
    """Closed loops of every task with prior, hybrid and oracle; or only timing where there is no plant."""
    artifact, control = load(context.out / "model"), context.scenario.control
    if control is None:
        context.save(
            "control", {"reason": f"scenario {context.scenario.name} defines no control problem"}, {}
        )
        return
    noise = noise_of(context.scenario, artifact, context.commanded("train"))
    set_process_noise(context.out / "model", noise)
    if context.scenario.plant is None:
        _only_timing(context, artifact, control, noise)
    else:
        rows, arrays = contest(context, artifact, control, noise)
        context.save("control", {"loops": rows, "sigma_x": noise}, arrays)


def _only_timing(context: Context, artifact: Kit, control: OCP, noise: dict[str, Array]) -> None:
    model = artifact.models["hybrid"]
    controller = make_controller(model, artifact.models["prior"], control)
    estimator = make_estimator(model, context.scenario, noise["hybrid_observer"])
    whole = context.dataset.whole
    most = max(2, TIMED_PERIODS // len(whole))
    durations = []
    for i, recording in enumerate(whole):
        context.progress.update("recordings", i, len(whole), f"timing on {recording.name}")
        monitor = make_monitor(model, None)
        durations.append(time_on_recording(controller, estimator, monitor, recording, most))
    reason = f"scenario {context.scenario.name} has no plant to close the loop with"
    context.save("control", {"reason": reason, "sigma_x": noise}, {"step_ms": np.concatenate(durations)})
