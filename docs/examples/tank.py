"""A tank with a pump: the scenario of docs/own-machine.md."""

import casadi as ca

from hybrid_mpc import OCP, Balance, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal


class Tank(Prior):
    """Torricelli's law: the outlet flow follows the square root of the level."""

    states = outputs = (Signal("level", "m", 0, 1),)
    inputs = (Signal("pump", "l/min", 0, 20),)
    parameters = (
        Parameter("area", 5, "dm^2", 5, 5),  # equal bounds: fixed, only k / area shows in the level
        Parameter("k", 15, "l/min/m^0.5", 5, 40),
    )
    operating_point = OperatingPoint(x=(0.25,), u=(7.5,))

    def out(self, x, p):
        return p.k * ca.sqrt(ca.fmax(x.level, 1e-3))  # differentiable at an empty tank

    def xdot(self, x, u, w, p):
        return ((u.pump - self.out(x, p)) / (600 * p.area),)  # 60 s/min, 10 dm/m

    def balances(self, x, u, w, p):
        water, out = 10 * p.area * x.level, self.out(x, p) / 60  # [l], [l/s]
        return (Balance("water", water, u.pump / 60, out, "l", "l/s"),)


scenario = Scenario(
    "tank",
    "Tank with a pump",
    "In the laboratory.",
    prior=Tank,
    data=DataSpec("time_s", ("pump_lpm",), ("level_m",), dt=5, max_gap=12, smoothing=50, warm_up=60),
    control=OCP(
        horizon=30,  # 150 s
        q=(0,),
        r=(1e-3,),
        r_delta=(1e-2,),  # moves of the input: 1 / (10 l/min)^2
        q_y=(1e3,),  # outputs: 1 / (0.03 m)^2
        u_min=(0,),
        u_max=(20,),
    ),
    sensor_sigma=(2e-3,),  # [m] standard deviation of the level sensor
    safe_input=(0,),  # the pump may stop
)
