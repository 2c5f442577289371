"""A blend of prior and hybrid whose share an observer can estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Parameter
from hybrid_mpc.model.model import (
    HybridModel,
    ManyPoints,
    SideBySide,
    at_arguments,
    inlined,
    step_function,
    step_symbols,
)

Array = NDArray[np.float64]
BLEND_SHARE = Parameter("correction_share", 1.0, "-", 0.0, 2.0, "share of the network's correction")
"""The blend's last parameter: 0 is the prior, 1 the hybrid. Its bounds are symmetric about the hybrid."""


def blended(prior: HybridModel, hybrid: HybridModel, share: float = BLEND_SHARE.value) -> HybridModel:
    """The model ``x+ = f_prior + share (f_hybrid - f_prior)``, whose last parameter is the share of the correction.

    Rates are blended likewise. Outputs and balances have no correction. The hidden state is the hybrid's.

    Args:
        prior: The model without correction.
        hybrid: The model with it.
        share: Value of the parameter. Default: 1, the hybrid.

    Raises:
        InputError: If the models have other states, inputs, disturbances or parameters, or a parameter has the name of
            :data:`BLEND_SHARE`.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m"),)
        >>> prior, hybrid = (HybridModel.of(name, 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + k * u,
        ...     xdot=k * u, y=x) for name, k in (("prior", 1.0), ("hybrid", 3.0)))
        >>> model = blended(prior, hybrid)
        >>> [float(model.step(0.0, [], 1.0, [], share)[0]) for share in (0.0, 0.5, 1.0)]
        [1.0, 2.0, 3.0]
    """
    same = ("dt", "states", "inputs", "disturbances", "parameters", "delay_states")
    if others := [name for name in same if getattr(prior, name) != getattr(hybrid, name)]:
        raise InputError(
            f"blend: prior {prior.name} and hybrid {hybrid.name} differ in {', '.join(others)}. Blend the two models "
            "of one kit [HM-MODEL-060]"
        )
    x, h, u, w, _ = step_symbols(hybrid)
    p = ca.MX.sym("p", hybrid.n_p + 1)
    part, point = p[hybrid.n_p], [x, h, u, w, p]
    own = [x, h, u, w, p[: hybrid.n_p]]
    queue = [x, h[: prior.n_h], *own[2:]]  # h begins with the delayed inputs, the prior's has only them
    base, full = inlined(prior.with_jacobian, queue), inlined(hybrid.with_jacobian, own)
    n_x, n_q = hybrid.n_x, hybrid.n_x + prior.n_h
    x_next = base[0] + part * (full[0] - base[0])
    padded = ca.horzcat(base[2][:n_x, :], ca.MX.zeros(n_x, hybrid.n_x + hybrid.n_h - n_q))
    a = ca.vertcat(padded + part * (full[2][:n_x, :] - padded), full[2][n_x:, :])
    b = ca.vertcat(base[3][:n_x, :] + part * (full[3][:n_x, :] - base[3][:n_x, :]), full[3][n_x:, :])
    rate, corrected = inlined(prior.xdot, queue)[0], inlined(hybrid.xdot, own)[0]
    return replace(
        with_share(hybrid, share),
        name=f"{hybrid.name}, blended",
        step=step_function("step", point, [x_next, full[1]]),
        xdot=ca.Function("xdot", point, [rate + part * (corrected - rate)]),
        with_jacobian=step_function("with_jacobian", point, [x_next, full[1], ca.densify(a), ca.densify(b)]),
        side_by_side=None
        if hybrid.side_by_side is None or prior.side_by_side is None
        else _side_by_side(prior, hybrid),
    )


def with_share(model: HybridModel, share: float = BLEND_SHARE.value) -> HybridModel:
    """The model with :data:`BLEND_SHARE` as a further parameter that has no effect: it stands beside a blend.

    Raises:
        InputError: If it has a parameter of this name.
    """
    if BLEND_SHARE.name in [p.name for p in model.parameters]:
        raise InputError(
            f"blend: model {model.name} has a parameter named {BLEND_SHARE.name}, which is the blend's. Rename it "
            "[HM-MODEL-061]"
        )
    x, h, u, w, _ = step_symbols(model)
    n_p, base = model.n_p, model.side_by_side
    p = ca.MX.sym("p", n_p + 1)

    def make(n: int, by: Mapping[str, Sequence[str]]) -> ManyPoints:
        assert base is not None
        many = base(n, by)
        return lambda x, h, u, w, p: many(x, h, u, w, np.ascontiguousarray(np.asarray(p)[:, :n_p]))

    covariance = np.zeros((n_p + 1, n_p + 1))
    if model.covariance:
        covariance[:n_p, :n_p] = model.covariance
    return at_arguments(
        model, [x, h, u, w, p], [x, h, u, w, p[:n_p]],
        side_by_side=None if base is None else make,
        parameters=(*model.parameters, replace(BLEND_SHARE, value=share)),
        covariance=tuple(map(tuple, covariance.tolist())) if model.covariance else (),
    )  # fmt: skip


def _side_by_side(prior: HybridModel, hybrid: HybridModel) -> SideBySide:
    """Evaluation of the blend at many points: that of both models."""
    first, second = prior.side_by_side, hybrid.side_by_side
    assert first is not None
    assert second is not None
    n_x, n_q, n_p = hybrid.n_x, prior.n_h, hybrid.n_p

    def make(n: int, by: Mapping[str, Sequence[str]]) -> ManyPoints:
        base, full = first(n, by), second(n, by)

        def evaluate(x: Array, h: Array, u: Array, w: Array, p: Array) -> tuple[Array, ...]:
            p = np.asarray(p)
            own, share = np.ascontiguousarray(p[:, :n_p]), p[:, n_p:]
            below, (x_next, *others) = (
                base(x, np.ascontiguousarray(h[:, :n_q]), u, w, own),
                full(x, h, u, w, own),
            )
            found = [below[0] + share * (x_next - below[0]), others[0]]
            for part, whole in zip(below[2:], others[1:], strict=True):
                padded = np.zeros((n, n_x, whole.shape[2]))
                padded[:, :, : part.shape[2]] = part[:, :n_x]
                mixed = whole.copy()
                mixed[:, :n_x] = padded + share[:, :, None] * (whole[:, :n_x] - padded)
                found.append(mixed)
            return tuple(found)

        return evaluate

    return make
