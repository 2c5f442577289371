from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.signal import lfilter
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import (
    Balance,
    InputError,
    Prior,
    PriorStep,
    Signal,
    Trajectory,
    evaluation_trajectories,
    free_runs,
    score,
)
from hybrid_mpc.identify.evaluate import FreeRun, input_correlation
from hybrid_mpc.identify.settings import kinds_of
from hybrid_mpc.identify.smooth import Smoother, sizes_of


class Two(Pendulum):
    """The pendulum with a second output and a second balance, in other units."""

    outputs = (Signal("phi", "rad"), Signal("level", "m"))

    def output(self, x, u, w, p):
        return x.phi, 2.0 * x.phi

    def balances(self, x, u, w, p):
        return (Balance("water", x.phi, u[0], unit="kg", rate_unit="kg/s"),)


def hand_made(n, error, off=0.5):
    """A run of n samples: rates [0, +-1] off by ``error``, outputs +-1 and +-10 off by ``off`` and 2, balances by 0.25
    W and 3 kg/s.
    """
    t, sign = 0.02 * np.arange(n), np.where(np.arange(n) % 2, 1.0, -1.0)[:, None]
    zeros, y = np.zeros((n, 2)), sign * np.array([1.0, 10.0])
    xdot = sign * np.array([0.0, 1.0])
    balances = zeros + np.array([1.0, -2.0])
    return FreeRun(
        "r", t, zeros[:, :1], zeros, zeros, y, y + np.array([off, 2.0]), xdot, xdot + np.array([0.0, error]),
        balances, balances + np.array([-0.25, 3.0]),
    )  # fmt: skip


def test_scores_of_a_run_made_by_hand():
    figures = score([hand_made(100, -3.0)], Two())
    assert figures.e_sim == pytest.approx(3.0, rel=1e-12)  # of the rate that changes, over its deviation of 1
    assert figures.rmse == pytest.approx({"phi [rad]": 0.5, "level [m]": 2.0})
    assert figures.fit_percent == pytest.approx({"phi [rad]": 50.0, "level [m]": 80.0})
    assert figures.error == pytest.approx(np.sqrt((0.5**2 + 0.2**2) / 2))
    assert figures.violation == pytest.approx({"energy [W]": 0.25, "water [kg/s]": 3.0})


def test_no_unit_counts_in_what_models_are_compared_by():
    run, scale = hand_made(100, -3.0), np.array([1.0, 1e3])
    milli = replace(
        run, y=scale * run.y, y_hat=scale * run.y_hat, xdot=scale * run.xdot, xdot_hat=scale * run.xdot_hat
    )
    one, other = score([run], Two()), score([milli], Two())
    assert (other.error, other.e_sim) == pytest.approx((one.error, one.e_sim))
    assert other.rmse["level [m]"] == pytest.approx(1e3 * one.rmse["level [m]"])


def test_a_given_spread_is_what_the_choice_compares_by():
    runs, spread = [hand_made(100, 1.0), hand_made(40, 1.0, off=0.1)], (2.0, 4.0)
    squares = np.concatenate([run.squared_errors(spread) for run in runs])
    assert score(runs, Two(), spread).error == pytest.approx(np.sqrt(squares.mean()))


def test_a_missing_sample_is_no_error_and_a_constant_output_has_no_fit():
    run = hand_made(100, 1.0)
    run.y[3, 0] = np.nan
    run.y[:, 1] = 7.0
    figures = score([run], Two())
    assert figures.rmse["phi [rad]"] == pytest.approx(0.5)
    assert list(figures.fit_percent) == ["phi [rad]"]
    run.y[:, 1] = np.nan
    with pytest.raises(InputError, match=r"level \[m\].*HM-IDENTIFY-010"):
        score([run], Two())


def test_a_diverging_run_makes_its_figures_infinite():
    run = hand_made(50, 1.0)
    run.y_hat[7, 0] = np.nan
    figures = score([run], Two())
    assert figures.rmse["phi [rad]"] == figures.error == np.inf
    assert figures.rmse["level [m]"] == pytest.approx(2.0)
    assert figures.e_sim == pytest.approx(1.0)


def test_a_prior_without_balances_has_no_violation():
    class Plain(Prior):
        states = outputs = (Signal("level", "m"),)
        inputs = (Signal("inflow", "m/s"),)

        def xdot(self, x, u, w, p):
            return (u.inflow - x.level,)

    t = 0.1 * np.arange(30)
    flow = np.sin(t)[:, None]
    run = Trajectory("r", "test", 0.1, t, flow, flow, flow, np.zeros_like(flow))
    (free,) = free_runs(PriorStep(Plain(), 0.1), Plain(), [run], 5)
    assert free.balances.shape == free.balances_hat.shape == (24, 0)
    assert score([free], Plain()).violation == {}
    assert kinds_of(Plain()) == ("rnn", "pgrnn")
    assert kinds_of(Pendulum()) == ("rnn", "pgrnn", "mopgrnn")


def test_the_true_model_runs_along_the_measurement():
    prior, run, warm = Pendulum(TRUTH), record(3, seconds=2.0), 25
    # x is exact and the prior true: only the integrator's error (1e-8 a period) is left
    (free,) = free_runs(PriorStep(prior, DT), prior, [run], warm, torch.zeros(0).double())
    assert len(free.t) == len(run.t) - warm - 1
    assert free.t[0] == run.t[warm]
    np.testing.assert_allclose(free.y_hat, free.y, atol=1e-4)
    assert score([free], prior).violation["energy [W]"] < 1e-3


def test_short_runs_start_every_fifth_of_their_length():
    run, warm = record(3, seconds=2.0), 25
    prior = Pendulum(TRUTH)
    smoother = Smoother(prior, DT, sigma=(1e-3,), walk=(0.1,), sizes=sizes_of(prior, [run], DT, 1.0))
    pieces = evaluation_trajectories([run], smoother, warm, 0.5)
    # 100 samples; 25 of warm-up, 25 periods of the run; a start every 5 samples
    assert [p.t[0] for p in pieces] == pytest.approx(run.t[0 : 100 - 50 : 5])
    assert {len(p.t) for p in pieces} == {51}
    assert len(evaluation_trajectories([run], smoother, warm)) == 1


def test_a_free_run_knows_nothing_of_the_measurement_after_its_start():
    prior, run, warm = Pendulum(TRUTH), record(3, seconds=2.0), 25
    later = replace(run, x=run.x.copy(), y=run.y.copy())
    later.x[warm + 1 :], later.y[warm + 1 :] = 9.0, 9.0
    step, h = PriorStep(prior, DT), torch.zeros(0).double()
    smoother = Smoother(prior, DT, sigma=(1e-3,), walk=(0.1,), sizes=sizes_of(prior, [run], DT, 1.0))
    ours, theirs = (
        free_runs(step, prior, evaluation_trajectories([r], smoother, warm), warm, h)[0] for r in (run, later)
    )
    np.testing.assert_array_equal(ours.x_hat, theirs.x_hat)
    assert not np.array_equal(ours.x, theirs.x)  # what it is compared with does know


# errors that an input explains


def test_what_an_input_drives_is_found_at_its_delay():
    rng = np.random.default_rng(0)
    u = [rng.standard_normal(800) for _ in range(3)]
    e = [0.3 * np.concatenate([np.zeros(4), v[:-4]]) + 0.3 * rng.standard_normal(800) for v in u]
    e[0][::5] = np.nan  # where nothing was measured
    rho, band = input_correlation(e[1:], u[1:], 10)
    assert int(np.argmax(np.abs(rho))) == 4
    assert rho[4] == pytest.approx(1 / np.sqrt(2), abs=0.05)  # of its variance a half
    assert band == pytest.approx(1.96 / np.sqrt(1600), rel=0.1)


@pytest.mark.parametrize("memory", [0.0, pytest.param(0.9, marks=pytest.mark.full), 0.97])
def test_the_band_holds_errors_that_are_independent_however_long_both_remember(memory):
    rng, inside = np.random.default_rng(1), []
    for _ in range(100):
        e, u = (lfilter([1.0], [1.0, -memory], rng.standard_normal((2, 1500)))[:, :, None] for _ in range(2))
        rho, band = input_correlation(list(e[:, :, 0]), list(u[:, :, 0]), 5)
        inside.append(np.abs(rho) <= band)
    # 95 % of 100 draws, whose lags are alike: three deviations of a share
    assert np.mean(inside) == pytest.approx(0.95, abs=0.05)


def test_what_does_not_move_has_none():
    rho, band = input_correlation([np.zeros(100)], [np.arange(100.0)], 3)
    assert np.isnan(rho).all()
    assert np.isnan(band)
