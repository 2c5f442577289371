"""The disturbance model where a scenario names none: it leaves no offset where as many loads as inputs leave one."""

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import DataSpec, Disturbance, OperatingPoint, Prior, Scenario, load
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.kit.artifact import save_artifact
from hybrid_mpc.kit.assembly import make_controller, make_estimator
from hybrid_mpc.kit.disturbances import default_disturbances, needed
from hybrid_mpc.kit.parts import loop_settings
from hybrid_mpc.loop.plant import ModelPlant
from hybrid_mpc.loop.simulate import simulate
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.model.model import HybridModel


class Assumed:
    """What an estimator assumes of its machine."""

    name, sensor_sigma, first_sigma, control, safe_input = "lags", (0.01, 0.01), None, None, None
    causes: ClassVar[dict] = {}


def model_of(rows, b, parameters=(), step=0.1, bounds=10.0):
    """States ``x' = rows(x, p) + b u``, all measured, by Euler's method; of rest at zero."""
    n, m = np.shape(b)
    x, u, p = ca.MX.sym("x", n), ca.MX.sym("u", m), ca.MX.sym("p", len(parameters))
    xdot = rows(x, p) + ca.mtimes(ca.DM(b), u)
    signals = tuple(Signal(f"x{i}", "-", -bounds, bounds) for i in range(n))
    inputs = tuple(Signal(f"u{i}", "-") for i in range(m))
    return HybridModel.of(
        "lags", step, signals, inputs, signals, x=x, u=u, p=p, x_next=x + step * xdot, xdot=xdot, y=x,
        parameters=parameters,
    )  # fmt: skip


def places(model, problem):
    found = default_disturbances(model, problem)
    return None if found is None else [(d.at, d.signal) for d in found]


def two_outputs(gain=1.0):
    """A lag behind an actuator's lag: one input, two outputs; at work at (1, 1)."""
    parameters = (Parameter("gain", gain, "-", 0.1, 5.0),)
    model = model_of(lambda x, p: ca.vertcat(-x[0] + p[0] * x[1], -x[1]), [[0.0], [1.0]], parameters)
    return replace(model, nominal_x=(1.0, 1.0), nominal_u=(1.0,))


PROBLEM = OCP(30, [0.0, 0.0], [0.0], [0.1], [-5.0], [5.0], q_y=[1.0, 0.0])


def test_an_output_that_is_not_held_has_its_own():
    assert places(two_outputs(), PROBLEM) == [("input", "u0"), ("output", "x1")]


@pytest.mark.parametrize(("chosen", "offset"), [(True, 0.01), (False, None)])
def test_a_wrong_gain_leaves_no_offset(chosen, offset):
    """The plant's gain is 30 % higher: one load cannot explain two outputs, and the held one stays off."""
    model = two_outputs()
    model = replace(model, disturbance_model=default_disturbances(model, PROBLEM) if chosen else None)
    observer = make_estimator(model, Assumed(), np.full(2, 1e-3), PROBLEM)
    result = simulate(
        ModelPlant(two_outputs(1.3), (0.0, 0.0)), observer, make_controller(model, model, PROBLEM), [2.0, 0.0],
        dt=0.1, duration=60.0, x0=[1.0, 1.0], seed=0,
    )  # fmt: skip
    late = abs(np.mean(result.x[-100:, 0]) - 2.0)
    assert late < offset if offset else late > 0.05


def test_errors_that_a_load_explains_need_no_more():
    """A cart: the gain of its force moves neither position nor speed at rest, and a load at the force explains all."""
    parameters = (Parameter("gain", 1.0, "-", 0.1, 5.0),)
    model = model_of(lambda x, p: ca.vertcat(x[1], -p[0] * x[1]), [[0.0], [1.0]], parameters)
    assert places(model, PROBLEM) is None


def test_of_more_inputs_than_outputs_those_that_are_told_apart():
    """The second input does what the first does; the third moves the other state."""
    model = model_of(lambda x, p: -x, [[1.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
    problem = OCP(30, [0.0] * 2, [0.0] * 3, [0.1] * 3, [-5.0] * 3, [5.0] * 3, q_y=[1.0, 1.0])
    found = places(model, problem)
    assert found is not None
    assert len(found) == 2
    assert ("input", "u2") in found
    assert all(at == "input" for at, _ in found)
    with pytest.raises(InputError):
        make_estimator(model, Assumed(), np.full(2, 1e-3), problem)


@pytest.mark.parametrize(("gain", "expected"), [(1.0, None), (0.01, [("rate", "x0")])])
def test_an_input_without_effect_at_rest_carries_no_load(gain, expected):
    """``x' = 1 - p x + gain u``: an error of p of 20 % asks for a load of 0.2 / gain, and the input's range is 2."""
    parameters = (Parameter("p", 1.0, "1/s", 0.1, 5.0),)
    x, u, p = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("p")
    signal = (Signal("x0", "-", 0.0, 2.0),)
    xdot = 1.0 - p * x + gain * u
    model = HybridModel.of(
        "lag", 0.1, signal, (Signal("u0", "-"),), signal, x=x, u=u, p=p, x_next=x + 0.1 * xdot, xdot=xdot, y=x,
        parameters=parameters, nominal_x=(1.0,), nominal_u=(0.0,),
    )  # fmt: skip
    problem = OCP(30, [0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[1.0])
    assert places(model, problem) == expected
    at_rest = 0.2 / gain / 2.0
    assert needed(model, problem) == pytest.approx(at_rest * (1.0 + 0.5 * gain), rel=1e-4)


def test_beside_an_input_without_effect_every_measured_state_has_its_own():
    parameters = (Parameter("p", 1.0, "1/s", 0.1, 5.0),)
    model = model_of(
        lambda x, p: ca.vertcat(1.0 - p * x[0], x[0] - x[1]), [[0.01], [0.0]], parameters, bounds=2.0
    )
    model = replace(model, nominal_x=(1.0, 1.0), nominal_u=(0.0,))
    assert places(model, PROBLEM) == [("rate", "x0"), ("rate", "x1")]


def test_references_of_states_have_one_at_each_input():
    assert default_disturbances(two_outputs(), OCP(30, [1.0, 0.0], [0.0], [0.1], [-5.0], [5.0])) is None


class TwoOutputs(Prior):
    """A lag behind an actuator's lag."""

    states = (Signal("level", "m", -5.0, 5.0), Signal("flow", "l/s", -5.0, 5.0))
    inputs = (Signal("valve", "-", -5.0, 5.0),)
    outputs = states
    parameters = (Parameter("gain", 1.0, "-", 0.1, 5.0),)
    operating_point = OperatingPoint(x=(1.0, 1.0), u=(1.0,))

    def xdot(self, x, u, w, p):
        """First order each."""
        return -x.level + p.gain * x.flow, u.valve - x.flow


def test_a_kit_has_the_default_where_its_scenario_names_none(tmp_path):
    spec = DataSpec("t", ("valve",), ("level", "flow"), 0.1, 0.5, 0.7, 1.0)
    scenario = Scenario(
        "two", "two", "", prior=TwoOutputs, data=spec, control=PROBLEM, sensor_sigma=(0.01, 0.01)
    )
    prior = TwoOutputs()
    save_artifact(
        tmp_path, {"prior": prior_programs(prior, 0.1)}, model_info(prior, 0.1), loop=loop_settings(scenario),
        recommended="prior",
    )  # fmt: skip
    kit = load(tmp_path)
    assert kit.models["prior"].disturbance_model is None
    found = kit.on(scenario)
    assert [(d.at, d.signal) for d in found.loop.disturbance_model] == [
        ("input", "valve"),
        ("output", "flow"),
    ]
    assert found.models["prior"].disturbance_model == found.loop.disturbance_model
    named = kit.on(replace(scenario, disturbance_model=(Disturbance("input", "valve"),)))
    assert named.models["prior"].n_d == 1
