"""EMPS, an electro-mechanical positioning system: a real prismatic axis with friction and no gravity."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, DataSpec, Scenario
from scenarios.common import LazyPrior

DESCRIPTION = """\
A motor drives a carriage along a rail through a ball screw; recorded in closed loop at 1 kHz. The input is the motor's
force, the recorded voltage times 35.15065 N/V (`gtau` in the file). Recording: A. Janot, M. Gautier, M. Brunot, Data
Set and Reference Models of EMPS, Workshop on Nonlinear System Identification Benchmarks, 2019. Nothing pulls the
carriage back: an error of the force is integrated twice, and a free run tells how well friction is known."""

NEWTON_PER_VOLT = 35.15065188248547
"""``gtau`` of the file."""


scenario = Scenario(
    name="emps",
    title="Electro-mechanical positioning system (real recording)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.emps.prior", "EmpsPrior"),
    data=DataSpec(
        time="t",
        inputs=("vir",),
        outputs=("qm",),
        dt=0.01,
        max_gap=0.02,
        smoothing=0.05,
        # the benchmark gives the first 20 samples of 1 ms: of this grid those at 0 and 10 ms
        warm_up=0.01,
        # the recording repeats a motion of 6.2 s four times: the last one is the validation
        fractions=(0.75, 0.25, 0.0),
        units={"vir": NEWTON_PER_VOLT},
    ),
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=0, free_run_steps=150, horizon=150, batch=16, decay=3000.0
            ),
            "full": BenchmarkBudget(
                16, 4, teacher_steps=0, free_run_steps=800, horizon=400, batch=32, decay=3000.0
            ),
        },
        units={"q": ("mm", 1e3)},
    ),
)
