"""Model predictive control: the problem, the condensed real-time iteration, the safeguard."""

from hybrid_mpc.mpc.condensed import CondensedController, Prepared
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.problem import Controller, Problem
from hybrid_mpc.mpc.safeguard import Decision, SafeController, Source
from hybrid_mpc.mpc.soft import SoftBound
from hybrid_mpc.mpc.solution import Solution, Status

__all__ = [
    "OCP",
    "CondensedController",
    "Controller",
    "Decision",
    "Prepared",
    "Problem",
    "SafeController",
    "SoftBound",
    "Solution",
    "Source",
    "Status",
]
