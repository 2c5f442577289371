"""What to do next: each finding of a run becomes a hint with a remedy, and nothing else does."""

from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc.compare.sequential import Comparison
from hybrid_mpc.compare.summary import Mean
from hybrid_mpc.files import read_object
from hybrid_mpc.report.page import Hint, Report, render
from hybrid_mpc.workflow.stages.advice import advice
from hybrid_mpc.workflow.stages.results import CandidateErrors, Results, StepTimes, read_results
from hybrid_mpc.workflow.stages.watch import CleanAlarms

PATH = Path(__file__).parents[2] / "docs/results/golf_robot_quick.json"


@pytest.fixture(scope="module")
def results() -> Results:
    """A run of the golf robot in which nothing stands out."""
    found = read_results(read_object(PATH), str(PATH))
    quick = replace(found.timing, controller_step_ms=StepTimes(median=3.0, p99=5.0, max=9.0))
    quiet = replace(found.watch, details=replace(found.watch.details, clean=CleanAlarms(300.0, 0)))
    return replace(found, timing=quick, watch=quiet)


def changed(results: Results, **details: object) -> Results:
    found = results.identification
    return replace(results, identification=replace(found, details=replace(found.details, **details)))


def chosen(results: Results, upper: float | None, ratio: float | None) -> Results:
    """The fitted prior is recommended, of a hybrid with these figures."""
    choice = results.identification.details.choice
    own = CandidateErrors(None if ratio is None else 0.1, ratio, upper, 1.0)
    candidates = {**choice.candidates, choice.hybrid: own}
    return changed(results, choice=replace(choice, recommended="phy", candidates=candidates))


def bad(results: Results) -> list[str]:
    return [hint.finding for hint in advice(results) if hint.verdict == "bad"]


def test_a_run_in_which_nothing_stands_out_says_how_to_go_on(results):
    assert bad(results) == []
    assert [hint.verdict for hint in advice(results)].count("good") == 1
    assert advice(results)[-1].verdict == "good"


def test_each_finding_is_told_with_what_to_do(results):
    slow = replace(results, timing=replace(results.timing, controller_step_ms=StepTimes(p99=30.7)))
    (said,) = bad(slow)
    assert "30.7 ms" in said
    assert "period is 20 ms" in said
    noisy = replace(results, watch=replace(
        results.watch, details=replace(results.watch.details, clean=CleanAlarms(250.0, 4))
    ))  # fmt: skip
    (said,) = bad(noisy)
    assert "false alarms: 4 in 250 s" in said
    within = replace(noisy.watch.details, clean=CleanAlarms(250.0, 1))  # 0.14 are to be expected
    assert bad(replace(noisy, watch=replace(noisy.watch, details=within))) == []
    warned = replace(results, data=replace(
        results.data, details=replace(results.data.details, warnings=("monday.csv is nearly constant",))
    ))  # fmt: skip
    assert bad(warned) == ["Recordings: monday.csv is nearly constant"]
    found = results.identification
    follows = replace(results, identification=replace(
        found, fit_percent={**found.fit_percent, "phy": {"phi [rad]": 41.0}}
    ))  # fmt: skip
    assert bad(follows) == []  # its windows with free first states are explained
    stages = ({"stage": "nominal", "validation_error": 0.5},)
    poor = changed(follows, prior_parameters=replace(found.details.prior_parameters, stages=stages))
    assert bad(poor) == ["The fitted prior has a FIT of 41 % on phi: the prior is too coarse."]
    bands = found.details.bands
    own = found.details.choice.recommended
    thin = changed(results, bands={**bands, own: replace(bands[own], coverage=0.6)})
    assert bad(thin) == [f"The 90% band of {own.upper()} contains 60% of the test data: it is too narrow."]
    arx = found.details.baselines["ARX"]
    assert arx.errors is not None
    linear = changed(results, baselines={"ARX": replace(arx, errors=replace(arx.errors, error=0.02))})
    error = found.error[own]
    assert bad(linear) == [
        f"On test data the linear model ARX has an error of 0.02, {own.upper()} {error:.3g}."
    ]
    control = results.control
    assert control.details is not None
    for ratio, said_of in ((Comparison(1.5, 1.2, 1.9, 6), ["has 1.5 (1.2 to 1.9) times the cost of prior_observer."]),
                           (Comparison(1.01, 1.005, 1.015, 6), []), (Comparison(1.2, 0.9, 1.6, 6), [])):  # fmt: skip
        own = {"prior": Comparison(0.5, 0.4, 0.6, 6), "prior_observer": ratio}
        dear = replace(results, control=replace(
            control, details=replace(control.details, comparisons={"track_sine": own})
        ))  # fmt: skip
        assert bad(dear) == [f"In track_sine hybrid_observer {said}" for said in said_of]
    cells = control.details.tasks["track_sine"]
    gone = {**cells, "hybrid_observer": replace(cells["hybrid_observer"], cost=Mean(None, None, 6))}
    none = Comparison(None, None, None, 6, "a loop diverged, its own")
    lost = replace(results, control=replace(control, details=replace(
        control.details, comparisons={"track_sine": {"prior": none, "prior_observer": none}},
        tasks={**control.details.tasks, "track_sine": gone},
    )))  # fmt: skip
    assert bad(lost) == ["In track_sine hybrid_observer diverges."]
    assert all(
        hint.remedy for case in (slow, noisy, warned, poor, thin, linear, lost) for hint in advice(case)[:1]
    )


def test_doubt_about_the_prior_comes_first_and_is_told_once(results):
    found = results.identification
    prior = replace(
        found.details.prior_parameters, in_doubt=("ARX has an error of 0.02, the fitted prior 0.1",)
    )
    arx = found.details.baselines["ARX"]
    assert arx.errors is not None
    better = {"ARX": replace(arx, errors=replace(arx.errors, error=0.02))}
    warned = replace(results, data=replace(
        results.data, details=replace(results.data.details, warnings=("monday.csv is nearly constant",))
    ))  # fmt: skip
    for start, others in ((results, []), (warned, ["Recordings: monday.csv is nearly constant"])):
        said = bad(changed(start, prior_parameters=prior, baselines=better))
        assert said == [
            "The structure of the prior is in doubt: ARX has an error of 0.02, the fitted prior 0.1.", *others
        ]  # fmt: skip


def test_an_error_that_is_the_sensor_s_noise_is_told(results):
    found = results.identification
    (error,) = found.rmse[found.details.choice.recommended].values()
    said = {
        factor: [
            hint.finding
            for hint in advice(
                changed(results, smoother=replace(found.details.smoother, sigma=(error / factor,)))
            )
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
        (None, 0.7, "three recordings"), (float("inf"), 0.7, "three recordings"), (1.1, 0.9, "Record more"),
        (1.5, 1.1, "residuals of the free runs"), (None, None, "shorter free runs"),
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
