"""The QP's answer is checked, whatever the solver says of it."""

import numpy as np
import pytest

from hybrid_mpc import OCP, Status
from hybrid_mpc.control import qp as qp_module
from hybrid_mpc.control.qp import InputQP
from hybrid_mpc.model.active_set import ActiveSet, Found

HESSIAN = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]])
GRADIENT = np.array([-9.0, 0.5, 1.0])
U, HELD = np.zeros((3, 1)), np.zeros(1)


def lie(change, du_max=None, held=HELD):
    """The QP's answer where the method returns something else than it found."""

    class Liar(ActiveSet):
        def solve(self, active=None):
            found = super().solve(active)
            s, multipliers = found.s.copy(), found.multipliers.copy()
            change({"x": s, "lam_x": multipliers})
            return Found(s, multipliers, found.active)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(qp_module, "ActiveSet", Liar)
        qp = qp_module.InputQP(OCP(3, [1.0], [1.0], [0.0], [-1.0], [2.0], du_max))
        return qp.solve(HESSIAN, GRADIENT, U, held)


def test_an_honest_solver_passes():
    answer = lie(lambda answer: None)
    assert answer.status is Status.SOLVED
    assert answer.kkt < 1e-5
    assert answer.step[0] == pytest.approx(2.0, abs=1e-6)  # the gradient pushes far beyond the upper bound


@pytest.mark.parametrize(
    ("entry", "value", "status"),
    [
        ("x", [2.0 / 1.5, 0.0, 0.0], Status.INACCURATE),  # feasible (scaled by half the range), not optimal
        ("x", [2.5 / 1.5, -0.8, -0.2], Status.INFEASIBLE),
        ("x", [np.nan, 0.0, 0.0], Status.NOT_FINITE),
        ("lam_x", [np.inf, 0.0, 0.0], Status.NOT_FINITE),
        ("lam_x", [0.0, 0.0, 0.0], Status.INACCURATE),  # multipliers that do not prove the answer
    ],
)
def test_wrong_answers_are_caught(entry, value, status):
    def change(answer):
        answer[entry][:] = value

    assert lie(change).status is status


def test_a_multiplier_of_the_wrong_sign_is_caught():
    def change(answer):  # the lower bound's corner: stationary with a multiplier that pushes outwards
        answer["x"][0] = -1.0 / 1.5
        h = HESSIAN * 1.5**2 / (3.0 * 1.5**2)
        answer["lam_x"][:] = -(h @ answer["x"] + GRADIENT * 1.5 / (3.0 * 1.5**2))

    assert lie(change).status is Status.INACCURATE


def test_a_limit_of_the_change_that_is_violated_or_cannot_be_kept_is_told():
    def change(answer):
        answer["x"][:] = 2.0 / 1.5

    assert lie(change, du_max=[0.5]).status is Status.INFEASIBLE
    held = np.array([9.0])  # no u within its bounds is near
    assert not lie(lambda answer: None, [0.5], held).status.ok


def test_an_ill_conditioned_problem_keeps_its_bounds():
    # A weight of 1e4 on one instant of a double integrator.
    rng, n = np.random.default_rng(0), 80
    qp = InputQP(OCP(n, [1.0], [1.0], [0.0], [-1.0], [1.0]))
    far = np.stack([np.arange(n)[::-1] + 0.5, np.ones(n)])
    for _ in range(20):
        hessian = far.T @ np.diag([1e2, 1e4]) @ far + 0.1 * np.eye(n)
        gradient = -far.T @ (np.array([1e5, 1e6]) * rng.normal(size=2)) + rng.normal(size=n)
        answer = qp.solve(hessian, gradient, np.zeros((n, 1)), HELD)
        assert answer.status is Status.SOLVED
        # rounding times the Hessian's condition of 1e8
        assert np.max(np.abs(answer.step)) <= 1 + 1e-7
