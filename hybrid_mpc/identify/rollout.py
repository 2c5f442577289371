"""Free runs of a stack of hybrids over many windows at once, with a hand-written derivative of the whole run.

Automatic differentiation would record some hundred operations in each period: those of the network, and those of the
prior in every stage of every sub-step. Here, one call of CasADi integrates a period of all runs and computes its exact
derivatives. The backward pass is a product with these derivatives and a few operations of the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybrid_mpc.identify.networks import StackedGRU, gate_matrices, step_back
from nn_export.vectorised import vectorised

Array = NDArray[np.float64]


class Rollout:
    """Free runs of ``s = features(x, u, w, p)``, ``c, h_next = network(s, h)``, ``x_next = flow(x, c, u, w, p)``.

    Args:
        features: Features of the network, as scalar operations.
        flow: State one period later, as scalar operations.
        scale: Scale from the network's output to ``c``, ``(n_c,)``.
    """

    def __init__(self, features: ca.Function, flow: ca.Function, scale: Tensor) -> None:
        self.n_x, self.n_c = flow.size1_in(0), flow.size1_in(1)
        self.n_in, self.scale = features.size1_out(0), scale
        x, c, u, w, p = flow.sx_in()
        point = features.sx_in()
        seen = features(*point)
        slopes = ca.Function("slopes", point, [ca.jacobian(seen, point[0]), ca.jacobian(seen, point[3])])
        u_next, w_next = ca.SX.sym("u_next", u.shape), ca.SX.sym("w_next", w.shape)
        x_next = flow(x, c, u, w, p)
        after, given = (x_next, u_next, w_next, p), [x, c, u, w, u_next, w_next, p]
        by_all = ca.jacobian(x_next, ca.vertcat(x, c, p))
        self._first = _SideBySide(point, [seen, *slopes(*point)])
        self._period = _SideBySide(given, [x_next, features(*after)])
        self._period_and_slopes = _SideBySide(given, [x_next, features(*after), by_all, *slopes(*after)])

    def __call__(self, network: StackedGRU, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor) -> Tensor:
        """States ``(T + 1, networks, n, n_x)`` from ``x`` ``(networks, n, n_x)`` and ``h`` ``(networks, n, z)``.

        ``u`` and ``w`` are ``(T, networks, n, ...)``, ``p`` ``(networks, 1, n_p)``. Differentiable once with respect to
        ``x``, ``h``, ``p`` and the network's weights.
        """
        recurrent, direct = gate_matrices(network.w_ih, network.w_hh, network.b_ih, network.b_hh)
        held = u.contiguous(), w.contiguous(), p.expand(-1, x.shape[1], -1).contiguous()
        weights = recurrent, direct, network.w_out * self.scale, network.b_out * self.scale
        states: Tensor = _FreeRun.apply(self, torch.is_grad_enabled(), x, h, *held, *weights)
        return states

    def run(
        self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor, weights: Sequence[Tensor], slopes: bool
    ) -> _Run:
        """Run forward; keeps all states, and the data of every period for the backward pass."""
        recurrent, direct, w_out, b_out = weights
        (networks, n, z), periods, count = h.shape, len(u), x.shape[0] * x.shape[1]
        run = _Run.empty(self, periods, networks, n, z, p.shape[-1], slopes)
        run.rows[:, 0, :, :z], run.rows[..., -1] = h, 1.0
        run.x[0] = x.flatten(0, 1).T
        # runs are the last axis for CasADi; the inputs of the last period are repeated
        u_at, w_at = (torch.cat([a, a[-1:]]).flatten(1, 2).mT.contiguous().numpy() for a in (u, w))
        p_at, x_at, c = p.flatten(0, 1).T.contiguous().numpy(), run.x.numpy(), _new(self.n_c, count)
        seen = _new(self.n_in, count)
        c_by_run, seen_by_run = (v.T.view(networks, n, -1) for v in (c, seen))
        c_at, seen_at = c.numpy(), seen.numpy()
        by_x, seen_by_x, seen_by_p = (a.numpy() for a in (run.flow_slopes, run.seen_by_x, run.seen_by_p))
        self._first((x_at[0], u_at[0], w_at[0], p_at), (seen_at, seen_by_x[0], seen_by_p[0]))
        for k in range(periods):
            now, g, candidate = run.rows[:, k], run.gates[k], run.candidate[k]
            now[..., z:-1] = seen_by_run
            torch.bmm(now, recurrent, out=g)
            torch.bmm(now[..., z:], direct, out=candidate)
            g[..., : 2 * z].sigmoid_()
            candidate.addcmul_(g[..., :z], g[..., 2 * z :]).tanh_()
            after = run.rows[:, k + 1, :, :z]
            torch.lerp(candidate, now[..., :z], g[..., z : 2 * z], out=after)
            c_by_run.copy_(torch.baddbmm(b_out, after, w_out))
            given = x_at[k], c_at, u_at[k], w_at[k], u_at[k + 1], w_at[k + 1], p_at
            if slopes:
                wanted = x_at[k + 1], seen_at, by_x[k], seen_by_x[k + 1], seen_by_p[k + 1]
                self._period_and_slopes(given, wanted)
            else:
                self._period(given, (x_at[k + 1], seen_at))
        return run


@dataclass(frozen=True)
class _Run:
    """Data of a free run for the backward pass: states ``(T + 1, n_x, runs)``, derivatives ``(columns, rows, runs)``.

    A row in ``rows`` ``(networks, T + 1, n, z + n_in + 1)`` is ``[h, s, 1]``; ``gates`` ``(T, networks, n, 3 z)`` are
    r, z and the factor of r in the candidate.
    """

    x: Tensor
    rows: Tensor
    gates: Tensor
    candidate: Tensor
    flow_slopes: Tensor
    seen_by_x: Tensor
    seen_by_p: Tensor

    @classmethod
    def empty(cls, of: Rollout, periods: int, networks: int, n: int, z: int, n_p: int, slopes: bool) -> _Run:
        """Allocate memory for a run; without ``slopes``, derivatives of the first period only."""
        count, kept, new = networks * n, periods if slopes else 0, _new
        return cls(
            new(periods + 1, of.n_x, count), new(networks, periods + 1, n, z + of.n_in + 1),
            new(periods, networks, n, 3 * z), new(periods, networks, n, z),
            new(kept, of.n_x + of.n_c + n_p, of.n_x, count), new(kept + 1, of.n_x, of.n_in, count),
            new(kept + 1, n_p, of.n_in, count),
        )  # fmt: skip


def _new(*shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.float64)


class _FreeRun(torch.autograd.Function):
    """All states of a run, as a function with a hand-written derivative."""

    @staticmethod
    def forward(ctx: Any, rollout: Rollout, slopes: bool, *given: Tensor) -> Tensor:
        x, h, u, w, p, *weights = given
        run = rollout.run(x, h, u, w, p, weights, slopes)
        ctx.rollout, ctx.run = rollout, run
        ctx.save_for_backward(*weights)
        return run.x.mT.unflatten(1, h.shape[:2])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        recurrent, direct, w_out, _ = ctx.saved_tensors
        run, n_x, n_c = ctx.run, ctx.rollout.n_x, ctx.rollout.n_c
        periods, networks, n, z = run.candidate.shape
        by_h, by_seen, direct_back, out_back = recurrent[:, :z].mT, recurrent[:, z:].mT, direct.mT, w_out.mT
        gates, candidates = _new(networks, periods, n, 3 * z), _new(networks, periods, n, z)
        outputs = _new(networks, periods, n, n_c)
        dh, carry = torch.zeros(2, networks, n, z, dtype=grad.dtype)
        by_p = torch.zeros(run.seen_by_p.shape[1], networks * n, dtype=grad.dtype)
        own = grad.flatten(1, 2).mT.contiguous()
        x_bar = own[periods]
        for k in range(periods - 1, -1, -1):
            back = (run.flow_slopes[k] * x_bar).sum(1)
            out = back[n_x : n_x + n_c].T.view(networks, n, n_c)
            outputs[:, k] = out
            d, d_n = gates[:, k], candidates[:, k]
            by_out, h = torch.bmm(out, out_back), run.rows[:, k, :, :z]
            step_back(by_out, carry, dh, h, run.gates[k], run.candidate[k], d, d_n)
            carry.baddbmm_(d, by_h)
            seen = torch.bmm(d, by_seen).baddbmm_(d_n, direct_back)[..., :-1].flatten(0, 1).T
            x_bar = back[:n_x] + (run.seen_by_x[k] * seen).sum(1)
            x_bar += own[k]
            if len(by_p):
                by_p += back[n_x + n_c :] + (run.seen_by_p[k] * seen).sum(1)
        rows = run.rows[:, :-1].flatten(1, 2)
        d_recurrent = rows.mT @ gates.flatten(1, 2)
        d_direct = rows[..., z:].mT @ candidates.flatten(1, 2)
        d_out = run.rows[:, 1:, :, :z].flatten(1, 2).mT @ outputs.flatten(1, 2)
        by_x, by_p = (v.T.unflatten(0, (networks, n)) for v in (x_bar, by_p))
        return (
            None,
            None,
            by_x,
            carry,
            None,
            None,
            by_p,
            d_recurrent,
            d_direct,
            d_out,
            outputs.sum((1, 2)).unsqueeze(1),
        )


class _SideBySide:
    """Scalar operations vectorized over many runs, on given memory."""

    def __init__(self, given: Sequence[ca.SX], wanted: Sequence[ca.SX]) -> None:
        self._used, self._kept = ([i for i, a in enumerate(every) if a.numel()] for every in (given, wanted))
        outs = [ca.densify(wanted[i]) for i in self._kept]
        function = ca.Function("period", [given[i] for i in self._used], ca.cse(outs))

        @cache
        def at(runs: int) -> tuple[Any, Any, Any]:
            side_by_side = vectorised(function, runs)
            return side_by_side, *side_by_side.buffer()

        self._at = at

    def __call__(self, given: Sequence[Array], wanted: Sequence[Array]) -> None:
        """Evaluate; all arrays are contiguous, runs are the last axis, and matrices are stored column by column."""
        _, buffer, evaluate = self._at(given[0].shape[-1])
        for i, k in enumerate(self._used):
            buffer.set_arg(i, memoryview(given[k].data))
        for i, k in enumerate(self._kept):
            buffer.set_res(i, memoryview(wanted[k].data))
        evaluate()
