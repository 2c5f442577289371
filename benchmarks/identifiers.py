"""What `identification.py` compares: the library's way from recordings to a model, and those of others.

Each is a function ``(problem, watch, seed)``. It identifies a model from ``problem.train`` (``problem.valid`` may
choose), and lets ``watch`` look at what it has whenever it has something; the clock stands still meanwhile. It ends
when ``watch`` raises ``Over``, or when it is done.

The rivals get what the library gets: the same recordings, the same prior (the scalar operations of its equations, in
numpy or in jax), the delay of the input as a parameter, the same bounds and the same first values.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import torch
from scipy.optimize import least_squares

from hybrid_mpc import Prior, Scenario, TrainingSettings, Trajectory, fit_prior
from hybrid_mpc.identify.delay import lost_samples
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.simulation import MAX_SUBSTEPS, required_substeps
from hybrid_mpc.identify.train import TrainingRun
from hybrid_mpc.workflow.benchmark_runs import run_freely
from nn_export.expressions import scalar_steps

Array = np.ndarray
Runs = Sequence[Trajectory]
Predict = Callable[[Runs], list[Array]]
"""Outputs ``(n, n_y)`` of free runs behind the warm-up of each run."""
GROWTH, LEAST = 1.3, 0.2
"""A method is looked at when its time has grown by this factor and this much [s]."""
BUDGETS = (2.0, 5.0, 15.0, 60.0)
"""Processor times [s] that are compared."""
SOON = tuple(0.95 * b for b in BUDGETS)
"""Times [s] at which a method is looked at in any case: shortly before each budget."""


class Over(Exception):
    """The time of a method is over."""


@dataclass(frozen=True)
class Problem:
    """A machine, its recordings by their roles, and the runs that judge, of which ``warm`` periods are given."""

    scenario: Scenario
    dt: float
    warm: int
    train: tuple[Trajectory, ...]
    valid: tuple[Trajectory, ...]
    valid_runs: tuple[Trajectory, ...]
    test_runs: tuple[Trajectory, ...]
    length: float | None
    largest_delay: float
    settings: Mapping[str, Any]
    """Of the networks of the library."""
    scale: float = 1.0

    def error(self, runs: Runs, outputs: Sequence[Array]) -> float:
        """Root mean square of the first output's error behind the warm-up; infinite where a run diverged."""
        square = [y_hat[:, 0] - t.y[self.warm + 1 :, 0] for t, y_hat in zip(runs, outputs, strict=True)]
        found = self.scale * float(np.sqrt(np.mean(np.concatenate(square) ** 2)))
        return found if math.isfinite(found) else math.inf


@dataclass
class Watch:
    """A method's clock, processor time, and what its model was worth when it was looked at."""

    problem: Problem
    limit: float
    points: list[tuple[float, float, float]] = field(default_factory=list)
    """Seconds, error on validation runs, error on test runs."""
    compiling: float = 0.0
    _started: float = field(default_factory=time.process_time)
    _next: float = 0.0

    @property
    def seconds(self) -> float:
        """Processor time of the method."""
        return time.process_time() - self._started

    @property
    def due(self) -> bool:
        """Whether it is time to look."""
        return self.seconds >= self._next

    def look(self, *candidates: Predict) -> float:
        """Judge the model; of several ways to run it that which validates best. Gives the validation error.

        Raises:
            Over: If the time is over.
        """
        now, p = self.seconds, self.problem
        with np.errstate(all="ignore"):
            errors = [p.error(p.valid_runs, predict(p.valid_runs)) for predict in candidates]
            valid, best = min(errors), candidates[int(np.argmin(errors))]
            test = p.error(p.test_runs, best(p.test_runs))
        self.points.append((now, valid, test))
        self._next = min(GROWTH * now + LEAST, *(b for b in SOON if b > now), math.inf)
        self._started += self.seconds - now
        if now >= self.limit:
            raise Over
        return valid

    def at(self, budget: float) -> float | None:
        """Test error of the model that validates best of all so far; None if there is none yet."""
        known = [(valid, test) for seconds, valid, test in self.points if seconds <= budget]
        return min(known)[1] if known else None


# The library.


def hybrid_mpc(problem: Problem, watch: Watch, seed: int) -> None:
    """The prior's fit, then a stack of PGRNNs around it."""
    p, make, dt = problem, problem.scenario.prior, problem.dt
    fit = fit_prior(make, p.train, p.valid, dt=dt, length=p.length, largest_delay=p.largest_delay)
    prior = make(fit.values)
    freely = partial(run_freely, prior, fit, warm_up=p.warm * dt, length=None)

    def predict(name: str, networks: Mapping[str, Any], runs: Runs) -> list[Array]:
        return [run.y_hat[name] for run in freely(networks, runs)]

    watch.look(partial(predict, "phy", {}))
    train, valid = (smoothed(make, fit, part, dt) for part in (p.train, p.valid))
    warm = max(1, p.warm - lost_samples(fit.delay, dt))
    settings = TrainingSettings(kind="pgrnn", seed=seed, warm=warm, **p.settings)
    run = TrainingRun(prior, train, valid, settings)
    while not run.over:  # as hybrid_mpc.train does
        if run.done in (0, settings.teacher_steps):
            run.enter_stage()
        for _ in range(min(settings.every, run.stage_end - run.done)):
            run.update()
        run.evaluate()
        if watch.due or run.over:
            networks = {"pgrnn": run.result()}
            watch.look(partial(predict, "pgrnn", networks))


# The prior in numpy and in jax.


def operators(xp: ModuleType) -> dict[int, Callable[..., Any]]:
    """What stands for CasADi's scalar operations in numpy, or what is called alike."""
    names = (
        "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "sinh", "cosh", "tanh", "sign", "floor", "ceil",
        "hypot", "fmin", "fmax", "copysign",
    )  # fmt: skip
    same = {getattr(ca, f"OP_{name.upper()}"): getattr(xp, name) for name in names}
    return same | {
        ca.OP_ASSIGN: lambda a: a, ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b,
        ca.OP_MUL: lambda a, b: a * b, ca.OP_DIV: lambda a, b: a / b, ca.OP_NEG: lambda a: -a,
        ca.OP_TWICE: lambda a: a + a, ca.OP_SQ: lambda a: a * a, ca.OP_INV: lambda a: 1.0 / a,
        ca.OP_POW: xp.power, ca.OP_CONSTPOW: xp.power, ca.OP_FABS: xp.abs, ca.OP_ASIN: xp.arcsin,
        ca.OP_ACOS: xp.arccos, ca.OP_ATAN: xp.arctan, ca.OP_ATAN2: xp.arctan2,
        ca.OP_LT: lambda a, b: 1.0 * (a < b), ca.OP_LE: lambda a, b: 1.0 * (a <= b),
        ca.OP_EQ: lambda a, b: 1.0 * (a == b), ca.OP_NE: lambda a, b: 1.0 * (a != b),
        ca.OP_NOT: lambda a: 1.0 * (a == 0),
        ca.OP_AND: lambda a, b: 1.0 * ((a != 0) & (b != 0)), ca.OP_OR: lambda a, b: 1.0 * ((a != 0) | (b != 0)),
        ca.OP_IF_ELSE_ZERO: lambda a, b: xp.where(a != 0, b, 0.0),
    }  # fmt: skip


def walked(function: ca.Function, xp: ModuleType) -> Callable[..., list[Any]]:
    """A CasADi function of columns as one of lists of arrays, in numpy or jax: its first output's entries.

    Example:
        >>> x = ca.SX.sym("x", 2)
        >>> walked(ca.Function("f", [x], [x[0] * ca.sin(x[1])]), np)([2.0, np.zeros(3)])
        [array([0., 0., 0.])]
    """
    steps, known = scalar_steps(function, 3000), operators(xp)

    def call(*columns: Sequence[Any]) -> list[Any]:
        slots: dict[int, Any] = {}
        result: list[Any] = [0.0] * function.nnz_out(0)
        for step in steps:
            if step.code == ca.OP_CONST:
                slots[step.given] = step.taken[0]
            elif step.code == ca.OP_INPUT:
                slots[step.given] = columns[step.taken[0]][step.taken[1]]
            elif step.code == ca.OP_OUTPUT:
                result[step.given[1]] = slots[step.taken[0]]
            else:
                slots[step.given] = known[step.code](*(slots[j] for j in step.taken))
        return result

    return call


def repeated(count: int, body: Callable[[int, Any], Any], start: Any) -> Any:
    """What ``body`` makes of ``start``, so many times: a loop of Python."""
    for k in range(count):
        start = body(k, start)
    return start


class GreyBox:
    """A prior as a discrete model in numpy or jax, by Runge-Kutta; free parameters over their sizes, the delay last.

    Arrays are ``(B, n)`` for B runs side by side. The delayed input is a line between two samples of the past.
    ``repeat`` is a loop, that of jax where a step is to be compiled once and not a sub-step after the other.
    """

    def __init__(
        self,
        prior: Prior,
        dt: float,
        largest_delay: float,
        xp: ModuleType,
        repeat: Callable[..., Any] = repeated,
    ) -> None:
        self.prior, self.dt, self.xp, self.repeat = prior, dt, xp, repeat
        self.rate, self.out = walked(prior.equations.xdot, xp), walked(prior.equations.output, xp)
        self.free = [i for i, p in enumerate(prior.parameters) if not p.fixed]
        chosen = [prior.parameters[i] for i in self.free]
        self.size = np.array([abs(p.value) or p.upper - p.lower for p in chosen])
        periods = largest_delay / dt
        late = [periods] if periods else []
        value, low, high = (
            np.array([getattr(p, name) for p in chosen]) for name in ("value", "lower", "upper")
        )
        self.first, self.lower, self.upper = (
            np.append(own / self.size, [share * v for v in late])
            for own, share in ((value, 0.5), (low, 0.0), (high, 1.0))
        )
        self.lags = math.floor(periods) + 2 if late else 1
        self.n_x, self.n_u, self.n_y = len(prior.states), len(prior.inputs), len(prior.outputs)
        stiffest = type(prior)({p.name: p.upper for p in chosen})
        self.substeps = min(MAX_SUBSTEPS, max(required_substeps(own, dt) for own in (prior, stiffest)))

    def lagged(self, u: Array) -> Array:
        """Inputs ``(n, n_u)`` with those of the samples before beside them ``(n, lags n_u)``."""
        rows = np.arange(len(u))
        return np.hstack([u[np.maximum(rows - j, 0)] for j in range(self.lags)])

    def point(self, u: Any, theta: Any) -> tuple[list[Any], list[Any], list[Any]]:
        """Inputs that act, no disturbances, and parameters, as lists of entries; ``theta`` ``(n,)`` or ``(n, B)``."""
        p: list[Any] = list(self.prior.p)
        for k, i in enumerate(self.free):
            p[i] = theta[k] * self.size[k]
        acting = [u[..., i] for i in range(self.n_u)]
        if self.lags > 1:
            weights = [
                self.xp.maximum(0.0, 1.0 - self.xp.abs(theta[len(self.free)] - j)) for j in range(self.lags)
            ]
            acting = [
                sum(w * u[..., j * self.n_u + i] for j, w in enumerate(weights)) for i in range(self.n_u)
            ]
        return acting, [], p

    def step(self, x: Any, u: Any, theta: Any) -> Any:
        """The states a period later."""
        held, s = self.point(u, theta), self.dt / self.substeps

        def substep(_: int, columns: list[Any]) -> list[Any]:
            def moved(slopes: list[Any], h: float) -> list[Any]:
                return [c + h * k for c, k in zip(columns, slopes, strict=True)]

            k1 = self.rate(columns, *held)
            k2 = self.rate(moved(k1, s / 2), *held)
            k3 = self.rate(moved(k2, s / 2), *held)
            k4 = self.rate(moved(k3, s), *held)
            return [
                c + s / 6 * (a + 2 * (b + d) + e)
                for c, a, b, d, e in zip(columns, k1, k2, k3, k4, strict=True)
            ]

        return self.xp.stack(self.repeat(self.substeps, substep, [x[..., i] for i in range(self.n_x)]), -1)

    def output(self, x: Any, u: Any, theta: Any) -> Any:
        """The outputs."""
        found = self.out([x[..., i] for i in range(self.n_x)], *self.point(u, theta))
        return self.xp.stack([0.0 * x[..., 0] + y for y in found], -1)

    def run(self, x: Array, u: Array, theta: Array) -> Array:
        """Outputs ``(B, T, n_y)`` of free runs from ``x`` ``(B, n_x)``; lagged inputs ``u`` ``(B, T, lags n_u)``."""
        found = []
        for k in range(u.shape[1]):
            found.append(self.output(x, u[:, k], theta))
            x = self.step(x, u[:, k], theta)
        return np.stack(found, 1)


# Free runs of models without a smoother: the first state is fitted to the warm-up.

Simulate = Callable[[Array, Array], Array]
"""First states ``(B, n_x)`` and inputs ``(B, T, n)`` to outputs ``(B, T, n_y)``."""


def fitted_states(simulate: Simulate, y: Array, u: Array, x: Array, size: Array, steps: int = 8) -> Array:
    """States ``(B, n_x)`` at the first sample that explain ``y`` ``(B, T, n_y)`` best: Levenberg and Marquardt."""
    n, n_x = x.shape

    def left(x: Array) -> Array:
        return np.nan_to_num((simulate(x, u) - y).reshape(len(x), -1), nan=1e6, posinf=1e6, neginf=-1e6)

    error, damping = left(x), np.full(n, 1e-2)
    for _ in range(steps):
        move = 1e-6 * np.diag(size)
        columns = [(left(x + row) - error) / 1e-6 for row in move]
        slope = np.stack(columns, -1)
        normal = slope.swapaxes(1, 2) @ slope
        scale = np.trace(normal, axis1=1, axis2=2)[:, None, None] / n_x + 1e-12
        normal = normal + (damping[:, None, None] * scale + 1e-9) * np.eye(n_x)
        step = np.linalg.solve(normal, slope.swapaxes(1, 2) @ error[..., None])[..., 0]
        tried = x - step * size
        new = left(tried)
        better = (new**2).sum(1) < (error**2).sum(1)
        x, error = np.where(better[:, None], tried, x), np.where(better[:, None], new, error)
        damping = np.clip(np.where(better, 0.2 * damping, 10 * damping), 1e-9, 1e6)
    return x


def predictions(
    simulate: Simulate, inputs: Callable[[Array], Array], guess: Callable[[Trajectory, int], Array], size: Array,
    warm: int, share: float, runs: Runs,
) -> list[Array]:  # fmt: skip
    """Free runs behind the warm-up; the state is fitted to the last ``share`` of it."""
    first = warm - round(share * warm)
    longest = max(len(t.t) for t in runs)

    def padded(values: Array) -> Array:
        return np.concatenate([values, np.repeat(values[-1:], longest - len(values), axis=0)])[first:]

    u, y = (
        np.stack([padded(v) for v in every]) for every in ([inputs(t.u) for t in runs], [t.y for t in runs])
    )
    known = warm + 1 - first
    x = np.stack([guess(t, first) for t in runs])
    x = fitted_states(simulate, y[:, :known], u[:, :known], x, size)
    found = simulate(x, u)
    return [y_hat[known : len(t.t) - first] for t, y_hat in zip(runs, found, strict=True)]


SHARES = (1.0, 0.4)
"""Of the warm-up, to which a rival's state is fitted: validation chooses whenever it is looked at."""


def scipy_grey(problem: Problem, watch: Watch, seed: int) -> None:
    """`scipy.optimize.least_squares` over the prior's parameters and each recording's first state, single shooting.

    Trust region reflective between the prior's bounds from its nominal values; the Jacobian by differences, of all
    directions and all recordings side by side in one pass of numpy.
    """
    box = GreyBox(problem.scenario.prior(), problem.dt, problem.largest_delay, np)
    size = np.std(np.concatenate([t.x for t in problem.train]), axis=0)
    n_p, n_x, n = len(box.first), box.n_x, len(problem.train)
    longest = max(len(t.t) for t in problem.train)
    u, y = np.zeros((n, longest, box.lags * box.n_u)), np.full((n, longest, box.n_y), np.nan)
    for i, t in enumerate(problem.train):
        u[i, : len(t.t)], y[i, : len(t.t)] = box.lagged(t.u), t.y
    spread = np.nanstd(y, axis=(0, 1))

    def errors(x: Array, theta: Array, copies: int = 1) -> Array:
        found = (box.run(x, np.tile(u, (copies, 1, 1)), theta) - np.tile(y, (copies, 1, 1))) / spread
        found = np.nan_to_num(np.clip(found, -1e3, 1e3), nan=0.0)  # where nothing was measured
        return found.reshape(copies, n, -1)

    def split(z: Array) -> tuple[Array, Array]:
        return z[:n_p], z[n_p:].reshape(n, n_x) * size

    def residual(z: Array) -> Array:
        theta, x = split(z)
        return errors(x, theta).ravel()

    def jacobian(z: Array) -> Array:
        theta, x = split(z)
        if watch.due and not np.array_equal(z, start):  # nominal values are no model that was identified
            look(theta)
        h = 1e-6
        directions = n_p + n_x + 1
        thetas, states = np.repeat(theta[:, None], directions, 1), np.repeat(x[None], directions, 0)
        for j in range(n_p):
            thetas[j, j + 1] += h if theta[j] + h <= box.upper[j] else -h
        for j in range(n_x):
            states[n_p + 1 + j, :, j] += h * size[j]
        found = errors(states.reshape(-1, n_x), np.repeat(thetas, n, axis=1), directions)
        slope = (found[1:] - found[0]) / h
        result = np.zeros((found[0].size, n_p + n * n_x))
        for j in range(n_p):
            result[:, j] = slope[j].ravel() * (1 if thetas[j, j + 1] > theta[j] else -1)
        for j in range(n_x):
            for i in range(n):
                rows = slice(i * slope.shape[2], (i + 1) * slope.shape[2])
                result[rows, n_p + i * n_x + j] = slope[n_p + j, i]
        return result

    def look(theta: Array) -> None:
        guess = lambda t, k: t.x[k]  # noqa: E731
        ways = [
            partial(predictions, partial(box.run, theta=theta), box.lagged, guess, size, problem.warm, share)
            for share in SHARES
        ]
        watch.look(*ways)

    low = np.concatenate([box.lower, np.full(n * n_x, -np.inf)])
    high = np.concatenate([box.upper, np.full(n * n_x, np.inf)])
    start = np.concatenate([box.first, np.concatenate([t.x[0] / size for t in problem.train])])
    start = np.clip(start, low + 1e-6, high - 1e-6)
    with np.errstate(all="ignore"):
        found = least_squares(
            residual, start, jac=jacobian, bounds=(low, high), x_scale="jac", xtol=1e-8, ftol=1e-8
        )
        look(found.x[:n_p])


# jax-sysid.


@dataclass(frozen=True)
class JaxSettings:
    """How jax-sysid is used: epochs, and the length [s] that recordings are cut into, each with a state of its own."""

    adam: int
    eta: float
    cut: float
    n_x: int = 0
    neurons: int = 0
    rho_x0: float = 1e-4
    rho_th: float = 1e-4
    chunk: int = 20


def jax_grey(problem: Problem, watch: Watch, seed: int, settings: JaxSettings | None = None) -> None:
    """jax-sysid's `Model` with the prior as its state function, parameters between the prior's bounds."""
    import jax
    import jax.numpy as jnp

    def loop(count: int, body: Callable[[int, Any], Any], start: Any) -> Any:
        start = [jnp.asarray(v) for v in start]
        return jax.lax.fori_loop(0, count, body, start) if count > 1 else body(0, start)

    s = settings or JaxSettings(adam=0, eta=1e-2, cut=5.0, rho_x0=0.0, rho_th=0.0)
    box = GreyBox(problem.scenario.prior(), problem.dt, problem.largest_delay, jnp, loop)
    size = np.std(np.concatenate([t.x for t in problem.train]), axis=0)

    def step(x: Any, u: Any, params: Any) -> Any:
        return box.step(x * size, u, params[0]) / size

    def output(x: Any, u: Any, params: Any) -> Any:
        return box.output(x * size, u, params[0])

    first = lambda t, k: t.x[k] / size  # noqa: E731
    bounds = {"params_min": [jnp.array(box.lower)], "params_max": [jnp.array(box.upper)]}
    _jax_fit(problem, watch, s, step, output, box.lagged, first, box.n_x, [box.first], bounds)


def jax_black(problem: Problem, watch: Watch, seed: int, settings: JaxSettings | None = None) -> None:
    """jax-sysid's residual recurrent network, as its documentation has it: signals scaled, sigmoids."""
    import jax

    s = settings or JaxSettings(adam=1000, eta=1e-3, cut=5.0, n_x=4, neurons=10)
    rng = np.random.default_rng(seed)
    every_u, every_y = (np.concatenate([getattr(t, key) for t in problem.train]) for key in ("u", "y"))
    u_mean, u_std, y_mean, y_std = every_u.mean(0), every_u.std(0), every_y.mean(0), every_y.std(0)
    n_x, n, n_u, n_y = s.n_x, s.neurons, every_u.shape[1], every_y.shape[1]

    sigmoid = jax.nn.sigmoid  # that of the documentation, without its overflow

    def step(x: Any, u: Any, params: Any) -> Any:
        a, b, _, w1, w2, w3, b1, b2, *_ = params
        return x @ a.T + u @ b.T + sigmoid(x @ w1.T + u @ w2.T + b1) @ w3.T + b2

    def output(x: Any, u: Any, params: Any) -> Any:
        c, w4, w5, b3, b4 = params[2], *params[8:]
        return (x @ c.T + sigmoid(x @ w4.T + b3) @ w5.T + b4) * y_std + y_mean

    def normal(scale: float, *shape: int) -> Array:
        return scale * rng.standard_normal(shape)

    params = [
        0.5 * np.eye(n_x), normal(0.1, n_x, n_u), normal(0.1, n_y, n_x), normal(0.1, n, n_x), normal(0.5, n, n_u),
        normal(0.5, n_x, n), np.zeros(n), np.zeros(n_x), normal(0.5, n, n_x), normal(0.5, n_y, n), np.zeros(n),
        np.zeros(n_y),
    ]  # fmt: skip
    zero = lambda t, k: np.zeros(n_x)  # noqa: E731
    _jax_fit(problem, watch, s, step, output, lambda u: (u - u_mean) / u_std, zero, n_x, params, {})


def _jax_fit(
    problem: Problem, watch: Watch, s: JaxSettings, step: Callable[..., Any], output: Callable[..., Any],
    inputs: Callable[[Array], Array], guess: Callable[[Trajectory, int], Array], n_x: int, params: list[Any],
    bounds: Mapping[str, Any],
) -> None:  # fmt: skip
    """`Model.fit`: Adam, then L-BFGS; all windows are one model whose states stand side by side.

    The same sum as jax-sysid's own of a list of experiments, which it scans one after the other: side by side is
    several times as fast. Adam is the package's own, cut into chunks so that it can be looked at.
    """
    import jax
    import jax.numpy as jnp
    import jax_sysid._model as package
    from jax_sysid.models import Model

    jax.config.update("jax_enable_x64", True)
    length = min(round(s.cut / problem.dt), *(len(t.t) for t in problem.train))
    cuts = [(t, k) for t in problem.train for k in range(0, len(t.t) - length + 1, length)]
    u = np.stack([inputs(t.u)[k : k + length] for t, k in cuts], 1)
    y = np.stack([t.y[k : k + length] for t, k in cuts], 1)
    count, n_u, n_y = len(cuts), u.shape[2], y.shape[2]
    spread = y.reshape(-1, n_y).std(0)

    def stacked(f: Callable[..., Any]) -> Callable[..., Any]:
        return lambda x, u, params: f(x.reshape(count, n_x), u.reshape(count, n_u), params).reshape(-1)

    def loss(y_hat: Any, y: Any) -> Any:
        return jnp.sum(((y_hat - y) / jnp.tile(spread, count)) ** 2) / y.shape[0]

    @jax.jit
    def simulate(x: Any, u: Any, params: Any) -> Any:
        def one(x: Any, u: Any) -> Any:
            return step(x, u, params), output(x, u, params)

        return jax.lax.scan(one, x, u.swapaxes(0, 1))[1].swapaxes(0, 1)

    def look(z: Sequence[Any]) -> None:
        own = [np.asarray(v) for v in z[: len(params)]]
        run = lambda x, u: np.asarray(simulate(x, u, own))  # noqa: E731
        ways = [
            partial(predictions, run, inputs, guess, np.ones(n_x), problem.warm, share) for share in SHARES
        ]
        watch.look(*ways)

    def adam(
        gradient: Any, z: Any, epochs: int, eta: float, iprint: int, low: Any = None, high: Any = None
    ) -> Any:
        def one(carry: Any, _: Any) -> Any:
            z, m, v, b1, b2, best, z_best = carry
            value, g = gradient(z)
            m = [0.9 * a + 0.1 * b for a, b in zip(m, g, strict=True)]
            v = [0.99 * a + 0.01 * b**2 for a, b in zip(v, g, strict=True)]
            new = [
                c - eta / (1 - b1) * a / (jnp.sqrt(b / (1 - b2)) + 1e-8)
                for c, a, b in zip(z, m, v, strict=True)
            ]
            if low is not None:
                new = [jnp.clip(c, a, b) for c, a, b in zip(new, low, high, strict=True)]
            z_best = jax.lax.cond(value < best, lambda: z, lambda: z_best)
            return (new, m, v, 0.9 * b1, 0.99 * b2, jnp.minimum(value, best), z_best), value

        chunk = jax.jit(lambda carry: jax.lax.scan(one, carry, None, length=s.chunk)[0])
        zero = [jnp.zeros_like(v) for v in z]
        carry = (
            [jnp.asarray(v) for v in z],
            zero,
            zero,
            jnp.array(0.9),
            jnp.array(0.99),
            jnp.array(jnp.inf),
            list(z),
        )
        spent = []
        for _ in range(math.ceil(epochs / s.chunk)):
            before = watch.seconds
            carry = jax.block_until_ready(chunk(carry))
            spent.append(watch.seconds - before)
            if watch.due:
                look(carry[6])
        watch.compiling += spent[0] - min(spent)
        return list(carry[6]), float(carry[5])

    marks: list[float] = []

    def callback(iterations: int, iprint: int, value: Any) -> Any:
        marks.append(watch.seconds)

        def each(z: Sequence[Any]) -> None:
            marks.append(watch.seconds)
            if len(marks) == 4:
                watch.compiling += marks[1] - marks[0] - (marks[3] - marks[2])
            if watch.due:
                look(z)
                marks[-1] = watch.seconds

        return each, None

    model = Model(count * n_x, count * n_y, count * n_u, state_fcn=stacked(step), output_fcn=stacked(output))
    model.loss(output_loss=loss, rho_x0=s.rho_x0, rho_th=s.rho_th)
    own = dict(bounds)
    if own:
        free = jnp.full(count * n_x, jnp.inf)
        own |= {"x0_min": -free, "x0_max": free}
    model.optimization(adam_epochs=s.adam, adam_eta=s.eta, lbfgs_epochs=1_000_000, iprint=-1, **own)
    model.init(params=params, x0=np.concatenate([guess(t, k) for t, k in cuts]))
    package.adam_solver, package.lbfgs_callback = adam, callback
    model.fit(y.reshape(length, -1), u.reshape(length, -1))
    look(model.params)


# deepSI.


@dataclass(frozen=True)
class SubnetSettings:
    """How deepSI is used; its own defaults where nothing else is said."""

    n_x: int = 10
    past: int = 20
    future: int = 50
    batch: int = 256
    rate: float = 1e-3
    check: int = 5


def subnet(problem: Problem, watch: Watch, seed: int, settings: SubnetSettings | None = None) -> None:
    """SUBNET of deepSI: encoder, state and output networks, trained by Adam on short runs from encoded states."""
    import deepSI
    from nonlinear_benchmarks import Input_output_data

    s = settings or SubnetSettings()
    torch.manual_seed(seed)
    past = min(s.past, problem.warm + 1)
    train, valid = (
        [Input_output_data(u=t.u.astype(np.float32), y=t.y.astype(np.float32)) for t in part]
        for part in (problem.train, problem.valid)
    )
    future = min(s.future, min(len(t.t) for t in problem.train) - past)
    n_u, n_y, norm = deepSI.get_nu_ny_and_auto_norm(train)
    model = deepSI.SUBNET(n_u, n_y, norm, nx=s.n_x, nb=past, na=past)
    known = problem.warm + 1

    def predict(runs: Runs) -> list[Array]:
        longest = max(len(t.t) for t in runs)

        def window(values: Array, first: int, end: int) -> Any:
            rows = np.minimum(np.arange(first, end), len(values) - 1)
            return torch.tensor(values[rows], dtype=torch.float32)

        u, y = (torch.stack([window(getattr(t, k), known - past, known) for t in runs]) for k in ("u", "y"))
        later = torch.stack([window(t.u, known, longest) for t in runs])
        with torch.no_grad():
            found = model(u, y, later).double().numpy()
        return [y_hat[: len(t.t) - known] for t, y_hat in zip(runs, found, strict=True)]

    def validate(net: Any, *arrays: Any) -> Any:
        # deepSI only keeps the best of its own validations; ours decides, so its own costs nothing here
        if watch.due:
            watch.look(predict)
        return torch.tensor(0.0)

    shortest = min(len(d) for d in valid)
    sizes = min(s.batch, sum(max(0, len(t.t) - past - future + 1) for t in problem.train))
    optimizer = torch.optim.Adam(model.parameters(), lr=s.rate)
    deepSI.fit(
        model, train, [d[:shortest] for d in valid], n_its=10_000_000, T=future, batch_size=sizes, val_freq=s.check,
        val_fun=validate, optimizer=optimizer,
    )  # fmt: skip


METHODS: dict[str, Callable[[Problem, Watch, int], None]] = {
    "hybrid-mpc": hybrid_mpc, "least_squares": scipy_grey, "jax-sysid grey": jax_grey, "jax-sysid black": jax_black,
    "SUBNET": subnet,
}  # fmt: skip
DRAWS = {"hybrid-mpc", "jax-sysid black", "SUBNET"}
"""Methods that draw first weights or batches; the others give the same with every seed."""
NEEDS = {"jax-sysid grey": "jax_sysid", "jax-sysid black": "jax_sysid", "SUBNET": "deepSI"}


def watched(problem: Problem, name: str, seed: int, limit: float, **options: Any) -> Watch:
    """A method's run, from the recordings on."""
    watch = Watch(problem, limit)
    with (
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
        contextlib.suppress(Over),
    ):
        METHODS[name](problem, watch, seed, **options)
    return watch
