"""Two heaters that warm each other and radiate: two inputs, two temperatures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

import hybrid_mpc as hm
from scenarios.simulated.plant import Experiment, SimulatedPlant, windows

Array = NDArray[np.float64]
DT, SECONDS = 10.0, 4000.0
AMBIENT, KELVIN = 20.0, 273.15
CAPACITY, LOSS, BETWEEN = 40.0, (0.35, 0.25), 0.15
GAINS = ((1.0, 0.3), (0.25, 0.8))
HEAT = (8.0, 5.0)


def _rest() -> tuple[float, float]:
    loss = np.diag(LOSS) + BETWEEN * np.array([[1.0, -1.0], [-1.0, 1.0]])
    first, second = AMBIENT + np.linalg.solve(loss, np.array(GAINS) @ HEAT)
    return float(first), float(second)


REST = _rest()
"""Temperatures [degC] of the operating point."""


class TwoHeatersPrior(hm.Prior):
    """``C T_i' = sum_j g_ij Q_j - loss_i (T_i - ambient) - between (T_i - T_j)``; what a heater gives warms both."""

    states: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("T1", "degC", -20.0, 400.0), hm.Signal("T2", "degC", -20.0, 400.0),
    )  # fmt: skip
    inputs: ClassVar[tuple[hm.Signal, ...]] = (
        hm.Signal("Q1", "W", 0.0, 60.0),
        hm.Signal("Q2", "W", 0.0, 60.0),
    )
    outputs: ClassVar[tuple[hm.Signal, ...]] = states
    parameters: ClassVar[tuple[hm.Parameter, ...]] = (
        hm.Parameter("C", CAPACITY, "J/K", CAPACITY, CAPACITY, "heat capacity (fixed: only ratios show)"),
        hm.Parameter("g11", GAINS[0][0], "-", 0.5, 2.0, "share of heater 1 that warms place 1"),
        hm.Parameter("g12", GAINS[0][1], "-", 0.1, 0.9, "share of heater 2 that warms place 1"),
        hm.Parameter("g21", GAINS[1][0], "-", 0.1, 0.9, "share of heater 1 that warms place 2"),
        hm.Parameter("g22", GAINS[1][1], "-", 0.4, 1.6, "share of heater 2 that warms place 2"),
        hm.Parameter("loss1", LOSS[0], "W/K", 0.1, 1.5, "loss of place 1 to the room"),
        hm.Parameter("loss2", LOSS[1], "W/K", 0.1, 1.5, "loss of place 2 to the room"),
        hm.Parameter("between", BETWEEN, "W/K", 0.02, 0.6, "conduction between the places"),
    )
    operating_point: ClassVar[hm.OperatingPoint] = hm.OperatingPoint(REST, HEAT)

    def heat(self, u: Any, p: Any) -> tuple[Any, Any]:
        """Heat that reaches each place [W]."""
        return p.g11 * u.Q1 + p.g12 * u.Q2, p.g21 * u.Q1 + p.g22 * u.Q2

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of both temperatures [K/s]."""
        (first, second), swapped = self.heat(u, p), p.between * (x.T1 - x.T2)
        return (
            (first - p.loss1 * (x.T1 - AMBIENT) - swapped) / p.C,
            (second - p.loss2 * (x.T2 - AMBIENT) + swapped) / p.C,
        )

    def balances(self, x: Any, u: Any, w: Any, p: Any) -> tuple[hm.Balance, ...]:
        """Heat of both places; a room that is warmer heats them, so what they lose to it is a supply."""
        lost = p.loss1 * (x.T1 - AMBIENT) + p.loss2 * (x.T2 - AMBIENT)
        return (hm.Balance("heat", p.C * (x.T1 + x.T2), sum(self.heat(u, p)) - lost),)


@dataclass(frozen=True)
class TwoHeaters(SimulatedPlant):
    """Other numbers, and both places radiate: ``radiation (T^4 - ambient^4)``, absolute temperatures."""

    C: float = 46.0
    g11: float = 1.1
    g12: float = 0.26
    g21: float = 0.29
    g22: float = 0.9
    loss1: float = 0.3
    loss2: float = 0.21
    between: float = 0.13
    radiation: float = 2.5e-9
    sigma: ClassVar[tuple[float, ...]] = (0.2, 0.2)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = (HEAT, ())

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of both temperatures."""
        first, second = z
        swapped = p.between * (first - second)

        def lost(t: Any, loss: Any) -> Any:
            radiated = p.radiation * ((t + KELVIN) ** 4 - (AMBIENT + KELVIN) ** 4)
            return loss * (t - AMBIENT) + radiated

        return (
            (p.g11 * u[0] + p.g12 * u[1] - lost(first, p.loss1) - swapped) / p.C,
            (p.g21 * u[0] + p.g22 * u[1] - lost(second, p.loss2) + swapped) / p.C,
        )

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Both temperatures [degC]."""
        return z


def signals(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Both heaters in random steps."""
    heat = [hm.random_steps(t, 0.0, 60.0, hold=(60.0, 500.0), rng=rng) for _ in HEAT]
    return np.column_stack(heat), np.zeros((len(t), 0))


EXPERIMENT = Experiment(
    "two_heaters", TwoHeaters, ("time_s", "q1_w", "q2_w", "t1_degc", "t2_degc"), DT, SECONDS, (AMBIENT, AMBIENT),
    signals, ((0.0, 0.0), (60.0, 60.0)),
)  # fmt: skip


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget."""
    return EXPERIMENT.write(folder, seed, budget)


def warm(t: Array) -> Array:
    """Set-points ``(n, 2)`` [degC]: up, then one down."""
    first = np.interp(t, [200.0, 500.0], [REST[0], 110.0])
    second = np.interp(t, [200.0, 500.0, 1200.0, 1400.0], [REST[1], 100.0, 100.0, 80.0])
    return np.column_stack([first, second])


def steady(t: Array) -> Array:
    """The operating point ``(n, 2)``."""
    return np.tile(REST, (len(t), 1))


scenario = hm.Scenario(
    name="two_heaters",
    title="Two heaters that warm each other and radiate (simulated)",
    description="Two heaters, two temperatures, each heater warms both. The prior's losses are in proportion to the "
    "temperature; the machine also radiates, which is more than its prior knows when it is hot.",
    prior=TwoHeatersPrior,
    data=hm.DataSpec("time_s", ("q1_w", "q2_w"), ("t1_degc", "t2_degc"), dt=DT, max_gap=2 * DT, smoothing=80.0,
                  warm_up=150.0, windows=windows(SECONDS), free_run=1500.0),
    make_data=make_data,
    plant=TwoHeaters,
    # 1 K, the heat that a set-point needs is free, 15 W a period; 300 s are three time constants
    control=hm.OCP(30, q=(0.0, 0.0), r=(1e-4, 1e-4), r_delta=(4e-3, 4e-3), u_min=(0.0, 0.0), u_max=(60.0, 60.0),
                q_y=(1.0, 1.0)),
    sensor_sigma=(0.2, 0.2),
    safe_input=(0.0, 0.0),
    disturbance_model=(hm.Disturbance("input", "Q1"), hm.Disturbance("input", "Q2")),
    tasks=(
        hm.Task("warm", "Warm both places up, then cool one", 2000.0, REST, warm),
        hm.Task("draught", "Keep both temperatures although heater 1 gives less", 1500.0, REST, steady,
             faults=(hm.Fault(200.0, np.inf, "input_offset", -3.0, "Q1"),)),
    ),
)  # fmt: skip
