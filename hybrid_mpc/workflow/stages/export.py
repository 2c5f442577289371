"""Stages export, noise and tasks: models, process noise of the estimators, and control problems of the artifact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import nn_export
from hybrid_mpc.compare.controllers import noise_of
from hybrid_mpc.compare.tracked import spread_of
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import digest, sha256
from hybrid_mpc.identify.export import check_parity, trace_model
from hybrid_mpc.identify.prior_model import model_info
from hybrid_mpc.identify.step import PriorStep, RecurrentStep
from hybrid_mpc.kit.artifact import member_names, save_artifact
from hybrid_mpc.kit.parts import (
    MOST_MEMBERS,
    PROGRAMS,
    ObserverSettings,
    Provenance,
    loop_settings,
    read_description,
    read_parts,
    write_observer,
    write_tasks,
)
from hybrid_mpc.kit.prediction import Predicting
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage, source_of
from hybrid_mpc.workflow.stages.choose import CHOICE
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR, TRAINING, UNTRAINED, trained_models
from hybrid_mpc.workflow.stages.track import TRACK

FEW = 10
"""Samples of the comparison with torch for a network that shares another network's program; one of ten is extreme."""


@dataclass(frozen=True)
class ExportResult:
    """The artifact: its models compared with PyTorch in float64, relative to the outputs' scale.

    Args:
        parity_max_abs_error: Largest difference of the values.
        jacobian_max_abs_error: Largest difference of the Jacobians.
        programs_sha256: Hash of the programs.
    """

    parity_max_abs_error: float
    jacobian_max_abs_error: float
    programs_sha256: str


@dataclass(frozen=True)
class NoiseResult:
    """Process noise of the estimators.

    Args:
        process_noise: Standard deviations per period ``(n_x,)`` [state units], by estimator.
        of: Digest of the models that it was estimated with.
        disturbance_model: Disturbances that the observer estimates. Default: one at each input.
    """

    process_noise: Mapping[str, tuple[float, ...]]
    of: str = ""
    disturbance_model: tuple[Disturbance, ...] | None = None


@dataclass(frozen=True)
class TasksResult:
    """Digest of the control problems, safe input and causes that the artifact holds."""

    digest: str


def export_stage(context: Context) -> ExportResult:
    """Write hybrid, fitted prior and each network of the hybrid as one artifact; compare all of them with torch."""
    dt, settings, prior, chosen = context.spec.dt, context.settings, context.prior, context.read(CHOICE)
    phy = context.scenario.prior(prior.fit.values)
    kind = UNTRAINED if chosen.deployed == "phy" else chosen.deployed
    trained = trained_models(context, kind).shrunk(phy, chosen.choice.share(kind))
    alone = trained.steps(phy, dt)[:MOST_MEMBERS] if len(trained.validation) > 1 else []
    members = member_names(len(alone))
    steps: dict[str, RecurrentStep | PriorStep] = {
        "hybrid": trained.step(phy, dt),
        "prior": PriorStep(phy, dt, prior.fit.substeps),
        **dict(zip(members, alone, strict=True)),
    }
    info = model_info(phy, dt, prior.fit.covariance(phy.parameters))
    smoothed = context.smoothed("train")
    deployed = replace(
        info, input_delay=prior.fit.delay, time_unit=context.time_unit,
        state_spread=spread_of([t.x for t in smoothed]), output_spread=spread_of([t.y for t in smoothed]),
    )  # fmt: skip
    programs: dict[str, dict[str, nn_export.Program]] = {}
    parities = []
    for i, (name, step) in enumerate(steps.items()):
        context.progress.update("models", i, len(steps), name)
        # members differ in their weights alone
        like = programs.get(member_names(1)[0]) if name in members else None
        programs[name] = trace_model(step, like)
        training, samples = context.smoothed("train"), FEW if like else 100
        parities.append(
            check_parity(step, programs[name], info, training, seed=settings.seed, samples=samples)
        )
    provenance = Provenance(
        context.scenario.name, settings.seed, settings.budget, context.read(DATA).hash, context.versions,
        phy.values,
    )  # fmt: skip
    folder = context.out / "model"
    beside = [programs.pop(name) for name in members]
    programs_sha256 = save_artifact(
        folder, programs, deployed, provenance=provenance,
        recommended="prior" if chosen.choice.recommended == "phy" else "hybrid", members=beside,
        predicting=predicting(context, phy),
    )  # fmt: skip
    return ExportResult(
        max(p.max_abs_error for p in parities),
        max(p.jacobian_max_abs_error for p in parities),
        programs_sha256,
    )


def predicting(context: Context, phy: Prior) -> Predicting:
    """Settings that predictions need besides the models."""
    fit, chosen = context.prior.fit, context.read(CHOICE)
    bands = {name: chosen.bands[key] for name, key in (("prior", "phy"), ("hybrid", chosen.deployed))}
    return Predicting(
        data=replace(context.spec, windows={}, free_run=context.prior.longest_run),
        corrects=tuple(phy.states[i].name for i in phy.corrected),
        bands=bands,
        longest=chosen.longest,
        **fit.smoother_settings,
    )


def artifact_is_there(context: Context, found: ExportResult) -> str:
    """Why the artifact must be written again: it is damaged or was changed; empty otherwise."""
    folder = context.out / "model"
    try:
        held = {read_description(folder).programs_sha256, sha256(folder / PROGRAMS)}
    except InputError as damaged:
        return str(damaged)
    return "" if held == {found.programs_sha256} else f"the artifact in {folder} was changed"


def noise_stage(context: Context) -> NoiseResult | Absent:
    """Tune the estimators on training recordings, by maximum likelihood."""
    of = read_parts(context.out / "model").models
    if context.scenario.control is None:
        put_noise(context, NoiseResult({}, of, context.scenario.disturbance_model))
        return Absent(f"scenario {context.scenario.name} defines no control problem")
    kit = context.kit
    scenario = context.scenario if context.budget.oracle_seeds else replace(context.scenario, oracle=None)
    found = noise_of(scenario, kit, context.commanded("train"))
    noise = {name: tuple(sigma.tolist()) for name, sigma in found.items()}
    result = NoiseResult(noise, of, kit.loop.disturbance_model)
    put_noise(context, result)
    return result


def put_noise(context: Context, found: NoiseResult) -> str:
    """Write ``observer.json``: process noise, tracked parameters, and the scenario's sensor noise and disturbances."""
    folder, scenario, track = context.out / "model", context.scenario, context.find(TRACK)
    tracked = () if isinstance(track, Absent) else track.tracking.tracked
    write_observer(
        folder,
        ObserverSettings(
            scenario.sensor_sigma, scenario.first_sigma, found.process_noise, found.disturbance_model,
            found.of, tracked,
        ),
    )  # fmt: skip
    return ""


def tasks_stage(context: Context) -> TasksResult:
    """Write the scenario's present control problems."""
    found = TasksResult(digest(loop_settings(context.scenario)))
    put_tasks(context, found)
    return found


def put_tasks(context: Context, found: TasksResult) -> str:
    """Write ``tasks.json`` and ``tasks/``."""
    write_tasks(context.out / "model", loop_settings(context.scenario))
    return ""


def observed(context: Context) -> dict[str, object]:
    """Everything of the scenario that the estimators of its loops depend on."""
    scenario, control = context.scenario, context.scenario.control
    return {
        "noise of sensors or first states": (scenario.sensor_sigma, scenario.first_sigma),
        "noise of the states": dict(scenario.state_noise),
        "limits of inputs": None if control is None else (control.u_min, control.u_max),
        "beyond recordings": scenario.beyond_recordings,
        "disturbance model": scenario.disturbance_model,
        "weights of outputs or horizon": None if control is None else (control.q_y, control.horizon),
        "oracle": source_of(scenario.oracle) if context.budget.oracle_seeds else None,
    }


EXPORT = Stage(
    "export", "exporting to CasADi", ExportResult, export_stage,
    lambda context: {"seed": context.settings.seed, "data specification": context.spec},
    (DATA, PRIOR, TRAINING, CHOICE), restore=artifact_is_there,
)  # fmt: skip
NOISE = Stage(
    "noise", "tuning the observers", NoiseResult, noise_stage, observed, (DATA, PRIOR, EXPORT, TRACK),
    optional=True, restore=put_noise,
)  # fmt: skip
TASKS = Stage(
    "tasks", "writing the control problems", TasksResult, tasks_stage,
    lambda context: {"control problems": loop_settings(context.scenario)}, (EXPORT,), restore=put_tasks,
)  # fmt: skip
