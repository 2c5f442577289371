"""Costs on the same seeds: the interval holds although loops stop early, and is little wider than a fixed one."""

import math
from statistics import fmean

import numpy as np
import pytest
from closed_loop_parts import loop_row
from scipy.stats import t as student

from hybrid_mpc.cli.run import comparison_lines
from hybrid_mpc.compare.sequential import SAME, Comparison, compare_costs, looks
from hybrid_mpc.compare.summary import interval, summaries
from hybrid_mpc.workflow.stages.compare import comparisons, decided


@pytest.mark.parametrize("most", range(1, 40))
def test_looks_rise_to_the_most(most):
    found = looks(most)
    assert found[-1] == most
    assert list(found) == sorted(set(found))
    assert len(found) <= 3
    assert min(found) >= min(6, most)


@pytest.mark.parametrize("most", [2, 10, 30])
@pytest.mark.parametrize("true", [1.0, 0.8])
def test_intervals_of_all_looks_hold_the_ratio_together(most, true):
    """Whatever the rule of stopping, the interval at the look where loops stop is one of these."""
    repetitions, rng = 1000, np.random.default_rng(most)
    logs = math.log(true) + 0.3 * rng.standard_normal((repetitions, most))
    missed = 0
    for row in logs:
        every = [compare_costs(np.exp(row[:n]), np.ones(n), most) for n in looks(most)]
        missed += any(not found.low <= true <= found.high for found in every)
    # three standard deviations of a share of 5 %
    assert missed / repetitions <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / repetitions)
    assert missed > 0


def test_one_look_is_student_s_interval():
    logs = np.array([0.1, -0.3, 0.2])
    found = compare_costs(np.exp(logs), np.ones(3), most=3)
    half = student.ppf(0.975, 2) * logs.std(ddof=1) / math.sqrt(3)
    assert (found.low, found.high) == pytest.approx(
        (math.exp(-half), math.exp(half))
    )  # the mean of the logs is zero
    assert found.ratio == pytest.approx(1.0)


def test_what_is_decided():
    assert Comparison(0.5, 0.4, 0.6, 6).finding == "cheaper"
    assert Comparison(2.0, 1.1, 3.0, 6).finding == "more expensive"
    assert Comparison(1.0, 1 - SAME / 2, 1 + SAME / 2, 6).finding == "the same"
    assert Comparison(0.99, 0.985, 0.995, 6).finding == "the same"  # apart, but nobody cares
    assert Comparison(0.9, 0.7, 1.1, 6).finding == Comparison(0.5, None, None, 1).finding == "undecided"


def test_the_terminal_names_the_baseline_that_the_hybrid_does_least_well_against():
    own = {"prior": Comparison(0.5, 0.4, 0.6, 6), "prior_observer": Comparison(0.8, 0.7, 0.9, 6)}
    none_of_it = Comparison(None, None, None, 6, "a loop diverged: the baseline's")
    lost = {"prior": none_of_it, "prior_observer": own["prior"]}
    both = {"prior": none_of_it, "prior_observer": none_of_it}
    assert comparison_lines({"track": own, "stroke": lost, "push": both}) == [
        "track: hybrid_observer / prior_observer 0.8 (0.7 to 0.9), 6 seeds: cheaper",
        "stroke: hybrid_observer / prior_observer 0.5 (0.4 to 0.6), 6 seeds: cheaper",
        "push: hybrid_observer / prior – (a loop diverged: the baseline's), 6 seeds: undecided",
    ]


def test_costs_without_a_ratio_are_told_and_decide_nothing():
    lost = compare_costs([1.0, math.inf], [1.0, 1.0], most=2)
    assert (lost.ratio, lost.reason, lost.decided) == (None, "a loop diverged: its own", False)
    assert compare_costs([1.0, 1.0], [math.inf, 1.0], most=2).reason == "a loop diverged: the baseline's"
    far = compare_costs([1e-3, 1e60], [1.0, 1.0], most=2)  # e to the power of half the width is no number
    assert (far.low, far.high, far.finding) == (None, None, "undecided")
    assert far.words == "3.16e+28 (the ratios scatter too much for an interval)"
    gain = compare_costs([-1.0, 2.0], [1.0, 1.0], most=2)
    assert (gain.ratio, gain.reason, gain.decided) == (None, "a cost is not positive", False)
    single = compare_costs([1.0], [2.0], most=1)
    assert (single.ratio, single.low, single.decided) == (0.5, None, False)
    assert single.words == "0.5 (one seed has no interval)"


@pytest.mark.parametrize(("costs", "base"), [([1.0] * 8, [1.0] * 8), ([1.0] * 7, [1.0] * 10)])
def test_costs_of_no_look_are_refused(costs, base):
    with pytest.raises(ValueError, match=r"\(7, 10\).*HM-COMPARE-021"):
        compare_costs(costs, base, most=10)


def cells(**costs):
    return {
        name: [loop_row(controller=name, seed=i, cost=cost) for i, cost in reversed(list(enumerate(values)))]
        for name, values in costs.items()
    }


def test_a_task_is_decided_where_the_harder_baseline_is():
    noise = np.array([1.0, 1.1, 0.95, 1.02, 0.9, 1.05, 1.0])
    found = cells(hybrid_observer=0.5 * noise, prior_observer=1.0 * noise, prior=1.2 * noise[::-1])
    own = comparisons(found, most=10)
    assert own["prior_observer"].ratio == pytest.approx(0.5)  # pairs are by seed, in whatever order rows come
    assert own["prior"].ratio == pytest.approx(math.exp(fmean(np.log(0.5 * noise / (1.2 * noise[::-1])))))
    assert decided(found, most=10)
    # the prior without observer is the harder one now, and not told apart
    near = cells(
        hybrid_observer=0.5 * noise, prior_observer=1.0 * noise, prior=0.5 * noise[[1, 0, 2, 4, 3, 6, 5]]
    )
    assert not decided(near, most=10)
    # it is the easier one, and its scatter does not matter
    wide = cells(
        hybrid_observer=0.5 * noise, prior_observer=1.0 * noise, prior=[0.4, 9.0, 1.0, 0.1, 2.0, 5.0, 99.0]
    )
    assert not comparisons(wide, most=10)["prior"].decided
    assert decided(wide, most=10)
    # nor does a baseline that diverges
    assert decided(cells(hybrid_observer=0.5 * noise, prior_observer=noise, prior=[math.inf] * 7), most=10)
    assert not decided(cells(hybrid_observer=[math.inf] * 7, prior_observer=noise, prior=noise), most=10)


@pytest.mark.parametrize("most", [4, 10, 30])
def test_mean_costs_of_all_looks_hold_together(most):
    """Of every controller, the oracle's with fewer seeds too: loops may stop at whatever look."""
    repetitions, few, rng = 600, max(2, most // 2), np.random.default_rng(most)
    draws = 5.0 + rng.standard_normal((repetitions, most))
    missed = dict.fromkeys(("hybrid_observer", "oracle"), 0)
    for row in draws:
        found = []
        for n in looks(most):
            costs = {"hybrid_observer": row[:n].tolist(), "oracle": row[: min(n, few)].tolist()}
            rows = [row for own in cells(**costs).values() for row in own]
            (task,) = summaries(rows, most).values()
            found.append({name: task[name].cost for name in costs})
        for name in missed:
            missed[name] += any(abs(look[name].mean - 5.0) > look[name].ci95 for look in found)
    # three standard deviations of a share of 5 %
    for name, count in missed.items():
        assert 0 < count / repetitions <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / repetitions), name


def test_a_fixed_number_of_loops_has_ordinary_intervals():
    costs = [1.0, 1.5, 0.7, 1.1, 0.9, 1.2]
    rows = cells(hybrid_observer=costs)["hybrid_observer"]
    half = {most: summaries(rows, most)[rows[0].task]["hybrid_observer"].cost.ci95 for most in (None, 6, 18)}
    assert half[None] == half[6] == pytest.approx(interval(costs).ci95)
    spread = np.std(costs, ddof=1) / math.sqrt(6)
    assert half[18] == pytest.approx(student.ppf(1 - 0.05 / 6 / 2, 5) * spread)
