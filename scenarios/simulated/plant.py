"""A simulated plant from its equations, and recordings of it. No torch in here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import Fault, Role, Window, check_plant_faults, write_csv
from scenarios.common import ROLES, sizes_of, whole_windows

Array = NDArray[np.float64]
TOLERANCE = 1e-8
"""Relative and absolute tolerance of the integration."""
SIZES: Mapping[str, Mapping[Role, int]] = {
    "quick": {"train": 4, "valid": 2, "test": 3},
    "full": {"train": 10, "valid": 4, "test": 6},
}
"""Recordings by budget and role."""


@dataclass(frozen=True)
class PlantState:
    """State of a plant: its own states ``z`` [SI], its time [s], and the inputs and disturbances that act."""

    z: Array
    t: float
    u: Array
    w: Array


@dataclass(frozen=True)
class SimulatedPlant:
    """A machine from its equations (a :class:`hybrid_mpc.loop.plant.Plant`).

    A subclass is a frozen dataclass whose numbers are its parameters. It writes :meth:`rates` and :meth:`outputs` in
    CasADi, with the parameters in ``p``; :meth:`start` and :meth:`shown` where it has more states than the model. It is
    integrated with steps of variable size and order (CVODES, BDF) to 1e-8, so jumps in slope cost steps, not accuracy.

    Args:
        faults: Faults of the machine: ``"plant_NAME"`` multiplies the parameter NAME. Default: none.
    """

    faults: tuple[Fault, ...] = ()
    sigma: ClassVar[tuple[float, ...]]
    """Standard deviations of the sensors ``(n_y,)``."""
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]]
    """Inputs ``(n_u,)`` and disturbances ``(n_w,)`` that act before the first period."""

    def rates(self, z: Sequence[Any], u: Sequence[Any], w: Sequence[Any], p: Any) -> Sequence[Any]:
        """Rates of the plant's own states."""
        raise NotImplementedError

    def outputs(self, z: Sequence[Any], u: Sequence[Any], w: Sequence[Any], p: Any) -> Sequence[Any]:
        """What the sensors show, without noise."""
        raise NotImplementedError

    def start(self, x: Array) -> Array:
        """The plant's own states at the model's states ``(n_x,)``. Default: the same."""
        return x

    def shown(self, z: Array) -> Array:
        """The model's states ``(n_x,)`` of the plant's own. Default: the same."""
        return z

    @property
    def parameters_of(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(f.name for f in fields(self) if f.name != "faults")

    def with_faults(self, faults: Sequence[Fault]) -> Self:
        """The plant with these faults; those that it does not know are refused."""
        check_plant_faults(faults, [f"plant_{name}" for name in self.parameters_of])
        return replace(self, faults=tuple(faults))

    def reset(self, x0: Array, seed: int) -> PlantState:
        """State at the model state ``x0`` ``(n_x,)``. Nothing inside is random, so ``seed`` changes nothing."""
        z = self.start(np.asarray(x0, dtype=np.float64))
        return PlantState(z, 0.0, *(np.array(v) for v in self.rest))

    def step(self, state: PlantState, u: Array, dt: float, w: Array | None = None) -> PlantState:
        """State after ``dt`` [s] with inputs ``u`` ``(n_u,)`` and disturbances ``w`` ``(n_w,)`` held."""
        w = np.zeros(0) if w is None else w
        step, _ = self._equations(len(state.z), len(u), len(w))
        given = np.concatenate([u, w, self._values(state.t), [dt]])
        z = step(x0=state.z, p=given)["xf"].full().ravel()
        return PlantState(z, state.t + dt, np.asarray(u, dtype=np.float64), np.asarray(w, dtype=np.float64))

    def measure(self, state: PlantState, rng: np.random.Generator) -> Array:
        """Measured outputs ``(n_y,)`` with white noise."""
        _, outputs = self._equations(len(state.z), len(state.u), len(state.w))
        y: Array = outputs(state.z, state.u, state.w, self._values(state.t)).full().ravel()
        return y + np.array(self.sigma) * rng.standard_normal(len(y))

    def truth(self, state: PlantState) -> Array:
        """True model states ``(n_x,)``."""
        return self.shown(state.z).copy()

    def hidden(self, state: PlantState) -> Array:
        """Nothing: there is no oracle."""
        return np.zeros(0)

    def _equations(self, n_z: int, n_u: int, n_w: int) -> tuple[ca.Function, ca.Function]:
        kind: Any = type(self)  # one for all of a class: parameters are arguments
        return equations(kind, n_z, n_u, n_w)

    def _values(self, t: float) -> Array:
        """Parameters at the time ``t`` [s], with the faults that act."""
        values = {name: float(getattr(self, name)) for name in self.parameters_of}
        for fault in self.faults:
            if fault.active(t):
                values[fault.target.removeprefix("plant_")] *= fault.value_at(t, 1.0)
        return np.array(list(values.values()))


@cache
def equations(kind: type[SimulatedPlant], n_z: int, n_u: int, n_w: int) -> tuple[ca.Function, ca.Function]:
    """Integrator ``(x0, p) -> xf`` of a plant over a time, and its outputs ``(z, u, w, parameters)``."""
    plant = kind()
    names = plant.parameters_of
    z, u, w = ca.SX.sym("z", n_z), ca.SX.sym("u", n_u), ca.SX.sym("w", n_w)
    p, dt = ca.SX.sym("p", len(names)), ca.SX.sym("dt")
    values = SimpleNamespace(**dict(zip(names, ca.vertsplit(p), strict=True)))
    zs, us, ws = (ca.vertsplit(v) if v.numel() else [] for v in (z, u, w))
    rates = ca.vertcat(*plant.rates(zs, us, ws, values))
    ode = {"x": z, "p": ca.vertcat(u, w, p, dt), "ode": dt * rates}
    options = {"abstol": TOLERANCE, "reltol": TOLERANCE, "max_num_steps": 100000}
    step = ca.integrator("step", "cvodes", ode, 0.0, 1.0, options)
    y = ca.vertcat(*plant.outputs(zs, us, ws, values))
    return step, ca.Function("outputs", [z, u, w, p], [y])


@dataclass(frozen=True)
class Experiment:
    """How a simulated machine records itself.

    Args:
        name: Name of the machine.
        plant: The machine.
        columns: Names of the columns: time, inputs, disturbances, outputs.
        dt: Period [s].
        seconds: Length [s] of a recording.
        x0: First state ``(n_x,)``.
        signals: ``(t, rng) -> (u (n, n_u), w (n, n_w))``: what excites the machine, held over each period.
        feedback: ``y (n_y,) -> (n_u,)``, what a simple controller adds to the inputs of a machine that would run
            away. Default: nothing.
        limits: Smallest and largest inputs ``(n_u,)`` each.
    """

    name: str
    plant: Callable[[], SimulatedPlant]
    columns: tuple[str, ...]
    dt: float
    seconds: float
    x0: tuple[float, ...]
    signals: Callable[[Array, np.random.Generator], tuple[Array, Array]]
    limits: tuple[tuple[float, ...], tuple[float, ...]]
    feedback: Callable[[Array], Array] | None = None

    def table(self, role: Role, number: int, seed: int) -> Array:
        """One recording ``(n, columns)``: random excitation, noisy measurements."""
        rng = np.random.default_rng((seed, ROLES.index(role), number))
        t = self.dt * np.arange(round(self.seconds / self.dt) + 1, dtype=np.float64)
        inputs, surroundings = self.signals(t, rng)
        plant, rows = self.plant(), []
        state = plant.reset(np.array(self.x0), seed)
        for now, u, w in zip(t, inputs, surroundings, strict=True):
            state = replace(state, w=w)
            y = plant.measure(state, rng)
            u = np.clip(u if self.feedback is None else u + self.feedback(y), *self.limits)
            rows.append(np.concatenate([[now], u, w, y]))
            state = plant.step(state, u, self.dt, w)
        return np.array(rows)

    def write(self, folder: Path, seed: int, budget: str) -> list[Path]:
        """Write the recordings of a budget as CSV files; their names begin with their role."""
        sizes, files = sizes_of(self.name, budget, SIZES), []
        for role in ROLES:
            for k in range(1, sizes[role] + 1):
                columns = dict(zip(self.columns, self.table(role, k, seed).T, strict=True))
                files.append(write_csv(folder / f"{role}_{k:02d}.csv", columns))
        return files


def windows(seconds: float) -> Mapping[str, tuple[Window, ...]]:
    """Windows of all recordings, each of one role and of this length [s]."""
    stems = [f"{role}_{k:02d}" for role in ROLES for k in range(1, SIZES["full"][role] + 1)]
    return whole_windows(stems, seconds)
