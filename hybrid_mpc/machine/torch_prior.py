"""Priors written in torch: traced once, and from then on CasADi functions like any other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import torch
from torch import Tensor, nn

import nn_export
from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.prior import Balance, Prior, named


class TorchPrior(Prior):
    """A prior whose methods are written in torch.

    Methods take named tuples of scalar tensors, ``x.level``, and return tuples of such tensors or of numbers, without
    a batch axis. They are traced once, so they must not branch on values: ``torch.where`` instead of ``if``. All else
    is as in :class:`~hybrid_mpc.machine.prior.Prior`. With :class:`~hybrid_mpc.machine.mechanical.MechanicalPrior` as a
    second base, its parts are written in torch.

    Raises:
        nn_export.ExportError: During tracing, if a method uses an operation that cannot be exported.

    Example:
        >>> from hybrid_mpc import Parameter, Signal
        >>> class Tank(TorchPrior):
        ...     states = (Signal("level", "m", 0.0, 1.0),)
        ...     inputs = (Signal("inflow", "m^3/s"),)
        ...     outputs = (Signal("level", "m"),)
        ...     parameters = (Parameter("area", 2.0, "m^2", 1.0, 4.0), Parameter("k", 0.2, "m^2.5/s", 0.0, 1.0))
        ...
        ...     def xdot(self, x, u, w, p):
        ...         return ((u.inflow - p.k * torch.sqrt(x.level.clamp_min(1e-6))) / p.area,)
        >>> tank = Tank()
        >>> tank.equations.xdot(0.25, 0.1, [], tank.p)
        DM(0)
    """

    def evaluated(self, method: str, *arguments: tuple[str, ca.SX]) -> Any:
        """See :class:`~hybrid_mpc.machine.prior.Prior`."""
        what = f"{type(self).__name__}.{method}"
        kind = type(what, (_Traced,), {})  # the name appears in messages about the export
        module = kind(self, method, tuple(self.names_of(key) for key, _ in arguments))
        examples = tuple(torch.ones(v.numel(), dtype=torch.float64) for _, v in arguments)
        try:
            shape = module.result(*examples)  # structure of the result: nested tuples, balances
        except (NotImplementedError, TypeError) as error:
            if "Tensor" not in str(error):
                raise
            raise InputError(
                f"{what} gets torch tensors: {str(error).splitlines()[0]} A method written in CasADi needs a Prior, "
                "not a TorchPrior. [HM-MACHINE-040]"
            ) from error
        scalars = _scalars(shape, what)
        if not any(isinstance(s, Tensor) for s in scalars):
            return shape
        names = [f"{key}{i}" for i, (key, _) in enumerate(arguments)]
        try:
            program = nn_export.trace(module, examples, input_names=names)
        except nn_export.ExportError as error:
            if str(error).startswith(what):
                raise
            raise type(error)(f"{what}: {error}") from error
        values = nn_export.build(program).expand()(*(v for _, v in arguments))
        return _like(shape, iter(ca.vertsplit(values)))


class _Traced(nn.Module):
    """One method of a prior, from vectors to one vector."""

    def __init__(self, prior: Prior, method: str, names: tuple[tuple[str, ...], ...]) -> None:
        super().__init__()
        self._prior, self._method, self._names = prior, method, names

    def result(self, *vectors: Tensor) -> Any:
        parts = (
            named(names, [v[i] for i in range(len(v))]) for names, v in zip(self._names, vectors, strict=True)
        )
        return getattr(self._prior, self._method)(*parts)

    def forward(self, *vectors: Tensor) -> Tensor:
        found = [s for s in _scalars(self.result(*vectors), type(self).__name__) if isinstance(s, Tensor)]
        # operators that need no decomposition are traced twice as fast
        return torch.stack(
            [s if s.ndim == 0 and s.dtype is torch.float64 else s.reshape(()).double() for s in found]
        )


def _parts_of(value: Any) -> list[Any] | None:
    """The parts of a tuple, a balance or a vector; None for a scalar."""
    if isinstance(value, Balance):
        return [value.storage, value.supply, value.loss]
    if isinstance(value, Tensor) and value.ndim:
        return list(value.unbind(0))
    return list(value) if isinstance(value, tuple | list) else None


def _scalars(value: Any, what: str) -> list[Any]:
    parts = _parts_of(value)
    if parts is not None:
        return [scalar for part in parts for scalar in _scalars(part, what)]
    if not isinstance(value, Tensor | float | int):
        raise InputError(
            f"{what} of a TorchPrior must give tensors or numbers in tuples, got {type(value).__name__}. Check for a "
            "missing 'return'; a method written in CasADi needs a Prior. [HM-MACHINE-041]"
        )
    return [value]


def _like(value: Any, scalars: Any) -> Any:
    """The same structure, with each tensor replaced by the next scalar."""
    if isinstance(value, Balance):
        storage, supply, loss = (_like(v, scalars) for v in (value.storage, value.supply, value.loss))
        return replace(value, storage=storage, supply=supply, loss=loss)
    parts = _parts_of(value)
    if parts is not None:
        return tuple(_like(part, scalars) for part in parts)
    return next(scalars) if isinstance(value, Tensor) else value
