"""The oracle: the pendulum's own equation as a model of the controller's form. No torch in here."""

from __future__ import annotations

import casadi as ca

from hybrid_mpc import HybridModel
from scenarios.common import rk4
from scenarios.pendulum.nominal import INPUTS, OUTPUTS, PUBLISHED, STATES
from scenarios.pendulum.plant import PendulumParameters


def oracle(dt: float, parameters: PendulumParameters | None = None, sub_steps: int = 10) -> HybridModel:
    """The plant as a :class:`HybridModel` with an empty hidden state."""
    p = parameters or PendulumParameters()
    x, u, rate = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("rate", 2)
    xdot = ca.vertcat(x[1], (u - p.gravity * ca.sin(x[0]) - p.d * x[1]) / p.inertia)
    rates, z = ca.Function("rates", [x, u], [xdot]), x
    for _ in range(sub_steps):
        z = rk4(rates, z, u, dt / sub_steps)
    published = {spec.name: spec.value for spec in PUBLISHED}
    m, length, d, g = (published[name] for name in ("m", "l", "d", "g"))
    torque = m * length**2 * rate[1] + m * g * length * ca.sin(x[0]) + d * x[1] - u
    return HybridModel.of(
        "oracle",
        dt,
        STATES,
        INPUTS,
        OUTPUTS,
        x=x,
        u=u,
        x_next=z,
        xdot=xdot,
        y=x[0],
        rate=rate,
        energy=x[1] * torque,
    )
