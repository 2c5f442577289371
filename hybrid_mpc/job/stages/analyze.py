"""Stage analysis: prior and hybrid linearized at rest and at working speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.stage import Stage
from hybrid_mpc.job.stages.export import EXPORT
from hybrid_mpc.kit.assembly import working_point
from hybrid_mpc.model.riccati import hidden_fixed_point
from hybrid_mpc.records import record

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearPoint:
    """A model linearized at a point; see :class:`~hybrid_mpc.analyze.properties.LinearAnalysis`.

    Args:
        dt: Period [s].
        poles: Poles as (real part, imaginary part), the largest magnitude first.
        frequency_rad_s: Their natural frequencies [rad/s]; None for a pole at zero.
        damping: Their damping ratios.
        slow: Whether each lies below ``split_rad_s``.
        split_rad_s: Border between slow and fast poles [rad/s].
        stable: All poles inside the unit circle.
        stabilisable: By the test of Popov, Belevitch and Hautus.
        detectable: Alike.
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
    """A model at its points.

    Args:
        rest: At rest.
        moving: At working speed; None without a control problem.
        fixed_point: The state at rest ``(n_x,)``; None where there is none near zero.
        fixed_point_reason: Why not. Default: there is one.
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
    """The linear analysis of a run.

    Args:
        models: By model.
        working_speed: Speeds at working speed; None without a control problem.
        arrays: Frequency responses, ``"MODEL/POINT/omega"``, ``magnitude`` and ``phase``.
    """

    models: Mapping[str, ModelAnalysis]
    working_speed: tuple[float, ...] | None = None
    arrays: Mapping[str, Array] = field(default_factory=dict)


def analysis_stage(context: Context) -> AnalysisResult:
    """Linearize prior and hybrid at rest and at working speed; poles, PBH tests, frequency responses."""
    from hybrid_mpc.analyze.equilibria import fixed_point
    from hybrid_mpc.analyze.linearize import linearize
    from hybrid_mpc.analyze.properties import analyze, frequency_response

    models, speed = context.kit.models, None
    control = context.scenario.control
    found: dict[str, ModelAnalysis] = {}
    arrays: dict[str, Array] = {}
    for i, (name, model) in enumerate(models.items()):
        context.progress.update("models", i, len(models), name)
        u = np.zeros(model.n_u) if control is None else control.rest_input
        x, rest, reason = np.zeros(model.n_x), None, ""
        try:
            x, h = fixed_point(model, u, x)
            rest = tuple(x.tolist())
        except InputError as none:  # a learned correction may leave no point of rest near zero
            h = hidden_fixed_point(model, x, u)
            reason = f"linearized at x = 0 instead: {none}"
        systems = {"rest": linearize(model, x, u, h)}
        if control is not None:
            moving = x + working_point(model, control)[0]
            systems["moving"] = linearize(model, moving, u, hidden_fixed_point(model, moving, u))
            speed = tuple(moving[model.n_x // 2 :].tolist())
        points: dict[str, LinearPoint] = {}
        for point, system in systems.items():
            omega = np.geomspace(0.1 / model.time_unit, np.pi / model.dt, 300)
            response = frequency_response(system, omega)
            arrays[f"{name}/{point}/omega"] = omega
            arrays[f"{name}/{point}/magnitude"] = response.magnitude[0, 0]
            arrays[f"{name}/{point}/phase"] = response.phase[0, 0]
            points[point] = record(LinearPoint, analyze(system).to_dict(), point)
        found[name] = ModelAnalysis(points["rest"], points.get("moving"), rest, reason)
    return AnalysisResult(found, speed, arrays)


ANALYSIS = Stage(
    "analysis", "linear analysis", AnalysisResult, analysis_stage,
    lambda context: {"control problem": context.scenario.control}, (EXPORT,), optional=True,
)  # fmt: skip
