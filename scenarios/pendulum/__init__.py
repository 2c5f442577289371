"""The damped pendulum of Schön, Götte and Timmermann (2022), in simulation: the paper's first system."""

from __future__ import annotations

from dataclasses import replace

from hybrid_mpc import DEFAULT_BUDGETS, DataSpec
from scenarios.common import LazyPrior, whole_windows
from scenarios.paper.experiment import PaperScenario
from scenarios.pendulum.data import DURATION, make_data, stems
from scenarios.pendulum.experiment import EXPERIMENT
from scenarios.pendulum.oracle import oracle
from scenarios.pendulum.plant import DampedPendulum
from scenarios.pendulum.tasks import CONTROL, TASKS

__all__ = ["scenario"]


scenario = PaperScenario(
    name="pendulum",
    title="Damped pendulum: a prior of the right form with wrong parameters",
    description=(
        "A mass of 50 kg at 45 mm from its axis, damped at 0.7 of critical, under a sinusoidal torque; phi = 0 "
        "hangs down. The prior is the paper's: 50 mm, and 5 % less damping. It is not fitted, here as there: with "
        "both free, a fit finds the plant itself, and no network could add to it."
    ),
    prior=LazyPrior("scenarios.pendulum.prior", "PublishedPendulumPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("u_nm",),
        outputs=("phi_rad",),
        dt=0.01,  # reason: docs/machines/simulated.md
        max_gap=0.005,
        smoothing=0.06,
        warm_up=0.1,
        windows=whole_windows(stems("full"), DURATION),
    ),
    make_data=make_data,
    plant=DampedPendulum,
    oracle=oracle,
    control=CONTROL,
    sensor_sigma=(1e-4,),
    first_sigma=(0.1,),
    safe_input=(0.0,),
    tasks=TASKS,
    experiment=EXPERIMENT,
    budgets={**DEFAULT_BUDGETS, "full": replace(DEFAULT_BUDGETS["full"], oracle_seeds=10)},
)
