"""Recurrent layers and cells in torch's form, kept whole; :mod:`nn_export.operators.cells` has the equations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import casadi as ca

from nn_export.operators import cells
from nn_export.operators.cells import Kind, State, Weights
from nn_export.operators.shape import flip, stack
from nn_export.operators.value import Value, arrange, concatenate, from_matrix, matrix, move, unrolled

Cell = Callable[[ca.MX, State, Weights], State]
Form = Callable[[Kind, ca.MX, State, Weights], State]
"""How a cell of some kind is written: a plain graph, a call, or a symbol that stands for it."""


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


def _lstm_cell(cell: Cell) -> Callable[..., tuple[Value, ...]]:
    def operator(
        input: Value,
        hx: Sequence[Value],
        w_ih: Value,
        w_hh: Value,
        b_ih: Value | None = None,
        b_hh: Value | None = None,
    ) -> tuple[Value, ...]:
        new = cell(_columns(input), tuple(_columns(v) for v in hx), (w_ih, w_hh, b_ih, b_hh))
        return tuple(from_matrix(mx.T, v.shape) for mx, v in zip(new, hx, strict=True))

    return operator


def _run(
    cell: Cell, x: Value, states: Sequence[Value], w: Weights, projection: Value | None, reverse: bool
) -> tuple[Value, list[Value]]:
    """One direction of one layer over ``x`` (T, B, F); states (B, H); ``projection`` (P, H) of ``h``."""
    unrolled(x.shape[0])
    x = flip(x, [0]) if reverse else x
    state = tuple(_columns(v) for v in states)
    steps = []
    for positions in x.positions:
        state = cell(arrange(x.mx, positions.T), state, w)
        if projection is not None:
            state = (ca.mtimes(matrix(projection, *projection.shape), state[0]), *state[1:])
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
        raise ValueError("dropout in training mode; use eval() [NN-054]")
    directions = 2 if bidirectional else 1
    unrolled(num_layers * max(x.shape, default=1))  # whichever axis is time
    size, left = divmod(len(params), num_layers * directions)
    whole = 4 if has_biases else 2
    if left or size not in (whole, whole + 1):
        raise ValueError(f"{len(params)} weights for {num_layers} layers of {directions} directions [NN-055]")
    swap = (1, 0, 2)
    x = move(x, x.positions.transpose(swap)) if batch_first else x
    finals: list[list[Value]] = [[] for _ in states]
    for layer in range(num_layers):
        outputs = []
        for d in range(directions):
            k = layer * directions + d
            w = params[k * size : (k + 1) * size]
            b_ih, b_hh = (w[2], w[3]) if has_biases else (None, None)
            first = [move(v, v.positions[k]) for v in states]
            projection = w[-1] if size > whole else None
            y, last = _run(cell, x, first, (w[0], w[1], b_ih, b_hh), projection, d == 1)
            outputs.append(y)
            for kept, value in zip(finals, last, strict=True):
                kept.append(value)
        x = concatenate(outputs, 2) if directions == 2 else outputs[0]
    x = move(x, x.positions.transpose(swap)) if batch_first else x
    return x, *(stack(values, 0) for values in finals)


def _layer(cell: Cell) -> Callable[..., tuple[Value, ...]]:
    def operator(
        input: Value,
        hx: Value | Sequence[Value],
        params: Sequence[Value],
        has_biases: bool,
        num_layers: int,
        dropout: float,
        train: bool,
        bidirectional: bool,
        batch_first: bool,
    ) -> tuple[Value, ...]:
        states = [hx] if isinstance(hx, Value) else hx  # an LSTM's are h and c
        flags = (has_biases, num_layers, dropout, train, bidirectional, batch_first)
        return _sequence(cell, input, states, params, *flags)

    return operator


def table(form: Form) -> dict[str, Callable[..., Value | tuple[Value, ...]]]:
    """The operators with a form of their cells: ``form(kind, x, state, weights) -> new state`` on columns."""
    gru, lstm, tanh, relu = (
        partial(form, kind) for kind in (cells.GRU, cells.LSTM, cells.RNN_TANH, cells.RNN_RELU)
    )
    return {
        "aten.gru.input": _layer(gru), "aten.rnn_tanh.input": _layer(tanh),
        "aten.rnn_relu.input": _layer(relu), "aten.lstm.input": _layer(lstm),
        "aten.gru_cell.default": _cell(gru), "aten.rnn_tanh_cell.default": _cell(tanh),
        "aten.rnn_relu_cell.default": _cell(relu), "aten.lstm_cell.default": _lstm_cell(lstm),
    }  # fmt: skip


OPERATORS = table(cells.call)
PLAIN = table(cells.plain)
"""The same without the cells' own Jacobians."""
