"""``hybrid-mpc tune``: its files, resuming, what it refuses, and a run with the settings found."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hybrid_mpc import InputError, RunSettings, SearchSpace, load_scenario
from hybrid_mpc.cli.main import app
from hybrid_mpc.files import LOCK, write_json
from hybrid_mpc.folder import JobNote, open_folder
from hybrid_mpc.identify.tune import parsed_space
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import read_network
from hybrid_mpc.workflow.stages.identify import training_settings
from hybrid_mpc.workflow.tune import TuneSettings, read_tuning, usage

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def words(machine):
    """A search of two trials on one recording without its --out."""
    data = ["--data", machine / "monday.csv"]
    vary = ["--vary", "hidden=2:8", "--vary", "horizon=20:60", "--vary", "learning_rate"]
    return ["tune", machine / "my_machine.py", *data, *vary]


@pytest.fixture(scope="module")
def searched(words, tmp_path_factory):
    out = tmp_path_factory.mktemp("search") / "out"
    done = CliRunner().invoke(app, [*map(str, words), "--trials", "2", "--out", str(out)])
    assert done.exit_code == 0, done.output
    return out


@pytest.mark.full
def test_results_are_read_and_written_back(searched, tmp_path):
    results = read_tuning(searched / "results.json")
    write_json(tmp_path / "again.json", results)
    assert (tmp_path / "again.json").read_text() == (searched / "results.json").read_text()
    assert (results.base_settings.kind, isinstance(results.best.values["hidden"], int)) == ("mopgrnn", True)


def trials(results):
    return [{k: v for k, v in row.items() if k != "duration"} for row in results["trials"]]


@pytest.mark.full  # these share one search of 20 s
def test_it_leaves_settings_a_table_and_figures(searched, machine):
    results = json.loads((searched / "results.json").read_text())
    assert (results["schema"], results["kind"], len(results["trials"])) == ("hybrid-mpc tune", "mopgrnn", 2)
    assert results["base_value"] == results["trials"][0]["value"] >= results["best"]["value"]
    with (searched / "trials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["value"]) for r in rows] == [t["value"] for t in results["trials"]]
    assert [float(r["horizon"]) for r in rows] == [t["values"]["horizon"] for t in results["trials"]]
    settings = json.loads((searched / "settings.json").read_text())
    assert settings == results["settings"]
    assert set(settings) == {"hidden", "horizon", "learning_rates"}
    for name in ("tune_history.png", "tune_settings.png"):
        assert (searched / "figures" / name).read_bytes().startswith(PNG)
    assert {p.name for p in searched.iterdir()} - {LOCK} == {
        "run.json", "checkpoints", "tune.jsonl", "results.json", "settings.json", "trials.csv", "figures",
    }  # fmt: skip
    # a run with this file trains what the best trial trained
    settings = RunSettings(str(machine / "my_machine.py"), network_file=searched / "settings.json")
    scenario = load_scenario(str(machine / "my_machine.py"))
    used = training_settings(Context(settings, scenario, searched), "mopgrnn")
    budget = training_settings(
        Context(dataclasses.replace(settings, network_file=None), scenario, searched), "mopgrnn"
    )
    best = SearchSpace(hidden=(2, 8), decay=None, free_run_learning_rate=None, horizon=(20, 60)).apply(
        budget, results["best"]["values"]
    )
    assert used == best


@pytest.mark.full
def test_a_search_goes_on_with_more_trials(searched, words, tmp_path, call):
    out = tmp_path / "out"
    shutil.copytree(searched, out)
    code, told, _ = call(*words, "--trials", 3, "--out", out, "--resume")
    assert code == 0
    assert f"--settings {out}/settings.json" in told
    assert "best: trial" in told
    before, after = (json.loads((d / "results.json").read_text()) for d in (searched, out))
    assert trials(after)[:2] == trials(before)
    assert len(after["trials"]) == 3


@pytest.mark.full
def test_what_is_refused(searched, words, arguments, tmp_path, call):
    new = ["--out", tmp_path / "new"]
    for given, message in (
        ([*words, "--out", searched], "already contains a run"),
        ([*words, "--out", searched, "--resume", "--kind", "rnn"], "kind differ"),
        ([*words, "--out", searched, "--resume", "--seed", "1"], "seed differ"),
        ([*words[:-1], "decay=1:2", "--out", searched, "--resume"], "space differ"),
        ([*map(str, words[:4]), "--out", searched, "--resume"], "space differ"),
        (["run", *map(str, words[1:4]), "--out", searched, "--resume"], "differ). Give the same settings"),
        ([*words, *new, "--kind", "gru"], "HM-WORKFLOW-045"),
        ([*words, *new, "--vary", "units=1:2"], "HM-IDENTIFY-057"),
        ([*words, *new, "--vary", "decay=8:4"], "lower one first"),
        ([*words, *new, "--timeout", "0"], "timeout above 0 s"),
        ([*words, *new, "--budget", "huge"], "no budget 'huge'"),
        ([*arguments, *new, "--settings", tmp_path / "none.json"], "none.json: the file is missing"),
    ):
        code, _, told = call(*given)
        assert code == 2, given
        assert message in told, given
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1]", r"no JSON object.*HM-WORKFLOW-034"),
        ("{", "HM-FILES-017"),
        ('{"hidden": 8, "kind": "rnn"}', r"also kind.*HM-WORKFLOW-034"),
        ('{"hidden": 8.5}', r"whole number.*HM-WORKFLOW-035"),
        ('{"hidden": true}', r"whole number.*HM-WORKFLOW-035"),
        ('{"hidden": 0}', r"whole number.*HM-WORKFLOW-035"),
        ('{"batch": [4]}', r"whole number.*HM-WORKFLOW-035"),
        ('{"decay": -1}', r"0 or more.*HM-WORKFLOW-035"),
        ('{"decay": "a lot"}', r"0 or more.*HM-WORKFLOW-035"),
        ('{"decay": NaN}', r"NaN.*NN-034"),
        ('{"learning_rates": [0.1, 0.1]}', "HM-WORKFLOW-035"),
        ('{"learning_rates": 0.1}', "HM-WORKFLOW-035"),
        ('{"learning_rates": [0.1, 0.1, 0.1, 0]}', "HM-WORKFLOW-035"),
    ],
)
def test_files_of_settings_that_are_none(tmp_path, content, message):
    path = tmp_path / "settings.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message):
        read_network(path)


def test_a_run_without_such_a_file_takes_the_budget_s_settings(tmp_path):
    scenario = load_scenario("golf_robot")
    plain = training_settings(Context(RunSettings("golf_robot"), scenario, tmp_path), "mopgrnn")
    assert (plain.hidden, plain.horizon, plain.batch, plain.validation_horizon) == (8, 50, 32, None)


def test_an_rnn_has_no_prior_to_replay():
    with pytest.raises(InputError, match="HM-WORKFLOW-046"):
        TuneSettings("golf_robot", kind="rnn", space=parsed_space(["prior_replay"]))


def test_prior_replay_reaches_the_training_from_budget_and_file(tmp_path):
    scenario = load_scenario("unbalanced_disk")
    plain = training_settings(Context(RunSettings("unbalanced_disk"), scenario, tmp_path), "mopgrnn")
    assert plain.prior_replay == 10.0
    path = tmp_path / "settings.json"
    path.write_text('{"prior_replay": 0}')
    settings = RunSettings("unbalanced_disk", network_file=path)
    assert training_settings(Context(settings, scenario, tmp_path), "mopgrnn").prior_replay == 0


def test_a_run_is_bound_to_the_content_of_its_file(tmp_path):
    path = tmp_path / "settings.json"
    path.write_text('{"hidden": 8}')
    settings = RunSettings("golf_robot", network_file=path)
    with open_folder(tmp_path / "run", JobNote("run", settings.identity()), resume=False):
        pass
    path.write_text('{ "hidden" : 8 }')
    with open_folder(tmp_path / "run", JobNote("run", settings.identity()), resume=True):
        pass
    path.write_text('{"hidden": 9}')
    for other in (settings, RunSettings("golf_robot")):
        with (
            pytest.raises(InputError, match=r"network_file.*HM-FOLDER-005"),
            open_folder(tmp_path / "run", JobNote("run", other.identity()), resume=True),
        ):
            pass


def test_the_line_to_use_it():
    settings = TuneSettings("a b.py", seed=3, budget="full", time="t")
    assert usage(settings, Path("runs/s")) == (
        "hybrid-mpc run 'a b.py' --time-column t --seed 3 --budget full --settings runs/s/settings.json "
        "--out runs/s-run"
    )
