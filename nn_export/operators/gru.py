"""The GRU cell in torch's form and its exact Jacobian: constant matrices with scaled rows.

With r = s(Wr x + br + Rr h + cr), z = s(Wz x + bz + Rz h + cz), q = Rn h + cn, n = tanh(Wn x + bn + r q) and
h+ = n + z (h - n)::

    dh+/dx = diag(a) Wz + diag(c) Wr + diag(b) Wn              a = (h - n) z (1 - z)
    dh+/dh = diag(a) Rz + diag(c) Rr + diag(b r) Rn + diag(z)  b = (1 - n^2) (1 - z),  c = b q r (1 - r)

Automatic differentiation makes the same matrices with one sweep of the cell a column.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from nn_export.operators.elementwise import gate
from nn_export.operators.value import Value, matrix

State = tuple[ca.MX, ...]
Weights = tuple[Value, Value, Value | None, Value | None]
Triple = tuple[ca.MX, ca.MX, ca.MX]


@dataclass(frozen=True)
class Cell:
    """One evaluation of the cell with the factors of its Jacobian.

    Args:
        h_next: New hidden state (H, batch).
        z: Update gate (H, batch).
        by_input: Row factors of ``Wr, Wz, Wn``.
        by_hidden: Row factors of ``Rr, Rz, Rn``.
    """

    h_next: ca.MX
    z: ca.MX
    by_input: Triple
    by_hidden: Triple


def affine(w: Value, x: ca.MX, b: Value | None) -> ca.MX:
    """``w x + b`` for the columns of ``x``."""
    y = ca.mtimes(matrix(w, *w.shape), x)
    return y if b is None else y + ca.repmat(matrix(b, b.shape[0], 1), 1, x.shape[1])


def cell(x: ca.MX, h: ca.MX, w: Weights) -> Cell:
    """The cell at columns ``x`` (F, batch) and ``h`` (H, batch)."""
    xr, xz, xn = ca.vertsplit(affine(w[0], x, w[2]), h.shape[0])
    hr, hz, q = ca.vertsplit(affine(w[1], h, w[3]), h.shape[0])
    r, z = gate(xr + hr), gate(xz + hz)
    n = ca.tanh(xn + r * q)
    a, b = (h - n) * z * (1 - z), (1 - n * n) * (1 - z)
    c = b * q * r * (1 - r)
    return Cell(n + z * (h - n), z, (c, a, b), (c, a, b * r))


def rows(w: Value, hidden: int) -> Triple:
    """The three gates' blocks ``r, z, n`` of a constant weight (3 H, n), cut now and not at each call."""
    m = ca.evalf(matrix(w, *w.shape))
    r, z, n = (ca.MX(m[i * hidden : (i + 1) * hidden, :]) for i in range(3))
    return r, z, n


def scaled(factors: Triple, blocks: Triple) -> ca.MX:
    """``sum diag(factor) block``. Repeating the factor is faster than a product with a sparse diagonal."""
    parts = [ca.repmat(f, 1, m.shape[1]) * m for f, m in zip(factors, blocks, strict=True)]
    return parts[0] + parts[1] + parts[2]


def gru(x: ca.MX, state: State, w: Weights) -> State:
    """The cell as a plain graph."""
    return (cell(x, state[0], w).h_next,)


def simple(x: ca.MX, w: Weights) -> bool:
    """True for one sample and constant weights."""
    return x.shape[1] == 1 and all(v is None or not ca.symvar(v.mx) for v in w)


def gru_call(x: ca.MX, state: State, w: Weights) -> State:
    """The cell as a call of a function that brings its own Jacobian; a plain graph for a batch.

    ``jac_penalty = 0`` makes CasADi multiply by this Jacobian instead of differentiating the cell; its
    own derivatives, and so all Hessians, are exact too.
    """
    if not simple(x, w):
        return gru(x, state, w)
    s, h = ca.MX.sym("s", x.shape[0]), ca.MX.sym("h", state[0].shape[0])
    at, n = cell(s, h, w), h.shape[0]
    by_input, by_hidden = scaled(at.by_input, rows(w[0], n)), scaled(at.by_hidden, rows(w[1], n))
    slopes: list[Any] = [by_input, by_hidden + ca.diag(at.z)]
    names = ["s", "h", "out_h_next"], ["jac_h_next_s", "jac_h_next_h"]
    jacobian = ca.Function("jac_gru_cell", [s, h, ca.MX(n, 1)], slopes, *names)
    options: dict[str, Any] = {"custom_jacobian": jacobian, "jac_penalty": 0, "never_inline": True}
    function = ca.Function("gru_cell", [s, h], [at.h_next], ["s", "h"], ["h_next"], options)
    return (function(x, state[0]),)
