"""Tasks of a scenario: selected by name, or repeated in rounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.default_tasks import default_tasks
from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import Scenario, Task

Array = NDArray[np.float64]


def ready(scenario: Scenario, values: Mapping[str, float] | None = None) -> Scenario:
    """The scenario, with default tasks if it has a control problem but neither plant nor tasks.

    Args:
        scenario: The scenario.
        values: Fitted parameters of its prior, which determine its equilibrium. Default: the prior's own.

    Raises:
        InputError: If default tasks are impossible.
    """
    if scenario.plant is not None or scenario.control is None or scenario.tasks:
        return scenario
    return replace(scenario, tasks=default_tasks(scenario, values))


def tasks_of(scenario: Scenario, names: Sequence[str] | None) -> tuple[Task, ...]:
    """The scenario's tasks with these names; None: all. InputError for an unknown name."""
    if names is None:
        return scenario.tasks
    there = {task.name: task for task in scenario.tasks}
    missing = [name for name in names if name not in there]
    if missing:
        raise InputError(
            f"scenario {scenario.name}: no task {', '.join(missing)}; choose from: {', '.join(there)} [HM-COMPARE-057]"
        )
    return tuple(there[name] for name in names)


def selected_tasks(scenario: Scenario, names: Sequence[str]) -> tuple[Task, ...]:
    """The tasks with these names, or whose names begin with them; all for no names.

    Raises:
        InputError: If no task matches a name.

    Example:
        >>> from hybrid_mpc.scenario import load_scenario
        >>> [task.name for task in selected_tasks(load_scenario("golf_robot"), ["track", "stroke_4"])]
        ['track_sine', 'track_step', 'stroke_4']
    """
    if not names:
        return scenario.tasks
    there = [task.name for task in scenario.tasks]
    chosen: set[str] = set()
    for name in names:
        fitting = [name] if name in there else [t for t in there if name and t.startswith(name)]
        if not fitting:
            raise InputError(
                f"scenario {scenario.name}: no task is called {name!r} or begins with it; choose from: "
                f"{', '.join(there) or 'none'}"
                " [HM-COMPARE-058]"
            )
        chosen.update(fitting)
    return tuple(task for task in scenario.tasks if task.name in chosen)


RETURN_S = 1.0
"""Shortest time of the return to the reference's start [time constants of the machine]."""


def repeated(
    task: Task, dt: float, shares: Array, time_unit: float = 1.0, speeds: Mapping[int, int] | None = None
) -> Task:
    """The task in several rounds; after each round the reference returns to its start along a quintic polynomial.

    Args:
        task: A task; its reference is only evaluated within its duration.
        dt: Period [s]; a round takes whole periods, since weights may be those of single samples.
        shares: Factor ``(m,)`` of each round on the distance from the reference's start.
        time_unit: Time constant of the machine [s], the shortest return. Default: 1.
        speeds: Columns that are rates of other columns, by the index of the other column
            (:func:`~hybrid_mpc.model.model.kinematics`). Default: none.

    Returns:
        The task of ``m`` rounds.

    Example:
        >>> ramp = Task("ramp", "", 1.0, (0.0, 0.0), lambda t: np.column_stack([t, np.ones(len(t))]))
        >>> twice = repeated(ramp, 0.02, np.array([1.0, 0.5]), speeds={0: 1})
        >>> twice.duration, twice.reference(np.array([0.5, 3.5])).round(6).tolist()
        (6.0, [[0.5, 1.0], [0.25, 0.5]])
    """
    length, pairs = round(task.duration / dt), dict(speeds or {})
    rows = task.reference(np.arange(length + 1, dtype=np.float64) * dt)
    first, last = rows[0], rows[-1]
    n = min(len(task.x0), len(first))  # further columns are not references of states
    positions, rates = list(pairs), list(pairs.values())
    fastest = np.abs(rows[:, rates]).max(axis=0)
    # a quintic's top speed is 15/8 of its mean
    far = np.abs(last - first)[positions] / np.maximum(fastest, 1e-9)
    back = max(RETURN_S * time_unit, 2.0 * float(far.max(initial=0.0)) if np.all(fastest > 0) else 0.0)
    period = (length + math.ceil(back / dt - 1e-9)) * dt
    start = first.copy()
    start[rates] = 0.0
    curve = {}
    for i in set(range(n)) - set(rates):
        v1, v0 = (first[pairs[i]], last[pairs[i]]) if i in pairs else (0.0, 0.0)
        curve[i] = _find_quintic(first[i], last[i], v1, v0, period - length * dt)

    rates_of = {i: polynomial.deriv() for i, polynomial in curve.items() if i in pairs}

    def place(t: Array) -> tuple[NDArray[np.int_], Array, NDArray[np.bool_]]:
        number = np.clip(np.floor(t / period + 1e-9).astype(int), 0, None)
        inside = np.maximum(t - number * period, 0.0)
        return np.minimum(number, len(shares) - 1), inside, inside < length * dt - 1e-9

    def reference(t: Array) -> Array:
        number, inside, during = place(np.asarray(t, dtype=float))
        rows = np.tile(last, (len(inside), 1))
        if during.any():
            rows[during] = task.reference(inside[during])
        left = inside[~during] - length * dt
        for i, polynomial in curve.items():
            rows[~during, i] = polynomial(left)
            if i in pairs:
                rows[~during, pairs[i]] = rates_of[i](left)
        rows[:, :n] = (start + shares[number, None] * (rows - start))[:, :n]
        return rows

    def weight(t: Array) -> Array:
        assert task.weight is not None
        _, inside, during = place(np.asarray(t, dtype=float))
        rows = np.ones((len(inside), len(task.x0)))
        if during.any():
            rows[during] = task.weight(inside[during])
        return rows

    def measured(t: Array) -> Array:
        assert task.w is not None
        inside = np.minimum(place(np.asarray(t, dtype=float))[1], task.duration)
        return np.asarray(task.w(inside))

    return replace(
        task,
        duration=round(period * len(shares), 9),
        reference=reference,
        weight=None if task.weight is None else weight,
        w=None if task.w is None else measured,
        figures=None,
    )


def _find_quintic(p1: float, p0: float, v1: float, v0: float, time: float) -> np.polynomial.Polynomial:
    """Quintic from position ``p0`` and speed ``v0`` to ``p1`` and ``v1`` within ``time``, without acceleration at its
    ends: ``p(0) = p0, p'(0) = v0, p''(0) = 0``, and likewise at ``time``.
    """
    d = p1 - p0
    a3 = (10 * d - time * (6 * v0 + 4 * v1)) / time**3
    a4 = (-15 * d + time * (8 * v0 + 7 * v1)) / time**4
    a5 = (6 * d - time * 3 * (v0 + v1)) / time**5
    return np.polynomial.Polynomial([p0, v0, 0.0, a3, a4, a5])
