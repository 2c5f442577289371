"""Rivals of the tool's loops, designed on the same fitted prior: PI(D) by SIMC, and LQR with integral action.

Which of the two a machine gets is decided by :func:`simc_models` before any loop runs: PI(D) where every paired
transfer function of the linearized prior has a model of lags and a delay (no unstable pole, one integrator at most,
damping 0.5 at least) and the relative gains of the pairing lie within 0.5 and 2; the regulator everywhere else.

The rule's free number (SIMC's closed-loop time constant with PI or PID; the regulator's integral time with the noise of
its Kalman filter) is the one of a grid that costs least in loops on the fitted prior with parameters 20 % off and
loads: the rival knows of both.

Sources: Skogestad, *Simple analytic rules for model reduction and PID controller tuning*, J. Process Control 13 (2003);
Bristol, *On a new measure of interaction*, IEEE TAC 11 (1966); Anderson and Moore, *Optimal Control* (1990), ch. 4.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import eig, solve_discrete_are

from hybrid_mpc import OCP, HybridModel
from hybrid_mpc.model.model import output_with_jacobian
from unknown.common import Array

DAMPED = 0.5
"""Least damping of a pair of poles that two equal lags stand for."""
INTERACTS = (0.5, 2.0)
"""Relative gains within which one loop hardly notices the others."""
TIGHT = (1.0, 3.0, 9.0, 27.0, 81.0)
"""Closed-loop time constants of SIMC, over the effective delay."""
INTEGRAL = (0.1, 0.3, 1.0)
"""Integral times of the regulator, over the horizon."""
FILTERS = (1.0, 5.0, 25.0)
"""Factors on the process noise of its Kalman filter."""
FILTERED = 10.0
"""A derivative's time over that of its filter."""


class Rival(Protocol):
    """A controller that the benchmark runs: ``start`` with the first sample, then ``step`` each period."""

    def start(self, y: Array, w: Array, goal: Array) -> Array:
        """The first input ``(n_u,)``."""
        ...

    def step(self, y: Array, w: Array, goal: Array) -> Array:
        """The next one."""
        ...


class Lags(NamedTuple):
    """``gain e^(-delay s) / ((slow s + 1)(quick s + 1))``, or ``gain / s`` in place of the slow lag where that is
    infinite.
    """

    gain: float
    slow: float
    quick: float
    delay: float


@dataclass(frozen=True)
class Point:
    """The fitted prior at rest: state, input, disturbances, and its continuous linearization."""

    model: HybridModel
    x: Array
    u: Array
    w: Array

    @property
    def rates(self) -> tuple[Array, Array, Array]:
        """``A``, ``B`` of the rates and ``C`` of the outputs."""
        import casadi as ca

        m = self.model
        x, u = ca.MX.sym("x", m.n_x), ca.MX.sym("u", m.n_u)
        rate = m.xdot(x, np.zeros(m.n_h), u, self.w, m.p)
        slopes = ca.Function("slopes", [x, u], [ca.jacobian(rate, x), ca.jacobian(rate, u)])
        a, b = (v.full() for v in slopes(self.x, self.u))
        return a, b, output_with_jacobian(m)(self.x, self.u, self.w)[1].full()

    @property
    def periods(self) -> tuple[Array, Array, Array]:
        """The same of a period."""
        m = self.model
        assert m.with_jacobian is not None
        _, _, a, b = (v.full() for v in m.with_jacobian(self.x, np.zeros(m.n_h), self.u, self.w, m.p))
        return a, b, output_with_jacobian(m)(self.x, self.u, self.w)[1].full()


def lags_of(a: Array, b: Array, c: Array, dt: float) -> Lags | None:
    """The half rule: a model of two lags and a delay of one transfer function; None where there is none."""
    pencil, n = np.block([[a, b[:, None]], [c[None], np.zeros((1, 1))]]), len(a)
    found = eig(pencil, np.diag([*np.ones(n), 0.0]), right=False)
    zeros = [z for z in found[np.isfinite(found)].tolist() if abs(z) < 1e3 / dt]
    poles = np.linalg.eigvals(a).tolist()
    size = max(abs(p) for p in poles)
    for zero in list(zeros):
        near = min(poles, key=lambda p: abs(p - zero), default=None)
        if near is not None and abs(near - zero) < 1e-4 * max(abs(near), 1e-3 * size):
            zeros.remove(zero)
            poles.remove(near)
    still = [p for p in poles if abs(p) < 1e-6 * size]
    moving = [p for p in poles if abs(p) >= 1e-6 * size]
    slack = [-p.real / abs(p) for p in moving]
    if len(still) > 1 or any(v < DAMPED for v in slack):
        return None
    # the gain at low frequencies, of s G(s) with an integrator
    at = 1e-4j * min((abs(v) for v in (*moving, *zeros)), default=1.0)
    value = complex((c @ np.linalg.solve(at * np.eye(len(a)) - a, b)) * (at if still else 1.0))
    gain, lags = float(value.real), sorted((1 / abs(p) for p in moving), reverse=True)
    delay = 0.5 * dt + sum(1 / z.real for z in zeros if z.real > 0)
    for lead in sorted((-1 / z.real for z in zeros if z.real < 0), reverse=True):
        gain *= _cancelled(lead, lags, delay)
    slow = math.inf if still else lags.pop(0) if lags else 0.5 * dt
    quick = lags[0] + (0.5 * lags[1] if len(lags) > 1 else 0.0) if lags else 0.0
    return Lags(gain, slow, quick, delay + (0.5 * lags[1] if len(lags) > 1 else 0.0) + sum(lags[2:]))


def _cancelled(lead: float, lags: list[float], delay: float) -> float:
    """Skogestad's rules T1 to T3: the factor on the gain by which ``lead s + 1`` and a lag, which changes, cancel."""
    larger = min((lag for lag in lags if lag >= lead), default=math.inf)
    smaller = max((lag for lag in lags if lag < lead), default=0.0)
    if math.isinf(larger) or (smaller > 0 and lead / smaller < min(larger / lead, 1.6)):
        if smaller > 0:
            lags.remove(smaller)
        return lead / max(smaller, delay) if lead >= delay else 1.0
    lags.remove(larger)
    if lead >= 5 * delay:
        return lead / larger
    short = min(larger, 5 * delay)
    if short > lead:
        lags.append(short - lead)
        lags.sort(reverse=True)
    return short / larger


def relative_gains(point: Point, held: Sequence[int], seconds: float) -> Array:
    """Bristol's relative gains ``(n_held, n_u)`` at a frequency well below the loops', where integrators count too."""
    a, b, c = point.rates
    g = c[list(held)] @ np.linalg.solve(2j * math.pi / (20 * seconds) * np.eye(len(a)) - a, b)
    return np.asarray((g * np.linalg.pinv(g).T).real)


def simc_models(point: Point, held: Sequence[int], seconds: float) -> tuple[list[tuple[int, Lags]], str]:
    """Input and lags of each held output, paired by relative gains; or nothing, and why."""
    a, b, c = point.rates
    if np.max(np.linalg.eigvals(a).real) > 1e-6 * np.abs(np.linalg.eigvals(a)).max():
        return [], "unstable"
    gains = relative_gains(point, held, seconds)
    ways = itertools.permutations(range(point.model.n_u), len(held))
    pairs = min(ways, key=lambda way: sum(abs(gains[i, j] - 1) for i, j in enumerate(way)))
    own = [float(gains[i, j]) for i, j in enumerate(pairs)]
    if not all(INTERACTS[0] <= v <= INTERACTS[1] for v in own):
        return [], f"coupled: relative gain {min(own):.2f} to {max(own):.2f}"
    found = []
    for place, j in zip(held, pairs, strict=True):
        lags = lags_of(a, b[:, j], c[place], point.model.dt)
        if lags is None:
            return [], "more than one integrator, or poles with little damping"
        found.append((j, lags))
    return found, ""


class Simc:
    """PI(D) of each pair by SIMC, in series form, derivative of the measurement through a filter.

    Args:
        point: Where the bias is taken.
        pairs: Input and lags of each held output.
        held: Places of the outputs.
        low: Lower limits of the inputs.
        high: Upper ones.
        tight: Closed-loop time constant over the effective delay.
        derivative: Whether the quick lag is cancelled by a derivative; without, half of it goes to the delay.
    """

    def __init__(
        self, point: Point, pairs: Sequence[tuple[int, Lags]], held: Sequence[int], low: Array, high: Array,
        tight: float, derivative: bool,
    ) -> None:  # fmt: skip
        self._u0, self._pairs, self._held, self._dt = point.u, pairs, list(held), point.model.dt
        self._low, self._high, self._gains = low, high, list[tuple[float, float, float]]()
        for _, lags in pairs:
            slow, delay, lead = lags.slow, lags.delay, lags.quick
            if not derivative:  # the half rule once more
                slow, delay, lead = slow + 0.5 * lead, delay + 0.5 * lead, 0.0
            wait = (1.0 + tight) * delay
            speed = 1.0 / lags.gain if math.isinf(slow) else slow / lags.gain
            self._gains.append((speed / wait, min(slow, 4.0 * wait), lead))

    def start(self, y: Array, w: Array, goal: Array) -> Array:
        """The first input: the bias, and what the error asks for."""
        self._integral = np.zeros(len(self._pairs))
        self._slow = y[self._held].copy()
        return self.step(y, w, goal)

    def step(self, y: Array, w: Array, goal: Array) -> Array:
        """The next one; an integral stops where its input is at a limit and the error pushes on."""
        u = self._u0.copy()
        for i, ((j, _), (gain, reset, lead)) in enumerate(zip(self._pairs, self._gains, strict=True)):
            seen = y[self._held[i]]
            error = goal[i] - seen
            slope = 0.0
            if lead > 0:
                filtered = max(lead / FILTERED, self._dt)
                self._slow[i] += -math.expm1(-self._dt / filtered) * (seen - self._slow[i])
                slope = lead * (seen - self._slow[i]) / filtered
            wanted = self._u0[j] + gain * (error - slope) + self._integral[i]
            moved = gain * error * self._dt / reset
            if not ((wanted > self._high[j] and moved > 0) or (wanted < self._low[j] and moved < 0)):
                self._integral[i] += moved
            u[j] = min(max(wanted, self._low[j]), self._high[j])
        return u


class Regulator:
    """LQR of state, last input and integrals of errors, about the prior's steady state of the set-point; a Kalman
    filter with the gain of its steady covariance, which predicts by the prior's own equations.

    Args:
        point: Where it is linearized.
        control: Weights and limits.
        held: Places of the outputs.
        targets: ``goal -> (x, u)``, the prior's steady states.
        sigma_x: Process noise ``(n_x,)`` a period.
        sigma_y: The sensors' noise ``(n_y,)``.
        integral: Integral time [s].
    """

    def __init__(
        self, point: Point, control: OCP, held: Sequence[int], targets: Callable[[Array], tuple[Array, Array]],
        sigma_x: Array, sigma_y: Array, integral: float,
    ) -> None:  # fmt: skip
        m, (a, b, c) = point.model, point.periods
        n_x, n_u, n_c = m.n_x, m.n_u, len(held)
        own, dt = c[list(held)], m.dt
        f = np.block([
            [a, b, np.zeros((n_x, n_c))],
            [np.zeros((n_u, n_x)), np.eye(n_u), np.zeros((n_u, n_c))],
            [dt * own, np.zeros((n_c, n_u)), np.eye(n_c)],
        ])  # fmt: skip
        g = np.vstack([b, np.eye(n_u), np.zeros((n_c, n_u))])
        weight = control.q_y[list(held)]
        q = np.zeros((len(f), len(f)))
        q[:n_x, :n_x] = own.T @ np.diag(weight) @ own
        q[n_x + n_u :, n_x + n_u :] = np.diag(weight / integral**2)
        # a free input and a mode that nothing weighs must still come back
        q += 1e-9 * np.diag([*np.full(n_x, np.trace(q[:n_x, :n_x]) / n_x), *control.r_delta, *np.zeros(n_c)])
        r = np.diag(control.r_delta)
        p = solve_discrete_are(f, g, q, r)
        self._gain = np.linalg.solve(r + g.T @ p @ g, g.T @ p @ f)
        noise = np.diag(np.maximum(sigma_x, 1e-9 * np.abs(point.x).max()) ** 2)
        cov = solve_discrete_are(a.T, c.T, noise, np.diag(sigma_y**2))
        self._kalman = cov @ c.T @ np.linalg.inv(c @ cov @ c.T + np.diag(sigma_y**2))
        self._m, self._point, self._targets, self._held = m, point, targets, list(held)
        self._low, self._high = control.u_min, control.u_max
        self._sizes = n_x, n_u
        self._goal: Array = np.zeros(0)

    def start(self, y: Array, w: Array, goal: Array) -> Array:
        """The first input."""
        self._x, self._u, self._sum = self._point.x.copy(), self._point.u.copy(), np.zeros(len(self._held))
        return self._decide(y, w, goal)

    def step(self, y: Array, w: Array, goal: Array) -> Array:
        """The next one; integrals stop while an input is at a limit."""
        m = self._m
        self._x = m.step(self._x, np.zeros(m.n_h), self._u, w, m.p)[0].full().ravel()
        return self._decide(y, w, goal)

    def _decide(self, y: Array, w: Array, goal: Array) -> Array:
        m = self._m
        self._x = self._x + self._kalman @ (y - m.output(self._x, self._u, w, m.p).full().ravel())
        if not np.array_equal(goal, self._goal):
            self._goal, self._to = goal, self._targets(goal)
        z = np.concatenate([self._x - self._to[0], self._u - self._to[1], self._sum])
        wanted = self._u - self._gain @ z
        self._u = np.clip(wanted, self._low, self._high)
        if np.array_equal(wanted, self._u):
            self._sum = self._sum + m.dt * (y[self._held] - goal)
        return self._u
