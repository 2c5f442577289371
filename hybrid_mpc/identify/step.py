"""Models as steps ``(x, h, u) -> (x_next, h_next)`` over one period: the prior alone, and prior plus network.

One code for training (any batch) and for export (one sample).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, vmap

from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import Windows
from hybrid_mpc.identify.networks import StackedGRU
from hybrid_mpc.machine.torch_prior import Prior

MAX_SUBSTEPS = 20
"""A prior stiffer than this many Runge-Kutta sub-steps a period can follow needs another dt."""
SPAN = 10
"""Periods over which the correction is averaged to find its scale."""


def rk4(f: Callable[[Tensor], Tensor], x: Tensor, dt: float, substeps: int) -> Tensor:
    """Classical Runge-Kutta of order 4 for ``xdot = f(x)`` over ``dt`` in equal sub-steps."""
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
    """
    return substeps_for(prior, len(prior.states), len(prior.inputs), dt, f"{type(prior).__name__}: the prior")


def substeps_for(f: Callable[[Tensor, Tensor], Tensor], n_x: int, n_u: int, dt: float, name: str) -> int:
    """:func:`required_substeps` of any ``xdot = f(x, u)``; ``name`` says in the error what is too stiff."""
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


class Step(nn.Module):
    """What every model is: a step over one period, its derivative, and the prior that names its signals."""

    def __init__(self, prior: Prior, dt: float) -> None:
        super().__init__()
        self.prior, self.dt = prior, dt

    @property
    def n_h(self) -> int:
        """Size of the hidden state; none by default."""
        return 0

    @property
    def h0(self) -> Tensor:
        """Zero hidden state ``(n_h,)``; of a stack of networks ``(networks, 1, n_h)``."""
        return torch.zeros(self.n_h, dtype=torch.float64)

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and next hidden state ``(..., n_h)``, with ``u`` held over the period."""
        raise NotImplementedError(f"{type(self).__name__} must define forward(x, h, u)")

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state ``(..., n_x)`` at the instant."""
        raise NotImplementedError(f"{type(self).__name__} must define xdot(x, h, u)")


class PriorStep(Step):
    """The prior alone, by Runge-Kutta of order 4; its hidden state is empty.

    Args:
        prior: The ODE prior.
        dt: Model period [s].

    Raises:
        InputError: If the prior is too stiff for the period.
    """

    def __init__(self, prior: Prior, dt: float) -> None:
        super().__init__(prior, dt)
        self.substeps = required_substeps(prior, dt)

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state and the hidden state as it came."""
        return rk4(lambda z: self.prior(z, u), x, self.dt, self.substeps), h

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state at the instant."""
        return self.prior(x, u)


@dataclass(frozen=True)
class Scaling:
    """Magnitudes that make features and outputs of order one; part of the model.

    Args:
        x: Scale of each state ``(n_x,)``.
        u: Scale of each input ``(n_u,)``.
        acceleration: Scale of what the prior gives as a feature: its acceleration ``(n_q,)``.
        correction: Scale of the network's output ``(n_q,)``.
    """

    x: tuple[float, ...]
    u: tuple[float, ...]
    acceleration: tuple[float, ...]
    correction: tuple[float, ...]


class RecurrentStep(Step):
    """A step with a network in it. A subclass is a form of model that :func:`~hybrid_mpc.identify.train.train` takes.

    A subclass says what the network sees and gives (``sizes``, ``scaling_of``, ``features``) and what becomes of it
    (``integrate``, ``derivative``, ``rate``, ``measured_rate``). ``use_prior=False`` makes the plain recurrent network
    (RNN) of the paper's comparison. ``dynamics`` is the prior's equation with parameters trained along (default:
    ``prior``); names, output and energy balance stay those of ``prior``.
    """

    corrects_prior: ClassVar[bool]
    """Whether a zero output is the prior itself: the training then starts there."""
    needs_rates: ClassVar[bool] = False
    """Whether it is trained on the recorded derivatives, which then have to be known."""
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
        super().__init__(prior, dt)
        self.network, self.use_prior, self.dynamics = network, use_prior, dynamics
        self.substeps = required_substeps(prior, dt) if use_prior and self.corrects_prior else 1
        for name in ("x", "u", "acceleration", "correction"):
            self.register_buffer(f"scale_{name}", torch.tensor(getattr(scaling, name), dtype=torch.float64))

    @classmethod
    def sizes(cls, prior: Prior, use_prior: bool) -> tuple[int, int]:
        """Number of features and of outputs of its network."""
        raise NotImplementedError(f"{cls.__name__} must define sizes(prior, use_prior)")

    @classmethod
    def scaling_of(cls, prior: Prior, windows: Windows, dt: float, *, use_prior: bool) -> Scaling:
        """Scaling from training windows."""
        raise NotImplementedError(f"{cls.__name__} must define scaling_of(prior, windows, dt, use_prior=...)")

    def features(self, x: Tensor, u: Tensor) -> Tensor:
        """Network inputs ``s``, scaled."""
        raise NotImplementedError(f"{type(self).__name__} must define features(x, u)")

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
        """The measured rate, from states and their recorded derivative."""
        raise NotImplementedError(f"{type(self).__name__} must define measured_rate(x, x_next, xdot)")

    @property
    def n_h(self) -> int:
        """Size of the network's hidden state."""
        network: Any = self.network
        return int(network.n_h)

    @property
    def h0(self) -> Tensor:
        """Zero hidden state ``(n_h,)``; of a stack of networks ``(networks, 1, n_h)``."""
        return self.network.initial(1) if isinstance(self.network, StackedGRU) else super().h0

    @property
    def physics(self) -> Prior | StackedPrior:
        """Whose equation of motion it is: ``dynamics``, or the prior."""
        return self.prior if self.dynamics is None else self.dynamics

    def stacked_features(self, x: Tensor, u: Tensor) -> Tensor:
        """Features of a stack ``(T, 1 or networks, n, n_in)`` at ``x`` ``(T, n, n_x)`` and ``u``, the same for all."""
        if isinstance(self.dynamics, StackedPrior):
            shape = (-1, self.dynamics.networks, -1, -1)
            return self.features(x.unsqueeze(1).expand(shape), u.unsqueeze(1).expand(shape))
        return self.features(x, u).unsqueeze(1)

    def correction(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """What the network gives [SI] (hybrid: acceleration ``(..., n_q)``), and the next hidden state."""
        out, h_next = self.network(self.features(x, u), h)
        return out * self.scale_correction, h_next

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and next hidden state."""
        correction, h_next = self.correction(x, h, u)
        return self.integrate(x, u, correction), h_next

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state at the instant, with the correction that ``(x, h, u)`` gives."""
        return self.derivative(x, u, self.correction(x, h, u)[0])


class HybridStep(RecurrentStep):
    """Prior plus recurrent correction of its acceleration.

    ``h`` is updated once at ``(x_k, u_k)``; the correction is held over ``dt``; the kinematics are exact; Runge-Kutta
    of order 4 integrates. Rates are means over the period, so that an input that jumps at a sample counts in the period
    it acts in. Without the prior (``use_prior=False``) the network gives the whole acceleration.

    Args:
        prior: The ODE prior; it also names the states.
        network: ``(s, h) -> (output, h_next)``, one network or a stack.
        scaling: Magnitudes of features and outputs.
        dt: Model period [s].
        use_prior: False for the plain recurrent network (RNN) of the paper's comparison.
        dynamics: The prior's equation with parameters that were trained along. Default: ``prior``.

    Raises:
        InputError: If the prior is too stiff for the period.
    """

    corrects_prior = True

    @classmethod
    def sizes(cls, prior: Prior, use_prior: bool) -> tuple[int, int]:
        """Number of features and of outputs of its network."""
        return n_features(prior, use_prior), prior.n_q

    @classmethod
    def scaling_of(cls, prior: Prior, windows: Windows, dt: float, *, use_prior: bool) -> Scaling:
        """Root mean squares of signals and of what the network must give.

        The latter is averaged over ``SPAN`` periods first: the noise of a twice differentiated position would set the
        scale otherwise, and networks on so large a scale learn noise.
        """
        x, u = windows.x[:, :-1].reshape(-1, windows.x.shape[-1]), windows.u.reshape(-1, windows.u.shape[-1])
        n_q = prior.n_q
        measured = (windows.x[:, 1:, n_q:] - windows.x[:, :-1, n_q:]) / dt
        predicted = prior.acceleration(x, u)
        residual = measured - predicted.reshape(measured.shape) if use_prior else measured
        uncut = residual[:, : residual.shape[1] // SPAN * SPAN] if residual.shape[1] >= SPAN else residual
        averaged = uncut.unflatten(1, (-1, min(SPAN, uncut.shape[1]))).mean(2).reshape(-1, n_q)
        return Scaling(x=rms(x), u=rms(u), acceleration=rms(predicted), correction=rms(averaged))

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


def n_features(prior: Prior, use_prior: bool) -> int:
    """Number of features of a :class:`HybridStep`'s network."""
    angles = sum(signal.periodic for signal in prior.states)
    return len(prior.states) + angles + len(prior.inputs) + (prior.n_q if use_prior else 0)


def rms(values: Tensor) -> tuple[float, ...]:
    """Root mean square of each column, at least 1e-9."""
    return tuple(float(v) for v in values.square().mean(0).sqrt().clamp_min(1e-9))


PREFIX = "prior."
"""What the names of trained parameters begin with among a training's weights."""


class StackedPrior(nn.Module):
    """A prior with parameters of its own for each of several networks.

    What is trained is the way from the prior's value in units of the parameter's range, ``(networks, 1)``, zero at
    first: weight decay then pulls towards the prior, as it pulls a network's weights towards no correction.
    :meth:`project` keeps the values within their bounds.
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
        return self.forward(x, u)[..., n_q:]

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
    """A copy of a prior with other parameter values [SI]."""
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
