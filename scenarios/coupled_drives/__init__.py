"""Coupled electric drives: a real belt drive whose speed is measured without its sign."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import OCP, BenchmarkBudget, BenchmarkSpec, Budget, DataSpec, Fault, Scenario, Task
from scenarios.common import LazyPrior
from scenarios.coupled_drives.plant import CoupledDrivesPlant

Array = NDArray[np.float64]

DESCRIPTION = """\
Two drives turn a pulley through a flexible belt on a spring. The input is the sum of the drives' voltages, the output
a counter of pulses: it does not see which way the pulley turns. Recordings: T. Wigren, M. Schoukens, Coupled electric
drives data set and reference models, Uppsala University, TR 2017-024: two with uniformly drawn inputs, the first 400
samples of which train and the last 100 judge, of which the first four are given; and three pseudo random ones. Loops
run on simulated drives with a belt that stiffens."""
REST = (0.25, 0.25, 0.0, 0.55)
"""Drives and pulley [V], acceleration [V/s] and reading [V] at about 1 V."""


def speeds(t: Array) -> Array:
    """Readings ``(n, 1)`` [V]: up, up to where the belt is damped most, down; each in 0.3 s."""
    times = [1.0, 1.3, 4.0, 4.3, 7.0, 7.3]
    return np.interp(t, times, [0.55, 1.5, 1.5, 3.0, 3.0, 0.8])[:, None]


def held(t: Array) -> Array:
    """A reading of 1.5 V ``(n, 1)``, from that at the start within 0.3 s."""
    return np.interp(t, [0.0, 0.3], [0.55, 1.5])[:, None]


def stop(t: Array) -> Array:
    """Down to a standstill, where the counter's slope is none, and on again ``(n, 1)`` [V]."""
    return np.interp(t, [1.0, 1.3, 3.0, 3.3], [0.55, 0.0, 0.0, 1.5])[:, None]


# 0.1 V of the reading, what a speed needs is free, 1 V a period; 0.8 s are four lags. Without a negative voltage the
# pulley never turns round, which nobody would see; the recordings go to 3 V.
CONTROL = OCP(40, q=(0.0,) * 4, r=(1e-3,), r_delta=(1.0,), u_min=(0.0,), u_max=(3.0,), q_y=(100.0,))

scenario = Scenario(
    name="coupled_drives",
    title="Coupled electric drives (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.coupled_drives.prior", "CoupledDrivesPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("u_v",),
        outputs=("speed",),
        dt=0.02,
        max_gap=0.05,
        smoothing=0.1,
        warm_up=0.06,  # the benchmark gives the first four samples
    ),
    plant=CoupledDrivesPlant,
    control=CONTROL,
    sensor_sigma=(0.01,),
    first_sigma=(0.2, 0.2, 2.0),
    # smoothed states jump where the counter does not tell which way the pulley turns; the machine's do not
    state_noise={"pulley": 0.002, "pulley_dot": 0.2, "counter": 0.02},
    safe_input=(0.0,),
    tasks=(
        Task("speeds", "Change the speed", 10.0, REST, speeds),
        Task("weak_drive", "Hold the speed although the drives give less", 10.0, REST, held,
             faults=(Fault(4.0, np.inf, "input_offset", -0.3),)),
        Task("standstill", "Stop, where the counter shows nothing of small speeds, and go on", 5.0, REST, stop),
    ),
    budgets={"quick": Budget(8, 4, 0, 200, seeds=2, decay=3000.0),
             "full": Budget(16, 4, 0, 1000, seeds=10, decay=3000.0)},
    benchmark=BenchmarkSpec(
        {"quick": BenchmarkBudget(8, 4, 0, 200, horizon=60, batch=16, decay=3000.0),
         "full": BenchmarkBudget(16, 4, 0, 1000, horizon=90, batch=16, decay=3000.0)},
        fractions=(0.75, 0.25, 0.0),
    ),
)  # fmt: skip
