"""From an artifact folder and a scenario to what is analysed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import FILE, Kit, artifact_folder, load
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimation.switching import SwitchingFilter
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc import OCP
from hybrid_mpc.scenario import Plant, Scenario, scenario_of
from hybrid_mpc.signals import Signal
from nn_export import Program, load_programs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Subject:
    """What is analysed.

    Args:
        models: By name; ``"prior"`` and ``"hybrid"`` are compared.
        programs: Exported programs of the artifact, ``"prior/step"`` and so on.
        x_range: Working range of the states ``(n_x, 2)``.
        u_range: That of the inputs ``(n_u, 2)``.
        speed: Working speeds ``(n_x / 2,)``.
        ocp: The control problem; default: none, then there are no loops.
        filters: Estimators by model and mode, ``("hybrid", "quiet")``; default: none.
        plant: The simulated machine; default: none.
        recordings: Inputs ``(n,)``, outputs ``(n,)`` and first states of recordings; default: none.
        outer: Range in which points of rest are looked for ``(n_x, 2)``. Default: ``x_range``.
    """

    models: Mapping[str, HybridModel]
    programs: Mapping[str, Program]
    x_range: Array
    u_range: Array
    speed: Array
    ocp: OCP | None = None
    filters: Mapping[tuple[str, str], ExtendedKalmanFilter] = field(default_factory=dict)
    plant: Plant | None = None
    recordings: Sequence[tuple[Array, Array, Array]] = ()
    outer: Array | None = None


@dataclass(frozen=True)
class Request:
    """What is to be analysed, as it is asked for.

    Args:
        folder: Artifact folder, or the folder of the run that holds it as ``model``.
        scenario: Name or file. Default: the one that the artifact names; without any the artifact's own control problem
            and noise make the loops, where it holds them.
        data: Recordings.
        speed: Working speed. Default: that of the scenario's weights, else 1.
        seed: Of the recordings that the scenario makes to estimate the filters' noise on, if the artifact holds none.
    """

    folder: Path
    scenario: str = ""
    data: tuple[Path, ...] = ()
    speed: float | None = None
    seed: int = 0


def subject_of(request: Request) -> tuple[Subject, tuple[str, ...]]:
    """What is analysed, and in words where it came from.

    Args:
        request: What is asked for.

    Raises:
        InputError: If there is no artifact, the scenario does not fit it, or a recording is bad.
    """
    folder = artifact_folder(request.folder)
    artifact = load(folder)
    scenario = scenario_of(artifact.provenance.scenario, folder / FILE, request.scenario)
    name = "" if scenario is None else scenario.name
    if scenario is None and request.data:
        raise InputError("--data needs --scenario: only it says which columns are which")
    model = next(iter(artifact.models.values()))
    if scenario is not None:
        artifact = artifact.on(scenario)
    control = artifact.control
    speed = _speed(model, control, request.speed)
    notes = [f"scenario {name}" if name else "no scenario: no response of a machine"]
    ocp: OCP | None = None
    filters: dict[tuple[str, str], ExtendedKalmanFilter] = {}
    told = scenario is not None or {"prior_observer", "hybrid_observer"} <= set(artifact.loop.process_noise)
    if control is not None and not told:
        notes.append("no loops: the model holds no process noise for its filters; run the scenario again")
    if control is not None and told and {"prior", "hybrid"} <= set(artifact.models):
        from hybrid_mpc.assembly import make_ocp

        ocp = make_ocp(artifact.models["prior"], control)
        filters, source = _filters(request, scenario, artifact)
        notes.append(f"filters' noise: {source}")
    subject = Subject(
        artifact.models, load_programs(folder), _range(model, control), _inputs(model, control), speed, ocp, filters,
        scenario.plant() if scenario is not None and scenario.plant is not None else None,
        _recordings(request, scenario, model), _outer(model),
    )  # fmt: skip
    return subject, tuple(notes)


def _speed(model: HybridModel, control: OCP | None, given: float | None) -> Array:
    n_v = model.n_x - model.n_x // 2
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise InputError(f"--speed must be positive, got {given}")
        return np.full(n_v, given)
    if control is None:
        return np.ones(n_v)
    weights = control.q[model.n_x // 2 :]
    return 1.0 / np.sqrt(np.where(weights > 0, weights, 1.0))


def _range(model: HybridModel, control: OCP | None) -> Array:
    """Working range of the states: the limits of the control problem, else the signals', else a unit."""
    none = np.full(model.n_x, np.inf)
    lower, upper = (-none, none) if control is None else (control.x_min, control.x_max)
    sides = zip(model.states, lower.tolist(), upper.tolist(), strict=True)
    return np.array([_within(s, _unit(s), low, high) for s, low, high in sides])


def _outer(model: HybridModel) -> Array:
    """Whole range of the states: the signals', a turn for an angle that turns, else a unit either way."""
    return np.array([_within(s, _unit(s)) for s in model.states])


def _inputs(model: HybridModel, control: OCP | None) -> Array:
    if control is None:
        return np.array([_within(s, 1.0) for s in model.inputs])
    sides = zip(model.inputs, control.input_scale, control.u_min, control.u_max, strict=True)
    return np.array([_within(s, size, low, high) for s, size, low, high in sides])


def _unit(signal: Signal) -> float:
    return np.pi if signal.periodic else 1.0


def _within(
    signal: Signal, size: float, lower: float = -np.inf, upper: float = np.inf
) -> tuple[float, float]:
    """The limits of a signal where they are finite, else its own; a side without either ends at ``size``, and at least
    so far from the other side.
    """
    low = lower if np.isfinite(lower) else signal.lower
    high = upper if np.isfinite(upper) else signal.upper
    if not np.isfinite(low):
        low = min(-size, high - size) if np.isfinite(high) else -size
    return low, high if np.isfinite(high) else max(size, low + size)


def _filters(
    request: Request, scenario: Scenario | None, kit: Kit
) -> tuple[dict[tuple[str, str], ExtendedKalmanFilter], str]:
    """The observers of the closed loops: while nothing happens, and in the periods after a load came or went."""
    from hybrid_mpc.assembly import MODES

    source = "the model's own"
    if scenario is not None:
        from hybrid_mpc.job.contenders import find_noise

        noise, source = find_noise(scenario, kit, ("prior_observer", "hybrid_observer"), request.seed)
        kit = kit.with_noise(noise)
    filters = {}
    for mode in ("quiet", "jump"):
        for name in ("prior", "hybrid"):
            switching = kit.observer(name)
            assert isinstance(switching, SwitchingFilter)
            filters[name, mode] = switching.filters[MODES.index(mode)]
    return filters, source


def _recordings(
    request: Request, scenario: Scenario | None, model: HybridModel
) -> tuple[tuple[Array, Array, Array], ...]:
    if not request.data or scenario is None:
        return ()
    from hybrid_mpc.data.trajectories import load_trajectories

    found = load_trajectories(
        request.data, scenario.data, outputs=model.outputs, inputs=model.inputs, states=model.states
    )
    return tuple((piece.u[:, 0], piece.y[:, 0], piece.x[0]) for piece in found.whole)
