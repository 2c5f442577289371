"""CasADi functions as torch modules: differentiable any number of times, over any batch, under torch.func."""

from __future__ import annotations

from typing import Any

import casadi as ca
import torch
from torch import Tensor

from nn_export.batched import Batched
from nn_export.errors import DtypeError, SignatureError


def from_casadi(function: ca.Function, *, own_derivatives: bool = True) -> CasadiModule:
    """A CasADi function as a torch module, e.g. a prior to train with.

    Gradients are CasADi's own derivative functions, of any order; branches that ``if_else`` does not take
    cannot spoil them. ``torch.func`` (``vmap``, ``jacrev``, ``jacfwd``, ``jvp``, ``hessian``) works; the older
    ``torch.autograd.functional`` with ``vectorize=True`` does not. Numbers that are to be trained are inputs of the
    function: pass a ``torch.nn.Parameter``.

    Args:
        function: Any CasADi function of real numbers. One that can be expanded to scalar operations (at most
            3000) can be exported again by :func:`nn_export.to_casadi` and runs on any device; others
            (solvers, tables, external code) run on the CPU.
        own_derivatives: False: torch differentiates the operators that it runs, which halves the time of a training
            through thousands of calls. Then a branch that ``if_else`` does not take must have finite derivatives, and
            the function must be expandable. Default: CasADi's derivatives.

    Returns:
        Module called with one tensor for each input, in the function's order. It has no parameters.

    Raises:
        SignatureError: If ``function`` is no CasADi function, or has no inputs or outputs.

    Example:
        >>> x, k = ca.SX.sym("x", 2), ca.SX.sym("k")
        >>> spring = from_casadi(ca.Function("spring", [x, k], [-k * x[0]], ["x", "k"], ["force"]))
        >>> stiffness = torch.tensor(3.0, requires_grad=True)
        >>> force = spring(torch.tensor([[1.0, 0.0], [2.0, 0.0]]), stiffness)
        >>> force.tolist(), torch.autograd.grad(force.sum(), stiffness)[0].item()
        ([[-3.0], [-6.0]], -3.0)
    """
    return CasadiModule(function, own_derivatives)


class CasadiModule(torch.nn.Module):
    """What :func:`from_casadi` returns.

    Shapes: a column of n (n = 1 too) is ``(..., n)``, any other r x c matrix ``(..., r, c)``; an input of one
    element may be a tensor without axes. The leading axes are the batch and are broadcast. Sparse inputs take
    dense tensors, of which only the nonzeros count; sparse outputs come back dense.

    All is computed in float64. The result has the widest dtype among the inputs: float32 inputs give the exact
    result rounded once to float32, and so do their gradients.

    Args:
        function: As in :func:`from_casadi`.
        own_derivatives: As in :func:`from_casadi`.

    Raises:
        SignatureError: If the function is none.
        ExportError: If it has no form in torch operators, and torch is to differentiate them.
    """

    def __init__(self, function: ca.Function, own_derivatives: bool = True) -> None:
        super().__init__()
        if not isinstance(function, ca.Function):
            raise SignatureError(f"expected a casadi.Function, got {type(function).__name__} [NN-100]")
        if not function.n_in() or not function.n_out():
            raise SignatureError(f"{function}: at least one input and one output are needed [NN-101]")
        self.batched, self.own_derivatives = Batched(function), own_derivatives
        if not own_derivatives:
            self.batched.check_walkable()

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """One tensor for each output, alone if there is one.

        Raises:
            SignatureError: If number or shapes of the tensors do not fit the function.
            DtypeError: If an input holds no real numbers.
            DerivativeError: On differentiation, if CasADi has no derivative.
        """
        f = self.batched.function
        if len(inputs) != f.n_in():
            raise SignatureError(f"{f}: {f.n_in()} tensors are needed, got {len(inputs)} [NN-102]")
        flat = [_nonzeros(f, i, x) for i, x in enumerate(inputs)]
        wide = [x if x.dtype is torch.float64 else x.to(torch.float64) for x in flat]
        walked = (
            torch.compiler.is_exporting() or not self.own_derivatives
        )  # an export records plain operators
        if not walked and len({x.shape[:-1] for x in flat}) > 1:
            wide = [x.expand(*_batch(f, inputs, flat), x.shape[-1]) for x in wide]
        dtype = flat[0].dtype
        for other in {x.dtype for x in flat} - {dtype}:
            dtype = torch.promote_types(dtype, other)
        results = (
            self.batched.walk(wide, _batch(f, inputs, flat)) if walked else _Call.apply(self.batched, *wide)
        )
        outputs = tuple(_dense(f.sparsity_out(i), y) for i, y in enumerate(results))
        outputs = tuple(y if y.dtype is dtype else y.to(dtype) for y in outputs)
        return outputs if len(outputs) > 1 else outputs[0]

    def extra_repr(self) -> str:
        """The signature of the function."""
        return str(self.batched.function)


class _Call(torch.autograd.Function):
    """One evaluation; its derivatives are evaluations of CasADi's derivative functions."""

    @staticmethod
    def forward(batched: Batched, *args: Tensor) -> tuple[Tensor, ...]:
        return tuple(batched.evaluate(list(args)))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.batched = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_Call.apply(ctx.batched.reverse, *ctx.saved_tensors, *seeds)

    @staticmethod
    def jvp(ctx: Any, _: None, *directions: Tensor | None) -> tuple[Tensor, ...]:
        args = ctx.saved_tensors
        given = (torch.zeros_like(a) if d is None else d for a, d in zip(args, directions, strict=True))
        return tuple(_Call.apply(ctx.batched.forward, *args, *given))

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], batched: Batched, *args: Tensor) -> tuple[Any, Any]:
        moved = [
            a.expand(info.batch_size, *a.shape) if d is None else a.movedim(d, 0)
            for a, d in zip(args, in_dims[1:], strict=True)
        ]
        results = _Call.apply(batched, *moved)
        return results, (0,) * len(results)


def _batch(f: ca.Function, inputs: tuple[Tensor, ...], flat: list[Tensor]) -> tuple[int, ...]:
    try:
        return tuple(torch.broadcast_shapes(*(x.shape[:-1] for x in flat)))
    except RuntimeError as error:
        shapes = ", ".join(str(tuple(x.shape)) for x in inputs)
        raise SignatureError(
            f"{f}: leading axes of {shapes} cannot be broadcast together [NN-103]"
        ) from error


def _nonzeros(f: ca.Function, i: int, x: Tensor) -> Tensor:
    """The tensor for an input as its nonzeros along the last axis, column by column."""
    sparsity, name = f.sparsity_in(i), f.name_in(i)
    rows, columns = sparsity.shape
    wanted = (rows,) if columns == 1 else (rows, columns)
    if not isinstance(x, Tensor) or not x.is_floating_point():
        given = x.dtype if isinstance(x, Tensor) else type(x).__name__
        raise DtypeError(
            f"{f}: {name} must be a tensor of real numbers, got {given}; use torch.as_tensor(..).double() [NN-104]"
        )
    if x.ndim == 0 and sparsity.numel() == 1:
        x = x.reshape(1)
    if tuple(x.shape[-len(wanted) :]) != wanted or x.ndim < len(wanted):
        expected = f"(..., {', '.join(map(str, wanted))})"
        raise SignatureError(f"{f}: {name} must have the shape {expected}, got {tuple(x.shape)} [NN-105]")
    flat = x if columns == 1 else x.transpose(-1, -2).flatten(-2)
    return flat if sparsity.is_dense() else flat[..., sparsity.find()]


def _dense(sparsity: ca.Sparsity, y: Tensor) -> Tensor:
    """An output's nonzeros as the dense tensor."""
    rows, columns = sparsity.shape
    if not sparsity.is_dense():
        where = [sparsity.nnz()] * sparsity.numel()  # structural zeros: the element appended
        for k, position in enumerate(sparsity.find()):
            where[position] = k
        y = torch.cat([y, y.new_zeros((*y.shape[:-1], 1))], -1)[..., where]
    return y if columns == 1 else y.unflatten(-1, (columns, rows)).transpose(-1, -2)
