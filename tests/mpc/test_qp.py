"""The QP's answer is checked, whatever the solver says of it."""

import numpy as np
import pytest

from hybrid_mpc.mpc import OCP, Status
from hybrid_mpc.mpc.qp import InputQP

HESSIAN = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]])
GRADIENT = np.array([-9.0, 0.5, 1.0])
U, HELD = np.zeros((3, 1)), np.zeros(1)


def make(du_max=None):
    return InputQP(OCP(3, [1.0], [1.0], [0.0], [-1.0], [2.0], du_max))


class Liar:
    """A solver that returns something else than it found, and calls it a success."""

    def __init__(self, solver, change, success=True):
        self.solver, self.change, self.success = solver, change, success

    def __call__(self, **arguments):
        answer = {key: value.full() for key, value in self.solver(**arguments).items()}
        self.change(answer)
        return {key: Full(value) for key, value in answer.items()}

    def stats(self):
        return {"success": self.success}


class Full:
    def __init__(self, value):
        self.value = value

    def full(self):
        return self.value


def lie(change, success=True, du_max=None):
    qp = make(du_max)
    qp._solver = Liar(qp._solver, change, success)
    return qp.solve(HESSIAN, GRADIENT, U, HELD)


def test_an_honest_solver_passes():
    step, status, kkt = lie(lambda answer: None)
    assert status is Status.SOLVED
    assert kkt < 1e-5
    assert step[0] == pytest.approx(2.0, abs=1e-6)  # the gradient pushes far beyond the upper bound


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
        answer[entry][:, 0] = value

    assert lie(change)[1] is status


def test_a_multiplier_of_the_wrong_sign_is_caught():
    def change(answer):  # the lower bound's corner: stationary with a multiplier that pushes outwards
        answer["x"][0] = -1.0 / 1.5
        h = HESSIAN * 1.5**2 / (3.0 * 1.5**2)
        answer["lam_x"][:, 0] = -(h @ answer["x"][:, 0] + GRADIENT * 1.5 / (3.0 * 1.5**2))

    assert lie(change)[1] is Status.INACCURATE


def test_a_violated_limit_of_the_change_is_caught():
    def change(answer):
        answer["x"][:, 0] = 2.0 / 1.5

    assert lie(change, du_max=[0.5])[1] is Status.INFEASIBLE


def test_a_reported_failure_counts():
    assert lie(lambda answer: None, success=False)[1] is Status.QP_FAILED


def test_messages_and_ok():
    assert [status for status in Status if status.ok] == [Status.SOLVED, Status.STOPPED]
    assert len({status.value for status in Status}) == len(Status)
