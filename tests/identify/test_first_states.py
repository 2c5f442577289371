"""What is known of first states: estimates are those of least squares with as many unknowns, and surer for it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from simulated_pendulum import DT, TRUTH, Pendulum

from hybrid_mpc import FirstStates, Trajectory, fit_prior
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import OUTLIERS, Shooting
from hybrid_mpc.identify.simulation import Simulation
from hybrid_mpc.identify.windows import cut_outputs

NOISE, N, RUNS, SUBSTEPS = 5e-3, 80, 4, 2
START = (0.4, 0.0)
WARM = 25
NAMES = list(TRUTH)


def simulated(values, start, u):
    """Angles ``(runs, N)`` of the pendulum from first states."""
    n = len(u)
    prior = Pendulum(dict(zip(NAMES, values, strict=True)))
    held = np.broadcast_to(start, (n, 2)), u, np.zeros((n, N, 0)), prior.p, SUBSTEPS
    return Simulation(prior.equations.xdot, DT).values(*held)[..., 0]


@pytest.fixture(scope="module")
def runs():
    """Recordings of a pendulum that is let go from one angle, at rest."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1.0, 1.0, (RUNS, N // 10, 1)), 10, axis=1)
    y = simulated(TRUTH.values(), START, u) + NOISE * rng.standard_normal((RUNS, N))
    t, nothing = DT * np.arange(N), np.full((N, 2), np.nan)
    return [Trajectory(f"run{i}", "train", DT, t, u[i], y[i, :, None], nothing, nothing) for i in range(RUNS)]


def problem_of(runs, first):
    """All of each recording as one window, first states guessed a little off."""
    fit = OutputFit(Pendulum, DT)
    guessed = [replace(run, x=np.tile([0.42, 0.1], (N, 1))) for run in runs]
    prior = fit.prior
    windows = cut_outputs(guessed, N - 1, 0, RUNS, prior.states, prior.outputs, first)
    return Shooting(fit, windows, np.array([10.0, 100.0]))


def least(residual, guess, scale):
    """Least squares with the fit's loss."""
    found = least_squares(
        lambda z: residual(z) / scale,
        guess,
        loss="soft_l1",
        f_scale=OUTLIERS,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    return found.x


def of_theory(kind, runs):
    """Parameters by least squares: first states are known, one for all, or one for each recording."""
    u, y = np.stack([r.u for r in runs]), np.stack([r.y[:, 0] for r in runs])
    states = {"known": 0, "shared": 2, "free": 2 * RUNS}[kind]

    def residual(z):
        start = np.array(START) if kind == "known" else z[3:].reshape(-1, 2)
        return (simulated(z[:3], start, u) - y).ravel()

    guess = np.concatenate([list(TRUTH.values()), np.tile(START, states // 2)])
    return least(residual, guess, NOISE)[:3]


@pytest.mark.parametrize(
    "first",
    [FirstStates(), FirstStates("known", {"phi": START[0], "phi_dot": START[1]}), FirstStates("shared")],
)
def test_estimates_are_those_of_least_squares_with_as_many_unknowns(runs, first):
    problem = problem_of(runs, first)
    found = problem.solve(problem.own.nominal)
    # the noise's level is estimated, and steps end before rounding: both far below a standard error
    error = problem.own.unit * np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.theta * problem.own.unit - of_theory(first.kind, runs)) < 0.1 * error).all()


@pytest.mark.full
def test_a_warm_up_alone_tells_the_first_states(runs):
    """Of each recording the warm-up gives the first state, for every set of parameters; what follows is fitted."""
    u, y = np.stack([r.u for r in runs]), np.stack([r.y[:, 0] for r in runs])

    def starts(values):
        def early(z):
            return (simulated(values, z.reshape(-1, 2), u) - y)[:, :WARM].ravel()

        return least(early, np.tile(START, RUNS), NOISE).reshape(-1, 2)

    def late(values):
        return (simulated(values, starts(values), u) - y)[:, WARM:].ravel()

    problem = problem_of(runs, FirstStates("warm_up", seconds=WARM * DT))
    found = problem.solve(problem.own.nominal)
    error = problem.own.unit * np.sqrt(np.diag(found.covariance))
    want = least_squares(
        lambda z: late(z) / NOISE, list(TRUTH.values()), loss="soft_l1", f_scale=OUTLIERS, diff_step=1e-4
    ).x
    assert (np.abs(found.theta * problem.own.unit - want) < 0.1 * error).all()
    # found first states are those of the warm-up, within what its noise leaves open of them
    states = problem.first_states(found.theta)
    np.testing.assert_allclose(states, starts(found.theta * problem.own.unit), atol=0.01)


def test_what_is_known_makes_the_rest_surer(runs):
    known = FirstStates("known", {"phi": START[0], "phi_dot": START[1]})
    fits = {
        first.kind: fit_prior(Pendulum, runs, runs, dt=DT, first_states=first)
        for first in (FirstStates(), FirstStates("shared"), known)
    }
    for kind, fit in fits.items():
        for name, value in TRUTH.items():
            assert abs(fit.values[name] - value) < 6 * fit.standard_errors[name], (kind, name)

    def spread(kind):
        problem = problem_of(runs, known if kind == "known" else FirstStates(kind))
        point = problem.start(problem.own.scaled(TRUTH), np.tile(START, (RUNS, 1)), "all")
        slopes, *_ = problem._eliminated(point)
        return np.diag(np.linalg.inv((slopes.swapaxes(1, 2) @ slopes).sum(axis=0)))

    # of the Cramer-Rao bounds: each thing known takes a column from the regression
    assert (spread("known") < spread("shared")).all()
    assert (spread("shared") < spread("free")).all()


def test_measured_outputs_that_are_states_are_exact_where_a_run_starts(runs):
    windows = cut_outputs(
        [replace(runs[0], x=np.zeros((N, 2)))],
        20,
        0,
        9,
        Pendulum.states,
        Pendulum.outputs,
        FirstStates("measured"),
    )
    assert windows.known.tolist() == [[True, False]] * 3
    np.testing.assert_array_equal(windows.x[:, 0], runs[0].y[:60:20, 0])
    fit = fit_prior(Pendulum, runs, runs, dt=DT, first_states=FirstStates("measured"))
    # the noise of the first sample of every run is taken for motion: 5 mrad of some tenths
    assert all(abs(fit.values[name] / value - 1) < 0.2 for name, value in TRUTH.items())


def test_only_a_recordings_own_first_sample_is_known(runs):
    guessed = [replace(run, x=np.full((N, 2), 0.3)) for run in runs]
    known = FirstStates("known", {"phi_dot": 0.0})
    windows = cut_outputs(guessed, 20, 0, 8, Pendulum.states, Pendulum.outputs, known)
    assert windows.known.tolist() == [[False, True]] * RUNS + [[False, False]] * 4
    assert windows.x[:RUNS].tolist() == [[0.3, 0.0]] * RUNS
    shared = cut_outputs(guessed, 20, 0, 8, Pendulum.states, Pendulum.outputs, FirstStates("shared"))
    assert shared.group.tolist() == [0] * RUNS + [1, 2, 3, 4]
    assert shared.times(2).group.tolist() == [*shared.group, *(shared.group + 5)]
