"""Jacobians at many points as numpy arrays: sums of products, and recurrent cells a column a point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nn_export.operators import cells
from nn_export.operators.value import matrix

Array = NDArray[np.float64]
Results: TypeAlias = Mapping[str, Array]
"""The Jacobians of one call by their names, each ``(n, rows, columns)``."""


@dataclass(frozen=True, eq=False)
class Slot:
    """Where a Jacobian of ``n`` points is kept: in an array ``own`` ``(n, *shape)``, or as rows and columns of the
    result ``block``.
    """

    shape: tuple[int, int]
    own: Array | None
    block: str = ""
    rows: slice | None = None
    columns: slice | None = None

    def of(self, results: Results) -> Array:
        """The array."""
        return self.own if self.own is not None else results[self.block][:, self.rows, self.columns]


Slope: TypeAlias = Array | Slot
"""A Jacobian: one for all points, or one a point."""


class Sum:
    """A sum of products of two Jacobians each."""

    def __init__(self) -> None:
        self.columns = 0
        self._constant: Array | None = None
        self._products: list[tuple[Slope, Slope | None]] = []

    def add(self, factor: Slope, slope: Slope) -> None:
        """One more product."""
        self.columns = slope.shape[1]
        if isinstance(factor, Slot) or isinstance(slope, Slot):
            if _is_eye(slope):
                self._products.append((factor, None))
            else:
                self._products.append((slope, None) if _is_eye(factor) else (factor, slope))
        else:
            product = factor @ slope
            self._constant = product if self._constant is None else self._constant + product

    def known(self) -> Slope | None:
        """The sum, if it is constant or a single Jacobian that is kept somewhere."""
        if not self._products:
            return self._constant
        (first, second), *others = self._products
        return first if second is None and not others and self._constant is None else None

    def into(self, slot: Slot) -> Callable[[Results], None]:
        """The step that takes the sum."""
        products = sorted(self._products, key=lambda pair: pair[1] is None)  # a product starts, for free
        constant = self._constant

        def step(results: Results) -> None:
            out = slot.of(results)
            _accumulate(out, products, results, started=False)
            if constant is not None:
                out += constant

        return step


def _is_eye(slope: Slope) -> bool:
    return not isinstance(slope, Slot) and np.array_equal(slope, np.eye(len(slope)))


def _accumulate(
    out: Array, products: list[tuple[Slope, Slope | None]], results: Results, *, started: bool
) -> None:
    for factor, slope in products:
        a = factor.of(results) if isinstance(factor, Slot) else factor
        if slope is None:
            if started:
                out += a
            else:
                out[...] = a
        else:
            b = slope.of(results) if isinstance(slope, Slot) else slope
            if started:
                out += a @ b
            else:
                np.matmul(a, b, out=out)
        started = True


def matrices(weights: cells.Weights) -> list[Array | None]:
    """Constant weights as matrices, biases as columns."""
    shapes = [(*w.shape, 1)[:2] if w is not None else (0, 0) for w in weights]
    return [
        None if w is None else np.ascontiguousarray(ca.evalf(matrix(w, *shape)).full())
        for w, shape in zip(weights, shapes, strict=True)
    ]


@dataclass(frozen=True)
class _Pattern:
    """Which of the row factors of a new state's Jacobian are the same: gates that share one are added.

    ``first`` are the positions of the different factors among all, the input's gates first; ``by_input`` and
    ``by_hidden`` have each gate's factor by number, or None; ``diagonal`` the old states that the new one depends on
    entry by entry.
    """

    first: list[int]
    by_input: list[int | None]
    by_hidden: list[int | None]
    diagonal: list[int]

    @classmethod
    def of(cls, slope: cells.Slope) -> _Pattern:
        factors = [*slope.by_input, *slope.by_hidden]
        first: list[int] = []
        number: list[int | None] = []
        for k, factor in enumerate(factors):
            same = [f for f, at in enumerate(first) if factors[at] is factor]
            if factor is not None and not same:
                first.append(k)
                same = [len(first) - 1]
            number.append(same[0] if same else None)
        gates = len(slope.by_input)
        return cls(first, number[:gates], number[gates:], list(slope.diagonal))


@dataclass(frozen=True)
class _Jacobian:
    """Jacobian of new state ``k`` by one input of the program: the sum of its parts.

    ``weights`` ``(H, factors, columns)`` are rows of the constant part, to be scaled; ``products`` the cell's own
    Jacobian times that of its argument; ``diagonal`` old states with their Jacobians, None for the identity.
    """

    k: int
    slot: Slot
    weights: Array | None
    products: list[tuple[Slope, Slope | None]]
    diagonal: list[tuple[int, Slope | None]]


class CellColumns:
    """A cell at ``n`` points, values and Jacobians; its input ``(F, n)`` and states ``(H, n)`` are arrays that stay."""

    values: list[Array]
    """New states ``(H, n)``, filled by a call."""

    def __init__(self, kind: cells.Kind, x: Array, state: list[Array], weights: list[Array | None]) -> None:
        self._kind, self._x, self._state = kind, x, state
        w, r, b, c = weights
        assert w is not None
        assert r is not None
        self._weights, self._biases, self._n = (w, r), (b, c), x.shape[1]
        self._sums = np.zeros((len(w), self._n)), np.zeros((len(w), self._n))
        # The first evaluation is made here: its Jacobians say which factors there are.
        at = self._evaluate()
        self.values = [np.array(value) for value in at.state]
        self._patterns = [_Pattern.of(slope) for slope in at.slopes]
        sizes = zip(self._patterns, at.state, strict=True)
        self._factors = [np.zeros((len(pattern.first), *value.shape)) for pattern, value in sizes]
        self._left = [f.transpose(1, 2, 0) for f in self._factors]  # (H, n, factors)
        self._own: dict[tuple[int, bool], tuple[Slot, Array]] = {}
        self._jacobians: list[_Jacobian] = []

    def differentiate(
        self, k: int, slot: Callable[[int], Slot], x: Slope | None, state: list[Slope | None]
    ) -> Slot:
        """Have the Jacobian of new state ``k`` by one input of the program taken by every call.

        ``slot`` gives the place for a number of columns; ``x`` and ``state`` are the Jacobians of the cell's input
        (None if it does not depend on the program's) and of its states.
        """
        pattern, constant = self._patterns[k], None
        products: list[tuple[Slope, Slope | None]] = []
        columns = next(slope.shape[1] for slope in (x, *state) if slope is not None)
        for hidden, slope in ((False, x), (True, state[0])):
            if isinstance(slope, Slot):
                products.append((self._by_argument(k, hidden), slope))
            elif slope is not None:
                rows = self._rows(k, hidden) @ slope
                constant = rows if constant is None else constant + rows
        known = [(old, s) for old in pattern.diagonal if (s := state[old]) is not None]
        diagonal = [(old, None if _is_eye(s) else s) for old, s in known]
        place = slot(columns)
        self._jacobians.append(_Jacobian(k, place, constant, products, diagonal))
        return place

    def __call__(self, results: Results) -> None:
        """New states, and the Jacobians asked for."""
        at = self._evaluate()
        for k, (slope, pattern) in enumerate(zip(at.slopes, self._patterns, strict=True)):
            self.values[k][...] = at.state[k]
            given = *slope.by_input, *slope.by_hidden
            for f, position in enumerate(pattern.first):
                self._factors[k][f] = given[position]
        for (k, _), (slot, rows) in self._own.items():
            np.matmul(self._left[k], rows, out=slot.of(results).transpose(1, 0, 2))
        for jacobian in self._jacobians:
            self._take(jacobian, at.slopes[jacobian.k].diagonal, results)

    def _evaluate(self) -> cells.Step:
        for w, values, bias, out in zip(
            self._weights, (self._x, self._state[0]), self._biases, self._sums, strict=True
        ):
            np.matmul(w, values, out=out)
            if bias is not None:
                out += bias
        return self._kind.equations(*self._sums, tuple(self._state))

    def _rows(self, k: int, hidden: bool) -> Array:
        """Weights of an argument by the factors of new state ``k``: (H, factors, columns)."""
        pattern = self._patterns[k]
        blocks = np.split(self._weights[hidden], self._kind.gates)
        rows = np.zeros((len(pattern.first), *blocks[0].shape))
        for block, factor in zip(blocks, pattern.by_hidden if hidden else pattern.by_input, strict=True):
            if factor is not None:
                rows[factor] += block
        return np.ascontiguousarray(rows.transpose(1, 0, 2))

    def _by_argument(self, k: int, hidden: bool) -> Slot:
        """The cell's own Jacobian by its input or its hidden state, without the diagonal."""
        if (k, hidden) not in self._own:
            rows = self._rows(k, hidden)
            height, _, columns = rows.shape
            slot = Slot((height, columns), np.zeros((self._n, height, columns)))
            self._own[k, hidden] = slot, rows
        return self._own[k, hidden][0]

    def _take(self, jacobian: _Jacobian, diagonals: Mapping[int, Array], results: Results) -> None:
        out, weights = jacobian.slot.of(results), jacobian.weights
        if weights is not None:
            np.matmul(self._left[jacobian.k], weights, out=out.transpose(1, 0, 2))
        elif not jacobian.products:
            out[...] = 0.0
        _accumulate(out, jacobian.products, results, started=weights is not None)
        for old, slope in jacobian.diagonal:
            factors = diagonals[old].T
            if slope is None:
                np.einsum("kii->ki", out)[...] += factors  # the diagonals of all points
            elif isinstance(slope, Slot):
                out += factors[:, :, None] * slope.of(results)
            else:
                rows, columns = np.nonzero(slope)
                out[:, rows, columns] += factors[:, rows] * slope[rows, columns]
