"""The first screen of a report: each answer follows from the run's figures, and turns where one of them is bad."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc import Promise
from hybrid_mpc.report.page import Report, render
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.answers import answer_all, controller_answer, model_answer, monitor_answer
from hybrid_mpc.workflow.stages.on_model import OnModelResult
from hybrid_mpc.workflow.stages.report import oracle_words
from hybrid_mpc.workflow.stages.results import Results, read_results
from hybrid_mpc.workflow.stages.watch import CleanAlarms

PATH = Path(__file__).parents[1] / "golden" / "results.json"


@pytest.fixture(scope="module")
def results() -> Results:
    return steps(read_results(PATH), misses=0)


def steps(results, **change):
    return with_control(results, step_ms=replace(results.control.step_ms, **change))


def with_control(results, **change):
    return replace(results, control=replace(results.control, **change))


def with_loops(results, task, name, **change):
    """The results where all loops of a task and controller have other figures."""
    rows = [
        replace(row, **change) if (row.task, row.controller) == (task, name) else row
        for row in results.control.rows
    ]
    return with_control(results, rows=tuple(rows))


def with_scores(results, name, **change):
    found = results.evaluation
    own = found.scores[name]
    scores = {**found.scores, name: replace(own, model=replace(own.model, **change))}
    return replace(results, evaluation=replace(found, scores=scores))


def lines(answer):
    return " ".join(answer.lines)


def test_a_good_run_is_answered_with_its_figures(results):
    model, controller, monitor = answer_all(results)
    assert [one.verdict for one in (model, controller, monitor)] == ["good", "good", "good"]
    (error,) = results.evaluation.scores[results.choice.choice.recommended].model.rmse.values()
    assert f"{error:.3g} rad" in lines(model)
    assert "the period is 20 ms" in lines(controller)
    found = results.watch.faults
    assert f"{len(found)} of {len(found)} detected" in lines(monitor)


def test_a_model_is_in_doubt_weak_or_diverged(results):
    name = results.choice.choice.recommended
    doubt = replace(results, prior=replace(results.prior, in_doubt=("a sign",)))
    assert model_answer(doubt).verdict == "bad"
    weak = model_answer(with_scores(results, name, fit_percent={"phi [rad]": 41.0}))
    assert (weak.verdict, weak.short) == ("bad", "Weak")
    gone = model_answer(
        with_scores(results, name, fit_percent={"phi [rad]": -math.inf}, rmse={"phi [rad]": math.inf})
    )
    assert gone.verdict == "bad"
    assert "phi: a free run diverged; the fitted prior has 0.0154 rad." in gone.lines


def test_a_controller_is_in_doubt_where_a_limit_is_passed_a_step_late_or_a_promise_open(results):
    assert controller_answer(steps(results, misses=3)).verdict == "bad"
    task = results.control.rows[0].task
    sources = dict.fromkeys(results.control.rows[0].sources, 0.0) | {"MPC": 0.9}
    for change in ({"limits": {"u": 1.04}}, {"sources": sources}):
        assert controller_answer(with_loops(results, task, "hybrid_observer", **change)).verdict == "bad", (
            change
        )
    for name, verdict in (("no offset", "bad"), ("innovations", "good")):
        rows = (
            Promise(name, "not promised", "it was not examined"),
            Promise("horizon", "shown", "long enough"),
        )
        open_ = replace(results, promises=replace(results.promises, rows=rows))
        assert controller_answer(open_).verdict == verdict
        assert f"1 of 2 are shown. Open: {name} (not promised)" in lines(controller_answer(open_))


@pytest.mark.parametrize("why", ["no loop", "no stage"])
def test_without_a_loop_nothing_is_said_to_be_safe(results, why):
    none = (
        replace(results.control, rows=(), reason="the scenario has no plant")
        if why == "no loop"
        else Absent("the scenario has no plant")
    )
    answer = controller_answer(replace(results, control=none))
    assert answer.verdict == "plain"
    assert "Closed loops: the scenario has no plant." in answer.lines


def test_loops_on_a_model_show_no_safety_and_long_times_are_in_seconds(results):
    none, own = replace(results.control, rows=(), reason="no plant"), OnModelResult({}, {}, True, ())
    answer = controller_answer(replace(results, control=none, on_model=own))
    assert answer.verdict == "plain"
    assert answer.short.startswith("Not shown")
    slow = controller_answer(steps(results, period=1e4, p99=2.5))
    assert "the period is 10 s." in lines(slow)


def test_a_monitor_is_judged_by_its_false_alarms_and_by_the_faults_that_it_finds(results):
    found = results.watch
    noisy = replace(found, clean=CleanAlarms(250.0, 4))
    assert monitor_answer(noisy).verdict == "bad"
    blind = replace(found, faults=(replace(found.faults[0], delay_s=None), *found.faults[1:]))
    assert monitor_answer(blind).verdict == "bad"
    assert f"Not detected: {found.faults[0].title}" in lines(monitor_answer(blind))
    none = replace(found, faults=None, faults_reason="the scenario has no plant")
    assert monitor_answer(none).verdict == "plain"
    assert "No faults were simulated: the scenario has no plant." in monitor_answer(none).lines
    for short in (replace(found, watch={}, reason="too little data"), Absent("too little data")):
        assert monitor_answer(short).short == "Not examined"
        assert "too little data." in monitor_answer(short).lines


def test_the_answers_come_first_on_the_page_and_hints_after_them(results):
    text = render(Report("t", "s", "the machine", "c", answers=answer_all(results)))
    assert (
        text.index("Is the model good?") < text.index("Is the controller safe?") < text.index("the machine")
    )


def test_an_oracle_that_is_beaten_is_explained(results):
    task = results.control.rows[0].task
    (said,) = oracle_words(with_loops(results, task, "oracle", cost=1e9).control)
    assert task in said
    for name in results.control.means:
        results = with_loops(results, name, "oracle", cost=0.0)
    assert oracle_words(results.control) == ()


def with_limits(found, limits):
    files = {
        name: replace(file, limits={**file.limits, found.kind: limits}) for name, file in found.watch.items()
    }
    return replace(found, watch=files)


def test_a_rate_that_cannot_be_promised_is_told_with_the_hours(results):
    limits = replace(results.watch.limits, rated=False, hours=0.1234, false_alarms_per_hour=10 / 0.96)
    words = lines(monitor_answer(with_limits(results.watch, limits)))
    assert "0.12 h" in words
    assert "10.4" not in words
    rated = replace(limits, rated=True, false_alarms_per_hour=10 / 360)
    assert "at 0.028 false alarms" in lines(monitor_answer(with_limits(results.watch, rated)))


def test_step_times_are_named_by_their_clock(results):
    words = lines(controller_answer(results))
    assert "ms of wall time" in words
    rows = () if isinstance(results.promises, Absent) else results.promises.rows
    assert words.count("Step time under") == sum(row.name == "step time" for row in rows)
