"""From a torch step to programs: the bridge between the offline and the online half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

import nn_export
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.identify.step import PriorStep, Step
from hybrid_mpc.kit.artifact import INPUTS, OUTPUTS, ModelInfo, build_model
from hybrid_mpc.model.model import STEP_INPUTS, STEP_OUTPUTS, step_symbols


@dataclass(frozen=True)
class Parity:
    """Largest differences between the exported step and torch in float64, relative to the outputs' scale."""

    max_abs_error: float
    jacobian_max_abs_error: float


class _Model(nn.Module):
    """``step`` or ``xdot`` of a model, which is what gets traced."""

    def __init__(self, step: Step, method: str) -> None:
        super().__init__()
        self.step, self.method = step, method

    def forward(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Any:
        return getattr(self.step, self.method)(x, h, u, w, p)


def trace_model(step: Step) -> dict[str, nn_export.Program]:
    """Programs ``step, xdot, output`` of one model, and of its prior's balances.

    The prior changes with ``p``; what a network adds does not: it was trained next to the fitted prior. Parameters that
    were trained along with a network move by as much as ``p`` differs from the fitted ones.

    Args:
        step: The model.
    """
    substeps = step.substeps if isinstance(step, PriorStep) else 0
    programs, examples = prior_programs(step.prior, step.dt, substeps), _examples(step)
    if isinstance(step, PriorStep):
        return programs
    for name, method in (("step", "forward"), ("xdot", "xdot")):
        programs[name] = nn_export.trace(
            _Model(step, method), tuple(examples[i] for i in INPUTS[name]), input_names=[*INPUTS[name]],
            output_names=[*OUTPUTS[name]],
        )  # fmt: skip
    return programs


def check_parity(
    step: Step,
    programs: dict[str, nn_export.Program],
    info: ModelInfo,
    trajectories: Sequence[Trajectory],
    *,
    seed: int,
) -> Parity:
    """Measure the exported step against torch on random and extreme inputs of the trajectories' magnitude.

    The step's parameters are the fitted ones.
    """
    model = build_model("m", {f"m/{name}": program for name, program in programs.items()}, info)
    point = step_symbols(model)
    nominal = list(model.step(*point[:4], model.p))
    examples = _examples(step)
    x, u, w = (np.concatenate([getattr(t, name) for t in trajectories]) for name in ("x", "u", "w"))
    scale = (np.abs(x).max(0), np.ones(examples["h"].numel()), np.abs(u).max(0), np.abs(w).max(0))
    function = ca.Function("step", point[:4], nominal, [*STEP_INPUTS[:4]], [*STEP_OUTPUTS])
    report = nn_export.parity(
        step, function, tuple(examples[i] for i in STEP_INPUTS[:4]), seed=seed, scale=scale
    )
    return Parity(report.value_rel, report.jacobian_rel)


def _examples(step: Step) -> dict[str, Tensor]:
    prior = step.prior
    shapes = {"x": len(prior.states), "h": step.n_h, "u": len(prior.inputs), "w": len(prior.disturbances)}
    zeros = {name: torch.zeros(n, dtype=torch.float64) for name, n in shapes.items()}
    return {**zeros, "p": torch.tensor(prior.p)}
