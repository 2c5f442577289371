"""ARX and subspace models: known systems are found, free runs start from their warm-up, real machines are predicted."""

from dataclasses import dataclass, replace

import control
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from hybrid_mpc import InputError, fit_arx, fit_subspace
from hybrid_mpc.identify import linear

EXACT = 1e-8
"""Relative: rounding, 1e-16, times the condition of regressions on some hundred samples, with room."""
DELAY = 3


@dataclass(frozen=True)
class Run:
    y: np.ndarray
    u: np.ndarray


@dataclass(frozen=True)
class Disturbed(Run):
    w: np.ndarray


def system(direct=0.0):
    """A, B, C, D of two inputs and two outputs: a swing, a slow and a fast mode, in mixed states."""
    rng = np.random.default_rng(7)
    a = np.diag([0.0, 0.0, 0.97, 0.5])
    a[:2, :2] = 0.93 * np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    mix, b, c = (rng.normal(size=shape) for shape in ((4, 4), (4, 2), (2, 4)))
    return mix @ a @ np.linalg.inv(mix), b, c, direct * rng.normal(size=(2, 2))


def run(matrices, n, seed, *, noise=0.0, process=0.0, offset=300.0):
    """A recording far from zero; its initial state is its own."""
    a, b, c, d = matrices
    rng = np.random.default_rng(seed)
    x, u, y = rng.normal(size=len(a)), 3 + rng.normal(size=(n, b.shape[1])), np.empty((n, len(c)))
    for k in range(n):
        y[k] = c @ x + d @ u[k]
        x = a @ x + b @ u[k] + process * rng.normal(size=len(a))
    return Run(y + offset + noise * rng.normal(size=y.shape), u)


def recordings(matrices, **options):
    """Two to train on and one to choose with, of different lengths."""
    first, second, third = (run(matrices, n, seed, **options) for seed, n in enumerate((300, 500, 200)))
    return [first, second], [third]


A1, A2 = np.array([[1.2, 0.1], [-0.2, 0.9]]), np.array([[-0.5, 0.0], [0.1, -0.3]])
B0, B1 = np.array([[1.0, 0.5], [0.0, 2.0]]), np.array([[0.3, 0.0], [-0.4, 0.1]])


def arx_run(n, seed, noise=0.0):
    """``y_k = A1 y_(k-1) + A2 y_(k-2) + B0 u_(k-3) + B1 u_(k-4) + c + e_k``."""
    rng = np.random.default_rng(seed)
    u, y, e = rng.normal(size=(n, 2)), np.zeros((n, 2)), noise * rng.normal(size=(n, 2))
    for k in range(DELAY + 1, n):
        y[k] = A1 @ y[k - 1] + A2 @ y[k - 2] + B0 @ u[k - DELAY] + B1 @ u[k - DELAY - 1] + [5.0, -2.0] + e[k]
    return Run(y[DELAY + 1 :], u[DELAY + 1 :])


def arx_markov(n):
    """Its answer to an impulse."""
    h = [np.zeros((2, 2))] * DELAY + [B0, A1 @ B0 + B1]
    while len(h) < n:
        h.append(A1 @ h[-1] + A2 @ h[-2])
    return np.array(h)


def markov(model, n):
    """D, C B, C A B, ... in the signals' units."""
    ss = model.state_space()
    found, x = [ss.D], ss.B
    while len(found) < n:
        found.append(ss.C @ x)
        x = ss.A @ x
    return np.array(found)


def response(ss):
    return np.asarray(ss.frequency_response(np.geomspace(1e-3, 3.0, 60) / ss.dt).complex)


def off(found, true):
    """Largest error over the largest value."""
    return float(np.abs(found - true).max() / np.abs(true).max())


def cva(*args, **options):
    return fit_subspace(*args, **options, weighting="cva")


def n4sid(*args, **options):
    return fit_subspace(*args, **options, weighting="n4sid")


all_fits = pytest.mark.parametrize("fit", [fit_arx, cva, n4sid])
both = pytest.mark.parametrize("fit", [fit_arx, fit_subspace])


# what is found


@all_fits
def test_a_system_without_noise_is_found_and_runs_freely(fit):
    matrices, (train, valid) = system(), recordings(system())
    model = fit(train, valid, 0.1, warm=10)
    assert (model.chosen.order, model.chosen.stable, model.warnings) == (2 if fit is fit_arx else 4, True, ())
    assert off(response(model.state_space()), response(control.ss(*matrices, 0.1))) < EXACT
    test = run(matrices, 250, 6)
    (y_hat,) = model.free_runs([test], 10)
    assert off(y_hat - 300, test.y[10:] - 300) < EXACT


def test_an_arx_with_delay_is_found():
    model = fit_arx([arx_run(400, 0), arx_run(200, 1)], [arx_run(200, 2)], 0.1, warm=10)
    assert (model.chosen.order, model.chosen.delay) == (2, DELAY)
    assert off(markov(model, 30), arx_markov(30)) < EXACT


@pytest.mark.parametrize(("fit", "option"), [(fit_arx, {"delays": [0]}), (fit_subspace, {"direct": True})])
def test_a_direct_path_is_found_where_it_is_asked_for(fit, option):
    matrices = system(direct=1.0)
    train, valid = recordings(matrices)
    model = fit(train, valid, 0.1, warm=10, **option)
    assert off(response(model.state_space()), response(control.ss(*matrices, 0.1))) < EXACT
    without = fit(train, valid, 0.1, warm=10)
    assert not without.D.any()
    assert without.chosen.error > 1e3 * model.chosen.error


def ratio_of_errors(error):
    """Error at 1000 over that at 16 times as many samples, root mean square over eight paired seeds."""
    few, many = (np.array([error(n, seed) for seed in range(8)]) for n in (1000, 16_000))
    return float(np.sqrt(np.mean(few**2) / np.mean(many**2)))


# With 1 / sqrt(n) it is 4. The root mean square of eight normal numbers is known to 1 / sqrt(2 * 8) = 25 %, the ratio
# of two, at three deviations, to the factor exp(3 * sqrt(2) * 0.25) = 2.9. An error that stays gives 1, 1 / n 16.
LAW = (4 / 2.9, 4 * 2.9)


@pytest.mark.parametrize("fit", [pytest.param(cva, marks=pytest.mark.full), n4sid])
def test_the_error_of_a_subspace_model_falls_as_the_root_of_the_samples(fit):
    true = response(control.ss(*system(), 0.1))

    def error(n, seed):
        train, valid = run(system(), n, seed, noise=1.0, process=0.3), run(system(), 100, 99)
        model = fit([train], [valid], 0.1, warm=10, orders=[4], horizons=[10])
        return off(response(model.state_space()), true)

    assert LAW[0] < ratio_of_errors(error) < LAW[1]


def test_the_gain_is_that_of_the_kalman_filter():
    """Its errors of one step are those of the best filter, and its poles, to what 20 000 samples tell."""
    a, b, c, d = system()
    noise, process = 1.0, 0.3
    train, valid = (
        run((a, b, c, d), n, seed, noise=noise, process=process) for seed, n in enumerate((20_000, 500))
    )
    model = fit_subspace([train], [valid], 0.1, warm=50, orders=[4], horizons=[20])
    p = solve_discrete_are(a.T, c.T, process**2 * np.eye(4), noise**2 * np.eye(2))
    best = c @ p @ c.T + noise**2 * np.eye(2)
    found = model.noise * np.outer(model.y_scale, model.y_scale)
    # a variance of 20 000 samples is known to 1 %; three deviations and the end of the past
    assert off(found, best) < 0.04
    # and the filter's poles are those of the best one: the gain's error is about 1 / sqrt(20 000) times a few
    gain = a @ p @ c.T @ np.linalg.inv(best)
    poles = np.sort(np.abs(np.linalg.eigvals(a - gain @ c)))
    assert np.sort(np.abs(np.linalg.eigvals(model.A - model.K @ model.C))) == pytest.approx(poles, abs=0.1)


# units, recordings, gaps


@both
def test_units_and_offsets_change_nothing(fit):
    train, valid = recordings(system(), noise=0.3)
    test = run(system(), 250, 6, noise=0.3)
    by_y, by_u = np.array([1e6, 1.0]), np.array([1.0, 1e-6])
    y_offset, u_offset = np.array([0.0, 300.0]), np.array([300.0, 0.0])

    def in_units(r):
        return Run((r.y + y_offset) * by_y, (r.u + u_offset) * by_u)

    model = fit(train, valid, 0.1, warm=10)
    other = fit([in_units(r) for r in train], [in_units(r) for r in valid], 0.1, warm=10)
    assert (other.chosen.order, other.chosen.delay) == (model.chosen.order, model.chosen.delay)
    expected = (model.free_runs([test], 10)[0] + y_offset) * by_y
    assert off(other.free_runs([in_units(test)], 10)[0] / by_y, expected / by_y) < EXACT
    gain, other_gain = response(model.state_space()), response(other.state_space())
    scale = by_y[:, None, None] / by_u[:, None]
    assert off(other_gain / scale, gain) < 1e-6  # an offset of 300 on a spread of 1 costs two digits


@all_fits
def test_missing_samples_are_left_out(fit):
    train, valid = recordings(system())
    missing = np.random.default_rng(0).random((500, 2)) < 0.01
    train = [train[0], replace(train[1], y=np.where(missing, np.nan, train[1].y))]
    gone = valid[0].y.copy()
    gone[[2, 3, 50]] = np.nan  # of its warm-up, too
    model = fit(train, [replace(valid[0], y=gone)], 0.1, warm=12)
    assert off(response(model.state_space()), response(control.ss(*system(), 0.1))) < EXACT
    (y_hat,) = model.free_runs([replace(valid[0], y=gone)], 12)
    assert off(y_hat - 300, valid[0].y[12:] - 300) < EXACT


def test_measured_disturbances_join_the_inputs():
    train, valid = recordings(system())
    split = [[Disturbed(r.y, r.u[:, :1], r.u[:, 1:]) for r in part] for part in (train, valid)]
    for fit in (fit_arx, fit_subspace):
        model, other = fit(train, valid, 0.1, warm=10), fit(*split, 0.1, warm=10)
        assert np.array_equal(model.B, other.B)
        assert np.array_equal(other.free_runs(split[1], 10)[0], model.free_runs(valid, 10)[0])
        assert np.array_equal(other.free_run(valid[0].y[:10], valid[0].u), other.free_runs(split[1], 10)[0])


# how a model is chosen


@both
def test_where_none_is_stable_the_best_is_taken_and_says_so(fit):
    grows = np.array([[1.05]]), np.array([[1.0]]), np.array([[1.0]]), np.zeros((1, 1))
    model = fit([run(grows, 80, 0)], [run(grows, 60, 1)], 0.1, warm=10, orders=[1])
    assert not model.chosen.stable
    assert "no candidate is stable" in model.warnings[-1]
    assert model.chosen.radius == pytest.approx(1.05, rel=1e-6)  # the bias of a growing mean costs digits


def test_a_candidate_whose_filter_cannot_be_made_is_passed_over(monkeypatch):
    make = linear._gain

    def gain(a, *given):
        if len(a) == 4:
            raise InputError("as of an A far from stable")
        return make(a, *given)

    monkeypatch.setattr(linear, "_gain", gain)
    model = fit_subspace(*recordings(system(), noise=0.3), 0.1, warm=10)
    assert model.chosen.order != 4
    assert {c.error for c in model.candidates if c.order == 4} == {np.inf}


@both
def test_the_order_follows_the_free_run_and_the_least_that_is_alike(fit):
    train, valid = recordings(system(), noise=0.3)
    model = fit(train, valid, 0.1, warm=10)
    stable = [c for c in model.candidates if c.stable]
    best = min(c.error for c in stable)
    assert model.chosen in model.candidates
    assert model.chosen.order == min(
        c.order for c in stable if c.error <= best * linear.ALIKE + linear.ROUNDING
    )
    errors = (model.free_runs(valid, 10)[0] - valid[0].y[10:]) / np.concatenate([r.y for r in train]).std(
        axis=0
    )
    assert model.chosen.error == pytest.approx(float(np.sqrt(np.mean(errors**2))), rel=1e-12)


# free runs


@both
def test_many_windows_are_each_its_own_free_run(fit):
    train, valid = recordings(system(), noise=0.3)
    model = fit(train, valid, 0.1, warm=10)
    starts = np.arange(0, 150, 7)
    y, u = (np.stack([a[s : s + 50] for s in starts]) for a in (valid[0].y, valid[0].u))
    y[1, 3], y[2, 4, 0] = np.nan, np.nan
    y_hat = model.free_run(y[:, :10], u)
    assert y_hat.shape == (len(starts), 40, 2)
    scaled = (u - model.u_centre) / model.u_scale
    for i in range(len(starts)):
        assert np.allclose(model.free_run(y[i, :10], u[i]), y_hat[i], rtol=0, atol=1e-9)  # rounding at 300
        x = model._start((y[i : i + 1, :10] - model.y_centre) / model.y_scale, scaled[i : i + 1, :10])[0]
        for k in range(10, 50):  # one step a time, as its equations say
            expected = (model.C @ x + model.D @ scaled[i, k]) * model.y_scale + model.y_centre
            assert np.allclose(y_hat[i, k - 10], expected, rtol=0, atol=1e-9)
            x = model.A @ x + model.B @ scaled[i, k] + model.bias
    stacked = model.free_run(y[:20, :10].reshape(4, 5, 10, 2), u[:20].reshape(4, 5, 50, 2))
    assert np.allclose(stacked.reshape(20, 40, 2), y_hat[:20], rtol=0, atol=1e-9)
    assert model.free_runs([], 10) == []


# what is refused, what is doubtful


def constant(array, column):
    array = array.copy()
    array[:, column] = 4.0
    return array


def nan_at(array):
    array = array.copy()
    array[7, 0] = np.nan
    return array


BOTH, SUBSPACE = (fit_arx, fit_subspace), (fit_subspace,)
SHORT = {"train": lambda r: [run(system(), 8, 0, noise=0.3)]}
REFUSED = {
    "no training": (BOTH, {"train": lambda r: []}, {}, r"training.*029"),
    "no validation": (BOTH, {"valid": lambda r: []}, {}, r"validation.*029"),
    "an input that rests": (BOTH, {"train": lambda r: [replace(x, u=constant(x.u, 1)) for x in r]}, {}, "036"),
    "an output that rests": (BOTH, {"train": lambda r: [replace(x, y=constant(x.y, 0)) for x in r]}, {}, "035"),
    "an output that is nowhere": (
        BOTH, {"train": lambda r: [replace(x, y=np.full_like(x.y, np.nan)) for x in r]}, {}, "035",
    ),
    "a column less": (BOTH, {"valid": lambda r: [replace(r[0], u=r[0].u[:, :1])]}, {}, r"validation recording 1.*031"),
    "a vector": (BOTH, {"train": lambda r: [Run(r[0].y[:, 0], r[0].u)]}, {}, r"\(300,\).*\(300, 2\).*030"),
    "different lengths": (BOTH, {"train": lambda r: [Run(r[0].y[:-1], r[0].u)]}, {}, r"\(299, 2\).*\(300, 2\).*030"),
    "a missing input": (BOTH, {"train": lambda r: [replace(r[0], u=nan_at(r[0].u)), r[1]]}, {}, "032"),
    "an infinite output": (BOTH, {"train": lambda r: [replace(r[0], y=1 / (r[0].y * 0 + [0, 1])), r[1]]}, {}, "033"),
    "a short validation": (BOTH, {"valid": lambda r: [Run(r[0].y[:10], r[0].u[:10])]}, {}, r"10.*10.*034"),
    "a disturbance of another length": (
        BOTH, {"train": lambda r: [Disturbed(r[0].y, r[0].u, np.zeros((5, 1)))]}, {}, r"\(5, 1\).*300.*026",
    ),
    "no warm-up": (BOTH, {}, {"warm": 0}, "028"),
    "half a sample": (BOTH, {}, {"warm": 2.5}, r"2\.5.*028"),
    "no period": (BOTH, {}, {"dt": 0.0}, r"0\.0.*027"),
    "a period that is no number": (BOTH, {}, {"dt": float("nan")}, r"nan.*027"),
    "no orders": (BOTH, {}, {"orders": []}, r"orders.*\[\].*037"),
    "an order of zero": (BOTH, {}, {"orders": [2, 0]}, "037"),
    "an unknown weighting": (SUBSPACE, {}, {"weighting": "moesp"}, r"'moesp'.*025"),
    "a horizon of one": (SUBSPACE, {}, {"horizons": [1]}, "037"),
    "more states than the data have": (SUBSPACE, {}, {"orders": [8]}, "039"),
    "too short for any order": ((fit_arx,), SHORT, {}, "15 runs of 2 samples, one recording of 16; there are 7.*038"),
    "too short for an order": (
        (fit_arx,), SHORT, {"orders": [1, 4]}, "needs 51 runs of 5 samples, one recording of 55; there are 4.*038",
    ),
    "too short for any horizon": (SUBSPACE, SHORT, {}, "123 runs of 10 samples, one recording of 132; there.*038"),
    "too many states for a horizon": (
        SUBSPACE, SHORT, {"orders": [30], "horizons": [10]}, "horizon 10 is too short for 30 states of 2 outputs.*038",
    ),
}  # fmt: skip
"""Fits, changes of the recordings, options, and what the message holds."""


@pytest.mark.parametrize(
    ("fit", "case"), [(fit, case) for case, (fits, *_) in REFUSED.items() for fit in fits]
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_what_cannot_be_used_is_refused(fit, case):
    _, changes, options, message = REFUSED[case]
    parts = dict(zip(("train", "valid"), recordings(system()), strict=True))
    parts |= {role: change(parts[role]) for role, change in changes.items()}
    with pytest.raises(InputError, match=message):
        fit(parts["train"], parts["valid"], **{"dt": 0.1, "warm": 10, **options})


@pytest.mark.parametrize("fit", [fit_arx, fit_subspace])
def test_the_length_that_is_asked_for_is_enough(fit):
    needed = 16 if fit is fit_arx else 132
    options = {"dt": 0.1, "warm": 10}
    valid = [run(system(), 100, 1)]
    assert fit([run(system(), needed, 0, noise=0.3)], valid, **options).candidates
    with pytest.raises(InputError, match="HM-IDENTIFY-038"):
        fit([run(system(), needed - 1, 0, noise=0.3)], valid, **options)


def test_a_free_run_of_other_shapes_is_refused():
    model = fit_arx(*recordings(system()), 0.1, warm=10, orders=[2])
    for y, u, message in (
        ((5, 2), (20, 3), "021"), ((5, 1), (20, 2), "021"), ((4, 5, 2), (3, 20, 2), "021"), ((2,), (20, 2), "021"),
        ((21, 2), (20, 2), r"21.*20.*022"), ((0, 2), (20, 2), "022"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            model.free_run(np.zeros(y), np.zeros(u))
    with pytest.raises(InputError, match="HM-IDENTIFY-023"):
        model.free_run(np.zeros((5, 2)), np.full((20, 2), np.nan))
    with pytest.raises(InputError, match=r"10.*HM-IDENTIFY-024"):
        model.free_runs([Run(np.zeros((10, 2)), np.zeros((10, 2)))], 10)


@both
def test_inputs_that_excite_too_little_are_doubtful(fit):
    def driven(n, seed, u):
        a, b, c, _ = system()
        x, y = np.zeros(4), []
        for k in range(n):
            y.append(c @ x)
            x = a @ x + b @ u[k]
        return Run(np.array(y) + 0.1 * np.random.default_rng(seed).normal(size=(n, 2)), u)

    sine = np.sin(0.3 * np.arange(400))[:, None] * [1.0, 0.5]  # one frequency, and the same one twice
    lines = driven(400, 0, sine)
    assert any("excite 2 of the" in w for w in fit([lines], [lines], 0.1, warm=10).warnings)
    noise = np.random.default_rng(1).normal(size=(400, 2))
    rich = driven(400, 0, noise)
    assert not fit([rich], [rich], 0.1, warm=10).warnings
    twice = driven(400, 0, noise[:, [0, 0]])
    assert any("excite" in w for w in fit([twice], [twice], 0.1, warm=10).warnings)


def test_a_disturbance_that_rests_is_doubtful():
    train, valid = recordings(system())
    still = [[Disturbed(r.y, r.u, np.full((len(r.y), 1), 21.5)) for r in part] for part in (train, valid)]
    for fit in (fit_arx, fit_subspace):
        model = fit(*still, 0.1, warm=10)
        assert model.warnings == (
            "measured disturbance (input 3) never changes in the training recordings, so the model lacks its effect",
        )
        assert off(response(model.state_space())[:, :2], response(control.ss(*system(), 0.1))) < EXACT
        assert np.abs(model.state_space().B[:, 2]).max() < EXACT
