"""Closed loops and a real-time run as they were."""

import json

import golden_parts as parts
import numpy as np
import pytest
from golden_parts import PERIODS, Parts, held, under
from scipy.stats import beta

TOLERANCE = 1e-6
"""Share of a signal's largest value. One and two threads give the same bits; other processors' sums change a stroke,
whose weights are of the order of 10^5, by 6e-8, and other loops by 1e-11 (README.md)."""


def notes(m):
    return json.loads((m.folder / "loops.json").read_text())


def test_closed_loops(m):
    for name, loop in m.data["loops"].items():
        result = parts.run_loop(Parts(m, loop["problem"], loop["guard"]), loop, seed=0)
        assert len(result.t) == PERIODS
        assert parts.switches_of(result) == notes(m)["switches"][name]
        until = loop.get("held", PERIODS)  # an unstable loop is the same for a while only
        found, frozen = parts.loop_values(result), under(m.arrays, f"loop/{name}")
        held(*({key: rows[:until] for key, rows in part.items()} for part in (found, frozen)), TOLERANCE)


def test_the_guards_take_every_way():
    """Over both machines: a backup, limits and rest, and back again."""
    seen = {tuple(s[1:3]) for name in parts.MACHINES for found in notes(parts.machine(name))["switches"].values()
            for s in found}  # fmt: skip
    assert {("NORMAL", "BACKUP"), ("NORMAL", "LIMITED"), ("NORMAL", "REST")} <= seen
    assert {"NORMAL"} <= {after for _, after in seen}


def test_the_runner_on_a_virtual_clock(m):
    found, counts = parts.run_real_time(m)
    assert counts == notes(m)["runner"]
    held(found, under(m.arrays, "runner"), TOLERANCE)


def test_the_run_met_what_can_go_wrong(m):
    counts = notes(m)["runner"]
    assert counts["missing"] == len(m.data["runner"]["lost"])
    assert counts["late"] >= 3
    assert counts["skipped"] >= 2
    assert counts["sources"]["PLAN"] >= 3


def binomial(k, n, share=0.95):
    """Counts of ``n`` that a rate within the interval of ``k`` of ``n`` (Clopper and Pearson) makes likely."""
    low = 0.0 if k == 0 else beta.ppf((1 - share) / 2, k, n - k + 1)
    high = 1.0 if k == n else beta.ppf((1 + share) / 2, k + 1, n - k)
    return low * n, high * n


@pytest.mark.full
def test_costs_and_alarms_of_ten_seeds(m):
    wanted = json.loads((m.folder / "costs.json").read_text())
    assert set(wanted) == set(m.data["loops"])
    for name, was in wanted.items():
        found = parts.paired(m, name, range(was["loops"]))
        change = np.mean(np.subtract(found["cost"], was["cost"]))
        # of an unstable loop rounding draws every cost anew: a difference of two means, each with this interval
        assert abs(change) <= np.sqrt(2) * was["ci95"], (name, change, was["mean"])
        for count in ("alarms", "detections", "switched"):
            low, high = binomial(was[count], was["loops"])
            assert low <= found[count] <= high, (name, count, found[count], was[count])
