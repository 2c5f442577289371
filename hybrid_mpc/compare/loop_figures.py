"""Figures of closed loops, from the arrays of their rows, the control problem and the machine's signals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.plots.loops import Motion, closed_loops

Arrays = Mapping[str, NDArray[np.float64]]


def curves_of(machine: Prior | HybridModel) -> list[tuple[int, Signal]]:
    """States that an animation shows as curves, with their indices: those that are outputs, else all.

    Example:
        >>> from scenarios.golf_robot.prior import GolfRobotPrior
        >>> [(i, s.label) for i, s in curves_of(GolfRobotPrior())]
        [(0, 'phi [rad]')]
    """
    measured = {signal.name for signal in machine.outputs}
    every = list(enumerate(machine.states))
    return [(i, signal) for i, signal in every if signal.name in measured] or every


def loop_figure(
    title: str, problem: OCP, machine: Prior | HybridModel, loops: Mapping[str, Arrays]
) -> Figure:
    """Figure of one task's loops by controller: outputs, states and inputs with their references and bounds.

    Each loop has the arrays in :data:`~hybrid_mpc.compare.loops.DRAWN`.

    Example: ``loop_figure(task.title, kit.problem(task.name), kit.models["prior"], {"hybrid": row.arrays})``
    """
    some = next(iter(loops.values()))
    references: dict[str, Any] = {"reference": some["reference"]}
    if problem.n_y:  # then the references of states are the computed steady states
        controlled = np.where(problem.q_y > 0, some["y_ref"], np.nan)
        references = {"reference": None, "output_reference": controlled}
    return closed_loops(
        title, some["t"], results={name: Motion(a["t"], a["x"], a["u"], a["y"]) for name, a in loops.items()},
        states=machine.states, inputs=machine.inputs, limits=(problem.u_min, problem.u_max), outputs=machine.outputs,
        state_limits=problem.state_range, output_limits=problem.output_range(len(machine.outputs)),
        disturbances=machine.disturbances, w=some["w"], **references,
    )  # fmt: skip
