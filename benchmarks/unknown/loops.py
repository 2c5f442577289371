"""Closed loops on true plants: what a new user gets, the trials, and what a loop costs."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from hybrid_mpc import OCP, DataSpec, Disturbance, HybridModel, Prior, Scenario, Trajectory, fit_prior
from hybrid_mpc.check.first_model import CLOSED, Runs, feedback_of, first_lag, growth_of, slowest
from hybrid_mpc.check.new import HORIZONS, first_limits
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.data.scales import robust_spread, time_unit
from hybrid_mpc.estimate.switching import Filter
from hybrid_mpc.estimate.tuning import process_noise
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.kit.assembly import make_controller, make_estimator, tuned_noise
from hybrid_mpc.kit.disturbances import default_disturbances
from hybrid_mpc.loop.loop import Loop
from unknown.common import Array, quantised
from unknown.plants import Plant
from unknown.rivals import FILTERS, INTEGRAL, TIGHT, Point, Regulator, Rival, Simc, simc_models

Choice = Callable[[HybridModel, OCP], "tuple[Disturbance, ...] | None"]
OFF, LOAD = (0.2, 0.1, 0.05), 0.2
"""Share by which each parameter of a plant is off, the next one only where no draw of the one before can hold its
set-points; share of the room to an input's limit that the load at it takes."""
HELD, LEAST, HOLDS = 6, 300, 3
"""Horizons that a set-point is held, as the trials of a kit's promises last, and periods at least; set-points of a
trial."""
END = 0.3
"""Share of a hold at its end over which offset and scatter count: the mean of fewer periods is that of the noise."""
INSIDE, MARGIN = 0.3, 0.05
"""Share of the recorded range that set-points keep away from its ends, and inputs that hold them from their limits."""
OFFSET, SCATTER = 1.0, 5.0
"""Largest offset, and largest scatter about it, in standard deviations of the sensor: as in a kit's promises."""
DRAWS = 60
"""Draws of set-points, parameters and loads at most. From half of them on inputs are drawn, and set-points are what the
plant makes of them: some machines can hold little of what was recorded."""
TUNED_FROM, TUNED = 1000, 2
"""First seed of the loops on the prior by which a rival's free number is chosen, and how many there are."""
TRIED = 4
"""Seeds that are tried at most, over those that are wanted: of some no draw can hold its set-points."""


@dataclass(frozen=True)
class Made:
    """What a new user gets of a machine's recordings.

    Args:
        scenario: Prior, recordings and control problem.
        model: The fitted prior as the loop's model.
        fit: The fit.
        noise: Process noise ``(n_x,)`` of the observer, and of a filter without loads.
        held: Places of the controlled outputs.
        span: Recorded range of the outputs, ``(2, n_y)``.
        w: Measured disturbances ``(n_w,)`` of all trials.
    """

    scenario: Scenario
    model: HybridModel
    fit: PriorFit
    noise: tuple[Array, Array]
    held: tuple[int, ...]
    span: Array
    w: Array

    @property
    def control(self) -> OCP:
        """The control problem."""
        assert self.scenario.control is not None
        return self.scenario.control

    @cached_property
    def sigma(self) -> Array:
        """The sensors' noise ``(n_y,)``."""
        return np.array(self.scenario.sensor_sigma)

    @cached_property
    def prior(self) -> Plant:
        """The fitted prior as a plant."""
        return of_model(self)

    def loop(self) -> Rival:
        """The tool's own loop."""
        return Own(Loop(*self.parts), self.held)

    @cached_property
    def parts(self) -> tuple[Filter, SafeController]:
        """Observer and controller, which keep nothing from one loop to the next."""
        observer = make_estimator(self.model, self.scenario, self.noise[0], self.control)
        return observer, make_controller(self.model, self.model, self.control)


class Own:
    """The tool's loop behind the rivals' interface."""

    def __init__(self, loop: Loop, held: Sequence[int]) -> None:
        self.loop, self._held = loop, list(held)

    def _goal(self, goal: Array) -> Array:
        row = np.full(self.loop.model.n_y, np.nan)
        row[self._held] = goal
        return np.nan_to_num(row)[None]

    def start(self, y: Array, w: Array, goal: Array) -> Array:
        """The first input."""
        return self.loop.start(y, w, reference=self._goal(goal))

    def step(self, y: Array, w: Array, goal: Array) -> Array:
        """The next one."""
        return self.loop.step(y, w, reference=self._goal(goal))


def first_problem(prior: Prior, train: Sequence[Trajectory], dt: float, held: Sequence[int]) -> OCP:
    """The control problem that ``hybrid-mpc new`` proposes for recordings, with weights on held outputs alone."""
    y, u = (np.concatenate([getattr(t, key) for t in train]) for key in "yu")
    runs = [Runs(t.y, np.hstack([t.u, t.w]) if prior.disturbances else t.u) for t in train]
    lags = [first_lag(runs, i, dt, u.shape[1]) for i in range(y.shape[1])]
    pace, _ = slowest(lags, dt * min(len(t.t) for t in train))
    horizon = min(max(round(2 * pace / dt), HORIZONS[0]), HORIZONS[1])
    spans = [np.nanmax(v, axis=0) - np.nanmin(v, axis=0) for v in (y, u)]
    weights = np.zeros(y.shape[1])
    weights[list(held)] = (0.05 * spans[0][list(held)]) ** -2
    commanded = [Runs(t.y, t.u) for t in train]
    growth = growth_of(commanded, dt) if feedback_of(commanded) > CLOSED else 0.0
    limits = np.array([first_limits((float(np.nanmin(v)), float(np.nanmax(v))), growth) for v in u.T])
    return OCP(
        horizon, np.zeros(len(prior.states)), np.zeros(u.shape[1]), (0.1 * spans[1]) ** -2, limits[:, 0],
        limits[:, 1], q_y=weights, preview=False,
    )  # fmt: skip


def made(
    name: str, make: type[Prior], spec: DataSpec, train: Sequence[Trajectory], valid: Sequence[Trajectory],
    length: float, sigma: Sequence[float], held: Sequence[int], control: OCP | None = None,
    choice: Choice = default_disturbances,
) -> Made:  # fmt: skip
    """Fit the prior, and make what a run makes of it: model, control problem, process noise.

    ``control`` is the control problem. Default: the one that is proposed for the recordings. ``choice`` gives the
    disturbance model of the fitted prior in it.
    """
    fit = fit_prior(make, train, valid, dt=spec.dt, length=length)
    phy, known = make(fit.values), smoothed(make, fit, train, spec.dt)
    info = replace(
        model_info(phy, spec.dt, fit.covariance(phy.parameters)), input_delay=fit.delay,
        time_unit=time_unit(train, spec.dt),
        state_spread=tuple(robust_spread(c) for c in np.concatenate([t.x for t in known]).T),
        output_spread=tuple(robust_spread(c) for c in np.concatenate([t.y for t in known]).T),
    )  # fmt: skip
    programs = prior_programs(phy, spec.dt, fit.substeps)
    model = build_model("prior", {f"prior/{key}": v for key, v in programs.items()}, info)
    control = first_problem(phy, train, spec.dt, held) if control is None else control
    scenario = Scenario(
        name, name, "", prior=make, data=spec, control=control,
        sensor_sigma=tuple(sigma),
    )  # fmt: skip
    model = replace(model, disturbance_model=choice(model, control))
    errors = process_noise(model, known)
    noise = tuple(tuned_noise(model, scenario, errors, known, observer=own) for own in (True, False))
    y = np.concatenate([t.y for t in train])
    span = np.array([np.nanmin(y, axis=0), np.nanmax(y, axis=0)])
    return Made(scenario, model, fit, (noise[0], noise[1]), tuple(held), span, model.w)


@dataclass(frozen=True)
class Trial:
    """One seed: set-points, loads, a plant with parameters off, and where it starts.

    Args:
        seed: Its number, of the sensors' noise too.
        goals: Set-points ``(holds, n_held)``.
        load: What is added to the inputs ``(n_u,)``.
        p: The plant's parameters.
        start: Its first state.
        u: Input ``(n_u,)`` that holds that.
        off: Share by which its parameters are off.
    """

    seed: int
    goals: Array
    load: Array
    p: Any
    start: Array
    u: Array
    off: float


def steady(plant: Plant, p: Any, held: Sequence[int], goal: Array, w: Array, x: Array, u: Array,
           ends: tuple[Array, Array], size: Array) -> tuple[Array, Array] | None:  # fmt: skip
    """State and input at which a plant's held outputs ``held`` are a set-point; None where none is found.

    Args:
        plant: The plant.
        p: Its parameters.
        held: Places of the outputs.
        goal: Set-point ``(n_held,)``.
        w: Measured disturbances.
        x: State to begin at.
        u: Input to begin at; of several the nearest is taken.
        ends: Limits of the inputs ``(n_u,)``.
        size: Tolerated deviations ``(n_held,)``.
    """
    n, scale = len(x), ends[1] - ends[0]
    pace = np.maximum(np.abs(plant.rates(x + 1e-3 * (1 + np.abs(x)), u + 0.1 * scale, w, p)), 1e-9)

    def lack(v: Array) -> Array:
        rates = plant.rates(v[:n], v[n:], w, p) / pace
        off = plant.measure(v[:n])[list(held)] - goal
        return np.concatenate([rates, off / size, 1e-6 * (v[n:] - u) / scale])

    try:
        found = least_squares(
            lack, np.concatenate([x, np.clip(u, ends[0] + 1e-3 * scale, ends[1] - 1e-3 * scale)]), x_scale="jac",
            xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=60,
            bounds=[np.concatenate([np.full(n, s * np.inf), v]) for s, v in zip((-1, 1), ends, strict=True)],
        )  # fmt: skip
    except ValueError:  # not finite
        return None
    if not np.max(np.abs(found.fun[: n + len(goal)])) < 1e-4:
        return None
    return found.x[:n], found.x[n:]


def answer(plant: Plant, p: Any, held: Sequence[int], w: Array, x: Array, u: Array, scale: Array) -> Array:
    """Held outputs at the steady state of an input ``(n_u,)``; NaN where none is found."""
    pace = np.maximum(np.abs(plant.rates(x + 1e-3 * (1 + np.abs(x)), u + 0.1 * scale, w, p)), 1e-9)
    found = least_squares(
        lambda v: plant.rates(v, u, w, p) / pace, x, x_scale="jac", xtol=1e-14, ftol=1e-14, max_nfev=60
    )
    sound = np.max(np.abs(found.fun)) < 1e-4
    return plant.measure(found.x)[list(held)] if sound else np.full(len(held), np.nan)


def slow_gain(plant: Plant, p: Any, held: Sequence[int], w: Array, x: Array, u: Array, rate: float) -> Array:
    """How held outputs answer to inputs ``(n_held, n_u)`` at a slow growth ``rate`` [1/s], by differences."""

    def slopes(f: Callable[[Array], Array], at: Array) -> Array:
        steps = 1e-5 * (1e-3 + np.abs(at))
        return np.array(
            [(f(at + h) - f(at - h)) / (2 * s) for h, s in zip(np.diag(steps), steps, strict=True)]
        ).T

    a = slopes(lambda v: plant.rates(v, u, w, p), x)
    b = slopes(lambda v: plant.rates(x, v, w, p), u)
    return np.asarray(slopes(plant.measure, x)[list(held)] @ np.linalg.solve(rate * np.eye(len(x)) - a, b))


def trials_of(name: str, plant: Plant, own: Made, first: int, number: int) -> list[Trial]:
    """So many trials from a first seed on; seeds without a draw that fits are left out.

    Raises:
        RuntimeError: If there are fewer.
    """
    found: list[Trial] = []
    for seed in range(first, first + TRIED * number):
        trial = drawn(name, plant, own, seed)
        found += [] if trial is None else [trial]
        if len(found) == number:
            return found
    raise RuntimeError(
        f"{name}: {len(found)} of {number} trials whose set-points can be held within the limits"
    )


def drawn(name: str, plant: Plant, own: Made, seed: int) -> Trial | None:
    """A trial; set-points, parameters and loads are drawn until the machine can hold what it is asked to. None: no draw
    fits.

    That is: the inputs can, within their limits and with the load; and the outputs answer to the inputs in the long run
    as those of the prior do. Of a machine that answers the other way round no controller of the prior holds an output
    without offset (Grosdidier, Morari and Holt, *Closed-loop properties from steady-state gain information*, 1985).
    """
    rng = np.random.default_rng([zlib.crc32(name.encode()), seed])
    c, held, prior = own.control, list(own.held), own.prior
    low, high = own.span[:, held]
    scale, size, ends = c.u_max - c.u_min, 1.0 / np.sqrt(c.q_y[held]), (c.u_min, c.u_max)
    x, u = np.array(plant.start, dtype=float), np.clip(own.model.u0, c.u_min, c.u_max)
    rate, names = 0.01 / (c.horizon * own.model.dt), list(plant.parameters)
    inside = INSIDE * (high - low)
    for off in OFF:
        for draw in range(DRAWS):
            signs, ways = rng.choice((-1.0, 1.0), len(names)), rng.choice((-1.0, 1.0), len(u))
            factors = dict(zip(names, 1 + off * signs, strict=True))
            p = SimpleNamespace(**{k: v * factors[k] for k, v in plant.parameters.items()})
            goals = rng.uniform(low + inside, high - inside, (HOLDS, len(held)))
            if 2 * draw >= DRAWS:
                asked = rng.uniform(c.u_min + INSIDE * scale, c.u_max - INSIDE * scale, (HOLDS, len(u)))
                goals = np.array([answer(plant, p, held, own.w, x, one, scale) for one in asked])
                if not (np.all(goals >= low) and np.all(goals <= high)):
                    continue
            found = []
            for goal in goals:
                at = steady(plant, p, held, goal, own.w, x, u, ends, size)
                if at is None:
                    break
                found.append(at)
            if len(found) < HOLDS:
                continue
            inputs = np.array([at[1] for at in found])
            load = (
                LOAD * ways * np.where(ways > 0, inputs.min(axis=0) - c.u_min, c.u_max - inputs.max(axis=0))
            )
            needed = np.vstack([inputs, inputs - load])
            fits = np.all((needed > c.u_min + MARGIN * scale) & (needed < c.u_max - MARGIN * scale))
            if fits and all(
                _answers_alike(prior, plant, p, own, at, goal, rate)
                for at, goal in zip(found, goals, strict=True)
            ):
                return Trial(seed, goals, load, p, *found[0], off)
    return None


def _answers_alike(
    prior: Plant, plant: Plant, p: Any, own: Made, at: tuple[Array, Array], goal: Array, rate: float
) -> bool:
    """Whether a plant at rest answers in the long run as the prior does at the same set-point."""
    c, held = own.control, list(own.held)
    size, ends = 1.0 / np.sqrt(c.q_y[held]), (c.u_min, c.u_max)
    there = steady(prior, prior.p, held, goal, own.w, own.model.x0, own.model.u0, ends, size)
    x, u = (own.model.x0, own.model.u0) if there is None else there
    ours, theirs = (
        slow_gain(prior, prior.p, held, own.w, x, u, rate),
        slow_gain(plant, p, held, own.w, *at, rate),
    )
    return bool(np.linalg.det(theirs @ np.linalg.pinv(ours)) > 0)


@dataclass(frozen=True)
class Ran:
    """A loop: true outputs ``(n, n_y)`` without noise, inputs ``(n, n_u)``, set-points ``(n, n_held)``; cost per second
    of time, its parts of errors and of inputs, and offsets and scatter at the ends of the holds ``(holds, n_held)``, in
    standard deviations of the sensors.
    """

    y: Array
    u: Array
    goals: Array
    cost: float
    error: float
    offset: Array
    scatter: Array

    @property
    def settled(self) -> bool:
        """Whether it ends every hold within the noise."""
        return bool(np.all(np.abs(self.offset) <= OFFSET) and np.all(self.scatter <= SCATTER))


def ran(plant: Plant, own: Made, trial: Trial, rival: Rival) -> Ran:
    """A loop of a controller on a plant with loads."""
    rng = np.random.default_rng([trial.seed, 7])
    dt = own.model.dt
    steps = max(1, math.ceil(dt / plant.longest - 1e-9))
    h, periods = dt / steps, max(HELD * own.control.horizon, LEAST)
    sigma, step = np.array(plant.sigma), np.array(plant.step)
    low, high = own.control.u_min, own.control.u_max

    def measured(x: Array) -> Array:
        y = plant.measure(x) + sigma * rng.standard_normal(len(sigma))
        return np.where(step > 0, quantised(y, np.where(step > 0, step, 1.0)), y)

    def moved(x: Array, u: Array, p: Any) -> Array:
        for _ in range(steps):
            k1 = plant.rates(x, u, own.w, p)
            k2 = plant.rates(x + h / 2 * k1, u, own.w, p)
            k3 = plant.rates(x + h / 2 * k2, u, own.w, p)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + plant.rates(x + h * k3, u, own.w, p))
        return x

    x, ys, us = trial.start.copy(), [], []
    with np.errstate(all="ignore"):
        for k in range(HOLDS * periods):
            goal = trial.goals[k // periods]
            y = measured(x)
            u = rival.start(y, own.w, goal) if k == 0 else rival.step(y, own.w, goal)
            ys.append(plant.measure(x))
            us.append(u)
            acting = np.clip(u, low, high) + trial.load
            x = plant.advance(x, acting, own.w, trial.p) if plant.advance else moved(x, acting, trial.p)
            if not np.all(np.isfinite(x)) or np.any(np.abs(x) > 1e6 * (1 + np.abs(trial.start))):
                break
    return judged(own, trial, np.array(ys), np.array(us), periods)


def judged(own: Made, trial: Trial, y: Array, u: Array, periods: int) -> Ran:
    """What a loop costs; one that ran away costs infinitely much."""
    held, c = list(own.held), own.control
    goals = np.repeat(trial.goals, periods, axis=0)
    whole = len(y) == len(goals) and bool(np.all(np.isfinite(y)) and np.all(np.isfinite(u)))
    n = len(held)
    if not whole:
        away = np.full((HOLDS, n), np.inf)
        return Ran(y, u, goals[: len(y)], math.inf, math.inf, away, away)
    error = y[:, held] - goals
    moves = np.diff(u, axis=0, prepend=u[:1])
    missed = float(np.mean(error**2 @ c.q_y[held]))
    late = error.reshape(HOLDS, periods, n)[:, -round(END * periods) :]
    sigma = own.sigma[held]
    cost = missed + float(np.mean(moves**2 @ c.r_delta))
    return Ran(y, u, goals, cost, missed, late.mean(axis=1) / sigma, late.std(axis=1) / sigma)


def of_model(own: Made) -> Plant:
    """The fitted prior as a plant, with parameters that may be moved."""
    m = own.model
    values = {one.name: one.value for one in m.parameters}
    names, empty = list(values), np.zeros(m.n_h)

    def rates(x: Array, u: Array, w: Array, p: Any) -> Array:
        return m.xdot(x, empty, u, w, [getattr(p, name) for name in names]).full().ravel()

    def measure(x: Array) -> Array:
        return m.output(x, m.u0, m.w, m.p).full().ravel()

    def advance(x: Array, u: Array, w: Array, p: Any) -> Array:
        return m.step(x, empty, u, w, [getattr(p, name) for name in names])[0].full().ravel()

    return Plant(
        rates, measure, values, tuple(m.x0), own.scenario.sensor_sigma, (0.0,) * m.n_y, m.dt, advance
    )


def tuned_rival(name: str, own: Made) -> tuple[Callable[[], Rival], str]:
    """The rival that suits a machine by rule, its free number chosen in loops on the fitted prior; and what it is."""
    prior, c, held = own.prior, own.control, list(own.held)
    ends, size = (c.u_min, c.u_max), 1.0 / np.sqrt(c.q_y[held])
    middle = own.span[:, held].mean(axis=0)
    nominal = prior.p

    def at(goal: Array) -> tuple[Array, Array]:
        found = steady(prior, nominal, held, goal, own.w, own.model.x0, own.model.u0, ends, size)
        return (own.model.x0, own.model.u0) if found is None else found

    point = Point(own.model, *at(middle), own.w)
    pairs, why = simc_models(point, held, c.horizon * own.model.dt)
    tries: list[tuple[str, Callable[[], Rival]]] = []
    if pairs:
        for tight in TIGHT:
            for derivative in (False, True) if any(lags.quick > 0 for _, lags in pairs) else (False,):
                kind = "PID" if derivative else "PI"

                def one(tight: float = tight, derivative: bool = derivative) -> Rival:
                    return Simc(point, pairs, held, c.u_min, c.u_max, tight, derivative)

                tries.append((f"SIMC {kind}, {tight:g} delays", one))
    else:
        for share, factor in [(s, f) for s in INTEGRAL for f in FILTERS]:

            def two(share: float = share, factor: float = factor) -> Rival:
                seconds = share * c.horizon * own.model.dt
                return Regulator(point, c, held, at, factor * own.noise[1], own.sigma, seconds)

            tries.append((f"LQR ({why}), {share:g} horizons, noise {factor:g}", two))
    trials = trials_of(f"{name} prior", prior_of_signs(prior, own), own, TUNED_FROM, TUNED)
    costs = []
    for _, make in tries:
        try:
            costs.append(float(np.mean([min(ran(prior, own, one, make()).cost, 1e12) for one in trials])))
        except np.linalg.LinAlgError:
            costs.append(math.inf)
    best = int(np.argmin(costs))
    return tries[best][1], tries[best][0]


def prior_of_signs(prior: Plant, own: Made) -> Plant:
    """The prior as a plant of which :func:`drawn` moves the free parameters alone."""
    free = {one.name for one in own.model.parameters if not one.fixed}
    fixed = {k: v for k, v in prior.parameters.items() if k not in free}

    def rates(x: Array, u: Array, w: Array, p: Any) -> Array:
        for key, value in fixed.items():
            setattr(p, key, value)
        return prior.rates(x, u, w, p)

    def advance(x: Array, u: Array, w: Array, p: Any) -> Array:
        assert prior.advance is not None
        for key, value in fixed.items():
            setattr(p, key, value)
        return prior.advance(x, u, w, p)

    return replace(prior, rates=rates, advance=advance)


Machines = Mapping[str, Plant]
