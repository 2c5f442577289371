"""Limits of inputs of any sign, on one side, both or none: loops, figures, tables, refusals."""

from dataclasses import replace
from types import SimpleNamespace

import cart
import numpy as np
import pytest
from closed_loop_parts import ScriptedMonitor
from online_models import PendulumPlant, linear_model, pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    DataSpec,
    Guard,
    Limits,
    Loop,
    Mode,
    SafeController,
    Scenario,
    Signal,
    TrueState,
    load_scenario,
    make_controller,
    make_estimator,
    make_monitor,
    make_resting_guard,
    simulate,
)
from hybrid_mpc.analyze.analysis import driving_input, input_range, responses_of, state_range
from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.compare.loops import excess, limits_used
from hybrid_mpc.kit.assembly import sensor_steps, working_point
from hybrid_mpc.loop.plant import ModelPlant
from hybrid_mpc.model.limits import share_used
from hybrid_mpc.plots.loops import Motion, closed_loops

INF = np.inf
FINITE = {
    "both signs": (-1.0, 2.0),
    "from zero": (0.0, 2.0),
    "to zero": (-2.0, 0.0),
    "positive": (0.5, 2.0),
    "negative": (-2.0, -0.5),
}
OPEN = {
    "below": (-0.5, INF),
    "above": (-INF, 0.5),
    "from zero on": (0.0, INF),
    "up to zero": (-INF, 0.0),
    "positive on": (0.5, INF),
    "none": (-INF, INF),
}
CONTROL = OCP(10, (30.0, 1.0), (0.05,), (0.05,), (-1.0,), (2.0,), (0.5,))
TOLERATED = 2 / np.sqrt(0.1)
"""What stands for the input's range where it has none: both ways of what the weights tolerate."""
SPEC = DataSpec("t", ("u",), ("y",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.1)
MACHINE = Scenario("pendulum", "", "", prior=pendulum_model, data=SPEC, control=CONTROL, sensor_sigma=(1e-3,))


SIGNS = ("from zero", "positive", "negative", "up to zero", "none")
"""Limits of every sign; the quick set has loops of the first, second and last."""


def of_signs(quick, others):
    """Limits by name; ``others`` are those of the full set."""
    names = [*quick, *(pytest.param(n, marks=pytest.mark.full) for n in others if n not in quick)]
    return pytest.mark.parametrize("name", names)


@of_signs(SIGNS, FINITE | OPEN)
def test_a_whole_loop_with_its_figures(name):
    limits = (FINITE | OPEN)[name]
    control = CONTROL.changed(u_min=limits[:1], u_max=limits[1:], x_min=(-1.0, -9.0))
    machine = replace(MACHINE, control=control)
    span = limits[1] - limits[0]
    span = span if np.isfinite(span) else TOLERATED
    assert control.input_range == pytest.approx(span)
    model, prior = pendulum_model(z=2), pendulum_model()
    rest = np.clip([0.0], *limits)
    estimator = make_estimator(model, machine, np.array([1e-3, 1e-2]))
    controller = make_controller(model, prior, control, safe_input=rest)
    assert controller.controller.problem.u_rest == rest
    result = simulate(
        PendulumPlant(), estimator, controller, lambda t: np.tile([0.3, 0.0], (len(t), 1)), dt=0.02,
        duration=1.0, x0=[0.0, 0.0], seed=0, guard=make_resting_guard(model),
        monitor=make_monitor(
            model, resolution=sensor_steps(machine.sensor_sigma), input_range=control.input_range
        ),
    )  # fmt: skip
    assert np.all(np.isfinite(result.x_hat))
    assert result.source.count("MPC") > 0.9 * len(result.source)
    assert np.all((result.u >= limits[0]) & (result.u <= limits[1]))
    used, u = limits_used(control, result, model), model.inputs[0].name
    assert set(used) == {u, f"change of {u}", *(s.name for s in model.states)}
    assert all(np.isfinite(share) for share in used.values())
    # A limit is 1, and the QPs keep them to rounding.
    assert 0 <= used[u] <= 1 + 1e-9
    assert 0 < used[f"change of {u}"] <= 1 + 1e-9
    left = excess(control, result, model)
    assert left[model.inputs[0].label] == 0.0
    assert left[model.states[0].label] == max(0.0, -1.0 - result.x[:, 0].min())
    assert working_point(model, control)[1] == rest


@pytest.fixture(scope="module")
def carts(tmp_path_factory):
    """The scenario of the cart, and its prior as a deployed model."""
    from hybrid_mpc import PriorStep, model_info, trace_model
    from hybrid_mpc.kit.artifact import build_model

    path = tmp_path_factory.mktemp("cart") / "cart.py"
    path.write_text(cart.MACHINE)
    scenario = load_scenario(str(path))
    prior = scenario.prior()
    programs = trace_model(PriorStep(prior, scenario.data.dt).requires_grad_(False))
    return scenario, build_model(
        "prior", {f"prior/{name}": p for name, p in programs.items()}, model_info(prior, scenario.data.dt)
    )


@of_signs(("from zero", "negative"), SIGNS)
def test_a_cart_is_brought_to_what_its_limits_allow(carts, name):
    limits = (FINITE | OPEN)[name]
    scenario, model = carts
    control = OCP(20, (400.0, 1.0), (1e-3,), (0.1,), limits[:1], limits[1:])
    machine = replace(scenario, control=control, sensor_sigma=(1e-4,))
    if limits == OPEN["none"]:
        check_scenario(machine)
    # At rest the spring of 1 N/m holds what pushes: a place of so many metres takes so many newtons.
    for place in (0.7, -0.7):
        result = simulate(
            ModelPlant(model, (1e-4,)), make_estimator(model, machine, np.array([1e-5, 1e-4])),
            make_controller(model, model, control), lambda t, place=place: np.tile([place, 0.0], (len(t), 1)),
            dt=model.dt, duration=14.0, x0=[0.0, 0.0], seed=0,
        )  # fmt: skip
        assert set(result.source) == {"MPC"}
        assert np.all((result.u >= limits[0]) & (result.u <= limits[1]))
        # Against a limit the cart swings out freely, in 2 pi s; 30 mm: and the weight of the input pulls a little.
        assert abs(result.x[-63:, 0].mean() - np.clip(place, *limits)) < 0.03


@pytest.mark.parametrize(
    ("values", "limits", "share"),
    [
        ([0.0, 0.0], (0.0, 5.0), 0.0),
        ([0.0, 2.0], (0.0, 5.0), 0.4),
        ([0.0, -2.0], (-5.0, 0.0), 0.4),
        ([0.0, -1.0], (0.0, 5.0), 1.2),
        ([0.0, 1.0], (-5.0, 0.0), 1.2),
        ([2.0, 3.0], (2.0, 4.0), 0.5),
        ([2.0, 1.0], (2.0, 4.0), 1.5),
        ([2.0, 5.0], (2.0, 4.0), 1.5),
        ([-2.0, -3.0], (-4.0, -2.0), 0.5),
        ([0.0, -0.1], (-0.2, 0.5), 0.5),
        ([0.0, -0.1], (-0.2, INF), 0.5),
        ([0.0, 9.0], (-0.2, INF), 0.0),
        ([0.0, 9.0], (0.0, INF), 0.0),
        ([0.0, -1e-9], (0.0, INF), INF),
        ([7.0, -9.0], (-INF, INF), 0.0),
    ],
)
def test_shares_are_of_the_way_from_rest_to_a_limit(values, limits, share):
    with np.errstate(all="raise"):
        assert share_used(np.array(values)[:, None], limits[:1], limits[1:]) == pytest.approx(share)


@pytest.mark.parametrize("mode", [Mode.REST, Mode.LIMITED, Mode.FALLBACK])
def test_a_guard_keeps_to_limits_beside_zero(mode):
    model = pendulum_model()
    ocp = OCP(10, (30.0, 1.0), [0.05], [0.05], [0.5], [2.0])
    safe = SafeController(CondensedController(model, ocp), model, safe_input=[0.5])
    guard = Guard(mode, limits=Limits([-INF], [1.0]))
    told = Loop(TrueState(model), safe, monitor=ScriptedMonitor([(0, 99)]), guard=guard)
    truth = [0.5, 0.0]
    told.start([0.5], truth=truth)
    for _ in range(4):
        u = told.step([0.5], truth=truth)
        assert told.state.guard.mode is mode
        assert 0.5 <= u <= 1.0


@pytest.mark.parametrize("limits", (FINITE | OPEN).values(), ids=(FINITE | OPEN).keys())
def test_figures_draw_the_limits_that_there_are(limits):
    t, x, u = np.array([0.0, 0.1]), np.zeros((2, 2)), np.full((2, 1), np.clip(0.0, *limits))
    figure = closed_loops(
        "Rest", t, x, {"prior": Motion(t, x, u)}, states=(Signal("q", "m"), Signal("v", "m/s")),
        inputs=(Signal("F", "N"),), limits=(limits[:1], limits[1:]),
    )  # fmt: skip
    drawn = [line.get_ydata()[0] for line in figure.axes[-1].lines if line.get_label() == "input limits"]
    assert drawn == [bound for bound in limits if np.isfinite(bound)]
    assert np.all(np.isfinite(figure.axes[-1].get_ylim()))


def test_a_scenario_whose_limits_cross_ends_before_anything_is_computed(call, tmp_path):
    path = tmp_path / "heater.py"
    path.write_text(
        "from hybrid_mpc import OCP, DataSpec, Scenario\n"
        "data = DataSpec('time_s', ('u',), ('y',), dt=0.1, max_gap=0.5, smoothing=0.1, warm_up=0.5)\n"
        "control = OCP(9, (1.0,), (1.0,), (1.0,), (5.0,), (0.0,))\n"
        "scenario = Scenario('heater', 'Heater', '', prior=lambda values=None: 1 / 0, data=data, control=control)\n"
    )
    code, _, told = call("run", path, "--data", tmp_path / "none.csv", "--out", tmp_path / "out")
    assert code == 2
    assert "heater.py:3" in told
    assert "u_max" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("signal", "inside"),
    [
        ((-INF, INF), (-1.0, 1.0)),
        ((0.0, INF), (0.0, 1.0)),
        ((2.0, INF), (2.0, 3.0)),
        ((-INF, -2.0), (-3.0, -2.0)),
        ((-INF, 0.5), (-1.0, 0.5)),
        ((290.0, 310.0), (290.0, 310.0)),
    ],
)
def test_ranges_that_are_analysed_never_cross(signal, inside):
    one = Signal("T", "K", *signal)
    model = SimpleNamespace(states=(one, one), inputs=(one,), n_x=2, x0=np.zeros(2), u0=np.zeros(1))
    np.testing.assert_array_equal(state_range(model), [inside, inside])
    np.testing.assert_array_equal(input_range(model, None), [inside])
    np.testing.assert_array_equal(state_range(model, None), [inside, inside])


def test_working_ranges_take_each_limit_that_there_is():
    one = Signal("T", "K", -4.0)
    model = SimpleNamespace(states=(one, one), inputs=(one,), n_x=2, x0=np.zeros(2), u0=np.zeros(1))
    control = CONTROL.changed(u_min=(0.0,), u_max=(5.0,), x_min=(2.0, -INF), x_max=None)
    np.testing.assert_array_equal(state_range(model, control), [(2.0, 3.0), (-4.0, 1.0)])
    np.testing.assert_array_equal(input_range(model, control), [(0.0, 5.0)])
    above = control.changed(u_max=(INF,))  # the signal has no upper bound either: what the weights tolerate
    np.testing.assert_allclose(input_range(model, above), [(0.0, TOLERATED / 2)])


def test_a_study_drives_inputs_within_their_ranges():
    given = SimpleNamespace(u_range=np.array([(0.0, 5.0), (-4.0, 0.0), (-1.0, 1.0)]))
    u = driving_input(given, SimpleNamespace(dt=0.02, n_u=3, time_unit=1.0), 30.0)
    np.testing.assert_allclose(u.max(axis=0) - u.min(axis=0), 0.5 * np.array([5.0, 4.0, 2.0]), rtol=0.1)
    np.testing.assert_allclose(u.mean(axis=0), [2.5, -2.0, 0.0], atol=0.05)
    assert np.all((u >= [0.0, -4.0, -1.0]) & (u <= [5.0, 0.0, 1.0]))


def test_a_machine_is_driven_within_its_inputs_range():
    class Lag:
        def __init__(self):
            self.inputs = []

        def reset(self, x0, seed):
            return x0.copy()

        def step(self, state, u, dt):
            self.inputs.append(float(u[0]))
            return a @ state + b @ u

        def measure(self, state, rng):
            return state[1:]

    a, b = np.array([[0.9, 0.0], [0.3, 0.7]]), np.array([[0.1], [0.0]])
    model, plant = linear_model(a, b, [[0.0, 1.0]], dt=0.1), Lag()
    given = SimpleNamespace(
        models={"prior": model}, recordings=(), plant=plant, u_range=np.array([(2.0, 6.0)])
    )
    found = responses_of(given)
    assert (min(plant.inputs), max(plant.inputs)) == pytest.approx((3.0, 5.0), abs=0.2)
    assert found.source.startswith("odd multisine of 1 - around 4 -, ")
    assert found.errors["prior"].largest < 1e-6  # the model is the machine
