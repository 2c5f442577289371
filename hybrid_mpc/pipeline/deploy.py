"""Stages export and control: the artifact, and closed loops with the models that it holds."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import __version__
from hybrid_mpc.artifact import Artifact, load_artifact, save_artifact
from hybrid_mpc.closed_loop.result import ClosedLoopResult
from hybrid_mpc.closed_loop.simulate import simulate
from hybrid_mpc.estimation.kalman import TrueState
from hybrid_mpc.model import HybridModel
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.loops import (
    make_controller,
    make_estimator,
    make_monitor,
    process_noise,
    time_on_recording,
)
from hybrid_mpc.scenario import ControlSpec, Task

Array = NDArray[np.float64]
DEPLOYED = "mopgrnn"
ORACLE_ITERATIONS = 3
"""Linearisations a period of the oracle, which need not be fast."""


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    packages = ("casadi", "numpy", "scipy", "safetensors", "torch", "control", "pandas")
    own = {"hybrid-mpc": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in packages}


def export_stage(context: Context) -> None:
    """Write the hybrid and the fitted prior as one artifact; measure both against torch."""
    from hybrid_mpc.identification.export import check_parity, model_info, trace_model
    from hybrid_mpc.identification.step import PriorStep
    from hybrid_mpc.pipeline.identify import load_trained

    dt, settings = context.spec.dt, context.settings
    phy = context.scenario.prior(context.result("prior")["values"])
    steps = {"hybrid": load_trained(context, DEPLOYED).step(phy, dt), "prior": PriorStep(phy, dt)}
    info = model_info(phy, dt)
    programs, parities = {}, []
    for i, (name, step) in enumerate(steps.items()):
        context.progress.update("models", i, len(steps), name)
        programs[name] = trace_model(step)
        parities.append(check_parity(step, programs[name], info, context.trajectories("train"), seed=settings.seed))
    provenance = {
        "scenario": context.scenario.name,
        "seed": settings.seed,
        "budget": settings.budget,
        "data_hash": context.result("data")["hash"],
        "versions": versions(),
        "prior_parameters": phy.values,
        "test_scores": context.result("evaluation")["scores"][DEPLOYED]["best"],
    }
    save_artifact(context.out / "model", programs, info, provenance=provenance)
    context.save(
        "export",
        {
            "parity_max_abs_error": max(p.max_abs_error for p in parities),
            "jacobian_max_abs_error": max(p.jacobian_max_abs_error for p in parities),
        },
    )


def control_stage(context: Context) -> None:
    """Closed loops of every task with prior, hybrid and oracle; or only timing where there is no plant."""
    artifact, control = load_artifact(context.out / "model"), context.scenario.control
    noise = {name: process_noise(m, context.trajectories("train")) for name, m in artifact.models.items()}
    if control is None:
        reason = f"scenario {context.scenario.name} defines no control problem"
        context.save("control", {"reason": reason, "sigma_x": noise}, {})
    elif context.scenario.plant is None:
        _only_timing(context, artifact, control, noise)
    else:
        _closed_loops(context, artifact, control, noise)


def _only_timing(context: Context, artifact: Artifact, control: ControlSpec, noise: dict[str, Array]) -> None:
    model = artifact.models["hybrid"]
    controller = make_controller(model, artifact.models["prior"], control)
    estimator = make_estimator(model, control, noise["hybrid"])
    durations = [
        time_on_recording(controller, estimator, make_monitor(model, None), t) for t in context.dataset.whole
    ]
    reason = f"scenario {context.scenario.name} has no plant to close the loop with"
    context.save("control", {"reason": reason, "sigma_x": noise}, {"step_ms": np.concatenate(durations)})


def _closed_loops(context: Context, artifact: Artifact, control: ControlSpec, noise: dict[str, Array]) -> None:
    scenario, seeds = context.scenario, context.budget.seeds
    names = ["prior", "hybrid", *(["oracle"] if scenario.oracle else [])]
    total, done = len(scenario.tasks) * len(names) * seeds, 0
    rows: list[dict[str, Any]] = []
    arrays: dict[str, Any] = {}
    for task in scenario.tasks:
        for name in names:
            for seed in range(seeds):
                context.progress.update("loops", done, total, f"{task.name}, {name}, seed {seed}")
                result = _loop(context, artifact, control, noise, task, name, seed)
                done += 1
                solved = result.source.count("MPC") / len(result.source)
                rows.append(
                    {"task": task.name, "controller": name, "seed": seed, "cost": result.cost,
                     "tracking_rmse_rad": result.tracking_rmse, "solved": solved,
                     "finite": bool(np.isfinite(result.x).all())}
                )  # fmt: skip
                arrays[f"{task.name}/{name}/{seed}/step_ms"] = result.timing_ms["total"]
                arrays[f"{task.name}/{name}/{seed}/level_w"] = result.level
                if seed == 0:
                    for key in ("t", "x", "u", "reference"):
                        arrays[f"{task.name}/{name}/{key}"] = getattr(result, key)
    context.save("control", {"loops": rows, "sigma_x": noise}, arrays)


def _loop(
    context: Context,
    artifact: Artifact,
    control: ControlSpec,
    noise: dict[str, Array],
    task: Task,
    name: str,
    seed: int,
) -> ClosedLoopResult:
    """One closed loop on the plant; all controllers share problem, period, horizon and safeguards."""
    scenario, prior = context.scenario, artifact.models["prior"]
    assert scenario.plant is not None
    model: HybridModel
    if name == "oracle":
        assert scenario.oracle is not None
        model = scenario.oracle(context.spec.dt)
        estimator: Any = TrueState(model)
        controller = make_controller(model, prior, control, iterations=ORACLE_ITERATIONS)
    else:
        model = artifact.models[name]
        estimator = make_estimator(model, control, noise[name])
        controller = make_controller(model, prior, control)
    return simulate(
        scenario.plant(),
        estimator,
        controller,
        task.reference,
        dt=context.spec.dt,
        duration=task.duration,
        x0=np.array(task.x0),
        seed=context.settings.seed * 1000 + seed,
        monitor=make_monitor(model, None),
    )
