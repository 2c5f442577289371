"""Networks that correct a prior: one network as it is exported, several stacked for training.

All of them are ``(s, h) -> (output, h_next)`` with the hidden state h an explicit vector; here are the GRUs and what
a stack has to be, :mod:`hybrid_mpc.identification.cells` has the others and makes them by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from hybrid_mpc.identification.fused_gru import fused_states

Uniform = Callable[..., nn.Parameter]
"""``uniform(*shape)``: a stacked weight ``(networks, *shape)`` of random numbers."""


class Network(nn.Module):
    """One network as it is exported: ``(s, h) -> (output, h_next)``; h is never kept inside.

    Args:
        hidden: Number of hidden units z.
        n_out: Number of outputs.
        n_h: Size of the hidden state; default: z.
    """

    def __init__(self, hidden: int, n_out: int, n_h: int | None = None) -> None:
        super().__init__()
        self.hidden, self.n_h = hidden, hidden if n_h is None else n_h

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(..., n_out)`` and next hidden state for features ``(..., n_in)`` and ``h (..., n_h)``."""
        raise NotImplementedError(f"{type(self).__name__} must define forward(s, h)")


class GRUNetwork(Network):
    """One GRU layer and one linear layer.

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
        super().__init__(hidden, n_out)
        self.cell = nn.GRUCell(n_in, hidden, dtype=torch.float64)
        self.head = nn.Linear(hidden, n_out, dtype=torch.float64)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(..., n_out)`` and next hidden state for features ``(..., n_in)`` and ``h``."""
        h_next = self.cell(s, h)
        return self.head(h_next), h_next


class StackedNetwork(nn.Module):
    """``networks`` independent networks with stacked weights, trained at once: what every stack can do.

    The tensors carry the network as first axis, ``(networks, batch, features)``. Small networks are
    bound by the cost of launching operations, so several cost little more than one.

    A subclass makes its weights in ``_make`` and defines ``forward``, ``sequence`` and ``member``.

    Args:
        networks: Number of networks.
        n_in: Number of input features.
        hidden: Number of hidden units z.
        n_out: Number of outputs.
        seed: Seed of the initial weights; network i of one seed is the same whatever ``networks`` is.
        zero_head: Start with zero output, so that a hybrid starts as its prior.
    """

    w_out: Tensor
    b_out: Tensor

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

        self._make(uniform)
        self.w_out, self.b_out = uniform(hidden, n_out), uniform(1, n_out)
        if zero_head:
            nn.init.zeros_(self.w_out)
            nn.init.zeros_(self.b_out)

    @property
    def n_h(self) -> int:
        """Size of the hidden state of one network."""
        return self.hidden

    def initial(self, batch: int) -> Tensor:
        """Zero hidden states ``(networks, batch, n_h)``."""
        return self.w_out.new_zeros(self.networks, batch, self.n_h)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(networks, batch, n_out)`` and next hidden state for ``s (networks, batch, n_in)``."""
        raise NotImplementedError(f"{type(self).__name__} must define forward(s, h)")

    def sequence(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs ``(T, networks, batch, n_out)`` and last h; features ``(T, networks, batch, n_in)``.

        The features may be the same for all networks, ``(T, 1, batch, n_in)``.
        """
        raise NotImplementedError(f"{type(self).__name__} must define sequence(s, h)")

    def member(self, i: int) -> Network:
        """Network ``i`` as one :class:`Network` with the same weights."""
        raise NotImplementedError(f"{type(self).__name__} must define member(i)")

    def _make(self, uniform: Uniform) -> None:
        raise NotImplementedError(f"{type(self).__name__} must define _make(uniform)")


class StackedRecurrent(StackedNetwork):
    """Recurrent networks whose gates are sums of a part by the features and a part by h."""

    gates = 0
    """Blocks of z gates; a subclass names its number."""
    w_ih: Tensor
    w_hh: Tensor
    b_ih: Tensor
    b_hh: Tensor

    def _make(self, uniform: Uniform) -> None:
        size = self.gates * self.hidden
        self.w_ih, self.w_hh = uniform(self.n_in, size), uniform(self.hidden, size)
        self.b_ih, self.b_hh = uniform(1, size), uniform(1, size)

    def forward(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Output ``(networks, batch, n_out)`` and next hidden state for ``s (networks, batch, n_in)``."""
        h_next = self._cell(torch.baddbmm(self.b_ih, s, self.w_ih), h)
        return torch.baddbmm(self.b_out, self._seen(h_next), self.w_out), h_next

    def sequence(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs ``(T, networks, batch, n_out)`` and last h; features ``(T, networks, batch, n_in)``."""
        gates = torch.matmul(s, self.w_ih) + self.b_ih
        states = []
        for gate in gates:
            h = self._cell(gate, h)
            states.append(self._seen(h))
        return torch.matmul(torch.stack(states), self.w_out) + self.b_out, h

    def member(self, i: int) -> Network:
        """Network ``i`` as one :class:`Network` with the same weights."""
        network = self._single()
        cell = {"weight_ih": self.w_ih, "weight_hh": self.w_hh, "bias_ih": self.b_ih, "bias_hh": self.b_hh}
        stacked = {f"cell.{name}": weight for name, weight in cell.items()}
        stacked |= {"head.weight": self.w_out, "head.bias": self.b_out}
        # a row of biases is a matrix (1, n) here and a vector there
        network.load_state_dict({n: w[i].T if "weight" in n else w[i, 0] for n, w in stacked.items()})
        return network

    def _cell(self, gate_in: Tensor, h: Tensor) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__} must define _cell(gate_in, h)")

    def _seen(self, h: Tensor) -> Tensor:
        """The part of h that the linear layer sees."""
        return h

    def _single(self) -> Network:
        raise NotImplementedError(f"{type(self).__name__} must define _single()")


class StackedGRU(StackedRecurrent):
    """Several :class:`GRUNetwork` with stacked weights.

    Args:
        networks: Number of networks.
        n_in: Number of input features.
        hidden: Number of hidden units z.
        n_out: Number of outputs.
        seed: Seed of the initial weights; network i of one seed is the same whatever ``networks`` is.
        zero_head: Start with zero output, so that a hybrid starts as its prior.
        one_bias: The paper's form: the bias inside the reset product, ``b_hh``, is zero and stays so. All
            other initial weights are those of torch's form with the same seed.
        fused: :meth:`sequence` with few operations a time step
            (:func:`~hybrid_mpc.identification.fused_gru.fused_states`): faster, other rounding.

    Example:
        >>> net = StackedGRU(2, 3, 4, 1, seed=0)
        >>> s = torch.rand(2, 5, 3, dtype=torch.float64)
        >>> out, h = net(s, net.initial(5))
        >>> one, _ = net.member(1)(s[1], h.new_zeros(5, 4))
        >>> torch.allclose(out[1], one, atol=1e-14)
        True
    """

    gates = 3

    def __init__(
        self,
        networks: int,
        n_in: int,
        hidden: int,
        n_out: int,
        *,
        seed: int,
        zero_head: bool = False,
        one_bias: bool = False,
        fused: bool = False,
    ) -> None:
        super().__init__(networks, n_in, hidden, n_out, seed=seed, zero_head=zero_head)
        self.fused = fused
        if one_bias:
            zeros = torch.zeros_like(self.b_hh.detach())
            del self.b_hh
            # no part of the state: it is no weight, and weights are loaded without it
            self.register_buffer("b_hh", zeros, persistent=False)

    def sequence(self, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs ``(T, networks, batch, n_out)`` and last h; features ``(T, networks, batch, n_in)``."""
        if not self.fused:
            return super().sequence(s, h)
        states = fused_states(s, h, self.w_ih, self.w_hh, self.b_ih, self.b_hh)
        outputs = torch.baddbmm(self.b_out, states.flatten(1, 2), self.w_out).unflatten(1, states.shape[1:3])
        return outputs.transpose(0, 1), states[:, -1]

    def _cell(self, gate_in: Tensor, h: Tensor) -> Tensor:
        gate_h = torch.baddbmm(self.b_hh, h, self.w_hh)
        n = 2 * self.hidden
        rz = torch.sigmoid(gate_in[..., :n] + gate_h[..., :n])
        r, z = rz[..., : self.hidden], rz[..., self.hidden :]
        candidate = torch.tanh(gate_in[..., n:] + r * gate_h[..., n:])
        return candidate + z * (h - candidate)

    def _single(self) -> GRUNetwork:
        return GRUNetwork(self.n_in, self.hidden, self.n_out)
