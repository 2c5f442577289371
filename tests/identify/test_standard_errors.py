"""What a fit says of its own errors, and what must not change it: the order of files, units, where files are cut."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from hybrid_mpc import Parameter, Prior, Signal, Trajectory, fit_prior

DT = 0.1
TRUTH = {"a": 1.2, "b": 0.8, "c": 2.0}
NOISE = 0.02
LIMIT = 1.96


class Two(Prior):
    """A slow and a fast lag one behind the other; the first has no sensor."""

    states = (Signal("first", "V", -10, 10), Signal("second", "V", -10, 10))
    inputs = (Signal("u", "V", -2, 2),)
    outputs = (Signal("second", "V", -10, 10),)
    parameters = (
        Parameter("a", 1.5, "1/s", 1.0, 4.0),
        Parameter("b", 0.6, "1/s", 0.2, 1.0),  # lags that change places give the same outputs
        Parameter("c", 1.0, "-", 0.2, 6.0),
    )

    def xdot(self, x, u, w, p):
        return p.a * (p.c * u.u - x.first), p.b * (x.first - x.second)


def exact(truth, u, dt=DT):
    """Outputs of the lags under held inputs, exact."""
    a = np.array(
        [[-truth["a"], 0.0, truth["a"] * truth["c"]], [truth["b"], -truth["b"], 0.0], [0.0, 0.0, 0.0]]
    )
    step, z, rows = expm(a * dt), np.zeros(2), []
    for value in u:
        rows.append(z[1])
        z = (step @ [*z, value])[:2]
    return np.array(rows)


def record(seed, n=300, noise=NOISE):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, n // 5 + 1), 5)[:n]
    y = exact(TRUTH, u) + noise * rng.standard_normal(n)
    nothing = np.full((n, 2), np.nan)
    return Trajectory(f"run{seed}", "train", DT, DT * np.arange(n), u[:, None], y[:, None], nothing, nothing)


def fitted(runs, prior=Two, dt=DT):
    *train, valid = runs
    return fit_prior(prior, train, [replace(valid, role="valid")], dt=dt)


@pytest.fixture(scope="module")
def runs():
    return [record(seed) for seed in range(4)]


@pytest.fixture(scope="module")
def fit(runs):
    return fitted(runs)


def cramer_rao(runs):
    """Standard errors that no unbiased estimate undercuts, of parameters with free first states."""
    information = np.zeros((3, 3))
    for run in runs:
        u, slopes = run.u[:, 0], []
        for name, value in TRUTH.items():
            h = 1e-5 * value
            slopes.append(
                (exact({**TRUTH, name: value + h}, u) - exact({**TRUTH, name: value - h}, u)) / (2 * h)
            )
        modes = np.stack([np.exp(-TRUTH[k] * run.t) for k in "ab"], axis=1)  # of the first state
        own = np.stack(slopes, axis=1)
        left = own - modes @ np.linalg.lstsq(modes, own, rcond=None)[0]
        information += left.T @ left / NOISE**2
    return np.sqrt(np.diag(np.linalg.inv(information)))


@pytest.mark.parametrize("draws", [20, pytest.param(200, marks=pytest.mark.full)])
def test_intervals_hold_the_truth_and_are_no_wider_than_need_be(draws):
    """Of 200 draws 92 to 98 % (three standard deviations of chance: 90.4 to 99.6 %); of 20 at least 80 %."""
    inside, ratio = [], []
    for draw in range(draws):
        runs = [record(1000 + 4 * draw + i, n=200) for i in range(4)]
        found = fitted(runs)
        off = np.array([found.values[name] - TRUTH[name] for name in TRUTH])
        own = np.array([found.standard_errors[name] for name in TRUTH])
        inside.append(np.abs(off) < LIMIT * own)
        ratio.append(own / cramer_rao(runs[:3]))
    share = np.mean(inside)
    assert (0.92 if draws == 200 else 0.8) <= share <= (0.98 if draws == 200 else 1.0)
    assert np.median(ratio, axis=0).max() < 1.3
    assert np.median(ratio, axis=0).min() > 0.75


def test_the_order_of_files_is_no_matter(runs, fit):
    *train, valid = runs
    other = fitted([*train[::-1], valid])
    for name, value in fit.values.items():
        assert other.values[name] == pytest.approx(value, rel=1e-9)
        assert other.standard_errors[name] == pytest.approx(fit.standard_errors[name], rel=1e-9)


@pytest.mark.parametrize("factor", [1e-6, 1e3])
def test_units_are_no_matter(runs, fit, factor):
    """States and outputs in other units: the same parameters and standard errors."""

    class Other(Two):
        states = tuple(
            replace(s, unit="x", lower=s.lower * factor, upper=s.upper * factor) for s in Two.states
        )
        outputs = (states[1],)
        parameters = (*Two.parameters[:2], Parameter("c", factor, "x/V", 0.2 * factor, 6.0 * factor))

    other = fitted([replace(r, y=r.y * factor) for r in runs], Other)
    for name, size in (("a", 1.0), ("b", 1.0), ("c", factor)):
        assert other.values[name] / size == pytest.approx(fit.values[name], rel=1e-6)
        assert other.standard_errors[name] / size == pytest.approx(fit.standard_errors[name], rel=1e-4)


def test_a_recording_cut_in_two_gives_the_same():
    """A second first state costs a little of what the samples tell."""
    *train, valid = (record(seed, n=1200) for seed in range(4))
    whole = fitted([*train, valid])
    halves = [r.part(part) for r in train for part in (slice(0, 600), slice(600, 1200))]
    other = fitted([*halves, valid])
    for name, value in whole.values.items():
        assert abs(other.values[name] - value) < 0.2 * whole.standard_errors[name], name


class Pole(Prior):
    """One lag, sampled hardly faster than it is."""

    states = outputs = (Signal("x", "V", -10, 10),)
    inputs = (Signal("u", "V", -2, 2),)
    parameters = (Parameter("a", 1.0, "1/s", 0.1, 10.0), Parameter("b", 1.0, "1/s", 0.1, 10.0))

    def xdot(self, x, u, w, p):
        return (p.b * u.u - p.a * x.x,)


@pytest.mark.parametrize("noise", [1e-4, 0.0])
def test_integration_steps_bias_no_parameter(noise):
    """A pole with a dt = 1.8: two Runge-Kutta steps a period would make it 1.822."""
    rng, dt, a, b = np.random.default_rng(0), 1.0, 1.8, 0.9
    runs = []
    for seed in range(3):
        u, x, y = np.repeat(rng.uniform(-1, 1, 150), 2), 0.0, []
        for value in u:
            y.append(x)
            x = np.exp(-a * dt) * x + (1 - np.exp(-a * dt)) / a * b * value
        n = len(u)
        y = np.array(y) + noise * rng.standard_normal(n)
        nothing = np.full((n, 1), np.nan)
        runs.append(
            Trajectory(f"r{seed}", "train", dt, dt * np.arange(n), u[:, None], y[:, None], nothing, nothing)
        )
    found = fitted(runs, Pole, dt)
    for name, value in (("a", a), ("b", b)):
        assert abs(found.values[name] - value) < 3 * found.standard_errors[name] + 3e-5 * value, name
    assert found.substeps >= 8


def test_a_noisy_pole_needs_no_more_steps(runs, fit):
    """The bias of one step is far below a standard error here."""
    assert fit.substeps == 1
