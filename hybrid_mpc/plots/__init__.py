"""Figures of the main job: one module a domain, plain arrays in, matplotlib figures out. No torch in here.

``style`` (colours, names, saving), ``data``, ``training``, ``fit``, ``loops``, ``tasks``,
``animation``, ``monitor``, ``analysis``, ``search``.
"""

from hybrid_mpc.plots.style import COLOURS, NAMES, new_figure, save

__all__ = ["COLOURS", "NAMES", "new_figure", "save"]
