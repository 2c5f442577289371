"""Models as steps: the prior alone, the hybrid step, and the paper's literal form.

The hybrid step has exact kinematics, prior plus learned correction of the acceleration, Runge-Kutta. In the literal
form the network gives the whole derivative of the state and explicit Euler integrates it. One code for training (any
batch) and for export (one sample).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, vmap

from hybrid_mpc.errors import InputError
from hybrid_mpc.machine.torch_prior import Prior

# Runge-Kutta of order 4 in torch, and the sub-steps that a model's stiffness asks for.

MAX_SUBSTEPS = 20
"""A prior stiffer than this many Runge-Kutta sub-steps a period can follow needs another dt."""


def rk4(f: Callable[[Tensor], Tensor], x: Tensor, dt: float, substeps: int) -> Tensor:
    """Classical Runge-Kutta of order 4 for ``xdot = f(x)`` over ``dt`` in equal sub-steps.

    Example:
        >>> x = rk4(lambda x: -x, torch.ones(1, dtype=torch.float64), 0.1, 2)
        >>> abs(x.item() - math.exp(-0.1)) < 1e-8
        True
    """
    s = dt / substeps
    for _ in range(substeps):
        k1 = f(x)
        k2 = f(x + 0.5 * s * k1)
        k3 = f(x + 0.5 * s * k2)
        k4 = f(x + s * k3)
        x = x + (s / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    return x


def required_substeps(prior: Prior, dt: float) -> int:
    """Sub-steps a period that keep every eigenvalue of the prior at rest within 1 / sub-step.

    Friction is steepest at rest; Runge-Kutta of order 4 is stable up to 2.8 and accurate to per cents
    of the fast mode at 1.

    Raises:
        InputError: If more than ``MAX_SUBSTEPS`` would be needed.
    """
    return substeps_for(prior, len(prior.states), len(prior.inputs), dt, f"{type(prior).__name__}: the prior")


def substeps_for(f: Callable[[Tensor, Tensor], Tensor], n_x: int, n_u: int, dt: float, name: str) -> int:
    """:func:`required_substeps` of any ``xdot = f(x, u)``; ``name`` says in the error what is too stiff.

    Raises:
        InputError: If more than ``MAX_SUBSTEPS`` would be needed.
    """
    zeros = torch.zeros(n_x, dtype=torch.float64)
    u = torch.zeros(n_u, dtype=torch.float64)
    slope = torch.func.jacrev(lambda x: f(x, u))(zeros)
    rate = float(torch.linalg.eigvals(slope).abs().max())
    substeps = max(1, math.ceil(rate * dt))
    if not math.isfinite(rate) or substeps > MAX_SUBSTEPS:
        raise InputError(
            f"{name}'s fastest mode at rest is {rate:.3g} 1/s; a period of {dt} s "
            f"would need {substeps} sub-steps (at most {MAX_SUBSTEPS}). Smooth its friction (lower the slope "
            f"at zero speed) or take a smaller dt."
        )
    return substeps


# Parameters of a prior that are trained along with the networks: each stacked network has its own.

PREFIX = "prior."
"""What the names of trained parameters begin with among a training's weights."""


class StackedPrior(nn.Module):
    """A prior with parameters of its own for each of several networks.

    What is trained is the way from the prior's value in units of the parameter's range, ``(networks, 1)``, zero at
    first: weight decay then pulls towards the prior, as it pulls a network's weights towards no correction.
    :meth:`project` keeps the values within their bounds.

    Args:
        prior: The fitted prior, where all of them start; it is not changed.
        networks: Number of networks.

    Raises:
        InputError: If the prior has no parameter that is free.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> stack = StackedPrior(PendulumPrior(), 2)
        >>> {name: value.tolist() for name, value in stack.values().items()}
        {'l': [0.05, 0.05], 'd': [2.0, 2.0]}
    """

    def __init__(self, prior: Prior, networks: int) -> None:
        super().__init__()
        free = [spec for spec in prior.parameters_spec if not spec.fixed]
        if not free:
            raise InputError(
                f"{type(prior).__name__} has no free parameter to train along (all have lower == upper); "
                "leave prior_parameters 'fixed' or give one of them bounds"
            )
        self.networks, start = networks, prior.values
        self._prior = (prior,)  # in a tuple: its parameters are no part of what is trained
        self._spec = {p.name: (start[p.name], p.lower, p.upper) for p in free}
        zeros = torch.zeros(networks, 1, dtype=torch.float64)
        self.ways = nn.ParameterDict({name: nn.Parameter(zeros.clone()) for name in self._spec})

    def values(self) -> dict[str, Tensor]:
        """Values [SI] of each free parameter, ``(networks,)``."""
        return {
            name: start + (upper - lower) * self.ways[name][:, 0]
            for name, (start, lower, upper) in self._spec.items()
        }

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        """Derivative ``(..., networks, batch, n_x)`` at ``x`` and ``u``, whose third axis from the end may be 1."""
        x, u = (z.expand(*z.shape[:-3], self.networks, *z.shape[-2:]) for z in (x, u))

        def one(values: dict[str, Tensor], x: Tensor, u: Tensor) -> Tensor:
            derivative: Tensor = functional_call(self._prior[0], values, (x, u))
            return derivative

        derivative: Tensor = vmap(one, in_dims=(0, -3, -3), out_dims=-3)(self.values(), x, u)
        return derivative

    def acceleration(self, x: Tensor, u: Tensor) -> Tensor:
        """Accelerations ``(..., networks, batch, n_q)``."""
        n_q = self._prior[0].n_q
        return self.forward(x, u)[..., n_q : 2 * n_q]

    def project(self) -> None:
        """Put values that have left their bounds back onto them."""
        with torch.no_grad():
            for name, (start, lower, upper) in self._spec.items():
                span = upper - lower
                self.ways[name].clamp_((lower - start) / span, (upper - start) / span)

    def weights(self) -> dict[str, nn.Parameter]:
        """What is trained, by name."""
        return {f"{PREFIX}{name}": way for name, way in self.ways.items()}

    def in_si(self, weights: Mapping[str, Tensor]) -> dict[str, NDArray[np.float64]]:
        """Values [SI] ``(networks,)`` of weights named as those of :meth:`weights`, none beyond its bound."""
        out = {}
        for name, (start, lower, upper) in self._spec.items():
            way = weights[f"{PREFIX}{name}"][:, 0].cpu().numpy()
            out[f"{PREFIX}{name}"] = np.clip(start + (upper - lower) * way, lower, upper)
        return out


def with_values(prior: Prior, values: Mapping[str, float]) -> Prior:
    """A copy of a prior with other parameter values [SI].

    Raises:
        InputError: If the prior has no such parameter.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> with_values(PendulumPrior(), {"d": 2.1}).values["d"]
        2.1
    """
    unknown = set(values) - set(prior.values)
    if unknown:
        raise InputError(
            f"{type(prior).__name__} has no parameter {', '.join(sorted(unknown))}, which was trained along; "
            "give the prior of the training"
        )
    copied = copy.deepcopy(prior)
    with torch.no_grad():
        for name, value in values.items():
            getattr(copied, name).fill_(value)
    return copied


@dataclass(frozen=True)
class Scaling:
    """Magnitudes that make features and outputs of order one; part of the model.

    Args:
        x: Scale of each state ``(n_x,)``.
        u: Scale of each input ``(n_u,)``.
        acceleration: Scale of the prior's acceleration as a feature ``(n_q,)``; literal form: of its whole
            xdot ``(n_x,)``.
        correction: Scale of the network's output ``(n_q,)``; literal form: of xdot ``(n_x,)``.
    """

    x: tuple[float, ...]
    u: tuple[float, ...]
    acceleration: tuple[float, ...]
    correction: tuple[float, ...]


class PriorStep(nn.Module):
    """The prior alone as a step ``(x, h, u) -> (x_next, h_next)`` with an empty hidden state.

    Args:
        prior: The ODE prior.
        dt: Model period [s].
        substeps: Runge-Kutta steps a period; default: what the prior's stiffness asks for.
    """

    def __init__(self, prior: Prior, dt: float, substeps: int | None = None) -> None:
        super().__init__()
        self.prior, self.dt = prior, dt
        self.substeps = substeps or required_substeps(prior, dt)

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and the hidden state as it came."""
        return rk4(lambda z: self.prior(z, u), x, self.dt, self.substeps), h

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state at the instant."""
        return self.prior(x, u)


class RecurrentStep(nn.Module):
    """A step ``(x, h, u) -> (x_next, h_next)`` with a network in it: what every form of it can do.

    A subclass defines ``features``, ``integrate``, ``derivative``, ``rate`` and ``measured_rate``.

    Args:
        prior: The ODE prior; it also names the states.
        network: ``(s, h) -> (output, h_next)``, one network or a stack.
        scaling: Magnitudes of features and outputs.
        dt: Model period [s].
        use_prior: False makes the plain recurrent network (RNN) of the paper's comparison.
        dynamics: The prior's equation with parameters that were, or are, trained along; names, output and energy
            balance stay those of ``prior``. Default: ``prior``.
    """

    scale_x: Tensor
    scale_u: Tensor
    scale_acceleration: Tensor
    scale_correction: Tensor

    def __init__(
        self,
        prior: Prior,
        network: nn.Module,
        scaling: Scaling,
        dt: float,
        *,
        use_prior: bool = True,
        dynamics: Prior | StackedPrior | None = None,
    ) -> None:
        super().__init__()
        self.prior, self.network, self.dt, self.use_prior = prior, network, dt, use_prior
        self.dynamics = dynamics
        for name in ("x", "u", "acceleration", "correction"):
            self.register_buffer(f"scale_{name}", torch.tensor(getattr(scaling, name), dtype=torch.float64))

    def features(self, x: Tensor, u: Tensor) -> Tensor:
        """Network inputs ``s``, scaled."""
        raise NotImplementedError(f"{type(self).__name__} must define features(x, u)")

    def stacked_features(self, x: Tensor, u: Tensor) -> Tensor:
        """Features of a stack ``(T, 1 or networks, n, n_in)`` at ``x`` ``(T, n, n_x)`` and ``u``, the same for all."""
        if isinstance(self.dynamics, StackedPrior):
            shape = (-1, self.dynamics.networks, -1, -1)
            return self.features(x.unsqueeze(1).expand(shape), u.unsqueeze(1).expand(shape))
        return self.features(x, u).unsqueeze(1)

    @property
    def physics(self) -> Prior | StackedPrior:
        """Whose equation of motion it is: ``dynamics``, or the prior."""
        return self.prior if self.dynamics is None else self.dynamics

    def correction(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """What the network gives [SI] (hybrid: acceleration ``(..., n_q)``), and the next hidden state."""
        out, h_next = self.network(self.features(x, u), h)
        return out * self.scale_correction, h_next

    def integrate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Next state with ``correction`` and ``u`` held over the period."""
        raise NotImplementedError(f"{type(self).__name__} must define integrate(x, u, correction)")

    def derivative(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Derivative of the state at the instant, ``(..., n_x)``."""
        raise NotImplementedError(f"{type(self).__name__} must define derivative(x, u, correction)")

    def rate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Rate of change over the period that the training compares with :meth:`measured_rate`."""
        raise NotImplementedError(f"{type(self).__name__} must define rate(x, u, correction)")

    def measured_rate(self, x: Tensor, x_next: Tensor, xdot: Tensor) -> Tensor:
        """What the model's rate is compared with, from measured states and their smoothed derivative."""
        raise NotImplementedError(f"{type(self).__name__} must define measured_rate(x, x_next, xdot)")

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and next hidden state."""
        correction, h_next = self.correction(x, h, u)
        return self.integrate(x, u, correction), h_next

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state at the instant, with the correction that ``(x, h, u)`` gives."""
        return self.derivative(x, u, self.correction(x, h, u)[0])


class HybridStep(RecurrentStep):
    """Prior and recurrent correction as a step ``(x, h, u) -> (x_next, h_next)`` (blueprint's hybrid step).

    ``h`` is updated once at ``(x_k, u_k)``; the correction of the acceleration is held over ``dt``; prior
    and correction are integrated by Runge-Kutta of order 4. Rates are means over the period, so that an
    input that jumps at a sample is credited to the period it acts in.

    Args:
        prior: The ODE prior; it also names the states.
        network: ``(s, h) -> (output, h_next)``, one network or a stack.
        scaling: Magnitudes of features and outputs.
        dt: Model period [s].
        use_prior: False makes the plain recurrent network (RNN) of the paper's comparison: it sees no
            prior and gives the whole acceleration; the kinematics stay exact.
        substeps: Runge-Kutta steps a period. Default: what the prior's stiffness asks for.
        dynamics: See :class:`RecurrentStep`.
    """

    def __init__(
        self,
        prior: Prior,
        network: nn.Module,
        scaling: Scaling,
        dt: float,
        *,
        use_prior: bool = True,
        substeps: int | None = None,
        dynamics: Prior | StackedPrior | None = None,
    ) -> None:
        super().__init__(prior, network, scaling, dt, use_prior=use_prior, dynamics=dynamics)
        self.substeps = (substeps or required_substeps(prior, dt)) if use_prior else 1

    def features(self, x: Tensor, u: Tensor) -> Tensor:
        """Network inputs ``s = [x, u, prior acceleration]``, scaled; an angle that turns as sin and cos."""
        parts = []
        for i, signal in enumerate(self.prior.states):
            component = x[..., i : i + 1]
            if signal.periodic:
                parts += [torch.sin(component), torch.cos(component)]
            else:
                parts.append(component / self.scale_x[i : i + 1])
        parts.append(u / self.scale_u)
        if self.use_prior:
            parts.append(self.physics.acceleration(x, u) / self.scale_acceleration)
        return torch.cat(parts, dim=-1)

    def integrate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Next state with ``correction`` and ``u`` held over the period."""
        return rk4(lambda z: self.derivative(z, u, correction), x, self.dt, self.substeps)

    def derivative(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Derivative of the state at the instant: exact kinematics, prior plus correction."""
        acceleration = self.physics.acceleration(x, u) + correction if self.use_prior else correction
        velocity = x[..., self.prior.n_q :]
        return torch.cat([velocity, acceleration.expand(velocity.shape)], dim=-1)

    def rate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Mean rate over the period, ``(x_{k+1} - x_k) / dt``."""
        return (self.integrate(x.expand(*correction.shape[:-1], -1), u, correction) - x) / self.dt

    def measured_rate(self, x: Tensor, x_next: Tensor, xdot: Tensor) -> Tensor:
        """Mean rate between two measured states; their derivative is not used."""
        return (x_next - x) / self.dt


class LiteralStep(RecurrentStep):
    """The paper's literal form: the network gives the whole xdot, explicit Euler integrates it.

    Features are ``[x, u, prior xdot]`` as they are (an angle that turns is no sine and cosine); the target
    of teacher forcing is the derivative xdot of the recording at the sample, not a mean over the period.
    Nothing ties ``q_dot`` to ``v``, and Euler feeds energy into an oscillation: both are the paper's.

    Args:
        prior: The ODE prior; it also names the states.
        network: ``(s, h) -> (output, h_next)`` with n_x outputs, one network or a stack.
        scaling: Magnitudes of features and outputs, those of xdot ``(n_x,)``.
        dt: Period of the data [s].
        use_prior: False leaves the prior's xdot out of the features (RNN).

    Source: Schön, Götte, Timmermann: Multi-Objective Physics-Guided Recurrent Neural Networks for
    Identifying Non-Autonomous Dynamical Systems (IFAC ALCOS 2022), Fig. 1.
    """

    def features(self, x: Tensor, u: Tensor) -> Tensor:
        """Network inputs ``s = [x, u, prior xdot]``, scaled."""
        parts = [x / self.scale_x, u / self.scale_u]
        if self.use_prior:
            parts.append(self.physics(x, u) / self.scale_acceleration)
        return torch.cat(parts, dim=-1)

    def integrate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Next state by explicit Euler."""
        return x + self.dt * correction

    def derivative(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """What the network gave."""
        return correction

    def rate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """What the network gave."""
        return correction

    def measured_rate(self, x: Tensor, x_next: Tensor, xdot: Tensor) -> Tensor:
        """The derivative of the recording at the sample."""
        return xdot


def n_features(prior: Prior, use_prior: bool, *, literal: bool = False) -> int:
    """Number of features of :meth:`HybridStep.features`, or :meth:`LiteralStep.features` if ``literal``."""
    if literal:
        return len(prior.states) * (2 if use_prior else 1) + len(prior.inputs)
    angles = sum(signal.periodic for signal in prior.states)
    return len(prior.states) + angles + len(prior.inputs) + (prior.n_q if use_prior else 0)
