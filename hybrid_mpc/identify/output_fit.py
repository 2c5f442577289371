"""Free parameters and input delay of a prior as one vector, and free runs with derivatives by that vector."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from functools import cached_property, lru_cache
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.identify.delay import NONE
from hybrid_mpc.identify.simulation import Points, Simulation, growth_rate, required_substeps
from hybrid_mpc.identify.windows import OutputWindows
from hybrid_mpc.machine.prior import Prior

Array = NDArray[np.float64]
GROWN = 10.0, 100.0
"""Growth of a small error over the two shortest windows of an unstable machine."""
LOOSE = 30.0
"""Distance of a parameter from its nominal value, in half ranges, that costs as much as one error of one standard
deviation. This pull moves an identifiable parameter by at most a thousandth of its standard error, and keeps a
parameter that is not identifiable at its nominal value."""
Slopes: TypeAlias = Literal["", "x", "all"]
"""Requested derivatives: none, with respect to initial states, or with respect to parameters too."""


class OutputFit:
    """A prior's free parameters and input delay as ``theta``, each over its size, and free runs for ``theta``.

    Args:
        make: Prior class or factory ``(values=None) -> Prior``.
        dt: Model period [s].
        largest_delay: Largest delay [s] of the inputs. Default 0: no delay is fitted.
        only: Names of the parameters to fit. Default: all that are not fixed.
    """

    def __init__(
        self,
        make: Callable[..., Prior],
        dt: float,
        largest_delay: float = 0.0,
        only: Collection[str] | None = None,
    ) -> None:
        self.make, self.prior, self.dt, self.largest = make, make(), dt, largest_delay
        self.free = [p for p in self.prior.parameters if not p.fixed and (only is None or p.name in only)]
        late = [dt] if largest_delay else []
        own = [abs(p.value) if p.value else (p.upper - p.lower) for p in self.free]
        self.unit = np.array([*own, *late])
        self._simulations: dict[tuple[int, ...], Simulation] = {}
        self.points: Points | None = None
        """Points of the recordings, once their states are known."""
        self.least = 1
        """Minimum number of sub-steps a period."""
        self.nominal = (
            np.array([*(p.value for p in self.free), *(0.5 * largest_delay for _ in late)]) / self.unit
        )
        self.lower = np.array([*(p.lower for p in self.free), *(0.0 for _ in late)]) / self.unit
        self.upper = np.array([*(p.upper for p in self.free), *(largest_delay for _ in late)]) / self.unit

    def with_delay(self, largest: float) -> OutputFit:
        """Copy this fit, and also fit a delay of up to ``largest`` [s]."""
        other = OutputFit(self.make, self.dt, largest)
        other._simulations, other.points, other.least = self._simulations, self.points, self.least
        return other

    @property
    def half(self) -> Array:
        """Half ranges of ``theta``."""
        return 0.5 * (self.upper - self.lower)

    @property
    def pull(self) -> Array:
        """Root of the weights of the pull towards the nominal values."""
        return 1.0 / (LOOSE * self.half)

    @property
    def names(self) -> list[str]:
        """Names of the fitted parameters, with ``"delay"`` if it is fitted."""
        return [*(p.name for p in self.free), *(["delay"] if self.largest else [])]

    @property
    def lead(self) -> int:
        """Number of samples before a window that delayed inputs may need."""
        return math.ceil(self.largest / self.dt) + 1 if self.largest else 0

    def values(self, theta: Array) -> dict[str, float]:
        """Values [their units] of all parameters by name, with fixed ones."""
        fitted = {p.name: float(v) for p, v in zip(self.free, theta * self.unit, strict=False)}
        return {**self.prior.values, **fitted}

    def scaled(self, values: Mapping[str, float], delay: float = 0.0) -> Array:
        """Convert values [their units] by name, and the delay [s], to ``theta``."""
        own = [values[p.name] for p in self.free]
        return np.array([*own, *([delay] if self.largest else [])]) / self.unit

    def delay(self, theta: Array) -> float:
        """Delay [s]; 0 below 5 % of a period."""
        found = float(theta[-1] * self.unit[-1]) if self.largest else 0.0
        return found if found >= NONE * self.dt else 0.0

    def substeps(self, theta: Array) -> int:
        """Number of sub-steps a period that the stiffness at ``theta`` requires, at rest and along the recordings."""
        return max(self.least, required_substeps(self.make(self.values(theta)), self.dt, self.points))

    def most_substeps(self, thetas: Array) -> int:
        """Largest number of sub-steps that one of several ``thetas`` ``(m, k)`` requires."""
        return max(self.substeps(one) for one in thetas)

    def reach(self, theta: Array, growth: float = GROWN[-1]) -> float:
        """Time [s] in which a small error grows by ``growth`` at ``theta``, along the recordings. Default: 100."""
        rate = 0.0 if self.points is None else growth_rate(self.make(self.values(theta)), self.points)
        return math.log(growth) / rate if rate > 0 else math.inf

    def outputs(
        self, theta: Array, x: Array, windows: OutputWindows, substeps: int, slopes: Slopes
    ) -> tuple[Array, Array]:
        """Outputs ``(n, T + 1, n_y)`` of free runs from ``x``, and their derivatives ``(n, T + 1, n_y, columns)``.

        ``slopes`` selects the columns: derivatives by ``theta``, then by ``x``; by ``x`` only; or none. Several
        ``theta`` ``(m, k)`` belong to consecutive parts of the windows, all of the same number.
        """
        thetas, n = np.atleast_2d(theta), len(x)
        each = n // len(thetas)
        p = np.repeat(self._every(thetas), each, axis=0)
        acting = [self._acting(one, windows.u[i * each :][:each], windows) for i, one in enumerate(thetas)]
        simulation = self._simulation(tuple(self._free) if slopes == "all" else ())
        given = x, np.concatenate(acting), windows.w, p, substeps
        if not slopes:
            return simulation.values(*given), np.zeros(0)
        y, by = simulation.by_all(*given)
        if slopes == "all":
            with np.errstate(over="ignore"):  # diverging runs are left out later
                by[..., : len(self._free)] *= self.unit[: len(self._free)]
        return y, by

    def _every(self, thetas: Array) -> list[list[float]]:
        """Parameters of the simulation for each of several ``thetas``."""
        return [self._constants(one) for one in thetas]

    def _constants(self, theta: Array) -> list[float]:
        """Parameters of the simulation: the prior's, and a small change of the delay."""
        return [*self.values(theta).values(), 0.0]

    @cached_property
    def _free(self) -> list[int]:
        """Indices of the fitted parameters in :meth:`_constants`."""
        every = [*(p.name for p in self.prior.parameters), "delay"]
        return [every.index(name) for name in self.names]

    def _simulation(self, free: tuple[int, ...]) -> Simulation:
        if free not in self._simulations:
            xdot, output = (delayed(f) for f in (self.prior.equations.xdot, self.prior.equations.output))
            self._simulations[free] = Simulation(xdot, self.dt, free, output)
        return self._simulations[free]

    def _acting(self, theta: Array, commanded: Array, windows: OutputWindows) -> Array:
        """Inputs that act (means over each period) and their derivative by the delay, ``(n, T + 1, 2 n_u)``."""
        n, first = windows.y.shape[1], windows.lead
        if not self.largest:
            u = commanded[:, first : first + n]
            return np.concatenate([u, np.zeros_like(u)], axis=-1)
        delay = float(theta[-1] * self.unit[-1]) / self.dt
        whole = min(math.floor(delay), first - 1)
        younger, older = (commanded[:, first - whole - k : first - whole - k + n] for k in (0, 1))
        share = delay - whole
        return np.concatenate([(1 - share) * younger + share * older, (older - younger) / self.dt], axis=-1)


@lru_cache(maxsize=64)
def delayed(f: ca.Function) -> ca.Function:
    """``f(x, u, w, p)`` with inputs ``[u, derivative by the delay]`` and parameters ``[p, change of the delay]``."""
    x, u, w, p = (ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(4))
    slope, change = ca.SX.sym("slope", u.shape[0]), ca.SX.sym("change")
    given = [x, ca.vertcat(u, slope), w, ca.vertcat(p, change)]
    return ca.Function("late", given, [f(x, u + change * slope, w, p)])
