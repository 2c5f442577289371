"""Stages export and control: the artifact, and closed loops with the models that it holds."""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import __version__
from hybrid_mpc.artifact import Artifact, load_artifact, save_artifact
from hybrid_mpc.closed_loop.result import ClosedLoopResult
from hybrid_mpc.closed_loop.simulate import simulate
from hybrid_mpc.estimation.kalman import TrueState
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.loops import (
    make_controller,
    make_estimator,
    make_monitor,
    process_noise,
    time_on_recording,
)
from hybrid_mpc.pipeline.parallel import WORKERS, run_jobs
from hybrid_mpc.scenario import ControlSpec, load_scenario

Array = NDArray[np.float64]
DEPLOYED = "mopgrnn"
ORACLE_ITERATIONS = 1
"""Linearisations a period of the oracle."""

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
    from hybrid_mpc.identification.step import HybridStep, PriorStep
    from hybrid_mpc.pipeline.identify import load_trained

    dt, settings = context.spec.dt, context.settings
    phy = context.scenario.prior(context.result("prior")["values"])
    steps: dict[str, HybridStep | PriorStep] = {
        "hybrid": load_trained(context, DEPLOYED).step(phy, dt),
        "prior": PriorStep(phy, dt),
    }
    info = model_info(phy, dt)
    programs, parities = {}, []
    for i, (name, step) in enumerate(steps.items()):
        context.progress.update("models", i, len(steps), name)
        programs[name] = trace_model(step)
        parities.append(
            check_parity(step, programs[name], info, context.smoothed("train"), seed=settings.seed)
        )
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
    noise = {name: process_noise(m, context.smoothed("train")) for name, m in artifact.models.items()}
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
    whole = context.dataset.whole
    most = max(2, TIMED_PERIODS // len(whole))
    durations = []
    for i, recording in enumerate(whole):
        context.progress.update("recordings", i, len(whole), f"timing on {recording.name}")
        monitor = make_monitor(model, None)
        durations.append(time_on_recording(controller, estimator, monitor, recording, most))
    reason = f"scenario {context.scenario.name} has no plant to close the loop with"
    context.save("control", {"reason": reason, "sigma_x": noise}, {"step_ms": np.concatenate(durations)})


def _closed_loops(
    context: Context, artifact: Artifact, control: ControlSpec, noise: dict[str, Array]
) -> None:
    """All loops; those that are timed run alone, the oracle's side by side in processes."""
    scenario, seeds = context.scenario, context.budget.seeds
    names = ("prior", "hybrid", *(("oracle",) if scenario.oracle else ()))
    keys = [(t.name, n, s) for t in scenario.tasks for n in names for s in range(seeds)]
    timed = [key for key in keys if key[1] != "oracle"]
    results: dict[tuple[str, str, int], ClosedLoopResult] = {}
    common = context.settings.scenario, context.out / "model", noise, context.settings.seed
    for i, key in enumerate(timed):
        context.progress.update("timed loops", i, len(timed), ", ".join(map(str, key)))
        results[key] = closed_loop(*common, *key)
    jobs: dict[str, Any] = {
        f"{key[0]}, oracle, seed {key[2]}": (closed_loop, (*common, *key)) for key in keys if key not in timed
    }
    oracle = run_jobs(jobs, context.progress.update, WORKERS)
    results |= {key: oracle[f"{key[0]}, oracle, seed {key[2]}"] for key in keys if key not in timed}
    arrays: dict[str, Any] = {}
    for (task, name, seed), result in results.items():
        arrays[f"{task}/{name}/{seed}/step_ms"] = result.timing_ms["total"]
        if seed == 0:
            arrays |= {f"{task}/{name}/{key}": getattr(result, key) for key in ("t", "x", "u", "reference")}
    rows = [
        {"task": task, "controller": name, "seed": seed, "cost": r.cost, "tracking_rmse_rad": r.tracking_rmse,
         "solved": r.source.count("MPC") / len(r.source)}
        for (task, name, seed), r in results.items()
    ]  # fmt: skip
    context.save("control", {"loops": rows, "sigma_x": noise}, arrays)


def closed_loop(
    scenario_name: str,
    folder: Path,
    noise: dict[str, Array],
    run_seed: int,
    task_name: str,
    name: str,
    seed: int,
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> ClosedLoopResult:
    """One closed loop on the plant; all controllers share problem, period, horizon and safeguards.

    Args:
        scenario_name: Name or path of the scenario.
        folder: The artifact.
        noise: Process noise by model, see :func:`~hybrid_mpc.pipeline.loops.process_noise`.
        run_seed: Seed of the run.
        task_name: Task.
        name: ``"prior"``, ``"hybrid"`` or ``"oracle"``.
        seed: Number of the loop; same seed, same sensor noise for every controller.
        report: Called with ``(done, total, text)`` as the loop goes on.
    """
    scenario, artifact = load_scenario(scenario_name), load_artifact(folder)
    control, prior = scenario.control, artifact.models["prior"]
    task = next(t for t in scenario.tasks if t.name == task_name)
    assert scenario.plant is not None
    assert control is not None
    estimator: Any
    if name == "oracle":
        assert scenario.oracle is not None
        model = scenario.oracle(prior.dt)
        estimator, iterations = TrueState(model), ORACLE_ITERATIONS
    else:
        model = artifact.models[name]
        estimator, iterations = make_estimator(model, control, noise[name]), 1
    periods = round(task.duration / prior.dt)
    return simulate(
        scenario.plant(),
        estimator,
        make_controller(model, prior, control, iterations=iterations),
        task.reference,
        dt=prior.dt,
        duration=task.duration,
        x0=np.array(task.x0),
        seed=run_seed * 1000 + seed,
        monitor=make_monitor(model, None),
        on_step=lambda step: report(step.k, periods, "periods") if step.k % 50 == 0 else None,
    )
