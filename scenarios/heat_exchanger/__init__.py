"""Plate heat exchanger: a real process with a measured disturbance and a bias from day to day."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, Budget, DataSpec, Disturbance, Scenario
from scenarios.common import LazyPrior
from scenarios.heat_exchanger.plant import HeatExchangerPlant
from scenarios.heat_exchanger.tasks import CONTROL, TASKS

DESCRIPTION = """\
Hot water from a reservoir warms cold water in a plate heat exchanger; a valve sets how much. The reservoir's thermostat
makes a saw-tooth, which is measured; flows and the cold water's temperature are not, and differ between days.
Recordings: University of Ljubljana, M. Ožbot, E. Lughofer, I. Škrjanc 2023 (10.1109/TFUZZ.2022.3216992; MIT): random
steps of the valve, for identification, staircases of two other days, and a day on which the reservoir's heater fails.
Runs of 300 s start from a state that the 240 s before tell. Loops run on a simulated exchanger."""
LARGEST_DELAY = 40.0
"""Longest time [s] from the valve's command to the outlet that is looked for."""

scenario = Scenario(
    name="heat_exchanger",
    title="Plate heat exchanger (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.heat_exchanger.prior", "HeatExchangerPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("valve",),
        outputs=("outlet_degc",),
        disturbances=("reservoir_degc",),
        dt=4.0,
        max_gap=12.0,
        smoothing=40.0,
        warm_up=240.0,
        free_run=300.0,
        largest_delay=LARGEST_DELAY,
    ),
    plant=HeatExchangerPlant,
    control=CONTROL,
    sensor_sigma=(0.065,),
    first_sigma=(3.0,),
    state_noise={"cold": 0.02},  # 0.6 K in an hour; by the recordings, whose every lag goes there, 0.7 K in 4 s
    safe_input=(0.0,),
    disturbance_model=(Disturbance("output", "outlet", 5.0),),
    tasks=TASKS,
    budgets={"quick": Budget(8, 4, 0, 150, seeds=2, decay=3000.0),
             "full": Budget(16, 4, 0, 1000, seeds=10, decay=3000.0)},
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=0, free_run_steps=150, horizon=75, batch=32, decay=3000.0
            ),
            "full": BenchmarkBudget(
                16, 4, teacher_steps=0, free_run_steps=1000, horizon=75, batch=32, decay=3000.0
            ),
        },
        units={"outlet": ("K", 1.0)},
        length=300.0,
        repeated=True,
        piece=700.0,
        fractions=(0.75, 0.25, 0.0),
    ),
)  # fmt: skip
