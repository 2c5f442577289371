"""From a torch step to programs: the bridge between the offline and the online half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

import nn_export
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.simulation import stepped
from hybrid_mpc.identify.step import PriorStep, Step, required_substeps
from hybrid_mpc.kit.artifact import INPUTS, OUTPUTS, BalanceInfo, ModelInfo, build_model
from hybrid_mpc.machine.prior import POINT, Prior
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
    programs, examples = prior_programs(step.prior, step.dt), _examples(step)
    if isinstance(step, PriorStep):
        return programs
    for name, method in (("step", "forward"), ("xdot", "xdot")):
        programs[name] = nn_export.trace(
            _Model(step, method), tuple(examples[i] for i in INPUTS[name]), input_names=[*INPUTS[name]],
            output_names=[*OUTPUTS[name]],
        )  # fmt: skip
    return programs


def prior_programs(prior: Prior, dt: float) -> dict[str, nn_export.Program]:
    """Programs of the prior alone: ``step`` and ``xdot`` with no hidden state, ``output``, and its balances."""
    equations = prior.equations
    names = dict(zip(POINT, (prior.states, prior.inputs, prior.disturbances, prior.parameters), strict=True))
    x, u, w, p = (ca.SX.sym(key, len(signals)) for key, signals in names.items())
    h = ca.SX.sym("h", 0)
    rates = equations.xdot(x, u, w, p)
    x_next = stepped(equations.xdot, x, u, w, p, dt, required_substeps(prior, dt))
    given, outputs = (
        {"step": [x, h, u, w, p], "xdot": [x, h, u, w, p]},
        {"step": [x_next, h], "xdot": [rates]},
    )
    programs = {
        name: nn_export.program_of(
            ca.Function(
                name, given[name], [ca.densify(v) for v in outputs[name]], [*INPUTS[name]], [*OUTPUTS[name]]
            )
        )
        for name in given
    }
    programs["output"] = nn_export.program_of(equations.output)
    for info, balance in zip(balances_of(prior), equations.balances, strict=True):
        programs[info.program] = nn_export.program_of(balance.residual)
    return programs


def balances_of(prior: Prior) -> tuple[BalanceInfo, ...]:
    """What an artifact says of a prior's balances."""
    return tuple(BalanceInfo(b.name, b.unit, b.rate_unit) for b in prior.equations.balances)


def model_info(prior: Prior, dt: float, covariance: Sequence[Sequence[float]] = ()) -> ModelInfo:
    """Period, signals, parameters and balances of the models built on ``prior``.

    Args:
        prior: The fitted prior.
        dt: Model period [s].
        covariance: Rows of the covariance of its parameters' values. Default: unknown.
    """
    values, point = prior.values, prior.operating_point
    return ModelInfo(
        dt, prior.states, prior.inputs, prior.outputs,
        tuple(replace(spec, value=values[spec.name]) for spec in prior.parameters),
        covariance=tuple(tuple(row) for row in covariance), balances=balances_of(prior),
        disturbances=prior.disturbances, nominal_w=() if point is None else point.w,
        nominal_x=() if point is None else point.x, nominal_u=() if point is None else point.u,
    )  # fmt: skip


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
