"""The first screen of a report, and what to do next: answers and hints follow from the run's figures."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc import Promise
from hybrid_mpc.identify.choose import CandidateFigures
from hybrid_mpc.report.page import Hint, Report, render
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.advice import advice
from hybrid_mpc.workflow.stages.answers import answer_all, controller_answer, model_answer, monitor_answer
from hybrid_mpc.workflow.stages.on_model import OnModelResult
from hybrid_mpc.workflow.stages.report import oracle_words
from hybrid_mpc.workflow.stages.results import Results, read_results
from hybrid_mpc.workflow.stages.watch import CleanAlarms

PATH = Path(__file__).parents[1] / "golden" / "results.json"


@pytest.fixture(scope="module")
def results() -> Results:
    """A run of the golf robot in which nothing stands out."""
    found = read_results(PATH)
    quiet = replace(found.watch, clean=CleanAlarms(300.0, 0))
    return replace(steps(found, median=3.0, p99=5.0, max=9.0, misses=0), watch=quiet)


def steps(results: Results, **change: float) -> Results:
    return with_control(results, step_ms=replace(results.control.step_ms, **change))


def with_control(results, **change):
    return replace(results, control=replace(results.control, **change))


def prior(results: Results, **change: object) -> Results:
    return replace(results, prior=replace(results.prior, **change))


def evaluation(results: Results, **change: object) -> Results:
    return replace(results, evaluation=replace(results.evaluation, **change))


def chosen(results: Results, upper: float, ratio: float) -> Results:
    """The fitted prior is recommended, of a hybrid with these figures."""
    choice = results.choice.choice
    own = CandidateFigures(0.1, ratio, upper, 1.0)
    other = replace(choice, recommended="phy", candidates={**choice.candidates, choice.hybrid: own})
    return replace(results, choice=replace(results.choice, choice=other))


def costs(results: Results, task: str, **change: tuple[float, ...]) -> Results:
    """The results with other costs of a task by controller, one for each seed."""
    rows = [
        replace(row, cost=change[row.controller][row.seed])
        if row.task == task and row.controller in change
        else row
        for row in results.control.rows
    ]
    return with_control(results, rows=tuple(rows))


def warned(results: Results, warning: str) -> Results:
    return replace(results, data=replace(results.data, warnings=(warning,)))


def test_how_a_file_was_read_asks_for_nothing(results):
    """A note on the recordings is no hint."""
    noted = replace(
        results, data=replace(results.data, notes=("a.csv: conversions while reading: a decimal comma",))
    )
    assert advice(noted) == advice(results)


def better(results: Results, error: float) -> dict[str, object]:
    """Baselines of which ARX has an error."""
    arx = results.prior.baselines["ARX"]
    assert arx.errors is not None
    return {"ARX": replace(arx, errors=replace(arx.errors, error=error))}


def bad(results: Results) -> list[str]:
    return [hint.finding for hint in advice(results) if hint.verdict == "bad"]


def test_a_run_in_which_nothing_stands_out_says_how_to_go_on(results):
    assert bad(results) == []
    assert [hint.verdict for hint in advice(results)].count("good") == 1
    assert advice(results)[-1].verdict == "good"


def test_each_finding_is_told_with_what_to_do(results):
    slow = steps(results, p99=30.7)
    (said,) = bad(slow)
    assert "30.7 ms" in said
    assert "period is 20 ms" in said
    noisy = replace(results, watch=replace(results.watch, clean=CleanAlarms(250.0, 4)))
    (said,) = bad(noisy)
    assert "false alarms: 4 in 250 s" in said
    within = replace(results.watch, clean=CleanAlarms(250.0, 1))  # 0.14 are to be expected
    assert bad(replace(results, watch=within)) == []
    repeated = warned(results, "monday.csv is nearly constant")
    assert bad(repeated) == ["Recordings: monday.csv is nearly constant"]
    scores, own = results.evaluation.scores, results.choice.choice.recommended
    coarse = replace(scores["phy"], model=replace(scores["phy"].model, fit_percent={"phi [rad]": 41.0}))
    follows = evaluation(results, scores={**scores, "phy": coarse})
    assert bad(follows) == []  # its windows with free first states are explained
    stages = ({"stage": "nominal", "validation_error": 0.5},)
    poor = prior(follows, fit=replace(results.prior.fit, stages=stages))
    assert bad(poor) == ["The fitted prior has a FIT of 41 % on phi: the prior is too coarse."]
    bands = results.evaluation.bands
    thin = evaluation(results, bands={**bands, own: replace(bands[own], coverage=0.6)})
    assert bad(thin) == [
        f"The 90% band of {own.upper()} contains 60% of the test data: the band is too narrow."
    ]
    linear = prior(results, baselines=better(results, 0.02))
    assert bad(linear) == [
        f"On test data the linear model ARX has an error of 0.02, {own.upper()} {scores[own].model.error:.3g}."
    ]
    for case in (slow, noisy, repeated, poor, thin, linear):
        assert all(hint.remedy for hint in advice(case)[:1])


@pytest.mark.parametrize(
    ("ratios", "told"),
    [
        ((1.5, 1.4, 1.6, 1.5, 1.45, 1.55), True), ((1.01, 1.01, 1.011, 1.01, 1.009, 1.01), False),
        ((1.2, 0.8, 1.6, 0.9, 1.4, 1.0), False),
    ],
)  # fmt: skip
def test_a_task_in_which_the_hybrid_costs_more_is_told(results, ratios, told):
    base = tuple(row.cost for row in results.control.rows if row.controller == "prior_observer")[:6]
    dear = tuple(ratio * cost for ratio, cost in zip(ratios, base, strict=True))
    given = {"prior": (1e3,) * 6, "prior_observer": base, "hybrid_observer": dear}
    found = costs(results, "track_sine", **given)
    words = found.control.comparisons["track_sine"]["prior_observer"].words
    said = [f"In track_sine hybrid_observer has {words} times the cost of prior_observer."] if told else []
    assert bad(found) == said


def test_a_hybrid_that_diverges_alone_is_told(results):
    found = costs(results, "track_sine", hybrid_observer=(math.inf,) * 6)
    assert bad(found) == ["In track_sine hybrid_observer diverges."]


def test_doubt_about_the_prior_comes_first_and_is_told_once(results):
    doubt = ("ARX has an error of 0.02, the fitted prior 0.1",)
    repeated = warned(results, "monday.csv is nearly constant")
    for start, others in ((results, []), (repeated, ["Recordings: monday.csv is nearly constant"])):
        said = bad(prior(start, in_doubt=doubt, baselines=better(results, 0.02)))
        assert said == [
            "The structure of the prior is in doubt: ARX has an error of 0.02, the fitted prior 0.1.", *others
        ]  # fmt: skip


def test_noise_that_is_declared_smaller_than_estimated_leaves_room_for_a_better_model(results):
    (error,) = results.evaluation.scores[results.choice.choice.recommended].model.rmse.values()
    found = prior(results, fit=replace(results.prior.fit, sigma=(error / 1.1,)))
    for declared, verdict in ((error / 3.7, "plain"), (error / 1.2, "good"), (error, "good")):
        (hint,) = [one for one in advice(found, declared=(declared,)) if "sensor noise" in one.finding]
        assert hint.verdict == verdict
        assert ("no better model" in hint.remedy) == (verdict == "good")


def test_an_error_that_is_the_sensor_s_noise_is_told(results):
    (error,) = results.evaluation.scores[results.choice.choice.recommended].model.rmse.values()
    said = {
        factor: [
            hint.finding
            for hint in advice(prior(results, fit=replace(results.prior.fit, sigma=(error / factor,))))
            if "noise" in hint.finding
        ]
        for factor in (1.2, 2.0)
    }
    assert said[2.0] == []
    (text,) = said[1.2]
    assert text.startswith(f"The free-run error of phi is {error:.2g} rad: 1.2 times its sensor noise")


@pytest.mark.parametrize(
    ("upper", "ratio", "remedy"),
    [
        (math.inf, 0.7, "three recordings"), (1.1, 0.9, "Record more"),
        (1.5, 1.1, "residuals of the free runs"), (math.inf, math.inf, "shorter free runs"),
    ],
)  # fmt: skip
def test_why_the_prior_is_recommended_says_what_may_help(results, upper, ratio, remedy):
    (hint,) = [h for h in advice(chosen(results, upper, ratio)) if remedy in h.remedy]
    assert hint.verdict == "plain"


def test_the_page_shows_hints_with_their_signs(results):
    page = Report("t", "s", "d", "c", hints=[Hint("bad", "a < b", "mend it"), Hint("good", "fine", "")])
    text = render(page)
    assert "What to do next" in text
    assert "✗</span> a &lt; b" in text
    assert text.index("✗</span>") < text.index("✓</span> fine")
    assert "What to do next" not in render(replace(page, hints=()))


# The answers of the first screen


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
    none, own = replace(results.control, rows=(), reason="no plant"), OnModelResult((), {}, True)
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
