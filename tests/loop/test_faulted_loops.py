"""Random faults in motion, on the golf robot's prior and a small hybrid: ten loops of 200 periods survive.

Every loop is one of the study ``faults_1000``: one to three of the machine's faults, missing samples and late solves
among them. *Forced* are the periods whose solve is declared late, and nothing else.
"""

from collections import Counter

import numpy as np
import pytest

from hybrid_mpc import load, make_controller, make_estimator, make_monitor, simulate
from hybrid_mpc.compare.study import built_in_study
from scenarios.golf_robot import scenario
from scenarios.golf_robot.faults import catalogue

DT, PERIODS = 0.02, 200
SIGMA_X = (1e-4, 2e-2)
"""Process noise per period [rad, rad/s]: the order of the prior's one-period errors on the rig."""
STUDY = built_in_study("faults_1000", ".")
TASKS = [task for task in scenario.tasks if task.name in STUDY.tasks]
"""Holding a position is no motion."""


def drawn(seed):
    """A random loop: task, faults, intervals of late solves, first instant of a fault [s]."""
    rng = np.random.default_rng(seed)
    task = TASKS[rng.integers(len(TASKS))]
    faults, late = STUDY.random_faults.drawn(rng)
    start = min([fault.start for fault in faults] + [begin for begin, _ in late])
    return task, (*task.faults, *faults), late, start


def excess(u, ocp):
    """Largest violation of a limit of the input or of its change; at most 0 where all are kept."""
    beyond = [np.max(u - ocp.u_max), np.max(ocp.u_min - u)]
    if ocp.du_max is not None:
        beyond.append(np.max(np.abs(np.diff(u, axis=0, prepend=np.zeros((1, 1)))) - ocp.du_max))
    return max(beyond)


@pytest.fixture(scope="module", params=[range(19, 22), pytest.param(range(12, 19), marks=pytest.mark.full)])
def loops(request, golf_artifact):
    """The draw and the result of loops, with the limits they had; an exception in any ends them all."""
    models, done = load(golf_artifact).models, []
    for seed in request.param:
        task, faults, spans, start = drawn(seed)
        late = {k for k in range(PERIODS) if any(a - 1e-9 <= k * DT < b - 1e-9 for a, b in spans)}
        model, control = models[("hybrid", "prior")[seed % 2]], task.control or scenario.control
        controller = make_controller(model, models["prior"], control)
        result = simulate(
            scenario.plant(), make_estimator(model, scenario, np.array(SIGMA_X), control), controller,
            task.reference, weight=task.weight, dt=DT, duration=PERIODS * DT, x0=np.array(task.x0), seed=seed,
            faults=faults, monitor=make_monitor(model), late=lambda t, at=late: round(t / DT) in at,
        )  # fmt: skip
        done.append((faults, late, start, result, controller.controller.ocp))
    return done


def test_inputs_are_finite_and_within_their_limits(loops):
    for faults, _, _, result, ocp in loops:
        assert len(result.u) == PERIODS, faults
        assert np.isfinite(result.u).all(), faults
        # rounding of the slew, a difference of inputs below 1 N m
        assert excess(result.u, ocp) <= 1e-12, faults


def test_nearly_all_periods_are_solved_but_those_whose_solve_is_late(loops):
    free, forced = Counter(), Counter()
    for _, late, _, result, _ in loops:
        free.update(s for k, s in enumerate(result.source) if k not in late)
        forced.update(s for k, s in enumerate(result.source) if k in late)
    assert forced.total() > 0
    assert forced["MPC"] == 0
    assert free["MPC"] >= 0.9 * free.total()  # 0.9997 of the 1000 loops in docs/results/loops.md


def test_faults_begin_in_motion(loops):
    for faults, _, start, result, _ in loops:
        begun = (result.t >= start - 1e-9) & (result.t < start + 0.3)
        assert np.abs(result.x[begun, 1]).max() > 0.05, faults  # rad/s


def test_draws_cover_the_catalogue():
    draws = [drawn(seed) for seed in range(200)]
    faults = [fault for _, some, *_ in draws for fault in some]
    assert any(late for *_, late, _ in draws)
    assert {case.target for entry in catalogue() if not entry.nominal for case in entry.faults} <= {
        fault.target for fault in faults
    }
    assert {np.sign(f.value) for f in faults if f.target == "plant_push"} == {-1.0, 1.0}
