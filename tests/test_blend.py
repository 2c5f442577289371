"""The blend of prior and hybrid: values and derivatives, its share in an observer, and the kit's controller of it."""

import shutil
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import make_filter, pendulum_model

import hybrid_mpc as hm
from hybrid_mpc.compare.loops import Bench, LoopSpec
from hybrid_mpc.compare.study import Study
from hybrid_mpc.estimate.tracking import TrackedParameter, TrackingFilter
from hybrid_mpc.kit.parts import loop_settings, save_loop
from hybrid_mpc.model.blend import BLEND_SHARE, blended, with_share
from hybrid_mpc.model.stages import Stages, VectorisedStages

DT = 0.02
NOISE = dict.fromkeys(("prior", "prior_observer", "hybrid", "hybrid_observer"), (0.0001, 0.01))


def pair(delay=0.0):
    models = pendulum_model(z=0, dt=DT), pendulum_model(z=3, dt=DT, correction=2.0)
    return [hm.with_input_delay(m, delay * DT) if delay else m for m in models]


@pytest.mark.parametrize("delay", [0.0, 1.6])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0, 1.7])
def test_the_blend_lies_between_prior_and_hybrid(delay, share):
    prior, hybrid = pair(delay)
    model = blended(prior, hybrid)
    rng, n = np.random.default_rng(0), hybrid.n_h
    x, h, u = rng.normal(size=2), rng.normal(size=n), rng.normal(size=1)
    low = prior.step(x, h[: prior.n_h], u, [], [])[0].full()
    high, h_next = (v.full() for v in hybrid.step(x, h, u, [], []))
    found = [v.full() for v in model.with_jacobian(x, h, u, [], [share])]
    np.testing.assert_allclose(found[0], low + share * (high - low), atol=1e-14)
    np.testing.assert_array_equal(found[1], h_next)
    rates = [m.xdot(x, h[: m.n_h], u, [], []).full() for m in (prior, hybrid)]
    np.testing.assert_allclose(
        model.xdot(x, h, u, [], [share]), rates[0] + share * (rates[1] - rates[0]), atol=1e-13
    )
    point = [ca.MX.sym(name, size) for name, size in (("x", 2), ("h", n), ("u", 1))]
    after = ca.vertcat(*model.step(*point, [], [share]))
    slopes = ca.Function("slopes", point, [ca.jacobian(after, ca.vertcat(*point))])(x, h, u).full()
    np.testing.assert_allclose(np.hstack(found[2:]), slopes, atol=1e-12)


def test_many_points_at_once_are_the_points_one_by_one(golf_artifact):
    kit = hm.load(golf_artifact)
    model = blended(kit.models["prior"], kit.models["hybrid"], 0.4)
    rng, n = np.random.default_rng(1), 5
    z = np.hstack([rng.normal(size=(n, model.n_x)), 0.3 * rng.normal(size=(n, model.n_h))])
    u = rng.normal(size=(n, model.n_u))
    one, many = Stages(model, n), VectorisedStages(model, n)
    for got, want in zip(many.at(z, u), one.at(z, u), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)
    for hidden in (False, True):
        np.testing.assert_allclose(
            many.slopes(1, hidden=hidden)(z, u), one.slopes(1, hidden=hidden)(z, u), atol=1e-12
        )


@pytest.mark.parametrize("true", [0.4, 1.5])
def test_the_observer_finds_the_share_of_a_machine(true):
    prior, hybrid = pair()
    model = blended(prior, hybrid)
    observer = TrackingFilter(make_filter(model, sigma_y=[1e-3]), [TrackedParameter("correction_share", 0.5)])
    x, h, rng = np.zeros(2), np.zeros(3), np.random.default_rng(2)
    estimate = observer.start(x[:1])
    for k in range(1500):
        u = np.array([2.0 * np.sin(0.07 * k) + np.sin(0.013 * k)])
        x, h = (v.full().ravel() for v in model.step(x, h, u, [], [true]))
        estimate = observer.update(estimate, x[:1] + 1e-3 * rng.standard_normal(1), u)
    assert estimate.w[-1] == pytest.approx(true, abs=4 * estimate.std[0])
    assert abs(estimate.w[-1] - true) < 0.5 * abs(1.0 - true)


def test_models_that_do_not_fit_are_refused():
    prior, hybrid = pair()
    with pytest.raises(hm.InputError, match="HM-MODEL-060"):
        blended(prior, replace(hybrid, dt=0.5))
    with pytest.raises(hm.InputError, match="HM-MODEL-061"):
        with_share(replace(with_share(prior), parameters=(BLEND_SHARE,)))


@pytest.fixture(scope="module")
def folder(golf_artifact, tmp_path_factory):
    place = shutil.copytree(golf_artifact, tmp_path_factory.mktemp("blend") / "model")
    save_loop(place, loop_settings(hm.load_scenario("golf_robot"), NOISE))
    return place


@pytest.fixture(scope="module")
def kit(folder):
    return hm.load(folder)


def test_a_kit_runs_prior_and_hybrid_side_by_side(kit):
    row, result = Bench(hm.load_scenario("golf_robot"), {"model": kit}).run(
        LoopSpec("golf_robot", "model", "track_step", "blended_observer", duration=1.0)
    )
    assert set(result.status) == {"SOLVED"}
    assert np.isfinite(row.cost)
    assert row.alarm_share is None  # the monitor watches the hybrid
    assert result.w.shape == (50, 1)
    assert result.w[0, 0] == 1.0
    assert np.ptp(result.w) > 0.0


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler (gcc)")
def test_its_c_has_the_share(folder, tmp_path, call):
    code, _, err = call(
        "export", "c", folder, "--blended", "--no-monitor", "--check", "--out", tmp_path / "c"
    )
    assert code == 0, err
    assert "`s.w`: correction_share" in (tmp_path / "c" / "README.md").read_text()


def test_a_kit_that_recommends_the_prior_asks_for_a_start(kit):
    careful = replace(kit, recommended="prior")
    with pytest.raises(hm.InputError, match="HM-KIT-042"):
        careful.blended()
    assert careful.blended(0.5).models["hybrid"].p[-1] == 0.5


def test_a_study_gives_the_blend_its_start(kit):
    """Also where the prior is recommended; controllers without a blend have no share."""
    study = Study(
        "golf_robot",
        "m",
        ["track_step"],
        ["prior_observer", "blended_observer"],
        seeds=1,
        duration=0.4,
        share=0.5,
    )
    specs = {spec.controller: spec for spec in study.runs()}
    assert {name: spec.share for name, spec in specs.items()} == {
        "prior_observer": None,
        "blended_observer": 0.5,
    }
    bench = Bench(hm.load_scenario("golf_robot"), {"model": replace(kit, recommended="prior")})
    own = specs["blended_observer"]
    assert bench.run(own)[1].w[0, 0] == 0.5
    assert own.id != replace(own, share=None).id
    with pytest.raises(hm.InputError, match="HM-KIT-042"):
        bench.run(replace(own, share=None))
    with pytest.raises(hm.InputError, match="HM-COMPARE-061"):
        replace(study, controllers=("prior_observer",))
    for share in (0.0, 2.0):
        with pytest.raises(hm.InputError, match="HM-COMPARE-062"):
            replace(study, share=share)


@pytest.mark.parametrize("share", [0.0, 2.0, np.nan])
def test_a_share_at_its_bound_could_not_move(kit, share):
    with pytest.raises(hm.InputError, match="HM-KIT-041"):
        kit.blended(share)


def test_the_guard_needs_a_hybrid_that_its_monitor_watches():
    with pytest.raises(hm.InputError, match="HM-COMPARE-003"):
        LoopSpec("golf_robot", "model", "track_step", "blended_observer", guard="rest")


def test_a_controller_of_studies_tracks_the_parameters_of_the_kit(kit):
    scenario, spec = (
        hm.load_scenario("golf_robot"),
        LoopSpec("golf_robot", "model", "track_step", "hybrid_tracking", duration=0.4),
    )
    with pytest.raises(hm.InputError, match="HM-KIT-040"):
        Bench(scenario, {"model": kit}).run(spec)
    tracked = [TrackedParameter("mu", 0.1, relative=True)]
    result = Bench(scenario, {"model": kit.with_tracked(tracked)}).run(spec)[1]
    assert set(result.status) == {"SOLVED"}
    assert np.ptp(result.w[:, 0]) > 0.0
