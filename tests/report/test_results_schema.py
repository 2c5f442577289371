"""results.json holds the stages' dataclasses; what does not fit is refused by name, and the page lists all keys."""

import json
import runpy
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.files import write_json
from hybrid_mpc.records import plain
from hybrid_mpc.workflow.run import STAGES
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.results import SCHEMA_VERSION, SHOWN, read_results

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "tests" / "golden" / "results.json"
SCHEMA = runpy.run_path(str(ROOT / "docs" / "site" / "results_schema.py"))


@pytest.fixture
def changed(tmp_path):
    """Reads the demo's results after a change of the document."""

    def read(path, value):
        document = json.loads(RESULTS.read_text())
        *groups, key = path.split(".")
        place = document
        for group in groups:
            place = place[group]
        if value is None:
            del place[key]
        else:
            place[key] = value
        file = tmp_path / "results.json"
        file.write_text(json.dumps(document))
        return read_results(file)

    return read


def test_results_are_read_and_written_back(tmp_path):
    results = read_results(RESULTS)
    write_json(tmp_path / "again.json", plain(results))
    assert (tmp_path / "again.json").read_text() == RESULTS.read_text()
    assert read_results(tmp_path / "again.json") == results


def test_a_stage_s_object_is_that_of_its_checkpoint():
    """Every stage is in it that finds something, with the fields of its result alone; arrays are not."""
    document = json.loads(RESULTS.read_text())
    named = {stage.name: stage for stage in SHOWN}
    assert {stage.name for stage in STAGES} - set(named) == {"tasks", "report"}
    for name, stage in named.items():
        keys = set(document[name])
        assert keys in ({"reason", "failed"}, set(SCHEMA["fields_of"](stage.result))), name
    assert "arrays" not in RESULTS.read_text()


def test_a_stage_without_a_result_has_its_reason(changed):
    found = changed("watch", plain(Absent("no plant", failed=True)))
    assert found.watch == Absent("no plant", failed=True)
    assert replace(found, watch=read_results(RESULTS).watch) == read_results(RESULTS)


@pytest.mark.parametrize(
    "path", ["data.hash", "prior.fit", "evaluation.scores", "control.step_ms.p99", "seed"]
)
def test_what_is_missing_unknown_or_of_a_wrong_kind_is_named(changed, path):
    with pytest.raises(InputError, match=f"{path.split('.')[-1]} is missing.*HM-RECORDS-003"):
        changed(path, None)
    with pytest.raises(InputError, match=r"HM-RECORDS-0(06|02|12)"):
        changed(path, [])
    with pytest.raises(InputError, match=r"HM-RECORDS-011"):
        changed(f"{path}_", 3)


@pytest.mark.parametrize("version", [11, SCHEMA_VERSION + 1, "12", [1]])
def test_another_version_is_refused_with_what_to_do(changed, version):
    with pytest.raises(InputError, match=r"--resume.*HM-WORKFLOW-040"):
        changed("schema_version", version)


def test_the_page_is_made_of_the_dataclasses():
    """``python docs/site/results_schema.py > docs/results-schema.md`` writes it."""
    assert (ROOT / "docs" / "results-schema.md").read_text() == SCHEMA["page"]()
