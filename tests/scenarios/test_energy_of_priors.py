"""Every prior of every scenario: its energy balance is zero along its own flow."""

import numpy as np
import pytest
import torch
from energy_checks import check_energy_balance, random_values, scenario_priors

from hybrid_mpc import Parameter, Prior, Signal

PRIORS = scenario_priors()


def test_the_scenarios_have_priors():
    assert {"GolfRobotPrior", "PendulumPrior", "TorquePendulumPrior"} <= {p.__name__ for p in PRIORS}


@pytest.mark.parametrize("prior", PRIORS, ids=lambda p: p.__name__)
def test_energy_balance_is_zero_along_the_flow(prior):
    check_energy_balance(prior())
    rng = np.random.default_rng(1)
    for seed in range(5):
        check_energy_balance(prior(random_values(prior, rng)), seed)


class Cart(Prior):
    """With a balance of its own that can be made wrong."""

    states = (Signal("s", "m"), Signal("v", "m/s"))
    inputs = (Signal("F", "N"),)
    outputs = (states[0],)
    parameters_spec = (Parameter("m", 2.0, "kg", 0.5, 5.0), Parameter("d", 0.5, "N s/m", 0.0, 2.0))
    forgets, wrong_sign = False, False

    def acceleration(self, x, u):
        return (u - self.d * x[..., 1:2]) / self.m

    def energy_balance(self, x, xdot, u):
        v = x[..., 1]
        lost = 0.0 * v if self.forgets else self.d * v
        power = v * (self.m * xdot[..., 1] + lost - u[..., 0])
        return -power if self.wrong_sign else power


def test_the_check_finds_what_is_wrong():
    check_energy_balance(Cart())
    forgetful, negative = Cart(), Cart()
    forgetful.forgets, negative.wrong_sign = True, True
    with pytest.raises(AssertionError, match="along the flow"):
        check_energy_balance(forgetful)
    with pytest.raises(AssertionError, match="wrong sign"):
        check_energy_balance(negative)
    idle = Cart()
    idle.energy_balance = lambda x, xdot, u: torch.zeros(x.shape[:-1], dtype=torch.float64)
    with pytest.raises(AssertionError, match="always zero"):
        check_energy_balance(idle)
