"""Library of physical terms that a prior may lack, with bounds and scales from the recordings. No torch in here.

The structure and units of a prior, not its names, determine which terms apply.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.identify.simulation import Points
from hybrid_mpc.machine import terms as laws
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Parameter, Signal
from hybrid_mpc.machine.terms import Place, Term
from hybrid_mpc.machine.units import parse_unit

Array = NDArray[np.float64]
WIDEST, NARROWEST = 0.05, 0.005
"""Largest and smallest width of the sign change of dry friction, over the speed's size. Between them, the width is half
the change of the speed in a period: the recordings do not resolve less, and the integration needs no shorter steps."""
EXPONENTS = 0.25, 4.0
"""Bounds of the exponent of a loss; an outlet has 0.5, radiation 4."""
STEEP = 0.9
"""Largest relative change of slope by a curve at the ends of its signal: the curve never reverses there."""


@dataclass(frozen=True)
class Candidate:
    """A term in one or several forms (for example with different exponents); the best form is used.

    Args:
        name: Name of the candidate.
        forms: The forms, with distinct names of parameters.
    """

    name: str
    forms: tuple[Term, ...]


def library(prior: Prior, points: Points, dt: float, length: float) -> tuple[Candidate, ...]:
    """Terms that a prior may lack, with bounds and scales from the recordings.

    Structure and units of the prior determine which terms apply:

    - a state whose rate is another state is the position of an axis; most kinds of friction act on axes only;
    - dry friction and losses act on other states of both signs, such as the speed of a fan;
    - forces and potentials need a :class:`~hybrid_mpc.machine.mechanical.MechanicalPrior`;
    - radiation and free convection act on temperatures;
    - an overflow acts on a level: a state that is never negative and not a temperature;
    - a periodic angle has no loss, and its value does not act on other states.

    Args:
        prior: The prior with fitted values.
        points: States ``(n, n_x)``, inputs ``(n, n_u)`` and disturbances ``(n, n_w)`` of the recordings.
        dt: Model period [s].
        length: Length [s] of the free runs that evaluate models; the largest lag is a quarter of it.
    """
    found = _Library(prior, points, dt, length).candidates()
    return tuple(Candidate(one.name, (one,)) if isinstance(one, Term) else one for one in found)


class _Library:
    """Scales of the signals, and the terms with these scales."""

    def __init__(self, prior: Prior, points: Points, dt: float, length: float) -> None:
        self.prior, self.dt, self.length = prior, dt, length
        self.own = len(
            getattr(type(prior), "base", type(prior)).states
        )  # a law acts on no state of another term
        self.x, self.u, self.w = points
        rates = prior.equations.xdot(self.x.T, self.u.T, self.w.T, prior.p).full().T
        self.rates = self.accelerations = np.sqrt(np.mean(np.square(rates), axis=0))
        self.changes = dt * self.rates
        self.units = [f"{s.unit}/s" for s in prior.states]
        self.positions = {v: q for q, v in prior.kinematics}
        self.mechanical = isinstance(prior, MechanicalPrior)
        if isinstance(prior, MechanicalPrior):
            half = self.x.shape[1] // 2
            mass = prior.masses.map(len(self.x))(
                self.x[:, :half].T, np.tile(prior.p, (len(self.x), 1)).T
            ).full()
            mass = mass.reshape(half, len(self.x), half).swapaxes(0, 1)
            forces = np.einsum("nij,nj->ni", mass, rates[:, half:])
            self.rates = np.concatenate([self.rates[:half], np.sqrt(np.mean(np.square(forces), axis=0))])
            self.units[half:] = ["N" if s.unit.startswith("m") else "N m" for s in prior.states[half:]]

    def candidates(self) -> Iterator[Term | Candidate]:
        """All candidates; a term alone is one of a single form."""
        exact = set(self.positions.values())
        for i, state in enumerate(self.prior.states[: self.own]):
            if i in self.positions:
                yield from self._axis(i, state)
            elif i not in exact and i in self.prior.corrected:
                yield from self._process(i, state)
        for i, signal in enumerate(self.prior.inputs):
            yield from self._input(i, signal)
        for i, signal in enumerate(self.prior.disturbances):
            yield from self._disturbance(i, signal)
        for i, signal in enumerate(self.prior.outputs):
            yield from self._output(i, signal)

    def _weight(
        self, i: int, key: str, size: float, per: Sequence[str] = (), positive: bool = False, words: str = ""
    ) -> Parameter:
        """Weight of a law of this size and unit ``per`` in the rate of state ``i``, or in the force on its axis."""
        # bound of a term's weight: largest effect of the term, over the state's rate in the recordings
        most, name = 3.0 * self.rates[i] / max(size, 1e-12), f"{key}_{self.prior.states[i].name}"
        return Parameter(name, 0.0, over(self.units[i], *per), 0.0 if positive else -most, most, words)

    def _axis(self, i: int, state: Signal) -> Iterator[Term | Candidate]:
        own, q = state.name, self.positions[i]
        v, position = self.x[:, i], self.x[:, q]
        speed, turning = float(np.sqrt(np.mean(v**2))), self.prior.states[q].unit == "rad"
        if not speed > 0:
            return
        place: Place = "force" if self.mechanical else "rate"
        width = min(WIDEST * speed, max(0.5 * self.changes[i], NARROWEST * speed))
        weight = partial(self._weight, i)
        v_unit, q_unit = state.unit, state.unit.removesuffix("/s")
        at: dict[str, Any] = {"width": width, "place": place}
        yield laws.coulomb(own, weight("F_c", 1.0, positive=True, words="dry friction"), **at)
        yield laws.asymmetric(own, weight("F_a", 1.0, words="direction dependence of dry friction"), **at)
        yield laws.viscous(own, weight("d", speed, (v_unit,), True, "viscous friction"), place=place)
        yield laws.viscous_by_direction(
            own, weight("d_a", speed, (v_unit,), words="viscous friction by direction"), place=place
        )
        yield laws.quadratic(own, weight("c", speed**2, (v_unit, v_unit), True, "drag"), place=place)
        yield Candidate(
            f"Stribeck friction of {own}",
            tuple(
                laws.stribeck(
                    own,
                    weight(f"F_s{k}", 0.3, positive=True, words="friction near rest"),
                    speed=share * speed,
                    **at,
                )
                for k, share in enumerate((0.1, 0.3, 1.0), 1)
            ),
        )
        for k, load in enumerate(("driven", "resting", "both"), 1):
            mu = Parameter(f"mu_{k}_{own}", 0.0, "-", 0.0, 2.0, f"friction by {load} load")
            yield laws.loaded(own, mu, load=load, **at)
        centre, span = float(np.mean(position)), float(np.std(position)) or 1.0
        sizes: tuple[float, float] = (0.7, 0.7) if turning else (span, span**2)
        per: tuple[tuple[str, ...], ...] = ((), ()) if turning else ((q_unit,), (q_unit, q_unit))
        names = [
            weight(f"F_{k}", size, p, words="position dependence of dry friction")
            for k, size, p in zip((1, 2), sizes, per, strict=True)
        ]
        if turning or not self.prior.states[q].periodic:  # the term's sine is that of radians
            yield laws.coulomb_by_position(
                own, *names, turning=turning, centre=0.0 if turning else centre, **at
            )
        yield laws.offset(own, weight("F_0", 1.0, words="offset"), place=place)
        if not self.mechanical:
            return
        most = self._weight(i, "J", float(self.accelerations[i]), positive=True, words="inertia")
        yield laws.inertia(own, replace(most, unit="kg m^2" if self.units[i] == "N m" else "kg"))
        if turning:
            yield laws.gravity_error(
                own, weight("G_s", 0.7, words="gravity by sin q"), weight("G_c", 0.7, words="by cos q")
            )
            yield Candidate(
                f"cogging of {own}",
                tuple(
                    laws.cogging(
                        own, weight(f"C_{n}s", 0.7, words="cogging by sin"), weight(f"C_{n}c", 0.7, words="by cos"),
                        periods=float(n),
                    )
                    for n in (2, 3, 4, 6, 8, 12)
                ),
            )  # fmt: skip
        if self.prior.states[q].periodic:
            return
        stiff = (q_unit,)
        yield laws.spring(own, weight("k", span, stiff, words="stiffness"), centre=centre)
        low, high = np.quantile(position, (0.02, 0.98))
        reach = 0.1 * (high - low)
        yield laws.elastic_end(
            own, weight("k_u", reach, stiff, True, "upper end"), edge=float(high - reach), upper=True
        )
        yield laws.elastic_end(
            own, weight("k_l", reach, stiff, True, "lower end"), edge=float(low + reach), upper=False
        )

    def _process(self, i: int, state: Signal) -> Iterator[Term | Candidate]:
        own, values, weight = state.name, self.x[:, i], partial(self._weight, i)
        temperature = (parse_unit(state.unit) or (1.0, ()))[1] == (0, 0, 0, 0, 1, 0, 0)
        yield laws.offset(own, weight("r_0", 1.0, words="offset of the rate"), place="rate")
        if state.lower < 0 and not (
            state.periodic or temperature
        ):  # such as a speed without a position, or a current
            size = float(np.sqrt(np.mean(values**2)))
            dry = weight("F_c", 1.0, positive=True, words="dry friction")
            yield laws.coulomb(own, dry, width=0.05 * size or 1.0, place="rate")
        if not state.periodic:
            yield from self._losses(i, state, temperature)
            yield self._storage(i, state)
        signals = [(s, c) for s, c in self._signals() if s.name != own and not s.periodic]
        for s, c in signals:
            scale, centre = float(np.std(c)), float(np.mean(c))
            if scale > 0:
                k = weight(f"k_{_short(s.name)}", scale, (s.unit,), words=f"of {s.name}")
                yield laws.coupling(own, k, source=s.name, centre=centre)
        everything = signals if state.periodic else [(state, values), *signals]
        for a, (one, c) in enumerate(everything):
            for two, d in everything[a:]:
                size = float(np.std(c) * np.std(d))
                if size > 0:
                    key = f"k_{_short(one.name)}_{_short(two.name)}"
                    k = weight(key, size, (one.unit, two.unit), words=f"of {one.name} and {two.name}")
                    centres = float(np.mean(c)), float(np.mean(d))
                    yield laws.product(own, k, one=one.name, two=two.name, centres=centres)

    def _losses(self, i: int, state: Signal, temperature: bool) -> Iterator[Term | Candidate]:
        """Losses of a state: to its surroundings, by radiation, by overflow."""
        own, values, weight = state.name, self.x[:, i], partial(self._weight, i, positive=True)
        low, high = float(values.min()), float(values.max())
        forms = []
        references: list[tuple[str | float, Array]] = (
            [(0.0, np.zeros(len(values)))]
            if not temperature and (low >= 0 or state.lower < 0)
            else [(low, np.full(len(values), low))]
        )
        references += [(s.name, c) for s, c in self._alike(i, state.unit)]
        for number, (reference, other) in enumerate(references, 1):
            far = float(np.sqrt(np.mean((values - other) ** 2))) or 1.0
            for exponent, key in ((1.0, "a"), (0.5, "b"), (2.0, "c")):
                if temperature and exponent == 0.5:
                    continue
                k = weight(f"k_{number}{key}", far, (state.unit,), words="loss")
                # the exponent is free: 1 to 1.33 for free convection, 0.5 for an outlet
                n = Parameter(f"n_{number}{key}_{own}", exponent, "-", *EXPONENTS, "exponent of the loss")
                forms.append(laws.loss(own, k, n, scale=far, reference=reference))
        yield Candidate(f"loss of {own}", tuple(forms))
        if temperature:
            kelvin = 0.0 if state.unit == "K" else 273.15
            size = abs((np.mean(values) + kelvin) ** 4 - (low + kelvin) ** 4) / 1e8 or 1.0
            k = replace(weight("e", float(size), words="radiation"), unit=f"{state.unit}/s 1e8/K^4")
            yield laws.radiation(own, k, kelvin=kelvin, surroundings=low)
        width = 0.02 * (high - low) or 1.0
        if state.lower < 0 or temperature:
            return
        edges = [low + share * (high - low) for share in (0.6, 0.75, 0.9)]
        yield Candidate(
            f"overflow of {own}",
            tuple(
                laws.overflow(
                    own,
                    weight(f"s_{n}", high - edge, (state.unit,), words="overflow"),
                    Parameter(f"edge_{n}_{own}", edge, state.unit, 0.5 * (low + high), high, "edge"),
                    width=width,
                )
                for n, edge in enumerate(edges, 1)
            ),
        )

    def _storage(self, i: int, state: Signal) -> Candidate:
        forms = []
        for number, share in enumerate((0.05, 0.3), 1):
            k = Parameter(
                f"k_s{number}_{state.name}",
                0.0,
                "1/s",
                0.0,
                1.0 / (4 * self.dt),
                "exchange with a second capacity",
            )
            tau = Parameter(
                f"tau_s{number}_{state.name}", max(share * self.length, 2 * self.dt), "s", self.dt, self.length,
                "time constant of the second capacity",
            )  # fmt: skip
            inner = _ranged(state, self.x[:, i], f"{state.name}_{number}")
            forms.append(laws.storage(state.name, k, tau, state=inner))
        return Candidate(f"second capacity of {state.name}", tuple(forms))

    def _disturbance(self, i: int, signal: Signal) -> Iterator[Term | Candidate]:
        own, values = signal.name, self.w[:, i]
        spread, centre = float(np.std(values)), float(np.mean(values))
        most = Parameter(
            f"o_{own}", 0.0, signal.unit, -2 * spread or -1.0, 2 * spread or 1.0, "offset of the disturbance"
        )
        yield laws.disturbance_offset(own, most)
        if not spread > 1e-9 * max(abs(centre), 1e-300):
            return
        gain = Parameter(f"g_{own}", 0.0, "-", -2.0, 2.0, "relative error of the disturbance's gain")
        yield laws.disturbance_gain(own, gain, centre=centre)
        acting = _ranged(signal, values, f"{own}_acting")
        yield laws.disturbance_lag(own, self._time(f"tau_{own}", "lag of the disturbance"), state=acting)

    def _time(self, name: str, words: str) -> Parameter:
        return Parameter(name, 2 * self.dt, "s", self.dt, max(0.25 * self.length, 4 * self.dt), words)

    def _signals(self) -> Iterator[tuple[Signal, Array]]:
        for group, values in (
            (self.prior.states[: self.own], self.x[:, : self.own]),
            (self.prior.inputs, self.u),
            (self.prior.disturbances, self.w),
        ):
            yield from zip(group, values.T, strict=True)

    def _alike(self, i: int, unit: str) -> Iterator[tuple[Signal, Array]]:
        """Other states and disturbances of the same unit."""
        for k, (s, c) in enumerate(self._signals()):
            if s.unit == unit and k != i and s.name not in {one.name for one in self.prior.inputs}:
                yield s, c

    def _input(self, i: int, signal: Signal) -> Iterator[Term | Candidate]:
        own, values = signal.name, self.u[:, i]
        spread, centre = float(np.std(values)), float(np.mean(values))
        if not spread > 1e-9 * max(abs(centre), 1e-300):
            return

        def of(key: str, most: float, unit: str = "-", words: str = "", positive: bool = False) -> Parameter:
            return Parameter(f"{key}_{own}", 0.0, unit, 0.0 if positive else -most, most, words)

        tau = self._time(f"tau_{own}", "lag of the input")
        yield laws.input_lag(own, tau, state=_ranged(signal, values, f"{own}_acting"))
        late = self._time(f"late_{own}", "delay of the input")
        yield laws.input_delay(own, late, state=_ranged(signal, values, f"{own}_late"))
        yield laws.input_gain(own, of("g", 0.9, words="relative error of the gain"))
        yield laws.input_offset(own, of("o", 2 * spread, signal.unit, "offset of the input"))
        if (values < 0).any() and (values > 0).any():
            yield laws.gain_by_direction(own, of("g_a", 0.9, words="direction dependence of the gain"))
            yield laws.dead_zone(own, of("z", spread, signal.unit, "dead zone", True), width=0.05 * spread)
        size = float(np.abs(values).max())
        k = Parameter(
            f"sat_{own}",
            0.0,
            over("1", signal.unit, signal.unit),
            0.0,
            9.0 / size**2,
            "saturation of the input",
        )
        yield laws.saturation(own, k)
        middle, span = (centre if centre > 2 * spread else 0.0), 2 * spread
        # slope of the curve: 1 + 2 c |u - middle| / span
        farthest = max(abs(end - middle) for end in _ends(signal, values))
        least = -min(0.5, 0.5 * STEEP * span / farthest)
        bend = Parameter(f"g_c_{own}", 0.0, "-", least, 0.5, "curvature of the input characteristic")
        yield laws.input_curve(own, bend, centre=middle, span=span)

    def _output(self, i: int, signal: Signal) -> Iterator[Term | Candidate]:
        y = self.prior.equations.output(self.x.T, self.u.T, self.w.T, self.prior.p).full()[i]
        own, spread = signal.name, float(np.std(y))
        if not spread > 0:
            return
        unit = signal.unit

        def of(key: str, most: float, own_unit: str = "-", words: str = "") -> Parameter:
            return Parameter(f"{key}_{own}", 0.0, own_unit, -most, most, words)

        tau = self._time(f"tau_{own}", "lag of the sensor")
        yield laws.output_lag(own, tau, state=_ranged(signal, y, f"{own}_shown"))
        yield laws.output_gain(own, of("s_g", 0.5, words="relative error of the sensor's gain"))
        yield laws.output_offset(own, of("s_o", 2 * spread, unit, "offset of the sensor"))
        low, high = (float(v) for v in np.quantile(y, (0.0, 1.0)))
        # slope of the curve: 1 + bend (2 y - low - high)
        farthest = max(abs(2 * end - low - high) for end in _ends(signal, y))
        bend = of("s_b", STEEP / farthest, over("1", unit), "curvature of the sensor characteristic")
        yield laws.output_curve(own, bend, lower=low, upper=high)


def _ranged(signal: Signal, values: Array, name: str) -> Signal:
    """State of a term that follows a signal: an estimator needs its range."""
    low, high = _ends(signal, values)
    return Signal(name, signal.unit, low, high)


def _ends(signal: Signal, values: Array) -> tuple[float, float]:
    """Range of a signal, in which a curve must not reverse: its bounds, else the recordings and a margin."""
    low, high = float(values.min()), float(values.max())
    # how far beyond the recordings no curve of a signal without bounds may reverse, over the range of the recordings
    more = 0.5 * (high - low)
    return (
        min(low, signal.lower) if math.isfinite(signal.lower) else low - more,
        max(high, signal.upper) if math.isfinite(signal.upper) else high + more,
    )


def _short(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


def over(unit: str, *by: str) -> str:
    """Divide a unit by others.

    Example:
        >>> over("N m", "rad/s"), over("m/s", "m/s"), over("1", "V", "V"), over("m/s", "m", "m")
        ('N m s/rad', '1', '1/V/V', '1/s/m')
    """
    up, *down = unit.split("/")
    ups = [up]
    for one in by:
        first, *rest = one.split("/")
        ups += rest
        down.append(first)
    for word in list(down):
        if word in ups:
            ups.remove(word)
            down.remove(word)
    words = [word for word in ups if word not in ("-", "1", "")]
    return " ".join(words or ["1"]) + "".join(f"/{word}" for word in down if word not in ("-", "1", ""))
