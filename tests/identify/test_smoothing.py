"""The smoother with the prior's equations: noise found again, jumps stay sharp, states that no sensor sees, samples
that are missing or censored, nothing known of the future; exact where the machine is linear.
"""

from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
import pytest
from example_priors import TANKS, Tanks
from scipy.linalg import expm

from hybrid_mpc import MechanicalPrior, OperatingPoint, Parameter, Prior, Signal, Trajectory, fit_smoother
from hybrid_mpc.data.differentiate import local_polynomial
from hybrid_mpc.data.scales import Sizes
from hybrid_mpc.identify.simulation import Simulation
from hybrid_mpc.identify.smooth import IGNORANCE, Smoother, _innovations, _whitened, sizes_of, unseen_states
from tests.simulated_pendulum import DT, TRUTH, Pendulum, record

SIGMA = 1e-3


def blind(run, **changed):
    """The recording with its outputs alone."""
    return replace(run, x=np.full_like(run.x, np.nan), xdot=np.full_like(run.xdot, np.nan), **changed)


def noisy(seed, seconds=4.0, extra=lambda phi, v: 0.0):
    run = record(seed, seconds=seconds, extra=extra)
    return run, blind(run, y=run.y + SIGMA * np.random.default_rng(100 + seed).standard_normal(run.y.shape))


def unknown(phi, v):
    return 0.1 * np.sin(2.0 * phi)


def smoother_of(prior, runs, dt, sigma, walk):
    return Smoother(prior, dt, sigma=sigma, walk=walk, sizes=sizes_of(prior, runs, dt, 1.0))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_noise_level_is_found_by_maximum_likelihood():
    runs = [noisy(seed, extra=unknown)[1] for seed in range(4)]
    smoother = fit_smoother(Pendulum(TRUTH), runs, DT)
    # 800 samples: the standard error of a standard deviation is 1 / sqrt(1600) = 2.5 %; four of them
    assert smoother.sigma[0] == pytest.approx(SIGMA, rel=0.1)


def test_velocity_is_better_than_a_polynomial_where_the_input_jumps():
    truth, run = noisy(1, extra=unknown)
    smoothed = fit_smoother(Pendulum(TRUTH), [run], DT).smooth([run])[0]
    polynomial = local_polynomial(run.y, DT, 0.2).first[:, 0]
    inner = slice(10, -10)

    def error(v):
        return rms((v - truth.x[:, 1])[inner])

    # jumps of about 0.4 N m / 0.1 kg m^2 smeared over 0.2 s; a factor of two leaves room for the noise drawn
    assert error(smoothed.x[:, 1]) < 0.5 * error(polynomial)
    # d is the unknown torque over J; tenth of its size: what noise leaves of it after smoothing
    prior = Pendulum(TRUTH)
    own = prior.equations.xdot(smoothed.x.T, run.u.T, [], prior.p).full().T
    np.testing.assert_array_equal(smoothed.xdot[:, 0], own[:, 0])  # kinematics are exact
    expected = unknown(truth.x[:, 0], 0.0) / TRUTH["J"]
    assert rms(((smoothed.xdot - own)[:, 1] - expected)[inner]) < 0.3 * np.std(expected)


def test_without_noise_and_with_the_true_prior_the_states_are_exact():
    truth = record(2)
    smoothed = smoother_of(Pendulum(TRUTH), [truth], DT, (1e-6,), (1e-3,)).smooth([blind(truth)])[0]
    # a wandering d of 1e-3 over a period, and more
    np.testing.assert_allclose(smoothed.x, truth.x, atol=1e-4)


def test_knows_nothing_outside_its_samples():
    run = noisy(4)[1]
    other = replace(run, y=np.where(run.t[:, None] > 1.0, 9.0, run.y))
    smoother = smoother_of(Pendulum(TRUTH), [run], DT, (SIGMA,), (0.5,))
    ours, theirs = (smoother.smooth([r.part(slice(50))])[0] for r in (run, other))
    np.testing.assert_array_equal(ours.x, theirs.x)


def test_trajectories_of_any_lengths_are_smoothed_each_for_itself():
    runs = [noisy(seed, seconds=s)[1] for seed, s in ((0, 1.0), (1, 2.0), (2, 1.0))]
    smoother = smoother_of(Pendulum(TRUTH), runs, DT, (SIGMA,), (0.5,))
    for together, run in zip(smoother.smooth(runs), runs, strict=True):
        np.testing.assert_array_equal(together.x, smoother.smooth([run])[0].x)
        assert together.name == run.name


# linear machines: the exact solution


class Masses(Prior):
    """Two masses on springs, pushed at the first, shaken by a disturbance at the second; sums are measured."""

    states = tuple(Signal(name, "-", -5.0, 5.0) for name in ("q_1", "q_2", "v_1", "v_2"))
    inputs = (Signal("push", "-"),)
    disturbances = (Signal("shake", "-"),)
    outputs = (Signal("sum", "-"), Signal("speed", "-"))
    corrects = ("v_1", "v_2")

    def xdot(self, x, u, w, p):
        apart = x.q_1 - x.q_2
        return (
            x.v_1,
            x.v_2,
            u.push - 9.0 * x.q_1 - 4.0 * apart - 0.3 * x.v_1,
            w.shake + 4.0 * apart - 0.2 * x.v_2,
        )

    def output(self, x, u, w, p):
        return x.q_1 + 0.5 * x.q_2 + 0.1 * u.push, x.v_1 - x.v_2 + 0.2 * w.shake


def discrete(dt):
    """``z_{k+1} = a z_k + b [u, w]`` of ``z = [x, d]``, ``y = c z + e [u, w]``: Taylor's series up to the fourth power,
    which is what a step of Runge-Kutta makes of a linear machine."""
    k = np.array([[-13.0, 4.0], [4.0, -4.0]])
    a = np.zeros((6, 6))
    a[:2, 2:4], a[2:4, :2], a[2:4, 2:4], a[2:4, 4:] = np.eye(2), k, np.diag([-0.3, -0.2]), np.eye(2)
    b = np.zeros((6, 2))
    b[2, 0], b[3, 1] = 1.0, 1.0
    whole = np.zeros((8, 8))
    whole[:6, :6], whole[:6, 6:] = a * dt, b * dt
    series, term = np.eye(8), np.eye(8)
    for i in range(1, 5):
        term = term @ whole / i
        series = series + term
    assert (
        np.abs(series - expm(whole)).max() < 1e-5
    )  # it is the machine: the next term is (0.05 * 3.9)^5 / 120
    c = np.array([[1.0, 0.5, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0, 0.0, 0.0]])
    return series[:6, :6], series[:6, 6:], c, np.array([[0.1, 0.0], [0.0, 0.2]])


def linear_recording(n, dt, seed=0):
    rng = np.random.default_rng(seed)
    a, b, c, e = discrete(dt)
    u, w = rng.normal(size=(n, 1)), rng.normal(size=(n, 1))
    z, y = np.array([0.5, -0.3, 0.2, 0.4, 1.0, -1.0]), []
    for k in range(n):
        held = np.array([u[k, 0], w[k, 0]])
        y.append(c @ z + e @ held + 0.01 * rng.standard_normal(2))
        z = a @ z + b @ held
        z[4:] += 0.2 * rng.standard_normal(2)
    nothing = np.full((n, 4), np.nan)
    return Trajectory("linear", "train", dt, dt * np.arange(n), u, np.array(y), nothing, nothing, w)


def ignorance(smoother):
    """Standard deviations of the first ``(x, d)``: ten sizes, of a state half its range at most."""
    ranges = [0.5 * (s.upper - s.lower) for s in smoother.prior.states]
    rates = IGNORANCE * np.array(smoother.sizes.rate)[list(smoother.prior.corrected)]
    return np.concatenate([np.minimum(IGNORANCE * np.array(smoother.sizes.x), ranges), rates])


def batch_solution(run, sigma, process, first, spread):
    """Gauss-Markov: all ``z_k`` by least squares of measurements, changes and what is known of the first."""
    n, (a, b, c, e) = len(run.t), discrete(run.dt)
    held = np.hstack([run.u, run.w])
    # unknowns: z_0, and the changes of z before each later sample
    response, known = np.zeros((n, 6, 6 * n)), np.zeros((n, 6))
    response[0, :, :6] = np.eye(6)
    for k in range(n - 1):
        response[k + 1], known[k + 1] = a @ response[k], a @ known[k] + b @ held[k]
        response[k + 1, :, 6 + 6 * k : 12 + 6 * k] += np.eye(6)
    rows, right = [], []
    for k, j in np.argwhere(np.isfinite(run.y)):
        rows.append(c[j] @ response[k] / sigma[j])
        right.append((run.y[k, j] - c[j] @ known[k] - e[j] @ held[k]) / sigma[j])
    size = np.concatenate([spread, np.tile(process, n - 1)])
    rows = np.vstack([np.array(rows), np.diag(1.0 / size)])
    right = np.concatenate([right, first / spread, np.zeros(6 * (n - 1))])
    # columns in units of their sizes, as rows are
    solution = size * np.linalg.lstsq(rows * size, right, rcond=None)[0]
    return response @ solution + known


@pytest.mark.parametrize("missing", ["none", "some", "the first output throughout", "a stretch"])
def test_a_linear_machine_is_smoothed_as_by_least_squares_over_all_samples(missing):
    dt, sigma, walk = 0.05, (0.01, 0.02), (0.2, 0.3)
    run = linear_recording(60, dt)
    rng = np.random.default_rng(5)
    if missing == "some":
        run.y[rng.uniform(size=run.y.shape) < 0.3] = np.nan
    elif missing == "the first output throughout":
        run.y[:, 0] = np.nan
    elif missing == "a stretch":
        run.y[20:40] = np.nan
    sizes = Sizes((1.0, 1.0), (0.01, 0.02), (2.0, 2.0, 3.0, 3.0), (1.0, 1.0, 2.0, 2.0))
    smoother = Smoother(Masses(), dt, sigma=sigma, walk=walk, sizes=sizes)
    ours = smoother.smooth([run])[0]
    first = np.concatenate([smoother._starts([run])[0], np.zeros(2)])
    spread = ignorance(smoother)
    exact = batch_solution(run, sigma, smoother._horizon.process, first, spread)
    # a step's rounding, by the ratio of what is known at first to what holds almost exactly: 1e-4 of the noise
    np.testing.assert_allclose(ours.x, exact[:, :4], rtol=0, atol=1e-6)
    own = Masses().equations.xdot(ours.x.T, run.u.T, run.w.T, []).full().T
    np.testing.assert_allclose((ours.xdot - own)[:, 2:], exact[:, 4:], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(ours.xdot[:, :2], own[:, :2])


def test_the_likelihood_is_that_of_the_joint_gaussian():
    """Squares and logarithms of the innovations: those of the measurements' own distribution, term by term."""
    dt, sigma, walk, n = 0.05, (0.01, 0.02), (0.2, 0.3), 12
    run = linear_recording(n, dt)
    run.y[4, 0] = run.y[7] = np.nan
    sizes = Sizes((1.0, 1.0), (0.01, 0.02), (2.0, 2.0, 3.0, 3.0), (1.0, 1.0, 2.0, 2.0))
    smoother = Smoother(Masses(), dt, sigma=sigma, walk=walk, sizes=sizes)
    a, b, c, e = discrete(dt)
    first = np.concatenate([smoother._starts([run])[0], np.zeros(2)])
    held, spread = np.hstack([run.u, run.w]), ignorance(smoother)
    mean, covariance, means, blocks = first, np.diag(spread**2), [], []
    cross = [covariance]  # of z_k with all before it
    total = np.zeros((2 * n, 2 * n))
    for k in range(n):
        means.append(c @ mean + e @ held[k])
        for i, block in enumerate(cross):  # block is cov(z_i, z_k)
            total[2 * i : 2 * i + 2, 2 * k : 2 * k + 2] = c @ block @ c.T
            total[2 * k : 2 * k + 2, 2 * i : 2 * i + 2] = (c @ block @ c.T).T
        total[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += np.diag(np.square(sigma))
        mean = a @ mean + b @ held[k]
        covariance = a @ covariance @ a.T + np.diag([0, 0, 0, 0, *np.square(walk)])
        cross = [block @ a.T for block in cross] + [covariance]
    blocks = total
    y, seen = run.y.ravel(), np.isfinite(run.y.ravel())
    error = (y - np.concatenate(means))[seen]
    within = blocks[np.ix_(seen, seen)]
    # the first samples end the ignorance and do not count: their part is that of the same sum over them alone
    skip = 2 * 3
    begin = within[:skip, :skip]
    squares = error @ np.linalg.solve(within, error) - error[:skip] @ np.linalg.solve(begin, error[:skip])
    logs = np.linalg.slogdet(within)[1] - np.linalg.slogdet(begin)[1]
    (found,) = _innovations([smoother], [run])
    assert found[2] == seen.sum() - skip
    # rounding of a matrix whose condition is the square of 3e3
    assert found[0] == pytest.approx(squares, rel=1e-6)
    assert found[1] == pytest.approx(logs, rel=1e-8)


# states without a sensor


def tank_run(seed=0, n=240, dt=0.5, noise=1e-4):
    """Levels under random inflow and rain, the lower one measured."""
    rng, prior = np.random.default_rng(seed), Tanks(TANKS)
    u, w = (np.repeat(rng.uniform(0.0, top, n // 20 + 1), 20)[:n, None] for top in (0.3, 0.1))
    simulation = Simulation(prior.equations.xdot, dt)
    x = simulation.values(np.array([[0.8, 0.4]]), u[None], w[None], prior.p, 4)[0]
    xdot = prior.equations.xdot(x.T, u.T, w.T, prior.p).full().T
    y = x[:, 1:] + noise * rng.standard_normal((n, 1))
    return Trajectory(f"tanks{seed}", "train", dt, dt * np.arange(n), u, y, x, xdot, w)


def test_a_level_without_a_sensor_is_found():
    truth = tank_run()
    runs = [blind(truth), blind(tank_run(1))]
    smoothed = fit_smoother(Tanks(TANKS), runs, 0.5).smooth(runs)[0]
    inner = slice(20, -20)  # at its ends the upper level is told by one side alone
    # noise of 0.1 mm; k_1 sqrt(h) over a_2 passes a change of 1 mm on as 0.1 mm/s: a hundredth of its spread
    assert rms((smoothed.x - truth.x)[inner, 0]) < 0.01 * np.std(truth.x[:, 0])
    assert rms((smoothed.x - truth.x)[inner, 1]) < 1e-4


class Speedometer(Pendulum):
    """Angle, and the speed without its sign."""

    outputs = (Signal("phi", "rad"), Signal("pace", "rad/s"))

    def output(self, x, u, w, p):
        return x.phi, ca.fabs(x.phi_dot)


class Pace(Pendulum):
    """The speed without its sign alone: it rests where the input leaves it, so that the angle shows in what follows."""

    outputs = (Signal("pace", "rad/s"),)

    def output(self, x, u, w, p):
        return (ca.fabs(x.phi_dot),)


def test_a_sensor_of_the_speeds_size_helps_and_its_sign_is_not_lost():
    truth = record(5)
    noise = np.random.default_rng(0).standard_normal((len(truth.t), 2)) * [0.05, 0.01]
    y = np.column_stack([truth.x[:, 0], np.abs(truth.x[:, 1])]) + noise
    run = blind(truth, y=y)
    both = smoother_of(Speedometer(TRUTH), [run], DT, (0.05, 0.01), (0.05,)).smooth([run])[0]
    angle = blind(truth, y=y[:, :1])
    alone = smoother_of(Pendulum(TRUTH), [angle], DT, (0.05,), (0.05,)).smooth([angle])[0]
    errors = [rms((s.x - truth.x)[:, 1]) for s in (both, alone)]
    assert errors[0] < 0.01  # the sensor's own noise; a wrong sign would cost the speed itself, 3 rad/s
    assert errors[0] < 0.3 * errors[1]


class Drive(Prior):
    """A speed that follows the input, a counter that shows a mean of its size."""

    states = (Signal("speed", "m/s", -5.0, 5.0), Signal("shown", "m/s", -1.0, 5.0))
    inputs = (Signal("voltage", "V", -5.0, 5.0),)
    outputs = (Signal("shown", "m/s"),)
    operating_point = OperatingPoint(x=(1.0, 1.0), u=(1.0,))

    def xdot(self, x, u, w, p):
        size = ca.sqrt(x.speed**2 + 1e-4)
        return (u.voltage - x.speed) / 0.3, (size - x.shown) / 0.05


@pytest.mark.parametrize("voltage", [-2.0, 2.0])
def test_the_first_input_says_which_way_a_machine_runs(voltage):
    """Four samples of a counter in the steady state; after them the input goes to zero."""
    prior, dt, n = Drive(), 0.02, 4
    run = Trajectory(
        "drive", "test", dt, dt * np.arange(n), np.full((n, 1), voltage), np.full((n, 1), 2.0),
        np.full((n, 2), np.nan), np.full((n, 2), np.nan),
    )  # fmt: skip
    (smoothed,) = smoother_of(prior, [run], dt, (1e-3,), (0.1, 0.1)).smooth([run])
    # the rounded corner makes the counter show 2.000025; four samples tell the speed to a few of their noises
    assert smoothed.x[-1] == pytest.approx([voltage, 2.0], abs=0.01)


def test_where_the_first_input_holds_nothing_the_start_is_at_rest():
    """A mass that a force drives away, and a drive whose equilibrium lies beyond its range."""
    mass = smoother_of(Pendulum(TRUTH), [record(5)], DT, (0.05,), (0.05,))
    upright = mass._held(np.array([np.pi, 0.0]), np.zeros((1, 1)), np.zeros((1, 0)))
    assert upright[0].tolist() == [np.pi, 0.0]  # an equilibrium, not a stable one
    run = replace(record(5), u=np.full((len(record(5).t), 1), 9.0))
    sizes = Sizes((1.0,), (1e-3,), (1.0, 1.0), (1.0, 1.0))
    drive = Smoother(Drive(), 0.02, sigma=(1e-3,), walk=(0.1, 0.1), sizes=sizes)
    assert drive._held(np.ones(2), run.u[:1], run.w[:1]).tolist() == [[1.0, 1.0]]


def test_what_no_output_tells_of_is_named():
    class Odometer(Prior):
        """Its own way is measured nowhere."""

        states = (Signal("way", "m"), Signal("speed", "m/s"), Signal("heat", "K", 0.0, 300.0))
        inputs = (Signal("force", "N"),)
        outputs = (Signal("speed", "m/s"),)

        def xdot(self, x, u, w, p):
            return x.speed, u.force - x.speed, x.speed - 0.1 * x.heat

    class Sum(Odometer):
        """Way and heat are told together but not apart: both run on at the same rate."""

        outputs = (Signal("speed", "m/s"), Signal("sum", "-"))

        def xdot(self, x, u, w, p):
            return x.speed, u.force - x.speed, x.speed

        def output(self, x, u, w, p):
            return x.speed, x.way + x.heat

    assert unseen_states(Odometer(), 0.1, 1.0) == ["way", "heat"]
    assert unseen_states(Sum(), 0.1, 1.0) == ["way", "heat"]
    for seen in (Tanks(), Masses(), Pendulum(), Speedometer(), Pace()):
        assert unseen_states(seen, DT, 1.0) == [], type(seen).__name__


# samples that are missing or censored


@dataclass(frozen=True)
class Censored(Trajectory):
    """A recording of a sensor that has ends."""

    censored: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int8))

    def part(self, keep, name=None, role=None):
        return replace(super().part(keep, name, role), censored=self.censored[keep])


def clipped(run, low, high):
    y = np.clip(run.y, low, high)
    sign = np.where(run.y >= high, 1, np.where(run.y <= low, -1, 0)).astype(np.int8)
    return Censored(**{**vars(run), "y": y, "censored": sign}), replace(run, y=y)


def test_a_sensor_at_its_end_says_at_least_and_not_exactly():
    truth, run = noisy(7)
    limit = 0.6 * np.abs(truth.y).max()
    told, taken = clipped(run, -limit, limit)
    assert 0.05 < (told.censored != 0).mean() < 0.7
    assert {-1, 1} <= set(told.censored.ravel().tolist())
    smoother = smoother_of(Pendulum(TRUTH), [run], DT, (SIGMA,), (0.05,))
    beyond = told.censored[:, 0] != 0
    errors = [rms((smoother.smooth([r])[0].x - truth.x)[beyond, 0]) for r in (told, taken)]
    # the equations carry on where the sensor stops, and do not believe that the pendulum does
    assert errors[0] < 5e-3
    assert errors[0] < 0.05 * errors[1]


def test_a_censored_sample_counts_where_the_estimate_contradicts_it():
    """A mass that no force moves. Its sensor says "at least 0.5 m" at first, and then measures 0."""

    class Free(MechanicalPrior):
        states, outputs = (Signal("q", "m"), Signal("v", "m/s")), (Signal("q", "m"),)
        inputs, parameters = (Signal("f", "N"),), (Parameter("m", 1.0, "kg", 0.5, 2.0),)

        def mass_matrix(self, q, p):
            return p.m

    n = 60
    nothing, sign = np.full((n, 2), np.nan), np.zeros((n, 1), dtype=np.int8)
    y = np.where(np.arange(n)[:, None] < 30, 0.5, 0.0)
    sign[:30] = 1
    base = {"u": np.zeros((n, 1)), "y": y, "x": nothing, "xdot": nothing, "w": np.zeros((n, 0))}
    run = Censored("free", "train", DT, DT * np.arange(n), **base, censored=sign)
    sizes = Sizes((1.0,), (0.01,), (1.0, 1.0), (1.0, 1.0))
    smoother = Smoother(Free(), DT, sigma=(0.01,), walk=(0.5,), sizes=sizes)
    above, below = (smoother.smooth([replace(run, censored=k * sign)])[0].x[:30, 0] for k in (1, -1))
    # the limit holds to a few of the sensor's standard deviations; the last samples before the jump give way to it
    assert above[:-6].min() > 0.5 - 0.04
    assert above.max() > 1.0  # and is no measurement
    assert below.max() < 0.5 + 0.04
    # "at most" is no news to who lies below: it is as if nothing had been measured
    missing = replace(run, y=np.where(sign != 0, np.nan, y), censored=0 * sign)
    # but for the guess of the first state, known to 10 m: as the sensor to it
    np.testing.assert_allclose(below, smoother.smooth([missing])[0].x[:30, 0], atol=0.01)


def test_errors_are_whitened_where_a_diverged_filter_makes_their_covariance_singular():
    """Covariances as those of a boat's filter at a walk far too large: rounding leaves them rank one."""
    rng = np.random.default_rng(0)
    e, roots = rng.normal(size=(2, 5, 3)), rng.normal(size=(5, 3, 3))
    s = roots @ roots.swapaxes(1, 2) * np.outer([1e-3, 1.0, 1e4], [1e-3, 1.0, 1e4])
    white, logs = _whitened(e, s)
    wanted = np.linalg.solve(np.linalg.cholesky(s), e[..., None])[..., 0]
    np.testing.assert_allclose(white, wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(logs, np.linalg.slogdet(s)[1], rtol=1e-12)
    deviations = np.array([2.0**175, 2.0**187, 2.0**149])
    white, logs = _whitened(e[0, :1], np.outer(deviations, deviations)[None])
    assert np.isfinite(white).all()
    assert np.isfinite(logs).all()
    assert np.isnan(_whitened(e[0, :1], np.full((1, 3, 3), np.nan))[1]).all()
