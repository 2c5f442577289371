"""hybrid-mpc: measurements and an ODE in, a guarded real-time nonlinear MPC out.

``import hybrid_mpc as hm``: what a machine is written with (``hm.Prior``, ``hm.Scenario``, ``hm.OCP`` ...), the job
(``hm.run``), and what its result is used with (``hm.load``, ``hm.Loop``, ``hm.simulate``, ``hm.Runner`` ...). Each name
is imported when it is used: torch by who writes a prior or trains, casadi by who states a problem or runs a loop.
"""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from hybrid_mpc.data_spec import DataSpec, Window
from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import Budget, Scenario, Task
from hybrid_mpc.signals import Parameter, Signal

if TYPE_CHECKING:
    from hybrid_mpc.artifact import Kit, load
    from hybrid_mpc.assembly import (
        make_adaptive_guard,
        make_controller,
        make_estimator,
        make_monitor,
        make_ocp,
        make_resting_guard,
        tuned_noise,
        working_point,
    )
    from hybrid_mpc.closed_loop.faults import Fault
    from hybrid_mpc.closed_loop.guard import Guard
    from hybrid_mpc.closed_loop.loop import Loop
    from hybrid_mpc.closed_loop.runner import Runner
    from hybrid_mpc.closed_loop.simulate import simulate
    from hybrid_mpc.job.contenders import find_noise
    from hybrid_mpc.job.loops import Bench, LoopRow, LoopSpec
    from hybrid_mpc.mpc.ocp import OCP
    from hybrid_mpc.physics import Prior
    from hybrid_mpc.pipeline.run import run
    from hybrid_mpc.pipeline.settings import RunSettings

try:
    __version__ = version("hybrid-mpc")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "OCP",
    "Bench",
    "Budget",
    "DataSpec",
    "Fault",
    "Guard",
    "InputError",
    "Kit",
    "Loop",
    "LoopRow",
    "LoopSpec",
    "Parameter",
    "Prior",
    "RunSettings",
    "Runner",
    "Scenario",
    "Signal",
    "Task",
    "Window",
    "__version__",
    "find_noise",
    "load",
    "make_adaptive_guard",
    "make_controller",
    "make_estimator",
    "make_monitor",
    "make_ocp",
    "make_resting_guard",
    "run",
    "simulate",
    "tuned_noise",
    "working_point",
]
_HOME = {
    "Bench": "job.loops",
    "Fault": "closed_loop.faults",
    "Guard": "closed_loop.guard",
    "Kit": "artifact",
    "Loop": "closed_loop.loop",
    "LoopRow": "job.loops",
    "LoopSpec": "job.loops",
    "OCP": "mpc.ocp",
    "Prior": "physics",
    "RunSettings": "pipeline.settings",
    "Runner": "closed_loop.runner",
    "find_noise": "job.contenders",
    "load": "artifact",
    "make_adaptive_guard": "assembly",
    "make_controller": "assembly",
    "make_estimator": "assembly",
    "make_monitor": "assembly",
    "make_ocp": "assembly",
    "make_resting_guard": "assembly",
    "run": "pipeline.run",
    "simulate": "closed_loop.simulate",
    "tuned_noise": "assembly",
    "working_point": "assembly",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.{_HOME[name]}"), name)
