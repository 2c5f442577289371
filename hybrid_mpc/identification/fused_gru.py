"""A stack of GRUs along a sequence with few operations a time step and a derivative written by hand.

Automatic differentiation records a dozen operations a time step, and walks back through three times as many; each
costs a launch, allocates its result, and every step adds to the gradients of all weights. Here a step is one matrix
product (hidden state, features and bias in one row) and four operations on the gates, written into memory that is
allocated once. The equations are those of :class:`~hybrid_mpc.identification.networks.StackedGRU`; sums run in
another order, so results differ by rounding.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def fused_states(s: Tensor, h: Tensor, w_ih: Tensor, w_hh: Tensor, b_ih: Tensor, b_hh: Tensor) -> Tensor:
    """Hidden states ``(networks, T, batch, z)`` along a sequence; differentiable once by every argument.

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
        (2, 2, 5, 4)
    """
    z = w_hh.shape[1]
    rows = torch.cat([s, s.new_ones(*s.shape[:3], 1)], dim=3).transpose(0, 1)
    gate = torch.cat([w_ih[..., : 2 * z], (b_ih + b_hh)[..., : 2 * z]], dim=1)
    inside = torch.cat([torch.zeros_like(w_ih[..., 2 * z :]), b_hh[..., 2 * z :]], dim=1)
    recurrent = torch.cat([w_hh, torch.cat([gate, inside], dim=2)], dim=1)
    direct = torch.cat([w_ih, b_ih], dim=1)[..., 2 * z :].contiguous()
    states: Tensor = _States.apply(rows, h, recurrent, direct)
    return states


class _States(torch.autograd.Function):
    """``h`` of all times from rows ``[s, 1]``; a row in memory is ``[h, s, 1]`` of one time.

    The network is the first axis and time the second: what is done for all times is one product a network.
    """

    @staticmethod
    def forward(ctx: Any, s: Tensor, h: Tensor, recurrent: Tensor, direct: Tensor) -> Tensor:
        networks, batch, z = h.shape
        steps = s.shape[1]
        x = s.new_empty(networks, steps + 1, batch, z + s.shape[3])
        x[:, 0, :, :z] = h
        x[:, :-1, :, z:] = s
        # r, z, and R_n h + b inside the reset product; time first, since products are written into whole memory
        gates = s.new_empty(steps, networks, batch, 3 * z)
        rows = s.flatten(1, 2).expand(networks, -1, -1)
        candidate = torch.bmm(rows, direct).unflatten(1, (steps, batch))
        for k, (g, n) in enumerate(zip(gates, candidate.unbind(1), strict=True)):
            now = x[:, k]
            torch.bmm(now, recurrent, out=g)
            g[..., : 2 * z].sigmoid_()
            n.addcmul_(g[..., :z], g[..., 2 * z :]).tanh_()
            torch.lerp(n, now[..., :z], g[..., z : 2 * z], out=x[:, k + 1, :, :z])
        ctx.save_for_backward(x, gates, candidate, recurrent, direct)
        return x[:, 1:, :, :z]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, gates, candidate, recurrent, direct = ctx.saved_tensors
        networks, steps, batch, z = candidate.shape
        by_h, by_s = recurrent[:, :z].mT, recurrent[:, z:].mT
        d_recurrent, by_direct = torch.zeros_like(recurrent), torch.zeros_like(direct)
        d_rows = x.new_empty(networks, steps, batch, direct.shape[1]) if ctx.needs_input_grad[0] else None
        d = x.new_empty(networks, batch, 3 * z)
        d_n, dh, carry = x.new_zeros(3, networks, batch, z)
        for k in range(steps - 1, -1, -1):
            now = x[:, k]
            _step_back(grad[:, k], carry, dh, now[..., :z], gates[k], candidate[:, k], d, d_n)
            carry.baddbmm_(d, by_h)
            d_recurrent.baddbmm_(now.mT, d)
            by_direct.baddbmm_(now[..., z:].mT, d_n)
            if d_rows is not None:
                d_rows[:, k] = torch.bmm(d, by_s) + torch.bmm(d_n, direct.mT)
        return d_rows, carry, d_recurrent, by_direct


def _step_back(
    grad: Tensor, carry: Tensor, dh: Tensor, h: Tensor, g: Tensor, n: Tensor, d: Tensor, d_n: Tensor
) -> None:
    """Derivatives by the gates' sums ``d`` and the candidate's ``d_n``, and what h itself hands on, ``carry``."""
    z, aten = n.shape[-1], torch.ops.aten
    torch.add(grad, carry, out=dh)
    torch.mul(dh, g[..., z : 2 * z], out=carry)
    torch.sub(dh, carry, out=d_n)
    aten.tanh_backward.grad_input(d_n, n, grad_input=d_n)
    torch.mul(d_n, g[..., 2 * z :], out=d[..., :z])
    torch.sub(h, n, out=d[..., z : 2 * z])
    d[..., z : 2 * z].mul_(dh)
    aten.sigmoid_backward.grad_input(d[..., : 2 * z], g[..., : 2 * z], grad_input=d[..., : 2 * z])
    torch.mul(d_n, g[..., :z], out=d[..., 2 * z :])
