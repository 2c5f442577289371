"""Study files and folders that are wrong, damaged or made to do harm: each ends with a message, soon."""

import random
import shutil

import pytest
import yaml

from hybrid_mpc import run_study
from tests.fuzz.forked import command, refused
from tests.trivial_runs import stand_in, study, trivial

GOOD = {
    "scenario": "golf_robot", "models": {"model": "model"}, "tasks": ["track_sine"], "controllers": ["prior"],
    "solvers": ["rti"], "horizons": [20], "monitors": ["own"], "faults": ["plant_friction=2@1"], "vary": {"m": 0.2},
    "draws": 2, "seeds": 2, "seed": 0, "duration": 1.0, "name": "mine",
    "random_faults": {"kinds": [{"target": "input_gain", "low": 0.5, "high": 0.9}], "at_once": [1, 1]},
}  # fmt: skip
ODD = [
    None, True, "on", "", "no such", -1, 10**30, 1e308, float("inf"), float("nan"), 2.5, [], [[]], {}, [None], [True],
    [10**30], [-1], ["a", "a"], {"a": None}, {"a": {"b": "c"}}, "2024-01-01", "1:30", [{"target": 5}], "x" * 5000,
    10**9,
]  # fmt: skip
RAW = {
    "nothing": "", "a text": "hello", "a list": "- 1\n- 2\n", "tabs": "a:\t- b\n\tc: d",
    "a tag": "a: !!python/object:os.x {}", "an alias": "a: &x [1]\nb: *x\n", "a file": "../x",
    "applied": "scenario: !!python/object/apply:os.system ['touch executed']",
    "laughs": "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n", "twice": "seeds: 1\nseeds: 2\n",
    "deep": "[" * 30_000, "deep mapping": "a: " + "{a: " * 5000, "long": "seeds: [" + "1, " * 40_000 + "]",
    "control": "a: \x07", "a script": "scenario: trap.py\nmodels: model\n",
    "merge": "<<: {seeds: 3}\nscenario: golf_robot\nmodels: m\n",
    "a date": "scenario: golf_robot\nmodels: m\nname: 2024-01-01\nseeds: 2024-01-01\n",
    "unknown": "scenario: golf_robot\nmodels: m\nhorizon: 5\n",
    "a number as a key": "1: 2\nscenario: golf_robot\nmodels: m\n",
}  # fmt: skip


@pytest.mark.parametrize("name", RAW)
def test_what_is_no_study(golf_artifact, tmp_path, name):
    path = tmp_path / "mine.yaml"
    path.write_text(RAW[name])
    (tmp_path / "trap.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')")
    refused(command("study", "run", path, "--out", tmp_path / "out"), name)
    assert not (tmp_path / "executed").exists()
    assert not (tmp_path / "out").exists()


@pytest.mark.full
@pytest.mark.parametrize("key", GOOD)
def test_fields_that_do_not_fit(golf_artifact, tmp_path, key):
    """Every field in turn; what is valid all the same ends at the model, which does not exist."""
    for odd in ODD:
        path = tmp_path / "mine.yaml"
        path.write_text(yaml.safe_dump({**GOOD, key: odd}))
        refused(command("study", "run", path, "--out", tmp_path / "out"), f"{key}: {str(odd)[:50]}")


@pytest.mark.full
def test_folders_of_studies_that_are_damaged(monkeypatch, tmp_path):
    stand_in(monkeypatch, trivial)
    made, rng = tmp_path / "study", random.Random(5)
    run_study(study(20), made, workers=1)
    tried = 0
    for name in ("study.json", "runs/000000.jsonl"):
        content = (made / name).read_bytes()
        for i in range(20):
            at = rng.randrange(len(content) - 1)
            damaged = (
                content[:at],
                content[:at] + rng.randbytes(4) + content[at + 4 :],
                content[:at] + content[at + 9 :],
            )[i % 3]
            if damaged == content:
                continue
            folder = shutil.copytree(made, tmp_path / "copy", dirs_exist_ok=True)
            (folder / "results.parquet").unlink(missing_ok=True)
            (folder / name).write_bytes(damaged)
            for words in (["report", folder], ["compare", folder, made]):
                ended = command("study", *words)
                assert "Traceback" not in ended.told, f"{name}, {i}:\n{ended.told}"
                # a log that ends with a torn line is whole
                assert ended.code in (0, 2), f"{name}, {i}:\n{ended.told}"
                tried += 1
    assert tried > 60
