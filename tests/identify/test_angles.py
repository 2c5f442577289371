"""A machine with angles in degrees is the machine with angles in radians."""

import math

import casadi as ca
import numpy as np
import pytest
import torch
from wrapped_machine import DEG, boat

from hybrid_mpc import HybridStep, Prior, Scaling, Signal, n_features
from hybrid_mpc.analyze.analysis import state_range
from hybrid_mpc.analyze.equilibria import equilibria
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.identify.prior_replay import _Places


def vane(unit: str) -> type[Prior]:
    """A weather vane: angle, speed, torque, and the direction of the wind."""
    size = Signal("a", unit, periodic=True).radians

    class Vane(Prior):
        states = (Signal("psi", unit, periodic=True), Signal("r", "1/s"))
        inputs = (Signal("torque", "N m"),)
        outputs = states
        disturbances = (Signal("speed", "m/s"), Signal("wind_from", unit, periodic=True))
        parameters = ()
        corrects = ("r",)

        def xdot(self, x, u, w, p):
            return x.r / size, u.torque - x.r + w.speed * ca.sin(size * (w.wind_from - x.psi))

        def output(self, x, u, w, p):
            return x.psi, x.r

    return Vane


def step_of(unit: str) -> HybridStep:
    prior, size = vane(unit)(), Signal("a", unit, periodic=True).radians
    scaling = Scaling(
        x=(1.0 / size, 2.0), u=(0.5,), rate=(3.0,), correction=(0.4,), w=(2.0, 1.0 / size),
        centre_x=(0.1 / size, 0.2), centre_u=(0.1,), centre_w=(1.0, 0.3 / size), xdot=(1.0 / size, 1.0),
    )  # fmt: skip
    torch.manual_seed(0)
    return HybridStep(prior, StackedGRU(1, n_features(prior, True), 4, 1, seed=0), scaling, 0.05)


def drawn(unit: str, turns: float = 0.0) -> list[torch.Tensor]:
    """States, inputs, disturbances of 20 samples, the angles so many turns further."""
    rng, turn = np.random.default_rng(0), Signal("a", unit, periodic=True).period
    x, u, w = (rng.normal(size=(20, n)) for n in (2, 1, 2))
    for angle in (x[:, 0], w[:, 1]):
        angle *= turn / (2 * math.pi)
        angle += turns * turn
    return [torch.tensor(v) for v in (x, u, w)]


@pytest.mark.parametrize("unit", ["deg", "rev"])
def test_a_network_sees_the_angle_and_not_its_unit(unit):
    own, radians = step_of(unit), step_of("rad")
    seen = own.features(*drawn(unit))
    assert seen.shape[-1] == n_features(own.prior, True) == 2 + 1 + 1 + 1 + 2 + 1
    torch.testing.assert_close(seen, radians.features(*drawn("rad")), rtol=0, atol=1e-12)
    torch.testing.assert_close(seen, own.features(*drawn(unit, turns=3.0)), rtol=0, atol=1e-11)


def test_distances_of_prior_replay_are_those_of_angles():
    x = np.array([[10.0, 1.0], [370.0, 1.0]])
    places = _Places(np.array([True, False]), np.array([DEG, 0.0]), np.array([1.0, 1.0]))(x)
    np.testing.assert_allclose(places[0], places[1], rtol=0, atol=1e-12)


def test_equilibria_count_modulo_a_turn_of_the_unit():
    model = boat()
    reach = state_range(model)
    assert reach[0].tolist() == [-180.0, 180.0]
    found = equilibria(model, [0.0], [(-180.0, 180.0), (-1.0, 1.0)], starts=32)
    # sin(psi) = 0: with the wind and against it
    assert sorted(abs(round(float(p.x[0]), 6)) % 360 for p in found.points) == [0.0, 180.0]
