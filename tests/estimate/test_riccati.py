"""Riccati equation, LQR and the hidden state's fixed point."""

import numpy as np
import pytest
from online_models import pendulum_model, random_linear

from hybrid_mpc import InputError, dare, lqr
from hybrid_mpc.model.riccati import hidden_fixed_point


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


def test_hidden_state_at_its_fixed_point():
    model = pendulum_model(z=5)
    x, u = np.array([0.4, 0.0]), np.array([0.3])
    h = hidden_fixed_point(model, x, u)
    np.testing.assert_allclose(model.step(x, h, u, model.w, model.p)[1].full().ravel(), h, atol=1e-9)
    assert np.max(np.abs(h)) > 1e-3


def test_friction_at_rest_dominates_and_a_moving_point_avoids_it():
    model, target = pendulum_model(friction=0.3), ([0.0, 0.0], [0.0], [10.0, 0.1], [1.0])
    rest, moving = lqr(model, *target), lqr(model, *target, working_point=([0.0, 2.0], [0.0]))
    assert rest[0, 1] != pytest.approx(moving[0, 1], rel=0.1)


def test_lqr_stabilises_the_upright_pendulum():
    model, up = pendulum_model(), np.array([np.pi, 0.0])
    k = lqr(model, up, [0.0], [10.0, 1.0], [0.1])
    x = up + np.array([0.05, 0.0])
    for _ in range(500):
        x = model.step(x, [], -k @ (x - up), model.w, model.p)[0].full().ravel()
    assert np.max(np.abs(x - up)) < 1e-4  # 10 s, several time constants of the closed loop
