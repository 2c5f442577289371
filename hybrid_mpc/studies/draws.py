"""What differs from draw to draw of a study: parameters of the plant, and faults of random kind, size and instant."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_mpc.closed_loop.faults import SIGNAL_TARGETS, Fault
from hybrid_mpc.errors import InputError
from hybrid_mpc.job.loops import Intervals
from hybrid_mpc.records import known, record

LATE = "late"
"""A target beside those of :class:`~hybrid_mpc.closed_loop.Fault`: solves miss their deadline."""


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault and how large it gets.

    Args:
        target: Target of a :class:`~hybrid_mpc.closed_loop.Fault`, or ``"late"``: solves miss their deadline.
        low: Smallest size.
        high: Largest size; drawn uniformly between.
        signed: Whether it takes either sign. Default: no.
        ramp: Time [s] over which it grows. Default: at once.
        length: Shortest and longest duration [s] of this kind, which then always ends. Default: the common one.

    Raises:
        InputError: If the target is unknown or a range is empty.

    Example:
        >>> FaultKind("plant_friction", 1.5, 4.0).signed
        False
    """

    target: str
    low: float = 0.0
    high: float = 0.0
    signed: bool = False
    ramp: float = 0.0
    length: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.target != LATE and not str(self.target).startswith("plant_"):
            known(self.target, (*SIGNAL_TARGETS, LATE), "fault target")
        _span((self.low, self.high), f"random fault {self.target}: low to high")
        if self.length is not None:
            span = _span(self.length, f"random fault {self.target}: length", above=0.0)
            object.__setattr__(self, "length", span)


@dataclass(frozen=True)
class RandomFaults:
    """Faults that a draw takes at random.

    Args:
        kinds: What can happen; mappings of :class:`FaultKind`'s fields are taken too.
        at_once: Fewest and most kinds in one draw. Default: 1 to 3.
        start: Earliest and latest instant [s] at which one begins. Default: 1.4 to 2.
        length: Shortest and longest duration [s] of one that ends. Default: 0.2 to 2.
        lasting: Share of those that never end. Default: a half.

    Raises:
        InputError: If there is no kind, more are asked for than there are, or a range is empty.

    Example:
        >>> some = RandomFaults([{"target": "input_gain", "low": 0.7, "high": 0.9}], at_once=(1, 1))
        >>> faults, late = some.drawn(np.random.default_rng(0))
        >>> faults[0].target, 0.7 <= faults[0].value <= 0.9, late
        ('input_gain', True, ())
    """

    kinds: Sequence[FaultKind | Mapping[str, Any]]
    at_once: Sequence[int] = (1, 3)
    start: Sequence[float] = (1.4, 2.0)
    length: Sequence[float] = (0.2, 2.0)
    lasting: float = 0.5

    def __post_init__(self) -> None:
        kinds = tuple(
            k if isinstance(k, FaultKind) else record(FaultKind, k, f"random_faults.kinds[{i}]")
            for i, k in enumerate(self.kinds)
        )
        object.__setattr__(self, "kinds", kinds)
        object.__setattr__(self, "start", _span(self.start, "random_faults: start", least=0.0))
        object.__setattr__(self, "length", _span(self.length, "random_faults: length", above=0.0))
        fewest, most = (int(n) for n in _span(self.at_once, "random_faults: at_once", least=0.0))
        object.__setattr__(self, "at_once", (fewest, most))
        if most < 1 or most > len(kinds):
            raise InputError(f"random_faults: at_once goes up to {most}; there are {len(kinds)} kinds")
        if not 0.0 <= self.lasting <= 1.0:
            raise InputError(f"random_faults: lasting is a share from 0 to 1, got {self.lasting}")

    def drawn(self, rng: np.random.Generator) -> tuple[tuple[Fault, ...], Intervals]:
        """Faults, and the intervals [s] in which solves are late."""
        n = int(rng.integers(self.at_once[0], self.at_once[1] + 1))
        faults, late = [], []
        for i in rng.choice(len(self.kinds), size=n, replace=False).tolist():
            kind = self.kinds[i]
            assert isinstance(kind, FaultKind)
            size, start = rng.uniform(kind.low, kind.high), float(rng.uniform(self.start[0], self.start[1]))
            sign = float(rng.choice([-1.0, 1.0])) if kind.signed else 1.0
            shortest, longest = kind.length or self.length
            length, lasts = rng.uniform(shortest, longest), rng.random() < self.lasting
            end = math.inf if lasts and kind.length is None else start + float(length)
            if kind.target == LATE:
                late.append((start, end))
            else:
                faults.append(Fault(start, end, kind.target, float(sign * size), ramp=kind.ramp))
        return tuple(faults), tuple(late)

    def examples(self) -> tuple[Fault, ...]:
        """The largest fault of each kind, to be checked against a plant."""
        found = []
        for kind in self.kinds:
            assert isinstance(kind, FaultKind)
            if kind.target != LATE:
                found.append(Fault(0.0, 1.0, kind.target, kind.high, ramp=kind.ramp))
        return tuple(found)


def generator(seed: int, draw: int, what: str) -> np.random.Generator:
    """Random numbers of one thing in one draw, whatever else is drawn.

    Example:
        >>> float(generator(0, 3, "m").random()) == float(generator(0, 3, "m").random())
        True
    """
    key = hashlib.sha256(f"{seed}/{draw}/{what}".encode()).digest()
    return np.random.default_rng(int.from_bytes(key[:16], "big"))


def factors(vary: Sequence[tuple[str, float]], seed: int, draw: int) -> tuple[tuple[str, float], ...]:
    """Factors of the plant's parameters, uniform in ``1 - span`` to ``1 + span``.

    Args:
        vary: Parameters with the span of each.
        seed: Seed of the study's draws.
        draw: Number of the draw.

    Example:
        >>> [(name, round(factor, 3)) for name, factor in factors([("m", 0.2)], seed=0, draw=1)]
        [('m', 1.194)]
    """
    return tuple(
        (name, float(1.0 + span * generator(seed, draw, name).uniform(-1.0, 1.0))) for name, span in vary
    )


def _span(
    values: Sequence[float], what: str, *, least: float = -math.inf, above: float = -math.inf
) -> tuple[float, float]:
    """Two numbers in order.

    Raises:
        InputError: If they are not.
    """
    try:
        low, high = (float(v) for v in values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: two numbers are needed, got {values!r}") from error
    if not (math.isfinite(low) and math.isfinite(high) and low <= high and low >= least and low > above):
        raise InputError(f"{what}: [{low}, {high}] is no range of numbers that is allowed here")
    return low, high
