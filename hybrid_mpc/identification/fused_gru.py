"""A stack of GRUs along a sequence with few operations a time step and a derivative written by hand.

Automatic differentiation records a dozen operations a time step, and walks back through three times as many; each
costs a launch, allocates its result, and every step adds to the gradients of all weights. Here a step is one matrix
product (features, bias and hidden state in one column) and four operations on the gates, written into memory that is
allocated once. The equations are those of :class:`~hybrid_mpc.identification.networks.StackedGRU`; sums run in
another order, so results differ by rounding.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def fused_states(s: Tensor, h: Tensor, w_ih: Tensor, w_hh: Tensor, b_ih: Tensor, b_hh: Tensor) -> Tensor:
    """Hidden states ``(T, networks, z, batch)`` along a sequence; differentiable once by every argument.

    Args:
        s: Features ``(T, networks or 1, batch, n_in)``.
        h: Hidden states at the start ``(networks, batch, z)``.
        w_ih: Weights of the features ``(networks, n_in, 3 z)``, gates r, z and candidate.
        w_hh: Weights of the hidden state ``(networks, z, 3 z)``.
        b_ih: Bias beside the features ``(networks, 1, 3 z)``.
        b_hh: Bias inside the reset product ``(networks, 1, 3 z)``.

    Example:
        >>> def w(*shape):
        ...     return torch.rand(2, *shape, dtype=torch.float64)
        >>> tuple(fused_states(w(1, 5, 3), w(5, 4), w(3, 12), w(4, 12), w(1, 12), w(1, 12)).shape)
        (2, 2, 4, 5)
    """
    z = w_hh.shape[1]
    ones = s.new_ones(*s.shape[:2], 1, s.shape[2])
    columns = torch.cat([s.mT, ones], dim=2)
    gate = torch.cat([w_ih[..., : 2 * z], (b_ih + b_hh)[..., : 2 * z]], dim=1)
    inside = torch.cat([torch.zeros_like(w_ih[..., 2 * z :]), b_hh[..., 2 * z :]], dim=1)
    recurrent = torch.cat([w_hh, torch.cat([gate, inside], dim=2)], dim=1).mT.contiguous()
    direct = torch.cat([w_ih, b_ih], dim=1)[..., 2 * z :].mT.contiguous()
    states: Tensor = _States.apply(columns, h.mT, recurrent, direct)
    return states


class _States(torch.autograd.Function):
    """``h`` of all times from columns ``[s; 1]``; a column in memory is ``[h; s; 1]`` of one time."""

    @staticmethod
    def forward(ctx: Any, s: Tensor, h: Tensor, recurrent: Tensor, direct: Tensor) -> Tensor:
        networks, z, batch = h.shape
        steps = s.shape[0]
        x = s.new_empty(steps + 1, networks, z + s.shape[2], batch)
        x[0, :, :z] = h
        x[:-1, :, z:] = s
        gates = s.new_empty(steps, networks, 3 * z, batch)  # r, z, and R_n h + b inside the reset product
        candidate = torch.matmul(direct, s)
        for now, new, g, n in zip(x[:-1], x[1:], gates, candidate, strict=True):
            torch.bmm(recurrent, now, out=g)
            g[:, : 2 * z].sigmoid_()
            n.addcmul_(g[:, :z], g[:, 2 * z :]).tanh_()
            torch.lerp(n, now[:, :z], g[:, z : 2 * z], out=new[:, :z])
        ctx.save_for_backward(x, gates, candidate, recurrent, direct)
        return x[1:, :, :z]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, gates, candidate, recurrent, direct = ctx.saved_tensors
        steps, networks, z, batch = candidate.shape
        by_h = recurrent[..., :z].mT.contiguous()
        d_recurrent = torch.zeros_like(recurrent)
        need_s = ctx.needs_input_grad[0]
        d_gates = x.new_empty(steps if need_s else 1, networks, 3 * z, batch)
        d_direct = torch.empty_like(candidate)
        dh, carry = x.new_empty(networks, z, batch), x.new_zeros(networks, z, batch)
        for k in range(steps - 1, -1, -1):
            g, d, d_n = gates[k], d_gates[k if need_s else 0], d_direct[k]
            _step_back(grad[k], carry, dh, x[k, :, :z], g, candidate[k], d, d_n)
            carry.baddbmm_(by_h, d)
            d_recurrent.baddbmm_(d, x[k].mT)
        columns = x[:-1, :, z:]
        d_columns = None
        if need_s:
            d_columns = torch.matmul(recurrent[..., z:].mT, d_gates) + torch.matmul(direct.mT, d_direct)
        by_direct = torch.matmul(d_direct, columns.mT).sum(0)
        return d_columns, carry, d_recurrent, by_direct


def _step_back(
    grad: Tensor, carry: Tensor, dh: Tensor, h: Tensor, g: Tensor, n: Tensor, d: Tensor, d_n: Tensor
) -> None:
    """Derivatives by the gates' sums ``d`` and the candidate's ``d_n``, and what h itself hands on, ``carry``."""
    z = n.shape[1]
    aten = torch.ops.aten
    torch.add(grad, carry, out=dh)
    torch.mul(dh, g[:, z : 2 * z], out=carry)
    torch.sub(dh, carry, out=d_n)
    aten.tanh_backward.grad_input(d_n, n, grad_input=d_n)
    torch.mul(d_n, g[:, 2 * z :], out=d[:, :z])
    torch.sub(h, n, out=d[:, z : 2 * z])
    d[:, z : 2 * z].mul_(dh)
    aten.sigmoid_backward.grad_input(d[:, : 2 * z], g[:, : 2 * z], grad_input=d[:, : 2 * z])
    torch.mul(d_n, g[:, :z], out=d[:, 2 * z :])
