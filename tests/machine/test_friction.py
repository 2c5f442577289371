"""Friction blocks: hand-written formulas, energy balance, passivity, export."""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from energy_checks import check_balances, random_points, random_values, rates
from example_priors import Tanks
from simulated_pendulum import Pendulum

from hybrid_mpc import (
    Coulomb,
    InputError,
    LoadDependent,
    MechanicalPrior,
    Parameter,
    PriorStep,
    Signal,
    Stribeck,
    Viscous,
    trace_model,
    with_friction,
)
from hybrid_mpc.machine.friction import coulomb, load_dependent, stribeck
from nn_export import build
from scenarios.golf_robot.prior import GolfRobotPrior
from scenarios.pendulum.prior import PendulumPrior
from scenarios.torque_pendulum.prior import TorquePendulumPrior

D = Parameter("d_2", 0.3, "N m s/rad", 0.0, 2.0)
LEVEL = Parameter("F_2", 0.5, "N m", 0.0, 2.0)
STATIC = Parameter("F_s", 0.8, "N m", 0.5, 2.0)
SPEED = Parameter("v_s", 0.2, "rad/s", 0.05, 1.0)
GAMMA = Parameter("gamma_2", 20.0, "s/rad", 1.0, 50.0)
ARM = Parameter("rho", 0.02, "m", 0.0, 0.05)


def carried(arm):
    """Load [N] on the bearing of a pendulum whose weight is ``arm`` (a parameter's name) from it."""
    return lambda q, v, p: p.m * v[0] * v[0] * getattr(p, arm) + p.m * p.g * cosine(q[0])


def cosine(x):
    return torch.cos(x) if isinstance(x, torch.Tensor) else ca.cos(x)


TERMS = {
    "viscous": (Viscous(D),),
    "coulomb": (Coulomb(LEVEL, GAMMA),),
    "stribeck": (Stribeck(LEVEL, STATIC, SPEED, GAMMA),),
    "load": (LoadDependent(ARM, GAMMA, carried("l")),),
    "all": (
        Viscous(D),
        LoadDependent(ARM, GAMMA, carried("l")),
        Stribeck(
            LEVEL, STATIC, SPEED, Parameter("gamma_3", 30.0, "s/rad", 1.0, 50.0)
        ),
    ),
}  # fmt: skip


def by_hand(kind, phi, v):
    """Friction torque of the pendulum at the nominal values, in plain Python."""
    sign = math.tanh(20.0 * v)
    load = abs(50.0 * v * v * 0.05 + 50.0 * 9.81 * math.cos(phi))
    return {
        "viscous": 0.3 * v,
        "coulomb": 0.5 * sign,
        "stribeck": (0.5 + 0.3 * math.exp(-((v / 0.2) ** 2))) * sign,
        "load": 0.02 * sign * load,
        "all": 0.3 * v + 0.02 * sign * load + (0.5 + 0.3 * math.exp(-((v / 0.2) ** 2))) * math.tanh(30.0 * v),
    }[kind]


def lost(prior, free, x, u):
    """Friction [N m] that one prior has beside the other's, by their rates and the inertia."""
    inertia = free.values["m"] * free.values["l"] ** 2
    return (rates(free, x, u) - rates(prior, x, u))[:, 1] * inertia


IN_TORCH = pytest.mark.parametrize(
    "kind", [k if k == "stribeck" else pytest.param(k, marks=pytest.mark.full) for k in TERMS]
)
"""On a prior in torch, which takes a second to trace: the quick set has the one with most parts."""


@IN_TORCH
def test_torques_are_the_hand_written_formulas(kind):
    prior, free = with_friction(PendulumPrior, *TERMS[kind])(), PendulumPrior()
    x, u, _ = random_points(prior, np.random.default_rng(0), 50)
    x[:25, 1] *= 0.02  # near rest, where friction bends
    expected = [by_hand(kind, *row) for row in x.tolist()]
    # rounding of torques of up to 30 N m
    np.testing.assert_allclose(lost(prior, free, x, u), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "base"),
    [(kind, base) for base in (GolfRobotPrior, TorquePendulumPrior, Pendulum) for kind in TERMS]
    + [pytest.param(kind, PendulumPrior, marks=pytest.mark.full) for kind in TERMS],
)
def test_energy_balance_stays_zero_along_the_flow(kind, base):
    # those without m, l and g have a load that changes its sign
    load = {PendulumPrior: carried("l"), GolfRobotPrior: carried("a")}.get(base, lambda q, v, p: 5.0 * q[0])
    terms = tuple(replace(t, load=load) if isinstance(t, LoadDependent) else t for t in TERMS[kind])
    made = with_friction(base, *terms)
    check_balances(made())
    check_balances(made(random_values(made, np.random.default_rng(1))), 1)
    # once more on top of it
    twice = with_friction(made, Viscous(Parameter("d_3", 0.1, "N m s/rad", 0.0, 1.0)))
    check_balances(twice())
    x, u, w = random_points(made(), np.random.default_rng(0))
    one, two = (rates(kind(), x, u, w)[:, 1] for kind in (made, twice))
    inertia = float(base().mass_matrix(None, Values(base())))
    np.testing.assert_allclose((one - two) * inertia, 0.1 * x[:, 1], rtol=1e-9, atol=1e-9)


class Values:
    """A prior's values as its methods take them."""

    def __init__(self, prior):
        self.__dict__.update(prior.values)


@IN_TORCH
def test_friction_only_takes_energy(kind):
    prior, free = with_friction(PendulumPrior, *TERMS[kind])(), PendulumPrior()
    x, u, _ = random_points(prior, np.random.default_rng(1))
    assert (lost(prior, free, x, u) * x[:, 1] > 0).all()
    x[:, 1] = 0.0
    np.testing.assert_array_equal(rates(prior, x, u), rates(free, x, u))  # none at rest


def test_the_golf_robot_s_own_friction_is_the_load_dependent_block():
    prior = GolfRobotPrior()
    x, u, w = random_points(prior, np.random.default_rng(2))
    p = prior.values
    load = p["m"] * x[:, 1] ** 2 * p["a"] + p["m"] * p["g"] * np.cos(x[:, 0])
    given = x[:, 1], load, p["r"] * p["mu"], p["gamma"]
    mine = load_dependent(*(torch.tensor(v, dtype=torch.float64) for v in given)).numpy()
    (energy,) = prior.equations.balances
    taken = energy.loss(x.T, u.T, w.T, prior.p).full()[0]
    # another order of the products
    np.testing.assert_allclose(taken, (mine + p["d"] * x[:, 1]) * x[:, 1], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    "number", [ca.DM, lambda v: torch.tensor(v, dtype=torch.float64)], ids=["CasADi", "torch"]
)
def test_stribeck_has_its_peak_and_its_level(number):
    def values(v):
        return np.asarray(v, dtype=float).ravel()

    level, static, speed, steep = (number(v) for v in (0.5, 0.8, 0.2, 1e4))
    v = number([1e-3, 0.2, 2.0])
    found = values(stribeck(v, level, static, speed, steep))
    np.testing.assert_allclose(found, [0.8, 0.5 + 0.3 / math.e, 0.5], atol=1e-5)  # 0.3 (1e-3 / 0.2)^2
    same = stribeck(v, level, level, speed, steep)
    np.testing.assert_array_equal(values(same), values(coulomb(v, level, steep)))


def test_terms_act_on_their_own_axis():
    class Two(MechanicalPrior):
        states = (Signal("a", "rad"), Signal("b", "rad"), Signal("a_dot", "rad/s"), Signal("b_dot", "rad/s"))
        inputs = (Signal("u", "N m"),)
        outputs = states[:2]
        parameters = (Parameter("k", 1.0, "N m", 0.5, 2.0),)

        def mass_matrix(self, q, p):
            return 2.0, 3.0 + ca.cos(q.a)

        def force(self, q, v, u, w, p):
            return u.u, p.k * ca.sin(q.b)

    made = with_friction(Two, Viscous(D, axis=1))
    check_balances(made())
    x, u, w = random_points(made(), np.random.default_rng(3))
    change = rates(made(), x, u, w) - rates(Two(), x, u, w)
    np.testing.assert_array_equal(change[:, :3], 0.0)
    np.testing.assert_allclose(change[:, 3], -0.3 * x[:, 3] / (3.0 + np.cos(x[:, 0])), rtol=1e-12, atol=1e-13)
    for axis in (2, -1):
        with pytest.raises(InputError, match=f"no axis {axis}; it has 2 degrees of freedom"):
            with_friction(Two, Viscous(D, axis=axis))


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="at least one term"):
        with_friction(PendulumPrior)
    with pytest.raises(InputError, match="d is there twice"):
        with_friction(PendulumPrior, Viscous(Parameter("d", 1.0, "N m s/rad", 0.0, 2.0)))
    with pytest.raises(InputError, match="must be a MechanicalPrior"):
        with_friction(Tanks, Viscous(D))


def test_it_is_fitted_and_exported_as_any_prior():
    made = with_friction(PendulumPrior, *TERMS["all"])
    prior = made({"F_2": 0.7})
    assert made.__name__ == "PendulumPriorWithViscousLoadDependentStribeck"
    assert prior.values["F_2"] == 0.7
    step = PriorStep(prior, 0.01)
    f = build(trace_model(step)["step"])
    x, u, h = torch.tensor([0.4, -0.7]).double(), torch.tensor([3.0]).double(), torch.zeros(0).double()
    # the exporter's promise
    found = f(x.numpy(), [], u.numpy(), [], prior.p)[0].full().ravel()
    np.testing.assert_allclose(found, step(x, h, u, h)[0], rtol=0, atol=1e-12)
