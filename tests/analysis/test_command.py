"""The study of an artifact's models, its tables and figures, and the command."""

import csv
import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from hybrid_mpc.analysis.outputs import write_analysis
from hybrid_mpc.analysis.study import study
from hybrid_mpc.analysis.subject import Request, Subject, check_out, subject_of
from hybrid_mpc.artifact import load_artifact
from hybrid_mpc.cli.main import app
from hybrid_mpc.errors import InputError
from nn_export import load_programs
from scenarios.golf_robot import scenario

PARTS = ("equilibria", "friction", "linear", "measured", "schedule", "loops", "memory", "sensitivity")


@pytest.fixture(scope="module")
def prior_alone(golf_artifact):
    artifact = load_artifact(golf_artifact)
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
    kept = json.loads((tmp_path / "analysis.json").read_text())
    assert kept["equilibria"]["prior"]["points"][1]["stability"] == "stable"
    for picture in (tmp_path / "figures").glob("*.png"):
        with Image.open(picture) as image:
            assert min(image.size) > 300


def test_what_does_not_fit_is_refused(golf_artifact, tmp_path):
    with pytest.raises(InputError, match="no artifact"):
        subject_of(Request(tmp_path))
    with pytest.raises(InputError, match="--scenario"):
        subject_of(Request(golf_artifact, data=(tmp_path / "a.csv",)))
    with pytest.raises(InputError, match="positive"):
        subject_of(Request(golf_artifact, speed=0.0))
    (tmp_path / "something").write_text("")
    with pytest.raises(InputError, match="empty"):
        check_out(tmp_path)


@pytest.mark.full
def test_the_command_analyses_prior_and_hybrid_with_their_loops(golf_artifact, tmp_path):
    noise = tmp_path / "run" / "checkpoints" / "control.json"
    noise.parent.mkdir(parents=True)
    sigma = {name: [1e-4, 2e-2] for name in ("prior_observer", "hybrid_observer")}
    noise.write_text(json.dumps({"sigma_x": sigma}))
    out = tmp_path / "out"
    arguments = [
        "analyze",
        str(golf_artifact),
        "--scenario",
        "golf_robot",
        "--noise",
        str(noise),
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
    assert len(list((out / "figures").glob("*.png"))) == 12
