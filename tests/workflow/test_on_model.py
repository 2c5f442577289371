"""A machine without plant and tasks: loops on a trained model in its place, labelled so everywhere."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from hybrid_mpc import OCP, Bench, InputError, LoopSpec, OperatingPoint, Prior, Signal, load, load_scenario
from hybrid_mpc.check.default_tasks import default_tasks
from hybrid_mpc.compare.loops import DRAWN_PRIOR, drawn_prior, moves_otherwise, stand_in
from hybrid_mpc.loop.plant import ModelPlant
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.workflow.control import read_control
from hybrid_mpc.workflow.stages.results import read_results
from scenarios.simulated import cart_pole, two_heaters, two_tanks

LABEL = "on the model, not the machine"


@pytest.fixture(scope="module")
def kit(bare_tanks):
    return load(bare_tanks / "run")


@pytest.mark.full
def test_every_task_runs_on_another_model_than_the_controller_s(bare_tanks):
    found = read_results(bare_tanks / "run" / "results.json")
    loops = found.on_model
    assert loops.plants == {"prior_observer": "hybrid", "hybrid_observer": "hybrid_1"}
    assert loops.default_tasks is True
    assert set(loops.means) == {"step", "hold"}
    for cells in loops.means.values():
        assert set(cells) == set(loops.plants)
        for cell in cells.values():
            assert cell.sources["MPC"] == 1.0
            # within the sensor's noise (1 mm) or a tenth of the step (0.1 m), which takes a while
            assert cell.tracking_rmse["lower [m]"].mean < 0.02
    # what compares prior and hybrid knows nothing of them
    assert found.control.rows == ()
    assert "no plant" in found.control.reason


def test_report_terminal_and_figures_say_that_it_is_no_machine(bare_tanks):
    page = re.sub(r"<img[^>]*>", "", (bare_tanks / "run" / "report.html").read_text())
    section = re.search(r"Closed loops on the model, not the machine</h2>(.*?)<h2", page, re.DOTALL)[1]
    tables = re.findall(r'<p class="caption">.*?</table>', section, re.DOTALL)
    assert len(tables) == 2
    assert all(("hybrid_1" in table) != ("on the model hybrid in" in table) for table in tables)
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", section, re.DOTALL)
    assert len(captions) == 4  # a figure a task and controller
    assert all(LABEL in caption for caption in captions)
    told = (bare_tanks / "told.txt").read_text()
    assert "prior_observer on the model hybrid, not the machine: cost of step" in told
    assert "hybrid_observer on the model hybrid_1, not the machine" in told


@pytest.mark.full
def test_control_does_the_same_from_the_artifact(call, bare_tanks, tmp_path):
    words = ("--model", bare_tanks / "run", "--task", "hold", "--seeds", 1, "--out", tmp_path / "loops")
    code, told, error = call("control", bare_tanks / "tanks.py", *words)
    assert code == 0, error
    found = read_control(tmp_path / "loops" / "results.json")
    assert found.loops.plants == {"prior_observer": "hybrid", "hybrid_observer": "hybrid_1"}
    names = {path.name for path in (tmp_path / "loops" / "figures").glob("hold*.png")}
    assert names == {"hold_prior_observer.png", "hold_hybrid_observer.png"}
    first, second = told.index("prior_observer on the model hybrid,"), told.index("on the model hybrid_1,")
    block = told[first:second]
    assert "hybrid_observer " not in block.partition("machine:")[2].partition("step time of")[0]


def test_a_study_which_compares_wants_a_plant(call, bare_tanks, tmp_path):
    (tmp_path / "s.yaml").write_text(f"scenario: two_tanks\nmodels: {bare_tanks / 'run'}\nseeds: 1\n")
    words = (
        "study",
        "run",
        tmp_path / "s.yaml",
        "--scenario",
        bare_tanks / "tanks.py",
        "--out",
        tmp_path / "o",
    )
    code, _, error = call(*words)
    assert code == 2
    assert "HM-COMPARE-015" in error


def test_check_names_the_default_tasks(call, bare_tanks):
    code, told, _ = call("check", bare_tanks / "tanks.py")
    assert code == 0
    assert "none given; default tasks: A step of lower by 0.1 m" in told
    assert "without a plant" in told


def test_without_another_network_the_hybrid_s_controller_has_another_prior(bare_tanks, kit):
    alone = replace(kit, members={})
    assert stand_in(alone, "hybrid_observer").model.name == DRAWN_PRIOR
    assert stand_in(alone, "prior_observer").model.name == "hybrid"
    with pytest.raises(InputError, match="HM-COMPARE-012"):
        stand_in(kit, "oracle")
    bench = Bench(load_scenario(str(bare_tanks / "tanks.py")), {"m": alone})
    spec = LoopSpec(str(bare_tanks / "tanks.py"), "m", "hold", "hybrid_observer", duration=20.0)
    assert bench.plant(spec).model.name == DRAWN_PRIOR


def test_members_are_networks_of_their_own(kit):
    hybrid, others = kit.models["hybrid"], [*kit.members.values()]
    assert [m.name for m in others] == ["hybrid_1", "hybrid_2"]
    assert {m.n_h for m in others} == {hybrid.n_h // 2}  # the hybrid holds both
    x, u, w, p = hybrid.x0 + 0.05, hybrid.u0 * 1.2, hybrid.w, hybrid.p
    own, first, second = (m.xdot(x, np.full(m.n_h, 0.1), u, w, p).full() for m in (hybrid, *others))
    assert np.abs(first - second).max() > 1e-6 * np.abs(first).max()
    share = (own - second) / (first - second)  # the same for all: a mean
    corrected = np.abs(first - second) > 1e-6 * np.abs(first).max()
    assert np.ptp(share[corrected]) < 1e-9
    assert 0 < share[corrected][0] < 1
    assert {float(m.output(x, u, w, p)) for m in (hybrid, *others)} == {float(hybrid.output(x, u, w, p))}


def test_a_model_as_plant_steps_as_the_model_does(kit):
    model = kit.models["hybrid"]
    plant = ModelPlant(model, (0.0,))
    state = plant.reset(model.x0, 0)
    assert np.array_equal(state.h, hidden_fixed_point(model, model.x0, model.u0))
    x, h = model.x0, state.h
    for k in range(3):
        u, w = model.u0 * (1 + 0.1 * k), model.w * (1 - 0.2 * k)
        state = plant.step(state, u, model.dt, w)
        x, h = (v.full().ravel() for v in model.step(x, h, u, w, model.p))
    assert np.array_equal(plant.truth(state), x)
    noisy = replace(plant, sigma=(0.01,))
    measured = np.array([noisy.measure(state, np.random.default_rng(i))[0] for i in range(400)])
    assert np.std(measured - plant.measure(state, np.random.default_rng(0))[0]) == pytest.approx(
        0.01, rel=0.15
    )  # four deviations of the standard deviation of 400 draws


@pytest.mark.parametrize("machine", [cart_pole, two_heaters, two_tanks], ids=lambda m: m.scenario.name)
def test_default_tasks_are_points_of_rest_within_the_limits(machine):
    scenario = machine.scenario
    step, hold = default_tasks(replace(scenario, tasks=()))
    prior, control = scenario.prior(), scenario.control
    t = np.arange(0.0, step.duration, scenario.data.dt)
    rows = np.unique(step.reference(t).round(9), axis=0)
    assert len(rows) == 1 + min(np.count_nonzero(control.q_y), len(prior.inputs))
    point = prior.operating_point
    x0, u0 = (
        (np.zeros(len(prior.states)), np.zeros(1))
        if point is None
        else (np.array(point.x), np.array(point.u))
    )
    assert np.array_equal(step.x0, x0)
    (push,) = hold.faults
    room = max(control.u_max[0] - u0[0], u0[0] - control.u_min[0])
    assert abs(push.value) == pytest.approx(0.2 * room)
    assert np.ptp(hold.reference(t), axis=0).max() == 0.0
    for signal, column in zip(prior.outputs, rows.T, strict=True):
        assert signal.lower <= column.min()
        assert column.max() <= signal.upper


def test_default_tasks_start_where_the_fitted_prior_rests():
    """The upper level that holds the lower one depends on what was fitted; the measured level is the user's."""
    scenario = replace(two_tanks.scenario, plant=None, tasks=())
    nominal = scenario.prior()
    fitted = {
        name: 1.15 * value if name.startswith("pipe_upper") else value
        for name, value in nominal.values.items()
    }
    prior = scenario.prior(fitted)
    point = prior.operating_point
    moving = prior.equations.xdot(point.x, point.u, point.w, prior.p).full().ravel()
    assert np.abs(moving * scenario.control.horizon * scenario.data.dt).max() > 0.01
    for task, own in zip(default_tasks(scenario, fitted), default_tasks(scenario), strict=True):
        assert np.array_equal(own.x0, point.x)
        first = task.reference(np.zeros(1))[0]
        np.testing.assert_allclose(first, own.reference(np.zeros(1))[0], rtol=1e-6)  # the same set-point
        # some input rests there: the rates that no input moves are zero
        u = minimize_scalar(
            lambda u, x=task.x0: np.sum(prior.equations.xdot(x, [u], point.w, prior.p).full() ** 2),
            bounds=(0.0, 10 * point.u[0]), options={"xatol": 1e-16},
        )  # fmt: skip
        assert np.sqrt(u.fun) < 1e-3 * np.abs(moving).max()


def test_a_prior_that_does_not_rest_gets_no_default_tasks():
    class Moving(two_tanks.TwoTanksPrior):
        operating_point = OperatingPoint(x=(0.5, 0.1), u=(1e-4,), w=(0.0,))

    scenario = replace(two_tanks.scenario, prior=Moving, plant=None, tasks=())
    with pytest.raises(InputError, match=r"upper, lower.*HM-CHECK-007"):
        default_tasks(scenario)


def test_where_the_networks_correct_nothing_no_controller_meets_its_own_model(kit):
    prior = kit.models["prior"]
    null = {"prior": prior, "hybrid": replace(prior, name="hybrid")}
    alike = replace(kit, models=null, members={"hybrid_1": replace(prior, name="hybrid_1")})
    for name in ("prior_observer", "hybrid_observer"):
        plant = stand_in(alike, name).model
        assert plant.name == DRAWN_PRIOR
        assert moves_otherwise(prior, plant)
        assert np.array_equal(plant.p, stand_in(alike, name).model.p)
    certain = {
        name: replace(model, covariance=tuple((0.0,) * prior.n_p for _ in range(prior.n_p)))
        for name, model in null.items()
    }
    for models in (certain, {name: replace(model, covariance=()) for name, model in certain.items()}):
        for name in ("prior_observer", "hybrid_observer"):
            with pytest.raises(InputError, match="HM-COMPARE-014"):
                stand_in(replace(alike, models=models), name)


def test_drawn_parameters_scatter_as_their_covariance_says_and_keep_their_bounds(kit, monkeypatch):
    prior = kit.models["prior"]
    wide = tuple(replace(p, lower=-np.inf, upper=np.inf) for p in prior.parameters)
    covariance = np.array(prior.covariance)
    free = replace(prior, parameters=wide)
    draws = []
    generator = np.random.default_rng
    for seed in range(400):
        monkeypatch.setattr(np.random, "default_rng", lambda _, seed=seed: generator(seed))
        draws.append(drawn_prior(free).p)
        kept = drawn_prior(prior)
        assert all(p.lower <= p.value <= p.upper for p in kept.parameters)
    found, size = np.cov(np.array(draws).T), np.sqrt(np.diag(covariance))
    scale = np.where(size > 0, size, 1.0)
    # four deviations of a correlation of 400 draws
    np.testing.assert_allclose(found / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.3)


class Room(Prior):
    """A room that is as warm as outside while heater and vent are off."""

    states = outputs = (Signal("T", "degC", -5, 45),)
    inputs = (Signal("heater", "%", 0, 100), Signal("vent", "%", 0, 100))
    operating_point = OperatingPoint(x=(15,), u=(0, 0))

    def xdot(self, x, u, w, p):
        return ((0.12 * u.heater - (0.5 + 0.01 * u.vent) * (x.T - 15)) / 1000,)


@pytest.mark.parametrize("u_max", [100, 1e-6])
def test_a_default_step_moves_inputs_away_from_their_limits(u_max):
    ocp = OCP(20, [0.0], [1e-5, 1e-2], [2.5e-3, 2.5e-3], [0, 0], [u_max, 100], q_y=[4.0])
    scenario = replace(two_heaters.scenario, name="room", prior=Room, control=ocp, tasks=())
    if u_max > 1:
        assert default_tasks(scenario)[0].title == "A step of T by 5 degC (default task)"
    else:
        with pytest.raises(InputError, match=r"inputs at a limit: heater, vent.*HM-CHECK-008"):
            default_tasks(scenario)
