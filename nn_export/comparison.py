"""Does the exported function compute what the module computes? Values, Jacobians, Hessians."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch

from nn_export.batched import Batched
from nn_export.errors import SignatureError
from nn_export.operators.value import Value, constant
from nn_export.tracing import float64_copy

ZEROS, LARGE, SATURATED = 1, 2, 5  # which of ten samples


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
        hvp_abs: Largest absolute error of an entry of a Hessian-vector product: of the outputs' sum with random
            weights, along a random direction of all inputs.
        hvp_rel: The same, relative as above. NaN if Hessians were not compared.
        hvp_left_out: Number of entries of these products that were not compared, as above.

    Example:
        >>> print(ParityReport(3, 0.0, 0.0, 1e-17, 1e-16, 6, 2e-16, 1e-15))
        parity over 3 samples      absolute  relative
          values                    0.0e+00   0.0e+00
          Jacobians                 1.0e-17   1.0e-16
          Hessian-vector products   2.0e-16   1.0e-15
          6 entries left out, not finite in torch
    """

    n: int
    value_abs: float
    value_rel: float
    jacobian_abs: float
    jacobian_rel: float
    left_out: int = 0
    hvp_abs: float = math.nan
    hvp_rel: float = math.nan
    hvp_left_out: int = 0

    def __str__(self) -> str:
        rows = [
            ("values", self.value_abs, self.value_rel),
            ("Jacobians", self.jacobian_abs, self.jacobian_rel),
        ]
        if not math.isnan(self.hvp_rel):
            rows.append(("Hessian-vector products", self.hvp_abs, self.hvp_rel))
        lines = [f"parity over {self.n} samples".ljust(27) + "absolute  relative"]
        lines += [f"  {name:23}{absolute:10.1e}{relative:10.1e}" for name, absolute, relative in rows]
        if self.left_out:
            lines.append(f"  {self.left_out} entries left out, not finite in torch")
        if self.hvp_left_out:
            lines.append(f"  {self.hvp_left_out} entries of products left out, not finite in torch")
        return "\n".join(lines)


def parity(
    module: torch.nn.Module,
    function: ca.Function,
    example_inputs: Sequence[torch.Tensor] | None = None,
    *,
    n: int = 100,
    seed: int = 0,
    scale: Sequence[float | np.ndarray] | None = None,
    hessians: bool = True,
) -> ParityReport:
    """Compare a module (in float64) with its CasADi function.

    Of ten samples one is all zeros, one is 1000 times as large, and one is 30 times the scale in every entry,
    with random signs (saturated gates). Derivatives at kinks (``abs`` at 0) are a matter of convention;
    functions with kinks may differ there.

    Args:
        module: The module that was exported.
        function: Its CasADi function.
        example_inputs: Tensors that give the shapes. Default: those of the function, a column of n as ``(n,)``.
        n: Number of samples.
        seed: Seed of the samples.
        scale: Magnitude of each input's normal distribution, a number or an array of its shape. Default: 1 for all.
        hessians: False leaves Hessian-vector products out, e.g. for operators that torch differentiates once.

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
    if example_inputs is None:
        sizes = [function.size_in(i) for i in range(function.n_in())]
        example_inputs = [torch.zeros(r if c == 1 else (r, c)) for r, c in sizes]
    scales = [1.0] * len(example_inputs) if scale is None else list(scale)
    if not len(scales) == len(example_inputs) == function.n_in():
        raise SignatureError(
            f"{len(example_inputs)} inputs, {len(scales)} scales, the function takes {function.n_in()} [NN-016]"
        )
    copy = float64_copy(module).requires_grad_(False)
    rng, weights = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    derivative = function.jacobian()
    second = Batched(function).reverse.forward.function if hessians else None
    jacobian = torch.func.jacrev(_flat(copy), argnums=tuple(range(len(scales))))
    values, jacobians, products = _Errors(), _Errors(), _Errors()
    for k in range(n):
        kind = k % 10 if k % 10 in (ZEROS, LARGE, SATURATED) else 0
        draws = [_draw(rng, kind, tuple(x.shape)) * s for x, s in zip(example_inputs, scales, strict=True)]
        tensors = [torch.tensor(d, dtype=torch.float64) for d in draws]
        held = [constant(d) for d in draws]
        ours = [ca.evalf(v.mx) for v in held]
        results = function.call(ours)
        blocks = derivative.call([*ours, *results])
        exact = jacobian(*tensors)
        outputs = [y.detach() for y in _leaves(copy(*tensors))]
        for i, output in enumerate(outputs):
            expected, shape = output.numpy().reshape(-1), tuple(output.shape)
            values.add((i, kind), _row_major(results[i], shape), expected)
            row = blocks[i * len(held) : (i + 1) * len(held)]
            jacobians.add((i, kind), *_slopes(row, exact[i], held, shape), np.isfinite(expected).all())
        if second is not None:
            given, product = _products(second, copy, tensors, outputs, weights)
            products.add((0, kind), given, product, all(bool(torch.isfinite(y).all()) for y in outputs))
    left_out = values.left_out + jacobians.left_out
    hvp = products.largest if hessians else (math.nan, math.nan)
    return ParityReport(n, *values.largest, *jacobians.largest, left_out, *hvp, products.left_out)


def _draw(rng: np.random.Generator, kind: int, shape: tuple[int, ...]) -> np.ndarray:
    draw = rng.standard_normal(shape)
    factor = {ZEROS: 0.0, LARGE: 1e3}.get(kind, 1.0)
    return (30.0 * np.sign(draw) if kind == SATURATED else factor * draw) + 0.0  # no negative zeros


def _slopes(
    row: Sequence[ca.DM], exact: Sequence[torch.Tensor], held: Sequence[Value], shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian of one output of this shape by all inputs, ours and torch's, in row-major order."""
    given = [block.full()[_order(shape)] for block in row]
    given = [g[:, x.positions.reshape(-1)] for g, x in zip(given, held, strict=True)]
    slopes = [e.detach().numpy().reshape(g.shape) for e, g in zip(exact, given, strict=True)]
    return np.hstack(given), np.hstack(slopes)


def _products(
    second: ca.Function,
    module: torch.nn.Module,
    inputs: Sequence[torch.Tensor],
    outputs: Sequence[torch.Tensor],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Second derivative of the outputs' sum with random weights along a random direction: ours, torch's."""
    w = [rng.standard_normal(tuple(y.shape)) for y in outputs]
    v = [rng.standard_normal(tuple(x.shape)) for x in inputs]
    arguments = [*(x.numpy() for x in inputs), *w, *v, *(np.zeros(y.shape) for y in w)]
    given = second.call([ca.evalf(constant(a).mx) for a in arguments])
    xs = [x.clone().requires_grad_() for x in inputs]
    slopes = _gradient(_dot(_leaves(module(*xs)), w), xs)
    exact = [g.detach().numpy().reshape(-1) for g in _gradient(_dot(slopes, v), xs)]
    return np.hstack([_row_major(g, x.shape) for g, x in zip(given, v, strict=True)]), np.hstack(exact)


def _dot(tensors: Sequence[torch.Tensor], weights: Sequence[np.ndarray]) -> torch.Tensor:
    return torch.stack([(t * torch.tensor(a)).sum() for t, a in zip(tensors, weights, strict=True)]).sum()


def _gradient(total: torch.Tensor, xs: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    if not total.requires_grad:  # constant or, for second derivatives, linear
        return tuple(torch.zeros_like(x) for x in xs)
    return torch.autograd.grad(total, xs, create_graph=True, materialize_grads=True)


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
