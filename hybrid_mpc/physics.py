"""The prior: the ODE that explains most of a machine, written once (torch).

The same code trains on any batch and is exported for one sample, because it indexes the last axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from hybrid_mpc.errors import InputError
from hybrid_mpc.signals import Parameter, Signal


class Prior(nn.Module):
    """A mechanical ODE prior with its output equation and its energy balance.

    The state is ``x = [q, v]``: positions first, then their velocities, so that ``q_dot = v`` is exact. ``n_extra``
    states of another kind (a lagging input, say) may follow, whose rates :meth:`extra_rates` gives.
    A subclass names its signals and parameters as class attributes and writes two methods. Every
    parameter becomes a float64 ``nn.Parameter`` of shape ``()`` under its name.

    Args:
        values: Parameter values [SI] by name that replace the nominal ones, e.g. fitted ones.

    Raises:
        InputError: If a name in ``values`` is no parameter, or the signals do not form ``[q, v]``.

    Example:
        >>> class Pendulum(Prior):
        ...     states = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
        ...     inputs = (Signal("torque", "N m"),)
        ...     outputs = (Signal("phi", "rad"),)
        ...     parameters_spec = (Parameter("J", 0.1, "kg m^2", 0.01, 1.0),)
        ...     def acceleration(self, x, u):
        ...         return u / self.J
        ...     def inertia(self, x):
        ...         return self.J
        >>> Pendulum()(torch.tensor([0.0, 1.0]), torch.tensor([0.2])).tolist()
        [1.0, 2.0]
    """

    states: ClassVar[tuple[Signal, ...]]
    inputs: ClassVar[tuple[Signal, ...]]
    outputs: ClassVar[tuple[Signal, ...]]
    parameters_spec: ClassVar[tuple[Parameter, ...]]
    n_extra: ClassVar[int] = 0

    def __init__(self, values: Mapping[str, float] | None = None) -> None:
        super().__init__()
        if (len(self.states) - self.n_extra) % 2:
            found = len(self.states) - self.n_extra
            raise InputError(f"{type(self).__name__}: states must be [q, v] in pairs, got {found}")
        values = dict(values or {})
        for spec in self.parameters_spec:
            value = torch.tensor(values.pop(spec.name, spec.value), dtype=torch.float64)
            self.register_parameter(spec.name, nn.Parameter(value, requires_grad=False))
        if values:
            names = ", ".join(spec.name for spec in self.parameters_spec)
            raise InputError(f"{type(self).__name__} has no parameter {', '.join(values)}; it has: {names}")

    @property
    def n_q(self) -> int:
        """Number of degrees of freedom."""
        return (len(self.states) - self.n_extra) // 2

    @property
    def values(self) -> dict[str, float]:
        """Current parameter values [SI] by name."""
        return {spec.name: float(getattr(self, spec.name)) for spec in self.parameters_spec}

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Accelerations ``v_dot``, shape ``(..., n_q)``, at ``x`` ``(..., 2 n_q)`` and ``u`` ``(..., n_u)``."""
        raise NotImplementedError(f"{type(self).__name__} must define acceleration(x, u)")

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """Derivative ``xdot`` ``(..., n_x)`` of the state: exact kinematics and :meth:`acceleration`."""
        if self.n_extra:
            return torch.cat([self._velocity(x), self.acceleration(x, u), self.extra_rates(x, u)], dim=-1)
        return torch.cat([x[..., self.n_q :], self.acceleration(x, u)], dim=-1)

    def extra_rates(self, x: Tensor, u: Tensor) -> Tensor:
        """Rates ``(..., n_extra)`` of the states after ``[q, v]``; only a prior that has such states needs it."""
        raise NotImplementedError(
            f"{type(self).__name__} has n_extra states and must define extra_rates(x, u)"
        )

    def output(self, x: Tensor, u: Tensor) -> Tensor:
        """Measured outputs ``(..., n_y)``. Default: the positions."""
        return x[..., : len(self.outputs)]

    def inertia(self, x: Tensor) -> Tensor | float:
        """Generalised inertia of each velocity [SI], a number or ``(..., n_q)``, for :meth:`energy_balance`."""
        raise NotImplementedError(
            f"{type(self).__name__} must define inertia(x), or energy_balance(x, xdot, u)"
        )

    def energy_balance(self, x: Tensor, xdot: Tensor, u: Tensor) -> Tensor:
        """Energy balance ΔE [W], shape ``(...)``: zero along the prior's own flow.

        The velocity comes from the state ``x``, the acceleration from ``xdot``. By default it is the equation
        of motion times the velocity, ``inertia * (v_dot - acceleration(x, u)) * v``: the same number as the
        balance written out term by term, and no equation is written twice.
        """
        v, v_dot = self._velocity(x), self._velocity(xdot)
        return (self.inertia(x) * (v_dot - self.acceleration(x, u)) * v).sum(-1)

    def _velocity(self, x: Tensor) -> Tensor:
        """The second ``n_q`` of a state or of its derivative."""
        return x[..., self.n_q : 2 * self.n_q] if self.n_extra else x[..., self.n_q :]
