"""The paper's form of a model: the network gives the whole derivative of the state, explicit Euler integrates it."""

from __future__ import annotations

import torch
from torch import Tensor

from hybrid_mpc.identify.dataset import Windows
from hybrid_mpc.identify.step import PriorEquations, RecurrentStep, Scaling, rms
from hybrid_mpc.machine.prior import Prior


class PaperStep(RecurrentStep):
    """The paper form as a step ``(x, h, u) -> (x_next, h_next)``; the network has n_x outputs.

    Features are ``[x, u, prior xdot]`` as they are (an angle that turns is no sine and cosine). Teacher forcing aims at
    the recorded derivative at the sample, not at a mean over the period. Nothing ties ``q_dot`` to ``v``, and Euler
    feeds energy into an oscillation: both are the paper's. Its :class:`~hybrid_mpc.identify.step.Scaling` holds the
    scales of the prior's xdot and of xdot, ``(n_x,)`` each.

    Source: Schön, Götte, Timmermann: Multi-Objective Physics-Guided Recurrent Neural Networks for Identifying
    Non-Autonomous Dynamical Systems (IFAC ALCOS 2022), Fig. 1.
    """

    corrects_prior = False
    needs_rates = True

    @classmethod
    def sizes(cls, prior: Prior, use_prior: bool) -> tuple[int, int]:
        """Number of features and of outputs of its network."""
        n_x = len(prior.states)
        return n_x * (2 if use_prior else 1) + len(prior.inputs), n_x

    @classmethod
    def scaling_of(cls, prior: Prior, windows: Windows, dt: float, *, use_prior: bool) -> Scaling:
        """Root mean squares of signals, of the prior's xdot and of xdot."""
        x, u, w = (z.flatten(0, 1) for z in (windows.x[:, :-1], windows.u, windows.w))
        with torch.no_grad():
            rates = PriorEquations(prior).xdot(x, u, w, torch.tensor(prior.p))
        return Scaling(rms(x), rms(u), rms(rates), rms(windows.xdot.flatten(0, 1)))

    def features(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Network inputs ``s = [x, u, prior xdot]``, scaled."""
        parts = [x / self.scale_x, u / self.scale_u]
        if self.use_prior:
            parts.append(self.prior_rates(x, u, w) / self.scale_rate)
            if self.trained is not None:  # each network has features of its own
                parts = [part.expand(*parts[-1].shape[:-1], -1) for part in parts]
        return torch.cat(parts, dim=-1)

    def integrate(
        self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor, p: Tensor | None = None
    ) -> Tensor:
        """Next state by explicit Euler."""
        return x + self.dt * correction

    def derivative(
        self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor, p: Tensor | None = None
    ) -> Tensor:
        """What the network gave."""
        return correction

    def rate(self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor) -> Tensor:
        """What the network gave."""
        return correction

    def measured_rate(self, x: Tensor, x_next: Tensor, xdot: Tensor) -> Tensor:
        """The recorded derivative at the sample."""
        return xdot
