"""What is wrong with a scenario is told before any work, all of it at once, whatever it is."""

import dataclasses
import math

import casadi as ca
import numpy as np
import pytest
import torch

from hybrid_mpc import (
    OCP,
    Budget,
    DataSpec,
    Fault,
    InputError,
    Parameter,
    Prior,
    Scenario,
    Signal,
    Task,
    load_scenario,
)
from hybrid_mpc.job.check import check_scenario
from hybrid_mpc.scenario import registered_scenarios


class Pendulum(Prior):
    states = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
    inputs = (Signal("tau", "N m", -3, 3),)
    outputs = (Signal("phi", "rad", -7, 7),)
    parameters_spec = (Parameter("J", 0.1, "kg m^2", 0.05, 0.2), Parameter("mgl", 1.0, "N m", 0.3, 3.0))

    def acceleration(self, x, u):
        return (u - self.mgl * torch.sin(x[..., :1])) / self.J

    def inertia(self, x):
        return self.J


class Plant:
    def reset(self, x0, seed):
        return np.array(x0)

    def step(self, state, u, dt):
        return state + dt * np.array([state[1], 10 * u[0] - 10 * np.sin(state[0])])

    def measure(self, state, rng):
        return state[:1]

    def truth(self, state):
        return state

    def hidden(self, state):
        return np.zeros(0)


DATA = DataSpec("t", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.2, warm_up=0.5)
CONTROL = OCP(10, (25, 0.25), (1,), (1,), (-1,), (1,))
TASK = Task("hold", "Hold", 1.0, (0.1, 0.0), lambda t: np.zeros((len(t), 2)))
GOOD = Scenario(
    "mine", "Mine", "", prior=Pendulum, data=DATA, control=CONTROL, sensor_sigma=(1e-3,), plant=Plant, tasks=(TASK,),
    budgets={"quick": Budget(4, 1, 5, 5, 1)},
)  # fmt: skip


def prior(**members):
    """Makes the fields of a scenario with a prior that differs."""
    return lambda: {"prior": type("Changed", (Pendulum,), members)}


def control(**fields):
    return lambda: {"control": CONTROL.changed(**fields)}


def task(**fields):
    return lambda: {"tasks": (dataclasses.replace(TASK, **fields),)}


def plant(**members):
    return lambda: {"plant": type("Changed", (Plant,), members)}


def budget(**fields):
    return lambda: {"budgets": {"quick": dataclasses.replace(GOOD.budgets["quick"], **fields)}}


def field(**fields):
    return lambda: fields


def raises(*given):
    raise KeyError("forgotten")


WRONG = {
    # the prior
    "raises": (prior(acceleration=raises), ["xdot(x, u) raised KeyError", "forgotten", "test_preflight.py"]),
    "raises when made": (field(prior=raises), ["prior raised KeyError"]),
    "is no prior": (field(prior=lambda values=None: 3), ["makes a int"]),
    "ignores its values": (field(prior=lambda values=None: Pendulum({"J": 0.06} if values is None else None)),
                           ["must take its values over"]),
    "takes no values": (field(prior=lambda: Pendulum()), ["prior raised TypeError"]),
    "returns None": (prior(acceleration=lambda self, x, u: None), ["xdot(x, u) raised"]),
    "forward returns None": (prior(forward=lambda self, x, u: None), ["must return a tensor, got NoneType", "return"]),
    "returns numpy": (prior(forward=lambda self, x, u: x.numpy()), ["must return a tensor, got ndarray"]),
    "returns NaN": (prior(acceleration=lambda self, x, u: u / 0.0 * 0.0), ["xdot(x, u)", "finite"]),
    "NaN at one side": (prior(acceleration=lambda self, x, u: torch.sqrt(u)), ["finite", "x = ", "u = "]),
    "returns another shape": (prior(acceleration=lambda self, x, u: (u / self.J).squeeze(-1)), ["xdot(x, u)"]),
    "returns a state too much": (prior(acceleration=lambda self, x, u: torch.cat([u, u], -1)), ["shape", "(17, 2)"]),
    "returns one number": (prior(forward=lambda self, x, u: torch.tensor(1.0)), ["must return the shape"]),
    "mixes the batch": (prior(acceleration=lambda self, x, u: u / self.J - x.mean()), ["in a batch"]),
    "indexes the batch": (prior(acceleration=lambda self, x, u: u / self.J + x[0, 0]), ["xdot(x, u) raised"]),
    "float32": (prior(acceleration=lambda self, x, u: (u / self.J).float(),
                      forward=lambda self, x, u: torch.cat([x[..., 1:], u], -1).float()), ["float64", "float32"]),
    "float32 buffer": (field(prior=lambda values=None: with_buffer(values)), ["table must be float64"]),
    "zero inertia": (prior(inertia=lambda self, x: 0.0 * self.J), ["energy_balance", "inertia(x) must be positive"]),
    "negative inertia": (prior(inertia=lambda self, x: -self.J), ["inertia(x) must be positive"]),
    "no inertia": (prior(inertia=Prior.inertia), ["must define inertia"]),
    "balance of another shape": (prior(energy_balance=lambda self, x, xdot, u: xdot), ["one number a sample"]),
    "balance that is none": (
        prior(energy_balance=lambda self, x, xdot, u: (self.J * xdot[..., 1] - u[..., 0]) * x[..., 1]),
        ["along the prior's own flow", "sign"],
    ),
    "output of another shape": (prior(output=lambda self, x, u: x), ["output(x, u)", "(17, 1)"]),
    "output raises": (prior(output=raises), ["output(x, u) raised KeyError"]),
    "three states": (prior(states=(*Pendulum.states, Signal("i", "A"))), ["[q, v] in pairs"]),
    "same names": (prior(states=(Signal("phi", "rad"), Signal("phi", "rad/s"))), ["same name"]),
    "states that are texts": (prior(states=("phi", "phi_dot")), ["tuple of one Signal or more"]),
    "an operator that is not exported": (
        prior(acceleration=lambda self, x, u: torch.special.bessel_j0(x[..., :1]) + u), ["export to CasADi", "bessel"],
    ),
    # data
    "too few columns": (field(data=dataclasses.replace(DATA, inputs=())), ["0 columns of inputs", "'tau'"]),
    "too many columns": (field(data=dataclasses.replace(DATA, outputs=("phi", "x"))), ["2 columns of outputs"]),
    "unknown cause": (field(causes={"mass": ("m",)}), ["no parameter m", "J, mgl"]),
    # control
    "horizon 0": (control(horizon=0), ["horizon must be a whole number of periods"]),
    "horizon half": (control(horizon=2.5), ["horizon must be a whole number of periods"]),
    "crossed bounds": (control(u_min=(1,), u_max=(-1,)), ["input bounds cross", "u_min"]),
    "NaN weight": (control(q=(math.nan, 1)), ["q: weights must be finite and not negative"]),
    "negative weight": (control(r=(-1,)), ["r: weights must be finite and not negative"]),
    "no weight at all": (control(r=(0,), r_delta=(0,)), ["every input needs a positive weight"]),
    "weights of too few": (
        field(control=OCP(10, (25,), (1,), (1,), (-1,), (1,))), ["control: q needs 2 numbers, got 1"]
    ),
    "inputs of too many": (
        field(control=OCP(10, (25, 1), (1, 1), (1, 1), (-1, -1), (1, 1))), ["control: r needs 1 numbers, got 2"]
    ),
    "bounds of too many": (control(u_min=(-1, -1), u_max=(1, 1)), ["u_min"]),
    "a problem that is none": (field(control={"horizon": 10}), ["control: OCP(...) needed, got {'horizon': 10}"]),
    "a field there is not": (control(horizn=9), ["'horizn'; did you mean 'horizon'?"]),
    "no sensor_sigma": (field(sensor_sigma=()), ["sensor_sigma needs 1 numbers, got 0"]),
    "zero sensor_sigma": (field(sensor_sigma=(0.0,)), ["sensor_sigma must be positive"]),
    "NaN sensor_sigma": (field(sensor_sigma=(math.nan,)), ["sensor_sigma must be positive"]),
    "first_sigma of all": (field(first_sigma=(1e-3, 0.1)), ["first_sigma needs 1 numbers, got 2"]),
    "zero du_max": (control(du_max=(0,)), ["du_max"]),
    "crossed states": (control(x_min=(1, -1), x_max=(-1, 1)), ["state bounds cross"]),
    "working point of one": (control(working_point=((0.0,), (0.0,))), ["working_point x: 1 values given, 2 needed"]),
    "starts of another shape": (control(starts=(((0.0,),),)), ["starts[0]: shape (1, 1) given", "(10, 1)"]),
    # tasks
    "no reference for all": (task(reference=lambda t: np.zeros((len(t), 1))), ["task hold: reference", "(50, 2)"]),
    "reference that raises": (task(reference=raises), ["task hold raised KeyError"]),
    "reference of NaN": (task(reference=lambda t: np.full((len(t), 2), np.nan)), ["reference is", "finite"]),
    "negative factors": (task(weight=lambda t: -np.ones((len(t), 2))), ["not be negative"]),
    "no duration": (task(duration=0.0), ["task hold: duration"]),
    "endless": (task(duration=math.inf), ["task hold: duration"]),
    "x0 of one": (task(x0=(0.0,)), ["x0 needs 2"]),
    "x0 of NaN": (task(x0=(math.nan, 0.0)), ["x0 needs 2"]),
    "task's own weights": (
        task(control=OCP(10, (25,), (1,), (1,), (-1,), (1,))), ["control of task hold: q needs 2 numbers"]
    ),
    "same tasks": (field(tasks=(TASK, TASK)), ["two have the same name"]),
    "fault of a channel": (task(faults=(Fault(0, 1, "input_gain", 0.5, channel=3),)), ["channel 3"]),
    "fault the plant lacks": (task(faults=(Fault(0, 1, "plant_fire", 0.5),)), ["takes no faults"]),
    "tasks without control": (field(control=None), ["no control problem"]),
    # plant and oracle
    "plant that raises": (plant(step=raises), ["plant raised KeyError"]),
    "plant measures all": (plant(measure=lambda self, state, rng: state), ["measure must return the shape (1,)"]),
    "plant tells less": (plant(truth=lambda self, state: state[:1]), ["truth must return the shape (2,)"]),
    "plant of NaN": (plant(step=lambda self, s, u, dt: s * np.nan), ["must be finite"]),
    "oracle that raises": (field(oracle=raises), ["oracle raised KeyError"]),
    # budgets
    "no networks": (budget(networks=0), ["budget quick: networks"]),
    "half a unit": (budget(hidden=2.5), ["budget quick: hidden"]),
    "negative decay": (budget(decay=-1.0), ["budget quick: decay"]),
}  # fmt: skip


def with_buffer(values):
    made = Pendulum(values)
    made.register_buffer("table", torch.zeros(3))
    return made


@pytest.mark.parametrize("changes", [v for v, _ in WRONG.values()], ids=WRONG)
@pytest.mark.full
def test_every_wrong_scenario_is_told(changes):
    words = next(w for v, w in WRONG.values() if v is changes)
    with pytest.raises(InputError) as told:
        check_scenario(dataclasses.replace(GOOD, **changes()))
    for word in words:
        assert word in str(told.value)


def test_all_problems_are_told_at_once():
    wrong = {
        **prior(acceleration=lambda self, x, u: None)(),
        **field(sensor_sigma=(0.0,))(),
        **budget(networks=0)(),
        **task(x0=(0.0,))(),
    }
    with pytest.raises(InputError) as told:
        check_scenario(dataclasses.replace(GOOD, **wrong))
    message = str(told.value)
    assert "3 problems" in message  # what hangs on the prior (the task's states) cannot be known without one
    for word in ("xdot", "sensor_sigma", "networks"):
        assert word in message


def test_a_problem_with_prices_asks_for_them_in_the_reference():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    priced = dataclasses.replace(
        GOOD, control=CONTROL.changed(economic=ca.Function("f", [x, u, p], [p * u**2]))
    )
    with pytest.raises(
        InputError, match=r"\(50, 3\) for 50 times, got \(50, 2\); the last 1 for the economic"
    ):
        check_scenario(priced)
    told = dataclasses.replace(TASK, reference=lambda t: np.ones((len(t), 3)))
    check_scenario(dataclasses.replace(priced, tasks=(told,)))


def test_a_good_scenario_passes():
    check_scenario(GOOD)
    check_scenario(dataclasses.replace(GOOD, control=None, tasks=(), plant=None))


@pytest.mark.full
@pytest.mark.parametrize("name", registered_scenarios())
def test_the_ready_scenarios_pass(name):
    check_scenario(load_scenario(name))


def test_the_command_tells_it_before_it_reads_anything(call, tmp_path):
    machine = tmp_path / "machine.py"
    machine.write_text(
        "from tests.job.test_preflight import GOOD, control\nimport dataclasses\n"
        "scenario = dataclasses.replace(GOOD, **control(horizon=0)())\n"
    )
    code, _, message = call("run", machine, "--data", tmp_path / "none.csv", "--out", tmp_path / "out")
    assert code == 2
    assert "horizon must be a whole number of periods, at least 1; got 0" in message
    assert "machine.py:3" in message
    assert not (tmp_path / "out").exists()
