"""A, B, C, D as CasADi functions of the operating point."""

from __future__ import annotations

import casadi as ca

from hybrid_mpc.errors import InputError
from hybrid_mpc.model import HybridModel


def jacobians(model: HybridModel, *, continuous: bool = False) -> ca.Function:
    """``(x, h, u) -> (A, B, C, D)`` of ``z = (x, h)``, exact, as a function that can be differentiated again.

    Args:
        model: The model.
        continuous: Of ``xdot`` instead of the step; needs a model without hidden state. Default: no.

    Returns:
        ``A`` ``(n_z, n_z)``, ``B`` ``(n_z, n_u)``, ``C`` ``(n_y, n_z)``, ``D`` ``(n_y, n_u)``, all dense.

    Raises:
        InputError: If the continuous form of a model with hidden state is asked for: that lives in steps of ``dt``.

    Example:
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("cubic", 0.1, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=x + 0.1 * (u - x**3), xdot=u - x**3, y=x)
        >>> round(float(jacobians(model)(2.0, [], 0.0)[0]), 12)
        -0.2
        >>> float(jacobians(model, continuous=True)(2.0, [], 0.0)[0])
        -12.0
    """
    if continuous and model.n_h:
        raise InputError(
            f"model {model.name} has {model.n_h} hidden states, which step once a period of {model.dt:g} s and have "
            "no rate; leave continuous=True out, or linearise the prior"
        )
    x, h, u = ca.MX.sym("x", model.n_x), ca.MX.sym("h", model.n_h), ca.MX.sym("u", model.n_u)
    if continuous:
        f = model.xdot(x, h, u, model.w, model.p)
        a, b = ca.jacobian(f, x), ca.jacobian(f, u)
    else:
        assert model.with_jacobian is not None
        *_, a, b = model.with_jacobian(x, h, u, model.w, model.p)
    y = model.output(x, u, model.w, model.p)
    c = ca.horzcat(ca.jacobian(y, x), ca.MX.zeros(model.n_y, model.n_h))
    results = [ca.densify(m) for m in (a, b, c, ca.jacobian(y, u))]
    return ca.Function("jacobians", [x, h, u], results, ["x", "h", "u"], ["A", "B", "C", "D"])
