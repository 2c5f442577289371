"""The test that every prior must pass: its energy balance is zero along its own flow, and power beside it."""

import importlib
import inspect
import pkgutil

import numpy as np
import torch

import scenarios
from hybrid_mpc import Prior

EPS = float(np.finfo(float).eps)
SAMPLES = 200


def scenario_priors() -> list[type[Prior]]:
    """Every prior that any scenario defines in its ``prior.py``, registered or not."""
    found = []
    for package in pkgutil.iter_modules(scenarios.__path__, "scenarios."):
        try:
            module = importlib.import_module(f"{package.name}.prior")
        except ModuleNotFoundError as missing:
            if missing.name != f"{package.name}.prior":
                raise
            continue
        found += [c for _, c in inspect.getmembers(module, inspect.isclass)
                  if issubclass(c, Prior) and c.__module__ == module.__name__]  # fmt: skip
    return found


def random_values(prior: type[Prior] | Prior, rng: np.random.Generator) -> dict[str, float]:
    """Parameters drawn within the bounds of the fit."""
    return {p.name: float(rng.uniform(p.lower, p.upper)) for p in prior.parameters_spec}


def random_points(
    prior: Prior, rng: np.random.Generator, n: int = SAMPLES
) -> tuple[torch.Tensor, torch.Tensor]:
    """States ``(n, n_x)`` and inputs ``(n, n_u)`` over the signals' ranges, at most 10 [SI] to either side."""

    def draw(signals) -> torch.Tensor:
        low, high = (np.clip([getattr(s, key) for s in signals], -10.0, 10.0) for key in ("lower", "upper"))
        return torch.tensor(rng.uniform(low, high, (n, len(signals))))

    return draw(prior.states), draw(prior.inputs)


def check_energy_balance(prior: Prior, seed: int = 0) -> None:
    """Fail unless the prior's energy balance is zero along its own flow to rounding, and not zero beside it.

    Along the flow the terms (inertia, gravity and losses, input) cancel; what may stay is the rounding of their sum:
    64 units in the last place of the largest one hold the dozen operations that make it. Beside the flow, an
    acceleration that nothing explains must leave the power ``inertia * acceleration * velocity``: of the sign of
    ``acceleration * velocity``, and twice as much for twice the acceleration.
    """
    x, u = random_points(prior, np.random.default_rng(seed))
    n_q = prior.n_q
    v = x[:, n_q : 2 * n_q]
    with torch.no_grad():
        flow = prior(x, u)
        assert torch.equal(flow[:, :n_q], v), "the kinematics are not exact"
        balance = prior.energy_balance(x, flow, u)
        assert balance.shape == (SAMPLES,)
        still, none = torch.zeros_like(flow), torch.zeros_like(u)
        held = prior.energy_balance(x, still, none)
        terms = (held, prior.energy_balance(x, flow, none) - held, prior.energy_balance(x, still, u) - held)
        largest = float(torch.stack(terms).abs().max())
        assert largest > 0, "a balance that is always zero tells nothing"
        worst = float(balance.abs().max())
        assert worst <= 64 * EPS * largest, f"{worst:.3g} W along the flow, of terms up to {largest:.3g} W"
        for axis in range(n_q):
            push = torch.zeros_like(flow)
            push[:, n_q + axis] = 10.0
            once, twice = (prior.energy_balance(x, flow + k * push, u) for k in (1.0, 2.0))
            assert (torch.sign(once) == torch.sign(v[:, axis])).all(), (
                "an unexplained push has the wrong sign"
            )
            torch.testing.assert_close(twice, 2 * once, rtol=1e-9, atol=128 * EPS * largest)
