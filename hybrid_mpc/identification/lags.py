"""Inputs that act late: first-order lag as a state of the prior, delay as a queue in the step's state."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.friction import _named, follows_acceleration
from hybrid_mpc.identification.step import required_substeps, rk4
from hybrid_mpc.physics import Prior
from hybrid_mpc.signals import Parameter

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
        >>> from hybrid_mpc.identification.step import PriorStep
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
