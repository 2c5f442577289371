import numpy as np
import pytest
from online_models import pendulum_model, random_linear

from hybrid_mpc import OCP, InputError, dare

GOOD = {
    "horizon": 10, "q": [1.0, 0.1], "r": [0.1], "r_delta": [0.0], "u_min": [-1.0], "u_max": [2.0],
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"horizon": 0}, "horizon"),
        ({"horizon": 2.5}, "horizon"),
        ({"horizon": np.nan}, "horizon"),
        ({"horizon": np.inf}, "horizon"),
        ({"horizon": "10"}, "horizon"),
        ({"q": "heavy"}, "q: numbers needed"),
        ({"q": np.eye(2)}, "the diagonal alone"),
        ({"soft": [3]}, "SoftBound"),
        ({"economic": 3}, "economic"),
        ({"blocks": (np.nan, 10)}, "whole numbers"),
        ({"q": [-1.0, 0.1]}, "q: weights"),
        ({"q": [np.nan, 0.1]}, "q: weights"),
        ({"r": [0.0]}, "not determined"),
        ({"r_delta": [0.0, 0.0]}, "r_delta: 2 values"),
        ({"u_min": [3.0]}, "cross"),
        ({"u_min": [np.nan]}, "cross"),
        ({"u_max": [1.0, 1.0]}, "1 needed"),
        ({"du_max": [0.0]}, "du_max must be positive"),
        ({"terminal": "lyapunov"}, "riccati"),
        ({"terminal": np.eye(3)}, r"\(2, 2\)"),
        ({"terminal": -np.eye(2)}, "negative eigenvalue"),
        ({"blocks": (1, 2, 4)}, "sum to the horizon of 10"),
        ({"blocks": (5, 5, 5)}, "15 periods"),
        ({"blocks": (10, 0)}, "at least 1"),
        ({"blocks": (2.5, 7.5)}, "whole numbers"),
        ({"blocks": ()}, "sum to the horizon"),
    ],
)
def test_bad_problems_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        OCP(**{**GOOD, **change})


def test_stage_cost_by_hand_and_over_a_batch():
    ocp = OCP(**{**GOOD, "r_delta": [10.0]})
    x, u, ref, du = np.array([[1.0, 2.0]] * 3), np.array([[0.5]] * 3), np.zeros((3, 2)), np.array([[0.1]] * 3)
    np.testing.assert_allclose(ocp.stage_cost(x, u, ref, du), 1 + 0.4 + 0.025 + 0.1, rtol=1e-14)


def test_terminal_weight_is_the_riccati_solution_times_dt():
    model, a, b, _ = random_linear(0, n_x=3, n_u=2)
    ocp = OCP(5, [1.0, 2.0, 3.0], [0.5, 0.6], [0.0, 0.0], [-1.0] * 2, [1.0] * 2)
    want, _ = dare(a, b, np.diag(ocp.q), np.diag(ocp.r))
    np.testing.assert_allclose(ocp.terminal_weight(model), want * model.dt, rtol=1e-9)


def test_terminal_weight_with_hidden_states_is_semidefinite():
    p = OCP(**GOOD, working_point=([0.0, 1.0], [0.0])).terminal_weight(pendulum_model(z=6))
    assert p.shape == (2, 2)
    assert np.min(np.linalg.eigvalsh(p)) >= 0
