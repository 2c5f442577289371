"""With delays the estimate is still the exact Kalman filter's, at the instant at which the input acts."""

import numpy as np
import pytest
from online_models import make_filter, pendulum_model, random_linear

from hybrid_mpc import DelayCompensation, InputError, TrueState


def augmented_filter(a, b, c, ys, us, m, p, delay, seen):
    """The textbook filter over the last ``delay + 1`` states side by side; the oldest is measured."""
    n_x, n_u = b.shape
    f = np.block([[a, b], [np.zeros((n_u, n_x)), np.eye(n_u)]])
    n, copies = n_x + n_u, delay + 1
    big, g, q = np.zeros((n * copies,) * 2), np.zeros((n * copies, n_u)), np.zeros((n * copies,) * 2)
    big[:n, :n], g[:n_x] = f, b
    for i in range(1, copies):
        big[i * n : (i + 1) * n, (i - 1) * n : i * n] = np.eye(n)
    q[:n, :n] = np.diag([0.05**2] * n_x + [0.02**2] * n_u)
    cc = np.zeros((len(c), n * copies))
    cc[:, (copies - 1) * n : (copies - 1) * n + n_x] = c
    m, p = np.tile(m, copies), np.tile(p, (copies, copies))
    for k in range(len(ys)):
        if k:
            m, p = big @ m + g @ us[k - 1], big @ p @ big.T + q
        if k >= delay and (k or delay) and seen[k]:
            gain = p @ cc.T @ np.linalg.inv(cc @ p @ cc.T + 0.01 * np.eye(len(c)))
            m, p = m + gain @ (ys[k] - cc @ m), (np.eye(len(m)) - gain @ cc) @ p
    return m[:n], p[:n, :n], f


@pytest.mark.parametrize("input_delay", [0, 1, 2])
@pytest.mark.parametrize("sensor_delay", [0, 1, 2, 5])
def test_it_is_the_exact_filter_of_the_delayed_system(sensor_delay, input_delay):
    model, a, b, c = random_linear(4, n_x=3, n_u=2, n_y=2)
    rng = np.random.default_rng(sensor_delay)
    decided, ys = rng.normal(size=(30, 2)), rng.normal(size=(30, 2))
    seen = rng.random(30) < 0.8  # some are missing
    seen[0] = True
    estimator = DelayCompensation(make_filter(model), sensor_delay=sensor_delay, input_delay=input_delay)
    first = estimator.estimator.start(ys[0])
    e = estimator.start(ys[0])
    for k in range(1, 30):
        e = estimator.update(e, ys[k] if seen[k] else np.full(2, np.nan), decided[k - 1])
    acting = np.vstack([np.zeros((input_delay, 2)), decided])  # the input that acts in each period
    m0 = np.concatenate([first.x, first.d])
    m, p, f = augmented_filter(a, b, c, ys, acting, m0, first.P, sensor_delay, seen)
    q = np.diag([0.05**2] * 3 + [0.02**2] * 2)
    for u in acting[29 : 29 + input_delay]:
        m, p = f @ m + np.concatenate([b @ u, np.zeros(2)]), f @ p @ f.T + q
    # Rounding only: 30 recursions on numbers of order one.
    np.testing.assert_allclose(np.concatenate([e.x, e.d]), m, rtol=0, atol=1e-10)
    np.testing.assert_allclose(e.P, p, rtol=0, atol=1e-10)
    assert e.t == pytest.approx((29 + input_delay) * model.dt)
    assert e.filtered.t == pytest.approx((29 - sensor_delay) * model.dt)


def test_an_oracle_predicts_with_its_model():
    model = pendulum_model(z=3)
    ahead = DelayCompensation(TrueState(model), input_delay=2)
    z, decided = np.array([0.3, 0.1, 0.0, 0.2, 0.0]), [np.array([0.5]), np.array([-0.7])]
    e = ahead.start(z)
    for u in decided:
        e = ahead.update(e, z, u)  # the machine has not moved, say
    x, h = z[:2], z[2:]
    for u in decided:
        x, h = (v.full().ravel() for v in model.step(x, h, u, model.w, model.p))
    np.testing.assert_allclose(np.concatenate([e.x, e.h]), np.concatenate([x, h]), atol=1e-15)


def test_estimates_are_pure():
    ekf = DelayCompensation(make_filter(pendulum_model(z=2)), sensor_delay=2)
    e = ekf.start([0.3])
    one, two = (ekf.update(ekf.update(e, [0.3], [0.1]), [0.3], [0.2]) for _ in range(2))
    np.testing.assert_array_equal(one.x, two.x)
    assert e.inputs == ()


def test_bad_delays_and_other_estimates_are_refused():
    ekf = make_filter(pendulum_model())
    for change in ({"sensor_delay": -1}, {"input_delay": 0.5}):
        with pytest.raises(InputError, match=r"delay.*HM-MODEL-025"):
            DelayCompensation(ekf, **change)
    with pytest.raises(InputError, match="HM-ESTIMATE-005"):
        DelayCompensation(ekf, sensor_delay=1).update(ekf.start([0.0]), [0.0], [0.0])
