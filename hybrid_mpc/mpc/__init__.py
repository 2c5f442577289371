"""Model predictive control: the problem, its solvers behind one interface, the safeguard.

Solvers: :class:`CondensedController` (real-time iteration), :class:`SQPController` (to convergence, with second
derivatives), :class:`IpoptController` (exact reference), :class:`BestOf` (any of these from several starts).

Nothing is imported before it is used: a problem is stated without scipy and without any solver.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid_mpc.mpc.best_of import BestOf
    from hybrid_mpc.mpc.condensed import CondensedController
    from hybrid_mpc.mpc.condensing import Prepared
    from hybrid_mpc.mpc.economic import output_cost
    from hybrid_mpc.mpc.limits import Limits
    from hybrid_mpc.mpc.nlp import IpoptController
    from hybrid_mpc.mpc.ocp import OCP
    from hybrid_mpc.mpc.problem import Controller, Problem
    from hybrid_mpc.mpc.safeguard import Decision, SafeController, Source
    from hybrid_mpc.mpc.soft import SoftBound
    from hybrid_mpc.mpc.solution import Solution, Status
    from hybrid_mpc.mpc.sqp import SQPController

__all__ = [
    "OCP",
    "BestOf",
    "CondensedController",
    "Controller",
    "Decision",
    "IpoptController",
    "Limits",
    "Prepared",
    "Problem",
    "SQPController",
    "SafeController",
    "SoftBound",
    "Solution",
    "Source",
    "Status",
    "output_cost",
]
_MODULES = {
    "best_of": ("BestOf",),
    "condensed": ("CondensedController",),
    "condensing": ("Prepared",),
    "economic": ("output_cost",),
    "limits": ("Limits",),
    "nlp": ("IpoptController",),
    "ocp": ("OCP",),
    "problem": ("Controller", "Problem"),
    "safeguard": ("Decision", "SafeController", "Source"),
    "soft": ("SoftBound",),
    "solution": ("Solution", "Status"),
    "sqp": ("SQPController",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc.mpc' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.mpc.{_HOME[name]}"), name)
