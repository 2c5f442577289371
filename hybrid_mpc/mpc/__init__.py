"""Model predictive control: the problem, the condensed real-time iteration, the safeguard."""

from hybrid_mpc.mpc.condensed import CondensedController, Prepared
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.safeguard import Decision, SafeController, Source
from hybrid_mpc.mpc.solution import Solution, Status

__all__ = [
    "OCP",
    "CondensedController",
    "Decision",
    "Prepared",
    "SafeController",
    "Solution",
    "Source",
    "Status",
]
