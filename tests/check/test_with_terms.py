"""A scenario with terms: states of lags join the control problem and the tasks."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import hybrid_mpc as hm

LAG = hm.terms.input_lag(
    "power", hm.Parameter("t_power", 2.0, "s", 0.5, 9.0), state=hm.Signal("power_acting", "W", 0.0, 50.0)
)
SHOWN = hm.terms.output_lag(
    "T", hm.Parameter("t_T", 3.0, "s", 0.5, 9.0), state=hm.Signal("T_shown", "degC", 0.0, 90.0)
)


class Heater(hm.Prior):
    states = outputs = (hm.Signal("T", "degC", 0.0, 90.0),)
    inputs = (hm.Signal("power", "W", 0.0, 50.0),)
    disturbances = (hm.Signal("room", "degC", 0.0, 40.0),)
    parameters = (hm.Parameter("c", 10.0, "J/K", 1.0, 99.0), hm.Parameter("k", 0.5, "W/K", 0.1, 9.0))
    operating_point = hm.OperatingPoint((40.0,), (10.0,), (20.0,))

    def xdot(self, x, u, w, p):
        return ((u.power - p.k * (x.T - w.room)) / p.c,)


def constant(value):
    return lambda t: np.full((len(t), 1), value)


def machine(**control):
    data = hm.DataSpec(
        "t", ("power",), ("T",), disturbances=("room",), dt=1.0, max_gap=1.0, smoothing=1.0, warm_up=5.0
    )
    problem = hm.OCP(20, [1.0], [1e-3], [1e-3], [0.0], [50.0], **control)
    task = hm.Task("warm", "Warm", 60.0, (30.0,), constant(50.0), constant(2.0), w=constant(10.0))
    return hm.Scenario(
        "heater", "", "", prior=Heater, data=data, control=problem, sensor_sigma=(0.1,), first_sigma=(),
        tasks=(task,),
    )  # fmt: skip


def test_states_of_terms_start_at_the_steady_value_of_the_task():
    """30 degC in a room of 10 degC are held by 10 W; the operating point has 40 degC, 20 degC and 10 W."""
    made = hm.with_terms(machine(), [LAG, SHOWN], {"k": 0.8}, name="slow")
    assert (made.name, made.explained, made.plant, made.oracle) == ("slow", True, None, None)
    assert made.prior().values["k"] == 0.8
    task = made.tasks[0]
    np.testing.assert_allclose(task.x0, (30.0, 0.8 * 20.0, 30.0), rtol=1e-8)
    np.testing.assert_allclose(task.reference(np.zeros(2))[0], (50.0, 16.0, 30.0), rtol=1e-8)
    np.testing.assert_array_equal(task.weight(np.zeros(1)), [[2.0, 1.0, 1.0]])
    np.testing.assert_array_equal(made.control.q, [1.0, 0.0, 0.0])
    assert made.first_sigma is None


def test_a_reference_of_outputs_has_no_further_column():
    given = machine(q_y=[1.0])
    task = hm.with_terms(given, [LAG], {}).tasks[0]
    assert task.reference is given.tasks[0].reference


def test_a_term_without_a_state_keeps_everything():
    drag = hm.terms.offset("T", hm.Parameter("o", 0.0, "degC/s", -1.0, 1.0), place="rate")
    given = machine()
    made = hm.with_terms(given, [drag], {"o": 0.1})
    assert (made.control, made.tasks) == (given.control, given.tasks)


def test_a_state_from_which_no_input_holds_starts_at_the_operating_point():
    given = machine()
    hot = replace(given, tasks=(replace(given.tasks[0], x0=(85.0,), w=constant(-99.0)),))
    assert hm.with_terms(hot, [LAG], {}).tasks[0].x0 == (85.0, 10.0)


def test_the_problem_with_further_states_has_the_same_cost():
    x, u = ca.SX.sym("x", 1), ca.SX.sym("u", 1)
    heat = ca.Function("heat", [x, u], [x * u])
    problem = hm.OCP(
        5, [1.0], [0.1], [0.0], [0.0], [9.0], terminal=[[3.0]], working_point=([2.0], [1.0]), x_max=[8.0],
        soft=[hm.SoftBound(heat, [-1.0], [4.0], [2.0], [3.0])],
        hard=[hm.HardBound("x", [0.0], [9.0], 2), hm.HardBound(heat, [-5.0], [5.0], at_end=True)],
        economic=ca.Function("price", [x, u], [u * u]),
    )  # fmt: skip
    wider = problem.with_states([7.0])
    np.testing.assert_array_equal(wider.terminal, np.diag([3.0, 0.0]))
    np.testing.assert_array_equal(wider.working_point[0], [2.0, 7.0])
    np.testing.assert_array_equal(wider.state_range[1], [8.0, np.inf])
    assert [b.priority for b in wider.hard] == [2, 0]
    assert wider.hard[1].at_end
    point = np.array([2.0, -4.0]), np.array([3.0])
    for mine, own in (
        (wider.soft[0].expression, heat),
        (wider.hard[1].what, heat),
        (wider.economic, problem.economic),
    ):
        assert float(mine(*point)) == float(own(point[0][:1], point[1]))
    rows = np.array([[1.0, 5.0]]), np.array([[2.0]])
    cost = wider.stage_cost(*rows, np.zeros((1, 2)), np.zeros((1, 1)))
    assert cost == problem.stage_cost(rows[0][:, :1], rows[1], np.zeros((1, 1)), np.zeros((1, 1)))


@pytest.mark.parametrize("weighed", ["states", "outputs"])
def test_the_check_accepts_the_problem_and_the_tasks(weighed):
    control = {"q_y": [1.0]} if weighed == "outputs" else {}
    hm.check_scenario(hm.with_terms(machine(**control), [LAG], {}))
