"""The fitted prior of a benchmark: parameters, the input's delay, and the smoother that starts every free run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor, nn
from torch.func import functional_call

from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.residuals import ParameterFit
from hybrid_mpc.identify.smooth import Smoother, fit_smoother
from hybrid_mpc.identify.step import required_substeps, rk4
from hybrid_mpc.machine.signals import Parameter
from hybrid_mpc.machine.torch_prior import Prior, _named, follows_acceleration

# Inputs that act late: first-order lag as a state of the prior, delay as a queue in the step's state.

TINY = 1e-9
"""Share of a period below which a delay's rest counts as none."""


def with_input_lag(base: type[Prior], lag: Parameter) -> type[Prior]:
    """A prior class whose inputs act through ``T z_dot = u - z``, with ``z`` as states after ``[q, v]``.

    What acts on the machine is ``z``, one for each input, all with the time constant T. The energy balance is the
    machine's with ``z`` as its input. A fit or a free run needs ``z`` at its start: see :func:`lagged`.

    Args:
        base: Prior class.
        lag: Its time constant [s], positive over its whole range.

    Returns:
        A class like ``base``; states are ``base.states`` and ``<input>_acting``.

    Raises:
        InputError: If the time constant may be zero, its name is there already, or ``base`` has a lag.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> slow = with_input_lag(PendulumPrior, Parameter("T_u", 0.02, "s", 0.005, 0.1))()
        >>> [signal.name for signal in slow.states], slow.n_q
        (['phi', 'phi_dot', 'u_acting'], 1)
        >>> x, u = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
        >>> slow(x, u).tolist()
        [0.0, 4.0, 25.0]
    """
    if not lag.lower > 0:
        raise InputError(f"input lag: {lag.label} must be positive, its lower bound is {lag.lower:g}")
    if base.n_extra:
        raise InputError(f"input lag: {base.__name__} has {base.n_extra} states beside [q, v] already")
    if lag.name in [p.name for p in base.parameters_spec]:
        raise InputError(f"input lag: {base.__name__} has a parameter {lag.name} already; name it otherwise")
    n = len(base.states)

    class Lagged(base):  # type: ignore[valid-type,misc]
        states = (*base.states, *(replace(s, name=f"{s.name}_acting") for s in base.inputs))
        parameters_spec = (*base.parameters_spec, lag)
        n_extra = len(base.inputs)
        balance_follows_acceleration = follows_acceleration(base)

        def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
            free: Tensor = super().acceleration(x[..., :n], x[..., n:])
            return free

        def extra_rates(self, x: Tensor, u: Tensor) -> Tensor:
            return (u - x[..., n:]) / getattr(self, lag.name)

        def energy_balance(self, x: Tensor, xdot: Tensor, u: Tensor) -> Tensor:
            balance: Tensor
            if self.balance_follows_acceleration:
                balance = super().energy_balance(x, xdot, u)  # made of this class's acceleration
            else:
                balance = super().energy_balance(x[..., :n], xdot[..., :n], x[..., n:])
            return balance

    return _named(Lagged, base, f"{base.__name__}WithInputLag")


class DelayedStep(nn.Module):
    """Any step whose input acts whole periods later: ``x = [x of the step, waiting inputs, the oldest first]``.

    Args:
        step: ``(x, h, u) -> (x_next, h_next)``, with ``xdot(x, h, u)``: of a prior or of a hybrid.
        n_x: States of the step.
        n_u: Inputs.
        periods: Periods from the decision to the effect, at least 1.

    Raises:
        InputError: If ``periods`` is not a whole number of at least 1.

    Example:
        >>> from hybrid_mpc.identify.step import PriorStep
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> late = DelayedStep(PriorStep(PendulumPrior(), 0.01), n_x=2, n_u=1, periods=2)
        >>> x = torch.zeros(4, dtype=torch.float64)
        >>> x, h = late(x, torch.zeros(0), torch.tensor([3.0], dtype=torch.float64))
        >>> x.tolist()
        [0.0, 0.0, 0.0, 3.0]
    """

    def __init__(self, step: nn.Module, *, n_x: int, n_u: int, periods: int) -> None:
        super().__init__()
        if not isinstance(periods, int) or periods < 1:
            raise InputError(f"delayed step: periods must be a whole number of at least 1, got {periods}")
        self.step, self.n_x, self.n_u = step, n_x, n_u
        self.n_waiting = periods * n_u

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x + periods n_u)`` and next hidden state."""
        own, acting, later = self._parts(x)
        x_next, h_next = self.step(own, h, acting)
        return torch.cat([x_next, later, u], dim=-1), h_next

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the step's own states ``(..., n_x)`` at the instant."""
        own, acting, _ = self._parts(x)
        derivative: Tensor = self.step.xdot(own, h, acting)  # type: ignore[operator]
        return derivative

    def _parts(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        n = self.n_x
        return x[..., :n], x[..., n : n + self.n_u], x[..., n + self.n_u :]


class DelayedPriorStep(nn.Module):
    """The prior as a step whose input acts ``delay`` later, any delay: ``x = [x, waiting inputs, the oldest first]``.

    Within a period the older input acts first, for the rest of the delay over whole periods, then the younger one.
    Both parts are integrated on their own, so the step is as exact as without delay.

    Args:
        prior: The prior.
        dt: Model period [s].
        delay: Of the input [s], positive.

    Raises:
        InputError: If the delay is not positive.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> DelayedPriorStep(PendulumPrior(), 0.01, 0.025).n_waiting
        3
    """

    def __init__(self, prior: Prior, dt: float, delay: float) -> None:
        super().__init__()
        whole, rest = _split(delay, dt)
        self.prior, self.dt, self.rest = prior, dt, rest
        self.substeps = required_substeps(prior, dt)
        self.n_waiting = (whole + (rest > 0)) * len(prior.inputs)

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x + n_waiting)`` and the hidden state as it came."""
        n, n_u = len(self.prior.states), len(self.prior.inputs)
        own, queue = x[..., :n], torch.cat([x[..., n:], u], dim=-1)
        older, younger = queue[..., :n_u], queue[..., n_u : 2 * n_u]
        if self.rest:
            own = rk4(lambda z: self.prior(z, older), own, self.rest, self.substeps)
            own = rk4(lambda z: self.prior(z, younger), own, self.dt - self.rest, self.substeps)
        else:
            own = rk4(lambda z: self.prior(z, older), own, self.dt, self.substeps)
        return torch.cat([own, queue[..., n_u:]], dim=-1), h

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the prior's states ``(..., n_x)`` at the instant, under the input that acts then."""
        derivative: Tensor = self.prior(*self._acting(x))
        return derivative

    def energy_balance(self, x: Tensor, xdot: Tensor, u: Tensor) -> Tensor:
        """The prior's energy balance [W] ``(...)`` with the input that acts at the instant; ``xdot`` ``(..., n_x)``."""
        own, acting = self._acting(x)
        return self.prior.energy_balance(own, xdot, acting)

    def _acting(self, x: Tensor) -> tuple[Tensor, Tensor]:
        n = len(self.prior.states)
        return x[..., :n], x[..., n : n + len(self.prior.inputs)]


def delayed(trajectory: Trajectory, delay: float) -> Trajectory:
    """The trajectory with the inputs that act under a delay: all of the identification then runs as without one.

    A delay of ``m`` periods and a share ``f`` gives ``(1 - f) u_{k-m} + f u_{k-m-1}``, the mean of what acts over the
    period. What acts before the first recorded input has arrived is not known: these samples are left out.

    Args:
        trajectory: Recording with the commanded inputs.
        delay: Of the input [s], positive.

    Raises:
        InputError: If the delay is not positive, or the recording is not longer.

    Example:
        >>> t, z = 0.1 * np.arange(6), np.zeros((6, 1))
        >>> run = Trajectory("run", "train", 0.1, t, np.arange(6.0)[:, None], z, np.zeros((6, 2)), np.zeros((6, 2)))
        >>> delayed(run, 0.15).u.ravel().round(6).tolist(), delayed(run, 0.15).t.round(1).tolist()
        ([0.5, 1.5, 2.5, 3.5], [0.2, 0.3, 0.4, 0.5])
    """
    whole, rest = _split(delay, trajectory.dt)
    share = rest / trajectory.dt
    first = whole + (share > 0)
    n = len(trajectory.t)
    if n <= first + 1:
        raise InputError(f"{trajectory.name}: a delay of {delay:g} s leaves nothing of {n} samples")
    younger = trajectory.u[first - whole : n - whole]
    older = trajectory.u[first - whole - 1 : n - whole - 1] if share > 0 else younger
    kept = trajectory.part(np.arange(n) >= first, trajectory.name, trajectory.role)
    return replace(kept, u=(1 - share) * younger + share * older)


def lagged(trajectory: Trajectory, time_constant: float) -> Trajectory:
    """The trajectory with the lagging inputs as states after ``[q, v]``, exact for inputs held over a period.

    At the start they are taken to have caught up with the first input: an error there fades with the time constant.

    Args:
        trajectory: Recording with the commanded inputs.
        time_constant: Of the lag [s], positive.

    Raises:
        InputError: If the time constant is not positive.

    Example:
        >>> t, u = 0.1 * np.arange(3), np.array([[0.0], [1.0], [1.0]])
        >>> run = Trajectory("run", "train", 0.1, t, u, 0 * u, np.zeros((3, 2)), np.zeros((3, 2)))
        >>> lagged(run, 0.1).x[:, 2].round(4).tolist()
        [0.0, 0.0, 0.6321]
    """
    if not time_constant > 0:
        raise InputError(f"{trajectory.name}: the time constant must be positive, got {time_constant}")
    kept = math.exp(-trajectory.dt / time_constant)
    z = np.empty_like(trajectory.u)
    z[0] = trajectory.u[0]
    for k in range(len(z) - 1):
        z[k + 1] = trajectory.u[k] + kept * (z[k] - trajectory.u[k])
    rates = (trajectory.u - z) / time_constant
    return replace(trajectory, x=np.hstack([trajectory.x, z]), xdot=np.hstack([trajectory.xdot, rates]))


def _split(delay: float, dt: float) -> tuple[int, float]:
    """Whole periods of a delay and what is left [s]."""
    if not (delay > 0 and math.isfinite(delay)):
        raise InputError(f"delay must be positive, got {delay} s; without one use the prior as it is")
    whole = math.floor(delay / dt + TINY)
    rest = delay - whole * dt
    return whole, (rest if rest > TINY * dt else 0.0)


# Output error over long free runs, parameters and the input's delay together, derivatives by differences.
#
# ``fit_prior`` has exact derivatives and takes its free runs from states; here runs of many seconds are compared with
# the measured outputs alone, as the benchmark does, and all perturbed parameters are simulated side by side, which
# makes a
# run of a thousand periods affordable.

Array = NDArray[np.float64]
STEP = 1e-5
"""Of the differences, in nominal sizes: far above rounding (1e-11 after a thousand periods), far below any bend."""
LARGEST = 30.0
"""Errors beyond this many spreads count as much: a run that diverges stays finite."""
AT_BOUND = 1e-3


@dataclass(frozen=True)
class Runs:
    """Free runs to be fitted.

    Args:
        x: First states ``(n, n_x)``.
        u: Commanded inputs ``(n, lead + periods, n_u)``, from ``lead`` samples before the first state on.
        y: Measured outputs after each period ``(n, periods, n_y)``.
        lead: Samples before the first state.
    """

    x: Tensor
    u: Tensor
    y: Tensor
    lead: int


def cut_runs(trajectories: Sequence[Trajectory], periods: int, lead: int, most: int) -> Runs:
    """At most ``most`` free runs of ``periods``, one after the other, evenly chosen.

    Raises:
        InputError: If no trajectory is long enough.

    Example:
        >>> z = np.zeros((50, 1))
        >>> run = Trajectory("run", "train", 0.1, 0.1 * np.arange(50), z, z, np.zeros((50, 2)), np.zeros((50, 2)))
        >>> cut_runs([run], 20, lead=3, most=10).u.shape
        torch.Size([2, 23, 1])
    """
    starts = [
        (t, k) for t in trajectories for k in range(lead, len(t.t) - periods, periods)
    ]  # a run needs the sample after its last period
    if not starts:
        longest = max((len(t.t) for t in trajectories), default=0)
        raise InputError(
            f"no recording is long enough: the longest has {longest} samples, a free run of {periods} periods with "
            f"{lead} samples before it needs {periods + lead + 1}"
        )
    chosen = [
        starts[i]
        for i in np.unique(np.linspace(0, len(starts) - 1, min(most, len(starts))).round().astype(int))
    ]
    x = np.stack([t.x[k] for t, k in chosen])
    u = np.stack([t.u[k - lead : k + periods] for t, k in chosen])
    y = np.stack([t.y[k + 1 : k + periods + 1] for t, k in chosen])
    return Runs(torch.tensor(x), torch.tensor(u), torch.tensor(y), lead)


class OutputErrorFit:
    """A prior's free parameters and its input's delay, over their nominal sizes, and their fit.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        dt: Model period [s].
        largest_delay: Longest delay [s]; zero: there is none.
    """

    def __init__(self, make: Callable[..., Prior], dt: float, largest_delay: float = 0.0) -> None:
        self.make, self.dt, self.largest = make, dt, largest_delay
        own = ParameterFit(make, dt)
        self.prior, self.free, self._own = own.prior, own.free, own
        late = [1.0] if largest_delay else []
        self.unit = np.concatenate([own.unit, [dt * one for one in late]])
        self.nominal = np.concatenate([own.nominal, [0.5 * largest_delay / dt for _ in late]])
        self.lower = np.concatenate([own.lower, [0.0 for _ in late]])
        self.upper = np.concatenate([own.upper, [largest_delay / dt for _ in late]])

    @property
    def lead(self) -> int:
        """Samples before a run's first state that its delayed inputs may need."""
        return int(np.ceil(self.largest / self.dt)) + 1 if self.largest else 0

    def values(self, theta: Array) -> dict[str, float]:
        """Values [SI] of all parameters by name."""
        return self._own.values(theta[: len(self.free)])

    def delay(self, theta: Array) -> float:
        """Delay [s]."""
        return float(theta[-1] * self.dt) if self.largest else 0.0

    def errors(self, thetas: Array, runs: Runs) -> Array:
        """Errors of the outputs ``(m, n, periods, n_y)`` [output unit] of ``m`` sets of parameters."""
        sets = torch.tensor(thetas * self.unit)
        values = {p.name: sets[:, i].reshape(-1, 1, 1) for i, p in enumerate(self.free)}
        substeps = required_substeps(self.make(self.values(thetas[0])), self.dt)
        inputs = self._acting(sets[:, -1], runs) if self.largest else runs.u[None, :, runs.lead :]
        x, out = runs.x.expand(len(thetas), *runs.x.shape), []
        with torch.no_grad():
            for k in range(runs.y.shape[1]):
                u = inputs[:, :, k].expand(len(thetas), -1, -1)
                x = rk4(lambda z, u=u: functional_call(self.prior, values, (z, u)), x, self.dt, substeps)  # type: ignore[misc]
                out.append(x)
            states = torch.stack(out, 2)
            error = self.prior.output(states, inputs.expand(len(thetas), -1, -1, -1)) - runs.y
        return np.nan_to_num(error.numpy(), nan=np.inf, posinf=np.inf, neginf=-np.inf)

    def rmse(self, theta: Array, runs: Runs) -> float:
        """Root mean square error of the outputs [output unit]."""
        return float(np.sqrt(np.mean(np.square(self.errors(theta[None], runs)))))

    def fit(self, start: Array, runs: Runs, evaluations: int, *, robust: bool) -> tuple[Array, Array]:
        """Fit from ``start``.

        Args:
            start: First ``theta``.
            runs: What is fitted.
            evaluations: Most simulations.
            robust: Soft absolute values instead of squares, for runs from starts that are far off.

        Returns:
            ``theta`` and the Jacobian of the residuals over their standard deviation.
        """
        spread = runs.y.reshape(-1, runs.y.shape[-1]).std(0).clamp_min(1e-12).numpy()

        def residuals(thetas: Array) -> Array:
            scaled = np.clip(self.errors(thetas, runs) / spread, -LARGEST, LARGEST)
            return scaled.reshape(len(thetas), -1)

        def jacobian(theta: Array) -> Array:
            side = np.where(theta + STEP > self.upper, -STEP, STEP)
            every = residuals(np.vstack([theta[None], theta + np.diag(side)]))
            return ((every[1:] - every[0]) / side[:, None]).T

        result: Any = least_squares(
            lambda theta: residuals(theta[None])[0],
            np.clip(start, self.lower + 1e-6, self.upper - 1e-6),
            jac=jacobian,
            bounds=(self.lower, self.upper),
            loss="soft_l1" if robust else "linear",
            f_scale=0.1,
            max_nfev=evaluations,
        )
        noise = np.sqrt(max(float(np.mean(residuals(result.x[None]) ** 2)), 1e-30))
        return result.x, jacobian(result.x) / noise

    def result(self, theta: Array, slope: Array, stages: Sequence[dict[str, Any]]) -> PriorFit:
        """Values with standard errors; the delay counts among what is fitted, it is no parameter of the prior."""
        _, singular, rows = np.linalg.svd(slope, full_matrices=False)
        covariance = (rows.T / np.maximum(singular, 1e-12 * singular[0]) ** 2) @ rows
        sizes = np.sqrt(np.diag(covariance))
        names = [p.name for p in self.free]
        near = np.minimum(theta - self.lower, self.upper - theta) < AT_BOUND * (self.upper - self.lower)
        warnings = tuple(f"{p.label} ends at a bound" for p, hit in zip(self.free, near, strict=False) if hit)
        correlations = {
            f"{names[i]}, {names[j]}": float(covariance[i, j] / (sizes[i] * sizes[j]))
            for i in range(len(names))
            for j in range(i + 1, len(names))
        }
        errors = {name: float(sizes[i] * self.unit[i]) for i, name in enumerate(names)}
        return PriorFit(self.values(theta), errors, warnings, tuple(stages), correlations)

    def _acting(self, delays: Tensor, runs: Runs) -> Tensor:
        """Inputs ``(m, n, periods, n_u)`` that act under each delay, means over each period."""
        parts, n = [], runs.y.shape[1]
        for delay in (delays / self.dt).tolist():
            whole = int(np.floor(delay))
            share, first = delay - whole, runs.lead - whole
            younger, older = runs.u[:, first : first + n], runs.u[:, first - 1 : first - 1 + n]
            parts.append((1 - share) * younger + share * older)
        return torch.stack(parts)


STAGES = ((1.0, 15, 48), (5.0, 10, 48))
"""Free runs from polynomially smoothed states: length [the machine's seconds], most simulations, most runs."""
LAST = (12, 40)
"""The last stage's, over the benchmark's own length from states that the fitted prior has smoothed."""
NONE = 0.05
"""Share of a period below which a delay counts as none."""
Report = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Physics:
    """The fitted prior.

    Args:
        fit: Parameters and what is known of their confidence.
        delay: Delay of the input [s], zero for none.
        sigma: Standard deviation of the measurement that the smoother assumes [output unit].
        walk: Standard deviation of the unexplained acceleration's change per period.
    """

    fit: PriorFit
    delay: float
    sigma: tuple[float, ...]
    walk: tuple[float, ...]

    def smoother(self, prior: Prior, dt: float) -> Smoother:
        """The smoother around the fitted prior."""
        return Smoother(prior, dt, self.sigma, self.walk)


def fit_physics(
    make: Callable[..., Prior],
    train: Sequence[Trajectory],
    valid: Sequence[Trajectory],
    *,
    dt: float,
    length: float,
    largest_delay: float = 0.0,
    on_progress: Report = lambda done, total, text: None,
) -> Physics:
    """Fit parameters and delay to longer and longer free runs; the last ones start from states smoothed by the prior.

    All stages compete on free runs over training and validation pieces, in the length that judges: a handful of
    parameters follows no noise, and where friction drifts a short validation part alone misleads.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        train: Training pieces.
        valid: Validation pieces: nothing is fitted to them.
        dt: Model period [s].
        length: Length [s] of the longest free runs.
        largest_delay: Longest delay searched for [s]. Default: zero, none is searched.
        on_progress: ``(done, total, text)``.
    """
    fit = OutputErrorFit(make, dt, largest_delay)
    theta, total, unit = fit.nominal, len(STAGES) + 1, time_unit(train, dt)
    found: list[tuple[str, Any, Any]] = []
    for i, (own_seconds, evaluations, most) in enumerate(STAGES):
        seconds = unit * own_seconds
        if _periods(train, min(seconds, length), dt, fit.lead) < 2:
            continue
        on_progress(i, total, f"free runs of {min(seconds, length):g} s")
        runs = cut_runs(train, _periods(train, min(seconds, length), dt, fit.lead), fit.lead, most)
        theta, slope = fit.fit(theta, runs, evaluations, robust=True)
        found.append((f"free runs of {seconds:g} s", theta, slope))
    delay = _delay(fit.delay(theta), dt)
    smoother = fit_smoother(make(fit.values(theta)), [*shifted(train, delay), *shifted(valid, delay)], dt)
    starts, others = (with_states(part, smoother, delay) for part in (train, valid))
    on_progress(total - 1, total, "the longest free runs")
    runs = cut_runs(starts, _periods(starts, length, dt, fit.lead), fit.lead, LAST[1])
    theta, slope = fit.fit(theta, runs, LAST[0], robust=False)
    found.append((f"free runs of {length:g} s at most", theta, slope))
    judges = [runs, cut_runs(others, _periods(others, length, dt, fit.lead), fit.lead, LAST[1])]
    scores = [_together([fit.rmse(theta, judge) for judge in judges], judges) for _, theta, _ in found]
    best = int(np.argmin(scores))
    stages = [{"stage": f[0], "validation_error": s} for f, s in zip(found, scores, strict=True)]
    _, theta, slope = found[best]
    delay = _delay(fit.delay(theta), dt)
    smoother = fit_smoother(make(fit.values(theta)), [*shifted(train, delay), *shifted(valid, delay)], dt)
    return Physics(fit.result(theta, slope, stages), delay, smoother.sigma, smoother.walk)


def smoothed(
    make: Callable[..., Prior], physics: Physics, trajectories: Sequence[Trajectory], dt: float
) -> list[Trajectory]:
    """Trajectories with the inputs that act and the states that the fitted prior smooths: what networks train on."""
    return physics.smoother(make(physics.fit.values), dt).smooth(shifted(trajectories, physics.delay))


def with_states(trajectories: Sequence[Trajectory], smoother: Smoother, delay: float) -> list[Trajectory]:
    """Trajectories with smoothed states but the inputs as they were commanded, without the samples a delay costs."""
    made = []
    for t, s in zip(trajectories, smoother.smooth(shifted(trajectories, delay)), strict=True):
        lost = len(t.t) - len(s.t)
        kept = t.part(np.arange(len(t.t)) >= lost, t.name, t.role)
        made.append(Trajectory(t.name, t.role, t.dt, kept.t, kept.u, kept.y, s.x, s.xdot))
    return made


def shifted(trajectories: Sequence[Trajectory], delay: float) -> list[Trajectory]:
    """Trajectories with the inputs that act; as they are without a delay."""
    return [delayed(t, delay) for t in trajectories] if delay else list(trajectories)


def lost_samples(delay: float, dt: float) -> int:
    """Samples at the start of a trajectory whose acting input is not known.

    Example:
        >>> lost_samples(0.0, 0.025), lost_samples(0.025, 0.025), lost_samples(0.03, 0.025)
        (0, 1, 2)
    """
    return math.ceil(delay / dt - 1e-6)


def _together(errors: Sequence[float], parts: Sequence[Runs]) -> float:
    """Root mean square over several parts."""
    sizes = [part.y.numel() for part in parts]
    return float(np.sqrt(np.average(np.square(errors), weights=sizes)))


def _delay(delay: float, dt: float) -> float:
    return delay if delay >= NONE * dt else 0.0


def _periods(trajectories: Sequence[Trajectory], length: float, dt: float, lead: int) -> int:
    """Periods of a run: the length asked for, or what the longest trajectory has."""
    return min(round(length / dt), max((len(t.t) for t in trajectories), default=0) - lead - 1)
