"""CasADi functions over batches of float64 tensors: by CasADi's machine, or as torch operators.

Everything here works on the nonzeros of inputs and outputs, column by column, along the last axis.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nn_export.errors import DerivativeError, ExportError, ProgramError, UnsupportedOperatorError, last_line
from nn_export.expressions import Step, scalar_steps

MAX_WALK = 3000
"""Scalar operations up to which a function is also kept as torch operators."""
WALK_FROM = 200
"""Samples from which torch operators are faster than CasADi's machine (`benchmarks/export.py`)."""
CHUNK = 1024  # samples of one call of CasADi's machine, at most: bounds the number of mapped functions


def _two(f: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Any, Any], Tensor]:
    """A torch operator that takes no numbers, for a tensor and a number too."""

    def g(a: Any, b: Any) -> Tensor:
        like = a if isinstance(a, Tensor) else b
        return f(*(v if isinstance(v, Tensor) else torch.full_like(like, v) for v in (a, b)))

    return g


def _truth(f: Callable[[Any, Any], Tensor]) -> Callable[[Any, Any], Tensor]:
    return lambda a, b: f(a, b).to(torch.float64)


OPERATORS: dict[int, Callable[..., Tensor]] = {
    ca.OP_ASSIGN: lambda a: a, ca.OP_LIFT: lambda a, _: a,
    ca.OP_ADD: operator.add, ca.OP_SUB: operator.sub, ca.OP_MUL: operator.mul, ca.OP_DIV: operator.truediv,
    ca.OP_NEG: operator.neg, ca.OP_TWICE: lambda a: a + a, ca.OP_SQ: lambda a: a * a, ca.OP_INV: lambda a: 1.0 / a,
    ca.OP_POW: _two(torch.pow), ca.OP_CONSTPOW: torch.pow, ca.OP_SQRT: torch.sqrt, ca.OP_EXP: torch.exp,
    ca.OP_LOG: torch.log, ca.OP_LOG1P: torch.log1p, ca.OP_EXPM1: torch.expm1,
    ca.OP_SIN: torch.sin, ca.OP_COS: torch.cos, ca.OP_TAN: torch.tan,
    ca.OP_ASIN: torch.asin, ca.OP_ACOS: torch.acos, ca.OP_ATAN: torch.atan, ca.OP_ATAN2: _two(torch.atan2),
    ca.OP_SINH: torch.sinh, ca.OP_COSH: torch.cosh, ca.OP_TANH: torch.tanh,
    ca.OP_ASINH: torch.asinh, ca.OP_ACOSH: torch.acosh, ca.OP_ATANH: torch.atanh,
    ca.OP_ERF: torch.erf, ca.OP_HYPOT: _two(torch.hypot), ca.OP_FABS: torch.abs, ca.OP_SIGN: torch.sign,
    ca.OP_COPYSIGN: _two(torch.copysign), ca.OP_FLOOR: torch.floor, ca.OP_CEIL: torch.ceil,
    ca.OP_FMOD: _two(torch.fmod), ca.OP_FMIN: _two(torch.fmin), ca.OP_FMAX: _two(torch.fmax),
    ca.OP_LT: _truth(operator.lt), ca.OP_LE: _truth(operator.le),
    ca.OP_EQ: _truth(operator.eq), ca.OP_NE: _truth(operator.ne),
    ca.OP_NOT: lambda a: (a == 0).to(torch.float64),
    ca.OP_AND: _two(lambda a, b: ((a != 0) & (b != 0)).to(torch.float64)),
    ca.OP_OR: _two(lambda a, b: ((a != 0) | (b != 0)).to(torch.float64)),
    ca.OP_IF_ELSE_ZERO: _two(lambda a, b: torch.where(a != 0, b, 0.0)),
}  # fmt: skip


@dataclass(frozen=True)
class Batched:
    """A CasADi function over batches, with its derivatives as further ones."""

    function: ca.Function

    def evaluate(self, args: list[Tensor]) -> list[Tensor]:
        """Nonzeros of the outputs ``(*batch, n)`` at those of the inputs, all with the same leading axes."""
        samples = math.prod(args[0].shape[:-1])
        many = samples >= WALK_FROM or args[0].device.type != "cpu"
        return (
            self.walk(args, args[0].shape[:-1])
            if many and self.steps is not None
            else self._run(args, samples)
        )

    @cached_property
    def steps(self) -> list[Step] | None:
        """The scalar operations of the function; None if it has too many, or others than torch has."""
        try:
            steps = scalar_steps(self.function, MAX_WALK)
        except (ProgramError, UnsupportedOperatorError):
            return None
        known = {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT, *OPERATORS}
        return steps if all(step.code in known for step in steps) else None

    def check_walkable(self) -> None:
        """Refuse a function that torch operators do not stand for."""
        if self.steps is None:
            raise ExportError(
                f"{self.function.name()} cannot be written in torch operators (a solver, a table, external code, or "
                f"more than {MAX_WALK} operations): training on the CPU works, but not export or another device "
                "[NN-001]"
            )

    def walk(self, args: list[Tensor], shape: torch.Size | tuple[int, ...]) -> list[Tensor]:
        """The same by torch operators; the leading axes of the arguments are broadcast to ``shape``."""
        self.check_walkable()
        assert self.steps is not None
        exporting = torch.compiler.is_exporting()  # unbind would have to be decomposed, which takes long
        columns = [[a.select(-1, i) for i in range(a.shape[-1])] if exporting else a.unbind(-1) for a in args]
        slots: dict[int, Any] = {}
        results: list[list[Any]] = [[None] * self.function.nnz_out(i) for i in range(self.function.n_out())]
        for step in self.steps:
            if step.code == ca.OP_CONST:
                slots[step.given] = step.taken[0]
            elif step.code == ca.OP_INPUT:
                slots[step.given] = columns[step.taken[0]][step.taken[1]]
            elif step.code == ca.OP_OUTPUT:
                results[step.given[0]][step.given[1]] = slots[step.taken[0]]
            else:
                slots[step.given] = OPERATORS[step.code](*(slots[j] for j in step.taken))
        return [_joined(values, shape, args[0]) for values in results]

    def _run(self, args: list[Tensor], samples: int) -> list[Tensor]:
        f, shape, device = self.function, args[0].shape[:-1], args[0].device
        arrays = [np.ascontiguousarray(a.detach().cpu().numpy()).reshape(samples, a.shape[-1]) for a in args]
        results = [np.empty((samples, f.nnz_out(i))) for i in range(f.n_out())]
        start = 0
        while start < samples:
            count = 1 << min((samples - start).bit_length() - 1, CHUNK.bit_length() - 1)
            if count not in self._mapped:
                self._mapped[count] = f.map(count)
            machine: tuple[Any, Any] = self._mapped[count].buffer()
            buffer, evaluate = machine
            for set_, data in ((buffer.set_arg, arrays), (buffer.set_res, results)):
                for i, array in enumerate(data):
                    if array.size:
                        set_(i, memoryview(array[start : start + count].data))
            evaluate()
            if buffer.ret():
                raise ExportError(
                    f"{f.name()}: CasADi could not evaluate it; call the function with one sample to see the reason "
                    "[NN-002]"
                )
            start += count
        return [torch.from_numpy(r).reshape(*shape, r.shape[1]).to(device) for r in results]

    @cached_property
    def _mapped(self) -> dict[int, ca.Function]:
        return {1: self.function}  # by number of samples, powers of two

    @cached_property
    def reverse(self) -> Batched:
        """(inputs, seeds of the outputs) to the inputs' adjoints."""
        return Batched(_derivative(self.function, forward=False))

    @cached_property
    def forward(self) -> Batched:
        """(inputs, directions of the inputs) to those of the outputs."""
        return Batched(_derivative(self.function, forward=True))

    def __getstate__(self) -> dict[str, Any]:
        return {"function": self.function}  # what is cached is made again

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


def _joined(values: list[Any], shape: torch.Size | tuple[int, ...], like: Tensor) -> Tensor:
    if not values:
        return like.new_zeros((*shape, 0))
    return torch.stack(
        [v.expand(shape) if isinstance(v, Tensor) else like.new_full(shape, v) for v in values], -1
    )


def _derivative(f: ca.Function, *, forward: bool) -> ca.Function:
    """CasADi's own derivative in one direction, as a function of inputs and seeds alone."""
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    inputs = [kind.sym(f"x{i}", f.sparsity_in(i)) for i in range(f.n_in())]
    ours = [f.sparsity_in(i) for i in range(f.n_in())]
    theirs = [f.sparsity_out(i) for i in range(f.n_out())]
    seeds = [kind.sym(f"s{i}", s) for i, s in enumerate(ours if forward else theirs)]
    try:
        derivative = f.forward(1) if forward else f.reverse(1)
        values = derivative.call([*inputs, *f.call(inputs), *seeds])
    except RuntimeError as error:
        raise DerivativeError(
            f"{f.name()} has no derivative ({last_line(error)}); give the CasADi function one, "
            "e.g. by the option custom_jacobian or enable_fd [NN-003]"
        ) from error
    results = [ca.project(v, s) for v, s in zip(values, theirs if forward else ours, strict=True)]
    name = f"{'forward' if forward else 'reverse'}_{f.name()}"
    return ca.Function(name[:60], [*inputs, *seeds], results)
