"""Parts of a study: gain schedules and control loops."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybrid_mpc.analysis.gains import mpc_gain, steady_filter
from hybrid_mpc.analysis.loop import Loop, mpc_loop
from hybrid_mpc.analysis.properties import frequency_response
from hybrid_mpc.analysis.schedule import gain_schedule, holding_input
from hybrid_mpc.analysis.study_models import POINTS, Array, Part, systems
from hybrid_mpc.analysis.subject import Subject
from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc import CondensedController

GRID = 21
"""Positions of the gain schedule."""


def schedule_part(subject: Subject) -> Part:
    """LQR gains over the positions of the working range."""
    ocp = subject.ocp
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    if ocp is None:
        raise InputError("a gain schedule needs the weights of the scenario's control problem")
    for name, model in sorted(subject.models.items(), key=lambda m: m[1].n_h):
        if model.n_x != 2 or model.n_u != 1:
            raise InputError("the schedule is made over one position with one input")
        points, lost = _held(model, np.linspace(subject.x_range[0, 0], subject.x_range[0, 1], GRID))
        weights = ocp.q * model.dt, (ocp.r + ocp.r_delta) * model.dt
        result[name] = {"positions_lost": lost}
        for point, speed in (("rest", None), ("working", subject.speed)):
            found = gain_schedule(model, points, *weights, speed=speed)
            key = f"{name}/{point}"
            arrays |= {f"{key}/{k}": getattr(found, k) for k in ("x", "u", "gain", "radius")}
            result[name][point] = {
                "gain_lowest": found.gain[:, 0, :2].min(axis=0), "gain_highest": found.gain[:, 0, :2].max(axis=0),
                "radius": found.radius.max(), "holding_input": [float(found.u.min()), float(found.u.max())],
            }  # fmt: skip
    return result, arrays


def _held(model: HybridModel, positions: Array) -> tuple[list[tuple[Array, Array]], list[float]]:
    """Points of rest at positions, outwards from zero, each begun at its neighbour's input; and those without one."""
    found: dict[float, Array] = {}
    lost: list[float] = []
    for q in sorted(positions.tolist(), key=abs):
        near = min(found, key=lambda known: abs(known - q), default=None)
        try:
            found[q] = holding_input(model, [q], u_guess=None if near is None else found[near])
        except InputError:
            lost.append(q)
    if not found:
        raise InputError(
            f"model {model.name}: no position of the range can be held by an input that was found"
        )
    return [(np.array([q, 0.0]), found[q]) for q in sorted(found)], sorted(lost)


def loops_part(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Each model's controller and filter around itself, and the prior's around the hybrid."""
    if subject.ocp is None or not subject.filters:
        raise InputError("loops need the scenario's control problem and the filters' noise")
    pairs = [(n, n) for n in subject.models]
    if {"prior", "hybrid"} <= set(subject.models):
        pairs.append(("prior", "hybrid"))
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    controllers = {n: CondensedController(m, subject.ocp) for n, m in subject.models.items()}
    made = {n: systems(subject, n, points[n]) for n in subject.models}
    for (name, mode), ekf in subject.filters.items():
        model, (x, h), zero = subject.models[name], points[name], np.zeros(subject.models[name].n_u)
        for point in POINTS:
            gain = mpc_gain(controllers[name], x, zero, h, system=made[name][point])
            steady = steady_filter(ekf, x, zero, h, system=made[name][point])
            for around in (plant for own, plant in pairs if own == name):
                loop = mpc_loop(gain, steady, made[around][point])
                key = f"{name} on {around}"
                row, curves = _judged(loop, model.dt)
                row["gain"] = gain.by_state[:, : model.n_x]
                result.setdefault(key, {}).setdefault(point, {})[mode] = row
                arrays |= {f"{key}/{point}/{mode}/{k}": v for k, v in curves.items()}
    return result, arrays


def _judged(loop: Loop, dt: float) -> Part:
    row: dict[str, Any] = {"stable": loop.stable, "radius": abs(loop.poles[0])}
    omega = np.geomspace(0.05, np.pi / dt, 500)
    response = frequency_response(loop.broken(), omega)
    curves: dict[str, Any] = {
        "omega": omega, "L": response.magnitude[0, 0] * np.exp(1j * response.phase[0, 0])
    }  # fmt: skip
    if loop.stable:
        row["margins"] = dict(vars(loop.margins()))
        functions = loop.sensitivity(omega)
        curves |= {k: functions[k][0, 0] for k in ("S", "T", "KS", "GS")}
        row["peak_S"], row["peak_T"] = (float(np.abs(functions[k][0, 0]).max()) for k in ("S", "T"))
    return row, curves
