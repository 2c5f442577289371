"""Figures: functions that take plain arrays and return matplotlib figures. This package never imports torch.

Each domain has a module: ``data``, ``fit``, ``explain``, ``loops``, ``animation``, ``estimation``, ``monitor``,
``analysis``, ``tune`` and ``studies``. ``style`` holds the shared parts: colours, names, panels, legends and saving.
A module is imported when one of its figures is used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from hybrid_mpc.plots.style import (
    COLOURS,
    NAMES,
    axis_label,
    colour,
    line_style,
    name_of,
    new_figure,
    save,
    shared_legend,
    title_axes,
)

if TYPE_CHECKING:
    from hybrid_mpc.plots.analysis import (
        bode,
        friction_damping,
        gain_schedules,
        measured_bode,
        nyquist,
        pole_map,
        sensitivities,
        sensitivity_functions,
        step_responses,
    )
    from hybrid_mpc.plots.animation import Scene, animate
    from hybrid_mpc.plots.data import coverage, recordings
    from hybrid_mpc.plots.estimation import innovations
    from hybrid_mpc.plots.fit import BalanceRun, curves, errors_bar, free_run, parity, prediction
    from hybrid_mpc.plots.loops import Motion, closed_loops, solve_times
    from hybrid_mpc.plots.monitor import channels
    from hybrid_mpc.plots.studies import differences, distributions, pareto

__all__ = [
    "COLOURS", "NAMES", "axis_label", "colour", "line_style", "name_of", "new_figure", "save", "shared_legend",
    "title_axes",
    "bode", "pole_map",
    "gain_schedules", "nyquist", "sensitivity_functions",
    "friction_damping", "measured_bode", "sensitivities", "step_responses",
    "animate",
    "coverage", "recordings",
    "innovations",
    "BalanceRun", "errors_bar", "free_run", "parity", "prediction",
    "Motion", "closed_loops", "solve_times",
    "channels",
    "Scene",
    "differences", "distributions", "pareto",
    "curves",
]  # fmt: skip
_MODULES = {
    "analysis": (
        "bode", "friction_damping", "gain_schedules", "measured_bode", "nyquist", "pole_map", "sensitivities",
        "sensitivity_functions", "step_responses",
    ),
    "animation": ("Scene", "animate"),
    "data": ("coverage", "recordings"),
    "estimation": ("innovations",),
    "fit": ("BalanceRun", "curves", "errors_bar", "free_run", "parity", "prediction"),
    "loops": ("Motion", "closed_loops", "solve_times"),
    "monitor": ("channels",),
    "studies": ("differences", "distributions", "pareto"),
}  # fmt: skip
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc.plots' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.plots.{_HOME[name]}"), name)
