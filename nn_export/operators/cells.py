"""Recurrent cells in torch's form with their exact Jacobians: constant matrices with scaled rows.

With s the logistic function, W and R the weights of the input and of the hidden state, b and c the biases,
and for every gate the sum ``W x + b + R h + c``::

    GRU   r = s(.), z = s(.), q = Rn h + cn, n = tanh(Wn x + bn + r q), h+ = n + z (h - n)
          dh+/dx = diag(g) Wr + diag(a) Wz + diag(b) Wn              a = (h - n) z (1 - z)
          dh+/dh = diag(g) Rr + diag(a) Rz + diag(b r) Rn + diag(z)  b = (1 - n^2)(1 - z), g = b q r (1 - r)
    LSTM  i, f, o = s(.), g = tanh(.), c+ = f c + i g, h+ = o t, t = tanh(c+), k = o (1 - t^2)
          dc+/dx = diag(g i (1 - i)) Wi + diag(c f (1 - f)) Wf + diag(i (1 - g^2)) Wg,  dc+/dc = diag(f)
          dh+/dx = diag(k) dc+/dx + diag(t o (1 - o)) Wo, the same with R by h,         dh+/dc = diag(k f)
    RNN   h+ = a(.), dh+/dx = diag(a') W, dh+/dh = diag(a') R,  a = tanh or relu

Automatic differentiation makes the same matrices with one sweep of the cell a column.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from nn_export.operators.value import Value, matrix

Columns = Any
"""A matrix (n, batch) of CasADi or of numpy."""
State = tuple[ca.MX, ...]
Weights = tuple[Value, Value, Value | None, Value | None]
Factors = tuple[Columns | None, ...]


@dataclass(frozen=True)
class Slope:
    """Jacobian of one new state: row factors of the gates' blocks of ``W`` and of ``R``, and diagonals by old states.

    A factor is None for a gate that does not act.
    """

    by_input: Factors
    by_hidden: Factors
    diagonal: dict[int, Columns] = field(default_factory=dict)


@dataclass(frozen=True)
class Step:
    """One evaluation of a cell: new states (H, batch), the hidden state first, and the Jacobian of each."""

    state: tuple[Columns, ...]
    slopes: tuple[Slope, ...]


@dataclass(frozen=True)
class Kind:
    """A kind of cell: names of its states, the hidden state first, and its number of gates, blocks of rows in its
    weights.

    ``equations(W x + b, R h + c, state)`` is the cell on columns, all of MX or all of numpy.
    """

    name: str
    states: tuple[str, ...]
    gates: int
    equations: Callable[[Columns, Columns, tuple[Columns, ...]], Step]

    def step(self, x: ca.MX, state: State, w: Weights) -> Step:
        """The cell on columns."""
        return self.equations(affine(w[0], x, w[2]), affine(w[1], state[0], w[3]), state)

    def width(self, w: Weights) -> int:
        """Number of units: also right where a projection makes ``h`` shorter."""
        return w[0].shape[0] // self.gates


def gate(x: Columns) -> Columns:
    """Logistic function: in CasADi through tanh, right to 1e-16 of 1, for factors, and nothing can overflow; in numpy
    through exp, which takes half the time there and whose overflow gives 0.
    """
    return 0.5 + 0.5 * ca.tanh(0.5 * x) if isinstance(x, ca.MX) else 1.0 / (1.0 + np.exp(-x))


def affine(w: Value, x: ca.MX, b: Value | None) -> ca.MX:
    """``w x + b`` for the columns of ``x``."""
    by = matrix(w, *w.shape)
    if b is None:
        return ca.mtimes(by, x)
    return ca.mac(by, x, ca.repmat(matrix(b, b.shape[0], 1), 1, x.shape[1]))  # one instruction less


def _tanh(x: Columns) -> Columns:
    return ca.tanh(x) if isinstance(x, ca.MX) else np.tanh(x)


def _parts(x: Columns, count: int) -> Iterable[Columns]:
    if isinstance(x, ca.MX):
        return ca.vertsplit(x, x.shape[0] // count)
    return x.reshape(count, -1, x.shape[1])  # views; np.split takes longer than a product


def _positive(y: Columns, value: Columns) -> Columns:
    return ca.if_else(y > 0, value, 0.0) if isinstance(y, ca.MX) else np.where(y > 0, value, 0.0)


def _gru(x: Columns, hidden: Columns, state: tuple[Columns, ...]) -> Step:
    h = state[0]
    (xr, xz, xn), (hr, hz, q) = _parts(x, 3), _parts(hidden, 3)
    r, z = gate(xr + hr), gate(xz + hz)
    n = _tanh(xn + r * q)
    kept, new = z * (h - n), 1 - z
    a, b = kept * new, (1 - n * n) * new
    g = b * q * r * (1 - r)
    return Step((n + kept,), (Slope((g, a, b), (g, a, b * r), {0: z}),))


def _lstm(x: Columns, hidden: Columns, state: tuple[Columns, ...]) -> Step:
    c = state[1]
    at_i, at_f, at_g, at_o = _parts(x + hidden, 4)
    i, f, g, o = gate(at_i), gate(at_f), _tanh(at_g), gate(at_o)
    c_next = f * c + i * g
    t = _tanh(c_next)
    by = (g * i * (1 - i), c * f * (1 - f), i * (1 - g * g), None)
    k = o * (1 - t * t)
    by_output = (*(k * p for p in by[:3]), t * o * (1 - o))
    return Step((o * t, c_next), (Slope(by_output, by_output, {1: k * f}), Slope(by, by, {1: f})))


def _rnn_tanh(x: Columns, hidden: Columns, state: tuple[Columns, ...]) -> Step:
    y = _tanh(x + hidden)
    slope = 1 - y * y
    return Step((y,), (Slope((slope,), (slope,)),))


def _rnn_relu(x: Columns, hidden: Columns, state: tuple[Columns, ...]) -> Step:
    y = x + hidden
    slope = _positive(y, 1.0)
    return Step((_positive(y, y),), (Slope((slope,), (slope,)),))


GRU = Kind("gru_cell", ("h",), 3, _gru)
LSTM = Kind("lstm_cell", ("h", "c"), 4, _lstm)
RNN_TANH = Kind("rnn_tanh_cell", ("h",), 1, _rnn_tanh)
RNN_RELU = Kind("rnn_relu_cell", ("h",), 1, _rnn_relu)


def rows(w: Value, gates: int) -> list[ca.MX]:
    """The gates' blocks of a constant weight (gates x H, n), cut now and not at each call."""
    m = ca.evalf(matrix(w, *w.shape))
    n = w.shape[0] // gates
    return [ca.MX(m[i * n : (i + 1) * n, :]) for i in range(gates)]


def scaled(factors: Factors, blocks: list[ca.MX]) -> ca.MX:
    """``sum diag(factor) block``. Repeating the factor is faster than a product with a sparse diagonal."""
    pairs = [(f, m) for f, m in zip(factors, blocks, strict=True) if f is not None]
    return reduce(lambda a, b: a + b, (ca.repmat(f, 1, m.shape[1]) * m for f, m in pairs))


def plain(kind: Kind, x: ca.MX, state: State, w: Weights) -> State:
    """The cell as a plain graph."""
    return kind.step(x, state, w).state


def simple(x: ca.MX, w: Weights) -> bool:
    """True for one sample and constant weights."""
    return x.shape[1] == 1 and all(v is None or not ca.symvar(v.mx) for v in w)


def call(kind: Kind, x: ca.MX, state: State, w: Weights) -> State:
    """The cell as a call of a function that brings its own Jacobian; a plain graph for a batch.

    ``jac_penalty = 0`` makes CasADi multiply by this Jacobian instead of differentiating the cell; its
    own derivatives, and so all Hessians, are exact too.
    """
    if not simple(x, w):
        return plain(kind, x, state, w)
    symbols = [ca.MX.sym(name, v.shape[0]) for name, v in zip(("x", *kind.states), (x, *state), strict=True)]
    names = [s.name() for s in symbols]
    new = [f"{s}_next" for s in kind.states]
    step = kind.step(symbols[0], tuple(symbols[1:]), w)
    blocks = [b for slope in step.slopes for b in _blocks(slope, w, symbols)]
    sizes = [ca.MX(v.shape[0], 1) for v in step.state]
    jacobian = ca.Function(
        f"jac_{kind.name}",
        [*symbols, *sizes],
        blocks,
        [*names, *(f"out_{n}" for n in new)],
        [f"jac_{n}_{s}" for n in new for s in names],
    )
    options: dict[str, Any] = {"custom_jacobian": jacobian, "jac_penalty": 0, "never_inline": True}
    function = ca.Function(kind.name, symbols, list(step.state), names, new, options)
    return tuple(function.call([x, *state]))


def _blocks(slope: Slope, w: Weights, symbols: list[ca.MX]) -> list[ca.MX]:
    by_hidden = scaled(slope.by_hidden, rows(w[1], len(slope.by_hidden)))
    if 0 in slope.diagonal:
        by_hidden = by_hidden + ca.diag(slope.diagonal[0])
    others: list[Any] = [ca.diag(slope.diagonal[k]) for k in range(1, len(symbols) - 1)]
    return [scaled(slope.by_input, rows(w[0], len(slope.by_input))), by_hidden, *others]
