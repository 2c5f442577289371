"""From a prior's class to a loop by way of the artifact, on a machine that is no pendulum."""

import casadi as ca
import numpy as np
import pytest
from machines import MachinePlant

import hybrid_mpc as hm
from hybrid_mpc.compare.loops import LoopSpec, excess, limits_used, row_of
from hybrid_mpc.compare.tasks import repeated
from hybrid_mpc.embedded.export import write_controller
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.parts import WatchFile, loop_settings, set_limits
from hybrid_mpc.workflow import monitor as monitor_job

DT = 10.0


class Tanks(hm.Prior):
    """The lower level is measured, and an inflow into the lower tank."""

    states = (hm.Signal("upper", "m", 0.0, 2.0), hm.Signal("lower", "m", 0.0, 2.0))
    inputs = (hm.Signal("pump", "m^3/s", 0.0, 4e-4),)
    outputs = (hm.Signal("lower", "m", 0.0, 2.0),)
    disturbances = (hm.Signal("inflow", "m^3/s"),)
    parameters = (hm.Parameter("k", 5e-4, "m^2.5/s", 1e-4, 1e-3),)
    operating_point = hm.OperatingPoint(x=(0.16, 0.25), u=(2e-4,), w=(5e-5,))

    def xdot(self, x, u, w, p):
        between, out = (p.k * ca.sqrt(ca.fmax(h, 1e-4)) for h in x)
        return (u.pump - between) / 0.02, (between + w.inflow - out) / 0.02


OCP = hm.OCP(12, [0.0, 0.0], [1e4], [1e5], [0.0], [4e-4], q_y=[1.0], y_max=[0.5], preview_w=True)
SCENARIO = hm.Scenario(
    "tanks", "", "", prior=Tanks, control=OCP, sensor_sigma=(1e-3,), safe_input=(5e-5,),
    data=hm.DataSpec("t", ("pump",), ("lower",), dt=DT, max_gap=DT, smoothing=DT, warm_up=DT, disturbances=("inflow",)),
    disturbance_model=(hm.Disturbance("rate", "lower", 5e-3),),
)  # fmt: skip


def saved(folder):
    """The folder with an artifact of the tanks' prior."""
    loop = loop_settings(SCENARIO, dict.fromkeys(("prior", "prior_observer"), (1e-5, 1e-5)))
    programs, info = {"prior": prior_programs(Tanks(), DT)}, hm.model_info(Tanks(), DT)
    hm.save_artifact(folder, programs, info, loop=loop, recommended="prior")
    return folder


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    return hm.load(saved(tmp_path_factory.mktemp("tanks")))


def test_the_artifact_says_all(kit):
    model = kit.models["prior"]
    assert (model.nominal_x, model.nominal_u, model.nominal_w) == ((0.16, 0.25), (2e-4,), (5e-5,))
    assert model.disturbance_model == SCENARIO.disturbance_model
    assert kit.control == OCP
    assert kit.safe_input == (5e-5,)
    np.testing.assert_allclose(
        model.step(model.x0, [], model.u0, model.w, model.p)[0].full().ravel(), model.x0
    )
    other = kit.on(hm.Scenario("tanks", "", "", prior=Tanks, data=SCENARIO.data, control=OCP))
    assert other.models["prior"].disturbance_model is None


def test_a_loop_from_the_kit_is_without_offset(kit):
    model = kit.models["prior"]
    w = lambda t: np.where(t < 300.0, 5e-5, 9e-5)[:, None]  # noqa: E731
    plant = MachinePlant(
        kit.on(hm.Scenario("tanks", "", "", prior=Tanks, data=SCENARIO.data)).models["prior"], load=1e-5
    )
    result = hm.simulate(
        plant, kit.observer(), kit.controller(), [0.4], dt=DT, duration=1500.0, x0=model.x0, seed=0, w=w
    )
    assert result.source == ("MPC",) * 150
    np.testing.assert_allclose(result.y[-10:], 0.4, atol=1e-4)
    assert np.max(result.y) < 0.51
    assert np.all(result.reached)
    spec = LoopSpec("tanks", "model", "hold", "prior_observer", monitor="none")
    task = hm.Task("hold", "", 1500.0, (0.16, 0.25), lambda t: np.full((len(t), 1), 0.4), w=w)
    row = row_of(spec, task, OCP, model, result)
    assert list(row.tracking_rmse) == ["lower [m]"]
    used = limits_used(OCP, result, model)
    assert set(used) == {"pump", "output lower"}
    assert used["pump"] == pytest.approx(
        max((result.u.max() - 2e-4) / 2e-4, (2e-4 - result.u.min()) / 2e-4)
    )  # counted from the operating point's input
    assert excess(OCP, result, model)["pump [m^3/s]"] == 0.0
    table = result.to_pandas(model)
    assert {"d rate lower", "w inflow [m^3/s]", "y_ref lower [m]"} <= set(table)


@pytest.mark.parametrize(
    ("kind", "own"),
    [("ekf", hm.ExtendedKalmanFilter), ("ukf", hm.UnscentedKalmanFilter), ("mhe", hm.MovingHorizonEstimator)],
)
def test_a_loop_with_another_kind_of_observer_is_without_offset(kit, kind, own):
    model, observer = kit.models["prior"], kit.observer(kind=kind)
    assert type(observer) is own
    plant = MachinePlant(model, load=1e-5)
    result = hm.simulate(
        plant, observer, kit.controller(), [0.4], dt=DT, duration=1500.0, x0=model.x0, seed=0
    )
    assert result.source == ("MPC",) * 150
    np.testing.assert_allclose(result.y[-10:], 0.4, atol=1e-3)


def test_other_kinds_of_observers_have_no_c(kit, tmp_path):
    with pytest.raises(hm.InputError, match=r"MovingHorizonEstimator.*HM-EMBEDDED-011"):
        write_controller(tmp_path / "c", kit.models["prior"], OCP, estimator=kit.observer(kind="mhe"))
    with pytest.raises(hm.InputError, match=r"did you mean 'mhe'.*HM-RECORDS-011"):
        kit.observer(kind="mhes")


def test_a_problem_whose_outputs_no_input_holds_is_refused(kit):
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    names = (hm.Signal("a", "-"), hm.Signal("b", "-"))
    apart = hm.HybridModel.of(
        "apart", 1.0, names, (hm.Signal("u", "-"),), names[1:], x=x, u=u, xdot=-x, y=x[1],
        x_next=ca.vertcat(0.5 * x[0] + u, 0.5 * x[1]),
    )  # fmt: skip
    with pytest.raises(hm.InputError, match=r"operating_point = .*HM-KIT-017"):
        hm.make_controller(apart, apart, hm.OCP(5, [0.0, 0.0], [1.0], [0.0], [-1.0], [1.0], q_y=[1.0]))


def test_the_working_point_is_the_operating_point_unless_positions_move(kit):
    ocp = hm.make_ocp(kit.models["prior"], OCP)
    np.testing.assert_array_equal(ocp.working_point[0], [0.16, 0.25])
    np.testing.assert_array_equal(ocp.working_point[1], [2e-4])


def test_a_task_of_outputs_is_repeated_without_speeds():
    ramp = hm.Task(
        "ramp", "", 100.0, (0.16, 0.25), lambda t: 0.2 + 0.001 * t[:, None], w=lambda t: 1e-5 * t[:, None]
    )
    twice = repeated(ramp, DT, np.array([1.0, 0.5]), 60.0)
    np.testing.assert_allclose(
        twice.reference(np.array([0.0, 50.0, 160.0, 210.0]))[:, 0], [0.2, 0.25, 0.2, 0.225]
    )
    way_back = twice.reference(np.linspace(100.0, 160.0, 7))[:, 0]
    assert np.all(np.diff(way_back) < 0)
    np.testing.assert_allclose(twice.w(np.array([50.0, 210.0, 140.0]))[:, 0], [5e-4, 5e-4, 1e-3])


NUMBERS = {
    "lower": ("m", (2e-3, 1e-3), (1e-3, 5e-4)), "inflow": ("m^3/s", (2e-5, 2e-5), (1e-5, 1e-5)),
    "free run of lower": ("m", (4e-3, 3e-3), (2e-3, 1.5e-3)),
}  # fmt: skip
LIMITS = hm.WatchLimits(
    "residuals",
    DT,
    tuple(
        hm.ChannelLimit(name, unit, length, top, end)
        for name, (unit, tops, ends) in NUMBERS.items()
        for length, top, end in zip((3, 30), tops, ends, strict=True)
    ),
    (5e-3,),
    (2,),
    1.0,
    1.0,
    time_unit=1.0,
)


def test_limits_of_residuals_are_kept_and_make_the_monitor(kit, tmp_path):
    saved(tmp_path)
    with pytest.raises(hm.InputError, match=r"'hybrid'.*prior.*HM-KIT-034"):
        set_limits(tmp_path, {"hybrid": [LIMITS]})
    set_limits(tmp_path, {"prior": [LIMITS]})
    learned = hm.load(tmp_path)
    assert learned.watch == {"prior": WatchFile({"residuals": LIMITS})}
    for kind in ("", "guard", "residuals"):
        assert learned.monitor(kind=kind).limits == LIMITS
    assert learned.monitor(kind="own").limits is None
    for kind in ("", "guard", "residuals"):  # nothing was learned
        with pytest.raises(hm.InputError, match=r"residuals.*HM-KIT-010"):
            kit.monitor(kind=kind)
    assert kit.monitor(kind="own").limits is None
    with pytest.raises(hm.InputError, match=r"energy.*HM-KIT-010"):
        learned.monitor(kind="energy")


def test_a_guard_listens_to_residuals_in_a_loop(kit):
    """A level sensor that is off by 0.1 m from 300 s on: the alarm names it, and the guard goes over to rest."""
    model = kit.models["prior"]
    monitor = hm.make_monitor(model, LIMITS)
    fault = hm.Fault(300.0, np.inf, "measurement_offset", 0.1, "lower")
    result = hm.simulate(
        MachinePlant(model), kit.observer(), kit.controller(), [0.3], dt=DT, duration=600.0, x0=model.x0, seed=0,
        monitor=monitor, guard=hm.Guard(hm.Mode.REST, dwell=50.0, quiet=100.0), faults=(fault,),
    )  # fmt: skip
    assert not result.alarm[result.t < 300.0].any()
    assert result.alarm[30]
    (first, *_) = result.switches
    assert (first.t, first.after.name) == (310.0, "REST")
    assert first.why.startswith("the model does not describe the machine: lower")
    np.testing.assert_array_equal(result.u[31:40], 5e-5)


def test_recordings_are_watched_by_their_channels(kit, tmp_path):
    """The command's way: learn from one recording, watch another whose sensor is off, read what it says."""
    model, rng = kit.models["prior"], np.random.default_rng(3)
    for name, off in (("calm", 0.0), ("off", 0.05)):
        plant, x, u, rows = MachinePlant(model, sigma=1e-3), model.x0, 2e-4, []
        for k in range(300):
            if k % 15 == 0:
                u = float(rng.uniform(1e-4, 3e-4))
            y = float(plant.measure(x, rng)[0]) + (off if k >= 200 else 0.0)
            w = 5e-5 + 1e-6 * rng.normal()
            rows.append((DT * k, u, y, w))
            x = plant.step(x, np.array([u]), DT, np.array([w]))
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header="t,pump,lower,inflow", comments="")
    folder = saved(tmp_path / "model")
    job = monitor_job.prepared(SCENARIO, folder, [tmp_path / "calm.csv"])
    limits = monitor_job.learn(job, 1.0, tmp_path)
    job = monitor_job.prepared(
        SCENARIO, folder, [tmp_path / "off.csv"], calibration=tmp_path / "calibration.json"
    )
    assert job.limits == limits
    out = tmp_path / "out"
    out.mkdir()
    (row,) = monitor_job.watch(job, out).recordings
    (first, *_) = row.alarms
    assert 2000.0 <= first.start_s <= 2000.0 + 3 * DT
    assert "lower" in first.channels
    assert "of lower" in first.diagnosis
    text = (out / "off.csv").read_text().splitlines()
    assert len(text) == 1 + len(job.data.whole[0].t)
    assert "free_run_of_lower_mean_3_m" in text[0]
    assert (out / "off.png").is_file()
    with pytest.raises(hm.InputError, match=r"energy.*HM-WORKFLOW-026"):
        monitor_job.read_limits(tmp_path / "calibration.json", "energy")
