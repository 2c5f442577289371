"""How a machine's recordings are read, and what their parts are used for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from hybrid_mpc.errors import InputError

Role = Literal["train", "valid", "test", "nominal"]
"""What a part of a recording is used for, see :class:`Window`."""


@dataclass(frozen=True)
class Window:
    """A part of a recording and what it is used for.

    Args:
        start: First time [s] in the recording's own time.
        end: Last time [s].
        role: ``"train"``, ``"valid"``, ``"test"``, or ``"nominal"``: known to be free of disturbances but used
            for no free run (standing at an unstable point, say); the monitor must stay quiet there.
    """

    start: float
    end: float
    role: Role


@dataclass(frozen=True)
class DataSpec:
    """How a machine's recordings are read.

    Args:
        time: Column of the time stamps [s].
        inputs: Columns of the inputs, in the order of the prior's inputs (zero-order hold).
        outputs: Columns of the measured positions, in the order of the prior's outputs.
        dt: Model period [s]; declaring it is the request to resample to it.
        max_gap: Longest distance [s] between two samples; a run is cut where it is exceeded.
        smoothing: Length [s] of the local polynomial that first smooths and differentiates the positions; the
            prior is fitted to that, then smooths them once more by its own equations.
        warm_up: Measured past [s] that starts every free run: x(0) is smoothed from it, h warmed up on
            it, and none of it is scored.
        windows: Known windows by file stem. A recording that is not named here is split by ``fractions``.
        fractions: Shares of training, validation and test samples, in this order of time.
        free_run: Length [s] of the free runs that judge a model, started every fifth of it. Default: each
            test trajectory as a whole. Where an unstable point multiplies every error, short runs from many
            starts say more than one long one.
        inputs_of: Input columns of single recordings, by file stem, where they differ from ``inputs``.
        units: Units of columns that are not in seconds or in their signal's unit, by column: ``"ms"``, ``"deg"``, or
            the factor as a number (:mod:`hybrid_mpc.data.units`).
        largest_delay: Longest delay [s] of the inputs that the main job searches for, with the prior's parameters, and
            then gives the deployed models. Default 0: none is searched, the input acts at once.

    Raises:
        InputError: If a length is not positive, the delay is negative, or the fractions do not sum to one.
    """

    time: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    max_gap: float
    smoothing: float
    warm_up: float
    windows: Mapping[str, tuple[Window, ...]] = field(default_factory=dict)
    fractions: tuple[float, float, float] = (0.6, 0.2, 0.2)
    free_run: float | None = None
    inputs_of: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str | float] = field(default_factory=dict)
    largest_delay: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.largest_delay < math.inf:
            raise InputError(
                f"data specification: largest_delay must be 0 s or more, got {self.largest_delay}"
            )
        for name in ("dt", "max_gap", "smoothing", "warm_up"):
            if not getattr(self, name) > 0:
                raise InputError(f"data specification: {name} must be positive, got {getattr(self, name)}")
        if self.free_run is not None and not self.free_run > 0:
            raise InputError(
                f"data specification: free_run must be positive or left out, got {self.free_run}"
            )
        if abs(sum(self.fractions) - 1.0) > 1e-9 or min(self.fractions) < 0:
            raise InputError(f"data specification: fractions must sum to 1, got {self.fractions}")
