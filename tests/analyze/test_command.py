"""The study of an artifact's models, its tables and figures, and the command."""

import csv
import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from hybrid_mpc import (
    InputError,
    load,
    make_controller,
    multisine,
    run_model,
    set_process_noise,
    simulate,
    write_csv,
)
from hybrid_mpc.analyze.linearize import control_toolbox
from hybrid_mpc.cli.main import app
from hybrid_mpc.job.analyze import Request, Subject, loops_part, measured_part, study, subject_of
from hybrid_mpc.job.analyze_page import write_analysis
from hybrid_mpc.kit.artifact import loop_settings, read_description, write_description
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
    return Subject(
        {"prior": artifact.models["prior"]}, load_programs(golf_artifact), np.array([[-0.85, 0.85], [-2.5, 2.5]]),
        np.array([[-0.5, 0.5]]), np.array([0.25]), plant=scenario.plant(),
    )  # fmt: skip


def test_a_study_without_a_control_problem_says_what_it_leaves_out(prior_alone, tmp_path):
    said = []
    findings = study(prior_alone, lambda *words: said.append(words[3]))
    assert tuple(said) == PARTS == tuple(findings.result)
    assert {p for p in PARTS if "reason" in findings.result[p]} == {"schedule", "loops"}
    assert findings.result["friction"]["prior"]["tangent_1_s"] > 50
    assert findings.result["measured"]["prior"]["median_relative_error"] < 0.5
    files = write_analysis(tmp_path, prior_alone, findings, ("a test",), "hybrid-mpc analyze")
    assert all(path.is_file() for path in files)
    page = (tmp_path / "analysis.html").read_text()
    assert "Left out: loops need" in page
    with (tmp_path / "modes.csv").open() as file:
        rows = list(csv.DictReader(file))
    poles = [
        complex(float(r["pole, real"]), float(r["pole, imaginary"])) for r in rows if r["point"] == "rest"
    ]
    assert np.array_equal(poles, findings.arrays["linear/prior/rest/poles"])  # all digits
    omega, size = (findings.arrays[f"linear/prior/rest/{key}"] for key in ("omega", "magnitude"))
    zeros, poles = (findings.arrays[f"linear/prior/rest/{key}"] for key in ("zeros", "poles"))
    z = np.exp(1j * omega * 0.02)[:, None]
    product = np.prod(np.abs(z - zeros), axis=1) / np.prod(np.abs(z - poles), axis=1)
    # Poles and zeros are the response but for a factor; near the Nyquist frequency it is 1e-3 of the largest.
    assert np.ptp(size[0, 0] / product) < 1e-9 * np.max(size[0, 0] / product)
    kept = json.loads((tmp_path / "analysis.json").read_text())
    assert kept["equilibria"]["prior"]["points"][0]["stability"] == "stable"
    for picture in (tmp_path / "figures").glob("*.png"):
        with Image.open(picture) as image:
            assert min(image.size) > 300


def test_recordings_are_taken_before_the_simulated_machine(golf_artifact, prior_alone, tmp_path):
    model, t = prior_alone.models["prior"], 0.02 * np.arange(3000)
    u = multisine(t, 0.25, 0.1, 2.0, period=20.0)
    phi = run_model(model, [0.0, 0.0])(u)
    file = write_csv(tmp_path / "run.csv", {"time_s": t, "u_nm": u, "phi_rad": phi})
    folder = noisy(golf_artifact, tmp_path)
    subject, notes = subject_of(Request(folder, "golf_robot", (file,)))
    assert len(subject.recordings) == 1
    assert "the model's own" in notes[1]
    assert set(subject.filters) == {(m, f) for m in ("prior", "hybrid") for f in ("quiet", "jump")}
    result, curves = measured_part(replace(prior_alone, recordings=subject.recordings))
    # The "machine" is the model itself, but for its first speed, which is smoothed from the recording.
    assert result["prior"]["median_relative_error"] < 0.02
    assert np.median(curves["measured/coherence"][:20]) > 0.9
    assert "1 recordings" in result["source"]


def test_a_folder_alone_has_loops_where_it_holds_what_they_need(golf_artifact, tmp_path):
    folder = shutil.copytree(golf_artifact, tmp_path / "bare")
    note = read_description(folder)
    anonymous = replace(note, loop=loop_settings(scenario), provenance=replace(note.provenance, scenario=""))
    write_description(folder, anonymous)
    subject, notes = subject_of(Request(folder))
    assert subject.filters == {}
    assert "holds no process noise" in notes[1]
    set_process_noise(folder, {name: [1e-4, 2e-2] for name in ("prior_observer", "hybrid_observer")})
    subject, notes = subject_of(Request(folder))
    assert set(subject.filters) == {(m, f) for m in ("prior", "hybrid") for f in ("quiet", "jump")}
    assert notes[1] == "filters' noise: the model's own"


def test_without_python_control_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(InputError, match=r"hybrid-mpc\[analysis\]"):
        control_toolbox()


def test_what_does_not_fit_is_refused(golf_artifact, tmp_path):
    with pytest.raises(InputError, match="needed is an artifact folder"):
        subject_of(Request(tmp_path))
    with pytest.raises(InputError, match="--scenario"):
        subject_of(Request(golf_artifact, data=(tmp_path / "a.csv",)))
    with pytest.raises(InputError, match="positive"):
        subject_of(Request(golf_artifact, speed=0.0))


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
    assert len(list((out / "figures").glob("*.png"))) == 13


@pytest.mark.full
def test_the_delay_that_the_margins_allow_is_the_delay_that_the_rig_stands(golf_artifact, tmp_path):
    folder = noisy(golf_artifact, tmp_path)
    subject, _ = subject_of(Request(folder, "golf_robot"))
    filters = {key: f for key, f in subject.filters.items() if key[0] == "prior"}
    subject = replace(subject, models={"prior": subject.models["prior"]}, filters=filters)
    loops, _ = loops_part(subject, {"prior": (np.zeros(2), np.zeros(0))})
    controller = make_controller(subject.models["prior"], subject.models["prior"], scenario.control)
    task = next(t for t in scenario.tasks if t.name == "track_sine")
    for mode in ("quiet", "jump"):
        allowed = loops["prior on prior"]["driven"][mode]["margins"]["delay_periods"]
        restless = []
        for delay in (0, allowed, allowed + 1):
            run = simulate(
                scenario.plant(), subject.filters["prior", mode], controller, task.reference, dt=0.02, duration=4.0,
                x0=np.array(task.x0), seed=0, input_delay=delay,
            )  # fmt: skip
            restless.append(np.sqrt(np.mean(np.diff(run.u[50:, 0]) ** 2)))
        # A loop that stands the delay moves its input as the task asks; one that does not swings between its bounds.
        assert restless[1] < 1.3 * restless[0]
        assert restless[2] > 1.5 * restless[1]
