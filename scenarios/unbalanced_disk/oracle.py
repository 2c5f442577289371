"""The oracle: the plant's own equations as a model of the controller's form. No torch in here."""

from __future__ import annotations

import warnings
from math import ceil

import casadi as ca

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel
from nn_export import compile_function
from nn_export.errors import CompileError
from scenarios.unbalanced_disk.dynamics import N_STATES, UNIT, DiskParameters, rhs, steps, steps_with_slopes
from scenarios.unbalanced_disk.nominal import INPUTS, OUTPUTS, PARAMETERS, STATES


def oracle(dt: float, parameters: DiskParameters | None = None, sub_step: float = 0.5e-3) -> HybridModel:
    """The plant as a :class:`HybridModel`.

    Its ``h`` is (the command before [V], motor current [A], bristle [rad]). Within a period the command before acts
    first, for the plant's delay, then the new one. ``xdot`` takes the voltage that acts. Its derivatives are compiled
    where there is a C compiler.

    Args:
        dt: Model period [s].
        parameters: The plant's parameters. Default: those of the default plant.
        sub_step: Largest Runge-Kutta step [s]. Default 0.5 ms.

    Returns:
        The model; its energy balance is the prior's, with the nominal parameters.

    Raises:
        InputError: If the delay is not within a period.

    Example:
        >>> oracle(0.025).n_h
        3
    """
    p = parameters or DiskParameters()
    if not 0 < p.delay < dt:
        raise InputError(f"disk's oracle: the delay must lie within a period of {dt} s, it is {p.delay} s")
    x, h, u, w = ca.MX.sym("x", 2), ca.MX.sym("h", 3), ca.MX.sym("u"), ca.MX.sym("w", 2)
    z, before = ca.vertcat(x, h[1:]), h[0]
    parts = [(length, ceil(length / sub_step)) for length in (p.delay, dt - p.delay)]
    (first, n), (rest, m) = parts
    end = steps(p, m)(steps(p, n)(z, before, first / n), u, rest / m)
    both = ca.vertcat(z, ca.vec(ca.MX(UNIT)))
    both = steps_with_slopes(p, n)(both, ca.vertcat(before, 1, 0), first / n)
    both = steps_with_slopes(p, m)(both, ca.vertcat(u, 0, 1), rest / m)
    slopes = ca.reshape(both[N_STATES:], N_STATES, N_STATES + 2)
    # order of the states: x, then h = (command before, current, bristle)
    by = ca.horzcat(slopes[:, :2], slopes[:, 4], slopes[:, 2:4])
    a = ca.vertcat(by[:2, :], ca.MX(1, 5), by[2:, :])
    b = ca.vertcat(slopes[:2, 5], 1, slopes[2:, 5])
    after = ca.vertcat(u, both[2:N_STATES])
    s, v = ca.SX.sym("s", N_STATES), ca.SX.sym("v")
    f = ca.Function("f", [s, v], [rhs(s, v, p)[:2]])
    return HybridModel(
        "oracle",
        dt,
        STATES,
        INPUTS,
        OUTPUTS,
        step=ca.Function("step", [x, h, u], [end[:2], ca.vertcat(u, end[2:])]),
        xdot=ca.Function("xdot", [x, h, u], [f(z, u)]),
        output=ca.Function("output", [x, u], [x[0]]),
        energy_balance=ca.Function("energy_balance", [x, w, u], [_energy_balance(x, w, u)]),
        with_jacobian=_compiled(
            ca.Function("with_jacobian", [x, h, u], [both[:2], after, ca.densify(a), ca.densify(b)])
        ),
        waiting=1,
    )


def _compiled(f: ca.Function) -> ca.Function:
    """The function as C; as it is where there is no compiler or it does not work: both compute the same."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            return compile_function(f)
        except CompileError:
            return f


def _energy_balance(x: ca.MX, xdot: ca.MX, u: ca.MX) -> ca.MX:
    p = {spec.name: spec.value for spec in PARAMETERS}
    phi, v = x[0], x[1]
    model = (
        p["K_u"] * u
        - p["w_0"] ** 2 * ca.sin(phi + p["phi_0"])
        - p["gamma"] * v
        - p["F_c"] * ca.tanh(v / 0.05)
    )
    return p["J"] * v * (xdot[1] - model)
