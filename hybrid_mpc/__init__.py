"""hybrid-mpc: measurements and an ODE in, a guarded real-time nonlinear MPC out.

What a user's own machine is written with stands here; everything else is imported from its room.
"""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from hybrid_mpc.data_spec import DataSpec, Window
from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import Budget, Scenario, Task
from hybrid_mpc.signals import Parameter, Signal

if TYPE_CHECKING:
    from hybrid_mpc.mpc.ocp import OCP
    from hybrid_mpc.physics import Prior

try:
    __version__ = version("hybrid-mpc")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "OCP",
    "Budget",
    "DataSpec",
    "InputError",
    "Parameter",
    "Prior",
    "Scenario",
    "Signal",
    "Task",
    "Window",
    "__version__",
]


def __getattr__(name: str) -> Any:
    if name == "Prior":  # torch is loaded by whoever writes a prior, and by nobody else
        from hybrid_mpc.physics import Prior

        return Prior
    if name == "OCP":  # and casadi by whoever states a problem
        from hybrid_mpc.mpc.ocp import OCP

        return OCP
    raise AttributeError(f"module 'hybrid_mpc' has no attribute {name!r}")
