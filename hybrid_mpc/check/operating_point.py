"""Check that a prior's operating point is an equilibrium, and search for the equilibria next to one that is not."""

from __future__ import annotations

from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.check.prior import DRIFT
from hybrid_mpc.identify.simulation import rest_of
from hybrid_mpc.identify.smooth import output_slope
from hybrid_mpc.machine.prior import OperatingPoint, Prior
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.equilibrium import Descent, RateEquations, rate_search
from hybrid_mpc.rules import counted

Array = NDArray[np.float64]
Places = NDArray[np.int64]
SHOWN, WRITTEN = 6, 10
"""Significant digits of a point in a message and in a file."""
MOST = 20
"""Most choices of held outputs that are tried."""


def drift_at_rest(prior: Prior, second: float) -> str:
    """The states that move at the operating point, as text; empty if none moves, or no point is given.

    ``second`` is the time [s] within which a state may drift by a hundredth of its size.
    """
    if prior.operating_point is None:
        return ""
    x, u, w = rest_of(prior)
    rates = prior.equations.xdot(x, u, w, prior.p).full().ravel()
    return ", ".join(
        f"{s.name} changes by {r:.3g} {s.unit} per second"
        for s, r, size in zip(prior.states, rates, sizes_of(prior.states, x), strict=True)
        if abs(r) * second > DRIFT * size
    )


def held_states(prior: Prior) -> OperatingPoint | None:
    """The equilibrium at the operating point's input that Newton's method finds from its states; None if there is none
    within the ranges.
    """
    return _search(prior, np.arange(len(prior.states)))


def holding_input(prior: Prior) -> OperatingPoint | None:
    """The input within its range that holds the operating point's states; None if there is none.

    States that belong to terms, such as that of a lag, follow the input.
    """
    return _search(prior, _places_of_inputs(prior))


def held_outputs(prior: Prior) -> tuple[OperatingPoint, tuple[str, ...]] | None:
    """An equilibrium with the operating point's values of as many outputs as there are inputs, else of fewer, and the
    names of these outputs; None if there is none within the ranges. An output that shows one state can be held.
    """
    x, u, w = rest_of(prior)
    by_x = output_slope(prior.equations)(x, u, w, prior.p)[1].full()
    shown = [
        (signal.name, int(np.flatnonzero(row)[0]))
        for signal, row in zip(prior.outputs, by_x, strict=True)
        if np.flatnonzero(row).size == 1
    ]
    for count in range(min(len(u), len(shown)), 0, -1):
        for some in islice(combinations(shown, count), MOST):
            free = np.delete(np.arange(len(x) + len(u)), [state for _, state in some])
            if (point := _search(prior, free)) is not None:
                return point, tuple(name for name, _ in some)
    return None


def _places_of_inputs(prior: Prior) -> Places:
    """Places of the inputs, and of the states of terms, in ``(x, u)``."""
    own = len(getattr(type(prior), "base", type(prior)).states)
    return np.arange(own, len(prior.states) + len(prior.inputs))


def steady_point(prior: Prior) -> OperatingPoint | None:
    """Equilibrium that replaces an operating point that is not one; None if none is found.

    It has the point's states with the input that holds them, else its values of as many outputs as there are inputs,
    else the steady states under its input, else it is the nearest one.

    Example:
        >>> class Tank(Prior):
        ...     states = outputs = (Signal("level", "m", 0.0, 2.0),)
        ...     inputs, parameters = (Signal("inflow", "m/s", 0.0, 1.0),), ()
        ...     operating_point = OperatingPoint((1.0,), (0.3,))
        ...     def xdot(self, x, u, w, p):
        ...         return (u.inflow - 0.5 * x.level,)
        >>> steady_point(Tank()), held_states(Tank())
        (OperatingPoint(x=(1.0,), u=(0.5,), w=()), OperatingPoint(x=(0.6,), u=(0.3,), w=()))
    """
    if (point := holding_input(prior)) is not None:
        return point
    if (found := held_outputs(prior)) is not None:
        return found[0]
    return held_states(prior) or _search(prior, np.arange(len(prior.states) + len(prior.inputs)))


def both_ways(prior: Prior) -> str:
    """The two equilibria next to an operating point that is not one, as text to copy."""
    held, holding = held_states(prior), holding_input(prior)
    states = "none within the ranges" if held is None else f"x = {_numbers(held.x)}"
    inputs = _why_not_held(prior) if holding is None else f"u = {_numbers(holding.u)}"
    if holding is not None and any(
        abs(a - b) > 1e-9 * max(1.0, abs(b)) for a, b in zip(holding.x, rest_of(prior)[0], strict=True)
    ):
        inputs += f" with x = {_numbers(holding.x)}"
    return f"Steady states under your input: {states}. Input that holds your states: {inputs}"


def place_of(prior: Prior) -> str:
    """Where an operating point with all states belongs: in the class, or after ``extended`` if terms have states."""
    base = getattr(type(prior), "base", type(prior))
    if len(base.states) == len(prior.states):
        return "operating_point"
    own = f"the class that extended({base.__name__}, ...) returns"
    return f"{own}: NAME.operating_point = OperatingPoint(x=(...), u=(...))"


def _why_not_held(prior: Prior) -> str:
    """Why no input holds the operating point's states, and an equilibrium with one of its outputs, if there is one."""
    text = "none within its range" if _found(prior, _places_of_inputs(prior)).steady else (
        f"none, even without limits: {counted(len(prior.inputs), 'input')} cannot make "
        f"{counted(len(prior.states), 'rate')} zero at these states"
    )  # fmt: skip
    if (found := held_outputs(prior)) is None:
        return text
    point, names = found
    return f"{text}. Steady state at your {' and '.join(names)}: x = {_numbers(point.x)}, u = {_numbers(point.u)}"


def sizes_of(signals: tuple[Signal, ...], at: Array) -> Array:
    """Size of each signal: its range, else its value, at least 1."""
    ranges = np.array([s.upper - s.lower for s in signals], dtype=np.float64)
    return np.where(np.isfinite(ranges), ranges, np.maximum(np.abs(at), 1.0))


def _search(prior: Prior, free: Places) -> OperatingPoint | None:
    """The equilibrium within the ranges that a search over the free ones of ``(x, u)`` finds."""
    (x, u, w), n_x = rest_of(prior), len(prior.states)
    found, near = _found(prior, free), np.concatenate([x, u])
    signals = (*prior.states, *prior.inputs)
    if not found.steady or not all(s.lower <= v <= s.upper for s, v in zip(signals, found.v, strict=True)):
        return None
    # values that were not searched stay exact
    values = [float(f"{v:.{WRITTEN}g}") + 0.0 if k in free else float(near[k]) for k, v in enumerate(found.v)]
    return OperatingPoint(tuple(values[:n_x]), tuple(values[n_x:]), tuple(w.tolist()))


def _found(prior: Prior, free: Places) -> Descent:
    """End of the search over the free ones of ``(x, u)`` from the operating point, without ranges."""
    x, u, w = rest_of(prior)
    ranges = np.array([s.upper - s.lower for s in prior.inputs], dtype=np.float64)
    sizes = np.where(np.isfinite(ranges), ranges, np.where(u != 0, np.abs(u), 1.0))
    near, scale = np.concatenate([x, u]), np.concatenate([sizes_of(prior.states, x), sizes])
    equations = RateEquations(prior.equations.xdot, w, prior.p)
    return rate_search(equations, scale, near, np.zeros(len(x)), free=free).descend(near, x)


def _numbers(values: tuple[float, ...]) -> str:
    return str([float(f"{v:.{SHOWN}g}") for v in values])
