"""The whole way of a prior with a wrong sign: ``check --fit`` and ``run`` name it, or the run stops."""

import html
import re
from dataclasses import replace
from pathlib import Path

import pytest
from machine_runs import finish
from wrong_signs import MACHINE, SIMULATED, TRUTH, WRONG_LOAD, WRONG_TORQUE, written

from hybrid_mpc import InputError, RunSettings, check_fit, load, load_scenario, run
from hybrid_mpc.engine import Progress
from hybrid_mpc.workflow.check_fit import long_windows
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stages.choose import CHOICE
from hybrid_mpc.workflow.stages.promises import STRUCTURE
from hybrid_mpc.workflow.stages.results import read_results

CASES = {"right": MACHINE, "wrong load": WRONG_LOAD, "wrong torque": WRONG_TORQUE}


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """Words of a command line on each machine."""
    return {name: written(tmp_path_factory.mktemp("motor"), text) for name, text in CASES.items()}


def settings(words: list[str]) -> RunSettings:
    return RunSettings(words[0], tuple(Path(word) for word in words[2::2]))


class Told(Progress):
    """Keeps titles of stages and texts of their parts."""

    def __init__(self):
        self.titles, self.texts = [], []

    def start(self, title):
        self.titles.append(title)

    def update(self, key, done, total, text):
        self.texts.append(text)


@pytest.fixture(scope="module")
def told():
    return {name: Told() for name in CASES}


@pytest.fixture(scope="module")
def checked(words, told):
    return {name: check_fit(settings(own), told[name]) for name, own in words.items()}


def test_the_search_for_wrong_terms_reports_its_parts(checked, told):
    searching = {text for text in told["wrong load"].texts if text.startswith("looking for wrong terms: ")}
    assert len(searching) >= 3
    assert not any("free_run" in title for title in told["wrong load"].titles)


def test_long_windows_are_reported_before_the_fit(words, monkeypatch):
    scenario = load_scenario(words["right"][0])
    context = Context(settings(words["right"]), scenario, Path())
    assert long_windows(context) == ""
    monkeypatch.setattr("hybrid_mpc.workflow.check_fit.MANY", 10)
    assert "free_run" in long_windows(context)
    limited = replace(scenario, data=replace(scenario.data, free_run=9.0))
    assert long_windows(Context(settings(words["right"]), limited, Path())) == ""


def test_a_right_prior_is_fitted_and_not_doubted(checked):
    found = checked["right"]
    for name, value in TRUTH.items():
        assert abs(found.fit.values[name] - value) < 5 * found.fit.standard_errors[name]
    assert (found.in_doubt, found.no_gain, found.bounds) == ((), "", ())
    assert found.errors["phy"].error < found.errors["phy_nominal"].error
    assert {name for name, one in found.baselines.items() if one.errors} == {"constant", "ARX", "N4SID"}


@pytest.mark.parametrize(
    ("case", "term", "stops"), [("wrong load", "load", False), ("wrong torque", "torque", True)]
)
def test_a_wrong_sign_is_named_first(checked, case, term, stops):
    found = checked[case]
    assert re.match(rf"\w+ {term} .*sign", found.in_doubt[0])
    assert bool(found.no_gain) == stops
    assert (found.errors["phy"].error > found.baselines["constant"].errors.error) == stops


@pytest.mark.parametrize(("case", "code"), [("right", 0), ("wrong load", 0), ("wrong torque", 2)])
def test_the_command_shows_fit_errors_and_doubts(call, words, case, code):
    done, told, _ = call("check", *words[case], "--fit")
    assert done == code
    lines = [line.split() for line in told.splitlines()]
    (row,) = (line for line in lines if line[:2] == ["J", "0.06"] and "to" in line)
    assert len(row) >= 7  # name, nominal, fitted, standard error, unit of two words, bounds
    assert [line[0] for line in lines if line and line[0] in ("constant", "ARX", "N4SID")] == [
        "constant",
        "ARX",
        "N4SID",
    ]
    assert ("its sign seems wrong" in told) == (case != "right")
    assert ("1 error" in told) == (code == 2)
    assert ("No errors" in told) == (case == "right")
    assert not list(Path(words[case][0]).parent.glob("runs"))


def test_without_recordings_the_command_says_what_it_needs(call, words):
    done, told, _ = call("check", words["right"][0], "--fit")
    assert done == 2
    assert "--data" in told


def test_what_the_recordings_do_not_allow_is_told_by_the_command(call, words, tmp_path):
    rows = Path(words["right"][2]).read_text().splitlines()
    (tmp_path / "short.csv").write_text("\n".join(rows[:20]))
    done, told, _ = call("check", words["right"][0], "--data", tmp_path / "short.csv", "--fit")
    assert done == 2
    assert "1 error" in told


def test_a_simulated_machine_needs_no_recordings(tmp_path, monkeypatch):
    (tmp_path / "motor.py").write_text(SIMULATED)
    monkeypatch.chdir(tmp_path)
    found = check_fit(RunSettings("motor.py"))
    assert found.in_doubt == ()
    assert [path.name for path in tmp_path.iterdir() if path.suffix or path.name in ("data", "runs")] == [
        "motor.py"
    ]


@pytest.fixture(scope="module")
def ran(words, tmp_path_factory):
    """Folder of a run of the machine whose load has the wrong sign, by the command, and what it told."""
    folder = tmp_path_factory.mktemp("ran")
    finish(folder, ["run", *words["wrong load"]], drawn=False)
    return folder


def test_a_run_says_first_that_the_prior_is_in_doubt(ran, checked):
    """Terminal, page, results and kit."""
    (first, *_), sentence = checked["wrong load"].in_doubt, "The structure of the prior is in doubt"
    told = (ran / "told.txt").read_text().splitlines()
    warned = next(line for line in told if "the structure of the prior is in doubt" in line)
    assert first in warned
    assert told.index(warned) < next(i for i, line in enumerate(told) if line.startswith("training"))
    (line,) = (line for line in told if line.startswith(sentence))
    assert first in line
    assert told.index(line) < told.index("free runs on held-out data:")

    page = html.unescape((ran / "run" / "report.html").read_text())
    body = page[page.index("<body>") :]
    assert f"{sentence}: {first}" in body[: body.index("</header>")]

    results = read_results(ran / "run" / "results.json")
    assert results.prior.in_doubt == checked["wrong load"].in_doubt
    choice = results.choice.choice
    assert choice.recommended == "phy" or first in choice.reason

    (row,) = (row for row in load(ran / "run" / "model").promises if row.name == STRUCTURE)
    assert row.verdict == "doubted"
    assert first in row.evidence


def test_a_hybrid_on_a_doubted_prior_is_recommended_with_that_sentence_alone(
    words, checked, tmp_path, jobs_here
):
    """Also where the user asks for it."""
    settings_ = replace(settings(words["wrong load"]), deploy="pgrnn")
    assert run(settings_, tmp_path / "run", only=("data", "prior", "training", "choice")) is None
    context = Context(settings_, load_scenario(settings_.scenario), tmp_path / "run")
    choice = context.read(CHOICE).choice
    assert choice.recommended == "pgrnn"
    assert checked["wrong load"].in_doubt[0] in choice.reason


def test_a_run_stops_where_a_constant_is_better(call, words, checked, tmp_path):
    code, _, told = call("run", *words["wrong torque"], "--out", tmp_path / "run")
    assert code == 2
    for text in (checked["wrong torque"].no_gain, checked["wrong torque"].in_doubt[0]):
        assert " ".join(text.split()) in " ".join(told.split())
    assert not list((tmp_path / "run").glob("checkpoints/prior*"))
    with pytest.raises(InputError, match="HM-WORKFLOW-049"):
        run(settings(words["wrong torque"]), tmp_path / "other")
