"""A stage that cannot run costs its own part of the report, and the exit code; what came before is kept."""

import shutil
from dataclasses import replace

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.errors import StorageError
from hybrid_mpc.workflow import run as job
from hybrid_mpc.workflow.run import NAMES, failed_stages
from hybrid_mpc.workflow.stages.results import read_results


def broken(stages, name, error):
    """The job's stages, of which one raises."""

    def raises(context):
        raise error

    return tuple(replace(s, compute=raises) if s.name == name else s for s in stages)


def without(finished, tmp_path, name):
    """A finished run from before a stage."""
    out = shutil.copytree(finished, tmp_path / "run")
    for stage in NAMES[NAMES.index(name) :]:
        (out / "checkpoints" / f"{stage}.json").unlink()
    (out / "report.html").unlink()
    return out


FAIL = ("control", "watch", "analysis")


@pytest.mark.parametrize("names", [FAIL, *(pytest.param((name,), marks=pytest.mark.full) for name in FAIL)])
def test_a_stage_that_cannot_run_leaves_its_reason_and_a_report(
    call, arguments, finished, tmp_path, monkeypatch, names
):
    out = without(finished, tmp_path, names[0])
    stages = job.STAGES
    for name in names:
        stages = broken(stages, name, InputError(f"no {name} on Sundays"))
    monkeypatch.setattr(job, "STAGES", stages)
    others = [word for stage in ("on_model",) for word in ("--skip", stage)]
    code, told, _ = call(*arguments, "--out", out, "--resume", *others)
    assert code == 1
    for name in names:
        assert f"stage {name} failed: no {name} on Sundays" in told
        assert failed_stages(out)[name] == f"no {name} on Sundays"
        assert f"no {name} on Sundays" in (out / "report.html").read_text()
    assert "mopgrnn" in read_results(out / "results.json").evaluation.scores


def test_a_stage_that_later_ones_need_ends_the_run(call, arguments, finished, tmp_path, monkeypatch):
    out = without(finished, tmp_path, "evaluation")
    monkeypatch.setattr(job, "STAGES", broken(job.STAGES, "evaluation", InputError("none")))
    code, _, message = call(*arguments, "--out", out, "--resume")
    assert (code, "error: none" in message) == (2, True)


def test_a_page_is_there_long_before_the_end(call, arguments, finished, tmp_path, monkeypatch):
    """After the fit it has the recordings and the prior, and says that the run goes on; at the end it does not."""
    assert "The run is not finished" not in (finished / "report.html").read_text()
    out = without(finished, tmp_path, "prior")
    monkeypatch.setattr(job, "STAGES", broken(job.STAGES, "training", InputError("none")))
    assert call(*arguments, "--out", out, "--resume")[0] == 2
    page = (out / "report.html").read_text()
    assert "The run is not finished" in page
    assert "standard error" in page  # of the prior's parameters
    assert "Closed loops" not in page


def test_a_full_disk_is_no_reason_to_go_on(call, arguments, finished, tmp_path, monkeypatch):
    out = without(finished, tmp_path, "watch")
    error = StorageError("cannot write watch.json: No space left on device")
    monkeypatch.setattr(job, "STAGES", broken(job.STAGES, "watch", error))
    code, _, message = call(*arguments, "--out", out, "--resume")
    assert code == 2
    assert "No space left" in message
    assert "finished stages are saved; repeat the command with --resume" in message
    assert not (out / "checkpoints" / "watch.json").exists()
