"""What is wrong with a scenario is told before any work, all of it at once, whatever it is."""

import dataclasses
import math

import casadi as ca
import numpy as np
import pytest
import torch
from example_priors import Tanks
from online_models import StatePlant

from hybrid_mpc import (
    OCP,
    Balance,
    Budget,
    DataSpec,
    Disturbance,
    Fault,
    HardBound,
    InputError,
    MechanicalPrior,
    OperatingPoint,
    Parameter,
    Prior,
    Scenario,
    Signal,
    Task,
    TorchPrior,
    load_scenario,
)
from hybrid_mpc.check.preflight import check_scenario, preflight
from hybrid_mpc.scenario import registered_scenarios


class Pendulum(MechanicalPrior):
    states = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
    inputs = (Signal("tau", "N m", -3, 3),)
    outputs = (Signal("phi", "rad", -7, 7),)
    parameters = (Parameter("J", 0.1, "kg m^2", 0.05, 0.2), Parameter("mgl", 1.0, "N m", 0.3, 3.0))

    def mass_matrix(self, q, p):
        return p.J

    def potential(self, q, p):
        return -p.mgl * ca.cos(q.phi)


class Tank(Prior):
    """A heated tank, in CasADi."""

    states = (Signal("level", "m", 0.0, 1.0), Signal("warmth", "K", 0.0, 90.0))
    inputs = (Signal("inflow", "m^3/s", 0.0, 1.0),)
    outputs = states
    parameters = (Parameter("area", 2.0, "m^2", 1.0, 4.0), Parameter("k", 0.2, "m^2.5/s", 0.0, 1.0))

    def xdot(self, x, u, w, p):
        return (u.inflow - p.k * ca.sqrt(ca.fmax(x.level, 1e-6))) / p.area, -0.1 * x.warmth

    def balances(self, x, u, w, p):
        out = p.k * ca.sqrt(ca.fmax(x.level, 1e-6))
        return (Balance("volume", p.area * x.level, u.inflow, out, "m^3", "m^3/s"),)


class TorchTank(TorchPrior):
    """The same in torch."""

    states, inputs, outputs, parameters = Tank.states, Tank.inputs, Tank.outputs, Tank.parameters

    def xdot(self, x, u, w, p):
        return (u.inflow - p.k * torch.sqrt(x.level.clamp_min(1e-6))) / p.area, -0.1 * x.warmth

    def balances(self, x, u, w, p):
        out = p.k * torch.sqrt(x.level.clamp_min(1e-6))
        return (Balance("volume", p.area * x.level, u.inflow, out, "m^3", "m^3/s"),)


class Plant(StatePlant):
    def step(self, state, u, dt):
        return state + dt * np.array([state[1], 10 * u[0] - 10 * np.sin(state[0])])


DATA = DataSpec("t", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.2, warm_up=0.5)
CONTROL = OCP(10, (25, 0.25), (1,), (1,), (-1,), (1,))
TASK = Task("hold", "Hold", 1.0, (0.1, 0.0), lambda t: np.zeros((len(t), 2)))
GOOD = Scenario(
    "mine", "Mine", "", prior=Pendulum, data=DATA, control=CONTROL, sensor_sigma=(1e-3,), plant=Plant, tasks=(TASK,),
    budgets={"quick": Budget(4, 1, 5, 5, seeds=1)},
)  # fmt: skip


TANK = Scenario(
    "mine", "Mine", "", prior=Tank, budgets=GOOD.budgets,
    data=dataclasses.replace(DATA, inputs=("inflow",), outputs=("level", "warmth")),
)  # fmt: skip


def prior(**members):
    """Makes the fields of a scenario with a prior that differs."""
    return lambda: {"prior": type("Changed", (Pendulum,), members)}


def data(**fields):
    return {"data": dataclasses.replace(DATA, **fields)}


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


def flow(*rates):
    """``xdot`` of these rates of the tank, each a function of ``(x, u, p, m)``; ``m`` is casadi or torch."""

    def members(m):
        def xdot(self, x, u, w, p):
            return tuple(rate(x, u, p, m) for rate in rates)

        return {"xdot": xdot, "balances": Prior.balances}

    return members


def level(rate):
    """The tank's flow with another rate of the level."""
    return flow(rate, lambda x, u, p, m: -0.1 * x.warmth)


def balance(*terms, **named):
    """A balance of the tank's warmth with these terms, each a function of ``(x, u, m)``."""

    def members(m):
        def balances(self, x, u, w, p):
            return (Balance("heat", *(term(x, u, m) for term in terms), **named),)

        return {"balances": balances}

    return members


def members(**given):
    return lambda m: given


def warmth(x, u, m):
    return x.warmth


def lost(x, u, m):
    return 0.1 * x.warmth


def nothing(x, u, m):
    return 0.0


PLACE = "test_preflight.py"
IN_BOTH = {
    # what a user gets wrong in the same way in CasADi and in torch
    "no tuple": (members(xdot=lambda self, x, u, w, p: u.inflow), "HM-CHECK-060"),
    "xdot raises": (members(xdot=lambda self, x, u, w, p: raises()), "HM-CHECK-061"),
    "a typing error": (flow(lambda x, u, p, m: x.levle), "HM-MACHINE-044"),
    "no such parameter": (level(lambda x, u, p, m: p.volume), "HM-MACHINE-044"),
    "output raises": (members(output=lambda self, x, u, w, p: raises()), "HM-CHECK-061"),
    "NaN": (level(lambda x, u, p, m: m.sqrt(x.level - 0.5)), "HM-CHECK-051"),
    "infinite slope": (level(lambda x, u, p, m: u.inflow - m.sqrt(x.level)), "HM-CHECK-051"),
    "infinite slope by a parameter": (level(lambda x, u, p, m: x.level**p.k * u.inflow**p.k), "HM-CHECK-051"),
    "NaN of an output": (members(output=lambda self, x, u, w, p: (1 / x.level, x.warmth)), "HM-CHECK-051"),
    "balance with a wrong sign": (balance(warmth, lost), "HM-CHECK-057"),
    "negative loss": (
        balance(warmth, lambda x, u, m: -0.2 * x.warmth, lambda x, u, m: -0.1 * x.warmth), "HM-CHECK-058",
    ),
    "balance of NaN": (
        balance(lambda x, u, m: m.log(x.warmth), lambda x, u, m: -0.1 + 0 * x.warmth, unit="1"), "HM-CHECK-056",
    ),
    "balance of nothing": (balance(nothing, lost, lost), "HM-CHECK-055"),
    "operating point of one": (members(operating_point=OperatingPoint((0.2,), (0.1,))), "HM-MACHINE-049"),
    "operating point out of range": (members(operating_point=OperatingPoint((0.2, 100.0), (0.1,))), "HM-CHECK-045"),
    "operating point of numbers": (members(operating_point=(0.2, 9.0)), "HM-MACHINE-048"),
    "parameters of one name": (
        members(parameters=(*Tank.parameters, Parameter("k", 1.0, "-", 0.0, 2.0))), "HM-CHECK-036",
    ),
    "states of one name": (members(states=(Tank.states[0], Tank.states[0])), "HM-CHECK-035"),
    "no states": (members(states=()), "HM-CHECK-034"),
    "states that are texts": (members(states=("level", "warmth")), "HM-MACHINE-005"),
}  # fmt: skip
"""Members of a class, made by a function of the module that the tank is written in, and the code of the error."""
BLIND = {"outputs": Tank.outputs[:1]}
"""A tank whose temperature nobody measures, and which the level does not hang on."""
TOGETHER = {
    "outputs": Tank.outputs[:1],
    "xdot": lambda self, x, u, w, p: (u.inflow - x.up - x.down, x.down, x.up),
    "states": (Tank.states[0], Signal("up", "m/s", -1.0, 1.0), Signal("down", "m/s", -1.0, 1.0)),
    "balances": Prior.balances,
}
"""Only the sum of two states can be seen."""
WRONG = {
    # the prior
    "raises when made": (field(prior=raises), "HM-CHECK-061"),
    "is no prior": (field(prior=lambda values=None: 3), "HM-CHECK-032"),
    "ignores its values": (
        field(prior=lambda values=None: Pendulum({"J": 0.06} if values is None else None)), "HM-CHECK-033",
    ),
    "takes no values": (field(prior=lambda: Pendulum()), "HM-CHECK-061"),
    "no xdot": (
        field(prior=type("Empty", (Prior,), {k: getattr(Tank, k) for k in ("states", "inputs", "outputs")})),
        "HM-CHECK-061",
    ),
    # a mechanical prior
    "zero inertia": (prior(mass_matrix=lambda self, q, p: 0.0 * p.J), "HM-CHECK-049"),
    "no inertia": (prior(mass_matrix=MechanicalPrior.mass_matrix), "HM-CHECK-061"),
    "inertia without return": (prior(mass_matrix=lambda self, q, p: None), "HM-MACHINE-003"),
    "inertia of two": (prior(mass_matrix=lambda self, q, p: ((p.J, 0), (0, p.J))), "HM-MACHINE-004"),
    "friction that drives": (prior(friction=lambda self, q, v, p: -0.1 * v.phi_dot), "HM-CHECK-058"),
    "friction of two": (prior(friction=lambda self, q, v, p: (v.phi_dot, v.phi_dot)), "HM-MACHINE-016"),
    "potential without return": (prior(potential=lambda self, q, p: None), "HM-MACHINE-015"),
    "force of two": (prior(force=lambda self, q, v, u, w, p: (u.tau, u.tau)), "HM-MACHINE-016"),
    "two inputs and no force": (
        lambda: prior(inputs=(Signal("a", "N"), Signal("b", "N")))() | data(inputs=("a", "b")), "HM-MACHINE-002",
    ),
    "three states": (prior(states=(*Pendulum.states, Signal("i", "A"))), "HM-MACHINE-001"),
    # data
    "too few columns": (field(data=dataclasses.replace(DATA, inputs=())), "HM-DATA-129"),
    "unknown cause": (field(causes={"mass": ("m",)}), "HM-CHECK-017"),
    # control
    "weights of too few": (field(control=OCP(10, (25,), (1,), (1,), (-1,), (1,))), "HM-CHECK-023"),
    "a problem that is none": (field(control={"horizon": 10}), "HM-SCENARIO-002"),
    "no sensor_sigma": (field(sensor_sigma=()), "HM-CHECK-019"),
    "zero sensor_sigma": (field(sensor_sigma=(0.0,)), "HM-CHECK-020"),
    "absurd sensor_sigma": (field(sensor_sigma=(1e300,)), "HM-RECORDS-007"),
    "first_sigma of all": (field(first_sigma=(1e-3, 0.1)), "HM-KIT-015"),
    "noise of no state": (field(state_noise={"phi_dott": 0.1}), "HM-CHECK-021"),
    "zero state_noise": (field(state_noise={"phi": 0.0}), "HM-CHECK-022"),
    "hard bounds of too many outputs": (control(hard=[HardBound("y", (-1.0,) * 3, (1.0,) * 3)]), "HM-CONTROL-037"),
    "hard bound out of reach": (
        control(hard=[HardBound(ca.Function("one", [ca.SX.sym("x", 2), ca.SX.sym("u")], [ca.SX(1)]), [0.0], [2.0])]),
        "HM-CONTROL-030",
    ),
    # tasks
    "no reference for all": (task(reference=lambda t: np.zeros((len(t), 1))), "HM-CHECK-059"),
    "reference that raises": (task(reference=raises), "HM-CHECK-061"),
    "reference of NaN": (task(reference=lambda t: np.full((len(t), 2), np.nan)), "HM-CHECK-029"),
    "negative factors": (task(weight=lambda t: -np.ones((len(t), 2))), "HM-CHECK-030"),
    "no duration": (task(duration=0.0), "HM-RECORDS-007"),
    "x0 of one": (task(x0=(0.0,)), "HM-CHECK-027"),
    "x0 of NaN": (task(x0=(math.nan, 0.0)), "HM-RECORDS-007"),
    "same tasks": (field(tasks=(TASK, TASK)), "HM-RECORDS-004"),
    "fault of a channel": (task(faults=(Fault(0, 1, "input_gain", 0.5, channel="third"),)), "HM-LOOP-004"),
    "fault the plant lacks": (task(faults=(Fault(0, 1, "plant_fire", 0.5),)), "HM-LOOP-006"),
    "tasks without control": (field(control=None), "HM-CHECK-018"),
    # plant and oracle
    "plant that raises": (plant(step=raises), "HM-CHECK-061"),
    "plant measures all": (plant(measure=lambda self, state, rng: state), "HM-CHECK-025"),
    "plant of NaN": (plant(step=lambda self, s, u, dt: s * np.nan), "HM-CHECK-026"),
    "oracle that raises": (field(oracle=raises), "HM-CHECK-061"),
    # budgets
    "no networks": (budget(networks=0), "HM-RECORDS-007"),
    "half a unit": (budget(hidden=2.5), "HM-RECORDS-006"),
}  # fmt: skip


ALSO_IN_TORCH = ("no such parameter", "NaN", "output raises", "negative loss", "operating point of numbers")
"""Of each kind one; torch takes half a second to trace a prior, so the full set has the others."""


@pytest.mark.parametrize(
    ("name", "base"),
    [
        pytest.param(name, base, marks=[] if base is Tank or name in ALSO_IN_TORCH else pytest.mark.full)
        for name in IN_BOTH
        for base in (Tank, TorchTank)
    ],
)
def test_every_wrong_prior_is_told_in_both_ways_of_writing(name, base):
    make, code = IN_BOTH[name]
    with pytest.raises(InputError, match=code):
        check_scenario(changed(base, make(ca if base is Tank else torch)))


def changed(base, members):
    """The tank's scenario with a prior that differs; a prior that cannot be seen whole has one column less."""
    own = type("Changed", (base,), members)
    columns = dataclasses.replace(TANK.data, outputs=TANK.data.outputs[: len(own.outputs)])
    return dataclasses.replace(TANK, prior=own, data=columns)


@pytest.mark.parametrize("base", [Tank, TorchTank])
@pytest.mark.parametrize(("members", "states"), [(BLIND, "warmth"), (TOGETHER, "up, down")])
def test_states_that_no_output_sees_are_named(base, members, states):
    with pytest.raises(
        InputError, match=rf"{states} (is|are) not observable: no output \(level\).*Measure (it|them)"
    ):
        check_scenario(changed(base, members))


NO_TORCH = ["Changed.xdot", "needs a TorchPrior"]
NO_CASADI = ["Changed.xdot", "needs a Prior"]


def if_else(x, u, p, m):
    return u.inflow if x.level > 0.5 else -u.inflow


@pytest.mark.parametrize(
    ("base", "rate", "words"),
    [
        (Tank, if_else, ["truth value", PLACE, "ca.if_else(condition, one, other)"]),
        (TorchTank, if_else, ["Changed.xdot decides by the values", PLACE, "torch.where instead of if"]),
        (
            TorchTank,
            lambda x, u, p, m: float(x.level) * u.inflow,
            ["Changed.xdot", PLACE, "instead of float(x)"],
        ),
        (
            TorchTank,
            lambda x, u, p, m: torch.special.bessel_j0(x.level),
            ["Changed.xdot", "bessel", "operators.md"],
        ),
        (TorchTank, lambda x, u, p, m: x.level.float(), ["Changed.xdot", "less than float64"]),
        (TorchTank, lambda x, u, p, m: ca.sqrt(x.level), NO_CASADI),
        (Tank, lambda x, u, p, m: torch.sqrt(x.level), NO_TORCH),
        (Tank, lambda x, u, p, m: x.level.clamp_min(1e-6), NO_TORCH),
    ],
)
def test_what_one_way_of_writing_cannot_do_is_told(base, rate, words):
    with pytest.raises(InputError) as told:
        check_scenario(changed(base, level(rate)(None)))
    for word in words:
        assert word in str(told.value)


@pytest.mark.parametrize(("changes", "code"), WRONG.values(), ids=WRONG)
@pytest.mark.full
def test_every_wrong_scenario_is_told(changes, code):
    with pytest.raises(InputError, match=code):
        check_scenario(dataclasses.replace(GOOD, **changes()))


def test_a_problem_with_prices_asks_for_them_in_the_reference():
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    priced = dataclasses.replace(
        GOOD, control=CONTROL.changed(economic=ca.Function("f", [x, u, p], [p * u**2]))
    )
    with pytest.raises(InputError, match=r"\(50, 3\).*50.*\(50, 2\); the last 1 columns.*HM-CHECK-059"):
        check_scenario(priced)
    told = dataclasses.replace(TASK, reference=lambda t: np.ones((len(t), 3)))
    check_scenario(dataclasses.replace(priced, tasks=(told,)))


def test_a_good_scenario_passes():
    check_scenario(GOOD)
    for base in (Tank, TorchTank):
        point = OperatingPoint((0.25, 0.0), (0.1,))
        check_scenario(changed(base, {"operating_point": point}))
    check_scenario(dataclasses.replace(GOOD, control=None, tasks=(), plant=None))


@pytest.mark.full
@pytest.mark.parametrize("name", registered_scenarios())
def test_the_ready_scenarios_pass(name):
    if name == "double_pendulum":
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    check_scenario(load_scenario(name))


def test_the_command_tells_it_before_it_reads_anything(call, tmp_path):
    machine = tmp_path / "machine.py"
    machine.write_text(
        "from tests.check.test_preflight import GOOD, control\nimport dataclasses\n"
        "scenario = dataclasses.replace(GOOD, **control(horizon=0)())\n"
    )
    code, _, message = call("run", machine, "--data", tmp_path / "none.csv", "--out", tmp_path / "out")
    assert code == 2
    assert "horizon [periods]: must be an integer from 1 to 10000, got 0" in message
    assert "machine.py:3" in message
    assert not (tmp_path / "out").exists()


class RainyTanks(Tanks):
    """Their operating point: both levels rest under inflow and rain."""

    outputs = (Signal("lower", "m", 0.0, 2.0),)
    operating_point = OperatingPoint((0.64, 0.64), (0.12,), (0.05,))
    parameters = (
        Parameter("a_1", 1.0, "m^2", 1.0, 1.0),
        Parameter("a_2", 1.2, "m^2", 0.3, 3.0),
        Parameter("k_1", 0.15, "m^2.5/s", 0.05, 0.6),
        Parameter("k_2", 0.2125, "m^2.5/s", 0.05, 0.6),
    )


class RainyPlant(StatePlant):
    """The prior itself, by small steps of Euler."""

    def __init__(self):
        self._prior = RainyTanks()

    def step(self, state, u, dt, w):
        p = self._prior.p
        for _ in range(50):
            state = state + dt / 50 * self._prior.equations.xdot(state, u, w, p).full().ravel()
        return state

    def measure(self, state, rng):
        return state[1:]


def filled(to):
    """A step of the lower tank's level, the only output."""
    return lambda t: np.where(t[:, None] < 20.0, 0.64, to)


def rain(t):
    return np.full((len(t), 1), 0.05)


def rainy(**changes):
    task = Task(
        "fill",
        "More in the lower tank",
        60.0,
        (0.64, 0.64),
        filled(0.8),
        w=lambda t: np.full((len(t), 1), 0.05),
    )
    made = Scenario(
        "tanks", "Two tanks in the rain", "Levels.", RainyTanks,
        DataSpec("t", ("inflow",), ("lower",), 1.0, 3.0, 4.0, 20.0, disturbances=("rain",)),
        plant=RainyPlant, control=OCP(20, (0.0, 0.0), (1.0,), (1.0,), (0.0,), (0.4,), q_y=(25.0,)),
        sensor_sigma=(1e-3,), first_sigma=(0.1,), safe_input=(0.12,), tasks=(task,),
        disturbance_model=(Disturbance("output", "lower", 0.1),),
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def test_set_points_of_outputs_measured_disturbances_and_a_disturbance_model_pass():
    check_scenario(rainy())


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (lambda t: filled(2.5)(t), ["reference: lower [m] is 2.5 at 20 s, outside its range 0 to 2"]),
        (lambda t: np.zeros((len(t), 2)), ["reference: must return shape (60, 1) for 60 times, got (60, 2)"]),
    ],
    ids=["beyond the range", "of the states"],
)
def test_a_set_point_of_outputs_that_cannot_be_is_told(changed, words):
    task = dataclasses.replace(rainy().tasks[0], reference=changed)
    with pytest.raises(InputError) as told:
        check_scenario(rainy(tasks=(task,)))
    for word in words:
        assert word in str(told.value)


def test_a_set_point_of_outputs_that_no_input_holds_is_told():
    """At most 0.2 flows in: 1.9 m are within the signal's range and out of reach."""
    task, weak = (
        dataclasses.replace(rainy().tasks[0], reference=filled(1.9)),
        rainy().control.changed(u_max=(0.2,)),
    )
    found = check_scenario(rainy(tasks=(task,), control=weak))
    (told,) = [w for w in found.warnings if "the reference ends" in w]
    assert "the reference ends at y = [1.9]" in told
    assert "under u = [0.2]" in told


def test_a_term_that_is_no_law_is_named():
    found = preflight(dataclasses.replace(GOOD, terms=("coulomb", "coulombic")))
    (problem,) = found.problems
    assert "coulombic" in problem
    assert "'coulomb'" in problem  # the nearest one
