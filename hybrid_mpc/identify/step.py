"""Models as steps ``(x, h, u, w) -> (x_next, h_next)`` over one period: the prior alone, and prior plus network.

The same code serves training (any batch) and export (one sample).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, cast

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import nn_export
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.dataset import Windows
from hybrid_mpc.identify.networks import GRUNetwork, StackedGRU
from hybrid_mpc.identify.rollout import Rollout
from hybrid_mpc.identify.simulation import Simulation, required_substeps, stepped
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Signal

SPAN = 10
"""Periods over which the correction is averaged for its scale."""


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


class PriorEquations(nn.Module):
    """A prior's equations on tensors with any leading axes: ``xdot``, ``output``, and a residual for each balance."""

    def __init__(self, prior: Prior) -> None:
        super().__init__()
        equations = prior.equations

        def on_tensors(function: Any) -> nn.Module:
            return nn_export.from_casadi(function, own_derivatives=False)

        self.xdot, self.output = on_tensors(equations.xdot), on_tensors(equations.output)
        self.residuals = nn.ModuleDict({b.name: on_tensors(b.residual) for b in equations.balances})


class Step(nn.Module):
    """Base class of all models: a step over one period, its derivative, and the prior that names its signals.

    The default of the prior's parameters ``p`` ``(n_p,)`` are those of ``prior``.
    """

    p: Tensor

    def __init__(self, prior: Prior, dt: float) -> None:
        super().__init__()
        self.prior, self.dt, self.equations = prior, dt, PriorEquations(prior)
        self.register_buffer("p", torch.tensor(prior.p), persistent=False)

    @property
    def n_h(self) -> int:
        """Size of the hidden state; none by default."""
        return 0

    @property
    def h0(self) -> Tensor:
        """Zero hidden state ``(n_h,)``; of a stack of networks ``(networks, 1, n_h)``."""
        return torch.zeros(self.n_h, dtype=torch.float64)

    def forward(
        self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and hidden state ``(..., n_h)``; ``u`` and ``w`` are constant over the period."""
        raise NotImplementedError(f"{type(self).__name__} must define forward(x, h, u, w, p)")

    def free_run(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """States ``(T + 1, ..., n_x)`` of a free run from ``x`` and ``h`` with ``u``, ``w`` ``(T, ..., n)``."""
        states = [x]
        for u_k, w_k in zip(u, w, strict=True):
            x, h = self(x, h, u_k, w_k)
            states.append(x)
        return torch.stack(states)

    def xdot(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None) -> Tensor:
        """Time derivative of the state ``(..., n_x)``."""
        raise NotImplementedError(f"{type(self).__name__} must define xdot(x, h, u, w, p)")


class PriorStep(Step):
    """The prior alone, by the Runge-Kutta method of order 4; its hidden state is empty.

    Args:
        prior: The ODE prior.
        dt: Model period [s].
        substeps: Runge-Kutta sub-steps a period (:attr:`~hybrid_mpc.identify.prior_result.PriorFit.substeps`). Default
            0: as many as the prior needs at rest.

    Raises:
        InputError: If the prior is too stiff for the period.
    """

    def __init__(self, prior: Prior, dt: float, substeps: int = 0) -> None:
        super().__init__(prior, dt)
        self.substeps = substeps or required_substeps(prior, dt)

    def forward(
        self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Next state, and the unchanged hidden state."""
        return rk4(lambda z: self.xdot(z, h, u, w, p), x, self.dt, self.substeps), h

    def free_run(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """States of free runs, all runs in one call of CasADi; not differentiable."""
        runs, periods = x.shape[:-1].numel(), len(u)
        # the last input is repeated
        u_all, w_all = (
            torch.cat([z, z[-1:]]).reshape(periods + 1, runs, z.shape[-1]).swapaxes(0, 1).numpy()
            for z in (u, w)
        )
        simulation = Simulation(self.prior.equations.xdot, self.dt)
        states = simulation.values(x.reshape(runs, -1).numpy(), u_all, w_all, self.p.numpy(), self.substeps)
        return torch.tensor(states).swapaxes(0, 1).reshape(periods + 1, *x.shape)

    def xdot(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None) -> Tensor:
        """Time derivative of the state."""
        rates: Tensor = self.equations.xdot(x, u, w, self.p if p is None else p)
        return rates


@dataclass(frozen=True)
class Scaling:
    """Scales of features and outputs; part of the model.

    Args:
        x: Scale of each state ``(n_x,)``.
        u: Scale of each input ``(n_u,)``.
        rate: Scale of the prior's rates of the corrected states, which are features ``(n_c,)``.
        correction: Scale of the network's output ``(n_c,)``.
        w: Scale of each disturbance ``(n_w,)``. Default: no disturbances.
        centre_x: Offset of each state, which is subtracted first. Default: zero.
        centre_u: Offset of each input. Default: zero.
        centre_w: Offset of each disturbance. Default: zero.
        xdot: Scale of each state's rate ``(n_x,)`` in the errors of rates. Default: 1.
        substeps: Runge-Kutta sub-steps a period that the prior needs along the training data. Default 0: as many as it
            needs at rest.
    """

    x: tuple[float, ...]
    u: tuple[float, ...]
    rate: tuple[float, ...]
    correction: tuple[float, ...]
    w: tuple[float, ...] = ()
    centre_x: tuple[float, ...] = ()
    centre_u: tuple[float, ...] = ()
    centre_w: tuple[float, ...] = ()
    xdot: tuple[float, ...] = ()
    substeps: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "xdot", tuple(self.xdot or (1.0,) * len(self.x)))
        for name in ("x", "u", "w"):
            centre = getattr(self, f"centre_{name}") or (0.0,) * len(getattr(self, name))
            object.__setattr__(self, f"centre_{name}", tuple(centre))


class RecurrentStep(Step):
    """A step with a network. A subclass is a form of model for :func:`~hybrid_mpc.identify.train.train`.

    A subclass defines the network's features and outputs (``sizes``, ``scaling_of``, ``features``) and their use
    (``integrate``, ``derivative``, ``rate``, ``measured_rate``). ``use_prior=False`` gives the plain recurrent network
    (RNN) of the paper's comparison. ``shift`` is added to the prior's parameters: trained minus fitted values. Names,
    output and balances are those of ``prior``.
    """

    corrects_prior: ClassVar[bool]
    """Whether the model with zero output is the prior; then the training starts with zero output."""
    needs_rates: ClassVar[bool] = False
    """Whether the training needs recorded derivatives."""
    scale_x: Tensor
    scale_u: Tensor
    scale_w: Tensor
    scale_rate: Tensor
    scale_correction: Tensor
    scale_centre_x: Tensor
    scale_centre_u: Tensor
    scale_centre_w: Tensor
    scale_xdot: Tensor
    own_shift: Tensor
    into: Tensor
    own_rows: Tensor

    def __init__(
        self,
        prior: Prior,
        network: nn.Module,
        scaling: Scaling,
        dt: float,
        *,
        use_prior: bool = True,
        shift: Tensor | TrainedParameters | None = None,
    ) -> None:
        super().__init__(prior, dt)
        self.network, self.use_prior = network, use_prior
        self.trained = shift if isinstance(shift, TrainedParameters) else None
        own_rates = use_prior and self.corrects_prior
        self.substeps = (scaling.substeps or required_substeps(prior, dt)) if own_rates else 1
        own = shift if isinstance(shift, Tensor) else torch.zeros(len(prior.parameters), dtype=torch.float64)
        self.register_buffer("own_shift", own, persistent=False)
        for name, values in vars(scaling).items():
            if name != "substeps":
                self.register_buffer(f"scale_{name}", torch.tensor(values, dtype=torch.float64))
        rows = torch.tensor(prior.corrected, dtype=torch.int64)
        into = torch.zeros(len(prior.states), len(rows), dtype=torch.float64)
        into[rows, torch.arange(len(rows))] = 1.0
        self.register_buffer("into", into, persistent=False)  # matrix from corrections to rates
        self.register_buffer("own_rows", 1.0 - into.sum(1), persistent=False)
        at = rows.tolist()
        self.corrected = slice(at[0], at[-1] + 1) if at == list(range(at[0], at[-1] + 1)) else rows

    @classmethod
    def sizes(cls, prior: Prior, use_prior: bool) -> tuple[int, int]:
        """Number of features and number of outputs of the network."""
        raise NotImplementedError(f"{cls.__name__} must define sizes(prior, use_prior)")

    @classmethod
    def scaling_of(cls, prior: Prior, windows: Windows, dt: float, *, use_prior: bool) -> Scaling:
        """Compute the scaling from training windows."""
        raise NotImplementedError(f"{cls.__name__} must define scaling_of(prior, windows, dt, use_prior=...)")

    def features(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Scaled network inputs ``s``."""
        raise NotImplementedError(f"{type(self).__name__} must define features(x, u, w)")

    @staticmethod
    def _shown(signal: Signal, value: Tensor, scaled: Tensor) -> list[Tensor]:
        """What a network sees of a signal: the scaled value, or sine and cosine of an angle."""
        if not signal.periodic:
            return [scaled]
        angle = value if signal.radians == 1.0 else signal.radians * value
        return [torch.sin(angle), torch.cos(angle)]

    def _given(self, signals: Sequence[Signal], values: Tensor, scaled: Tensor) -> list[Tensor]:
        """What a network sees of inputs or disturbances."""
        if not any(signal.periodic for signal in signals):
            return [scaled]
        columns = ((s, slice(i, i + 1)) for i, s in enumerate(signals))
        return [part for s, own in columns for part in self._shown(s, values[..., own], scaled[..., own])]

    def integrate(
        self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor, p: Tensor | None = None
    ) -> Tensor:
        """Next state; ``correction``, ``u`` and ``w`` are constant over the period."""
        raise NotImplementedError(f"{type(self).__name__} must define integrate(x, u, w, correction, p)")

    def derivative(
        self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor, p: Tensor | None = None
    ) -> Tensor:
        """Time derivative of the state, ``(..., n_x)``."""
        raise NotImplementedError(f"{type(self).__name__} must define derivative(x, u, w, correction, p)")

    def rate(self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor) -> Tensor:
        """Rate of change over the period that the training compares with :meth:`measured_rate`."""
        raise NotImplementedError(f"{type(self).__name__} must define rate(x, u, w, correction)")

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

    def prior_rates(self, x: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None) -> Tensor:
        """The prior's rates ``(..., n_x)``, with the parameters that were trained with the network."""
        shift = self.own_shift if self.trained is None else self.trained.shift()
        rates: Tensor = self.equations.xdot(x, u, w, (self.p if p is None else p) + shift)
        return rates

    def stacked_features(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Features ``(T, 1 or networks, n, n_in)`` of a stack at ``x`` ``(T, n, n_x)``, ``u``, ``w``."""
        return self.features(*(z.unsqueeze(1) for z in (x, u, w)))

    def correction(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Output of the network (hybrid: rates ``(..., n_c)`` [state units per second]), and the next hidden state."""
        out, h_next = self.network(self.features(x, u, w), h)
        return out * self.scale_correction, h_next

    def forward(
        self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and next hidden state. The network's correction does not depend on ``p``."""
        correction, h_next = self.correction(x, h, u, w)
        return self.integrate(x, u, w, correction, p), h_next

    def xdot(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor, p: Tensor | None = None) -> Tensor:
        """Time derivative of the state, with the correction at ``(x, h, u, w)``."""
        return self.derivative(x, u, w, self.correction(x, h, u, w)[0], p)


class HybridStep(RecurrentStep):
    """Prior plus recurrent correction of the rates that the prior names (``Prior.corrects``).

    ``x_{k+1} = RK4(xdot_prior(x, u_k, w_k) + I_c c_k)`` with ``c_k, h_{k+1} = network(features(x_k, u_k, w_k), h_k)``:
    ``h`` is updated once in each period, and the correction ``c_k`` is constant over ``dt``. Rates in objectives are
    means over the period, so an input that jumps at a sample counts in the period in which it acts. Without the prior
    (``use_prior=False``), the network gives the whole corrected rates.

    Args:
        prior: The ODE prior; it also names the states.
        network: ``(s, h) -> (output, h_next)``, one network or a stack.
        scaling: Magnitudes of features and outputs.
        dt: Model period [s].
        use_prior: False for the plain recurrent network (RNN) of the paper's comparison.
        shift: Added to the prior's parameters ``(n_p,)``: trained minus fitted values. Default: zero.

    Raises:
        InputError: If the prior is too stiff for the period.
    """

    corrects_prior = True

    @classmethod
    def sizes(cls, prior: Prior, use_prior: bool) -> tuple[int, int]:
        """Number of features and number of outputs of the network."""
        return n_features(prior, use_prior), len(prior.corrected)

    @classmethod
    def scaling_of(cls, prior: Prior, windows: Windows, dt: float, *, use_prior: bool) -> Scaling:
        """Compute means and spreads of the signals, and root mean squares of the rates and of the needed correction.

        The needed correction is averaged over ``SPAN`` periods first. Otherwise the noise of a differentiated
        measurement would determine the scale, and networks with such a large scale learn noise.
        """
        x, u, w = (z.flatten(0, 1) for z in (windows.x[:, :-1], windows.u, windows.w))
        rows = list(prior.corrected)
        measured = ((windows.x[:, 1:] - windows.x[:, :-1]) / dt)[..., rows]
        with torch.no_grad():
            predicted = PriorEquations(prior).xdot(x, u, w, torch.tensor(prior.p))[..., rows]
        residual = measured - predicted.reshape(measured.shape) if use_prior else measured
        uncut = residual[:, : residual.shape[1] // SPAN * SPAN] if residual.shape[1] >= SPAN else residual
        averaged = uncut.unflatten(1, (-1, min(SPAN, uncut.shape[1]))).mean(2).reshape(-1, len(rows))
        return Scaling(
            x=spread(x),
            u=spread(u),
            rate=rms(predicted),
            correction=rms(averaged),
            w=spread(w),
            centre_x=mean(x),
            centre_u=mean(u),
            centre_w=mean(w),
            xdot=spread(((windows.x[:, 1:] - windows.x[:, :-1]) / dt).flatten(0, 1)),
        )

    def features(self, x: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """Scaled network inputs ``s = [x, u, w, prior's rates]``; a periodic angle is replaced by its sin and cos."""
        parts, scaled = [], (x - self.scale_centre_x) / self.scale_x
        for i, signal in enumerate(self.prior.states):
            own = slice(i, i + 1)
            parts += self._shown(signal, x[..., own], scaled[..., own])
        parts += self._given(self.prior.inputs, u, (u - self.scale_centre_u) / self.scale_u)
        if self.prior.disturbances:
            parts += self._given(self.prior.disturbances, w, (w - self.scale_centre_w) / self.scale_w)
        if self.use_prior:
            parts.append(self.prior_rates(x, u, w)[..., self.corrected] / self.scale_rate)
            if self.trained is not None:  # each network has its own features
                parts = [part.expand(*parts[-1].shape[:-1], -1) for part in parts]
        return torch.cat(parts, dim=-1)

    def integrate(
        self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor, p: Tensor | None = None
    ) -> Tensor:
        """Next state; ``correction``, ``u`` and ``w`` are constant over the period."""
        added = nn.functional.linear(correction, self.into)

        def rates(z: Tensor) -> Tensor:
            own = self.prior_rates(z, u, w, p)
            return (own if self.use_prior else own * self.own_rows) + added

        return rk4(rates, x, self.dt, self.substeps)

    def free_run(self, x: Tensor, h: Tensor, u: Tensor, w: Tensor) -> Tensor:
        """States of free runs; on the CPU by :class:`~hybrid_mpc.identify.rollout.Rollout`.

        Free runs of a single network are not differentiable.
        """
        if x.device.type != "cpu":
            return super().free_run(x, h, u, w)
        if isinstance(self.network, StackedGRU):
            p = x.new_zeros(len(h), 1, 0) if self.trained is None else self.trained.shift()
            return self._rollout(self.network, x, h, u, w, p)
        runs, periods = x.shape[:-1], len(u)
        x_0, h_0 = (z.reshape(1, runs.numel(), z.shape[-1]) for z in (x, h))
        u_all, w_all = (z.reshape(periods, 1, runs.numel(), z.shape[-1]) for z in (u, w))
        stack = StackedGRU.of(cast(GRUNetwork, self.network))
        with torch.no_grad():
            states = self._rollout(stack, x_0, h_0, u_all, w_all, x.new_zeros(1, 1, 0))
        return states.reshape(periods + 1, *x.shape)

    @cached_property
    def _rollout(self) -> Rollout:
        """Features and period of the model as scalar operations; ``p`` is added to the prior's parameters."""
        prior, xdot = self.prior, self.prior.equations.xdot
        sizes = {name: xdot.size1_in(i) for i, name in enumerate("xuw")}
        x, u, w = (ca.SX.sym(name, size) for name, size in sizes.items())
        c = ca.SX.sym("c", len(prior.corrected))
        p = ca.SX.sym("p", 0 if self.trained is None else len(prior.parameters))
        fitted = ca.DM((self.p + self.own_shift).numpy())
        shifted = fitted if self.trained is None else fitted + p
        scale, centre = (
            {k: ca.DM(getattr(self, f"scale_{a}{k}").numpy()) for k in "xuw"} for a in ("", "centre_")
        )
        parts = []
        for key, values, signals in (
            ("x", x, prior.states), ("u", u, prior.inputs), ("w", w, prior.disturbances)
        ):  # fmt: skip
            scaled = (values - centre[key]) / scale[key]
            for i, signal in enumerate(signals):
                angle = signal.radians * values[i]
                parts += [ca.sin(angle), ca.cos(angle)] if signal.periodic else [scaled[i]]
        if self.use_prior:
            parts.append(xdot(x, u, w, shifted)[list(prior.corrected)] / ca.DM(self.scale_rate.numpy()))
        own = ca.DM.ones(sizes["x"]) if self.use_prior else ca.DM(self.own_rows.numpy())
        z, held, into = ca.SX.sym("z", sizes["x"]), ca.vertcat(p, c), ca.DM(self.into.numpy())
        rates = ca.Function("xdot", [z, u, w, held], [xdot(z, u, w, shifted) * own + into @ c])
        x_next = stepped(rates, x, u, w, held, self.dt, self.substeps)
        features = ca.Function("features", [x, u, w, p], [ca.densify(ca.vertcat(*parts))])
        return Rollout(
            features, ca.Function("flow", [x, c, u, w, p], [ca.densify(x_next)]), self.scale_correction
        )

    def derivative(
        self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor, p: Tensor | None = None
    ) -> Tensor:
        """Time derivative of the state: the prior's rates plus the correction."""
        own = self.prior_rates(x, u, w, p)
        return (own if self.use_prior else own * self.own_rows) + nn.functional.linear(correction, self.into)

    def rate(self, x: Tensor, u: Tensor, w: Tensor, correction: Tensor) -> Tensor:
        """Mean rate over the period, ``(x_{k+1} - x_k) / dt``."""
        return (self.integrate(x.expand(*correction.shape[:-1], -1), u, w, correction) - x) / self.dt

    def measured_rate(self, x: Tensor, x_next: Tensor, xdot: Tensor) -> Tensor:
        """Mean rate between two measured states; ``xdot`` is not used."""
        return (x_next - x) / self.dt


def n_features(prior: Prior, use_prior: bool) -> int:
    """Number of features of a :class:`HybridStep`'s network."""
    signals = (*prior.states, *prior.inputs, *prior.disturbances)
    angles = sum(signal.periodic for signal in signals)
    return len(signals) + angles + (len(prior.corrected) if use_prior else 0)


def rms(values: Tensor) -> tuple[float, ...]:
    """Root mean square of each column, at least 1e-9."""
    return tuple(float(v) for v in values.square().mean(0).sqrt().clamp_min(1e-9))


def mean(values: Tensor) -> tuple[float, ...]:
    """Mean of each column."""
    return tuple(float(v) for v in values.mean(0))


def spread(values: Tensor) -> tuple[float, ...]:
    """Standard deviation of each column; the size of an almost constant column, and 1 for a zero column."""
    if not values.shape[1]:
        return ()
    deviations, sizes = values.std(0, correction=0).tolist(), values.square().mean(0).sqrt().tolist()
    # ratio of spread to size of a signal below which the signal is scaled by its size
    return tuple(s if s > 1e-3 * size else size or 1.0 for s, size in zip(deviations, sizes, strict=True))


PREFIX = "prior."
"""Prefix of the names of trained parameters among a training's weights."""


class TrainedParameters(nn.Module):
    """A prior's free parameters, trained with the networks; each network has its own values.

    The trained weight of a parameter is its distance from the prior's value, over the parameter's range, ``(networks,
    1)``; it starts at zero. So weight decay pulls parameters towards the prior, as it pulls networks towards zero
    correction. :meth:`project` keeps the values within their bounds.
    """

    spans: Tensor

    def __init__(self, prior: Prior, networks: int) -> None:
        super().__init__()
        free = [spec for spec in prior.parameters if not spec.fixed]
        if not free:
            raise InputError(
                f"{type(prior).__name__}: no free parameter to train (all have lower == upper). "
                "Set prior_parameters to 'fixed', or give a parameter bounds [HM-IDENTIFY-050]"
            )
        self.networks, start, n_p = networks, prior.values, len(prior.parameters)
        self._spec = {p.name: (start[p.name], p.lower, p.upper) for p in free}
        zeros = torch.zeros(networks, 1, dtype=torch.float64)
        self.ways = nn.ParameterDict({name: nn.Parameter(zeros.clone()) for name in self._spec})
        into = torch.zeros(len(free), n_p, dtype=torch.float64)
        for i, spec in enumerate(free):
            into[i, prior.parameters.index(spec)] = spec.upper - spec.lower
        self.register_buffer("spans", into, persistent=False)

    def shift(self) -> Tensor:
        """Difference from the prior's parameters, ``(networks, 1, n_p)``."""
        ways = torch.cat([self.ways[name] for name in self._spec], dim=1)
        return (ways @ self.spans).unsqueeze(1)

    def project(self) -> None:
        """Clip the values to their bounds."""
        with torch.no_grad():
            for name, (start, lower, upper) in self._spec.items():
                span = upper - lower
                self.ways[name].clamp_((lower - start) / span, (upper - start) / span)

    def weights(self) -> dict[str, nn.Parameter]:
        """Trained weights by name."""
        return {f"{PREFIX}{name}": way for name, way in self.ways.items()}

    def in_units(self, weights: Mapping[str, Tensor]) -> dict[str, NDArray[np.float64]]:
        """Convert weights (named as in :meth:`weights`) to values ``(networks,)`` [their units], within the bounds."""
        out = {}
        for name, (start, lower, upper) in self._spec.items():
            way = weights[f"{PREFIX}{name}"][:, 0].cpu().numpy()
            out[f"{PREFIX}{name}"] = np.clip(start + (upper - lower) * way, lower, upper)
        return out


def shift_to(prior: Prior, values: Mapping[str, float]) -> Tensor:
    """Difference ``(n_p,)`` of other ``values`` [their units] by name from a prior's parameters."""
    own = prior.values
    unknown = set(values) - set(own)
    if unknown:
        raise InputError(
            f"{type(prior).__name__}: no parameter {', '.join(sorted(unknown))}, which was trained. "
            "Give the prior of the training [HM-IDENTIFY-051]"
        )
    return torch.tensor(
        [values.get(name, fitted) - fitted for name, fitted in own.items()], dtype=torch.float64
    )
