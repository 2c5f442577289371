"""Stage analysis: prior and hybrid linearized at the operating point; mechanical ones also at working speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
class LinearPoint:
    """A model linearized at a point.

    Args:
        dt: Period [s].
        poles: Eigenvalues of the one-step map as (real part, imaginary part), the largest first.
        frequency_rad_s: Natural frequency of each pole; None for a pole at zero.
        damping: Damping of each pole.
        slow: Whether the natural frequency of each pole is below ``split_rad_s``.
        split_rad_s: A tenth of the Nyquist frequency.
        stable: Whether every mode decays.
        stabilisable: Whether the inputs reach every mode that does not decay.
        detectable: Whether the outputs show every mode that does not decay.
    """

    dt: float
    poles: tuple[tuple[float, float], ...]
    frequency_rad_s: tuple[float | None, ...]
    damping: tuple[float, ...]
    slow: tuple[bool, ...]
    split_rad_s: float
    stable: bool
    stabilisable: bool
    detectable: bool


@dataclass(frozen=True)
class ModelAnalysis:
    """A linearized model.

    Args:
        rest: The model at rest.
        moving: The model at working speed, if it is mechanical and has a control problem.
        fixed_point: The steady state ``(n_x,)``; None if none lies near the operating point.
        fixed_point_reason: Why there is none.
    """

    rest: LinearPoint
    moving: LinearPoint | None = None
    fixed_point: tuple[float, ...] | None = None
    fixed_point_reason: str = ""

    @property
    def points(self) -> dict[str, LinearPoint]:
        """The points by name."""
        return {"rest": self.rest} | ({} if self.moving is None else {"moving": self.moving})


@dataclass(frozen=True)
class AnalysisResult:
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


def analysis_stage(context: Context) -> AnalysisResult:
    """Linearize prior and hybrid at rest, mechanical ones at working speed too: poles, PBH tests, responses."""
    from hybrid_mpc.analyze.linearize import linearize
    from hybrid_mpc.analyze.properties import frequency_response

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
        points: dict[str, LinearPoint] = {}
        for point, system in systems.items():
            omega = np.geomspace(0.1 / model.time_unit, np.pi / model.dt, 300)
            response = frequency_response(system, omega)
            arrays[f"{name}/{point}/omega"] = omega
            arrays[f"{name}/{point}/magnitude"] = response.magnitude
            arrays[f"{name}/{point}/phase"] = response.phase
            points[point] = linear_point(system)
        found[name] = ModelAnalysis(points["rest"], points.get("moving"), rest, reason)
    return AnalysisResult(found, speed, arrays)


def linear_point(system: Any) -> LinearPoint:
    """Poles of a discrete ``control.StateSpace``, and whether it can be stabilised and observed."""
    from hybrid_mpc.analyze.properties import modes, stabilisable_detectable

    found, split = modes(system), 0.1 * np.pi / system.dt
    return LinearPoint(
        float(system.dt),
        tuple((m.pole.real, m.pole.imag) for m in found),
        tuple(m.frequency if np.isfinite(m.frequency) else None for m in found),
        tuple(m.damping for m in found),
        tuple(m.frequency < split for m in found),
        float(split),
        all(abs(m.pole) < 1.0 for m in found),
        *stabilisable_detectable(found),
    )


ANALYSIS = Stage(
    "analysis", "linear analysis", AnalysisResult, analysis_stage,
    lambda context: {"control problem": context.scenario.control}, (EXPORT,), optional=True,
)  # fmt: skip
