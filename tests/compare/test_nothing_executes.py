"""A name that stands in a file loads no code: only registered scenarios, and files that the user types himself."""

import json
import shutil
from dataclasses import replace

import pytest

from hybrid_mpc import InputError, Provenance, run_study
from hybrid_mpc.compare.study import read_study
from hybrid_mpc.kit.parts import read_description, write_description
from tests.trivial_runs import stand_in, study, trivial


@pytest.fixture
def trap(tmp_path):
    """A Python file that leaves a mark when it is run."""
    path, mark = tmp_path / "trap.py", tmp_path / "executed"
    path.write_text(f"open({str(mark)!r}, 'w')\nfrom scenarios.golf_robot import scenario\n")
    return path, mark


@pytest.fixture
def model(golf_artifact, trap, tmp_path):
    """A model folder that names the file as its scenario."""
    folder = tmp_path / "model"
    shutil.copytree(golf_artifact, folder)
    write_description(folder, replace(read_description(folder), provenance=Provenance(str(trap[0]))))
    return folder


def recording(tmp_path):
    path = tmp_path / "today.csv"
    path.write_text("time_s,u_nm,phi_rad\n" + "".join(f"{0.02 * k:.2f},0.1,0.1\n" for k in range(500)))
    return path


@pytest.mark.parametrize("command", ["monitor", "analyze"])
def test_a_model_folder_executes_nothing(call, model, trap, tmp_path, command):
    data = [recording(tmp_path)] if command == "monitor" else []
    code, _, message = call(command, model, *data, "--out", tmp_path / "out")
    assert code == 2
    assert "HM-SCENARIO-004" in message
    assert "--scenario FILE.py" in message
    assert not trap[1].exists()
    assert not (tmp_path / "out").exists()


def test_what_the_user_types_is_run(call, model, trap, tmp_path):
    """With another name than the model's it is refused, but it was the user's own word to run it."""
    code, _, message = call("analyze", model, "--scenario", trap[0], "--out", tmp_path / "out")
    assert code == 2
    assert "not for 'golf_robot'" in message
    assert trap[1].exists()


def test_control_takes_the_scenario_from_the_command_line_alone(call, model, trap, tmp_path):
    code, _, message = call("control", "golf_robot", "--model", model, "--out", tmp_path / "out")
    assert code == 2
    assert "HM-COMPARE-017" in message
    assert not trap[1].exists()


@pytest.mark.parametrize("command", [["report"], pytest.param(["compare"], marks=pytest.mark.full)])
def test_a_study_folder_executes_nothing(call, monkeypatch, trap, tmp_path, command):
    stand_in(monkeypatch, trivial)
    folder = tmp_path / "study"
    run_study(study(4), folder, workers=1)
    (folder / "results.parquet").unlink()
    note = json.loads((folder / "study.json").read_text())
    note["study"]["scenario"] = str(trap[0])
    (folder / "study.json").write_text(json.dumps(note))
    call("study", *command, *[folder] * (1 + (command == ["compare"])))
    assert not trap[1].exists()


def test_a_study_file_executes_nothing(call, trap, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(f"scenario: {trap[0]}\nmodels: model\n")
    with pytest.raises(InputError, match="HM-SCENARIO-004"):
        read_study(path)
    code, _, message = call("study", "run", path, "--out", tmp_path / "out")
    assert code == 2
    assert "--scenario FILE.py" in message
    assert not trap[1].exists()
    assert read_study(path, scenario=str(trap[0])).size > 0
    assert trap[1].exists()
