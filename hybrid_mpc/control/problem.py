"""A model and a control problem made ready for a solver: free run, targets, cost, first plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP, Limits, input_plan
from hybrid_mpc.control.soft import SoftBound
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.buffered import BufferedFunction
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.model.stages import free_run

Array = NDArray[np.float64]


class Status(Enum):
    """How a solve ended; the value is the message."""

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
        cost: Cost of the plan (see :class:`~hybrid_mpc.control.ocp.OCP`); NaN if it was not solved.
        status: How the solve ended.
        kkt: KKT residual in the QP's scaling, relative to its gradient [-]; of ``ipopt`` that of the NLP.
        defect: Largest defect ``|x_{k+1} - f(x_k, h_k, u_k)|`` at the last linearization, over (x, h).
        timing: Durations [ms] by name (``prepare``, ``feedback``); recorded, never used to decide.
        excess: Largest violation of a soft bound in the plan [its unit].
        iterations: Linearizations (or iterations of the nonlinear solver) of this solve.
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

    @property
    def following(self) -> Array:
        """Inputs ``(N, n_u)`` of the plan one period later, the last one repeated."""
        return np.vstack([self.u[1:], self.u[-1:]])

    def beginning_with(self, u: Array) -> Solution:
        """The plan with ``u`` ``(n_u,)`` as its first input."""
        return replace(self, u=np.vstack([u[None], self.u[1:]]))

    def delayed(self, u_held: Array) -> Solution:
        """The plan one period earlier, with ``u_held`` ``(n_u,)`` held in it: a solve that shifts it has this plan.

        It loses its last period, which the shift appends anew.
        """
        x, h = (np.vstack([v[:1], v[:-1]]) for v in (self.x, self.h))
        c = self.curvature
        c = None if c is None else np.concatenate([c[:1], c[:-1]])
        return replace(self, u=np.vstack([u_held[None], self.u[:-1]]), x=x, h=h, curvature=c)


class SoftRows:
    """The M soft bounds of a problem along a trajectory, one row a bound and period.

    Bounds on states hold for ``x_1 .. x_N`` (``x_0`` is given), expressions for ``(x_0, u_0) .. (x_{N-1}, u_{N-1})``.
    """

    stage: NDArray[np.int64]
    """State ``(M,)`` of the trajectory that a row looks at."""

    def __init__(self, ocp: OCP) -> None:
        n = ocp.horizon
        self._n_x, self._n_u, self._horizon = ocp.n_x, ocp.n_u, n
        self._states = np.flatnonzero(np.isfinite(ocp.x_min) | np.isfinite(ocp.x_max))
        chosen = self._states
        self._expressions = [BufferedFunction(_with_slopes(b, ocp.n_x, ocp.n_u).map(n)) for b in ocp.soft]
        columns = [[np.tile(v[chosen], n) for v in (ocp.x_min, ocp.x_max, *ocp.penalties)]]
        columns += [[np.tile(v, n) for v in (b.lower, b.upper, b.linear, b.quadratic)] for b in ocp.soft]
        self.lower, self.upper, self.linear, self.quadratic = (
            np.concatenate([c[i] for c in columns]) for i in range(4)
        )
        stages = [np.repeat(np.arange(1, n + 1), chosen.size)]
        stages += [np.repeat(np.arange(n), b.lower.size) for b in ocp.soft]
        self.stage = np.concatenate(stages)
        half = 0.5 * (self.upper - self.lower)
        # One-sided bounds have no range: the violation that costs as much quadratically as linearly, or 1.
        other = np.where(self.linear > 0, self.linear / self.quadratic, 1.0)
        self.scale: Array = np.where(np.isfinite(half), half, other)

    def __len__(self) -> int:
        return int(self.stage.size)

    def values(self, x: Array, u: Array) -> Array:
        """Bounded values ``(M,)`` along states ``(N + 1, n_x)`` and inputs ``(N, n_u)``."""
        return self.linearize(x, u)[0]

    def linearize(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Values ``(M,)`` and their derivatives by the row's state ``(M, n_x)`` and input ``(M, n_u)``."""
        n = self._horizon
        by_x = np.tile(np.eye(self._n_x)[self._states], (n, 1))
        rows = [(x[1:, self._states].ravel(), by_x, np.zeros((by_x.shape[0], self._n_u)))]
        for f in self._expressions:
            f.inputs[0][:], f.inputs[1][:] = x[:-1].ravel(), u.ravel()
            f()
            e, e_x, e_u = (out.copy() for out in f.outputs)
            each = e.size // n
            e_x = e_x.reshape(n, self._n_x, each).transpose(0, 2, 1).reshape(e.size, self._n_x)
            e_u = e_u.reshape(n, self._n_u, each).transpose(0, 2, 1).reshape(e.size, self._n_u)
            rows.append((e, e_x, e_u))
        return (
            np.concatenate([r[0] for r in rows]),
            np.vstack([r[1] for r in rows]),
            np.vstack([r[2] for r in rows]),
        )

    def condensed(self, x: Array, u: Array, from_u: Array) -> tuple[Array, Array, Array]:
        """Values ``(M,)`` and their derivatives by the row's state ``(M, n_x)`` and by all inputs ``(M, N n_u)``.

        ``from_u`` ``((N + 1) n_x, N n_u)`` are the derivatives of the states by the inputs.
        """
        if not len(self):
            return np.zeros(0), np.zeros((0, self._n_x)), np.zeros((0, u.size))
        value, by_x, by_u = self.linearize(x, u)
        states = from_u.reshape(len(x), self._n_x, u.size)[self.stage]
        slope = (by_x[:, None, :] @ states)[:, 0, :]
        direct = np.flatnonzero(np.any(by_u != 0, axis=1))
        for j in range(self._n_u):
            slope[direct, self.stage[direct] * self._n_u + j] += by_u[direct, j]
        return value, by_x, slope

    def excess(self, values: Array) -> Array:
        """Violations ``(M,)``, zero where a bound is kept."""
        return np.asarray(np.maximum(0.0, np.maximum(values - self.upper, self.lower - values)))

    def penalty(self, excess: Array) -> float:
        """Cost per second of violations ``(M,)``, summed."""
        return float(self.linear @ excess + self.quadratic @ excess**2)


def _with_slopes(bound: SoftBound, n_x: int, n_u: int) -> ca.Function:
    """``(x, u)`` to the expression and its derivatives by ``x`` and by ``u``."""
    f = bound.expression
    if (f.size_in(0), f.size_in(1)) != ((n_x, 1), (n_u, 1)):
        raise InputError(f"soft bound: expression {f} does not take (x, u) of {n_x} states and {n_u} inputs")
    # One Jacobian by both, in scalar code where the expression is some: two would run through its calls twice.
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    z, x, u = kind.sym("z", n_x + n_u), ca.MX.sym("x", n_x), ca.MX.sym("u", n_u)
    e = f(z[:n_x], z[n_x:])
    both = ca.Function("both", [z], [ca.densify(e), ca.densify(ca.jacobian(e, z))], {"cse": True})
    value, slope = both(ca.vertcat(x, u))
    return ca.Function("soft", [x, u], [value, slope[:, :n_x], slope[:, n_x:]])


class EconomicCost:
    """The economic stage cost along a trajectory, with first and second derivatives; zero where there is none."""

    def __init__(self, ocp: OCP, dt: float) -> None:
        self.function, self._dt, self._n = ocp.economic, dt, ocp.horizon
        f, n_x, n_u = ocp.economic, ocp.n_x, ocp.n_u
        if f is None:
            return
        if (f.size_in(0), f.size_in(1)) != ((n_x, 1), (n_u, 1)) or (f.n_in() > 2 and f.size2_in(2) != 1):
            raise InputError(
                f"economic: {f} does not take (x, u) of {n_x} states and {n_u} inputs, nor these and a column p"
            )
        x, u, p = ca.MX.sym("x", n_x), ca.MX.sym("u", n_u), ca.MX.sym("p", ocp.n_p)
        value = ca.densify(f(x, u, p) if f.n_in() > 2 else f(x, u))
        slope = ca.horzcat(ca.jacobian(value, x), ca.jacobian(value, u)).T
        curvature = ca.horzcat(ca.jacobian(slope, x), ca.jacobian(slope, u))
        self._value = BufferedFunction(ca.Function("economic", [x, u, p], [value]).map(self._n))
        outs = [ca.densify(slope), ca.densify(curvature)]
        self._derivatives = BufferedFunction(ca.Function("economic_slopes", [x, u, p], outs).map(self._n))

    def value(self, x: Array, u: Array, p: Array | None = None) -> float:
        """Cost of states ``(N + 1, n_x)`` or longer, inputs ``(N, n_u)`` and parameters ``(N + 1, n_p)``."""
        if self.function is None:
            return 0.0
        self._fill(self._value, x, u, p)
        self._value()
        return self._dt * float(np.sum(self._value.outputs[0]))

    def derivatives(self, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
        """Derivatives of the stages' costs by ``(x, u)``: ``(N, n_x + n_u)`` and ``(N, n_x + n_u, n_x + n_u)``."""
        f, n = self._derivatives, self._n
        self._fill(f, x, u, p)
        f()
        slope = self._dt * f.outputs[0].reshape(n, -1)
        return slope, self._dt * f.outputs[1].reshape(n, slope.shape[1], -1)

    def convex(self, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
        """The same, second derivatives made positive semi-definite: what curves down counts as flat."""
        slope, curvature = self.derivatives(x, u, p)
        if not np.all(np.isfinite(curvature)):
            return slope, curvature
        values, vectors = np.linalg.eigh(curvature)
        flat = np.maximum(values, 0.0)[:, None, :]
        return slope, (vectors * flat) @ vectors.transpose(0, 2, 1)

    def _fill(self, f: BufferedFunction, x: Array, u: Array, p: Array | None) -> None:
        f.inputs[0][:], f.inputs[1][:] = x[: self._n].ravel(), u.ravel()
        if p is not None:
            f.inputs[2][:] = p[: self._n].ravel()


def output_cost(output: ca.Function, q_y: ArrayLike) -> ca.Function:
    """``(x, u, p) -> (y(x, u) - p)' diag(q_y) (y(x, u) - p)``: the economic stage cost that tracks outputs.

    References then have ``n_y`` more columns, the outputs'. It is for outputs that are no states; for states ``q`` says
    the same and has a terminal weight.

    Args:
        output: ``(x, u) -> y``, a column; of a model's own outputs ``(x, u, w, p) -> y`` with its ``w`` and ``p``
            put in.
        q_y: Weights ``(n_y,)`` [cost/s/unit^2], not negative.

    Raises:
        InputError: If the function is another, or a weight is negative, not finite or missing.

    Example:
        >>> x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
        >>> tip = output_cost(ca.Function("tip", [x, u], [ca.sin(x[0])]), [4.0])
        >>> float(tip([0.0, 1.0], 0.0, 0.5))
        1.0
    """
    if (output.n_in(), output.n_out()) != (2, 1) or output.size2_out(0) != 1:
        raise InputError(f"output_cost: {output} given; needed: a function (x, u) -> column")
    n, weight = output.size1_out(0), np.asarray(q_y, dtype=float).ravel()
    if weight.shape != (n,) or not np.all(np.isfinite(weight) & (weight >= 0)):
        raise InputError(f"output_cost: q_y {weight} given; needed: {n} finite weights, none negative")
    x, u = (ca.MX.sym(name, output.size1_in(i)) for i, name in enumerate("xu"))
    p = ca.MX.sym("p", n)
    return ca.Function("output_cost", [x, u, p], [ca.dot(weight, (output(x, u) - p) ** 2)])


@dataclass(frozen=True)
class Target:
    """Reference ``(N + 1, n_x)``, weight factors on ``q``, and parameters ``(N + 1, n_p)`` of the economic stage cost.

    The last values hold where the preview ends.
    """

    x: Array
    weight: Array
    p: Array

    @property
    def ok(self) -> bool:
        """True if all is finite and no factor is negative."""
        return bool(np.all(np.isfinite(self.x)) and np.all(np.isfinite(self.p)) and weights_ok(self.weight))


def weights_ok(weight: Array) -> bool:
    """True for weight factors that are finite and not negative."""
    return bool(np.all(np.isfinite(weight)) and np.all(weight >= 0))


class Problem:
    """A model with an :class:`~hybrid_mpc.control.ocp.OCP`, and what every solver needs of the two.

    Raises:
        InputError: If problem and model do not fit, or the terminal weight cannot be found.
    """

    def __init__(self, model: HybridModel, ocp: OCP) -> None:
        if (ocp.n_x, ocp.n_u) != (model.n_x, model.n_u):
            raise InputError(
                f"the problem has {ocp.n_x} states and {ocp.n_u} inputs, model {model.name} has "
                f"{model.n_x} and {model.n_u}"
            )
        self.model, self.ocp = model, ocp
        self.terminal = ocp.terminal_weight(model)
        self.soft = SoftRows(ocp)
        self.economic = EconomicCost(ocp, model.dt)
        self.run = free_run(model, ocp.horizon)
        self._rows = np.arange(ocp.horizon + 1)

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan, of status INITIAL: the model run freely from the estimate on ``u`` ``(N, n_u)``.

        ``u[0]`` counts as the input held before the next solve; without ``u`` it is zero, or the bound next to it.
        Where the free run diverges, the state is held at the estimate.
        """
        n, ocp = self.ocp.horizon, self.ocp
        start = np.tile(ocp.rest_input, (n, 1)) if u is None else input_plan(u, n, ocp.n_u, "u")
        plan = np.clip(start, ocp.u_min, ocp.u_max)
        z = self.run(np.concatenate([estimate.x, estimate.h]), plan + estimate.d)
        if not np.all(np.isfinite(z)):
            z = np.tile(z[0], (n + 1, 1))
        x, h = z[:, : ocp.n_x], z[:, ocp.n_x :]
        return Solution(plan, x, h, estimate.d, float("nan"), Status.INITIAL, float("nan"), float("nan"), {})

    def target(self, reference: ArrayLike, weight: ArrayLike | None = None) -> Target:
        """Reference and factors over the horizon; the last value holds where the preview is shorter."""
        rows = self._preview(reference, "reference", self.ocp.n_x + self.ocp.n_p)
        return Target(rows[:, : self.ocp.n_x], self.weights(weight), rows[:, self.ocp.n_x :])

    def weights(self, weight: ArrayLike | None) -> Array:
        """Weight factors ``(N + 1, n_x)`` from ``(m, n_x)``, the last value held. Default: 1."""
        if weight is None:
            return np.ones((self.ocp.horizon + 1, self.ocp.n_x))
        return self._preview(weight, "weight", self.ocp.n_x)

    def _preview(self, values: ArrayLike, name: str, columns: int) -> Array:
        array = np.asarray(values, dtype=float)
        if array.ndim != 2 or len(array) < 1 or array.shape[1] != columns:
            raise InputError(f"{name}: shape {array.shape} given, (m, {columns}) with m > 0 needed")
        return np.asarray(array[np.minimum(self._rows, len(array) - 1)])

    def state_weights(self, weight: Array) -> tuple[Array, Array]:
        """Weights of the stages ``(N, n_x)`` and the terminal matrix for weight factors ``(N + 1, n_x)``."""
        root = np.sqrt(weight[-1])
        return weight[:-1] * (self.ocp.q * self.model.dt), self.terminal * root * root[:, None]

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is looked at and refused
    def cost(self, z: Array, u: Array, u_prev: Array, target: Target, excess: Array | None = None) -> float:
        """Cost of a plan with the trajectory ``z`` ``(N + 1, n_x)`` or longer rows, penalties of soft bounds included.

        ``excess`` ``(M,)`` are the violations of the soft bounds. Default: those of the trajectory.
        """
        x = z[:, : self.ocp.n_x]
        du = u - np.vstack([u_prev, u[:-1]])
        stages, terminal = self.state_weights(target.weight)
        error = x - target.x
        stage = np.sum(error[:-1] ** 2 * stages)
        stage += self.model.dt * np.sum(u**2 @ self.ocp.r + du**2 @ self.ocp.r_delta)
        total = float(stage + error[-1] @ terminal @ error[-1]) + self.economic.value(x, u, target.p)
        if len(self.soft):
            excess = self.soft.excess(self.soft.values(x, u)) if excess is None else excess
            total += self.model.dt * self.soft.penalty(excess)
        return total


class Controller(Protocol):
    """What every solver offers. Built once; no method changes it or raises on the numbers it is given."""

    problem: Problem
    """Problem and model made ready."""
    converges: bool = True
    """False where a solve improves the last plan only a little: the first plan is then another solver's."""

    @property
    def model(self) -> HybridModel:
        """The model that predicts."""
        return self.problem.model

    @property
    def ocp(self) -> OCP:
        """The problem as plain data."""
        return self.problem.ocp

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan: the model run freely from the estimate; see :meth:`Problem.initial`."""
        return self.problem.initial(estimate, u)

    def solve(
        self, previous: Solution, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None,
    ) -> Solution:  # fmt: skip
        """The plan from now on; ``previous.u[0]`` is the input that is being held.

        Args:
            previous: The last plan; shifted by one period it is the first guess.
            estimate: The state now; its ``d`` is assumed constant over the horizon.
            reference: ``(m, n_x)``, from now on in steps of ``dt``; if ``m < N + 1`` its last value holds.
                Where the economic stage cost has parameters, ``n_p`` more columns are their values.
            weight: Factors on ``q`` ``(m, n_x)``, not negative, as the reference. Default: 1.
            limits: Bounds of the inputs for this solve. Default: the problem's own.
        """
        ...


class SplitController(Controller):
    """A solver whose work is mostly done before the measurement: the loop prepares while the last input acts."""

    def prepare(self, previous: Solution, weight: Array | None = None) -> Any:
        """The part of the next :meth:`solve` that needs no measurement; arguments as there."""
        raise NotImplementedError

    def finish(
        self, prepared: Any, estimate: Estimate, reference: Array, limits: Limits | None = None
    ) -> Solution:
        """The rest of it, given what :meth:`prepare` made."""
        raise NotImplementedError
