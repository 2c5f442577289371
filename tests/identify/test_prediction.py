"""Recordings under feedback: they are told, and predictions are fitted where free runs are led astray."""

import numpy as np
import pytest

from hybrid_mpc import Parameter, Prior, Signal, Trajectory, fit_prior
from hybrid_mpc.identify.closed_loop import PredictionFit, feedback, fit_by_prediction
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.smooth import fit_smoother
from hybrid_mpc.identify.windows import cut_outputs

DT, N = 0.1, 400
TRUTH = {"a": -0.5, "b": 1.5}


class First(Prior):
    states = (Signal("x", "m"),)
    inputs = (Signal("u", "V"),)
    outputs = states
    parameters = (Parameter("a", -1.0, "1/s", -3.0, 2.0), Parameter("b", 1.0, "m/(V s)", 0.2, 4.0))

    def xdot(self, x, u, w, p):
        return (p.a * x.x + p.b * u.u,)


def record(seed, *, gain, a=TRUTH["a"], disturbed=1.0, noise=0.01):
    """A run with a random disturbance of the rate, under ``u = r - gain y``; ``gain`` zero is open loop."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.uniform(-1, 1, N // 10 + 1), 10)[:N]
    x, d, y, u = 0.0, 0.0, np.empty(N), np.empty(N)
    for k in range(N):
        y[k] = x + noise * rng.standard_normal()
        u[k] = r[k] - gain * y[k]
        d = 0.98 * d + disturbed * 0.2 * rng.standard_normal()
        e = np.exp(a * DT)
        x = e * x + (e - 1) / a * (TRUTH["b"] * u[k] + d)
    z = np.zeros((N, 1))
    return Trajectory(f"run{seed}", "train", DT, DT * np.arange(N), u[:, None], y[:, None], z, z)


def answered(runs):
    prior = First(TRUTH)
    smoother = fit_smoother(prior, runs, DT, time_unit=1.0)
    return feedback([run.u for run in runs], smoother.prediction_errors(runs))


def test_feedback_is_told_from_open_loop():
    """Twelve seeds each: a correlation of chance exceeds four standard deviations once in 16,000 times."""
    assert max(answered([record(seed, gain=0.0) for seed in (s, s + 100)]) for s in range(12)) < 1.0
    assert min(answered([record(seed, gain=2.0) for seed in (s, s + 100)]) for s in range(12)) > 1.5


def test_a_fitted_delay_in_place_of_a_lag_is_no_feedback():
    """The actuator has a lag of 60 ms, so what the delay leaves unexplained depends on the last commands."""
    runs = []
    for seed in range(3):
        rng, x, v, y = np.random.default_rng(seed), 0.0, 0.0, np.empty(N)
        u = np.repeat(rng.uniform(-1, 1, N // 4), 4)
        for k in range(N):
            y[k] = x + 0.002 * rng.standard_normal()
            for _ in range(20):
                v += (u[k] - v) * DT / 20 / 0.06
                x += DT / 20 * (TRUTH["a"] * x + TRUTH["b"] * v)
        z = np.zeros((N, 1))
        runs.append(Trajectory(f"run{seed}", "train", DT, DT * np.arange(N), u[:, None], y[:, None], z, z))
    found = fit_prior(First, runs[:2], runs[2:], dt=DT, largest_delay=2 * DT)
    assert found.delay == pytest.approx(0.5 * DT, rel=0.1)
    assert not any("closed loop" in warning for warning in found.warnings)


@pytest.mark.parametrize(
    ("loops", "most", "loop"),
    [
        pytest.param(10, 0.1, {"gain": 2.0}, marks=pytest.mark.full),
        (8, 0.15, {"gain": 3.0, "a": 0.8, "disturbed": 0.1}),  # an unstable machine
    ],
)
def test_predictions_find_the_parameters_under_feedback(loops, most, loop):
    """Over recordings of a disturbed loop the mean estimate is the truth within three of its standard errors."""
    found = []
    for s in range(loops):
        runs = [record(10 * s + i, **loop) for i in range(3)]
        fit = OutputFit(First, DT)
        smoother = fit_smoother(First(), runs, DT, time_unit=1.0)
        result = fit_by_prediction(fit, fit.nominal, cut_outputs(runs, N - 1, 0, 10), smoother)
        found.append([fit.values(result.theta)[name] for name in TRUTH])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(loops)
    truth = [loop.get("a", TRUTH["a"]), TRUTH["b"]]
    assert (np.abs(mean - truth) < 3 * error + 0.02).all(), (mean, error)
    assert (error < most).all()


def test_an_observer_predicts_as_its_equations_say():
    """``z+ = f(z + K (y - g(z)))`` period by period; a missing sample corrects nothing."""
    run = record(0, gain=1.0)
    run.y[5] = np.nan
    smoother = fit_smoother(First(TRUTH), [run], DT, time_unit=1.0)
    own = PredictionFit(OutputFit(First, DT), smoother)
    windows = own.of(cut_outputs([run], 20, 0, 1))
    theta = own.nominal.copy()
    theta[2:] = np.array([0.4, 0.7]) / own.unit[2:]
    found, slopes = own.outputs(theta, windows.x, windows, 1, "all")
    a, b = (theta * own.unit)[:2]
    z, expected = windows.x[0].copy(), []
    for k in range(21):
        expected.append(z[0])
        if k != 5:
            z = z + np.array([0.4, 0.7]) * (windows.y[0, k, 0] - z[0])
        rate = a * DT
        grown = 1 + rate + rate**2 / 2 + rate**3 / 6 + rate**4 / 24  # Runge-Kutta of order 4
        z = np.array([grown * z[0] + (grown - 1) / a * (b * windows.u[0, k, 0] + z[1]), z[1]])
    np.testing.assert_allclose(found[0, :, 0], expected, rtol=1e-12, atol=1e-12)
    step = 1e-6
    for i in range(4):
        side = [own.outputs(theta + h * np.eye(4)[i], windows.x, windows, 1, "")[0] for h in (step, -step)]
        np.testing.assert_allclose(slopes[..., i], (side[0] - side[1]) / (2 * step), rtol=1e-6, atol=1e-8)
