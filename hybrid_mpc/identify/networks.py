"""LSTM and feed-forward networks beside the GRU, one and stacked; and stacks by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hybrid_mpc.errors import InputError

# A stack of GRUs along a sequence with few operations a time step and a derivative written by hand.
#
# Automatic differentiation records a dozen operations a time step, and walks back through three times as many; each
# costs a launch, allocates its result, and every step adds to the gradients of all weights. Here a step is one matrix
# product (hidden state, features and bias in one row) and four operations on the gates, written into memory that is
# allocated once. The equations are those of :class:`~hybrid_mpc.identify.networks.StackedGRU`; sums run in
# another order, so results differ by rounding.


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


# Networks that correct a prior: one network as it is exported, several stacked for training.
#
# All of them are ``(s, h) -> (output, h_next)`` with the hidden state h an explicit vector; here are the GRUs and what
# a stack has to be, :mod:`hybrid_mpc.identify.networks` has the others and makes them by name.

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
            (:func:`~hybrid_mpc.identify.networks.fused_states`): faster, other rounding.

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
