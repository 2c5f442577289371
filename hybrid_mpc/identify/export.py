"""Export of a torch step as programs for the deployed model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

import nn_export
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.identify.step import PriorStep, Step
from hybrid_mpc.kit.artifact import INPUTS, OUTPUTS, build_model
from hybrid_mpc.kit.parts import ModelInfo
from hybrid_mpc.model.model import STEP_INPUTS, STEP_OUTPUTS, step_symbols


@dataclass(frozen=True)
class Parity:
    """Largest differences between the exported step and torch in float64, relative to the outputs' scale."""

    max_abs_error: float
    jacobian_max_abs_error: float


class _Model(nn.Module):
    """``step`` or ``xdot`` of a model, for tracing."""

    def __init__(self, step: Step, method: str) -> None:
        super().__init__()
        self.step, self.method = step, method

    def forward(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Any:
        return getattr(self.step, self.method)(x, h, u, w, p)


def trace_model(
    step: Step, like: Mapping[str, nn_export.Program] | None = None
) -> dict[str, nn_export.Program]:
    """Trace the programs ``step, xdot, output`` of one model, and those of its prior's balances.

    The prior depends on ``p``; the network's correction does not, since it was trained with the fitted prior.
    Parameters that were trained with a network change by the difference of ``p`` from the fitted parameters.

    Args:
        step: The model.
        like: Programs of another single network of the same training; only their weights are replaced, which is a
            hundred times faster. Default: the model is traced.
    """
    substeps = step.substeps if isinstance(step, PriorStep) else 0
    programs, examples = prior_programs(step.prior, step.dt, substeps), _examples(step)
    if isinstance(step, PriorStep):
        return programs
    for name, method in (("step", "forward"), ("xdot", "xdot")):
        if like is not None:
            programs[name] = _with_weights(like[name], _Model(step, method))
            continue
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
    samples: int = 100,
) -> Parity:
    """Compare the exported step with torch, on random and extreme inputs of the trajectories' magnitude.

    The parameters are the fitted ones.
    """
    model = build_model("m", {f"m/{name}": program for name, program in programs.items()}, info)
    point = step_symbols(model)
    nominal = list(model.step(*point[:4], model.p))
    examples = _examples(step)
    x, u, w = (np.concatenate([getattr(t, name) for t in trajectories]) for name in ("x", "u", "w"))
    scale = (np.abs(x).max(0), np.ones(examples["h"].numel()), np.abs(u).max(0), np.abs(w).max(0))
    function = ca.Function("step", point[:4], nominal, [*STEP_INPUTS[:4]], [*STEP_OUTPUTS])
    report = nn_export.parity(
        step, function, tuple(examples[i] for i in STEP_INPUTS[:4]), n=samples, seed=seed, scale=scale,
        hessians=False,
    )  # fmt: skip
    return Parity(report.value_rel, report.jacobian_rel)


def _with_weights(program: nn_export.Program, module: nn.Module) -> nn_export.Program:
    """Replace the weights of a program by those of another module of the same structure."""
    own = {**dict(module.named_parameters()), **dict(module.named_buffers())}
    held = {n: own[n].detach().numpy().copy() if n in own else w for n, w in program.weights.items()}
    strange = [name for name, value in held.items() if value.shape != program.weights[name].shape]
    if strange:
        raise InputError(
            f"{strange[0]}: its shape differs from that in the given program. Trace the model without that program"
            " [HM-IDENTIFY-016]"
        )
    return replace(program, weights=held)


def _examples(step: Step) -> dict[str, Tensor]:
    prior = step.prior
    shapes = {"x": len(prior.states), "h": step.n_h, "u": len(prior.inputs), "w": len(prior.disturbances)}
    zeros = {name: torch.zeros(n, dtype=torch.float64) for name, n in shapes.items()}
    return {**zeros, "p": torch.tensor(prior.p)}
