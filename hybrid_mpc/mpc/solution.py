"""What a solve returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Status(Enum):
    """How a solve ended; the value is the message.

    Example:
        >>> Status.INFEASIBLE.ok, Status.SOLVED.ok
        (False, True)
    """

    INITIAL = "a first plan, not optimised"
    SOLVED = "the QP was solved and its solution checked"
    NOT_FINITE = "the estimate, the reference, the model or the plan holds a value that is not finite"
    STOPPED = "the iterations ended before convergence; the plan keeps the model and the limits"
    INFEASIBLE = "the solution violates an input bound or the limit of its change"
    INACCURATE = "the solution fails the KKT check"
    NLP_FAILED = "the nonlinear solver's answer keeps neither the model nor the limits"
    LATE = "the solve missed its deadline"

    @property
    def ok(self) -> bool:
        """True if the plan may be applied."""
        return self in (Status.SOLVED, Status.STOPPED)


@dataclass(frozen=True)
class Solution:
    """A plan from ``t_k`` on, and how it was found.

    Args:
        u: Inputs ``(N, n_u)``; ``u[0]`` is the one to hold now.
        x: Predicted states ``(N + 1, n_x)``.
        h: Predicted hidden states ``(N + 1, n_h)``.
        d: Input disturbance ``(n_u,)`` that the prediction assumes: the model runs on ``u + d``.
        cost: Cost of the plan (see :class:`~hybrid_mpc.mpc.OCP`); NaN if it was not solved.
        status: How the solve ended.
        kkt: KKT residual in the QP's scaling, relative to its gradient [-]; of ``ipopt`` that of the NLP.
        defect: Largest defect ``|x_{k+1} - f(x_k, h_k, u_k)|`` at the last linearisation, over (x, h).
        timing: Durations [ms] by name (``prepare``, ``feedback``); recorded, never used to decide.
        excess: Largest violation of a soft bound in the plan [its unit].
        iterations: Linearisations (or iterations of the nonlinear solver) of this solve.
        curvature: Second derivatives of the stages by ``(x, u, h)`` ``(N, n, n)``, or by ``(x, u)`` where the
            hidden state's hardly matter, that ``sqp`` starts its next solve with; None from other solvers.
    """

    u: Array
    x: Array
    h: Array
    d: Array
    cost: float
    status: Status
    kkt: float
    defect: float
    timing: Mapping[str, float]
    excess: float = 0.0
    iterations: int = 1
    curvature: Array | None = None

    def delayed(self, u_held: Array) -> Solution:
        """The plan one period earlier, with ``u_held`` ``(n_u,)`` held in it: a solve that shifts it has this plan.

        It loses its last period, which the shift appends anew.
        """
        x, h = (np.vstack([v[:1], v[:-1]]) for v in (self.x, self.h))
        c = self.curvature
        c = None if c is None else np.concatenate([c[:1], c[:-1]])
        return replace(self, u=np.vstack([u_held[None], self.u[:-1]]), x=x, h=h, curvature=c)
