"""Temperature lab: two real heaters that warm each other, two sensors that lag behind them."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, DataSpec, Scenario
from scenarios.common import LazyPrior

DESCRIPTION = """\
Two transistor heaters and two thermistors on one board, coupled by conduction and radiation. Recordings: a real TCLab,
S. Kuntz, J. Rawlings, Maximum likelihood identification of uncertain models (2024; rawlings-group/mlid_2024, MIT): one
in open loop with power in steps of 300 s, for identification; closed loops with steps of the set-point, and with known
faults. The heaters' own temperatures and the room's are not measured. A run is judged over 600 s."""


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
        fractions=(0.75, 0.25, 0.0),
        free_run=600.0,
    ),
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
    ),
)
