"""What the loop looks ahead at: reference, weight factors and measured disturbances over the horizon."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.limits import check_function, floats, sampled

Array = NDArray[np.float64]
Preview = Callable[[Array], Array]
"""Values ``(n, columns)`` at the times ``t (n,)`` [s]."""


class Previews:
    """Reference and weight factors over the horizon, in their shapes; arguments are those of a ``Loop``.

    Without ``ocp.preview`` they are those of the instant alone. Where values beyond the ``end`` of the run [s] are not
    finite, the last before them is held. ``standing`` ``(columns,)`` is the reference where none is given.
    """

    def __init__(
        self, reference: Preview | ArrayLike | None, weight: Preview | None, ocp: OCP, dt: float, end: float,
        standing: Array,
    ) -> None:  # fmt: skip
        if weight is not None:
            check_function(weight, "weight")
        self._reference, self._weight = _function_of(reference, standing), weight
        self._end = float(sampled(end, (), "end"))
        self._n_x, self._columns = ocp.n_x, ocp.columns
        self._ahead: Array = np.arange(ocp.horizon + 1 if ocp.preview else 1, dtype=np.float64) * dt

    def __call__(self, t: float) -> tuple[Array, Array | None]:
        """Reference and factors (None for 1) from ``t`` on."""
        times = t + self._ahead
        x_ref = self._over(self._reference, times, "reference", self._columns)
        weight = None if self._weight is None else self._over(self._weight, times, "weight", self._n_x)
        return x_ref, weight

    def _over(self, preview: Preview, times: Array, name: str, columns: int) -> Array:
        values = floats(preview(times), f"what {name} returns")
        if values.shape != (times.size, columns):
            raise InputError(f"{name} returns {values.shape}, needed: {(times.size, columns)} [HM-LOOP-031]")
        beyond = (times > self._end + 1e-9) & ~np.all(np.isfinite(values), axis=1)
        if beyond.any():
            last = int(np.argmax(beyond)) - 1
            ended = (
                values[last]
                if last >= 0
                else floats(preview(np.array([self._end])), f"what {name} returns")[0]
            )
            values[beyond] = ended
        return values


class Forecast:
    """Measured disturbances ``(N, n_w)`` from an instant on, where the problem previews them and a forecast is given.

    Args:
        w: ``t (n,) [s] -> (n, n_w)``; None: there is no forecast.
        ocp: The problem.
        n_w: Number of measured disturbances.
        dt: Period [s].

    Raises:
        InputError: If there is a forecast but nothing to forecast.
    """

    def __init__(self, w: Preview | None, ocp: OCP, n_w: int, dt: float) -> None:
        if w is not None and not n_w:
            raise InputError("w: a forecast of measured disturbances given, the model has none [HM-LOOP-032]")
        if w is not None:
            check_function(w, "w")
        self._w = w if ocp.preview_w else None
        self._n_w, self._ahead = n_w, np.arange(ocp.horizon, dtype=np.float64) * dt

    def __call__(self, t: float) -> Array | None:
        """Disturbances from ``t`` on; None: those measured last are held."""
        if self._w is None:
            return None
        return sampled(self._w(t + self._ahead), (self._ahead.size, self._n_w), "what w returns")


def held(values: Array, first: Array) -> Array:
    """Rows ``(m, n)`` in which what is not finite is the value before it, at the beginning ``first`` ``(n,)``."""
    rows, last = values.copy(), first
    for row in rows:
        last = np.where(np.isfinite(row), row, last)
        row[:] = last
    return rows


def _function_of(reference: Preview | ArrayLike | None, standing: Array) -> Preview:
    """The reference as a function of time, also where a set-point or nothing was given."""
    if callable(reference):
        check_function(reference, "reference")
        return reference
    goal = standing if reference is None else sampled(reference, standing.shape, "the reference")
    return lambda t: np.tile(goal, (len(t), 1))
