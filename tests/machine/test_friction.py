"""Friction blocks: hand-written formulas, energy balance, passivity, export."""

import math

import numpy as np
import pytest
import torch
from energy_checks import check_energy_balance, random_points, random_values
from simulated_pendulum import Pendulum

from hybrid_mpc import (
    Coulomb,
    InputError,
    LoadDependent,
    Parameter,
    PendulumLoad,
    Prior,
    Signal,
    Stribeck,
    Viscous,
    with_friction,
)
from hybrid_mpc.machine.torch_prior import coulomb, load_dependent, stribeck
from scenarios.golf_robot.prior import GolfRobotPrior
from scenarios.pendulum.prior import PendulumPrior
from scenarios.torque_pendulum.prior import TorquePendulumPrior

D = Parameter("d_2", 0.3, "N m s/rad", 0.0, 2.0)
LEVEL = Parameter("F_2", 0.5, "N m", 0.0, 2.0)
STATIC = Parameter("F_s", 0.8, "N m", 0.5, 2.0)
SPEED = Parameter("v_s", 0.2, "rad/s", 0.05, 1.0)
GAMMA = Parameter("gamma_2", 20.0, "s/rad", 1.0, 50.0)
ARM = Parameter("rho", 0.02, "m", 0.0, 0.05)
TERMS = {
    "viscous": (Viscous(D),),
    "coulomb": (Coulomb(LEVEL, GAMMA),),
    "stribeck": (Stribeck(LEVEL, STATIC, SPEED, GAMMA),),
    "load": (LoadDependent(ARM, GAMMA, PendulumLoad("m", "l", "g")),),
    "all": (
        Viscous(D),
        LoadDependent(ARM, GAMMA, PendulumLoad()),
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


@pytest.mark.parametrize("kind", TERMS)
def test_torques_are_the_hand_written_formulas(kind):
    prior, free = with_friction(PendulumPrior, *TERMS[kind])(), PendulumPrior()
    x, u = random_points(prior, np.random.default_rng(0), 50)
    x[:25, 1] *= 0.02  # near rest, where friction bends
    lost = (free.acceleration(x, u) - prior.acceleration(x, u))[:, 0] * 50.0 * 0.05**2
    expected = [by_hand(kind, *row) for row in x.tolist()]
    np.testing.assert_allclose(lost, expected, rtol=0, atol=1e-12)  # rounding of torques of up to 30 N m


@pytest.mark.parametrize("kind", TERMS)
@pytest.mark.parametrize("base", [PendulumPrior, GolfRobotPrior, TorquePendulumPrior, Pendulum])
def test_energy_balance_stays_zero_along_the_flow(kind, base):
    terms = TERMS[kind]
    if base in (TorquePendulumPrior, Pendulum):  # they have no m, l, g: their load is a constant one
        terms = tuple(
            LoadDependent(t.arm, t.steepness, lambda prior, x: 5.0 + x[..., 0])
            if isinstance(t, LoadDependent) else t for t in terms
        )  # fmt: skip
    elif base is GolfRobotPrior:
        terms = tuple(
            LoadDependent(t.arm, t.steepness, PendulumLoad("m", "a", "g"))
            if isinstance(t, LoadDependent) else t for t in terms
        )  # fmt: skip
    if base is Pendulum:

        class Lumped(Pendulum):  # as a user writes it: the base class makes the balance
            energy_balance = Prior.energy_balance

            def inertia(self, x):
                return self.J

        base = Lumped
    made = with_friction(base, *terms)
    check_energy_balance(made())
    for seed in range(3):
        check_energy_balance(made(random_values(made, np.random.default_rng(seed))), seed)
    # once more on top of it
    twice = with_friction(made, Viscous(Parameter("d_3", 0.1, "N m s/rad", 0.0, 1.0)))
    check_energy_balance(twice())


@pytest.mark.parametrize("kind", TERMS)
def test_friction_only_takes_energy(kind):
    prior, free = with_friction(PendulumPrior, *TERMS[kind])(), PendulumPrior()
    x, u = random_points(prior, np.random.default_rng(1))
    power = (prior.acceleration(x, u) - free.acceleration(x, u))[:, 0] * x[:, 1]
    assert (power < 0).all()
    still = x.clone()
    still[:, 1] = 0.0
    assert torch.equal(prior.acceleration(still, u), free.acceleration(still, u))  # none at rest


def test_the_golf_robot_s_own_friction_is_the_load_dependent_block():
    prior = GolfRobotPrior()
    x, _ = random_points(prior, np.random.default_rng(2))
    load = PendulumLoad("m", "a", "g")(prior, x)
    mine = load_dependent(x[:, 1], load, prior.r * prior.mu, prior.gamma)
    np.testing.assert_allclose(mine, prior.friction(x), rtol=1e-14)  # another order of the products


def test_stribeck_has_its_peak_and_its_level():
    level, static, speed, steep = (torch.tensor(v, dtype=torch.float64) for v in (0.5, 0.8, 0.2, 1e4))
    v = torch.tensor([1e-3, 0.2, 2.0], dtype=torch.float64)
    found = stribeck(v, level, static, speed, steep)
    np.testing.assert_allclose(found, [0.8, 0.5 + 0.3 / math.e, 0.5], atol=1e-5)  # 0.3 (1e-3 / 0.2)^2
    same = stribeck(v, level, level, speed, steep)
    assert torch.equal(same, coulomb(v, level, steep))


def test_terms_act_on_their_own_axis():
    class Two(Prior):
        states = (Signal("a", "rad"), Signal("b", "rad"), Signal("a_dot", "rad/s"), Signal("b_dot", "rad/s"))
        inputs = (Signal("u", "N m"),)
        outputs = states[:2]
        parameters_spec = (Parameter("k", 1.0, "N m", 0.5, 2.0),)

        def inertia(self, x):
            return torch.stack([2.0 + 0 * x[..., 0], 3.0 + torch.cos(x[..., 0])], dim=-1)

        def acceleration(self, x, u):
            return torch.cat([u, self.k * torch.sin(x[..., 1:2])], dim=-1) / self.inertia(x)

    made = with_friction(Two, Viscous(D, axis=1))
    check_energy_balance(made())
    x, u = random_points(made(), np.random.default_rng(3))
    change = made().acceleration(x, u) - Two().acceleration(x, u)
    assert torch.equal(change[:, 0], torch.zeros(len(x), dtype=torch.float64))
    np.testing.assert_allclose(
        change[:, 1], -0.3 * x[:, 3] / (3.0 + torch.cos(x[:, 0])), rtol=1e-12, atol=1e-13
    )
    with pytest.raises(InputError, match="no axis 2"):
        with_friction(Two, Viscous(D, axis=2))


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="at least one term"):
        with_friction(PendulumPrior)
    with pytest.raises(InputError, match="d is there twice"):
        with_friction(PendulumPrior, Viscous(Parameter("d", 1.0, "N m s/rad", 0.0, 2.0)))
    with pytest.raises(InputError, match="must define inertia"):
        with_friction(Pendulum, Viscous(D))


def test_it_is_fitted_and_exported_as_any_prior():
    import casadi as ca

    from hybrid_mpc import PriorStep
    from nn_export import to_casadi

    made = with_friction(PendulumPrior, *TERMS["all"])
    prior = made({"F_2": 0.7})
    assert made.__name__ == "PendulumPriorWithViscousLoadDependentStribeck"
    assert prior.values["F_2"] == 0.7
    step = PriorStep(prior, 0.01)
    x, u, h = torch.tensor([0.4, -0.7]).double(), torch.tensor([3.0]).double(), torch.zeros(0).double()
    f = to_casadi(prior, (x, u))
    assert isinstance(f, ca.Function)
    # the exporter's promise
    np.testing.assert_allclose(f(x.numpy(), u.numpy()).full().ravel(), prior(x, u), rtol=0, atol=1e-12)
    assert torch.isfinite(step(x, h, u)[0]).all()
