"""The filter is the textbook Kalman filter on a linear model, and gets over what no filter can use."""

import numpy as np
import pytest
from online_models import linear_model, make_filter, pendulum_model, random_linear

from hybrid_mpc import ExtendedKalmanFilter, InputError, TrueState
from hybrid_mpc.estimate.kalman import START_LIMIT


@pytest.mark.parametrize(("n_h", "n_u"), [(0, 1), (0, 2), (3, 2)])
def test_linear_model_gives_the_textbook_kalman_filter(n_h, n_u):
    model, a, b, c = random_linear(4, n_x=3, n_u=n_u, n_y=2, n_h=n_h)
    ekf = make_filter(model)
    rng = np.random.default_rng(1)
    ys, us = rng.normal(size=(40, 2)), rng.normal(size=(40, n_u))
    got = ekf.run(ys, us)
    n_z = 3 + n_h
    f = np.block([[a, b], [np.zeros((n_u, n_z)), np.eye(n_u)]])
    g = np.vstack([b, np.zeros((n_u, n_u))])
    cc = np.hstack([c, np.zeros((2, n_h + n_u))])
    q = np.diag([0.05**2] * 3 + [0.0] * n_h + [0.02**2] * n_u)
    m = np.concatenate([got[0].x, got[0].h, got[0].d])
    p = np.diag([0.3**2] * 3 + [0.0] * n_h + [0.2**2] * n_u)
    for k in range(1, 40):
        m, p = f @ m + g @ us[k - 1], f @ p @ f.T + q
        gain = p @ cc.T @ np.linalg.inv(cc @ p @ cc.T + 0.01 * np.eye(2))
        m, p = m + gain @ (ys[k] - cc @ m), (np.eye(len(m)) - gain @ cc) @ p
    # Rounding only: 40 recursions on numbers of order one.
    np.testing.assert_allclose(np.concatenate([got[-1].x, got[-1].h, got[-1].d]), m, rtol=0, atol=1e-10)
    np.testing.assert_allclose(got[-1].P, p, rtol=0, atol=1e-10)
    assert got[-1].t == pytest.approx(39 * model.dt)


def test_nis_is_chi_square_where_the_assumptions_hold():
    model, a, b, c = random_linear(2, n_x=2, n_u=1, n_y=1)
    ekf = make_filter(model, sigma_d=[0.0], sigma_d0=[0.0])
    rng = np.random.default_rng(0)
    x, u, ys = np.zeros(2), rng.normal(size=(2000, 1)), []
    for k in range(2000):
        ys.append(c @ x + 0.1 * rng.normal(size=1))
        x = a @ x + b @ u[k] + 0.05 * rng.normal(size=2)
    nis = np.array([e.nis for e in ekf.run(np.array(ys), u)[50:]])
    # Mean of 1950 chi-square(1) numbers: 1 with deviation sqrt(2/1950) = 0.032; four of these.
    assert abs(nis.mean() - 1.0) < 0.13


def test_start_is_at_rest_at_the_measurement_with_the_hidden_state_warmed_up():
    model = pendulum_model(z=4)
    e = make_filter(model).start([0.7], t=2.0)
    np.testing.assert_allclose(e.x, [0.7, 0.0], atol=1e-12)  # solved to 1e-12
    h = np.zeros(model.n_h)
    for _ in range(START_LIMIT):  # at rest for as long as training warms h up
        h = model.step(e.x, h, [0.0], model.w, model.p)[1].full().ravel()
    np.testing.assert_allclose(e.h, h, atol=1e-9)  # or fewer periods, once h moves by less than 1e-10
    assert e.t == 2.0
    assert np.all(e.d == 0)


def test_missing_measurement_leaves_the_prediction():
    ekf = make_filter(pendulum_model(z=4))
    predicted = ekf.predict(ekf.start([0.3]), [0.1])
    assert ekf.correct(predicted, [np.nan]) is predicted
    assert np.isnan(predicted.nis)
    assert np.all(np.isfinite(ekf.start([np.nan]).x))


def test_partly_missing_measurement_uses_the_rest():
    a, b = np.eye(2), np.ones((2, 1))
    both = make_filter(linear_model(a, b, np.eye(2)))
    one = make_filter(linear_model(a, b, np.eye(2)[:1]), sigma_y=[0.1])
    predicted = both.predict(both.start([0.0, 0.0]), [0.0])
    got, want = both.correct(predicted, [0.4, np.nan]), one.correct(predicted, [0.4])
    np.testing.assert_allclose(got.x, want.x, atol=1e-14)  # the same arithmetic
    assert np.isnan(got.innovation[1])


def test_without_deviations_of_d_there_is_no_disturbance_observer():
    model = pendulum_model(z=2)
    ekf = ExtendedKalmanFilter(model, sigma_y=[1e-3], sigma_x=[1e-3, 1e-2], sigma_x0=[1e-2, 0.1])
    e = ekf.start([0.0])
    for k in range(50):
        e = ekf.update(e, [0.01 * k], [0.3])  # far from what the model does
    assert e.d[0] == 0.0
    assert np.all(e.P[-1] == 0.0)


def test_true_state_passes_the_truth_on():
    model = pendulum_model(z=3)
    oracle = TrueState(model)
    e = oracle.update(oracle.start([0.0, 0, 0, 0, 0]), [1.0, 2, 3, 4, 5], [0.0])
    np.testing.assert_array_equal(np.concatenate([e.x, e.h]), [1.0, 2, 3, 4, 5])
    assert e.t == model.dt
    with pytest.raises(InputError, match="HM-ESTIMATE-009"):
        oracle.start([1.0, 2.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sigma_y": [0.0]}, "HM-ESTIMATE-006"),
        ({"sigma_x": [0.1]}, r"sigma_x.*HM-MODEL-017"),
        ({"sigma_d": [-1.0]}, r"sigma_d.*HM-ESTIMATE-008"),
        ({"sigma_x0": [np.nan, 1.0]}, "finite"),
    ],
)
def test_bad_deviations_and_shapes_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        make_filter(pendulum_model(), **change)
    with pytest.raises(InputError, match="HM-MODEL-019"):
        make_filter(pendulum_model()).run(np.zeros((5, 1)), np.zeros((4, 1)))


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("n", [50, 400, 3000])
def test_an_unstable_model_without_measurements_for_long(n, seed):
    # growth 1.3 per period: the covariance reaches 1e22 (singular to rounding), 1e91, and infinity
    model, *_ = random_linear(seed, n_x=2, n_u=1, n_y=2, radius=1.3)
    ekf = make_filter(model)
    e = ekf.start([0.5, -0.5])
    for _ in range(n):
        e = ekf.update(e, [np.nan, np.nan], [0.0])
    for _ in range(10):  # the machine rests at zero
        e = ekf.update(e, [0.0, 0.0], [0.0])
    deviation = np.sqrt(np.diag(e.P))
    assert np.all(np.abs(np.concatenate([e.x, e.d])) < 3 * deviation)  # as the filter itself believes
    assert np.max(deviation[:2]) < 0.3  # it is back at its ordinary size, sigma_x0
    assert np.min(np.linalg.eigvalsh(e.P)) > 0


@pytest.mark.filterwarnings("error")
def test_an_absurd_measurement_is_got_over_without_a_warning():
    ekf = make_filter(pendulum_model(z=3))
    e = ekf.start([0.1])
    for y in (1e308, 1e308, 0.1):
        e = ekf.update(e, [y], [0.0])
    assert not np.all(np.isfinite(ekf.predict(e, [0.0]).x))  # else this test shows nothing
    for _ in range(3):
        e = ekf.update(e, [0.1], [0.0])
    assert abs(e.x[0] - 0.1) < 0.3  # sigma_x0
    for y in (-1e308, np.inf, 0.1):
        e = ekf.update(e, [y], [1e300])
    assert np.all(np.isfinite(e.x))
