"""Stage analysis: prior and hybrid linearized at the operating point; mechanical ones also at working speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analyze.linearize import linearize
from hybrid_mpc.analyze.properties import Mode, frequency_response, modes
from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.assembly import working_point
from hybrid_mpc.model.equilibrium import fixed_point, hidden_fixed_point
from hybrid_mpc.model.model import kinematics
from hybrid_mpc.records import beside
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Stage
from hybrid_mpc.workflow.stages.export import EXPORT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelAnalysis:
    """A linearized model.

    Args:
        points: Its modes by point, the largest pole first: ``"rest"``, and at working speed ``"moving"``, if it is
            mechanical and has a control problem.
        fixed_point: The steady state ``(n_x,)``; None if none lies near the operating point.
        fixed_point_reason: Why there is none.
    """

    points: Mapping[str, tuple[Mode, ...]]
    fixed_point: tuple[float, ...] | None = None
    fixed_point_reason: str = ""


@dataclass(frozen=True)
class LinearizedModels:
    """Linearized models.

    Args:
        models: The models by name.
        working_speed: Speeds at which mechanical models are linearized. Default: none.
        arrays: Frequency responses: ``"MODEL/POINT/omega"`` ``(n,)``, and ``.../magnitude`` and ``.../phase``
            ``(n_y, n_u, n)``.
    """

    models: Mapping[str, ModelAnalysis]
    working_speed: tuple[float, ...] | None = None
    arrays: Mapping[str, Array] = beside()


def analysis_stage(context: Context) -> LinearizedModels:
    """Linearize prior and hybrid at rest, mechanical ones at working speed too: poles, PBH tests, responses."""
    models, speed = context.kit.models, None
    control = context.scenario.control
    found: dict[str, ModelAnalysis] = {}
    arrays: dict[str, Array] = {}
    for i, (name, model) in enumerate(models.items()):
        context.progress.update("models", i, len(models), name)
        u = model.u0 if control is None else np.clip(model.u0, control.u_min, control.u_max)
        x, rest, reason = model.x0, None, ""
        try:
            x, h = fixed_point(model, u, x)
            rest = tuple(x.tolist())
        except InputError as none:  # a learned correction may leave no equilibrium nearby
            h = hidden_fixed_point(model, x, u)
            reason = f"linearized at the operating point, because no equilibrium was found: {none}"
        systems = {"rest": linearize(model, x, u, h)}
        speeds = list(kinematics(model).values())
        if control is not None and speeds:
            moving = x.copy()
            moving[speeds] = working_point(model, control)[0][speeds]
            systems["moving"] = linearize(model, moving, u, hidden_fixed_point(model, moving, u))
            speed = tuple(moving[speeds].tolist())
        for point, system in systems.items():
            omega = np.geomspace(0.1 / model.time_unit, np.pi / model.dt, 300)
            response = frequency_response(system, omega)
            arrays[f"{name}/{point}/omega"] = omega
            arrays[f"{name}/{point}/magnitude"] = response.magnitude
            arrays[f"{name}/{point}/phase"] = response.phase
        points = {point: modes(system) for point, system in systems.items()}
        found[name] = ModelAnalysis(points, rest, reason)
    return LinearizedModels(found, speed, arrays=arrays)


ANALYSIS = Stage(
    "analysis", "linear analysis", LinearizedModels, analysis_stage,
    lambda context: {"control problem": context.scenario.control}, (EXPORT,), optional=True,
)  # fmt: skip
