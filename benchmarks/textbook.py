"""Priors as textbooks have them, one for each real machine and one for the golf robot: what a search for missing terms
starts from (``benchmarks/explain.py``).

Written before the library of terms, from the books that each class names, and fixed since. They take the columns
of the scenario's own prior, so that ``replace(scenario, prior=TEXTBOOK[name])`` is judged on the same recordings.
"""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Prior, Signal

GRAVITY = 9.81
ROOT_WIDTH = 0.1
"""Level [V] below which a root is smoothed: its slope at an empty tank has no end."""
CORNER = 0.03
"""Speed [V] below which an absolute value is rounded."""
TURNING: tuple[Signal, Signal] = (
    Signal("phi", "rad", -60.0, 60.0, periodic=True),
    Signal("phi_dot", "rad/s", -100.0, 100.0),
)
HANGING = OperatingPoint((0.0, 0.0), (0.0,))


class PendulumPrior(MechanicalPrior):
    """``J phi'' = torque - mgl sin phi - d phi'``: a rigid pendulum with viscous friction.

    Source: H. K. Khalil, *Nonlinear Systems*, 3rd edition (2002), section 1.2.1.
    """

    states: ClassVar[tuple[Signal, ...]] = TURNING
    outputs: ClassVar[tuple[Signal, ...]] = (TURNING[0],)
    operating_point: ClassVar[OperatingPoint | None] = HANGING

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertia about the axis [kg m^2]."""
        return p.J

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the pendulum [J]."""
        return -p.mgl * ca.cos(q.phi)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction [N m]."""
        return p.d * v.phi_dot

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """The commanded torque [N m]."""
        return u.torque


class DiskPrior(PendulumPrior):
    """``phi'' = -w_0^2 sin phi - gamma phi' + K_u u``: a pendulum on a direct-current motor without inductance.

    Source: K. Ogata, *Modern Control Engineering*, 5th edition (2010), sections 3.3 and 3.4.
    """

    inputs: ClassVar[tuple[Signal, ...]] = (Signal("voltage", "V", -12.0, 12.0),)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("J", 2.44e-4, "kg m^2", 2.44e-4, 2.44e-4, "inertia (fixed: it shows in no motion)"),
        Parameter("w_0", 11.0, "rad/s", 5.0, 20.0, "natural frequency"),
        Parameter("gamma", 1.5, "1/s", 0.0, 20.0, "viscous friction and back-EMF over J"),
        Parameter("K_u", 28.0, "rad/s^2/V", 5.0, 100.0, "acceleration a volt"),
    )

    def potential(self, q: Any, p: Any) -> Any:
        """Height of the weight [J]."""
        return -p.J * p.w_0 * p.w_0 * ca.cos(q.phi)

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction and back-EMF [N m]."""
        return p.J * p.gamma * v.phi_dot

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Torque of the motor's voltage [N m]."""
        return p.J * p.K_u * u.voltage


class AxisPrior(MechanicalPrior):
    """``M q'' = F - F_v q'``: a linear motor on a viscous guide.

    Source: K. Ogata, *Modern Control Engineering*, 5th edition (2010), section 3.2.
    """

    states: ClassVar[tuple[Signal, ...]] = (Signal("q", "m", -1.0, 1.0), Signal("q_dot", "m/s", -5.0, 5.0))
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("force", "N", -1000.0, 1000.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("M", 95.0, "kg", 30.0, 300.0, "inertia at the carriage"),
        Parameter("F_v", 200.0, "N s/m", 0.0, 1000.0, "viscous friction"),
    )
    operating_point: ClassVar[OperatingPoint | None] = HANGING

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Mass [kg]."""
        return p.M

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction [N]."""
        return p.F_v * v.q_dot

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Force of the drive [N]."""
        return u.force


class ServoPrior(PendulumPrior):
    """``J phi'' = e k_t / R (duty U - k_t phi') - mgl sin phi - d phi'``: a pendulum on a direct-current motor.

    ``e`` is 1 with the motor switched on and 0 without.

    Source: K. Ogata, *Modern Control Engineering*, 5th edition (2010), sections 3.3 and 3.4.
    """

    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("duty", "-", -1.0, 1.0),
        Signal("supply", "V", 0.0, 14.0),
        Signal("enabled", "-", 0.0, 1.0),
    )
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("mgl", 0.4807, "N m", 0.4807, 0.4807, "largest gravity torque: 0.49 kg at 0.10 m (fixed)"),
        Parameter("J", 0.0065, "kg m^2", 0.003, 0.03, "inertia with the rotor's"),
        Parameter("k_t", 0.39, "N m/A", 0.1, 1.5, "torque constant at the output"),
        Parameter("R", 4.0, "ohm", 0.5, 20.0, "resistance"),
        Parameter("d", 0.004, "N m s/rad", 0.0, 0.2, "viscous friction"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((0.0, 0.0), (0.0, 12.0, 1.0))

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Torque of the motor [N m]."""
        return u.enabled * p.k_t / p.R * (u.duty * u.supply - p.k_t * v.phi_dot)


class TorquePrior(PendulumPrior):
    """A pendulum whose torque is commanded."""

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("phi", "rad", -40.0, 40.0, periodic=True),
        Signal("phi_dot", "rad/s", -40.0, 40.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("torque", "N m", -5.0, 5.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("J", 0.15, "kg m^2", 0.05, 0.5, "inertia about the axis"),
        Parameter("mgl", 3.0, "N m", 1.0, 8.0, "largest gravity torque"),
        Parameter("d", 0.01, "N m s/rad", 0.0, 0.5, "viscous friction"),
    )


class ClubPrior(PendulumPrior):
    """``J phi'' = 4 u - mgl sin phi - d phi'``: the golf robot as a pendulum with viscous friction.

    Source: H. K. Khalil, *Nonlinear Systems*, 3rd edition (2002), section 1.2.1.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("phi", "rad", -3.2, 3.2),
        Signal("phi_dot", "rad/s", -15.0, 15.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("u", "N m", -0.6, 0.6),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0],)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("J", 0.1445, "kg m^2", 0.05, 0.4, "inertia about the axis"),
        Parameter("mgl", 2.4, "N m", 1.0, 5.0, "largest gravity torque"),
        Parameter("d", 0.0132, "N m s/rad", 0.0, 0.5, "viscous damping"),
    )

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        """Motor torque at the club, with the gear's ratio of 4 [N m]."""
        return 4.0 * u.u


class TanksPrior(Prior):
    """``upper' = k_p u - k_1 sqrt(upper)``, ``lower' = k_1 sqrt(upper) - k_2 sqrt(lower)``, measured as it is.

    Source: K. H. Johansson, *The quadruple-tank process*, IEEE TCST 8 (2000); Torricelli's law, a tank above a tank.
    """

    states: ClassVar[tuple[Signal, ...]] = (Signal("upper", "V", 0.0, 16.0), Signal("lower", "V", 0.0, 12.0))
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("pump", "V", 0.0, 10.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (Signal("level", "V", 0.0, 12.0, saturation=(-ca.inf, 10.0)),)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k_1", 0.05, "V^0.5/s", 0.01, 0.3, "outlet of the upper tank"),
        Parameter("k_2", 0.05, "V^0.5/s", 0.01, 0.3, "outlet of the lower tank"),
        Parameter("k_p", 0.05, "1/s", 0.01, 0.3, "inflow a volt of the pump"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((6.0, 6.0), (2.45,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of both levels [V/s]."""
        out = [k * h / (h * h + ROOT_WIDTH**2) ** 0.25 for k, h in ((p.k_1, x.upper), (p.k_2, x.lower))]
        return p.k_p * u.pump - out[0], out[0] - out[1]

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """The lower level [V]."""
        return (x.lower,)


class HeatersPrior(Prior):
    """``T_i' = (P_i Q_i + T_a - T_i) / tau + (T_j - T_i) / tau_12``: two heat balances with straight losses.

    Source: D. E. Seborg, T. F. Edgar, D. A. Mellichamp, F. J. Doyle, *Process Dynamics and Control*, 3rd edition
    (2011), section 2.4.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("temperature1", "degC", 0.0, 120.0),
        Signal("temperature2", "degC", 0.0, 120.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("power1", "%", 0.0, 100.0),
        Signal("power2", "%", 0.0, 100.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = states
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("P1", 0.7, "K/%", 0.2, 2.0, "warming of heater 1 over the room a per cent"),
        Parameter("P2", 0.5, "K/%", 0.1, 2.0, "of heater 2"),
        Parameter("T_a", 24.0, "degC", 10.0, 40.0, "temperature of the room"),
        Parameter("tau", 150.0, "s", 20.0, 600.0, "time constant of a heater against the room"),
        Parameter("tau_12", 500.0, "s", 50.0, 5000.0, "of a heater against the other"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((45.0, 45.0), (30.0, 42.0))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the temperatures [K/s]."""
        between = (x.temperature2 - x.temperature1) / p.tau_12
        return (
            (p.P1 * u.power1 + p.T_a - x.temperature1) / p.tau + between,
            (p.P2 * u.power2 + p.T_a - x.temperature2) / p.tau - between,
        )


class ExchangerPrior(Prior):
    """``tau outlet' = k valve (reservoir - cold) + cold - outlet``: a mixer of hot and cold with one time constant.

    Source: D. E. Seborg, T. F. Edgar, D. A. Mellichamp, F. J. Doyle, *Process Dynamics and Control*, 3rd edition
    (2011), sections 2.4 and 5.2.
    """

    states: ClassVar[tuple[Signal, ...]] = (Signal("outlet", "degC", 0.0, 100.0),)
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("valve", "-", -0.5, 3.0),)
    disturbances: ClassVar[tuple[Signal, ...]] = (Signal("reservoir", "degC", 20.0, 100.0),)
    outputs: ClassVar[tuple[Signal, ...]] = states
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k", 0.3, "-", 0.05, 1.0, "share of hot water at a command of 1"),
        Parameter("cold", 41.0, "degC", 20.0, 60.0, "temperature of the cold side"),
        Parameter("tau", 17.0, "s", 3.0, 100.0, "time constant of the plates"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((52.1,), (1.0,), (78.0,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rate of the outlet's temperature [K/s]."""
        return ((p.k * u.valve * (w.reservoir - p.cold) + p.cold - x.outlet) / p.tau,)


class TwoLinkPrior(MechanicalPrior):
    """``M(q) q'' + C(q, q') q' + dV/dq + b q' = torques``: two rigid links with viscous friction, without rotors.

    ``q2`` counts from the first link.

    Source: M. W. Spong, S. Hutchinson, M. Vidyasagar, *Robot Modeling and Control* (2006), section 7.3.2.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("q1", "rad", -20.0, 20.0, periodic=True),
        Signal("q2", "rad", -20.0, 20.0, periodic=True),
        Signal("v1", "rad/s", -40.0, 40.0),
        Signal("v2", "rad/s", -60.0, 60.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("tau1", "N m", -8.0, 8.0),
        Signal("tau2", "N m", -8.0, 8.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = states
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "J_1", 0.057, "kg m^2", 0.01, 0.2, "first link and the second's mass about the first joint"
        ),
        Parameter("J_2", 0.05, "kg m^2", 0.01, 0.2, "second link about its joint"),
        Parameter("mr_1", 0.23, "kg m", 0.05, 0.6, "first moment of the first link with the second's mass"),
        Parameter("mr_2", 0.16, "kg m", 0.03, 0.5, "first moment of the second link"),
        Parameter("l_1", 0.2, "m", 0.2, 0.2, "length of the first link (fixed)"),
        Parameter("b_1", 0.01, "N m s/rad", 0.0, 0.5, "viscous friction of the first joint"),
        Parameter("b_2", 0.01, "N m s/rad", 0.0, 0.5, "of the second joint"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((0.0, 0.0, 0.0, 0.0), (0.0, 0.0))

    def mass_matrix(self, q: Any, p: Any) -> Any:
        """Inertias of the links [kg m^2]."""
        coupling = p.l_1 * p.mr_2 * ca.cos(q.q2)
        return (p.J_1 + p.J_2 + 2 * coupling, p.J_2 + coupling), (p.J_2 + coupling, p.J_2)

    def potential(self, q: Any, p: Any) -> Any:
        """Height of both links [J]."""
        return -GRAVITY * (p.mr_1 * ca.cos(q.q1) + p.mr_2 * ca.cos(q.q1 + q.q2))

    def friction(self, q: Any, v: Any, p: Any) -> Any:
        """Viscous friction of both joints [N m]."""
        return p.b_1 * v.v1, p.b_2 * v.v2


class DrivesPrior(Prior):
    """``lag motor' = gain u - motor``, ``pulley'' = w^2 (motor - pulley) - 2 zeta w pulley'``, ``y = |pulley|``.

    Source: T. Wigren, M. Schoukens, *Coupled electric drives data set and reference models*, Uppsala TR 2017-024, the
    linear model of third order.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("motor", "V", -10.0, 10.0),
        Signal("pulley", "V", -10.0, 10.0),
        Signal("pulley_dot", "V/s", -200.0, 200.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("drives", "V", -10.0, 10.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (Signal("speed", "V", -0.5, 10.0),)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("gain", 1.0, "-", 0.1, 10.0, "speed a volt"),
        Parameter("lag", 0.2, "s", 0.02, 1.0, "of the drives"),
        Parameter("w", 24.0, "rad/s", 8.0, 60.0, "natural frequency of the belt"),
        Parameter("zeta", 0.3, "-", 0.0, 1.0, "its damping"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((1.0, 1.0, 0.0), (1.0,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the motor's speed, the pulley's speed, its acceleration [V/s, V/s^2]."""
        return (
            (p.gain * u.drives - x.motor) / p.lag,
            x.pulley_dot,
            p.w * p.w * (x.motor - x.pulley) - 2 * p.zeta * p.w * x.pulley_dot,
        )

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """The speed without its sign [V]."""
        return (ca.sqrt(x.pulley * x.pulley + CORNER**2) - CORNER,)


class BicyclePrior(Prior):
    """``x' = v cos psi``, ``y' = v sin psi``, ``psi' = v tan(delta) / L``, ``v' = (command - v) / tau``.

    The front wheels stand at the commanded angle ``delta``; the rear axle's middle is measured.

    Source: R. Rajamani, *Vehicle Dynamics and Control*, 2nd edition (2012), section 2.2.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("x", "m", -20.0, 20.0),
        Signal("y", "m", -20.0, 20.0),
        Signal("heading", "rad", -10.0, 10.0, periodic=True),
        Signal("speed", "m/s", -1.0, 5.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("steering_command", "rad", -0.6, 0.6),
        Signal("speed_command", "m/s", -1.0, 5.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = states
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("L", 0.33, "m", 0.2, 0.6, "distance of the axles"),
        Parameter("tau", 0.2, "s", 0.03, 1.0, "lag of the speed"),
    )
    corrects: ClassVar[tuple[str, ...]] = ("heading", "speed")
    operating_point: ClassVar[OperatingPoint] = OperatingPoint((0.0, 0.0, 0.0, 0.3), (0.0, 0.3))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of position [m/s], heading [rad/s] and speed [m/s^2]."""
        return (
            x.speed * ca.cos(x.heading),
            x.speed * ca.sin(x.heading),
            x.speed * ca.tan(u.steering_command) / p.L,
            (u.speed_command - x.speed) / p.tau,
        )


TEXTBOOK: dict[str, type[Prior]] = {
    "unbalanced_disk": DiskPrior,
    "emps": AxisPrior,
    "xl330_pendulum": ServoPrior,
    "torque_pendulum": TorquePrior,
    "cascaded_tanks": TanksPrior,
    "temperature_lab": HeatersPrior,
    "heat_exchanger": ExchangerPrior,
    "double_pendulum": TwoLinkPrior,
    "coupled_drives": DrivesPrior,
    "race_car": BicyclePrior,
    "golf_robot": ClubPrior,
}
"""Textbook priors by the name of the scenario."""
