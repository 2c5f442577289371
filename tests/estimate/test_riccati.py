"""Riccati equation, LQR and the hidden state's fixed point."""

import numpy as np
import pytest
from online_models import pendulum_model, random_linear

from hybrid_mpc import InputError, dare, lqr


def test_dare_solves_its_equation_and_its_matrix_is_the_cost_of_the_closed_loop():
    _, a, b, _ = random_linear(3, n_x=4, n_u=2, radius=1.3)
    q, r = np.diag([1.0, 0.5, 0.0, 2.0]), np.diag([0.3, 0.7])
    p, k = dare(a, b, q, r)
    residual = q + a.T @ p @ a - a.T @ p @ b @ k - p
    assert np.max(np.abs(residual)) < 1e-9 * np.max(np.abs(p))  # rounding of a 4 x 4 solve
    assert np.max(np.abs(np.linalg.eigvals(a - b @ k))) < 1
    x = np.array([1.0, -2.0, 0.5, 0.3])
    want, cost = x @ p @ x, 0.0
    for _ in range(2000):
        u = -k @ x
        cost, x = cost + x @ q @ x + u @ r @ u, a @ x + b @ u
    assert cost == pytest.approx(want, rel=1e-10)  # the closed loop has decayed to zero


@pytest.mark.parametrize(
    ("a", "b", "r"),
    [([[2.0]], [[0.0]], [[1.0]]), ([[1.0]], [[np.nan]], [[1.0]]), ([[2.0]], [[0.0]], [[0.0]])],
)
def test_what_cannot_be_stabilised_is_refused(a, b, r):
    with pytest.raises(InputError):
        dare(a, b, [[1.0]], r)


def test_friction_at_rest_dominates_and_a_moving_point_avoids_it():
    model, target = pendulum_model(friction=0.3), ([0.0, 0.0], [0.0], [10.0, 0.1], [1.0])
    rest, moving = lqr(model, *target), lqr(model, *target, working_point=([0.0, 2.0], [0.0]))
    assert rest[0, 1] != pytest.approx(moving[0, 1], rel=0.1)


def precise_gain(a, b, q, r):
    """The gain by doubling with eighty digits."""
    mp = pytest.importorskip("mpmath")
    with mp.workdps(80):
        a, b, q, r = (mp.matrix(m.tolist()) for m in (a, b, q, r))
        f, g, h, eye = a, b * r**-1 * b.T, q, mp.eye(a.rows)
        for _ in range(200):
            w = (eye + g * h) ** -1
            f, g, h, before = f * w * f, g + f * w * g * f.T, h + f.T * h * w * f, h
            if mp.norm(h - before) <= mp.mpf(10) ** -60 * mp.norm(h):
                break
        return np.array(((r + b.T * h * b) ** -1 * b.T * h * a).tolist(), dtype=float)


SYSTEMS = {
    "integrator": ([[1.0]], [[1.0]]),
    "two integrators": ([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]]),
    "unstable": ([[1.1, 0.1], [0.2, 0.9]], [[0.0], [0.1]]),
    "stable": ([[0.9, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.99]], [[1.0], [1.0], [1.0]]),
    "two inputs": ([[1.0, 0.1, 0.0], [0.0, 1.0, 0.3], [0.0, 0.1, 0.8]], [[0.0, 0.1], [0.1, 0.0], [1.0, 0.0]]),
}


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("power", [-14, -7, 0, 7, 14, 16])
def test_the_gain_is_right_for_inputs_of_any_weight(name, power):
    """At 1e16 a closed loop's modes are 1e-8 from the unit circle: as many digits are lost at most."""
    a, b = map(np.array, SYSTEMS[name])
    q, r = np.eye(len(a)), 10.0**power * np.eye(b.shape[1])
    wanted = precise_gain(a, b, q, r)
    assert np.abs(dare(a, b, q, r)[1] - wanted).max() < 1e-7 * np.abs(wanted).max()


@pytest.mark.parametrize("power", [-9, -4, 4, 9])
def test_the_gain_is_the_same_in_other_units(power):
    """State 0 in units that are ten to the power as large, state 1 the other way round."""
    a, b = map(np.array, SYSTEMS["two integrators"])
    size = np.array([10.0**power, 10.0**-power])
    scaled = a * size[:, None] / size, b * size[:, None], np.diag(size**-2.0), np.eye(1)
    wanted = dare(a, b, np.eye(2), np.eye(1))[1] / size
    np.testing.assert_allclose(dare(*scaled)[1], wanted, rtol=1e-9)
