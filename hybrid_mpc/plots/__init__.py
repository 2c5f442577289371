"""Figures of the main job: one module a domain, plain arrays in, matplotlib figures out. No torch in here.

``data``, ``training``, ``fit``, ``loops``, ``tasks``, ``animation``, ``estimation``, ``monitor``, ``monitor_trace``,
``analysis``, ``analysis_loops``, ``analysis_models``, ``search``, ``studies``, ``machines``, ``reproduction``; and
``style``: colours, names, saving. What a figure of one's own in the same look needs stands here.
"""

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

__all__ = [
    "COLOURS",
    "NAMES",
    "axis_label",
    "colour",
    "line_style",
    "name_of",
    "new_figure",
    "save",
    "shared_legend",
    "title_axes",
]
