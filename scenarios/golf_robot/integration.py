"""The rig's equations, integrated: classical Runge-Kutta steps in CasADi's virtual machine. No torch in here."""

from __future__ import annotations

import casadi as ca
import numpy as np

from scenarios.common import repeated, rk4
from scenarios.golf_robot.dynamics import HEALTHY, N_STATES, Conditions, RigParameters, rhs


def one_step(p: RigParameters, *, faulty: bool = False) -> ca.Function:
    """Function ``(s, q, h) -> s`` of one RK4 step of length ``h`` [s] of the rig's equations."""
    s, q, h = ca.SX.sym("s", N_STATES), ca.SX.sym("q", 5 if faulty else 1), ca.SX.sym("h")
    conditions = Conditions(*(q[i] for i in range(1, 5))) if faulty else HEALTHY
    f = ca.Function("f", [s, q], [rhs(s, q[0], p, conditions)[0]])
    after = rk4(f, s, q, h)
    if faulty:
        after[4] = ca.fmin(ca.fmax(after[4], -conditions.limit), conditions.limit)
    return ca.Function("one", [s, q, h], [after])


def steps(p: RigParameters, n: int, *, faulty: bool = False) -> ca.Function:
    """Function ``(s, q, h) -> s`` of ``n`` times :func:`one_step` with the same ``q`` and ``h``."""
    return repeated(one_step(p, faulty=faulty), n)


def steps_with_jacobian(p: RigParameters, n: int) -> ca.Function:
    """Function ``(s, u, h) -> (s, A, B)`` of ``n`` RK4 steps, with the derivatives by ``s`` and by ``u``.

    The sensitivities are integrated beside the state, whose equations' Jacobian is sparse. By RK4 they are the
    derivative of RK4's own map, not an approximation, and they cost a third of CasADi's forward mode.
    """
    s, u, h = ca.SX.sym("s", N_STATES), ca.SX.sym("u"), ca.SX.sym("h")
    w = ca.SX.sym("w", N_STATES, N_STATES + 1)  # derivatives of the state by (its start, u)
    ds = rhs(s, u, p)[0]
    by_u = ca.horzcat(ca.SX(N_STATES, N_STATES), ca.jacobian(ds, u))
    rates = ca.vertcat(ds, ca.vec(ca.densify(ca.jacobian(ds, s) @ w + by_u)))
    both = ca.vertcat(s, ca.vec(w))
    f = ca.Function("f", [both, u], [rates])
    one = ca.Function("one", [both, u, h], [rk4(f, both, u, h)])
    z, q, step = ca.MX.sym("z", N_STATES), ca.MX.sym("q"), ca.MX.sym("h")
    unit = np.eye(N_STATES, N_STATES + 1)
    end = repeated(one, n)(ca.vertcat(z, ca.vec(ca.MX(unit))), q, step)
    slopes = ca.reshape(end[N_STATES:], N_STATES, N_STATES + 1)
    results = [end[:N_STATES], slopes[:, :N_STATES], slopes[:, N_STATES]]
    return ca.Function("steps_with_jacobian", [z, q, step], results)
