"""The simulated machine: the plant, its delays and its faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.loop.faults import Fault, corrupt_input, corrupt_measurement
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.limits import sampled
from hybrid_mpc.model.model import HybridModel

Array = NDArray[np.float64]


class Plant(Protocol):
    """Interface of a simulated machine. Its state may be anything; ``truth`` gives the model's states.

    It uses numpy, scipy and casadi only, with its own integrator and tolerance. A machine with measured disturbances
    gets them as a fourth argument, ``step(state, u, dt, w)`` with ``w`` ``(n_w,)`` held over the period.
    """

    def reset(self, x0: Array, seed: int) -> Any:
        """Plant state at the model state ``x0`` ``(n_x,)`` [SI], with its internal states in equilibrium."""

    def step(self, state: Any, u: Array, dt: float) -> Any:
        """Plant state after ``dt`` [s] with the input ``u`` ``(n_u,)`` held.

        If the prior has measured disturbances, the call is ``step(state, u, dt, w)`` with ``w`` ``(n_w,)``.
        """

    def measure(self, state: Any, rng: np.random.Generator) -> Array:
        """Measured outputs ``(n_y,)`` with sensor noise drawn from ``rng``."""

    def truth(self, state: Any) -> Array:
        """True model states ``(n_x,)``."""

    def hidden(self, state: Any) -> Array:
        """True internal states ``(n_h,)`` in the order of the scenario's oracle model (may be empty)."""


class ModelState(NamedTuple):
    """State and hidden state of a model, with the input and the measured disturbances of the last period."""

    x: Array
    h: Array
    u: Array
    w: Array


@dataclass(frozen=True)
class ModelPlant:
    """A model in place of the machine, for a controller of another model. A loop with it shows whether two models
    agree, and nothing about the machine.

    Args:
        model: The model.
        sigma: Standard deviations of its sensors' white noise ``(n_y,)`` [output units].

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("u", "m/s"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> plant = ModelPlant(tank, (0.0,))
        >>> state = plant.step(plant.reset(np.array([0.5]), seed=0), np.array([0.25]), 1.0)
        >>> plant.truth(state), plant.measure(state, np.random.default_rng(0))
        (array([0.75]), array([0.75]))
    """

    model: HybridModel
    sigma: tuple[float, ...]

    def reset(self, x0: Array, seed: int) -> ModelState:
        """State at ``x0`` ``(n_x,)``, with the hidden state in equilibrium for the operating point's input."""
        m = self.model
        return ModelState(np.asarray(x0, dtype=float), hidden_fixed_point(m, x0, m.u0), m.u0, m.w)

    def step(self, state: ModelState, u: Array, dt: float, w: Array | None = None) -> ModelState:
        """The state after one period."""
        m, now = self.model, self.model.w if w is None else w
        x, h = (part.full().ravel() for part in m.step(state.x, state.h, u, now, m.p))
        return ModelState(x, h, np.asarray(u, dtype=float), now)

    def measure(self, state: ModelState, rng: np.random.Generator) -> Array:
        """Outputs with noise, within the ranges of the sensors that declare one."""
        m = self.model
        y = m.output(state.x, state.u, state.w, m.p).full().ravel() + self.sigma * rng.standard_normal(m.n_y)
        low, high = np.array([s.saturation or (-np.inf, np.inf) for s in m.outputs]).T
        return np.asarray(np.clip(y, low, high))

    def truth(self, state: ModelState) -> Array:
        """The model's state."""
        return state.x

    def hidden(self, state: ModelState) -> Array:
        """Empty: a model as plant has no internal states of an oracle."""
        return np.zeros(0)


class SimulatedMachine:
    """A plant behind the delays [periods] and faults of its sensors and actuators, whose names are ``outputs`` and
    ``inputs``. It changes in place.
    """

    def __init__(
        self, plant: Plant, x0: Array, seed: int, outputs: Sequence[str], inputs: Sequence[str],
        faults: Sequence[Fault], dt: float, sensor_delay: int, input_delay: int,
    ) -> None:  # fmt: skip
        self._plant, self._n_y, self._faults, self._dt = plant, len(outputs), faults, dt
        self._outputs, self._inputs = outputs, inputs
        self._rng = np.random.default_rng(seed)
        self.state = plant.reset(x0, seed)
        self._measurements = [self._read_sensor() for _ in range(sensor_delay)]
        self._input_delay = input_delay
        self._y = np.full(self._n_y, np.nan)
        self._commands: list[Array] = []
        self._acting: Array = np.zeros(0)

    def measure(self, t: float) -> Array:
        """The measurement that arrives at ``t``."""
        self._measurements.append(self._read_sensor())
        self._y = corrupt_measurement(self._faults, t, self._measurements.pop(0), self._y, self._outputs)
        return self._y

    def rest(self, u: Array) -> None:
        """The input ``u`` has acted before the start."""
        self._commands = [u] * self._input_delay
        self._acting = u

    def command(self, u: Array) -> tuple[Array, Array]:
        """The input that acts from now on when ``u`` is commanded, and the one that acted before."""
        self._commands.append(u)
        before, self._acting = self._acting, self._commands.pop(0)
        return self._acting, before

    def advance(self, t: float, w: Array | None = None) -> None:
        """One period on, with measured disturbances ``w`` ``(n_w,)`` if there are any."""
        u, plant = corrupt_input(self._faults, t, self._acting, self._inputs), self._plant
        step: Any = plant.step
        self.state = step(self.state, u, self._dt, *(() if w is None else (w,)))

    def _read_sensor(self) -> Array:
        return sampled(self._plant.measure(self.state, self._rng), (self._n_y,), "the plant's measurement")
