"""``hybrid-mpc study``: run, report, compare, list."""

from functools import partial

import pytest
import trivial_runs

from hybrid_mpc.compare.study import built_in_studies

YAML = "scenario: golf_robot\nmodels: nowhere\ntasks: [track_sine]\ncontrollers: [prior, hybrid]\nseeds: 6\n"


@pytest.fixture
def call(call):
    """Run the command in this process: ``(exit code, stdout, stderr)``."""
    return partial(call, "study")


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(YAML)
    return path


def steps(run):
    """What the report needs beside the cost."""
    return {
        **trivial_runs.trivial(run),
        "timing_step_median_ms": 1.0 + len(run.controller),
        "timing_cpu_s": 0.0,
    }


def test_run_report_compare(call, config, here, tmp_path):
    here(steps)
    first, second = tmp_path / "first", tmp_path / "second"
    for out in (first, second):
        code, told, _ = call("run", config, "--out", out)
        assert code == 0
        assert "hybrid" in told
        assert "results.parquet" in told
    code, told, _ = call("report", first)
    assert code == 0
    assert (first / "report.html").is_file()
    code, told, _ = call("compare", first, second)
    assert code == 0
    assert "difference" in told
    code, _, error = call("run", config, "--out", first)
    assert (code, "--resume" in error) == (2, True)
    assert call("run", config, "--out", first, "--resume")[0] == 0
    assert (code, "did you mean 'cost'" in call("compare", first, second, "--value", "csot")[2]) == (2, True)


def test_a_run_that_raises_makes_the_exit_code(call, config, here, tmp_path):
    here(trivial_runs.raising)
    code, told, _ = call("run", config, "--out", tmp_path / "s")
    assert code == 1
    assert "4 of 12 runs failed" in told
    assert "ZeroDivisionError" in told


def test_list(call):
    code, told, _ = call("list")
    assert code == 0
    for name in built_in_studies():
        assert name in told
    assert "1000 runs" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["plant_variation"], "needs a model"),
        (["plant_variaton", "--model", "m"], "no study 'plant_variaton'"),
        (["none.yaml"], "is missing"),
        (["horizon_size", "--model", "a", "--model", "b"], "LABEL=FOLDER"),
        (["horizon_size", "--model", "nowhere"], "does not exist"),
    ],
)
def test_bad_words(call, tmp_path, words, told):
    code, _, error = call("run", *words, "--out", tmp_path / "s")
    assert code == 2
    assert told in error
    assert not (tmp_path / "s").exists()
