"""The analysis of an artifact's models, its tables and figures, and the command."""

import csv
import json
import shutil
import sys
from dataclasses import fields, replace
from html import unescape

import casadi as ca
import numpy as np
import pytest
from machines import dc_motor, thermal, two_tanks
from PIL import Image
from typer.testing import CliRunner

from hybrid_mpc import (
    InputError,
    load,
    make_controller,
    make_ocp,
    multisine,
    run_model,
    set_process_noise,
    simulate,
    write_csv,
)
from hybrid_mpc.analyze.analysis import (
    AnalysisInput,
    Missing,
    analyze_models,
    input_range,
    loops_of,
    responses_of,
    state_range,
)
from hybrid_mpc.analyze.linearize import control_toolbox, jacobians
from hybrid_mpc.analyze.page import _draw_measured, tables_of, write_analysis
from hybrid_mpc.cli.analyze import command
from hybrid_mpc.cli.main import app
from hybrid_mpc.kit.parts import loop_settings, read_description, save_loop, write_description
from hybrid_mpc.records import plain
from hybrid_mpc.workflow.analyze import AnalysisSettings, _speed, analysis_input
from nn_export import load_programs
from scenarios.golf_robot import scenario

PARTS = ("equilibria", "friction", "linear", "measured", "schedule", "loops", "memory", "sensitivity")


def noisy(model, tmp_path):
    """A copy of an artifact whose filters' noise is known."""
    folder = shutil.copytree(model, tmp_path / "model")
    set_process_noise(folder, {name: [1e-4, 2e-2] for name in ("prior_observer", "hybrid_observer")})
    return folder


@pytest.fixture(scope="module")
def prior_alone(golf_artifact):
    artifact = load(golf_artifact)
    return AnalysisInput(
        {"prior": artifact.models["prior"]}, load_programs(golf_artifact / "models"),
        np.array([[-0.85, 0.85], [-2.5, 2.5]]), np.array([[-0.5, 0.5]]), np.array([0.25]), plant=scenario.plant(),
    )  # fmt: skip


@pytest.mark.full
def test_an_analysis_without_a_control_problem_says_what_it_leaves_out(prior_alone, tmp_path):
    told = []
    result = analyze_models(prior_alone, lambda *words: told.append(words[3]))
    assert tuple(told) == PARTS == tuple(f.name for f in fields(result))
    assert {part for part in PARTS if isinstance(getattr(result, part), Missing)} == {"schedule", "loops"}
    assert result.friction["prior"].working.tangent > 50
    assert result.measured.errors["prior"].median < 0.5
    files = write_analysis(tmp_path, prior_alone, result, ("a test",), "hybrid-mpc analyze")
    assert all(path.is_file() for path in files)
    assert f"Left out: {result.loops.reason}." in unescape((tmp_path / "analysis.html").read_text())
    with (tmp_path / "modes.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["point"] == "rest"]
    written = [complex(float(r["pole, real [-]"]), float(r["pole, imaginary [-]"])) for r in rows]
    at_rest = result.linear["prior"]["rest"]
    assert np.array_equal(written, at_rest.structure.poles)  # all digits
    z = np.exp(1j * at_rest.response.omega * 0.02)[:, None]
    product = np.prod(np.abs(z - at_rest.zeros), axis=1) / np.prod(
        np.abs(z - at_rest.structure.poles), axis=1
    )
    # Poles and zeros are the response but for a factor; near the Nyquist frequency it is 1e-3 of the largest.
    factor = at_rest.response.magnitude[0, 0] / product
    assert np.ptp(factor) < 1e-9 * np.max(factor)
    numbers = json.loads((tmp_path / "analysis.json").read_text())
    assert numbers["equilibria"]["prior"]["points"][0]["stability"] == "stable"
    assert numbers["linear"]["prior"]["rest"]["structure"]["modes"] == plain(at_rest.structure.modes)
    with np.load(tmp_path / "curves.npz") as curves:
        assert np.array_equal(curves["linear/prior/rest/zeros"], at_rest.zeros)
    for picture in (tmp_path / "figures").glob("*.png"):
        with Image.open(picture) as image:
            assert min(image.size) > 300


def test_every_number_of_the_page_has_a_unit(prior_alone):
    given = replace(prior_alone, ocp=make_ocp(prior_alone.models["prior"], scenario.control))
    result = replace(
        analyze_models(replace(given, plant=None)), loops=Missing("none"), sensitivity=Missing("none")
    )
    tables = tables_of(given, result)
    assert set(tables) == {"equilibria", "friction", "modes", "steady_gain", "gain_schedule", "memory"}
    words = {
        "model",
        "channel",
        "point",
        "stability",
        "hits",
        "contraction certified",
        "positions that no input holds",
        "unit",
    }
    for table in tables.values():
        assert all(column.endswith("]") for column in table.columns if column not in words), table.columns
    assert tables["gain_schedule"].columns[2] == "gain of phi, lowest [N m/rad]"


def test_recordings_are_taken_before_the_simulated_machine(golf_artifact, prior_alone, tmp_path):
    model, t = prior_alone.models["prior"], 0.02 * np.arange(3000)
    u = multisine(t, 0.25, 0.1, 2.0, period=20.0)
    phi = run_model(model, [0.0, 0.0])(u)
    file = write_csv(tmp_path / "run.csv", {"time_s": t, "u_nm": u, "phi_rad": phi})
    folder = noisy(golf_artifact, tmp_path)
    given, notes = analysis_input(AnalysisSettings(folder, "golf_robot", (file,)))
    assert len(given.recordings) == 1
    assert "the model's own" in notes[1]
    assert set(given.filters) == {(m, f) for m in ("prior", "hybrid") for f in ("quiet", "jump")}
    found = responses_of(replace(prior_alone, recordings=given.recordings))
    # The "machine" is the model itself, but for its first speed, which is smoothed from the recording.
    assert found.errors["prior"].median < 0.02
    assert np.median(found.machine.coherence[:20]) > 0.9
    assert "1 recordings" in found.source


def test_a_folder_alone_has_loops_where_it_holds_what_they_need(golf_artifact, tmp_path):
    folder = shutil.copytree(golf_artifact, tmp_path / "bare")
    note = read_description(folder)
    write_description(folder, replace(note, provenance=replace(note.provenance, scenario="")))
    save_loop(folder, loop_settings(scenario))
    given, notes = analysis_input(AnalysisSettings(folder))
    assert given.filters == {}
    assert "no process noise" in notes[1]
    set_process_noise(folder, {name: [1e-4, 2e-2] for name in ("prior_observer", "hybrid_observer")})
    given, notes = analysis_input(AnalysisSettings(folder))
    assert set(given.filters) == {(m, f) for m in ("prior", "hybrid") for f in ("quiet", "jump")}
    assert notes[1] == "observers' noise: the model's own"


def test_the_command_of_the_page_repeats_the_analysis(tmp_path):
    data = tmp_path / "a run.csv"
    settings = AnalysisSettings(tmp_path / "model", "golf_robot", (data,), 0.25)
    assert command(settings, tmp_path / "out") == (
        f"hybrid-mpc analyze {tmp_path}/model --out {tmp_path}/out --scenario golf_robot --data '{data}' --speed 0.25"
    )


def test_without_python_control_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(InputError, match=r"analysis.*HM-ERRORS-001"):
        control_toolbox()


def test_what_does_not_fit_is_refused(golf_artifact, tmp_path):
    with pytest.raises(InputError, match="HM-KIT-038"):
        analysis_input(AnalysisSettings(tmp_path))
    with pytest.raises(InputError, match="HM-WORKFLOW-001"):
        analysis_input(AnalysisSettings(golf_artifact, data=(tmp_path / "a.csv",)))
    with pytest.raises(InputError, match="HM-WORKFLOW-002"):
        analysis_input(AnalysisSettings(golf_artifact, speed=0.0))


@pytest.mark.full
def test_the_command_analyses_prior_and_hybrid_with_their_loops(golf_artifact, tmp_path):
    out = tmp_path / "out"
    arguments = [
        "analyze",
        str(noisy(golf_artifact, tmp_path)),
        "--scenario",
        "golf_robot",
        "--out",
        str(out),
    ]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    found = json.loads((out / "analysis.json").read_text())
    assert [p for p in PARTS if "reason" in found[p]] == []
    assert found["loops"]["prior on prior"]["driven"]["quiet"]["stable"]
    assert found["loops"]["hybrid on hybrid"]["moving"]["jump"]["margins"]["gain_up"] > 1
    assert "--scenario golf_robot" in (out / "analysis.html").read_text()
    assert len(list((out / "figures").glob("*.png"))) == 14


def test_loops_of_problems_with_weights_on_outputs_are_those_of_the_same_weights_on_states(
    golf_artifact, tmp_path
):
    """The angle is the rig's output: a weight on it is a weight on the state."""
    given, _ = analysis_input(AnalysisSettings(noisy(golf_artifact, tmp_path), "golf_robot"))
    filters = {key: f for key, f in given.filters.items() if key == ("prior", "quiet")}
    given = replace(given, models={"prior": given.models["prior"]}, filters=filters)
    problem = scenario.control.changed(du_max=None, r=(1e-3,))
    by_state, by_output = (
        loops_of(replace(given, ocp=ocp), {"prior": (np.zeros(2), np.zeros(0))})["prior on prior"]["rest"][
            "quiet"
        ]
        for ocp in (problem.changed(q=(1e4, 0.0)), problem.changed(q=(0.0, 0.0), q_y=(1e4,)))
    )
    assert by_output.stable
    # differences of solves are exact to about 1e-6; the problems' terminal weights differ slightly
    np.testing.assert_allclose(by_output.gain, by_state.gain, rtol=0.02)


@pytest.mark.full
def test_the_delay_that_the_margins_allow_is_the_delay_that_the_rig_stands(golf_artifact, tmp_path):
    folder = noisy(golf_artifact, tmp_path)
    given, _ = analysis_input(AnalysisSettings(folder, "golf_robot"))
    filters = {key: f for key, f in given.filters.items() if key[0] == "prior"}
    given = replace(given, models={"prior": given.models["prior"]}, filters=filters)
    loops = loops_of(given, {"prior": (np.zeros(2), np.zeros(0))})
    controller = make_controller(given.models["prior"], given.models["prior"], scenario.control)
    task = next(t for t in scenario.tasks if t.name == "track_sine")
    for mode in ("quiet", "jump"):
        allowed = loops["prior on prior"]["driven"][mode].margins.delay_periods
        restless = []
        for delay in (0, allowed, allowed + 1):
            run = simulate(
                scenario.plant(), given.filters["prior", mode], controller, task.reference, dt=0.02, duration=4.0,
                x0=np.array(task.x0), seed=0, input_delay=delay,
            )  # fmt: skip
            restless.append(np.std(run.u[50:, 0]))  # not of its moves: those of the jump filter are noise
        # A loop that stands the delay moves its input as the task asks; one that does not swings between its bounds.
        assert restless[1] < 1.3 * restless[0]
        assert restless[2] > 1.5 * restless[1]


@pytest.mark.parametrize(
    "make", [dc_motor, *(pytest.param(make, marks=pytest.mark.full) for make in (two_tanks, thermal))]
)
def test_machines_without_positions_are_analyzed_around_their_operating_point(make, tmp_path):
    """What has no speeds lacks friction and a working speed; all else is there, channel by channel."""
    model = make()
    given = AnalysisInput({"prior": model}, {}, state_range(model), input_range(model, None), np.zeros(0))
    found = analyze_models(given)
    assert "must be positions followed by their speeds" in found.friction.reason
    (rest,) = (p for p in found.equilibria["prior"].points if np.allclose(p.x, model.x0, rtol=1e-6))
    assert rest.stability == "stable"
    linear = found.linear["prior"]
    assert list(linear) == ["rest", "driven"]
    # each channel by hand: C (e^(i omega dt) - A)^-1 B + D
    a, b, c, d = (m.full() for m in jacobians(model)(model.x0, [], model.u0))
    response = linear["rest"].response
    for k in (0, 200):
        z = np.exp(1j * response.omega[k] * model.dt)
        by_hand = c @ np.linalg.solve(z * np.eye(model.n_x) - a, b) + d
        found_k = response.magnitude[..., k] * np.exp(1j * response.phase[..., k])
        np.testing.assert_allclose(found_k, by_hand, rtol=1e-9, atol=1e-9 * np.abs(by_hand).max())
    dc = c @ np.linalg.solve(np.eye(model.n_x) - a, b) + d
    np.testing.assert_allclose(linear["rest"].gain.gain, dc, rtol=1e-9)
    assert (linear["rest"].gain.relative is None) == (model.n_y != model.n_u)
    if make is dc_motor:
        return  # what is drawn has nothing new
    files = {p.name for p in write_analysis(tmp_path, given, found, ["a test"], "none")}
    channels = [f"_from_{u.name}_to_{y.name}" for u in model.inputs for y in model.outputs]
    for named in channels if len(channels) > 1 else [""]:
        assert {f"bode_rest{named}.png", f"bode_driven{named}.png", f"steps{named}.png"} <= files
    page = (tmp_path / "analysis.html").read_text()
    assert page.count("Bode plot of the linearizations at rest") == 2 * len(channels)  # caption and alt text
    assert "Left out: model" in page


def test_a_working_speed_is_refused_where_nothing_moves():
    with pytest.raises(InputError, match=r"two tanks.*upper, lower.*HM-MODEL-031"):
        _speed(two_tanks(), None, 0.5)


@pytest.mark.parametrize("recorded", [True, False])
def test_a_model_that_diverges_is_left_out_of_the_responses(prior_alone, tmp_path, recorded):
    model = prior_alone.models["prior"]
    x, h, u, w, p = (
        ca.MX.sym(name, n) for name, n in zip("xhuwp", (2, 0, 1, model.n_w, model.n_p), strict=True)
    )
    wild = replace(model, step=ca.Function("step", [x, h, u, w, p], [1e3 * x + 1.0, h]))
    given = replace(prior_alone, models={"prior": model, "hybrid": wild})
    if recorded:
        drive = multisine(0.02 * np.arange(3000), 0.2, 0.1, 2.0, period=10.0)
        out = run_model(model, [0.0, 0.0])(drive)
        given = replace(given, plant=None, recordings=((drive, out, np.zeros(2)),))
    found = responses_of(given)
    assert set(found.models) == set(found.errors) == {"prior"}
    assert set(found.left_out) == {"hybrid"}
    assert "diverges" in found.left_out["hybrid"]
    (_, figure, _), *_ = _draw_measured(given, found)
    assert figure.axes
