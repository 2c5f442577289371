"""``hybrid-mpc analyze``: input of the linear analysis, read from an artifact, a scenario and recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analyze.analysis import AnalysisInput, input_range, state_range
from hybrid_mpc.compare.controllers import OBSERVERS, find_noise
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.data.trajectories import load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import SwitchingFilter
from hybrid_mpc.kit.artifact import Kit, load
from hybrid_mpc.kit.assembly import MODES, make_ocp
from hybrid_mpc.kit.parts import KIT, MODELS, artifact_folder
from hybrid_mpc.model.model import HybridModel, positions_of
from hybrid_mpc.scenario import Scenario, scenario_of
from nn_export import load_programs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AnalysisSettings:
    """Settings of ``hybrid-mpc analyze``.

    Args:
        folder: Folder of the artifact, or of the run that holds it as ``model``.
        scenario: Name or file of the scenario. Default: the artifact's.
        data: Recordings. Default: none.
        speed: Working speed [unit of v]. Default: from the scenario's weights, else 1.
        seed: Seed of the random signals. Default: 0.
    """

    folder: Path
    scenario: str = ""
    data: tuple[Path, ...] = ()
    speed: float | None = None
    seed: int = 0


def analysis_input(settings: AnalysisSettings) -> tuple[AnalysisInput, tuple[str, ...]]:
    """Read the input of the analysis; returns it with notes on its sources."""
    folder = artifact_folder(settings.folder)
    kit = load(folder)
    scenario = scenario_of(kit.provenance.scenario, folder / KIT, settings.scenario)
    if scenario is None and settings.data:
        raise InputError(
            "--data: add --scenario, which names the columns of the recordings [HM-WORKFLOW-001]"
        )
    model = next(iter(kit.models.values()))
    if scenario is not None:
        kit = kit.on(scenario)
    control = kit.control
    speed = _speed(model, control, settings.speed)
    notes = [
        f"scenario {scenario.name}"
        if scenario
        else "without a scenario, no response of the machine is estimated"
    ]
    ocp: OCP | None = None
    filters: dict[tuple[str, str], ExtendedKalmanFilter] = {}
    noise_known = scenario is not None or set(OBSERVERS) <= set(kit.loop.process_noise)
    if control is not None and not noise_known:
        notes.append(
            "no closed loops: the kit has no process noise for its observers. Give --scenario, or set it with "
            "set_process_noise"
        )
    if control is not None and noise_known and {"prior", "hybrid"} <= set(kit.models):
        ocp = make_ocp(kit.models["prior"], control)
        filters, source = _filters(settings, scenario, kit)
        notes.append(f"observers' noise: {source}")
    plant = scenario.plant() if scenario is not None and scenario.plant is not None else None
    return AnalysisInput(
        models=kit.models,
        programs=load_programs(folder / MODELS),
        x_range=state_range(model, control),
        u_range=input_range(model, control),
        speed=speed,
        ocp=ocp,
        filters=filters,
        plant=plant,
        recordings=_recordings(settings.data, scenario, model),
        region=state_range(model),
    ), tuple(notes)


def _speed(model: HybridModel, control: OCP | None, given: float | None) -> Array:
    if given is not None and not (np.isfinite(given) and given > 0):
        raise InputError(f"--speed: give a positive number, got {given} [HM-WORKFLOW-002]")
    try:
        n_q = positions_of(model)
    except InputError as none:
        if given is not None:
            raise InputError(f"--speed: {none} [HM-WORKFLOW-003]") from None
        return np.zeros(0)
    if given is not None:
        return np.full(n_q, given)
    if control is None:
        return np.ones(n_q)
    weights = control.q[n_q:]
    return 1.0 / np.sqrt(np.where(weights > 0, weights, 1.0))


def _filters(
    settings: AnalysisSettings, scenario: Scenario | None, kit: Kit
) -> tuple[dict[tuple[str, str], ExtendedKalmanFilter], str]:
    """Filters of the closed loops by model and mode: ``quiet``, and ``jump`` for the periods after a load step."""
    source = "the model's own"
    if scenario is not None:
        noise, source = find_noise(scenario, kit, OBSERVERS, settings.seed)
        kit = kit.with_noise(noise)
    filters = {}
    for mode in ("quiet", "jump"):
        for name in ("prior", "hybrid"):
            switching = kit.observer(name)
            assert isinstance(switching, SwitchingFilter)
            filters[name, mode] = switching.filters[MODES.index(mode)]
    return filters, source


def _recordings(
    files: Sequence[Path], scenario: Scenario | None, model: HybridModel
) -> tuple[tuple[Array, Array, Array], ...]:
    if not files or scenario is None:
        return ()
    found = load_trajectories(files, model, scenario.data)
    return tuple((piece.u[:, 0], piece.y[:, 0], piece.x[0]) for piece in found.whole)
