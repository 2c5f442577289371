"""The promise about the prior's structure: wrong terms, and missing ones, which a network's gain is a sign of."""

from dataclasses import replace
from pathlib import Path

import pytest

from hybrid_mpc import Promise
from hybrid_mpc.identify.choose import CandidateFigures
from hybrid_mpc.workflow.stages.answers import controller_answer
from hybrid_mpc.workflow.stages.promises import STRUCTURE, structure
from hybrid_mpc.workflow.stages.results import read_results


@pytest.fixture(scope="module")
def results():
    found = read_results(Path(__file__).parents[1] / "golden" / "results.json")
    return replace(found, prior=replace(found.prior, in_doubt=(), lacking=()))


def choice(results, ratio, recommended="phy"):
    own = results.choice.choice
    figures = {**own.candidates, own.hybrid: CandidateFigures(0.05, ratio, ratio, 1.0)}
    return replace(own, recommended=recommended, candidates=figures, sure=())


@pytest.mark.parametrize(("ratio", "named"), [(0.98, False), (0.7, True)])
def test_a_network_with_clearly_less_error_is_a_sign_of_a_missing_term(results, ratio, named):
    row = structure(results.prior, choice(results, ratio))
    assert row.verdict == ("doubted" if named else "shown")
    assert ("hybrid-mpc explain" in row.remedy) == named
    assert (f"{ratio:.2f}" in row.evidence) == named


def test_a_recommended_network_is_one_until_the_search_was_made(results):
    own = choice(results, 0.9, results.choice.choice.hybrid)
    assert structure(results.prior, own).verdict == "doubted"
    row = structure(results.prior, own, ())
    assert (row.verdict, row.remedy) == ("shown", "")
    assert "0.90" in row.evidence


def test_doubts_that_a_missing_term_explains_name_the_search(results):
    lacks = replace(results.prior, in_doubt=("k ends at its bound",), lacking=("k ends at its bound",))
    assert "hybrid-mpc explain" in structure(lacks, choice(results, 1.0)).remedy
    assert "hybrid-mpc explain" not in structure(lacks, choice(results, 1.0), ()).remedy
    wrong = replace(results.prior, in_doubt=("k: its sign seems wrong",))
    row = structure(wrong, choice(results, 1.0))
    assert row.verdict == "doubted"
    assert "hybrid-mpc explain" not in row.remedy


def test_a_term_that_may_be_missing_leaves_tested_loops_as_they_are(results):
    """A wrong structure does not."""
    rows = tuple(
        Promise(STRUCTURE, "doubted", "a term may be missing") if row.name == STRUCTURE else row
        for row in results.promises.rows
    )
    doubted = replace(results, promises=replace(results.promises, rows=rows))
    assert STRUCTURE not in controller_answer(doubted).short
    wrong = replace(doubted, prior=replace(results.prior, in_doubt=("k: its sign seems wrong",)))
    assert STRUCTURE in controller_answer(wrong).short
