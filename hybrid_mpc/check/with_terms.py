"""A scenario whose prior has terms: states of terms are added to its control problem and tasks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.operating_point import holding_input
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.machine.prior import OperatingPoint, Prior
from hybrid_mpc.machine.terms import Term, extended, with_nominal
from hybrid_mpc.scenario import Scenario, Task

Array = NDArray[np.float64]


def with_terms(
    machine: Scenario,
    terms: Sequence[Term],
    values: Mapping[str, float],
    operating_point: OperatingPoint | None = None,
    *,
    name: str = "",
    title: str = "",
) -> Scenario:
    """A scenario with further terms in its prior, as ``hybrid-mpc explain`` writes it.

    A state of a term, e.g. of a lag, gets no weight and no bounds in the control problem. At the start of a task it has
    its steady value at the input that holds the task's first state; if no input does, that of the operating point. The
    scenario's plant and oracle, which do not have this state, are left out: loops then run on a trained model.
    The promise "structure of the prior" lists the terms as those of a search (``explained``).
    ``first_sigma`` is left to its default: with the lag of a sensor, other states are measured directly than before.

    Args:
        machine: The scenario.
        terms: The terms.
        values: Nominal values [their units] by name. Other parameters keep their values.
        operating_point: The equilibrium with these values, including the states of terms. Default: the prior's.
        name: Name of the new scenario. Default: that of ``machine``.
        title: Its title. Default: that of ``machine``.

    Raises:
        InputError: If a term does not match the prior (:func:`~hybrid_mpc.machine.terms.extended`), or a value lies
            outside its bounds.

    Example:
        >>> import hybrid_mpc as hm
        >>> tank = hm.load_scenario("cascaded_tanks")
        >>> late = hm.terms.input_lag(
        ...     "pump", hm.Parameter("tau", 5.0, "s", 4.0, 60.0), state=hm.Signal("pump_acting", "V", 0.0, 10.0)
        ... )
        >>> slower = with_terms(tank, [late], {})
        >>> tank.control.q.size, slower.control.q.size, [s.name for s in slower.prior().states][-1]
        (2, 3, 'pump_acting')
    """
    base = type(machine.prior())
    prior = with_nominal(extended(base, *terms), values, operating_point)
    more = len(prior.states) - len(base.states)
    changed = replace(
        machine, name=name or machine.name, title=title or machine.title, prior=prior, explained=True
    )
    if not more or machine.control is None:
        return changed
    point = prior.operating_point
    at_rest = np.zeros(more) if point is None else np.array(point.x[-more:])
    return replace(
        changed,
        control=machine.control.with_states(at_rest),
        tasks=tuple(_with_states(task, machine.control, prior, at_rest) for task in machine.tasks),
        first_sigma=None,
        plant=None,
        oracle=None,
    )


def _with_states(task: Task, problem: OCP, prior: type[Prior], at_rest: Array) -> Task:
    """A task with the states of terms: their first values, and columns of its reference and weights."""
    own = problem if task.control is None else task.control
    n_x, point = len(task.x0), prior.operating_point
    steady = None
    if point is not None:
        w = point.w if task.w is None else tuple(task.w(np.zeros(1))[0].tolist())
        start = OperatingPoint((*task.x0, *at_rest.tolist()), point.u, w)
        steady = holding_input(with_nominal(prior, {}, start)())
    first = at_rest if steady is None else np.array(steady.x[n_x:])

    def widened(rows: Callable[[Array], Array], added: Array) -> Callable[[Array], Array]:
        def of(t: Array) -> Array:
            given = np.asarray(rows(t))
            columns = np.broadcast_to(added, (len(given), len(added)))
            return np.hstack([given[:, :n_x], columns, given[:, n_x:]])

        return of

    return replace(
        task,
        x0=(*task.x0, *first.tolist()),
        reference=task.reference if own.n_y else widened(task.reference, first),
        weight=task.weight and widened(task.weight, np.ones(len(first))),
        control=task.control and task.control.with_states(at_rest),
    )
