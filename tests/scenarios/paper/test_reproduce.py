"""A tiny reproduction from end to end: its files, its resumption, what it refuses."""

import csv
import json
import subprocess
import sys
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from patience import HANGS

from hybrid_mpc import InputError, PriorStep
from scenarios.paper import run as run_module
from scenarios.paper.run import SCHEMA_VERSION, read_results, reproduce, table_of, text_table
from scenarios.paper.settings import ReproductionSettings

from .conftest import Interrupting

MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn", "hybrid")


def without_timing(folder):
    return {k: v for k, v in read_results(folder / "results.json").items() if k != "timing"}


def test_a_row_for_every_model_and_amount(finished):
    results = read_results(finished / "results.json")
    table = table_of(results)
    assert table.models == list(MODELS)
    assert table.sequences == [1, 2]
    for count in (1, 2):
        for model in MODELS:
            cell = table.cell("exact", count, model)
            assert cell.networks == (1 if model.startswith("phy") else 2)
        # nothing is fitted here, so both are the published prior
        assert table.cell("exact", count, "phy") == table.cell("exact", count, "phy_nominal")
        assert table.cell("exact", count, "rnn").mean != table.cell("exact", count, "pgrnn").mean
    assert results["settings"]["effort"]["networks"] == 2
    assert "pysindy" in results["notes"][0]


def test_tables_claims_and_figures_are_written(finished):
    results = read_results(finished / "results.json")
    with (finished / "results.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 2 * len(MODELS)
    first = results["summary"][0]
    assert float(lines[0]["e_sim_s_mean"]) == first["e_sim_s_mean"]
    words = (finished / "claims.txt").read_text().splitlines()
    assert len(words) == len(results["claims"]) + 1  # a line each, and why sindy is not there
    verdicts = ("reproduced: ", "not reproduced: ", "not tested: ")
    assert all(line.startswith(verdicts) for line in words[:-1])
    names = {path.name for path in (finished / "figures").iterdir()}
    assert names == {"e_sim.png", "rmse.png", "energy_violation.png", "free_run_exact.png"}
    assert sum("±" in line for line in text_table(results)) >= 1


def test_the_hybrid_has_as_many_steps_as_the_others(finished):
    for model, free in (("mopgrnn", 0), ("hybrid", 5)):
        curve = np.load(finished / "checkpoints" / f"exact_02_{model}.npz")
        assert curve["curve.step"][-1, 0] == 20
        switched = curve["curve.free_run"][:, 0].any()
        assert switched == (free > 0)


@pytest.mark.full
@pytest.mark.usefixtures("no_sindy")
def test_interrupted_and_resumed_equals_the_finished_one(exact, finished, tmp_path):
    """Also the test of determinism: everything but timing is the same, bit for bit."""
    out, settings = tmp_path / "out", ReproductionSettings(exact)
    with pytest.raises(KeyboardInterrupt):
        reproduce(settings, out, workers=0, progress=Interrupting("exact_01_pgrnn", 10))
    assert (out / "checkpoints" / "exact_01_pgrnn.safetensors").is_file()
    assert not (out / "checkpoints" / "exact_01_pgrnn.json").exists()
    assert not (out / "results.json").exists()
    reproduce(settings, out, workers=0, resume=True)
    assert without_timing(out) == without_timing(finished)
    assert (out / "results.csv").read_bytes() == (finished / "results.csv").read_bytes()


@pytest.mark.full
@pytest.mark.usefixtures("no_sindy")
def test_where_only_the_angle_is_measured(measured, tmp_path):
    results = reproduce(ReproductionSettings(measured), tmp_path / "out", workers=0)
    values = results["priors"]["exact_02_prior"]["values"]
    # two parameters are wrong and free, the data have 0.1 mrad of noise: a fit finds the plant's within a per cent
    assert values["l"] == pytest.approx(0.045, rel=0.01)
    table = table_of(results)
    assert table.cell("exact", 2, "phy").mean < 0.5 * table.cell("exact", 2, "phy_nominal").mean


@pytest.mark.full
def test_sindy_has_a_row_where_it_is_there(exact, tmp_path, monkeypatch):
    def fit(training, prior, dt, *, validation, warm):
        assert len(training) == 1
        step = PriorStep(prior, dt)
        step.text = lambda: ("phi_dot' = u",)
        return step

    fake = types.ModuleType("sindy")
    fake.fit_sindy = fit
    monkeypatch.setitem(sys.modules, "scenarios.paper.sindy", fake)
    monkeypatch.setattr(run_module, "missing_for_sindy", lambda: "")
    monkeypatch.setattr(run_module, "NETWORKS", ("mopgrnn",))
    settings = ReproductionSettings(exact, sequences=(1,), networks=1)
    results = reproduce(settings, tmp_path / "out", workers=0)
    table = table_of(results)
    assert table.cell("exact", 1, "sindy") == table.cell("exact", 1, "phy")
    assert results["details"]["exact_01_sindy"]["equations"] == ["phi_dot' = u"]
    assert results["notes"] == []


@pytest.mark.full
def test_on_the_command_line_with_two_processes(exact, finished, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "hybrid_mpc", "reproduce", exact, "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANGS)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "MOPGRNN" in done.stdout
    found, expected = (table_of(read_results(f / "results.json")) for f in (out, finished))
    for model in MODELS:
        assert found.cell("exact", 2, model) == expected.cell("exact", 2, model)


@pytest.fixture
def call(call):
    """Run the command in this process: ``(exit code, stdout, stderr)``."""
    return partial(call, "reproduce")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["golf_robott"], ["golf_robott", "pendulum"]),
        (["torque_pendulum"], ["no experiment", "golf_robot, pendulum"]),
        (["pendulum", "--sequences", "3,16"], ["3,16", "15"]),
        (["pendulum", "--sequences", "0"], ["between 1 and 15"]),
        (["pendulum", "--sequences", "three"], ["three", "whole numbers"]),
        (["pendulum", "--networks", "0"], ["HM-SCENARIOS-026", "--networks"]),
        (["pendulum", "--budget", "huge"], ["huge", "quick, full"]),
        (["pendulum", "--form", "other"], ["other", "paper"]),
    ],
)
def test_bad_settings(call, tmp_path, words, named):
    code, _, message = call(*words, "--out", tmp_path / "o")
    assert code == 2
    for word in named:
        assert word in message
    assert not (tmp_path / "o").exists()


def test_folder_of_another_reproduction_or_of_something_else(call, exact, finished, tmp_path):
    code, _, message = call(exact, "--out", finished)
    assert code == 2
    assert "--resume" in message
    for option in (["--seed", "7"], ["--networks", "1"], ["--form", "paper"], ["--sequences", "1"]):
        code, _, message = call(exact, "--out", finished, "--resume", *option)
        assert code == 2
        assert option[0].lstrip("-") in message
    code, _, message = call("pendulum", "--out", finished, "--resume")
    assert code == 2
    assert "scenario" in message
    (tmp_path / "letter.txt").write_text("mine")
    code, _, message = call(exact, "--out", tmp_path)
    assert code == 2
    assert "HM-FOLDER-002" in message


def test_results_of_another_schema_are_refused(finished, tmp_path):
    path = Path(tmp_path) / "results.json"
    results = json.loads((finished / "results.json").read_text())
    for change, word in (
        ({"schema": "other"}, "HM-SCENARIOS-022"),
        ({"schema_version": SCHEMA_VERSION + 1}, "version"),
    ):
        path.write_text(json.dumps(results | change))
        with pytest.raises(InputError, match=word):
            read_results(path)
