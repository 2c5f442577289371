"""The record of a closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

    from hybrid_mpc.closed_loop.guard import Switch
    from hybrid_mpc.model import HybridModel

Array = NDArray[np.float64]
UNITS = {"stage_cost": "1/s", "violation": "W", "level": "W"}


@dataclass(frozen=True)
class ClosedLoopResult:
    """A closed loop of n periods; row k belongs to ``t_k = k dt``.

    Args:
        dt: Period [s].
        t: ``(n,)`` [s].
        x: True states ``(n, n_x)`` at ``t_k``.
        y: Measurements ``(n, n_y)`` as they arrived, faults and noise included; NaN for a dropout.
        u: Commanded inputs ``(n, n_u)``, held from ``t_k`` on (with an input delay: from that much later).
        x_hat: Estimated states ``(n, n_x)``; with an input delay of the instant at which ``u`` will act.
        h: Estimated hidden states ``(n, n_h)``.
        d: Estimated input disturbance ``(n, n_u)``.
        reference: Reference ``(n, n_x)`` at ``t_k``.
        source: Name of the :class:`~hybrid_mpc.mpc.Source` of each input.
        status: Name of the :class:`~hybrid_mpc.mpc.Status` of each solve.
        stage_cost: Stage cost ``(n,)`` per second on the true state and the input that acts on it, with the
            weight factors of that instant and without penalties of soft bounds.
        timing_ms: Durations ``(n,)`` [ms] of ``estimate``, ``solve``, ``monitor``, ``prepare`` and ``total``. The only
            field in which two runs may differ.
        violation: Energy violation ``(n,)`` [W]; NaN without a monitor.
        level: Alarm level ``(n,)`` [W]; NaN without a monitor.
        alarm: ``(n,)``, True while the monitor alarms.
        switches: Changes of the guard's mode, in their order. Default: none.
        judged: ``(n,)``, True where the monitor could judge the period. Default: unknown.
        innovation: Innovations of the estimator ``(n, n_y)`` [output units]; NaN where it had none. Default: unknown.
        nis: Normalised innovations squared ``(n,)`` [-]; NaN where there was none. Default: unknown.
        numbers: The monitor's readings as numbers ``(n, columns)``, from which detectors are learned. Default: none.

    Example:
        >>> one = np.ones((2, 1))
        >>> result = ClosedLoopResult(0.1, np.array([0.0, 0.1]), one, one, one, one, one, one, 0 * one,
        ...     ("MPC",) * 2, ("SOLVED",) * 2, np.array([2.0, 4.0]), {},
        ...     one[:, 0], one[:, 0], np.zeros(2, bool))
        >>> round(result.cost, 6), result.tracking_rmse
        (0.6, 1.0)
    """

    dt: float
    t: Array
    x: Array
    y: Array
    u: Array
    x_hat: Array
    h: Array
    d: Array
    reference: Array
    source: tuple[str, ...]
    status: tuple[str, ...]
    stage_cost: Array
    timing_ms: Mapping[str, Array]
    violation: Array
    level: Array
    alarm: NDArray[np.bool_]
    switches: tuple[Switch, ...] = ()
    judged: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    innovation: Array = field(default_factory=lambda: np.zeros((0, 0)))
    nis: Array = field(default_factory=lambda: np.zeros(0))
    numbers: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def mode(self) -> tuple[str, ...]:
        """Name of the guard's mode in each period."""
        names = ["NORMAL"] * len(self.t)
        for switch in self.switches:
            first = int(np.searchsorted(self.t, switch.t - 0.5 * self.dt))
            names[first:] = [switch.after.name] * (len(names) - first)
        return tuple(names)

    @property
    def cost(self) -> float:
        """Closed-loop cost ``J = sum_k stage_cost_k dt`` on the true state."""
        return float(np.sum(self.stage_cost) * self.dt)

    @property
    def tracking_rmse(self) -> float:
        """Root mean square of the true first state's deviation from its reference [its unit]."""
        return float(np.sqrt(np.mean((self.x[:, 0] - self.reference[:, 0]) ** 2)))

    def to_pandas(self, model: HybridModel | None = None) -> pd.DataFrame:
        """One row a period. Needs pandas.

        Args:
            model: Names and units of the columns: ``"x phi [rad]"``, ``"y phi [rad]"``, ``"t [s]"``. Default: numbers
                without units, ``x_0``, ``x_1``, ``t``.

        Raises:
            InputError: If the model has other numbers of states, inputs or outputs.

        Example: ``result.to_pandas(model)["u torque [N m]"]``
        """
        import pandas as pd

        columns: dict[str, object] = {"t" if model is None else "t [s]": self.t}
        for name in ("x", "y", "u", "x_hat", "h", "d", "reference"):
            values = getattr(self, name)
            labels = _labels(name, values.shape[1], model)
            columns.update({label: values[:, i] for i, label in enumerate(labels)})
        for name in ("source", "status", "stage_cost", "violation", "level", "alarm"):
            unit = "" if model is None or name not in UNITS else f" [{UNITS[name]}]"
            columns[name + unit] = getattr(self, name)
        unit = "_ms" if model is None else " [ms]"
        columns.update({f"{name}{unit}": values for name, values in self.timing_ms.items()})
        return pd.DataFrame(columns)


def _labels(name: str, n: int, model: HybridModel | None) -> list[str]:
    if model is None or name == "h":
        return [f"{name}_{i}" for i in range(n)]
    signals = model.outputs if name == "y" else model.inputs if name in ("u", "d") else model.states
    if len(signals) != n:
        raise InputError(
            f"to_pandas: the loop has {n} columns of {name}, the model {model.name} {len(signals)}"
        )
    return [f"{name} {s.name} [{s.unit}]" for s in signals]
