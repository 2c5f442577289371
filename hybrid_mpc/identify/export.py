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
from hybrid_mpc.identify.step import RecurrentStep, Step
from hybrid_mpc.kit.artifact import INPUTS, OUTPUTS, BalanceInfo, ModelInfo, build_model
from hybrid_mpc.machine.torch_prior import Prior
from hybrid_mpc.model.model import STEP_INPUTS, STEP_OUTPUTS, step_symbols

ENERGY = BalanceInfo("energy", "J", "W")
"""The balance that every prior states."""


@dataclass(frozen=True)
class Parity:
    """Largest differences between the exported step and torch in float64, relative to the outputs' scale."""

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


class _WithParameters(nn.Module):
    """A function of a model with the prior's parameters as its last input ``p``, in the order of its specification.

    The prior changes with ``p``; what a network adds does not: it was trained next to the fitted prior. Parameters
    that were trained along with a network move by as much as ``p`` differs from the fitted ones.
    """

    def __init__(self, prior: Prior, dynamics: nn.Module | None = None) -> None:
        super().__init__()
        self.prior = prior
        self.fitted = prior.values
        self.trained = dynamics.values if isinstance(dynamics, Prior) else None

    def at(self, part: nn.Module, within: str, p: Tensor, *args: Tensor) -> Any:
        """``part(*args)`` with other values of the parameters that it holds under the names ``within``."""
        values = {}
        for i, (name, fitted) in enumerate(self.fitted.items()):
            values[f"{within}{name}"] = p[i] if self.trained is None else self.trained[name] + (p[i] - fitted)
        return torch.func.functional_call(part, values, args)


class _OfStep(_WithParameters):
    """``step`` or ``xdot`` of a model."""

    def __init__(self, step: Step, whole: str, after_correction: str) -> None:
        """``whole`` names the method of a step without a network, the other the one that takes its correction."""
        super().__init__(step.prior, getattr(step, "dynamics", None))
        self.step = step
        self.within = "owner.prior." if self.trained is None else "owner.dynamics."
        self.part = _Method(step, after_correction if isinstance(step, RecurrentStep) else whole)

    def forward(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        if isinstance(self.step, RecurrentStep):
            correction, h_next = self.step.correction(x, h, u)
            return self.at(self.part, self.within, p, x, u, correction), h_next
        found = self.at(self.part, self.within, p, x, h, u)
        return found if isinstance(found, tuple) else (found, h)


class _Xdot(_OfStep):
    """``xdot`` alone."""

    def forward(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:  # type: ignore[override]
        return super().forward(x, h, u, w, p)[0]


class OfPrior(_WithParameters):
    """``output`` or ``energy_balance`` of a prior; its last two inputs are ``w`` and ``p``."""

    def __init__(self, prior: Prior, method: str) -> None:
        super().__init__(prior)
        self.part = _Method(prior, method)

    def forward(self, *args: Tensor) -> Tensor:
        """The method's result at the signals, ``w`` and ``p``."""
        *signals, _, p = args
        found: Tensor = self.at(self.part, "owner.", p, *signals)
        return found


def trace_model(step: Step) -> dict[str, nn_export.Program]:
    """Programs ``step, xdot, output`` of one model, and of its prior's balances.

    Args:
        step: The model.
    """
    modules: dict[str, nn.Module] = {
        "step": _OfStep(step, "forward", "integrate"),
        "xdot": _Xdot(step, "xdot", "derivative"),
        "output": OfPrior(step.prior, "output"),
        ENERGY.program: OfPrior(step.prior, "energy_balance"),
    }
    examples = _examples(step)
    programs = {}
    for name, module in modules.items():
        inputs, outputs = (table[name.partition("/")[0]] for table in (INPUTS, OUTPUTS))
        programs[name] = nn_export.trace(
            module, tuple(examples[i] for i in inputs), input_names=list(inputs), output_names=list(outputs)
        )
    return programs


def model_info(prior: Prior, dt: float, covariance: Sequence[Sequence[float]] = ()) -> ModelInfo:
    """Period, signals, parameters and balances of the models built on ``prior``.

    Args:
        prior: The fitted prior.
        dt: Model period [s].
        covariance: Rows of the covariance of its parameters' values. Default: unknown.
    """
    values = prior.values
    return ModelInfo(
        dt, prior.states, prior.inputs, prior.outputs,
        tuple(replace(spec, value=values[spec.name]) for spec in prior.parameters_spec),
        covariance=tuple(tuple(row) for row in covariance), balances=(ENERGY,),
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
    nominal = list(model.step(*point[:3], model.w, model.p))
    examples = _examples(step)
    x, u = (np.concatenate([getattr(t, name) for t in trajectories]) for name in ("x", "u"))
    scale = (np.abs(x).max(0), np.ones(examples["h"].numel()), np.abs(u).max(0))
    function = ca.Function("step", point[:3], nominal, [*STEP_INPUTS[:3]], [*STEP_OUTPUTS])
    report = nn_export.parity(
        step, function, tuple(examples[i] for i in STEP_INPUTS[:3]), seed=seed, scale=scale
    )
    return Parity(report.value_rel, report.jacobian_rel)


def _examples(step: Step) -> dict[str, Tensor]:
    n_x, n_u = len(step.prior.states), len(step.prior.inputs)
    shapes = {"x": n_x, "h": step.n_h, "u": n_u, "w": 0, "xdot": n_x}
    zeros = {name: torch.zeros(n, dtype=torch.float64) for name, n in shapes.items()}
    return {**zeros, "p": torch.tensor(list(step.prior.values.values()), dtype=torch.float64)}
