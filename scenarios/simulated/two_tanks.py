"""Two tanks, of which the upper one runs over: only the lower level is measured, and an inflow disturbs it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import hybrid_mpc as hm
from scenarios.simulated.plant import Experiment, SimulatedPlant, windows

Array = NDArray[np.float64]
GRAVITY = 9.81
PUMP, INFLOW, PIPE, AREA = 1.8e-4, 4e-5, 1.2e-4, 0.02
"""Flows of the operating point [m^3/s], clear width of a pipe [m^2], floor of a tank [m^2]."""
LEVELS = tuple((flow / PIPE) ** 2 / (2 * GRAVITY) for flow in (PUMP, PUMP + INFLOW))
"""Levels [m] of the prior's operating point."""
DT, SECONDS = 5.0, 2000.0


def outflow(pipe: Any, level: Any) -> Any:
    """What leaves a tank [m^3/s], by Torricelli; below 0.1 mm it stays as it is."""
    return pipe * ca.sqrt(2 * GRAVITY * ca.fmax(level, 1e-4))


class TwoTanksPrior(hm.Prior):
    """``area upper' = pump - outflow(upper)``, ``area lower' = outflow(upper) + inflow - outflow(lower)``."""

    states: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("upper", "m", 0.0, 2.0),
        hm.Signal("lower", "m", 0.0, 2.0),
    )
    inputs: ClassVar[tuple[hm.Signal, ...]] = (hm.Signal("pump", "m^3/s", 0.0, 4e-4),)
    disturbances: ClassVar[tuple[hm.Signal, ...]] = (hm.Signal("inflow", "m^3/s", 0.0, 2e-4),)
    outputs: ClassVar[tuple[hm.Signal, ...]] = (hm.Signal("lower", "m", -0.1, 2.0),)
    parameters: ClassVar[tuple[hm.Parameter, ...]] = (
        hm.Parameter("area", AREA, "m^2", AREA, AREA, "floor of a tank (fixed: by a ruler)"),
        hm.Parameter("pipe_upper", PIPE, "m^2", 6e-5, 2.4e-4, "clear width of the upper tank's pipe"),
        hm.Parameter("pipe_lower", PIPE, "m^2", 6e-5, 2.4e-4, "of the lower tank's"),
    )
    operating_point: ClassVar[hm.OperatingPoint] = hm.OperatingPoint(LEVELS, (PUMP,), (INFLOW,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of both levels [m/s]."""
        between, out = outflow(p.pipe_upper, x.upper), outflow(p.pipe_lower, x.lower)
        return (u.pump - between) / p.area, (between + w.inflow - out) / p.area

    def balances(self, x: Any, u: Any, w: Any, p: Any) -> tuple[hm.Balance, ...]:
        """Volume of water in both tanks."""
        volume, lost = p.area * (x.upper + x.lower), outflow(p.pipe_lower, x.lower)
        return (hm.Balance("volume", volume, u.pump + w.inflow, lost, "m^3", "m^3/s"),)


@dataclass(frozen=True)
class TwoTanks(SimulatedPlant):
    """Another floor, other pipes, and a weir: above its edge the upper tank runs over onto the floor."""

    area: float = 0.0208
    pipe_upper: float = 1.05e-4
    pipe_lower: float = 1.38e-4
    edge: float = 0.36
    weir: float = 0.02
    sigma: ClassVar[tuple[float, ...]] = (1e-3,)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((PUMP,), (INFLOW,))

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of both levels [m/s]."""
        between, out = outflow(p.pipe_upper, z[0]), outflow(p.pipe_lower, z[1])
        spilled = p.weir * ca.fmax(z[0] - p.edge, 0.0) ** 1.5  # a rectangular weir (Poleni)
        return (u[0] - between - spilled) / p.area, (between + w[0] - out) / p.area

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """The lower level [m]."""
        return (z[1],)


def signals(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pump and inflow in random steps."""
    pump = hm.random_steps(t, 4e-5, 3.6e-4, hold=(40.0, 250.0), rng=rng)
    return pump[:, None], hm.random_steps(t, 0.0, 8e-5, hold=(100.0, 500.0), rng=rng)[:, None]


EXPERIMENT = Experiment(
    "two_tanks",
    TwoTanks,
    ("time_s", "pump", "inflow", "lower_m"),
    DT,
    SECONDS,
    LEVELS,
    signals,
    ((0.0,), (4e-4,)),
)


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget."""
    return EXPERIMENT.write(folder, seed, budget)


def levels(t: Array) -> Array:
    """Set-points of the lower level ``(n, 1)`` [m]."""
    return np.interp(t, [100.0, 160.0, 500.0, 560.0], [LEVELS[1], 0.28, 0.28, 0.2])[:, None]


def still(t: Array) -> Array:
    """The operating point's level ``(n, 1)`` [m]."""
    return np.full((len(t), 1), LEVELS[1])


def rain(t: Array) -> Array:
    """A measured inflow ``(n, 1)`` [m^3/s] that doubles, then stops."""
    return np.interp(t, [200.0, 205.0, 500.0, 505.0], [INFLOW, 2 * INFLOW, 2 * INFLOW, 0.0])[:, None]


scenario = hm.Scenario(
    name="two_tanks",
    title="Two tanks: the upper level is not measured, and runs over (simulated)",
    description="A pump fills the upper of two tanks, which drains into the lower one; a measured inflow joins there. "
    "The prior knows pipes and floors; above 0.36 m the upper tank runs over, which it does not know.",
    prior=TwoTanksPrior,
    data=hm.DataSpec("time_s", ("pump",), ("lower_m",), dt=DT, max_gap=2 * DT, smoothing=40.0, warm_up=150.0,
                  disturbances=("inflow",), windows=windows(SECONDS), free_run=800.0),
    make_data=make_data,
    plant=TwoTanks,
    # 1 cm, half the pump, a tenth of it a period; 200 s are five time constants of a tank
    control=hm.OCP(40, q=(0.0, 0.0), r=(2.5e5,), r_delta=(6e8,), u_min=(0.0,), u_max=(4e-4,), q_y=(1e4,)),
    sensor_sigma=(1e-3,),
    first_sigma=(0.05,),
    safe_input=(0.0,),
    disturbance_model=(hm.Disturbance("input", "pump"),),
    tasks=(
        hm.Task("levels", "Change the lower level", 900.0, LEVELS, levels),
        hm.Task("leak", "Hold the level although the pump gives less", 900.0, LEVELS, still,
             faults=(hm.Fault(100.0, np.inf, "input_offset", -3e-5),)),
        hm.Task("rain", "Hold the level while the inflow changes", 900.0, LEVELS, still, w=rain),
    ),
)  # fmt: skip
