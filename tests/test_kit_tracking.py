"""A kit that names tracked parameters: its files, its observer and controller in a loop and as C."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from test_kit_any_machine import DT, OCP, SCENARIO, Tanks, saved

import hybrid_mpc as hm
from hybrid_mpc.embedded.export import write_controller
from hybrid_mpc.estimate.tracking import DAY, TrackedParameter
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.kit.parts import WatchFile, save_loop

LIMITS = hm.WatchLimits(
    "residuals", DT, (hm.ChannelLimit("lower", "m", 1, 2e-3, 1e-3),), (np.inf,), (0,),
    time_unit=1.0,
)  # fmt: skip
TRACKED = (TrackedParameter("k", 0.2, relative=True),)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("tanks"))


@pytest.fixture(scope="module")
def kit(folder):
    own = hm.load(folder)
    save_loop(folder, own.with_tracked(TRACKED).loop)
    return hm.load(folder)


def test_observer_json_names_the_tracked_parameters(folder, kit):
    assert kit.loop.tracked == TRACKED
    written = json.loads((folder / "observer.json").read_text(encoding="utf-8"))
    assert written["tracked"] == [{"name": "k", "relative": True, "std": 0.2, "time": DAY}]
    assert kit.on(SCENARIO).loop.tracked == TRACKED


def test_promises_depend_on_the_tracked_parameters(kit):
    assert kit.with_tracked(()).identity != kit.identity
    assert kit.with_tracked([replace(TRACKED[0], time=3600.0)]).identity != kit.identity
    assert kit.with_tracked(TRACKED).identity == kit.identity


def test_a_kit_without_tracked_parameters_says_so(kit):
    for ask in (
        kit.with_tracked(()).tracking_observer,
        lambda: kit.with_tracked(()).controller(tracking=True),
    ):
        with pytest.raises(hm.InputError, match="HM-KIT-040"):
            ask()


def test_a_tracking_loop_finds_the_outlet_and_has_no_offset(kit):
    model = kit.models["prior"]
    observer, controller = kit.tracking_observer(), kit.controller(tracking=True)
    assert observer.model.n_w == controller.controller.model.n_w == 2
    prior = Tanks({"k": 6.5e-4})
    programs = {f"prior/{name}": p for name, p in prior_programs(prior, DT).items()}
    plant = build_model("prior", programs, hm.model_info(prior, DT))
    loop = hm.Loop(observer, controller, reference=[0.4])
    x = model.x0
    rng, heights = np.random.default_rng(0), []
    u = loop.start(x[1:], w=[5e-5, np.nan])
    for _ in range(200):
        x = plant.step(x, [], u, [5e-5], plant.p)[0].full().ravel()
        loop.finish()
        u = loop.step(x[1:] + 1e-4 * rng.standard_normal(1), w=[5e-5, np.nan])
        heights.append(x[1])
    assert loop.estimate.w[1] == pytest.approx(6.5e-4, rel=0.1)
    np.testing.assert_allclose(np.mean(heights[-20:]), 0.4, atol=2e-3)


def test_the_window_of_a_moving_horizon_observer_has_the_tracked_parameters(kit):
    assert isinstance(kit.tracking_observer(kind="mhe").inner, hm.MovingHorizonEstimator)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler (gcc)")
def test_its_c_tracks(kit, folder, tmp_path, call):
    """By the command, without a monitor; in Python, with one and a guard."""
    code, _, err = call("export", "c", folder, "--track", "--no-monitor", "--check", "--out", tmp_path / "c")
    assert code == 0, err
    assert "last entries of `s.w`: k" in (tmp_path / "c" / "README.md").read_text()
    watched = replace(kit, watch={"prior": WatchFile({"residuals": LIMITS})})
    place = hm.generate_controller(watched, tmp_path / "watched", tracking=True, guard="rest")
    sizes = (place / "hmpc_config.h").read_text()
    assert all(f"#define HMPC_{size}\n" in sizes for size in ("NW 2", "TRACKED 1", "LIMITS 2", "GUARD 1"))


def test_what_has_no_c(kit, tmp_path):
    observer = kit.tracking_observer(kind="mhe")
    with pytest.raises(hm.InputError, match=r"MovingHorizonEstimator.*HM-EMBEDDED-011"):
        write_controller(tmp_path / "c", observer.model, OCP, estimator=observer)
    with pytest.raises(hm.InputError, match="HM-KIT-043"):
        hm.generate_controller(kit, tmp_path / "c", tracking=True, guard="adapt")
    with pytest.raises(hm.InputError, match="HM-KIT-040"):
        hm.generate_controller(kit.with_tracked(()), tmp_path / "c", tracking=True, monitor=False)


@pytest.mark.parametrize("w", [[5e-5], [5e-5, np.nan], [[5e-5], [5e-5]]])
def test_measured_disturbances_come_with_or_without_the_tracked_ones(kit, w):
    loop = hm.Loop(kit.tracking_observer(), kit.controller(tracking=True), reference=[0.4])
    loop.start(kit.models["prior"].x0[1:], w=w)
    assert loop.n_measured == 1
    assert loop.estimate.w[0] == 5e-5
    with pytest.raises(hm.InputError, match="HM-MODEL-019"):
        loop.step([0.3], w=[1.0, 2.0, 3.0])


@pytest.mark.parametrize(("k", "named"), [(6e-4, False), (9.5e-4, True)])
def test_the_monitor_tells_drift_from_a_machine_beyond_it(folder, kit, k, named):
    """The fitted value is 5e-4, the standard deviation between recordings a fifth of it.

    Its readings with fitted parameters are at most 4e-4 m at 5e-4, the limit is five times that.
    """

    def steps(t):
        return np.where((t // 600) % 2 == 0, 0.4, 0.3)[:, None]

    kit = replace(kit, watch={"prior": WatchFile({"residuals": LIMITS})})
    programs = {f"prior/{name}": p for name, p in prior_programs(Tanks({"k": k}), DT).items()}
    plant, model = build_model("prior", programs, hm.model_info(Tanks({"k": k}), DT)), kit.models["prior"]
    alarms = {}
    for tracking in (False, True):
        observer = kit.tracking_observer() if tracking else kit.observer()
        monitor = kit.monitor(tracking=tracking)
        loop = hm.Loop(observer, kit.controller(tracking=tracking), monitor=monitor, reference=steps)
        x, rng, seen = model.x0, np.random.default_rng(0), []
        u = loop.start(x[1:], w=[5e-5])
        for _ in range(300):
            x = plant.step(x, [], u, [5e-5], plant.p)[0].full().ravel()
            loop.finish()
            seen.append(loop.reading.channels)
            u = loop.step(x[1:] + 1e-4 * rng.standard_normal(1), w=[5e-5])
        alarms[tracking] = {name for names in seen[150:] for name in names}
    assert "k" not in alarms[False]
    assert ("k" in alarms[True]) is named
    assert alarms[False]  # without tracking, drift within its usual range alarms
    assert named or not alarms[True]
