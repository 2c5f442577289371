"""Priors that nobody wrote: random graphs of +, products, sin, exp, sqrt and |.|, with recordings made from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from hybrid_mpc import Parameter, Prior, Signal, Trajectory

Array = NDArray[np.float64]
DT, SAMPLES, SUBSTEPS = 0.05, 300, 4
ROLES = ("train", "train", "train", "valid", "test")
GROWTH = 2.0
"""Largest rate at which an unstable one may grow [1/s]."""
REACH = 30.0
"""Largest value of a state; what goes beyond is drawn again."""


@dataclass(frozen=True)
class Drawn:
    """A random prior with recordings: ``truth`` are the parameters that made them."""

    prior: type[Prior]
    truth: Mapping[str, float]
    stable: bool
    train: tuple[Trajectory, ...]
    valid: tuple[Trajectory, ...]
    test: tuple[Trajectory, ...]
    length: float


def drawn(seed: int) -> Drawn:
    """The random prior of a seed: the first draw whose recordings stay within bounds."""
    rng = np.random.default_rng([seed, 77])
    while True:
        found = _draw(rng, seed)
        if found is not None:
            return found


def _draw(rng: np.random.Generator, seed: int) -> Drawn | None:
    n_x, n_u, n_p = int(rng.integers(2, 9)), int(rng.integers(1, 3)), int(rng.integers(2, 7))
    n_y, stable = int(rng.integers(1, min(n_x, 3) + 1)), bool(rng.random() < 0.6)
    coefficients: list[float] = []

    def number(low: float, high: float, signed: bool = True) -> int:
        value = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        coefficients.append(value * (float(rng.choice([-1.0, 1.0])) if signed else 1.0))
        return len(coefficients) - 1

    decay = [number(0.3, 3.0, False) for _ in range(n_x)]
    chain = [number(0.5, 2.0) for _ in range(n_x)]
    inputs = [(int(rng.integers(0, n_x)), j, number(0.5, 2.0)) for j in range(n_u)]
    terms = [
        (i, number(0.2, 1.5), _graph(rng, n_x, n_u, int(rng.integers(1, 4))))
        for i in range(n_x) if rng.random() < 0.6
    ]  # fmt: skip
    feedback = None if stable else (0, n_x - 1, number(1.0, 6.0, False))
    outputs = [n_x - 1, *(int(i) for i in rng.permutation(n_x - 1)[: n_y - 1])]

    def rates(x: Any, u: Any, c: Any) -> list[Any]:
        own = [-c[decay[i]] * x[i] + c[chain[i]] * (x[i - 1] if i else u[0]) for i in range(n_x)]
        for i, j, k in inputs[1:]:
            own[i] = own[i] + c[k] * u[j]
        for i, k, graph in terms:
            own[i] = own[i] + c[k] * graph(x, u)
        if feedback is not None:
            i, j, k = feedback
            own[i] = own[i] + c[k] * x[j] * float(np.prod(np.sign([coefficients[q] for q in chain[1:]])))
        return own

    fitted = sorted(int(i) for i in rng.choice(len(coefficients), min(n_p, len(coefficients)), replace=False))
    truth = {f"p{i}": coefficients[i] for i in fitted}
    nominal = {name: value / (1 + rng.uniform(-0.5, 0.5)) for name, value in truth.items()}

    def of(p: Any) -> list[Any]:
        return [getattr(p, f"p{i}") if i in fitted else coefficients[i] for i in range(len(coefficients))]

    x, u = ca.SX.sym("x", n_x), ca.SX.sym("u", n_u)
    rate = ca.vertcat(*rates(ca.vertsplit(x), ca.vertsplit(u), coefficients))
    h, after = DT / SUBSTEPS, x
    f = ca.Function("f", [x, u], [rate])
    for _ in range(SUBSTEPS):
        k1 = f(after, u)
        k2 = f(after + h / 2 * k1, u)
        k3 = f(after + h / 2 * k2, u)
        after = after + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(after + h * k3, u))
    period = ca.Function("period", [x, u], [after])
    slope = ca.Function("slope", [x, u], [ca.jacobian(rate, x), ca.jacobian(rate, u)])
    a, b = (v.full() for v in slope(np.zeros(n_x), np.zeros(n_u)))
    if not np.isfinite(a).all() or not np.isfinite(b).all():
        return None
    growth = float(np.linalg.eigvals(a).real.max())
    if stable == (growth > -0.05) or growth > GROWTH:
        return None
    gain = np.zeros((n_u, n_x)) if stable else _regulator(a, b)
    if gain is None:
        return None
    runs = []
    for _ in range(5):
        own = _record(rng, period, gain, n_x, n_u)
        if own is None:
            return None
        runs.append(own)
    states = np.concatenate([r[0] for r in runs])
    spread = states.std(0)
    if (spread < 0.02).any():
        return None
    noise = 10.0 ** rng.uniform(-3, -1.3)
    signals = tuple(
        Signal(f"x{i}", "-", float(lo - 2 * s), float(hi + 2 * s))
        for i, (lo, hi, s) in enumerate(zip(states.min(0), states.max(0), spread, strict=True))
    )
    limit = float(np.abs(np.concatenate([r[1] for r in runs])).max())

    def xdot(self: Prior, x: Any, u: Any, w: Any, p: Any) -> tuple[Any, ...]:
        return tuple(rates(x, u, of(p)))

    prior = type(f"Random{seed}", (Prior,), {
        "states": signals,
        "inputs": tuple(Signal(f"u{j}", "-", -limit, limit) for j in range(n_u)),
        "outputs": tuple(signals[i] for i in outputs),
        "parameters": tuple(
            Parameter(name, v, "-", *sorted((v / 5, 5 * v))) for name, v in nominal.items()
        ),
        "xdot": xdot,
    })  # fmt: skip
    nothing = np.full((SAMPLES, n_x), np.nan)
    made = [
        Trajectory(
            f"run{i}", role, DT, DT * np.arange(SAMPLES), inputs,
            states[:, outputs] + noise * spread[outputs] * rng.standard_normal((SAMPLES, len(outputs))),
            nothing, nothing,
        )
        for i, (role, (states, inputs)) in enumerate(zip(ROLES, runs, strict=True))
    ]  # fmt: skip
    length = 5.0 if growth <= 0 else min(5.0, np.log(30.0) / growth)
    return Drawn(prior, truth, stable, tuple(made[:3]), tuple(made[3:4]), tuple(made[4:]), float(length))


Graph = Callable[[Any, Any], Any]


def _graph(rng: np.random.Generator, n_x: int, n_u: int, depth: int) -> Graph:
    """A tree of operations over states and inputs."""
    if depth == 0:
        i = int(rng.integers(0, n_x + n_u))
        return (lambda x, u: x[i]) if i < n_x else (lambda x, u: u[i - n_x])
    kind = rng.choice(["+", "*", "sin", "exp", "sqrt", "abs"])
    a = _graph(rng, n_x, n_u, depth - 1)
    if kind in ("+", "*"):
        b = _graph(rng, n_x, n_u, int(rng.integers(0, depth)))
        return (lambda x, u: a(x, u) + b(x, u)) if kind == "+" else (lambda x, u: 0.3 * a(x, u) * b(x, u))
    return {
        "sin": lambda x, u: ca.sin(a(x, u)),
        "exp": lambda x, u: ca.exp(-0.3 * ca.fabs(a(x, u))),
        "sqrt": lambda x, u: ca.sqrt(ca.fabs(a(x, u)) + 1e-3),
        "abs": lambda x, u: ca.fabs(a(x, u)),
    }[str(kind)]


def _regulator(a: Array, b: Array) -> Array | None:
    n_x, n_u = b.shape
    step = expm(DT * np.block([[a, b], [np.zeros((n_u, n_x + n_u))]]))
    ad, bd = step[:n_x, :n_x], step[:n_x, n_x:]
    try:
        p = solve_discrete_are(ad, bd, np.eye(n_x), np.eye(n_u))
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(np.linalg.solve(np.eye(n_u) + bd.T @ p @ bd, bd.T @ p @ ad))


def _record(
    rng: np.random.Generator, period: ca.Function, gain: Array, n_x: int, n_u: int
) -> tuple[Array, Array] | None:
    """States and inputs of a recording; none if it leaves what is bounded."""
    x, states, inputs = 0.3 * rng.standard_normal(n_x), [], []
    push = np.zeros(n_u)
    for k in range(-60, SAMPLES):
        if k % 12 == 0:
            push = rng.uniform(-1.5, 1.5, n_u)
        u = push - gain @ x
        if k >= 0:
            states.append(x)
            inputs.append(u)
        x = period(x, u).full()[:, 0]
        if not np.isfinite(x).all() or np.abs(x).max() > REACH:
            return None
    return np.array(states), np.array(inputs)
