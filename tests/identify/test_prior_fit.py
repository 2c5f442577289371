"""The fit of a prior to measured outputs: true parameters found again, from any start, with what recordings have."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from example_priors import TANKS, Arm, Swing, Tanks, TorchArm, TorchSwing, TorchTanks
from scipy.optimize._numdiff import approx_derivative
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError, Parameter, Signal, Trajectory, fit_prior
from hybrid_mpc.identify.fit import beyond_ranges, refit, smoothed
from hybrid_mpc.identify.fit_warnings import warnings_of
from hybrid_mpc.identify.identifiable import Fitted
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.simulation import Simulation, rest_of
from hybrid_mpc.identify.windows import continued, cut_outputs

NOISE = 2e-3


def outputs_of(prior, run, noise=0.0, seed=0):
    """A recording with the outputs of another prior [of the same states], white noise on them, and nothing else."""
    rng, f = np.random.default_rng(seed), prior.equations.output
    y = f(run.x.T, run.u.T, run.w.T, prior.p).full().T
    nothing = np.full_like(run.x, np.nan)
    return replace(run, y=y + noise * rng.standard_normal(y.shape), x=nothing, xdot=nothing)


def swings(prior=Pendulum, noise=0.0, n=3, seconds=3.0, first=0, **options):
    """Recordings of the true pendulum by the outputs of a prior."""
    runs = [record(first + seed, seconds=seconds, **options) for seed in range(n)]
    return [outputs_of(prior(TRUTH), run, noise, first + seed) for seed, run in enumerate(runs)]


def tanks(seed, noise=0.0, n=200, dt=1.0):
    """The true tanks under random inflow and rain; of their levels the lower one is measured."""
    rng, prior = np.random.default_rng(seed), Tanks(TANKS)
    u, w = (np.repeat(rng.uniform(0.02, top, n // 10 + 1), 10)[:n, None] for top in (0.35, 0.1))
    start = rng.uniform(0.3, 1.0, (1, 2))
    simulation = Simulation(prior.equations.xdot, dt)
    x = simulation.values(start, u[None], w[None], prior.p, 4)[0]
    empty = np.zeros_like(x)
    run = Trajectory(f"tanks{seed}", "train", dt, dt * np.arange(n), u, x[:, 1:], x, empty, w)
    return outputs_of(prior, run, noise, 100 + seed)


def off(fit, truth):
    """Largest error of the parameters, relative."""
    return max(abs(fit.values[name] / value - 1) for name, value in truth.items())


def fitted(prior, runs, dt=DT, **options):
    *train, valid = runs
    return fit_prior(prior, train, [replace(valid, role="valid")], dt=dt, **options)


@pytest.fixture(scope="module")
def noisy_runs():
    return swings(noise=NOISE, n=4)


@pytest.fixture(scope="module")
def fit(noisy_runs):
    return fitted(Pendulum, noisy_runs)


# machines and sensors


class AlongTheArm(Pendulum):
    """The weight's way to the side: one height of it, two angles."""

    outputs = (Signal("side", "m"),)

    def output(self, x, u, w, p):
        return 0.8 * np.sin(x.phi) if isinstance(x.phi, float) else 0.8 * x.phi.sin()


class Tachometer(Pendulum):
    outputs = (Signal("phi_dot", "rad/s"),)


class TwoSensors(Pendulum):
    """Of one degree of freedom the angle, and a current that a second motor would need: not the states themselves."""

    outputs = (Signal("phi", "rad"), Signal("current", "A"))

    def output(self, x, u, w, p):
        return x.phi, 1e3 * (u.torque - p.d * x.phi_dot)


@pytest.mark.parametrize(
    "sensor",
    [Pendulum, AlongTheArm, *(pytest.param(s, marks=pytest.mark.full) for s in (Tachometer, TwoSensors))],
)
def test_true_parameters_are_found_without_noise(sensor):
    found = fitted(sensor, swings(sensor))
    # the recordings are integrated to 1e-10; a step of Runge-Kutta is off by (0.07)^5 / 120 a period
    assert off(found, TRUTH) < 1e-4
    assert found.warnings == ()


@pytest.mark.parametrize(("sensor", "noise"), [
    pytest.param(Pendulum, 2e-3, marks=pytest.mark.full), pytest.param(AlongTheArm, 2e-3, marks=pytest.mark.full),
    (Tachometer, 2e-2), (TwoSensors, np.array([2e-3, 0.5])),
])  # fmt: skip
def test_true_parameters_are_found_in_noise(sensor, noise):
    found = fitted(sensor, swings(sensor, noise))
    # noise of some tenths of a per cent of the motion over 6 s
    assert off(found, {"J": TRUTH["J"], "mgl": TRUTH["mgl"]}) < 0.01
    assert off(found, TRUTH) < 0.05  # damping takes a tenth of the swing's energy
    for name, value in TRUTH.items():
        # few windows: their scatter tells the errors by a factor of two only
        assert abs(found.values[name] - value) < 6 * found.standard_errors[name], name


@pytest.mark.parametrize("kind", [Tanks, pytest.param(TorchTanks, marks=pytest.mark.full)])
def test_a_tank_is_found_whose_level_has_no_sensor(kind):
    exact = fitted(kind, [tanks(seed) for seed in range(3)], dt=1.0)
    # the same integrator with other sub-steps
    assert off(exact, TANKS) < 1e-3
    found = fitted(kind, [tanks(seed, noise=1e-3) for seed in range(3)], dt=1.0)
    assert off(found, TANKS) < 0.1  # 1 mm; area and outflow of the upper tank show in the lower one alone
    assert found.warnings == ()
    run = tanks(5)
    upper = Simulation(Tanks(TANKS).equations.xdot, 1.0)
    level = smoothed(kind, found, [run], 1.0)[0].x
    again = upper.values(level[20:21], run.u[None, 20:], run.w[None, 20:], Tanks(TANKS).p, 4)[0]
    np.testing.assert_allclose(level[20:-20, 0], again[:-20, 0], atol=0.05)  # a tenth of how far it moves


def reaching(noise=NOISE):
    """The true arm under random torques, both angles measured."""
    prior, runs = Arm(), []
    for seed in range(3):
        rng, n = np.random.default_rng(seed), 150
        u = np.repeat(rng.uniform(-1.0, 1.0, (n // 10, len(prior.inputs))), 10, axis=0)
        simulation = Simulation(prior.equations.xdot, DT)
        start = np.array([[0.3, -0.2, 0.0, 0.0]])
        x = simulation.values(start, u[None], np.zeros((1, n, 0)), 1.05 * prior.p, 4)[0]
        run = Trajectory(f"arm{seed}", "train", DT, DT * np.arange(n), u, x[:, :2], x, np.zeros_like(x))
        runs.append(outputs_of(prior, run, noise, seed))
    return runs


@pytest.mark.parametrize(("one", "other", "runs"), [
    pytest.param(Swing, TorchSwing, lambda: swings(noise=NOISE), marks=pytest.mark.full),
    (Tanks, TorchTanks, lambda: [tanks(seed, noise=1e-3) for seed in range(3)]),
    pytest.param(Arm, TorchArm, lambda: reaching(), marks=pytest.mark.full),
])  # fmt: skip
def test_the_same_machine_in_casadi_and_in_torch_has_the_same_fit(one, other, runs):
    data, found = runs(), []
    for kind in (one, other):
        fit = OutputFit(kind, data[0].dt)
        guessed = [replace(run, x=np.tile(rest_of(kind())[0] + 0.1, (len(run.t), 1))) for run in data]
        problem = Shooting(fit, cut_outputs(guessed, 25, 0, 8), np.ones(len(fit.prior.states)))
        point = problem.start(1.02 * fit.nominal, problem.windows.x, "all")
        best = problem.solve(fit.nominal)
        found.append((point, best, problem.explained([best.theta])[0]))
    (ours, best, cost), (theirs, other_best, other_cost) = found
    # the same operations in another order
    np.testing.assert_allclose(theirs.error, ours.error, rtol=0, atol=1e-10)
    np.testing.assert_allclose(theirs.slopes, ours.slopes, rtol=0, atol=1e-10 * np.abs(ours.slopes).max())
    assert other_cost == pytest.approx(cost, rel=1e-8)
    told = np.sqrt(np.diag(best.covariance))
    assert (np.abs(other_best.theta - best.theta) <= 1e-4 * told).all()
    whole, again = (fitted(kind, data, dt=data[0].dt) for kind in (one, other))
    for name, error in whole.standard_errors.items():
        assert abs(again.values[name] - whole.values[name]) <= 1e-4 * error, name
        assert again.standard_errors[name] == pytest.approx(error, rel=1e-6), name
    assert again.best == whole.best


# recordings as they are


@pytest.mark.parametrize("share", [pytest.param(0.2, marks=pytest.mark.full), 0.6])
def test_missing_samples_are_no_hindrance(noisy_runs, fit, share):
    rng = np.random.default_rng(0)
    gappy = [
        replace(run, y=np.where(rng.uniform(size=run.y.shape) < share, np.nan, run.y)) for run in noisy_runs
    ]
    gappy[0].y[60:80] = np.nan
    found = fitted(Pendulum, gappy)
    assert off(found, {"J": TRUTH["J"], "mgl": TRUTH["mgl"]}) < 0.01
    assert off(found, TRUTH) < 0.05
    # fewer samples tell less, not more
    assert found.standard_errors["mgl"] > 0.8 * fit.standard_errors["mgl"]


def test_two_sensors_of_different_rates():
    runs = swings(TwoSensors, np.array([2e-3, 0.5]))
    for run in runs:
        run.y[::2, 1] = np.nan
        run.y[1::3, 0] = np.nan
    assert off(fitted(TwoSensors, runs), TRUTH) < 0.05


@pytest.mark.parametrize("size", [0.5, 50.0])
def test_a_few_gross_outliers_move_nothing(noisy_runs, fit, size):
    rng, spoilt = np.random.default_rng(1), []
    for run in noisy_runs:
        y = run.y.copy()
        y[rng.integers(10, len(y) - 10, 5), 0] += size * rng.choice([-1.0, 1.0], 5)
        spoilt.append(replace(run, y=y))
    found = fitted(Pendulum, spoilt)
    assert off(found, TRUTH) < 0.05
    for name, value in fit.values.items():
        # five of 150 samples count by three standard deviations at most: half of what the noise of the rest makes
        assert abs(found.values[name] - value) < 3 * fit.standard_errors[name], name
        assert 0.5 < found.standard_errors[name] / fit.standard_errors[name] < 4.0, name


@pytest.mark.parametrize(
    "start", [*(pytest.param(s, marks=pytest.mark.full) for s in ("lower", "upper")), "mixed"]
)
def test_bad_starts_still_find_the_machine(noisy_runs, start):
    """Nominal values at the corners of the bounds: 5 times too small an inertia, 10 times too much damping."""

    def corner(i, p):
        value = {"lower": p.lower, "upper": p.upper, "mixed": (p.lower, p.upper)[i % 2]}[start]
        return replace(p, value=value)

    class Bad(Pendulum):
        parameters = tuple(corner(i, p) for i, p in enumerate(Pendulum.parameters))

    assert off(fitted(Bad, noisy_runs), TRUTH) < 0.05


def test_a_start_of_ones_own_is_tried_besides_the_nominal_values(noisy_runs):
    class Fixed(Pendulum):
        parameters = (*Pendulum.parameters[:2], Parameter("d", 0.05, "N m s/rad", 0.05, 0.05))

    found = fitted(Fixed, noisy_runs, start=TRUTH)  # a fixed one of it is left out
    assert off(found, TRUTH) < 0.02
    assert found.values["d"] == 0.05
    assert set(found.standard_errors) == {"J", "mgl"}


# what the result says


@pytest.mark.full
def test_standard_errors_are_the_scatter_over_noise():
    """Over 20 draws the errors over their standard errors have a root mean square of 1, which 20 draws of three
    correlated parameters tell to some 20 %; scatter of a dozen windows as a measure of the errors and the ends of
    windows that share samples take more: half and twice."""
    runs, draws = swings(n=4, seconds=3.0), []
    for seed in range(20):
        rng = np.random.default_rng([seed, 1])  # not the numbers that the motions are drawn with
        noisy = [replace(run, y=run.y + 5e-3 * rng.standard_normal(run.y.shape)) for run in runs]
        found = fitted(Pendulum, noisy, length=0.5)
        draws.append([(found.values[k] - v, found.standard_errors[k]) for k, v in TRUTH.items()])
    error, stated = np.moveaxis(np.array(draws), 2, 0)
    ratio = np.sqrt(np.mean(np.square(error / stated)))
    assert 0.5 < ratio < 2.0
    for i, name in enumerate(TRUTH):
        scatter = np.std(error[:, i], ddof=1)
        assert 0.4 < np.median(stated[:, i]) / scatter < 2.5, name
        assert abs(np.mean(error[:, i])) < 4 * scatter / np.sqrt(20), name  # no bias


def test_it_says_what_smooths_states(noisy_runs, fit):
    assert fit.sigma[0] == pytest.approx(NOISE, rel=0.1)  # 600 samples: 3 %
    assert (len(fit.walk), fit.delay) == (1, 0.0)
    truth, found = record(0, seconds=3.0), smoothed(Pendulum, fit, noisy_runs[:1], DT)[0]
    assert np.sqrt(np.mean((found.x - truth.x)[:, 0] ** 2)) < NOISE
    assert np.sqrt(np.mean((found.x - truth.x)[:, 1] ** 2)) < 0.01 * np.std(truth.x[:, 1])


def test_progress_is_told(noisy_runs):
    seen = []
    fitted(Pendulum, noisy_runs[:2], on_progress=lambda *told: seen.append(told))
    assert [done for done, _, _ in seen] == sorted(done for done, _, _ in seen)
    assert seen[-1] == (5, 5, "done")
    assert [text for _, _, text in seen if "free runs" in text] == [
        f"free runs of {seconds} s" for seconds in (0.5, 2, 2.98)
    ]


def test_a_prior_without_free_parameters_stays_as_it_is(noisy_runs):
    class Fixed(Pendulum):
        parameters = tuple(replace(p, lower=p.value, upper=p.value) for p in Pendulum.parameters)

    same = fitted(Fixed, noisy_runs)
    assert same.values == Fixed().values
    assert (same.best, same.standard_errors, same.warnings) == ("nominal", {}, ())
    assert same.stages[0]["validation_error"] > 0.01  # J is 50 % off
    assert same.sigma[0] > 0


def test_the_table_has_a_row_a_parameter(fit):
    table = fit.table(Pendulum.parameters)
    assert list(table.index) == ["J", "mgl", "d"]
    assert table.loc["mgl", "nominal"] == 1.0
    assert table.loc["mgl", "fitted"] == fit.values["mgl"]
    assert table.loc["mgl", "t_ratio"] == pytest.approx(fit.values["mgl"] / fit.standard_errors["mgl"])
    with_j = [fit.correlations[key] for key in ("J, mgl", "J, d")]
    assert table.loc["J", "correlation"] == max(with_j, key=abs)
    assert fit.rows(Pendulum.parameters)[2]["unit"] == "N m s/rad"
    assert set(fit.correlations) == {"J, mgl", "J, d", "mgl, d"}
    assert fit.t_ratios["J"] == fit.values["J"] / fit.standard_errors["J"]
    assert fit.identifiability == fit.warnings == ()  # these data identify all three
    close = replace(fit, correlations={"J, mgl": -0.995})
    assert any("J and mgl are hardly identifiable separately" in line for line in close.identifiability)
    covariance = np.array(fit.covariance(Pendulum.parameters))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), list(fit.standard_errors.values()), rtol=1e-12)
    assert (
        np.linalg.eigvalsh(covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))) > 0
    ).all()


# what the data do not tell


class Redundant(Pendulum):
    """Inertia and a second one, of which only the sum shows."""

    parameters = (*Pendulum.parameters, Parameter("J_2", 0.01, "kg m^2", 0.0, 0.1))

    def mass_matrix(self, q, p):
        return p.J + p.J_2


class Idle(Pendulum):
    """A parameter that is nowhere in the equations."""

    parameters = (*Pendulum.parameters, Parameter("idle", 1.0, "-", 0.0, 2.0))


@pytest.mark.parametrize(("kind", "names"), [(Redundant, {"J", "J_2"}), (Idle, {"idle"})])
def test_parameters_that_the_data_do_not_identify_are_named(noisy_runs, kind, names):
    found = fitted(kind, noisy_runs)
    (untold,) = found.unidentified
    assert set(untold.parameters) == names
    assert str(untold) in found.warnings
    if kind is Redundant:  # the sum shows
        assert not untold.product
        np.testing.assert_allclose(untold.weights, 1.0, rtol=0.02)
        assert untold.error < 0.01 * TRUTH["J"]
    inertia = found.values["J"] + found.values.get("J_2", 0.0)
    assert inertia == pytest.approx(TRUTH["J"], rel=0.01)  # what shows is found


def test_what_an_output_tells_only_together_is_reported():
    """Of a tank whose level has no sensor the outflow tells ``k_1^2 / a_1``."""

    class Both(Tanks):
        parameters = (Parameter("a_1", 0.8, "m^2", 0.3, 3.0), *Tanks.parameters[1:])

    found = fitted(Both, [tanks(seed, noise=1e-3) for seed in range(3)], dt=1.0)
    assert any("a_1" in line and "k_1" in line for line in found.identifiability)
    ratio = found.values["k_1"] ** 2 / found.values["a_1"]
    assert ratio == pytest.approx(TANKS["k_1"] ** 2 / TANKS["a_1"], rel=0.1)


def test_nothing_that_moves_tells_nothing():
    rest = record(0, seconds=1.0)
    still = replace(rest, u=0 * rest.u, y=0 * rest.y, x=0 * rest.x, xdot=0 * rest.xdot)
    assert fit_prior(Pendulum, [still], [still], dt=DT).warnings


def test_a_parameter_at_its_bound_is_named(noisy_runs):
    class Narrow(Pendulum):
        parameters = (Parameter("J", 0.15, "kg m^2", 0.12, 0.5), *Pendulum.parameters[1:])

    found = fitted(Narrow, noisy_runs)
    assert found.values["J"] == pytest.approx(0.12, rel=1e-3)
    assert any(line.startswith("J [kg m^2] ends at a bound (0.12") for line in found.warnings)


# what it is made of


def test_windows_lie_one_behind_the_other():
    runs = [record(seed, seconds=3.0) for seed in range(2)]  # 150 samples each
    windows = cut_outputs(runs, 25, 0, 100)
    assert windows.y.shape == (10, 26, 1)
    assert (windows.u.shape, windows.w.shape, windows.x.shape) == ((10, 26, 1), (10, 26, 0), (10, 2))
    for i in range(4):
        np.testing.assert_array_equal(windows.y[i, -1], windows.y[i + 1, 0])
    np.testing.assert_array_equal(windows.x[5], runs[1].x[0])
    late = cut_outputs(runs, 25, 3, 100)  # three inputs before each
    np.testing.assert_array_equal(late.u[0, :, 0], runs[0].u[:29, 0])
    np.testing.assert_array_equal(late.y[0], runs[0].y[3:29])
    few = cut_outputs([record(k, seconds=3.0) for k in range(4)], 25, 0, 10)
    assert len(few.y) == 10  # evenly chosen: the first and the last are there
    np.testing.assert_array_equal(few.y[-1], record(3, seconds=3.0).y[100:126])
    with pytest.raises(InputError, match=r"400.*403.*HM-IDENTIFY-073"):
        cut_outputs(runs, 400, 2, 10)


def _twice(windows):
    return np.concatenate([windows.x] * 2), windows.times(2)


@pytest.mark.parametrize("delay", [0.0, 2.5 * DT])
def test_its_derivatives_are_those_of_finite_differences(delay):
    """Outputs by parameters, delay and first states; outputs that ask for input and parameters themselves."""
    runs = [replace(run, x=record(k, seconds=3.0).x) for k, run in enumerate(swings(TwoSensors, n=2))]
    own = OutputFit(TwoSensors, DT, largest_delay=delay)
    windows = cut_outputs(runs, 20, own.lead, 3)
    theta = own.nominal * 1.1
    y, slopes = own.outputs(theta, windows.x, windows, 2, "all")
    assert y.shape == windows.y.shape

    def outputs(z):
        n = len(theta)
        states = windows.x + z[n:]
        return own.outputs(z[:n], states, windows, 2, "")[0].ravel()

    z = np.concatenate([theta, [0.0, 0.0]])
    numeric = approx_derivative(outputs, z, method="3-point")
    n = len(theta)
    scale = np.abs(numeric).max()
    # three-point differences: rounding^(2/3) of outputs of up to some hundred
    of_states = slopes[..., n:].reshape(-1, 2)
    np.testing.assert_allclose(slopes[..., :n].reshape(-1, n), numeric[:, :n], rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(of_states, numeric[:, n:], rtol=0, atol=1e-8 * scale)
    alone = own.outputs(theta, windows.x, windows, 2, "x")[1].reshape(-1, 2)
    np.testing.assert_allclose(alone, of_states, rtol=0, atol=1e-13 * scale)  # the same, in another order
    every, _ = own.outputs(np.stack([own.nominal, theta]), *_twice(windows), 2, "")
    np.testing.assert_array_equal(every[len(y) :], y)  # of several the last


def test_a_missing_sample_has_no_error_and_a_censored_one_only_on_the_wrong_side():
    (run,) = swings(n=1)
    run.y[5] = np.nan
    own = OutputFit(Pendulum, DT)
    windows = cut_outputs([replace(run, x=record(0, seconds=3.0).x)], 25, 0, 1)
    theta = own.scaled(TRUTH)
    y = own.outputs(theta, windows.x, windows, own.substeps(theta), "")[0]
    limit = replace(windows, y=np.where(np.isfinite(windows.y), y, np.nan))
    sign = np.zeros(y.shape)
    sign[:, 10:15], sign[:, 15:20] = 1, -1
    limit.y[:, 10:15] -= np.array([-0.1, 0.1, 0.1, -0.1, 0.1])[
        :, None
    ]  # at least this: exceeded where it is lower
    limit.y[:, 15:20] -= np.array([-0.1, 0.1, 0.1, -0.1, 0.1])[:, None]
    error = Shooting(own, replace(limit, censored=sign), np.ones(2)).start(theta, windows.x, "x").error
    counted = np.flatnonzero(np.abs(error[0]) > 1e-9)
    # at least: the estimate lies below; at most: it lies above
    assert counted.tolist() == [10, 13, 16, 17, 19]


def test_a_refit_goes_on_from_an_earlier_fit(fit):
    heavier = {**TRUTH, "mgl": 1.5, "J": 0.13}

    class Changed(Pendulum):
        pass

    rng = np.random.default_rng(3)
    base = record(40, seconds=3.0)
    prior = Changed(heavier)
    x = Simulation(prior.equations.xdot, DT).values(
        base.x[:1], base.u[None], np.zeros((1, len(base.u), 0)), prior.p, 2
    )[0]
    run = replace(base, y=x[:, :1] + NOISE * rng.standard_normal((len(x), 1)), x=np.full_like(x, np.nan))
    again = refit(Pendulum, fit, [run], dt=DT, lengths=(0.5, 1.0))
    assert off(again, {"J": 0.13, "mgl": 1.5}) < 0.03
    assert [row["stage"] for row in again.stages] == ["free runs of 0.5 s", "free runs of 1 s"]
    assert (again.sigma, again.walk, again.sizes) == (fit.sigma, fit.walk, fit.sizes)
    assert set(again.standard_errors) == set(TRUTH)


class Narrow(Pendulum):
    states = (Signal("phi", "rad", -0.01, 0.01), Pendulum.states[1])


def test_a_state_beyond_its_range_is_named(noisy_runs, fit):
    runs = smoothed(Pendulum, fit, noisy_runs, DT)
    (line,) = beyond_ranges(Narrow(), runs)
    assert "phi [rad] reaches -" in line
    assert "outside its range [-0.01, 0.01]" in line
    assert beyond_ranges(Pendulum(), runs) == ()


def test_a_fit_that_finds_its_nominal_values_again_raises_no_doubt(noisy_runs, fit):
    """As after an earlier fit's values were written into the prior."""

    class Known(Pendulum):
        parameters = tuple(replace(p, value=fit.values[p.name]) for p in Pendulum.parameters)

    again = fitted(Known, noisy_runs)
    assert not any("hardly improves" in line for line in again.warnings)
    assert not any("improve" in line for line in fit.warnings)  # from wrong nominal values


def test_a_fit_that_hardly_improves_says_so_unless_it_confirms_its_nominal_values():
    free = tuple(replace(p, value=TRUTH[p.name]) for p in Pendulum.parameters if not p.fixed)
    ones = np.ones(len(free))
    problem = SimpleNamespace(free=free, nominal=ones, lower=0.0 * ones, upper=3.0 * ones)
    sure, rough = (Fitted(ones, size**2 * np.eye(len(free)), ()) for size in (0.01, 0.2))
    moved, unknown = replace(sure, theta=1.2 * ones), replace(rough, unidentified=("m is not identifiable",))
    said = [len(warnings_of(problem, one, 0.0, 0.999)) for one in (sure, rough, moved, unknown)]
    assert said == [0, 0, 1, 2]


def test_recordings_that_follow_each_other_count_as_one() -> None:
    """A recording cut in two, files in any order, is the same recording; one that begins elsewhere stays apart."""
    runs = [record(k, seconds=3.0) for k in range(2)]
    moved = [replace(t, t=t.t + 100.0 * k) for k, t in enumerate(runs)]
    keeps = {"b": slice(70, None), "a": slice(0, 70)}
    halves = [t.part(keep, f"{k}{name}") for k, t in enumerate(moved) for name, keep in keeps.items()]
    for one, other in zip(continued(halves), moved, strict=True):
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.y, other.y)
    late = replace(halves[0], t=halves[0].t + 0.5 * halves[0].dt)
    assert len(continued([late, halves[1]])) == 2
    assert len(continued([t.part(keep) for t in moved for keep in keeps.values()])) == 4  # cut from one file
    jumped = replace(halves[0], y=halves[0].y + 10.0 * np.ptp(halves[0].y))
    assert len(continued([jumped, halves[1]])) == 2
