"""What to do next: each finding of a run becomes a hint with a remedy, and nothing else does."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc.identify.choose import CandidateFigures
from hybrid_mpc.report.page import Hint, Report, render
from hybrid_mpc.workflow.stages.advice import advice
from hybrid_mpc.workflow.stages.results import Results, read_results
from hybrid_mpc.workflow.stages.watch import CleanAlarms

PATH = Path(__file__).parents[1] / "golden" / "results.json"


@pytest.fixture(scope="module")
def results() -> Results:
    """A run of the golf robot in which nothing stands out."""
    found = read_results(PATH)
    quiet = replace(found.watch, clean=CleanAlarms(300.0, 0))
    return replace(steps(found, median=3.0, p99=5.0, max=9.0), watch=quiet)


def steps(results: Results, **change: float) -> Results:
    control = results.control
    return replace(results, control=replace(control, step_ms=replace(control.step_ms, **change)))


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
    return replace(results, control=replace(results.control, rows=tuple(rows)))


def warned(results: Results, warning: str) -> Results:
    return replace(results, data=replace(results.data, warnings=(warning,)))


def test_how_a_file_was_read_asks_for_nothing(results):
    """A note on the recordings is no hint."""
    noted = replace(results, data=replace(results.data, notes=("a.csv: as it was read: a decimal comma",)))
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
    assert bad(thin) == [f"The 90% band of {own.upper()} contains 60% of the test data: it is too narrow."]
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
