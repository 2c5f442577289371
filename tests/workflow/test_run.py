"""The main job as a user runs it: its folder, its determinism, its resumption."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from patience import HANGS

from hybrid_mpc import InputError, load
from hybrid_mpc.kit.parts import KIT, OWNERS, PROGRAMS, WEIGHTS, read_description, write_description
from hybrid_mpc.workflow.stages.results import read_results


def results(folder):
    return read_results(folder / "results.json")


def without_timing(folder):
    """Everything that a seed determines: all but durations, of steps and of the loops that were run."""
    found = json.loads((folder / "results.json").read_text())
    rows = [row for row in found["promises"]["rows"] if row["name"] != "step time"]
    loops = [{key: v for key, v in row.items() if key != "timing_ms"} for row in found["on_model"]["rows"]]
    return found | {"promises": rows, "on_model": found["on_model"] | {"rows": loops}, "control": None}


def test_folder_holds_what_the_readme_says(finished):
    found = results(finished)
    assert found.scenario == "my_machine"
    assert found.export.parity_max_abs_error <= 1e-12  # the project's bound for values
    assert found.export.jacobian_max_abs_error <= 1e-10  # and for Jacobians
    page = (finished / "report.html").read_text()
    assert not re.search(r"<(script|link|img|iframe)[^>]* (src|href)=[\"']?https?:", page)
    names = {path.name for path in (finished / "figures").glob("*.png")}
    for name in ("prior_observer", "hybrid_observer"):
        assert found.estimation.observers[name].samples > 100  # at least five times the 20 lags
        assert f"innovations_{name}.png" in names
    assert {"recordings.png", "training.png", "errors.png", "step_times.png", "poles.png"} <= names


def test_doubts_about_recordings_reach_terminal_results_and_report(finished):
    (warning,) = results(finished).data.warnings
    assert "tuesday.csv: column 'phi_rad' repeats" in warning
    page = (finished / "report.html").read_text()
    assert "Warning: tuesday.csv: column" in page
    assert f"warning: {warning}" in (finished.parent / "told.txt").read_text()


def test_the_fitted_prior_beats_the_nominal_one(finished):
    # the machine's parameters are 10 to 20 % off the README's nominal ones, and it has dry friction
    scores = results(finished).evaluation.scores
    (fitted,), (nominal,) = (scores[name].model.rmse.values() for name in ("phy", "phy_nominal"))
    assert fitted < 0.7 * nominal
    fitted = results(finished).prior.fit.values
    # dry friction that the prior lacks biases it a little
    assert fitted["mgl"] == pytest.approx(1.1, rel=0.05)


def test_a_machine_without_plant_says_why_it_has_no_closed_loop(finished):
    control = results(finished).control
    assert control.gap == (None, control.reason)
    assert "no plant" in control.reason
    assert control.step_ms.median > 0


def test_bounds_never_rise(finished):
    (path,) = (finished / "checkpoints" / "training").glob("*/mopgrnn.npz")
    curve = np.load(path)
    for name in ("bound_output", "bound_energy"):
        for stage in (0.0, 1.0):
            bound = curve[f"curve.{name}"][curve["curve.free_run"][:, 0] == stage]
            assert len(bound) >= 2
            assert (np.diff(bound, axis=0) <= 0).all()


@pytest.mark.full
def test_killed_and_resumed_run_equals_the_finished_one(finished, arguments, tmp_path):
    """Also the test of determinism: everything but timing is the same, bit for bit."""
    out = tmp_path / "run"
    command = [sys.executable, "-m", "hybrid_mpc", *arguments, "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + HANGS
    while not list(out.glob("checkpoints/training/*/*.safetensors")):  # in the middle of the training
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (out / "results.json").exists()
    done = subprocess.run([*command, "--resume"], capture_output=True, text=True, timeout=HANGS)
    assert done.returncode == 0, done.stdout + done.stderr
    assert without_timing(out) == without_timing(finished)
    assert (out / "model" / WEIGHTS).read_bytes() == (finished / "model" / WEIGHTS).read_bytes()


@pytest.mark.full
def test_killed_several_times(finished, arguments, tmp_path):
    """At random moments; whatever the moment, --resume finishes the run to the same results."""
    rng, out = np.random.default_rng(0), tmp_path / "run"
    command = [sys.executable, "-m", "hybrid_mpc", *arguments, "--out", str(out)]
    for _ in range(3):
        resume = ["--resume"] if (out / "run.json").is_file() else []
        process = subprocess.Popen(
            [*command, *resume], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(float(rng.uniform(3.0, 25.0)))
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    resume = ["--resume"] if (out / "run.json").is_file() else []
    done = subprocess.run([*command, *resume], capture_output=True, text=True, timeout=HANGS)
    assert done.returncode == 0, done.stdout + done.stderr
    assert without_timing(out) == without_timing(finished)


def test_folder_of_another_run_or_of_something_else(call, arguments, finished, tmp_path):
    code, _, message = call(*arguments, "--out", finished)
    assert code == 2
    assert "--resume" in message
    code, _, message = call("run", "two_tanks", "--out", finished, "--resume")
    assert code == 2
    assert "scenario" in message
    (tmp_path / "letter.txt").write_text("mine")
    code, _, message = call(*arguments, "--out", tmp_path)
    assert code == 2
    assert "HM-FOLDER-002" in message
    code, _, message = call(*arguments, "--out", tmp_path / "fresh", "--resume")
    assert code == 2
    assert "no run to resume" in message


def test_resume_of_a_damaged_checkpoint(call, arguments, finished, tmp_path):
    out = tmp_path / "copy"
    shutil.copytree(finished, out)
    (out / "checkpoints" / "report.json").unlink()
    (out / "checkpoints" / "evaluation.json").write_text("{broken")
    code, _, message = call(*arguments, "--out", out, "--resume")
    assert code == 2
    assert "evaluation.json" in message
    assert "damaged" in message


@pytest.mark.parametrize(
    ("file", "damage", "words"),
    [
        (KIT, lambda b: b[: len(b) // 2], "damaged"),
        (KIT, lambda b: b.replace(b'"schema_version": 6', b'"schema_version": 99'), "schema_version"),
        (PROGRAMS, lambda b: b[: len(b) // 2], "programs.json"),
        (WEIGHTS, lambda b: b[:-8], "weights.safetensors"),
        (WEIGHTS, lambda b: b[:-8] + bytes(8), "weights.safetensors"),
        (PROGRAMS, None, "programs.json"),
    ],
)
def test_damaged_artifact_is_refused(golf_artifact, tmp_path, file, damage, words):
    shutil.copytree(golf_artifact, tmp_path, dirs_exist_ok=True)
    if damage is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_bytes(damage((tmp_path / file).read_bytes()))
    with pytest.raises(InputError, match=re.escape(words)):
        load(tmp_path)


def test_artifact_holds_data_only(finished):
    folder = finished / "model"
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    # no task has a control problem of its own
    watched = {"watch/hybrid.json", "watch/prior.json"}
    assert names == {name for name in OWNERS if "*" not in name} | watched
    artifact = load(finished / "model")
    assert set(artifact.models) == {"hybrid", "prior"}
    assert artifact.models["prior"].n_h == 0
    assert artifact.limits("hybrid").hours > 0
    assert artifact.provenance.data_hash == results(finished).data.hash


def test_the_artifact_holds_the_fitted_parameters_with_what_is_known_of_them(finished):
    fit, model = results(finished).prior.fit, load(finished / "model").models["hybrid"]
    assert {p.name: p.value for p in model.parameters} == fit.values
    assert all(p.lower <= p.value <= p.upper and p.unit for p in model.parameters)
    errors = [fit.standard_errors.get(p.name, 0.0) for p in model.parameters]
    covariance = np.array(model.covariance)
    assert covariance.shape == (model.n_p, model.n_p)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), errors, rtol=1e-12)
    np.testing.assert_allclose(covariance, covariance.T)
    assert min(errors) == 0.0 or np.all(np.linalg.eigvalsh(covariance) > 0)


def test_the_main_job_says_what_its_monitor_lacks(finished):
    found = results(finished).watch
    limits = load(finished / "model").limits("hybrid")
    assert not limits.rated
    assert "need 2.5 min" in limits.method
    assert (found.kind, found.faults) == ("energy", None)
    assert "no plant" in found.faults_reason
    page = (finished / "report.html").read_text()
    assert "1.5 x the highest nominal level" in page


def test_the_folder_alone_is_monitored(call, machine, finished, tmp_path):
    """The machine of the folder is a user's own, so no name says where its scenario is."""
    found = []
    for extra in ((), ("--scenario", machine / "my_machine.py")):
        out = tmp_path / f"out{len(extra)}"
        code, told, error = call("monitor", finished, machine / "monday.csv", "--out", out, *extra)
        assert code == 0, told + error
        found.append(((out / "monitor.json").read_text(), (out / "monday.csv").read_text()))
    assert found[0] == found[1]
    bare = shutil.copytree(finished / "model", tmp_path / "model")
    write_description(bare, replace(read_description(bare), predicting=None))
    code, _, error = call("monitor", bare, machine / "monday.csv", "--out", tmp_path / "none")
    assert code == 2
    assert "--scenario" in error
