"""Values and Jacobians of a program at many points in one call, faster than point by point. No torch in here.

The chain rule is that of :mod:`nn_export.jacobian`. What lies between recurrent cells is vectorised scalar code
(:mod:`nn_export.vectorised`); cells run in numpy, a column a point. A cell's Jacobian is a sum of constant
matrices with scaled rows, so row ``i`` of the Jacobians of all points is one product, (points x factors) (factors x
columns).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nn_export.budget import NUMBER, Budget, Limits
from nn_export.chain import Chain, differentiated
from nn_export.columns import CellColumns, Results, Slope, Slot, Sum, matrices
from nn_export.errors import ProgramError, ShapeError
from nn_export.graph import graph, named
from nn_export.jacobian import checked_blocks, spend_results
from nn_export.operators import OPERATORS, cells, recurrent
from nn_export.program import Program
from nn_export.vectorised import OnArrays, vectorised

Array = NDArray[np.float64]


class SideBySide:
    """A program's outputs and their Jacobians at ``n`` points.

    Args:
        program: What :func:`nn_export.trace` made or :func:`nn_export.load_programs` read.
        n: Number of points.
        blocks: The Jacobians, as in :func:`nn_export.with_jacobian`. Those by few inputs are faster than all.
        limits: What it may cost at one point. Default: :class:`nn_export.Limits`.

    Raises:
        ProgramError: As :func:`nn_export.with_jacobian`, or if ``n < 1``.

    Example:
        >>> from nn_export import Node, Port
        >>> node = Node("tanh", "aten.tanh.default", [{"input": "x"}], {}, ((2,),))
        >>> program = Program((Port("x", (2,)),), (Port("y", (2,), {"node": "tanh"}),), (node,))
        >>> y, slope = SideBySide(program, 3)(np.array([[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]]))
        >>> y.shape, slope.shape, slope[0].round(3).tolist()
        ((3, 2), (3, 2, 2), [[1.0, 0.0], [0.0, 0.42]])
    """

    def __init__(
        self,
        program: Program,
        n: int,
        blocks: Mapping[str, Sequence[str]] | None = None,
        *,
        limits: Limits | None = None,
    ) -> None:
        if n < 1:
            raise ProgramError(f"n = {n} points given; at least 1 needed [NN-082]")
        blocks = checked_blocks(program, blocks)
        inputs, wanted = (
            [port.name for port in program.inputs],
            {i for names in blocks.values() for i in names},
        )
        with named(f"{n} points"):
            chain = _Chain(n, budget := Budget(limits))
            symbols, outputs = graph(program, {**OPERATORS, **recurrent.table(chain.cell)}, budget)
            targets, sizes = (
                [v.mx for v in outputs],
                dict(zip(inputs, (s.numel() for s in symbols), strict=True)),
            )
            spend_results(budget, outputs, blocks, sizes)
            for name in wanted:
                budget.spend(
                    f"the slope of {name}", elements=sizes[name] ** 2, memory=NUMBER * sizes[name] ** 2
                )
            self._inputs = [np.zeros((size, n)) for size in sizes.values()]
            for symbol, name, buffer in zip(symbols, inputs, self._inputs, strict=True):
                if buffer.size:
                    chain.add(symbol, _Known(buffer, {name: np.eye(len(buffer))} if name in wanted else {}))
            places = _places(targets, blocks, sizes)
            chain.promise({(hash(targets[t]), name): slot for (t, name), slot in reversed(places)})
            chain.settle()
            results = chain.derive(targets)
            self._steps = chain.steps
            self._values = [known.value for known in results]
            self._fill: list[tuple[Slot, Slope]] = []
            for (t, name), place in places:
                slope = results[t].slopes.get(name, np.zeros(place.shape))
                if slope is not place:
                    self._fill.append((place, slope))
            rows = sum(target.numel() for target in targets)
            self._shapes = {b: (n, rows, sum(sizes[i] for i in names)) for b, names in blocks.items()}

    @np.errstate(all="ignore")  # what overflows is the caller's to look at, as in CasADi
    def __call__(self, *points: Array) -> tuple[Array, ...]:
        """Outputs ``(n, size)`` and Jacobians ``(n, rows, columns)``, new arrays."""
        if [p.shape for p in points] != [b.T.shape for b in self._inputs]:
            needed = ", ".join(str(b.T.shape) for b in self._inputs)
            raise ShapeError(f"arrays of {[p.shape for p in points]} given, {needed} needed [NN-083]")
        for buffer, values in zip(self._inputs, points, strict=True):
            buffer[...] = values.T
        results = {name: np.empty(shape) for name, shape in self._shapes.items()}
        for step in self._steps:
            step(results)
        for place, slope in self._fill:
            place.of(results)[...] = slope.of(results) if isinstance(slope, Slot) else slope
        return (*(value.T.copy() for value in self._values), *results.values())


@dataclass(frozen=True)
class _Known:
    """Values ``(size, n)`` in an array that stays, and Jacobians by inputs: constant ones, or slots."""

    value: Array
    slopes: dict[str, Slope]


def _places(
    targets: list[ca.MX], blocks: Mapping[str, Sequence[str]], sizes: Mapping[str, int]
) -> list[tuple[tuple[int, str], Slot]]:
    """Where in the results the Jacobian of each target by each input belongs."""
    places, row = [], 0
    for t, target in enumerate(targets):
        below = row + target.numel()
        for block, names in blocks.items():
            column = 0
            for name in names:
                after = column + sizes[name]
                slot = Slot(
                    (below - row, after - column), None, block, slice(row, below), slice(column, after)
                )
                places.append(((t, name), slot))
                column = after
        row = below
    return [(key, slot) for key, slot in places if min(slot.shape) > 0]


class _Chain(Chain[_Known]):
    """Values and slopes in arrays, and the steps that fill them."""

    def __init__(self, n: int, budget: Budget) -> None:
        super().__init__(budget)
        self._n = n
        self._promised: dict[tuple[int, str], Slot] = {}
        self.steps: list[Callable[[Results], None]] = []

    def promise(self, places: Mapping[tuple[int, str], Slot]) -> None:
        """Where in the results slopes are to be written: by the hash of the expression and the input."""
        self._promised = dict(places)

    def _slot(self, target: ca.MX, name: str, columns: int) -> Slot:
        shape = target.numel(), columns
        return self._promised.get((hash(target), name)) or Slot(shape, np.zeros((self._n, *shape)))

    def _constant(self, target: ca.MX) -> _Known:
        column = ca.evalf(target).full().reshape(-1, 1, order="F")
        return _Known(np.repeat(column, self._n, axis=1), {})

    def _piece(self, symbols: list[ca.MX], targets: list[ca.MX], arguments: list[_Known]) -> list[_Known]:
        piece = differentiated(symbols, targets, [bool(a.slopes) for a in arguments], self.budget)
        values = [np.zeros((t.numel(), self._n)) for t in targets]
        expressions = [ca.densify(ca.vec(v)) for v in piece.values]
        raw: list[Array] = []
        copies: list[tuple[Array, Array]] = []
        sums = []
        for target, row in zip(targets, piece.blocks, strict=True):
            terms: dict[str, Sum] = {}
            for block, argument in zip(row, arguments, strict=True):
                if not argument.slopes or not block.nnz():
                    continue
                factor: Slope
                if not ca.symvar(block):
                    factor = ca.evalf(block).full()
                else:
                    expressions.append(ca.densify(block.T))  # its columns are the rows
                    raw.append(np.zeros((block.numel(), self._n)))
                    factor = Slot(block.shape, np.zeros((self._n, *block.shape)))
                    copies.append((factor.of({}).reshape(self._n, -1), raw[-1].T))
                for name, slope in argument.slopes.items():
                    terms.setdefault(name, Sum()).add(factor, slope)
            sums.append({name: (target, term) for name, term in terms.items()})
        single = ca.Function("piece", piece.inner, expressions)
        self.budget.spend("a piece at many points", nodes=single.n_instructions())
        function = vectorised(single, self._n)
        evaluate = OnArrays(function, [a.value for a in arguments], [*values, *raw])

        def step(results: Results) -> None:
            evaluate()
            for to, given in copies:
                to[...] = given

        self.steps.append(step)
        slopes = [{i: self._summed(t, i, s) for i, (t, s) in by_name.items()} for by_name in sums]
        return [_Known(value, by) for value, by in zip(values, slopes, strict=True)]

    def _summed(self, target: ca.MX, name: str, terms: Sum) -> Slope:
        """A sum of products as a slope, and the step that takes it where it is not there already."""
        known = terms.known()
        if known is not None:
            return known
        slot = self._slot(target, name, terms.columns)
        self.steps.append(terms.into(slot))
        return slot

    def _after(
        self, symbols: list[ca.MX], kind: cells.Kind, x: _Known, state: list[_Known], w: cells.Weights
    ) -> list[_Known]:
        self.spend(symbols, [x.slopes, *(s.slopes for s in state)])
        cell = CellColumns(kind, x.value, [s.value for s in state], matrices(w))
        known = []
        for k, symbol in enumerate(symbols):
            slopes: dict[str, Slope] = {}
            for name in {
                **x.slopes,
                **{i: s for known_state in state for i, s in known_state.slopes.items()},
            }:
                by = x.slopes.get(name), [s.slopes.get(name) for s in state]
                slopes[name] = cell.differentiate(k, partial(self._slot, symbol, name), *by)
            known.append(_Known(cell.values[k], slopes))
        self.steps.append(cell)
        return known
