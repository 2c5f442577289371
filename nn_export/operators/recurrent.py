"""Recurrent layers and cells in torch's form, kept whole.

GRU: r = s(Wr x + br + Rr h + cr), z = s(Wz x + bz + Rz h + cz), n = tanh(Wn x + bn + r (Rn h + cn)),
h+ = (1 - z) n + z h. LSTM: i, f, o = s(.), g = tanh(.), c+ = f c + i g, h+ = o tanh(c+).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from nn_export.operators.elementwise import gate
from nn_export.operators.gru import State, Weights, affine, gru, gru_call
from nn_export.operators.shape import flip, stack
from nn_export.operators.value import Value, arrange, concatenate, from_matrix, move

Cell = Callable[[ca.MX, State, Weights], State]


def _lstm(x: ca.MX, state: State, w: Weights) -> State:
    h, c = state
    i, f, g, o = ca.vertsplit(affine(w[0], x, w[2]) + affine(w[1], h, w[3]), c.shape[0])
    c = gate(f) * c + gate(i) * ca.tanh(g)
    return gate(o) * ca.tanh(c), c


def _tanh(x: ca.MX, state: State, w: Weights) -> State:
    return (ca.tanh(affine(w[0], x, w[2]) + affine(w[1], state[0], w[3])),)


def _relu(x: ca.MX, state: State, w: Weights) -> State:
    y = affine(w[0], x, w[2]) + affine(w[1], state[0], w[3])
    return (ca.if_else(y > 0, y, 0.0),)


def _columns(value: Value) -> ca.MX:  # (batch, n) or (n,) as n x batch
    positions = value.positions.reshape(-1, value.shape[-1])
    return arrange(value.mx, positions.T)


def _cell(cell: Cell) -> Callable[..., Value]:
    def operator(
        input: Value,
        hx: Value,
        w_ih: Value,
        w_hh: Value,
        b_ih: Value | None = None,
        b_hh: Value | None = None,
    ) -> Value:
        result = cell(_columns(input), (_columns(hx),), (w_ih, w_hh, b_ih, b_hh))
        return from_matrix(result[0].T, hx.shape)

    return operator


def lstm_cell(
    input: Value,
    hx: Sequence[Value],
    w_ih: Value,
    w_hh: Value,
    b_ih: Value | None = None,
    b_hh: Value | None = None,
) -> tuple[Value, ...]:
    """One step of an LSTM: new hidden state and cell state."""
    new = _lstm(_columns(input), tuple(_columns(v) for v in hx), (w_ih, w_hh, b_ih, b_hh))
    return tuple(from_matrix(mx.T, v.shape) for mx, v in zip(new, hx, strict=True))


def _run(
    cell: Cell, x: Value, states: Sequence[Value], w: Weights, reverse: bool
) -> tuple[Value, list[Value]]:
    """One direction of one layer over ``x`` (T, B, F); states (B, H)."""
    x = flip(x, [0]) if reverse else x
    state = tuple(_columns(v) for v in states)
    steps = []
    for positions in x.positions:
        state = cell(arrange(x.mx, positions.T), state, w)
        steps.append(from_matrix(state[0].T, states[0].shape))
    y = stack(steps, 0)
    return flip(y, [0]) if reverse else y, [
        from_matrix(s.T, v.shape) for s, v in zip(state, states, strict=True)
    ]


def _sequence(
    cell: Cell,
    x: Value,
    states: Sequence[Value],
    params: Sequence[Value],
    has_biases: bool,
    num_layers: int,
    dropout: float,
    train: bool,
    bidirectional: bool,
    batch_first: bool,
) -> tuple[Value, ...]:
    if train and dropout:
        raise ValueError("dropout in training mode; use eval()")
    directions, size = 2 if bidirectional else 1, 4 if has_biases else 2
    if len(params) != num_layers * directions * size:
        raise ValueError(f"{len(params)} weights; projections (proj_size) are not supported")
    swap = (1, 0, 2)
    x = move(x, x.positions.transpose(swap)) if batch_first else x
    finals: list[list[Value]] = [[] for _ in states]
    for layer in range(num_layers):
        outputs = []
        for d in range(directions):
            k = layer * directions + d
            w = [*params[k * size : (k + 1) * size], None, None]
            first = [move(v, v.positions[k]) for v in states]
            y, last = _run(cell, x, first, (params[k * size], params[k * size + 1], w[2], w[3]), d == 1)
            outputs.append(y)
            for kept, value in zip(finals, last, strict=True):
                kept.append(value)
        x = concatenate(outputs, 2) if directions == 2 else outputs[0]
    x = move(x, x.positions.transpose(swap)) if batch_first else x
    return x, *(stack(values, 0) for values in finals)


def _layer(cell: Cell) -> Callable[..., tuple[Value, ...]]:
    def operator(
        input: Value,
        hx: Value,
        params: Sequence[Value],
        has_biases: bool,
        num_layers: int,
        dropout: float,
        train: bool,
        bidirectional: bool,
        batch_first: bool,
    ) -> tuple[Value, ...]:
        flags = (has_biases, num_layers, dropout, train, bidirectional, batch_first)
        return _sequence(cell, input, [hx], params, *flags)

    return operator


def lstm(
    input: Value,
    hx: Sequence[Value],
    params: Sequence[Value],
    has_biases: bool,
    num_layers: int,
    dropout: float,
    train: bool,
    bidirectional: bool,
    batch_first: bool,
) -> tuple[Value, ...]:
    """A stacked LSTM over a sequence: outputs, last hidden states, last cell states."""
    flags = (has_biases, num_layers, dropout, train, bidirectional, batch_first)
    return _sequence(_lstm, input, hx, params, *flags)


def table(gru: Cell) -> dict[str, Callable[..., Value | tuple[Value, ...]]]:
    """The operators with a form of the GRU cell: ``gru(x, (h,), weights) -> (h_next,)`` on columns."""
    return {
        "aten.gru.input": _layer(gru), "aten.rnn_tanh.input": _layer(_tanh),
        "aten.rnn_relu.input": _layer(_relu), "aten.lstm.input": lstm, "aten.gru_cell.default": _cell(gru),
        "aten.rnn_tanh_cell.default": _cell(_tanh), "aten.rnn_relu_cell.default": _cell(_relu),
        "aten.lstm_cell.default": lstm_cell,
    }  # fmt: skip


OPERATORS = table(gru_call)
PLAIN = table(gru)
"""The same without the cell's own Jacobian."""
