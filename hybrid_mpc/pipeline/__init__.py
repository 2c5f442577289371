"""The main job as a call, and what its closed loops are made of: filters, controllers, monitor of a scenario.

``run_job`` does what ``hybrid-mpc run`` does. The others need no torch: they make, from an artifact's models and the
scenario's control problem, the same loops that the main job judges.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hybrid_mpc.pipeline.settings import RunSettings

if TYPE_CHECKING:
    from hybrid_mpc.pipeline.control_noise import find_noise
    from hybrid_mpc.pipeline.guards import make_adaptive_guard
    from hybrid_mpc.pipeline.loops import (
        make_controller,
        make_estimator,
        make_monitor,
        make_ocp,
        tuned_noise,
        working_point,
    )
    from hybrid_mpc.pipeline.run import run as run_job

__all__ = [
    "RunSettings",
    "find_noise",
    "make_adaptive_guard",
    "make_controller",
    "make_estimator",
    "make_monitor",
    "make_ocp",
    "run_job",
    "tuned_noise",
    "working_point",
]

_HOMES = {
    "run_job": ("run", "run"),
    "find_noise": ("control_noise", "find_noise"),
    "make_adaptive_guard": ("guards", "make_adaptive_guard"),
}


def __getattr__(name: str) -> Any:
    # loaded when asked for: stages bring torch along, loops CasADi, and the command line starts without either
    if name not in __all__:
        raise AttributeError(f"module 'hybrid_mpc.pipeline' has no attribute {name!r}")
    module, attribute = _HOMES.get(name, ("loops", name))
    return getattr(import_module(f"hybrid_mpc.pipeline.{module}"), attribute)
