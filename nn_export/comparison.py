"""Does the exported function compute what the module computes? Values and Jacobians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch

from nn_export.errors import SignatureError
from nn_export.operators.value import constant
from nn_export.tracing import float64_copy


@dataclass(frozen=True)
class ParityReport:
    """Largest differences between a module and its export over all samples and outputs.

    Args:
        n: Number of samples.
        value_abs: Largest absolute error of a value.
        value_rel: The same over the largest magnitude that output took in samples of the same kind
            (normal, zeros, extreme); never less than 1e-3 of the magnitude in normal samples.
        jacobian_abs: Largest absolute error of an entry of a Jacobian.
        jacobian_rel: The same for the Jacobian of one output by all inputs.
        left_out: Number of entries of values and Jacobians that were not compared, because torch itself
            gave infinity or NaN there.

    Example:
        >>> print(ParityReport(3, 0.0, 0.0, 1e-17, 1e-16))
        parity over 3 samples: values 0.0e+00 abs, 0.0e+00 rel; Jacobians 1.0e-17 abs, 1.0e-16 rel
        >>> print(str(ParityReport(3, 0.0, 0.0, 0.0, 0.0, left_out=6)).split("; ")[2])
        6 entries left out, not finite in torch
    """

    n: int
    value_abs: float
    value_rel: float
    jacobian_abs: float
    jacobian_rel: float
    left_out: int = 0

    def __str__(self) -> str:
        left_out = f"; {self.left_out} entries left out, not finite in torch" if self.left_out else ""
        return (
            f"parity over {self.n} samples: values {self.value_abs:.1e} abs, {self.value_rel:.1e} rel; "
            f"Jacobians {self.jacobian_abs:.1e} abs, {self.jacobian_rel:.1e} rel{left_out}"
        )


def parity(
    module: torch.nn.Module,
    function: ca.Function,
    example_inputs: Sequence[torch.Tensor],
    *,
    n: int = 100,
    seed: int = 0,
    scale: Sequence[float | np.ndarray] | None = None,
) -> ParityReport:
    """Compare a module (in float64) with its CasADi function.

    One sample in ten is all zeros, one in ten is 1000 times as large (saturated gates). Jacobians of
    kinks (``abs`` at 0) are a matter of convention; functions with kinks may differ there.

    Args:
        module: The module that was exported.
        function: Its CasADi function.
        example_inputs: Tensors that give the shapes.
        n: Number of samples.
        seed: Seed of the samples.
        scale: Magnitude of each input's normal distribution, a number or an array of its shape. Default: 1 for all.

    Returns:
        The largest differences. A value that is not finite on both sides is left out and counted; so is
        the Jacobian of an output whose value or Jacobian is not finite in torch (a model that diverges
        from an extreme sample). What is not finite in CasADi alone counts as an infinite error, and so
        does a value that is not finite in torch alone.

    Raises:
        SignatureError: If the numbers of inputs or scales differ.

    Example:
        >>> from nn_export import to_casadi
        >>> linear, x = torch.nn.Linear(2, 1), (torch.zeros(2),)
        >>> parity(linear, to_casadi(linear, x), x, n=5).value_rel < 1e-12
        True
    """
    scales = [1.0] * len(example_inputs) if scale is None else list(scale)
    if not len(scales) == len(example_inputs) == function.n_in():
        raise SignatureError(
            f"{len(example_inputs)} inputs, {len(scales)} scales, the function takes {function.n_in()}"
        )
    copy = float64_copy(module).requires_grad_(False)
    rng = np.random.default_rng(seed)
    derivative = function.jacobian()
    jacobian = torch.func.jacrev(_flat(copy), argnums=tuple(range(len(scales))))
    values, jacobians = _Errors(), _Errors()
    for k in range(n):
        factor = {1: 0.0, 2: 1e3}.get(k % 10, 1.0)
        kind = k % 10 if k % 10 in (1, 2) else 0
        draws = [
            factor * s * rng.standard_normal(tuple(x.shape)) + 0.0  # no negative zeros
            for x, s in zip(example_inputs, scales, strict=True)
        ]
        tensors = [torch.tensor(d, dtype=torch.float64) for d in draws]
        held = [constant(d) for d in draws]
        ours = [ca.evalf(v.mx) for v in held]
        results = function.call(ours)
        blocks = derivative.call([*ours, *results])
        exact = jacobian(*tensors)
        for i, output in enumerate(_leaves(copy(*tensors))):
            expected, shape = output.detach().numpy().reshape(-1), tuple(output.shape)
            values.add((i, kind), _row_major(results[i], shape), expected)
            given = [blocks[i * len(held) + j].full()[_order(shape)] for j in range(len(held))]
            given = [g[:, x.positions.reshape(-1)] for g, x in zip(given, held, strict=True)]
            slopes = [e.detach().numpy().reshape(g.shape) for e, g in zip(exact[i], given, strict=True)]
            jacobians.add((i, kind), np.hstack(given), np.hstack(slopes), np.isfinite(expected).all())
    return ParityReport(n, *values.largest, *jacobians.largest, values.left_out + jacobians.left_out)


class _Errors:
    """Largest errors by key, and the largest magnitudes that they are relative to."""

    def __init__(self) -> None:
        self.error: dict[tuple[int, int], float] = {}
        self.size: dict[tuple[int, int], float] = {}
        self.left_out = 0

    def add(
        self, key: tuple[int, int], given: np.ndarray, expected: np.ndarray, whole: bool | None = None
    ) -> None:
        # Entries not finite on both sides are left out; with ``whole`` given, all entries unless it and
        # every expected one are finite.
        finite = np.isfinite(expected)
        kept = finite | np.isfinite(given) if whole is None else np.full(given.shape, whole and finite.all())
        self.left_out += int(np.sum(~kept))
        with np.errstate(invalid="ignore"):
            difference = np.abs(given - expected)[kept]
        worst = float(np.max(np.where(np.isfinite(difference), difference, np.inf), initial=0.0))
        size = float(np.max(np.abs(expected[kept & finite]), initial=0.0))
        self.error[key] = max(self.error.get(key, 0.0), worst)
        self.size[key] = max(self.size.get(key, 0.0), size)

    @property
    def largest(self) -> tuple[float, float]:
        relative = []
        for (i, kind), error in self.error.items():
            size = max(self.size[i, kind], 1e-3 * self.size.get((i, 0), 0.0))
            relative.append(0.0 if error == 0 else error / size if size else np.inf)
        return max(self.error.values(), default=0.0), max(relative, default=0.0)


def _leaves(output: object) -> list[torch.Tensor]:
    return list(torch.utils._pytree.tree_leaves(output))


def _flat(module: torch.nn.Module) -> Callable[..., tuple[torch.Tensor, ...]]:
    def f(*args: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(t.reshape(-1) for t in _leaves(module(*args)))

    return f


def _order(shape: tuple[int, ...]) -> np.ndarray:
    size = int(np.prod(shape))
    return constant(np.arange(size).reshape(shape)).positions.reshape(-1)


def _row_major(result: ca.DM, shape: tuple[int, ...]) -> np.ndarray:
    return np.asarray(result.full()).flatten(order="F")[_order(shape)]
