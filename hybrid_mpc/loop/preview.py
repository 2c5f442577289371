"""Preview of reference, weight factors and measured disturbances over the horizon."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import Problem
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.equilibrium import Steady
from hybrid_mpc.model.limits import check_function, floats, sampled

Array = NDArray[np.float64]
Preview = Callable[[Array], Array]
"""Values ``(n, columns)`` at the times ``t (n,)`` [s]."""


class Previews:
    """Reference and weight factors over the horizon; the arguments are those of a ``Loop``.

    Without ``ocp.preview`` they are those of the present time only. Non-finite values beyond the ``end`` of the run [s]
    are replaced by the last value before them. The default reference is that of the operating point.
    """

    def __init__(
        self, reference: Preview | ArrayLike | None, weight: Preview | None, problem: Problem, end: float
    ) -> None:
        if weight is not None:
            check_function(weight, "weight")
        ocp, self._name = problem.ocp, problem.reference_name
        self._reference, self._weight = _function_of(reference, problem), weight
        self._end = float(sampled(end, (), "end"))
        self._n_x, self._columns = ocp.n_x, ocp.columns
        self._ahead: Array = problem.model.dt * np.arange(
            ocp.horizon + 1 if ocp.preview else 1, dtype=np.float64
        )

    def __call__(self, t: float) -> tuple[Array, Array | None]:
        """Reference and factors (None for 1) from ``t`` on."""
        times = t + self._ahead
        x_ref = self._evaluate(self._reference, times, self._name, self._columns)
        weight = None if self._weight is None else self._evaluate(self._weight, times, "weight", self._n_x)
        return x_ref, weight

    def _evaluate(self, preview: Preview, times: Array, name: str, columns: int) -> Array:
        values = floats(preview(times), f"what {name} returns")
        if values.shape != (times.size, columns):
            raise InputError(
                f"{name}: it returns the shape {values.shape}, but must return {(times.size, columns)} [HM-LOOP-031]"
            )
        beyond = (times > self._end + 1e-9) & ~np.all(np.isfinite(values), axis=1)
        if beyond.any():
            last = int(np.argmax(beyond)) - 1
            at_end = values if last >= 0 else floats(preview(np.array([self._end])), f"what {name} returns")
            values[beyond] = at_end[max(last, 0)]
        return values


class Forecast:
    """Forecast of the measured disturbances ``(N, n_w)``, if the problem previews them.

    Args:
        w: ``t (n,) [s] -> (n, n_w)``; None without a forecast.
        ocp: The problem.
        n_w: Number of measured disturbances.
        dt: Period [s].
        unknown: Number of columns of NaN to append, one for each tracked parameter. Default: 0.

    Raises:
        InputError: If there is a forecast, but no measured disturbance.
    """

    def __init__(self, w: Preview | None, ocp: OCP, n_w: int, dt: float, unknown: int = 0) -> None:
        if w is not None and not n_w:
            raise InputError("w: the model has no measured disturbances to forecast; remove w [HM-LOOP-032]")
        if w is not None:
            check_function(w, "w")
        self._w = w if ocp.preview_w else None
        self._n_w, self._unknown, self._ahead = n_w, unknown, np.arange(ocp.horizon, dtype=np.float64) * dt

    def __call__(self, t: float) -> Array | None:
        """Disturbances from ``t`` on; None: the last measured values are held."""
        if self._w is None:
            return None
        return with_unknown(
            sampled(self._w(t + self._ahead), (self._ahead.size, self._n_w), "what w returns"), self._unknown
        )


def n_tracked(estimator: object) -> int:
    """Number of parameters that an estimator tracks: its model has them as the last measured disturbances."""
    return len(getattr(estimator, "tracked", ()))


def with_unknown(w: Array, n: int) -> Array:
    """Measured disturbances ``(m, n_w)`` with ``n`` further columns of NaN: values that only the estimator knows."""
    return np.hstack([w, np.full((len(w), n), np.nan)]) if n else w


def held(values: Array, first: Array) -> Array:
    """Rows ``(m, n)`` in which non-finite values are replaced by the value before, initially ``first`` ``(n,)``."""
    rows, last = values.copy(), first
    for row in rows:
        last = np.where(np.isfinite(row), row, last)
        row[:] = last
    return rows


def shortest_way(reference: Array, now: Array, period: Array) -> Array:
    """A reference ``(m, columns)`` whose first ``n`` columns are moved by whole periods ``(n,)``: the first row to the
    nearest of ``now`` ``(n,)``, each later one to the nearest of the row before.
    """
    n = now.size
    rows = np.vstack([np.where(np.isfinite(now), now, reference[0, :n]), reference[:, :n]])
    # after a value that is not finite none is: no plan follows such a reference anyway
    with np.errstate(over="ignore", invalid="ignore"):
        for i in np.flatnonzero(np.isfinite(period)):
            rows[:, i] = np.unwrap(rows[:, i], period=period[i])
    return np.hstack([rows[1:], reference[:, n:]])


def _function_of(reference: Preview | ArrayLike | None, problem: Problem) -> Preview:
    """The reference as a function of time, from a function, a set-point, or None."""
    if callable(reference):
        check_function(reference, "reference")
        return reference
    goal = problem.standing()[0]
    if reference is not None:
        goal = sampled(reference, goal.shape, problem.reference_name)
        refuse_beyond(goal[None], problem)
    return lambda t: np.tile(goal, (len(t), 1))


def beyond_range(reference: Array, problem: Problem) -> str:
    """The first set-point in the rows ``(m, columns)`` outside its signal's declared range, as text; empty without one.

    Signals without weight, and periodic ones, whose references count turns, are not checked.
    """
    ocp, model = problem.ocp, problem.model
    weights, signals = (ocp.q_y, model.outputs) if ocp.n_y else (ocp.q, model.states)
    for weight, s, column in zip(weights, signals, reference.T, strict=False):  # further columns: parameters
        wrong = column[s.outside(column)]
        if weight > 0 and wrong.size and not s.periodic:
            return (
                f"{s.name} = {wrong[0]:g} {s.unit} is outside its range {s.lower:g} to {s.upper:g} {s.unit}"
            )
    return ""


def unreached(steady: Steady | None, problem: Problem) -> str:
    """Why a plan's steady state is not at its set-point, as text; empty if it is, or if there is no set-point."""
    if steady is None or steady.reached:
        return ""
    if not steady.steady:
        return "no steady state found: the plan returns to the operating point"
    ocp, model = problem.ocp, problem.model
    rows = zip(ocp.q_y, model.outputs, steady.y, steady.goal, strict=True)
    off = [f"{s.name} reaches {y:.4g}, not {goal:.4g} {s.unit}" for weight, s, y, goal in rows if weight > 0]
    near = 1e-6 * ocp.input_range
    ended = (steady.u <= ocp.u_min + near) | (steady.u >= ocp.u_max - near)
    ends = [s.name for s, end in zip(model.inputs, ended, strict=True) if end]
    return "; ".join([*off, *([f"at a limit: {', '.join(ends)}"] if ends else [])])


def refuse_beyond(reference: Array, problem: Problem) -> None:
    """Refuse set-points outside the declared ranges of their signals."""
    if text := beyond_range(reference, problem):
        raise InputError(
            f"reference: {text}. Correct the value or its unit, or the bounds of the signal [HM-LOOP-054]"
        )
