"""Coupled electric drives: a real belt drive whose speed is measured without its sign."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, DataSpec, Scenario
from scenarios.common import LazyPrior

DESCRIPTION = """\
Two drives turn a pulley through a flexible belt on a spring. The input is the sum of the drives' voltages, the output
a counter of pulses: it does not see which way the pulley turns. Recordings: T. Wigren, M. Schoukens, Coupled electric
drives data set and reference models, Uppsala University, TR 2017-024: two with uniformly drawn inputs, the first 400
samples of which train and the last 100 judge, of which the first four are given; and three pseudo random ones."""


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
        fractions=(0.75, 0.25, 0.0),
    ),
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=0, free_run_steps=200, horizon=60, batch=16, decay=3000.0
            ),
            "full": BenchmarkBudget(
                16, 4, teacher_steps=0, free_run_steps=1000, horizon=90, batch=16, decay=3000.0
            ),
        },
    ),
)
