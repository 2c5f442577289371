"""The record as a table, and what a simulation refuses."""

import numpy as np
import pytest
from closed_loop_parts import make_ekf, run
from online_models import PendulumPlant, linear_model, pendulum_model
from wrapped_machine import SIGMAS, boat

from hybrid_mpc import OCP, CondensedController, ExtendedKalmanFilter, Fault, InputError, Loop


def test_a_table_has_every_column_with_a_model_its_names_and_units(model, safe):
    result = run(model, safe)
    plain, named = result.to_pandas(), result.to_pandas(model)
    assert plain.shape == named.shape
    assert len(plain) == 30
    numbered = {"t", "x_0", "x_1", "u_0", "h_1", "d_0", "reference_1", "source", "alarm", "solve_ms"}
    assert numbered <= set(plain)
    names = {
        "t [s]", "x phi [rad]", "y phi [rad]", "u torque [N m]", "x_hat phi_dot [rad/s]", "share [-]", "solve [ms]",
    }  # fmt: skip
    assert names <= set(named)
    np.testing.assert_array_equal(named["x phi_dot [rad/s]"], result.x[:, 1])
    other = linear_model(np.eye(3), np.ones((3, 1)), np.eye(3)[:1])
    with pytest.raises(InputError, match=r"linear.*HM-LOOP-051"):
        result.to_pandas(other)


class Odd(PendulumPlant):
    """A plant of which one method returns another shape."""

    def __init__(self, name, value):
        super().__init__()
        object.__setattr__(self, name, lambda *_: value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dt": 0.01}, r"0\.01.*0\.02.*HM-LOOP-048"),
        ({"dt": np.nan}, "dt"),
        ({"duration": 0.005}, "HM-LOOP-050"),
        ({"duration": np.inf}, "duration"),
        ({"duration": np.nan}, "duration"),
        ({"x0": [0.0]}, r"x0.*HM-MODEL-017"),
        ({"x0": [0.0, np.nan]}, r"x0.*HM-MODEL-018"),
        ({"w": [1.0]}, "HM-LOOP-045"),
        ({"reference": lambda t: np.zeros(len(t))}, r"reference.*\(11,\).*HM-LOOP-031"),
        ({"weight": lambda t: np.ones(len(t))}, r"weight.*\(11,\).*HM-LOOP-031"),
        ({"sensor_delay": -1}, "sensor_delay"),
        ({"input_delay": 1.5}, "input_delay"),
        ({"reference": lambda t: np.zeros((len(t), 1))}, r"phi \[rad\]; phi_dot .*\(11, 2\).*HM-LOOP-031"),
        ({"faults": [Fault(0.0, 1.0, "input_gain", channel="third")]}, r"input.*'third'.*HM-LOOP-004"),
        ({"plant": Odd("measure", np.zeros(2))}, r"measurement.*\(2,\).*HM-MODEL-019"),
        ({"plant": Odd("truth", np.zeros(3))}, r"truth.*\(3,\).*HM-MODEL-019"),
        ({"estimator": "prior"}, "HM-LOOP-025"),
        ({"stage_cost": OCP(3, [1.0], [1.0], [0.0], [-1.0], [1.0])}, "stage_cost"),
    ],
)
def test_bad_input_is_refused(model, safe, change, words):
    if change.get("estimator") == "prior":
        change = {"estimator": make_ekf(pendulum_model())}
    with pytest.raises(InputError, match=words):
        run(model, safe, **change)


def test_a_reference_of_another_width_names_the_outputs_and_those_without_weight():
    model = boat()
    observer = ExtendedKalmanFilter(model, **SIGMAS)
    controller = CondensedController(model, OCP(5, [0.0, 0.0], [0.1], [0.1], [-30.0], [30.0], q_y=[1.0, 0.0]))
    columns = r"outputs: psi \[deg\]; r \[deg/s\], without weight"
    with pytest.raises(InputError, match=rf"{columns}.*HM-MODEL-019"):
        Loop(observer, controller, reference=[20.0])
    estimate = observer.start([0.0, 0.0])
    with pytest.raises(InputError, match=rf"{columns}.*HM-CONTROL-038"):
        controller.solve(controller.initial(estimate), estimate, np.zeros((3, 1)))
