"""Fits of each recording alone, where scatter between recordings hides what the prior lacks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import evenly
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.fit_warnings import ADD_DELAY, LATE, FittedDelay, fitted_delay
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.starts import START_ITERATIONS
from hybrid_mpc.identify.varying import SHORTEST, WINDOWS_OF_EACH, Varying, find_varying, pieces_of
from hybrid_mpc.identify.windows import WINDOWS, cut_outputs
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
COMPARED = WINDOWS // WINDOWS_OF_EACH
"""Largest number of recordings that are fitted alone, evenly chosen: so that their windows are as many as those of the
fit."""
DIFFERENT = 0.8
"""Error with own values over that with common ones below which a difference is reported: effects that the prior lacks
also change a parameter between recordings; the ratio is then 0.86 and above in examples."""
LISTED = 6
"""Largest number of recordings whose values are listed; beyond this number the smallest and the largest value."""


@dataclass(frozen=True)
class OwnFits:
    """Fits of each recording alone.

    Args:
        recordings: Names of the recordings; of a single one its blocks.
        varying: Parameters that differ between the recordings, by the evidence.
        values: Value of each of them in each recording [its unit].
        ratio: Free-run error with each recording's own values over that with the common ones, over all recordings [-].
        late: Delay of the inputs that a fit of each recording alone shows; empty if a recording does not show it.
    """

    recordings: tuple[str, ...]
    varying: Varying
    values: dict[str, tuple[float, ...]]
    ratio: float
    late: tuple[FittedDelay, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Effects that separate fits show and the common fit hides."""
        each = "block of the recording" if self.varying.blocks else "recording"
        found = []
        if self.late:
            delays, ratios = [one.delay for one in self.late], [max(one.ratios) for one in self.late]
            found.append(
                f"in separate fits to each {each}, inputs seem to act {_span(delays)} s later than recorded: such a "
                f"delay would reduce the error of each fit by a factor of {_span(ratios)}. In the common fit, "
                f"differences between recordings hide the delay. {ADD_DELAY} [HM-IDENTIFY-081]"
            )
        if self.values and self.ratio < DIFFERENT:
            units = {p.name: p.unit for p in self.varying.parameters}
            listed = "; ".join(
                f"{name} [{units[name]}]: {_listed(self.recordings, values)}"
                for name, values in self.values.items()
            )
            found.append(
                f"parameters differ from {each} to {each}: {listed}. With separate values for each {each}, the error "
                f"of free runs falls to {100 * self.ratio:.0f} %. Add missing terms first; then track the parameters "
                "that still differ (hybrid-mpc run --track, docs/tracking.md) [HM-IDENTIFY-082]"
            )
        return tuple(found)


def fit_each(
    make: Callable[..., Prior],
    fit: PriorFit,
    recordings: Sequence[Trajectory],
    *,
    dt: float,
    length: float,
    delay: bool = True,
) -> OwnFits | None:
    """Fit the varying parameters to each recording alone, and look for a late input in each.

    Evidence decides which parameters vary (:func:`~hybrid_mpc.identify.varying.find_varying`). Recordings that are too
    short are left out; of more than ``COMPARED`` recordings, evenly chosen ones are used.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        fit: The fit to all these recordings.
        recordings: The recordings that it was fitted to, inputs as commanded.
        dt: Model period [s].
        length: Longest length [s] of the free runs.
        delay: Whether to look for a late input. Default: True.

    Returns:
        The fits; None if the recordings are too short.

    Example:
        ``fit_each(make, fit, [*train, *valid], dt=0.02, length=2.0).warnings``
    """
    long = WINDOWS_OF_EACH * SHORTEST + math.ceil(LATE) + 1  # samples
    files = sorted({t.file for t in recordings if len(t.t) >= long})
    files = [files[i] for i in evenly(len(files), COMPARED)]
    chosen = [t for t in recordings if t.file in files]
    try:
        varying = find_varying(make, fit, chosen, dt=dt, length=length) if chosen else Varying((), 0)
    except InputError:  # blocks of a single recording are too short
        return None
    if not varying.parameters:
        return None
    pieces, _ = pieces_of(smoothed(make, fit, chosen, dt))

    def known(values: Mapping[str, float] = MappingProxyType({})) -> Prior:
        return make({**fit.values, **values})

    every, own = (OutputFit(known, dt, only=names) for names in (None, varying.names))
    every.least = own.least = max(1, fit.substeps)
    late = every.with_delay(LATE * dt)
    sizes = np.array(fit.smoother(every.prior, dt).sizes.x)
    samples = min(max(len(t.t) for t in part) for part in pieces) - late.lead
    periods, most = (
        min(round(length / dt), samples // WINDOWS_OF_EACH),
        max(WINDOWS_OF_EACH, WINDOWS // len(pieces)),
    )
    thetas, squares, delays = [], np.zeros(2), []
    for part in pieces:
        windows = cut_outputs(part, periods, late.lead, most, every.prior.states, every.prior.outputs)
        problem, common = Shooting(own, windows, sizes), own.scaled(fit.values)
        alone = problem.solve(common, START_ITERATIONS).theta if varying.names else common
        squares += np.square(problem.explained([common, alone])) * windows.y.size
        thetas.append(own.values(alone))
        if delay:
            delays.append(fitted_delay(every, every.scaled(thetas[-1]), [Shooting(late, windows, sizes)]))
    significant = [one for one in delays if one is not None and one.significant]
    return OwnFits(
        tuple(f"block {i}" if varying.blocks else part[0].file for i, part in enumerate(pieces, 1)),
        varying,
        {name: tuple(theta[name] for theta in thetas) for name in varying.names},
        math.sqrt(float(squares[1] / max(squares[0], 1e-300))),
        tuple(significant) if len(significant) == len(pieces) else (),
    )


def _span(values: Sequence[float]) -> str:
    """Smallest and largest value as text.

    Example:
        >>> _span([0.31, 0.24, 0.45]), _span([18.0, 18.01])
        ('0.24 to 0.45', '18')
    """
    low, high = f"{min(values):.2g}", f"{max(values):.2g}"
    return low if low == high else f"{low} to {high}"


def _listed(names: Sequence[str], values: Sequence[float]) -> str:
    """Values of recordings; of many the smallest and the largest.

    Example:
        >>> _listed(["monday", "tuesday"], [0.4, 0.6])
        'monday 0.4, tuesday 0.6'
    """
    order = range(len(names)) if len(names) <= LISTED else (int(np.argmin(values)), int(np.argmax(values)))
    return (", " if len(names) <= LISTED else " to ").join(f"{names[i]} {values[i]:.3g}" for i in order)
