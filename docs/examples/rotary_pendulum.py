"""A rotary pendulum as its user first wrote it, with a sign of the coupling for the other direction of an angle.

``SIGN = 1.0`` is right.
"""

import casadi as ca

from hybrid_mpc import OCP, DataSpec, MechanicalPrior, OperatingPoint, Parameter, Scenario, Signal

SIGN = -1.0


class RotaryPendulum(MechanicalPrior):
    """``alpha`` from upright, voltage in."""

    states = (
        Signal("theta", "rad", -2.5, 2.5),
        Signal("alpha", "rad", -0.6, 0.6),
        Signal("theta_dot", "rad/s", -30.0, 30.0),
        Signal("alpha_dot", "rad/s", -30.0, 30.0),
    )
    inputs = (Signal("voltage", "V", -10.0, 10.0),)
    outputs = states[:2]
    parameters = (
        Parameter("Jr", 5.7e-5, "kg m^2", 1e-5, 5e-4, "arm about its pivot"),
        Parameter("mp", 0.024, "kg", 0.024, 0.024),
        Parameter("Lr", 0.085, "m", 0.085, 0.085),
        Parameter("Lp", 0.129, "m", 0.129, 0.129),
        Parameter("Jp", 3.33e-5, "kg m^2", 5e-6, 2e-4, "pendulum about its centre"),
        Parameter("km", 0.042, "V s/rad", 0.01, 0.1),
        Parameter("Rm", 8.4, "ohm", 8.4, 8.4),
        Parameter("Dr", 0.0015, "N m s/rad", 0.0, 0.01),
        Parameter("Dp", 0.0005, "N m s/rad", 0.0, 0.01),
    )
    operating_point = OperatingPoint(x=(0.0, 0.0, 0.0, 0.0), u=(0.0,))

    def mass_matrix(self, q, p):
        c = SIGN * 0.5 * p.mp * p.Lp * p.Lr * ca.cos(q.alpha)
        a = p.Jr + p.mp * p.Lr**2 + 0.25 * p.mp * p.Lp**2 * ca.sin(q.alpha) ** 2
        return (a, c), (c, p.Jp + 0.25 * p.mp * p.Lp**2)

    def potential(self, q, p):
        return 0.5 * p.mp * 9.81 * p.Lp * ca.cos(q.alpha)

    def friction(self, q, v, p):
        return p.Dr * v.theta_dot, p.Dp * v.alpha_dot

    def force(self, q, v, u, w, p):
        return p.km * (u.voltage - p.km * v.theta_dot) / p.Rm, 0.0


scenario = Scenario(
    "rotary_pendulum",
    "Rotary pendulum, upright",
    "Held upright by a controller.",
    prior=RotaryPendulum,
    data=DataSpec("t", ("voltage",), ("theta", "alpha"), dt=0.008, max_gap=0.02, smoothing=0.04, warm_up=0.4),
    control=OCP(
        100, q=(0, 0, 0, 0), r=(0.0,), u_min=(-10.0,), u_max=(10.0,), r_delta=(1.0,), q_y=(100.0, 400.0)
    ),
    sensor_sigma=(0.0015, 0.0015),
    safe_input=(0.0,),
)
