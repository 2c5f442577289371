"""Priors of mechanical machines: an equation of motion from mass matrix, potential, friction and forces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.prior import POINT, Balance, Prior, column, components


class MechanicalPrior(Prior):
    """``M(q) q_ddot + C(q, q_dot) q_dot + dV/dq + friction = force``; the states are ``x = [q, v]``, ``q_dot = v``.

    A subclass defines :meth:`mass_matrix` and, as needed, :meth:`potential`, :meth:`friction` and :meth:`force`.
    Coriolis and centrifugal forces follow from the mass matrix. The kinematics ``q_dot = v`` are exact, so networks
    correct only the accelerations (``corrects`` is the speeds). The energy balance follows from the same parts: ``T +
    V`` is stored, the power of the force is supplied, that of the friction is lost. Its residual is the paper's ΔE.
    Balances of :meth:`balances` are added.

    Methods take named tuples of scalars, ``q`` (first half of the states) and ``v`` (second half). They are
    written in torch if the class derives from :class:`~hybrid_mpc.machine.torch_prior.TorchPrior`.

    Raises:
        InputError: If the states are not ``[q, v]`` in pairs.

    Example:
        >>> from hybrid_mpc import Parameter, Signal
        >>> class Pendulum(MechanicalPrior):
        ...     states = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
        ...     inputs = (Signal("torque", "N m"),)
        ...     outputs = (Signal("phi", "rad"),)
        ...     parameters = (Parameter("J", 0.1, "kg m^2", 0.01, 1.0), Parameter("mgl", 2.0, "N m", 1.0, 4.0))
        ...
        ...     def mass_matrix(self, q, p):
        ...         return p.J
        ...
        ...     def potential(self, q, p):
        ...         return -p.mgl * ca.cos(q.phi)
        >>> pendulum = Pendulum()
        >>> pendulum.equations.xdot([ca.pi / 2, 1.0], 2.5, [], pendulum.p)
        DM([1, 5])
    """

    corrects: ClassVar[tuple[str, ...] | None] = None
    methods: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "mass_matrix": ("q", "p"), "potential": ("q", "p"), "friction": ("q", "v", "p"),
        "force": ("q", "v", *POINT[1:]), "output": POINT, "balances": POINT,
    }  # fmt: skip
    _speeds: ClassVar[tuple[str, ...] | None] = None

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        states = getattr(cls, "states", ())  # from the class, a base or a mixin
        if len(states) % 2:
            raise InputError(
                f"{cls.__name__}: states must be [q, v] in pairs, got {len(states)}: "
                f"{', '.join(s.name for s in states)} [HM-MACHINE-001]"
            )
        if cls.corrects is cls._speeds:  # the user has chosen no others
            cls.corrects = cls._speeds = tuple(s.name for s in states[len(states) // 2 :]) or None

    @property
    def n_q(self) -> int:
        """Number of degrees of freedom."""
        return len(self.states) // 2

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia [SI]: rows of the symmetric, positive definite matrix ``((m11, m12), (m21, m22))``.

        A tuple of scalars is a diagonal; a scalar is the inertia of one degree of freedom.
        """
        raise NotImplementedError(f"{type(self).__name__} must define mass_matrix(q, p)")

    def potential(self, q: Any, p: Any) -> Any:
        """Potential energy V [J]. Default: none."""
        return 0.0

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Generalised forces against the motion, one per degree of freedom [N or N m]. Default: none.

        Their power is the loss, so it must not be negative.
        """
        return (0.0,) * self.n_q

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Generalised driving forces, one per degree of freedom [N or N m]. Default: the inputs."""
        if len(self.inputs) != self.n_q:
            raise InputError(
                f"{type(self).__name__}: {len(self.inputs)} inputs for {self.n_q} degrees of freedom. Define "
                "force(q, v, u, w, p). [HM-MACHINE-002]"
            )
        return tuple(u)

    def names_of(self, argument: str) -> tuple[str, ...]:
        """Names of the components of ``x, u, w, p``, and of ``q`` and ``v``."""
        if argument in ("q", "v"):
            names = super().names_of("x")
            return names[: self.n_q] if argument == "q" else names[self.n_q :]
        return super().names_of(argument)

    def _parts(self, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[ca.SX, ...]:
        """``q, v``, mass matrix, potential energy, friction and force."""
        n, kind = self.n_q, type(self).__name__
        q, v = ca.SX.sym("q", n), ca.SX.sym("v", n)
        mass = self._matrix(self.evaluated("mass_matrix", ("q", q), ("p", p)))
        potential = column(self.evaluated("potential", ("q", q), ("p", p)), 1, f"{kind}.potential(q, p)")
        rubbing = self.evaluated("friction", ("q", q), ("v", v), ("p", p))
        friction = column(rubbing, n, f"{kind}.friction(q, v, p)", self.names_of("v"))
        given = ("q", q), ("v", v), ("u", u), ("w", w), ("p", p)
        force = column(self.evaluated("force", *given), n, f"{kind}.force(q, v, u, w, p)", self.names_of("v"))
        return q, v, mass, potential, friction, force

    @property
    def masses(self) -> ca.Function:
        """The mass matrix as a function ``(q, p) -> M (n_q, n_q)``."""
        q, p = ca.SX.sym("q", self.n_q), ca.SX.sym("p", len(self.parameters))
        matrix = self._matrix(self.evaluated("mass_matrix", ("q", q), ("p", p)))
        return ca.Function("mass_matrix", [q, p], [ca.densify(matrix)], ["q", "p"], ["M"])

    def _matrix(self, value: Any) -> ca.SX:
        n, found = self.n_q, components(value)
        if any(one is None for one in found):
            raise InputError(
                f"{type(self).__name__}.mass_matrix(q, p) gives None. Check for a missing 'return'. [HM-MACHINE-003]"
            )
        entries = [ca.SX(c) for c in found]
        if len(entries) == n:
            return ca.diag(ca.vertcat(*entries))
        if len(entries) != n * n:
            raise InputError(
                f"{type(self).__name__}.mass_matrix(q, p) must give {n} rows of {n} values, or {n} values of a "
                f"diagonal; got {len(entries)} values [HM-MACHINE-004]"
            )
        return ca.reshape(ca.vertcat(*entries), n, n).T

    def expressions(self, x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[Any, Any, tuple[Balance, ...]]:
        """Rates of the states, outputs and balances from the equation of motion."""
        given = tuple(zip(POINT, (x, u, w, p), strict=True))
        q, v, mass, potential, friction, force = self._parts(u, w, p)
        # Lagrange: d/dt(M v) - dT/dq + dV/dq = force - friction with T = v' M v / 2,
        # so M v_dot = force - friction - dV/dq - (d(M v)/dq v - dT/dq)
        momentum = mass @ v
        kinetic = 0.5 * ca.dot(v, momentum)
        gyroscopic = ca.jacobian(momentum, q) @ v - ca.gradient(kinetic, q)
        driving = force - friction - ca.gradient(potential, q) - gyroscopic
        diagonal = mass.sparsity().is_diag()
        rate = driving / ca.diag(mass) if diagonal else ca.solve(mass, driving)
        terms = ca.vertcat(v, rate), kinetic + potential, ca.dot(force, v), ca.dot(friction, v)
        xdot, stored, supplied, lost = (ca.substitute(term, ca.vertcat(q, v), x) for term in terms)
        energy = Balance("energy", stored, supplied, lost)
        return xdot, self.evaluated("output", *given), (energy, *self._balances(*given))
