"""Double pendulum: a real chain of two links with a motor at each joint."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, Budget, DataSpec, Scenario
from scenarios.common import LazyPrior
from scenarios.double_pendulum.plant import DoublePendulumPlant
from scenarios.double_pendulum.tasks import DT, PENDUBOT, TASKS

DESCRIPTION = """\
Two links of 0.2 and 0.3 m, a quasi-direct drive (gear 6) at either joint; q1 = 0 hangs down, q2 counts from the first
link. Recordings: DFKI Robotics Innovation Center, double_pendulum, design C.1 (BSD-3-Clause; Wiebe et al. 2023): sines
of torque at 500 Hz, for identification; swing-ups of acrobot and pendubot at 33 Hz; balancing while torques push. The
input is the commanded torque; angles and speeds are measured, by the drives. The answer of a motor is stored a row
late, 2 ms at 500 Hz, 30 ms at 33 Hz. Near upright every error
grows fast, so runs are 0.5 s. Loops run in MuJoCo (the extra mujoco), with the torque at one joint (5 N m) and little
at the other (0.5 N m)."""
ROW = 0.002
"""Distance of two rows [s] of the recordings for identification."""
SLOW_ROW = 0.03
"""The same of the swing-ups [s]."""
LARGEST_DELAY = 2 * ROW
"""Longest delay [s] of the torques behind their commands that the prior's fit may find: the rows by which the measured
torque lags its command. The slow sines hardly tell it, and more of it would stand in for friction."""
MEASURED = ("q1_rad", "q2_rad", "dq1_rad_s", "dq2_rad_s")
SLOW = tuple(f"{robot}_swingup_{k:02d}" for robot in ("acrobot", "pendubot") for k in (1, 2, 3))


def draw(x: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Both links of the state ``x`` ``(4,)`` as one polyline ``(3, 2)`` [m] from the first joint."""
    turned = np.array([x[0], x[0] + x[1]])
    ends = np.array([[0.2], [0.3]]) * np.column_stack([np.sin(turned), -np.cos(turned)])
    return [np.vstack([np.zeros((1, 2)), np.cumsum(ends, axis=0)])]


scenario = Scenario(
    name="double_pendulum",
    title="Double pendulum with two torques (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.double_pendulum.prior", "DoublePendulumPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("tau1_command_nm", "tau2_command_nm"),
        outputs=MEASURED,
        dt=DT,
        max_gap=0.05,
        smoothing=0.06,
        warm_up=0.1,
        free_run=0.5,
        largest_delay=LARGEST_DELAY,
        delays=dict.fromkeys(MEASURED, ROW),
        delays_of={stem: dict.fromkeys(MEASURED, SLOW_ROW) for stem in SLOW},
    ),
    plant=DoublePendulumPlant,
    control=PENDUBOT,
    sensor_sigma=(3e-4, 3e-4, 0.08, 0.08),
    safe_input=(0.0, 0.0),
    tasks=TASKS,
    draw=draw,
    budgets={"quick": Budget(8, 4, 0, 150, seeds=2, decay=1000.0),
             "full": Budget(16, 4, 0, 1000, seeds=10, decay=1000.0)},
    beyond_recordings=True,  # those for identification hang; tasks stand
    benchmark=BenchmarkSpec(
        {"quick": BenchmarkBudget(8, 4, 0, 150, horizon=50, batch=32, decay=1000.0),
         "full": BenchmarkBudget(32, 4, 0, 1000, horizon=50, batch=32, decay=1000.0)},
        length=0.5,
        repeated=True,
        piece=1.0,
        valid_every=3,
        fractions=(0.75, 0.25, 0.0),
    ),
)  # fmt: skip
