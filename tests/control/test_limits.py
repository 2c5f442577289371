"""Limits given for one solve: kept by every solver, entered as fast as the limit of the change allows."""

import numpy as np
import pytest
from control_parts import POINT, estimate_of, plan_of
from hypothesis import given, settings
from hypothesis import strategies as st
from online_models import pendulum_model

from hybrid_mpc import (
    OCP,
    BestOf,
    CondensedController,
    InputError,
    IpoptController,
    Limits,
    SafeController,
    SQPController,
    Status,
)
from hybrid_mpc.control.safeguard import Source

E0 = estimate_of(pendulum_model(), [-0.4, 0.0])
GOAL = np.array([[0.5, 0.0]])


def problem(**others):
    return OCP(20, [50.0, 0.5], [0.1], [0.1], [-1.0], [1.0], working_point=POINT, **others)


@pytest.mark.parametrize("others", [{}, {"du_max": [0.2]}, {"du_max": [0.2], "blocks": (1, 1, 2, 4, 4, 8)}])
@pytest.mark.parametrize("solver", [CondensedController, SQPController, IpoptController])
def test_solvers_keep_tighter_limits(solver, others):
    ocp = problem(**others)
    controller, limits = solver(pendulum_model(), ocp), Limits([-0.3], [0.25])
    start = np.full((20, 1), 0.8)  # held far beyond them
    free, plan = (plan_of(controller, E0, GOAL, start=start, limits=given) for given in (None, limits))
    assert plan.status is Status.SOLVED
    assert np.max(free.u) > 0.3  # it would want more
    lower, upper = ocp.bounds(np.array([0.8]), limits)
    # The clip after the solve makes bounds exact; IPOPT relaxes the changes by 1e-8 of their range.
    assert np.all((lower <= plan.u) & (plan.u <= upper))
    if ocp.du_max is not None:
        assert np.all(np.abs(np.diff(plan.u[:, 0], prepend=0.8)) <= 0.2 + 1e-6)
        assert plan.u[0, 0] == pytest.approx(0.6, abs=1e-6)  # as fast as may be
    assert np.all(plan.u[5:] <= 0.25)


def test_limits_are_those_of_a_problem_that_has_them():
    model, limits = pendulum_model(), Limits([-0.3], [0.25])
    wide, own = (
        SQPController(model, problem()),
        SQPController(model, problem().changed(u_min=[-0.3], u_max=[0.25])),
    )
    expected = plan_of(own, E0, GOAL).cost
    assert plan_of(wide, E0, GOAL, limits=limits).cost == pytest.approx(expected, rel=1e-9)  # sqp's own 1e-10
    best = BestOf(wide, starts=[np.zeros((20, 1))])
    assert plan_of(best, E0, GOAL, limits=limits).cost <= expected * (1 + 1e-9)


@settings(max_examples=60, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-2.0, 2.0), st.floats(0.0, 2.0), st.sampled_from([None, 0.05, 0.5]))
def test_there_is_always_an_admissible_plan(u_prev, low, width, du_max):
    ocp = problem(du_max=None if du_max is None else [du_max])
    held = np.array([u_prev])
    lower, upper = ocp.bounds(held, Limits([low], [low + width]))
    assert np.all(lower <= upper)
    assert np.all((ocp.u_min <= lower) & (upper <= ocp.u_max))
    u = held
    for k in range(20):
        reach = (u - du_max, u + du_max) if du_max is not None else (lower[k], upper[k])
        u = np.clip(np.clip(u, lower[k], upper[k]), *reach)
        assert lower[k] - 1e-12 <= u <= upper[k] + 1e-12  # rounding of k du_max
    first = ocp.saturate(np.array([9.0]), held, Limits([low], [low + width]))
    assert lower[0] <= first <= upper[0]


def test_a_safe_controller_keeps_them_whatever_happens():
    ocp = problem(du_max=[0.2])
    safe = SafeController(CondensedController(pendulum_model(), ocp), pendulum_model(), max_age=1)
    limits, decision, seen = Limits([-0.1], [0.1]), safe.initial(E0, np.array([0.8])), []
    for k in range(8):
        goal = GOAL if k % 2 else np.full((1, 2), np.nan)  # every other solve fails
        held, decide = decision.u, safe.late if k == 5 else safe.decide
        decision = decide(decision, E0, goal, limits=limits)
        seen.append(decision.source)
        assert abs(decision.u - held) <= 0.2 + 1e-12  # rounding
        assert abs(decision.u) <= max(0.1, abs(held) - 0.2) + 1e-12
    assert {Source.MPC, Source.PLAN} <= set(seen)
    assert abs(decision.u) <= 0.1


@pytest.mark.parametrize("bad", [([1.0], [0.0]), ([0.0, 0.0], [1.0]), ([np.nan], [1.0])])
def test_limits_that_are_none_are_refused(bad):
    with pytest.raises(InputError, match="HM-CONTROL-009"):
        Limits(*bad)


def test_limits_of_another_size_are_refused():
    with pytest.raises(InputError, match="HM-CONTROL-010"):
        problem().bounds(np.zeros(1), Limits([0.0, 0.0], [1.0, 1.0]))
