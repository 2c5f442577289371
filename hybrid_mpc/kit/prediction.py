"""Settings that predictions of recordings need besides the models: columns, smoother of the initial state, bands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.scales import SmootherSettings
from hybrid_mpc.machine.specification import DataSpec

Array = NDArray[np.float64]
SHARE = 0.9
"""Nominal coverage of a band: share of the measurements within it."""


@dataclass(frozen=True)
class Bands:
    """Half widths of a band as a function of the parts of the variance: ``scale sqrt(sum_m weights_m parts_m)``.

    Args:
        weights: Weight of each part, by output ``(n_y, m)``.
        scale: Half width over the standard deviation, by output.
        constant: Half width of a band of constant width, over the noise of the sensor. Default: unknown.
        share: Nominal coverage. Default: 0.9.
    """

    weights: tuple[tuple[float, ...], ...]
    scale: tuple[float, ...]
    constant: tuple[float, ...] = ()
    share: float = SHARE

    def of_constant_width(self) -> Bands:
        """A band of constant width with the same nominal coverage; see :func:`~hybrid_mpc.identify.bands.fit_bands`."""
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
class Predicting(SmootherSettings):
    """Settings that predictions of a recording need besides the models, with those of the warm-up's smoother.

    Args:
        data: How recordings are read; its ``free_run`` is the length of the run's free runs.
        corrects: States whose rates a network may correct.
        bands: Bands around free runs, by model. Default: none.
        longest: Length [s] of the longest free run of their calibration. Default: 0, unknown.
    """

    data: DataSpec
    corrects: tuple[str, ...]
    bands: Mapping[str, Bands] = field(default_factory=dict)
    longest: float = 0.0
