"""Nominal loops that the energy guard is learned from: the tasks, over and over, under the hybrid MPC."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import load
from hybrid_mpc.closed_loop import Fault, simulate
from hybrid_mpc.closed_loop.faults import install
from hybrid_mpc.closed_loop.simulate import Step
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.contenders import build
from hybrid_mpc.monitor import guard_monitor
from hybrid_mpc.monitor.lengths import SETTLING_S, block_seconds, samples
from hybrid_mpc.pipeline.monitor_job import stored_rest
from hybrid_mpc.scenario import Budget, Scenario, Task, load_scenario

Array = NDArray[np.float64]
CONTENDER = "hybrid_observer"
"""The controller that the guard is for."""
BLOCKS = 9
"""Whole blocks (of five of the machine's seconds) in a loop. Four such loops carry two false alarms an hour, eight
carry one."""
FEWEST, MOST = 4, 16
"""Loops: two for each seed of the budget, within these."""
FIRST_SEED = 500
"""Their numbers begin here, away from those of the compared loops."""
SMALLEST = 0.6
"""Every time round, the reference is scaled by a factor drawn from here to 1: no two rounds are alike."""
RETURN_S = 1.0
"""Shortest way back to the reference's beginning [the machine's seconds]."""
AGEING, DRIFT_S = (1.0, 1.1, 0.9), 30.0
"""Where the plant knows it, friction drifts to these shares, in turn, within so many of the machine's seconds:
ageing, of which the guard is to say nothing."""


@dataclass(frozen=True)
class NominalLoop:
    """One loop.

    Args:
        task: Name of the task that it repeats.
        seed: Number of the loop.
        friction: Share that friction drifts to.
    """

    task: str
    seed: int
    friction: float = 1.0

    @property
    def stage(self) -> str:
        """Name of its checkpoint."""
        return f"guard/{self.task}-{self.seed}"


def nominal_loops(scenario: Scenario, budget: Budget) -> list[NominalLoop]:
    """The loops of a budget: tracking tasks in which nothing goes wrong, in turn; if there are none, other tasks.

    Raises:
        InputError: If something goes wrong in every task.

    Example:
        >>> from hybrid_mpc.scenario import load_scenario
        >>> golf = load_scenario("golf_robot")
        >>> [(loop.task, loop.friction) for loop in nominal_loops(golf, golf.budgets["quick"])]
        [('track_sine', 1.0), ('track_step', 1.1), ('track_sine', 0.9), ('track_step', 1.0)]
    """
    calm = [task for task in scenario.tasks if not task.faults]
    tasks = [task for task in calm if task.weight is None] or calm
    if not tasks:
        raise InputError(
            f"scenario {scenario.name}: every task brings a fault; the guard is learned from one without"
        )
    ages = AGEING if knows(scenario, "plant_friction") else AGEING[:1]
    n = min(max(2 * budget.seeds, FEWEST), MOST)
    return [NominalLoop(tasks[i % len(tasks)].name, FIRST_SEED + i, ages[i % len(ages)]) for i in range(n)]


def knows(scenario: Scenario, target: str) -> bool:
    """Whether the scenario's plant can show a fault of its own."""
    if scenario.plant is None:
        return False
    try:
        install(scenario.plant(), (Fault(0.0, 1.0, target, 1.0),))
    except InputError:
        return False
    return True


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


def run_nominal(
    scenario_name: str,
    folder: Path,
    noise: Mapping[str, Array],
    run_seed: int,
    loop: NominalLoop,
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> tuple[dict[str, Any], dict[str, Array]]:
    """One loop: what the monitor reads in it, and what it was fed.

    Args:
        scenario_name: Name or path of the scenario.
        folder: The artifact.
        noise: Process noise by contender.
        run_seed: Seed of the run.
        loop: Which.
        report: Called with ``(done, total, text)``.

    Returns:
        Task, seed, friction, length [s] and cost; arrays ``numbers`` (the first second left out), ``y``, ``u``.
    """
    scenario, artifact = load_scenario(scenario_name), load(folder)
    task = next(t for t in scenario.tasks if t.name == loop.task)
    control, model = task.control or scenario.control, artifact.models["hybrid"]
    assert scenario.plant is not None
    assert control is not None
    settling, unit = samples(SETTLING_S, model), model.time_unit
    periods = settling + BLOCKS * max(round(block_seconds(model.dt, unit) / model.dt), 1)
    seconds, rng = periods * model.dt, np.random.default_rng([run_seed, loop.seed])
    many = repeated(task, model.dt, rng.uniform(SMALLEST, 1.0, math.ceil(seconds / task.duration)), unit)
    drift = (Fault(0.0, math.inf, "plant_friction", loop.friction, ramp=DRIFT_S * unit),)
    numbers: list[tuple[float, ...]] = []

    def on_step(step: Step) -> None:
        numbers.append(step.reading.numbers)  # type: ignore[union-attr]
        if step.k % 100 == 0:
            report(step.k, periods, "periods")

    estimator, controller = build(CONTENDER, scenario, artifact, control, noise)
    result = simulate(
        scenario.plant(), estimator, controller, many.reference, weight=many.weight, dt=model.dt,
        duration=seconds, x0=np.array(task.x0), seed=run_seed * 1000 + loop.seed,
        monitor=guard_monitor(model, rest_speed=stored_rest(artifact)),
        faults=drift if loop.friction != 1.0 else (), on_step=on_step,
    )  # fmt: skip
    kept = {"numbers": np.array(numbers)[settling:], "y": result.y, "u": result.u}
    told = {"task": loop.task, "seed": loop.seed, "friction": loop.friction}
    return {**told, "seconds": seconds, "cost": result.cost}, kept
