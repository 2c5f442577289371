"""The hybrid step: exact kinematics, prior plus learned correction of the acceleration, Runge-Kutta.

One code for training (any batch) and for export (one sample).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hybrid_mpc.errors import InputError
from hybrid_mpc.physics import Prior

MAX_SUBSTEPS = 20
"""A prior stiffer than this many Runge-Kutta sub-steps a period can follow needs another dt."""


@dataclass(frozen=True)
class Scaling:
    """Magnitudes that make features and outputs of order one; part of the model.

    Args:
        x: Scale of each state ``(n_x,)``.
        u: Scale of each input ``(n_u,)``.
        acceleration: Scale of the prior's acceleration as a feature ``(n_q,)``.
        correction: Scale of the network's output ``(n_q,)``.
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


class HybridStep(nn.Module):
    """Prior and recurrent correction as a step ``(x, h, u) -> (x_next, h_next)`` (blueprint's hybrid step).

    ``h`` is updated once at ``(x_k, u_k)``; the correction of the acceleration is held over ``dt``; prior
    and correction are integrated by Runge-Kutta of order 4.

    Args:
        prior: The ODE prior; it also names the states.
        network: ``(s, h) -> (output, h_next)``, one network or a stack.
        scaling: Magnitudes of features and outputs.
        dt: Model period [s].
        use_prior: False makes the plain recurrent network (RNN) of the paper's comparison: it sees no
            prior and gives the whole acceleration; the kinematics stay exact.
        substeps: Runge-Kutta steps a period.
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
        substeps: int | None = None,
    ) -> None:
        super().__init__()
        self.prior, self.network, self.dt, self.use_prior = prior, network, dt, use_prior
        self.substeps = (substeps or required_substeps(prior, dt)) if use_prior else 1
        for name in ("x", "u", "acceleration", "correction"):
            self.register_buffer(f"scale_{name}", torch.tensor(getattr(scaling, name), dtype=torch.float64))

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
            parts.append(self.prior.acceleration(x, u) / self.scale_acceleration)
        return torch.cat(parts, dim=-1)

    def correction(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Learned acceleration ``(..., n_q)`` [SI] and next hidden state."""
        out, h_next = self.network(self.features(x, u), h)
        return out * self.scale_correction, h_next

    def integrate(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        """Next state with ``correction`` and ``u`` held over the period."""
        return rk4(lambda z: self._xdot(z, u, correction), x, self.dt, self.substeps)

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and next hidden state."""
        correction, h_next = self.correction(x, h, u)
        return self.integrate(x, u, correction), h_next

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state at the instant, with the correction that ``(x, h, u)`` gives."""
        return self._xdot(x, u, self.correction(x, h, u)[0])

    def _xdot(self, x: Tensor, u: Tensor, correction: Tensor) -> Tensor:
        acceleration = self.prior.acceleration(x, u) + correction if self.use_prior else correction
        velocity = x[..., self.prior.n_q :]
        return torch.cat([velocity, acceleration.expand(velocity.shape)], dim=-1)


def n_features(prior: Prior, use_prior: bool) -> int:
    """Number of features that :meth:`HybridStep.features` gives."""
    angles = sum(signal.periodic for signal in prior.states)
    return len(prior.states) + angles + len(prior.inputs) + (prior.n_q if use_prior else 0)


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
    zeros = torch.zeros(len(prior.states), dtype=torch.float64)
    u = torch.zeros(len(prior.inputs), dtype=torch.float64)
    slope = torch.func.jacrev(lambda x: prior(x, u))(zeros)
    rate = float(torch.linalg.eigvals(slope).abs().max())
    substeps = max(1, math.ceil(rate * dt))
    if not math.isfinite(rate) or substeps > MAX_SUBSTEPS:
        raise InputError(
            f"{type(prior).__name__}: the prior's fastest mode at rest is {rate:.3g} 1/s; a period of {dt} s "
            f"would need {substeps} sub-steps (at most {MAX_SUBSTEPS}). Smooth its friction (lower the slope "
            f"at zero speed) or take a smaller dt."
        )
    return substeps
