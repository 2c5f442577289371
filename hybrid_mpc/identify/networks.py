"""The GRU that corrects a prior: a single network for export, and a stack of networks for training.

Both are functions ``(s, h) -> (output, h_next)`` with an explicit hidden state h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn


class GRUNetwork(nn.Module):
    """One GRU layer and one linear layer, for export.

    ``r = sig(W_r s + b_ir + R_r h + b_hr)``, ``z = sig(W_z s + b_iz + R_z h + b_hz)``,
    ``n = tanh(W_n s + b_in + r (R_n h + b_hn))``, ``h+ = (1 - z) n + z h``: torch's form of the paper's GRU (z with the
    opposite sign, and one more bias).

    Args:
        n_in: Number of input features.
        hidden: Number of hidden units z.
        n_out: Number of outputs.

    Example:
        >>> s, h = torch.zeros(3, dtype=torch.float64), torch.zeros(4, dtype=torch.float64)
        >>> out, h = GRUNetwork(3, 4, 1)(s, h)
        >>> tuple(out.shape), tuple(h.shape)
        ((1,), (4,))
    """

    def __init__(self, n_in: int, hidden: int, n_out: int) -> None:
        super().__init__()
        self.n_h = hidden
        self.cell = nn.GRUCell(n_in, hidden, dtype=torch.float64)
        self.head = nn.Linear(hidden, n_out, dtype=torch.float64)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(..., n_out)`` and next hidden state for features ``(..., n_in)`` and ``h (..., z)``."""
        h_next = self.cell(s, h)
        return self.head(h_next), h_next


class StackedGRU(nn.Module):
    """Several independent :class:`GRUNetwork` with stacked weights, trained at once.

    The first axis of a tensor is the network, ``(networks, batch, features)``. The time of small networks is that of
    launching operations, so several networks cost little more than one. Network i depends on ``seed`` but not on the
    number of ``networks``. ``zero_head``: True: the initial output is zero.
    """

    def __init__(
        self, networks: int, n_in: int, hidden: int, n_out: int, *, seed: int, zero_head: bool = False
    ) -> None:
        super().__init__()
        self.networks, self.n_in, self.n_h, self.n_out = networks, n_in, hidden, n_out
        bound = 1.0 / math.sqrt(hidden)
        generators = [torch.Generator().manual_seed(seed * 1009 + i) for i in range(networks)]

        def uniform(*shape: int) -> nn.Parameter:
            draws = [torch.rand(shape, generator=g, dtype=torch.float64) for g in generators]
            return nn.Parameter((2.0 * torch.stack(draws) - 1.0) * bound)

        self.w_ih, self.w_hh = uniform(n_in, 3 * hidden), uniform(hidden, 3 * hidden)
        self.b_ih, self.b_hh = uniform(1, 3 * hidden), uniform(1, 3 * hidden)
        self.w_out, self.b_out = uniform(hidden, n_out), uniform(1, n_out)
        if zero_head:
            nn.init.zeros_(self.w_out)
            nn.init.zeros_(self.b_out)

    @classmethod
    def of(cls, network: GRUNetwork) -> StackedGRU:
        """Create a stack of one network, with copies of its weights."""
        cell, head = network.cell, network.head
        stack = cls(1, cell.input_size, network.n_h, head.out_features, seed=0)
        weights = cell.weight_ih.T, cell.weight_hh.T, cell.bias_ih, cell.bias_hh, head.weight.T, head.bias
        with torch.no_grad():
            for own, weight in zip(stack.parameters(), weights, strict=True):
                own.copy_(weight.reshape(own.shape))
        return stack.requires_grad_(network.head.weight.requires_grad)

    def initial(self, batch: int) -> Tensor:
        """Zero hidden states ``(networks, batch, z)``."""
        return self.w_out.new_zeros(self.networks, batch, self.n_h)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(networks, batch, n_out)`` and next hidden state for ``s (networks, batch, n_in)``."""
        h_next = self._cell(torch.baddbmm(self.b_ih, s, self.w_ih), h)
        return torch.baddbmm(self.b_out, h_next, self.w_out), h_next

    def sequence(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs ``(T, networks, batch, n_out)`` and the last h along a sequence.

        Features ``s`` are ``(T, networks, batch, n_in)``, or ``(T, 1, batch, n_in)`` if all networks have the same.
        """
        states = hidden_states(s, h, self.w_ih, self.w_hh, self.b_ih, self.b_hh)
        out = torch.baddbmm(self.b_out, states.flatten(1, 2), self.w_out).unflatten(1, states.shape[1:3])
        return out.transpose(0, 1), states[:, -1]

    def member(self, i: int) -> GRUNetwork:
        """Extract network ``i``."""
        network = GRUNetwork(self.n_in, self.n_h, self.n_out)
        cell = {"weight_ih": self.w_ih, "weight_hh": self.w_hh, "bias_ih": self.b_ih, "bias_hh": self.b_hh}
        stacked = {f"cell.{name}": weight for name, weight in cell.items()}
        stacked |= {"head.weight": self.w_out, "head.bias": self.b_out}
        # biases are matrices (1, n) in the stack and vectors in the single network
        network.load_state_dict({n: w[i].T if "weight" in n else w[i, 0] for n, w in stacked.items()})
        return network

    def joined(self, shares: Sequence[float]) -> GRUNetwork:
        """Join all networks to one whose output is their weighted mean.

        The hidden state consists of the networks' hidden states, one after the other. The recurrent weights are
        block-diagonal, so the networks do not interact. ``shares`` ``(networks,)`` are the weights; their sum is one.

        Example:
            >>> stack = StackedGRU(2, 3, 4, 1, seed=0).requires_grad_(False)
            >>> s, h = torch.ones(3, dtype=torch.float64), torch.zeros(4, dtype=torch.float64)
            >>> each = [stack.member(i)(s, h)[0] for i in range(2)]
            >>> out, h = stack.joined([0.5, 0.5])(s, torch.zeros(8, dtype=torch.float64))
            >>> bool(torch.allclose(out, sum(each) / 2)), tuple(h.shape)
            (True, (8,))
        """
        m, z = self.networks, self.n_h
        network = GRUNetwork(self.n_in, m * z, self.n_out)

        def rows(weight: Tensor) -> Tensor:
            """Reorder the gates of each network ``(m, n, 3 z)``, so that each gate of all networks is one block."""
            return weight.mT.unflatten(1, (3, z)).transpose(0, 1).reshape(3 * m * z, -1)

        share = torch.tensor(shares, dtype=torch.float64)[:, None, None]
        of = torch.arange(m).repeat_interleave(z)  # network of each unit
        recurrent = rows(self.w_hh).repeat(1, m) * (of.repeat(3)[:, None] == of)
        network.load_state_dict(
            {
                "cell.weight_ih": rows(self.w_ih),
                "cell.weight_hh": recurrent,
                "cell.bias_ih": rows(self.b_ih)[:, 0],
                "cell.bias_hh": rows(self.b_hh)[:, 0],
                "head.weight": (share * self.w_out).flatten(0, 1).T,
                "head.bias": (share * self.b_out).sum(0)[0],
            }
        )
        return network

    def _cell(self, gate_in: Tensor, h: Tensor) -> Tensor:
        gate_h = torch.baddbmm(self.b_hh, h, self.w_hh)
        n = 2 * self.n_h
        rz = torch.sigmoid(gate_in[..., :n] + gate_h[..., :n])
        r, z = rz[..., : self.n_h], rz[..., self.n_h :]
        candidate = torch.tanh(gate_in[..., n:] + r * gate_h[..., n:])
        return candidate + z * (h - candidate)


def hidden_states(s: Tensor, h: Tensor, w_ih: Tensor, w_hh: Tensor, b_ih: Tensor, b_hh: Tensor) -> Tensor:
    """Hidden states ``(networks, T, batch, z)`` along a sequence; differentiable once with respect to every argument.

    The equations of :class:`StackedGRU` with a hand-written derivative. A time step is one matrix product (hidden
    state, features and bias in one row) and four operations on the gates, in preallocated memory. Automatic
    differentiation would record about a dozen operations for each step. Sums have another order, so results differ by
    rounding. ``s`` is ``(T, networks or 1, batch, n_in)``, h ``(networks, batch, z)``; the columns of the weights are
    the gates r, z and the candidate.
    """
    rows = torch.cat([s, s.new_ones(*s.shape[:3], 1)], dim=3).transpose(0, 1)
    states: Tensor = _States.apply(rows, h, *gate_matrices(w_ih, w_hh, b_ih, b_hh))
    return states


def gate_matrices(w_ih: Tensor, w_hh: Tensor, b_ih: Tensor, b_hh: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices of a time step as two products.

    Returns:
        ``(networks, z + n_in + 1, 3 z)`` from ``[h, s, 1]`` to the sums of r and z and to the factor of r in the
        candidate, and ``(networks, n_in + 1, z)`` from ``[s, 1]`` to the rest of the candidate's sum.
    """
    z = w_hh.shape[1]
    gate = torch.cat([w_ih[..., : 2 * z], (b_ih + b_hh)[..., : 2 * z]], dim=1)
    inside = torch.cat([torch.zeros_like(w_ih[..., 2 * z :]), b_hh[..., 2 * z :]], dim=1)
    recurrent = torch.cat([w_hh, torch.cat([gate, inside], dim=2)], dim=1)
    return recurrent, torch.cat([w_ih, b_ih], dim=1)[..., 2 * z :].contiguous()


class _States(torch.autograd.Function):
    """``h`` of all time steps from rows ``[s, 1]``; a row in memory is ``[h, s, 1]`` of one time step.

    The network is the first axis and time the second, so operations on all time steps are one product per network.
    """

    @staticmethod
    def forward(ctx: Any, s: Tensor, h: Tensor, recurrent: Tensor, direct: Tensor) -> Tensor:
        networks, batch, z = h.shape
        steps = s.shape[1]
        x = s.new_empty(networks, steps + 1, batch, z + s.shape[3])
        x[:, 0, :, :z] = h
        x[:, :-1, :, z:] = s
        # r, z, and R_n h + b_hn; time is the first axis, because products are written to contiguous memory
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
            step_back(grad[:, k], carry, dh, now[..., :z], gates[k], candidate[:, k], d, d_n)
            carry.baddbmm_(d, by_h)
            d_recurrent.baddbmm_(now.mT, d)
            by_direct.baddbmm_(now[..., z:].mT, d_n)
            if d_rows is not None:
                d_rows[:, k] = torch.bmm(d, by_s) + torch.bmm(d_n, direct.mT)
        return d_rows, carry, d_recurrent, by_direct


def step_back(
    grad: Tensor, carry: Tensor, dh: Tensor, h: Tensor, g: Tensor, n: Tensor, d: Tensor, d_n: Tensor
) -> None:
    """Backward pass of one step: derivatives by the gates' sums ``d`` and the candidate's sum ``d_n``, and ``carry``.

    ``carry`` is the part of the derivative that reaches the previous h directly: ``z dh``.
    """
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
