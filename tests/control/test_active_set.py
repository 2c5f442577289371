"""Quadratic programs by active sets, against DAQP with a slack for every penalised row."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc.model.active_set import ActiveSet, RowQP


def random_qp(seed, n=12, m=40):
    """A problem with bounds, and rows along a smooth curve, so that many of them compete; the last half penalised."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    a = np.cumsum(rng.normal(size=(m, n)), axis=0) / 3
    lower, upper = -rng.uniform(0.2, 1.0, size=n + m), rng.uniform(0.2, 1.0, size=n + m)
    lower[n + 10 :: 3] = -np.inf
    linear, give = np.full(n + m, np.inf), np.zeros(n + m)
    soft = np.arange(n + m // 2, n + m)
    linear[soft], give[soft] = (
        10 ** rng.uniform(-1, 2, size=soft.size),
        10 ** rng.uniform(-2, 1, size=soft.size),
    )
    # the penalised rows may lie apart, so that they must give way
    shift = rng.normal(size=soft.size) * (seed % 3)
    lower[soft] += shift
    upper[soft] += shift
    return RowQP(root @ root.T + 0.1 * np.eye(n), 5 * rng.normal(size=n), a, lower, upper, linear, give)


def by_daqp(qp):
    """Unknowns by DAQP, with two slacks for every penalised row."""
    n, m = qp.g.size, len(qp.a)
    soft = np.flatnonzero(np.isfinite(qp.linear[n:]))
    h = np.diag(np.concatenate([np.zeros(n), np.tile(1.0 / qp.give[n + soft], 2)]))
    h[:n, :n] = qp.h
    a = np.zeros((m, n + 2 * soft.size))
    a[:, :n] = qp.a
    a[soft, n + np.arange(soft.size)] = -1.0
    a[soft, n + soft.size + np.arange(soft.size)] = 1.0
    given = {
        "h": h, "g": np.concatenate([qp.g, np.tile(qp.linear[n + soft], 2)]), "a": a,
        "lba": qp.lower[n:], "uba": qp.upper[n:],
        "lbx": np.concatenate([qp.lower[:n], np.zeros(2 * soft.size)]),
        "ubx": np.concatenate([qp.upper[:n], np.full(2 * soft.size, np.inf)]),
    }  # fmt: skip
    sparsity = {"h": ca.DM(h).sparsity(), "a": ca.Sparsity.dense(*a.shape)}
    solver = ca.conic("reference", "daqp", sparsity, {"error_on_fail": True, "daqp": {"primal_tol": 1e-10}})
    return solver(**{k: ca.DM(v) for k, v in given.items()})["x"].full().ravel()[:n]


def near(qp, seed):
    """The rows that act in a problem a few per cent off: what the last period's plan knows of this one's."""
    g = qp.g * (1 + 0.05 * np.random.default_rng(seed).normal(size=qp.g.size))
    return ActiveSet(replace(qp, g=g)).solve().active


@pytest.mark.parametrize("method", ["all_at_once", "one_at_a_time"])
def test_answers_are_those_of_daqp_with_slacks(method):
    solved, beyond, met = 0, 0, 0
    for seed in range(40):
        qp = random_qp(seed)
        found = getattr(ActiveSet(qp), method)(near(qp, seed))
        if found is None:  # all_at_once may fail
            continue
        solved += 1
        assert max(qp.residuals(found.s, found.multipliers)) < 1e-9  # rounding in an H of condition 1e3
        # of DAQP's two tolerances of 1e-10 and 1e-6, the second in the multipliers
        np.testing.assert_allclose(found.s, by_daqp(qp), atol=1e-6)
        beyond += np.any(np.abs(found.active) == 2)
        met += np.any(np.abs(found.active[found.multipliers != 0]) == 1)
    assert solved == 40 or (method == "all_at_once" and solved > 25)
    assert min(beyond, met) > 10  # rows of each kind act


@pytest.mark.parametrize("seed", range(10))
def test_any_start_leads_to_the_answer(seed):
    qp = random_qp(seed)
    rng = np.random.default_rng(seed)
    start = rng.integers(-1, 2, size=qp.lower.size).astype(np.int8)
    start[~np.isfinite(qp.lower) & (start < 0)] = 0
    np.testing.assert_allclose(ActiveSet(qp).solve(start).s, ActiveSet(qp).solve().s, atol=1e-10)


def test_rows_that_say_the_same_are_no_trouble():
    """Dependent rows: the dual has many answers, the unknowns one."""
    one, inf = np.ones((3, 1)), np.full(4, np.inf)
    qp = RowQP(
        np.eye(1), np.array([-3.0]), one, np.full(4, -1.0), np.array([2.0, 1.0, 1.0, 1.0]), inf, np.zeros(4)
    )
    found = ActiveSet(qp).solve()
    assert found.s == pytest.approx([1.0], abs=1e-12)
    assert max(qp.residuals(found.s, found.multipliers)) < 1e-12


def test_hard_rows_that_contradict_each_other_are_told():
    inf = np.full(2, np.inf)
    qp = RowQP(
        np.eye(1),
        np.zeros(1),
        np.ones((1, 1)),
        np.array([1.0, -3.0]),
        np.array([2.0, -2.0]),
        inf,
        np.zeros(2),
    )
    found = ActiveSet(qp).solve()
    assert qp.residuals(found.s, found.multipliers)[2] > 0.5


def test_a_hessian_that_is_none_gives_no_numbers():
    no = np.zeros((0, 1))
    qp = RowQP(-np.eye(1), np.zeros(1), no, -np.ones(1), np.ones(1), np.full(1, np.inf), np.zeros(1))
    assert np.all(np.isnan(ActiveSet(qp).solve().s))


def test_a_row_that_hardly_depends_on_the_unknowns_is_kept_as_exactly():
    inf, no, upper = np.full(2, np.inf), np.zeros(2), np.array([9.0, 1e-3 - 5e-10])
    found = ActiveSet(RowQP(np.eye(1), -np.ones(1), np.full((1, 1), 1e-3), -inf, upper, inf, no)).solve()
    # 1e-3 s <= 1e-3 - 5e-10
    assert found.s == pytest.approx([1.0 - 5e-7], abs=1e-12)
