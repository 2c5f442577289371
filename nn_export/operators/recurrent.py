"""Recurrent layers and cells in torch's form, kept whole; :mod:`nn_export.operators.cells` has the cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from nn_export.operators import cells
from nn_export.operators.cells import Call, Kind, Weights
from nn_export.operators.shape import flip, stack
from nn_export.operators.value import Value, arrange, concatenate, from_matrix, matrix, move


def _columns(value: Value) -> ca.MX:  # (batch, n) or (n,) as n x batch
    positions = value.positions.reshape(-1, value.shape[-1])
    return arrange(value.mx, positions.T)


def _cell(call: Call, kind: Kind) -> Callable[..., Value]:
    def operator(
        input: Value,
        hx: Value,
        w_ih: Value,
        w_hh: Value,
        b_ih: Value | None = None,
        b_hh: Value | None = None,
    ) -> Value:
        result = call(kind, _columns(input), (_columns(hx),), (w_ih, w_hh, b_ih, b_hh))
        return from_matrix(result[0].T, hx.shape)

    return operator


def _lstm_cell(call: Call) -> Callable[..., tuple[Value, ...]]:
    def operator(
        input: Value,
        hx: Sequence[Value],
        w_ih: Value,
        w_hh: Value,
        b_ih: Value | None = None,
        b_hh: Value | None = None,
    ) -> tuple[Value, ...]:
        state = tuple(_columns(v) for v in hx)
        new = call(cells.lstm, _columns(input), state, (w_ih, w_hh, b_ih, b_hh))
        return tuple(from_matrix(mx.T, v.shape) for mx, v in zip(new, hx, strict=True))

    return operator


def _run(
    call: Call,
    kind: Kind,
    x: Value,
    states: Sequence[Value],
    w: Weights,
    projection: Value | None,
    reverse: bool,
) -> tuple[Value, list[Value]]:
    """One direction of one layer over ``x`` (T, B, F); states (B, H)."""
    x = flip(x, [0]) if reverse else x
    state = tuple(_columns(v) for v in states)
    steps = []
    for positions in x.positions:
        state = call(kind, arrange(x.mx, positions.T), state, w)
        if projection is not None:
            state = (ca.mtimes(matrix(projection, *projection.shape), state[0]), *state[1:])
        steps.append(from_matrix(state[0].T, states[0].shape))
    y = stack(steps, 0)
    return flip(y, [0]) if reverse else y, [
        from_matrix(s.T, v.shape) for s, v in zip(state, states, strict=True)
    ]


def _sequence(
    call: Call,
    kind: Kind,
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
    directions, plain_size = 2 if bidirectional else 1, 4 if has_biases else 2
    size, rest = divmod(len(params), num_layers * directions)
    if rest or size not in (plain_size, plain_size + 1):
        raise ValueError(f"{len(params)} weights for {num_layers * directions} layers and directions")
    swap = (1, 0, 2)
    x = move(x, x.positions.transpose(swap)) if batch_first else x
    finals: list[list[Value]] = [[] for _ in states]
    for layer in range(num_layers):
        outputs = []
        for d in range(directions):
            k = layer * directions + d
            own = params[k * size : (k + 1) * size]
            w = (own[0], own[1], own[2] if has_biases else None, own[3] if has_biases else None)
            first = [move(v, v.positions[k]) for v in states]
            projection = own[-1] if size > plain_size else None
            y, last = _run(call, kind, x, first, w, projection, d == 1)
            outputs.append(y)
            for kept, value in zip(finals, last, strict=True):
                kept.append(value)
        x = concatenate(outputs, 2) if directions == 2 else outputs[0]
    x = move(x, x.positions.transpose(swap)) if batch_first else x
    return x, *(stack(values, 0) for values in finals)


def _layer(call: Call, kind: Kind) -> Callable[..., tuple[Value, ...]]:
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
        flags = (has_biases, num_layers, dropout, train, bidirectional, batch_first)
        states = [hx] if isinstance(hx, Value) else hx
        return _sequence(call, kind, input, states, params, *flags)

    return operator


def table(call: Call) -> dict[str, Callable[..., Value | tuple[Value, ...]]]:
    """The operators with a way to call a cell: ``call(kind, x, states, weights) -> new states``, on columns."""
    return {
        "aten.gru.input": _layer(call, cells.gru),
        "aten.lstm.input": _layer(call, cells.lstm),
        "aten.rnn_tanh.input": _layer(call, cells.rnn_tanh),
        "aten.rnn_relu.input": _layer(call, cells.rnn_relu),
        "aten.gru_cell.default": _cell(call, cells.gru),
        "aten.lstm_cell.default": _lstm_cell(call),
        "aten.rnn_tanh_cell.default": _cell(call, cells.rnn_tanh),
        "aten.rnn_relu_cell.default": _cell(call, cells.rnn_relu),
    }


OPERATORS = table(cells.called)
PLAIN = table(cells.plain)
"""The same without the cells' own Jacobians."""
