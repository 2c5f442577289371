"""The quick set of benchmarks/faulted_loops.py: random faults in motion, on the prior and a small hybrid."""

import importlib.util
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import OCP

PATH = Path(__file__).parents[2] / "benchmarks" / "faulted_loops.py"


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("faulted_loops", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_ten_loops_survive(bench, golf_artifact):
    # three of these have forced failures, one a frozen encoder, two single dropouts
    rows, figures = bench.run(10, 9, golf_artifact, say=lambda text: None)
    assert figures["exceptions"] == 0, [row.error for row in rows]
    assert figures["not_finite"] == 0
    assert figures["largest_excess_nm"] <= 1e-12  # rounding of the slew, a difference of inputs below 1 N m
    assert figures["shares"]["outside_forced"]["MPC"] >= 0.9
    assert figures["steps"] == 10 * bench.PERIODS
    assert figures["moving"] == 1.0
    assert set(figures["loops_by_model"]) == {"prior", "hybrid"}
    assert figures["forced_steps"] > 0
    assert figures["shares"]["forced"]["MPC"] == 0.0
    assert bench.passed(figures)
    for worse in ({"exceptions": 1}, {"largest_excess_nm": 1e-6}, {"not_finite": 1}):
        assert not bench.passed({**figures, **worse})


def test_draws_are_reproducible_and_cover_the_catalogue(bench):
    draws = [bench.drawn(seed) for seed in range(200)]
    assert draws[7] == bench.drawn(7)
    kinds = Counter(kind for draw in draws for kind in draw.kinds)
    assert set(kinds) == set(bench.KINDS)
    for draw in draws:
        assert draw.faults or draw.late
        assert 1.4 <= draw.start < 2.0
    signs = {np.sign(f.value) for draw in draws for f in draw.faults if f.target == "plant_push"}
    assert signs == {-1.0, 1.0}


def test_a_loop_that_fails_is_counted(bench, golf_artifact):
    loops = bench.Loops(golf_artifact)
    broken = replace(bench.drawn(3), faults=(bench.Fault(0.0, 1.0, "plant_fire"),))
    row = loops.run(broken, "prior")
    assert "plant_fire" in row.error
    figures = bench.summary([row])
    assert figures["exceptions"] == 1
    assert not bench.passed(figures)


def test_limits_are_looked_at(bench):
    ocp = OCP(5, [1.0], [1.0], [0.0], [-0.5], [0.5], du_max=[0.25])
    assert bench._excess(np.array([[0.25], [0.5], [0.3]]), ocp) <= 0.0
    assert bench._excess(np.array([[0.25], [0.6]]), ocp) == pytest.approx(0.1)
    assert bench._excess(np.array([[0.3], [0.3]]), ocp) == pytest.approx(0.05)
    beside_zero = OCP(5, [1.0], [1.0], [0.0], [2.0], [4.0], du_max=[0.25])
    assert bench._excess(np.array([[2.0], [2.25]]), beside_zero) <= 0.0  # from rest on, which is 2
