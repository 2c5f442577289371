"""Model race car: a real F1TENTH in slow manoeuvres, commanded by steering and speed."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, Budget, DataSpec, Scenario
from scenarios.common import LazyPrior
from scenarios.race_car.plant import RaceCarPlant
from scenarios.race_car.tasks import CONTROL, TASKS

DESCRIPTION = """\
A car of a tenth of the size drives slowly (up to 0.4 m/s) with commanded steering and speed; position, heading and
speed are measured. Recordings: N. Kochdumper, S. Bak, model race car data of AutoKoopman (2022, CC0-1.0): 31 runs of
3 s at 40 Hz. The first row of inputs is zero in every file: it alone acts
within what is given at a run's start. Loops run on a simulated car whose tyres slip; speeds beyond 0.4 m/s are
extrapolation."""


scenario = Scenario(
    name="race_car",
    title="Model race car (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.race_car.prior", "RaceCarPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("steering_rad", "speed_command_m_s"),
        outputs=("x_m", "y_m", "heading_rad", "speed_m_s"),
        dt=0.025,
        max_gap=0.06,
        smoothing=0.1,
        warm_up=0.025,  # two samples at rest: a run of 3 s is to be judged as a whole
    ),
    plant=RaceCarPlant,
    control=CONTROL,
    sensor_sigma=(0.003, 0.003, 0.003, 0.01),
    first_sigma=(0.05,),
    safe_input=(0.0, 0.0),
    tasks=TASKS,
    budgets={"quick": Budget(8, 4, 0, 150, seeds=2, decay=3000.0),
             "full": Budget(16, 4, 0, 1000, seeds=10, decay=3000.0)},
    beyond_recordings=True,
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=0, free_run_steps=150, horizon=100, batch=16, decay=3000.0
            ),
            "full": BenchmarkBudget(
                16, 4, teacher_steps=0, free_run_steps=1000, horizon=115, batch=16, decay=3000.0
            ),
        },
        units={"x": ("mm", 1e3), "y": ("mm", 1e3)},
        valid_every=4,
        fractions=(0.75, 0.25, 0.0),
    ),
)  # fmt: skip
