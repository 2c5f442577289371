"""What the tests of the controllers share."""

import numpy as np

from hybrid_mpc import OCP, Estimate

POINT = [0.0, 1.0], [0.0]
"""A working point in motion, where the pendulum's friction is flat."""


def estimate_of(model, z, d=0.0):
    """An estimate at ``z = (x, h)``, or at ``x`` with a hidden state of zero."""
    x, h = np.split(np.asarray(z, dtype=float), [model.n_x])
    h = h if h.size else np.zeros(model.n_h)
    d = np.broadcast_to(np.asarray(d, dtype=float), model.n_u)
    return Estimate(0.0, x, h, d, np.eye(x.size + h.size + d.size), np.zeros(1), 0.0)


def plan_of(controller, estimate, reference, weight=None, *, start=None, **options):
    """The plan of a first solve."""
    return controller.solve(controller.initial(estimate, start), estimate, reference, weight, **options)


def pendulum_problem(horizon, bound=2.0, r_delta=0.2, **others):
    """Weights of the pendulum that most tests use."""
    return OCP(horizon, [50.0, 0.5], [0.5], [r_delta], [-bound], [bound], working_point=POINT, **others)


def linear_problem(n_u, horizon, *, bound=np.inf, du_max=None, r_delta=0.0):
    """A problem of three states; the bounds are not symmetric."""
    r = np.linspace(0.4, 0.7, n_u)
    limit = None if du_max is None else [du_max] * n_u
    return OCP(horizon, [1.0, 0.5, 2.0], r, [r_delta] * n_u, [-bound] * n_u, [0.7 * bound] * n_u, limit)
