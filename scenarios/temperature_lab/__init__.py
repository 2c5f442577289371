"""Temperature lab: two real heaters that warm each other, two sensors that lag behind them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import (
    OCP,
    BenchmarkBudget,
    BenchmarkSpec,
    Budget,
    DataSpec,
    Disturbance,
    Fault,
    Scenario,
    Task,
)  # fmt: skip
from scenarios.common import LazyPrior
from scenarios.temperature_lab.plant import TemperatureLabPlant

Array = NDArray[np.float64]

DESCRIPTION = """\
Two transistor heaters and two thermistors on one board, coupled by conduction and radiation. Recordings: a real TCLab,
S. Kuntz, J. Rawlings, Maximum likelihood identification of uncertain models (2024; rawlings-group/mlid_2024, MIT): one
in open loop with power in steps of 300 s, for identification; closed loops with steps of the set-point, and with known
faults. The heaters' own temperatures and the room's are not measured. A run is judged over 600 s. Loops run on a
simulated lab that radiates."""
REST = (43.5, 36.0, 43.5, 36.0, 24.0)
"""Temperatures [degC] of the prior's operating point."""


def set_points(t: Array) -> Array:
    """Set-points ``(n, 2)`` [degC] in steps of 60 s: one up, the other up, the first down."""
    first = np.interp(t, [200.0, 260.0, 1400.0, 1460.0], [REST[2], 55.0, 55.0, 48.0])
    return np.column_stack([first, np.interp(t, [800.0, 860.0], [REST[3], 46.0])])


def held(t: Array) -> Array:
    """The operating point ``(n, 2)`` [degC]."""
    return np.tile(REST[2:4], (len(t), 1))


scenario = Scenario(
    name="temperature_lab",
    title="Temperature lab: two heaters, two temperatures (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.temperature_lab.prior", "TemperatureLabPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("heater1_pct", "heater2_pct"),
        outputs=("temperature1_degc", "temperature2_degc"),
        dt=10.0,
        max_gap=5.0,
        smoothing=60.0,
        warm_up=200.0,  # long enough to tell the room's temperature from that of the heaters
        free_run=600.0,
    ),
    plant=TemperatureLabPlant,
    # 1 K, the power that a set-point needs is free, 20 % a period; 400 s are some four time constants. The transistors,
    # which are not measured, are to stay below 80 degC.
    control=OCP(40, q=(0.0,) * 5, r=(1e-4, 1e-4), r_delta=(2.5e-3, 2.5e-3), u_min=(0.0, 0.0), u_max=(100.0, 100.0),
                x_max=(80.0, 80.0, np.inf, np.inf, np.inf), q_y=(1.0, 1.0)),
    sensor_sigma=(0.08, 0.08),
    first_sigma=(5.0, 5.0, 3.0),
    safe_input=(0.0, 0.0),
    disturbance_model=(Disturbance("input", "power1"), Disturbance("input", "power2")),
    tasks=(
        Task("set_points", "Warm both places up, then cool one", 2000.0, REST, set_points),
        Task("weak_heater", "Hold both temperatures although heater 1 gives less", 2000.0, REST, held,
             faults=(Fault(300.0, np.inf, "input_offset", -10.0, "power1"),)),
    ),
    budgets={"quick": Budget(8, 4, 0, 100, seeds=2, decay=3000.0),
             "full": Budget(16, 4, 0, 800, seeds=10, decay=3000.0)},
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=0, free_run_steps=100, horizon=60, batch=16, decay=3000.0
            ),
            "full": BenchmarkBudget(
                16, 4, teacher_steps=0, free_run_steps=800, horizon=60, batch=16, decay=3000.0
            ),
        },
        units=dict.fromkeys(("temperature1", "temperature2"), ("K", 1.0)),
        length=600.0,
        repeated=True,
        piece=900.0,
        fractions=(0.75, 0.25, 0.0),
    ),
)  # fmt: skip
