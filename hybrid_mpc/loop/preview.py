"""What the loop looks ahead at: reference and weight factors over the horizon."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError

Array = NDArray[np.float64]
Preview = Callable[[Array], Array]
"""Values ``(n, columns)`` at the times ``t (n,)`` [s]."""


class Previews:
    """Reference and weight factors over the horizon, in their shapes; arguments are those of a ``Loop``.

    Where values beyond the ``end`` of the run [s] are not finite, the last before them is held.
    """

    def __init__(
        self, reference: Preview | ArrayLike | None, weight: Preview | None, ocp: OCP, horizon: int | None,
        dt: float, end: float,
    ) -> None:  # fmt: skip
        steps = ocp.horizon if horizon is None else horizon
        if steps < 0:
            raise InputError(f"horizon must not be negative, got {horizon}")
        self._reference, self._weight, self._end = _function_of(reference, ocp), weight, end
        self._n_x, self._columns = ocp.n_x, ocp.n_x + ocp.n_p
        self._ahead: Array = np.arange(steps + 1, dtype=np.float64) * dt

    def __call__(self, t: float) -> tuple[Array, Array | None]:
        """Reference and factors (None for 1) from ``t`` on."""
        times = t + self._ahead
        x_ref = self._over(self._reference, times, "reference", self._columns)
        weight = None if self._weight is None else self._over(self._weight, times, "weight", self._n_x)
        return x_ref, weight

    def _over(self, preview: Preview, times: Array, name: str, columns: int) -> Array:
        values = np.array(preview(times), dtype=np.float64)
        if values.shape != (times.size, columns):
            raise InputError(f"{name} returns {values.shape}, needed: {(times.size, columns)}")
        beyond = (times > self._end + 1e-9) & ~np.all(np.isfinite(values), axis=1)
        if beyond.any():
            last = int(np.argmax(beyond)) - 1
            ended = values[last] if last >= 0 else np.asarray(preview(np.array([self._end])), float)[0]
            values[beyond] = ended
        return values


def _function_of(reference: Preview | ArrayLike | None, ocp: OCP) -> Preview:
    """The reference as a function of time, also where a set-point or nothing was given."""
    if callable(reference):
        return reference
    columns = ocp.n_x + ocp.n_p
    goal = np.zeros(columns) if reference is None else np.asarray(reference, dtype=np.float64)
    if goal.shape != (columns,):
        raise InputError(
            f"reference: a function of time or a set-point of shape {(columns,)} needed, got shape {goal.shape}"
        )
    return lambda t: np.tile(goal, (len(t), 1))
