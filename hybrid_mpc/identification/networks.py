"""GRU networks that correct a prior: one network as it is exported, several stacked for training."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class GRUNetwork(nn.Module):
    """One GRU layer and one linear layer: ``(s, h) -> (output, h_next)``; h is never kept inside.

    The gates are torch's form of the paper's GRU (the z gate's sign turned, one more bias).

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
        self.hidden = hidden
        self.cell = nn.GRUCell(n_in, hidden, dtype=torch.float64)
        self.head = nn.Linear(hidden, n_out, dtype=torch.float64)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(..., n_out)`` and next hidden state for features ``(..., n_in)`` and ``h``."""
        h_next = self.cell(s, h)
        return self.head(h_next), h_next


class StackedGRU(nn.Module):
    """``networks`` independent :class:`GRUNetwork` with stacked weights, trained at once.

    The tensors carry the network as first axis, ``(networks, batch, features)``. Small networks are
    bound by the cost of launching operations, so several cost little more than one.

    Args:
        networks: Number of networks.
        n_in: Number of input features.
        hidden: Number of hidden units z.
        n_out: Number of outputs.
        seed: Seed of the initial weights; network i of one seed is the same whatever ``networks`` is.
        zero_head: Start with zero output, so that a hybrid starts as its prior.

    Example:
        >>> net = StackedGRU(2, 3, 4, 1, seed=0)
        >>> s = torch.rand(2, 5, 3, dtype=torch.float64)
        >>> out, h = net(s, net.initial(5))
        >>> one, _ = net.member(1)(s[1], h.new_zeros(5, 4))
        >>> torch.allclose(out[1], one, atol=1e-14)
        True
    """

    def __init__(
        self, networks: int, n_in: int, hidden: int, n_out: int, *, seed: int, zero_head: bool = False
    ) -> None:
        super().__init__()
        self.networks, self.n_in, self.hidden, self.n_out = networks, n_in, hidden, n_out
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

    def initial(self, batch: int) -> Tensor:
        """Zero hidden states ``(networks, batch, hidden)``."""
        return torch.zeros(self.networks, batch, self.hidden, dtype=torch.float64)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(networks, batch, n_out)`` and next hidden state for ``s (networks, batch, n_in)``."""
        h_next = self._cell(torch.baddbmm(self.b_ih, s, self.w_ih), h)
        return torch.baddbmm(self.b_out, h_next, self.w_out), h_next

    def sequence(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs ``(T, networks, batch, n_out)`` and last h; features ``(T, networks, batch, n_in)``."""
        gates = torch.matmul(s, self.w_ih) + self.b_ih
        states = []
        for gate in gates:
            h = self._cell(gate, h)
            states.append(h)
        return torch.matmul(torch.stack(states), self.w_out) + self.b_out, h

    def _cell(self, gate_in: Tensor, h: Tensor) -> Tensor:
        gate_h = torch.baddbmm(self.b_hh, h, self.w_hh)
        n = 2 * self.hidden
        rz = torch.sigmoid(gate_in[..., :n] + gate_h[..., :n])
        r, z = rz[..., : self.hidden], rz[..., self.hidden :]
        candidate = torch.tanh(gate_in[..., n:] + r * gate_h[..., n:])
        return candidate + z * (h - candidate)

    def member(self, i: int) -> GRUNetwork:
        """Network ``i`` as one :class:`GRUNetwork` with the same weights."""
        network = GRUNetwork(self.n_in, self.hidden, self.n_out)
        with torch.no_grad():
            network.cell.weight_ih.copy_(self.w_ih[i].T)
            network.cell.weight_hh.copy_(self.w_hh[i].T)
            network.cell.bias_ih.copy_(self.b_ih[i, 0])
            network.cell.bias_hh.copy_(self.b_hh[i, 0])
            network.head.weight.copy_(self.w_out[i].T)
            network.head.bias.copy_(self.b_out[i, 0])
        return network
