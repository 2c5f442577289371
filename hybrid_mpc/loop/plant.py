"""What a simulated loop is closed around: the plant behind its delays and faults, and the previews."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.errors import InputError
from hybrid_mpc.loop.faults import Fault, corrupt_input, corrupt_measurement

if TYPE_CHECKING:
    from hybrid_mpc.control.ocp import OCP
    from hybrid_mpc.loop.faults import Fault

Array = NDArray[np.float64]
Preview = Callable[[Array], Array]


class Machine:
    """The plant with its sensors, actuators, faults and delays; unlike the rest it keeps its state in itself.

    Args:
        plant: The machine.
        x0: Initial state ``(n_x,)``.
        seed: Seed of the plant and of the measurement noise.
        n_y: Number of outputs.
        faults: May be empty.
        dt: Period [s].
        sensor_delay: Periods.
        input_delay: Periods.

    Raises:
        InputError: If a delay is not a whole number of periods or negative, or a measurement's shape does
            not fit.
    """

    def __init__(
        self, plant: Plant, x0: Array, seed: int, n_y: int, faults: Sequence[Fault], dt: float,
        sensor_delay: int, input_delay: int,
    ) -> None:  # fmt: skip
        self._plant, self._n_y, self._faults, self._dt = plant, n_y, faults, dt
        self._rng = np.random.default_rng(seed)
        self.state = plant.reset(x0, seed)
        self._on_the_way = [self._sensor() for _ in range(sensor_delay)]
        self._input_delay = input_delay
        self._y = np.full(n_y, np.nan)
        self._commands: list[Array] = []
        self._acting: Array = np.zeros(0)

    def _sensor(self) -> Array:
        return fitting(self._plant.measure(self.state, self._rng), self._n_y, "the plant's measurement")

    def measure(self, t: float) -> Array:
        """What arrives at ``t``."""
        self._on_the_way.append(self._sensor())
        self._y = corrupt_measurement(self._faults, t, self._on_the_way.pop(0), self._y)
        return self._y

    def rest(self, u: Array) -> None:
        """The input ``u`` was held before the start."""
        self._commands = [u] * self._input_delay
        self._acting = u

    def command(self, u: Array) -> tuple[Array, Array]:
        """The input that acts from now on when ``u`` is commanded, and the one that acted before."""
        self._commands.append(u)
        before, self._acting = self._acting, self._commands.pop(0)
        return self._acting, before

    def advance(self, t: float) -> None:
        """One period on."""
        self.state = self._plant.step(self.state, corrupt_input(self._faults, t, self._acting), self._dt)


class Previews:
    """Reference and weight factors over the horizon, in their shapes.

    Args:
        reference: ``t (n,) -> (n, n_x)``, with ``n_p`` more columns where the economic stage cost has parameters.
        weight: ``t (n,) -> (n, n_x)`` for the factors on ``q``, or None for 1.
        ocp: The problem.
        horizon: Periods of preview, or None for the problem's.
        dt: Period [s].
        end: End of the run [s]; where values beyond it are not finite, the last before them is held.

    Raises:
        InputError: If the horizon is negative, or a shape does not fit.

    Example:
        >>> ocp = OCP(2, [1.0], [1.0], [0.0], [-1.0], [1.0])
        >>> ends = Previews(lambda t: np.where(t < 1.05, t, np.nan)[:, None], None, ocp, None, 0.1, 1.0)
        >>> ends(0.9)[0].ravel().round(6)
        array([0.9, 1. , 1. ])
    """

    def __init__(
        self, reference: Preview, weight: Preview | None, ocp: OCP, horizon: int | None, dt: float, end: float
    ) -> None:
        steps = ocp.horizon if horizon is None else horizon
        if steps < 0:
            raise InputError(f"horizon must not be negative, got {horizon}")
        self._reference, self._weight, self._n_x, self._end = reference, weight, ocp.n_x, end
        self._columns = ocp.n_x + ocp.n_p
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


def fitting(values: ArrayLike, size: int, name: str) -> Array:
    """``values`` as a vector ``(size,)``; NaN is allowed.

    Raises:
        InputError: If the shape is another; ``name`` says whose.
    """
    array: Array = np.array(values, dtype=np.float64)
    if array.shape != (size,):
        raise InputError(f"{name} has shape {array.shape}, the model needs {(size,)}")
    return array


class Plant(Protocol):
    """The machine in simulation. Its state is its own affair; ``truth`` gives the model's states.

    It uses numpy, scipy and casadi only, and its own integrator with its own tolerance.
    """

    def reset(self, x0: Array, seed: int) -> Any:
        """Plant state at rest within itself at the model state ``x0`` ``(n_x,)`` [SI]."""

    def step(self, state: Any, u: Array, dt: float) -> Any:
        """Plant state after ``dt`` [s] with the input ``u`` ``(n_u,)`` held."""

    def measure(self, state: Any, rng: np.random.Generator) -> Array:
        """Measured outputs ``(n_y,)`` with sensor noise drawn from ``rng``."""

    def truth(self, state: Any) -> Array:
        """True model states ``(n_x,)``."""

    def hidden(self, state: Any) -> Array:
        """True internal states ``(n_h,)`` in the order of the scenario's oracle model (may be empty)."""
