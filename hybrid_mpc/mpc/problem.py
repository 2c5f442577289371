"""A model and a control problem made ready for a solver: free run, targets, cost, first plan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.buffered import BufferedFunction
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.economic import EconomicCost
from hybrid_mpc.mpc.limits import Limits
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.soft import SoftRows
from hybrid_mpc.mpc.solution import Solution, Status

Array = NDArray[np.float64]


class Controller(Protocol):
    """What every solver offers. Built once; no method changes it or raises on the numbers it is given."""

    @property
    def model(self) -> HybridModel:
        """The model that predicts."""

    @property
    def ocp(self) -> OCP:
        """The problem."""

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan: the model run freely from the estimate; ``u`` ``(N, n_u)``, see :class:`Problem`."""

    def solve(
        self,
        previous: Solution,
        estimate: Estimate,
        reference: Array,
        weight: Array | None = None,
        *,
        limits: Limits | None = None,
    ) -> Solution:
        """The plan from now on; ``previous.u[0]`` is the input that is being held.

        Args:
            previous: The last plan; shifted by one period it is the first guess.
            estimate: The state now; its ``d`` is assumed constant over the horizon.
            reference: ``(m, n_x)``, from now on in steps of ``dt``; if ``m < N + 1`` its last value holds.
                Where the economic stage cost has parameters, ``n_p`` more columns are their values.
            weight: Factors on ``q`` ``(m, n_x)``, not negative, as the reference. Default: 1.
            limits: Bounds of the inputs for this solve. Default: the problem's own.
        """


@dataclass(frozen=True)
class Target:
    """Reference and weight factors over the horizon, the last values held where the preview ends.

    Args:
        x: Reference ``(N + 1, n_x)``.
        weight: Factors ``(N + 1, n_x)`` on ``q``.
        p: Parameters of the economic stage cost ``(N + 1, n_p)``.
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
    """A model with an :class:`~hybrid_mpc.mpc.OCP`, and what every solver needs of the two.

    Args:
        model: The deployed model; ``n_h`` may be 0.
        ocp: The problem.

    Raises:
        InputError: If problem and model do not fit, or the terminal weight cannot be found.

    Example:
        >>> from hybrid_mpc.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> problem = Problem(model, OCP(3, [1.0], [1.0], [0.0], [-9.0], [9.0], terminal=[[1.0]]))
        >>> z = problem.run(np.zeros(1), np.ones((3, 1)))
        >>> z[:, 0].tolist()
        [0.0, 1.0, 2.0, 3.0]
        >>> problem.cost(z, np.ones((3, 1)), np.zeros(1), problem.target(np.zeros((1, 1))))
        17.0
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
        self._rollout = _rollout(model, ocp.horizon)
        self._rows = np.arange(ocp.horizon + 1)

    def initial(self, estimate: Estimate, u: Array | None = None) -> Solution:
        """A first plan: the model run freely from the estimate.

        Args:
            estimate: Where the plan starts.
            u: Inputs ``(N, n_u)``; ``u[0]`` counts as the input held before the next solve. Default:
                zero, or the bound next to it.

        Returns:
            A plan of status INITIAL. Where the free run diverges, the state is held at the estimate.

        Raises:
            InputError: If ``u`` has another shape or is not finite.
        """
        n, ocp = self.ocp.horizon, self.ocp
        start = np.tile(ocp.rest_input, (n, 1)) if u is None else np.asarray(u, dtype=float)
        if start.shape != (n, ocp.n_u) or not np.all(np.isfinite(start)):
            raise InputError(f"u: finite values of shape {(n, ocp.n_u)} needed, got {start}")
        plan = np.clip(start, ocp.u_min, ocp.u_max)
        z = self.run(np.concatenate([estimate.x, estimate.h]), plan + estimate.d)
        if not np.all(np.isfinite(z)):
            z = np.tile(z[0], (n + 1, 1))
        x, h = z[:, : ocp.n_x], z[:, ocp.n_x :]
        return Solution(plan, x, h, estimate.d, float("nan"), Status.INITIAL, float("nan"), float("nan"), {})

    def run(self, z0: Array, u: Array) -> Array:
        """States and hidden states ``(N + 1, n_z)`` of the model from ``z0`` on inputs ``(N, n_u)``."""
        self._rollout.inputs[0][:], self._rollout.inputs[1][:] = z0, u.ravel()
        self._rollout()
        return np.vstack([z0, self._rollout.outputs[0].reshape(len(u), -1)])

    def target(self, reference: ArrayLike, weight: ArrayLike | None = None) -> Target:
        """Reference and factors over the horizon; the last value holds where the preview is shorter.

        Raises:
            InputError: If a shape is not ``(m, n_x)``, or of the reference ``(m, n_x + n_p)``, with m > 0.
        """
        rows = self._preview(reference, "reference", self.ocp.n_x + self.ocp.n_p)
        return Target(rows[:, : self.ocp.n_x], self.weights(weight), rows[:, self.ocp.n_x :])

    def weights(self, weight: ArrayLike | None) -> Array:
        """Weight factors ``(N + 1, n_x)``; default: 1.

        Raises:
            InputError: If the shape is not ``(m, n_x)`` with m > 0.
        """
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
        """Cost of a plan, penalties of soft bounds included.

        Args:
            z: Trajectory ``(N + 1, n_x)`` or longer rows.
            u: Inputs ``(N, n_u)``.
            u_prev: Input held before ``(n_u,)``.
            target: Reference and factors.
            excess: Violations of the soft bounds ``(M,)``. Default: those of the trajectory.
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


def _rollout(model: HybridModel, n: int) -> BufferedFunction:
    z, u = ca.MX.sym("z", model.n_x + model.n_h), ca.MX.sym("u", model.n_u)
    z_next = ca.vertcat(*model.step(z[: model.n_x], z[model.n_x :], u, model.w, model.p))
    return BufferedFunction(ca.Function("z_step", [z, u], [z_next]).mapaccum("rollout", n))
