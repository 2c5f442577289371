"""Means, intervals and paired differences against theory; comparison of studies; the report."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from hybrid_mpc import InputError, StudyResults, run_study, write_study_report
from hybrid_mpc.compare.study_log import ModelNote, NoiseNote, StudyNote, intact
from hybrid_mpc.plots import studies as plots
from tests.trivial_runs import stand_in, study, trivial

NOTE = StudyNote(
    {"name": "mine", "scenario": "golf_robot", "faults": [[], [{"target": "x", "value": 1.0}]]},
    "Golf robot", "It putts.", {"model": ModelNote("0", {}, NoiseNote("a run", {}))}, 80, {"hybrid-mpc": "0"},
)  # fmt: skip


def table(draws=10, seeds=2, shift=0.3, model="model", gain=1.0):
    """Runs of two controllers: cost = a draw's own + a seed's own + ``shift`` for the hybrid + noise."""
    rng, found = np.random.default_rng(0), []
    for draw in range(draws):
        machine = rng.normal(10.0, 3.0)
        for seed in range(seeds):
            luck = rng.normal(0.0, 0.5)
            for task in ("track_sine", "stroke_1.4"):
                for controller in ("prior", "hybrid"):
                    own = rng.normal(0.0, 0.1) - (shift if controller == "hybrid" else 0.0)
                    found.append({
                        "id": f"{model}{len(found)}", "model": model, "task": task, "controller": controller,
                        "solver": "rti", "horizon": np.nan, "monitor": "own", "faults": "none",
                        "drawn_faults": f"push {draw}", "draw": draw, "seed": seed, "status": "done", "error": "",
                        "factor_m": 1.0 + 0.01 * draw, "cost": gain * (machine + luck + own), "share_MPC": 1.0,
                        "task_speed_error_rel": 0.01 if task == "stroke_1.4" else np.nan, "timing_cpu_s": 1.0,
                        "timing_step_median_ms": 2.0 if controller == "hybrid" else 1.0, "hidden_units": 32,
                    })  # fmt: skip
    return pd.DataFrame(found)


def results(**given):
    return StudyResults(table(**given), NOTE, Path("."))


def test_intervals_are_students_over_draws():
    r = results()
    assert r.factors == ["task", "controller"]
    found = r.summary().set_index(["task", "controller"]).loc[("track_sine", "prior")]
    rows = r.table[(r.table.task == "track_sine") & (r.table.controller == "prior")]
    means = rows.groupby("draw")["cost"].mean()
    low, high = stats.t.interval(0.95, len(means) - 1, means.mean(), stats.sem(means))
    assert found["n"] == 10  # draws, not runs: two seeds of a draw share the machine
    assert (found["mean"], found["low"], found["high"]) == pytest.approx((means.mean(), low, high), rel=1e-12)
    assert found["left_out"] == 0


def test_seeds_are_the_units_where_there_is_one_draw():
    r = results(draws=1, seeds=6)
    assert set(r.summary()["n"]) == {6}
    assert np.isnan(results(draws=1, seeds=1).summary()["low"]).all()


def test_pairs_find_what_means_do_not():
    r = results()
    found = r.paired(base="prior").set_index("task").loc["track_sine"]
    rows = r.table[r.table.task == "track_sine"]
    wide = rows.pivot_table(index="draw", columns="controller", values="cost")
    test = stats.ttest_rel(wide["hybrid"], wide["prior"]).confidence_interval(0.95)
    assert found["difference"] == pytest.approx((wide["hybrid"] - wide["prior"]).mean(), rel=1e-12)
    assert (found["low"], found["high"]) == pytest.approx((test.low, test.high), rel=1e-9)
    assert found["high"] < 0.0  # the shift of 0.3 is seen through machines that differ by 3
    assert found["relative"] == pytest.approx(found["difference"] / wide["prior"].mean())
    assert found["ratio"] == pytest.approx(stats.gmean(wide["hybrid"] / wide["prior"]))
    summary = r.summary(by=["controller"]).set_index("controller")
    assert summary.loc["hybrid", "high"] > summary.loc["prior", "low"]  # the means' intervals overlap
    back = r.paired(base="hybrid").set_index("task").loc["track_sine"]
    assert back["difference"] == pytest.approx(-found["difference"])
    assert found["better"] + back["better"] == pytest.approx(1.0)


def test_a_failed_run_leaves_its_pair_out():
    data = table(draws=1, seeds=5)
    data.loc[(data.controller == "hybrid") & (data.seed == 2), ["status", "cost"]] = ["failed", np.nan]
    r = StudyResults(data, NOTE, Path("."))
    assert len(r.failed) == 2
    assert set(r.paired()["n"]) == {4}
    assert set(r.summary().set_index("controller").loc["hybrid", "left_out"]) == {1}
    assert set(r.summary().set_index("controller").loc["prior", "n"]) == {5}


def test_studies_are_compared_run_by_run():
    one, other = results(model="z16"), results(model="z32", gain=1.1)
    found = one.compare(other)
    assert found.attrs["differs"] == {"model": ("z16", "z32")}
    assert found["relative"].to_numpy() == pytest.approx(0.1)
    assert found["ratio"].to_numpy() == pytest.approx(1.1)
    assert set(found["n"]) == {10}
    assert one.compare(results(model="z16"))["difference"].abs().max() == 0.0
    half = StudyResults(other.table[other.table.draw < 4], NOTE, Path("."))
    assert set(one.compare(half)["n"]) == {4}
    strange = StudyResults(other.table.assign(draw=other.table.draw + 99), NOTE, Path("."))
    with pytest.raises(InputError, match="HM-COMPARE-052"):
        one.compare(strange)


def test_unknown_figures_and_levels():
    with pytest.raises(InputError, match=r"did you mean 'cost'.*HM-RECORDS-011"):
        results().summary("costs")
    with pytest.raises(InputError, match=r"controller.*'pid'.*HM-COMPARE-051"):
        results().paired(base="pid")
    with pytest.raises(InputError, match=r"column.*'colour'.*HM-RECORDS-011"):
        results().paired(over="colour")


def test_report(tmp_path):
    data = table()
    failure = "failed", np.nan, "Traceback ...\nZeroDivisionError: <cursed>"
    data.loc[3, ["status", "cost", "error"]] = failure
    path = write_study_report(StudyResults(data, NOTE, tmp_path))
    page = path.read_text()
    assert path == tmp_path / "report.html"
    assert page.count("<img") == 3
    assert "ZeroDivisionError: &lt;cursed&gt;" in page
    assert "speed_error_rel" in page
    assert "Paired differences" in page
    # a page of one controller has nothing to compare
    alone = StudyResults(data[data.controller == "prior"], NOTE, tmp_path)
    assert write_study_report(alone, tmp_path / "alone.html").read_text().count("<img") == 2
    nothing = StudyResults(data[:0], NOTE, tmp_path)
    with pytest.raises(InputError, match="HM-COMPARE-053"):
        write_study_report(nothing)


def test_plots_leave_out_what_is_not_finite():
    values = {"a": {"prior": np.array([1.0, np.inf, 3.0]), "hybrid": np.array([np.nan])}, "b": {}}
    figure = plots.distributions(values, "cost")
    (middle,) = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert middle.get_xdata()[0] == 2.0
    figure = plots.pareto(
        {"a": {"x": (1.0, 5.0), "y": (2.0, 6.0), "z": (3.0, 1.0), "w": (4.0, np.nan)}}, "cost"
    )
    steps = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    # y is dearer and slower than x
    assert [tuple(p) for p in steps[0].get_xydata()] == [(1.0, 5.0), (3.0, 1.0)]
    for draw, nothing in (
        (plots.distributions, {"a": {"x": np.array([np.nan])}}),
        (plots.differences, {"a": {"x": (np.nan, 0.0, 0.0)}}),
        (plots.pareto, {"a": {"x": (np.nan, 1.0)}}),
    ):
        with pytest.raises(InputError, match="no finite"):
            draw(nothing, "cost")


@pytest.mark.full
def test_a_damaged_table_is_made_of_the_log_again(monkeypatch, tmp_path):
    """Report, comparison and resumption go on from the log, which has every row."""
    stand_in(monkeypatch, trivial)
    whole = run_study(study(6), tmp_path / "s", workers=1)
    path = tmp_path / "s" / "results.parquet"
    content = path.read_bytes()
    for damage in (content[:50], content[: len(content) // 2] + bytes(len(content) // 2), b"", b"PAR1" * 10):
        path.write_bytes(damage)
        found = StudyResults.load(tmp_path / "s")
        assert found.table["cost"].tolist() == whole.table["cost"].tolist()
    again = run_study(study(6), tmp_path / "s", workers=1, resume=True)
    assert again.table["cost"].tolist() == whole.table["cost"].tolist()
    assert intact(path)
