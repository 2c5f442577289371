"""Do no harm: a hybrid is recommended where it surely beats the prior, and nowhere else."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t as student

from hybrid_mpc import ChoiceRule, InputError
from hybrid_mpc.identify.choose import CandidateFigures, evidence_of, recommend


def runs(rng, n=4, size=1.0, length=200):
    """Squared errors of ``n`` runs."""
    return [size * np.square(rng.standard_normal(length)) for _ in range(n)]


def test_a_hybrid_that_halves_the_error_is_recommended():
    rng = np.random.default_rng(0)
    prior = runs(rng)
    choice = recommend(
        {"phy": prior, "pgrnn": [0.25 * r for r in prior], "mopgrnn": [0.16 * r for r in prior]}
    )
    assert choice.recommended == choice.hybrid == "mopgrnn"
    assert choice.candidates["pgrnn"].ratio == pytest.approx(0.5)
    assert choice.candidates["mopgrnn"].ratio == pytest.approx(0.4)  # roots of the squares' ratios
    assert choice.candidates["mopgrnn"].upper == pytest.approx(
        0.4
    )  # the same share in every block: no scatter
    assert "0.40 times the prior's" in choice.reason


def test_a_hybrid_that_is_better_by_chance_is_not():
    """With equal errors a hybrid must be recommended in about a twentieth of the cases: 50 of 1000, at most 80 by four
    standard deviations and the jackknife's own error of some per cent."""
    rng = np.random.default_rng(1)
    chosen = [recommend({"phy": runs(rng), "pgrnn": runs(rng)}).recommended for _ in range(1000)]
    assert 20 <= chosen.count("pgrnn") <= 80


def test_one_recording_that_is_much_better_does_not_make_it_sure():
    rng = np.random.default_rng(2)
    prior = runs(rng, n=8)
    hybrid = [1.05 * r for r in prior]
    hybrid[0] = 0.01 * prior[0]
    prior[0] = prior[0] * 3.0
    choice = recommend({"phy": prior, "pgrnn": hybrid})
    assert choice.candidates["pgrnn"].ratio < 1.0 < choice.candidates["pgrnn"].upper
    assert choice.recommended == "phy"
    assert "is not significantly better" in choice.reason


def test_of_a_single_recording_each_left_out_part_is_a_piece_of_evidence():
    of = {name: SimpleNamespace(file=name) for name in ("monday", "tuesday")}
    one = [(0, [of["monday"]] * 2), (1, [of["monday"]])]
    assert evidence_of(one) == (["part 0", "part 0", "part 1"], "parts of one recording")
    both = [(0, [of["monday"]]), (1, [of["tuesday"]])]
    assert evidence_of(both) == (["monday", "tuesday"], "recordings")
    assert evidence_of([(None, [of["monday"]] * 3)]) == (["monday"] * 3, "recordings")  # nothing was left out


def test_blocks_of_one_part_do_not_make_a_hybrid_sure():
    """Two of four parts are much better, two a little worse; the ten runs of a part say the same thing ten times."""
    rng = np.random.default_rng(4)
    prior = runs(rng, n=40)
    hybrid = [(0.2 if i < 10 else 1.05) * r for i, r in enumerate(prior)]
    hybrid = [0.6 * r if 10 <= i < 20 else r for i, r in enumerate(hybrid)]
    given = {"phy": prior, "pgrnn": hybrid}
    assert recommend(given).recommended == "pgrnn"
    parts = [f"part {i // 10}" for i in range(40)]
    found = recommend(given, recordings=parts, evidence="parts of one recording")
    assert found.recommended == "phy"
    assert "4 parts of one recording" in found.reason


def test_a_hybrid_that_diverges_is_never_recommended():
    rng = np.random.default_rng(3)
    prior = runs(rng)
    bad = [0.1 * r for r in prior]
    bad[1] = np.full(200, np.inf)
    choice = recommend({"phy": prior, "pgrnn": bad})
    assert choice.recommended == "phy"
    assert "diverge" in choice.reason
    good = recommend({"phy": bad, "pgrnn": prior})  # and a prior that diverges is beaten by what does not
    assert good.recommended == "pgrnn"


def test_the_user_overrules():
    rng = np.random.default_rng(4)
    prior = runs(rng)
    errors = {"phy": prior, "pgrnn": [2.0 * r for r in prior], "mopgrnn": [0.5 * r for r in prior]}
    choice = recommend(errors, deploy="pgrnn")
    assert choice.recommended == choice.hybrid == "pgrnn"
    assert choice.reason.startswith("pgrnn is deployed as requested. mopgrnn is recommended")
    kept = recommend(errors, deploy="phy")
    assert (kept.recommended, kept.hybrid) == ("phy", "mopgrnn")
    with pytest.raises(InputError, match=r"'rnn'.*HM-IDENTIFY-003"):
        recommend(errors, deploy="rnn")


def test_one_block_tells_nothing_of_its_scatter():
    choice = recommend({"phy": [np.ones(5)], "pgrnn": [0.1 * np.ones(5)]}, samples=5)
    assert choice.blocks == 1
    assert choice.candidates["pgrnn"].upper == np.inf
    assert choice.recommended == "phy"


def test_recordings_count_alike_however_far_off_the_prior_is():
    """The prior is far off in one of six recordings, which the hybrid mends; in the others it does no better."""
    rng = np.random.default_rng(6)
    prior = [10.0 * own if i == 0 else own for i, own in enumerate(runs(rng, n=6))]
    hybrid = [
        0.01 * prior[0],
        *(factor * own for factor, own in zip((1.0, 1.1, 0.9, 1.05, 0.95), prior[1:], strict=True)),
    ]
    names = [f"file{i}" for i in range(6)]
    by_block = recommend({"phy": prior, "pgrnn": hybrid})
    choice = recommend({"phy": prior, "pgrnn": hybrid}, recordings=names)
    assert choice.candidates["pgrnn"].error == pytest.approx(by_block.candidates["pgrnn"].error)
    assert by_block.recommended == "pgrnn"  # blocks of all recordings together are ruled by the first
    assert choice.recommended == "phy"
    assert "6 recordings" in choice.reason
    # the bound by hand: mean and standard deviation of the logarithms, Student's quantile 2.015 of five degrees
    logs = 0.5 * np.log([0.01, 1.0, 1.1, 0.9, 1.05, 0.95])
    assert choice.candidates["pgrnn"].ratio == pytest.approx(np.exp(logs.mean()))
    upper = np.exp(logs.mean() + 2.015 * logs.std(ddof=1) / np.sqrt(6))
    assert choice.candidates["pgrnn"].upper == pytest.approx(upper, rel=1e-3)
    # harm by hand: Student's distribution beyond log 1.05
    harm = student.cdf((logs.mean() - np.log(1.05)) / (logs.std(ddof=1) / np.sqrt(6)), 5)
    assert choice.candidates["pgrnn"].harm == pytest.approx(harm)
    assert (
        f"is {np.exp(logs.mean()):.2f} times the prior's (upper bound {upper:.2f}, "
        f"probability of harm {100 * harm:.0f} %; 6 recordings, their geometric mean)" in choice.reason
    )
    better = [0.25 * own for own in prior]
    assert recommend({"phy": prior, "pgrnn": better}, recordings=names).recommended == "pgrnn"


def test_the_bound_is_that_of_the_mean_over_recordings_and_both_must_be_better():
    """Much better in all but the loudest recording, which rules the sum: the bound is not raised to the sum's ratio."""
    prior = runs(np.random.default_rng(8), n=8)
    prior[0] = 1000.0 * prior[0]
    factors = [1.1**2] + [0.2**2 * (1 + 0.01 * i) for i in range(7)]
    errors = {"phy": prior, "pgrnn": [factor * own for factor, own in zip(factors, prior, strict=True)]}
    choice = recommend(errors, recordings=[f"file{i}" for i in range(8)])
    own = choice.candidates["pgrnn"]
    assert own.ratio < own.upper < 1.0
    assert own.error > choice.candidates["phy"].error  # over all together it is worse: the rule is no looser
    assert choice.recommended == "phy"
    assert "the prior's error over all these data together is not larger" in choice.reason


def test_of_two_sure_hybrids_the_one_of_the_lower_ratio_is_taken():
    """One recording has nearly all of the error: there ``mopgrnn`` is better, in all seven others ``pgrnn`` is."""
    prior = [np.full(60, 100.0 if i == 0 else 1.0) for i in range(8)]
    factors = {"pgrnn": [0.7] + [0.3] * 7, "mopgrnn": [0.6] + [0.6] * 7}
    errors = {"phy": prior} | {
        name: [f * own for f, own in zip(by, prior, strict=True)] for name, by in factors.items()
    }
    choice = recommend(errors, recordings=[f"file{i}" for i in range(8)])
    found = choice.candidates
    assert choice.sure == ("pgrnn", "mopgrnn")
    assert found["pgrnn"].error > found["mopgrnn"].error
    assert found["pgrnn"].ratio < found["mopgrnn"].ratio
    assert choice.recommended == choice.hybrid == "pgrnn"


def test_two_recordings_give_no_bound():
    """However well they agree; of three the bound is a number."""
    prior = runs(np.random.default_rng(9), n=3)
    errors = {"phy": prior, "pgrnn": [0.25 * own for own in prior]}
    two = recommend({name: own[:2] for name, own in errors.items()}, recordings=["a", "b"])
    assert two.candidates["pgrnn"].ratio == pytest.approx(0.5)
    assert two.candidates["pgrnn"].upper == np.inf
    assert two.recommended == "phy"
    assert "no upper bound: too few data; 2 recordings" in two.reason
    assert recommend(errors, recordings=["a", "b", "c"]).recommended == "pgrnn"


def blended(prior, hybrid):
    """Squared errors of a share of the way from one run's errors to another's, by run."""
    return lambda name, share: [
        np.square((1 - share) * a + share * b) for a, b in zip(prior, hybrid[name], strict=True)
    ]


def test_a_share_of_a_correction_is_taken_where_the_whole_is_not_sure():
    """What the hybrid adds helps in all recordings, and scatters so that the whole is no better."""
    rng = np.random.default_rng(5)
    prior = [1.0 + 0.1 * rng.standard_normal(200) for _ in range(6)]
    hybrid = {"pgrnn": [0.3 + size * rng.standard_normal(200) for size in (0.6, 0.8, 1.0, 1.2, 0.7, 0.9)]}
    of = [f"{i}" for i in range(6)]
    given = {"phy": [r**2 for r in prior], "pgrnn": [r**2 for r in hybrid["pgrnn"]]}
    alone = recommend(given, recordings=of)
    assert (alone.recommended, alone.share("pgrnn")) == ("phy", 1.0)
    tried = []

    def shrunk(name, share):
        tried.append((name, share))
        return blended(prior, hybrid)(name, share)

    found = recommend(given, recordings=of, shrunk=shrunk)
    assert found.recommended == "pgrnn"
    assert found.share("pgrnn") == tried[-1][1] < 1
    assert [share for _, share in tried] == [s for s in (0.75, 0.5) if s >= found.share("pgrnn")]
    assert found.candidates["pgrnn"].upper < 1 <= alone.candidates["pgrnn"].upper
    assert f"with {found.share('pgrnn'):g} of its correction" in found.reason
    assert found.share("phy") == 1


def test_no_share_of_what_does_not_help_is_taken():
    """A correction that points the wrong way is worse by every share; its own figures are told, those of the whole."""
    rng = np.random.default_rng(6)
    prior = [1.0 + 0.1 * rng.standard_normal(200) for _ in range(6)]
    hybrid = {"pgrnn": [1.2 + 0.1 * rng.standard_normal(200) for _ in range(6)]}
    given = {"phy": [r**2 for r in prior], "pgrnn": [r**2 for r in hybrid["pgrnn"]]}
    found = recommend(given, recordings=[f"{i}" for i in range(6)], shrunk=blended(prior, hybrid))
    assert (found.recommended, found.share("pgrnn")) == ("phy", 1.0)
    assert found.candidates["pgrnn"].ratio == pytest.approx(1.2, abs=0.02)


def test_of_what_is_no_better_few_are_taken_by_chance():
    """Half a correction is exactly as good as the prior, the others are worse: about a twentieth of 300 choices may
    take one, 18 by 6 %; 4 standard deviations of that to either side."""
    rng, size, taken = np.random.default_rng(8), 0.6, 0
    along = -0.25 * size  # by a share s the mean square is 1 + 2 s size along + (s size)^2
    for _ in range(300):
        prior = [rng.standard_normal(200) for _ in range(6)]
        across = [rng.standard_normal(200) for _ in prior]
        hybrid = {
            "pgrnn": [
                r + size * (along * r + np.sqrt(1 - along**2) * z) for r, z in zip(prior, across, strict=True)
            ]
        }
        given = {"phy": [r**2 for r in prior], "pgrnn": [r**2 for r in hybrid["pgrnn"]]}
        found = recommend(given, recordings=[f"{i}" for i in range(6)], shrunk=blended(prior, hybrid))
        taken += found.recommended == "pgrnn"
    assert 3 <= taken <= 34


def test_a_prior_that_diverges_has_no_figures():
    rng = np.random.default_rng(9)
    bad = [np.full(100, np.inf), *runs(rng, n=2, length=100)]
    found = recommend({"phy": bad, "pgrnn": [np.full(100, np.inf), *bad[1:]]}, recordings=["a", "b", "c"])
    assert found.candidates["phy"] == CandidateFigures(np.inf, np.inf, np.inf)
    assert found.candidates["pgrnn"].upper == np.inf
    assert found.recommended == "phy"


def test_the_hybrid_that_is_exported_is_the_recommended_one():
    """The MOPGRNN has the lower error, and is sure of nothing: two recordings rule it."""
    prior = [np.full(100, 1.0) for _ in range(6)]
    sure, unsure = (
        [0.95 * r for r in prior],
        [0.01 * prior[0], *(1.2 * r for r in prior[1:5]), 0.01 * prior[5]],
    )
    of = [f"{i}" for i in range(6)]
    found = recommend({"phy": prior, "pgrnn": sure, "mopgrnn": unsure}, recordings=of)
    assert found.candidates["mopgrnn"].error < found.candidates["pgrnn"].error
    assert found.sure == ("pgrnn",)
    assert found.recommended == found.hybrid == "pgrnn"
    asked = recommend({"phy": prior, "pgrnn": sure, "mopgrnn": unsure}, recordings=of, deploy="phy")
    assert (asked.recommended, asked.hybrid) == ("phy", "pgrnn")
    none = recommend({"phy": prior, "pgrnn": [1.1 * r for r in prior], "mopgrnn": unsure}, recordings=of)
    assert (none.recommended, none.hybrid) == ("phy", "mopgrnn")


def test_a_rule_asks_for_more_evidence_for_fewer_recordings_and_for_other_shares():
    """Mean log ratio -0.25, standard error 0.1: beyond Student's 95 % point (2.13), not beyond that of 99 % (3.75)."""
    rng = np.random.default_rng(0)
    logs = rng.standard_normal(5)
    logs = (logs - logs.mean()) / logs.std(ddof=1) * 0.1 * math.sqrt(5) - 0.25
    prior = [np.ones(100) for _ in logs]
    errors = {"phy": prior, "pgrnn": [np.full(100, math.exp(2 * v)) for v in logs]}
    names = [f"file{i}" for i in range(5)]

    def upper(**rule):
        found = recommend(errors, recordings=names, rule=ChoiceRule(**rule))
        return found.candidates["pgrnn"].upper, found.recommended

    assert upper(confidence=0.95)[1] == "pgrnn"
    assert upper(confidence=0.99)[1] == "phy"
    assert upper(confidence=0.95)[0] == pytest.approx(math.exp(-0.25 + student.ppf(0.95, 4) * 0.1))
    assert math.isinf(upper(fewest=6)[0])
    asked = []
    recommend(
        errors, recordings=names, rule=ChoiceRule(confidence=0.99, shares=(0.3,)),
        shrunk=lambda name, share: asked.append(share) or errors[name],
    )  # fmt: skip
    assert asked == [0.3]


def test_a_limit_above_one_recommends_the_best_expectation_if_harm_is_improbable():
    prior = runs(np.random.default_rng(8), n=6)
    factors = (0.3, 0.5, 0.6, 0.95, 1.1, 0.8)
    errors = {"phy": prior, "pgrnn": [f**2 * own for f, own in zip(factors, prior, strict=True)]}
    names = [f"file{i}" for i in range(6)]
    safe, expected = (
        recommend(errors, recordings=names, rule=rule)
        for rule in (ChoiceRule(confidence=0.99), ChoiceRule(confidence=0.9, limit=1.05))
    )
    assert (safe.recommended, safe.confidence) == ("phy", 0.99)
    assert (expected.recommended, expected.confidence) == ("pgrnn", 0.9)
    own = expected.candidates["pgrnn"]
    # the bound at 90 % is below 1.05 where the probability of a larger ratio is below 10 %
    assert (own.upper < 1.05) == (own.harm < 0.1)
    assert own.harm == pytest.approx(safe.candidates["pgrnn"].harm)


def test_no_output_gets_much_worse_for_the_others_sake():
    rng = np.random.default_rng(3)
    prior = [np.square(rng.standard_normal((100, 2))) for _ in range(5)]
    names = [f"file{i}" for i in range(5)]

    def chosen(factor, **rule):
        hybrid = [own * np.array([0.01, factor**2]) for own in prior]
        return recommend({"phy": prior, "pgrnn": hybrid}, recordings=names, rule=ChoiceRule(**rule))

    good, bad, allowed = chosen(1.05), chosen(1.2), chosen(1.2, each=1.25)
    assert [one.recommended for one in (good, bad, allowed)] == ["pgrnn", "phy", "pgrnn"]
    assert bad.candidates["pgrnn"].worst == pytest.approx(1.2)
    assert bad.candidates["pgrnn"].upper < 1.0
    assert "that of an output is 1.20 times the prior's" in bad.reason
    prior[0][:, 1] = np.nan  # an output without samples in a recording
    assert chosen(1.2).candidates["pgrnn"].worst == pytest.approx(1.2)
