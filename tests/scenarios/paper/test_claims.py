"""Claims on tables made by hand: reproduced, not reproduced, not tested; and what divergence does to them."""

import math

import pytest

from scenarios.paper.table import Claim, Divergence, Network, Row, Table

AWAY = Divergence("test_01", 7, 0.14, 2)
CALM = {"phy": (1.0, 1.0), "rnn": (0.9, 0.8), "pgrnn": (0.7, 0.5), "mopgrnn": (0.52, 0.5)}


def network(value, steps=None):
    """One with this E_sim; a diverged one for infinity."""
    if math.isinf(value):
        return Network({}, diverged=AWAY)
    return Network({"e_sim_s": value, "energy_violation_w": value / 10}, 1.0, steps)


def table(figures, spread=0.0, steps=None):
    """E_sim of two networks that are ``spread`` apart, with 3 and 15 sequences."""
    rows = []
    for model, values in figures.items():
        for count, value in zip((3, 15), values, strict=True):
            own = spread.get(model, 0.0) if isinstance(spread, dict) else spread
            pair = tuple(network(value + sign * own / 2, (steps or {}).get(model)) for sign in (-1, 1))
            rows.append(Row("a", count, model, pair))
    return Table(rows)


@pytest.mark.parametrize(
    ("check", "holds"),
    [
        (Claim.below("mopgrnn", "phy", 0.46, "a"), True),  # 48 % and 50 %
        (Claim.below("mopgrnn", "phy", 0.49, "a"), False),
        (Claim.below("mopgrnn", "phy", 0.49, "a", at="most"), True),
        (Claim.below("mopgrnn", "phy", 0.49, "a", at="some"), True),
        (Claim.below("mopgrnn", "phy", 0.49, "a", at="least"), False),
        (Claim.below("pgrnn", "rnn", 0.2, "a", metric="energy_violation_w"), True),
        (Claim.below("rnn", "phy", -0.1, "a"), True),
        (Claim.above("rnn", "pgrnn", 0.2, "a"), True),  # 29 % and 60 %
        (Claim.above("rnn", "pgrnn", 0.5, "a"), False),
        (Claim.above("phy", "rnn", 0.2, "a"), False),  # 11 % and 25 %
        (Claim.level("rnn", "phy", 0.2, "a"), True),
        (Claim.level("mopgrnn", "phy", 0.2, "a"), False),
        (Claim.steady("mopgrnn", 0.1, "a"), True),  # 4 %
        (Claim.steady("pgrnn", 0.1, "a"), False),  # 40 %
    ],
)
def test_a_claim_is_checked_by_its_numbers(check, holds):
    assert check(table(CALM)).holds is holds


def test_a_better_model_of_which_a_network_diverged_is_not_better():
    rows = [Row("a", 3, "phy", (network(1.0),)), Row("a", 3, "mopgrnn", (network(0.1), network(math.inf)))]
    verdict = Claim.below("mopgrnn", "phy", 0.4, "a")(Table(rows))
    assert verdict.holds is False
    assert "1 of 2 networks of mopgrnn diverged" in verdict.found


def test_a_model_of_which_all_diverged_is_infinitely_worse():
    lost = table(CALM | {"rnn": (math.inf, math.inf)})
    assert Claim.above("rnn", "phy", 0.23, "a")(lost).holds is True
    assert Claim.below("rnn", "phy", 0.5, "a")(lost).holds is False
    assert Claim.below("pgrnn", "rnn", 0.34, "a")(lost).holds is True
    assert "∞" in Claim.above("rnn", "phy", 0.23, "a")(lost).found
    both = table({"rnn": (math.inf, math.inf), "pgrnn": (math.inf, math.inf)})
    assert Claim.below("pgrnn", "rnn", 0.34, "a")(both).holds is None


def test_deviations_and_order():
    wide = {"phy": 0.0, "rnn": 0.3, "pgrnn": 0.2, "mopgrnn": 0.1}
    assert Claim.narrower("mopgrnn", ("pgrnn", "rnn"), "a")(table(CALM, wide)).holds is True
    assert Claim.narrower("pgrnn", ("mopgrnn", "rnn"), "a")(table(CALM, wide)).holds is False
    one = Table([Row("a", 3, m, (network(0.5),)) for m in ("pgrnn", "mopgrnn")])
    assert Claim.narrower("mopgrnn", ("pgrnn",), "a")(one).holds is None
    falling = CALM | {"mopgrnn": (0.5, 0.4)}
    assert Claim.ordered(("rnn", "pgrnn", "mopgrnn"), "a")(table(falling, wide)).holds is True
    assert Claim.ordered(("pgrnn", "rnn", "mopgrnn"), "a")(table(falling, wide)).holds is False
