"""Constrained linear-quadratic problems solved by other means than the controller's: a least-squares problem
over the inputs, its matrix found by simulating unit inputs, its constraints met by NNLS."""

import casadi as ca
import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls


def residuals(u, a, b, ocp, dt, terminal, z0, d, reference, u_prev, weight=None):
    """Weighted residuals; their sum of squares is the cost of the plan ``u`` (N, n_u)."""
    z, before, rows = z0, u_prev, []
    weight = np.ones((ocp.horizon + 1, ocp.n_x)) if weight is None else weight
    for k in range(ocp.horizon):
        du = u[k] - before
        rows += [np.sqrt(dt * weight[k] * ocp.q) * (z[: ocp.n_x] - reference[k])]
        rows += [np.sqrt(dt * ocp.r) * u[k], np.sqrt(dt * ocp.r_delta) * du]
        z, before = a @ z + b @ (u[k] + d), u[k]
    rows.append(cholesky(terminal) @ (np.sqrt(weight[-1]) * (z[: ocp.n_x] - reference[-1])))
    return np.concatenate(rows)


def lq_plan(a, b, ocp, dt, terminal, z0, d, reference, u_prev, weight=None):
    """Optimal plan (N, n_u): least squares without bounds, least-distance programming with them."""
    shape = ocp.horizon, ocp.n_u
    n = ocp.horizon * ocp.n_u
    f = lambda u: residuals(u.reshape(shape), a, b, ocp, dt, terminal, z0, d, reference, u_prev, weight)  # noqa: E731
    r0 = f(np.zeros(n))
    m = np.stack([f(e) - r0 for e in np.eye(n)], axis=1)
    g, h = constraints(ocp, u_prev)
    if not len(g):
        return np.linalg.lstsq(m, -r0, rcond=None)[0].reshape(shape)
    return least_squares(m, r0, g, h).reshape(shape)


def constraints(ocp, u_prev):
    """``G u <= h``: finite bounds, then limits of the change."""
    eye = np.eye(ocp.horizon * ocp.n_u)
    g, h = [eye, -eye], [np.tile(ocp.u_max, ocp.horizon), -np.tile(ocp.u_min, ocp.horizon)]
    if ocp.du_max is not None:
        difference = eye - np.eye(len(eye), k=-ocp.n_u)
        limit = np.tile(ocp.du_max, ocp.horizon)
        held = np.concatenate([u_prev, np.zeros(len(eye) - ocp.n_u)])
        g, h = [*g, difference, -difference], [*h, limit + held, limit - held]
    finite = np.isfinite(np.concatenate(h))
    return np.vstack(g)[finite], np.concatenate(h)[finite]


def least_squares(m, r0, g, h):
    """``min |M s + r0|`` with ``G s <= h``: Lawson and Hanson, *Solving Least Squares Problems*, chapter 23."""
    q, r = np.linalg.qr(m)
    shift = q.T @ r0
    g_y = solve_triangular(r, g.T, trans="T").T
    c, f = -g_y, -(h + g_y @ shift)
    e, rhs = np.vstack([c.T, f]), np.append(np.zeros(len(r)), 1.0)
    distance = e @ nnls(e, rhs)[0] - rhs
    y = -distance[:-1] / distance[-1]
    return solve_triangular(r, y - shift)


def states(u, a, b, ocp, z0, d):
    """States (N, n_x) after each input of the plan ``u`` (N, n_u)."""
    z, rows = z0, []
    for k in range(ocp.horizon):
        z = a @ z + b @ (u[k] + d)
        rows.append(z[: ocp.n_x])
    return np.array(rows)


def soft_plan(a, b, ocp, dt, terminal, z0, d, reference, u_prev, weight=None):
    """Optimal plan with soft bounds on the states, by IPOPT over the inputs and a slack for every bound, and its
    cost."""
    shape, n = (ocp.horizon, ocp.n_u), ocp.horizon * ocp.n_u
    f = lambda u: residuals(u.reshape(shape), a, b, ocp, dt, terminal, z0, d, reference, u_prev, weight)  # noqa: E731
    x = lambda u: states(u.reshape(shape), a, b, ocp, z0, d).ravel()  # noqa: E731
    r0, x0 = f(np.zeros(n)), x(np.zeros(n))
    m, by_u = (np.stack([g(e) - g0 for e in np.eye(n)], axis=1) for g, g0 in ((f, r0), (x, x0)))
    opti = ca.Opti()
    u, s = opti.variable(n), opti.variable(x0.size)
    linear, quadratic = (np.tile(v, ocp.horizon) * dt for v in ocp.penalties)
    opti.minimize(ca.sumsqr(m @ u + r0) + ca.dot(linear, s) + ca.dot(quadratic, s**2))
    g, h = constraints(ocp, u_prev)
    opti.subject_to(g @ u <= h)
    opti.subject_to(s >= 0)
    for bound, sign in ((ocp.x_max, 1), (ocp.x_min, -1)):
        rows = np.flatnonzero(np.isfinite(np.tile(bound, ocp.horizon)))
        limit = np.tile(bound, ocp.horizon)[rows]
        opti.subject_to(sign * (x0[rows] + by_u[rows] @ u - limit) <= s[rows])
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-11})
    answer = opti.solve()
    return answer.value(u).reshape(shape), answer.value(opti.f)
