"""The oracle: the rig's own equations as a model of the controller's form. No torch in here."""

from __future__ import annotations

import warnings

import casadi as ca

from hybrid_mpc import HybridModel
from nn_export import compile_function
from nn_export.errors import CompileError
from scenarios.golf_robot.dynamics import N_STATES, RigParameters, rhs
from scenarios.golf_robot.integration import steps, steps_with_jacobian
from scenarios.golf_robot.nominal import GEAR, INPUTS, OUTPUTS, PARAMETERS, STATES


def oracle(dt: float, parameters: RigParameters | None = None, sub_steps: int = 50) -> HybridModel:
    """The rig as a :class:`HybridModel`.

    Its ``h`` is (bristle [-], motor torque [N m], belt twist [rad], motor speed / 4 [rad/s]). All of it is
    smooth but for ``|phi_dot|`` in the bristle's equation and the drag, so its Jacobian exists through stiction
    and backlash. Steps and derivatives are compiled where there is a C compiler, else CasADi's virtual machine makes
    them. 50 RK4 steps of 0.4 ms at 20 ms are stable to about 6 rad/s. Its energy balance is the prior's.
    """
    p = parameters or RigParameters()
    run = _compiled(steps(p, sub_steps), derivatives=True)
    x, h, u, rate = ca.MX.sym("x", 2), ca.MX.sym("h", N_STATES - 2), ca.MX.sym("u"), ca.MX.sym("rate", 2)
    after = run(ca.vertcat(x, h), u, dt / sub_steps)
    end, a, b = steps_with_jacobian(p, sub_steps)(ca.vertcat(x, h), u, dt / sub_steps)
    s, v = ca.SX.sym("s", N_STATES), ca.SX.sym("v")
    f = ca.Function("f", [s, v], [rhs(s, v, p)[0][:2]])
    none = ca.MX.sym("none", 0)
    slopes = ca.Function("with_jacobian", [x, h, u, none, none], [end[:2], end[2:], a, b])
    return HybridModel.of(
        "oracle", dt, STATES, INPUTS, OUTPUTS,
        x=x, h=h, u=u, x_next=after[:2], h_next=after[2:], xdot=f(ca.vertcat(x, h), u), y=x[0],
        rate=rate, energy=_energy_balance(x, rate, u), with_jacobian=_compiled(slopes),
    )  # fmt: skip


def _compiled(f: ca.Function, *, derivatives: bool = False) -> ca.Function:
    """The function as C; as it is where there is no compiler or it does not work: both compute the same."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            return compile_function(f, derivatives=derivatives)
        except CompileError:
            return f


def _energy_balance(x: ca.MX, xdot: ca.MX, u: ca.MX) -> ca.MX:
    p = {spec.name: spec.value for spec in PARAMETERS}
    phi, v = x[0], x[1]
    load = ca.fabs(p["m"] * v**2 * p["a"] + p["m"] * p["g"] * ca.cos(phi))
    friction = p["r"] * p["mu"] * ca.tanh(p["gamma"] * v) * load
    gravity = p["m"] * p["g"] * p["a"] * ca.sin(phi)
    return v * (p["J"] * xdot[1] + gravity + p["d"] * v + friction - GEAR * u)
