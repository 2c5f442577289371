"""The chain rule along a program that is cut at its recurrent cells: the order of it, whatever the numbers are."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate, compress, pairwise
from typing import Any, Generic, TypeVar

import casadi as ca

from nn_export.budget import NUMBER, Budget
from nn_export.operators import cells
from nn_export.operators.value import HUGE

SCALAR_LIMIT = 50_000
"""Scalar operations, times sweeps of differentiation, up to which a piece becomes scalar code."""

Known = TypeVar("Known")


class Chain(ABC, Generic[Known]):
    """The cuts of a graph: cells in order, each with its arguments; then what is known of their outputs."""

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self._cells: list[tuple[list[ca.MX], cells.Kind, ca.MX, cells.State, cells.Weights]] = []
        self._known: dict[str, Known] = {}

    def cell(self, kind: cells.Kind, x: ca.MX, state: cells.State, w: cells.Weights) -> cells.State:
        """The form of a cell: symbols instead of its results."""
        if not cells.simple(x, w):
            return cells.call(kind, x, state, w)
        number = len(self._cells)
        symbols = [ca.MX.sym(f"cell {number} {s}", kind.width(w)) for s in kind.states]
        self._cells.append((symbols, kind, x, state, w))
        return tuple(symbols)

    def add(self, symbol: ca.MX, known: Known) -> None:
        """What a symbol stands for."""
        self._known[symbol.name()] = known

    def settle(self) -> None:
        """All cells in order."""
        for symbols, kind, x, state, w in self._cells:
            at_x, *at_state = self.derive([x, *state])
            results = self._after(symbols, kind, at_x, at_state, w)
            for symbol, known in zip(symbols, results, strict=True):
                self.add(symbol, known)

    def derive(self, targets: list[ca.MX]) -> list[Known]:
        """Expressions of the symbols, as values and slopes."""
        known: dict[int, Known] = {}
        rest = []
        for k, target in enumerate(targets):
            if target.is_symbolic():
                known[k] = self._known[target.name()]
            elif not ca.symvar(target):
                known[k] = self._constant(target)
            else:
                rest.append(k)
        if rest:
            chosen = [targets[k] for k in rest]
            symbols = ca.symvar(ca.veccat(*chosen))
            results = self._piece(symbols, chosen, [self._known[s.name()] for s in symbols])
            known |= dict(zip(rest, results, strict=True))
        return [known[k] for k in range(len(targets))]

    def spend(self, symbols: list[ca.MX], slopes: Iterable[Mapping[str, Any]]) -> None:
        """Take off what the Jacobians of a cell's results cost, by all that its arguments depend on."""
        widths = {name: slope.shape[1] for by_name in slopes for name, slope in by_name.items()}
        size = sum(symbol.numel() for symbol in symbols)
        self.budget.spend(
            f"the Jacobian of {symbols[0].name()} by {', '.join(widths)!s:.80}",
            elements=size * max(widths.values(), default=0),
            memory=NUMBER * size * sum(widths.values()),
            nodes=24 * len(widths) * len(symbols),
        )

    @abstractmethod
    def _constant(self, target: ca.MX) -> Known:
        """A value without slopes."""

    @abstractmethod
    def _piece(self, symbols: list[ca.MX], targets: list[ca.MX], arguments: list[Known]) -> list[Known]:
        """Expressions of symbols at what these stand for."""

    @abstractmethod
    def _after(
        self, symbols: list[ca.MX], kind: cells.Kind, x: Known, state: list[Known], w: cells.Weights
    ) -> list[Known]:
        """The results of a cell, for which the symbols stand."""


@dataclass(frozen=True)
class Piece:
    """Expressions ``values`` of the symbols ``inner``, scalar code (SX) or a graph of MX, and their Jacobians.

    ``blocks`` has a row an expression, with its Jacobian by each symbol; empty by those that nobody asks for.
    """

    scalar: bool
    inner: list[Any]
    values: list[Any]
    blocks: list[list[Any]]


def differentiated(symbols: list[ca.MX], targets: list[ca.MX], wanted: list[bool], budget: Budget) -> Piece:
    """Expressions with their Jacobians by the symbols that are wanted, as scalar code where they are small."""
    piece = ca.Function("piece", symbols, targets)
    rows, columns = _edges(targets), _edges(list(compress(symbols, wanted)))
    sweeps = min(rows[-1], columns[-1])
    count = operations(piece)
    scalar = count * sweeps <= SCALAR_LIMIT
    # A scalar operation of a sweep takes a tenth of the time of a node, an operation on matrices half of it.
    made = count * sweeps / 10 if scalar else piece.n_instructions() * (sweeps + 8) / 2
    budget.spend(
        f"a Jacobian of {rows[-1]} values by {columns[-1]}",
        elements=rows[-1] * columns[-1],
        memory=NUMBER * rows[-1] * columns[-1],
        work=int(min(count * sweeps, HUGE)),
        nodes=int(made) + 8 * len(targets) * len(symbols),
    )
    inner: list[Any] = [(ca.SX if scalar else ca.MX).sym("v", *s.shape) for s in symbols]
    values = piece.call(inner, True, False)
    whole = ca.jacobian(ca.veccat(*values), ca.veccat(*compress(inner, wanted)))
    blocks = []
    for a, b in pairwise(rows):
        asked = (whole[a:b, c:d] for c, d in pairwise(columns))
        blocks.append(
            [
                next(asked) if by else type(whole)(b - a, v.numel())
                for v, by in zip(inner, wanted, strict=True)
            ]
        )
    return Piece(scalar, inner, values, blocks)


def _edges(parts: list[ca.MX]) -> list[int]:
    return list(accumulate((p.numel() for p in parts), initial=0))


def operations(f: ca.Function) -> float:
    """Scalar operations of a matrix graph, about; infinite if it calls functions that are no scalar code."""
    total = 0
    for k in range(f.n_instructions()):
        kind = f.instruction_id(k)
        if kind == ca.OP_CALL:
            called = f.instruction_MX(k).which_function()
            if not called.is_a("SXFunction"):
                return math.inf
            total += called.n_instructions()
        elif kind not in (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST):
            node = f.instruction_MX(k)
            total += node.numel() * (2 * node.dep(1).size2() if kind == ca.OP_MTIMES else 1)
    return total
