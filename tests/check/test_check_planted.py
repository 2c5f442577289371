"""One error for each clause of what a machine must keep to: each is told with what was given and what mends it, and all
of them at once.
"""

import itertools
import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import StatePlant

from hybrid_mpc import (
    OCP,
    Balance,
    Budget,
    DataSpec,
    InputError,
    MechanicalPrior,
    OperatingPoint,
    Parameter,
    Prior,
    Scenario,
    Signal,
    Task,
    load_scenario,
)
from hybrid_mpc.check.preflight import check_scenario, preflight


class Kettle(Prior):
    """Water that runs in, out through a hole, and is warmed; the room's warmth is measured."""

    states = (Signal("level", "m", 0.0, 1.0), Signal("warmth", "K", 0.0, 90.0))
    inputs = (Signal("inflow", "m^3/s", 0.0, 0.2), Signal("heat", "W", 0.0, 4e6))
    outputs = states
    disturbances = (Signal("room", "K", -20.0, 40.0),)
    parameters = (Parameter("area", 2.0, "m^2", 1.0, 4.0), Parameter("k", 0.2, "m^2.5/s", 0.1, 0.3))
    operating_point = OperatingPoint((0.25, 20.0), (0.1, 0.0), (20.0,))

    def xdot(self, x, u, w, p):
        out = p.k * ca.sqrt(ca.fmax(x.level, 1e-4))
        return (u.inflow - out) / p.area, 1e-6 * u.heat - 0.05 * (x.warmth - w.room)

    def balances(self, x, u, w, p):
        out = p.k * ca.sqrt(ca.fmax(x.level, 1e-4))
        return (Balance("volume", p.area * x.level, u.inflow, out, "m^3", "m^3/s"),)


class Cart(MechanicalPrior):
    """A cart on a spring."""

    states = (Signal("s", "m", -1.0, 1.0), Signal("v", "m/s", -5.0, 5.0))
    inputs = (Signal("force", "N", -9.0, 9.0),)
    outputs = states[:1]
    parameters = (Parameter("m", 2.0, "kg", 1.0, 4.0), Parameter("c", 8.0, "N/m", 1.0, 20.0))

    def mass_matrix(self, q, p):
        return p.m

    def potential(self, q, p):
        return p.c * q.s**2 / 2


class Plant(StatePlant):
    """A cart in simulation."""

    def step(self, state, u, dt):
        v = state[1] + dt * (u[0] - 8.0 * state[0]) / 2.0
        return np.array([state[0] + dt * v, v])


BUDGET = {"quick": Budget(4, 1, 5, 5, seeds=1)}
KETTLE = Scenario(
    "kettle", "Kettle", "", prior=Kettle, budgets=BUDGET,
    data=DataSpec("t", ("inflow", "heat"), ("level", "warmth"), dt=0.5, max_gap=2.0, smoothing=5.0, warm_up=5.0,
                  disturbances=("room",)),
)  # fmt: skip
TASK = Task("hold", "Hold", 2.0, (0.1, 0.0), lambda t: np.zeros((len(t), 2)))
CART = Scenario(
    "cart", "Cart", "", prior=Cart, budgets=BUDGET, plant=Plant, tasks=(TASK,), sensor_sigma=(1e-3,),
    data=DataSpec("t", ("force",), ("s",), dt=0.02, max_gap=0.1, smoothing=0.2, warm_up=0.5),
    control=OCP(10, (25, 0.25), (1,), (1,), (-5,), (5,)),
)  # fmt: skip


def kettle(**members):
    return lambda: replace(KETTLE, prior=type("Mine", (Kettle,), members))


def rates(level=None, warmth=None, **members):
    """A kettle with other rates; what balances then say does not count."""

    def xdot(self, x, u, w, p):
        own = Kettle.xdot(self, x, u, w, p)
        given = (f and f(x, u, w, p) for f in (level, warmth))
        return tuple(rate if new is None else new for new, rate in zip(given, own, strict=True))

    return kettle(xdot=xdot, balances=Prior.balances, operating_point=None, **members)


def balance(storage, supply, loss=lambda x, u: 0.0, unit="J", rate_unit="W"):
    def balances(self, x, u, w, p):
        return (Balance("heat", storage(x, u), supply(x, u, w), loss(x, u), unit, rate_unit),)

    return kettle(balances=balances)


def cart(**members):
    return lambda: replace(CART, prior=type("Mine", (Cart,), members))


def cart_with(**fields):
    return lambda: replace(CART, **fields)


CALLS = itertools.count()
PLANTED = {
    # what is measured
    "a state that no output sees": (
        lambda: replace(kettle(outputs=Kettle.outputs[:1])(), data=replace(KETTLE.data, outputs=("level",))),
        "HM-IDENTIFY-019",
    ),
    "an output in another unit": (kettle(outputs=(Signal("level", "mm"), Kettle.outputs[1])), "HM-CHECK-040"),
    "no outputs": (
        lambda: replace(KETTLE, prior=type("Bare", (Prior,), {"states": Kettle.states, "inputs": Kettle.inputs})),
        "HM-MACHINE-008",
    ),
    "a disturbance without a column": (
        lambda: replace(KETTLE, data=replace(KETTLE.data, disturbances=())), "HM-DATA-129",
    ),
    "a column in a unit of something else": (
        lambda: replace(KETTLE, data=replace(KETTLE.data, outputs=("level [kg]", "warmth"))), "HM-DATA-128",
    ),
    "a unit that nobody knows": (
        lambda: replace(KETTLE, data=replace(KETTLE.data, units={"level": "furlong"})), "HM-DATA-128",
    ),
    # balances
    "a rate in the unit of what is stored": (
        balance(lambda x, u: x.warmth, lambda x, u, w: 1e-6 * u.heat - 0.05 * (x.warmth - w.room), unit="J",
            rate_unit="J"), "HM-CHECK-047",
    ),
    # names
    "corrects a text": (kettle(corrects="level"), "HM-MACHINE-011"),
    "a misspelt role": (kettle(disturbance=(Signal("wind", "m/s"),)), "HM-CHECK-038"),
    # numbers
    "NaN within a parameter's bounds": (
        rates(level=lambda x, u, w, p: u.inflow - ca.sqrt(p.k - 0.15) * x.level), "HM-CHECK-051",
    ),
    "a mode that is too fast": (rates(level=lambda x, u, w, p: u.inflow - 1e3 * x.level), "HM-IDENTIFY-049"),
    # what is not supported: algebraic variables, whole numbers, time, jumps
    "declared algebraic variables": (kettle(algebraic=(Signal("pressure", "Pa"),)), "HM-CHECK-037"),
    "rates of algebraic variables": (kettle(xdot=lambda self, x, z, u, w, p: (u.inflow, u.heat)), "HM-CHECK-046"),
    "a valve of whole numbers": (
        rates(level=lambda x, u, w, p: ca.floor(20 * u.inflow) / 20 - p.k * x.level), "HM-CHECK-052",
    ),
    "a heater that is on or off": (
        rates(warmth=lambda x, u, w, p: ca.if_else(u.heat > 2e6, 4.0, 0.0) - 0.05 * (x.warmth - w.room)),
        "HM-CHECK-054",
    ),
    "rates of time": (kettle(xdot=lambda self, x, u, w, p, t: (u.inflow * ca.sin(t), u.heat)), "HM-CHECK-046"),
    "a state that counts the time": (
        lambda: replace(
            kettle(
                states=(*Kettle.states, Signal("clock", "s")), outputs=(*Kettle.outputs, Signal("clock", "s")),
                xdot=lambda self, x, u, w, p: (*Kettle.xdot(self, x, u, w, p), 1.0), operating_point=None,
            )(),
            data=replace(KETTLE.data, outputs=("level", "warmth", "clock")),
        ), "HM-CHECK-053",
    ),
    "a clock in the code": (rates(level=lambda x, u, w, p: u.inflow - p.k * x.level + next(CALLS)), "HM-CHECK-048"),
    "a jump": (rates(level=lambda x, u, w, p: u.inflow - 0.1 * ca.sign(x.level - 0.3)), "HM-CHECK-052"),
    "a function of numbers": (rates(level=lambda x, u, w, p: u.inflow - p.k * math.sqrt(x.level)), "HM-CHECK-050"),
    "an input that does nothing": (rates(warmth=lambda x, u, w, p: -0.05 * (x.warmth - w.room)), "HM-CHECK-054"),
    # the operating point
    "an operating point that drifts": (
        kettle(operating_point=OperatingPoint((0.25, 20.0), (0.15, 0.0), (20.0,))), "HM-CHECK-015",
    ),
    # a mechanical machine
    "a speed in another unit": (cart(states=(Cart.states[0], Signal("v", "mm/s"))), "HM-CHECK-041"),
    "a force that is none": (cart(inputs=(Signal("force", "V", -9.0, 9.0),)), "HM-CHECK-042"),
    "rates that nobody asks for": (cart(xdot=lambda self, x, u, w, p: (x.v, u.force)), "HM-CHECK-039"),
    # tasks
    "a reference in another unit": (
        cart_with(tasks=(replace(TASK, reference=lambda t: np.tile([50.0, 0.0], (len(t), 1))),)), "HM-CHECK-031",
    ),
    "a start beyond the range": (cart_with(tasks=(replace(TASK, x0=(0.0, 9.0)),)), "HM-CHECK-031"),
    "a state that nothing brings back": (
        lambda: replace(
            kettle(
                states=(*Kettle.states, Signal("room", "K", -20.0, 40.0)), disturbances=(), balances=Prior.balances,
                xdot=lambda self, x, u, w, p: (*Kettle.xdot(self, x, u, x, p), 0.0),
                operating_point=OperatingPoint((0.25, 20.0, 20.0), (0.1, 0.0)),
            )(),
            data=replace(KETTLE.data, disturbances=()), sensor_sigma=(1e-3, 0.1),
            control=OCP(10, (1, 1, 0), (1, 1), (1, 1), (0, 0), (0.2, 4e6)),
        ), "no input affects room, and the dynamics do not return",  # the cause, which the code does not tell
    ),
    "no disturbance that is unmeasured": (cart_with(disturbance_model=()), "HM-MODEL-005"),
}  # fmt: skip
"""How each error is planted, and its code; others, of the same checks, are in ``test_preflight``."""


def told(scenario):
    with pytest.raises(InputError) as error:
        check_scenario(scenario)
    return error.value.problems


def test_nothing_is_planted_in_what_errors_are_planted_in():
    for scenario in (KETTLE, CART):
        found = check_scenario(scenario)
        assert (found.problems, found.warnings) == ((), ())


@pytest.mark.parametrize("name", PLANTED)
def test_each_planted_error_has_its_code(name):
    make, code = PLANTED[name]
    problems = told(make())
    assert any(code in problem for problem in problems), problems


def test_errors_in_different_places_are_told_in_one_pass():
    """Ten at once: no part hides what is wrong with another, as long as that other can be asked."""
    wrong = replace(
        kettle(
            algebraic=(Signal("pressure", "Pa"),),
            corrects=("levl",),
            disturbance=(Signal("wind", "m/s"),),
            operating_point=OperatingPoint((0.25, 120.0), (0.1, 0.0), (20.0,)),
            xdot=lambda self, x, u, w, p, t: (u.inflow, u.heat),
            output=lambda self, x, u, w, p: (x.level,),
            balances=lambda self, x, u, w, p: (x.level,),
        )(),
        data=replace(KETTLE.data, inputs=("inflow",), units={"level": "furlong"}, disturbances=()),
        tasks=(replace(TASK, x0=(2.0, 0.0)),),
        control=OCP(10, (25,), (1,), (1,), (-5,), (5,)),
    )
    problems = told(wrong)
    for word in (
        "'algebraic'", "corrects names levl", "did you mean 'disturbances'?", "range of warmth", "(x, u, w, p, t)",
        "output(x, u, w, p) must give 2", "tuple of Balance", "inputs has 1 column", "is in 'furlong'",
        "disturbances has 0 columns", "task hold: x0", "control: q must have 2", "sensor_sigma: must have 2",
    ):  # fmt: skip
        assert sum(word in problem for problem in problems) == 1, (word, problems)


def test_numbers_are_looked_at_whatever_else_is_wrong():
    """Equations that can be asked are asked, though names, units and balances are wrong."""

    def balances(self, x, u, w, p):
        return (
            Balance("one", p.area * x.level, u.inflow, 0.0, "m^3", "m^3"),
            Balance("other", x.warmth, 1e-6 * u.heat - 0.05 * (x.warmth - w.room) + 1.0),
        )

    problems = told(kettle(corrects=("levl",), balances=balances)())
    assert any("corrects names levl" in problem for problem in problems)
    balances_are_none = [problem for problem in problems if "balance" in problem]
    assert balances_are_none == []  # what a balance says of corrected rates hangs on which these are

    blind = {"outputs": Kettle.outputs[:1], "disturbance": (Signal("wind", "m/s"),)}
    scenario = kettle(balances=balances, **blind)()
    problems = told(replace(scenario, data=replace(KETTLE.data, outputs=("level",))))
    for word in (
        "balance one [m^3]: dS/dt", "balance one: the rate of", "balance other [W]: dS/dt",
        "warmth is not observable", "did you mean 'disturbances'?",
    ):  # fmt: skip
        assert sum(word in problem for problem in problems) == 1, (word, problems)


class Backwards(Plant):
    def step(self, state, u, dt):
        return super().step(state, -u, dt)


class Swing(Cart):
    states = (Signal("phi", "rad", -6.0, 6.0), Signal("rate", "rad/s", -9.0, 9.0))
    inputs = (Signal("torque", "N m", -9.0, 9.0),)
    outputs = states[:1]

    def potential(self, q, p):
        return -p.c * ca.cos(q.phi)


DOUBTFUL = {
    "a plant that moves the other way": (
        cart_with(plant=Backwards), ["plant: a step of force [N]", "different directions"],
    ),
    "a set-point that no input holds": (
        cart_with(tasks=(replace(TASK, reference=lambda t: np.tile([0.9, 0.0], (len(t), 1))),)),
        ["ends at x = [0.9, 0.0]", "x = [0.625, 0.0] under u = [5.0]"],
    ),
    "several equilibria": (
        lambda: replace(CART, prior=Swing, plant=None, tasks=(), data=replace(CART.data, outputs=("phi",))),
        ["several equilibria under u = [0.0]", "[0.0, 0.0] (", "(unstable)", "operating_point = OperatingPoint("],
    ),
    "a parameter of nothing": (
        kettle(parameters=(*Kettle.parameters, Parameter("rho", 1e3, "kg/m^3", 9e2, 1.1e3))),
        ["no rate and no output depends on the parameter rho [kg/m^3]"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTFUL)
def test_what_is_doubtful_is_a_warning(name):
    make, words = DOUBTFUL[name]
    found = preflight(make())
    assert found.problems == ()
    assert any(all(word in warning for word in words) for warning in found.warnings), found.warnings


FILE = """
from hybrid_mpc import DataSpec, Prior, Scenario, Signal

class Valve(Prior):
    states = outputs = (Signal("level", "m"),)
    inputs = (Signal("valve", "-", {}),)
    def xdot(self, x, u, w, p):
        return (u.valve - x.level,)

scenario = Scenario("valve", "", "", prior=Valve, data=DataSpec("t", ("v",), ("y",), 0.1, 0.3, 1.0, 1.0))
"""


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("integer=True", ["valve.py:6", "'integer'", "Inputs that are integers"]),
        ("values=(0, 1)", ["valve.py:6", "'values'", "Inputs that are integers"]),
        ("lover=0.0", ["valve.py:6", "'lover'", "did you mean 'lower'?"]),
    ],
)
def test_what_a_signal_cannot_be_is_told_by_the_file(tmp_path, given, words):
    (tmp_path / "valve.py").write_text(FILE.format(given))
    with pytest.raises(InputError) as error:
        load_scenario(str(tmp_path / "valve.py"))
    for word in words:
        assert word in str(error.value)


SEVEN = """
import casadi as ca
import numpy as np

from hybrid_mpc import OCP, Balance, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal, Task


class Tank(Prior):
    states = outputs = (Signal("level", "m", 0, 1),)
    inputs = (Signal("pump", "l/min", 0, 20),)
    parameters = (Parameter("area", 5, "dm^2", 5, 5), Parameter("k", 15, "l/min/m^0.5", 5, 40))
    operating_point = OperatingPoint(x=(0.25,), u=(9.5,))

    def out(self, x, p):
        return p.k * ca.sqrt(x.level)

    def xdot(self, x, u, w, p):
        return ((u.pump - self.out(x, p)) / (600 * p.area),)

    def balances(self, x, u, w, p):
        return (Balance("water", 10 * p.area * x.level, -u.pump / 60, self.out(x, p) / 60, "l", "l/s"),)


scenario = Scenario(
    "tank", "A tank", "", prior=Tank,
    data=DataSpec("t", ("pump", "valve"), ("level",), dt=5.0, max_gap=12.0, smoothing=50.0, warm_up=60.0),
    control=OCP(30, q=(0,), r=(1e-3,), r_delta=(1e-2,), u_min=(0,), u_max=(20,), q_y=(1e3,)),
    sensor_sigma=(2e-3, 1e-3),
    safe_input=(-3.0,),
    tasks=(Task("fill", "Fill", 600.0, (0.25, 0.1), lambda t: np.full((len(t), 1), 0.4)),),
)
"""


def test_a_user_s_file_with_seven_errors_has_seven_lines(call, tmp_path):
    (tmp_path / "tank.py").write_text(SEVEN)
    code, told_to_user, _ = call("check", tmp_path / "tank.py")
    assert code == 2
    assert "7 errors" in told_to_user
    for word in (
        "its derivative by x is not finite at x = [0.0]", "balance water [l/s]: dS/dt - supply + loss",
        "operating_point is not an equilibrium", "inputs has 2 columns", "sensor_sigma: must have 1 numbers",
        "HM-KIT-029", "task fill: x0 must have 1",
    ):  # fmt: skip
        assert sum(word in line for line in told_to_user.splitlines()) == 1, word
