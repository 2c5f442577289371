"""Tasks of a scenario: chosen by name, or run over and over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import Scenario, Task

Array = NDArray[np.float64]


def tasks_of(scenario: Scenario, names: Sequence[str] | None) -> tuple[Task, ...]:
    """The scenario's tasks of exactly these names, all for None; an unknown name is refused."""
    if names is None:
        return scenario.tasks
    there = {task.name: task for task in scenario.tasks}
    missing = [name for name in names if name not in there]
    if missing:
        raise InputError(
            f"scenario {scenario.name}: no task {', '.join(missing)}; there are: {', '.join(there)}"
        )
    return tuple(there[name] for name in names)


def selected_tasks(scenario: Scenario, names: Sequence[str]) -> tuple[Task, ...]:
    """The tasks of these names or, where there is none of a name, those whose names begin so; all for no names.

    Raises:
        InputError: If nothing fits a name.

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
                f"scenario {scenario.name}: no task {name!r}, none begins so; there are: {', '.join(there) or 'none'}"
            )
        chosen.update(fitting)
    return tuple(task for task in scenario.tasks if task.name in chosen)


RETURN_S = 1.0
"""Shortest way back to the reference's beginning [the machine's seconds]."""


def repeated(task: Task, dt: float, shares: Array, time_unit: float = 1.0) -> Task:
    """The task over and over: to its end, back to its beginning along a quintic, and again.

    Args:
        task: A task; its reference is asked for within its duration alone.
        dt: Period [s]; a round takes whole periods, since weights may be of single instants.
        shares: Factor ``(m,)`` on the distance from the reference's beginning, a round each.
        time_unit: The machine's second [s]: the way back takes one at least. Default 1.

    Returns:
        The task of ``m`` rounds.

    Example:
        >>> ramp = Task("ramp", "", 1.0, (0.0, 0.0), lambda t: np.column_stack([t, np.ones(len(t))]))
        >>> twice = repeated(ramp, 0.02, np.array([1.0, 0.5]))
        >>> twice.duration, twice.reference(np.array([0.5, 3.5])).round(6).tolist()
        (6.0, [[0.5, 1.0], [0.25, 0.5]])
    """
    n_q, length = len(task.x0) // 2, round(task.duration / dt)
    rows = task.reference(np.arange(length + 1, dtype=np.float64) * dt)
    first, last = rows[0], rows[-1]
    fastest = np.abs(rows[:, n_q : 2 * n_q]).max(axis=0)
    far = np.abs(last - first)[:n_q] / np.maximum(fastest, 1e-9)  # a quintic's top speed is 15/8 of its mean
    back = max(RETURN_S * time_unit, 2.0 * float(far.max(initial=0.0)) if np.all(fastest > 0) else 0.0)
    period = (length + math.ceil(back / dt - 1e-9)) * dt
    curve = [
        _quintic(first[i], last[i], first[n_q + i], last[n_q + i], period - length * dt) for i in range(n_q)
    ]

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
        for i, polynomial in enumerate(curve):
            rows[~during, i], rows[~during, n_q + i] = polynomial(left), polynomial.deriv()(left)
        start = np.concatenate([first[:n_q], np.zeros(len(first) - n_q)])
        rows[:, : 2 * n_q] = (start + shares[number, None] * (rows - start))[:, : 2 * n_q]
        return rows

    def weight(t: Array) -> Array:
        assert task.weight is not None
        _, inside, during = place(np.asarray(t, dtype=float))
        rows = np.ones((len(inside), len(task.x0)))
        if during.any():
            rows[during] = task.weight(inside[during])
        return rows

    return replace(
        task,
        duration=round(period * len(shares), 9),
        reference=reference,
        weight=None if task.weight is None else weight,
        figures=None,
    )


def _quintic(p1: float, p0: float, v1: float, v0: float, time: float) -> np.polynomial.Polynomial:
    """From position ``p0`` and speed ``v0`` to ``p1`` and ``v1`` within ``time``, without acceleration at the ends."""
    d = p1 - p0
    a3 = (10 * d - time * (6 * v0 + 4 * v1)) / time**3
    a4 = (-15 * d + time * (8 * v0 + 7 * v1)) / time**4
    a5 = (6 * d - time * 3 * (v0 + v1)) / time**5
    return np.polynomial.Polynomial([p0, v0, 0.0, a3, a4, a5])
