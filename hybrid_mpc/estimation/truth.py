"""The estimator of an oracle: it is told the plant's truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.model import HybridModel


class TrueState:
    """The estimator of an oracle: its "measurement" is the plant's truth ``(x, hidden)``.

    ``closed_loop.simulate`` hands it the true states instead of the sensors' outputs.

    Args:
        model: The oracle model, whose hidden states are the plant's own (a prior has none).

    Example:
        >>> from types import SimpleNamespace
        >>> TrueState(SimpleNamespace(n_x=2, n_h=0, n_u=1, n_y=1)).start(np.array([0.1, 0.2])).x
        array([0.1, 0.2])
    """

    def __init__(self, model: HybridModel) -> None:
        self._model = model

    @property
    def model(self) -> HybridModel:
        """The oracle model."""
        return self._model

    def start(self, y: ArrayLike, t: float = 0.0) -> Estimate:
        """Estimate that is the truth ``y = (x, hidden)``, ``(n_x + n_h,)`` or longer; ``d`` zero.

        Raises:
            InputError: If the plant has fewer hidden states than the model.
        """
        m, z = self._model, np.asarray(y, dtype=float).ravel()
        n_z = m.n_x + m.n_h
        if z.size < n_z:
            raise InputError(f"true state: the plant gives {z.size} states, the oracle model needs {n_z}")
        p, empty = np.zeros((n_z + m.n_u, n_z + m.n_u)), np.full(m.n_y, np.nan)
        return Estimate(float(t), z[: m.n_x], z[m.n_x : n_z], np.zeros(m.n_u), p, empty, float("nan"))

    def predict(self, estimate: Estimate, u: ArrayLike) -> Estimate:
        """The model's own step with ``u`` ``(n_u,)`` held: what an oracle knows of the time ahead."""
        m = self._model
        x, h = (
            v.full().ravel() for v in m.step(estimate.x, estimate.h, np.asarray(u, dtype=float), m.w, m.p)
        )
        return self.start(np.concatenate([x, h]), estimate.t + m.dt)

    def correct(self, estimate: Estimate, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """The truth ``y`` at the estimate's own instant."""
        return self.start(y, estimate.t)

    def update(self, estimate: Estimate, y: ArrayLike, u_prev: ArrayLike) -> Estimate:
        """The truth one period later; ``u_prev`` is not used."""
        return self.start(y, estimate.t + self._model.dt)
