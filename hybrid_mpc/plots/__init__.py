"""Figures of the main job: one module a domain, plain arrays in, matplotlib figures out. No torch in here.

``data``, ``training``, ``fit``, ``loops``, ``tasks``, ``animation``, ``estimation``, ``monitor``, ``monitor_trace``,
``analysis``, ``analysis_loops``, ``analysis_models``, ``search``, ``studies``, ``machines``, ``reproduction``; and
``style``: colours, names, saving. What a figure of one's own in the same look needs stands here, and the figures that
other things than the job draw, too; those are imported when they are used.
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
    from hybrid_mpc.plots.analysis import bode, pole_map
    from hybrid_mpc.plots.analysis_loops import gain_schedules, nyquist, sensitivity_functions
    from hybrid_mpc.plots.analysis_models import (
        friction_damping,
        measured_bode,
        sensitivities,
        step_responses,
    )
    from hybrid_mpc.plots.animation import animate
    from hybrid_mpc.plots.data import coverage, recordings
    from hybrid_mpc.plots.estimation import innovations
    from hybrid_mpc.plots.fit import errors_bar, free_run, parity
    from hybrid_mpc.plots.loops import Motion, closed_loops, solve_times
    from hybrid_mpc.plots.monitor_trace import overview
    from hybrid_mpc.plots.scene import Scene
    from hybrid_mpc.plots.studies import differences, distributions, pareto
    from hybrid_mpc.plots.training import curves

__all__ = [
    "COLOURS", "NAMES", "axis_label", "colour", "line_style", "name_of", "new_figure", "save", "shared_legend",
    "title_axes",
    "bode", "pole_map",
    "gain_schedules", "nyquist", "sensitivity_functions",
    "friction_damping", "measured_bode", "sensitivities", "step_responses",
    "animate",
    "coverage", "recordings",
    "innovations",
    "errors_bar", "free_run", "parity",
    "Motion", "closed_loops", "solve_times",
    "overview",
    "Scene",
    "differences", "distributions", "pareto",
    "curves",
]  # fmt: skip
_MODULES = {
    "analysis": ("bode", "pole_map"),
    "analysis_loops": ("gain_schedules", "nyquist", "sensitivity_functions"),
    "analysis_models": ("friction_damping", "measured_bode", "sensitivities", "step_responses"),
    "animation": ("animate",),
    "data": ("coverage", "recordings"),
    "estimation": ("innovations",),
    "fit": ("errors_bar", "free_run", "parity"),
    "loops": ("Motion", "closed_loops", "solve_times"),
    "monitor_trace": ("overview",),
    "scene": ("Scene",),
    "studies": ("differences", "distributions", "pareto"),
    "training": ("curves",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc.plots' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.plots.{_HOME[name]}"), name)
