"""A pendulum on the bench, written by its mass matrix, potential and friction."""

import casadi as ca

from hybrid_mpc import OCP, DataSpec, MechanicalPrior, OperatingPoint, Parameter, Scenario, Signal


class Pendulum(MechanicalPrior):
    """A rod on an axis with viscous friction, driven by a torque."""

    states, inputs = (Signal("phi", "rad"), Signal("phi_dot", "rad/s")), (Signal("tau", "N m", -3, 3),)
    outputs = (Signal("phi", "rad", -7, 7),)  # readings beyond 7 rad are refused as implausible
    parameters = (
        Parameter("J", 0.1, "kg m^2", 0.1, 0.1),
        Parameter("d", 0.05, "N m s", 0.0, 0.5),
        Parameter("mgl", 1.0, "N m", 0.3, 3.0),
    )  # name, value, unit, bounds of the fit
    operating_point = OperatingPoint(x=(0.0, 0.0), u=(0.0,))  # it hangs

    def mass_matrix(self, q, p):
        return p.J

    def potential(self, q, p):
        return -p.mgl * ca.cos(q.phi)

    def friction(self, q, v, p):
        return p.d * v.phi_dot


scenario = Scenario(
    "my_machine",
    "My pendulum",
    "On the bench.",
    prior=Pendulum,
    data=DataSpec("time_s", ("tau_nm",), ("phi_rad",), dt=0.02, max_gap=0.05, smoothing=0.2, warm_up=0.5),
    control=OCP(
        50, q=(25, 0.25), r=(0,), r_delta=(1,), u_min=(-1,), u_max=(1,)
    ),  # r > 0 would weigh holding it
    sensor_sigma=(1e-3,),  # rad
)
