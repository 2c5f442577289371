"""Export of a prior as programs of a deployed model, without torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

import nn_export
from hybrid_mpc.identify.simulation import required_substeps, stepped
from hybrid_mpc.kit.artifact import INPUTS, OUTPUTS
from hybrid_mpc.kit.parts import BalanceInfo, ModelInfo
from hybrid_mpc.machine.prior import POINT, Prior


def prior_programs(prior: Prior, dt: float, substeps: int = 0) -> dict[str, nn_export.Program]:
    """Programs of the prior: ``step`` and ``xdot`` without hidden state, ``output``, and its balances.

    ``substeps`` is the number of Runge-Kutta sub-steps a period. Default 0: as many as the prior needs at rest.
    """
    equations = prior.equations
    names = dict(zip(POINT, (prior.states, prior.inputs, prior.disturbances, prior.parameters), strict=True))
    x, u, w, p = (ca.SX.sym(key, len(signals)) for key, signals in names.items())
    h = ca.SX.sym("h", 0)
    rates = equations.xdot(x, u, w, p)
    x_next = stepped(equations.xdot, x, u, w, p, dt, substeps or required_substeps(prior, dt))
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
    """Description of a prior's balances in an artifact."""
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
