"""Default tasks of a machine without tasks: a step of the controlled signals, and holding against a disturbance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.simulation import rest_of
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.equilibrium import Range, RateEquations, rate_search
from hybrid_mpc.scenario import Scenario, Task

Array = NDArray[np.float64]
ROOM, PUSH = 0.5, 0.2
"""Largest shares of the distance from the operating point to a limit: of a step, and of a disturbance at an input."""
HOLD, LEAD, LASTS = 3, 0.5, 6
"""Durations in horizons: of a set-point, of the rest before the first change, and of the holding task."""
RESTS = 0.1
"""Largest rate of a given operating point, in sizes of the states per horizon."""


@dataclass(frozen=True)
class _Rest:
    """The prior at its steady state ``(x, u, w)``, and the control problem; ``horizon`` in seconds."""

    prior: Prior
    control: OCP
    horizon: float
    x: Array
    u: Array
    w: Array

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Signals of the references."""
        return self.prior.outputs if self.control.n_y else self.prior.states

    @property
    def weights(self) -> Array:
        """Weights of these signals."""
        return self.control.q_y if self.control.n_y else self.control.q

    def tracked(self, x: Array, u: Array) -> Array:
        """Values of these signals at a point."""
        return self.equations.shown(np.concatenate([x, u]))[0]

    def sizes(self) -> Array:
        """Sizes of ``(x, u)``: ranges, else the deviations that the weights tolerate, else 1."""
        ranges = np.array([s.upper - s.lower for s in self.prior.states])
        tolerated = 1.0 / np.sqrt(np.where(self.control.q > 0, self.control.q, 1.0))
        return np.concatenate([np.where(np.isfinite(ranges), ranges, tolerated), self.control.input_range])

    def rates(self) -> Array:
        """Rates ``(n_x,)`` in sizes of the states per horizon."""
        rates = self.equations.rest(np.concatenate([self.x, self.u]))[0]
        return rates * self.horizon / self.sizes()[: len(self.x)]

    @cached_property
    def equations(self) -> RateEquations:
        """Rates of the prior, and the signals of the references."""
        equations = self.prior.equations
        return RateEquations(
            equations.xdot, self.w, self.prior.p, equations.output if self.control.n_y else None
        )

    def moved(self, j: Sequence[int], by: float, unit: Array, room: float) -> tuple[Array, Array] | None:
        """The nearest steady state at which the tracked signals ``j`` differ by ``by``; None if there is none.

        They are met within a millionth of ``unit`` ``(len(j),)``, with inputs that use at most the share ``room`` of
        the distance to their limits.
        """
        c, open_, outputs = self.control, np.full(len(self.x), np.inf), np.full(len(self.signals), np.inf)
        bounds = Range(
            np.concatenate([-open_, self.u - room * (self.u - c.u_min)]),
            np.concatenate([open_, self.u + room * (c.u_max - self.u)]),
            np.ones(len(self.x) + len(self.u), dtype=bool), -outputs, outputs,
        )  # fmt: skip
        own, start = list(j), np.concatenate([self.x, self.u])
        goal, root = self.tracked(self.x, self.u), np.zeros(len(self.signals))
        goal[own] += by
        root[own] = 1.0 / unit
        found = rate_search(self.equations, self.sizes(), start, root, bounds=bounds).descend(start, goal)
        return (found.v[: len(self.x)], found.v[len(self.x) :]) if found.reached else None

    def settled(self) -> _Rest:
        """The steady state with the same values of the weighted signals, as many as there are inputs.

        A fit changes parameters and so the steady state. Without such a state the point itself is returned.
        """
        own = np.flatnonzero(self.weights > 0)[: len(self.u)]
        found = self.moved(own.tolist(), 0.0, 1.0 / np.sqrt(self.weights[own]), 1.0)
        inside = found is not None and all(
            np.all((v >= low) & (v <= high))
            for v, low, high in (
                (found[0], *_ranges(self.prior.states)),
                (found[1], self.control.u_min, self.control.u_max),
            )
        )
        return replace(self, x=found[0], u=found[1]) if found is not None and inside else self

    def within(self, x: Array, u: Array) -> bool:
        """Whether a point uses at most the share ``ROOM`` of the distance to any limit."""
        c, y = self.control, self.prior.outputs
        at = self.prior.equations.output
        rest, now = (at(*p, self.w, self.prior.p).full().ravel() for p in ((self.x, self.u), (x, u)))
        pairs = (
            (self.u, u, c.u_min, c.u_max),
            (self.x, x, c.x_min, c.x_max),
            (self.x, x, *_ranges(self.prior.states)),
            (rest, now, *_ranges(y)),
            *([(rest, now, c.y_min, c.y_max)] if c.y_min.size else []),
        )
        return all(
            bool(np.all((b >= a - ROOM * (a - low) - 1e-12) & (b <= a + ROOM * (high - a) + 1e-12)))
            for a, b, low, high in pairs
        )


def _ranges(signals: Sequence[Signal]) -> tuple[Array, Array]:
    low, high = np.array([(s.lower, s.upper) for s in signals], dtype=np.float64).reshape(-1, 2).T
    return low, high


def default_tasks(scenario: Scenario, values: Mapping[str, float] | None = None) -> tuple[Task, ...]:
    """Two tasks around the operating point of a scenario with a control problem.

    ``step``: the weighted signals, as many as there are inputs, step one after the other; the last set-point is the
    operating point. Set-points are steady states within half of the distance to every limit, and at most ten times the
    deviation that the weights tolerate. ``hold``: the operating point is held against a constant disturbance at the
    first input, a fifth of the distance to its limit.

    Args:
        scenario: The scenario.
        values: Fitted parameters of the prior. If the operating point is no steady state with them, the steady state
            with the same values of the weighted signals replaces it. Default: the prior's own.

    Raises:
        InputError: If the prior has no steady state at its operating point, or no weighted signal has another steady
            state.

    Example:
        >>> from dataclasses import replace
        >>> from hybrid_mpc.scenario import load_scenario
        >>> golf = load_scenario("golf_robot")
        >>> [task.title for task in default_tasks(replace(golf, tasks=()))]
        ['A step of phi by 0.1 rad (default task)', 'Hold against a load of -0.1 N m at u (default task)']
    """
    prior, control, dt = scenario.prior(values), scenario.control, scenario.data.dt
    assert control is not None
    length = control.horizon * dt
    rest = _Rest(prior, control, length, *rest_of(prior))
    why = f"scenario {scenario.name} has no tasks, and default tasks cannot be made: "
    rates = rest.rates()
    if values is not None and not np.all(np.abs(rates) < RESTS):
        rest = rest.settled()
        rates = rest.rates()
    if not np.all(np.abs(rates) < RESTS):
        moving = ", ".join(s.name for s, r in zip(prior.states, rates, strict=True) if not abs(r) < RESTS)
        raise InputError(
            f"{why}the operating point is not a steady state of the prior; {moving} would change. Give operating_point "
            "= OperatingPoint(x=(...), u=(...)), or tasks=(Task(...),). [HM-CHECK-007]"
        )
    steps = _steps(rest)
    if not steps:
        pairs = zip(prior.inputs, rest.u, control.u_min, control.u_max, strict=True)
        ends = ", ".join(s.name for s, u, low, high in pairs if not low < u < high)
        raise InputError(
            f"{why}no weighted signal of the control problem can reach another steady state within half the distance "
            f"to every limit{f'; inputs at a limit: {ends}' if ends else ''}. Give an operating_point farther from the "
            "limits, or tasks=(Task(...),). [HM-CHECK-008]"
        )
    return _step_task(rest, steps, dt), _hold_task(rest, dt)


def _steps(rest: _Rest) -> list[tuple[int, float, Array]]:
    """Index and size of each step, and all references at the new steady state."""
    found = []
    for j in np.flatnonzero(rest.weights > 0).tolist():
        # largest step, over the deviation that the weights tolerate, ``1 / sqrt(q)``
        size = 10.0 / math.sqrt(rest.weights[j])
        candidates = ((sign, size / 2**k) for k in range(12) for sign in (1.0, -1.0))
        for sign, own in candidates:
            point = rest.moved([j], sign * own, np.array([own]), ROOM)
            if point is not None and rest.within(*point):
                found.append((j, sign * own, rest.tracked(*point)))
                break
        if len(found) == len(rest.u):
            break
    return found


def _step_task(rest: _Rest, steps: Sequence[tuple[int, float, Array]], dt: float) -> Task:
    start, hold = LEAD * rest.horizon, HOLD * rest.horizon
    first, n_p = rest.tracked(rest.x, rest.u), rest.control.n_p
    goals = np.array([*(goal for *_, goal in steps), first])

    def reference(t: Array) -> Array:
        number = np.floor((np.asarray(t, dtype=float) - start) / hold + 1e-9).astype(int)
        rows = goals[np.clip(number, 0, len(goals) - 1)]
        rows[number < 0] = first
        return np.hstack([rows, np.zeros((len(rows), n_p))])

    names = ", ".join(f"{rest.signals[j].name} by {by:.3g} {rest.signals[j].unit}" for j, by, _ in steps)
    return Task(
        "step", f"A step of {names} (default task)", _periods(start + hold * len(goals), dt), tuple(rest.x.tolist()),
        reference,
    )  # fmt: skip


def _hold_task(rest: _Rest, dt: float) -> Task:
    c, signal = rest.control, rest.prior.inputs[0]
    up, down = float(c.u_max[0] - rest.u[0]), float(rest.u[0] - c.u_min[0])
    room = max(up, down) if math.isfinite(max(up, down)) else 0.5 * float(c.input_range[0])
    push = -PUSH * room if up >= down else PUSH * room
    first, n_p = rest.tracked(rest.x, rest.u), c.n_p
    several = signal.name if len(rest.u) > 1 else ""

    def reference(t: Array) -> Array:
        return np.hstack([np.tile(first, (len(t), 1)), np.zeros((len(t), n_p))])

    return Task(
        "hold", f"Hold against a load of {push:.3g} {signal.unit} at {signal.name} (default task)",
        _periods(LASTS * rest.horizon, dt), tuple(rest.x.tolist()), reference,
        faults=(Fault(_periods(LEAD * rest.horizon, dt), math.inf, "input_offset", push, several),),
    )  # fmt: skip


def _periods(seconds: float, dt: float) -> float:
    return round(seconds / dt) * dt
