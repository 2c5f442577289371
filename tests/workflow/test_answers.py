"""The first screen of a report: each answer follows from the run's figures, and turns where one of them is bad."""

from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc import Promise
from hybrid_mpc.files import read_object
from hybrid_mpc.report.page import Report, render
from hybrid_mpc.workflow.stages.answers import answer_all, controller_answer, model_answer, monitor_answer
from hybrid_mpc.workflow.stages.report import oracle_words
from hybrid_mpc.workflow.stages.results import Results, read_results
from hybrid_mpc.workflow.stages.watch import CleanAlarms

PATH = Path(__file__).parents[2] / "docs/results/golf_robot_quick.json"


@pytest.fixture(scope="module")
def results() -> Results:
    found = read_results(read_object(PATH), str(PATH))
    return replace(found, timing=replace(found.timing, misses=0))


def lines(answer):
    return " ".join(answer.lines)


def test_a_good_run_is_answered_with_its_figures(results):
    model, controller, monitor = answer_all(results)
    assert [one.verdict for one in (model, controller, monitor)] == ["good", "good", "good"]
    name = results.identification.details.choice.recommended
    (error,) = results.identification.rmse[name].values()
    assert f"{error:.3g} rad" in lines(model)
    assert "the period is 20 ms" in lines(controller)
    found = results.watch.faults
    assert f"{len(found)} of {len(found)} detected" in lines(monitor)


def test_a_model_is_in_doubt_weak_or_diverged(results):
    found = results.identification
    name, details = found.details.choice.recommended, found.details
    doubt = replace(details, prior_parameters=replace(details.prior_parameters, in_doubt=("a sign",)))
    assert model_answer(replace(found, details=doubt)).verdict == "bad"
    weak = replace(found, fit_percent={**found.fit_percent, name: {"phi [rad]": 41.0}})
    assert (model_answer(weak).verdict, model_answer(weak).short) == ("bad", "Weak")
    gone = replace(found, fit_percent={**found.fit_percent, name: None}, rmse={**found.rmse, name: None})
    assert model_answer(gone).verdict == "bad"


def test_a_controller_is_in_doubt_where_a_limit_is_passed_a_step_late_or_a_promise_open(results):
    late = replace(results, timing=replace(results.timing, misses=3))
    assert controller_answer(late).verdict == "bad"
    control = results.control
    task, cells = next(iter(control.details.tasks.items()))
    for change in ({"limits": {"u": 1.04}}, {"sources": {"MPC": 0.9}}):
        name = "hybrid_observer"
        own = {**control.details.tasks, task: {**cells, name: replace(cells[name], **change)}}
        wrong = replace(results, control=replace(control, details=replace(control.details, tasks=own)))
        assert controller_answer(wrong).verdict == "bad", change
    for name, verdict in (("no offset", "bad"), ("innovations", "good")):
        rows = (
            Promise(name, "not promised", "it was not examined"),
            Promise("horizon", "shown", "long enough"),
        )
        open_ = replace(results, promises=replace(results.promises, rows=rows))
        assert controller_answer(open_).verdict == verdict
        assert f"1 of 2 are shown. Open: {name} (not promised)" in lines(controller_answer(open_))


def test_without_a_loop_nothing_is_said_to_be_safe(results):
    none = replace(
        results.control, details=None, gap_closed=None, gap_closed_reason="the scenario has no plant"
    )
    assert controller_answer(replace(results, control=none)).verdict == "plain"


def test_a_monitor_is_judged_by_its_false_alarms_and_by_the_faults_that_it_finds(results):
    found = results.watch
    noisy = replace(found, details=replace(found.details, clean=CleanAlarms(250.0, 4)))
    assert monitor_answer(noisy).verdict == "bad"
    blind = replace(found, faults=(replace(found.faults[0], delay_s=None), *found.faults[1:]))
    assert monitor_answer(blind).verdict == "bad"
    assert f"Not detected: {found.faults[0].title}" in lines(monitor_answer(blind))
    none = replace(found, faults=None, faults_reason="the scenario has no plant")
    assert monitor_answer(none).verdict == "plain"
    assert monitor_answer(replace(found, alarms=None, reason="too little data")).short == "Not examined"


def test_the_answers_come_first_on_the_page_and_hints_after_them(results):
    text = render(Report("t", "s", "the machine", "c", answers=answer_all(results)))
    assert (
        text.index("Is the model good?") < text.index("Is the controller safe?") < text.index("the machine")
    )


def test_an_oracle_that_is_beaten_is_explained(results):
    control = results.control
    task, cells = next(iter(control.details.tasks.items()))
    dear = replace(cells["oracle"], cost=replace(cells["oracle"].cost, mean=1e9))
    tasks = {**control.details.tasks, task: {**cells, "oracle": dear}}
    (said,) = oracle_words(replace(control, details=replace(control.details, tasks=tasks)))
    assert task in said
    cheap = replace(cells["oracle"], cost=replace(cells["oracle"].cost, mean=0.0))
    all_cheap = {name: {**own, "oracle": cheap} for name, own in control.details.tasks.items()}
    assert oracle_words(replace(control, details=replace(control.details, tasks=all_cheap))) == ()
