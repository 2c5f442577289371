"""The window's estimate is the Kalman filter's where nothing else acts, and IPOPT's where bounds and outliers do."""

from functools import partial

import casadi as ca
import numpy as np
import pytest
from online_models import linear_model, pendulum_model, random_linear

from hybrid_mpc import (
    OCP,
    CondensedController,
    DelayCompensation,
    Disturbance,
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    Loop,
    MovingHorizonEstimator,
    Parameter,
    Signal,
    TrackedParameter,
    TrackingFilter,
    UnscentedKalmanFilter,
)

STATES = ("x", "h", "d")


def sigmas(model, **changes):
    own = {
        "sigma_y": np.full(model.n_y, 0.1), "sigma_x": np.full(model.n_x, 0.05), "sigma_d": np.full(model.n_d, 0.02),
        "sigma_x0": np.full(model.n_x, 0.3), "sigma_d0": np.full(model.n_d, 0.2),
    }  # fmt: skip
    return {**own, **changes}


def stacked(estimate):
    return np.concatenate([estimate.x, estimate.h, estimate.d])


def tanks(lower=0.0):
    """Two levels, each from ``lower`` up; the second is measured, its outflow depends on a parameter."""
    x, u, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p")
    out = ca.vertcat(0.3, p) * ca.sqrt(x + 0.01)  # smooth down to an empty tank
    rates = ca.vertcat(u - out[0], out[0] - out[1])
    return HybridModel.of(
        "tanks", 0.2, (Signal("upper", "m", lower, 3.0), Signal("lower", "m", lower, 3.0)),
        (Signal("pump", "m/s"),), (Signal("level", "m"),), x=x, u=u, p=p, x_next=x + 0.2 * rates, xdot=rates, y=x[1],
        parameters=(Parameter("outlet", 0.35, "m^0.5/s", 0.1, 1.0),), nominal_x=(0.3, 0.2),
        nominal_u=(0.3 * np.sqrt(0.31),), disturbance_model=(Disturbance("input", "pump"),),
    )  # fmt: skip


def emptied(model, n, seed=0, load=0.0):
    """Outputs and inputs while the tanks run empty, with noise of 0.02, and from the ninth period on an inflow."""
    rng, x, ys = np.random.default_rng(seed), np.array([0.2, 0.15]), []
    us = np.where(np.arange(n) < 0.8 * n, 0.0, 0.2)[:, None]
    for k, u in enumerate(us):
        ys.append(x[1:] + 0.02 * rng.normal(size=1))
        x = np.maximum(model.step(x, [], u + load * (k >= 8), model.w, model.p)[0].full().ravel(), 0.0)
    return np.array(ys), us


TANK = {
    "sigma_y": [0.02],
    "sigma_x": [0.02, 0.02],
    "sigma_x0": [0.2, 0.02],
    "sigma_d": [0.01],
    "sigma_d0": [0.05],
}


def plain(model, periods=6):
    """Without a robust loss the window's estimate of a linear model is the Kalman filter's."""
    return MovingHorizonEstimator(model, **sigmas(model), periods=periods, huber=np.inf, jump=np.inf)


def unscented(model):
    return UnscentedKalmanFilter(model, **sigmas(model))


@pytest.mark.parametrize(
    ("n_h", "kind"),
    [
        (0, partial(plain, periods=5)),
        (0, partial(plain, periods=60)),
        (3, partial(plain, periods=8)),
        (0, unscented),
        (3, unscented),
    ],
    ids=["window 5", "window 60", "window 8, h", "unscented", "unscented, h"],
)
def test_on_a_linear_model_it_is_the_kalman_filter(n_h, kind):
    model, *_ = random_linear(4, n_x=3, n_u=2, n_y=2, n_h=n_h)
    rng = np.random.default_rng(0)
    ys, us = rng.normal(size=(40, 2)), rng.normal(size=(40, 2))
    ys[7], ys[9, 0] = np.nan, np.nan
    got, want = kind(model), ExtendedKalmanFilter(model, **sigmas(model))
    for a, b in zip(got.run(ys, us), want.run(ys, us), strict=True):
        np.testing.assert_allclose(stacked(a), stacked(b), rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.P, b.P, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            [*a.innovation, a.nis, a.t], [*b.innovation, b.nis, b.t], rtol=0, atol=1e-9
        )
    ahead = want.predict(want.start(ys[0]), us[0])
    assert got.assess(ahead, ys[1])[1] == pytest.approx(want.assess(ahead, ys[1])[1], abs=1e-9)
    np.testing.assert_allclose(
        got.innovation_covariance(ahead), want.innovation_covariance(ahead), atol=1e-12
    )


def solved_by_ipopt(mhe, e, first):
    """The window's problem as a nonlinear program over the trajectory, slacks for the losses' linear parts."""
    model, (m, n) = mhe.model, (len(e.ys), e.z.shape[1])
    (q, r), p0, n_x = mhe.noise, np.diag(mhe.first), model.n_x
    z, over, under = ca.MX.sym("z", n, m + 1), ca.MX.sym("over", 2, m), ca.MX.sym("under", 2, m)
    cost = 0.5 * ca.bilin(ca.inv(ca.DM(p0)), z[:, 0] - first)
    for k in range(m):
        x_next, _ = model.step(z[:n_x, k], [], e.us[k] + z[n_x:, k], model.w, model.p)
        noise = (z[:, k + 1] - ca.vertcat(x_next, z[n_x:, k])) / np.sqrt(q)
        cost += 0.5 * ca.sumsqr(noise[:n_x]) + 0.5 * (noise[n_x:] - over[1, k] + under[1, k]) ** 2
        error = (e.ys[k] - model.output(z[:n_x, k + 1], e.us[k], model.w, model.p)) / np.sqrt(r)
        cost += 0.5 * (error - over[0, k] + under[0, k]) ** 2
        cost += mhe.huber * (over[0, k] + under[0, k]) + mhe.jump * (over[1, k] + under[1, k])
    v = ca.vertcat(z[:], over[:], under[:])
    free = np.full((m + 1, n - n_x), np.inf)
    low, high = np.tile(mhe.lower, (m + 1, 1)), np.tile(mhe.upper, (m + 1, 1))
    options = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.tol": 1e-10,
        "ipopt.bound_relax_factor": 0.0,
    }
    solver = ca.nlpsol("mhe", "ipopt", {"x": v, "f": cost}, options)
    found = solver(
        x0=np.concatenate([e.z.ravel() + 0.01, np.ones(4 * m)]),
        lbx=np.concatenate([np.hstack([low, -free]).ravel(), np.zeros(4 * m)]),
        ubx=np.concatenate([np.hstack([high, free]).ravel(), np.full(4 * m, np.inf)]),
    )["x"]
    assert solver.stats()["success"]
    return found.full().ravel()[: (m + 1) * n].reshape(m + 1, n)


@pytest.mark.parametrize(("seed", "load"), [(0, 0.0), (1, 0.0), (0, 1.5)])
def test_converged_it_is_the_solution_of_ipopt_with_bounds_outliers_and_jumps(seed, load):
    model = tanks()
    ys, us = emptied(model, 19, seed, load)
    ys[5] += 1.0  # 50 standard deviations
    noise = {**TANK, "sigma_x": [2e-3, 2e-3], "sigma_d": [0.1], "sigma_d0": [0.01]} if load else TANK
    mhe = MovingHorizonEstimator(model, **noise, periods=20, iterations=200, jump=1.0)
    e = mhe.run(ys, us)[-1]
    want = solved_by_ipopt(mhe, e, e.first)
    if load:  # a jump has the linear loss
        assert np.max(np.abs(np.diff(want[:, 2]))) > 1.1 * mhe.jump * 0.1
    else:  # a bound is active
        assert np.any(want[:, :2] < 1e-7)
    np.testing.assert_allclose(e.z, want, rtol=0, atol=1e-6)


def test_bounds_are_kept_where_the_kalman_filter_violates_them():
    model = tanks()
    ys, us = emptied(model, 120)
    ys[60] = np.nan
    mhe, ekf = MovingHorizonEstimator(model, **TANK, periods=10), ExtendedKalmanFilter(tanks(-1.0), **TANK)
    for e in mhe.run(ys, us):
        assert np.all(e.z[:, :2] >= 0)
        assert np.all(e.x >= 0)
    assert min(e.x.min() for e in ekf.run(ys, us)) < -1e-3
    other = MovingHorizonEstimator(model, **TANK, lower=[-np.inf, 0.05], upper=[np.inf, np.inf])
    assert min(e.x[1] for e in other.run(ys, us)) == 0.05


def test_ranges_of_periodic_signals_are_no_bounds():
    model = pendulum_model()
    assert not np.isfinite(MovingHorizonEstimator(model, **sigmas(model)).lower).any()


@pytest.mark.parametrize("at", [30, 39])
def test_an_outlier_moves_it_less_than_the_kalman_filter(at):
    model, a, b, c = random_linear(2, n_x=2, n_u=1, n_y=1)
    rng = np.random.default_rng(0)
    x, us, ys = np.zeros(2), rng.normal(size=(40, 1)), []
    for u in us:
        ys.append(c @ x + 0.1 * rng.normal(size=1))
        x = a @ x + b @ u + 0.05 * rng.normal(size=2)
    clean, dirty = np.array(ys), np.array(ys)
    dirty[at] += 10.0  # 100 standard deviations
    moved = {}
    for kind in (ExtendedKalmanFilter, MovingHorizonEstimator):
        filter = kind(model, **sigmas(model))
        moved[kind] = np.linalg.norm(filter.run(dirty, us)[-1].x - filter.run(clean, us)[-1].x)
    assert moved[MovingHorizonEstimator] < 0.1 * moved[ExtendedKalmanFilter]


def test_an_outlier_that_left_the_window_keeps_its_bounded_influence():
    model, *_ = random_linear(2, n_x=2, n_u=1, n_y=1)
    ys, us = np.zeros((30, 1)), np.zeros((30, 1))
    ys[4] = 1e6
    short, long = (MovingHorizonEstimator(model, **sigmas(model), periods=n) for n in (6, 40))
    # the same problem; the short window decides about an outlier without the samples that come later
    np.testing.assert_allclose(short.run(ys, us)[-1].x, long.run(ys, us)[-1].x, rtol=0, atol=0.02)


def test_missing_samples_leave_the_prediction_and_the_rest_of_a_sample_counts():
    model, *_ = random_linear(4, n_x=3, n_u=2, n_y=2)
    mhe, ekf = (kind(model, **sigmas(model)) for kind in (MovingHorizonEstimator, ExtendedKalmanFilter))
    ahead = mhe.predict(mhe.start([0.1, 0.2]), [0.1, 0.0])
    assert mhe.correct(ahead, [np.nan, np.inf]) is ahead
    got, want = (f.correct(f.predict(f.start([0.1, 0.2]), [0.1, 0.0]), [0.15, np.nan]) for f in (mhe, ekf))
    np.testing.assert_allclose(got.x, want.x, rtol=0, atol=1e-12)
    e = mhe.start([0.1, 0.2])
    for _ in range(50):  # longer than the window
        e = mhe.predict(e, [0.0, 0.0])
    assert len(e.ys) == mhe.periods


def rubbish(n, n_y, seed=0):
    """Samples of every kind that a broken sensor sends, between ordinary ones."""
    rng = np.random.default_rng(seed)
    bad = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e154, 1e9, 5.0])
    ys = 0.1 * rng.normal(size=(n, n_y))
    ys = np.where(rng.random((n, n_y)) < 0.3, bad[rng.integers(len(bad), size=(n, n_y))], ys)
    return np.where(
        (np.arange(n)[:, None] // 40) % 7 == 3, np.nan, ys + 3.0 * ((np.arange(n)[:, None] // 100) % 2)
    )


def survives(kind, model, n, **options):
    """Drive through rubbish samples and inputs, then 200 ordinary ones."""
    filter = kind(model, **options)
    rng = np.random.default_rng(1)
    us = np.where(rng.random((n, model.n_u)) < 0.02, 1e300, 0.1 * rng.normal(size=(n, model.n_u)))
    us = np.where(rng.random((n, model.n_u)) < 0.02, np.nan, us)
    e = filter.start(np.full(model.n_y, np.nan))
    for y, u in zip(rubbish(n, model.n_y), us, strict=True):
        e = filter.update(e, y, u)
    for _ in range(200):
        e = filter.update(e, model.output(model.x0, model.u0, model.w, model.p).full().ravel(), model.u0)
    assert e.finite
    assert np.isfinite(e.P).all()
    np.testing.assert_allclose(e.x, model.x0, rtol=0, atol=0.05)


PENDULUM = {
    "sigma_y": [1e-3],
    "sigma_x": [1e-3, 1e-2],
    "sigma_x0": [1e-2, 0.1],
    "sigma_d": [0.02],
    "sigma_d0": [0.1],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n", [2000, pytest.param(50_000, marks=pytest.mark.full)])
def test_rubbish_raises_nothing(n):
    survives(MovingHorizonEstimator, tanks(), n, **TANK)
    converging = {"huber": np.inf, "jump": np.inf, "iterations": 3}
    survives(MovingHorizonEstimator, pendulum_model(z=3), n // 5, **PENDULUM, **converging)
    survives(UnscentedKalmanFilter, pendulum_model(z=3), n, **PENDULUM)


def test_a_jump_of_the_load_is_found_sooner_than_by_the_kalman_filter():
    a, b = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.005], [0.1]])
    model, errors = linear_model(a, b, np.array([[1.0, 0.0]])), {}
    for kind in (ExtendedKalmanFilter, MovingHorizonEstimator):
        filter = kind(model, **sigmas(model, sigma_y=[0.01], sigma_x=[1e-3, 1e-3], sigma_d=[0.02]))
        rng, x, e = np.random.default_rng(0), np.zeros(2), filter.start([0.0])
        for k in range(55):
            x = a @ x + b[:, 0] * 2.0 * (k >= 40)
            e = filter.update(e, x[:1] + 0.01 * rng.normal(size=1), [0.0])
        errors[kind] = abs(e.d[0] - 2.0)
    assert errors[MovingHorizonEstimator] < 0.5 * errors[ExtendedKalmanFilter], errors


@pytest.mark.parametrize("kind", [MovingHorizonEstimator, UnscentedKalmanFilter])
def test_a_constant_load_leaves_no_offset(kind):
    model = pendulum_model()
    filter = kind(model, **PENDULUM)
    x, e = np.zeros(2), filter.start([0.0])
    for _ in range(300):
        x = model.step(x, [], [0.3 + 0.5], model.w, model.p)[0].full().ravel()
        e = filter.update(e, x[:1], [0.3])
    np.testing.assert_allclose(e.d, 0.5, rtol=0, atol=0.01)
    np.testing.assert_allclose(e.x, x, rtol=0, atol=2e-3)


@pytest.mark.parametrize("kind", [plain, unscented])
@pytest.mark.parametrize("delays", [(0, 2), (3, 1)])
def test_with_delays_it_is_the_delayed_kalman_filter(kind, delays):
    model, *_ = random_linear(4, n_x=3, n_u=2, n_y=2)
    rng = np.random.default_rng(0)
    ys, us = rng.normal(size=(30, 2)), rng.normal(size=(30, 2))
    got, want = (
        DelayCompensation(f, sensor_delay=delays[0], input_delay=delays[1])
        for f in (kind(model), ExtendedKalmanFilter(model, **sigmas(model)))
    )
    a, b = got.start(ys[0]), want.start(ys[0])
    for y, u in zip(ys[1:], us, strict=False):
        a, b = got.update(a, y, u), want.update(b, y, u)
        np.testing.assert_allclose(stacked(a), stacked(b), rtol=0, atol=1e-9)


def test_tracked_parameters_are_states_of_its_window():
    model = tanks()
    base = MovingHorizonEstimator(model, **TANK, periods=7, huber=3.0)
    tracking = TrackingFilter(base, [TrackedParameter("outlet", 0.3, relative=True)])
    assert isinstance(tracking.inner, MovingHorizonEstimator)
    assert (tracking.inner.periods, tracking.inner.huber) == (7, 3.0)
    x, e = np.array([0.3, 0.2]), tracking.start([0.2])
    rng = np.random.default_rng(0)
    for k in range(400):
        u = [0.25 + 0.15 * np.sin(0.1 * k)]
        x = model.step(x, [], u, model.w, [0.45])[0].full().ravel()
        e = tracking.update(e, x[1:] + 0.005 * rng.normal(size=1), u)
    assert e.w[-1] > 0.4  # 0.35 is the fitted value, 0.45 the true one


def test_measured_disturbances_act_in_their_period():
    x, u, w = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("w")
    level = (Signal("x", "m"),)
    model = HybridModel.of(
        "tank", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, w=w, x_next=0.9 * x + u + w, xdot=u, y=x + 0.1 * w,
        disturbances=(Signal("inflow", "-"),),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    ys, us, ws = (rng.normal(size=(30, 1)) for _ in range(3))
    ws[4] = np.nan
    got, want = (
        f.run(ys, us, w=ws)[-1] for f in (plain(model), ExtendedKalmanFilter(model, **sigmas(model)))
    )
    np.testing.assert_allclose(stacked(got), stacked(want), rtol=0, atol=1e-9)


def test_a_loop_runs_with_it():
    model = linear_model(
        np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]]), np.array([[1.0, 0.0]])
    )
    loop = Loop(
        MovingHorizonEstimator(model, **sigmas(model, sigma_y=[0.01], sigma_d=[0.2])),
        CondensedController(model, OCP(20, [1.0, 0.1], [0.0], [0.1], [-5.0], [5.0])), reference=[0.5, 0.0],
    )  # fmt: skip
    x, u = np.zeros(2), loop.start([0.0])
    for k in range(80):
        x = np.array([[1.0, 0.1], [0.0, 1.0]]) @ x + np.array([0.005, 0.1]) * (u[0] + 1.0)  # a load of 1
        u = loop.step([np.nan if k % 9 == 0 else 40.0 if k % 13 == 0 else x[0]])
    assert abs(x[0] - 0.5) < 0.02


def test_estimates_are_pure():
    model = pendulum_model(z=2)
    mhe = MovingHorizonEstimator(model, **PENDULUM)
    e = mhe.update(mhe.start([0.1]), [0.11], [0.1])
    one, two = (mhe.update(mhe.update(e, [0.3], [0.1]), [0.3], [0.2]) for _ in range(2))
    np.testing.assert_array_equal(one.z, two.z)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"huber": 0.0}, "HM-ESTIMATE-028"),
        ({"jump": np.nan}, "HM-ESTIMATE-028"),
        ({"lower": [0.0]}, "HM-ESTIMATE-029"),
        ({"lower": [0.0, 5.0]}, "HM-ESTIMATE-030"),
        ({"upper": [np.nan, 1.0]}, "HM-ESTIMATE-030"),
        ({"periods": 0}, "HM-MODEL-025"),
        ({"iterations": 0.5}, "HM-MODEL-025"),
    ],
)
def test_bad_options_are_refused(change, code):
    with pytest.raises(InputError, match=code):
        MovingHorizonEstimator(tanks(), **TANK, **change)
