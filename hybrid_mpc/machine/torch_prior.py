"""Priors written in torch, and friction as blocks that any of them can be given."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.signals import Parameter, Signal


class Prior(nn.Module):
    """A mechanical ODE prior with its output equation and its energy balance.

    The state is ``x = [q, v]``: positions first, then their velocities, so that ``q_dot = v`` is exact. A
    subclass names its signals and parameters as class attributes and writes ``acceleration`` and ``inertia``; both
    index the last axis of their arguments. Every parameter becomes a float64 ``nn.Parameter`` of shape ``()`` under its
    name.

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

    def __init__(self, values: Mapping[str, float] | None = None) -> None:
        super().__init__()
        if len(self.states) % 2:
            raise InputError(f"{type(self).__name__}: states must be [q, v] in pairs, got {len(self.states)}")
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
        return len(self.states) // 2

    @property
    def values(self) -> dict[str, float]:
        """Current parameter values [SI] by name."""
        return {spec.name: float(getattr(self, spec.name)) for spec in self.parameters_spec}

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Accelerations ``v_dot``, shape ``(..., n_q)``, at ``x`` ``(..., 2 n_q)`` and ``u`` ``(..., n_u)``."""
        raise NotImplementedError(f"{type(self).__name__} must define acceleration(x, u)")

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """Derivative ``xdot`` ``(..., n_x)`` of the state: exact kinematics and :meth:`acceleration`."""
        return torch.cat([x[..., self.n_q :], self.acceleration(x, u)], dim=-1)

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

        By default the equation of motion times the velocity, ``inertia * (v_dot - acceleration(x, u)) * v``: what the
        balance written out term by term comes to. ``v`` is taken from ``x``, ``v_dot`` from ``xdot``.
        """
        v, v_dot = x[..., self.n_q :], xdot[..., self.n_q :]
        return (self.inertia(x) * (v_dot - self.acceleration(x, u)) * v).sum(-1)


class FrictionTerm(ABC):
    """A torque (or force) that opposes the velocity of one axis; a dataclass whose parameters the prior takes over.

    What it takes from the machine, torque times velocity, is never negative.
    """

    axis: int

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in the order of its fields."""
        fields = [getattr(self, field.name) for field in dataclasses.fields(self)]  # type: ignore[arg-type]
        return tuple(value for value in fields if isinstance(value, Parameter))

    @abstractmethod
    def torque(self, prior: Prior, x: Tensor, v: Tensor) -> Tensor:
        """Torque against the motion ``(...)`` [SI] at states ``x`` ``(..., n_x)`` and the axis' velocity ``v``."""

    def values(self, prior: Prior) -> tuple[Tensor, ...]:
        """The prior's present values of :attr:`parameters`."""
        return tuple(getattr(prior, parameter.name) for parameter in self.parameters)


@dataclass(frozen=True)
class Viscous(FrictionTerm):
    """``d v``.

    Args:
        d: Damping [N m s/rad], not negative.
        axis: Degree of freedom. Default: the first.
    """

    d: Parameter
    axis: int = 0

    def torque(self, prior: Prior, x: Tensor, v: Tensor) -> Tensor:
        """See :class:`FrictionTerm`."""
        (d,) = self.values(prior)
        return d * v


@dataclass(frozen=True)
class Coulomb(FrictionTerm):
    """``F_c tanh(gamma v)``: dry friction, smooth at rest.

    ``gamma F_c / inertia`` is the rate at which it stops the machine near rest, and the prior's sub-steps follow it:
    an upper bound of gamma that asks for more than 20 of them a period is refused by whoever steps the prior.

    Args:
        level: Sliding friction F_c [N m].
        steepness: gamma [s/rad].
        axis: Degree of freedom. Default: the first.
    """

    level: Parameter
    steepness: Parameter
    axis: int = 0

    def torque(self, prior: Prior, x: Tensor, v: Tensor) -> Tensor:
        """See :class:`FrictionTerm`."""
        return coulomb(v, *self.values(prior))


@dataclass(frozen=True)
class Stribeck(FrictionTerm):
    """``(F_c + (F_s - F_c) exp(-(v / v_s)^2)) tanh(gamma v)``: more friction near rest than in motion.

    Args:
        level: Sliding friction F_c [N m].
        static: Friction near rest F_s [N m].
        speed: Stribeck speed v_s [rad/s], positive.
        steepness: gamma [s/rad]; 2 / v_s and more, or the smooth sign hides the peak.
        axis: Degree of freedom. Default: the first.

    Source: Armstrong-Hélouvry, Dupont, Canudas de Wit, *A survey of models, analysis tools and compensation methods
    for the control of machines with friction*, Automatica 30 (1994).
    """

    level: Parameter
    static: Parameter
    speed: Parameter
    steepness: Parameter
    axis: int = 0

    def torque(self, prior: Prior, x: Tensor, v: Tensor) -> Tensor:
        """See :class:`FrictionTerm`."""
        return stribeck(v, *self.values(prior))


@dataclass(frozen=True)
class LoadDependent(FrictionTerm):
    """``rho tanh(gamma v) |load(x)|``: Coulomb friction of a bearing that carries a load.

    Args:
        arm: Friction coefficient times friction radius rho [m]; motion tells only their product.
        steepness: gamma [s/rad].
        load: ``(prior, x) -> (...)``, the load [N] of either sign, e.g. :class:`PendulumLoad`.
        axis: Degree of freedom. Default: the first.

    Source: Schön, Götte, Timmermann (2022), system 2.
    """

    arm: Parameter
    steepness: Parameter
    load: Callable[[Prior, Tensor], Tensor]
    axis: int = 0

    def torque(self, prior: Prior, x: Tensor, v: Tensor) -> Tensor:
        """See :class:`FrictionTerm`."""
        return load_dependent(v, self.load(prior, x), *self.values(prior))


@dataclass(frozen=True)
class PendulumLoad:
    """``m v^2 l + m g cos phi``: what the axis of a pendulum carries along its rod [N].

    Args:
        mass: Name of the prior's parameter m [kg].
        length: Name of l [m].
        gravity: Name of g [m/s^2].
    """

    mass: str = "m"
    length: str = "l"
    gravity: str = "g"

    def __call__(self, prior: Prior, x: Tensor) -> Tensor:
        """The load ``(...)`` [N] at ``x`` ``(..., n_x)``."""
        m, length, g = (getattr(prior, name) for name in (self.mass, self.length, self.gravity))
        return m * x[..., 1] * x[..., 1] * length + m * g * torch.cos(x[..., 0])


def coulomb(v: Tensor, level: Tensor, steepness: Tensor) -> Tensor:
    """``level tanh(steepness v)``, any shape."""
    return level * torch.tanh(steepness * v)


def stribeck(v: Tensor, level: Tensor, static: Tensor, speed: Tensor, steepness: Tensor) -> Tensor:
    """``(level + (static - level) exp(-(v / speed)^2)) tanh(steepness v)``, any shape."""
    ratio = v / speed
    return (level + (static - level) * torch.exp(-ratio * ratio)) * torch.tanh(steepness * v)


def load_dependent(v: Tensor, load: Tensor, arm: Tensor, steepness: Tensor) -> Tensor:
    """``arm tanh(steepness v) |load|``, any shape."""
    return arm * torch.tanh(steepness * v) * torch.abs(load)


def with_friction(base: type[Prior], *terms: FrictionTerm) -> type[Prior]:
    """A prior class with friction beside what ``base`` has; it is fitted, trained on and exported like any other.

    ``M v_dot = M base_acceleration(x, u) - sum of torques``, and the torques times the velocities join the energy
    balance. The terms' parameters come after those of ``base``.

    Args:
        base: Prior class with ``inertia(x)``.
        terms: Blocks, any number on any axis.

    Raises:
        InputError: If there is no term, ``base`` has no ``inertia``, a parameter's name is there already, or there
            is no such axis.

    Example:
        >>> class Disk(Prior):
        ...     states, outputs = (Signal("phi", "rad"), Signal("phi_dot", "rad/s")), (Signal("phi", "rad"),)
        ...     inputs, parameters_spec = (Signal("torque", "N m"),), (Parameter("J", 0.5, "kg m^2", 0.1, 1.0),)
        ...     def acceleration(self, x, u):
        ...         return u / self.J
        ...     def inertia(self, x):
        ...         return self.J
        >>> rubbing = with_friction(Disk, Viscous(Parameter("d", 0.1, "N m s/rad", 0.0, 1.0)))({"d": 0.2})
        >>> rubbing(torch.tensor([0.0, 1.0]), torch.tensor([0.0])).tolist()
        [1.0, -0.4]
    """
    _check(base, terms)
    added = tuple(p for term in terms for p in term.parameters)

    def torques(prior: Prior, x: Tensor) -> Tensor:
        n_q = prior.n_q
        v = x[..., n_q:]
        none = torch.zeros_like(v[..., 0])
        on = [[t.torque(prior, x, v[..., i]) for t in terms if t.axis == i] for i in range(n_q)]
        return torch.stack([sum(parts, none) for parts in on], dim=-1)

    class Rubbing(base):  # type: ignore[valid-type,misc]
        parameters_spec = (*base.parameters_spec, *added)
        # whether the balance is made of ``acceleration``, not written out term by term
        balance_follows_acceleration = base.energy_balance is Prior.energy_balance or bool(
            getattr(base, "balance_follows_acceleration", False)
        )

        def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
            free: Tensor = super().acceleration(x, u)
            return free - torques(self, x) / self.inertia(x)

        def energy_balance(self, x: Tensor, xdot: Tensor, u: Tensor) -> Tensor:
            balance: Tensor = super().energy_balance(x, xdot, u)
            if self.balance_follows_acceleration:
                return balance  # it is made of this class's acceleration
            return balance + (torques(self, x) * x[..., self.n_q :]).sum(-1)

    made: Any = Rubbing  # under a name and with a docstring that tell what it is
    made.__name__ = made.__qualname__ = f"{base.__name__}With{''.join(type(t).__name__ for t in terms)}"
    made.__module__, made.__doc__ = base.__module__, base.__doc__
    result: type[Prior] = made
    return result


def _check(base: type[Prior], terms: Sequence[FrictionTerm]) -> None:
    if not terms:
        raise InputError(
            f"friction for {base.__name__}: give at least one term, e.g. Coulomb(level, steepness)"
        )
    if base.inertia is Prior.inertia:
        raise InputError(
            f"friction for {base.__name__}: it must define inertia(x), which turns torque into motion"
        )
    names = [p.name for p in base.parameters_spec] + [p.name for t in terms for p in t.parameters]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"friction for {base.__name__}: parameter {', '.join(twice)} is there twice; rename one"
        )
    n_q = len(base.states) // 2
    for term in terms:
        if not 0 <= term.axis < n_q:
            raise InputError(
                f"friction for {base.__name__}: no axis {term.axis}; it has {n_q} degrees of freedom, from 0"
            )
