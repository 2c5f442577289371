"""The test that every prior must pass: its balances hold along its own flow, integrated and at each point."""

import importlib
import inspect
import pkgutil

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

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
    return {p.name: float(rng.uniform(p.lower, p.upper)) for p in prior.parameters}


def random_points(prior: Prior, rng: np.random.Generator, n: int = SAMPLES) -> tuple[np.ndarray, ...]:
    """States ``(n, n_x)``, inputs and disturbances over the signals' ranges, at most 10 to either side."""

    def draw(signals) -> np.ndarray:
        low, high = (np.clip([getattr(s, key) for s in signals], -10.0, 10.0) for key in ("lower", "upper"))
        return rng.uniform(low, high, (n, len(signals)))

    return draw(prior.states), draw(prior.inputs), draw(prior.disturbances)


def rates(prior: Prior, x, u, w=None) -> np.ndarray:
    """The prior's rates ``(n, n_x)`` at points ``(n, ...)``."""
    w = np.zeros((len(x), len(prior.disturbances))) if w is None else w
    return prior.equations.xdot(x.T, u.T, w.T, prior.p).full().T


def check_balances(prior: Prior, seed: int = 0) -> None:
    """Fail unless each balance of the prior is zero along its own flow to rounding, its loss is never negative, and
    what is stored changes along a finely integrated motion by the integral of supply less loss.

    Along the flow the terms cancel; what may stay is the rounding of their sum: 64 units in the last place of the
    largest one hold the dozen operations that make it. The integral is that of an integrator of order 8 with tolerances
    of 1e-10; a wrong sign of any term leaves some per cent of what it moves.
    """
    x, u, w = random_points(prior, np.random.default_rng(seed))
    held = u.T, w.T, prior.p
    flow = rates(prior, x, u, w)
    assert prior.equations.balances, "a prior without balances has none to check"
    for balance in prior.equations.balances:
        residual = balance.residual(x.T, flow.T, *held).full()[0]
        supply, loss = (f(x.T, *held).full()[0] for f in (balance.supply, balance.loss))
        largest = float(np.max(np.abs([supply, loss, supply - loss])))
        stored = balance.residual(x.T, flow.T, *held).full()[0] + supply - loss  # dS/dt
        largest = max(largest, float(np.abs(stored).max()))
        assert largest > 0, "a balance that is always zero tells nothing"
        # dS/dt is a sum itself, of terms that may be larger than it
        slope = ca.SX.sym("x", len(prior.states))
        parts = ca.Function("parts", [slope], [ca.gradient(balance.storage(slope, prior.p), slope)])
        largest = max(largest, float(np.abs(parts(x.T).full() * flow.T).max()))
        worst = float(np.abs(residual).max())
        assert worst <= 64 * EPS * largest, f"{worst:.3g} along the flow, of terms up to {largest:.3g}"
        assert loss.min() >= -64 * EPS * largest, f"loss of {loss.min():.3g}: it must not be negative"
        _check_integral(prior, balance, x[:3], u[:3], w[:3])


def _check_integral(prior: Prior, balance, starts, inputs, disturbances) -> None:
    n_x, seconds = len(prior.states), 0.05
    for x0, u, w in zip(starts, inputs, disturbances, strict=True):

        def motion(_, z, u=u, w=w):
            x = z[:n_x]
            put_in = float(balance.supply(x, u, w, prior.p)) - float(balance.loss(x, u, w, prior.p))
            return [*prior.equations.xdot(x, u, w, prior.p).full()[:, 0], put_in, abs(put_in)]

        end = solve_ivp(motion, (0, seconds), [*x0, 0.0, 0.0], method="DOP853", rtol=1e-10, atol=1e-12).y[
            :, -1
        ]
        change = float(balance.storage(end[:n_x], prior.p)) - float(balance.storage(x0, prior.p))
        size = max(end[-1], abs(float(balance.storage(x0, prior.p))), 1e-300)
        assert abs(change - end[n_x]) <= 1e-6 * size, f"{change:.6g} stored, {end[n_x]:.6g} put in"
