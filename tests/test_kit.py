"""What a run leaves for controllers: everything in one folder, and nothing else is read."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc import (
    CondensedController,
    ExtendedKalmanFilter,
    Fault,
    LoopSettings,
    Mode,
    SoftBound,
    SwitchingFilter,
    load_scenario,
    make_controller,
    make_estimator,
    set_limits,
    set_process_noise,
    simulate,
)
from hybrid_mpc.kit.assembly import SOLVERS, first_deviations
from hybrid_mpc.kit.parts import loop_settings, read_description, read_parts, save_loop

README = Path(__file__).parents[1] / "README.md"
GOLF = load_scenario("golf_robot")
NOISE = {name: [1e-4, 1e-2] for name in ("prior", "prior_observer", "hybrid", "hybrid_observer")}
FORCE = hm.ChannelLimit("force of phi", "N m", 0, 4.0, 2.0, (1e-4, 1e-4, 0.0, 1e-4), 2.0)
LIMITS = hm.WatchLimits("energy", 0.02, (FORCE,), (0.01,), (0,), 1.0, 0.1, "by hand", rest_speed=(0.2,))


@pytest.fixture(scope="module")
def run(golf_artifact, tmp_path_factory):
    """The folder of a run, as far as loops read it."""
    folder = tmp_path_factory.mktemp("run")
    model = shutil.copytree(golf_artifact, folder / "model")
    save_loop(model, loop_settings(GOLF))
    set_process_noise(model, NOISE)
    set_limits(model, {"hybrid": [LIMITS]})
    return folder


def closed(estimator, controller, **options):
    task = GOLF.tasks[0]
    return simulate(
        GOLF.plant(), estimator, controller, task.reference, dt=0.02, duration=1.0, x0=np.array(task.x0),
        seed=3, **options,
    )  # fmt: skip


def test_loops_of_the_folder_are_those_of_the_scenario(run):
    kit = hm.load(str(run))
    models = kit.models
    want = closed(
        make_estimator(models["hybrid"], GOLF, np.array(NOISE["hybrid_observer"])),
        make_controller(models["hybrid"], models["prior"], GOLF.control),
    )
    found = closed(kit.observer(), kit.controller())
    np.testing.assert_array_equal(found.u, want.u)
    np.testing.assert_array_equal(found.d, want.d)


def test_every_part_is_made_from_the_folder(run, tmp_path):
    """The folder alone, elsewhere: no checkpoint beside it, no scenario."""
    kit = hm.load(shutil.copytree(run / "model", tmp_path / "elsewhere"))
    assert isinstance(kit.observer(), SwitchingFilter)
    assert isinstance(kit.observer("prior", load=False), ExtendedKalmanFilter)
    assert kit.controller("prior").controller.model.n_h == 0
    assert kit.monitor().limits == LIMITS
    assert kit.guard(adapt=True).on_model is Mode.BACKUP
    assert (kit.name, kit.causes) == ("", GOLF.causes)
    assert kit.safe_input == (0.0,)
    assert kit.on(replace(GOLF, safe_input=None)).controller().safe_input is None
    np.testing.assert_array_equal(kit.controller().safe_input, [0.0])
    limited = next(task for task in GOLF.tasks if task.control is not None)
    assert kit.problem(limited.name) == limited.control
    plain = next(task for task in GOLF.tasks if task.control is None)
    assert kit.problem(plain.name) == GOLF.control
    assert kit.controller(task=limited.name).controller.ocp.u_max == limited.control.u_max


def test_a_monitor_that_cannot_alarm_is_refused(run):
    kit = hm.load(run)
    assert kit.monitor().limits == kit.limits() == LIMITS
    assert kit.monitor(kind="own").limits is None
    for kind in ("", "energy", "guard", "residuals"):
        with pytest.raises(hm.InputError, match="HM-KIT-010"):
            replace(kit, watch={}).monitor(kind=kind)
    with pytest.raises(hm.InputError, match=r"residuals.*hybrid.*HM-KIT-010"):
        kit.monitor(kind="residuals")
    replace(kit, watch={}).monitor(kind="own")


def test_a_kit_is_printed_short(run):
    text = repr(hm.load(run))
    assert "<models prior, hybrid>" in text or "<models hybrid, prior>" in text
    assert len(text) < 2000  # the signals of two models take 1,000 characters, one program some 10,000


def test_the_safe_input_is_the_scenario_s(run):
    kit = hm.load(run)
    other = kit.on(replace(GOLF, safe_input=(0.1,)))
    result = closed(
        other.observer(), other.controller(), monitor=other.monitor(), guard=other.guard(),
        faults=[Fault(0.4, 0.8, "measurement_freeze")],
    )  # fmt: skip
    first = round(result.switches[0].t / result.dt)
    assert result.switches[0].after is Mode.REST
    # the limit of the change lets it be reached in a few periods
    assert 0.1 in np.round(result.u[first : first + 10, 0], 9)
    assert hm.Loop(other.observer(), other.controller()).safe_input.tolist() == [0.1]
    for wrong, words in (
        ((9.0,), "HM-KIT-029"),
        ((0.0, 0.0), "HM-KIT-029"),
        ((np.nan,), "finite"),
    ):
        with pytest.raises(hm.InputError, match=words):
            kit.on(replace(GOLF, safe_input=wrong))


@pytest.mark.parametrize(
    ("solver", "kind"),
    [("rti", "CondensedController"), ("sqp", "SQPController"), ("ipopt", "IpoptController")],
)
def test_the_solver_is_the_one_asked_for(run, solver, kind):
    assert type(hm.load(run).controller(solver=solver).controller).__name__ == kind


@pytest.mark.parametrize("solver", ["rti", "sqp", "ipopt", "native"])
def test_iterations_count_or_are_refused(run, solver):
    """None of the solvers ignores them: 0 is refused where they count, any number where they do not."""
    with pytest.raises(hm.InputError, match="HM-KIT-018" if solver == "native" else "iterations"):
        hm.load(run).controller(solver=solver, iterations=0)


def test_a_solver_more_is_a_line_in_the_table(run, monkeypatch):
    """A real-time iteration by another name: split into its two parts, its first plan another's."""
    monkeypatch.setitem(SOLVERS, "mine", CondensedController)
    kit = hm.load(run)
    mine, rti = (closed(kit.observer(), kit.controller(solver=name)) for name in ("mine", "rti"))
    np.testing.assert_array_equal(mine.u, rti.u)
    assert mine.timing_ms["prepare"][1:].min() > 0


def test_the_first_speed_is_as_uncertain_as_two_readings_a_period_apart(run):
    kit = hm.load(run)
    sigma, dt = GOLF.sensor_sigma[0], kit.models["prior"].dt
    want = [sigma, np.sqrt(2) * sigma / dt]
    found = first_deviations(kit.models["prior"], replace(GOLF, first_sigma=None))
    np.testing.assert_allclose(found, want, rtol=1e-15)


def test_a_scenario_s_problem_is_taken_as_it_now_is(run):
    kit = hm.load(run).on(replace(GOLF, control=GOLF.control.changed(horizon=7), sensor_sigma=(2e-3,)))
    assert kit.controller().controller.ocp.horizon == 7
    assert kit.sensor_sigma == (2e-3,)
    np.testing.assert_array_equal(kit.noise("hybrid"), NOISE["hybrid"])  # learned, so the model's


def test_the_lines_of_the_readme(run, monkeypatch):
    """They are run as they stand, around the simulated machine."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.S)
    lines = next(b for b in blocks if "hm.load(" in b and "loop.step(" in b)
    plant, rng = GOLF.plant(), np.random.default_rng(0)
    machine = {"state": plant.reset(np.zeros(2), 0), "left": 150, "u": np.zeros(1)}

    def wait():
        machine["state"] = plant.step(machine["state"], machine["u"], 0.02)

    def running():
        machine["left"] -= 1
        return machine["left"] >= 0

    monkeypatch.chdir(run.parent)
    names = {
        "read": lambda: plant.measure(machine["state"], rng), "write": lambda u: machine.update(u=u), "wait": wait,
        "running": running, "goal": [0.5, 0.0],
    }  # fmt: skip
    exec(lines.replace('"runs/mine"', repr(run.name)), names)
    assert names["loop"].state.k == 150
    # 3 s of a step to 0.5 rad with a random network: within a tenth of it
    assert plant.truth(machine["state"])[0] == pytest.approx(0.5, abs=0.05)


def test_expressions_go_along(run, tmp_path):
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    power = SoftBound(ca.Function("power", [x, u], [u * x[1]]), [-1.0], [1.0], [10.0], [10.0])
    price = ca.Function("price", [x, u], [ca.tanh(u * x[1]) ** 2])
    model = shutil.copytree(run / "model", tmp_path / "model")
    problem = GOLF.control.changed(soft=(power,), economic=price)
    save_loop(model, replace(read_parts(model).loop, control={"": problem}))
    assert hm.load(model).problem() == problem


@pytest.mark.parametrize(
    ("change", "use", "told"),
    [
        ({"control": {}}, lambda kit: kit.controller(), "HM-KIT-007"),
        ({"process_noise": {}}, lambda kit: kit.observer(), r"hybrid_observer.*HM-KIT-008"),
        (
            {"process_noise": {}},
            lambda kit: kit.guard(adapt=True),
            r"hybrid_observer.*HM-KIT-008",
        ),
        ({"causes": {}}, lambda kit: kit.guard(adapt=True), "HM-KIT-020"),
        ({}, lambda kit: kit.observer("hybird"), r"did you mean 'hybrid'.*HM-RECORDS-011"),
        (
            {},
            lambda kit: kit.problem("track_sin"),
            r"task.*'track_sin'.*'track_sine'.*HM-RECORDS-011",
        ),
        ({}, lambda kit: kit.controller(task="mistyped"), r"task.*'mistyped'.*HM-RECORDS-011"),
        (
            {"tasks": (), "control": {}},
            lambda kit: kit.guard(adapt=True, task="any"),
            r"none.*HM-RECORDS-011",
        ),
        ({"sensor_sigma": (1.0, 1.0)}, lambda kit: kit.observer(), "HM-KIT-014"),
    ],
)
def test_what_is_missing_is_named(run, tmp_path, change, use, told):
    model = shutil.copytree(run / "model", tmp_path / "model")
    save_loop(model, replace(read_parts(model).loop, **change))
    with pytest.raises(hm.InputError, match=told):
        use(hm.load(model))


def test_impossible_settings_and_models_are_refused(run):
    with pytest.raises(hm.InputError, match=r"process_noise.*HM-RECORDS-007"):
        LoopSettings(process_noise={"prior": (-1.0,)})
    with pytest.raises(hm.InputError, match="HM-KIT-038"):
        hm.load("nowhere")
    info = read_description(run / "model").model
    for change in ({"dt": 0.0}, {"dt": np.inf}, {"time_unit": -1.0}, {"input_delay": -0.1}):
        with pytest.raises(hm.InputError, match=next(iter(change))):
            replace(info, **change)


def test_parts_of_two_models_are_refused_before_the_loop_begins(run):
    kit = hm.load(run)
    with pytest.raises(hm.InputError, match=r"hybrid.*HM-LOOP-027"):
        hm.Loop(kit.observer("prior"), kit.controller("prior"), monitor=kit.monitor())
    hm.Loop(kit.observer("prior"), kit.controller("prior"), monitor=kit.monitor("prior", kind="own"))
    with pytest.raises(hm.InputError, match=r"energy.*prior.*HM-KIT-010"):
        kit.monitor("prior")


def test_a_state_of_other_parts_is_refused(run):
    kit = hm.load(run)
    mine, prior = (hm.Loop(kit.observer(name), kit.controller(name)) for name in ("hybrid", "prior"))
    mine.start([0.0])
    prior.start([0.0])
    with pytest.raises(hm.InputError, match=r"hidden state has 0 numbers.* 8.*HM-LOOP-030"):
        mine.restore(prior.state)
    with pytest.raises(hm.InputError, match=r"no.*HM-LOOP-029"):
        hm.Loop(kit.observer(), kit.controller(), monitor=kit.monitor()).restore(mine.state)
    with pytest.raises(hm.InputError, match=r"NoneType.*HM-LOOP-028"):
        mine.restore(None)
    assert mine.restore(mine.state) == mine.decision.u


NO_NAME = [np.nan, 3, b"x", {}, [], object(), np.zeros(5), 10**400]


def test_a_kit_refuses_what_is_no_name_no_flag_and_no_folder(run):
    kit = hm.load(run)
    for value in NO_NAME:
        for call in (
            lambda v=value: hm.load(v), lambda v=value: kit.problem(v), lambda v=value: kit.noise(v),
            lambda v=value: kit.observer(v), lambda v=value: kit.observer(task=v), lambda v=value: kit.observer(load=v),
            lambda v=value: kit.controller(v), lambda v=value: kit.controller(task=v),
            lambda v=value: kit.controller(solver=v), lambda v=value: kit.monitor(v),
            lambda v=value: kit.monitor(kind=v), lambda v=value: kit.diagnoser(v),
            lambda v=value: kit.guard(adapt=v), lambda v=value: kit.on(v),
        ):  # fmt: skip
            with pytest.raises(hm.InputError):
                call()
