"""A control problem as plain data: checked, written, read, compared; the same problem to the last bit."""

import json
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from control_parts import POINT, plan_of
from hypothesis import given, settings
from hypothesis import strategies as st
from online_models import pendulum_model, random_linear

from hybrid_mpc import (
    OCP,
    CondensedController,
    InputError,
    SoftBound,
    SQPController,
    TrueState,
    dare,
    load_scenario,
)
from hybrid_mpc.records import plain, record
from hybrid_mpc.scenario import registered_scenarios

GOOD = {
    "horizon": 10, "q": [1.0, 0.1], "r": [0.1], "r_delta": [0.0], "u_min": [-1.0], "u_max": [2.0],
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"horizon": 0}, r"horizon.*HM-MODEL-025"),
        ({"horizon": 2.5}, "horizon"),
        ({"horizon": np.nan}, "horizon"),
        ({"horizon": np.inf}, "horizon"),
        ({"horizon": "10"}, "horizon"),
        ({"q": "heavy"}, "HM-MODEL-015"),
        ({"q": np.eye(2)}, "HM-CONTROL-020"),
        ({"soft": [3]}, "SoftBound"),
        ({"economic": 3}, "economic"),
        ({"blocks": (np.nan, 10)}, r"blocks.*HM-MODEL-025"),
        ({"q": [-1.0, 0.1]}, "HM-CONTROL-022"),
        ({"q": [np.nan, 0.1]}, "HM-CONTROL-022"),
        ({"r": [0.0]}, "HM-CONTROL-023"),
        ({"r_delta": [0.0, 0.0]}, r"r_delta.*HM-MODEL-017"),
        ({"u_min": [3.0]}, "HM-MODEL-013"),
        ({"u_min": [np.nan]}, "HM-MODEL-013"),
        ({"u_max": [1.0, 1.0]}, "HM-MODEL-012"),
        ({"du_max": [0.0]}, "HM-CONTROL-018"),
        ({"terminal": "lyapunov"}, "riccati"),
        ({"terminal": np.eye(3)}, "HM-CONTROL-028"),
        ({"terminal": -np.eye(2)}, "HM-CONTROL-029"),
        ({"blocks": (1, 2, 4)}, r"10.*HM-CONTROL-026"),
        ({"blocks": (5, 5, 5)}, r"10.*HM-CONTROL-026"),
        ({"blocks": (10, 0)}, r"blocks.*HM-MODEL-025"),
        ({"blocks": (2.5, 7.5)}, r"blocks.*HM-MODEL-025"),
        ({"blocks": ()}, "HM-CONTROL-026"),
    ],
)
def test_bad_problems_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        OCP(**{**GOOD, **change})


def test_stage_cost_by_hand_and_over_a_batch():
    ocp = OCP(**{**GOOD, "r_delta": [10.0]})
    x, u, ref, du = np.array([[1.0, 2.0]] * 3), np.array([[0.5]] * 3), np.zeros((3, 2)), np.array([[0.1]] * 3)
    np.testing.assert_allclose(ocp.stage_cost(x, u, ref, du), 1 + 0.4 + 0.025 + 0.1, rtol=1e-14)


def test_terminal_weight_is_the_riccati_solution_times_dt():
    model, a, b, _ = random_linear(0, n_x=3, n_u=2)
    ocp = OCP(5, [1.0, 2.0, 3.0], [0.5, 0.6], [0.0, 0.0], [-1.0] * 2, [1.0] * 2)
    want, _ = dare(a, b, np.diag(ocp.q), np.diag(ocp.r))
    np.testing.assert_allclose(ocp.terminal_weight(model), want * model.dt, rtol=1e-9)


def test_terminal_weight_with_hidden_states_is_semidefinite():
    p = OCP(**GOOD, working_point=POINT).terminal_weight(pendulum_model(z=6))
    assert p.shape == (2, 2)
    assert np.min(np.linalg.eigvalsh(p)) >= 0


def expressions(kind=ca.SX):
    x, u, p = kind.sym("x", 2), kind.sym("u"), kind.sym("p")
    power = ca.Function("power", [x, u], [ca.vertcat(u * x[1], ca.sin(x[0]) ** 2)], ["x", "u"], ["e"])
    price = ca.Function("price", [x, u, p], [p * ca.fmax(u, 0) ** 2 + ca.log(1 + x[0] ** 2)])
    return power, price


def full(kind=ca.SX, **fields):
    """A problem in which every field is given."""
    power, price = expressions(kind)
    given = {
        "horizon": 8, "q": [30.0, 0.1], "r": [0.05], "r_delta": [1 / 3], "u_min": [-np.inf], "u_max": [1.7],
        "du_max": [0.9], "terminal": [[3.0, 0.1], [0.1, 0.7]], "working_point": ([0.0, 0.1], [0.0]),
        "x_min": [-0.4, -np.inf], "x_max": [0.4, 2.5], "slack_linear": [1e3, 2e2], "slack_quadratic": [1e3, 1e2],
        "soft": [SoftBound(power, [-1.5, -np.inf], [1.1, 0.1], [50.0, 60.0], [1.0, 2.0])], "blocks": [1, 1, 2, 4],
        "economic": price, "starts": [np.full((8, 1), 0.3), np.linspace(0, 1, 8)[:, None]],
    }  # fmt: skip
    return OCP(**{**given, **fields})


def read(ocp):
    return record(OCP, json.loads(json.dumps(plain(ocp), allow_nan=False)), "ocp.json")


def plans(ocp, solver):
    """Two solves from a start that the bounds and expressions bend."""
    controller = solver(pendulum_model(z=2), ocp)
    reference = np.tile([0.6, 0.0, 0.4][: 2 + ocp.n_p], (9, 1))
    estimate = TrueState(controller.model).start([0.2, 0.5, 0.1, -0.1])
    plan = plan_of(controller, estimate, reference)
    return [plan, controller.solve(plan, estimate, reference)]


@pytest.mark.parametrize("solver", [CondensedController, SQPController])
def test_what_was_read_is_the_same_problem_to_the_last_bit(solver):
    ocp = full()
    for one, other in zip(plans(ocp, solver), plans(read(ocp), solver), strict=True):
        assert np.array_equal(one.u, other.u)
        assert np.array_equal(one.x, other.x)
        assert one.cost == other.cost
    free = plans(full(soft=(), economic=None), solver)
    assert not np.allclose(free[1].u, plans(ocp, solver)[1].u)  # the expressions count


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_equal_means_the_same_content(kind):
    ocp = full(kind)
    for same in (read(ocp), full(kind), full(ca.SX), pickle.loads(pickle.dumps(ocp)), ocp.changed()):
        assert same == ocp
        assert hash(same) == hash(ocp)
        assert plain(same) == plain(ocp)
    power, _ = expressions()
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    bound = SoftBound(power, [-1.5, -np.inf], [1.1, 0.2], [50.0, 60.0], [1.0, 2.0])
    changes = {
        "horizon": {"horizon": 9, "blocks": None, "starts": ()}, "q": {"q": [30.0, 0.2]}, "du_max": {"du_max": None},
        "terminal": {"terminal": "riccati"}, "economic": {"economic": None}, "soft": {"soft": [bound]},
        "another expression": {"economic": ca.Function("cost", [x, u], [u**2], ["x", "u"], ["o0"])},
        "starts": {"starts": ocp.starts[:1]}, "working point": {"working_point": ([0.0, 0.2], [0.0])},
    }  # fmt: skip
    for name, change in changes.items():
        assert ocp.changed(**change) != ocp, name
    assert ocp != plain(ocp)
    assert {ocp: "kept"}[full()] == "kept"


def test_an_expression_without_plain_form_is_the_same_as_itself_alone():
    x, u, z = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("z")
    solve = ca.rootfinder("root", "newton", {"x": z, "p": x, "g": z**3 + z - x[0]})
    cost = ca.Function("cost", [x, u], [solve(0.0, x) ** 2 + u**2])
    ocp = full(economic=cost)
    assert ocp == full(economic=cost)
    assert ocp != full(economic=ca.Function("cost", [x, u], [solve(0.0, x) ** 2 + u**2]))
    with pytest.raises(InputError, match=r"cost.*root \(Newton\).*NN-024"):
        plain(ocp)


def test_arrays_cannot_be_written_into_nor_seen_through():
    q = np.array([1.0, 2.0])
    ocp = full(q=q)
    q[0] = 9.0
    assert ocp.q[0] == 1.0
    arrays = ocp.q, ocp.u_min, ocp.x_max, ocp.terminal, *ocp.starts, *ocp.working_point, ocp.soft[0].lower
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7.0


def test_a_changed_problem_takes_what_was_given_not_what_followed_from_it():
    with pytest.raises(
        InputError, match=r"field.*of a control problem 'horizn'.*did you mean 'horizon'.*HM-RECORDS-011"
    ):
        OCP(**GOOD).changed(horizn=30)
    ocp = OCP(5, [4.0], [1.0], [0.0], [-1.0], [1.0], x_max=[1.0])
    np.testing.assert_array_equal(ocp.changed(q=[16.0]).penalties, [[4000.0], [16000.0]])
    assert ocp.changed(slack_linear=[7.0]).changed(q=[16.0]).penalties[0] == 7.0


@pytest.mark.parametrize("name", registered_scenarios())
def test_the_problems_of_the_ready_scenarios_come_back(name):
    scenario = load_scenario(name)
    problems = {task.name: task.control or scenario.control for task in scenario.tasks} | {
        "": scenario.control
    }
    for ocp in (p for p in problems.values() if p is not None):
        assert read(ocp) == ocp


def test_outputs_that_are_tracked_come_back():
    outputs = {"q_y": [4.0, 0.0], "y_max": [1.0, np.inf], "preview": False, "preview_w": True}
    ocp = read(full(**outputs))
    assert (ocp.n_y, ocp.columns) == (2, 2 + ocp.n_p)
    assert ocp.y_min.tolist() == [-np.inf, -np.inf]
    assert ocp == full(**outputs)
    assert ocp != full(**{**outputs, "q_y": [4.0, 1.0]})
    assert read(full()).q_y.size == 0


SMALL = {"horizon": 5, "q": [1], "r": [1], "r_delta": [0.5], "u_min": ["-inf"], "u_max": ["inf"]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"q": [1, "heavy"]},
            "q: numbers in a list, or in lists of the same length, is needed, got a list of 2",
        ),
        ({"q": None}, "q: numbers in a list"),
        ({"q": [-1]}, "q: weights must be finite and not negative"),
        ({"horizon": 2.5}, "horizon: a whole number is needed, got 2.5"),
        ({"horizn": 5}, "no field 'horizn'; did you mean 'horizon'?"),
        ({"u_max": ["-inf"]}, "HM-MODEL-013"),
        ({"terminal": [[1, 0], [0]]}, "terminal: "),
        ({"terminal": "lyapunov"}, "terminal: "),
        ({"starts": [[[0.0]]]}, r"starts\[0\]: .*HM-CONTROL-024"),
        ({"working_point": [[0]]}, "working_point: a list of 2 or null is needed, got a list of 1"),
        ({"economic": "u**2"}, "economic: "),
        (
            {"economic": {"inputs": []}},
            r"economic: program: expected the fields \['inputs', 'metadata', 'nodes'",
        ),
        ({"soft": [{"lower": [0]}]}, r"soft\[0\]: expression is missing"),
    ],
)
def test_what_is_wrong_is_told_by_field(change, words):
    with pytest.raises(InputError, match=rf"^ocp\.json: .*{words}"):
        record(OCP, {**SMALL, **change}, "ocp.json")


LEAVES = (
    st.none() | st.booleans() | st.integers(-3, 9) | st.floats() | st.sampled_from(["inf", "riccati", "x"])
)
JSON = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
    st.sampled_from(["inputs", "outputs", "nodes", "metadata", "expression", "lower"]), inner, max_size=4,
), max_leaves=12)  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(st.sampled_from(list(plain(full()))), JSON, max_size=3))
def test_any_json_is_a_problem_or_refused(changes):
    try:
        found = record(OCP, {**plain(full()), **changes}, "ocp.json")
    except InputError as error:
        told = str(error)
    else:
        told = "ocp.json: " * isinstance(found, OCP)
    assert told.startswith("ocp.json: ")


def test_a_problem_is_stated_without_torch_and_scipy():
    code = (
        "import sys\nfrom hybrid_mpc import OCP, Scenario\n"
        "OCP(20, [1.0], [0.1], [0.0], [-1.0], [1.0])\n"
        "assert not {'torch', 'scipy', 'daqp'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_another_number_of_states_needs_no_new_bounds_where_none_bound_anything():
    ocp = OCP(10, [1.0, 2.0], [0.1], [0.0], [-1.0], [1.0])
    wider = ocp.changed(q=(1.0, 2.0, 3.0))
    assert (wider.n_x, wider.x_max.size) == (3, 3)
    with pytest.raises(InputError, match="HM-CONTROL-052"):
        ocp.changed(x_max=[1.0, np.inf]).changed(q=(1.0, 2.0, 3.0))
