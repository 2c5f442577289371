"""From a torch step to programs: the bridge between the offline and the online half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np
import torch
from torch import Tensor, nn

import nn_export
from hybrid_mpc.artifact import INPUTS, OUTPUTS, PARAMETRIC, ModelInfo, build_model
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.networks import Network
from hybrid_mpc.identification.output_network import OutputModel
from hybrid_mpc.identification.sindy_step import SindyStep
from hybrid_mpc.identification.step import PriorStep, RecurrentStep
from hybrid_mpc.physics import Prior

Step: TypeAlias = RecurrentStep | PriorStep | SindyStep
"""What can be exported: every model as a step ``(x, h, u) -> (x_next, h_next)``."""


@dataclass(frozen=True)
class Parity:
    """Largest differences between the exported step and torch in float64, relative to the outputs' scale.

    Args:
        max_abs_error: Of the values.
        jacobian_max_abs_error: Of the Jacobians.
    """

    max_abs_error: float
    jacobian_max_abs_error: float


class _Method(nn.Module):
    """One method of a module as a module of its own, which is what gets traced."""

    def __init__(self, owner: nn.Module, method: str) -> None:
        super().__init__()
        self.owner, self.method = owner, method

    def forward(self, *args: Tensor) -> Tensor:
        result: Tensor = getattr(self.owner, self.method)(*args)
        return result


class _Parametric(nn.Module):
    """The prior's acceleration with its parameters as an input ``p`` ``(n_p,)``, in the order of its specification."""

    def __init__(self, prior: Prior) -> None:
        super().__init__()
        self.prior, self.names = prior, list(prior.values)

    def forward(self, x: Tensor, u: Tensor, p: Tensor) -> Tensor:
        values = {name: p[i] for i, name in enumerate(self.names)}
        xdot: Tensor = torch.func.functional_call(self.prior, values, (x, u))
        return xdot[..., self.prior.n_q : 2 * self.prior.n_q]


def trace_parametric(prior: Prior) -> nn_export.Program:
    """Program ``(x, u, p) -> acceleration (n_q,)`` of a prior: how it depends on its parameters.

    Args:
        prior: The prior; the order of ``p`` is that of ``prior.values``.
    """
    sizes = len(prior.states), len(prior.inputs), len(prior.parameters_spec)
    examples = [torch.zeros(n, dtype=torch.float64) for n in sizes[:2]]
    examples.append(torch.tensor(list(prior.values.values()), dtype=torch.float64))
    return nn_export.trace(
        _Parametric(prior), tuple(examples), input_names=["x", "u", "p"], output_names=["acceleration"]
    )


def trace_model(step: Step, output: OutputModel | None = None) -> dict[str, nn_export.Program]:
    """Programs ``step, xdot, output, energy_balance`` of one model, and ``parametric`` of its prior.

    Args:
        step: The model.
        output: Its output, with a network G in it. Default: the prior's output.
    """
    prior = step.prior
    modules: dict[str, nn.Module] = {
        "step": step,
        "xdot": _Method(step, "xdot"),
        "output": _Method(prior, "output") if output is None else output,
        "energy_balance": _Method(prior, "energy_balance"),
    }
    examples = _examples(step)
    programs = {
        name: nn_export.trace(
            module,
            tuple(examples[i] for i in INPUTS[name]),
            input_names=list(INPUTS[name]),
            output_names=list(OUTPUTS[name]),
        )
        for name, module in modules.items()
    }
    return {**programs, PARAMETRIC: trace_parametric(prior)} if prior.parameters_spec else programs


def model_info(prior: Prior, dt: float) -> ModelInfo:
    """Period and signals of the models built on ``prior``."""
    return ModelInfo(dt, prior.states, prior.inputs, prior.outputs, prior.values)


def check_parity(
    step: Step,
    programs: dict[str, nn_export.Program],
    info: ModelInfo,
    trajectories: Sequence[Trajectory],
    *,
    seed: int,
) -> Parity:
    """Measure the exported step against torch on random and extreme inputs of the trajectories' magnitude."""
    model = build_model("m", {f"m/{name}": program for name, program in programs.items()}, info)
    examples = _examples(step)
    x, u = (np.concatenate([getattr(t, name) for t in trajectories]) for name in ("x", "u"))
    scale = (np.abs(x).max(0), np.ones(examples["h"].numel()), np.abs(u).max(0))
    report = nn_export.parity(
        step, model.step, tuple(examples[i] for i in INPUTS["step"]), seed=seed, scale=scale
    )
    return Parity(report.value_rel, report.jacobian_rel)


def _examples(step: Step) -> dict[str, Tensor]:
    n_h = cast(Network, step.network).n_h if isinstance(step, RecurrentStep) else 0
    n_x, n_u = len(step.prior.states), len(step.prior.inputs)
    shapes = {"x": n_x, "h": n_h, "u": n_u, "xdot": n_x}
    return {name: torch.zeros(n, dtype=torch.float64) for name, n in shapes.items()}
