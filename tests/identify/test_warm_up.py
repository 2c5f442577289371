"""A fit whose free runs fail from a warm-up is fitted to such runs; others stay as they are."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc.data.trajectories import Trajectory, load_trajectories
from hybrid_mpc.identify import warm_up
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.prior_result import FROM_WARM_UP, winner
from hybrid_mpc.identify.warm_up import error_from_warm_up, refitted

TANKS = Path(__file__).parents[3] / "shared" / "data" / "cascaded_tanks" / "estimation.csv"
DT = 4.0


class Tanks(hm.Prior):
    """Two tanks, one below the other; only the lower level is measured, and the prior has no overflow."""

    states = (hm.Signal("upper", "V", 0.0, 16.0), hm.Signal("lower", "V", 0.0, 12.0))
    inputs = (hm.Signal("pump", "V", 0.0, 10.0),)
    outputs = (hm.Signal("level", "V", 0.0, 12.0, saturation=(-np.inf, 10.0)),)
    parameters = (
        hm.Parameter("k_1", 0.05, "V^0.5/s", 0.01, 0.3), hm.Parameter("k_2", 0.05, "V^0.5/s", 0.01, 0.3),
        hm.Parameter("k_p", 0.05, "1/s", 0.01, 0.3),
    )  # fmt: skip
    operating_point = hm.OperatingPoint((4.0, 4.0), (2.0,))

    def xdot(self, x, u, w, p):
        out = p.k_1 * ca.sqrt(ca.fmax(x.upper, 1e-6)), p.k_2 * ca.sqrt(ca.fmax(x.lower, 1e-6))
        return p.k_p * u.pump - out[0], out[0] - out[1]

    def output(self, x, u, w, p):
        return (x.lower,)


def recorded(seed, n=400):
    rng, x = np.random.default_rng(seed), np.array([4.0, 4.0])
    u = np.repeat(rng.uniform(0.5, 3.0, n // 20), 20)[:, None]
    states = []
    for pump in u[:, 0]:
        states.append(x)
        for _ in range(8):
            flow = 0.05 * np.sqrt(np.maximum(x, 0.0))
            x = x + DT / 8 * np.array([0.05 * pump - flow[0], flow[0] - 1.1 * flow[1]])
    states = np.array(states)
    y = states[:, 1:] + 0.01 * rng.standard_normal((n, 1))
    return Trajectory(
        f"run{seed}", "train", DT, DT * np.arange(n), u, y, states, np.zeros_like(states), np.zeros((n, 0)),
        np.zeros_like(y, dtype=np.int8),
    )  # fmt: skip


@pytest.fixture(scope="module")
def good():
    """Recordings that the prior explains, and their fit."""
    runs = [recorded(k) for k in range(3)]
    return runs, hm.fit_prior(Tanks, runs, [], dt=DT, length=400.0)


def test_the_error_from_a_warm_up_is_that_of_the_runs(good):
    runs, fit = good
    smoother = fit.smoother(Tanks(fit.values), DT)
    own = error_from_warm_up(smoother, runs, 20, 100)
    assert own < 0.05
    wrong = Tanks({**fit.values, "k_2": 2.0 * fit.values["k_2"]})
    assert error_from_warm_up(replace(smoother, prior=wrong), runs, 20, 100) > 10 * own


def test_a_fit_that_predicts_well_from_a_warm_up_stays(good):
    runs, fit = good
    again = hm.fit_prior(Tanks, runs, [], dt=DT, length=400.0, warm_up=80.0)
    assert again.values == fit.values
    assert again.best != FROM_WARM_UP


@pytest.mark.parametrize(("errors", "used"), [((0.5, 0.2), True), ((0.5, 0.3), False), ((0.15, 0.0), False)])
def test_the_second_fit_must_halve_a_large_error(good, monkeypatch, errors, used):
    """The first error counts from twice that with free initial states, 0.1."""
    given = iter(errors)
    monkeypatch.setattr(warm_up, "error_from_warm_up", lambda *rest: next(given))
    runs, own = good
    smoother = own.smoother(Tanks(own.values), DT)
    fit = OutputFit(Tanks, DT)
    chosen = Fitted(fit.scaled(own.values), np.zeros((0, 0)), ())
    found = refitted(
        fit, chosen, smoother, [], runs, 0.1, warm=5, periods=50, smoother_of=lambda found: smoother
    )
    assert (found is not None) == used
    nothing = refitted(
        fit, chosen, smoother, [], runs, 0.1, warm=0, periods=50, smoother_of=lambda found: smoother
    )
    assert nothing is None


def test_a_start_that_is_too_stiff_is_left_out(good, monkeypatch):
    runs, own = good
    smoother, fit = own.smoother(Tanks(own.values), DT), OutputFit(Tanks, DT)
    chosen = Fitted(fit.scaled(own.values), np.zeros((0, 0)), ())
    given = iter((0.5, 0.2))
    monkeypatch.setattr(warm_up, "error_from_warm_up", lambda *rest: next(given))
    tried = []

    def smoother_of(found):
        tried.append(found)
        if len(tried) == 1:
            raise hm.InputError("too stiff")
        return smoother

    found = refitted(
        fit, chosen, smoother, [fit.nominal], runs, 0.1, warm=5, periods=50, smoother_of=smoother_of
    )
    assert found == (tried[1], smoother)


def test_the_stage_from_the_warm_up_is_the_result():
    assert winner(["nominal", "free runs of 4 s", FROM_WARM_UP], [0.5, 0.1, 0.2]) == 2


@pytest.mark.skipif(not TANKS.is_file(), reason=f"no recording {TANKS}")
def test_a_textbook_prior_of_tanks_predicts_from_a_warm_up():
    """Its upper level is not measured, and it lacks the overflow: with free initial states many outlets fit alike."""
    spec = hm.load_scenario("cascaded_tanks").data
    runs = load_trajectories([TANKS], Tanks(), spec).trajectories
    quarter = len(runs[0].t) // 4
    parts = [runs[0].part(slice(k * quarter, (k + 1) * quarter), f"part{k}") for k in range(3)]
    fits = [hm.fit_prior(Tanks, parts, [], dt=DT, length=400.0, warm_up=s) for s in (0.0, spec.warm_up)]
    warm = round(spec.warm_up / DT)
    before, after = (
        error_from_warm_up(fit.smoother(Tanks(fit.values), DT), parts, warm, 100) for fit in fits
    )
    assert fits[1].best == FROM_WARM_UP
    assert after < 0.5 * before
