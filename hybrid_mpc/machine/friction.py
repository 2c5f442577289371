"""Friction as blocks that any mechanical prior can be given, written in CasADi or in torch."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import components
from hybrid_mpc.machine.signals import Parameter


class FrictionTerm(ABC):
    """A force or torque that opposes the velocity of one axis; a dataclass whose parameters the prior takes over.

    What it takes from the machine, force times velocity, is never negative. Scalars are CasADi's or torch's.
    """

    axis: int

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in the order of its fields."""
        fields = [getattr(self, field.name) for field in dataclasses.fields(self)]  # type: ignore[arg-type]
        return tuple(value for value in fields if isinstance(value, Parameter))

    @abstractmethod
    def force(self, q: Any, v: Any, p: Any) -> Any:
        """Force or torque against the motion, a scalar, at the machine's ``q``, ``v`` and ``p``."""

    def values(self, p: Any) -> tuple[Any, ...]:
        """The values in ``p`` of :attr:`parameters`."""
        return tuple(getattr(p, parameter.name) for parameter in self.parameters)


@dataclass(frozen=True)
class Viscous(FrictionTerm):
    """``d v``.

    Args:
        d: Damping [N m s/rad], not negative.
        axis: Degree of freedom. Default: the first.
    """

    d: Parameter
    axis: int = 0

    def force(self, q: Any, v: Any, p: Any) -> Any:
        """See :class:`FrictionTerm`."""
        (d,) = self.values(p)
        return d * v[self.axis]


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

    def force(self, q: Any, v: Any, p: Any) -> Any:
        """See :class:`FrictionTerm`."""
        return coulomb(v[self.axis], *self.values(p))


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

    def force(self, q: Any, v: Any, p: Any) -> Any:
        """See :class:`FrictionTerm`."""
        return stribeck(v[self.axis], *self.values(p))


@dataclass(frozen=True)
class LoadDependent(FrictionTerm):
    """``rho tanh(gamma v) |load(q, v, p)|``: Coulomb friction of a bearing that carries a load.

    Args:
        arm: Friction coefficient times friction radius rho [m]; motion tells only their product.
        steepness: gamma [s/rad].
        load: ``(q, v, p) -> load``, the load [N] of either sign.
        axis: Degree of freedom. Default: the first.

    Source: Schön, Götte, Timmermann (2022), system 2.
    """

    arm: Parameter
    steepness: Parameter
    load: Callable[[Any, Any, Any], Any]
    axis: int = 0

    def force(self, q: Any, v: Any, p: Any) -> Any:
        """See :class:`FrictionTerm`."""
        return load_dependent(v[self.axis], self.load(q, v, p), *self.values(p))


def coulomb(v: Any, level: Any, steepness: Any) -> Any:
    """``level tanh(steepness v)``."""
    return level * (steepness * v).tanh()


def stribeck(v: Any, level: Any, static: Any, speed: Any, steepness: Any) -> Any:
    """``(level + (static - level) exp(-(v / speed)^2)) tanh(steepness v)``."""
    ratio = v / speed
    return (level + (static - level) * (-ratio * ratio).exp()) * (steepness * v).tanh()


def load_dependent(v: Any, load: Any, arm: Any, steepness: Any) -> Any:
    """``arm tanh(steepness v) |load|``."""
    return arm * (steepness * v).tanh() * abs(load)


def with_friction(base: type[MechanicalPrior], *terms: FrictionTerm) -> type[MechanicalPrior]:
    """A prior class with friction beside what ``base`` has; it is fitted, trained on and exported like any other.

    The terms' forces join the equation of motion and what the energy balance loses; their parameters come after those
    of ``base``.

    Args:
        base: Mechanical prior, in CasADi or in torch.
        terms: Blocks, any number on any axis.

    Raises:
        InputError: If there is no term, ``base`` is no mechanical prior, a parameter's name is there already, or there
            is no such axis.

    Example:
        >>> from hybrid_mpc import Signal
        >>> class Disk(MechanicalPrior):
        ...     states, outputs = (Signal("phi", "rad"), Signal("phi_dot", "rad/s")), (Signal("phi", "rad"),)
        ...     inputs, parameters = (Signal("torque", "N m"),), (Parameter("J", 0.5, "kg m^2", 0.1, 1.0),)
        ...     def mass_matrix(self, q, p):
        ...         return p.J
        >>> rubbing = with_friction(Disk, Viscous(Parameter("d", 0.1, "N m s/rad", 0.0, 1.0)))({"d": 0.2})
        >>> rubbing.equations.xdot([0.0, 1.0], 0.0, [], rubbing.p)
        DM([1, -0.4])
    """
    _check(base, terms)

    class Rubbing(base):  # type: ignore[valid-type,misc]
        parameters = (*base.parameters, *(p for term in terms for p in term.parameters))

        def friction(self, q: Any, v: Any, p: Any) -> Any:
            own = components(super().friction(q, v, p))
            acting = [[t.force(q, v, p) for t in terms if t.axis == i] for i in range(len(own))]
            return tuple(sum(parts, first) for first, parts in zip(own, acting, strict=True))

    made: Any = Rubbing  # under a name and with a docstring that tell what it is
    made.__name__ = made.__qualname__ = f"{base.__name__}With{''.join(type(t).__name__ for t in terms)}"
    made.__module__, made.__doc__ = base.__module__, base.__doc__
    result: type[MechanicalPrior] = made
    return result


def _check(base: type[MechanicalPrior], terms: Sequence[FrictionTerm]) -> None:
    if not terms:
        raise InputError(
            f"friction for {base.__name__}: give at least one term, e.g. Coulomb(level, steepness)"
        )
    if not issubclass(base, MechanicalPrior):
        raise InputError(
            f"friction for {base.__name__}: it must be a MechanicalPrior, whose mass matrix turns force into motion"
        )
    names = [p.name for p in base.parameters] + [p.name for t in terms for p in t.parameters]
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
