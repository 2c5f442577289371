"""Pictures of found terms over the recordings."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.explanation import FittedParameter, TermPicture
from hybrid_mpc.identify.term_fits import Array, TermFits, Terms, index_of
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import named
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.machine.terms import At, Term, extended, signals_at

DRAWN = 200
"""Number of points of a term's picture."""


class TermPictures:
    """Pictures of a model's terms over its recordings."""

    def __init__(
        self,
        fits: TermFits,
        terms: Terms,
        parameters: Sequence[FittedParameter],
        known: Sequence[Trajectory],
    ) -> None:
        self.base, self.terms, self.parameters = fits.base, terms, parameters
        columns = [np.concatenate([getattr(t, key) for t in known]) for key in ("x", "u", "w", "xdot")]
        whole = np.isfinite(np.hstack(columns)).all(axis=1)
        chosen = np.flatnonzero(whole)
        chosen = chosen[evenly(len(chosen), DRAWN)]
        self.bare_x, self.u, self.w, self.xdot = (c[chosen] for c in columns)
        self.x, _, _ = fits.with_states(terms, (self.bare_x, self.u, self.w))
        self.values = np.array([p.value for p in parameters])
        self.prior = extended(fits.base, *terms)()
        plain = fits.base()
        self.masses = plain.masses if isinstance(plain, MechanicalPrior) else None
        self.n_p = len(plain.parameters)

    def of(self, term: Term) -> TermPicture | None:
        """Picture of one term; None for a term with a state, which is not a curve."""
        if term.state is not None:
            return None
        places = [k for k, p in enumerate(self.parameters) if p.name in term.names]
        value = self._added(term, self.values)
        spread = np.zeros(len(value))
        for k in places:
            moved = self.values.copy()
            moved[k] += self.parameters[k].standard_error
            spread = spread + np.square(self._added(term, moved) - value)
        spread = 2.0 * np.sqrt(spread)
        over, abscissa = self._over(term)
        order = np.argsort(over, kind="stable")
        data = self._left(term)
        shown = () if data is None else tuple((value + data)[order].tolist())
        at, drawn, low, high = (
            tuple(c[order].tolist()) for c in (over, value, value - spread, value + spread)
        )
        return TermPicture(abscissa, self._ordinate(term), at, drawn, low, high, shown)

    def _signal(self, name: str) -> tuple[Signal, Array]:
        for group, values in (
            (self.base.states, self.bare_x), (self.base.inputs, self.u), (self.base.disturbances, self.w),
        ):  # fmt: skip
            for k, signal in enumerate(group):
                if signal.name == name:
                    return signal, values[:, k]
        raise KeyError(name)

    def _over(self, term: Term) -> tuple[Array, str]:
        """Values and label of the horizontal axis."""
        if term.place == "output":
            k = index_of(self.base, term)
            return self._shown(without=term)[:, k], self.base.outputs[k].label
        if term.place == "inertia":
            k = index_of(self.base, term)
            return self.xdot[:, k], f"d({term.of})/dt [{self.base.states[k].unit}/s]"
        options = {} if term.made is None else term.made.options
        name = str(options.get("source") or options.get("one") or term.of)
        positions = {self.base.states[v].name: self.base.states[q].name for q, v in self.base().kinematics}
        if term.place == "potential" or (term.made is not None and term.made.maker == "coulomb_by_position"):
            name = positions[term.of]
        signal, values = self._signal(name)
        return values, signal.label

    def _ordinate(self, term: Term) -> str:
        unit = signals_at(self.base, term.place)[index_of(self.base, term)].unit
        if term.place in ("input", "disturbance", "output"):
            return f"{term.name} [{unit}]"
        if term.place == "rate":
            return f"{term.name} [{unit}/s]"
        return f"{term.name} [{'N' if unit.startswith('m') else 'N m'}]"

    def _zeroed(self, term: Term, values: Array) -> Array:
        own = values.copy()
        own[[k for k, p in enumerate(self.parameters) if p.name in term.names]] = 0.0
        return own

    def _shown(self, values: Array | None = None, without: Term | None = None) -> Array:
        own = self.values if values is None else values
        own = own if without is None else self._zeroed(without, own)
        return np.asarray(self.prior.equations.output(self.x.T, self.u.T, self.w.T, own).full().T)

    def _rates(self, values: Array) -> Array:
        n_x = self.bare_x.shape[1]
        return np.asarray(self.prior.equations.xdot(self.x.T, self.u.T, self.w.T, values).full().T)[:, :n_x]

    def _as_force(self, rates: Array, term: Term) -> Array:
        """Convert rates to a force on the term's axis if the term is a force; else return the rate of its state."""
        k = index_of(self.base, term)
        if term.place == "rate" or self.masses is None:
            return rates[:, k]
        half = self.bare_x.shape[1] // 2
        found = np.empty(len(rates))
        for i, (q, own) in enumerate(zip(self.bare_x[:, :half], rates[:, half:], strict=True)):
            found[i] = (self.masses(q, self.values[: self.n_p]).full() @ own)[k - half]
        return found

    def _added(self, term: Term, values: Array) -> Array:
        """Value of a term at every point ``(n,)``."""
        zero = self._zeroed(term, values)
        if term.place == "output":
            k = index_of(self.base, term)
            return (self._shown(values) - self._shown(zero))[:, k]
        if term.place in ("input", "disturbance"):
            point = [ca.DM(v) for v in (self.bare_x.T, self.u.T, self.w.T, self.values[: self.n_p])]
            own = ca.DM(self._signal(term.of)[1]).T
            given = [float(v) for v, p in zip(values, self.parameters, strict=True) if p.name in term.names]
            acting = term.law(At.of(self.base(), point, own), named(term.names, given))
            return np.asarray((acting - own).full().ravel())
        return self._as_force(self._rates(values) - self._rates(zero), term)

    def _left(self, term: Term) -> Array | None:
        """Residual of the rate or force at the term's place ``(n,)``; None for terms of inputs, disturbances, outputs.

        The states are smoothed without the terms, so they follow a wrong sensor, and residuals of outputs do not show
        it.
        """
        if term.place in ("input", "disturbance", "output"):
            return None
        return self._as_force(self.xdot - self._rates(self.values), term)
