"""The golf robot's scenario: prior, oracle, data, tasks, and that it is worth learning."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import InputError
from hybrid_mpc.plots import save
from scenarios.golf_robot import scenario
from scenarios.golf_robot.data import make_data, record, stems
from scenarios.golf_robot.effects import measure_effects
from scenarios.golf_robot.excitation import KINDS, excitation
from scenarios.golf_robot.nominal import GEAR, PARAMETERS
from scenarios.golf_robot.oracle import oracle
from scenarios.golf_robot.rig import Rig
from scenarios.golf_robot.tasks import FOLLOW_THROUGH, IMPACT, LONG_FOLLOW_THROUGH, impact


def run_beside(torques, x0):
    """Largest angle error [rad] of the oracle against the rig, from the rig's own hidden state, and the ends."""
    model, rig = scenario.oracle(0.02), Rig()
    state = rig.reset(np.array(x0), 0)
    x, h, worst = rig.truth(state), rig.hidden(state), 0.0
    for torque in torques:
        u = np.array([torque])
        state, (x, h) = rig.step(state, u, 0.02), model.step(x, h, u, model.w, model.p)
        worst = max(worst, abs(float(x[0]) - state.z[0]))
    return worst, np.array(h).ravel(), rig.hidden(state)


def test_oracle_follows_the_rig():
    for torques in (0.2 * np.sin(0.25 * np.arange(100)), np.where(np.arange(100) % 30 < 15, 0.5, -0.5)):
        worst, h, hidden = run_beside(torques, [0.6, 0.0])
        # both of order 4, steps of 0.5 and 0.4 ms, kinks at reversals; a fifteenth of the sensor's noise
        assert worst < 3e-5
        assert h == pytest.approx(hidden, abs=1e-2)


def test_oracle_jacobian_is_the_derivative_of_its_step():
    model = oracle(0.02)
    x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", 4), ca.MX.sym("u")
    after = ca.vertcat(*model.step(x, h, u, model.w, model.p))
    own = ca.Function("own", [x, h, u], [after, ca.jacobian(after, ca.vertcat(x, h)), ca.jacobian(after, u)])
    for z in (
        [0.3, 1.0, 1.3, 0.1, 2e-3, 1.1],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-0.2, -0.02, 1.9, 0.3, -1e-3, 3],
    ):
        x_next, h_next, a, b = (m.full() for m in model.with_jacobian(z[:2], z[2:], 0.1, model.w, model.p))
        wanted = [m.full() for m in own(z[:2], z[2:], 0.1)]
        for given, want in zip((np.vstack([x_next, h_next]), a, b), wanted, strict=True):
            assert given == pytest.approx(want, rel=1e-9, abs=1e-10)  # rounding of entries up to 100


@pytest.mark.full
def test_data_files_are_reproducible_and_have_their_roles(tmp_path, monkeypatch):
    monkeypatch.setattr("scenarios.golf_robot.data.SIZES", {"full": {"train": 2, "valid": 1, "test": 1}})
    paths = make_data(tmp_path / "a", 3, "full")
    again = make_data(tmp_path / "b", 3, "full")
    other = make_data(tmp_path / "c", 4, "full")
    assert [p.read_bytes() for p in paths] == [p.read_bytes() for p in again]
    assert paths[0].read_bytes() != other[0].read_bytes()
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == sorted(p.name for p in paths)  # no leftovers
    assert paths[0].read_text().startswith("time_s,phi_rad,u_nm\n")
    t, phi, u = np.loadtxt(paths[0], delimiter=",", skiprows=1).T
    assert len(t) == 2001
    assert np.diff(t).min() > 0.007  # 10 ms less 8 standard deviations of jitter, clipped at 4 each
    assert np.std(t - 0.01 * np.arange(2001)) == pytest.approx(0.2e-3, rel=0.1)  # 1.6 % standard error
    assert np.abs(phi).max() < 3.0
    assert np.array_equal(u[:-1:2], u[1::2])  # the input changes on the model's grid


@pytest.mark.parametrize("data_set", ["a", "b"])
@pytest.mark.parametrize("budget", ["quick", "full"])
def test_every_recording_has_a_window(budget, data_set):
    names = stems(budget, data_set)
    for stem in names:
        (window,) = scenario.data.windows[stem]
        assert stem.startswith(window.role)
    kinds = {stem.split("_")[2] for stem in names if stem.startswith("train")}
    assert kinds == set(KINDS) - ({"sine", "fastsine"} if data_set == "a" else set())
    judged = [stem for stem in names if not stem.startswith("train")]
    assert judged == [stem for stem in stems(budget, "b") if not stem.startswith("train")]


def test_full_data_are_as_many_as_the_paper_s_comparison_needs():
    roles = [stem.split("_")[0] for stem in stems("full")]
    assert {role: roles.count(role) for role in set(roles)} == {"train": 15, "valid": 6, "test": 15}
    with pytest.raises(InputError, match=r"quick.*HM-SCENARIOS-001"):
        stems("huge")
    with pytest.raises(InputError, match=r"a, b.*HM-SCENARIOS-004"):
        stems("full", "c")


@pytest.mark.parametrize("kind", KINDS)
def test_torques_keep_to_the_motor_s_range(kind):
    t = 0.02 * np.arange(1001)
    torques = [excitation(kind, np.random.default_rng(seed), t) for seed in range(20)]
    largest = np.abs(torques).max()
    assert largest <= 0.5 * (1 + 1e-12)
    assert largest > (0.4 if kind in ("stair", "pulse", "fastsine", "fastchirp") else 0.1)
    if kind in ("stair", "pulse"):  # rounded: at most the steepest of half a cosine
        assert np.abs(np.diff(torques)).max() < 1.0 * np.pi / 2 * 0.02 / 0.2 + 1e-9
    with pytest.raises(InputError, match=r"fastchirp.*HM-SCENARIOS-006"):
        excitation("noise", np.random.default_rng(0), t)


def test_a_recording_that_goes_too_far_is_repeated_with_less_torque(monkeypatch):
    usual, states = record(Rig(), "step", (0, 0, 2))
    reach = np.abs(states[:, 0]).max()
    monkeypatch.setattr("scenarios.golf_robot.data.LARGEST", 0.99 * reach)
    smaller, states = record(Rig(), "step", (0, 0, 2))
    assert smaller[:, 2] == pytest.approx(0.8 * usual[:, 2])
    assert np.abs(states[:, 0]).max() < 0.99 * reach


def test_recorded_angles_are_the_states_at_the_recorded_times():
    table, states = record(Rig(), "step", (0, 0, 2))
    error = table[:, 1] - states[:, 0]
    assert error.std() == pytest.approx(np.hypot(0.2e-3, 2 * np.pi / 4096 / np.sqrt(12)), rel=0.3)
    # a club at rest quantises to a constant error, hence the wide 30 %; a shift by one sample gives 10 times


@pytest.mark.full
def test_data_reach_what_they_promise_and_leave_something_to_learn():
    effects = measure_effects()
    assert 1.0 < effects.largest_angle <= 1.5
    assert 4.0 < effects.largest_speed < 8.0
    assert effects.residual <= effects.residual_published
    # the criterion of a rig that is not too tame
    assert effects.residual > 3 * effects.noise_floor
    assert 0.03 < effects.residual_moving < effects.residual
    assert all(value > 0 for value in effects.torques.values())


FOLLOWED = [task for task in scenario.tasks if task.weight is None]
STROKES = [task for task in scenario.tasks if task.weight is not None]


@pytest.mark.parametrize("task", FOLLOWED, ids=lambda task: task.name)
def test_references_are_feasible_and_consistent(task):
    t = np.linspace(0, task.duration, 6001)
    ref = task.reference(t)
    assert ref.shape == (6001, 2)
    assert np.abs(ref[:, 0]).max() <= 0.8
    assert ref[0] == pytest.approx(np.array(task.x0), abs=1e-9)
    # second order differences: error (dt^2 / 6) times the third derivative, 150 rad/s^3 where a move begins
    assert np.gradient(ref[:, 0], t)[1:-1] == pytest.approx(ref[1:-1, 1], abs=1e-4)
    p = {s.name: s.value for s in PARAMETERS}
    load = np.abs(p["m"] * ref[:, 1] ** 2 * p["a"] + p["m"] * p["g"] * np.cos(ref[:, 0]))
    friction = p["r"] * 1.5 * p["mu"] * load
    torque = p["J"] * np.gradient(ref[:, 1], t) + p["m"] * p["g"] * p["a"] * np.sin(ref[:, 0])
    needed = (np.abs(torque) + friction).max() / GEAR  # with half as much friction again
    assert needed < scenario.control.u_max[0]


@pytest.mark.parametrize("task", STROKES, ids=lambda task: task.name)
def test_a_stroke_asks_for_nothing_but_the_impact_and_then_rest(task):
    t = 0.02 * np.arange(round(task.duration / 0.02))
    weight, reference = task.weight(t), task.reference(t)
    (k,) = np.flatnonzero(weight[:, 0] > 1)
    assert t[k] == pytest.approx(IMPACT)
    assert t[k] <= task.control.horizon * 0.02 + 1e-9  # the first plan sees it
    assert not weight[:k].any()
    assert reference[k] == pytest.approx([0.0, float(task.name.split("_")[1])])
    assert not np.delete(reference, k, axis=0).any()
    free = LONG_FOLLOW_THROUGH if task.name in ("stroke_1.9", "stroke_4") else FOLLOW_THROUGH
    assert not weight[k + 1 : k + round(free / 0.02)].any()
    assert (weight[t > IMPACT + free + 0.01] == 1).all()
    # a miss by 5 mrad and by 10 mrad/s costs 1 each
    cost = weight[k] * task.control.q * 0.02 * np.array([5e-3, 1e-2]) ** 2
    assert cost == pytest.approx([1.0, 1.0])


def test_an_impact_is_read_off_the_true_crossing():
    # phi = 0.1 sin(w (t - 1.61)): crosses 10 ms late at 0.1 w; a cubic between samples errs by (w dt)^4 / 384
    w, t = 10.0, 0.02 * np.arange(150)
    x = np.column_stack([0.1 * np.sin(w * (t - 1.61)), 0.1 * w * np.cos(w * (t - 1.61))])
    figures = impact(SimpleNamespace(t=t, x=x, u=np.full((150, 1), 0.5)), 0.8)
    assert figures["timing_error_s"] == pytest.approx(0.01, abs=1e-5)
    assert figures["speed_error_rel"] == pytest.approx(0.25, abs=1e-3)
    assert figures["effort_nm2s"] == pytest.approx(0.25 * 1.6)
    never = impact(SimpleNamespace(t=t, x=0 * x - 1.0, u=np.zeros((150, 1))), 0.8)
    assert never["speed_error_rel"] == np.inf


def stroke(controller="hybrid", speed=1.2, error=0.004, timing=0.003):
    figures = {"speed_rad_s": speed, "speed_error_rel": error, "timing_error_s": timing, "effort_nm2s": 1.0}
    return SimpleNamespace(controller=controller, figures=figures)


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_figure_of_the_strokes_shows_units_targets_and_mean_absolute_errors(tmp_path):
    rows = [
        stroke(error=0.004, timing=0.002),
        stroke(error=-0.002, timing=-0.006),
        stroke(error=np.inf, timing=np.inf),
        stroke("prior", 1.9, -0.4, 0.02),
        stroke("oracle", error=np.inf, timing=np.inf),
        SimpleNamespace(controller="hybrid", figures={}),  # a task that is no stroke
    ]
    figure, _ = scenario.figures(rows)["strokes"]
    upper, lower = figure.axes
    assert [ax.get_ylabel() for ax in (upper, lower)] == ["speed error [%]", "timing error [ms]"]
    assert [text.get_text() for text in lower.get_xticklabels()] == ["1.2", "1.9"]
    for ax, target in ((upper, 1.0), (lower, 10.0)):
        box = ax.patches[0].get_window_extent().transformed(ax.transData.inverted())
        np.testing.assert_allclose([box.y0, box.y1], [-target, target], atol=1e-9)
    assert legend(figure) == [
        "hybrid: 0.3 %, 4 ms, 1 of 3 missed",
        "prior, fitted: 40 %, 20 ms",
        "oracle: all 1 missed",
    ]
    means = [
        line.get_ydata()[0] for line in upper.lines if line.get_marker() == "o" and len(line.get_ydata())
    ]
    assert means == pytest.approx([0.1, -40.0])  # signed
    assert (upper.get_yscale(), lower.get_yscale()) == ("symlog", "linear")  # more than ten bands
    assert upper.get_ylim()[1] > 40
    assert save(figure, tmp_path / "strokes.png").exists()
    figure, _ = scenario.figures(rows[4:5])["strokes"]  # no stroke hit at all
    assert save(figure, tmp_path / "missed.png").exists()
    assert scenario.figures(rows[5:]) == {}
