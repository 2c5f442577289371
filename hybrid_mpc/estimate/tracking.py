"""Tracked parameters: slow states of an observer beside state, hidden state and disturbances.

The deviation ``theta`` of a tracked parameter from its fitted value is a stationary first-order process with the
standard deviation ``std`` between recordings and the time constant ``time`` of its drift, by default a day:
``theta_{k+1} = a theta_k + w_k``, ``a = exp(-dt / time)``, ``w_k ~ N(0, (1 - a^2) std^2)``. So without excitation the
covariance of ``theta`` cannot exceed ``std^2`` (a random walk's would grow without bound), the estimate stays where it
is, and over ``time`` it returns to the fitted value. A parameter stays within its bounds by a saturation of ``theta``.

For controller and monitor a tracked parameter is a measured disturbance: :func:`with_tracked` makes it one.

Source: Simon, *Optimal State Estimation*, 2006, section 13.4; Ljung and Soderstrom, *Theory and Practice of Recursive
Identification*, 1983, section 2.6, of prior information in tracking.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter
from hybrid_mpc.estimate.offset_free import distinguishable
from hybrid_mpc.estimate.switching import Filter, SwitchingFilter
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.model.limits import sampled
from hybrid_mpc.model.model import (
    HybridModel,
    ManyPoints,
    SideBySide,
    at_arguments,
    inlined,
    step_function,
    step_symbols,
    with_slopes,
)
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Name, Positive

Array = NDArray[np.float64]
DAY = 86400.0
"""Time constant [s] of a parameter's drift: all but constant in a recording of minutes or hours."""
FARTHEST = 3.0
"""Largest relative deviation of a parameter, as a logarithm, whose bound is zero."""
NEAREST = 1e-6
"""Smallest distance from a bound, in standard deviations: a parameter at its bound cannot go beyond."""
CHECKED = 2.0
"""Deviation of each tracked parameter, in standard deviations, at which disturbances must be detectable."""


@dataclass(frozen=True)
class TrackedParameter:
    """A parameter that an observer tracks.

    Args:
        name: Name of the parameter of the prior.
        std: Standard deviation of its values between recordings: relative [-], or in the parameter's unit.
        relative: Whether ``std`` is relative. Default: False.
        time: Time constant [s] of its drift, and of its return to the fitted value without excitation. Default: a day.
    """

    name: Name
    std: Positive
    relative: bool = False
    time: Positive = DAY

    def __post_init__(self) -> None:
        Fields(self, f"tracked parameter {self.name!r}").refuse()

    def decay(self, dt: float) -> float:
        """Factor ``a`` [-] of its deviation after a period ``dt`` [s] without excitation."""
        return math.exp(-dt / self.time)

    def drift(self, over: float) -> float:
        """Standard deviation of its change over a time ``over`` [s]; relative, or in the parameter's unit.

        ``E (theta_{k+n} - theta_k)^2 = 2 std^2 (1 - a^n)``.
        """
        return self.std * math.sqrt(-2.0 * math.expm1(-over / self.time))

    def words(self, unit: str, over: float) -> str:
        """Its standard deviation, and its drift over a time ``over`` [s], as text; ``unit`` is the parameter's.

        Example:
            >>> TrackedParameter("gain", 0.2, relative=True).words("V", 60.0)
            '20 %, drift 0.745 % in 60 s'
            >>> TrackedParameter("bias", 0.5, time=600.0).words("V", 60.0)
            '0.5 V, drift 0.218 V in 60 s'
        """
        std, drift = (
            f"{100 * v:.3g} %" if self.relative else f"{v:.3g} {unit}" for v in (self.std, self.drift(over))
        )
        return f"{std}, drift {drift} in {over:g} s"


def is_relative(parameter: Parameter) -> bool:
    """Whether the deviations of a parameter are relative: its bounds exclude zero, as those of a time constant.

    Example:
        >>> is_relative(Parameter("tau", 2.0, "s", 0.5, 9.0)), is_relative(Parameter("friction", 0.1, "N", 0.0, 1.0))
        (True, False)
    """
    return parameter.lower > 0 or parameter.upper < 0


def tracked_values(model: HybridModel, tracked: Sequence[TrackedParameter], theta: ca.MX) -> ca.MX:
    """Values ``(n_t,)`` [their units] of the tracked parameters for deviations ``theta`` ``(n_t,)``, within bounds."""
    found = []
    for one, t in zip(tracked, ca.vertsplit(theta), strict=True):
        p = next(p for p in model.parameters if p.name == one.name)
        down, up = _room(p, one)
        saturated = up * ca.tanh(ca.fmax(t, 0) / up) + down * ca.tanh(ca.fmin(t, 0) / down)
        value = p.value * ca.exp(saturated) if one.relative else p.value + saturated
        found.append(ca.fmin(ca.fmax(value, p.lower), p.upper))  # rounding, and a value at its bound
    return ca.vertcat(*found)


def tracked_range(
    model: HybridModel, tracked: Sequence[TrackedParameter], deviations: float = 3.0
) -> tuple[Array, Array]:
    """Smallest and largest values ``(n_t,)`` [their units] of tracked parameters within some standard deviations.

    Example:
        >>> x, u, p = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("p")
        >>> level = (Signal("x", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, p=p, x_next=x + p * u,
        ...     xdot=p * u, y=x, parameters=(Parameter("k", 2.0, "m/s", -50.0, 50.0),))
        >>> [end.round(2).tolist() for end in tracked_range(tank, [TrackedParameter("k", 0.5)])]
        [[0.5], [3.5]]
    """
    ends = []
    for sign in (-deviations, deviations):
        theta = ca.MX(ca.DM([sign * one.std for one in tracked]))
        ends.append(ca.evalf(tracked_values(model, tracked, theta)).full().ravel())
    return np.minimum(*ends), np.maximum(*ends)


def _room(p: Parameter, one: TrackedParameter) -> tuple[float, float]:
    """Largest deviation of a parameter to both sides of its fitted value."""
    if not one.relative:
        ends = p.value - p.lower, p.upper - p.value
    else:
        low, high = sorted((abs(p.lower), abs(p.upper)))
        value = max(abs(p.value), np.finfo(float).tiny)
        ends = math.log(value / low) if low else FARTHEST, math.log(high / value) if high else FARTHEST
    down, up = (min(max(end, NEAREST * one.std), 1e3 * one.std) for end in ends)
    return down, up


def with_tracked(model: HybridModel, tracked: Sequence[TrackedParameter]) -> HybridModel:
    """The model with tracked parameters as its last measured disturbances; their fitted values are the nominal ones.

    Raises:
        InputError: If a parameter is unknown.

    Example:
        >>> x, u, p = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("p")
        >>> level = (Signal("x", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, p=p, x_next=x + p * u,
        ...     xdot=p * u, y=x, parameters=(Parameter("k", 2.0, "m/s", 1.0, 4.0),))
        >>> tracking = with_tracked(tank, [TrackedParameter("k", 0.1, relative=True)])
        >>> float(tracking.step(0.0, [], 1.0, [3.0], tracking.p)[0])
        3.0
    """
    n_w, places = model.n_w, _places(model, tracked)
    x, h, u, _, p = step_symbols(model)
    w = ca.MX.sym("w", n_w + len(places))
    parameters = [model.parameters[i] for i in places]
    return at_arguments(
        model, [x, h, u, w, p], [x, h, u, w[:n_w], _exchanged(p, places, w[n_w:])],
        side_by_side=None if model.side_by_side is None else _side_by_side(model.side_by_side, n_w, places),
        disturbances=(*model.disturbances, *(_signal(p) for p in parameters)),
        nominal_w=(*model.w.tolist(), *(p.value for p in parameters)),
    )  # fmt: skip


def _signal(p: Parameter) -> Signal:
    return Signal(p.name, p.unit) if p.fixed else Signal(p.name, p.unit, p.lower, p.upper)


def _exchanged(p: ca.MX, places: Sequence[int], values: ca.MX) -> ca.MX:
    every = ca.vertsplit(p)
    for i, value in zip(places, ca.vertsplit(values), strict=True):
        every[i] = value
    return ca.vertcat(*every)


def _side_by_side(base: SideBySide, n_w: int, places: Sequence[int]) -> SideBySide:
    def make(n: int, by: Mapping[str, Sequence[str]]) -> ManyPoints:
        own = base(n, by)

        def evaluate(x: Array, h: Array, u: Array, w: Array, p: Array) -> tuple[Array, ...]:
            chosen = np.array(p)
            chosen[:, list(places)] = w[:, n_w:]
            return own(x, h, u, np.ascontiguousarray(w[:, :n_w]), chosen)

        return evaluate

    return make


def shown_parameters(model: HybridModel) -> tuple[str, ...]:
    """Names of the parameters in the output equation, which cannot be tracked."""
    _, places = model.output.jac_sparsity(0, 3).get_triplet()
    return tuple(model.parameters[i].name for i in sorted(set(places)))


def tracking_model(model: HybridModel, tracked: Sequence[TrackedParameter]) -> HybridModel:
    """The model of the observer: deviations ``theta`` of the tracked parameters are the last hidden states.

    Raises:
        InputError: If a parameter is unknown, or appears in the output equation.
    """
    places, n_h = _places(model, tracked), model.n_h
    x, _, u, w, p = step_symbols(model)
    shown = shown_parameters(model)
    if names := [one.name for one in tracked if one.name in shown]:
        raise InputError(
            f"tracked parameters: {', '.join(names)} appear in the output equation of model {model.name}, which is not "
            "supported. Declare a disturbance of the output instead (disturbance_model), or Parameter(..., "
            "varies=False) [HM-ESTIMATE-023]"
        )
    h = ca.MX.sym("h", n_h + len(places))
    theta = h[n_h:]
    chosen = _exchanged(p, places, tracked_values(model, tracked, theta))
    decay = ca.DM([one.decay(model.dt) for one in tracked])
    point = [x, h, u, w, p]
    x_next, h_next = inlined(model.step, [x, h[:n_h], u, w, chosen])
    step = step_function("step", point, [x_next, ca.vertcat(h_next, decay * theta)])
    return replace(
        model,
        step=step,
        xdot=ca.Function("xdot", point, [ca.densify(model.xdot(x, h[:n_h], u, w, chosen))]),
        with_jacobian=with_slopes(step),
        side_by_side=None,
    )


def _places(model: HybridModel, tracked: Sequence[TrackedParameter]) -> list[int]:
    """Indices of the tracked parameters among the model's."""
    names, known = [one.name for one in tracked], [p.name for p in model.parameters]
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"tracked parameters: at least one is needed, and none twice, got {names} [HM-ESTIMATE-024]"
        )
    for name in names:
        if name not in known:
            raise InputError(
                f"tracked parameters: model {model.name} has no parameter {name!r}; known names: "
                f"{', '.join(known) or 'none'} [HM-ESTIMATE-025]"
            )
    return [known.index(name) for name in names]


@dataclass(frozen=True)
class TrackedEstimate(Estimate):
    """An estimate with tracked parameters: the last entries of ``w`` are their values [their units].

    Args:
        inner: Estimate of the filter of :func:`tracking_model`.
        std: Standard deviations ``(n_t,)`` of the tracked deviations: relative, or in the parameters' units.
    """

    inner: Estimate
    std: Array = field(default_factory=lambda: np.zeros(0))


class TrackingFilter:
    """A filter that also tracks parameters.

    It estimates ``(x, h, theta, d)`` by a filter of the same kind as the given one, with its noise. Its estimates are
    those of ``model``, whose last disturbances ``w`` are the tracked parameters: a controller or a prediction of this
    model uses the tracked values.

    Offset-free control needs no more than before: ``d`` is detectable if the rank condition of
    :func:`~hybrid_mpc.estimate.offset_free.offset_free` holds for constant parameters. It is checked at the fitted
    values and at deviations of two standard deviations. At rest outputs cannot distinguish parameters and disturbances;
    whichever combination explains them leads to the same targets.

    Args:
        filter: A filter without tracked parameters.
        tracked: The parameters to track.

    Raises:
        InputError: If a parameter is unknown, given twice, or appears in the output equation; if the disturbances are
            not detectable for other values of the parameters.

    Example:
        ``TrackingFilter(kit.observer("prior"), [TrackedParameter("gain", 0.2, relative=True)])``
    """

    def __init__(self, filter: Filter, tracked: Sequence[TrackedParameter]) -> None:
        base, self.tracked = filter.model, tuple(tracked)
        self.model = with_tracked(base, tracked)
        """The model of the estimates."""
        own, self._n_h, self._n_w = tracking_model(base, tracked), base.n_h, base.n_w
        self._check_detectable(base)
        filters = filter.filters if isinstance(filter, SwitchingFilter) else (filter,)
        made = [self._extended(one, own) for one in filters]
        self.inner: Filter = (
            SwitchingFilter(made, filter.transition) if isinstance(filter, SwitchingFilter) else made[0]
        )
        """The filter over ``(x, h, theta, d)``."""
        theta = ca.MX.sym("theta", len(self.tracked))
        self._values = ca.Function("values", [theta], [tracked_values(base, tracked, theta)])

    def _check_detectable(self, base: HybridModel) -> None:
        """Refuse disturbances that are detectable at the fitted parameters alone."""
        if not base.n_d or not distinguishable(base).detectable:
            return  # without disturbances, or refused already where the filter was made
        for sign in (-CHECKED, CHECKED):
            theta = ca.DM([sign * one.std for one in self.tracked])
            values = ca.evalf(tracked_values(base, self.tracked, ca.MX(theta))).full().ravel().tolist()
            moved = dict(zip([one.name for one in self.tracked], values, strict=True))
            parameters = tuple(replace(p, value=moved.get(p.name, p.value)) for p in base.parameters)
            found = distinguishable(replace(base, parameters=parameters))
            if not found.detectable:
                raise InputError(
                    f"tracked parameters: at {', '.join(f'{k} = {v:.3g}' for k, v in moved.items())} "
                    f"{found.why_undetectable}. Track fewer parameters, or declare other disturbances [HM-ESTIMATE-026]"
                )

    def _extended(self, filter: ExtendedKalmanFilter, model: HybridModel) -> ExtendedKalmanFilter:
        """The same filter with the tracked parameters."""
        n_x, n_z = model.n_x, model.n_x + self._n_h
        noise, first = np.sqrt(filter.noise[0]), np.sqrt(filter.first)
        std = np.array([one.std for one in self.tracked])
        rest = np.array([1.0 - math.exp(-2.0 * model.dt / one.time) for one in self.tracked])
        return filter.same_on(
            model, sigma_y=np.sqrt(filter.noise[1]), sigma_x=noise[:n_x], sigma_x0=first[:n_x],
            sigma_d=noise[n_z:], sigma_d0=first[n_z:],
            sigma_h=np.append(noise[n_x:n_z], std * np.sqrt(rest)), sigma_h0=np.append(first[n_x:n_z], std),
        )  # fmt: skip

    def start(self, y: ArrayLike, t: float = 0.0, *, w: ArrayLike | None = None) -> TrackedEstimate:
        """First estimate; the parameters have their fitted values. See :meth:`ExtendedKalmanFilter.start`."""
        return self._outer(self.inner.start(y, t, w=self._measured(w)))

    def predict(self, estimate: Estimate, u: ArrayLike) -> TrackedEstimate:
        """Estimate one period later with the input ``u`` ``(n_u,)`` held."""
        return self._outer(self.inner.predict(self._own(estimate).inner, u))

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> TrackedEstimate:
        """Estimate after the measurement ``y`` ``(n_y,)``."""
        return self.assess(estimate, y, u)[0]

    def assess(
        self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None
    ) -> tuple[TrackedEstimate, float]:
        """:meth:`correct`, and the log-likelihood of the measurement, without its constant."""
        after, likelihood = self.inner.assess(self._own(estimate).inner, y, u)
        return self._outer(after), likelihood

    def update(
        self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike, *, w: ArrayLike | None = None
    ) -> TrackedEstimate:
        """:meth:`predict`, then :meth:`correct`; ``w`` ``(n_w,)`` without the tracked parameters, or with them, which
        are ignored.
        """
        return self._outer(self.inner.update(self._own(estimate).inner, y, u_prev, w=self._measured(w)))

    def measuring(self, predicted: Estimate, w: ArrayLike | None) -> TrackedEstimate:
        """The prediction with the disturbances ``w`` that were measured at its time."""
        return self._outer(self.inner.measuring(self._own(predicted).inner, self._measured(w)))

    def _measured(self, w: ArrayLike | None) -> Array | None:
        if w is None:
            return None
        values = np.asarray(w, dtype=float).ravel()
        with_them = values.size == self._n_w + len(self.tracked)
        return sampled(values[: self._n_w] if with_them else values, (self._n_w,), "w")

    def _own(self, estimate: Estimate) -> TrackedEstimate:
        if not isinstance(estimate, TrackedEstimate):
            raise InputError(
                "TrackingFilter: the estimate is of another filter. Begin with start() of this filter. "
                "[HM-ESTIMATE-027]"
            )
        return estimate

    def _outer(self, inner: Estimate) -> TrackedEstimate:
        """The estimate as one of the model with tracked parameters as disturbances."""
        n_h, n_t, n_x = self._n_h, len(self.tracked), inner.x.size
        theta = slice(n_x + n_h, n_x + n_h + n_t)
        rest = np.r_[0 : n_x + n_h, n_x + n_h + n_t : len(inner.P)]
        values = self._values(inner.h[n_h:]).full().ravel()
        return TrackedEstimate(
            inner.t, inner.x, inner.h[:n_h], inner.d, inner.P[np.ix_(rest, rest)], inner.innovation, inner.nis,
            inner, np.sqrt(np.maximum(np.diag(inner.P)[theta], 0.0)), w=np.append(inner.w, values),
        )  # fmt: skip
