"""What predictions of recordings need beside the models, as plain data: columns, smoother of the first state, bands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import Sizes
from hybrid_mpc.machine.specification import DataSpec

Array = NDArray[np.float64]
SHARE = 0.9
"""Share of the measurements that a band is to hold."""


@dataclass(frozen=True)
class Bands:
    """Half widths of a band as a function of the parts of the variance.

    Args:
        weights: Weight of each part, by output ``(n_y, m)``.
        scale: Half width over the standard deviation, by output.
        constant: The same for a band of constant width, over the noise of the sensor. Default: not known.
        share: Share of the measurements that it is to hold. Default: 90 %.
    """

    weights: tuple[tuple[float, ...], ...]
    scale: tuple[float, ...]
    constant: tuple[float, ...] = ()
    share: float = SHARE

    def of_constant_width(self) -> Bands:
        """A band of one width for all times, as it is calibrated to hold the same share; see
        :func:`~hybrid_mpc.identify.bands.fit_bands`.
        """
        return Bands(
            tuple((1.0, *(0.0 for _ in own[1:])) for own in self.weights),
            self.constant,
            self.constant,
            self.share,
        )

    def half_width(self, parts: Array) -> Array:
        """Half widths ``(n, n_y)`` [output units] of parts ``(n, n_y, m)``."""
        variance = np.einsum("kjm,jm->kj", parts, np.array(self.weights))
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)) * np.array(self.scale))


@dataclass(frozen=True)
class Predicting:
    """What predictions of a recording need beside the models.

    Args:
        data: How recordings are read.
        corrects: States whose rates a network may correct.
        sigma: Noise of each sensor that the smoother of the warm-up assumes [output units].
        walk: Change per period of the unexplained rates that it assumes, by corrected state.
        sizes: Natural sizes of the signals that it assumes.
        fading: What is left of an unexplained rate after a period [-].
        substeps: Runge-Kutta sub-steps a period of the fitted prior.
        bands: Bands around free runs, by model. Default: none were calibrated.
        longest: Length [s] of the longest free run that they were calibrated on. Default: not known.
    """

    data: DataSpec
    corrects: tuple[str, ...]
    sigma: tuple[float, ...]
    walk: tuple[float, ...]
    sizes: Sizes
    fading: float = 1.0
    substeps: int = 0
    bands: Mapping[str, Bands] = field(default_factory=dict)
    longest: float = 0.0
