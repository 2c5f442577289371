"""Recurrent cells in torch's form with their exact Jacobians: constant matrices with scaled rows.

GRU, with r = s(Wr x + br + Rr h + cr), z = s(Wz x + bz + Rz h + cz), q = Rn h + cn,
n = tanh(Wn x + bn + r q) and h+ = n + z (h - n)::

    dh+/dx = diag(a) Wz + diag(c) Wr + diag(b) Wn              a = (h - n) z (1 - z)
    dh+/dh = diag(a) Rz + diag(c) Rr + diag(b r) Rn + diag(z)  b = (1 - n^2) (1 - z),  c = b q r (1 - r)

LSTM, with i, f, o = s(.), g = tanh(.), c+ = f c + i g, t = tanh(c+), h+ = o t, e = o (1 - t^2)::

    dc+/dx = diag(g i (1 - i)) Wi + diag(c f (1 - f)) Wf + diag(i (1 - g^2)) Wg,     dc+/dc = diag(f)
    dh+/dx = diag(e) dc+/dx + diag(t o (1 - o)) Wo,                                  dh+/dc = diag(e f)

and the same by h with R in place of W. RNN, h+ = tanh(y): diag(1 - h+^2) W; relu(y): diag(y > 0) W.

Automatic differentiation makes the same matrices with one sweep of the cell a column.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from nn_export.operators.elementwise import gate
from nn_export.operators.value import Value, matrix

State = tuple[ca.MX, ...]
Weights = tuple[Value, Value, Value | None, Value | None]
Factors = tuple[ca.MX | None, ...]


@dataclass(frozen=True)
class Cell:
    """One evaluation of a cell with the factors of its Jacobian; None is 0.

    Args:
        state: New states (H, batch).
        by_input: For each new state the row factors of each gate's block of the input weights.
        by_hidden: For each new state the row factors of each gate's block of the hidden weights.
        direct: For each new state the diagonals of its slopes by each old state, beside those through
            the weights.
    """

    state: State
    by_input: tuple[Factors, ...]
    by_hidden: tuple[Factors, ...]
    direct: tuple[Factors, ...]


Kind = Callable[[ca.MX, State, Weights], Cell]
Call = Callable[[Kind, ca.MX, State, Weights], State]


def affine(w: Value, x: ca.MX, b: Value | None) -> ca.MX:
    """``w x + b`` for the columns of ``x``."""
    y = ca.mtimes(matrix(w, *w.shape), x)
    return y if b is None else y + ca.repmat(matrix(b, b.shape[0], 1), 1, x.shape[1])


def gru(x: ca.MX, state: State, w: Weights) -> Cell:
    """GRU cell at columns ``x`` (F, batch) and ``h`` (H, batch)."""
    h = state[0]
    xr, xz, xn = ca.vertsplit(affine(w[0], x, w[2]), h.shape[0])
    hr, hz, q = ca.vertsplit(affine(w[1], h, w[3]), h.shape[0])
    r, z = gate(xr + hr), gate(xz + hz)
    n = ca.tanh(xn + r * q)
    a, b = (h - n) * z * (1 - z), (1 - n * n) * (1 - z)
    c = b * q * r * (1 - r)
    return Cell((n + z * (h - n),), ((c, a, b),), ((c, a, b * r),), ((z,),))


def lstm(x: ca.MX, state: State, w: Weights) -> Cell:
    """LSTM cell at columns ``x`` (F, batch), ``h`` (H or its projection, batch) and ``c`` (H, batch).

    The new hidden state is the one before a projection.
    """
    h, c = state
    yi, yf, yg, yo = ca.vertsplit(affine(w[0], x, w[2]) + affine(w[1], h, w[3]), c.shape[0])
    i, f, g, o = gate(yi), gate(yf), ca.tanh(yg), gate(yo)
    c_next = f * c + i * g
    t = ca.tanh(c_next)
    e = o * (1 - t * t)
    by_i, by_f, by_g = g * i * (1 - i), c * f * (1 - f), i * (1 - g * g)
    factors: tuple[Factors, ...] = (
        (e * by_i, e * by_f, e * by_g, t * o * (1 - o)),
        (by_i, by_f, by_g, None),
    )
    return Cell((o * t, c_next), factors, factors, ((None, e * f), (None, f)))


def rnn_tanh(x: ca.MX, state: State, w: Weights) -> Cell:
    """Elman cell with tanh."""
    h = ca.tanh(affine(w[0], x, w[2]) + affine(w[1], state[0], w[3]))
    factors: tuple[Factors, ...] = ((1 - h * h,),)
    return Cell((h,), factors, factors, ((None,),))


def rnn_relu(x: ca.MX, state: State, w: Weights) -> Cell:
    """Elman cell with the rectifier."""
    y = affine(w[0], x, w[2]) + affine(w[1], state[0], w[3])
    factors: tuple[Factors, ...] = ((y > 0,),)
    return Cell((ca.if_else(y > 0, y, 0.0),), factors, factors, ((None,),))


def gates(w: Value, hidden: int) -> list[ca.MX]:
    """The gates' blocks of a constant weight (k H, n), cut now and not at each call."""
    m = ca.evalf(matrix(w, *w.shape))
    return [ca.MX(m[i : i + hidden, :]) for i in range(0, m.shape[0], hidden)]


def scaled(factors: Factors, blocks: Sequence[ca.MX]) -> ca.MX:
    """``sum diag(factor) block``. Repeating the factor is faster than a product with a sparse diagonal."""
    pairs = zip(factors, blocks, strict=True)
    parts = [ca.repmat(f, 1, m.shape[1]) * m for f, m in pairs if f is not None]
    return sum(parts[1:], parts[0])


def simple(x: ca.MX, w: Weights) -> bool:
    """True for one sample and constant weights: only then is a Jacobian a scaled constant."""
    return x.shape[1] == 1 and all(v is None or not ca.symvar(v.mx) for v in w)


def plain(kind: Kind, x: ca.MX, state: State, w: Weights) -> State:
    """The cell as a plain graph."""
    return kind(x, state, w).state


def called(kind: Kind, x: ca.MX, state: State, w: Weights) -> State:
    """The cell as a call of :func:`cell_function`; a plain graph for a batch or for computed weights."""
    if not simple(x, w):
        return plain(kind, x, state, w)
    return tuple(cell_function(kind, x.shape[0], [s.shape[0] for s in state], w).call([x, *state]))


def cell_function(kind: Kind, n_x: int, sizes: Sequence[int], w: Weights) -> ca.Function:
    """The cell as a function ``(x, *states) -> new states`` that brings its own Jacobian.

    ``jac_penalty = 0`` makes CasADi multiply by this Jacobian instead of differentiating the cell; its
    own derivatives, and so all Hessians, are exact too.
    """
    x, states = ca.MX.sym("x", n_x), tuple(ca.MX.sym(f"s{i}", n) for i, n in enumerate(sizes))
    at, hidden = kind(x, states, w), sizes[-1]
    w_gates, r_gates = gates(w[0], hidden), gates(w[1], hidden)
    slopes: list[Any] = []
    for by_input, by_hidden, direct in zip(at.by_input, at.by_hidden, at.direct, strict=True):
        row = [scaled(by_input, w_gates), scaled(by_hidden, r_gates)]
        row += [ca.MX(hidden, n) for n in sizes[1:]]
        for i, diagonal in enumerate(direct):
            if diagonal is not None:
                row[1 + i] += ca.diag(diagonal)
        slopes += row
    n_in, n_out = ["x", *(f"s{i}" for i in range(len(sizes)))], [f"y{i}" for i in range(len(sizes))]
    jacobian = ca.Function(
        f"jac_{kind.__name__}_cell",
        [x, *states, *(ca.MX(*y.shape) for y in at.state)],
        slopes,
        [*n_in, *(f"out_{n}" for n in n_out)],
        [f"jac_{o}_{i}" for o in n_out for i in n_in],
    )
    options: dict[str, Any] = {"custom_jacobian": jacobian, "jac_penalty": 0, "never_inline": True}
    return ca.Function(f"{kind.__name__}_cell", [x, *states], list(at.state), n_in, n_out, options)
