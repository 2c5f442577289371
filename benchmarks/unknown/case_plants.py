"""The plants of the simulated cases: the equations of ``make.py``, with parameters that may be moved."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from unknown.common import Array
from unknown.plants import Plant, chosen, first

ROTARY = ("JR", "MP", "LR", "LP", "KM", "RM", "DR", "DP", "STATIC")
TANK = ("Q", "DH", "UA", "LAG", "K0")
ARM = ("G", "K", "D", "T", "OFF", "STATIC")
"""Constants of ``make.py`` that are parameters."""


def case_plants(folder: Path) -> dict[str, Plant]:
    """The plants of the cases in a folder, by name."""
    found = {}
    for name, make in {"rotary_pendulum": rotary, "stirred_tank": tank, "propeller_arm": arm}.items():
        program = folder / name / "make.py"
        if program.is_file():
            found[name] = make(runpy.run_path(str(program)))
    return found


def _with(own: Mapping[str, Any], p: Any, names: tuple[str, ...]) -> Callable[..., Array]:
    """The rates of a program with other values of its constants."""
    rates = own["rates"]
    rates.__globals__.update({name: getattr(p, name) for name in names})
    return rates  # type: ignore[no-any-return]


def rotary(own: Mapping[str, Any]) -> Plant:
    """The pendulum; its rod's inertia follows its mass and length."""

    def rates(x: Array, u: Array, w: Array, p: Any) -> Array:
        made = _with(own, p, ROTARY)
        made.__globals__["JP"] = p.MP * p.LP**2 / 12
        return made(x, u[0])

    step = float(own["STEP"])
    return Plant(
        rates, first(2), {name: own[name] for name in ROTARY}, (0.0,) * 4, (0.0, 0.0), (step, step), 1e-3
    )


def tank(own: Mapping[str, Any]) -> Plant:
    """The tank, before its heat transfer falls."""

    def rates(x: Array, u: Array, w: Array, p: Any) -> Array:
        return _with(own, p, TANK)(x, u[0], w[0], 0.0) / 60.0

    return Plant(
        rates, chosen(1), {name: own[name] for name in TANK}, (0.56, 316.0, 290.0), (0.3,), (0.0,), 2.0
    )


def arm(own: Mapping[str, Any]) -> Plant:
    """The arm, its static friction as steep damping."""

    def rates(x: Array, u: Array, w: Array, p: Any) -> Array:
        q, v, m = x
        push = -p.G * np.sin(np.radians(q - p.OFF)) + p.K * max(m, 0.0) ** 2 - p.D * np.radians(v)
        return np.array([v, np.degrees(push - p.STATIC * np.tanh(v / 0.5)), (u[0] - m) / p.T])

    return Plant(
        rates, first(1), {name: own[name] for name in ARM}, (43.0, 0.0, 38.0), (0.02,), (0.01,), 1e-3
    )
