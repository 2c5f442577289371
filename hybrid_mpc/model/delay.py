"""A model with a delayed input: the delayed inputs are delay states, the first entries of ``h``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.model import (
    STEP_INPUTS,
    HybridModel,
    ManyPoints,
    SideBySide,
    inlined,
    step_function,
    step_symbols,
)

Array = NDArray[np.float64]
TINY = 1e-9
"""Fraction of a period below which the remainder of a delay is zero."""
MOST_DELAY_STATES = 1000
"""Most delay states: an estimator can still work with matrices of a thousand rows. It is 10 s of one input at 100 Hz; a
longer delay has a wrong unit, or comes from a damaged file."""


def with_input_delay(model: HybridModel, delay: float) -> HybridModel:
    """The model with an input that acts ``delay`` later: ``h = [delayed inputs, the oldest first; h]``.

    For a delay of ``m`` periods and a fraction ``f``, the mean input ``(1 - f) u_{k-m} + f u_{k-m-1}`` acts in period
    ``k``, as in training (:func:`hybrid_mpc.identify.delay.delayed`). Estimator, controller and monitor need no change;
    the first estimate assumes that earlier inputs were zero. ``xdot`` and the balances are those of the model and take
    the input that acts.

    Args:
        model: The model without delay.
        delay: Delay of the input [s], positive; at most :data:`MOST_DELAY_STATES` delay states (periods times inputs).

    Raises:
        InputError: If the delay is not positive or too long, or the model has delay states already.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> late = with_input_delay(model, 0.75)
        >>> x_next, h_next = late.step(0.0, 4.0, 8.0, late.w, late.p)  # 0.75 of the old input, 0.25 of the new one
        >>> float(x_next), float(h_next)
        (5.0, 8.0)
    """
    if not (delay > 0 and math.isfinite(delay)):
        raise InputError(
            f"model {model.name}: the input's delay must be positive, got {delay} s [HM-MODEL-001]"
        )
    periods = delay / model.dt
    if not periods * model.n_u <= MOST_DELAY_STATES:
        raise InputError(
            f"model {model.name}: an input delay of {delay:g} s is {periods:.4g} periods of {model.dt:g} s and needs "
            f"{periods * model.n_u:.4g} delay states; at most {MOST_DELAY_STATES} are possible. Give the delay in "
            "seconds, or use a model with a longer period. [HM-MODEL-002]"
        )
    if model.delay_states:
        raise InputError(
            f"model {model.name} has delay states already. Give the model without a delay. [HM-MODEL-003]"
        )
    queue = _Queue(periods, model.n_u)
    x, _, u, w, p = step_symbols(model)
    h = ca.MX.sym("h", queue.size + model.n_h)
    inputs = ca.vertcat(h[: queue.size], u)
    own, acting, later = h[queue.size :], ca.sparsify(ca.DM(queue.share)) @ inputs, inputs[model.n_u :]
    x_next, h_next = inlined(model.step, [x, own, acting, w, p])
    x_slope, h_slope, a, b = inlined(model.with_jacobian, [x, own, acting, w, p])
    point, slopes = [x, h, u, w, p], queue.slopes(model.n_x, a, b)
    return replace(
        model,
        step=step_function("step", point, [x_next, ca.vertcat(later, h_next)]),
        xdot=ca.Function("xdot", point, inlined(model.xdot, [x, own, u, w, p]), [*STEP_INPUTS], ["xdot"]),
        with_jacobian=step_function("with_jacobian", point, [x_slope, ca.vertcat(later, h_slope), *slopes]),
        side_by_side=None
        if model.side_by_side is None
        else _side_by_side(model.side_by_side, model.n_x, queue),
        delay_states=queue.size,
    )


class _Queue:
    """The number of delay states, and the share of each (and of the new input) that acts."""

    def __init__(self, periods: float, n_u: int) -> None:
        whole = math.floor(periods + TINY)
        rest = max(periods - whole, 0.0)
        late = rest > TINY
        self.n_u, self.size = n_u, (whole + late) * n_u
        share = np.zeros((n_u, self.size + n_u))
        share[:, :n_u] = (rest if late else 1.0) * np.eye(n_u)
        if late:
            share[:, n_u : 2 * n_u] = (1.0 - rest) * np.eye(n_u)
        self.share = share

    def slopes(self, n_x: int, a: ca.MX, b: ca.MX) -> tuple[ca.MX, ca.MX]:
        """``A`` and ``B`` of the delayed model, from those of the model."""
        n, n_u = self.size, self.n_u
        old, new = b @ ca.DM(self.share[:, :n]), b @ ca.DM(self.share[:, n:])
        moved = ca.DM(np.eye(n, n + n_u, n_u))
        rows = ca.horzcat(ca.MX(n, n_x), ca.MX(moved[:, :n]), ca.MX(n, a.shape[1] - n_x))
        own = ca.horzcat(a[:, :n_x], old, a[:, n_x:])
        return (
            ca.densify(ca.vertcat(own[:n_x, :], rows, own[n_x:, :])),
            ca.densify(ca.vertcat(new[:n_x, :], ca.MX(moved[:, n:]), new[n_x:, :])),
        )


def _side_by_side(inner: SideBySide, n_x: int, queue: _Queue) -> SideBySide:
    """The delayed model at many points in one call, from the model's own function."""

    def make(n: int, blocks: Mapping[str, Sequence[str]]) -> ManyPoints:
        many = inner(n, {name: (name,) for name in ("x", "h", "u")})
        size, n_u = queue.size, queue.n_u
        moved = np.eye(size, size + n_u, n_u)

        def evaluate(x: Array, h: Array, u: Array, w: Array, p: Array) -> tuple[Array, ...]:
            inputs = np.hstack([h[:, :size], u])
            x_next, h_next, by_x, by_h, by_u = many(x, h[:, size:], inputs @ queue.share.T, w, p)
            by_queue = by_u @ queue.share
            zero_x, zero_h = np.zeros((n, size, by_x.shape[2])), np.zeros((n, size, by_h.shape[2]))
            shift = np.broadcast_to(moved, (n, *moved.shape))
            columns = {
                "x": _inserted(by_x, n_x, zero_x),
                "u": _inserted(by_queue[:, :, size:], n_x, shift[:, :, size:]),
                "h": np.concatenate(
                    [_inserted(by_queue[:, :, :size], n_x, shift[:, :, :size]), _inserted(by_h, n_x, zero_h)],
                    axis=2,
                ),
            }
            slopes = (np.concatenate([columns[name] for name in names], axis=2) for names in blocks.values())
            return x_next, np.hstack([inputs[:, n_u:], h_next]), *slopes

        return evaluate

    return make


def _inserted(rows: Array, n_x: int, queue: Array) -> Array:
    """Rows of a Jacobian ``(n, n_x + n_h, columns)`` with those of the delay states inserted after the states'."""
    return np.concatenate([rows[:, :n_x], queue, rows[:, n_x:]], axis=1)
