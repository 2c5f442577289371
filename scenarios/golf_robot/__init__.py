"""The golf robot of Schön, Götte and Timmermann (2022), in simulation: a rig with dry friction."""

from __future__ import annotations

from dataclasses import replace

from hybrid_mpc import DEFAULT_BUDGETS
from scenarios.common import LazyPrior
from scenarios.golf_robot.data import make_data
from scenarios.golf_robot.drawing import draw
from scenarios.golf_robot.experiment import DATA, EXPERIMENT
from scenarios.golf_robot.faults import CAUSES
from scenarios.golf_robot.oracle import oracle
from scenarios.golf_robot.rig import Rig
from scenarios.golf_robot.strokes import figures
from scenarios.golf_robot.tasks import CONTROL, QUICK_TASKS, TASKS
from scenarios.paper.experiment import PaperScenario

__all__ = ["scenario"]


scenario = PaperScenario(
    name="golf_robot",
    title="Golf robot: a club on a belt drive with load-dependent dry friction",
    description=(
        "A motor swings a golf club through a belt (ratio 4). The prior is the paper's equation; the rig "
        "has dynamic friction with stiction and Stribeck effect, another friction forwards than backwards, "
        "a soft belt with backlash, torque lag, cogging, drag and parameters some per cent off. Only the "
        "club's angle is measured. The data are simulated, since the paper's are not public."
    ),
    prior=LazyPrior("scenarios.golf_robot.prior", "GolfRobotPrior"),
    data=DATA,
    make_data=make_data,
    plant=Rig,
    oracle=oracle,
    control=CONTROL,
    sensor_sigma=(0.5e-3,),  # the encoder's quantisation (0.44 mrad) and noise
    first_sigma=(0.1,),
    safe_input=(0.0,),
    tasks=TASKS,
    draw=draw,
    figures=figures,
    experiment=EXPERIMENT,
    causes=CAUSES,
    budgets={
        "quick": replace(DEFAULT_BUDGETS["quick"], seeds=6, tasks=QUICK_TASKS),  # two seeds bound no mean
        "full": replace(DEFAULT_BUDGETS["full"], oracle_seeds=10),
    },
)
