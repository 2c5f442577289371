"""LSTM and feed-forward networks beside the GRU, one and stacked; and stacks by name."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.networks import Network, StackedGRU, StackedNetwork, StackedRecurrent, Uniform

Cell = Literal["gru", "gru_paper", "lstm", "feed_forward"]


class LSTMNetwork(Network):
    """One LSTM layer and one linear layer; the hidden state is h and c side by side, ``(..., 2 z)``.

    Args:
        n_in: Number of input features.
        hidden: Number of hidden units z.
        n_out: Number of outputs.

    Example:
        >>> s, h = torch.zeros(3, dtype=torch.float64), torch.zeros(8, dtype=torch.float64)
        >>> out, h = LSTMNetwork(3, 4, 1)(s, h)
        >>> tuple(out.shape), tuple(h.shape)
        ((1,), (8,))
    """

    def __init__(self, n_in: int, hidden: int, n_out: int) -> None:
        super().__init__(hidden, n_out, 2 * hidden)
        self.cell = nn.LSTMCell(n_in, hidden, dtype=torch.float64)
        self.head = nn.Linear(hidden, n_out, dtype=torch.float64)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(..., n_out)`` and next hidden state for features ``(..., n_in)`` and ``h``."""
        out, c = self.cell(s, (h[..., : self.hidden], h[..., self.hidden :]))
        return self.head(out), torch.cat([out, c], dim=-1)


class FeedForwardNetwork(Network):
    """Two layers of tanh and a linear one; it remembers nothing, its hidden state is empty.

    Args:
        n_in: Number of input features.
        hidden: Units of each layer.
        n_out: Number of outputs.

    Example:
        >>> s, h = torch.zeros(3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        >>> out, h = FeedForwardNetwork(3, 4, 1)(s, h)
        >>> tuple(out.shape), tuple(h.shape)
        ((1,), (0,))
    """

    def __init__(self, n_in: int, hidden: int, n_out: int) -> None:
        super().__init__(hidden, n_out, 0)
        self.first = nn.Linear(n_in, hidden, dtype=torch.float64)
        self.second = nn.Linear(hidden, hidden, dtype=torch.float64)
        self.head = nn.Linear(hidden, n_out, dtype=torch.float64)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(..., n_out)`` for features ``(..., n_in)``, and ``h`` as it came."""
        return self.head(torch.tanh(self.second(torch.tanh(self.first(s))))), h


class StackedLSTM(StackedRecurrent):
    """Several :class:`LSTMNetwork` with stacked weights (arguments: :class:`StackedNetwork`).

    Example:
        >>> net = StackedLSTM(2, 3, 4, 1, seed=0)
        >>> s = torch.rand(2, 5, 3, dtype=torch.float64)
        >>> out, h = net(s, net.initial(5))
        >>> one, _ = net.member(1)(s[1], net.initial(5)[1])
        >>> torch.allclose(out[1], one, atol=1e-14)
        True
    """

    gates = 4

    @property
    def n_h(self) -> int:
        """Size of the hidden state of one network: h and c."""
        return 2 * self.hidden

    def _cell(self, gate_in: Tensor, h: Tensor) -> Tensor:
        z = self.hidden
        gate = gate_in + torch.baddbmm(self.b_hh, h[..., :z], self.w_hh)
        keep = torch.sigmoid(gate[..., : 2 * z])  # input and forget
        c = keep[..., z:] * h[..., z:] + keep[..., :z] * torch.tanh(gate[..., 2 * z : 3 * z])
        return torch.cat([torch.sigmoid(gate[..., 3 * z :]) * torch.tanh(c), c], dim=-1)

    def _seen(self, h: Tensor) -> Tensor:
        return h[..., : self.hidden]

    def _single(self) -> LSTMNetwork:
        return LSTMNetwork(self.n_in, self.hidden, self.n_out)


class StackedFeedForward(StackedNetwork):
    """Several :class:`FeedForwardNetwork` with stacked weights (arguments: :class:`StackedNetwork`).

    Example:
        >>> net = StackedFeedForward(2, 3, 4, 1, seed=0)
        >>> s = torch.rand(2, 5, 3, dtype=torch.float64)
        >>> out, h = net(s, net.initial(5))
        >>> one, _ = net.member(1)(s[1], h[1])
        >>> torch.allclose(out[1], one, atol=1e-14)
        True
    """

    def _make(self, uniform: Uniform) -> None:
        self.w_first, self.b_first = uniform(self.n_in, self.hidden), uniform(1, self.hidden)
        self.w_second, self.b_second = uniform(self.hidden, self.hidden), uniform(1, self.hidden)

    @property
    def n_h(self) -> int:
        """Size of the hidden state: none."""
        return 0

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(networks, batch, n_out)`` for ``s (networks, batch, n_in)``, and h as it came."""
        return self.sequence(s, h)

    def sequence(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs ``(T, networks, batch, n_out)``; features ``(T, networks, batch, n_in)``."""
        first = torch.tanh(torch.matmul(s, self.w_first) + self.b_first)
        second = torch.tanh(torch.matmul(first, self.w_second) + self.b_second)
        return torch.matmul(second, self.w_out) + self.b_out, h

    def member(self, i: int) -> FeedForwardNetwork:
        """Network ``i`` as one :class:`FeedForwardNetwork` with the same weights."""
        network = FeedForwardNetwork(self.n_in, self.hidden, self.n_out)
        layers = (
            (network.first, self.w_first, self.b_first),
            (network.second, self.w_second, self.b_second),
            (network.head, self.w_out, self.b_out),
        )
        with torch.no_grad():
            for layer, weight, bias in layers:
                layer.weight.copy_(weight[i].T)
                layer.bias.copy_(bias[i, 0])
        return network


def make_stack(
    cell: Cell,
    networks: int,
    n_in: int,
    hidden: int,
    n_out: int,
    *,
    seed: int,
    zero_head: bool = False,
    fused: bool = False,
) -> StackedNetwork:
    """A stack by the name of its cell.

    Args:
        cell: ``"gru"`` (torch's form), ``"gru_paper"`` (the paper's, one bias a gate), ``"lstm"``,
            ``"feed_forward"`` (no memory).
        networks: Number of networks.
        n_in: Number of input features.
        hidden: Number of hidden units z; of each of the two layers of ``"feed_forward"``.
        n_out: Number of outputs.
        seed: Seed of the initial weights.
        zero_head: Start with zero output.
        fused: Faster sequences of the GRUs, with other rounding; the others have none.

    Raises:
        InputError: If there is no such cell, or it has no fused form.

    Example:
        >>> make_stack("lstm", 2, 3, 4, 1, seed=0).n_h
        8
    """
    if fused and not cell.startswith("gru"):
        raise InputError(
            f"cell {cell!r} has no fused form; only 'gru' and 'gru_paper' have: leave fused False"
        )
    if cell in ("gru", "gru_paper"):
        one_bias = cell == "gru_paper"
        return StackedGRU(
            networks, n_in, hidden, n_out, seed=seed, zero_head=zero_head, one_bias=one_bias, fused=fused
        )
    if cell == "lstm":
        return StackedLSTM(networks, n_in, hidden, n_out, seed=seed, zero_head=zero_head)
    if cell == "feed_forward":
        return StackedFeedForward(networks, n_in, hidden, n_out, seed=seed, zero_head=zero_head)
    raise InputError(f"no cell {cell!r}; there are 'gru', 'gru_paper', 'lstm' and 'feed_forward'")
