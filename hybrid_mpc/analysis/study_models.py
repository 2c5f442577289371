"""Parts of a study: the models by themselves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analysis.along import linearize_along
from hybrid_mpc.analysis.equilibria import equilibria
from hybrid_mpc.analysis.friction import friction_slopes, linearize_secant
from hybrid_mpc.analysis.linearize import hidden_fixed_point, linearize, linearize_at_speed
from hybrid_mpc.analysis.properties import frequency_response
from hybrid_mpc.analysis.reduction import physical_states
from hybrid_mpc.analysis.structure import system_structure
from hybrid_mpc.analysis.subject import Subject
from hybrid_mpc.analysis.toolbox import control_toolbox
from hybrid_mpc.data.excitation import multisine
from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel

Array = NDArray[np.float64]
Part: TypeAlias = tuple[dict[str, Any], dict[str, Any]]
"""Plain numbers, and curves by name."""
POINTS = ("rest", "working", "moving", "driven")
"""Linearisations: the tangent at rest, the describing function of motions of working size around it, the tangent in
motion at working speed, and the mean along a driven run."""
FARTHEST = 1e6
"""Zeros farther out belong to a way through the system that begins later: rounding, over the fall of its gain."""
LEVEL = 0.5
"""Size of the multisine over half the input's range."""


def rest(subject: Subject, model: HybridModel) -> tuple[Array, Array]:
    """The point of rest without input that is nearest to zero, else zero; with the hidden state there."""
    u = np.zeros(model.n_u)
    found = equilibria(model, u, pairs(subject.x_range), starts=16).points
    calm = [p for p in found if p.stability == "stable"] or list(found)
    if calm:
        best = min(calm, key=lambda p: float(np.linalg.norm(p.x)))
        return best.x, best.h
    x = np.zeros(model.n_x)
    return x, hidden_fixed_point(model, x, u)


def pairs(box: Array) -> list[tuple[float, float]]:
    """Rows of a box as pairs."""
    return [(float(a), float(b)) for a, b in box]


def equilibria_part(subject: Subject) -> Part:
    """Points of rest of each model in the whole range of the states."""
    outer = subject.x_range if subject.outer is None else subject.outer
    result: dict[str, Any] = {"region": outer}
    for name, model in subject.models.items():
        found = equilibria(model, np.zeros(model.n_u), pairs(outer))
        rows = [
            {
                "x": p.x,
                "residual": p.residual,
                "radius": abs(p.poles[0]),
                "stability": p.stability,
                "hits": p.hits,
            }
            for p in found.points
        ]
        counts = {"starts": found.starts, "converged": found.converged, "unseen": found.unseen}
        result[name] = {"points": rows, **counts}
    return result, {}


def friction_part(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Damping at rest, as chords and in motion."""
    result: dict[str, Any] = {"working_speed": subject.speed}
    arrays: dict[str, Any] = {}
    for name, model in subject.models.items():
        q = points[name][0][: model.n_x // 2]
        work = float(subject.speed[0])
        found = friction_slopes(model, q, work * np.geomspace(0.01, 10.0, 61))
        at_work = friction_slopes(model, q, [work])
        result[name] = {
            "tangent_1_s": found.tangent, "secant_1_s": at_work.secant[0], "harmonic_1_s": at_work.harmonic[0],
            "moving_1_s": at_work.moving[0], "per_input": found.per_input,
        }  # fmt: skip
        arrays |= {f"{name}/{key}": getattr(found, key) for key in ("speed", "secant", "harmonic", "moving")}
    return result, arrays


def systems(subject: Subject, name: str, point: tuple[Array, Array]) -> dict[str, Any]:
    """The linearisations of a model, by the names in :data:`POINTS`."""
    model, (x, h), u = subject.models[name], point, np.zeros(subject.models[name].n_u)
    return {
        "rest": linearize(model, x, u, h), "working": linearize_secant(model, x, u, subject.speed, h),
        "moving": linearize_at_speed(model, x[: model.n_x // 2], subject.speed, u),
        "driven": linearize_along(model, x, drive(subject, model, 30.0), h).mean(round(5.0 / model.dt)),
    }  # fmt: skip


def linear_part(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Modes, reduced systems, frequency and step responses of the linearisations."""
    control = control_toolbox()
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    half_x, half_u = (0.5 * (box[:, 1] - box[:, 0]) for box in (subject.x_range, subject.u_range))
    for name, model in subject.models.items():
        x, h = points[name]
        result[name] = {"x": x}
        for point, system in systems(subject, name, points[name]).items():
            found = system_structure(system)
            row: dict[str, Any] = found.to_dict()
            omega = np.geomspace(0.02, np.pi / model.dt, 400)
            curves = {"": system}
            if model.n_h:
                try:
                    small = physical_states(
                        model, x, np.zeros(model.n_u), h, x_scale=half_x, u_scale=half_u, system=system
                    )
                    row["reduced"] = {
                        "A": small.system.A, "B": small.system.B, "bound": small.bound, "hankel": small.hankel,
                    }  # fmt: skip
                    curves["_reduced"] = small.system
                except InputError as none:
                    row["reduced"] = {"reason": str(none)}
            for suffix, one in curves.items():
                response = frequency_response(one, omega)
                key = f"{name}/{point}{suffix}"
                arrays |= {
                    f"{key}/omega": omega, f"{key}/magnitude": response.magnitude, f"{key}/phase": response.phase
                }  # fmt: skip
            t = model.dt * np.arange(round(4.0 / model.dt) + 1)
            step = control.step_response(system, t)
            arrays |= {f"{name}/{point}/t": t, f"{name}/{point}/step": step.outputs}
            arrays[f"{name}/{point}/poles"] = np.array([m.pole for m in found.modes])
            if model.n_u == model.n_y:
                arrays[f"{name}/{point}/zeros"] = _zeros(system)
            result[name][point] = row
    return result, arrays


def _zeros(system: Any) -> NDArray[np.complex128]:
    """Zeros of a square system; those that rounding alone keeps from infinity are left out."""
    found = np.asarray(system.zeros(), dtype=np.complex128)
    return found[np.abs(found) < FARTHEST]


def drive(subject: Subject, model: HybridModel, seconds: float) -> Array:
    """A multisine ``(n, n_u)`` of working size around the middle of each input's range."""
    t = np.asarray(model.dt * np.arange(round(seconds / model.dt)), dtype=np.float64)
    sizes = [(LEVEL * 0.5 * (high - low), 0.5 * (low + high)) for low, high in pairs(subject.u_range)]
    return np.column_stack([multisine(t, size, 0.1, 1.5, offset=middle) for size, middle in sizes])
